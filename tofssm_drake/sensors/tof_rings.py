"""Rings of range sensors around robot links, simulated."""

from collections.abc import Sequence
import dataclasses as dc
import math

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.common.value import Value
from pydrake.geometry import QueryObject
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from tofssm_drake.errors import require
from tofssm_drake.messages import RingScan
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayBundles, RayCaster
from tofssm_drake.sensors.range_sensor import RangeSensor, measure_checked
from tofssm_drake.sensors.ring_mount import RingMount

# A sample at the time of a plant step shows the world before the step. It is
# taken slightly earlier, or rounding would decide which of the two it shows.
_EARLY = 1e-9


def make_ring_bundles(
    *,
    config: RangeSensor,
    caster: RayCaster,
    mounts: Sequence[RingMount],
) -> RayBundles:
    """Makes the rays of rings, cast together.

    Args:
        config: the sensors' model: field of view, number of rays, range.
        caster: what the rays are cast against.
        mounts: the rings; no sensor sees the link that carries it.

    Returns:
        One bundle per sensor, ring by ring.
    """
    traits = config.traits
    return caster.make_bundles(
        frame_id=[mount.frame_id for mount in mounts for _ in mount.X_FS],
        X_FS=[X for mount in mounts for X in mount.X_FS],
        fan_S=make_cone_fan(
            math.radians(traits.fov_deg), traits.rays_per_sensor
        ),
        max_range=float(traits.cast_range),
        excluded=[mount.geometry_ids for mount in mounts for _ in mount.X_FS],
    )


def _count_sensors(num_sensors, constants, num_rings):
    """Returns the number of sensors of each ring.

    Raises:
        ValueError: if constants or number of sensors do not suit the rings.
    """
    n, rest = divmod(num_sensors, num_rings)
    if n == 0 or rest:
        raise ValueError(f"bundles: {num_sensors} for {num_rings} rings")
    if len(constants) != num_sensors:
        raise ValueError(f"constants: not those of {num_sensors} sensors")
    return n


@dc.dataclass(frozen=True, eq=False)
class _Queue:
    """Pending scans, oldest first, and their total number: cheap to copy."""

    scans: tuple[tuple[RingScan, ...], ...] = ()
    next_sequence: int = 0

    def __deepcopy__(self, memo):
        return self


class TofRings(LeafSystem):
    """Simulates rings of sensors of one model that sample together.

    .. pydrake_system::

        name: TofRings
        input_ports:
        - geometry_query
        - noise
        output_ports:
        - scan_<ring>

    Once a period the rays of all N sensors are cast against the scene and
    turned into one `RingScan` per ring. This happens at the centre of the
    sensors' integration, which is the scans' `sensor_time`. The scans appear
    on the ports a latency later (half the integration and the readout). The
    latency may exceed the period: pending scans wait in a queue. Rings that
    sample at different times need separate systems; a single ring is fine.

    A port holds an empty scan (sequence -1) before the first one.

    The port `noise` takes standard normal numbers, as many as the model wants
    for each sensor and each of `noise_scans` scans in turn. All of them must
    change once in that many periods, the first time at 0 s. It may be left
    unconnected if the model wants none. What tells one sensor from the other is
    an argument.

    The jitter of a device's period is not simulated.
    """

    def __init__(
        self,
        *,
        config: RangeSensor,
        caster: RayCaster,
        bundles: RayBundles,
        constants: np.ndarray | None = None,
        phase: float = 0.0,
        noise_scans: int = 1,
        name: tuple[str, ...],
    ):
        """Constructs the system.

        Args:
            config: the sensors' model.
            caster: of the SceneGraph that is connected to `geometry_query`.
            bundles: the sensors' rays, see `make_ring_bundles`; the same
                number of sensors for each ring.
            constants: the model's constant draws of each sensor, see
                `draw_constants`, (N, constant_draws); None: all 0.
            phase: time of the first sample, s, 0 for one period; staggers
                the rings.
            noise_scans: number of scans for which the port `noise` has
                numbers. A source that changes rarely costs the Diagram
                less: its event makes Drake copy all State.
            name: the rings, in the order of `bundles`.

        Raises:
            UserError: if a setting is out of range.
            ValueError: if constants or rays do not suit the rings.
        """
        super().__init__()
        traits = config.traits
        traits.check("sensor")
        require(
            math.isfinite(phase) and phase >= 0.0,
            f"rings.phase: {phase} is out of range; use 0 or more",
        )
        num_sensors = bundles.num_bundles
        if constants is None:
            constants = np.zeros((num_sensors, traits.constant_draws))
        n = _count_sensors(num_sensors, constants, len(name))
        if noise_scans < 1:
            raise ValueError(f"noise_scans: {noise_scans} is not 1 or more")
        self._caster = caster
        self._bundles = bundles
        self._sensor = config
        self._constants = constants
        self._latency = traits.latency
        self._noise_shape = (noise_scans, num_sensors, traits.noise_draws)
        self._rows = [slice(n * i, n * i + n) for i in range(len(name))]

        self._geometry_query = self.DeclareAbstractInputPort(
            "geometry_query", Value(QueryObject())
        )
        self._noise = self.DeclareVectorInputPort(
            "noise",
            math.prod(self._noise_shape),
            RandomDistribution.kGaussian,
        )
        self._scans = [
            self.DeclareAbstractState(Value(RingScan())) for _ in name
        ]
        self._queue = self.DeclareAbstractState(Value(_Queue()))
        for ring, index in zip(name, self._scans, strict=True):
            self.DeclareStateOutputPort(f"scan_{ring}", index)
        first = phase if phase > 0.0 else traits.period
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            traits.period, first - _EARLY, self._capture
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            traits.period, first + traits.latency, self._deliver
        )

    @property
    def num_sensors(self) -> int:
        """Sensors of all rings, N."""
        return self._bundles.num_bundles

    def _capture(self, context: Context, state: State):
        """Takes a sample and queues it."""
        # From `state`, not `context`: it includes a delivery at the same time.
        value = state.get_mutable_abstract_state(self._queue)
        before = value.get_value()
        scans = self._measure(context, before.next_sequence)
        # Injected faults (a silent ring, a frozen or stuck value, two sensors
        # at one address, a dirty cover) would change `scans` here.
        value.set_value(
            _Queue((*before.scans, scans), before.next_sequence + 1)
        )

    def _deliver(self, context: Context, state: State):
        """Moves the oldest pending scans to the ports, if they are due."""
        value = state.get_mutable_abstract_state(self._queue)
        queue = value.get_value()
        # The tolerance covers the rounding of the events' times.
        if (
            not queue.scans
            or queue.scans[0][0].time > context.get_time() + 1e-6
        ):
            return EventStatus.DidNothing()
        for index, scan in zip(self._scans, queue.scans[0], strict=True):
            state.get_mutable_abstract_state(index).set_value(scan)
        value.set_value(_Queue(queue.scans[1:], queue.next_sequence))
        return EventStatus.Succeeded()

    def _measure(self, context: Context, sequence: int) -> tuple[RingScan, ...]:
        X_WF = self._caster.poses_from_query_object(
            self._geometry_query.Eval(context)
        )
        ray_distance, _ = self._caster.cast_bundles(self._bundles, X_WF)
        distance, status = measure_checked(
            self._sensor,
            ray_distance,
            self._get_noise(context, sequence),
            self._constants,
        )
        time = context.get_time()
        sensor_time = np.full(len(distance), time)
        # The messages are views of these.
        for array in (sensor_time, distance, status):
            array.setflags(write=False)
        return tuple(
            RingScan.of_read_only(
                sequence=sequence,
                time=time + self._latency,
                sensor_time=sensor_time[rows],
                distance=distance[rows],
                status=status[rows],
            )
            for rows in self._rows
        )

    def _get_noise(self, context: Context, sequence: int) -> np.ndarray:
        """Returns the numbers for a scan, (N, noise_draws)."""
        scans, sensors, draws = self._noise_shape
        if draws == 0:
            return np.empty((sensors, 0))
        noise = self._noise.Eval(context).reshape(self._noise_shape)
        return noise[sequence % scans]
