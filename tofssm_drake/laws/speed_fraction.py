"""Smooth speed fraction of the program (the 2019 paper, Eq. 3 and II-C-2)."""

import atexit
import dataclasses as dc
import functools
import math
import threading

from pydrake.common.value import Value
from pydrake.systems.framework import EventStatus, LeafSystem
from ruckig import (
    ControlInterface,
    InputParameter,
    Result,
    Ruckig,
    RuckigError,
    Trajectory,
)

from tofssm_drake.errors import check_range, require_period
from tofssm_drake.messages import make_empty_decision

RATES = 0.001, 1e4
ACCELERATIONS = 0.001, 1e6
"""Least and greatest rate, 1/s, and acceleration, 1/s^2, of a speed fraction:
slower ones never reach full speed in a run, faster ones are a step within a
control tick."""

# Rounding error of a completed profile.
_TOLERANCE = 1e-9


@dc.dataclass(kw_only=True)
class SpeedRamp:
    """How fast the speed fraction may change, the same for every law."""

    # Greatest rate of the speed fraction, 1/s. *Assumed*: with the next one
    # it gives a stop within the paper's T_stop and its braking distance.
    max_rate: float = 10.0 / 3.0

    # Greatest acceleration of the speed fraction, 1/s^2. *Assumed*.
    max_acceleration: float = 100.0 / 3.0

    # True follows the paper literally: the speed fraction may still rise after
    # the decision to stop. For comparison only.
    literal: bool = False

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is valid.

        Args:
            where: Name of these settings in the user's input.
        """
        for name, low, high in (
            ("max_rate", *RATES),
            ("max_acceleration", *ACCELERATIONS),
        ):
            check_range(where, name, getattr(self, name), low, high)


@functools.lru_cache(maxsize=16)
def _make_planner(max_rate, max_acceleration, thread):
    """Makes Ruckig's objects for one degree of freedom, once per thread.

    They are only working memory: `calculate` depends on its input, not on the
    previous tick.
    """
    otg_input = InputParameter(1)
    otg_input.control_interface = ControlInterface.Velocity
    otg_input.max_acceleration = [max_rate]
    otg_input.max_jerk = [max_acceleration]
    return Ruckig(1), Trajectory(1), otg_input


# Ruckig's binding complains about objects that outlive the interpreter.
atexit.register(_make_planner.cache_clear)


def calc_next_speed_fraction(
    *,
    ramp: SpeedRamp,
    period: float,
    rho: float,
    rate: float,
    target: float,
) -> tuple[float, float]:
    """Moves the speed fraction rho towards its target for one control tick.

    Time-optimal with limited rate and acceleration: Ruckig's velocity interface
    with rho as the velocity, which is what Reflexxes Type II computes. Every
    tick is planned from scratch from the given values.

    If the target drops below where rho is heading while rho still rises, the
    limited acceleration would let rho rise for up to
    max_rate / max_acceleration (0.1 s) more, and a stop would take that much
    longer than T_stop. Unless `ramp.literal`, the rise is therefore cut off
    in that tick: rho never passes its target from below, never rises while
    the target is 0, and stops from any state within the time and the distance
    of a stop from rho = 1.

    Args:
        ramp: Settings.
        period: Control tick, s.
        rho: Speed fraction, in [0, 1].
        rate: Its rate, 1/s.
        target: Its target, in [0, 1].

    Returns:
        rho and rate after the tick; 0 and 0 if no profile can be planned.
    """
    if rho == target and rate == 0.0:
        return rho, rate
    highest = 1.0
    if not ramp.literal:
        highest = max(rho, target)
        if rate > 0.0:
            room = 2.0 * ramp.max_acceleration * (highest - rho)
            rate = min(rate, math.sqrt(room))
    otg, trajectory, otg_input = _make_planner(
        ramp.max_rate,
        ramp.max_acceleration,
        threading.get_ident(),
    )
    otg_input.current_velocity = [rho]
    otg_input.current_acceleration = [rate]
    otg_input.target_velocity = [target]
    try:
        result = otg.calculate(otg_input, trajectory)
        if result not in (Result.Working, Result.Finished):
            return 0.0, 0.0
        _, (next_rho,), (next_rate,) = trajectory.at_time(period)
    except RuckigError:
        return 0.0, 0.0
    if not (math.isfinite(next_rho) and math.isfinite(next_rate)):
        return 0.0, 0.0
    if abs(next_rho - target) < _TOLERANCE and abs(next_rate) < _TOLERANCE:
        return target, 0.0
    return min(max(next_rho, 0.0), highest), next_rate


class SpeedFractionTrajectory(LeafSystem):
    """Turns a law's decision into a smooth speed fraction.

    .. pydrake_system::

        name: SpeedFractionTrajectory
        input_ports:
        - decision
        output_ports:
        - speed_fraction

    `decision` is a `SpeedDecision`; a target that is not a number from 0 to 1
    stops. `speed_fraction` (vector, 1) is rho, which moves towards the target.
    It starts at 0. The state is rho and its rate, 1/s.

    Args:
        name: The m watched links.
        ramp: Settings.
        period: Control tick, s.
    """

    def __init__(
        self,
        *,
        name: tuple[str, ...],
        ramp: SpeedRamp | None = None,
        period: float = 0.008,
    ):
        super().__init__()
        ramp = SpeedRamp() if ramp is None else ramp
        ramp.check("ramp")
        require_period(period)
        self._ramp = dc.replace(ramp)
        self._period = period
        self._decision = self.DeclareAbstractInputPort(
            "decision", Value(make_empty_decision(name))
        )
        self._rho = self.DeclareDiscreteState(1)
        self._rate = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("speed_fraction", self._rho)
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec=period, offset_sec=0.0, update=self._update
        )

    def _update(self, context, discrete_state):
        # Before the update: those of the context.
        (rho,) = discrete_state.get_value(self._rho).tolist()
        (rate,) = discrete_state.get_value(self._rate).tolist()
        target = self._decision.Eval(context).safe_target
        if rho == target and rate == 0.0:
            return EventStatus.DidNothing()
        rho, rate = calc_next_speed_fraction(
            ramp=self._ramp,
            period=self._period,
            rho=rho,
            rate=rate,
            target=target,
        )
        discrete_state.get_mutable_value(self._rho)[0] = rho
        discrete_state.get_mutable_value(self._rate)[0] = rate
        return EventStatus.Succeeded()
