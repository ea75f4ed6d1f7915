"""Runs the monitor on a real robot's reports, one tick for each of them."""

import dataclasses as dc
import math
import time

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from tofssm_drake.diagrams.hardware_station import make_hardware_station
from tofssm_drake.diagrams.scenario import Scenario, make_law
from tofssm_drake.diagrams.simulation import make_simulator
from tofssm_drake.diagrams.workcell import Workcell, make_workcell
from tofssm_drake.hardware.held_connections import HeldRings, HeldRobot
from tofssm_drake.hardware.slider import (
    SliderConfig,
    SliderPhase,
    SliderState,
)
from tofssm_drake.messages import (
    RINGS,
    RingHealth,
    RingScan,
    RobotReport,
    RobotState,
    Separation,
)
from tofssm_drake.robot.kinematics import RingKinematics
from tofssm_drake.robot.program import make_program_path
from tofssm_drake.ssm.sensing_problem import find_sensing_problem
from tofssm_drake.visualization.health_board import (
    BLIND,
    FAULT,
    HELD,
    OK,
    HealthBoard,
)

# The world of virtual rings, or made-up scans, for so many periods of them.
_WARM_UP = 3


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TickInput:
    """All that a tick follows from."""

    time: float
    """Diagram's time, s; does not fall."""
    report: RobotReport
    scans: tuple[RingScan, ...] = ()
    """Newest scan of each ring on the host's clock; of virtual ones none."""
    clock_offset: float = 0.0
    """What the Diagram's clock shows more than the host's, s."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TickResult:
    """What a tick gave."""

    time: float
    """Diagram's time, s."""
    robot_state: int
    """Number of the state."""
    ring_states: tuple[int, ...]
    reason: str
    problem: str
    """Why the sensing is not fresh and healthy; empty: it is."""
    speed_fraction: float
    slider: SliderState
    separation: Separation
    products_placed: int
    task_done: bool
    sent: float
    """Host's time when the command had been handed over, s; NaN: it was not."""

    @property
    def health(self) -> str:
        """Why the robot does not run at full speed, in one line.

        The law's reason and the slider's; empty: it does.
        """
        reasons = [self.slider.reason]
        if self.robot_state != RobotState.NORMAL:
            reasons.insert(0, self.reason)
        return "; ".join(filter(None, reasons))


def describe_links(result: TickResult, *, deadline: float) -> dict[str, str]:
    """Returns the health of rings and robot, as `HealthBoard` shows it.

    Args:
        result: Of the newest tick.
        deadline: How old the law lets a sample be, s.
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


def _update(system, context):
    """Makes a system's forced update, in place."""
    system.CalcForcedUnrestrictedUpdate(context, context.get_mutable_state())


class _Ticker:
    """Ticks on a Context of its own.

    Args:
        workcell: Of a hardware station; several tickers may share it.
        context: To begin with.
        deadline: How old the law lets a sample be, s.
    """

    def __init__(self, workcell: Workcell, context: Context, deadline: float):
        self._deadline = deadline
        # All is looked up once, not in each tick.
        station = workcell.station.diagram
        self._monitor = workcell.diagram.GetSubsystemByName("monitor")
        self._mask = self._monitor.GetSubsystemByName("mask")
        self._answers = {
            name: self._monitor.GetOutputPort(name)
            for name in (
                "robot_state",
                "ring_states",
                "reason",
                "speed_fraction",
                "separation",
            )
        }
        self._publisher = station.GetSubsystemByName("robot_publisher")
        slider = station.GetSubsystemByName("slider_control")
        self._slider_state = slider.GetOutputPort("slider")
        self.simulator = make_simulator(workcell.diagram, context)
        root = self.simulator.get_mutable_context()
        self._monitor_context = self._monitor.GetMyContextFromRoot(root)
        self._mask_context = self._mask.GetMyMutableContextFromRoot(root)
        self._publisher_context = self._publisher.GetMyContextFromRoot(root)
        self._robot_context = station.GetSubsystemByName(
            "robot_subscriber"
        ).GetMyMutableContextFromRoot(root)
        self._slider_context = slider.GetMyMutableContextFromRoot(root)
        self._shown_report, self._shown_problem = (
            slider.GetInputPort(name).FixValue(
                self._slider_context, AbstractValue.Make(value)
            )
            for name, value in (("report", RobotReport()), ("problem", ""))
        )
        self._problem = ""
        self._reasons_for = self._reason = None
        self._taken = None
        self._rings = None
        if workcell.station.rings is not None:
            self._rings = station.GetSubsystemByName("ring_subscriber")
            self._ring_context = self._rings.GetMyMutableContextFromRoot(root)
            self._clock_offset = self._rings.GetInputPort(
                "clock_offset"
            ).FixValue(self._ring_context, [0.0])
        self._initialized = False

    def tick(self, given: TickInput) -> tuple[SliderState, str]:
        """Computes and publishes; returns slider and `TickResult.problem`.

        Args:
            given: What is new; the station's connections hold the same.
        """
        if not self._initialized:
            # With the first report, or the record would begin without one.
            self._show_offset(given.clock_offset)
            self.simulator.Initialize()
            self._initialized = True
            # The events of the first tick come with the first advance.
            self._take_scans(given.scans)
        self._robot_context.SetAbstractState(0, given.report)
        self.simulator.AdvanceTo(given.time)
        self._show_offset(given.clock_offset)
        self._take_scans(given.scans)
        # The tick's own events: without it they would wait for the next one.
        self.simulator.AdvancePendingEvents()
        problem = find_sensing_problem(
            index=self.ask("separation"),
            now=given.time,
            deadline=self._deadline,
        )
        self._shown_report.GetMutableData().set_value(given.report)
        if problem != self._problem:
            self._problem = problem
            self._shown_problem.GetMutableData().set_value(problem)
        self._publisher.ForcedPublish(self._publisher_context)
        # What was published is remembered; a forced update would compute it
        # anew.
        slider = self._slider_state.Eval(self._slider_context)
        self._slider_context.SetAbstractState(0, slider)
        return slider, problem

    def ask(self, name: str):
        """Returns what an output of the monitor says after the tick."""
        return self._answers[name].Eval(self._monitor_context)

    def ask_reason(self) -> str:
        """Returns `reason`; words are made for what is new only."""
        reasons_for = self.ask("separation"), self.ask("robot_state")[0]
        if reasons_for != self._reasons_for:
            self._reasons_for = reasons_for
            self._reason = self.ask("reason")
        return self._reason

    def _take_scans(self, scans):
        """Lets subscriber and mask look, if there is anything to see."""
        if self._rings is None:
            return
        if [scan.sequence for scan in scans] == self._taken:
            return
        _update(self._rings, self._ring_context)
        _update(self._mask, self._mask_context)
        self._taken = [
            self._rings.get_output_port(i).Eval(self._ring_context).sequence
            for i in range(len(RINGS))
        ]

    def _show_offset(self, clock_offset):
        if self._rings is not None:
            offset = self._clock_offset.GetMutableData().get_mutable_value()
            offset[0] = clock_offset


class HardwareLoop:
    """The monitor in a loop with a station that is handed its data.

    Args:
        scenario: Checked settings; rings on the arm.
        virtual_rings: Simulate the rings in the twin.
        send: Takes the commands; None drops them.
        slider: Settings of the slider.
        gripper_output: Number of the digital output that closes the gripper.
        meshcat: Where to show the twin; None shows nothing.
        with_samples: Keep samples for a report; they grow with the run.
    """

    def __init__(
        self,
        *,
        scenario: Scenario,
        virtual_rings: bool,
        send=None,
        slider: SliderConfig | None = None,
        gripper_output: int = 0,
        meshcat: Meshcat | None = None,
        with_samples: bool = False,
    ):
        self._scenario = scenario
        self._sending = False
        self._send = send
        self._deadline = make_law(scenario).deadline
        slider = SliderConfig() if slider is None else slider
        self._station = make_hardware_station(
            scenario,
            robot=HeldRobot(self._send_if_live),
            rings=None if virtual_rings else HeldRings(),
            slider=dc.replace(
                slider, reduced_fraction=scenario.ssm.rho_reduced
            ),
            gripper_output=gripper_output,
        )
        self._workcell = make_workcell(
            scenario,
            station=self._station,
            meshcat=meshcat,
            with_samples=with_samples,
            masks_periodically=virtual_rings,
        )
        self._board = None
        self._sent = math.nan
        self._ticker = self._make_ticker(0)
        self._warm_up()
        self._ticker = self._make_ticker(scenario.random_seed)
        if meshcat is not None:
            self._board = HealthBoard(meshcat=meshcat)
        self._sending = True

    @property
    def workcell(self) -> Workcell:
        """Station, monitor and record."""
        return self._workcell

    @property
    def context(self) -> Context:
        """The workcell's Context after the last tick."""
        return self._ticker.simulator.get_context()

    def tick(self, given: TickInput) -> TickResult:
        """Takes a report, computes, and sends the command.

        Args:
            given: What is new.

        Returns:
            What the monitor says of it and what was sent.
        """
        self._station.robot.report = given.report
        if self._station.rings is not None:
            self._station.rings.scans = given.scans
        self._sent = math.nan
        slider, problem = self._ticker.tick(given)
        result = self._read(given, problem, slider)
        if self._board is not None:
            self._board.show(describe_links(result, deadline=self._deadline))
        return result

    def _read(self, given, problem, slider):
        ask = self._ticker.ask
        report = given.report
        return TickResult(
            time=given.time,
            robot_state=int(ask("robot_state")[0]),
            ring_states=tuple(int(s) for s in ask("ring_states")),
            reason=self._ticker.ask_reason(),
            problem=problem,
            speed_fraction=float(ask("speed_fraction")[0]),
            slider=slider,
            separation=ask("separation"),
            products_placed=max(report.products_placed, 0),
            task_done=report.products_placed >= self._scenario.program.products,
            sent=self._sent,
        )

    def _make_ticker(self, random_seed):
        return _Ticker(
            self._workcell,
            self._workcell.make_context(random_seed),
            self._deadline,
        )

    def _send_if_live(self, command):
        if not self._sending or self._send is None or not self._send(command):
            return False
        self._sent = time.monotonic()
        return True

    def _warm_up(self):
        """Runs a few ticks in vain: the first call of a kernel is slow."""
        scenario = self._scenario
        n = scenario.sensors_per_ring
        path = make_program_path(
            scenario.program, RingKinematics.from_plant(self._station.plant)
        )
        q = path.calc_motion(0.0)[0]
        self._station.robot.report = RobotReport(
            sequence=0, position=q, velocity=np.zeros(6)
        )
        period = scenario.rings.period
        for i in range(_WARM_UP):
            scan = RingScan(
                sequence=i,
                time=i * period,
                sensor_time=np.full(n, i * period),
                distance=np.full(n, 1.0),
                status=np.zeros(n, dtype=np.uint8),
            )
            self.tick(
                TickInput(
                    time=(i + 1) * period,
                    report=self._station.robot.report,
                    scans=(scan,) * len(RINGS),
                )
            )
        self._station.robot.report = RobotReport()
        if self._station.rings is not None:
            self._station.rings.scans = HeldRings().scans
