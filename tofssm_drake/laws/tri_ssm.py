"""TriSSM state: normal, reduced or stop (the 2019 paper, II-A)."""

import dataclasses as dc

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from tofssm_drake.kernels import njit
from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.messages import (
    RingHealth,
    RobotState,
    SafetyIndex,
    make_empty_safety_index,
)

# As compile-time constants for the kernel.
_STOP = float(RobotState.STOP)
_REDUCED = float(RobotState.REDUCED)
_NORMAL = float(RobotState.NORMAL)
_HEALTHY = int(RingHealth.HEALTHY)
_BLIND = int(RingHealth.BLIND)
_DEGRADED = int(RingHealth.DEGRADED)
_WORKING = (_HEALTHY, _BLIND, _DEGRADED)


@njit(cache=True)
def classify_index(dsi, dsi_C, dsi_R, literal):
    """Returns psi_i for the filtered index (end of Algorithm 1).

    The stop test comes first, and NaN stops. `literal` uses the paper's order,
    normal first, which matters if d_R < d_C.
    """
    if literal and dsi <= dsi_R:
        return _NORMAL
    if not dsi < dsi_C:
        return _STOP
    return _NORMAL if dsi <= dsi_R else _REDUCED


@njit(cache=True)
def _calc_states(
    now, deadline, literal, sequence, time, health, dsi, dsi_C, dsi_R, states
):
    for i in range(len(sequence)):
        if sequence[i] < 0 or not abs(now - time[i]) <= deadline:
            states[i] = _STOP
        elif health[i] == _HEALTHY:
            states[i] = classify_index(dsi[i], dsi_C[i], dsi_R[i], literal)
        elif health[i] == _BLIND or health[i] == _DEGRADED:
            # Without an index, that is all that is known.
            states[i] = _REDUCED
            if dsi[i] != np.inf:
                state = classify_index(dsi[i], dsi_C[i], dsi_R[i], literal)
                states[i] = min(_REDUCED, state)
        else:
            states[i] = _STOP


def calc_ring_states(
    *, index: SafetyIndex, now: float, config: SsmConfig
) -> np.ndarray:
    """Returns psi_i of every link (`RobotState`), shape (m,).

    Stop without a sample, with a sample further from now than the deadline
    (older, or from the future if clocks disagree), with faulted sensing, and if
    the filtered index is critical. A blind or degraded link is at most reduced.

    Args:
        index: Filtered indices and thresholds.
        now: Time, s, on the clock of `index.time`.
        config: Settings; only `deadline` and `literal` count.
    """
    states = np.empty(len(index.sequence))
    _calc_states(
        now,
        config.deadline,
        config.literal,
        index.sequence,
        index.time,
        index.health,
        index.dsi,
        index.dsi_C,
        index.dsi_R,
        states,
    )
    return states


def calc_reason(*, index: SafetyIndex, now: float, config: SsmConfig) -> str:
    """Says in one line why the robot is not in the normal state.

    It names the deciding link with its distance and threshold. Of several links
    in the lowest state that is one without a distance, else the one whose index
    is greatest relative to its threshold.

    Args:
        index: Filtered indices and thresholds.
        now: Time, s.
        config: Settings.
    """
    states = calc_ring_states(index=index, now=now, config=config)
    psi = states.min()
    if psi == RobotState.NORMAL:
        return "normal"
    is_stop = psi == RobotState.STOP
    state = "stop" if is_stop else "reduced"
    threshold = index.dsi_C if is_stop else index.dsi_R
    deciding, greatest = -1, -np.inf
    for i in np.flatnonzero(states == psi):
        name = index.name[i]
        age = now - index.time[i]
        if index.sequence[i] < 0:
            return f"{state}: {name} has no sample yet"
        problem = index.problem[i] if index.problem else ""
        if index.health[i] not in _WORKING:
            return f"{state}: {name} is faulted{problem and ', ' + problem}"
        if not abs(age) <= config.deadline:
            return (
                f"{state}: {name} sample is {age:.3f} s old, deadline "
                f"{config.deadline:.3f} s"
            )
        if index.health[i] == RingHealth.BLIND and not is_stop:
            return f"{state}: {name} is blind"
        is_near = index.dsi[i] > index.dsi_R[i]
        if index.health[i] == RingHealth.DEGRADED and not is_near:
            return f"{state}: {name} is degraded{problem and ', ' + problem}"
        ratio = index.dsi[i] / threshold[i]
        if not ratio <= greatest:
            deciding, greatest = i, ratio
    distance = config.C_dC / np.sqrt(index.dsi[deciding])
    symbol, limit = (
        ("<= d_C", index.d_C[deciding])
        if is_stop
        else ("< d_R", index.d_R[deciding])
    )
    text = f"{state}: {index.name[deciding]} at {distance:.3f} m"
    dsi_raw = index.dsi_raw[deciding]
    if dsi_raw != index.dsi[deciding]:
        if dsi_raw == 0.0:
            measured = "clear"
        elif dsi_raw > 0.0:
            measured = f"{config.C_dC / np.sqrt(dsi_raw):.3f} m"
        else:
            measured = "nothing"
        text += f" (filtered; measured {measured})"
    return f"{text} {symbol} {limit:.3f} m"


class TriSsmState(LeafSystem):
    """Decides between normal, reduced and stop.

    .. pydrake_system::

        name: TriSsmState
        input_ports:
        - dsi
        output_ports:
        - robot_state
        - ring_states
        - reason

    `dsi` is a `SafetyIndex`. `ring_states` (vector, m) is psi_i of every
    link, `robot_state` (vector, 1) psi, the lowest of them (`RobotState`).
    `reason` (str) is one line that says why psi is not normal.

    It has no state: psi is stop until there is a sample of every link. The
    outputs depend on time, because an old sample stops the robot.

    Args:
        config: Settings.
        name: The m watched links.
    """

    def __init__(
        self, *, config: SsmConfig | None = None, name: tuple[str, ...]
    ):
        super().__init__()
        config = SsmConfig() if config is None else config
        config.check("ssm")
        self._config = dc.replace(config)
        self._dsi = self.DeclareAbstractInputPort(
            "dsi", Value(make_empty_safety_index(tuple(name)))
        )
        prerequisites = {self._dsi.ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort(
            "robot_state",
            1,
            self._calc_robot_state,
            prerequisites_of_calc=prerequisites,
        )
        self._ring_states = self.DeclareVectorOutputPort(
            "ring_states",
            len(name),
            self._calc_ring_states,
            prerequisites_of_calc=prerequisites,
        )
        self.DeclareAbstractOutputPort(
            "reason",
            alloc=Value("").Clone,
            calc=self._calc_reason,
            prerequisites_of_calc=prerequisites,
        )

    def _calc(self, function, context):
        return function(
            index=self._dsi.Eval(context),
            now=context.get_time(),
            config=self._config,
        )

    def _calc_robot_state(self, context, output):
        output[0] = min(self._ring_states.Eval(context).tolist())

    def _calc_ring_states(self, context, output):
        output.SetFromVector(self._calc(calc_ring_states, context))

    def _calc_reason(self, context, output):
        output.set_value(self._calc(calc_reason, context))
