"""What drives an arm: one file for each kind.

To add a kind of real robot, write its file, and name it in `ArmDriver`.
"""

from tofssm_drake.arms.sim_arm import Simulated
from tofssm_drake.diagrams.drivers.custom_driver import CustomDriver
from tofssm_drake.diagrams.drivers.real_cell import RealCell
from tofssm_drake.diagrams.drivers.rtde import Rtde

__all__ = [
    "ArmDriver",
    "CustomDriver",
    "RealCell",
    "Rtde",
    "Simulated",
    "find_real_cell",
]

ArmDriver = Simulated | Rtde | CustomDriver


def find_real_cell(driver: ArmDriver) -> Rtde | CustomDriver:
    """Returns the settings of the real cell; RTDE's if it is simulated."""
    return Rtde() if isinstance(driver, Simulated) else driver
