"""Whether the arm does what its speed slider says.

The slider's echo says where the slider is, not how fast the arm moves. So
the measured joint speeds are compared with what the slider allows. One pure
function, `step_arm`, does it, once per report.

The arm is judged only while the robot's program plays: otherwise a person may
push the arm, and a protective stop may let it sag. The robot's own limiter
(`speed_scaling`) is not used: it can only lower the speed, and what it shows
is not published.
"""

import bisect
import dataclasses as dc
import math
import operator

import numpy as np

from tofssm_drake.errors import require
from tofssm_drake.messages import RobotReport

# Fractions within this of the lowest count as the lowest.
_ZERO = 0.005


@dc.dataclass(kw_only=True)
class ArmConfig:
    """How fast an arm must follow its speed slider."""

    # Time that the arm may take to follow the slider, s (assumed). Until then
    # it may still be as fast as the slider allowed before. The simulated UR
    # takes 0.2 s over the full range; 0.1 s is margin. How long a real one
    # takes is not published: measure it (docs/hardware.md). The law's T_stop
    # of 0.4 s is the time in which the slider itself falls: an arm that lags
    # by more than this needs a longer T_stop as well.
    ramp_time: float = 0.3

    # A joint may exceed the allowed fraction of its greatest speed by this
    # part of its greatest speed (assumed: 0.01 for a rounded echo, the rest
    # for overshoot).
    speed_margin: float = 0.1

    # Every joint must be at rest this long after the slider reached its
    # lowest, s (assumed: the 0.5 s that UR's own safety system allows for a
    # stop of category 1 or 2). A faulted arm must be at rest for as long
    # before it may move again.
    rest_time: float = 0.5

    # Up to this speed a joint is at rest, rad/s (assumed: five times what
    # counts as standing still, which is above the noise of a UR at rest).
    rest_speed: float = 0.05

    # An excess that lasts longer is a fault, s (assumed: a dozen reports of a
    # CB3, too long for noise).
    confirm_time: float = 0.1

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        for name, least, most, unit in (
            ("ramp_time", 0.0, 5.0, "s"),
            ("speed_margin", 0.0, 0.5, ""),
            ("rest_time", 0.0, 10.0, "s"),
            ("rest_speed", 0.0, 0.5, "rad/s"),
            ("confirm_time", 0.0, 1.0, "s"),
        ):
            value = getattr(self, name)
            require(
                least < value <= most,
                f"{where}.{name}: must be more than {least:g} and at most "
                f"{most:g} {unit}".rstrip()
                + f", got {value:g}",
            )
        require(
            self.ramp_time <= self.rest_time,
            f"{where}.rest_time: must not be less than ramp_time, "
            f"{self.ramp_time:g} s, got {self.rest_time:g}",
        )


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ArmState:
    """What is remembered of slider and arm from one report to the next."""

    allowed: tuple[tuple[float, float], ...] = ()
    """(robot's time until which it held, fraction that the slider allowed)
    of the last `rest_time`, s, with falling fractions; inf where the arm was
    not judged."""
    wrong_since: float = math.nan
    """Since when the arm has been too fast, s; NaN: it is not too fast."""
    resting_since: float = math.nan
    """Since when all joints have been at rest, s; NaN: they are not."""
    problem: str = ""
    """What has been wrong for long enough, in one line; else empty.
    It stays until the arm has been at rest for `rest_time`."""

    def __deepcopy__(self, memo):
        return self


def step_arm(
    config: ArmConfig,
    state: ArmState,
    report: RobotReport,
    *,
    allowed: float,
    lowest: float,
    joint_speeds: tuple[float, ...],
    is_judged: bool,
) -> ArmState:
    """Takes one report and says whether the arm obeys.

    Args:
        config: Settings; checked.
        state: After the report before, of the same session.
        report: The newest.
        allowed: What the slider allows: the greater of its echo and of what
            was written last, 0 to 1.
        lowest: Where the slider stands to stop the arm.
        joint_speeds: Greatest speed of each joint, rad/s, (6,).
        is_judged: The robot's program plays and nobody guides the arm.

    Returns:
        The next state; `problem` says whether the arm obeys.
    """
    now = report.timestamp
    # Plain numbers: faster than arrays of six.
    speeds = [abs(v) for v in report.velocity.tolist()]
    history = _remember(
        state.allowed, now, allowed if is_judged else math.inf, config.rest_time
    )
    rest = [config.rest_speed + lowest * speed for speed in joint_speeds]
    fraction = _find_fraction(history, now, config.ramp_time)
    factor = fraction + config.speed_margin
    limits = [factor * speed for speed in joint_speeds]
    # The first is the greatest.
    if history[0][1] <= lowest + _ZERO:
        limits = list(map(min, limits, rest))
    is_at_rest = _are_within(speeds, rest)
    is_wrong = is_judged and not _are_within(speeds, limits)
    resting_since = _keep(state.resting_since, now) if is_at_rest else math.nan
    wrong_since = _keep(state.wrong_since, now) if is_wrong else math.nan
    problem = state.problem
    if problem and now - resting_since >= config.rest_time:
        problem = ""
    if not problem and now - wrong_since >= config.confirm_time:
        problem = _describe(speeds, limits, fraction, joint_speeds)
    return ArmState(
        allowed=history,
        wrong_since=wrong_since,
        resting_since=resting_since,
        problem=problem,
    )


def _keep(since, now):
    """Returns when something that is true now began."""
    return now if math.isnan(since) else since


def _remember(history, now, allowed, duration):
    """Returns what the slider allowed recently, the newest last."""
    first, end = _find_recent(history, now, duration), len(history)
    # An older, lower fraction is not the greatest of any period.
    while end > first and history[end - 1][1] <= allowed:
        end -= 1
    return (*history[first:end], (now, allowed))


def _find_fraction(history, now, duration):
    """Returns the greatest fraction of the last seconds."""
    # The last is of now, whatever the clock shows.
    first = min(_find_recent(history, now, duration), len(history) - 1)
    return history[first][1]


def _find_recent(history, now, duration):
    """Returns the index of the first entry of the last seconds."""
    return bisect.bisect_left(
        history, True, key=lambda entry: now - entry[0] <= duration
    )


def _are_within(speeds, limits):
    """Returns whether no joint is faster than its limit; NaN is faster."""
    return all(map(operator.le, speeds, limits))


def _describe(speeds, limits, fraction, joint_speeds):
    """Returns which joint is too fast, in one line."""
    # The first NaN, else the one that exceeds its limit most.
    j = int(
        np.argmax(
            np.where(np.isnan(speeds), np.inf, np.subtract(speeds, limits))
        )
    )
    return (
        f"arm does not slow: joint {j + 1} at {speeds[j]:.2f} rad/s, the "
        f"slider allows {fraction * joint_speeds[j]:.2f}"
    )
