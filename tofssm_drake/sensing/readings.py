"""What a sensor's sample means to the monitor: the reading policy.

| status                | sample                       | reading             |
|-----------------------|------------------------------|---------------------|
| 0 valid               | plausible distance           | VALID, or MASKED    |
| 0 valid               | saturated, negative, not a   | FAULTED             |
|                       | number, beyond what is       |                     |
|                       | plausible                    |                     |
| 3 min range clipped   | nearer than can be measured  | VALID at 0 m, or    |
|                       |                              | MASKED              |
| 2 signal fail,        | nothing came back            | CLEAR               |
| 4 out of bounds,      |                              |                     |
| 7 wrap around         |                              |                     |
| 1 sigma fail          | there is something, how far  | FAULTED             |
|                       | it is can not be told        |                     |
| 254 no new data       | the sensor's sample before,  | as that sample was  |
|                       | until it is too old          |                     |
| 5, 6, 8, 10, 13, 14,  | broken, first or unchecked   | FAULTED             |
| 253, 255, any other   | sample, unknown              |                     |
| any                   | older than the deadline      | FAULTED             |

Only a fresh "nothing came back" is ever taken for clear. A valid distance
below the minimum range is detected but wrong, so it too counts as 0 m, the
nearest possible.
"""

import numpy as np

from tofssm_drake.kernels import njit
from tofssm_drake.messages import Reading, RingHealth
from tofssm_drake.sensing.vl53l1x import (
    SATURATED,
    STATUS_MIN_RANGE_CLIPPED,
    STATUS_OUT_OF_BOUNDS,
    STATUS_SIGNAL_FAIL,
    STATUS_VALID,
    STATUS_WRAP_AROUND,
)

# Numba freezes plain integers, not members of an enumeration.
_CLEAR = int(Reading.CLEAR)
_VALID = int(Reading.VALID)
_MASKED = int(Reading.MASKED)
_FAULTED = int(Reading.FAULTED)
_HEALTHY = int(RingHealth.HEALTHY)
_BLIND = int(RingHealth.BLIND)
_RING_FAULTED = int(RingHealth.FAULTED)


@njit(cache=True)
def classify_readings(
    distance,
    status,
    age,
    self_nearest,
    self_farthest,
    tolerance,
    min_range,
    max_range,
    max_age,
):
    """Tells what each sensor's sample means, by the table of this module.

    A sample is masked when its distance lies within the self-hits of the
    sensor's own rays, [self_nearest, self_farthest], widened by `tolerance`
    to both sides (paper, Self Occlusion Detection, with tolerance = 3 sigma).
    Where a self-hit is nearer than the minimum range, any distance up to the
    minimum range (plus tolerance) may come from it.

    Args:
        distance: (n,) m.
        status: (n,) range status.
        age: (n,) how long ago the sample was taken, s.
        self_nearest: (n,) m; inf where no ray hits the robot or its cell.
        self_farthest: (n,) m; -inf there.
        tolerance: m.
        min_range: a valid distance below it is nearer than can be measured.
        max_range: a valid distance above it is implausible, m.
        max_age: s.

    Returns:
        `Reading` (n,), uint8, and the distance to reckon with (n,), m: 0
        where it is the nearest possible, else as measured.
    """
    n = distance.shape[0]
    reading = np.empty(n, dtype=np.uint8)
    reckoned = distance.copy()
    for i in range(n):
        d = distance[i]
        s = status[i]
        if not age[i] <= max_age:
            reading[i] = _FAULTED
        elif s in (
            STATUS_SIGNAL_FAIL,
            STATUS_OUT_OF_BOUNDS,
            STATUS_WRAP_AROUND,
        ):
            reading[i] = _CLEAR
        elif s == STATUS_MIN_RANGE_CLIPPED or (
            s == STATUS_VALID and 0.0 <= d < min_range
        ):
            reckoned[i] = 0.0
            if self_nearest[i] - tolerance <= min_range:
                reading[i] = _MASKED
            else:
                reading[i] = _VALID
        elif s == STATUS_VALID and 0.0 <= d <= max_range and d < SATURATED:
            near = self_nearest[i] - tolerance
            far = self_farthest[i]
            if self_nearest[i] < min_range:
                far = max(far, min_range)
            if near <= d <= far + tolerance:
                reading[i] = _MASKED
            else:
                reading[i] = _VALID
        else:
            reading[i] = _FAULTED
    return reading, reckoned


@njit(cache=True)
def calc_self_interval(self_distance):
    """Returns the nearest and farthest self-hit of each sensor, m.

    Args:
        self_distance: (n, k) along each ray, m; inf where it hits nothing.

    Returns:
        Nearest (n,), inf where no ray hits; farthest (n,), -inf there.
    """
    n = self_distance.shape[0]
    nearest = np.full(n, np.inf)
    farthest = np.full(n, -np.inf)
    for i in range(n):
        for d in self_distance[i]:
            if d < np.inf:
                nearest[i] = min(nearest[i], d)
                farthest[i] = max(farthest[i], d)
    return nearest, farthest


@njit(cache=True)
def count_readings(reading):
    """Returns how many sensors are clear, valid, masked, faulted, (4,)."""
    count = np.zeros(4, dtype=np.int64)
    for r in reading:
        count[min(r, _FAULTED)] += 1
    return count


@njit(cache=True)
def calc_ring_health(count, max_faulted_sensors):
    """Tells from the readings' counts whether a ring can be trusted.

    FAULTED when more sensors are faulted than allowed, or all of them, or
    there are none. BLIND when every sensor that works is masked: nothing is
    known of the ring's surroundings. HEALTHY otherwise, so one clear or valid
    sensor is enough.

    Args:
        count: (4,) sensors that are clear, valid, masked, faulted.
        max_faulted_sensors: how many may be faulted at a time.

    Returns:
        `RingHealth` as an integer.
    """
    working = count[_CLEAR] + count[_VALID] + count[_MASKED]
    if count[_FAULTED] > max_faulted_sensors or working == 0:
        return _RING_FAULTED
    if count[_MASKED] == working:
        return _BLIND
    return _HEALTHY
