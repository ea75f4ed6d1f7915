"""The driver of a UR robot, over RTDE."""

import dataclasses as dc
from typing import ClassVar

import numpy as np

from tofssm_drake.diagrams.drivers.real_cell import RealCell
from tofssm_drake.errors import require
from tofssm_drake.messages import RTDE_JOINTS
from tofssm_drake.robots.driver import (
    DriverTraits,
    ProgressReport,
    Tap,
    read_carried_objects,
)
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.tasks.path import ProgramPath


@dc.dataclass(kw_only=True)
class Rtde(RealCell):
    """A UR robot, or a simulated one, and rings; see `Driver`."""

    # The robot's controller: host, port, registers, times.
    robot: RtdeConfig = dc.field(default_factory=RtdeConfig)

    # Digital output that closes the gripper: 0-7 standard, 8-15 configurable,
    # 16-17 tool.
    gripper_output: int = 0

    traits: ClassVar[DriverTraits] = DriverTraits(
        name="RTDE", joints=RTDE_JOINTS
    )

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        self.robot.check(f"{where}.robot")
        require(
            0 <= self.gripper_output <= 17,
            f"{where}.gripper_output: must be from 0 to 17, got "
            f"{self.gripper_output}",
        )
        super().check(where)

    @property
    def writes(self) -> bool:
        """Whether the settings allow to write to the robot."""
        return self.robot.write

    def open(self, *, write: bool = True, tap: Tap | None = None) -> RtdeClient:
        """Connects to the controller, see `Driver`."""
        robot = dc.replace(self.robot, write=write and self.robot.write)
        return RtdeClient(robot, tap=tap)

    def find_carried_objects(
        self, report: ProgressReport, path: ProgramPath
    ) -> np.ndarray:
        """Returns each object's place, from gripper and products' register.

        An output that is not reported counts as open: what the gripper holds
        is then an obstacle.
        """
        bits = max(report.digital_outputs, 0)
        return read_carried_objects(
            report,
            path,
            gripper_closed=bool(bits >> self.gripper_output & 1),
        )
