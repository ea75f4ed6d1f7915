"""Separation from a planar lidar at the robot's base.

It sees a person at the height of its plane: legs, or the lower torso. Two
things follow from its place. The distance is from the base's axis, so either
the law's distances grow by the radius of the robot's workspace or the radius
is subtracted from the distance. And the lidar does not move with the robot: a
measured speed is the person's alone.
"""

import dataclasses as dc
import math
from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from tofssm_drake.errors import check_range, require, require_period
from tofssm_drake.kernels import njit
from tofssm_drake.messages import (
    LidarScan,
    Reading,
    RingHealth,
    Separation,
    make_empty_separation,
)
from tofssm_drake.perception.readings import count_readings
from tofssm_drake.perception.separation import (
    lay_out_separation,
    make_columns,
    saturate,
)

# As compile-time constants for the kernels.
_CLEAR = int(Reading.CLEAR)
_VALID = int(Reading.VALID)
_MASKED = int(Reading.MASKED)
_FAULTED = int(Reading.FAULTED)

# See `LidarSeparationConfig.max_gap`; s.
_GAP_PERIODS = 2.5
_LEAST_MAX_GAP = 0.1

DISTANCE_RULES = ("raw", "subtracted", "literal")


@dc.dataclass(kw_only=True)
class LidarSeparationConfig:
    """How a distance and directed speeds follow from a lidar's scans."""

    # How the workspace radius r_o is used. "raw": the distance from the base's
    # axis as it is; r_o is added to the law's C_dC and to its fixed distances
    # (1.12 m, 1.32 m and 1.92 m by default). "subtracted": max(d - r_o, 0),
    # with the law's distances as they are. "literal": the paper's Eq. 11,
    # d - r_o outside of the workspace and d inside, which jumps from 0 to r_o
    # at its border; for comparison only.
    distance_rule: str = "raw"

    # Radius r_o of the robot's workspace about the base's axis, m (paper).
    workspace_radius: float = 0.82

    # A return this far before the taught background, m, is from something new;
    # one this far behind it, or none at all, means that the background is gone
    # (*assumed*: five standard deviations of the lidar's noise).
    background_margin: float = 0.05

    # From scan to scan the same person is looked for this far to the side, m
    # (*assumed*: either leg of a stride). A speed is the difference quotient of
    # two such distances.
    track_width: float = 0.4

    # Scans farther apart than this give no speed, s. null: two and a half
    # periods of the lidar, so that one may be lost; at least 0.1 s (*assumed*).
    max_gap: float | None = None

    # Speed of a person whose motion is not known yet, m/s (ISO/TS 15066).
    V_hmax: float = 1.6

    # With more faulted rays than this at a time the robot stops (*assumed*).
    max_faulted_share: float = 0.05

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            self.distance_rule in DISTANCE_RULES,
            f"{where}.distance_rule: {self.distance_rule!r} is unknown, use "
            f"one of {', '.join(DISTANCE_RULES)}",
        )
        for name, low, high in (
            ("workspace_radius", 0.0, 10.0),
            ("background_margin", 0.001, 1.0),
            ("track_width", 0.01, 10.0),
            ("V_hmax", 0.0, 10.0),
            ("max_faulted_share", 0.0, 1.0),
        ):
            check_range(where, name, getattr(self, name), low, high)
        if self.max_gap is not None:
            check_range(where, "max_gap", self.max_gap, 0.0, 10.0)

    def calc_max_gap(self, period: float = 0.0) -> float:
        """Returns from which time between scans on they give no speed, s.

        Args:
            period: Of the lidar, s; 0: the least.
        """
        if self.max_gap is not None:
            return self.max_gap
        return max(_LEAST_MAX_GAP, _GAP_PERIODS * period)

    @property
    def threshold_offset(self) -> float:
        """Amount added to the law's distances, m."""
        return self.workspace_radius if self.distance_rule == "raw" else 0.0


def calc_lidar_distance(config: LidarSeparationConfig, d):
    """Returns the distance ||D|| that the law uses, m.

    Args:
        config: rule and workspace radius.
        d: from the base's axis, m, a number or an array; inf stays inf.
    """
    r_o = config.workspace_radius
    if config.distance_rule == "raw":
        return d
    if config.distance_rule == "subtracted":
        return np.maximum(d - r_o, 0.0)
    return np.where(d > r_o, d - r_o, d)


def classify_rays(
    *, ranges: np.ndarray, background: np.ndarray, margin: float
) -> np.ndarray:
    """Classifies each ray's range against the taught background.

    VALID before the background or where there is none; MASKED at the
    background; CLEAR without return where none was taught. FAULTED where the
    background is gone (moved, or hidden by something that reflects nothing) and
    for impossible ranges.

    Args:
        ranges: m, (n,); inf: no return.
        background: of the same rays in the empty cell, m, (n,); inf: none.
        margin: m.

    Returns:
        `Reading`, (n,), uint8.
    """
    reading = np.full(len(ranges), _FAULTED, dtype=np.uint8)
    _write_readings(ranges, background, margin, reading)
    return reading


@njit(cache=True)
def _write_readings(ranges, background, margin, reading):
    for i in range(len(ranges)):
        d = ranges[i]
        if not d >= 0.0:
            continue
        is_taught = np.isfinite(background[i])
        if is_taught and abs(d - background[i]) <= margin:
            reading[i] = _MASKED
        elif not is_taught and d == np.inf:
            reading[i] = _CLEAR
        elif d < np.inf and not (is_taught and d - background[i] >= -margin):
            reading[i] = _VALID


@njit(cache=True)
def find_nearest(ranges, reading):
    """Returns the index of the nearest VALID range, the first one; -1: none.

    Args:
        ranges: m, (n,).
        reading: `Reading` of each, (n,).
    """
    nearest = -1
    for i in range(len(ranges)):
        if reading[i] == _VALID and (
            nearest < 0 or ranges[i] < ranges[nearest]
        ):
            nearest = i
    return nearest


@njit(cache=True)
def find_nearest_around(angles, ranges, reading, angle, distance, width):
    """Returns the nearest VALID range at or beside a place, m; inf: none.

    Args:
        angles: of the rays, rad, (n,).
        ranges: m, (n,).
        reading: `Reading` of each, (n,).
        angle: of the place, rad.
        distance: of the place, m.
        width: how far beside it, m.
    """
    half = width / distance if distance > width else math.pi
    nearest = math.inf
    for i in range(len(ranges)):
        if reading[i] == _VALID and ranges[i] < nearest:
            turn = (angles[i] - angle + math.pi) % (2 * math.pi) - math.pi
            if abs(turn) <= half:
                nearest = ranges[i]
    return nearest


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Classified:
    """A scan with its readings, to compare the next one with."""

    scan: LidarScan = dc.field(default_factory=LidarScan)
    reading: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.uint8)
    )

    def __deepcopy__(self, memo):
        return self


def calc_lidar_health(count: np.ndarray, max_faulted: int) -> RingHealth:
    """Judges whether a lidar's scan can be trusted.

    FAULTED if more rays are faulted than allowed, or there are none; BLIND if
    every working ray is masked.

    Args:
        count: Numbers of clear, valid, masked and faulted rays, (4,).
        max_faulted: Number that may be faulted at a time.
    """
    working = count[_CLEAR] + count[_VALID] + count[_MASKED]
    if count[_FAULTED] > max_faulted or working == 0:
        return RingHealth.FAULTED
    return RingHealth.BLIND if count[_MASKED] == working else RingHealth.HEALTHY


def calc_lidar_separation(
    *,
    config: LidarSeparationConfig,
    scan: LidarScan,
    reading: np.ndarray,
    previous: LidarScan | None = None,
    previous_reading: np.ndarray | None = None,
    v_WT: np.ndarray,
    k_max: float = 3.3,
    yaw: float = 0.0,
    name: str = "lidar",
) -> Separation:
    """Calculates the separation of the robot from a lidar's scan.

    The nearest VALID ray decides. P^ is its direction: the lidar's z axis is
    that of the world. The robot's speed is the tool's (which reaches as far as
    r_o): k_l = V_tool . P^. The lidar stands still, so the person's own
    speed towards it is the change of the raw distance from scan to scan, and
    k_o = k_l - (d(t) - d(t - dt)) / dt. If the previous scan shows nothing
    within `track_width`, k_o = k_l + V_hmax. Without any VALID ray the
    distance is inf, k_l = ||V_tool|| and k_o = ||V_tool|| + V_hmax.

    Args:
        config: settings.
        scan: at least one.
        reading: of its rays, see classify_rays(), (n,).
        previous: the previous scan; None: there was none.
        previous_reading: its readings.
        v_WT: velocity of the tool, m/s, (3,).
        k_max: k_l and k_o are saturated to +-k_max, m/s.
        yaw: of the lidar's x axis about the world's z axis, rad.
        name: of the lidar's link.
    """
    speed = float(np.linalg.norm(v_WT))
    count = count_readings(reading)
    health = calc_lidar_health(
        count, int(config.max_faulted_share * len(reading))
    )
    ray = find_nearest(scan.ranges, reading)
    if ray < 0:
        distance = math.inf
        direction = math.nan, math.nan, math.nan
        k_l, v_h = speed, config.V_hmax
    else:
        angle, d = float(scan.angles[ray]), float(scan.ranges[ray])
        distance = float(calc_lidar_distance(config, d))
        direction = math.cos(angle + yaw), math.sin(angle + yaw), 0.0
        k_l = float(v_WT @ np.array(direction))
        v_h = config.V_hmax
        if (
            previous is not None
            and 0.0 < (dt := scan.time - previous.time) <= config.calc_max_gap()
        ):
            before = find_nearest_around(
                previous.angles,
                previous.ranges,
                previous_reading,
                angle,
                d,
                config.track_width,
            )
            if math.isfinite(before):
                v_h = (before - d) / dt
    reals, whole = make_columns(1)
    reals[:, 0] = (
        scan.time,
        distance,
        speed,
        saturate(k_l, k_max),
        saturate(k_l + v_h, k_max),
        *direction,
    )
    whole[:, 0] = scan.sequence, ray, health, *count
    return lay_out_separation((name,), reals, whole)


class ToolKinematics(Protocol):
    """What LidarSeparation needs to know about the robot."""

    @property
    def num_joints(self) -> int:
        """Number of the robot's joints."""

    def calc_sites(
        self, q: np.ndarray, qd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns X_WS and v_WS (s, 3) of sites; the last one is the tool."""


class LidarSeparation(LeafSystem):
    """Calculates the separation of the robot from its planar lidar.

    .. pydrake_system::

        name: LidarSeparation
        input_ports:
        - scan
        - position_measured
        - velocity_measured
        output_ports:
        - separation

    See calc_lidar_separation(). A new scan is looked for at every control
    tick. The tool's velocity is the one that the robot reports at that tick,
    which is newer than the scan.

    The cell itself is taught once, as with a real scanner: the `background` is
    a scan of the empty cell. That is valid as long as only people move in the
    lidar's plane, so the plane must be below the reach of the robot. Behind the
    background (a table's leg) the lidar sees nobody.
    """

    def __init__(
        self,
        *,
        config: LidarSeparationConfig,
        k_max: float = 3.3,
        kinematics: ToolKinematics,
        background: np.ndarray,
        period: float = 0.008,
        yaw: float = 0.0,
        name: str = "lidar",
    ):
        """Constructs the system.

        Args:
            config: settings.
            k_max: k_l and k_o are saturated to +-k_max, m/s.
            kinematics: of the robot.
            background: of the empty cell, m, (n,); inf: nothing in range.
            period: control tick, s.
            yaw: of the lidar's x axis about the world's z axis, rad.
            name: of the only link: the whole robot.

        Raises:
            UserError: if a setting is out of range.
        """
        super().__init__()
        config.check("lidar_separation")
        require_period(period)
        self._config = dc.replace(config)
        self._k_max = k_max
        self._yaw = yaw
        self._name = name
        self._kinematics = kinematics
        self._background = np.array(background, dtype=float)
        self._scan = self.DeclareAbstractInputPort("scan", Value(LidarScan()))
        self._position = self.DeclareVectorInputPort(
            "position_measured", kinematics.num_joints
        )
        self._velocity = self.DeclareVectorInputPort(
            "velocity_measured", kinematics.num_joints
        )
        self._before = self.DeclareAbstractState(Value(_Classified()))
        self._separation = self.DeclareAbstractState(
            Value(make_empty_separation((name,)))
        )
        self.DeclareStateOutputPort("separation", self._separation)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: State):
        scan = self._scan.Eval(context)
        before = context.get_abstract_state(self._before).get_value()
        if scan.sequence < 0 or scan.sequence == before.scan.sequence:
            return EventStatus.DidNothing()
        if scan.ranges.shape != self._background.shape:
            raise ValueError(
                f"scan has {len(scan.ranges)} rays, the background "
                f"{len(self._background)}"
            )
        reading = classify_rays(
            ranges=scan.ranges,
            background=self._background,
            margin=self._config.background_margin,
        )
        _, v_WS = self._kinematics.calc_sites(
            self._position.Eval(context), self._velocity.Eval(context)
        )
        is_first = before.scan.sequence < 0
        separation = calc_lidar_separation(
            config=self._config,
            scan=scan,
            reading=reading,
            previous=None if is_first else before.scan,
            previous_reading=None if is_first else before.reading,
            v_WT=v_WS[-1],
            k_max=self._k_max,
            yaw=self._yaw,
            name=self._name,
        )
        state.get_mutable_abstract_state(self._separation).set_value(separation)
        state.get_mutable_abstract_state(self._before).set_value(
            _Classified(scan=scan, reading=reading)
        )
        return EventStatus.Succeeded()
