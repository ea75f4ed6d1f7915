"""Whether the rings see the robot where they must: the statistics.

The twin says what each sensor must see of the robot and its cell. That is
compared with the sensor's reports, in two sequential tests (CUSUM, Page 1954):

- for each sensor, whether expected self-hits are missing: `unseen self-hit`.
  Only hits that are missing or too far count: a person may stand in front of
  the robot, but cannot make it vanish;
- for each possible error of a ring's mounting or of the joints (`Misfit`),
  whether the readings fit better with it than without.

A test's sum grows by the logarithm of a reading's likelihood ratio, with the
fault over without, and never falls below 0. If the likelihoods are right, the
mean number of looks between two false alarms is at least e^threshold (Lorden
1971).

A third test, without probabilities, is for hits that ride with the robot: see
`step_rides`.
"""

import dataclasses as dc
import itertools
import math

import numpy as np

from tofssm_drake.errors import check_range, require
from tofssm_drake.kernels import njit
from tofssm_drake.perception.occlusion_mask import (
    OcclusionMaskConfig,
    make_mask_fan,
)
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.sensors.range_sensor import SensorTraits
from tofssm_drake.sensors.range_status import (
    STATUS_MIN_RANGE_CLIPPED,
    STATUS_VALID,
    is_no_return,
)

# How a reading compares with an expectation.
QUIET, MATCH, MISS, ALONE = 0, 1, 2, 3
"""QUIET: no information. MATCH: the robot or its cell is seen where it is.
MISS: it is not seen although it must be, or is seen too far away. ALONE:
something, perhaps a person, is seen where the robot is not."""

RIDE_STEP = 0.001
"""Smaller movements of a sensor do not count, m (*assumed*: far above the noise
of the reported joints of a robot at rest)."""

RIDE_LOOKS_TO_END = 2
"""A riding hit's alarm ends after this many looks in a row that do not fit it:
one lost sample must not end it."""

MISPLACED = "misplaced"
"""A ring is turned or elsewhere, or its sensors are numbered differently."""
MODEL = "robot model or joints do not fit"
"""The rings see the robot elsewhere than its joints say."""


@dc.dataclass(kw_only=True)
class SelfHitConfig:
    """How the rings are verified by what they see of the robot itself."""

    # False: no verification. A ring that sees nothing at all passes for one
    # with nobody around it.
    enabled: bool = True

    # A cone narrower by this on each side must see the robot, and a cone wider
    # by this may see it, deg (*assumed*: as in the mask, the last degree of a
    # mounting).
    edge_margin_deg: float = 1.0

    # Nothing need be seen beyond this distance, m (*assumed*), nor beyond the
    # sensor's own sure range.
    max_distance: float = 0.9

    # Rate at which a working sensor misses an expected self-hit (*assumed*:
    # four times the model's dropouts), and the least rate of a broken one that
    # is to be found as fast as possible.
    miss_rate: float = 0.02
    broken_rate: float = 0.5

    # Scans of a ring per look. More looks find small misfits sooner, but take
    # computing time.
    scans_per_look: int = 3

    # Threshold of a sensor's sum. e^23 looks of 6 sensors at 14 Hz are three
    # years between two false alarms at the miss rate above. 8 misses in a row
    # reach it: 0.6 s.
    sensor_threshold: float = 23.0

    # Scores, as natural logarithms, of a reading that is alone by one
    # expectation and matches the other, and of one that is missing by only one
    # of them. A ring's scan counts at most the limit, so that none decides. A
    # person may cause a lone reading, so it counts less than a likelihood ratio
    # would (*assumed*).
    alone_score: float = 2.0
    miss_score: float = 4.0
    score_limit: float = 4.0

    # A lone reading counts less the wider the interval that it matches, and
    # nothing from this width on, m (*measured*: with it a person's sums are
    # less than half as high). A wide interval is easily hit by chance.
    full_width: float = 0.5

    # Threshold of the sum of a misfit (*measured*: twice the highest sum that a
    # person caused in an hour, see docs/self_hits.md).
    misfit_threshold: float = 12.0

    # A misfit whose sum is above this is named in a sensor's alarm: if a ring
    # is turned, single sensors miss the robot first.
    name_threshold: float = 4.0

    # Some joint must have moved by this between two looks for misfits, rad
    # (*assumed*): seeing the same thing again and again beside a robot at rest
    # proves nothing. A robot that has not moved is looked at a fifth as often.
    min_motion: float = 0.02

    # Turns of a ring about its axis that are tried to both sides, deg. Turns by
    # whole sensors are always tried.
    turns_deg: list[float] = dc.field(default_factory=lambda: [5.0, 20.0])

    # Shift of the tool's ring along its axis that is tried to both sides, m: an
    # adapter that is not in the model.
    tool_shift: float = 0.05

    # Offset of the first joint that is tried to both sides, rad, and delay of
    # the joints, s.
    joint_offset: float = 0.1
    joint_delay: float = 0.05

    # If a reading stays alone at one distance, within the sensor's tolerance,
    # while its sensor travels farther than this, the hit rides with the robot,
    # m (*assumed*: nobody keeps a distance to within 30 mm along a metre of the
    # arm's path; for what a person does see docs/self_hits.md).
    ride_travel: float = 1.0

    # If a ring's best sensor has an expected self-hit in less than this part of
    # the task, the ring cannot be verified (*assumed*: twice in a cycle of
    # 6.6 s).
    min_share: float = 0.02

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        for name, low, high in (
            ("edge_margin_deg", 0.0, 10.0),
            ("max_distance", 0.1, 4.0),
            ("miss_rate", 1e-6, 0.5),
            ("broken_rate", 1e-6, 0.999),
            ("scans_per_look", 1, 1000),
            ("sensor_threshold", 1.0, 1000.0),
            ("alone_score", 0.0, 100.0),
            ("miss_score", 0.0, 100.0),
            ("score_limit", 0.0, 100.0),
            ("full_width", 0.01, 10.0),
            ("misfit_threshold", 1.0, 1000.0),
            ("name_threshold", 0.0, 1000.0),
            ("min_motion", 0.0, 1.0),
            ("tool_shift", 0.0, 1.0),
            ("joint_offset", 0.0, 1.0),
            ("joint_delay", 0.0, 1.0),
            ("ride_travel", 0.1, 100.0),
            ("min_share", 0.0, 1.0),
        ):
            check_range(where, name, getattr(self, name), low, high)
        require(
            self.miss_rate < self.broken_rate,
            f"{where}.broken_rate: {self.broken_rate} must be above "
            f"miss_rate, {self.miss_rate}",
        )
        for turn in self.turns_deg:
            require(
                0.0 < turn <= 180.0,
                f"{where}.turns_deg: {turn} is out of range; use 0 to 180",
            )


def make_self_hit_fan(
    config: SelfHitConfig,
    mask_config: OcclusionMaskConfig,
    sensor: SensorTraits,
) -> tuple[np.ndarray, int]:
    """Returns directions of a sensor's rays on the twin, in two cones.

    Returns:
        (k, 3) unit vectors, and how many of them belong to the wide cone, which
        may see the robot; the others belong to the narrow cone, which must.
    """
    wide = make_mask_fan(
        dc.replace(mask_config, edge_margin_deg=config.edge_margin_deg),
        sensor,
    )
    fov_deg = max(sensor.fov_deg - 2.0 * config.edge_margin_deg, 0.5)
    narrow = make_cone_fan(math.radians(fov_deg), sensor.rays_per_sensor)
    return np.vstack([wide, narrow]), len(wide)


@njit(cache=True)
def widen_expectation(ray_distance, num_wide, expectation):
    """Adds a look at the twin to what sensors may and must see.

    Args:
        ray_distance: along the rays of `make_self_hit_fan`, m, inf where they
            hit nothing, (n, k).
        num_wide: number of rays of the wide cone.
        expectation: changed: nearest and farthest self-hit of the wide cone
            (inf and -inf: none), and greatest distance of the robot for the
            narrow one, which takes two rays (inf: it need not be seen),
            m, (3, n).
    """
    for i in range(ray_distance.shape[0]):
        first = np.inf
        second = np.inf
        for j in range(ray_distance.shape[1]):
            d = ray_distance[i, j]
            if d == np.inf:
                continue
            if j < num_wide:
                expectation[0, i] = min(expectation[0, i], d)
                expectation[1, i] = max(expectation[1, i], d)
            elif d < first:
                second = first
                first = d
            elif d < second:
                second = d
        expectation[2, i] = max(expectation[2, i], second)


def make_no_expectation(n: int) -> np.ndarray:
    """Returns the expectation of n sensors before any look, (3, n)."""
    expectation = np.full((3, n), -np.inf)
    expectation[0] = np.inf
    return expectation


@njit(cache=True)
def must_see(expectation, min_range, max_distance):
    """Returns whether each sensor must see the robot, (n,).

    Args:
        expectation: see `widen_expectation`, (3, n).
        min_range: a nearer self-hit may give any distance, m.
        max_distance: a farther one need not be seen, m.
    """
    return (expectation[2] < max_distance) & (expectation[0] >= min_range)


@njit(cache=True)
def classify_self_hits(
    distance, status, expectation, tolerance, min_range, max_distance, outcome
):
    """Compares each reading with an expectation.

    Args:
        distance: as measured, m, (n,).
        status: range status, (n,).
        expectation: see `widen_expectation`, (3, n).
        tolerance: of a distance, m.
        min_range: a nearer target has no distance, m.
        max_distance: see `must_see`, m.
        outcome: result, QUIET, MATCH, MISS or ALONE, (n,).

    Returns:
        Whether any is MISS or ALONE.
    """
    is_odd = False
    must = must_see(expectation, min_range, max_distance)
    for i in range(distance.shape[0]):
        s = status[i]
        d = distance[i]
        near = expectation[0, i] - tolerance
        outcome[i] = QUIET
        if is_no_return(s):
            if must[i]:
                outcome[i] = MISS
        elif s == STATUS_MIN_RANGE_CLIPPED or (
            s == STATUS_VALID and d < min_range
        ):
            outcome[i] = MATCH if near <= min_range else ALONE
        elif s == STATUS_VALID:
            if must[i] and d > expectation[2, i] + tolerance:
                outcome[i] = MISS
            elif near <= d <= expectation[1, i] + tolerance:
                outcome[i] = MATCH
            else:
                outcome[i] = ALONE
        is_odd = is_odd or outcome[i] >= MISS
    return is_odd


@njit(cache=True)
def calc_origins(X_WF, frame_index, X_FS):
    """Returns the positions of sensors in the world, m, (n, 3).

    Args:
        X_WF: poses of frames, (frames, 3, 4).
        frame_index: which of them carries each sensor, (n,).
        X_FS: poses of the sensors in their frames, (n, 3, 4).
    """
    origin = np.empty((frame_index.shape[0], 3))
    for i in range(frame_index.shape[0]):
        X = X_WF[frame_index[i]]
        for row in range(3):
            origin[i, row] = X[row, 3]
            for column in range(3):
                origin[i, row] += X[row, column] * X_FS[i, column, 3]
    return origin


@njit(cache=True)
def step_rides(
    start,
    travel,
    last,
    alarm,
    unfit,
    outcome,
    distance,
    status,
    origin,
    tolerance,
    ride_travel,
):
    """Counts a look in the test for hits that ride with the robot.

    A stretch begins with a reading that is ALONE. It ends with one that is not,
    or that is at another distance, which begins the next; during an alarm, with
    `RIDE_LOOKS_TO_END` of them in a row. A sensor without a reading (a sample
    of another time, a failure) changes nothing, so that no failure ends an
    alarm.

    Args:
        start: distance at which the stretch began, m, inf if there is
            none; changed, (n,).
        travel: how far the sensor has moved since, m; changed, (n,).
        last: position when that was updated, in world, m; changed,
            (n, 3).
        alarm: changed, 0 or 1, (n,).
        unfit: looks in a row that did not fit the alarm; changed, (n,).
        outcome: of `classify_self_hits`, (n,).
        distance: as measured, m, (n,).
        status: range status, (n,).
        origin: positions of the sensors, in world, m, (n, 3).
        tolerance: of a distance, m.
        ride_travel: an alarm begins beyond this, m.
    """
    for i in range(start.shape[0]):
        if outcome[i] == QUIET and not is_no_return(status[i]):
            continue
        if outcome[i] == ALONE and abs(distance[i] - start[i]) <= tolerance:
            unfit[i] = 0.0
            x, y, z = origin[i] - last[i]
            moved = math.sqrt(x * x + y * y + z * z)
            if moved >= RIDE_STEP:
                travel[i] += moved
                last[i] = origin[i]
        elif alarm[i] > 0.0 and unfit[i] + 1.0 < RIDE_LOOKS_TO_END:
            unfit[i] += 1.0
        else:
            unfit[i] = 0.0
            start[i] = distance[i] if outcome[i] == ALONE else np.inf
            travel[i] = 0.0
            last[i] = origin[i]
        alarm[i] = 1.0 if travel[i] > ride_travel else 0.0


@njit(cache=True)
def calc_step(
    believed,
    tried,
    width,
    full_width,
    alone_score,
    miss_score,
    score_limit,
):
    """Returns how much better one expectation fits than another.

    A sensor that sees nothing although it must is no evidence for a misfit with
    which it need not see anything: it may be broken, and has its own test.

    Args:
        believed: outcomes of a ring's sensors with the model as it is, (n,).
        tried: their outcomes with the misfit, (n,).
        width: from nearest to farthest self-hit with the misfit, m, (n,).
        full_width: see `SelfHitConfig`, m, like the next three.
        alone_score: of a lone reading.
        miss_score: of a miss.
        score_limit: of the result.
    """
    step = 0.0
    for i in range(believed.shape[0]):
        b = believed[i]
        t = tried[i]
        if b == MISS and t == MATCH:
            step += miss_score
        elif t == MISS and b != MISS:
            step -= miss_score
        elif b == ALONE and t == MATCH:
            step += alone_score * max(0.0, 1.0 - width[i] / full_width)
        elif t == ALONE and b == MATCH:
            step -= alone_score
    return min(max(step, -score_limit), score_limit)


@njit(cache=True)
def step_cusum(total, is_alarm, step, threshold):
    """Adds to the sum of a sequential test; returns it and the alarm.

    The alarm begins at the threshold and ends when the sum is 0 again. The sum
    is limited to twice the threshold, so that a long alarm does not take longer
    to end.

    Args:
        total: the previous sum.
        is_alarm: whether there was an alarm.
        step: logarithm of the likelihood ratio, faulty over healthy.
        threshold: above 0.
    """
    total = min(max(total + step, 0.0), 2.0 * threshold)
    if total >= threshold:
        return total, True
    return total, is_alarm and total > 0.0


@njit(cache=True)
def step_sensors(
    total, alarm, outcome, must, miss_rate, broken_rate, threshold
):
    """Counts a look in each sensor's test for expected self-hits.

    Args:
        total: changed, (n,).
        alarm: changed, 0 or 1, (n,).
        outcome: of `classify_self_hits`, (n,).
        must: whether the sensor must see the robot, (n,).
        miss_rate: of a working sensor.
        broken_rate: of a broken one.
        threshold: of the sum.
    """
    for i in range(total.shape[0]):
        if not must[i] or outcome[i] == QUIET:
            continue
        if outcome[i] == MISS:
            step = math.log(broken_rate / miss_rate)
        else:
            step = math.log((1.0 - broken_rate) / (1.0 - miss_rate))
        total[i], is_alarm = step_cusum(
            total[i], alarm[i] > 0.0, step, threshold
        )
        alarm[i] = 1.0 if is_alarm else 0.0


@njit(cache=True)
def step_misfit(
    total,
    alarm,
    test,
    distance,
    status,
    expectation,
    believed,
    limits,
    scores,
    threshold,
    weight,
):
    """Counts a look in the test for one misfit.

    Args:
        total: sums of all tests; changed.
        alarm: of all tests, 0 or 1; changed.
        test: index of this one.
        distance: of a ring's sensors, m, (n,).
        status: likewise.
        expectation: with the misfit, (3, n).
        believed: outcomes without it, (n,).
        limits: the last three of `classify_self_hits`.
        scores: the last four of `calc_step`.
        threshold: of the sum.
        weight: number of looks that it counts for.
    """
    tried = np.empty_like(believed)
    classify_self_hits(
        distance, status, expectation, limits[0], limits[1], limits[2], tried
    )
    step = calc_step(
        believed,
        tried,
        expectation[1] - expectation[0],
        scores[0],
        scores[1],
        scores[2],
        scores[3],
    )
    total[test], is_alarm = step_cusum(
        total[test], alarm[test] > 0.0, weight * step, threshold
    )
    alarm[test] = 1.0 if is_alarm else 0.0


@njit(cache=True)
def step_orders(
    total,
    alarm,
    ring,
    is_odd,
    distance,
    status,
    expectation,
    orders,
    swaps,
    believed,
    limits,
    scores,
    threshold,
):
    """Counts a look in the tests for wrongly numbered sensors or rings.

    They need no rays of their own. For other rings the expectation of the last
    look, some milliseconds ago, is used.

    Args:
        total: sums of all tests: orders ring by ring, then swaps; changed.
        alarm: of all tests, 0 or 1; changed.
        ring: index of the ring.
        is_odd: whether any of its readings is missing or alone. If not,
        nothing can fit better, and sums that are 0 stay so.
        distance: of its sensors, m, (n,).
        status: likewise.
        expectation: of all rings' sensors, (3, m n).
        orders: see `make_orders`, (p, n).
        swaps: see `list_swaps`, (s, 2).
        believed: outcomes with the model as it is, (n,).
        limits: the last three of `classify_self_hits`.
        scores: the last four of `calc_step`.
        threshold: of the sums.
    """
    p, n = orders.shape
    own = expectation[:, n * ring : n * ring + n]
    for j in range(p + swaps.shape[0]):
        if j < p:
            test = ring * p + j
            tried = own[:, orders[j]].copy()
        else:
            test = expectation.shape[1] // n * p + j - p
            pair = swaps[j - p]
            if ring not in (pair[0], pair[1]):
                continue
            other = pair[0] + pair[1] - ring
            tried = expectation[:, n * other : n * other + n].copy()
        if is_odd or total[test] > 0.0:
            step_misfit(
                total,
                alarm,
                test,
                distance,
                status,
                tried,
                believed,
                limits,
                scores,
                threshold,
                1,
            )


def make_orders(n: int) -> np.ndarray:
    """Returns the wrong numberings of a ring's sensors that are tried.

    Returns:
        For each, the model's sensor of each index, (2 n - 1, n): shifted by 1
        to n - 1, then reversed and shifted by 0 to n - 1.
    """
    index = np.arange(n)
    shifted = [(index + s) % n for s in range(1, n)]
    backwards = [(n - 1 - index + s) % n for s in range(n)]
    return np.array(shifted + backwards)


def name_order(order: np.ndarray) -> str:
    """Returns a text for one of `make_orders`."""
    n = len(order)
    if order[1] == (order[0] - 1) % n:
        return "its sensors are numbered backwards"
    shift = int(order[0])
    shift = shift - n if shift > n // 2 else shift
    return (
        f"it is turned by {360 * shift / n:g} deg (its sensors are shifted "
        f"by {abs(shift)})"
    )


@dc.dataclass(frozen=True, kw_only=True)
class Misfit:
    """A possible error that needs its own rays to try."""

    kind: str
    """MISPLACED or MODEL."""
    text: str
    """What it is, e.g. "it is turned by 5 deg"."""
    ring: int
    """The ring concerned; -1: all of them."""
    turn: float = 0.0
    """Of the ring about its z, rad."""
    shift: float = 0.0
    """Of the ring along its z, m."""
    offset: float = 0.0
    """True minus reported angle of the first joint, rad."""
    delay: float = 0.0
    """Delay of the reported joints, s."""


def list_misfits(config: SelfHitConfig, rings: int) -> tuple[Misfit, ...]:
    """Returns the misfits to try; the last ring is the tool's."""
    misfits = [
        Misfit(
            kind=MISPLACED,
            text=f"it is turned by {sign * turn:g} deg",
            ring=ring,
            turn=math.radians(sign * turn),
        )
        for ring in range(rings)
        for turn in config.turns_deg
        for sign in (1.0, -1.0)
    ]
    if config.tool_shift > 0.0:
        misfits += [
            Misfit(
                kind=MISPLACED,
                text=f"it sits {1000 * config.tool_shift:g} mm farther {where}",
                ring=rings - 1,
                shift=sign * config.tool_shift,
            )
            for sign, where in ((1.0, "out"), (-1.0, "in"))
        ]
    for sign in (1.0, -1.0):
        if config.joint_offset > 0.0:
            misfits.append(
                Misfit(
                    kind=MODEL,
                    text=f"{sign * config.joint_offset:+g} rad on joint 1",
                    ring=-1,
                    offset=sign * config.joint_offset,
                )
            )
        if config.joint_delay > 0.0:
            when = "late" if sign > 0.0 else "early"
            misfits.append(
                Misfit(
                    kind=MODEL,
                    text=f"joints {1000 * config.joint_delay:g} ms {when}",
                    ring=-1,
                    delay=sign * config.joint_delay,
                )
            )
    return tuple(misfits)


def list_swaps(rings: int) -> list[tuple[int, int]]:
    """Returns the pairs of rings that may be swapped."""
    return list(itertools.combinations(range(rings), 2))
