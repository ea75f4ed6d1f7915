"""The occlusion mask: which sensors see the robot itself or its cell."""

from collections.abc import Sequence
import dataclasses as dc
import functools
import math
from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    State,
)

from tofssm_drake.errors import require, require_period
from tofssm_drake.geometry.fan import make_cone_fan
from tofssm_drake.geometry.ray_caster import RayBundles, RayCaster
from tofssm_drake.kernels import njit
from tofssm_drake.leaf_system import (
    DID_NOTHING,
    SUCCEEDED,
    LeafSystem,
)
from tofssm_drake.messages import RINGS, MaskedScan, Reading, RingScan
from tofssm_drake.sensing.readings import (
    calc_self_interval,
    classify_readings,
)
from tofssm_drake.sensing.ring_mount import RingMount
from tofssm_drake.sensing.tof_rings import TofRingConfig
from tofssm_drake.sensing.vl53l1x import (
    STATUS_NO_NEW_DATA,
    calc_cast_range,
    check_range,
)


@dc.dataclass(kw_only=True)
class OcclusionMaskConfig:
    """Which readings count as the robot's own."""

    # False: nothing is masked, the robot stops at the sight of itself.
    enabled: bool = True

    # Standard deviation of a reading on the robot or its cell, m: readings
    # within 3 sigma of the expected ones are masked. 3 sigma covers the
    # datasheet's +-25 mm with 5 mm to spare for a sensor whose constant error
    # is at its bound.
    sigma: float = 0.010

    # Rays that stand for a sensor's cone; 0: as many as the ring's.
    rays_per_sensor: int = 0

    # The mask also looks this far beyond the edge of a sensor's cone, deg
    # (*assumed*): what the cone just grazes is seen or not, near or far, by
    # the last degree of a mounting and the last millisecond of a clock. 0:
    # not beyond.
    edge_margin_deg: float = 1.0

    # The robot is also looked at as it was this long before and after a
    # sample, s (*assumed*: half a control tick). Clocks, an integration that
    # takes its time, and a simulated world that stands still for a plant step
    # leave that open. 0: only at the sample's own time.
    time_margin: float = 0.004

    # Below this distance a sensor detects but can not measure, m: such a
    # target is as near as possible.
    min_range: float = 0.040

    # A reading beyond this distance is implausible, m: no mode of the sensor
    # reaches farther.
    max_range: float = 4.0

    # A sample older than this is stale and the sensor faulted, s (*assumed*:
    # three periods of a ring).
    max_age: float = 0.072

    @property
    def tolerance(self) -> float:
        """By how much the expected interval is widened to each side, m."""
        return 3.0 * self.sigma

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        check_range(where, "sigma", self.sigma, 0.0, 0.1)
        check_range(where, "rays_per_sensor", self.rays_per_sensor, 0, 10000)
        check_range(where, "edge_margin_deg", self.edge_margin_deg, 0.0, 10.0)
        check_range(where, "time_margin", self.time_margin, 0.0, 0.1)
        check_range(where, "min_range", self.min_range, 0.0, 0.2)
        check_range(where, "max_range", self.max_range, 0.1, 65.0)
        check_range(where, "max_age", self.max_age, 0.001, 10.0)


def make_mask_bundles(
    *,
    config: OcclusionMaskConfig,
    ring_config: TofRingConfig,
    caster: RayCaster,
    mounts: Sequence[RingMount],
) -> RayBundles:
    """Makes the rays of all rings' masks, cast on the twin in one go.

    Args:
        config: number of rays, tolerance.
        ring_config: field of view and range of the sensors, number of rays.
        caster: of the twin's SceneGraph.
        mounts: the rings on the twin; no sensor sees the link that carries it.

    Returns:
        One bundle per sensor, ring by ring.
    """
    return caster.make_bundles(
        frame_id=[mount.frame_id for mount in mounts for _ in mount.X_FS],
        X_FS=[X for mount in mounts for X in mount.X_FS],
        fan_S=make_mask_fan(config, ring_config),
        max_range=calc_cast_range(ring_config.sensor) + config.tolerance,
        excluded=[mount.geometry_ids for mount in mounts for _ in mount.X_FS],
    )


def make_mask_fan(
    config: OcclusionMaskConfig, ring_config: TofRingConfig
) -> np.ndarray:
    """Returns the directions of a sensor's rays on the twin, (k, 3).

    Those of the ring itself, so that a sensor in the simulated world and the
    mask see the same, and a circle of rays beyond the cone's edge.
    """
    fan_S = make_cone_fan(
        math.radians(ring_config.fov_deg),
        config.rays_per_sensor or ring_config.rays_per_sensor,
    )
    if config.edge_margin_deg == 0.0:
        return fan_S
    angle = math.radians(0.5 * ring_config.fov_deg + config.edge_margin_deg)
    turn = 2.0 * np.pi * np.arange(_EDGE_RAYS) / _EDGE_RAYS
    edge_S = np.empty((_EDGE_RAYS, 3))
    edge_S[:, 0] = math.cos(angle)
    edge_S[:, 1] = math.sin(angle) * np.cos(turn)
    edge_S[:, 2] = math.sin(angle) * np.sin(turn)
    return np.vstack([fan_S, edge_S])


class Twin(Protocol):
    """The monitor's own idea of the robot, what it holds, and its cell."""

    def calc(
        self, q: np.ndarray, gripper_closed: float, products_placed: float
    ) -> np.ndarray:
        """Returns X_WF of the mask's ray caster's frames, (frames, 3, 4)."""


_VALID = int(Reading.VALID)
_EDGE_RAYS = 16

# A robot this slow does not move by a millimetre within the time margin,
# rad/s.
_STILL = 0.05

# Columns of the history's table.
_TIME, _POSITION, _VELOCITY = 0, slice(1, 7), slice(7, 13)
_GRIPPER_CLOSED, _PRODUCTS_PLACED = 13, 14
_COLUMNS = 15

REPORT_SIZE = _COLUMNS - 1
"""Of what a robot reports: position and velocity of the joints (6 each, rad,
rad/s), gripper closed, products placed."""


def make_robot_history(length: int) -> np.ndarray:
    """Returns an empty history of what the robot reported.

    Args:
        length: h, of how many control ticks.

    Returns:
        Oldest first: time, s (-inf in unused rows), position, rad, (6),
        velocity, rad/s, (6), gripper closed, products placed; (h, 15).
    """
    table = np.zeros((length, _COLUMNS))
    table[:, _TIME] = -np.inf
    return table


@njit(cache=True)
def push_report(table, time, report):
    """Adds a report to a history's table, (h, 15), and drops the oldest.

    Args:
        table: changed in place.
        time: of the report, s.
        report: the other columns, (14,).
    """
    table[:-1] = table[1:]
    table[-1, 0] = time
    table[-1, 1:] = report


@njit(cache=True)
def interpolate_reports(table, time):
    """Returns what the robot reported for a time, as a row of the table.

    Joints and their speeds are interpolated linearly; gripper and products
    are those of the last report before. Outside of the history's span it is
    the oldest or the newest report.
    """
    last = table.shape[0] - 1
    i = last
    while i > 0 and table[i, 0] > time and table[i - 1, 0] > -np.inf:
        i -= 1
    result = table[i].copy()
    if i < last and table[i, 0] <= time:
        s = (time - table[i, 0]) / (table[i + 1, 0] - table[i, 0])
        for j in range(13):
            result[j] += s * (table[i + 1, j] - table[i, j])
    return result


# Rows of the table of all rings' samples.
_NEAREST, _FARTHEST, _PREVIOUS_DISTANCE, _PREVIOUS_TIME = 0, 1, 2, 3
_SENSOR_TIME, _DISTANCE, _STATUS, _RECKONED, _MOVES = 4, 5, 6, 7, 8
_ROWS = 9


@functools.cache
def _make_no_samples(num_sensors):
    """Returns the table of samples without any, (9, num_sensors)."""
    samples = np.zeros((_ROWS, num_sensors))
    samples[_SENSOR_TIME] = -np.inf
    samples[_PREVIOUS_DISTANCE] = np.nan
    samples[_PREVIOUS_TIME] = -np.inf
    samples[_NEAREST] = np.inf
    samples[_FARTHEST] = -np.inf
    return samples


@njit(cache=True)
def _hold_samples(
    samples,
    first,
    sensor_time,
    distance,
    status,
    before_time,
    before_distance,
    before_status,
    before_reading,
    before_previous_distance,
    before_previous_time,
):
    """Writes a ring's new samples and those before them.

    The sample before stands in place of "no new data": a ring may fire its
    sensors in turns, or a sensor may take longer; its last sample then
    stands, with its own time, until it is too old.

    Args:
        samples: the table, (9, N).
        first: the ring's first sensor in the table.
        sensor_time: of the new samples, s, (n,).
        distance: those, m, (n,).
        status: of those, (n,).
        before_time: of the samples in the scan before, s, (n,); all empty
            if there was none.
        before_distance: those, m, (n,).
        before_status: of those, (n,).
        before_reading: what they meant, (n,).
        before_previous_distance: the samples before those, m, (n,); NaN where
            it was not VALID.
        before_previous_time: when they were, s, (n,).

    Returns:
        Whether a sample before stands.
    """
    some_held = False
    for j in range(sensor_time.shape[0]):
        i = first + j
        samples[_SENSOR_TIME, i] = sensor_time[j]
        samples[_DISTANCE, i] = distance[j]
        samples[_STATUS, i] = status[j]
        if before_reading.shape[0] == 0:
            continue
        if status[j] == STATUS_NO_NEW_DATA:
            some_held = True
            samples[_SENSOR_TIME, i] = before_time[j]
            samples[_DISTANCE, i] = before_distance[j]
            samples[_STATUS, i] = before_status[j]
        if samples[_SENSOR_TIME, i] == before_time[j]:
            # A sample that is held has still the same one before it.
            samples[_PREVIOUS_DISTANCE, i] = before_previous_distance[j]
            samples[_PREVIOUS_TIME, i] = before_previous_time[j]
        else:
            if before_reading[j] == _VALID:
                samples[_PREVIOUS_DISTANCE, i] = before_distance[j]
            samples[_PREVIOUS_TIME, i] = before_time[j]
    return some_held


@njit(cache=True)
def _report_motion(samples, table, n, motion):
    """Writes the robot's motion at each sample's time.

    Args:
        samples: of rings of n sensors, (9, N); tells where the robot moves.
        table: the robot's reports, see `make_robot_history`.
        n: sensors of a ring.
        motion: result, measured joints, rad, and their speeds, rad/s, both
            (N, 6); (2, N, 6). 0 where the time is not finite.
    """
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
                report = interpolate_reports(table, time)
                motion[0, i] = report[1:7]
                motion[1, i] = report[7:13]
                for v in motion[1, i]:
                    speed = max(speed, abs(v))
        samples[_MOVES, first : first + n] = speed > _STILL


@njit(cache=True)
def _classify(samples, time, limits, wider, reading, unsettled):
    """Tells what each sample means by what was seen of the robot so far.

    Args:
        samples: the table, (9, N); gets the distance to reckon with.
        time: now, s.
        limits: tolerance, min_range, max_range and max_age of
            `classify_readings`.
        wider: whether only a look at another time can tell more, which it
            can where the robot moves.
        reading: result, (N,).
        unsettled: result, whether another look at the robot can change the
            reading, (N,): only VALID ones can become MASKED.

    Returns:
        Whether any is unsettled.
    """
    result, samples[_RECKONED] = classify_readings(
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
    reading[:] = result
    some = False
    for i in range(reading.shape[0]):
        unsettled[i] = (
            reading[i] == _VALID
            and math.isfinite(samples[_SENSOR_TIME, i])
            and (not wider or samples[_MOVES, i] > 0.0)
        )
        some = some or unsettled[i]
    return some


# The mask in three steps of compiled code, since each call of one costs
# microseconds: `_begin`, then `_begin_look` and `_end_look` for each look at
# the twin.


@njit(cache=True)
def _begin(samples, table, n, time, limits, motion, reading, unsettled):
    """Fills in motion and readings before any look; returns `_classify`'s."""
    _report_motion(samples, table, n, motion)
    return _classify(samples, time, limits, False, reading, unsettled)


@njit(cache=True)
def _begin_look(samples, table, shift, rest, which, report):
    """Takes the sensors that sampled at one time out of the rest.

    Args:
        samples: the table, (9, N).
        table: the robot's reports, see `make_robot_history`.
        shift: how much later than at the sample to look at the robot, s.
        rest: the sensors to choose from, (N,); the chosen ones are taken out.
        which: result, those that are chosen, (N,).
        report: result, what the robot reported for their time, (15,).

    Returns:
        Whether there is still a rest.
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
    report[:] = interpolate_reports(table, time + shift)
    return more


@njit(cache=True)
def _end_look(
    samples, which, self_distance, more, time, limits, reading, unsettled
):
    """Lets the self-hits of some sensors count, (N, k) m, inf for none.

    Returns:
        Whether any sensor is unsettled once there is no rest to look at.
    """
    nearest, farthest = calc_self_interval(self_distance)
    for i in range(which.shape[0]):
        if which[i]:
            samples[_NEAREST, i] = min(samples[_NEAREST, i], nearest[i])
            samples[_FARTHEST, i] = max(samples[_FARTHEST, i], farthest[i])
    return more or _classify(samples, time, limits, True, reading, unsettled)


def mask_scans(
    config: OcclusionMaskConfig,
    *,
    scans: Sequence[RingScan | None],
    before: Sequence[MaskedScan],
    time: float,
    table: np.ndarray,
    caster: RayCaster,
    bundles: RayBundles,
    twin: Twin,
) -> tuple[MaskedScan, ...]:
    """Tells what each reading of new scans means.

    Casts each sensor's rays on the twin, posed as the robot was at the
    sample's own time, and compares (paper, Self Occlusion Detection; table
    in `tofssm_drake.sensing.readings`). What would be valid is compared again
    with the robot as it was a little earlier and later. Only sensors whose
    reading can still change are looked at, rings that sampled at the same
    time in one go.

    Args:
        config: settings.
        scans: each ring's new scan of n sensors; None where there is none.
        before: each ring's result for the scan before.
        time: now, s.
        table: the robot's reports, see `make_robot_history`.
        caster: of the twin.
        bundles: the rays of all rings' sensors, see `make_mask_bundles`.
        twin: gives the poses that the caster needs.

    Returns:
        Each ring's masked scan, that before where there is no new one. Its
        `scan` is as the monitor reckons with it: 0 m for a target nearer than
        can be measured, and the sample before where there is no new data.
    """
    num_sensors = bundles.num_bundles
    n = num_sensors // len(scans)
    samples = _make_no_samples(num_sensors).copy()
    held = [
        scan is not None and _load_samples(samples, n * i, n, scan, was)
        for i, (scan, was) in enumerate(zip(scans, before, strict=True))
    ]
    motion = np.empty((2, num_sensors, 6))
    reading = np.empty(num_sensors, dtype=np.uint8)
    unsettled = np.empty(num_sensors, dtype=bool)
    which = np.empty(num_sensors, dtype=bool)
    report = np.empty(_COLUMNS)

    limits = (
        config.tolerance,
        config.min_range,
        config.max_range,
        config.max_age,
    )
    margin = config.time_margin
    is_unsettled = _begin(
        samples, table, n, time, limits, motion, reading, unsettled
    )
    if config.enabled:
        for shift in (0.0, -margin, margin) if margin > 0.0 else (0.0,):
            more = is_unsettled
            while more:
                more = _begin_look(
                    samples, table, shift, unsettled, which, report
                )
                X_WF = twin.calc(
                    report[_POSITION],
                    report[_GRIPPER_CLOSED],
                    report[_PRODUCTS_PLACED],
                )
                self_distance, _ = caster.cast_bundles(bundles, X_WF, which)
                is_unsettled = _end_look(
                    samples,
                    which,
                    self_distance,
                    more,
                    time,
                    limits,
                    reading,
                    unsettled,
                )

    # The messages are views of these.
    for array in (samples, motion, reading):
        array.setflags(write=False)
    return tuple(
        was
        if scan is None
        else _make_masked_scan(
            scan, held[i], samples, reading, motion, slice(n * i, n * i + n)
        )
        for i, (scan, was) in enumerate(zip(scans, before, strict=True))
    )


def _load_samples(samples, first, n, scan, before):
    if scan.status.shape != (n,):
        raise ValueError(
            f"scan of {len(scan.status)} sensors, but the mask has {n}"
        )
    if before.reading.shape != (n,):
        before = _NOTHING_BEFORE
    return _hold_samples(
        samples,
        first,
        scan.sensor_time,
        scan.distance,
        scan.status,
        before.scan.sensor_time,
        before.scan.distance,
        before.scan.status,
        before.reading,
        before.previous_distance,
        before.previous_time,
    )


_NOTHING_BEFORE = MaskedScan()


def _make_masked_scan(scan, is_held, samples, reading, motion, sensors):
    distance = samples[_RECKONED, sensors]
    if is_held or distance.tobytes() != scan.distance.tobytes():
        status = scan.status
        if is_held:
            status = samples[_STATUS, sensors].astype(np.uint8)
            status.setflags(write=False)
        scan = RingScan.of_read_only(
            sequence=scan.sequence,
            time=scan.time,
            sensor_time=samples[_SENSOR_TIME, sensors],
            distance=distance,
            status=status,
        )
    return MaskedScan.of_read_only(
        scan=scan,
        reading=reading[sensors],
        self_nearest=samples[_NEAREST, sensors],
        self_farthest=samples[_FARTHEST, sensors],
        previous_distance=samples[_PREVIOUS_DISTANCE, sensors],
        previous_time=samples[_PREVIOUS_TIME, sensors],
        position=motion[0, sensors],
        velocity=motion[1, sensors],
    )


class OcclusionMask(LeafSystem):
    """Tells the robot and its cell from everything else in the rings' scans.

    .. pydrake_system::

        name: OcclusionMask
        input_ports:
        - scan_base
        - scan_elbow
        - scan_tool
        - robot_report
        output_ports:
        - masked_scan_base
        - masked_scan_elbow
        - masked_scan_tool

    `robot_report` (vector, REPORT_SIZE) is what the robot tells of itself.
    Once a control tick it is remembered; where a ring's
    scan is new, it tells what each reading means (`mask_scans`). Nothing of
    the simulated world is used: the rays are cast on a twin that is posed
    from the measured joints. All rings share one system, since they share
    the robot's reports and an event costs more than a look at a scan.

    Before a ring's first scan its port holds an empty one (sequence -1).
    """

    def __init__(
        self,
        *,
        config: OcclusionMaskConfig,
        period: float = 0.008,
        caster: RayCaster,
        bundles: RayBundles,
        twin: Twin,
        masks_periodically: bool = True,
        name: tuple[str, ...] = RINGS,
    ):
        """Constructs the system.

        Args:
            config: settings.
            period: control tick, s.
            caster: of the twin's SceneGraph.
            bundles: the rings' rays by that caster, see `make_mask_bundles`;
                as many for each ring.
            twin: gives the poses of `caster.frame_ids`.
            masks_periodically: look at the scans at each control tick; else
                only in forced updates, which spare a loop the copy of the
                Diagram's whole State.
            name: the rings, in the order of `bundles`.

        Raises:
            UserError: if a setting is out of range.
            ValueError: if the rays do not suit the rings.
        """
        super().__init__()
        config.check("mask")
        require_period(period)
        require(
            config.max_age >= period,
            f"mask.max_age: {config.max_age} is shorter than the control tick "
            f"of {period}",
        )
        n, rest = divmod(bundles.num_bundles, len(name))
        if n == 0 or rest:
            raise ValueError(
                f"bundles: {bundles.num_bundles} for {len(name)} rings"
            )
        self._config = config
        self._caster = caster
        self._bundles = bundles
        self._twin = twin
        self._scans = [
            self.DeclareAbstractInputPort(f"scan_{ring}", Value(RingScan()))
            for ring in name
        ]
        self._report = self.DeclareVectorInputPort("robot_report", REPORT_SIZE)
        # A sample that is not stale lies within the history, and so does the
        # look back from it.
        length = math.ceil((config.max_age + config.time_margin) / period) + 2
        self._history = self.DeclareDiscreteState(
            make_robot_history(length).ravel()
        )
        # Of the scans that are masked: cheaper to ask than the messages.
        self._sequence = self.DeclareDiscreteState([-1.0] * len(name))
        self._masked_scans = [
            self.DeclareAbstractState(Value(MaskedScan())) for _ in name
        ]
        for ring, index in zip(name, self._masked_scans, strict=True):
            self.DeclareStateOutputPort(f"masked_scan_{ring}", index)
        # Two events: most ticks bring no scan, and what follows from the
        # masked scans is then not computed again.
        if masks_periodically:
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._mask)
        self.DeclareForcedUnrestrictedUpdateEvent(self._mask)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def _remember(self, context: Context, discrete_state: DiscreteValues):
        history = discrete_state.get_mutable_value(self._history)
        push_report(
            history.reshape(-1, _COLUMNS),
            context.get_time(),
            self._report.Eval(context),
        )

    def _mask(self, context: Context, state: State):
        scans = [port.Eval(context) for port in self._scans]
        sequence = [scan.sequence for scan in scans]
        last_sequence = state.get_discrete_state().get_value(self._sequence)
        if sequence == last_sequence.tolist():
            return DID_NOTHING
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
        table = history.reshape(-1, _COLUMNS).copy()
        push_report(table, context.get_time(), self._report.Eval(context))
        masked_scans = mask_scans(
            self._config,
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
        )
        for value, masked_scan, new in zip(
            values, masked_scans, is_new, strict=True
        ):
            if new:
                value.set_value(masked_scan)
        state.get_mutable_discrete_state().set_value(self._sequence, sequence)
        return SUCCEEDED
