"""The monitor alone, in front of rings that a test plays."""

import dataclasses as dc

import numpy as np
from paper_cell import RINGS
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context

from tofssm_drake.messages import RingScan

TICK = 0.008
PERIOD = 0.024
LATENCY = 0.015

VALID, SIGNAL_FAIL, HARDWARE_FAIL = 0, 2, 5


@dc.dataclass(frozen=True, kw_only=True)
class Moment:
    """Where a rig was, to go back to."""

    context: Context
    tick: int
    rings: dict[str, tuple]
    """What each ring has delivered, and is about to."""


class Rig:
    """A monitor whose rings see nothing until a test says otherwise."""

    def __init__(self, monitor, q):
        self.monitor = monitor
        self.simulator = Simulator(monitor)
        self.context = self.simulator.get_mutable_context()
        for name, value in (
            ("position_measured", q),
            ("velocity_measured", np.zeros(6)),
            ("carried_objects", np.zeros(10)),
        ):
            self.monitor.GetInputPort(name).FixValue(self.context, value)
        self.scans = {
            ring: self.monitor.GetInputPort(f"scan_{ring}").FixValue(
                self.context, RingScan()
            )
            for ring in RINGS
        }
        self.sequence = dict.fromkeys(RINGS, -1)
        self.silent = set()
        self.readings = dict.fromkeys(RINGS, (SIGNAL_FAIL, 4.0))
        # How old each sensor's sample is at its delivery, s.
        self.ages = dict.fromkeys(RINGS, LATENCY)
        self.simulator.Initialize()
        self.tick = 0

    def deliver(self, ring, age=None):
        """Delivers a scan; `age` overrides the age of its samples."""
        age = self.ages[ring] if age is None else age
        self.sequence[ring] += 1
        status, distance = self.readings[ring]
        time = self.tick * TICK
        self.scans[ring].GetMutableData().set_value(
            RingScan(
                sequence=self.sequence[ring],
                time=time - np.min(age) + LATENCY,
                sensor_time=time - np.broadcast_to(age, 8),
                distance=np.broadcast_to(distance, 8).astype(float),
                status=np.broadcast_to(status, 8).astype(np.uint8),
            )
        )

    def run(self, duration):
        """Advances; returns rows of (time, psi, rho)."""
        rows = []
        for _ in range(round(duration / TICK)):
            if self.is_due:
                for ring in RINGS:
                    if ring not in self.silent:
                        self.deliver(ring)
            self.tick += 1
            self.simulator.AdvanceTo(self.tick * TICK)
            rows.append((self.tick * TICK, self.state, self.rho))
        return np.array(rows)

    def save(self):
        """Returns the present moment."""
        return Moment(
            context=self.context.Clone(),
            tick=self.tick,
            rings={
                ring: (
                    self.scans[ring].GetMutableData().get_value(),
                    self.sequence[ring],
                    self.readings[ring],
                    self.ages[ring],
                )
                for ring in RINGS
            },
        )

    def restore(self, moment):
        """Goes back to a moment; what follows is the same, bit by bit."""
        self.context.SetTimeStateAndParametersFrom(moment.context)
        self.tick = moment.tick
        for ring, (scan, sequence, readings, age) in moment.rings.items():
            self.scans[ring].GetMutableData().set_value(scan)
            self.sequence[ring] = sequence
            self.readings[ring] = readings
            self.ages[ring] = age
        self.simulator.Initialize(
            InitializeParams(suppress_initialization_events=True)
        )

    def eval(self, name):
        return self.monitor.GetOutputPort(name).Eval(self.context)

    @property
    def decision(self):
        return self.eval("decision")

    @property
    def is_due(self):
        """Whether the rings deliver at this tick."""
        return self.tick % round(PERIOD / TICK) == 0

    @property
    def state(self):
        return self.decision.robot_state

    @property
    def rho(self):
        return self.eval("speed_fraction")[0]
