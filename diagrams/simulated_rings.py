"""Rings in a simulated world around a robot that runs elsewhere."""

from collections.abc import Callable, Iterator, Sequence
import heapq
import itertools
from typing import Protocol

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.drivers import find_real_cell
from tofssm_drake.diagrams.ring_world import make_ring_world
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.ringlink.ring_device import DeviceClock, make_frame
from tofssm_drake.ringlink.ring_fault_injection import FaultInjector, RingFault
from tofssm_drake.ringlink.ring_frame import RingFrame
from tofssm_drake.robots.driver import ProgressReport

# Longest extrapolation of the robot's motion from its last report, s: slightly
# more than two of its control cycles; and backwards, if a busy computer wakes
# up late and the report is newer than needed.
_CARRY_ON = 0.02
_CARRY_BACK = 0.1

# An event happens only once its time has passed.
_PAST = 1e-6


class Report(ProgressReport, Protocol):
    """What is needed from a robot's report."""

    @property
    def sequence(self) -> int:
        """-1: none yet."""

    @property
    def time(self) -> float:
        """Host's time of its arrival, s."""

    @property
    def position(self) -> np.ndarray:
        """Joints, rad, (n,)."""

    @property
    def velocity(self) -> np.ndarray:
        """Joint speeds, rad/s, (n,)."""


def carry_on(report: Report, now: float) -> np.ndarray:
    """Returns the joints shortly after or before a report, rad, (n,).

    Args:
        report: The newest.
        now: Host's time of interest, s.
    """
    age = min(max(now - report.time, -_CARRY_BACK), _CARRY_ON)
    return report.position + age * report.velocity


def iterate_wake_times(scenario: Scenario) -> Iterator[float]:
    """Yields the times of samples and of scans to send, s.

    Args:
        scenario: Checked settings.
    """
    times = {
        (ring.phase or traits.period, traits.period, latency)
        for ring in find_rings(scenario.sensors).values()
        for traits in [ring.sensor.traits]
        for latency in (0.0, traits.latency)
    }
    return heapq.merge(
        *(
            _iterate_times(first + latency, period)
            for first, period, latency in sorted(times)
        )
    )


def _iterate_times(first, period):
    return (first + k * period + _PAST for k in itertools.count())


class SimulatedRings:
    """Rings that look at a robot posed from its reports.

    Attributes:
        sent: Number of frames sent of each ring.
    """

    def __init__(
        self,
        *,
        scenario: Scenario,
        ring_numbers: Sequence[int] = (),
        clocks: Sequence[DeviceClock] | None = None,
        faults: Sequence[RingFault] = (),
        send: Callable[[RingFrame, bool], bool],
    ):
        """Makes the world.

        Args:
            scenario: Checked settings; uses rings, person, task and seed.
            ring_numbers: Numbers of the rings in the frames; none: 0, 1, 2, ...
            clocks: Of the rings' devices; None: they show the world's time.
            faults: Faults to inject; their times are the world's.
            send: Called with each frame and whether to damage it on the way;
                returns whether it left.
        """
        self._rings = find_rings(scenario.sensors)
        self._ring_numbers = ring_numbers or range(len(self._rings))
        self._driver = find_real_cell(scenario.driver)
        self._clocks = clocks or [DeviceClock()] * len(self._rings)
        self._injectors = [
            FaultInjector(f for f in faults if f.ring == ring)
            for ring in self._rings
        ]
        self._send = send
        kinematics = ArmKinematics.from_plant(
            make_cell_plant(arm=scenario.robot)
        )
        self._path = make_task_path(scenario.task, kinematics, scenario.robot)
        self._diagram = make_ring_world(scenario)
        context = self._diagram.CreateDefaultContext()
        self._diagram.SetRandomContext(
            context, RandomGenerator(scenario.random_seed)
        )
        self._compile(context.Clone())
        self._simulator = Simulator(self._diagram, context)
        self._context = self._simulator.get_mutable_context()
        self._sequence = [-1] * len(self._rings)
        self.sent = dict.fromkeys(self._rings, 0)

    def _compile(self, context):
        """Runs two periods so that kernels are compiled."""
        for name in ("position_measured", "carried_objects"):
            port = self._diagram.GetInputPort(name)
            port.FixValue(context, np.zeros(port.size()))
        Simulator(self._diagram, context).AdvanceTo(
            2.0
            * max(ring.sensor.traits.period for ring in self._rings.values())
        )

    def advance(self, time: float, report: Report, now: float) -> None:
        """Advances the world, and sends the frames that the rings deliver.

        Args:
            time: World's time, s, never decreasing.
            report: The robot's newest; there must be one.
            now: Host's time at the world's time, s.
        """
        carried = self._driver.find_carried_objects(report, self._path)
        for name, value in (
            ("position_measured", carry_on(report, now)),
            ("carried_objects", carried),
        ):
            self._diagram.GetInputPort(name).FixValue(self._context, value)
        self._simulator.AdvanceTo(time)
        for i, (ring, config) in enumerate(self._rings.items()):
            scan = self._diagram.GetOutputPort(f"scan_{ring}").Eval(
                self._context
            )
            if scan.sequence == self._sequence[i]:
                continue
            self._sequence[i] = scan.sequence
            frame = make_frame(
                scan,
                ring=self._ring_numbers[i],
                timing_budget=config.sensor.traits.integration_time,
                period=config.sensor.traits.period,
                clock=self._clocks[i],
            )
            self._injectors[i].put(frame, scan.time)
        self._deliver(time)

    def _deliver(self, time):
        """Sends the frames that are due."""
        for ring, injector in zip(self._rings, self._injectors, strict=True):
            for delivery in injector.take(time):
                if self._send(delivery.frame, delivery.is_damaged):
                    self.sent[ring] += 1
