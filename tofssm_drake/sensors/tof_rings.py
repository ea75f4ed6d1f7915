"""Rings of Time-of-Flight sensors around robot links, simulated."""

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
from tofssm_drake.sensors.ring_mount import RingMount
from tofssm_drake.sensors.vl53l1x import (
    NOISE_DRAWS,
    SensorErrors,
    Vl53l1x,
    calc_cast_range,
    make_perfect_sensor_errors,
    measure_packed,
    pack_config,
)

# A sample at the time of a plant step shows the world before the step. It is
# taken slightly earlier, or rounding would decide which of the two it shows.
_EARLY = 1e-9


def make_ring_bundles(
    *,
    config: Vl53l1x,
    caster: RayCaster,
    mounts: Sequence[RingMount],
) -> RayBundles:
    """Makes the rays of rings, cast together.

    Args:
        config: field of view, number of rays, range.
        caster: what the rays are cast against.
        mounts: the rings; no sensor sees the link that carries it.

    Returns:
        One bundle per sensor, ring by ring.
    """
    return caster.make_bundles(
        frame_id=[mount.frame_id for mount in mounts for _ in mount.X_FS],
        X_FS=[X for mount in mounts for X in mount.X_FS],
        fan_S=make_cone_fan(
            math.radians(config.fov_deg), config.rays_per_sensor
        ),
        max_range=calc_cast_range(config),
        excluded=[mount.geometry_ids for mount in mounts for _ in mount.X_FS],
    )


def _count_sensors(num_sensors, errors, num_rings):
    """Returns the number of sensors of each ring.

    Raises:
        ValueError: if errors or number of sensors do not suit the rings.
    """
    n, rest = divmod(num_sensors, num_rings)
    if n == 0 or rest:
        raise ValueError(f"bundles: {num_sensors} for {num_rings} rings")
    if not errors.bias.shape == errors.gain.shape == (num_sensors,):
        raise ValueError(f"errors: not those of {num_sensors} sensors")
    return n


@dc.dataclass(frozen=True, eq=False)
class _Queue:
    """Pending scans, oldest first, and their total number: cheap to copy."""

    scans: tuple[tuple[RingScan, ...], ...] = ()
    next_sequence: int = 0

    def __deepcopy__(self, memo):
        return self


class TofRings(LeafSystem):
    """Simulates rings of VL53L1X sensors that sample together.

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
    on the ports a latency later (half the timing budget and the readout). The
    latency may exceed the period: pending scans wait in a queue. Rings that
    sample at different times need separate systems; a single ring is fine.

    A port holds an empty scan (sequence -1) before the first one.

    The port `noise` takes standard normal numbers, NOISE_DRAWS per sensor for
    each of `noise_scans` scans in turn. All of them must change once in that
    many periods, the first time at 0 s. It may be left unconnected if the
    sensors are ideal. Constant errors are an argument.

    The device's jitter of the period (1 %) is not simulated.
    """

    def __init__(
        self,
        *,
        config: Vl53l1x,
        caster: RayCaster,
        bundles: RayBundles,
        errors: SensorErrors | None = None,
        phase: float = 0.0,
        noise_scans: int = 1,
        name: tuple[str, ...],
    ):
        """Constructs the system.

        Args:
            config: settings of the rings.
            caster: of the SceneGraph that is connected to `geometry_query`.
            bundles: the sensors' rays, see `make_ring_bundles`; the same
                number of sensors for each ring.
            errors: the sensors' constant errors; None: no errors.
            phase: time of the first sample, s, 0 for one period; staggers
                the rings.
            noise_scans: number of scans for which the port `noise` has
                numbers. A source that changes rarely costs the Diagram
                less: its event makes Drake copy all State.
            name: the rings, in the order of `bundles`.

        Raises:
            UserError: if a setting is out of range.
            ValueError: if errors or rays do not suit the rings.
        """
        super().__init__()
        config.check("sensor")
        require(
            math.isfinite(phase) and phase >= 0.0,
            f"rings.phase: {phase} is out of range; use 0 or more",
        )
        num_sensors = bundles.num_bundles
        if errors is None:
            errors = make_perfect_sensor_errors(num_sensors)
        n = _count_sensors(num_sensors, errors, len(name))
        if noise_scans < 1:
            raise ValueError(f"noise_scans: {noise_scans} is not 1 or more")
        self._caster = caster
        self._bundles = bundles
        self._errors = errors
        self._parameters = pack_config(config)
        self._latency = config.latency
        self._noise_scans = noise_scans
        self._rows = [slice(n * i, n * i + n) for i in range(len(name))]
        self._no_noise = (
            np.zeros((num_sensors, NOISE_DRAWS)) if config.ideal else None
        )

        self._geometry_query = self.DeclareAbstractInputPort(
            "geometry_query", Value(QueryObject())
        )
        self._noise = self.DeclareVectorInputPort(
            "noise",
            noise_scans * num_sensors * NOISE_DRAWS,
            RandomDistribution.kGaussian,
        )
        self._scans = [
            self.DeclareAbstractState(Value(RingScan())) for _ in name
        ]
        self._queue = self.DeclareAbstractState(Value(_Queue()))
        for ring, index in zip(name, self._scans, strict=True):
            self.DeclareStateOutputPort(f"scan_{ring}", index)
        first = phase if phase > 0.0 else config.period
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period, first - _EARLY, self._capture
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period, first + config.latency, self._deliver
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
        noise = self._no_noise
        if noise is None:
            noise = self._noise.Eval(context).reshape(
                self._noise_scans, -1, NOISE_DRAWS
            )[sequence % self._noise_scans]
        distance = np.empty(len(ray_distance))
        status = np.empty(len(ray_distance), dtype=np.uint8)
        measure_packed(
            self._parameters,
            ray_distance,
            noise,
            self._errors.bias,
            self._errors.gain,
            distance,
            status,
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
