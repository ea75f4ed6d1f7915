"""Verifies the rings by what they see of the robot itself.

`self_hits` has the statistics; this module applies them to twin and systems.
"""

from collections.abc import Callable, Sequence
import dataclasses as dc
import functools
import itertools
import math

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from tofssm_drake.errors import require_period
from tofssm_drake.messages import (
    MaskedScan,
    Reading,
    RingHealth,
    SelfHitHealth,
    SensorFault,
    Separation,
    make_empty_self_hit_health,
    make_empty_separation,
)
from tofssm_drake.perception.occlusion_mask import (
    OcclusionMaskConfig,
    Twin,
    calc_report_size,
)
from tofssm_drake.perception.self_hits import (
    MISPLACED,
    MISS,
    MODEL,
    Misfit,
    SelfHitConfig,
    calc_origins,
    classify_self_hits,
    list_misfits,
    list_swaps,
    make_no_expectation,
    make_orders,
    make_self_hit_fan,
    must_see,
    name_order,
    step_misfit,
    step_orders,
    step_rides,
    step_sensors,
    widen_expectation,
)
from tofssm_drake.raycast.ray_caster import RayBundles, RayCaster
from tofssm_drake.sensors.range_sensor import SensorTraits
from tofssm_drake.sensors.range_status import STATUS_NO_NEW_DATA
from tofssm_drake.sensors.ring_mount import RingMount

# Below this speed a robot moves less than a millimetre in the time margin,
# rad/s.
_STILL = 0.05

# Samples farther apart than this are not compared with a single pose of the
# robot, s (*assumed*: at 1.7 m/s the robot moves by a third of the mask's
# tolerance in that time).
_SPREAD = 0.006

# For this long after an object was taken or let go, it is uncertain what the
# robot carried at a sample's time, s (*assumed*: more than a sample's greatest
# age).
_UNCERTAIN = 0.1

# One in this many looks at a robot that has not moved counts.
_REST_LOOKS = 5


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SelfHitModel:
    """What is needed to compute what m rings of n sensors should see.

    Made by `make_self_hit_model`.
    """

    config: SelfHitConfig
    name: tuple[str, ...]
    """The rings; the last one is the tool's."""
    caster: RayCaster
    twin: Twin
    num_wide: int
    """See `make_self_hit_fan`."""
    believed: RayBundles
    """Rays of all rings' sensors as modelled."""
    misfits: tuple[Misfit, ...]
    """Those of single rings first."""
    moved: RayBundles | None
    """Rays of the moved ring, misfit by misfit; None: there are no misfits of
    single rings. They are cast together."""
    orders: np.ndarray
    """See `make_orders`."""
    swaps: np.ndarray
    """See `list_swaps`, (s, 2)."""
    limits: tuple[float, float, float]
    """Tolerance, least and greatest distance of `classify_self_hits`, m."""
    scores: tuple[float, float, float, float]
    """Scores of `calc_step`."""
    time_margin: float
    """Uncertainty of a sample's time, s."""
    is_dead: np.ndarray
    """Sensors that are declared dead and do not count, (N,)."""

    @property
    def num_sensors(self) -> int:
        """Number of sensors of a ring, n."""
        return self.believed.num_bundles // len(self.name)


def move_mount(mount: RingMount, turn: float, shift: float) -> list:
    """Returns X_FS of a ring turned about its z (rad), and moved along (m)."""
    X_FL = mount.X_FS[0] @ mount.X_LS[0].inverse()
    X_LL = RigidTransform(RotationMatrix.MakeZRotation(turn), [0, 0, shift])
    return [X_FL @ X_LL @ X_LS for X_LS in mount.X_LS]


def _make_bundles(caster, fan_S, max_range, rings):
    """Returns the rays of rings, each a mount and the poses of its sensors."""
    return caster.make_bundles(
        frame_id=[mount.frame_id for mount, X in rings for _ in X],
        X_FS=[X_FS for _, X in rings for X_FS in X],
        fan_S=fan_S,
        max_range=max_range,
        excluded=[mount.geometry_ids for mount, X in rings for _ in X],
    )


def make_self_hit_model(
    *,
    config: SelfHitConfig,
    mask_config: OcclusionMaskConfig,
    sensor: SensorTraits,
    caster: RayCaster,
    mounts: Sequence[RingMount],
    make_twin: Callable[[RayCaster], Twin],
    is_dead: np.ndarray | None = None,
    name: tuple[str, ...],
) -> SelfHitModel:
    """Makes the model of what rings should see.

    Args:
        config: settings.
        mask_config: rays, margins; the mask's own.
        sensor: field of view, ranges and tolerance of the sensors.
        caster: of the twin's SceneGraph.
        mounts: the rings on the twin.
        make_twin: returns what poses a caster's `frame_ids`. It is called at
            the end: a ring on a frame without geometry adds that frame.
        is_dead: sensors that are declared dead, ring by ring, (N,); None: none.
        name: of the rings, in the order of `mounts`.

    Raises:
        UserError: if a setting is out of range.
    """
    config.check("self_hits")
    num_sensors = sum(len(mount.X_FS) for mount in mounts)
    fan_S, num_wide = make_self_hit_fan(config, mask_config, sensor)
    max_range = sensor.cast_range + sensor.tolerance
    misfits = list_misfits(config, len(mounts))
    moved = [
        (mounts[m.ring], move_mount(mounts[m.ring], m.turn, m.shift))
        for m in misfits
        if m.ring >= 0
    ]
    make_bundles = functools.partial(_make_bundles, caster, fan_S, max_range)
    believed = make_bundles([(mount, mount.X_FS) for mount in mounts])
    moved_bundles = make_bundles(moved) if moved else None
    return SelfHitModel(
        config=config,
        name=tuple(name),
        caster=caster,
        twin=make_twin(caster),
        num_wide=num_wide,
        believed=believed,
        misfits=misfits,
        moved=moved_bundles,
        orders=make_orders(len(mounts[0].X_FS)),
        swaps=np.array(list_swaps(len(mounts)), dtype=np.int64).reshape(-1, 2),
        limits=(
            float(sensor.tolerance),
            float(sensor.min_range),
            float(min(config.max_distance, sensor.sure_range)),
        ),
        scores=(
            config.full_width,
            config.alone_score,
            config.miss_score,
            config.score_limit,
        ),
        time_margin=mask_config.time_margin,
        is_dead=np.zeros(num_sensors, dtype=bool)
        if is_dead is None
        else is_dead,
    )


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SelfHitState:
    """The remembered state: views of one vector, see `view_state`."""

    sensor_sum: np.ndarray
    """Of each sensor's test, (N,)."""
    sensor_alarm: np.ndarray
    """0 or 1, (N,)."""
    misfit_sum: np.ndarray
    """Of each test for a misfit, (b,): orders ring by ring, swaps, misfits."""
    misfit_alarm: np.ndarray
    """0 or 1, (b,)."""
    ride_start: np.ndarray
    """Distance at which each sensor's stretch began, m, (N,); inf: none.
    This and the next four belong to `step_rides`."""
    ride_travel: np.ndarray
    """How far the sensor has moved since, m, (N,)."""
    ride_last: np.ndarray
    """Position when that was last updated, in world, m, (N, 3)."""
    ride_alarm: np.ndarray
    """0 or 1, (N,)."""
    ride_unfit: np.ndarray
    """Number of looks in a row that did not fit the alarm, (N,)."""
    expectation: np.ndarray
    """What was expected of each sensor at its last look, (3, N)."""
    position: np.ndarray
    """Joints when each sensor last counted for misfits, rad, (N, j)."""
    time: np.ndarray
    """Of each sensor's last sample that counted, s, (N,); -inf: none."""
    sequence: np.ndarray
    """Of the last scan of each ring, (m,); -1: none."""
    carried: np.ndarray
    """Place of each object, or ON_TOOL, and when one changed, s, (p + 1,)."""
    rest: np.ndarray
    """Number of looks at a robot that had not moved, (1,)."""


@functools.lru_cache(maxsize=8)
def _lay_out(rings, sensors, tests, joints, objects):
    """Returns the place of each field in the vector, and its shape."""
    shapes = {
        "sensor_alarm": (sensors,),
        "misfit_alarm": (tests,),
        "ride_alarm": (sensors,),
        "sensor_sum": (sensors,),
        "misfit_sum": (tests,),
        "ride_start": (sensors,),
        "ride_travel": (sensors,),
        "ride_last": (sensors, 3),
        "ride_unfit": (sensors,),
        "expectation": (3, sensors),
        "position": (sensors, joints),
        "time": (sensors,),
        "sequence": (rings,),
        "carried": (objects + 1,),
        "rest": (1,),
    }
    sizes = [math.prod(shape) for shape in shapes.values()]
    ends = list(itertools.accumulate(sizes))
    return [
        (name, slice(end - size, end), shape)
        for (name, shape), size, end in zip(
            shapes.items(), sizes, ends, strict=True
        )
    ]


def _lay_out_model(model):
    m = len(model.name)
    tests = m * len(model.orders) + len(model.swaps) + len(model.misfits)
    return _lay_out(
        m,
        model.believed.num_bundles,
        tests,
        model.twin.num_joints,
        model.twin.num_objects,
    )


def make_state_vector(model: SelfHitModel) -> np.ndarray:
    """Returns the vector of the initial state."""
    vector = np.zeros(_lay_out_model(model)[-1][1].stop)
    state = view_state(model, vector)
    state.expectation[:] = make_no_expectation(len(state.sensor_sum))
    state.ride_start[:] = np.inf
    state.position[:] = np.inf
    state.time[:] = -np.inf
    state.sequence[:] = -1.0
    state.carried[-1] = -np.inf
    return vector


def view_state(model: SelfHitModel, vector: np.ndarray) -> SelfHitState:
    """Returns a state whose fields are views of the vector."""
    return SelfHitState(
        **{
            name: vector[part].reshape(shape)
            for name, part, shape in _lay_out_model(model)
        }
    )


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """New scans of rings that sampled together, and the robot's report.

    The arrays are of all N sensors of all rings.
    """

    rings: tuple[int, ...]
    """Which rings have been looked at."""
    which: np.ndarray
    """Whether a sensor belongs to them, (N,)."""
    sampled: np.ndarray
    """Whether a sensor's sample is new and of this time, (N,)."""
    time: np.ndarray
    """Of each sensor's sample, s, (N,)."""
    distance: np.ndarray
    """As measured, m, (N,)."""
    status: np.ndarray
    """Range status; "no new data" for samples of another time, (N,)."""
    q: np.ndarray
    """Measured joints, rad, (j,)."""
    qd: np.ndarray
    """Their speeds, rad/s, (j,)."""
    spread: float
    """Greatest difference of a sample's time from the look's, s."""
    carried: np.ndarray
    """Place of each object, or ON_TOOL, (p,)."""


def make_looks(
    masked_scans: Sequence[MaskedScan],
    counted_time: np.ndarray,
    carried: np.ndarray,
    is_dead: np.ndarray,
) -> list[Look]:
    """Makes looks of new samples, one for all that were taken together.

    Args:
        masked_scans: of m rings of n sensors each.
        counted_time: of each sensor's last sample that counted, s, (N,).
        carried: place of each object, or ON_TOOL, (p,).
        is_dead: sensors that do not count, (N,).

    Returns:
        Looks at samples that are newer than those, oldest first.
    """
    scans = [masked_scan.raw for masked_scan in masked_scans]
    n = max(len(scan.status) for scan in scans)
    if n == 0:
        return []
    time, distance, status = (
        _stack(scans, n, name, empty)
        for name, empty in (
            ("sensor_time", -np.inf),
            ("distance", 0.0),
            ("status", STATUS_NO_NEW_DATA),
        )
    )
    joints = max(masked.position.shape[1] for masked in masked_scans)
    motion = np.stack(
        [
            _stack(masked_scans, n, name, 0.0, joints)
            for name in ("position", "velocity")
        ]
    )
    # A held reading comes with the robot's motion of another time.
    is_held = _stack(masked_scans, n, "reading", 0) == Reading.HELD
    rest = (time > counted_time) & np.isfinite(time) & ~is_dead
    looks = []
    while rest.any():
        first = time[rest].min()
        sampled = rest & (time <= first + _SPREAD)
        rest &= ~sampled
        timed = sampled & ~is_held
        q, qd = motion[:, timed if timed.any() else sampled].mean(axis=1)
        has_sampled = sampled.reshape(-1, n).any(axis=1)
        looks.append(
            Look(
                rings=tuple(np.flatnonzero(has_sampled).tolist()),
                which=np.repeat(has_sampled, n),
                sampled=sampled,
                time=time,
                distance=distance,
                status=np.where(sampled, status, STATUS_NO_NEW_DATA),
                q=q,
                qd=qd,
                spread=0.5 * float(np.ptp(time[sampled])),
                carried=carried,
            )
        )
    return looks


def _stack(messages, n, name, empty, *shape):
    """Returns an array of all rings, (N, ...); `empty` where there is none."""
    arrays = [getattr(message, name) for message in messages]
    return np.concatenate(
        [
            array if len(array) == n else np.full((n, *shape), empty)
            for array in arrays
        ]
    )


def expect(
    model: SelfHitModel,
    look: Look,
    bundles: RayBundles,
    expectation: np.ndarray,
    *,
    shift: float = 0.0,
    offset: float = 0.0,
    which: np.ndarray | None = None,
) -> np.ndarray:
    """Computes what a look's sensors may and must see.

    Args:
        model: casts the rays on the twin.
        look: rings and position of the robot.
        bundles: rays of the model.
        expectation: changed, see `widen_expectation`, (3, N).
        shift: how long after the samples' time to look at the robot, s.
        offset: true minus reported angle of the first joint, rad.
        which: the sensors, (N,); None: all of the look's.

    Returns:
        X_WF of the caster's frames, (frames, 3, 4).
    """
    q = look.q + shift * look.qd
    q[0] += offset
    X_WF = model.twin.calc(q, look.carried)
    distance, _ = model.caster.cast_bundles(
        bundles, X_WF, look.which if which is None else which
    )
    widen_expectation(distance, model.num_wide, expectation)
    return X_WF


def count_look(model: SelfHitModel, state: SelfHitState, look: Look) -> None:
    """Counts a look in all tests.

    Args:
        model: what to expect.
        state: changed.
        look: not yet counted.
    """
    config = model.config
    n = model.num_sensors
    expectation = make_no_expectation(len(look.which))
    outcome = np.empty(len(look.which), dtype=np.int64)

    def classify():
        return classify_self_hits(
            look.distance, look.status, expectation, *model.limits, outcome
        )

    X_WF = expect(model, look, model.believed, expectation)
    rays = model.believed
    origin = calc_origins(X_WF, rays.frame_index, rays.X_FS)
    is_odd = classify()
    margin = model.time_margin + look.spread
    if is_odd and margin > 0.0 and np.abs(look.qd).max() > _STILL:
        expect(model, look, model.believed, expectation, shift=margin)
        expect(model, look, model.believed, expectation, shift=-margin)
        is_odd = classify()
    step_sensors(
        state.sensor_sum,
        state.sensor_alarm,
        outcome,
        must_see(expectation, *model.limits[1:]),
        config.miss_rate,
        config.broken_rate,
        config.sensor_threshold,
    )
    _count_rides(model, state, look, outcome, origin)
    state.expectation[:, look.which] = expectation[:, look.which]
    before = state.position[look.sampled][0]
    if np.abs(look.q - before).max() < config.min_motion:
        return
    state.position[look.sampled] = look.q
    if not (is_odd or state.misfit_sum.any()):
        return
    odd = np.any((outcome >= MISS).reshape(-1, n), axis=1)
    for ring in look.rings:
        _try_orders(model, state, look, outcome, ring, odd[ring])
    _try_misfits(model, state, look, outcome, odd)


def _count_rides(model, state, look, outcome, origin):
    """Counts a look in the test for hits that ride with the robot."""
    step_rides(
        state.ride_start,
        state.ride_travel,
        state.ride_last,
        state.ride_alarm,
        state.ride_unfit,
        outcome,
        look.distance,
        look.status,
        origin,
        model.limits[0],
        model.config.ride_travel,
    )


def _try_orders(model, state, look, outcome, ring, is_odd):
    """Counts a look in the tests for wrongly numbered sensors or rings."""
    n = model.num_sensors
    sensors = slice(n * ring, n * ring + n)
    step_orders(
        state.misfit_sum,
        state.misfit_alarm,
        ring,
        is_odd,
        look.distance[sensors],
        look.status[sensors],
        state.expectation,
        model.orders,
        model.swaps,
        outcome[sensors],
        model.limits,
        model.scores,
        model.config.misfit_threshold,
    )


def _try_misfits(model, state, look, outcome, odd):
    """Counts a look in the tests for misfits that need their own rays.

    If all is as believed nothing can fit better: sums that are 0 stay so and
    are not tried. The others are tried in turn, one per look, which counts for
    all of them.
    """
    first = len(state.misfit_sum) - len(model.misfits)
    tried = []
    live = []
    for i, misfit in enumerate(model.misfits):
        if misfit.ring >= 0 and misfit.ring not in look.rings:
            continue
        if odd.any() if misfit.ring < 0 else odd[misfit.ring]:
            tried.append((i, 1))
        elif state.misfit_sum[first + i] > 0.0:
            live.append(i)
    if live:
        turn = int(state.sequence[look.rings[0]]) % len(live)
        tried.append((live[turn], len(live)))
    n = model.num_sensors
    expectations = _expect_moved(
        model, look, [i for i, _ in tried if model.misfits[i].ring >= 0]
    )
    for i, weight in tried:
        misfit = model.misfits[i]
        if misfit.ring >= 0:
            sensors = slice(n * misfit.ring, n * misfit.ring + n)
            expectation = expectations[:, n * i : n * i + n]
        else:
            sensors = slice(None)
            expectation = make_no_expectation(len(look.which))
            expect(
                model,
                look,
                model.believed,
                expectation,
                shift=misfit.delay,
                offset=misfit.offset,
            )
        step_misfit(
            state.misfit_sum,
            state.misfit_alarm,
            first + i,
            look.distance[sensors],
            look.status[sensors],
            expectation,
            outcome[sensors],
            model.limits,
            model.scores,
            model.config.misfit_threshold,
            weight,
        )


def _expect_moved(model, look, misfits):
    """Returns what moved rings see, misfit by misfit, (3, k n)."""
    if not misfits:
        return None
    n = model.num_sensors
    which = np.zeros(model.moved.num_bundles, dtype=bool)
    for i in misfits:
        which[n * i : n * i + n] = True
    expectation = make_no_expectation(len(which))
    expect(model, look, model.moved, expectation, which=which)
    return expectation


def describe_test(
    model: SelfHitModel, test: int
) -> tuple[str, tuple[int, ...], str]:
    """Describes what a test for a misfit is about.

    Args:
        model: its tests.
        test: index into `SelfHitState.misfit_sum`.

    Returns:
        MISPLACED or MODEL, the rings concerned, and a text.
    """
    m, p, s = len(model.name), len(model.orders), len(model.swaps)
    if test < m * p:
        ring, order = divmod(test, p)
        text = name_order(model.orders[order])
        return MISPLACED, (ring,), f"{model.name[ring]} ring fits if {text}"
    if test < m * p + s:
        pair = tuple(model.swaps[test - m * p].tolist())
        a, b = (model.name[i] for i in pair)
        return MISPLACED, pair, f"{a} and {b} rings fit if swapped"
    misfit = model.misfits[test - m * p - s]
    if misfit.kind == MODEL:
        return MODEL, tuple(range(m)), f"fits with {misfit.text}"
    name = model.name[misfit.ring]
    return MISPLACED, (misfit.ring,), f"{name} ring fits if {misfit.text}"


def tell_health(model: SelfHitModel, state: SelfHitState) -> SelfHitHealth:
    """Makes the message from the results of the tests.

    A sensor's alarm also names the misfit that explains it best, if there is
    one: if a ring is turned, single sensors miss the robot first.
    """
    m, n = len(model.name), model.num_sensors
    unseen = state.sensor_alarm.reshape(m, n) > 0.0
    lines: list[list[str]] = [[] for _ in range(m)]
    # The best explanation first.
    for test in np.argsort(-state.misfit_sum, kind="stable").tolist():
        if state.misfit_sum[test] < model.config.name_threshold:
            break
        kind, rings, text = describe_test(model, test)
        for ring in rings:
            if not lines[ring] and (
                state.misfit_alarm[test] or unseen[ring].any()
            ):
                lines[ring].append(f"{kind}: {text}")
    for ring in range(m):
        if unseen[ring].any():
            sensors = ", ".join(map(str, np.flatnonzero(unseen[ring])))
            lines[ring].append(
                f"unseen self-hit: {model.name[ring]} sensor {sensors}"
            )
    # An alarm is reported until its sum is back at 0.
    for test in np.flatnonzero(state.misfit_alarm).tolist():
        kind, rings, text = describe_test(model, test)
        for ring in rings:
            lines[ring] = lines[ring] or [f"{kind}: {text}"]
    rides = state.ride_alarm.reshape(m, n) > 0.0
    for ring, sensor in np.argwhere(rides).tolist():
        distance = state.ride_start[n * ring + sensor]
        lines[ring].append(
            f"{model.name[ring]} sensor {sensor}: a hit at {distance:.2f} m "
            "rides with the robot"
        )
    fault = np.full((m, n), SensorFault.NONE, dtype=np.uint8)
    fault[rides] = SensorFault.RIDING_HIT
    fault[unseen] = SensorFault.UNSEEN_SELF_HIT
    return SelfHitHealth(
        name=model.name,
        fault=fault,
        problem=tuple("; ".join(line) for line in lines),
    )


class SelfHitWatch(LeafSystem):
    """Checks whether the rings see the robot where the twin says they must.

    .. pydrake_system::

        name: SelfHitWatch
        input_ports:
        - masked_scan_<ring>
        - robot_report
        output_ports:
        - self_hit_health

    Once a period, each sensor's newest sample counts in all tests
    (`count_look`). Skipping some samples does no harm: the tests take seconds.
    The masked scans hold the samples as they came, and the robot's motion at
    their times. An alarm ends
    when the readings have spoken for the model as much as against it.
    """

    def __init__(self, *, model: SelfHitModel, period: float = 0.024):
        """Constructs the system.

        Args:
            model: from `make_self_hit_model`.
            period: between looks, s; the rings' own is enough.

        Raises:
            UserError: if the period is not positive.
        """
        super().__init__()
        require_period(period)
        self._model = model
        self._empty = make_empty_self_hit_health(model.name, model.num_sensors)
        self._masked_scans = [
            self.DeclareAbstractInputPort(
                f"masked_scan_{ring}", Value(MaskedScan())
            )
            for ring in model.name
        ]
        self._report = self.DeclareVectorInputPort(
            "robot_report",
            calc_report_size(model.twin.num_joints, model.twin.num_objects),
        )
        vector = make_state_vector(model)
        state = view_state(model, vector)
        # They come first.
        self._alarms = slice(
            len(state.sensor_alarm)
            + len(state.misfit_alarm)
            + len(state.ride_alarm)
        )
        self._state = self.DeclareDiscreteState(vector)
        self.DeclareAbstractOutputPort(
            "self_hit_health",
            Value(self._empty).Clone,
            self._calc_health,
            prerequisites_of_calc={self.discrete_state_ticket(self._state)},
        )
        if model.config.enabled:
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._watch)

    @property
    def model(self) -> SelfHitModel:
        """The model that the rings are compared with."""
        return self._model

    def _watch(
        self, context: Context, discrete_state: DiscreteValues
    ) -> EventStatus:
        masked_scans = [port.Eval(context) for port in self._masked_scans]
        # As it was until it is written.
        state = view_state(
            self._model, discrete_state.get_mutable_value(self._state)
        )
        sequence = [scan.raw.sequence for scan in masked_scans]
        report = self._report.Eval(context)
        carried = report[2 * self._model.twin.num_joints :]
        has_changed = carried.tolist() != state.carried[:-1].tolist()
        if sequence == state.sequence.tolist() and not has_changed:
            return EventStatus.DidNothing()
        state.sequence[:] = sequence
        if has_changed:
            state.carried[:-1] = carried
            state.carried[-1] = context.get_time()
        if context.get_time() < state.carried[-1] + _UNCERTAIN:
            return EventStatus.Succeeded()
        moved = np.abs(report[: state.position.shape[1]] - state.position).max()
        if moved < self._model.config.min_motion:
            state.rest[0] += 1.0
            if state.rest[0] % _REST_LOOKS:
                return EventStatus.Succeeded()
        looks = make_looks(
            masked_scans, state.time, carried, self._model.is_dead
        )
        for look in looks:
            count_look(self._model, state, look)
            state.time[look.sampled] = look.time[look.sampled]
        return EventStatus.Succeeded()

    def _calc_health(self, context: Context, output):
        vector = context.get_discrete_state(self._state).value()
        before = output.get_value()
        if not vector[self._alarms].any():
            if before is not self._empty:
                output.set_value(self._empty)
            return
        health = tell_health(self._model, view_state(self._model, vector))
        if (
            health.problem != before.problem
            or (health.fault != before.fault).any()
        ):
            output.set_value(health)


def apply_health(separation: Separation, health: SelfHitHealth) -> Separation:
    """Returns a separation in which links with a problem are faulted."""
    if not any(health.problem):
        return separation
    is_bad = [line != "" for line in health.problem]
    before = separation.problem or ("",) * len(is_bad)
    return dc.replace(
        separation,
        health=np.where(is_bad, RingHealth.FAULTED, separation.health),
        problem=tuple(
            "; ".join(filter(None, lines))
            for lines in zip(before, health.problem, strict=True)
        ),
    )


class SelfHitStop(LeafSystem):
    """Marks a link as faulted if its ring does not see the robot as it must.

    .. pydrake_system::

        name: SelfHitStop
        input_ports:
        - separation
        - self_hit_health
        output_ports:
        - separation

    Args:
        name: the links.
    """

    def __init__(self, name: tuple[str, ...]):
        super().__init__()
        separation = make_empty_separation(name)
        health = make_empty_self_hit_health(name)
        self._separation = self.DeclareAbstractInputPort(
            "separation", Value(separation)
        )
        self._health = self.DeclareAbstractInputPort(
            "self_hit_health", Value(health)
        )
        self.DeclareAbstractOutputPort(
            "separation",
            Value(separation).Clone,
            self._calc_separation,
            prerequisites_of_calc={
                self._separation.ticket(),
                self._health.ticket(),
            },
        )

    def _calc_separation(self, context: Context, output):
        output.set_value(
            apply_health(
                self._separation.Eval(context), self._health.Eval(context)
            )
        )
