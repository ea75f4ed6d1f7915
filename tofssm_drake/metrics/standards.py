"""What the standards require of the law, as pure functions.

ISO/TS 15066:2016, 5.5.4 (protective separation distance) and ISO 13855 (speeds
of people). It is used only to audit a run.
"""

import dataclasses as dc

from tofssm_drake.errors import require

WALKING_SPEED = 1.6
"""Speed of an unmonitored person towards the robot, m/s (ISO 13855)."""


@dc.dataclass(kw_only=True)
class AuditConfig:
    """The audit's assumptions about what the scenario does not say."""

    # Speed of the person in the protective separation distance, m/s (ISO/TS
    # 15066: 1.6 where it is not monitored).
    V_h: float = WALKING_SPEED

    # Masking the scans and computing the distances, s (paper: about 2 ms).
    monitor_time: float = 0.002

    # One cycle of the robot's interface, s (CB3: 8 ms).
    rtde_period: float = 0.008

    # From the command to the start of braking, s (*assumed*).
    brake_start: float = 0.024

    def check(self, where: str) -> None:
        """Raises UserError unless every setting makes sense."""
        for name in ("V_h", "monitor_time", "rtde_period", "brake_start"):
            value = getattr(self, name)
            require(
                0.0 <= value <= 10.0,
                f"{where}.{name}: {value!r} is out of range; use 0 to 10",
            )


def calc_protective_distance(*, v_h, v_r, T_R: float, T_S, C: float):
    """Returns the protective separation distance S_p, m.

    ISO/TS 15066, 5.5.4.2, with constant speeds:

        S_p = v_h (T_R + T_S) + v_r T_R + v_r T_S / 2 + C

    the person's path S_h, the robot's path S_r until it brakes, and its
    stopping distance S_s under constant deceleration. The arguments may be
    arrays.

    Args:
        v_h: Speed of the person towards the robot, m/s; may be negative.
        v_r: Speed of the robot towards the person, m/s; may be negative.
        T_R: Reaction time, s.
        T_S: Stopping time, s.
        C: Intrusion distance and uncertainties, C + Z_d + Z_r, m.
    """
    return v_h * (T_R + T_S) + v_r * (T_R + 0.5 * T_S) + C


def make_latency_budget(
    *,
    config: AuditConfig,
    integration: float,
    wait: float,
    delivery: float,
    control_period: float,
) -> dict[str, float]:
    """Lists the worst-case delays from a person's motion to braking, s.

    Args:
        config: Delays that do not depend on the sensing.
        integration: Integration time of a sample, s.
        wait: Time to the next sample, s.
        delivery: From the end of the sample to the monitor, s.
        control_period: Control tick, s.

    Returns:
        Times by name, in order; the latency is their sum.
    """
    return {
        "integration": integration,
        "wait for the next sample": wait,
        "delivery": delivery,
        "mask and distances": config.monitor_time,
        "control tick": control_period,
        "robot's interface": config.rtde_period,
        "start of braking": config.brake_start,
    }


def calc_rate_bound(runs: int, *, confidence: float = 0.95) -> float:
    """Returns how frequent an event may be that never happened in so many runs.

    The exact (Clopper-Pearson) upper bound of a rate of 0 of n, one-sided.

    Args:
        runs: n, at least 1.
        confidence: Of the bound.
    """
    return 1.0 - (1.0 - confidence) ** (1.0 / runs)
