"""When to write the robot's speed slider, and whether it obeys.

The slider is a wish, not a fact: a write may be lost, a person may move the
slider, a pause may reset it. So each report's echo, `target_speed_fraction`,
is compared with what was written, and the arm's speed with what the echo allows
(`arm_obedience.py`). One pure function, `step_slider`, does it all, once per
report.
"""

import dataclasses as dc
import enum
import math

from tofssm_drake.errors import require
from tofssm_drake.hardware.arm_obedience import ArmConfig, ArmState, step_arm
from tofssm_drake.hardware.rtde_fields import (
    RobotMode,
    RobotStatusBit,
    RuntimeState,
    SafetyMode,
    SafetyStatusBit,
    name_of,
)
from tofssm_drake.messages import RobotReport, SliderCommand

# After a gap between reports the fraction rises as if it was only that, s.
_LONGEST_STEP = 0.05
# An echo of what was written that long ago is a late one, and nobody's hand, s.
_LATE = 0.25
# A robot whose joints are not faster stands still, rad/s; and the fastest
# joint of all, which at the lowest fraction may creep on.
_STANDING = 0.01
_FASTEST = 3.2
# An echo that is not above it is 0.
_ZERO = 0.005
# Safety status bits with which a robot may move.
_MOVING = SafetyStatusBit.NORMAL | SafetyStatusBit.REDUCED
# A protective stop that soon after the slider left 0 came of that, s.
_OFFENCE = 1.0


@dc.dataclass(kw_only=True)
class SliderConfig:
    """How the speed slider is used."""

    # The echo must follow a write within that many reports, one per control
    # cycle; else it is written once more, and if that does not help either it
    # is a fault.
    confirm_cycles: int = 5

    # Echo and wish may differ by that much (assumed: how a controller rounds
    # is not published).
    tolerance: float = 0.01

    # The slider is never set lower, except in a fault. 0 stops the robot.
    # Some robots were reported to answer the step from 0 upwards with a
    # protective stop; for them a value such as 0.01 lets the robot creep
    # instead of stopping, and what then really stops it must be another.
    minimum_fraction: float = 0.0

    # After a pause, a stop, a fault or a new connection the fraction may grow
    # no faster than that, 1/s.
    rise_rate: float = 2.0

    # The way back to speed leads through that fraction, the safety law's of
    # the reduced state: the slider must have stood there for that long, s,
    # with all being well (assumed: five times as long as a sample of a ring
    # may be old).
    reduced_fraction: float = 0.5
    recovery_time: float = 0.5

    # If a fault ends before the law has slowed the robot down that far, the
    # slider does so at that rate, 1/s (the law's own).
    fall_rate: float = 10.0 / 3.0

    # What happens if someone sets the slider lower than wanted: True leaves
    # it there until someone raises it, False sets it back.
    yield_to_operator: bool = True

    # Up to where the slider may go at first, 0 to 1, until a person moves it.
    # None: no further than where it stands at the start, since a person may
    # have set it there. What an earlier run left at 0 stays there until
    # somebody raises it.
    operator_limit: float | None = None

    # How fast the arm must follow the slider.
    arm: ArmConfig = dc.field(default_factory=ArmConfig)

    # Greatest speed of each joint, rad/s: who makes the system puts the robot
    # model's here. These are a UR10's (Universal Robots' user manual).
    joint_speeds: tuple[float, ...] = (2.0944, 2.0944, *4 * (3.1416,))

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
            self.minimum_fraction < self.reduced_fraction < 1,
            f"{where}.reduced_fraction: must be above minimum_fraction, "
            f"{self.minimum_fraction:g}, and below 1, "
            f"got {self.reduced_fraction:g}",
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
        self.arm.check(f"{where}.arm")


class SliderPhase(enum.IntEnum):
    """What the slider is up to."""

    WAITING = 0
    """No report yet, or robot and slider were not yet seen at rest."""
    FOLLOWING = 1
    """The echo is what was written."""
    RISING = 2
    """So it is, but the fraction may grow only slowly for now."""
    YIELDING = 3
    """Someone has set it lower, and that holds."""
    HOLDING = 4
    """The robot does not run its program: the slider stays lowest."""
    FAULT = 5
    """Echo or arm does not follow: 0 is written, the heartbeat stops."""
    RECOVERING = 6
    """Something was wrong, or is: no more than the reduced fraction."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SliderState:
    """All that is remembered from one report to the next."""

    phase: SliderPhase = SliderPhase.WAITING
    reason: str = "no report from the robot yet"
    """Why the slider is not simply following, in one line; else empty."""
    command: SliderCommand = dc.field(default_factory=SliderCommand)
    """What to send now, in answer to the report of its sequence."""
    session: int = -1
    """Of that report."""
    timestamp: float = math.nan
    """Of that report, s on the robot's clock."""
    count: int = 0
    """Of reports answered."""
    echo: float = math.nan
    """Of that report: where the slider was."""
    fraction: float = math.nan
    """Where it was last set or left; NaN: not yet in this session."""
    replaced: tuple[tuple[float, int, float], ...] = ()
    """(fraction, `count` and `timestamp` when another took its place) of
    late."""
    confirmed: bool = False
    """The echo was `fraction` at least once since a start or a fault, while
    the robot stood still."""
    obeyed: int = 0
    """For how many reports in a row it is so by now."""
    deadline: float = math.inf
    """`count` by which setting it once more must have helped."""
    operator_fraction: float = math.nan
    """What a person at the slider allows, also in the sessions to come; NaN:
    nothing was seen yet."""
    ceiling: float = 0.0
    """What is allowed after a hold or a fault, growing; inf: no limit."""
    healthy: float = 0.0
    """For how long all was well at the reduced fraction, since `cause`, s."""
    cause: str = ""
    """What was wrong last."""
    left_zero: float = -math.inf
    """When the slider was last set from 0 to more, s."""
    arm: ArmState = dc.field(default_factory=ArmState)
    """Whether the arm follows the slider."""

    def __deepcopy__(self, memo):
        return self


def find_hold(report: RobotReport) -> str:
    """Returns why the robot does not run its program; "" if it does."""
    if report.robot_mode != RobotMode.RUNNING:
        return f"robot mode: {name_of(RobotMode, report.robot_mode)}"
    for mode in (report.safety_mode, report.safety_status):
        # Older software has no safety status: -1.
        if mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED, -1):
            return f"safety mode: {name_of(SafetyMode, mode)}"
    # What contradicts the mode counts as well; 0 is of those that say nothing.
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
    """Takes one report and says what to send in answer.

    The mask of the command is 1 only where the slider must be set: when the
    wanted fraction changed or the echo is astray. Otherwise a person could
    not move it.

    Whatever was wrong, with the robot or with what the monitor knows, the
    fraction grows again only through `reduced_fraction`. A problem of the
    monitor's does not stop the robot here: the safety law does.

    Args:
        config: Settings.
        state: After the report before.
        report: The newest; if it is not new, nothing changes.
        wanted: Speed fraction of the safety law; not a number counts as 0.
        problem: Why the monitor's data are not fresh and healthy; empty: they
            are.

    Returns:
        The next state, with the command in it.
    """
    if report.sequence < 0 or report.sequence == state.command.sequence:
        return state
    echo = report.target_speed_fraction
    if not -config.tolerance <= echo <= 1.0 + config.tolerance:
        # No slider stands there, and nobody's hand has put it there.
        echo = math.nan
    if report.session != state.session or state.count == 0:
        # The new session knows nothing of what was written in the old one.
        state = SliderState(
            command=state.command,
            count=state.count,
            ceiling=config.minimum_fraction,
            cause="new session with the robot",
            operator_fraction=_carry_operator(config, state, echo),
        )
    # Reports are counted, not time: a computer that was late has neither
    # written nor looked in the meantime.
    now = state.count + 1
    wanted = min(wanted, 1.0) if wanted > 0.0 else 0.0
    hold = find_hold(report)
    was_fault = state.phase == SliderPhase.FAULT
    fresh = math.isnan(state.fraction)
    arm = _watch_arm(config, state, report, echo, hold)

    replaced = tuple(
        p for p in state.replaced if report.timestamp - p[2] <= _LATE
    )
    # Comparisons with an echo that is not a number are all false.
    obeys = abs(echo - state.fraction) <= config.tolerance
    recent = [f for f, n, _ in replaced if now - n <= config.confirm_cycles]
    astray = not fresh and not _is_within(
        echo, (state.fraction, *recent), config.tolerance
    )
    moved = (
        astray
        and abs(echo - state.echo) > config.tolerance
        and not _is_within(
            echo, (state.fraction, *(f for f, *_ in replaced)), config.tolerance
        )
    )
    obeyed = state.obeyed + 1 if obeys else 0
    confirmed = state.confirmed or (obeys and _is_standing(config, report))
    operator = state.operator_fraction
    if moved and config.yield_to_operator and not was_fault:
        operator = min(max(echo, 0.0), 1.0)

    ceiling, healthy = _calc_ceiling(
        config,
        state,
        echo=echo,
        elapsed=min(report.timestamp - state.timestamp, _LONGEST_STEP),
        is_down=bool(hold) or not confirmed,
        is_well=not problem,
    )
    target = max(min(wanted, ceiling), config.minimum_fraction)
    target = min(target, operator)

    # Whoever left the slider where it may be needs no correction.
    astray = astray and not (moved and target == echo)
    deadline = state.deadline if astray else math.inf
    if astray and deadline == math.inf:
        deadline = now + config.confirm_cycles
    if was_fault:
        fault = obeyed < config.confirm_cycles
    else:
        fault = now > deadline or math.isnan(echo)
    fault = fault or bool(arm.problem)
    if fault:
        target, ceiling, deadline = 0.0, config.minimum_fraction, math.inf
        healthy = 0.0
        confirmed = was_fault and confirmed
    if was_fault != fault:
        obeyed = 0
    set_it = fault or fresh or astray or target != state.fraction
    if moved and target == echo:
        set_it = fault
    if target != state.fraction and not fresh:
        replaced = (*replaced, (state.fraction, now, report.timestamp))
    cause = hold or problem or state.cause
    if fault:
        cause = "arm did not slow" if arm.problem else "slider did not obey"
    recovering = problem or (target < wanted and healthy < config.recovery_time)
    return SliderState(
        **_describe(
            state,
            report,
            wanted=wanted,
            target=target,
            hold=hold,
            fault=fault,
            arm_problem=arm.problem,
            astray=astray,
            confirmed=confirmed,
            operator=operator,
            recovering=f"slider at most {config.reduced_fraction:.2f} for "
            f"now{': ' if problem else ', after: '}{cause}"
            if recovering
            else "",
        ),
        command=SliderCommand(
            sequence=report.sequence,
            mask=int(set_it),
            speed_fraction=target,
            heartbeat=(state.command.heartbeat + (not fault)) & 0x7FFFFFFF,
        ),
        session=report.session,
        timestamp=report.timestamp,
        count=now,
        echo=echo,
        fraction=target,
        replaced=replaced,
        confirmed=confirmed,
        obeyed=obeyed,
        deadline=deadline,
        operator_fraction=operator,
        ceiling=ceiling,
        healthy=healthy,
        cause=cause,
        left_zero=report.timestamp
        if target > 0.0 == state.fraction
        else state.left_zero,
        arm=arm,
    )


def _watch_arm(config, state, report, echo, hold):
    """Returns whether the arm follows the slider."""
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
        # Without an echo nobody knows what the slider allows.
        is_judged=not (
            hold or is_guided or math.isnan(echo) or math.isnan(state.fraction)
        ),
    )


def find_operator_limit(config: SliderConfig, echo: float) -> float | None:
    """Returns up to where the slider may go, by where it stands at first.

    Args:
        config: Settings; with `operator_limit` it is that.
        echo: Where the slider stands before anything was written.

    Returns:
        For `operator_limit`; None: it stands at 0, or nobody knows where.
    """
    if config.operator_limit is not None:
        return config.operator_limit
    if not config.yield_to_operator:
        return 1.0
    if not 0.0 < echo <= 1.0 + config.tolerance:
        return None
    # One that is rounded down from 1 is nobody's hand.
    return echo if echo < 1.0 - config.tolerance else 1.0


def _carry_operator(config, state, echo):
    """Returns what a person allows as far as is known at a new session.

    No more than in the session before: nobody is asked to set the slider
    low a second time because a cable was loose.
    """
    if math.isnan(state.operator_fraction):
        return find_operator_limit(config, echo) or 0.0
    written = (state.fraction, *(f for f, *_ in state.replaced))
    if (
        config.yield_to_operator
        and state.phase != SliderPhase.FAULT
        and echo < min(written) - config.tolerance
    ):
        # Lower than all that may have been written: a person, meanwhile.
        return min(max(echo, 0.0), state.operator_fraction)
    return state.operator_fraction


def _calc_ceiling(config, state, *, echo, elapsed, is_down, is_well):
    """Returns what is allowed now, and for how long all was well, s."""
    if is_down:
        return config.minimum_fraction, 0.0
    reduced = config.reduced_fraction
    healthy = state.healthy if is_well else 0.0
    if healthy >= config.recovery_time:
        ceiling = state.ceiling + config.rise_rate * elapsed
        return (ceiling if ceiling < 1.0 else math.inf), healthy
    if state.ceiling > reduced:
        # From where the slider is; never up again.
        ceiling = state.fraction - config.fall_rate * elapsed
        return max(ceiling, reduced), 0.0
    if is_well and abs(echo - reduced) <= config.tolerance:
        healthy += elapsed
    return min(state.ceiling + config.rise_rate * elapsed, reduced), healthy


def _is_standing(config, report):
    """Returns whether the robot stands still, or creeps if that is lowest."""
    limit = _STANDING + config.minimum_fraction * _FASTEST
    return bool((abs(report.velocity) <= limit).all())


def _is_within(value, values, tolerance):
    """Returns whether a value lies between others; NaN does not."""
    return min(values) - tolerance <= value <= max(values) + tolerance


def _describe(
    state,
    report,
    *,
    wanted,
    target,
    hold,
    fault,
    arm_problem,
    astray,
    confirmed,
    operator,
    recovering,
):
    """Returns phase and reason."""
    echo = report.target_speed_fraction
    if fault:
        reason = arm_problem or (
            f"slider does not obey: at {echo:.2f}, not {state.fraction:.2f}"
        )
        if state.phase == SliderPhase.FAULT and not arm_problem:
            reason = state.reason
        return {"phase": SliderPhase.FAULT, "reason": reason}
    if hold:
        if (
            report.safety_mode == SafetyMode.PROTECTIVE_STOP
            and report.timestamp - state.left_zero < _OFFENCE
        ):
            hold += ", right after the slider left 0: see minimum_fraction"
        elif state.reason.startswith(hold):
            hold = state.reason
        return {"phase": SliderPhase.HOLDING, "reason": hold}
    if not confirmed:
        reason = f"slider at {echo:.2f}, not yet seen at {target:.2f}"
        if abs(echo - target) <= 0.005:
            reason = "waits until the robot stands still"
        return {"phase": SliderPhase.WAITING, "reason": reason}
    if astray:
        reason = f"slider was moved to {echo:.2f}, is set to {target:.2f}"
        return {"phase": SliderPhase.FOLLOWING, "reason": reason}
    if operator < wanted and target == operator:
        reason = f"someone has set the slider to {operator:.2f}"
        if operator <= _ZERO:
            reason = (
                "slider stands at 0, left by a person or an earlier run: "
                "raise it on the pendant"
            )
        return {"phase": SliderPhase.YIELDING, "reason": reason}
    if recovering:
        return {"phase": SliderPhase.RECOVERING, "reason": recovering}
    if target < wanted:
        reason = f"slider rises from a stop, at {target:.2f}"
        return {"phase": SliderPhase.RISING, "reason": reason}
    return {"phase": SliderPhase.FOLLOWING, "reason": ""}
