"""From masked scans to a person's distance and how fast it shrinks."""

from collections.abc import Sequence
import dataclasses as dc
import math
from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem

from tofssm_drake.errors import check_range
from tofssm_drake.kernels import njit
from tofssm_drake.messages import (
    FAULT_NAMES,
    MaskedScan,
    Reading,
    RingHealth,
    SensorFault,
    Separation,
    make_empty_separation,
)
from tofssm_drake.perception.readings import calc_ring_health, count_readings

_VALID = int(Reading.VALID)
_FAULTED = int(Reading.FAULTED)
_HELD = int(Reading.HELD)

# See `SeparationConfig.max_gap`; s.
_GAP_PERIODS = 4.1
_LEAST_MAX_GAP = 0.1


@dc.dataclass(kw_only=True)
class SeparationConfig:
    """How distances and directed speeds follow from masked scans."""

    # Speed of a person whose motion is not known yet, m/s (ISO/TS 15066: an
    # unmonitored person walks at 1.6 m/s towards the robot).
    V_hmax: float = 1.6

    # Differentiate the minimum over the ring, whichever sensors saw it, as in
    # the paper's Eq. 9, instead of each sensor's own samples.
    literal: bool = False

    # Keep the sign of the paper's Eq. 9, which gives an approaching person a
    # negative closing speed. Not safe; for comparison only.
    literal_sign: bool = False

    # A sensor's samples farther apart than this give no speed, s. null:
    # slightly more than four periods of the ring's sensors, so that three may
    # be lost; at least 0.1 s (*assumed*).
    max_gap: float | None = None

    # If a sensor is faulted for longer than this, s, its link is faulted,
    # which stops the robot (*assumed*: a person walks half a metre in that
    # time, and at 42 Hz it takes 12 lost samples in a row, or 13 more than a
    # fifth of the good ones among them. If one sample in 20 is lost, three
    # rings of 8 stop the robot less than once in four years; if one in 14 is,
    # once in four days: such a sensor is not healthy).
    # If more than half of a ring's sensors are faulted at once, the robot stops
    # at once; with one lost sample in a hundred that happens by chance once in
    # 17 days.
    fault_time: float = 0.3

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        check_range(where, "V_hmax", self.V_hmax, 0.0, 10.0)
        if self.max_gap is not None:
            check_range(where, "max_gap", self.max_gap, 0.0, 10.0)
        check_range(where, "fault_time", self.fault_time, 0.0, 10.0)

    def calc_max_gap(self, sensor_period: float = 0.0) -> float:
        """Returns from which time between samples on they give no speed, s.

        Args:
            sensor_period: Of the ring, s; 0: the least.
        """
        if self.max_gap is not None:
            return self.max_gap
        return max(_LEAST_MAX_GAP, _GAP_PERIODS * sensor_period)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingGeometry:
    """Where the n sensors of a ring are on their link."""

    radius: float
    """Radius r_l of the circle of the sensors' origins, m; 0 unless the beams
    are radial."""
    beam_L: np.ndarray
    """Unit vectors of the beams in the ring's frame L, (n, 3)."""
    p_LS: np.ndarray
    """Origins of the sensors in L, m, (n, 3)."""
    is_radial: bool = True
    """Whether all beams start at one radius and point straight outwards."""

    def calc_centre_distance(self, distance: np.ndarray) -> np.ndarray:
        """Returns ||D|| - r_l of what each sensor sees on its axis, m, (n,).

        For radial beams it is the measured distance itself (paper:
        ||D|| = r_l + d).

        Args:
            distance: As measured, m, (n,).
        """
        if self.is_radial:
            return distance
        seen = np.isfinite(distance)
        p_LO = self.p_LS + np.where(seen, distance, 0.0)[:, None] * self.beam_L
        return np.where(seen, np.linalg.norm(p_LO, axis=1), distance)

    def find_direction(self, sensor: int, distance: float) -> np.ndarray:
        """Returns the unit vector from the link's centre to what is seen, (3,).

        Args:
            sensor: Which one sees it.
            distance: As measured, m.
        """
        if self.is_radial:
            return self.beam_L[sensor]
        p_LO = self.p_LS[sensor] + distance * self.beam_L[sensor]
        length = np.linalg.norm(p_LO)
        return p_LO / length if length > 0.0 else self.beam_L[sensor]


def make_ring_geometry(X_LS: Sequence) -> RingGeometry:
    """Reads origins and beams from the sensors' poses.

    Args:
        X_LS: pose of each sensor's frame S in the ring's frame L, whose
            origin is the link's centre; x of S is the axis of the beam.
    """
    p_LS = np.array([X.translation() for X in X_LS])
    beam_L = np.array([X.rotation().matrix()[:, 0] for X in X_LS])
    radius = float(np.linalg.norm(p_LS[0]))
    is_radial = np.allclose(p_LS, radius * beam_L, rtol=0.0, atol=1e-6)
    return RingGeometry(
        radius=radius if is_radial else 0.0,
        beam_L=beam_L,
        p_LS=p_LS,
        is_radial=is_radial,
    )


class LinkKinematics(Protocol):
    """What TofSeparation needs to know about the robot."""

    @property
    def num_joints(self) -> int:
        """Number of the robot's joints."""

    def calc(
        self, q: np.ndarray, qd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns p_WL (m, 3), R_WL (m, 3, 3) and v_WL (m, 3)."""


@njit(cache=True)
def find_nearest(distance, reading):
    """Returns the index of the nearest sensor with an obstacle; -1: none.

    Args:
        distance: (n,) m.
        reading: (n,) `Reading`; only VALID and HELD ones are obstacles.
    """
    nearest = -1
    for i in range(distance.shape[0]):
        if (reading[i] == _VALID or reading[i] == _HELD) and (
            nearest < 0 or distance[i] < distance[nearest]
        ):
            nearest = i
    return nearest


@njit(cache=True)
def close_in(distance, reading, sensor_time, now, speed):
    """Returns the present distances: HELD ones have shrunk, (n,) m.

    Args:
        distance: (n,) m, as of `sensor_time`.
        reading: (n,) `Reading`.
        sensor_time: (n,) s.
        now: s.
        speed: at which held obstacles come closer, m/s.
    """
    result = distance.copy()
    for i in range(distance.shape[0]):
        if reading[i] == _HELD:
            elapsed = max(now - sensor_time[i], 0.0)
            result[i] = max(distance[i] - speed * elapsed, 0.0)
    return result


@njit(cache=True)
def saturate(k, k_max):
    """Returns k limited to [-k_max, k_max]."""
    return min(max(k, -k_max), k_max)


# Columns of a link's row, the fields of a Separation: first the real numbers,
# then the integers.
_TIME = 0
_DISTANCE = 1
_LINK_SPEED = 2
_K_L = 3
_K_O = 4
_DIRECTION = 5
_REALS = 8
_SEQUENCE = 8
_SENSOR = 9
_HEALTH = 10
_COUNT = 11
_COLUMNS = 15


@njit(cache=True)
def _find_moment(distance, reading, sensor_time, now):
    """Returns the deciding sensor, the one whose pose counts, and the time."""
    sensor = find_nearest(distance, reading)
    if sensor >= 0 and reading[sensor] == _VALID:
        return sensor, sensor, sensor_time[sensor]
    # Nothing was measured: the link at the newest sample, but with the time
    # of the oldest sample that the ring relies on.
    newest = 0
    oldest_time = np.inf
    for i in range(sensor_time.shape[0]):
        if sensor_time[i] > sensor_time[newest]:
            newest = i
        if reading[i] != _FAULTED and reading[i] != _HELD:
            oldest_time = min(oldest_time, sensor_time[i])
    if sensor >= 0:
        # The pose and the distance of a held obstacle are those of now.
        return sensor, sensor, min(oldest_time, now)
    if oldest_time == np.inf:
        oldest_time = -np.inf
    return -1, newest, oldest_time


@njit(cache=True)
def _calc_closing_speed(sensor, measured, max_gap, literal):
    """Returns -d||D||/dt of a sensor; NaN if it is unknown.

    Args:
        sensor: the deciding one.
        measured: distances, m, times, s, and the same of the previous samples,
            (n,) each.
        max_gap: s.
        literal: `literal` and `literal_sign`.
    """
    distance, time, previous_distance, previous_time = measured
    before = sensor
    if literal[0]:
        for i in range(distance.shape[0]):
            if previous_distance[i] < previous_distance[before] or np.isnan(
                previous_distance[before]
            ):
                before = i
    dt = time[sensor] - previous_time[before]
    # NaN if that sensor had no valid sample: the comparison is false.
    if 0.0 < dt <= max_gap and previous_distance[before] >= 0.0:
        speed = (previous_distance[before] - distance[sensor]) / dt
        return -speed if literal[1] else speed
    return np.nan


@njit(cache=True)
def _calc_speeds(measured_speed, is_held, direction_L, R_WL, v_WL, V_hmax):
    """Returns direction in world (3), k_l and k_o of the deciding sensor."""
    direction = np.zeros(3)
    k_l = 0.0
    for i in range(3):
        for j in range(3):
            direction[i] += R_WL[i, j] * direction_L[j]
        k_l += v_WL[i] * direction[i]
    k_o = k_l + V_hmax
    if measured_speed == measured_speed:
        k_o = max(k_o, measured_speed) if is_held else measured_speed
    return direction, k_l, k_o


# A link's row in two compiled steps, since each call costs a microsecond:
# between them the deciding sensor is known, and the link is posed for it.


@njit(cache=True)
def _begin_row(row, reading, distance, sensor_time, now, k_max):
    """Finds the deciding sensor; -1: none.

    Args:
        row: gets time, distance, sensor and counts, (15,).
        reading: (n,) `Reading`.
        distance: as measured, (n,) m.
        sensor_time: (n,) s.
        now: s.
        k_max: speed at which held obstacles come closer, m/s.

    Returns:
        The sensor, and the one at whose time the link is to be posed.
    """
    closed_in = close_in(distance, reading, sensor_time, now, k_max)
    sensor, moment, time = _find_moment(closed_in, reading, sensor_time, now)
    row[_TIME] = time
    row[_SENSOR] = sensor
    row[_DISTANCE] = np.inf if sensor < 0 else closed_in[sensor]
    row[_COUNT:] = count_readings(reading)
    return sensor, moment


@njit(cache=True)
def _end_row(row, reading, measured, direction_L, R_WL, v_WL, limits, literal):
    """Writes direction, k_l and k_o, from time, distance and sensor.

    Args:
        row: from `_begin_row`, with the link's speed, (15,); changed.
        reading: (n,) `Reading`.
        measured: distances, m, times, s, and the same of the previous samples,
            (n,) each.
        direction_L: from the link's centre to what is seen, in L, (3,).
        R_WL: orientation of the link in world, (3, 3).
        v_WL: its velocity, m/s, (3,).
        limits: V_hmax, m/s, max_gap, s, and k_max, m/s.
        literal: `literal` and `literal_sign`.
    """
    V_hmax, max_gap, k_max = limits
    sensor = int(row[_SENSOR])
    if sensor < 0:
        row[_DIRECTION:_REALS] = np.nan
        k_l = row[_LINK_SPEED]
        k_o = k_l + V_hmax
    else:
        measured_speed = _calc_closing_speed(sensor, measured, max_gap, literal)
        row[_DIRECTION:_REALS], k_l, k_o = _calc_speeds(
            measured_speed,
            reading[sensor] == _HELD,
            direction_L,
            R_WL,
            v_WL,
            V_hmax,
        )
    row[_K_L] = saturate(k_l, k_max)
    row[_K_O] = saturate(k_o, k_max)


def calc_link_row(
    config: SeparationConfig,
    masked_scan: MaskedScan,
    geometry: RingGeometry,
    kinematics: LinkKinematics,
    link: int,
    k_max: float = 3.3,
) -> np.ndarray:
    """Calculates a link's part of a Separation from its ring's scan.

    The nearest VALID sensor decides (paper, Minimum Distance Calculation):
    ||D|| = r_l + d, along its beam; for a sensor that does not look straight
    outwards, D goes to the point at d on its axis. The directed speeds are
    k_l = V_l . P^ and k_o = -(||D||(t) - ||D||(t - dt)) / dt of the same
    sensor by its own times, which includes the robot's own motion;
    where that sensor had no valid sample before, k_o = k_l + V_hmax.
    Without a valid sensor the distance is inf, k_l = ||V_l|| and
    k_o = ||V_l|| + V_hmax: a person may appear in any direction.

    A HELD distance counts like a valid one. It has shrunk at k_max since it was
    measured, and its k_o is the greater of the last measured one and
    k_l + V_hmax.

    Args:
        config: settings.
        masked_scan: of the ring of this link, with at least one sensor.
        geometry: of that ring.
        kinematics: of the robot.
        link: index of the link in what `kinematics` returns.
        k_max: k_l and k_o are saturated to +-k_max, m/s.

    Returns:
        Time, distance, link speed, k_l, k_o, direction (3), sequence, sensor,
        health, counts (4): a row of what `make_separation` takes.
    """
    scan, reading = masked_scan.scan, masked_scan.reading
    distance = geometry.calc_centre_distance(scan.distance)
    row = np.empty(_COLUMNS)
    row[_SEQUENCE] = scan.sequence
    row[_HEALTH] = _calc_health(config, masked_scan)
    sensor, moment = _begin_row(
        row, reading, distance, scan.sensor_time, scan.time, k_max
    )
    if sensor >= 0:
        row[_DISTANCE] += geometry.radius
    _, R_WL, v_WL = kinematics.calc(
        masked_scan.position[moment], masked_scan.velocity[moment]
    )
    row[_LINK_SPEED] = math.sqrt(v_WL[link] @ v_WL[link])
    _end_row(
        row,
        reading,
        (
            distance,
            scan.sensor_time,
            geometry.calc_centre_distance(masked_scan.previous_distance),
            masked_scan.previous_time,
        ),
        geometry.find_direction(sensor, scan.distance[sensor]),
        R_WL[link],
        v_WL[link],
        (config.V_hmax, config.calc_max_gap(), k_max),
        (config.literal, config.literal_sign),
    )
    return row


def _calc_health(config, masked_scan):
    """Returns the `RingHealth` of a ring."""
    if masked_scan.scan.problem:
        return RingHealth.FAULTED
    return calc_ring_health(
        masked_scan.reading,
        masked_scan.fault,
        masked_scan.scan.time - masked_scan.healthy_time,
        config.fault_time,
    )


def describe_problem(masked_scan: MaskedScan) -> str:
    """Says in a few words what is wrong with a ring; empty: nothing.

    The text does not change while the fault is the same, e.g.
    "sensor 3: bus; sensors 5, 6: frozen".
    """
    if masked_scan.scan.problem:
        return masked_scan.scan.problem
    parts = []
    for fault in np.unique(masked_scan.fault):
        if fault != SensorFault.NONE:
            sensors = np.flatnonzero(masked_scan.fault == fault).tolist()
            if len(sensors) == len(masked_scan.fault):
                who = "all sensors"
            else:
                plural = "s" if len(sensors) > 1 else ""
                who = f"sensor{plural} {', '.join(map(str, sensors))}"
            parts.append(f"{who}: {FAULT_NAMES[SensorFault(fault)]}")
    return "; ".join(parts)


def make_separation(
    rows: np.ndarray,
    name: tuple[str, ...],
    masked_scans: tuple[MaskedScan, ...] = (),
) -> Separation:
    """Makes the message from the links' rows, (m, 15).

    Args:
        rows: From `calc_link_row`.
        name: The m links.
        masked_scans: What the rows were made from.
    """
    # Column by column, so that each field is contiguous.
    columns = rows.T.copy()
    whole = columns[_REALS:].astype(int)
    direction = columns[_DIRECTION:_REALS].T.copy()
    count = whole[_COUNT - _REALS :].T.copy()
    for array in (rows, columns, whole, direction, count):
        array.setflags(write=False)
    return Separation.of_read_only(
        name=name,
        sequence=whole[_SEQUENCE - _REALS],
        time=columns[_TIME],
        distance=columns[_DISTANCE],
        sensor=whole[_SENSOR - _REALS],
        direction=direction,
        link_speed=columns[_LINK_SPEED],
        k_l=columns[_K_L],
        k_o=columns[_K_O],
        health=whole[_HEALTH - _REALS],
        count=count,
        problem=_describe_problems(whole[_HEALTH - _REALS], masked_scans),
    )


def _describe_problems(health, masked_scans):
    """Returns `Separation.problem`; texts are made only for faults."""
    if len(masked_scans) != len(health):
        return ("",) * len(health)
    return tuple(
        describe_problem(masked_scan)
        if health[i] in _WITH_PROBLEM and masked_scan.scan.sequence >= 0
        else ""
        for i, masked_scan in enumerate(masked_scans)
    )


_WITH_PROBLEM = (int(RingHealth.FAULTED), int(RingHealth.DEGRADED))


# Input of `lay_out_separation`, rows of m links each. After the rows of `reals`
# come the directions, link by link, after those of `whole` the counts.
TIME, DISTANCE, LINK_SPEED, K_L, K_O = range(5)
SEQUENCE, SENSOR, HEALTH = range(3)


def make_columns(m: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns empty (reals, whole) for m links, (8, m) and (7, m)."""
    return np.empty((8, m)), np.empty((7, m), dtype=int)


def lay_out_separation(
    name: tuple[str, ...], reals: np.ndarray, whole: np.ndarray
) -> Separation:
    """Makes the message from two arrays, which become read-only.

    Its fields are views of them, which takes a third of the time of separate
    arrays.

    Args:
        name: The m links.
        reals: From `make_columns`, filled in.
        whole: Likewise.
    """
    reals.setflags(write=False)
    whole.setflags(write=False)
    return Separation.of_read_only(
        name=name,
        sequence=whole[SEQUENCE],
        time=reals[TIME],
        distance=reals[DISTANCE],
        sensor=whole[SENSOR],
        direction=reals[K_O + 1 :].reshape(-1, 3),
        link_speed=reals[LINK_SPEED],
        k_l=reals[K_L],
        k_o=reals[K_O],
        health=whole[HEALTH],
        count=whole[HEALTH + 1 :].reshape(-1, 4),
    )


def _make_empty_row() -> np.ndarray:
    """Returns the row of a link that was never measured."""
    empty = make_empty_separation(("",))
    row = np.empty(_COLUMNS)
    row[_SEQUENCE] = empty.sequence[0]
    row[_TIME] = empty.time[0]
    row[_DISTANCE] = empty.distance[0]
    row[_SENSOR] = empty.sensor[0]
    row[_DIRECTION:_REALS] = empty.direction[0]
    row[_LINK_SPEED] = empty.link_speed[0]
    row[_K_L] = empty.k_l[0]
    row[_K_O] = empty.k_o[0]
    row[_HEALTH] = empty.health[0]
    row[_COUNT:] = empty.count[0]
    return row


class _LastKinematics:
    """Remembers the last result: rings usually sample at the same time."""

    def __init__(self, kinematics: LinkKinematics):
        self._kinematics = kinematics
        self._last: tuple = None, None

    @property
    def num_joints(self) -> int:
        return self._kinematics.num_joints

    def calc(self, q, qd):
        key = q.tobytes() + qd.tobytes()
        last_key, result = self._last
        if key != last_key:
            result = self._kinematics.calc(q, qd)
            self._last = key, result
        return result


class TofSeparation(LeafSystem):
    """Calculates the separation of the robot's links from its ToF rings.

    .. pydrake_system::

        name: TofSeparation
        input_ports:
        - masked_scan_<ring>
        output_ports:
        - separation

    See `calc_link_row` for the equations. Each link's values change only
    when its own ring has a new scan. A link whose ring has not measured yet
    is FAULTED.
    """

    def __init__(
        self,
        *,
        config: SeparationConfig,
        k_max: float = 3.3,
        kinematics: LinkKinematics,
        geometries: Sequence[RingGeometry],
        sensor_period: float = 0.0,
        name: tuple[str, ...],
    ):
        """Constructs the system.

        Args:
            config: settings.
            k_max: k_l and k_o are saturated to +-k_max, m/s.
            kinematics: of the links, in the order of `name`.
            geometries: of the rings, in the same order.
            sensor_period: from one sample of a sensor to the next, s, for
                `config.max_gap`; 0: the least.
            name: the rings.

        Raises:
            UserError: if a setting is out of range.
            ValueError: if there are not as many rings as names, or k_max is
                not positive.
        """
        super().__init__()
        config.check("separation")
        if not (math.isfinite(k_max) and k_max > 0.0):
            raise ValueError(f"k_max: {k_max} must be a speed above 0")
        self._k_max = k_max
        self._config = dc.replace(
            config, max_gap=config.calc_max_gap(sensor_period)
        )
        self._kinematics = _LastKinematics(kinematics)
        self._geometries = tuple(geometries)
        self._name = tuple(name)
        if len(self._geometries) != len(self._name):
            raise ValueError(
                f"geometries: {len(self._geometries)} for "
                f"{len(self._name)} rings"
            )
        self._masked_scans = [
            self.DeclareAbstractInputPort(
                f"masked_scan_{ring}", Value(MaskedScan())
            )
            for ring in self._name
        ]
        prerequisites = {port.ticket() for port in self._masked_scans}
        self.DeclareAbstractOutputPort(
            "separation",
            Value(
                make_separation(
                    np.tile(_make_empty_row(), (len(self._name), 1)),
                    self._name,
                    (MaskedScan(),) * len(self._name),
                )
            ).Clone,
            self._calc_separation,
            prerequisites_of_calc=prerequisites,
        )

    def _calc_separation(self, context: Context, output):
        """Calculates a row for each link."""
        masked_scans = tuple(port.Eval(context) for port in self._masked_scans)
        rows = np.array(
            [
                _make_empty_row()
                if masked_scan.scan.sequence < 0
                else calc_link_row(
                    self._config,
                    masked_scan,
                    self._geometries[link],
                    self._kinematics,
                    link,
                    self._k_max,
                )
                for link, masked_scan in enumerate(masked_scans)
            ]
        )
        output.set_value(make_separation(rows, self._name, masked_scans))
