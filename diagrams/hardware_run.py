"""A run on a real robot: waiting for it, one tick a report, and the end.

    wait for a report -> tick -> command        as often as the robot reports

Whatever ends it, the connection is closed, which puts the slider to 0.
"""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses as dc
import math
import os
import threading
import time

import numpy as np

from tofssm_drake.diagrams.hardware_loop import (
    HardwareLoop,
    TickInput,
    TickResult,
)
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.errors import UserError, require
from tofssm_drake.hardware.model_match import (
    ModelConfig,
    ModelMatch,
    start_model_match,
    step_model_match,
)
from tofssm_drake.hardware.ring_link import RingConnection, explain_silence
from tofssm_drake.hardware.robot_checks import RobotChecks
from tofssm_drake.hardware.robot_clock import RobotClock
from tofssm_drake.hardware.robot_connection import RobotConnection
from tofssm_drake.hardware.rtde_fields import SafetyMode, name_of
from tofssm_drake.hardware.run_record import RecordedTick, RunRecorder
from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.robot.kinematics import RingKinematics
from tofssm_drake.robot.program import make_program_path

# One wait for a report, s; then the signals are looked at.
_WAIT = 0.05
# A robot that is silent that long ends the run, s.
_LONGEST_SILENCE = 10.0
# Reports that come so much later than the fastest ones end the run, s.
_LATEST = 0.25
_PATH_STEP = 0.05
# A joint that is that many times as fast as it can be is a fault, and so is
# one that is that far from where it may have gone, rad (assumed).
_TOO_FAST = 3.0
_JUMP = 0.5
# So near to where it was put the slider is there.
_AT_LOWEST = 0.005
# Above all that is not real-time, and below the system's own threads (50).
_PRIORITY = 10
# Between two lines about what is waited for, s.
_QUIET = 2.0


def require_ready(
    report: RobotReport,
    scenario: Scenario,
    plant,
    *,
    max_deviation: float,
    model: ModelConfig | None = None,
) -> None:
    """Raises UserError unless the robot may be watched as it is.

    Args:
        report: The robot's newest.
        scenario: Checked settings.
        plant: The cell's, with the arm's limits.
        max_deviation: How far any joint may be from where the program ever
            is, rad; inf: anywhere within the limits.
        model: How near its tool must be to the model's; None: as by default.
    """
    for mode in (report.safety_mode, report.safety_status):
        # Older software has no safety status: -1.
        require(
            mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)
            or (mode == -1 and report.safety_mode != -1),
            f"robot: safety mode is {name_of(SafetyMode, mode)}, must be "
            "normal or reduced",
        )
    require_plausible(report, RobotReport(), JointLimits.from_plant(plant))
    kinematics = RingKinematics.from_plant(plant)
    start_model_match(model or ModelConfig(), kinematics, report)
    q = report.position
    path = make_program_path(scenario.program, kinematics)
    positions = np.array(
        [
            path.calc_motion(t)[0]
            for t in np.arange(0.0, path.duration, _PATH_STEP)
        ]
    )
    deviations = np.abs(positions - q)
    nearest = deviations[deviations.max(axis=1).argmin()]
    j = nearest.argmax()
    require(
        nearest[j] <= max_deviation,
        f"robot: joint {j + 1} is at {q[j]:.3f} rad, {nearest[j]:.2f} from "
        f"where the scenario's program ever is, more than {max_deviation:g}",
    )


@dc.dataclass(frozen=True, kw_only=True)
class JointLimits:
    """What no robot of this kind does; each for six joints."""

    low: tuple[float, ...]
    """Least position, rad."""
    high: tuple[float, ...]
    """Greatest position, rad."""
    speed: tuple[float, ...]
    """Greatest speed, rad/s."""

    @classmethod
    def from_plant(cls, plant) -> "JointLimits":
        """Returns the limits of the cell's arm."""
        return cls(
            low=tuple(plant.GetPositionLowerLimits()[:6].tolist()),
            high=tuple(plant.GetPositionUpperLimits()[:6].tolist()),
            speed=tuple(plant.GetVelocityUpperLimits()[:6].tolist()),
        )


def require_plausible(
    report: RobotReport, before: RobotReport, limits: JointLimits
) -> None:
    """Raises UserError if no such robot could have moved like that.

    Args:
        report: The robot's newest.
        before: The one that was answered before it.
        limits: Of the arm.
    """
    elapsed = math.inf
    if report.session == before.session:
        elapsed = report.timestamp - before.timestamp
    joints = zip(
        report.position.tolist(),
        report.velocity.tolist(),
        before.position.tolist(),
        limits.low,
        limits.high,
        limits.speed,
        strict=True,
    )
    # Words are made only of what is wrong: this is done in each tick.
    for j, (q, v, q_before, low, high, speed) in enumerate(joints):
        problem = ""
        if not low <= q <= high:
            problem = (
                f"is at {q:.3f} rad, the model's limits are {low:.3f} and "
                f"{high:.3f}"
            )
        elif not abs(v) <= _TOO_FAST * speed:
            problem = (
                f"turns at {v:.3g} rad/s, the model's limit is {speed:.3g}"
            )
        elif abs(q - q_before) > _JUMP + speed * elapsed:
            problem = (
                f"went from {q_before:.3f} to {q:.3f} rad in {elapsed:.3f} s"
            )
        if problem:
            raise UserError(f"robot: joint {j + 1} {problem}")


def hold_robot(robot: RobotConnection, fraction: float) -> None:
    """Puts the slider to the lowest until there is a monitor; no heartbeat.

    Args:
        robot: The robot, if it has reported.
        fraction: Where the slider shall be.
    """
    report = robot.get_report()
    # An echo that is no number is none that is low enough.
    if not report.target_speed_fraction <= fraction + _AT_LOWEST:
        robot.send(
            SliderCommand(
                sequence=report.sequence, mask=1, speed_fraction=fraction
            )
        )


@contextlib.contextmanager
def run_in_real_time() -> Iterator[bool]:
    """Puts the program's threads before all other programs, where it may.

    All of Python's that there are: one that another program has interrupted
    would hold up those that wait for the interpreter. Threads and programs
    that are started within do not get the priority. A program that was
    started with a real-time priority is left as it is.

    Yields:
        Whether they have a real-time priority.
    """
    usual, real_time = (
        policy | os.SCHED_RESET_ON_FORK
        for policy in (os.SCHED_OTHER, os.SCHED_FIFO)
    )
    changed = []
    for thread in threading.enumerate():
        # It may not, or the thread has just ended.
        with contextlib.suppress(OSError):
            if os.sched_getscheduler(thread.native_id) == os.SCHED_OTHER:
                os.sched_setscheduler(
                    thread.native_id, real_time, os.sched_param(_PRIORITY)
                )
                changed.append(thread.native_id)
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    try:
        yield policy in (os.SCHED_FIFO, os.SCHED_RR)
    finally:
        for number in changed:
            # The flag stays: only a privileged user may take it back.
            with contextlib.suppress(OSError):
                os.sched_setscheduler(number, usual, os.sched_param(0))


def wait_for_robot(
    robot: RobotConnection,
    *,
    timeout: float,
    tell: Callable[[str], None],
    is_stopped: Callable[[], bool],
) -> bool:
    """Waits until the robot has reported.

    Args:
        robot: Where reports come from.
        timeout: Longest wait, s.
        tell: Called with what is waited for, whenever that changes.
        is_stopped: Whether to give up.

    Returns:
        Whether it has; False: it was given up.

    Raises:
        UserError: The time is over.
    """

    def has_reported():
        return robot.wait_for_report(after=-1, timeout=_WAIT).sequence >= 0

    def find_problem():
        problem = robot.get_status().problem
        return f"no report from the robot: {problem or 'it is silent'}"

    return _wait(has_reported, find_problem, timeout, tell, is_stopped)


def require_control_period(control_period: float | None) -> None:
    """Raises UserError if no robot could make such ticks.

    Args:
        control_period: Control tick that the user wants, s; None: any.
    """
    require(
        control_period is None or 0.001 <= control_period <= 0.1,
        "--control-period: must be from 0.001 to 0.1 s, got "
        f"{control_period!r}",
    )


def set_control_period(
    scenario: Scenario, *, frequency: float, control_period: float | None
) -> None:
    """Puts the scenario's control tick onto the robot's reports.

    Args:
        scenario: Checked settings; changed in place.
        frequency: Reports per second.
        control_period: Control tick that the user wants, s; None: one for
            each report.

    Raises:
        UserError: The reports cannot make such ticks.
    """
    require_control_period(control_period)
    period = 1.0 / frequency
    if control_period is not None:
        ticks = control_period / period
        require(
            round(ticks) >= 1 and abs(ticks - round(ticks)) < 1e-6,
            f"--control-period: must be a multiple of {period:g} s, since the "
            f"robot reports at {frequency:g} Hz; got {control_period:g}",
        )
        period = control_period
    scenario.control_period = period
    scenario.audit.rtde_period = 1.0 / frequency
    # The simulated arm is not used, but its settings must fit.
    scenario.robot.time_step = min(scenario.robot.time_step, period)
    scenario.check()


class HardwareRun:
    """Robot, rings and monitor, one tick for each of the robot's reports.

    Args:
        loop: The monitor in its loop.
        robot: Where reports come from.
        rings: Where scans come from; None: they are virtual.
        period: Control tick, s.
        record: What everything is written to; None: nothing is.
        limits: What no report may exceed; None: anything may be.
        kinematics: Of the modelled robot; None: any robot will do.
        checks: How the robot is checked; None: as by default.
        lowest: Where the slider is put while robot and rings are waited for.
        clock: Shows the host's time, s.
    """

    def __init__(
        self,
        *,
        loop: HardwareLoop,
        robot: RobotConnection,
        rings: RingConnection | None,
        period: float,
        record: RunRecorder | None = None,
        limits: JointLimits | None = None,
        kinematics: RingKinematics | None = None,
        checks: RobotChecks | None = None,
        lowest: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._loop = loop
        self._robot = robot
        self._rings = rings
        self._record = record
        self._limits = limits
        self._kinematics = kinematics
        self._checks = RobotChecks() if checks is None else checks
        self._checks.check("checks")
        self._match = ModelMatch()
        self._lowest = lowest
        # The newest that was taken.
        self._report = RobotReport()
        self._robot_clock = RobotClock(period=period)
        self._clock = clock
        self._heard = clock()
        self.ticks = 0
        """Reports answered."""

    def wait(
        self,
        *,
        timeout: float,
        tell: Callable[[str], None],
        is_stopped: Callable[[], bool],
    ) -> RobotReport | None:
        """Waits until robot and rings are there; holds the robot meanwhile.

        Args:
            timeout: Longest wait for each, s.
            tell: Called with what is waited for, whenever that changes.
            is_stopped: Whether to give up.

        Returns:
            The robot's newest report; None: it was given up.

        Raises:
            UserError: The time is over.
        """
        if not wait_for_robot(
            self._robot, timeout=timeout, tell=tell, is_stopped=is_stopped
        ):
            return None
        hold_robot(self._robot, self._lowest)
        if self._rings is not None and not _wait(
            self._have_rings_come,
            lambda: explain_silence(self._rings.get_status()),
            timeout,
            tell,
            is_stopped,
        ):
            return None
        self._heard = self._clock()
        return self._robot.get_report()

    def step(self) -> TickResult | None:
        """Waits for the next report and answers it.

        Returns:
            What the monitor says; None: there is no new report yet.

        Raises:
            UserError: The robot is silent for too long, or far too late, or
                what it reports cannot be, or not of the modelled robot.
        """
        report = self._robot.wait_for_report(
            after=self._report.sequence, timeout=_WAIT
        )
        if report.sequence <= self._report.sequence:
            silence = self._clock() - self._heard
            problem = self._robot.get_status().problem
            require(
                silence <= _LONGEST_SILENCE,
                f"robot: no report for {silence:.0f} s: "
                f"{problem or 'it is silent'}",
            )
            return None
        self._heard = report.time
        if self._limits is not None:
            require_plausible(report, self._report, self._limits)
        self._report = report
        tick_time = self._robot_clock.update(report)
        self._require_good_clock()
        given = TickInput(
            time=tick_time,
            report=report,
            scans=self._get_scans(),
            clock_offset=self._robot_clock.offset,
        )
        result = self._loop.tick(given)
        self.ticks += 1
        if self._record is not None:
            self._record.add_tick(make_recorded_tick(given, result))
        # After the answer, which must not wait for it.
        self._require_modelled_robot(report)
        return result

    def _require_good_clock(self):
        """Raises UserError if reports are far too late or their time is off."""
        lateness = self._robot_clock.lateness
        if not lateness <= _LATEST:
            raise UserError(f"robot: reports come {1e3 * lateness:.0f} ms late")
        rate, tolerance = self._robot_clock.rate, self._checks.clock_tolerance
        if not abs(rate.rate - 1.0) <= tolerance:
            raise UserError(
                f"robot: its clock runs {rate.newest:.3f} times as fast as "
                f"this computer's, 1 +- {tolerance:g} is allowed"
            )

    def _require_modelled_robot(self, report):
        """Raises UserError if the robot is not the modelled one."""
        if self._kinematics is None:
            return
        self._match = step_model_match(
            self._checks.model, self._kinematics, self._match, report
        )
        if self._match.problem:
            raise UserError(f"robot: {self._match.problem}")

    def _have_rings_come(self):
        # Somebody may have moved the slider, or the robot has started anew.
        hold_robot(self._robot, self._lowest)
        return self._rings.wait_for_scans(_WAIT)

    def _get_scans(self):
        return () if self._rings is None else self._rings.get_scans()


def make_recorded_tick(given: TickInput, result: TickResult) -> RecordedTick:
    """Returns what is recorded of a tick."""
    return RecordedTick(
        time=given.time,
        clock_offset=given.clock_offset,
        report=given.report,
        scans=given.scans,
        command=result.slider.command,
        state=describe_state(result),
        sent=result.sent,
        busy=time.process_time(),
    )


def describe_state(result: TickResult) -> dict:
    """Returns what the monitor said in a tick as plain values."""
    return {
        "robot_state": result.robot_state,
        "ring_states": list(result.ring_states),
        "reason": result.reason,
        "speed_fraction": result.speed_fraction,
        "slider_phase": int(result.slider.phase),
        "slider_reason": result.slider.reason,
        "distance": result.separation.distance.tolist(),
        "problem": list(result.separation.problem),
        "sample_time": result.separation.time.tolist(),
    }


def _wait(is_there, find_problem, timeout, tell, is_stopped):
    """Returns True when something is there, False if it was given up."""
    deadline = time.monotonic() + timeout
    told = ""
    quiet = time.monotonic() + _QUIET
    while not is_there():
        if is_stopped():
            return False
        problem = find_problem()
        if time.monotonic() > deadline:
            raise UserError(f"{problem} (waited {timeout:g} s)")
        if problem != told and time.monotonic() > quiet:
            tell(f"waiting: {problem}")
            told = problem
            quiet = time.monotonic() + _QUIET
    return True
