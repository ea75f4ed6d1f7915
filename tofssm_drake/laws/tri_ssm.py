"""TriSSM state: normal, reduced or stop (the 2019 paper, II-A)."""

import dataclasses as dc
import math

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from tofssm_drake.kernels import njit
from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.messages import (
    RingHealth,
    RobotState,
    SafetyIndex,
    SpeedDecision,
    make_empty_decision,
    make_empty_safety_index,
)

SIGNALS = ("d_C", "d_R", "dsi_raw", "dsi", "dsi_C", "dsi_R")
"""Names of the signals in the law's decision: fields of `SafetyIndex`."""

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


def calc_reason(
    *,
    index: SafetyIndex,
    now: float,
    config: SsmConfig,
    offset: np.ndarray | None = None,
) -> str:
    """Says in one line why the robot is not in the normal state.

    See `explain_states`, which also has the arguments.
    """
    states = calc_ring_states(index=index, now=now, config=config)
    return explain_states(
        states=states, index=index, now=now, config=config, offset=offset
    )[1]


def explain_states(
    *,
    states: np.ndarray,
    index: SafetyIndex,
    now: float,
    config: SsmConfig,
    offset: np.ndarray | None = None,
) -> tuple[str, str]:
    """Returns which link decides, and in one line why.

    Of several links in the lowest state that is one without a distance, else
    the one whose index is greatest relative to its threshold.

    Args:
        states: From `calc_ring_states`, (m,).
        index: Filtered indices and thresholds.
        now: Time, s.
        config: Settings.
        offset: See `DsiFilter`, m, (m,); None: 0.

    Returns:
        Name of the link, empty if the robot is in the normal state; and the
        line, with the link's distance and threshold if it has one.
    """
    # Plain numbers throughout: this runs in each tick of a real robot.
    each = states.tolist()
    psi = min(each)
    if psi == _NORMAL:
        return "", "normal"
    is_stop = psi == _STOP
    state = "stop" if is_stop else "reduced"
    threshold = (index.dsi_C if is_stop else index.dsi_R).tolist()
    dsi = index.dsi.tolist()
    deciding, greatest = -1, -math.inf
    for i, name in enumerate(index.name):
        if each[i] != psi:
            continue
        problem = _find_problem(index, i, now, config, is_stop)
        if problem:
            return name, f"{state}: {name} {problem}"
        ratio = dsi[i] / threshold[i] if threshold[i] else math.inf
        if not ratio <= greatest:
            deciding, greatest = i, ratio
    more = 0.0 if offset is None else float(offset[deciding])
    text = _describe_distance(index, deciding, config.grow(more).C_dC, is_stop)
    return index.name[deciding], f"{state}: {text}"


def _find_problem(index, i, now, config, is_stop):
    """Returns why a link counts without its distance; empty: it does not."""
    if index.sequence[i] < 0:
        return "has no sample yet"
    health = int(index.health[i])
    problem = index.problem[i] if index.problem else ""
    if health not in _WORKING:
        return f"is faulted{problem and ', ' + problem}"
    age = now - float(index.time[i])
    if not abs(age) <= config.deadline:
        return f"sample is {age:.3f} s old, deadline {config.deadline:.3f} s"
    if health == _BLIND and not is_stop:
        return "is blind"
    if health == _DEGRADED and not index.dsi[i] > index.dsi_R[i]:
        return f"is degraded{problem and ', ' + problem}"
    return ""


def _describe_distance(index, i, C_dC, is_stop):
    """Returns a link with its distance and the threshold it is under."""
    dsi, dsi_raw = float(index.dsi[i]), float(index.dsi_raw[i])
    symbol, limit = (
        ("<= d_C", index.d_C[i]) if is_stop else ("< d_R", index.d_R[i])
    )
    text = f"{index.name[i]} at {_find_distance(C_dC, dsi):.3f} m"
    if dsi_raw != dsi:
        if dsi_raw == 0.0:
            measured = "clear"
        elif dsi_raw > 0.0:
            measured = f"{_find_distance(C_dC, dsi_raw):.3f} m"
        else:
            measured = "nothing"
        text += f" (filtered; measured {measured})"
    return f"{text} {symbol} {limit:.3f} m"


def _is_late(index, now, deadline):
    """Returns whether a sample is too old: only then a reason has its age."""
    return any(not abs(now - time) <= deadline for time in index.time.tolist())


def _find_distance(C_dC, dsi):
    """Returns the distance that gives an index, m."""
    return C_dC / math.sqrt(dsi) if dsi else math.inf


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
        name: The m watched links.
        config: Settings.
        offset: See `DsiFilter`, m, (m,); None: 0.
    """

    def __init__(
        self,
        *,
        name: tuple[str, ...],
        config: SsmConfig | None = None,
        offset: np.ndarray | None = None,
    ):
        super().__init__()
        config = SsmConfig() if config is None else config
        config.check("law")
        self._config = dc.replace(config)
        self._offset = offset
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

    def _calc_robot_state(self, context, output):
        output[0] = min(self._ring_states.Eval(context).tolist())

    def _calc_ring_states(self, context, output):
        output.SetFromVector(
            calc_ring_states(
                index=self._dsi.Eval(context),
                now=context.get_time(),
                config=self._config,
            )
        )

    def _calc_reason(self, context, output):
        output.set_value(
            calc_reason(
                index=self._dsi.Eval(context),
                now=context.get_time(),
                config=self._config,
                offset=self._offset,
            )
        )


class TriSsmDecision(LeafSystem):
    """Puts the states into the message that all laws have in common.

    .. pydrake_system::

        name: TriSsmDecision
        input_ports:
        - dsi
        - ring_states
        output_ports:
        - decision

    `dsi` is a `SafetyIndex`, `ring_states` (vector, m) the psi_i that
    `TriSsmState` made of it. `decision` is a `SpeedDecision`: its target is 0,
    `rho_reduced` or 1 (the paper's Eq. 3) for the lowest psi_i; one that is not
    a number of `RobotState` counts as stop. Its signals are `SIGNALS`.

    Args:
        name: The m watched links.
        config: Settings.
        offset: See `DsiFilter`, m, (m,); None: 0.
    """

    def __init__(
        self,
        *,
        name: tuple[str, ...],
        config: SsmConfig | None = None,
        offset: np.ndarray | None = None,
    ):
        super().__init__()
        config = SsmConfig() if config is None else config
        config.check("law")
        self._config = dc.replace(config)
        self._offset = offset
        self._targets = {
            _STOP: 0.0,
            _REDUCED: config.rho_reduced,
            _NORMAL: 1.0,
        }
        self._dsi = self.DeclareAbstractInputPort(
            "dsi", Value(make_empty_safety_index(tuple(name)))
        )
        self._states = self.DeclareVectorInputPort("ring_states", len(name))
        # What was decided last, and from what: most ticks bring nothing new.
        self._last: tuple = None, None, None
        self.DeclareAbstractOutputPort(
            "decision",
            alloc=Value(make_empty_decision(tuple(name), SIGNALS)).Clone,
            calc=self._calc_decision,
            prerequisites_of_calc={
                self._dsi.ticket(),
                self._states.ticket(),
                # The reason tells the age of an old sample.
                self.time_ticket(),
            },
        )

    def _calc_decision(self, context, output):
        index = self._dsi.Eval(context)
        psi = self._states.Eval(context).tolist()
        now = context.get_time()
        last_index, last_psi, decision = self._last
        is_late = _is_late(index, now, self._config.deadline)
        if is_late or index is not last_index or psi != last_psi:
            decision = self._decide(index, psi, now)
            self._last = (None,) * 3 if is_late else (index, psi, decision)
        output.set_value(decision)

    def _decide(self, index, psi, now):
        psi = [x if x in self._targets else _STOP for x in psi]
        states = np.array(psi)
        link, reason = explain_states(
            states=states,
            index=index,
            now=now,
            config=self._config,
            offset=self._offset,
        )
        return SpeedDecision(
            name=index.name,
            target=self._targets[min(psi)],
            link=link,
            reason=reason,
            state=states.astype(np.int8),
            signal={name: getattr(index, name) for name in SIGNALS},
        )
