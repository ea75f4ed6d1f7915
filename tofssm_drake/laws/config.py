"""Settings of the safety law."""

import dataclasses as dc

from tofssm_drake.errors import check_range, require
from tofssm_drake.laws.speed_fraction import ACCELERATIONS, RATES

CONFIGURATIONS = ("vo", "vr", "sm")

# Unit and upper bound of what must be above 0. An arm needs seconds to stop,
# not minutes, and moves at metres per second; no cell is larger than 100 m; a
# sample of 10 s ago says nothing of a person who walks.
_MOST = {
    "T_stop": ("s", 60.0),
    "T_red": ("s", 60.0),
    "V_lmax": ("m/s", 100.0),
    "k_omax": ("m/s", 100.0),
    "k_lmax": ("m/s", 100.0),
    "C_dC": ("m", 100.0),
    "d_C_sm": ("m", 100.0),
    "deadline": ("s", 10.0),
}


@dc.dataclass(kw_only=True)
class SsmConfig:
    """Settings of the safety law, by default those of the paper's Table.

    The names are the paper's symbols.
    """

    # Which distances watch the robot: "vo" uses the relative directed speed
    # of robot and person, "vr" that of the robot alone, "sm" none (fixed
    # distances).
    configuration: str = "vo"

    # True follows the paper literally: distances that may fall below each
    # other and below C_dC when the gap opens, the normal state tested first,
    # and a speed fraction that may still rise after the decision to stop. For
    # comparison only.
    literal: bool = False

    # Time from normal speed to a standstill, s.
    T_stop: float = 0.4

    # Time from normal to reduced speed, s.
    T_red: float = 0.4

    # Reaction time of sensing and robot, s.
    T_R: float = 0.1

    # Greatest speed of the robot, m/s.
    V_lmax: float = 1.7

    # Greatest relative directed speed, m/s (k_max of "vo"): V_lmax plus a
    # person walking at 1.6 m/s.
    k_omax: float = 3.3

    # Greatest directed speed of the robot alone, m/s (k_max of "vr"). The
    # paper's text has V_lmax, its Table 3.3.
    k_lmax: float = 1.7

    # Cushioning constant, m: intrusion distance and the uncertainties of the
    # positions of person and robot.
    C_dC: float = 0.3

    # Least braking distance, m.
    B_min: float = 0.2

    # Critical distance of "sm", m.
    d_C_sm: float = 0.5

    # Reduced distance of "sm", m.
    d_R_sm: float = 1.1

    # Weight of a new sample in the filter when the index falls, in (0, 1].
    alpha_I: float = 0.3

    # The same when it rises without being critical.
    alpha_D: float = 0.8

    # Age of a sample above which its link counts as unwatched and the robot
    # stops, s. *Assumed*: T_R, because the distances do not allow for older
    # samples; it is also three 24 ms periods of a ring plus its latency of
    # 24 ms. For rings with a period of 37 ms use 0.135.
    deadline: float = 0.1

    # Speed fraction of the reduced state, in (0, 1).
    rho_reduced: float = 0.5

    # Greatest rate of the speed fraction, 1/s. *Assumed*: with the next one
    # it gives a stop within T_stop and the paper's braking distance.
    rho_max_rate: float = 10.0 / 3.0

    # Greatest acceleration of the speed fraction, 1/s^2. *Assumed*.
    rho_max_acceleration: float = 100.0 / 3.0

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is valid.

        Args:
            where: Name of these settings in the user's input.
        """
        require(
            self.configuration in CONFIGURATIONS,
            f"{where}.configuration: {self.configuration!r} is unknown, use "
            f"one of {', '.join(CONFIGURATIONS)}",
        )
        for name, (unit, most) in _MOST.items():
            value = getattr(self, name)
            require(
                0.0 < value <= most,
                f"{where}.{name}: {value!r} must be greater than 0 and at most "
                f"{most:g} {unit}",
            )
        for name, unit, most in (("T_R", "s", 10.0), ("B_min", "m", 100.0)):
            value = getattr(self, name)
            require(
                0.0 <= value <= most,
                f"{where}.{name}: {value!r} must be at least 0 and at most "
                f"{most:g} {unit}",
            )
        require(
            self.d_C_sm <= self.d_R_sm <= 100.0,
            f"{where}.d_R_sm: {self.d_R_sm!r} must be at least d_C_sm "
            f"({self.d_C_sm!r}) and at most 100 m",
        )
        check_range(where, "rho_max_rate", self.rho_max_rate, *RATES)
        check_range(
            where,
            "rho_max_acceleration",
            self.rho_max_acceleration,
            *ACCELERATIONS,
        )
        for name in ("alpha_I", "alpha_D"):
            value = getattr(self, name)
            require(
                0.0 < value <= 1.0,
                f"{where}.{name}: {value!r} must be above 0 and at most 1",
            )
        require(
            0.0 < self.rho_reduced < 1.0,
            f"{where}.rho_reduced: {self.rho_reduced!r} must be between 0 "
            "and 1",
        )

    def grow(self, offset: float) -> "SsmConfig":
        """Returns the settings of a link that is measured from farther away.

        The constant distances are greater by the offset. For distances that a
        lidar measures from the axis of the robot's base, the paper's Table
        adds the radius of the workspace, 0.82 m: `C_dC = 1.12`,
        `d_C_sm = 1.32`, `d_R_sm = 1.92`.

        Args:
            offset: Between the point that is measured from and the centre of
                an ordinary link, m.
        """
        if offset == 0.0:
            return self
        # Exact in decimals: 0.3 + 0.82 is 1.12.
        return dc.replace(
            self,
            **{
                name: round(getattr(self, name) + offset, 12)
                for name in ("C_dC", "d_C_sm", "d_R_sm")
            },
        )

    def k_max(self) -> float:
        """Returns the greatest directed speed of this configuration, m/s."""
        return self.k_omax if self.configuration == "vo" else self.k_lmax
