"""Publishes the speed fraction over LCM, without a change of the project.

A system of one's own is added by `prebuild`, just before the Diagram is built.
Run it with `python examples/publish_fraction.py`; any LCM tool can listen to
the channel SPEED_FRACTION.
"""

import struct

from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.workcell import make_workcell


class FractionPublisher(LeafSystem):
    """Sends time, s, and speed fraction as two doubles."""

    def __init__(self, lcm, channel="SPEED_FRACTION", period=0.04):
        super().__init__()
        self._lcm, self._channel = lcm, channel
        self._fraction = self.DeclareVectorInputPort("speed_fraction", 1)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)

    def _publish(self, context):
        values = context.get_time(), self._fraction.Eval(context)[0]
        self._lcm.Publish(self._channel, struct.pack(">dd", *values))


def run(duration=5.0, lcm=None):
    """Runs the default cell; returns what is in force at its end."""
    lcm = lcm or DrakeLcm()

    def prebuild(builder, station, monitor):
        publisher = builder.AddSystem(FractionPublisher(lcm))
        builder.Connect(
            monitor.GetOutputPort("speed_fraction"),
            publisher.GetInputPort("speed_fraction"),
        )

    workcell = make_workcell(load_scenario(), prebuild=prebuild)
    simulator = Simulator(workcell.diagram, workcell.make_context(0))
    simulator.AdvanceTo(duration)
    return workcell.diagram.GetOutputPort("speed_fraction").Eval(
        simulator.get_context()
    )[0]


if __name__ == "__main__":
    print(f"speed fraction {run():.2f}")
