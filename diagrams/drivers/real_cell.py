"""What every driver of a real cell has: rings, and how its robot is watched."""

import abc
import dataclasses as dc

import numpy as np

from tofssm_drake.errors import require
from tofssm_drake.ringlink.ring_address import (
    SerialAddress,
    UdpAddress,
    parse_ring_address,
    require_distinct,
)
from tofssm_drake.ringlink.ring_receiver import RingLinkConfig
from tofssm_drake.robots.driver import DriverTraits, ProgressReport, Tap
from tofssm_drake.robots.robot_connection import RobotConnection
from tofssm_drake.rtde.robot_checks import RobotChecks
from tofssm_drake.rtde.slider import SliderSettings
from tofssm_drake.tasks.path import ProgramPath

VIRTUAL = "virtual"
"""In place of addresses: the rings are simulated around the real robot."""


@dc.dataclass(kw_only=True)
class RealCell(abc.ABC):
    """Settings of a cell for `tofssm hardware`, whatever its robot's brand.

    A kind of driver is derived from it and adds what `Driver`
    (`tofssm_drake/robots/driver.py`) has, and its own settings.
    """

    # The robot must start this close to the task's path, rad.
    max_deviation: float = 0.5

    # How the speed slider is used.
    slider: SliderSettings = dc.field(default_factory=SliderSettings)

    # What the robot is checked for.
    checks: RobotChecks = dc.field(default_factory=RobotChecks)

    # Where the rings' frames come from: udp://ADDRESS:PORT,
    # serial:///dev/NAME; or virtual alone, which simulates the rings around
    # the robot.
    rings: list[str] = dc.field(default_factory=list)

    # Let an address of `rings` listen on every interface (0.0.0.0).
    allow_remote: bool = False

    # How the rings' frames are received.
    ring_link: RingLinkConfig = dc.field(default_factory=RingLinkConfig)

    @property
    def writes(self) -> bool:
        """Whether the settings allow to write to the robot."""
        return True

    @property
    @abc.abstractmethod
    def traits(self) -> DriverTraits:
        """See `Driver`."""

    @abc.abstractmethod
    def open(
        self, *, write: bool = True, tap: Tap | None = None
    ) -> RobotConnection:
        """See `Driver`."""

    @abc.abstractmethod
    def find_carried_objects(
        self, report: ProgressReport, path: ProgramPath
    ) -> np.ndarray:
        """See `Driver`."""

    @property
    def is_virtual(self) -> bool:
        """Whether the rings are simulated."""
        return self.rings == [VIRTUAL]

    def parse_rings(self, where: str) -> tuple[UdpAddress | SerialAddress, ...]:
        """Returns the addresses of the rings; none if they are simulated.

        Args:
            where: What the user calls them, for the message.

        Raises:
            UserError: One is wrong, or two are the same.
        """
        if self.is_virtual:
            return ()
        addresses = tuple(
            parse_ring_address(
                text, where=where, allow_remote=self.allow_remote
            )
            for text in self.rings
        )
        require_distinct(addresses, where)
        return addresses

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        self.slider.check(f"{where}.slider")
        self.checks.check(f"{where}.checks")
        self.ring_link.check(f"{where}.ring_link")
        require(
            0.0 < self.max_deviation <= 10.0,
            f"{where}.max_deviation: must be more than 0 and at most 10 rad, "
            f"got {self.max_deviation:g}",
        )
        # Addresses are those of the computer at the cell, so not parsed here.
        self.check_rings(f"{where}.rings")

    def check_rings(self, where: str) -> None:
        """Raises UserError if real and simulated rings are mixed."""
        require(
            self.is_virtual or VIRTUAL not in self.rings,
            f"{where}: {VIRTUAL} stands alone, got {', '.join(self.rings)}",
        )
