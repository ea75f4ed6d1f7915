"""A lidar that scans one plane, simulated."""

from collections.abc import Collection
import dataclasses as dc
import math

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.common.value import Value
from pydrake.geometry import FrameId, GeometryId, QueryObject
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from tofssm_drake.errors import check_range, require
from tofssm_drake.messages import LidarScan
from tofssm_drake.raycast.ray_caster import RayBundles, RayCaster

# A scan at the time of a plant step shows the world before the step. It is
# taken slightly earlier, or rounding would decide which of the two it shows.
_EARLY = 1e-9


@dc.dataclass(kw_only=True)
class Lidar2dConfig:
    """Where a planar lidar looks and how well it measures."""

    # Height of the scanned plane above the origin of the frame that carries
    # the lidar, m (*assumed*: the shins of a person).
    height: float = 0.3

    # First and last direction in the plane, deg; 0 is the x axis of the
    # scanner's frame, positive is counter-clockwise seen from above. In a full
    # turn the last direction is left out, as it is the first.
    angle_min_deg: float = -180.0
    angle_max_deg: float = 180.0

    # From one direction to the next, deg (*assumed*).
    angle_step_deg: float = 0.5

    # Nothing is seen beyond this distance, m (*assumed*).
    max_range: float = 10.0

    # From one scan to the next, s: 1 / rate (*assumed*; five ticks of 8 ms).
    period: float = 0.040

    # From a scan's time, the middle of the turn, to its delivery, s
    # (*assumed*: half a turn); less than the period.
    latency: float = 0.020

    # Standard deviation of a range, m (*assumed*). 0: no noise.
    noise_sigma: float = 0.010

    # Step of the reported ranges, m; 0: none.
    resolution: float = 0.001

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        for name, low, high in (
            ("height", -10.0, 10.0),
            ("angle_min_deg", -180.0, 180.0),
            ("angle_max_deg", -180.0, 180.0),
            ("angle_step_deg", 0.01, 360.0),
            ("max_range", 0.01, 1000.0),
            ("period", 0.001, 10.0),
            ("latency", 0.0, 10.0),
            ("noise_sigma", 0.0, 1.0),
            ("resolution", 0.0, 1.0),
        ):
            check_range(where, name, getattr(self, name), low, high)
        require(
            self.angle_min_deg <= self.angle_max_deg,
            f"{where}.angle_min_deg: {self.angle_min_deg} is greater than"
            f" angle_max_deg {self.angle_max_deg}; use the smaller one first",
        )
        # With equal times it would be undefined which scan is delivered.
        require(
            self.latency <= self.period - 1e-6,
            f"{where}.latency: {self.latency} is out of range; use 0 to less"
            f" than the period {self.period}",
        )


def calc_lidar_angles(config: Lidar2dConfig) -> np.ndarray:
    """Returns the directions of a scan about z from x, rad, shape (n,)."""
    span = config.angle_max_deg - config.angle_min_deg
    # The tolerance covers the rounding of a span of whole steps.
    steps = math.floor(span / config.angle_step_deg + 1e-9)
    count = steps + 1
    if steps * config.angle_step_deg > 360.0 - 1e-6:
        count = steps
    angles = config.angle_min_deg + config.angle_step_deg * np.arange(count)
    return np.radians(angles)


def make_lidar_bundle(
    *,
    config: Lidar2dConfig,
    caster: RayCaster,
    frame_id: FrameId | None = None,
    X_FS: RigidTransform | None = None,
    excluded: Collection[GeometryId] = (),
) -> RayBundles:
    """Makes the rays of a lidar: one bundle in the xy plane of S.

    Args:
        config: directions, range and height.
        caster: what the rays are cast against.
        frame_id: the frame F that carries the lidar; None: the world.
        X_FS: pose of the scanner's frame S in F; None: `config.height` above
            the origin of F, axes as those of F.
        excluded: geometries that it does not see, such as its housing.

    Raises:
        UserError: if a setting is out of range.
    """
    config.check("lidar")
    if X_FS is None:
        X_FS = RigidTransform([0.0, 0.0, config.height])
    return caster.make_bundles(
        frame_id=caster.world_frame_id if frame_id is None else frame_id,
        X_FS=[X_FS],
        fan_S=_calc_directions(calc_lidar_angles(config)),
        max_range=config.max_range,
        excluded=[excluded],
    )


def measure_ranges(
    config: Lidar2dConfig, *, distance: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Turns exact distances into what a lidar reports.

    Args:
        config: noise and resolution.
        distance: of the n rays, m, shape (n,); inf: nothing within range.
        noise: standard normal numbers, shape (n,).

    Returns:
        Ranges, m, shape (n,), at least 0; inf stays inf.
    """
    ranges = np.maximum(distance + config.noise_sigma * noise, 0.0)
    if config.resolution > 0.0:
        ranges = config.resolution * np.round(ranges / config.resolution)
    return ranges


def _calc_directions(angles: np.ndarray) -> np.ndarray:
    return np.column_stack(
        [np.cos(angles), np.sin(angles), np.zeros(len(angles))]
    )


class Lidar2d(LeafSystem):
    """Simulates a lidar that scans one plane.

    .. pydrake_system::

        name: Lidar2d
        input_ports:
        - geometry_query
        - noise
        output_ports:
        - scan

    Once a period all n rays are cast against the scene at one moment, which
    stands for the middle of the scanner's turn and is the scan's `time`. The
    `LidarScan` appears on the port a latency later; before the first one the
    port holds an empty scan (sequence -1).

    The port `noise` takes n standard normal numbers, which must change at least
    once a period. It may be left unconnected if `noise_sigma` is 0.
    """

    def __init__(
        self,
        *,
        config: Lidar2dConfig,
        caster: RayCaster,
        bundle: RayBundles,
    ):
        """Constructs the system.

        Args:
            config: settings of the lidar.
            caster: of the SceneGraph that is connected to `geometry_query`.
            bundle: the rays, see `make_lidar_bundle`.

        Raises:
            UserError: if a setting is out of range.
            ValueError: if the rays are not those of such a lidar.
        """
        super().__init__()
        config.check("lidar")
        angles = calc_lidar_angles(config)
        directions = _calc_directions(angles)
        if bundle.num_bundles != 1 or not (
            bundle.fan_S.shape == directions.shape
            and np.allclose(bundle.fan_S, directions)
        ):
            raise ValueError(
                f"bundle: {bundle.num_bundles} of {len(bundle.fan_S)} rays is"
                f" not the one of this lidar's {len(angles)} rays"
            )
        if bundle.max_range[0] != config.max_range:
            raise ValueError(
                f"bundle: reaches {bundle.max_range[0]:g} m, the lidar "
                f"{config.max_range:g} m"
            )
        self._config = dc.replace(config)
        self._caster = caster
        self._bundle = bundle
        self._angles = angles
        self._no_noise = (
            np.zeros(len(angles)) if config.noise_sigma == 0.0 else None
        )

        self._geometry_query = self.DeclareAbstractInputPort(
            "geometry_query", Value(QueryObject())
        )
        self._noise = self.DeclareVectorInputPort(
            "noise", len(angles), RandomDistribution.kGaussian
        )
        self._pending = self.DeclareAbstractState(Value(LidarScan()))
        self._scan = self.DeclareAbstractState(Value(LidarScan()))
        self.DeclareStateOutputPort("scan", self._scan)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period, config.period - _EARLY, self._capture
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period, config.period + config.latency, self._deliver
        )

    @property
    def angles(self) -> np.ndarray:
        """Directions of the rays about z from x, rad, shape (n,)."""
        return self._angles

    def _capture(self, context: Context, state: State):
        """Takes a scan, to be delivered later."""
        pending = state.get_mutable_abstract_state(self._pending)
        sequence = pending.get_value().sequence + 1
        pending.set_value(self._measure(context, sequence))

    def _deliver(self, context: Context, state: State):
        """Moves the pending scan to the port."""
        pending = state.get_mutable_abstract_state(self._pending).get_value()
        state.get_mutable_abstract_state(self._scan).set_value(pending)
        return EventStatus.Succeeded()

    def _measure(self, context: Context, sequence: int) -> LidarScan:
        X_WF = self._caster.poses_from_query_object(
            self._geometry_query.Eval(context)
        )
        distance, _ = self._caster.cast_bundles(self._bundle, X_WF)
        noise = self._no_noise
        if noise is None:
            noise = self._noise.Eval(context)
        return LidarScan(
            sequence=sequence,
            time=context.get_time(),
            angles=self._angles,
            ranges=measure_ranges(
                self._config, distance=distance[0], noise=noise
            ),
        )
