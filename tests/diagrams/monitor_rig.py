"""The monitor alone, in front of rings that a test plays."""

import numpy as np
from paper_cell import RINGS
from pydrake.systems.analysis import Simulator

from tofssm_drake.messages import RingScan

TICK = 0.008
PERIOD = 0.024
LATENCY = 0.015

VALID, SIGNAL_FAIL, HARDWARE_FAIL = 0, 2, 5


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
