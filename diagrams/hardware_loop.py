"""Runs the monitor on a real robot's reports, one tick per report."""

from collections.abc import Callable
import dataclasses as dc
import functools
import math
import time

import numpy as np
from pydrake.systems.framework import Context

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.hardware_station import (
    make_hardware_station,
    make_slider_config,
)
from tofssm_drake.diagrams.held_connections import HeldRings, HeldRobot
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.diagrams.simulation import make_simulator
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.diagrams.viewer import add_frame_sender
from tofssm_drake.diagrams.workcell import Workcell, make_workcell
from tofssm_drake.messages import (
    Frame,
    RingHealth,
    RingScan,
    RobotReport,
    RobotState,
    Separation,
    SpeedDecision,
)
from tofssm_drake.rtde.slider import (
    SliderConfig,
    SliderPhase,
    SliderState,
)
from tofssm_drake.visualization.health_board import (
    BLIND,
    FAULT,
    HELD,
    OK,
)

# How many periods of virtual rings, or of made-up scans, a warm-up takes.
_WARM_UP = 3


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TickInput:
    """All input of a tick."""

    time: float
    """Diagram's time, s, never decreasing."""
    report: RobotReport
    scans: tuple[RingScan, ...] = ()
    """Newest scan of each ring on the host's clock; none of virtual rings."""
    clock_offset: float = 0.0
    """Diagram's minus host's clock, s."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TickResult:
    """Result of a tick."""

    time: float
    """Diagram's time, s."""
    decision: SpeedDecision
    problem: str
    """Why the sensing is not fresh and healthy; empty: it is."""
    speed_fraction: float
    slider: SliderState
    separation: Separation
    products_placed: int
    task_done: bool
    sent: float
    """Host's time at which the command was handed over, s; NaN: it was not."""

    @property
    def robot_state(self) -> RobotState:
        """What the law's target amounts to."""
        return self.decision.robot_state

    @property
    def reason(self) -> str:
        """The law's reason, in one line."""
        return self.decision.reason

    @property
    def health(self) -> str:
        """Why the robot is not at full speed, in one line.

        The law's reason and the slider's; empty: it is.
        """
        reasons = [self.slider.reason]
        if self.robot_state != RobotState.NORMAL:
            reasons.insert(0, self.reason)
        return "; ".join(filter(None, reasons))


def describe_links(result: TickResult, *, deadline: float) -> dict[str, str]:
    """Returns the health of rings and robot, as `HealthBoard` shows it.

    Args:
        result: Of the newest tick.
        deadline: Greatest age of a sample for the law, s.
    """
    separation = result.separation
    status = {}
    for i, ring in enumerate(separation.name):
        health = separation.health[i]
        is_fresh = abs(result.time - separation.time[i]) <= deadline
        if separation.sequence[i] < 0 or not is_fresh:
            status[ring] = FAULT
        elif health == RingHealth.BLIND:
            status[ring] = BLIND
        else:
            status[ring] = OK if health == RingHealth.HEALTHY else FAULT
    if result.slider.phase == SliderPhase.FAULT:
        status["robot"] = FAULT
    elif result.slider.phase in (SliderPhase.FOLLOWING, SliderPhase.RISING):
        status["robot"] = OK
    else:
        status["robot"] = HELD
    return status


class HardwareLoop:
    """The monitor in a loop with a station whose data are handed in.

    Args:
        scenario: Checked settings; rings on the arm.
        virtual_rings: Simulate the rings in the twin.
        send: Takes the commands; None drops them.
        slider: Settings of the slider; None: the scenario's.
        show: Takes what a viewer draws, 16 times a second; it must neither
            raise nor block. None shows nothing.
        with_samples: Keep samples for a report; they grow with the run.
    """

    def __init__(
        self,
        *,
        scenario: Scenario,
        virtual_rings: bool,
        send=None,
        slider: SliderConfig | None = None,
        show: Callable[[Frame], None] | None = None,
        with_samples: bool = False,
    ):
        self._scenario = scenario
        self._sending = False
        self._send = send
        self._newest: TickResult | None = None
        law = scenario.law.traits
        self._deadline = law.deadline
        slider = make_slider_config(scenario) if slider is None else slider
        self._station = make_hardware_station(
            scenario,
            robot=HeldRobot(self._send_if_live),
            rings=(
                None
                if virtual_rings
                else HeldRings(tuple(find_rings(scenario.sensors)))
            ),
            slider=dc.replace(slider, reduced_fraction=law.reduced_fraction),
        )
        self._workcell = make_workcell(
            scenario,
            station=self._station,
            prebuild=show and functools.partial(self._show_frames, show),
            with_samples=with_samples,
        )
        self._publisher = self._station.diagram.GetSubsystemByName(
            "robot_publisher"
        )
        self._sent = math.nan
        self._has_begun = False
        self._begin(random_seed=0)
        self._warm_up()
        self._begin(random_seed=scenario.random_seed)
        self._sending = True

    @property
    def workcell(self) -> Workcell:
        """Station, monitor and record."""
        return self._workcell

    @property
    def context(self) -> Context:
        """The workcell's Context after the last tick."""
        return self._context

    def tick(self, given: TickInput) -> TickResult:
        """Takes a report, computes, and sends the command.

        Args:
            given: The new input.

        Returns:
            The monitor's results and what was sent.
        """
        self._station.robot.report = given.report
        if self._station.rings is not None:
            self._station.rings.take(
                given.scans, clock_offset=given.clock_offset
            )
        self._sent = math.nan
        if not self._has_begun:
            self._simulator.Initialize()
            self._has_begun = True
        self._simulator.AdvanceTo(given.time)
        # Events at exactly that time would otherwise wait for the next tick.
        self._simulator.AdvancePendingEvents()
        self._publisher.ForcedPublish(self._publisher_context)
        self._newest = self._read(given)
        return self._newest

    def _begin(self, random_seed):
        """Starts from a new Context."""
        self._simulator = make_simulator(
            self._workcell.diagram, self._workcell.make_context(random_seed)
        )
        self._context = self._simulator.get_context()
        self._publisher_context = self._publisher.GetMyContextFromRoot(
            self._context
        )
        self._ask = self._find_outputs()
        self._has_begun = False

    def _find_outputs(self):
        """Returns what evaluates each output that a result has, by name."""
        station = self._station.diagram
        monitor = self._workcell.diagram.GetSubsystemByName("monitor")
        return {
            name: functools.partial(
                system.GetOutputPort(name).Eval,
                system.GetMyContextFromRoot(self._context),
            )
            for system, names in (
                (monitor, ("decision", "speed_fraction", "separation")),
                (station.GetSubsystemByName("sensing_problem"), ("problem",)),
                (station.GetSubsystemByName("slider_control"), ("slider",)),
                (station, ("products_placed", "task_done")),
            )
            for name in names
        }

    def _read(self, given):
        ask = self._ask
        return TickResult(
            time=given.time,
            decision=ask["decision"](),
            problem=ask["problem"](),
            speed_fraction=float(ask["speed_fraction"]()[0]),
            slider=ask["slider"](),
            separation=ask["separation"](),
            products_placed=int(ask["products_placed"]()[0]),
            task_done=ask["task_done"]()[0] > 0.5,
            sent=self._sent,
        )

    def _send_if_live(self, command):
        if not self._sending or self._send is None or not self._send(command):
            return False
        self._sent = time.monotonic()
        return True

    def _show_frames(self, show, builder, station, monitor):
        """Adds what shows frames, with the health at the tick before."""

        def send(frame):
            if not self._sending:
                return
            if self._newest is not None:
                health = describe_links(self._newest, deadline=self._deadline)
                frame = dc.replace(frame, health=health)
            show(frame)

        add_frame_sender(builder, self._scenario, station, monitor, send)

    def _warm_up(self):
        """Runs a few ticks so that kernels are compiled."""
        scenario = self._scenario
        rings = find_rings(scenario.sensors)
        path = make_task_path(
            scenario.task,
            ArmKinematics.from_plant(self._station.plant),
            scenario.robot,
        )
        q = path.calc_motion(0.0)[0]
        self._station.robot.report = RobotReport(
            sequence=0, position=q, velocity=np.zeros(len(q))
        )
        period = max(ring.sensor.traits.period for ring in rings.values())
        for i in range(_WARM_UP):
            self.tick(
                TickInput(
                    time=(i + 1) * period,
                    report=self._station.robot.report,
                    scans=tuple(
                        _make_warm_up_scan(i, i * period, ring.num_sensors)
                        for ring in rings.values()
                    ),
                )
            )
        self._newest = None
        self._station.robot.report = RobotReport()
        if self._station.rings is not None:
            self._station.rings.scans = HeldRings(tuple(rings)).scans


def _make_warm_up_scan(sequence, time, n):
    """Returns a scan in which each of n sensors sees something at 1 m."""
    return RingScan(
        sequence=sequence,
        time=time,
        sensor_time=np.full(n, time),
        distance=np.full(n, 1.0),
        status=np.zeros(n, dtype=np.uint8),
    )
