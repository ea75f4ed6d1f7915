"""What the monitor needs of a brand's driver."""

from collections.abc import Callable
import dataclasses as dc
from typing import Protocol

import numpy as np

from tofssm_drake.robots.robot_connection import RobotConnection
from tofssm_drake.tasks.path import ProgramPath

Tap = Callable[[float, bool, bytes], None]
"""Takes (host's monotonic time, s; whether it was sent; bytes) of each package
for the record; returns at once and never raises."""


@dc.dataclass(frozen=True, kw_only=True)
class DriverTraits:
    """What a driver says of its brand."""

    name: str
    """In messages, e.g. RTDE."""
    joints: int | None = None
    """Joints of its arms; None: any number."""
    has_echo: bool = True
    """Whether the robot reports its speed fraction. If it does, a report
    without it is a fault. If not, only the measured joint speeds show whether
    it obeys, and a person cannot lower the fraction at the robot."""


class ProgressReport(Protocol):
    """What a robot reports of its program; `RobotReport` is one."""

    @property
    def digital_outputs(self) -> int:
        """Bits, or -1."""

    @property
    def products_placed(self) -> int:
        """Number, or -1."""


class Driver(Protocol):
    """Any brand of robot, as `!Rtde` and what `!CustomDriver` loads.

    A wrong robot is told by `tcp_pose` of the reports, which is compared with
    the model at the reported joints; a robot that does not report it is refused
    unless the user allows it (`--allow-no-pose`).
    """

    @property
    def traits(self) -> DriverTraits:
        """What others need to know of it."""

    def open(
        self, *, write: bool = True, tap: Tap | None = None
    ) -> RobotConnection:
        """Connects to the robot, in a thread of its own, and returns at once.

        Closing the connection sets the speed fraction to 0 and waits briefly
        until that is seen.

        Args:
            write: Whether commands may be sent; if not, nothing is written.
            tap: Takes the bytes for the record.
        """

    def find_carried_objects(
        self, report: ProgressReport, path: ProgramPath
    ) -> np.ndarray:
        """Returns where the task's objects are, by what the robot reports.

        A pure function: it is asked again in a replay.

        Args:
            report: The robot's.
            path: Of the robot's program.

        Returns:
            Place of each object, or ON_TOOL, (p,).
        """


def read_carried_objects(
    report: ProgressReport, path: ProgramPath, *, gripper_closed: bool = False
) -> np.ndarray:
    """Returns where the objects are, by number of products and gripper.

    Args:
        report: The robot's; -1 products count as none.
        path: Of the robot's program.
        gripper_closed: If that is not reported, False: what the gripper holds
            is then an obstacle.

    Returns:
        Place of each object, or ON_TOOL, (p,).
    """
    return path.find_carried_objects(
        products_placed=max(report.products_placed, 0),
        gripper_closed=gripper_closed,
    )
