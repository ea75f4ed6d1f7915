"""Smooth speed fraction of the program (the 2019 paper, Eq. 3 and II-C-2)."""

import atexit
import dataclasses as dc
import functools
import math
import threading

from pydrake.systems.framework import EventStatus, LeafSystem
from ruckig import (
    ControlInterface,
    InputParameter,
    Result,
    Ruckig,
    RuckigError,
    Trajectory,
)

from tofssm_drake.errors import require_period
from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.messages import RobotState

# Rounding error of a completed profile.
_TOLERANCE = 1e-9


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
    config: SsmConfig,
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
    rho_max_rate / rho_max_acceleration (0.1 s) more, and a stop would take that
    much longer than T_stop. Unless `config.literal`, the rise is therefore cut
    off in that tick: rho never passes its target from below, never rises while
    the target is 0, and stops from any state within the time and the distance
    of a stop from rho = 1.

    Args:
        config: Settings.
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
    if not config.literal:
        highest = max(rho, target)
        if rate > 0.0:
            room = 2.0 * config.rho_max_acceleration * (highest - rho)
            rate = min(rate, math.sqrt(room))
    otg, trajectory, otg_input = _make_planner(
        config.rho_max_rate,
        config.rho_max_acceleration,
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
    """Turns the TriSSM state into a smooth speed fraction.

    .. pydrake_system::

        name: SpeedFractionTrajectory
        input_ports:
        - robot_state
        output_ports:
        - speed_fraction

    `robot_state` (vector, 1) is psi; its targets are rho = 0, `rho_reduced`
    and 1 (the paper's Eq. 3), and anything that is not a number of
    `RobotState` stops. `speed_fraction` (vector, 1) is rho. It starts at 0.
    The state is rho and its rate, 1/s.

    Args:
        config: Settings.
        period: Control tick, s.
    """

    def __init__(
        self, *, config: SsmConfig | None = None, period: float = 0.008
    ):
        super().__init__()
        config = SsmConfig() if config is None else config
        config.check("ssm")
        require_period(period)
        self._config = dc.replace(config)
        self._period = period
        self._targets = {
            float(RobotState.STOP): 0.0,
            float(RobotState.REDUCED): config.rho_reduced,
            float(RobotState.NORMAL): 1.0,
        }
        self._robot_state = self.DeclareVectorInputPort("robot_state", 1)
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
        target = self._targets.get(self._robot_state.Eval(context)[0], 0.0)
        if rho == target and rate == 0.0:
            return EventStatus.DidNothing()
        rho, rate = calc_next_speed_fraction(
            config=self._config,
            period=self._period,
            rho=rho,
            rate=rate,
            target=target,
        )
        discrete_state.get_mutable_value(self._rho)[0] = rho
        discrete_state.get_mutable_value(self._rate)[0] = rate
        return EventStatus.Succeeded()
