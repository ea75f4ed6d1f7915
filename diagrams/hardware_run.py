"""A run on a real robot: the wait for it, one tick per report, and the end.

    wait for a report -> tick -> command        as often as the robot reports

However it ends, the connection is closed, which sets the slider to 0.
"""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses as dc
import math
import os
import threading
import time

import numpy as np

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.limits import ArmLimits
from tofssm_drake.arms.sim_arm import Simulated
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.diagrams.hardware_loop import (
    HardwareLoop,
    TickInput,
    TickResult,
)
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.errors import UserError, require
from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.path_times import list_times
from tofssm_drake.recording.run_record import RecordedTick, RunRecorder
from tofssm_drake.ringlink.ring_link import RingConnection, explain_silence
from tofssm_drake.robots.robot_connection import RobotConnection
from tofssm_drake.robots.robot_modes import SafetyMode, name_of
from tofssm_drake.rtde.model_match import (
    ModelConfig,
    ModelMatch,
    start_model_match,
    step_model_match,
)
from tofssm_drake.rtde.robot_checks import RobotChecks
from tofssm_drake.rtde.robot_clock import RobotClock

# One wait for a report, s; then signals are checked.
_WAIT = 0.05
# The run ends if the robot is silent for this long, s.
_LONGEST_SILENCE = 10.0
# The run ends if reports come this much later than the fastest ones, s.
_LATEST = 0.25
_PATH_STEP = 0.05
_MOST_LOOKS = 20_000
# A joint that exceeds its speed limit by this factor is a fault, and so is one
# that is this far beyond where it can have gone, rad (assumed).
_TOO_FAST = 3.0
_JUMP = 0.5
# The slider is where it was set if it is this close.
_AT_LOWEST = 0.005
# Above everything that is not real-time, below the system's own threads (50).
_PRIORITY = 10
# Between two lines about the reason for waiting, s.
_QUIET = 2.0


def require_ready(
    report: RobotReport,
    scenario: Scenario,
    plant,
    *,
    max_deviation: float,
    model: ModelConfig | None = None,
) -> None:
    """Raises UserError unless the robot is in a state to be monitored.

    Args:
        report: The robot's newest.
        scenario: Checked settings.
        plant: The cell's, with the arm's limits.
        max_deviation: How far any joint may be from the program's path, rad;
            inf: anywhere within the limits.
        model: How close its tool must be to the model's; None: the default.
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
    kinematics = ArmKinematics.from_plant(plant)
    start_model_match(
        model or ModelConfig(), kinematics, report, _name_arm(scenario.robot)
    )
    q = report.position
    path = make_task_path(scenario.task, kinematics, scenario.robot)
    positions = np.array(
        [
            path.calc_motion(t)[0]
            for t in list_times(
                path.duration, step=_PATH_STEP, most=_MOST_LOOKS
            )
        ]
    )
    deviations = np.abs(positions - q)
    nearest = deviations[deviations.max(axis=1).argmin()]
    j = nearest.argmax()
    require(
        nearest[j] <= max_deviation,
        f"robot: joint {j + 1} is at {q[j]:.3f} rad, {nearest[j]:.2f} from "
        f"the path of the scenario's program, more than {max_deviation:g}",
    )


def _name_arm(robot):
    """Returns what the scenario's arm is, for a message."""
    if isinstance(robot, UrArm):
        return f"the scenario's {robot.model}"
    return "the scenario's arm"


@dc.dataclass(frozen=True, kw_only=True)
class JointLimits:
    """Limits of the robot's n joints, (n,) each."""

    low: tuple[float, ...]
    """Least position, rad."""
    high: tuple[float, ...]
    """Greatest position, rad."""
    speed: tuple[float, ...]
    """Greatest speed, rad/s."""

    @classmethod
    def from_plant(cls, plant) -> "JointLimits":
        """Returns the limits of the cell's arm."""
        limits = ArmLimits.from_plant(plant)
        return cls(
            low=tuple(limits.lower.tolist()),
            high=tuple(limits.upper.tolist()),
            speed=tuple(limits.speed.tolist()),
        )


def require_plausible(
    report: RobotReport, before: RobotReport, limits: JointLimits
) -> None:
    """Raises UserError if the robot cannot have moved like that.

    Args:
        report: The robot's newest.
        before: The report answered before it.
        limits: Of the arm.
    """
    joints = len(limits.speed)
    for values in (report.position, report.velocity):
        if len(values) != joints:
            raise UserError(
                f"robot: reports {len(values)} joints, the scenario's arm has "
                f"{joints}"
            )
    # Before the first report there is no position.
    positions_before = report.position
    if before.sequence >= 0:
        positions_before = before.position
    elapsed = math.inf
    if report.session == before.session:
        elapsed = report.timestamp - before.timestamp
    joint_values = zip(
        report.position.tolist(),
        report.velocity.tolist(),
        positions_before.tolist(),
        limits.low,
        limits.high,
        limits.speed,
        strict=True,
    )
    # Texts are made only for faults, since this runs in each tick.
    for j, (q, v, q_before, low, high, speed) in enumerate(joint_values):
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
    """Sets the slider to its lowest until the monitor runs; no heartbeat.

    Args:
        robot: The robot, if it has reported.
        fraction: Where to set the slider.
    """
    report = robot.get_report()
    # A NaN echo never counts as low enough.
    if not report.target_speed_fraction <= fraction + _AT_LOWEST:
        robot.send(
            SliderCommand(
                sequence=report.sequence, mask=1, speed_fraction=fraction
            )
        )


@contextlib.contextmanager
def run_in_real_time() -> Iterator[bool]:
    """Gives the program's threads real-time priority, if allowed.

    It includes all of Python's threads: one that another program interrupts
    would delay those that wait for the interpreter. Threads and programs
    started within do not inherit the priority. A program that was started with
    real-time priority is left as it is.

    Yields:
        Whether they have a real-time priority.
    """
    usual, real_time = (
        policy | os.SCHED_RESET_ON_FORK
        for policy in (os.SCHED_OTHER, os.SCHED_FIFO)
    )
    changed = []
    for thread in threading.enumerate():
        number = thread.native_id
        if number is None:
            continue
        # Not allowed, or the thread has just ended.
        with contextlib.suppress(OSError):
            if os.sched_getscheduler(number) == os.SCHED_OTHER:
                os.sched_setscheduler(
                    number, real_time, os.sched_param(_PRIORITY)
                )
                changed.append(number)
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    try:
        yield policy in (os.SCHED_FIFO, os.SCHED_RR)
    finally:
        for number in changed:
            # The flag stays: only a privileged user may clear it.
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
        tell: Called with the reason for waiting, whenever it changes.
        is_stopped: Whether to give up.

    Returns:
        Whether it has; False: it gave up.

    Raises:
        UserError: The timeout has passed.
    """

    def has_reported():
        return robot.wait_for_report(after=-1, timeout=_WAIT).sequence >= 0

    def find_problem():
        problem = robot.get_status().problem
        return f"no report from the robot: {problem or 'it is silent'}"

    return _wait(has_reported, find_problem, timeout, tell, is_stopped)


def require_control_period(control_period: float | None) -> None:
    """Raises UserError if no robot could provide such ticks.

    Args:
        control_period: Control tick wanted by the user, s; None: any.
    """
    require(
        control_period is None or 0.001 <= control_period <= 0.1,
        "--control-period: must be from 0.001 to 0.1 s, got "
        f"{control_period!r}",
    )


def set_control_period(
    scenario: Scenario, *, frequency: float, control_period: float | None
) -> None:
    """Sets the scenario's control tick to match the robot's reports.

    Args:
        scenario: Checked settings; changed in place.
        frequency: Reports per second.
        control_period: Control tick wanted by the user, s; None: one per
            report.

    Raises:
        UserError: The reports cannot provide such ticks.
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
    if isinstance(scenario.driver, Simulated):
        # The simulated arm is not used, but its settings are checked.
        time_step = min(scenario.driver.time_step, period)
        scenario.driver.time_step = time_step
    scenario.check()


class HardwareRun:
    """Robot, rings and monitor, one tick per report of the robot.

    Args:
        loop: The monitor in its loop.
        robot: Where reports come from.
        rings: Where scans come from; None: they are virtual.
        period: Control tick, s.
        record: Where everything is recorded; None: nowhere.
        limits: Limits of the reports; None: no limits.
        kinematics: Of the modelled robot; None: any robot is accepted.
        checks: How the robot is checked; None: the default.
        lowest: Where the slider is set while waiting for robot and rings.
        clock: Returns the host's time, s.
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
        kinematics: ArmKinematics | None = None,
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
        """Number of reports answered."""

    def wait(
        self,
        *,
        timeout: float,
        tell: Callable[[str], None],
        is_stopped: Callable[[], bool],
    ) -> RobotReport | None:
        """Waits for robot and rings; holds the robot meanwhile.

        Args:
            timeout: Longest wait for each, s.
            tell: Called with the reason for waiting, whenever it changes.
            is_stopped: Whether to give up.

        Returns:
            The robot's newest report; None: it gave up.

        Raises:
            UserError: The timeout has passed.
        """
        if not wait_for_robot(
            self._robot, timeout=timeout, tell=tell, is_stopped=is_stopped
        ):
            return None
        hold_robot(self._robot, self._lowest)
        rings = self._rings
        if rings is not None and not _wait(
            lambda: self._have_rings_come(rings),
            lambda: explain_silence(rings.get_status()),
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
            The monitor's result; None: no new report yet.

        Raises:
            UserError: The robot is silent for too long or far too late, its
                report is impossible, or it is not the modelled robot.
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
        # After the answer, which must not wait for this.
        self._require_modelled_robot(report)
        return result

    def _require_good_clock(self):
        """Raises UserError if reports are too late or their clock is off."""
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

    def _have_rings_come(self, rings):
        # Someone may have moved the slider, or the robot has restarted.
        hold_robot(self._robot, self._lowest)
        return rings.wait_for_scans(_WAIT)

    def _get_scans(self):
        return () if self._rings is None else self._rings.get_scans()


def make_recorded_tick(given: TickInput, result: TickResult) -> RecordedTick:
    """Returns what to record of a tick."""
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
    """Returns the monitor's results in a tick as plain values."""
    decision = result.decision
    return {
        "robot_state": int(result.robot_state),
        "ring_states": decision.state.tolist(),
        "reason": decision.reason,
        "target": decision.target,
        "deciding_link": decision.link,
        "signals": {
            name: values.tolist() for name, values in decision.signal.items()
        },
        "speed_fraction": result.speed_fraction,
        "slider_phase": int(result.slider.phase),
        "slider_reason": result.slider.reason,
        "distance": result.separation.distance.tolist(),
        "problem": list(result.separation.problem),
        "sample_time": result.separation.time.tolist(),
    }


def _wait(is_there, find_problem, timeout, tell, is_stopped):
    """Returns True when something is there, False if it gave up."""
    deadline = time.monotonic() + timeout
    reported = ""
    quiet = time.monotonic() + _QUIET
    while not is_there():
        if is_stopped():
            return False
        problem = find_problem()
        if time.monotonic() > deadline:
            raise UserError(f"{problem} (waited {timeout:g} s)")
        if problem != reported and time.monotonic() > quiet:
            tell(f"waiting: {problem}")
            reported = problem
            quiet = time.monotonic() + _QUIET
    return True
