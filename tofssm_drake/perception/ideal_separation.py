"""Separation as motion capture would know it: the person's true surface."""

import dataclasses as dc
import math

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from tofssm_drake.errors import check_range, require_period
from tofssm_drake.kernels import njit
from tofssm_drake.messages import (
    Reading,
    RingHealth,
    Separation,
    make_empty_separation,
)
from tofssm_drake.perception.separation import (
    DISTANCE,
    HEALTH,
    K_L,
    K_O,
    LINK_SPEED,
    SENSOR,
    SEQUENCE,
    TIME,
    LinkKinematics,
    lay_out_separation,
    make_columns,
    saturate,
)

# As compile-time constants for the kernel.
_CLEAR = int(Reading.CLEAR)
_VALID = int(Reading.VALID)
_FAULTED = int(Reading.FAULTED)
_HEALTHY = int(RingHealth.HEALTHY)
_RING_FAULTED = int(RingHealth.FAULTED)

# Tolerance for rounding: a sample that is due at a tick is taken at it, s.
_SLACK = 1e-9


@dc.dataclass(kw_only=True)
class IdealSeparationConfig:
    """How often and how late motion capture delivers."""

    # From one sample to the next, s (paper: 120 to 125 Hz). A multiple of the
    # control tick is best.
    period: float = 0.008

    # From the sample to its separation, s, rounded up to whole periods:
    # capture and computing the distance between the meshes. The paper gives
    # no number; 0 is the best case.
    latency: float = 0.0

    # Speed of a person whose motion is not known yet, m/s (ISO/TS 15066).
    V_hmax: float = 1.6

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        check_range(where, "period", self.period, 0.001, 1.0)
        check_range(where, "latency", self.latency, 0.0, 1.0)
        check_range(where, "V_hmax", self.V_hmax, 0.0, 10.0)


@njit(cache=True)
def find_nearest_on_person(p_WL, ends, velocities, radii):
    """Finds the point nearest to a given one on a person of capsules.

    Args:
        p_WL: The point in world, m, (3,).
        ends: Both ends of each capsule in world, m, (c, 2, 3).
        velocities: Of these ends, m/s, (c, 2, 3).
        radii: Of the capsules, m, (c,).

    Returns:
        (distance, n, v): distance to the surface, m, 0 inside of it; inf
        without capsules. The unit vector towards it, (3,), NaN where there
        is none. The velocity of the nearest point of the capsule's axis, m/s,
        (3,): (v_WL - v) . n is exactly the speed at which the distance
        shrinks, since turning about its own axis does not move the
        surface of a capsule.
    """
    nearest = np.inf
    n = np.full(3, np.nan)
    v = np.full(3, np.nan)
    for j in range(radii.shape[0]):
        length2 = 0.0
        along = 0.0
        for k in range(3):
            u = ends[j, 1, k] - ends[j, 0, k]
            length2 += u * u
            along += (p_WL[k] - ends[j, 0, k]) * u
        w = min(max(along / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
        gap2 = 0.0
        for k in range(3):
            p = ends[j, 0, k] + w * (ends[j, 1, k] - ends[j, 0, k])
            gap2 += (p - p_WL[k]) ** 2
        gap = math.sqrt(gap2)
        if gap - radii[j] < nearest:
            nearest = gap - radii[j]
            for k in range(3):
                p = ends[j, 0, k] + w * (ends[j, 1, k] - ends[j, 0, k])
                n[k] = (p - p_WL[k]) / gap if gap > 0.0 else np.nan
                v[k] = velocities[j, 0, k] + w * (
                    velocities[j, 1, k] - velocities[j, 0, k]
                )
    return max(nearest, 0.0), n, v


@njit(cache=True)
def _calc_links(
    p_WL, v_WL, ends, velocities, radii, k_max, V_hmax, reals, whole
):
    """Writes all of a separation except its time, see `make_columns`."""
    m = p_WL.shape[0]
    direction = reals[K_O + 1 :].reshape(m, 3)
    count = whole[HEALTH + 1 :].reshape(m, 4)
    is_person_known = np.isfinite(ends).all()
    for i in range(m):
        distance, n, v = find_nearest_on_person(
            p_WL[i], ends, velocities, radii
        )
        is_seen = np.isfinite(distance)
        speed2 = 0.0
        k_l = 0.0
        v_h = 0.0
        for k in range(3):
            speed2 += v_WL[i, k] ** 2
            k_l += v_WL[i, k] * n[k]
            v_h -= v[k] * n[k]
        speed = math.sqrt(speed2)
        if np.isnan(k_l):
            # Nobody is there, or the link's centre is on a bone: any direction.
            k_l = speed
            v_h = V_hmax
        elif np.isnan(v_h):
            v_h = V_hmax
        reals[DISTANCE, i] = distance
        reals[LINK_SPEED, i] = speed
        reals[K_L, i] = saturate(k_l, k_max)
        reals[K_O, i] = saturate(k_l + v_h, k_max)
        direction[i] = n
        whole[SENSOR, i] = 0 if is_seen else -1
        count[i] = 0
        if is_person_known and np.isfinite(p_WL[i]).all():
            whole[HEALTH, i] = _HEALTHY
            count[i, _VALID if is_seen else _CLEAR] = 1
        else:
            whole[HEALTH, i] = _RING_FAULTED
            count[i, _FAULTED] = 1


def calc_ideal_separation(
    *,
    p_WL: np.ndarray,
    v_WL: np.ndarray,
    ends: np.ndarray,
    velocities: np.ndarray,
    radii: np.ndarray,
    k_max: float = 3.3,
    V_hmax: float = 1.6,
    sequence: int = 0,
    time: float = 0.0,
    name: tuple[str, ...],
) -> Separation:
    """Calculates the separation from the true positions of person and robot.

    The distance is that from each link's centre to the person's surface, the
    directed speeds those of the paper's Eqs. 4a and 4b: k_l = V_l . P^ and
    k_o = (V_l - V_o) . P^ with V_o of the nearest point. Where the person's
    velocity is not known, k_o = k_l + V_hmax. Without a person the distance
    is inf, k_l = ||V_l|| and k_o = ||V_l|| + V_hmax.

    Args:
        p_WL: Link centres in world, m, (m, 3).
        v_WL: Their velocities, m/s, (m, 3).
        ends: Ends of the person's capsules in world, m, (c, 2, 3).
        velocities: Their velocities, m/s, (c, 2, 3); NaN: not known.
        radii: Radii of the capsules, m, (c,).
        k_max: k_l and k_o are saturated to +-k_max, m/s.
        V_hmax: See above, m/s.
        sequence: Number of the sample.
        time: Of the sample, s.
        name: The m links.
    """
    reals, whole = make_columns(len(name))
    reals[TIME] = time
    whole[SEQUENCE] = sequence
    _calc_links(
        p_WL, v_WL, ends, velocities, radii, k_max, V_hmax, reals, whole
    )
    return lay_out_separation(name, reals, whole)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Capture:
    """The last sample, and the separations not yet delivered."""

    sequence: int = -1
    time: float = -math.inf
    ends: np.ndarray | None = None
    waiting: tuple[Separation, ...] = ()

    def __deepcopy__(self, memo):
        return self


class IdealSeparation(LeafSystem):
    """Calculates the separation from the true person, without a sensor.

    .. pydrake_system::

        name: IdealSeparation
        input_ports:
        - position_measured
        - velocity_measured
        - skeleton
        output_ports:
        - separation

    It stands for motion capture (the paper's *Ideal* sensing). `skeleton` is
    the avatar's: both ends of each of c capsules, m, in world, 6 c numbers.
    Once a period it samples person and robot; see calc_ideal_separation().
    The person's velocity is the difference quotient of two samples, as in a
    motion capture system. The separation appears at the port `latency` later,
    with the sample's own time.
    """

    def __init__(
        self,
        *,
        config: IdealSeparationConfig,
        k_max: float = 3.3,
        kinematics: LinkKinematics,
        radii: np.ndarray,
        name: tuple[str, ...],
    ):
        """Constructs the system.

        Args:
            config: settings.
            k_max: k_l and k_o are saturated to +-k_max, m/s.
            kinematics: of the links, in the order of `name`.
            radii: of the person's capsules, m, (c,); none without a person.
            name: the links.

        Raises:
            UserError: if a setting is out of range.
        """
        super().__init__()
        config.check("ideal")
        require_period(config.period)
        self._config = dc.replace(config)
        self._k_max = k_max
        self._kinematics = kinematics
        self._radii = np.array(radii, dtype=float)
        self._name = tuple(name)
        self._position = self.DeclareVectorInputPort(
            "position_measured", kinematics.num_joints
        )
        self._velocity = self.DeclareVectorInputPort(
            "velocity_measured", kinematics.num_joints
        )
        self._skeleton = self.DeclareVectorInputPort(
            "skeleton", 6 * len(self._radii)
        )
        self._capture = self.DeclareAbstractState(Value(_Capture()))
        self._separation = self.DeclareAbstractState(
            Value(make_empty_separation(self._name))
        )
        self.DeclareStateOutputPort("separation", self._separation)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period, 0.0, self._update
        )

    def _update(self, context: Context, state: State):
        before = context.get_abstract_state(self._capture).get_value()
        time = context.get_time()
        ends, separation = self._sample(context, time, before)
        waiting = [*before.waiting, separation]
        due = time - self._config.latency + _SLACK
        delivered = None
        while waiting and waiting[0].time[0] <= due:
            delivered = waiting.pop(0)
        if delivered is not None:
            state.get_mutable_abstract_state(self._separation).set_value(
                delivered
            )
        state.get_mutable_abstract_state(self._capture).set_value(
            _Capture(
                sequence=before.sequence + 1,
                time=time,
                ends=ends,
                waiting=tuple(waiting),
            )
        )
        return EventStatus.Succeeded()

    def _sample(self, context, time, before):
        """Returns where the person is now, and the separation."""
        ends = np.empty((len(self._radii), 2, 3))
        if len(ends):
            # A copy, since the evaluated value changes later.
            ends[:] = self._skeleton.Eval(context).reshape(ends.shape)
        if before.ends is None or time <= before.time:
            velocities = np.full(ends.shape, np.nan)
        else:
            velocities = (ends - before.ends) / (time - before.time)
        p_WL, _, v_WL = self._kinematics.calc(
            self._position.Eval(context), self._velocity.Eval(context)
        )
        return ends, calc_ideal_separation(
            p_WL=p_WL,
            v_WL=v_WL,
            ends=ends,
            velocities=velocities,
            radii=self._radii,
            k_max=self._k_max,
            V_hmax=self._config.V_hmax,
            sequence=before.sequence + 1,
            time=time,
            name=self._name,
        )
