"""Faults of ring devices that show in the samples themselves."""

from collections.abc import Sequence
import math

import numpy as np

from tofssm_drake.sensors.range_sensor import SensorTraits
from tofssm_drake.sensors.range_status import STATUS_NO_NEW_DATA, STATUS_VALID

# A changed distance takes this many repetitions back.
_TAKEN_BACK = 2

# This many are no coincidence if noise has a standard deviation of 0.75 of the
# step (*assumed*: 0.75 mm, 0.15 % of half a metre, in a frame's millimetres):
# with 24 sensors at 42 Hz they come together once in some years.
FROZEN_SAMPLES = 25
_USUAL_NOISE = 0.75

# With more, a ring would be found too late to be of use.
_MOST_FROZEN_SAMPLES = 1000


def calc_repeat_probability(noise: float) -> float:
    """Returns how likely two samples of a still target are the same.

    The target is where that is likeliest, in the middle of a step.

    Args:
        noise: Standard deviation of a distance, in steps of what is reported.
    """
    if noise <= 0.0:
        return 1.0
    # Most of the sum is within five standard deviations.
    k = np.arange(math.ceil(5.0 * noise) + 2)
    below = np.array([math.erf((i + 0.5) / (noise * math.sqrt(2))) for i in k])
    within = np.diff(below, prepend=0.0)  # Of steps 0, +-1, +-2, ...
    return float(within[0] ** 2 + 0.5 * (within[1:] ** 2).sum())


def _calc_rarity(probability):
    """Returns by which factor each further repetition is rarer.

    The count of `count_repeats` is a random walk, up by 1 with this
    probability, else down by 2; a count of n comes with a probability of about
    this factor to the power of -n. At 1 or below it grows by itself.
    """
    p, q = probability, 1.0 - probability
    return (q + math.sqrt(q * q + 4.0 * p * q)) / (2.0 * p)


def calc_frozen_samples(sensor: SensorTraits) -> int:
    """Returns how many repetitions of a distance are no coincidence.

    Args:
        sensor: What its model says of it. A coarse step with little noise
            repeats distances rightly.

    Returns:
        For `find_frozen_sensors`; 0: no number proves anything.
    """
    # A frame has millimetres.
    noise = sensor.least_noise / max(sensor.resolution, 0.001)
    rarity = _calc_rarity(calc_repeat_probability(noise))
    if rarity <= 1.0:
        return 0
    usual = _calc_rarity(calc_repeat_probability(_USUAL_NOISE))
    needed = FROZEN_SAMPLES * math.log(usual) / math.log(rarity)
    if needed > _MOST_FROZEN_SAMPLES:
        return 0
    return max(FROZEN_SAMPLES, math.ceil(needed - 1e-9))


def count_repeats(
    repeats: np.ndarray,
    *,
    before: Sequence[np.ndarray],
    now: Sequence[np.ndarray],
    most: int,
) -> np.ndarray:
    """Counts how often each sensor has repeated its sample to the last bit.

    A distance that changes takes two repetitions back, not all of them: a
    device that sends each sample several times is found as well.

    Args:
        repeats: The counts so far, (n,).
        before: Millimetres and status of each sensor's last fresh sample,
            both (n,).
        now: Those of this frame.
        most: No count is higher, so that a sensor that works again is trusted
            again.

    Returns:
        The counts with this frame, (n,). Where there is no new data the count
        is what it was.
    """
    (mm_before, status_before), (mm, status) = before, now
    is_same = (mm == mm_before) & (status == status_before)
    is_other_distance = (status == STATUS_VALID) & (status == status_before)
    fewer = np.where(is_other_distance, np.maximum(repeats - _TAKEN_BACK, 0), 0)
    counts = np.where(is_same, np.minimum(repeats + 1, most), fewer)
    return np.where(status == STATUS_NO_NEW_DATA, repeats, counts)


def find_frozen_sensors(
    repeats: np.ndarray, *, status: np.ndarray, frozen_samples: int
) -> np.ndarray:
    """Returns which sensors have stopped measuring, though they answer.

    A measured distance has noise: a sensor that repeats one bit for bit is
    frozen. A sensor without a return proves nothing, since a device may always
    report the same number for it.

    If no sensor of the ring changes, the device repeats itself and nothing
    that the ring reports counts. Then the repetitions of all sensors with a
    distance are added up: eight of them in 4 frames are as unlikely a
    coincidence as one in 25.

    Args:
        repeats: From `count_repeats`, (n,).
        status: Range status of each sensor's last fresh sample, (n,).
        frozen_samples: This many repetitions are not a coincidence; 0: any
            number is.

    Returns:
        Whether each sensor is frozen, (n,).
    """
    if frozen_samples == 0:
        return np.zeros(len(repeats), dtype=bool)
    is_valid = status == STATUS_VALID
    frames = int(repeats.min())
    if frames * int(is_valid.sum()) >= frozen_samples:
        return np.ones(len(repeats), dtype=bool)
    return (repeats >= frozen_samples) & is_valid
