"""From a separation to a speed fraction: the safety law."""

from tofssm_drake.laws.custom_law import Custom
from tofssm_drake.laws.law import Law, LawTraits
from tofssm_drake.laws.speed_fraction import SpeedFractionTrajectory, SpeedRamp
from tofssm_drake.laws.tri_ssm_law import TriSsm

__all__ = [
    "Custom",
    "Law",
    "LawTraits",
    "SpeedFractionTrajectory",
    "SpeedRamp",
    "TriSsm",
]
