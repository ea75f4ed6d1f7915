"""Filter of the Distance Safety Index (the 2019 paper's Algorithm 1)."""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import EventStatus, LeafSystem

from tofssm_drake.errors import require_period
from tofssm_drake.kernels import njit
from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.laws.distances import (
    DistanceConstants,
    critical_distance,
    make_link_constants,
    reduced_distance,
)
from tofssm_drake.messages import (
    RingHealth,
    RobotState,
    SafetyIndex,
    Separation,
    make_empty_safety_index,
    make_empty_separation,
)

# Shorter, or negative, measured distances count as this one, m: the filter must
# be able to recover from the index.
MIN_DISTANCE = 1e-3

# As compile-time constants for the kernel.
_HEALTHY = int(RingHealth.HEALTHY)
_FAULTED = int(RingHealth.FAULTED)
_DEGRADED = int(RingHealth.DEGRADED)
_STOP = float(RobotState.STOP)
_REDUCED = float(RobotState.REDUCED)
_NORMAL = float(RobotState.NORMAL)


@njit(cache=True)
def filter_index(dsi, previous_dsi, dsi_C, alpha_I, alpha_D):
    """Takes a step of Algorithm 1's asymmetric exponential filter.

    A falling index is followed slowly (alpha_I), a rising one faster (alpha_D),
    and a rising one that is critical at once. Rounding never takes the result
    below a falling index, so a critical sample always stops the robot.

    Args:
        dsi: New sample, finite.
        previous_dsi: Filtered index so far; inf: none yet.
        dsi_C: Critical threshold.
        alpha_I: Weight of a falling sample.
        alpha_D: Weight of a rising sample.

    Returns:
        The filtered index.
    """
    if previous_dsi == np.inf or (dsi >= previous_dsi and dsi >= dsi_C):
        return dsi
    alpha = alpha_I if dsi < previous_dsi else alpha_D
    return dsi + (1.0 - alpha) * (previous_dsi - dsi)


@njit(cache=True)
def _threshold(C_dC, distance):
    # Only `literal` can give a distance of 0 (or less).
    return np.inf if distance == 0.0 else (C_dC / distance) ** 2


@njit(cache=True)
def _calc_index(
    constants, state, sequence, distance, link_speed, k, health, index
):
    # Rows of `index`: sequence, dsi and the thresholds' robot state, as they
    # will be stored, then d_C, d_R, dsi_raw, dsi_C, dsi_R, health.
    m = len(sequence)
    for i in range(m):
        c = constants[i]
        dsi = state[m + i]
        is_new = sequence[i] != state[i]
        robot_state = state[3 * m] if is_new else state[2 * m + i]
        index[0, i] = sequence[i]
        index[1, i] = dsi
        index[2, i] = robot_state
        if sequence[i] < 0 or not (
            distance[i] == distance[i]
            and (c.fixed or np.isfinite(k[i] + link_speed[i]))
        ):
            # Nothing is known: no distance is sufficient.
            index[3, i] = np.inf
            index[4, i] = np.inf
            index[5, i] = np.nan
            index[6, i] = 0.0
            index[7, i] = 0.0
            index[8, i] = _FAULTED
            continue
        d_C = critical_distance(c, k[i], link_speed[i])
        d_R = reduced_distance(c, k[i], robot_state, d_C)
        dsi_C = _threshold(c.C_dC, d_C)
        dsi_raw = np.nan
        if health[i] == _HEALTHY or health[i] == _DEGRADED:
            dsi_raw = (c.C_dC / max(distance[i], MIN_DISTANCE)) ** 2
            if is_new:
                dsi = filter_index(dsi_raw, dsi, dsi_C, c.alpha_I, c.alpha_D)
        index[1, i] = dsi
        index[3, i] = d_C
        index[4, i] = d_R
        index[5, i] = dsi_raw
        index[6, i] = dsi_C
        index[7, i] = _threshold(c.C_dC, d_R)
        index[8, i] = health[i]


def make_initial_filter_state(m: int) -> np.ndarray:
    """Returns the filter's state before any sample, shape (3 m + 1,).

    It holds, for m links, the sequence of the last sample (-1: none), its
    filtered index (inf: none) and the robot state used for its thresholds; then
    the robot state of the last control tick.
    """
    return np.concatenate(
        [
            np.full(m, -1.0),
            np.full(m, np.inf),
            np.full(m + 1, _STOP),
        ]
    )


def calc_safety_index(
    *,
    constants: tuple[DistanceConstants, ...],
    state: np.ndarray,
    separation: Separation,
) -> SafetyIndex:
    """Returns the filtered index and the thresholds of every link.

    A link whose sequence differs from the stored one has a new sample: the
    filter takes one step, and the thresholds use the robot state of the last
    control tick. Without a new sample the result stays the same, however often
    it is evaluated. A link that is not healthy keeps its index.

    Args:
        constants: Settings of each of the m links.
        state: See make_initial_filter_state(), shape (3 m + 1,).
        separation: Result of the sensing.

    Returns:
        The index. `dsi_raw` is NaN if the link has no reading. A NaN distance
        or speed makes the link FAULTED.
    """
    return _make_index(_calc_rows(constants, state, separation), separation)


def _calc_rows(constants, state, separation):
    """Returns the rows of `_calc_index`, (9, m)."""
    index = np.empty((9, len(separation.sequence)))
    _calc_index(
        constants,
        state,
        separation.sequence,
        separation.distance,
        separation.link_speed,
        separation.k_o if constants[0].use_k_o else separation.k_l,
        separation.health,
        index,
    )
    return index


def _make_index(index, separation):
    """Makes the message from the rows, which become read-only."""
    health = index[8].astype(np.uint8)
    for array in (index, health):
        array.setflags(write=False)
    return SafetyIndex.of_read_only(
        name=separation.name,
        sequence=separation.sequence,
        time=separation.time,
        d_C=index[3],
        d_R=index[4],
        dsi_raw=index[5],
        dsi=index[1],
        dsi_C=index[6],
        dsi_R=index[7],
        health=health,
        problem=separation.problem,
    )


class _LastIndex:
    """Remembers the last index: at most ticks there is no new sample.

    Without one the result stays the same, see `calc_safety_index`.
    """

    def __init__(self, constants):
        self._constants = constants
        self._last: tuple = None, b"", None

    def calc(self, state, separation):
        """Returns what `calc_safety_index` does."""
        before, stored, index = self._last
        if separation is before and state[:-1].tobytes() == stored:
            return index
        rows = _calc_rows(self._constants, state, separation)
        index = _make_index(rows, separation)
        # The first three rows are the state once this sample is stored.
        self._last = separation, rows[:3].tobytes(), index
        return index


@njit(cache=True)
def advance_filter_state(state, sequence, dsi, robot_state):
    """Advances the filter's state by a control tick.

    Args:
        state: See make_initial_filter_state(), shape (3 m + 1,);
            overwritten.
        sequence: Of the index from calc_safety_index(), (m,).
        dsi: Of that index, (m,).
        robot_state: psi that follows from it; STOP if not a number of
            `RobotState`.

    Returns:
        Whether anything has changed.
    """
    m = len(sequence)
    changed = False
    for i in range(m):
        if sequence[i] != state[i]:
            state[i] = sequence[i]
            state[2 * m + i] = state[3 * m]
            changed = True
        if dsi[i] != state[m + i]:
            state[m + i] = dsi[i]
            changed = True
    is_known = robot_state == _REDUCED or robot_state == _NORMAL
    psi = robot_state if is_known else _STOP
    if psi != state[3 * m]:
        state[3 * m] = psi
        changed = True
    return changed


class DsiFilter(LeafSystem):
    """Filters the Distance Safety Index of every link (Algorithm 1).

    .. pydrake_system::

        name: DsiFilter
        input_ports:
        - separation
        - robot_state
        output_ports:
        - dsi

    `separation` is a `Separation`, `dsi` a `SafetyIndex`. `robot_state` is
    psi, which follows from `dsi`: it is stored at every control tick, and the
    thresholds of a later sample use the stored one, so that no output depends
    on this port directly.

    `dsi` shows a new sample as soon as it arrives. The filter takes one step
    per sample of a link (a changed `sequence`), not per control tick; see
    calc_safety_index().

    Args:
        name: The m watched links.
        config: Settings.
        offset: By how much the law's constant distances are greater at each
            link, m, (m,); None: 0.
        period: Control tick, s.
    """

    def __init__(
        self,
        *,
        name: tuple[str, ...],
        config: SsmConfig | None = None,
        offset: np.ndarray | None = None,
        period: float = 0.008,
    ):
        super().__init__()
        config = SsmConfig() if config is None else config
        config.check("law")
        require_period(period)
        self._name = tuple(name)
        self._last = _LastIndex(make_link_constants(config, self._name, offset))

        self._separation = self.DeclareAbstractInputPort(
            "separation", Value(make_empty_separation(self._name))
        )
        self._robot_state = self.DeclareVectorInputPort("robot_state", 1)
        self._state = self.DeclareDiscreteState(
            make_initial_filter_state(len(self._name))
        )
        self._dsi = self.DeclareAbstractOutputPort(
            "dsi",
            alloc=Value(make_empty_safety_index(self._name)).Clone,
            calc=self._calc_dsi,
            prerequisites_of_calc={
                self._separation.ticket(),
                self.discrete_state_ticket(self._state),
            },
        )
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec=period, offset_sec=0.0, update=self._update
        )

    def _calc_dsi(self, context, output):
        separation = self._separation.Eval(context)
        if separation.name != self._name:
            raise ValueError(
                f"separation is of the links {separation.name}, the filter "
                f"was made for {self._name}"
            )
        state = context.get_discrete_state(self._state).value()
        output.set_value(self._last.calc(state, separation))

    def _update(self, context, discrete_state):
        index = self._dsi.Eval(context)
        # If nothing is new, what depends on the state stays valid.
        if advance_filter_state(
            discrete_state.get_mutable_value(self._state),
            index.sequence,
            index.dsi,
            self._robot_state.Eval(context)[0],
        ):
            return EventStatus.Succeeded()
        return EventStatus.DidNothing()
