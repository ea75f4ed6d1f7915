"""Faults of ring devices that show in the samples themselves."""

from collections.abc import Sequence

import numpy as np

from tofssm_drake.sensing.vl53l1x import STATUS_NO_NEW_DATA, STATUS_VALID


def count_repeats(
    repeats: np.ndarray,
    *,
    before: Sequence[np.ndarray],
    now: Sequence[np.ndarray],
) -> np.ndarray:
    """Counts how often each sensor has repeated its sample to the last bit.

    Args:
        repeats: The counts so far, (n,).
        before: Millimetres and status of each sensor's last fresh sample,
            both (n,).
        now: Those of this frame.

    Returns:
        The counts with this frame, (n,). Where there is no new data the count
        is what it was.
    """
    (mm_before, status_before), (mm, status) = before, now
    is_same = (mm == mm_before) & (status == status_before)
    counts = np.where(is_same, repeats + 1, 0)
    return np.where(status == STATUS_NO_NEW_DATA, repeats, counts)


def find_frozen_sensors(
    repeats: np.ndarray, *, status: np.ndarray, frozen_samples: int
) -> np.ndarray:
    """Tells which sensors do not measure any more, though they answer.

    A measured distance has noise: a sensor that repeats one to the last bit
    is frozen. A sensor without a return proves nothing, since a device may
    report one and the same number for it.

    Where no sensor of the ring changes it is the device that repeats itself,
    and nothing that the ring says counts. The repetitions of all sensors
    with a distance are taken together then: eight of them are as little of a
    coincidence in 4 frames as one is in 25.

    Args:
        repeats: From `count_repeats`, (n,).
        status: Range status of each sensor's last fresh sample, (n,).
        frozen_samples: So many repetitions are no coincidence; 0: whatever
            repeats is fine.

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
