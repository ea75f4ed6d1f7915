"""The occlusion mask: which sensors see the robot itself or its cell."""

from collections.abc import Sequence
import dataclasses as dc
import functools
import math
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    State,
)

from tofssm_drake.errors import check_range, require, require_period
from tofssm_drake.kernels import njit
from tofssm_drake.messages import (
    MaskedScan,
    Reading,
    RingScan,
    SensorFault,
)
from tofssm_drake.perception.memory import (
    LONGEST_STEP,
    SensorMemoryConfig,
    calc_healthy_time,
    find_other_obstacles,
    hold_obstacles,
)
from tofssm_drake.perception.readings import (
    calc_self_interval,
    classify_readings,
)
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayBundles, RayCaster
from tofssm_drake.sensors.range_sensor import SensorTraits
from tofssm_drake.sensors.range_status import STATUS_NO_NEW_DATA
from tofssm_drake.sensors.ring_mount import RingMount

# s, see `OcclusionMaskConfig.max_age`.
_LEAST_MAX_AGE = 0.072


@dc.dataclass(kw_only=True)
class OcclusionMaskConfig:
    """Which readings count as the robot's own.

    How much a reading may be off, and which are possible at all, the sensor's
    model says (`SensorTraits`).
    """

    RENAMED: ClassVar[dict[str, str]] = {
        "sigma": "sensors.<ring>.sensor.tolerance, which is 3 sigma",
        "min_range": "sensors.<ring>.sensor.min_range",
        "max_range": "what sensors.<ring>.sensor can measure, and some more",
    }
    """Former keys and where they are now, for the error message."""

    # False: nothing is masked, and the robot stops when it sees itself.
    enabled: bool = True

    # Rays that represent a sensor's cone; 0: as many as the ring's.
    rays_per_sensor: int = 0

    # The mask also looks this far beyond the edge of a sensor's cone, deg
    # (*assumed*): whether and where the cone grazes something depends on the
    # last degree of a mounting and the last millisecond of a clock. 0: not
    # beyond.
    edge_margin_deg: float = 1.0

    # The robot is also looked at where it was this long before and after a
    # sample, s (*assumed*: half a control tick), since clocks, integration
    # time and the plant steps of a simulated world leave that uncertain. 0:
    # only at the sample's own time.
    time_margin: float = 0.004

    # How long obstacles are remembered that a sensor no longer sees.
    memory: SensorMemoryConfig = dc.field(default_factory=SensorMemoryConfig)

    # If its sample is older than this, s, a sensor is faulted. null: three
    # periods of the ring's sensors, or two and their latency if that is longer;
    # at least 0.072 s, three of a VL53L1X (*assumed*).
    max_age: float | None = None

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        check_range(where, "rays_per_sensor", self.rays_per_sensor, 0, 10000)
        check_range(where, "edge_margin_deg", self.edge_margin_deg, 0.0, 10.0)
        check_range(where, "time_margin", self.time_margin, 0.0, 0.1)
        if self.max_age is not None:
            check_range(where, "max_age", self.max_age, 0.001, 10.0)
        self.memory.check(f"{where}.memory")

    def calc_max_age(self, sensor: SensorTraits) -> float:
        """Returns from which age on a sample is too old, s.

        Args:
            sensor: Of the ring.
        """
        if self.max_age is not None:
            return self.max_age
        own = 2.0 * sensor.period + max(sensor.period, sensor.latency)
        # Without the rounding of decimal fractions.
        return max(_LEAST_MAX_AGE, round(own, 9))


def make_mask_bundles(
    *,
    config: OcclusionMaskConfig,
    sensor: SensorTraits,
    caster: RayCaster,
    mounts: Sequence[RingMount],
) -> RayBundles:
    """Makes the rays of all rings' masks, cast together on the twin.

    Args:
        config: number of rays.
        sensor: field of view, range and tolerance of the sensors, number of
            rays.
        caster: of the twin's SceneGraph.
        mounts: the rings on the twin; no sensor sees the link that carries it.

    Returns:
        One bundle per sensor, ring by ring.
    """
    return caster.make_bundles(
        frame_id=[mount.frame_id for mount in mounts for _ in mount.X_FS],
        X_FS=[X for mount in mounts for X in mount.X_FS],
        fan_S=make_mask_fan(config, sensor),
        max_range=sensor.cast_range + sensor.tolerance,
        excluded=[mount.geometry_ids for mount in mounts for _ in mount.X_FS],
    )


def make_proof_bundles(
    *,
    config: OcclusionMaskConfig,
    sensor: SensorTraits,
    caster: RayCaster,
    mounts: Sequence[RingMount],
) -> RayBundles:
    """Makes the rays for where a sensor must see the robot.

    Like those of the mask, but in a cone narrower than the sensor's by
    `edge_margin_deg` on each side: what its edge grazes need not be seen.
    """
    narrow_deg = sensor.fov_deg - 2.0 * config.edge_margin_deg
    return caster.make_bundles(
        frame_id=[mount.frame_id for mount in mounts for _ in mount.X_FS],
        X_FS=[X for mount in mounts for X in mount.X_FS],
        fan_S=make_cone_fan(
            math.radians(max(narrow_deg, 0.1)),
            config.rays_per_sensor or sensor.rays_per_sensor,
        ),
        max_range=min(_SURELY_SEEN, sensor.sure_range),
        excluded=[mount.geometry_ids for mount in mounts for _ in mount.X_FS],
    )


def make_mask_fan(
    config: OcclusionMaskConfig, sensor: SensorTraits
) -> np.ndarray:
    """Returns the directions of a sensor's rays on the twin, (k, 3).

    They are those of the ring itself, so that a simulated sensor and the mask
    see the same, and a circle of rays beyond the cone's edge.
    """
    fan_S = make_cone_fan(
        math.radians(sensor.fov_deg),
        config.rays_per_sensor or sensor.rays_per_sensor,
    )
    if config.edge_margin_deg == 0.0:
        return fan_S
    angle = math.radians(0.5 * sensor.fov_deg + config.edge_margin_deg)
    turn = 2.0 * np.pi * np.arange(_EDGE_RAYS) / _EDGE_RAYS
    edge_S = np.empty((_EDGE_RAYS, 3))
    edge_S[:, 0] = math.cos(angle)
    edge_S[:, 1] = math.sin(angle) * np.cos(turn)
    edge_S[:, 2] = math.sin(angle) * np.sin(turn)
    return np.vstack([fan_S, edge_S])


class Twin(Protocol):
    """The monitor's own model of the robot, what it carries, and its cell."""

    num_joints: int
    """Of the robot, j."""
    num_objects: int
    """Number of objects that it may carry, p."""

    def calc(self, q: np.ndarray, carried: np.ndarray) -> np.ndarray:
        """Returns X_WF of the mask's ray caster's frames, (frames, 3, 4).

        Args:
            q: Joint positions, rad or m, (j,).
            carried: Place of each object, or ON_TOOL, (p,).
        """


_CLEAR = int(Reading.CLEAR)
_VALID = int(Reading.VALID)
_HELD = int(Reading.HELD)
_NO_FAULT = int(SensorFault.NONE)
_UNRELIABLE = int(SensorFault.UNRELIABLE)
_DEAD = int(SensorFault.DEAD)
_EDGE_RAYS = 16

# Up to this distance, m, a sensor must see what fills the middle of its cone,
# if its own sure range is not shorter.
_SURELY_SEEN = 0.9

# Below this speed a robot moves less than a millimetre in the time margin,
# rad/s.
_STILL = 0.05

# A shorter lag is rounding, s.
_NO_LAG = 1e-6

# First column of the history's table, before positions and velocities of the
# j joints and the places of the p objects.
_TIME = 0


def calc_report_size(num_joints: int, num_objects: int) -> int:
    """Returns the size of a robot's report.

    It has position and velocity of the j joints, rad and rad/s (m and m/s),
    and the place of each of p objects, or ON_TOOL.
    """
    return 2 * num_joints + num_objects


def make_robot_history(
    length: int, num_joints: int, num_objects: int
) -> np.ndarray:
    """Returns an empty history of the robot's reports.

    Args:
        length: h, number of control ticks.
        num_joints: j.
        num_objects: p.

    Returns:
        Oldest first: time, s (-inf in unused rows), position, rad or m, (j),
        velocity, (j), place of each object, (p); (h, 1 + 2 j + p).
    """
    table = np.zeros((length, 1 + calc_report_size(num_joints, num_objects)))
    table[:, _TIME] = -np.inf
    return table


@njit(cache=True)
def push_report(table, time, report):
    """Adds a report to a history's table and drops the oldest.

    Args:
        table: changed in place.
        time: of the report, s.
        report: the other columns, (2 j + p,).
    """
    table[:-1] = table[1:]
    table[-1, 0] = time
    table[-1, 1:] = report


@njit(cache=True)
def interpolate_reports(table, time, joints):
    """Returns the robot's report for a time, as a row of the table.

    The joints, of which there are `joints`, and their speeds are interpolated
    linearly; objects are where the last report before has them. Outside the
    history's span it is the oldest or the newest report.
    """
    last = table.shape[0] - 1
    i = last
    while i > 0 and table[i, 0] > time and table[i - 1, 0] > -np.inf:
        i -= 1
    result = table[i].copy()
    if i < last and table[i, 0] <= time:
        s = (time - table[i, 0]) / (table[i + 1, 0] - table[i, 0])
        for j in range(1 + 2 * joints):
            result[j] += s * (table[i + 1, j] - table[i, j])
    return result


# Rows of the table of all rings' samples.
_NEAREST, _FARTHEST, _PREVIOUS_DISTANCE, _PREVIOUS_TIME = 0, 1, 2, 3
_SENSOR_TIME, _DISTANCE, _STATUS, _COUNTED, _MOVES = 4, 5, 6, 7, 8
# What the scan before left: the obstacle's distance and time, the distance and
# time before that, whether there was an obstacle, until when the sensor worked,
# and the sensor's last sample as it came.
_BEFORE_DISTANCE, _BEFORE_TIME, _HAD_OBSTACLE, _HEALTHY_TIME = 9, 10, 11, 12
_BEFORE_PREVIOUS_DISTANCE, _BEFORE_PREVIOUS_TIME = 13, 14
_RAW_TIME, _RAW_DISTANCE = 15, 16
_ROWS = 17

# Rows of the table of results for each sensor: reading, fault, and the counts
# of `hold_obstacles`.
_READING, _FAULT, _NO_RETURNS, _UNMEASURED, _OTHERS = 0, 1, 2, 3, 4
_VERDICT_ROWS = 5


@functools.cache
def _make_no_samples(num_sensors):
    """Returns an empty table of samples, (17, num_sensors)."""
    samples = np.zeros((_ROWS, num_sensors))
    samples[_SENSOR_TIME] = -np.inf
    samples[_PREVIOUS_DISTANCE] = np.nan
    samples[_PREVIOUS_TIME] = -np.inf
    samples[_BEFORE_TIME] = -np.inf
    samples[_RAW_TIME] = -np.inf
    samples[_HEALTHY_TIME] = -np.inf
    samples[_NEAREST] = np.inf
    samples[_FARTHEST] = -np.inf
    return samples


# Rows of what is left of a ring's scan before.
_WAS_TIME, _WAS_DISTANCE, _WAS_READING = 0, 1, 2
_WAS_PREVIOUS_DISTANCE, _WAS_PREVIOUS_TIME, _WAS_HEALTHY_TIME = 3, 4, 5
_WAS_NO_RETURNS, _WAS_UNMEASURED, _WAS_OTHERS = 6, 7, 8
_WAS_RAW_TIME, _WAS_RAW_DISTANCE = 9, 10


def _stack_before(before, time):
    """Returns what is left of the scan before, (11, n).

    While a ring sends nothing, its sensors neither work nor fail: their healthy
    time moves on.

    Args:
        before: the ring's masked scan before.
        time: of the new scan, s.
    """
    rows = _stack(
        before.scan.sensor_time,
        before.scan.distance,
        before.reading,
        before.previous_distance,
        before.previous_time,
        before.healthy_time,
        before.no_returns,
        before.unmeasured,
        before.others,
        before.raw.sensor_time,
        before.raw.distance,
    )
    if before.scan.sequence >= 0:
        pause = max(time - before.scan.time - LONGEST_STEP, 0.0)
        rows[_WAS_HEALTHY_TIME] += pause
    return rows


def _stack(*rows):
    """Returns arrays of one length as rows of floats."""
    # Much faster than np.array.
    return np.concatenate(rows, dtype=float).reshape(len(rows), -1)


@njit(cache=True)
def _load_ring(samples, verdict, first, new, was):
    """Writes a ring's newest samples and what is left of those before.

    Args:
        samples: the table, (17, N).
        verdict: the table of results, (5, N).
        first: the ring's first sensor in the tables.
        new: time, s, distance, m, and status of the newest samples, (3, n).
        was: see `_stack_before`, (11, n).
    """
    for j in range(was.shape[1]):
        i = first + j
        time, distance = new[0, j], new[1, j]
        samples[_SENSOR_TIME, i] = time
        samples[_DISTANCE, i] = distance
        samples[_STATUS, i] = new[2, j]
        reading = was[_WAS_READING, j]
        samples[_PREVIOUS_TIME, i] = was[_WAS_TIME, j]
        if time == was[_WAS_RAW_TIME, j]:
            # The same sample as in the scan before.
            samples[_PREVIOUS_DISTANCE, i] = was[_WAS_PREVIOUS_DISTANCE, j]
            samples[_PREVIOUS_TIME, i] = was[_WAS_PREVIOUS_TIME, j]
        elif reading == _VALID:
            samples[_PREVIOUS_DISTANCE, i] = was[_WAS_DISTANCE, j]
            if (
                distance == was[_WAS_RAW_DISTANCE, j]
                and was[_WAS_PREVIOUS_DISTANCE, j] > distance
            ):
                # A repeated distance may be frozen: the obstacle still
                # approaches as fast as it did.
                span = was[_WAS_TIME, j] - was[_WAS_PREVIOUS_TIME, j]
                samples[_PREVIOUS_DISTANCE, i] = was[_WAS_PREVIOUS_DISTANCE, j]
                samples[_PREVIOUS_TIME, i] = time - span
        samples[_BEFORE_DISTANCE, i] = was[_WAS_DISTANCE, j]
        samples[_BEFORE_TIME, i] = was[_WAS_TIME, j]
        samples[_BEFORE_PREVIOUS_DISTANCE, i] = was[_WAS_PREVIOUS_DISTANCE, j]
        samples[_BEFORE_PREVIOUS_TIME, i] = was[_WAS_PREVIOUS_TIME, j]
        samples[_HAD_OBSTACLE, i] = reading == _VALID or reading == _HELD
        samples[_HEALTHY_TIME, i] = was[_WAS_HEALTHY_TIME, j]
        samples[_RAW_TIME, i] = was[_WAS_RAW_TIME, j]
        samples[_RAW_DISTANCE, i] = was[_WAS_RAW_DISTANCE, j]
        verdict[_NO_RETURNS, i] = was[_WAS_NO_RETURNS, j]
        verdict[_UNMEASURED, i] = was[_WAS_UNMEASURED, j]
        verdict[_OTHERS, i] = was[_WAS_OTHERS, j]


@njit(cache=True)
def _report_motion(samples, table, n, motion):
    """Writes the robot's motion at each sample's time.

    Args:
        samples: of rings of n sensors, (15, N); gets whether the robot moves.
        table: the robot's reports, see `make_robot_history`.
        n: number of sensors of a ring.
        motion: result, measured joints, rad, and their speeds, rad/s, both
            (N, j); (2, N, j). 0 where the time is not finite.
    """
    joints = motion.shape[2]
    for first in range(0, samples.shape[1], n):
        speed = 0.0
        for i in range(first, first + n):
            time = samples[_SENSOR_TIME, i]
            if i > first and time == samples[_SENSOR_TIME, i - 1]:
                motion[0, i] = motion[0, i - 1]
                motion[1, i] = motion[1, i - 1]
                continue
            motion[:, i] = 0.0
            if math.isfinite(time):
                report = interpolate_reports(table, time, joints)
                motion[0, i] = report[1 : joints + 1]
                motion[1, i] = report[joints + 1 : 2 * joints + 1]
                for v in motion[1, i]:
                    speed = max(speed, abs(v))
        samples[_MOVES, first : first + n] = speed > _STILL


@njit(cache=True)
def _classify(samples, time, limits, wider, verdict, unsettled):
    """Classifies each sample by the self-hits found so far.

    Args:
        samples: the table, (15, N); gets the distance to use.
        time: now, s.
        limits: tolerance, min_range, max_range and max_age of
            `classify_readings`.
        wider: whether only a look at another time can change a reading, which
            it can if the robot moves.
        verdict: result, rows of readings and faults, (4, N).
        unsettled: result, whether another look at the robot can change the
            reading, (N,): only VALID ones can become MASKED.

    Returns:
        Whether any is unsettled.
    """
    reading, fault, samples[_COUNTED] = classify_readings(
        samples[_DISTANCE],
        samples[_STATUS],
        time - samples[_SENSOR_TIME],
        samples[_NEAREST],
        samples[_FARTHEST],
        limits[0],
        limits[1],
        limits[2],
        limits[3],
    )
    verdict[_READING] = reading
    verdict[_FAULT] = fault
    some = False
    for i in range(reading.shape[0]):
        unsettled[i] = (
            reading[i] == _VALID
            and math.isfinite(samples[_SENSOR_TIME, i])
            and (not wider or samples[_MOVES, i] > 0.0)
        )
        some = some or unsettled[i]
    return some


# The mask in three compiled steps, since each call costs microseconds:
# `_begin`, then `_begin_look` and `_end_look` for each look at the twin.


@njit(cache=True)
def _begin(samples, table, n, time, limits, motion, verdict, unsettled):
    """Fills in motion and readings before any look; returns as `_classify`."""
    _report_motion(samples, table, n, motion)
    return _classify(samples, time, limits, False, verdict, unsettled)


@njit(cache=True)
def _begin_look(samples, table, joints, shift, rest, which, report):
    """Takes the sensors that sampled at the same time out of the rest.

    Args:
        samples: the table, (15, N).
        table: the robot's reports, see `make_robot_history`.
        joints: their number.
        shift: how much later than at the sample to look at the robot, s.
        rest: the sensors to choose from, (N,); the chosen ones are taken out.
        which: result, the chosen ones, (N,).
        report: result, the robot's report for their time, (1 + 2 j + p,).

    Returns:
        Whether any are left.
    """
    time = np.nan
    more = False
    for i in range(rest.shape[0]):
        which[i] = False
        if rest[i]:
            if math.isnan(time):
                time = samples[_SENSOR_TIME, i]
            which[i] = samples[_SENSOR_TIME, i] == time
            rest[i] = not which[i]
            more = more or rest[i]
    report[:] = interpolate_reports(table, time + shift, joints)
    return more


@njit(cache=True)
def _end_look(
    samples, which, self_distance, more, time, limits, verdict, unsettled
):
    """Adds the self-hits of some sensors, (N, k) m, inf for none.

    Returns:
        Whether any sensor is left to look at, or else still unsettled.
    """
    nearest, farthest = calc_self_interval(self_distance)
    for i in range(which.shape[0]):
        if which[i]:
            samples[_NEAREST, i] = min(samples[_NEAREST, i], nearest[i])
            samples[_FARTHEST, i] = max(samples[_FARTHEST, i], farthest[i])
    return more or _classify(samples, time, limits, True, verdict, unsettled)


@njit(cache=True)
def _remember(
    samples, verdict, is_proven, time, report, is_dead, memory, motion
):
    """Lets obstacles that sensors saw before count on, see `hold_obstacles`.

    Args:
        samples: the table, (17, N); HELD sensors get the sample before.
        verdict: the table of results, (5, N); changed.
        is_proven: whether each sensor's ring sees the robot where it must,
            (N,).
        time: now, s.
        report: what the robot reported last, (1 + 2 j + p,).
        is_dead: whether each sensor is declared dead, (N,).
        memory: the settings of SensorMemoryConfig in their order.
        motion: of the robot, (2, N, j); HELD sensors get that of now.
    """
    n = verdict.shape[1]
    has_lag = np.zeros(n, dtype=np.bool_)
    is_new = samples[_SENSOR_TIME] != samples[_RAW_TIME]
    for i in range(n):
        if is_dead[i]:
            verdict[_FAULT, i] = _DEAD
        if verdict[_FAULT, i] == _NO_FAULT and is_new[i]:
            samples[_HEALTHY_TIME, i] = calc_healthy_time(
                samples[_HEALTHY_TIME, i],
                samples[_SENSOR_TIME, i],
                samples[_RAW_TIME, i],
                memory[2],
                memory[4],
            )
        lag = samples[_SENSOR_TIME, i] - samples[_HEALTHY_TIME, i]
        has_lag[i] = lag > _NO_LAG
    had_obstacle = samples[_HAD_OBSTACLE] > 0.0
    is_other = find_other_obstacles(
        verdict[_READING],
        had_obstacle,
        samples[_DISTANCE],
        samples[_SENSOR_TIME],
        samples[_BEFORE_DISTANCE : _BEFORE_TIME + 1],
        is_new & (samples[_DISTANCE] != samples[_RAW_DISTANCE]),
        has_lag,
        memory[5:7],
        verdict[_OTHERS],
    )
    is_nearest = hold_obstacles(
        verdict[_READING],
        verdict[_FAULT],
        is_new,
        is_proven,
        has_lag,
        is_other,
        had_obstacle,
        verdict[_NO_RETURNS : _OTHERS + 1],
        memory[0],
        memory[1],
    )
    joints = motion.shape[2]
    for i in range(n):
        lag = samples[_SENSOR_TIME, i] - samples[_HEALTHY_TIME, i]
        if verdict[_FAULT, i] == _NO_FAULT and lag > memory[3]:
            verdict[_FAULT, i] = _UNRELIABLE
        if verdict[_READING, i] != _HELD:
            continue
        motion[0, i] = report[1 : joints + 1]
        motion[1, i] = report[joints + 1 : 2 * joints + 1]
        if is_nearest[i]:
            samples[_COUNTED, i] = 0.0
            samples[_SENSOR_TIME, i] = time
            samples[_PREVIOUS_DISTANCE, i] = np.nan
        else:
            samples[_COUNTED, i] = samples[_BEFORE_DISTANCE, i]
            samples[_SENSOR_TIME, i] = samples[_BEFORE_TIME, i]
            distance = samples[_BEFORE_PREVIOUS_DISTANCE, i]
            samples[_PREVIOUS_DISTANCE, i] = distance
            samples[_PREVIOUS_TIME, i] = samples[_BEFORE_PREVIOUS_TIME, i]


def mask_scans(
    config: OcclusionMaskConfig,
    *,
    sensor: SensorTraits,
    scans: Sequence[RingScan | None],
    before: Sequence[MaskedScan],
    time: float,
    table: np.ndarray,
    caster: RayCaster,
    bundles: RayBundles,
    twin: Twin,
    proof_bundles: RayBundles | None = None,
    is_dead: np.ndarray | None = None,
) -> tuple[MaskedScan, ...]:
    """Classifies each reading of new scans.

    Casts each sensor's rays on the twin, posed as the robot was at the sample's
    own time, and compares (paper, Self Occlusion Detection; table in
    `tofssm_drake.perception.readings`). A valid reading is compared again with
    the robot slightly earlier and later. Only sensors whose reading can still
    change are looked at; rings that sampled at the same time are cast together.

    Args:
        config: settings.
        sensor: of all rings.
        scans: each ring's new scan of n sensors; None where there is none.
        before: each ring's result for the previous scan.
        time: now, s.
        table: the robot's reports, see `make_robot_history`.
        caster: of the twin.
        bundles: the rays of all rings' sensors, see `make_mask_bundles`.
        twin: gives the poses that the caster needs.
        proof_bundles: the rays for where a sensor must see the robot, see
            `make_proof_bundles`; None: nothing must be proven.
        is_dead: whether each sensor is declared dead, (N,); None: none is.

    Returns:
        Each ring's masked scan, the previous one if there is no new one. Its
        `scan` is as the monitor uses it: 0 m for a target that is too near to
        be measured, the previous sample if there is no new data, and the last
        obstacle with its own time if that is HELD.
    """
    num_sensors = bundles.num_bundles
    n = num_sensors // len(scans)
    tables = _Tables(
        samples=_make_no_samples(num_sensors).copy(),
        verdict=np.zeros((_VERDICT_ROWS, num_sensors), dtype=np.int64),
        motion=np.empty((2, num_sensors, twin.num_joints)),
        sensors_per_ring=n,
    )
    newest = [
        None if scan is None else _load_scan(tables, n * i, scan, was)
        for i, (scan, was) in enumerate(zip(scans, before, strict=True))
    ]
    view = _View(table, caster, twin)
    _compare_with_twin(config, sensor, tables, view, bundles, time)
    is_proven = np.ones(num_sensors, dtype=bool)
    if config.enabled and proof_bundles is not None:
        is_proven = _find_proven(tables, view, proof_bundles, sensor.min_range)
    _remember(
        tables.samples,
        tables.verdict,
        is_proven,
        time,
        table[-1],
        np.zeros(num_sensors, dtype=bool) if is_dead is None else is_dead,
        np.array(list(vars(config.memory).values())),
        tables.motion,
    )
    # The messages are views of these.
    outcome = tables.verdict[: _FAULT + 1].astype(np.uint8)
    for array in (tables.samples, tables.verdict, tables.motion, outcome):
        array.setflags(write=False)
    return tuple(
        was
        if raw is None
        else _make_masked_scan(tables, outcome, raw, slice(n * i, n * i + n))
        for i, (raw, was) in enumerate(zip(newest, before, strict=True))
    )


class _Tables(NamedTuple):
    """What is known of all N sensors of the rings."""

    samples: np.ndarray
    """See `_make_no_samples`, (15, N)."""
    verdict: np.ndarray
    """Readings, faults, numbers of samples in a row, (4, N)."""
    motion: np.ndarray
    """Joints, rad, and their speeds, rad/s, at the samples, (2, N, j)."""
    sensors_per_ring: int


class _View(NamedTuple):
    """The twin, posed as the robot was at the samples' times."""

    table: np.ndarray
    """The robot's reports, see `make_robot_history`."""
    caster: RayCaster
    twin: Twin

    def cast(self, bundles, samples, shift, rest, which):
        """Casts the rays of sensors that sampled at the same time.

        Args:
            bundles: the rays of all sensors.
            samples: the table, (15, N).
            shift: see `_begin_look`; as the next two.
            rest: changed.
            which: changed.

        Returns:
            Self-hits, m, (N, k), and whether any sensors are left.
        """
        report = np.empty(self.table.shape[1])
        n = self.twin.num_joints
        more = _begin_look(samples, self.table, n, shift, rest, which, report)
        X_WF = self.twin.calc(report[1 : n + 1], report[2 * n + 1 :])
        self_distance, _ = self.caster.cast_bundles(bundles, X_WF, which)
        return self_distance, more


def _compare_with_twin(config, sensor, tables, view, bundles, time):
    """Fills in what each sample alone means, and the robot's motion."""
    samples, verdict, motion, n = tables
    unsettled = np.empty(samples.shape[1], dtype=bool)
    which = np.empty(samples.shape[1], dtype=bool)
    limits = (
        float(sensor.tolerance),
        float(sensor.min_range),
        float(sensor.max_range),
        config.calc_max_age(sensor),
    )
    margin = config.time_margin
    is_unsettled = _begin(
        samples, view.table, n, time, limits, motion, verdict, unsettled
    )
    if not config.enabled:
        return
    for shift in (0.0, -margin, margin) if margin > 0.0 else (0.0,):
        more = is_unsettled
        while more:
            self_distance, more = view.cast(
                bundles, samples, shift, unsettled, which
            )
            is_unsettled = _end_look(
                samples,
                which,
                self_distance,
                more,
                time,
                limits,
                verdict,
                unsettled,
            )


@njit(cache=True)
def _choose_to_prove(samples, verdict, n):
    """Returns which sensors must prove that they see, (N,).

    All that see nothing, in rings in which one of them saw something before.
    """
    chosen = np.zeros(verdict.shape[1], dtype=np.bool_)
    for first in range(0, verdict.shape[1], n):
        for i in range(first, first + n):
            if (
                verdict[_READING, i] == _CLEAR
                and samples[_HAD_OBSTACLE, i] > 0.0
            ):
                for j in range(first, first + n):
                    chosen[j] = verdict[_READING, j] == _CLEAR
                break
    return chosen


@njit(cache=True)
def _count_sure_hits(self_distance, which, least, hits):
    """Counts the rays that hit the robot where it must be seen.

    Args:
        self_distance: along each ray, m, (N, k); inf: none.
        which: whether a sensor was cast, (N,).
        least: nearest distance that can be measured, m.
        hits: result, (N,).
    """
    for i in range(self_distance.shape[0]):
        if which[i]:
            for d in self_distance[i]:
                if least <= d <= _SURELY_SEEN:
                    hits[i] += 1


def _find_proven(tables, view, bundles, least):
    """Returns for each sensor whether its ring sees the robot where it must.

    Only rings in which a sensor is about to become clear are looked at; the
    others count as proven.
    """
    n = tables.sensors_per_ring
    rest = _choose_to_prove(tables.samples, tables.verdict, n)
    more = bool(rest.any())
    if not more:
        return np.ones(len(rest), dtype=bool)
    hits = np.zeros(len(rest), dtype=int)
    which = np.empty(len(rest), dtype=bool)
    while more:
        self_distance, more = view.cast(
            bundles, tables.samples, 0.0, rest, which
        )
        _count_sure_hits(self_distance, which, least, hits)
    misses = (hits >= 2).reshape(-1, n).any(axis=1)
    return np.repeat(~misses, n)


def _load_scan(tables, first, scan, before):
    """Writes a scan into the tables; returns it with all newest samples."""
    n = tables.sensors_per_ring
    if scan.status.shape != (n,):
        raise ValueError(
            f"scan of {len(scan.status)} sensors, but the mask has {n}"
        )
    if before.reading.shape != (n,):
        before = _make_nothing_before(n)
    raw = _fill_in(scan, before.raw)
    new = _stack(raw.sensor_time, raw.distance, raw.status)
    _load_ring(
        tables.samples,
        tables.verdict,
        first,
        new,
        _stack_before(before, scan.time),
    )
    return raw


def _fill_in(scan, before):
    """Returns a scan with the previous sample in place of "no new data".

    A ring may fire its sensors in turns, or a sensor may take longer: its last
    sample then stands, with its own time, until it is too old.
    """
    if STATUS_NO_NEW_DATA not in scan.status.tolist():
        return scan
    missing = scan.status == STATUS_NO_NEW_DATA
    arrays = [
        np.where(missing, old, new)
        for old, new in (
            (before.sensor_time, scan.sensor_time),
            (before.distance, scan.distance),
            (before.status, scan.status),
        )
    ]
    for array in arrays:
        array.setflags(write=False)
    sensor_time, distance, status = arrays
    return RingScan.of_read_only(
        sequence=scan.sequence,
        time=scan.time,
        sensor_time=sensor_time,
        distance=distance,
        status=status,
        problem=scan.problem,
    )


@functools.cache
def _make_nothing_before(n):
    """Returns what counts as previous for a ring's first scan of n sensors."""
    scan = RingScan(
        sensor_time=np.full(n, -np.inf),
        distance=np.full(n, np.nan),
        status=np.full(n, STATUS_NO_NEW_DATA, dtype=np.uint8),
    )
    return MaskedScan(
        scan=scan,
        raw=scan,
        reading=np.full(n, Reading.FAULTED, dtype=np.uint8),
        fault=np.full(n, SensorFault.NO_DATA, dtype=np.uint8),
        healthy_time=np.full(n, -np.inf),
        no_returns=np.zeros(n, dtype=np.int64),
        unmeasured=np.zeros(n, dtype=np.int64),
        others=np.zeros(n, dtype=np.int64),
        previous_distance=np.full(n, np.nan),
        previous_time=np.full(n, -np.inf),
    )


def _make_masked_scan(tables, outcome, raw, sensors):
    """Makes the message of a ring whose newest samples are `raw`.

    Args:
        tables: of all rings, read-only.
        outcome: readings and faults, as in the message, (2, N).
        raw: with each sensor's newest sample.
        sensors: the ring's part of the tables.
    """
    samples, verdict, motion, _ = tables
    distance = samples[_COUNTED, sensors]
    reading = outcome[_READING, sensors]
    scan = raw
    if (
        _HELD in reading.tolist()
        or distance.tobytes() != raw.distance.tobytes()
    ):
        scan = RingScan.of_read_only(
            sequence=raw.sequence,
            time=raw.time,
            sensor_time=samples[_SENSOR_TIME, sensors],
            distance=distance,
            status=raw.status,
            problem=raw.problem,
        )
    return MaskedScan.of_read_only(
        scan=scan,
        raw=raw,
        reading=reading,
        fault=outcome[_FAULT, sensors],
        healthy_time=samples[_HEALTHY_TIME, sensors],
        no_returns=verdict[_NO_RETURNS, sensors],
        unmeasured=verdict[_UNMEASURED, sensors],
        others=verdict[_OTHERS, sensors],
        self_nearest=samples[_NEAREST, sensors],
        self_farthest=samples[_FARTHEST, sensors],
        previous_distance=samples[_PREVIOUS_DISTANCE, sensors],
        previous_time=samples[_PREVIOUS_TIME, sensors],
        position=motion[0, sensors],
        velocity=motion[1, sensors],
    )


class OcclusionMask(LeafSystem):
    """Separates the robot and its cell from everything else in scans of rings.

    .. pydrake_system::

        name: OcclusionMask
        input_ports:
        - scan_<ring>
        - robot_report
        output_ports:
        - masked_scan_<ring>

    `robot_report` is the robot's report (`calc_report_size`). It is remembered
    at every control tick; new scans of rings are classified with it
    (`mask_scans`). Nothing of the simulated world is used: the rays are cast on
    a twin that is posed from the measured joints. All rings share one system,
    since they share the robot's reports and an event costs more than a look at
    a scan.

    Before a ring's first scan its port holds an empty one (sequence -1).
    """

    def __init__(
        self,
        *,
        config: OcclusionMaskConfig,
        sensor: SensorTraits,
        period: float = 0.008,
        caster: RayCaster,
        bundles: RayBundles,
        twin: Twin,
        proof_bundles: RayBundles | None = None,
        is_dead: np.ndarray | None = None,
        name: tuple[str, ...],
    ):
        """Constructs the system.

        Args:
            config: settings.
            sensor: of all rings.
            period: control tick, s.
            caster: of the twin's SceneGraph.
            bundles: the rings' rays by that caster, see `make_mask_bundles`;
                the same number for each ring.
            twin: gives the poses of `caster.frame_ids`.
            proof_bundles: where a sensor must see the robot, see
                `make_proof_bundles`; None: nothing must be proven.
            is_dead: whether each sensor is declared dead, ring by ring, (N,);
                None: none is.
            name: the rings, in the order of `bundles`.

        Raises:
            UserError: if a setting is out of range.
            ValueError: if the rays do not suit the rings.
        """
        super().__init__()
        config.check("mask")
        require_period(period)
        max_age = config.calc_max_age(sensor)
        require(
            max_age >= period,
            f"mask.max_age: {max_age} is shorter than the control tick of "
            f"{period}",
        )
        n, rest = divmod(bundles.num_bundles, len(name))
        if n == 0 or rest:
            raise ValueError(
                f"bundles: {bundles.num_bundles} for {len(name)} rings"
            )
        self._config = config
        self._sensor = sensor
        self._caster = caster
        self._bundles = bundles
        self._twin = twin
        self._proof_bundles = proof_bundles
        self._is_dead = is_dead
        self._scans = [
            self.DeclareAbstractInputPort(f"scan_{ring}", Value(RingScan()))
            for ring in name
        ]
        self._report = self.DeclareVectorInputPort(
            "robot_report",
            calc_report_size(twin.num_joints, twin.num_objects),
        )
        # The history includes every sample that is not stale, and the look
        # back from it.
        length = math.ceil((max_age + config.time_margin) / period) + 2
        self._history = self.DeclareDiscreteState(
            make_robot_history(
                length, twin.num_joints, twin.num_objects
            ).ravel()
        )
        # Of the masked scans: cheaper to read than from the messages.
        self._sequence = self.DeclareDiscreteState([-1.0] * len(name))
        self._masked_scans = [
            self.DeclareAbstractState(Value(MaskedScan())) for _ in name
        ]
        for ring, index in zip(name, self._masked_scans, strict=True):
            self.DeclareStateOutputPort(f"masked_scan_{ring}", index)
        # Two events: most ticks bring no scan, and then what follows from the
        # masked scans is not computed again.
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._mask)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def _remember(self, context: Context, discrete_state: DiscreteValues):
        history = discrete_state.get_mutable_value(self._history)
        push_report(
            history.reshape(-1, 1 + self._report.size()),
            context.get_time(),
            self._report.Eval(context),
        )

    def _mask(self, context: Context, state: State):
        scans = [port.Eval(context) for port in self._scans]
        sequence = [scan.sequence for scan in scans]
        last_sequence = state.get_discrete_state().get_value(self._sequence)
        if sequence == last_sequence.tolist():
            return EventStatus.DidNothing()
        values = [
            state.get_mutable_abstract_state(index)
            for index in self._masked_scans
        ]
        before = [value.get_value() for value in values]
        is_new = [
            scan.sequence != was.scan.sequence
            for scan, was in zip(scans, before, strict=True)
        ]
        history = context.get_discrete_state(self._history).value()
        table = history.reshape(-1, 1 + self._report.size()).copy()
        push_report(table, context.get_time(), self._report.Eval(context))
        masked_scans = mask_scans(
            self._config,
            sensor=self._sensor,
            scans=[
                scan if new else None
                for scan, new in zip(scans, is_new, strict=True)
            ],
            before=before,
            time=context.get_time(),
            table=table,
            caster=self._caster,
            bundles=self._bundles,
            twin=self._twin,
            proof_bundles=self._proof_bundles,
            is_dead=self._is_dead,
        )
        for value, masked_scan, new in zip(
            values, masked_scans, is_new, strict=True
        ):
            if new:
                value.set_value(masked_scan)
        state.get_mutable_discrete_state().set_value(self._sequence, sequence)
        return EventStatus.Succeeded()
