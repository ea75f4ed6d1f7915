"""When to write the robot's speed slider, and whether it obeys.

Writing the slider is only a request: a write may be lost, a person may move
the slider, a pause may reset it. So each report's echo,
`target_speed_fraction`, is compared with what was written, and the arm's speed
with what the echo allows (`arm_obedience.py`). One pure function,
`step_slider`, does this for each report.
"""

import bisect
import dataclasses as dc
import enum
import math

from tofssm_drake.errors import require
from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.robots.robot_modes import (
    RobotMode,
    RobotStatusBit,
    RuntimeState,
    SafetyMode,
    SafetyStatusBit,
    name_of,
)
from tofssm_drake.rtde.arm_obedience import ArmConfig, ArmState, step_arm

# A longer gap between reports counts as this long, s.
_LONGEST_STEP = 0.05
# An echo may still show a value that was replaced this long ago, s.
_LATE = 0.25
# A robot whose joints are all slower stands still, rad/s; and the top speed of
# the fastest joint, which may creep at the lowest fraction.
_STANDING = 0.01
_FASTEST = 3.2
# An echo up to this counts as 0.
_ZERO = 0.005
# Safety status bits with which a robot may move.
_MOVING = SafetyStatusBit.NORMAL | SafetyStatusBit.REDUCED
# A protective stop within this time was caused by the slider leaving 0, s.
_OFFENCE = 1.0


@dc.dataclass(kw_only=True)
class SliderSettings:
    """How the speed slider of a cell's robot is used."""

    # The echo must follow a write within this many reports, one per control
    # cycle. If not, the value is written once more; if that does not help
    # either, it is a fault.
    confirm_cycles: int = 5

    # Echo and written value may differ by this much (assumed: the rounding of
    # controllers is not published).
    tolerance: float = 0.01

    # The slider is never set lower, except in a fault. 0 stops the robot.
    # Some robots are reported to make a protective stop when the slider
    # leaves 0. With a value such as 0.01 they creep instead of stopping;
    # something else must then really stop them.
    minimum_fraction: float = 0.0

    # After a pause, a stop, a fault or a new connection the fraction may grow
    # no faster than this, 1/s.
    rise_rate: float = 2.0

    # On the way back to full speed the slider must stay at the safety law's
    # fraction of the reduced state for this long, s, without a problem
    # (assumed: five times the greatest age of a ring's sample).
    recovery_time: float = 0.5

    # If a fault ends before the law has slowed the robot that far, the slider
    # falls at this rate, 1/s (the law's own).
    fall_rate: float = 10.0 / 3.0

    # If someone sets the slider lower than wanted: True leaves it there until
    # someone raises it, False sets it back.
    yield_to_operator: bool = True

    # Upper limit of the slider until a person moves it, 0 to 1. None: where
    # it stands at the start, since a person may have set it there. If an
    # earlier run left it at 0, it stays there until someone raises it.
    operator_limit: float | None = None

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        require(
            1 <= self.confirm_cycles <= 125,
            f"{where}.confirm_cycles: must be from 1 to 125, "
            f"got {self.confirm_cycles}",
        )
        require(
            0 < self.tolerance <= 0.05,
            f"{where}.tolerance: must be more than 0 and at most 0.05, "
            f"got {self.tolerance:g}",
        )
        require(
            0 <= self.minimum_fraction <= 0.1,
            f"{where}.minimum_fraction: must be from 0 to 0.1, "
            f"got {self.minimum_fraction:g}",
        )
        for name in ("rise_rate", "fall_rate"):
            require(
                0 < getattr(self, name) <= 100,
                f"{where}.{name}: must be more than 0 and at most 100 1/s, "
                f"got {getattr(self, name):g}",
            )
        require(
            0 <= self.recovery_time <= 60,
            f"{where}.recovery_time: must be from 0 to 60 s, "
            f"got {self.recovery_time:g}",
        )
        require(
            self.operator_limit is None or 0 < self.operator_limit <= 1,
            f"{where}.operator_limit: must be above 0 and at most 1, "
            f"got {self.operator_limit}",
        )


@dc.dataclass(kw_only=True)
class SliderConfig(SliderSettings):
    """The same, with what law, robot and its checks add."""

    # The safety law's fraction of the reduced state.
    reduced_fraction: float = 0.5

    # The robot reports where its slider is. If not, the arm's speed alone shows
    # whether it obeys.
    has_echo: bool = True

    # How fast the arm must follow the slider.
    arm: ArmConfig = dc.field(default_factory=ArmConfig)

    # Greatest speed of each joint, rad/s, from the robot model. These are a
    # UR10's (Universal Robots' user manual).
    joint_speeds: tuple[float, ...] = (2.0944, 2.0944, *4 * (3.1416,))

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        super().check(where)
        require(
            self.minimum_fraction < self.reduced_fraction < 1,
            f"{where}.reduced_fraction: must be above minimum_fraction, "
            f"{self.minimum_fraction:g}, and below 1, "
            f"got {self.reduced_fraction:g}",
        )
        self.arm.check(f"{where}.arm")


class SliderPhase(enum.IntEnum):
    """What is happening to the slider."""

    WAITING = 0
    """No report yet, or robot and slider not yet seen at rest."""
    FOLLOWING = 1
    """The echo is what was written."""
    RISING = 2
    """The echo follows, but the fraction may only grow slowly for now."""
    YIELDING = 3
    """Someone has set it lower, and that is respected."""
    HOLDING = 4
    """The robot does not run its program: the slider stays at its lowest."""
    FAULT = 5
    """Echo or arm does not follow: 0 is written, the heartbeat stops."""
    RECOVERING = 6
    """Something is or was wrong: at most the reduced fraction."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SliderState:
    """All that is remembered from one report to the next."""

    phase: SliderPhase = SliderPhase.WAITING
    reason: str = "no report from the robot yet"
    """Why the slider is not simply following, in one line; else empty."""
    command: SliderCommand = dc.field(default_factory=SliderCommand)
    """What to send now, in answer to the report with its sequence."""
    session: int = -1
    """Of that report."""
    timestamp: float = math.nan
    """Of that report, s on the robot's clock."""
    count: int = 0
    """Number of reports answered."""
    echo: float = math.nan
    """Of that report: where the slider was."""
    fraction: float = math.nan
    """Where it was last set or left; NaN: not yet in this session."""
    replaced: tuple[tuple[float, int, float], ...] = ()
    """Recently replaced fractions, with `count` and `timestamp` of that."""
    confirmed: bool = False
    """Since the start or the last fault the echo has been `fraction` at least
    once while the robot stood still."""
    obeyed: int = 0
    """Number of reports in a row in which the echo was `fraction`."""
    deadline: float = math.inf
    """`count` by which setting it again must have worked."""
    operator_fraction: float = math.nan
    """Limit set by a person at the slider, also for later sessions; NaN: not
    seen yet."""
    ceiling: float = 0.0
    """Rising limit after a hold or a fault; inf: no limit."""
    healthy: float = 0.0
    """Time at the reduced fraction without a problem, s."""
    cause: str = ""
    """What was wrong last."""
    left_zero: float = -math.inf
    """When the slider was last raised from 0, s."""
    arm: ArmState = dc.field(default_factory=ArmState)
    """Whether the arm follows the slider."""

    def __deepcopy__(self, memo):
        return self


def find_hold(report: RobotReport) -> str:
    """Returns why the robot is not running its program; "" if it is."""
    if report.robot_mode != RobotMode.RUNNING:
        return f"robot mode: {name_of(RobotMode, report.robot_mode)}"
    for mode in (report.safety_mode, report.safety_status):
        # Older software has no safety status: -1.
        if mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED, -1):
            return f"safety mode: {name_of(SafetyMode, mode)}"
    # Bits that contradict the mode count as well; 0 has no meaning.
    bits = report.safety_status_bits
    if bits > 0 and bits & ~_MOVING:
        return f"safety status bits: {bits:#x}"
    if report.safety_mode == -1:
        return "safety mode: unknown"
    if report.runtime_state != RuntimeState.PLAYING:
        return f"program: {name_of(RuntimeState, report.runtime_state)}"
    return ""


def step_slider(
    config: SliderConfig,
    state: SliderState,
    report: RobotReport,
    wanted: float,
    problem: str = "",
) -> SliderState:
    """Takes one report and decides what to send in answer.

    The mask of the command is 1 only if the slider must be set: when the
    wanted fraction changed or the echo is wrong. Otherwise a person could not
    move it.

    After any problem with the robot or with the monitor's data, the fraction
    recovers only through `reduced_fraction`. It is the safety law, not this
    function, that stops the robot for a problem with the monitor's data.

    Args:
        config: Settings.
        state: After the previous report.
        report: The newest; if it is not new, nothing changes.
        wanted: Speed fraction of the safety law; NaN counts as 0.
        problem: Why the monitor's data are not fresh and healthy; "" if they
            are.

    Returns:
        The next state, with the command in it.
    """
    if report.sequence < 0 or report.sequence == state.command.sequence:
        return state
    echo = _read_echo(config, state, report)
    if report.session != state.session or state.count == 0:
        state = _begin_session(config, state, echo)
    now = _Now(
        report=report,
        echo=echo,
        count=state.count + 1,
        wanted=min(wanted, 1.0) if wanted > 0.0 else 0.0,
        hold=find_hold(report),
        problem=problem,
    )
    seen = _compare_echo(config, state, now)
    arm = _watch_arm(config, state, now)
    choice = _choose(config, state, now, seen, is_arm_faulty=bool(arm.problem))
    return _make_next_state(config, state, now, seen, arm, choice)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Now:
    """One report and what is known at its time."""

    report: RobotReport
    echo: float
    """Where the slider is; NaN: the report's value is impossible."""
    count: int
    """Number of this report. Reports are counted, not time, since a late
    computer neither wrote nor looked in the meantime."""
    wanted: float
    hold: str
    problem: str


@dc.dataclass(frozen=True, kw_only=True)
class _Seen:
    """How the echo compares with what was written."""

    replaced: tuple[tuple[float, int, float], ...]
    """See `SliderState`; without outdated ones."""
    obeys: bool
    """The echo is what was last written."""
    astray: bool
    """It is neither that nor what was written shortly before."""
    moved: bool
    """It changed to a value that was never written: a person moved it."""


@dc.dataclass(frozen=True, kw_only=True)
class _Choice:
    """What to do with the slider; the names are those of `SliderState`."""

    target: float
    set_it: bool
    fault: bool
    astray: bool
    confirmed: bool
    obeyed: int
    deadline: float
    operator: float
    ceiling: float
    healthy: float


def _read_echo(config, state, report):
    """Returns where the slider is; NaN if that is impossible."""
    if not config.has_echo:
        # Where it was set; `step_arm` judges whether that is true.
        return 0.0 if math.isnan(state.fraction) else state.fraction
    echo = report.target_speed_fraction
    if -config.tolerance <= echo <= 1.0 + config.tolerance:
        return echo
    return math.nan


def _begin_session(config, state, echo):
    """Returns the state for a new session."""
    return SliderState(
        command=state.command,
        count=state.count,
        ceiling=config.minimum_fraction,
        cause="new session with the robot",
        operator_fraction=_carry_operator(config, state, echo),
    )


def _compare_echo(config, state, now):
    """Compares the echo with what was written."""
    echo = now.echo
    # The oldest come first.
    first = bisect.bisect_left(
        state.replaced,
        True,
        key=lambda p: now.report.timestamp - p[2] <= _LATE,
    )
    replaced = state.replaced[first:]
    recent = [
        f
        for f, n, _ in replaced[-config.confirm_cycles :]
        if now.count - n <= config.confirm_cycles
    ]
    # Comparisons with NaN are false.
    astray = not math.isnan(state.fraction) and not _is_within(
        echo, (state.fraction, *recent), config.tolerance
    )
    late = (state.fraction, *(f for f, *_ in replaced)) if astray else ()
    return _Seen(
        replaced=replaced,
        obeys=abs(echo - state.fraction) <= config.tolerance,
        astray=astray,
        moved=astray
        and abs(echo - state.echo) > config.tolerance
        and not _is_within(echo, late, config.tolerance),
    )


def _choose(config, state, now, seen, *, is_arm_faulty):
    """Decides where the slider goes, and whether it obeys."""
    was_fault = state.phase == SliderPhase.FAULT
    obeyed = state.obeyed + 1 if seen.obeys else 0
    confirmed = state.confirmed or (
        seen.obeys and _is_standing(config, now.report)
    )
    operator = state.operator_fraction
    if seen.moved and config.yield_to_operator and not was_fault:
        operator = min(max(now.echo, 0.0), 1.0)
    ceiling, healthy = _calc_ceiling(
        config, state, now, is_down=bool(now.hold) or not confirmed
    )
    target = max(min(now.wanted, ceiling), config.minimum_fraction)
    target = min(target, operator)
    # A person left the slider at the target: nothing to correct.
    kept = seen.moved and target == now.echo
    astray = seen.astray and not kept
    deadline = _find_deadline(config, state, now, astray)
    if was_fault:
        fault = obeyed < config.confirm_cycles
    else:
        fault = now.count > deadline or math.isnan(now.echo)
    fault = fault or is_arm_faulty
    if fault:
        target, ceiling, deadline = 0.0, config.minimum_fraction, math.inf
        healthy = 0.0
        confirmed = was_fault and confirmed
    return _Choice(
        target=target,
        # In the first report of a session `fraction` is NaN.
        set_it=fault or (not kept and (astray or target != state.fraction)),
        fault=fault,
        astray=astray,
        confirmed=confirmed,
        obeyed=obeyed if was_fault == fault else 0,
        deadline=deadline,
        operator=operator,
        ceiling=ceiling,
        healthy=healthy,
    )


def _find_deadline(config, state, now, astray):
    """Returns the `count` by which setting it again must have worked."""
    if not astray:
        return math.inf
    if state.deadline == math.inf:
        return now.count + config.confirm_cycles
    return state.deadline


def _make_next_state(config, state, now, seen, arm, choice):
    """Returns the next state, with the command in it."""
    report, target = now.report, choice.target
    replaced = seen.replaced
    if target != state.fraction and not math.isnan(state.fraction):
        replaced = (*replaced, (state.fraction, now.count, report.timestamp))
    cause = now.hold or now.problem or state.cause
    if choice.fault:
        cause = "arm did not slow" if arm.problem else "slider did not obey"
    phase, reason = _describe(config, state, now, choice, arm.problem, cause)
    return SliderState(
        phase=phase,
        reason=reason,
        command=SliderCommand(
            sequence=report.sequence,
            mask=int(choice.set_it),
            speed_fraction=target,
            heartbeat=(state.command.heartbeat + (not choice.fault))
            & 0x7FFFFFFF,
        ),
        session=report.session,
        timestamp=report.timestamp,
        count=now.count,
        echo=now.echo,
        fraction=target,
        replaced=replaced,
        confirmed=choice.confirmed,
        obeyed=choice.obeyed,
        deadline=choice.deadline,
        operator_fraction=choice.operator,
        ceiling=choice.ceiling,
        healthy=choice.healthy,
        cause=cause,
        left_zero=report.timestamp
        if target > 0.0 == state.fraction
        else state.left_zero,
        arm=arm,
    )


def _watch_arm(config, state, now):
    """Returns whether the arm follows the slider."""
    report, echo = now.report, now.echo
    is_guided = report.robot_status_bits > 0 and bool(
        report.robot_status_bits & RobotStatusBit.TEACH_BUTTON
    )
    return step_arm(
        config.arm,
        state.arm,
        report,
        allowed=max(echo, state.fraction),
        lowest=config.minimum_fraction,
        joint_speeds=config.joint_speeds,
        # Without an echo it is unknown what the slider allows.
        is_judged=not (
            now.hold
            or is_guided
            or math.isnan(echo)
            or math.isnan(state.fraction)
        ),
    )


def find_operator_limit(config: SliderConfig, echo: float) -> float | None:
    """Returns the slider's limit, from where it stands at the start.

    Args:
        config: Settings; `operator_limit` is returned if it is set.
        echo: Where the slider stands before anything is written.

    Returns:
        For `operator_limit`; None: it is at 0 or at an unknown value.
    """
    if config.operator_limit is not None:
        return config.operator_limit
    if not (config.yield_to_operator and config.has_echo):
        return 1.0
    if not 0.0 < echo <= 1.0 + config.tolerance:
        return None
    # A value rounded down from 1 was not set by a person.
    return echo if echo < 1.0 - config.tolerance else 1.0


def _carry_operator(config, state, echo):
    """Returns a person's limit, as far as known at a new session.

    It is never above that of the previous session: a loose cable must not
    require a person to set the slider low again.
    """
    if math.isnan(state.operator_fraction):
        return find_operator_limit(config, echo) or 0.0
    written = (state.fraction, *(f for f, *_ in state.replaced))
    if (
        config.yield_to_operator
        and state.phase != SliderPhase.FAULT
        and echo < min(written) - config.tolerance
    ):
        # Lower than anything written: a person moved it meanwhile.
        return min(max(echo, 0.0), state.operator_fraction)
    return state.operator_fraction


def _calc_ceiling(config, state, now, *, is_down):
    """Returns the limit now, and how long there was no problem, s."""
    if is_down:
        return config.minimum_fraction, 0.0
    is_well = not now.problem
    elapsed = min(now.report.timestamp - state.timestamp, _LONGEST_STEP)
    reduced = config.reduced_fraction
    healthy = state.healthy if is_well else 0.0
    if healthy >= config.recovery_time:
        ceiling = state.ceiling + config.rise_rate * elapsed
        return (ceiling if ceiling < 1.0 else math.inf), healthy
    if state.ceiling > reduced:
        # Down from where the slider is, never up.
        ceiling = state.fraction - config.fall_rate * elapsed
        return max(ceiling, reduced), 0.0
    if is_well and abs(now.echo - reduced) <= config.tolerance:
        healthy += elapsed
    return min(state.ceiling + config.rise_rate * elapsed, reduced), healthy


def _is_standing(config, report):
    """Returns whether no joint is faster than the lowest fraction allows."""
    limit = _STANDING + config.minimum_fraction * _FASTEST
    return all(abs(v) <= limit for v in report.velocity.tolist())


def _is_within(value, values, tolerance):
    """Returns whether a value lies between others; never for NaN."""
    return min(values) - tolerance <= value <= max(values) + tolerance


def _describe(config, state, now, choice, arm_problem, cause):
    """Returns phase and reason."""
    report, target = now.report, choice.target
    echo = report.target_speed_fraction if config.has_echo else now.echo
    if choice.fault:
        reason = arm_problem or (
            f"slider does not obey: at {echo:.2f}, not {state.fraction:.2f}"
        )
        if state.phase == SliderPhase.FAULT and not arm_problem:
            reason = state.reason
        return SliderPhase.FAULT, reason
    if now.hold:
        return SliderPhase.HOLDING, _describe_hold(state, report, now.hold)
    if not choice.confirmed:
        reason = f"slider at {echo:.2f}, not yet seen at {target:.2f}"
        if abs(echo - target) <= 0.005:
            reason = "waiting until the robot stands still"
        return SliderPhase.WAITING, reason
    if choice.astray:
        reason = f"slider was moved to {echo:.2f}, is set to {target:.2f}"
        return SliderPhase.FOLLOWING, reason
    if choice.operator < now.wanted and target == choice.operator:
        return SliderPhase.YIELDING, _describe_operator(choice.operator)
    is_below = target < now.wanted
    if now.problem or (is_below and choice.healthy < config.recovery_time):
        # A present problem is reported beside it.
        after = "" if now.problem else f", after: {cause}"
        return SliderPhase.RECOVERING, (
            f"slider at most {config.reduced_fraction:.2f} for now{after}"
        )
    if is_below:
        reason = f"slider rises from a stop, at {target:.2f}"
        return SliderPhase.RISING, reason
    return SliderPhase.FOLLOWING, ""


def _describe_hold(state, report, hold):
    """Says why the slider stays at its lowest."""
    if (
        report.safety_mode == SafetyMode.PROTECTIVE_STOP
        and report.timestamp - state.left_zero < _OFFENCE
    ):
        return hold + ", right after the slider left 0: see minimum_fraction"
    return state.reason if state.reason.startswith(hold) else hold


def _describe_operator(operator):
    """Says that a person holds the slider low."""
    if operator <= _ZERO:
        return (
            "slider stands at 0, left by a person or an earlier run: "
            "raise it on the pendant"
        )
    return f"someone has set the slider to {operator:.2f}"
