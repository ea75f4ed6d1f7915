"""What a sensor saw before: a failure must not make an obstacle disappear.

A sensor that saw something and then fails keeps its last distance. The
reading is HELD until the next good sample: the distance still counts, as of
the time when it was measured, and is assumed to shrink since then.

An empty room gives no return, but so does one sample in a few hundred of a
target that is there, and a limb that turns its dark or shiny side for a moment.
So a sensor that saw something must see nothing a few times in a row before it
is clear. A ring that does not see the robot where it must is blind: its missing
returns confirm nothing.

A target that cannot be measured gives no distance at all. If the sensor saw
nothing before, one such sample is tolerated as a lost one; after that the
target counts as being as near as possible, 0 m.

A sensor that fails again and again must not look healthy in between. Each
sensor has a lag: it grows with time while the sensor fails, and shrinks
`recovery_ratio` times as slowly while it works. While there is a lag, no
obstacle of that sensor disappears; if it is longer than
`separation.fault_time`, the sensor is faulted.

A sudden far value is believed no sooner than "nothing": it must come a few
times, and not as the very same number, which a stuck sensor would repeat.
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.errors import check_range, require
from tofssm_drake.kernels import njit
from tofssm_drake.messages import Reading, SensorFault

_CLEAR = int(Reading.CLEAR)
_VALID = int(Reading.VALID)
_FAULTED = int(Reading.FAULTED)
_HELD = int(Reading.HELD)
_NONE = int(SensorFault.NONE)
_SIGMA = int(SensorFault.SIGMA)
_DEAD = int(SensorFault.DEAD)

LONGEST_STEP = 0.1
"""A pause between samples counts as no more than this, s: the law judges what a
ring does not send by the age of its samples."""


@dc.dataclass(kw_only=True)
class SensorMemoryConfig:
    """How long a sensor's report of nothing there is not believed."""

    # A sensor that saw something is clear after this many samples in a row
    # without a return (*assumed*: 0.4 % of the samples of a target are lost
    # and look the same; an obstacle is forgotten by chance after one sample
    # in 55,000 with 2 and in 13 million with 3. 2 costs 7 % of the default
    # run's speed and 3 costs 14 %, since each limb that leaves a beam stays
    # for one or two samples more).
    clear_samples: int = 2

    # A target without a distance in this many samples in a row counts as
    # being as near as possible (*assumed*: one is usually a lost sample).
    sigma_samples: int = 2

    # A sensor that failed for some time must work this many times as long to
    # be as good as before (*assumed*: of a sensor that loses up to one sample
    # in six the lag does not grow).
    recovery_ratio: float = 5.0

    # With a longer lag than this the sensor is faulted though its last sample
    # was good, s (as `separation.fault_time`).
    unreliable_lag: float = 0.3

    # No lag is longer than this, s, or a sensor that was dead for a minute
    # would be distrusted for five.
    longest_lag: float = 0.5

    # An obstacle that moves away faster than this is another one, m/s
    # (*assumed*: a running person and the arm, each at 1.6 m/s), after
    # allowing `recede_margin`, m, for noise.
    recede_speed: float = 3.3
    recede_margin: float = 0.05

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        check_range(where, "recovery_ratio", self.recovery_ratio, 0.1, 1000.0)
        check_range(where, "unreliable_lag", self.unreliable_lag, 0.0, 10.0)
        check_range(
            where, "longest_lag", self.longest_lag, self.unreliable_lag, 10.0
        )
        check_range(where, "recede_speed", self.recede_speed, 0.0, 100.0)
        check_range(where, "recede_margin", self.recede_margin, 0.0, 10.0)
        for name in ("clear_samples", "sigma_samples"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and 1 <= value <= 100,
                f"{where}.{name}: {value} is out of range; use a whole number "
                "from 1 to 100",
            )


@njit(cache=True)
def calc_healthy_time(healthy_time, time, time_before, ratio, longest_lag):
    """Returns until when a sensor that works counts as having worked, s.

    Args:
        healthy_time: the same after the sample before, s; -inf: none yet.
        time: of the sample, s.
        time_before: of the sensor's sample before, whatever it was, s.
        ratio: see SensorMemoryConfig.
        longest_lag: likewise, s.

    Returns:
        The time of the sample less the lag that is left.
    """
    if healthy_time == -np.inf:
        return time
    worked = min(max(time - time_before, 0.0), LONGEST_STEP)
    lag = time - healthy_time - (1.0 + 1.0 / ratio) * worked
    return time - min(max(lag, 0.0), longest_lag)


@njit(cache=True)
def hold_obstacles(
    reading,
    fault,
    is_new,
    is_proven,
    has_lag,
    is_other,
    had_obstacle,
    counts,
    clear_samples,
    sigma_samples,
):
    """Turns readings into HELD ones where an obstacle must not disappear.

    Args:
        reading: `Reading` of each sensor's sample by itself, (n,); changed.
        fault: `SensorFault` of each sensor, (n,).
        is_new: whether the sample differs from that of the scan before, (n,).
        is_proven: whether the sensor's ring sees the robot where it must, (n,);
            if not, a sample without a return confirms nothing.
        has_lag: whether the sensor failed lately, (n,): no obstacle of it
            disappears.
        is_other: see `find_other_obstacles`, (n,).
        had_obstacle: whether the reading before was VALID or HELD, (n,).
        counts: samples in a row without a return; with a target but no
            distance; with another obstacle, see `find_other_obstacles`;
            (3, n); changed.
        clear_samples: see SensorMemoryConfig.
        sigma_samples: likewise.

    Returns:
        Where a HELD distance is not the one before but 0 m, as of now, (n,).
    """
    n = reading.shape[0]
    no_returns, unmeasured, others = counts[0], counts[1], counts[2]
    is_nearest = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        if fault[i] == _DEAD:
            reading[i] = _FAULTED
            continue
        is_clear = fault[i] == _NONE and reading[i] == _CLEAR
        if not is_clear or not is_proven[i]:
            no_returns[i] = 0
        elif is_new[i]:
            no_returns[i] += 1
        if fault[i] == _SIGMA:
            unmeasured[i] += is_new[i]
        elif not is_clear or no_returns[i] >= clear_samples:
            unmeasured[i] = 0
        is_unknown = (
            fault[i] != _NONE
            or (is_clear and (has_lag[i] or no_returns[i] < clear_samples))
            or (is_other[i] and others[i] < clear_samples)
        )
        if had_obstacle[i] and is_unknown:
            reading[i] = _HELD
        elif unmeasured[i] >= sigma_samples:
            reading[i] = _HELD
            is_nearest[i] = True
    return is_nearest


@njit(cache=True)
def find_other_obstacles(
    reading,
    had_obstacle,
    distance,
    time,
    before,
    is_changed,
    has_lag,
    recede,
    others,
):
    """Finds valid distances too far away to be the obstacle seen before.

    Args:
        reading: `Reading` of each sensor's sample by itself, (n,).
        had_obstacle: whether the reading before was VALID or HELD, (n,).
        distance: of the samples, m, (n,).
        time: of the samples, s, (n,).
        before: distance, m, and time, s, of the obstacle before, (2, n).
        is_changed: whether the sample is new and its distance is not that of
            the sample before to the last digit, (n,).
        has_lag: whether the sensor failed lately, (n,): then none counts, and
            no obstacle may move away by more than the margin.
        recede: recede_speed, m/s, and recede_margin, m.
        others: how many such samples came in a row, (n,); changed.

    Returns:
        Whether there is such a distance, (n,).
    """
    n = reading.shape[0]
    is_other = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        if reading[i] != _VALID:
            continue
        away = distance[i] - before[0, i] - recede[1]
        elapsed = max(time[i] - before[1, i], 0.0)
        is_other[i] = had_obstacle[i] and (
            away > recede[0] * elapsed
            or (away > 0.0 and (has_lag[i] or others[i] > 0))
        )
        if not is_other[i] or has_lag[i]:
            others[i] = 0
        elif is_changed[i]:
            others[i] += 1
    return is_other
