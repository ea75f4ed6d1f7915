"""A ring of Time-of-Flight sensors around a robot link, simulated."""

from collections.abc import Collection, Sequence
import dataclasses as dc
import math

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.common.value import Value
from pydrake.geometry import FrameId, GeometryId, QueryObject
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from tofssm_drake.errors import require
from tofssm_drake.geometry.fan import make_cone_fan
from tofssm_drake.geometry.ray_caster import RayBundles, RayCaster
from tofssm_drake.messages import RingScan
from tofssm_drake.sensing.vl53l1x import (
    NOISE_DRAWS,
    SensorErrors,
    TofSensorConfig,
    calc_cast_range,
    check_range,
    make_perfect_sensor_errors,
    measure_packed,
    pack_config,
)

# A sample at the time of a plant step shows the world before the step: it is
# taken a little earlier, or rounding would decide which of the two it shows.
_EARLY = 1e-9


@dc.dataclass(kw_only=True)
class TofRingConfig:
    """What all rings of a robot have in common."""

    # How well each sensor measures.
    sensor: TofSensorConfig = dc.field(default_factory=TofSensorConfig)

    # Full opening angle of a sensor's cone, deg (paper).
    fov_deg: float = 25.0

    # Rays that stand for the cone; 25 are 1 + 8 + 16, the last ring on the
    # cone's edge.
    rays_per_sensor: int = 25

    # The device needs this long between two integrations, s; the period of a
    # ring is the timing budget plus this.
    period_overhead: float = 0.004

    # From the end of the integration to the delivered scan, s (*assumed*):
    # reading 8 sensors out over a 400 kHz bus takes 0.8 ms each, of which
    # the mean sample waits half, the frame about 1 ms more.
    readout_time: float = 0.005

    @property
    def period(self) -> float:
        """From one scan to the next, s."""
        return self.sensor.timing_budget + self.period_overhead

    @property
    def latency(self) -> float:
        """From the centre of the integration to the delivered scan, s."""
        return 0.5 * self.sensor.timing_budget + self.readout_time

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        self.sensor.check(f"{where}.sensor")
        check_range(where, "fov_deg", self.fov_deg, 1.0, 90.0)
        check_range(where, "rays_per_sensor", self.rays_per_sensor, 1, 10000)
        check_range(where, "period_overhead", self.period_overhead, 0.0, 10.0)
        check_range(where, "readout_time", self.readout_time, 0.0, 1.0)


def make_ring_bundles(
    *,
    config: TofRingConfig,
    caster: RayCaster,
    frame_id: FrameId,
    X_FS: Sequence[RigidTransform],
    excluded: Collection[GeometryId] = (),
) -> RayBundles:
    """Makes the rays of one ring.

    Args:
        config: field of view, number of rays, range.
        caster: what the rays are cast against.
        frame_id: the frame F of the link that carries the ring.
        X_FS: the sensors' poses in F; x is the axis of the beam.
        excluded: what no sensor of the ring sees: the link that carries it.
    """
    return caster.make_bundles(
        frame_id=frame_id,
        X_FS=X_FS,
        fan_S=make_cone_fan(
            math.radians(config.fov_deg), config.rays_per_sensor
        ),
        max_range=calc_cast_range(config.sensor),
        excluded=[excluded] * len(X_FS),
    )


@dc.dataclass(frozen=True, eq=False)
class _RingState:
    """All that the system remembers, in one piece: cheap to copy."""

    scan: RingScan = dc.field(default_factory=RingScan)
    """The last one delivered."""
    queue: tuple[RingScan, ...] = ()
    """Those under way, oldest first."""

    def __deepcopy__(self, memo):
        return self


class TofRing(LeafSystem):
    """Simulates a ring of n VL53L1X sensors.

    .. pydrake_system::

        name: TofRing
        input_ports:
        - geometry_query
        - frame_poses
        - noise
        output_ports:
        - scan

    Once a period the sensors' rays are cast against the scene and turned into
    a `RingScan`. This happens at the centre of the sensors' integration,
    which is the scan's `sensor_time`. The scan appears on the port a latency
    later (half the timing budget and the readout). The latency may exceed the
    period: scans under way wait in a queue.

    Where things are comes from one of two ports. `geometry_query` serves any
    Diagram with a SceneGraph; `frame_poses`, X_WF of `caster.frame_ids`,
    (f, 3, 4), is used instead where it is connected, and is much faster for
    who has all poses at hand (see ScenePoses).

    The port `scan` holds an empty scan (sequence -1) before the first one.

    The port `noise` takes standard normal numbers, NOISE_DRAWS per sensor,
    which have to change at least once a period. It may be left unconnected
    if the sensors are ideal. Constant errors are an argument.

    All sensors of a ring integrate at the same time here. The device's jitter
    of the period (1 %) is not simulated.
    """

    def __init__(
        self,
        *,
        config: TofRingConfig,
        caster: RayCaster,
        bundles: RayBundles,
        errors: SensorErrors | None = None,
        phase: float = 0.0,
    ):
        """Constructs the system.

        Args:
            config: settings of the rings.
            caster: of the SceneGraph that is connected to `geometry_query`.
            bundles: the sensors' rays, see `make_ring_bundles`.
            errors: the sensors' constant errors; None: there are none.
            phase: time of the first sample, s, 0 for one period; tells the
                rings' turns apart.

        Raises:
            UserError: if a setting is out of range.
            ValueError: if the errors are not those of n sensors.
        """
        super().__init__()
        config.check("rings")
        require(
            math.isfinite(phase) and phase >= 0.0,
            f"rings.phase: {phase} is out of range; use 0 or more",
        )
        n = bundles.num_bundles
        if errors is None:
            errors = make_perfect_sensor_errors(n)
        if errors.bias.shape != (n,) or errors.gain.shape != (n,):
            raise ValueError(f"errors: not those of {n} sensors")
        self._caster = caster
        self._bundles = bundles
        self._errors = errors
        self._parameters = pack_config(config.sensor)
        self._latency = config.latency
        self._no_noise = (
            np.zeros((n, NOISE_DRAWS)) if config.sensor.ideal else None
        )

        self._geometry_query = self.DeclareAbstractInputPort(
            "geometry_query", Value(QueryObject())
        )
        self._frame_poses = self.DeclareAbstractInputPort(
            "frame_poses", Value(np.zeros((len(caster.frame_ids), 3, 4)))
        )
        self._noise = self.DeclareVectorInputPort(
            "noise", n * NOISE_DRAWS, RandomDistribution.kGaussian
        )
        self._state = self.DeclareAbstractState(Value(_RingState()))
        self.DeclareAbstractOutputPort(
            "scan",
            Value(RingScan()).Clone,
            self._calc_scan,
            prerequisites_of_calc={self.abstract_state_ticket(self._state)},
        )
        first = phase if phase > 0.0 else config.period
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period, first - _EARLY, self._capture
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period, first + config.latency, self._deliver
        )

    @property
    def num_sensors(self) -> int:
        """Sensors of the ring, n."""
        return self._bundles.num_bundles

    def _calc_scan(self, context: Context, output):
        state = context.get_abstract_state(self._state).get_value()
        output.set_value(state.scan)

    def _capture(self, context: Context, state: State):
        """Takes a sample and queues it."""
        # `state` and not `context`: a delivery at the same time has its say.
        value = state.get_mutable_abstract_state(self._state)
        before = value.get_value()
        last = before.queue[-1] if before.queue else before.scan
        scan = self._measure(context, last.sequence + 1)
        # Faults to inject (a silent ring, a frozen or stuck value, two
        # sensors at one address, a dirty cover) would change `scan` here.
        value.set_value(_RingState(before.scan, (*before.queue, scan)))

    def _deliver(self, context: Context, state: State):
        """Moves the oldest scan under way to the port, if it is due."""
        value = state.get_mutable_abstract_state(self._state)
        queue = value.get_value().queue
        # The tolerance covers the rounding of the events' times.
        if not queue or queue[0].time > context.get_time() + 1e-6:
            return EventStatus.DidNothing()
        value.set_value(_RingState(queue[0], queue[1:]))
        return EventStatus.Succeeded()

    def _measure(self, context: Context, sequence: int) -> RingScan:
        if self._frame_poses.HasValue(context):
            X_WF = self._frame_poses.Eval(context)
        else:
            X_WF = self._caster.poses_from_query_object(
                self._geometry_query.Eval(context)
            )
        ray_distance, _ = self._caster.cast_bundles(self._bundles, X_WF)
        noise = self._no_noise
        if noise is None:
            noise = self._noise.Eval(context).reshape(-1, NOISE_DRAWS)
        distance, status = measure_packed(
            self._parameters,
            ray_distance,
            noise,
            self._errors.bias,
            self._errors.gain,
        )
        time = context.get_time()
        return RingScan(
            sequence=sequence,
            time=time + self._latency,
            sensor_time=np.full(len(distance), time),
            distance=distance,
            status=status,
        )
