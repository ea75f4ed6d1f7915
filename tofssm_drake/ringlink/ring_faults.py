"""Faults of ring devices that show in the samples themselves."""

from collections.abc import Sequence

import numpy as np

from tofssm_drake.sensors.range_status import STATUS_NO_NEW_DATA, STATUS_VALID


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
    fewer = np.where(is_other_distance, np.maximum(repeats - 2, 0), 0)
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
