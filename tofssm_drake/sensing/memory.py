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
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.errors import require
from tofssm_drake.kernels import njit
from tofssm_drake.messages import Reading, SensorFault

_CLEAR = int(Reading.CLEAR)
_VALID = int(Reading.VALID)
_FAULTED = int(Reading.FAULTED)
_HELD = int(Reading.HELD)
_NONE = int(SensorFault.NONE)
_SIGMA = int(SensorFault.SIGMA)
_DEAD = int(SensorFault.DEAD)


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

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        for name in ("clear_samples", "sigma_samples"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and 1 <= value <= 100,
                f"{where}.{name}: {value} is out of range; use a whole number "
                "from 1 to 100",
            )


@njit(cache=True)
def hold_obstacles(
    reading,
    fault,
    is_new,
    is_proven,
    had_obstacle,
    no_returns,
    unmeasured,
    clear_samples,
    sigma_samples,
):
    """Makes readings HELD where an obstacle must not disappear.

    Args:
        reading: `Reading` of each sensor's sample alone, (n,); changed.
        fault: `SensorFault` of each sensor, (n,).
        is_new: whether the sample differs from that in the previous scan,
            (n,).
        is_proven: whether the sensor's ring sees the robot where it must,
            (n,); otherwise a sample without a return confirms nothing.
        had_obstacle: whether the previous reading was VALID or HELD, (n,).
        no_returns: samples in a row without a return, (n,); changed.
        unmeasured: samples in a row with a target but no distance, (n,);
            changed.
        clear_samples: see SensorMemoryConfig.
        sigma_samples: likewise.

    Returns:
        Where a HELD distance is not the previous one but 0 m, as of now, (n,).
    """
    n = reading.shape[0]
    is_nearest = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        if fault[i] == _DEAD:
            reading[i] = _FAULTED
            continue
        if fault[i] != _NONE or reading[i] != _CLEAR:
            no_returns[i] = 0
        elif not is_proven[i]:
            no_returns[i] = 0
        elif is_new[i]:
            no_returns[i] += 1
        if fault[i] != _SIGMA:
            unmeasured[i] = 0
        elif is_new[i]:
            unmeasured[i] += 1
        is_unknown = fault[i] != _NONE or (
            reading[i] == _CLEAR and no_returns[i] < clear_samples
        )
        if had_obstacle[i] and is_unknown:
            reading[i] = _HELD
        elif unmeasured[i] >= sigma_samples:
            reading[i] = _HELD
            is_nearest[i] = True
    return is_nearest
