"""What a sensor's sample means to the monitor: the reading policy.

ST's manuals (UM2356 for the full driver, UM2510 and UM2931 for the small
ones) define the range statuses. If one can mean two things, the worse is
taken:

| status            | what ST says of it            | reading                 |
|-------------------|-------------------------------|-------------------------|
| 0 valid           | a distance                    | VALID, or MASKED        |
| 0 valid           | (beyond the mode, negative)   | fault IMPLAUSIBLE       |
| 0, 2, 4, 7        | (a distance that is not a     | fault IMPLAUSIBLE       |
|                   | number)                       |                         |
| 3 min range       | nearer than can be measured   | VALID at 0 m, or MASKED |
| clipped, 13 min   |                               |                         |
| range fail        |                               |                         |
| 2 signal fail     | too far, too dark, too small  | CLEAR, once confirmed   |
| 4 out of bounds   | nothing within the mode       | CLEAR, once confirmed   |
| 7 wrap around     | farther than the mode         | CLEAR, once confirmed   |
| 1 sigma fail      | a target, but too noisy       | fault SIGMA             |
| 9 cross-talk      | signal hidden by cross-talk   | fault SIGMA             |
| 12 lack of signal | a target, but too weak        | fault SIGMA             |
| 6, 11             | valid, but unchecked for      | fault SIGMA             |
|                   | wrapping, or two targets in   |                         |
|                   | one                           |                         |
| 254 no new data   | (this project's)              | the sample before, until|
|                   |                               | it is too old           |
| 253               | (this project's) no answer on | fault BUS               |
|                   | the bus                       |                         |
| 240, 241, 242     | (the host's) frozen,          | fault of that name      |
|                   | self-test, contested          |                         |
| 5, 8, 10, 14,     | broken, first or invalid      | fault HARDWARE          |
| 255, any other    | sample, unknown               |                         |
| any               | older than the deadline       | fault LATE              |

A fault makes the reading FAULTED here. `tofssm_drake.perception.memory` handles
what a sensor saw before and how a missing return is confirmed.

Statuses 2, 4 and 7 must be clear, because an empty room gives them all the
time. A target that gives one of them within the usable range is darker than
anything that the sensor is specified for; a person in such clothes cannot be
seen, whatever is done here.

A valid distance below the minimum range is detected but wrong, so it also
counts as 0 m.
"""

import math

import numpy as np

from tofssm_drake.kernels import njit
from tofssm_drake.messages import Reading, RingHealth, SensorFault
from tofssm_drake.sensors.range_status import (
    SATURATED,
    STATUS_BUS_FAILURE,
    STATUS_CONTESTED,
    STATUS_FROZEN,
    STATUS_MIN_RANGE_CLIPPED,
    STATUS_MIN_RANGE_FAIL,
    STATUS_NO_NEW_DATA,
    STATUS_OUT_OF_BOUNDS,
    STATUS_SELF_TEST,
    STATUS_SIGNAL_FAIL,
    STATUS_VALID,
    STATUS_WRAP_AROUND,
)

# Numba freezes plain integers, not members of an enumeration.
_CLEAR = int(Reading.CLEAR)
_VALID = int(Reading.VALID)
_MASKED = int(Reading.MASKED)
_FAULTED = int(Reading.FAULTED)
_HELD = int(Reading.HELD)
_NONE = int(SensorFault.NONE)
_BUS = int(SensorFault.BUS)
_NO_DATA = int(SensorFault.NO_DATA)
_LATE = int(SensorFault.LATE)
_IMPLAUSIBLE = int(SensorFault.IMPLAUSIBLE)
_SIGMA = int(SensorFault.SIGMA)
_HARDWARE = int(SensorFault.HARDWARE)
_FROZEN = int(SensorFault.FROZEN)
_SELF_TEST = int(SensorFault.SELF_TEST)
_CONTESTED = int(SensorFault.CONTESTED)
_DEAD = int(SensorFault.DEAD)
_HEALTHY = int(RingHealth.HEALTHY)
_BLIND = int(RingHealth.BLIND)
_RING_FAULTED = int(RingHealth.FAULTED)
_DEGRADED = int(RingHealth.DEGRADED)

# Something is there at an unknown distance: sigma fail, unchecked for
# wrapping, hidden by cross-talk, merged targets, lack of signal.
_UNMEASURED = (1, 6, 9, 11, 12)


@njit(cache=True)
def find_fault(status, age, max_age):
    """Returns the `SensorFault` that follows from status and age of a sample.

    Args:
        status: range status.
        age: of the sample, s; NaN is too old.
        max_age: s.
    """
    if status == STATUS_BUS_FAILURE:
        return _BUS
    if status == STATUS_FROZEN:
        return _FROZEN
    if status == STATUS_SELF_TEST:
        return _SELF_TEST
    if status == STATUS_CONTESTED:
        return _CONTESTED
    if status == STATUS_NO_NEW_DATA:
        return _NO_DATA
    if not age <= max_age:
        return _LATE
    if status in _UNMEASURED:
        return _SIGMA
    if status in (
        STATUS_VALID,
        STATUS_SIGNAL_FAIL,
        STATUS_MIN_RANGE_CLIPPED,
        STATUS_OUT_OF_BOUNDS,
        STATUS_WRAP_AROUND,
        STATUS_MIN_RANGE_FAIL,
    ):
        return _NONE
    return _HARDWARE


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
    """Classifies each sensor's sample, by the table of this module.

    A sample is masked when its distance lies within the self-hits of the
    sensor's own rays, [self_nearest, self_farthest], widened by `tolerance`
    to both sides (paper, Self Occlusion Detection, with tolerance = 3 sigma).
    Where a self-hit is nearer than the minimum range, any distance up to the
    minimum range (plus tolerance) may come from it.

    Args:
        distance: (n,) m.
        status: (n,) range status.
        age: (n,) of the samples, s.
        self_nearest: (n,) m; inf where no ray hits the robot or its cell.
        self_farthest: (n,) m; -inf there.
        tolerance: m.
        min_range: a valid distance below it is too near to be measured, m.
        max_range: a valid distance above it is implausible, m.
        max_age: s.

    Returns:
        `Reading` (n,), uint8; `SensorFault` (n,), uint8; and the distance to
        use (n,), m: 0 if too near to be measured, else as measured.
    """
    n = distance.shape[0]
    reading = np.empty(n, dtype=np.uint8)
    fault = np.empty(n, dtype=np.uint8)
    counted = distance.copy()
    for i in range(n):
        d = distance[i]
        s = status[i]
        fault[i] = find_fault(s, age[i], max_age)
        is_near = s == STATUS_MIN_RANGE_CLIPPED or s == STATUS_MIN_RANGE_FAIL
        if math.isnan(d) and not is_near:
            # Also with "no return": such a sensor is not to be trusted.
            fault[i] = fault[i] or _IMPLAUSIBLE
        if s == STATUS_VALID:
            if not (0.0 <= d <= max_range and d < SATURATED):
                fault[i] = fault[i] or _IMPLAUSIBLE
            is_near = d < min_range
        if fault[i] != _NONE:
            reading[i] = _FAULTED
        elif is_near:
            counted[i] = 0.0
            is_own = self_nearest[i] - tolerance <= min_range
            reading[i] = _MASKED if is_own else _VALID
        elif s == STATUS_VALID:
            near = self_nearest[i] - tolerance
            far = self_farthest[i]
            if self_nearest[i] < min_range:
                far = max(far, min_range)
            is_own = near <= d <= far + tolerance
            reading[i] = _MASKED if is_own else _VALID
        else:
            reading[i] = _CLEAR
    return reading, fault, counted


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
    """Returns the numbers of clear, valid, masked and faulted sensors, (4,).

    A held distance counts as valid: it is an obstacle.
    """
    count = np.zeros(4, dtype=np.int64)
    for r in reading:
        if r == _HELD:
            r = _VALID
        count[min(r, _FAULTED)] += 1
    return count


@njit(cache=True)
def calc_ring_health(reading, fault, faulted_for, fault_time):
    """Judges from its sensors whether a ring can be trusted.

    FAULTED if a sensor has been faulted for longer than `fault_time`, more than
    half of the ring's sensors are faulted at once (a shared cause, such as the
    bus), or none is left. BLIND if every working sensor is masked: nothing is
    known about the ring's surroundings. DEGRADED if a sensor is declared dead,
    HEALTHY otherwise.

    Args:
        reading: `Reading` of each sensor, (n,).
        fault: `SensorFault` of each sensor, (n,); DEAD ones do not count.
        faulted_for: time since each sensor's last good sample, s, (n,).
        fault_time: how long a sensor may be faulted, s.

    Returns:
        `RingHealth` as an integer.
    """
    alive, faulted, masked = 0, 0, 0
    for i in range(reading.shape[0]):
        if fault[i] == _DEAD:
            continue
        alive += 1
        if fault[i] != _NONE:
            faulted += 1
            if not faulted_for[i] <= fault_time:
                return _RING_FAULTED
        elif reading[i] == _MASKED:
            masked += 1
    if alive == 0 or 2 * faulted > alive:
        return _RING_FAULTED
    if masked == alive - faulted:
        return _BLIND
    return _DEGRADED if alive < reading.shape[0] else _HEALTHY
