"""The robot arm: model, kinematics, simulated controller."""

from tofssm_drake.arms.arm import Arm, ArmModel
from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.limits import ArmLimits
from tofssm_drake.arms.sim_arm import Simulated, make_sim_arm
from tofssm_drake.arms.ur_arm import UrArm

__all__ = [
    "Arm",
    "ArmKinematics",
    "ArmLimits",
    "ArmModel",
    "Simulated",
    "UrArm",
    "make_cell_plant",
    "make_sim_arm",
]
