"""The occlusion mask: which sensors see the robot itself or its cell."""

from collections.abc import Sequence
import dataclasses as dc
import functools
import math
from typing import Protocol

from numba import njit
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    State,
)

from tofssm_drake.errors import require, require_period
from tofssm_drake.geometry.fan import make_cone_fan
from tofssm_drake.geometry.ray_caster import RayBundles, RayCaster
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
def push_report(
    table, time, position, velocity, gripper_closed, products_placed
):
    """Returns a history's table with a report added and the oldest dropped."""
    result = np.empty_like(table)
    result[:-1] = table[1:]
    last = result[-1]
    last[0] = time
    last[1:7] = position
    last[7:13] = velocity
    last[13] = gripper_closed
    last[14] = products_placed
    return result


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


@njit(cache=True)
def inspect_scan(sensor_time, status):
    """Tells whether all sensors have one time, and whether any has no data.

    Args:
        sensor_time: (n,) s.
        status: (n,) range status.
    """
    one_time = math.isfinite(sensor_time[0])
    some_held = False
    for i in range(sensor_time.shape[0]):
        one_time = one_time and sensor_time[i] == sensor_time[0]
        some_held = some_held or status[i] == STATUS_NO_NEW_DATA
    return one_time, some_held


def hold_readings(scan: RingScan, before: RingScan) -> RingScan:
    """Puts the sample before in place of "no new data".

    A ring may fire its sensors in turns, or a sensor may take longer; its
    last sample then stands, with its own time, until it is too old.

    Args:
        scan: the new scan.
        before: what was made of the scan before it.
    """
    held = scan.status == STATUS_NO_NEW_DATA
    if before.status.shape != scan.status.shape:
        return scan
    return dc.replace(
        scan,
        sensor_time=np.where(held, before.sensor_time, scan.sensor_time),
        distance=np.where(held, before.distance, scan.distance),
        status=np.where(held, before.status, scan.status),
    )


@njit(cache=True)
def pick_previous(
    sensor_time,
    before_time,
    before_distance,
    before_reading,
    before_previous_distance,
    before_previous_time,
):
    """Returns each sensor's sample before this one.

    Args:
        sensor_time: of the new samples, s, (n,).
        before_time: of the samples in the scan before, s, (n,).
        before_distance: those, m, (n,).
        before_reading: what they meant, (n,).
        before_previous_distance: the samples before those, m, (n,).
        before_previous_time: when they were, s, (n,).

    Returns:
        Distance, m, (n,), NaN where it was not VALID; its time, s, (n,).
    """
    n = sensor_time.shape[0]
    distance = np.full(n, np.nan)
    time = np.empty(n)
    for i in range(n):
        if sensor_time[i] == before_time[i]:
            # A sample that is held has still the same one before it.
            distance[i] = before_previous_distance[i]
            time[i] = before_previous_time[i]
        else:
            if before_reading[i] == _VALID:
                distance[i] = before_distance[i]
            time[i] = before_time[i]
    return distance, time


class TwinView:
    """What all sensors would see of the robot itself and its cell.

    Rings that sampled at the same time share one look.
    """

    def __init__(
        self,
        *,
        enabled: bool,
        caster: RayCaster,
        bundles: RayBundles,
        twin: Twin,
        table: np.ndarray,
    ):
        """Constructs the view.

        Args:
            enabled: False: nothing is ever seen.
            caster: of the twin.
            bundles: the rays of all sensors, see `make_mask_bundles`.
            twin: gives the poses that the caster needs.
            table: the robot's reports, see `make_robot_history`.
        """
        self.num_sensors = bundles.num_bundles
        self._enabled = enabled
        self._caster = caster
        self._bundles = bundles
        self._twin = twin
        self._table = table
        self._looks = {}

    def look(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Casts all rays at the robot as it was at a time.

        Args:
            time: s.

        Returns:
            Distances along the rays, m, (sensors, k), and the robot's report
            for that time, (15,).
        """
        if time not in self._looks:
            report = interpolate_reports(self._table, time)
            if self._enabled:
                self_distance, _ = self._caster.cast_bundles(
                    self._bundles,
                    self._twin.calc(
                        report[_POSITION],
                        report[_GRIPPER_CLOSED],
                        report[_PRODUCTS_PLACED],
                    ),
                )
            else:
                self_distance = np.full((self.num_sensors, 1), np.inf)
            self._looks[time] = self_distance, report
        return self._looks[time]


def mask_scan(
    config: OcclusionMaskConfig,
    *,
    scan: RingScan,
    before: MaskedScan,
    time: float,
    view: TwinView,
    rows: slice,
) -> MaskedScan:
    """Tells what each reading of a new scan means.

    Looks at the twin as the robot was at the sample's own time, and compares
    (paper, Self Occlusion Detection; table in
    `tofssm_drake.sensing.readings`). What would be valid is compared again
    with the robot as it was a little earlier and later.

    Args:
        config: settings.
        scan: the new scan of n sensors.
        before: the result for the scan before it.
        time: now, s.
        view: what all sensors would see of the robot itself.
        rows: the ring's n sensors among those of the view.

    Returns:
        The masked scan. Its `scan` is as the monitor reckons with it: 0 m for
        a target nearer than can be measured, and the sample before where
        there is no new data.
    """
    n = len(scan.status)
    if n != rows.stop - rows.start:
        raise ValueError(
            f"scan of {n} sensors, but the mask has {rows.stop - rows.start}"
        )
    one_time, some_held = inspect_scan(scan.sensor_time, scan.status)
    if some_held:
        scan = hold_readings(scan, before.scan)
        one_time = False
    if before.reading.shape != (n,):
        before = _make_nothing_before(n)

    def look(shift):
        return _look_at_own_times(view, rows, scan.sensor_time, one_time, shift)

    def interpret(self_distance):
        return _interpret(
            scan.distance,
            scan.status,
            scan.sensor_time,
            self_distance,
            reports,
            before.scan.sensor_time,
            before.scan.distance,
            before.reading,
            before.previous_distance,
            before.previous_time,
            time,
            config.tolerance,
            config.min_range,
            config.max_range,
            config.max_age,
        )

    self_distance, reports = look(0.0)
    result = interpret(self_distance)
    if config.enabled and config.time_margin > 0.0 and result[-1]:
        # A wider look can only turn valid readings into masked ones, so it is
        # left for when there are any.
        early, _ = look(-config.time_margin)
        late, _ = look(config.time_margin)
        result = interpret(np.hstack([self_distance, early, late]))
    (
        reading,
        reckoned,
        is_other,
        self_nearest,
        self_farthest,
        previous_distance,
        previous_time,
        position,
        velocity,
        _,
    ) = result
    if is_other:
        scan = dc.replace(scan, distance=reckoned)
    return MaskedScan(
        scan=scan,
        reading=reading,
        self_nearest=self_nearest,
        self_farthest=self_farthest,
        previous_distance=previous_distance,
        previous_time=previous_time,
        position=position,
        velocity=velocity,
    )


@functools.cache
def _make_nothing_before(n):
    """Returns the masked scan before the first of n sensors."""
    nothing = np.full(n, np.nan)
    return MaskedScan(
        scan=RingScan(sensor_time=np.full(n, -np.inf), distance=nothing),
        reading=np.full(n, Reading.FAULTED, dtype=np.uint8),
        previous_distance=nothing,
        previous_time=np.full(n, -np.inf),
    )


def _look_at_own_times(view, rows, sensor_time, one_time, shift):
    """Returns what each sensor would see at its own time, shifted.

    Returns:
        Distances along the rays, m, (n, k), and the robot's report for each
        sensor's time, (n, 15); one row if it is the same for all.
    """
    if one_time:
        self_distance, report = view.look(sensor_time[0] + shift)
        return self_distance[rows], report[None]

    n = len(sensor_time)
    reports = np.zeros((n, _COLUMNS))
    self_distance = None
    todo = np.isfinite(sensor_time)
    while todo.any():
        time = sensor_time[np.argmax(todo)]
        now = sensor_time == time
        todo &= ~now
        seen, reports[now] = view.look(time + shift)
        if self_distance is None:
            self_distance = np.full((n, seen.shape[1]), np.inf)
        self_distance[now] = seen[rows][now]
    if self_distance is None:
        self_distance = np.full((n, 1), np.inf)
    return self_distance, reports


@njit(cache=True)
def _interpret(
    distance,
    status,
    sensor_time,
    self_distance,
    reports,
    before_time,
    before_distance,
    before_reading,
    before_previous_distance,
    before_previous_time,
    time,
    tolerance,
    min_range,
    max_range,
    max_age,
):
    """Does all the arithmetic of a scan at once: calls cost more than it."""
    n = distance.shape[0]
    self_nearest, self_farthest = calc_self_interval(self_distance)
    reading, reckoned = classify_readings(
        distance,
        status,
        time - sensor_time,
        self_nearest,
        self_farthest,
        tolerance,
        min_range,
        max_range,
        max_age,
    )
    is_other = False
    some_valid = False
    speed = 0.0
    position = np.empty((n, 6))
    velocity = np.empty((n, 6))
    last_report = reports.shape[0] - 1
    for i in range(n):
        if reckoned[i] != distance[i]:
            is_other = True
        if reading[i] == _VALID:
            some_valid = True
        report = reports[min(i, last_report)]
        for j in range(6):
            position[i, j] = report[1 + j]
            velocity[i, j] = report[7 + j]
            speed = max(speed, abs(velocity[i, j]))
    previous_distance, previous_time = pick_previous(
        sensor_time,
        before_time,
        before_distance,
        before_reading,
        before_previous_distance,
        before_previous_time,
    )
    return (
        reading,
        reckoned,
        is_other,
        self_nearest,
        self_farthest,
        previous_distance,
        previous_time,
        position,
        velocity,
        some_valid and speed > _STILL,
    )


class OcclusionMask(LeafSystem):
    """Tells the robot and its cell from everything else in the rings' scans.

    .. pydrake_system::

        name: OcclusionMask
        input_ports:
        - scan_base
        - scan_elbow
        - scan_tool
        - position_measured
        - velocity_measured
        - gripper_closed
        - products_placed
        output_ports:
        - masked_scan_base
        - masked_scan_elbow
        - masked_scan_tool

    Once a control tick it remembers what the robot reports; where a ring's
    scan is new, it tells what each reading means (`mask_scan`). Nothing of
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
        self._rows = [slice(n * i, n * i + n) for i in range(len(name))]
        self._twin = twin
        self._scans = [
            self.DeclareAbstractInputPort(f"scan_{ring}", Value(RingScan()))
            for ring in name
        ]
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._velocity = self.DeclareVectorInputPort("velocity_measured", 6)
        self._gripper_closed = self.DeclareVectorInputPort("gripper_closed", 1)
        self._products_placed = self.DeclareVectorInputPort(
            "products_placed", 1
        )
        # A sample that is not stale lies within the history, and so does the
        # look back from it.
        length = math.ceil((config.max_age + config.time_margin) / period) + 2
        self._history = self.DeclareDiscreteState(
            make_robot_history(length).ravel()
        )
        self._masked_scans = [
            self.DeclareAbstractState(Value(MaskedScan())) for _ in name
        ]
        for ring, index in zip(name, self._masked_scans, strict=True):
            self.DeclareStateOutputPort(f"masked_scan_{ring}", index)
        # Two events: most ticks bring no scan, and what follows from the
        # masked scans is then not computed again.
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._mask)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._remember)

    def _push_report(self, context: Context) -> np.ndarray:
        """Returns the history with the present report added."""
        history = context.get_discrete_state(self._history).value()
        return push_report(
            history.reshape(-1, _COLUMNS),
            context.get_time(),
            self._position.Eval(context),
            self._velocity.Eval(context),
            self._gripper_closed.Eval(context)[0],
            self._products_placed.Eval(context)[0],
        )

    def _remember(self, context: Context, discrete_state: DiscreteValues):
        discrete_state.set_value(
            self._history, self._push_report(context).ravel()
        )

    def _mask(self, context: Context, state: State):
        values = [
            state.get_mutable_abstract_state(index)
            for index in self._masked_scans
        ]
        view = None
        for value, port, rows in zip(
            values, self._scans, self._rows, strict=True
        ):
            scan = port.Eval(context)
            before = value.get_value()
            if scan.sequence == before.scan.sequence:
                continue
            if view is None:
                view = TwinView(
                    enabled=self._config.enabled,
                    caster=self._caster,
                    bundles=self._bundles,
                    twin=self._twin,
                    table=self._push_report(context),
                )
            value.set_value(
                mask_scan(
                    self._config,
                    scan=scan,
                    before=before,
                    time=context.get_time(),
                    view=view,
                    rows=rows,
                )
            )
        if view is None:
            return EventStatus.DidNothing()
        return EventStatus.Succeeded()
