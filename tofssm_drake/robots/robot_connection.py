"""The interface of a robot connection, and two that need no robot."""

import dataclasses as dc
import math
import threading
from typing import Protocol

from tofssm_drake.messages import RobotReport, SliderCommand


@dc.dataclass(frozen=True, kw_only=True)
class RobotStatus:
    """How a connection is doing."""

    connected: bool = False
    """Packages stream in, and writing was granted if requested."""
    problem: str = "not started"
    """Why not, in one line; empty while connected."""
    controller: tuple[int, ...] = ()
    """Its version: major, minor, bugfix, build."""
    frequency: float = math.nan
    """Requested packages per second."""
    types: dict[str, str] = dc.field(default_factory=dict)
    """Received fields, with the controller's types."""
    writes: bool = False
    """Whether the slider is ours."""
    connections: int = 0
    """How often a stream of packages began."""
    packages: int = 0
    """Received and good."""
    missed: int = 0
    """Missing, by the robot's clock."""
    rejected: int = 0
    """Of a wrong size or recipe, or with impossible values."""
    repeated: int = 0
    """With the previous one's timestamp."""
    texts: int = 0
    """Text messages from the controller."""
    last_text: str = ""
    """The last of them."""


class RobotConnection(Protocol):
    """What systems and run loop need from a connection to a robot.

    `RtdeClient` is the real one; the two here work without a robot.
    """

    def get_report(self) -> RobotReport:
        """Returns the newest report; its sequence is -1 if there is none."""

    def wait_for_report(self, *, after: int, timeout: float) -> RobotReport:
        """Waits for a report newer than sequence `after`, at most that long.

        Returns:
            The newest report, which is not newer after a timeout.
        """

    def send(self, command: SliderCommand) -> bool:
        """Sends a command; returns whether it was handed over.

        A command that was handed over may still not arrive.
        """

    def get_status(self) -> RobotStatus:
        """Returns how the connection is doing."""

    def close(self) -> None:
        """Ends the connection; harmless if it has ended."""


class LoopbackConnection:
    """Its holder plays the robot: for tests and replays."""

    def __init__(self):
        self._condition = threading.Condition()
        self._report = RobotReport()
        self._closed = False
        self.sent: list[SliderCommand] = []
        """Every command that was sent, oldest first."""

    def put(self, report: RobotReport) -> None:
        """Delivers a report."""
        with self._condition:
            self._report = report
            self._condition.notify_all()

    def get_report(self) -> RobotReport:
        """Returns the newest report; its sequence is -1 if there is none."""
        return self._report

    def wait_for_report(self, *, after: int, timeout: float) -> RobotReport:
        """Waits for a report newer than sequence `after`, at most that long.

        Returns:
            The newest report, which is not newer after a timeout.
        """
        with self._condition:
            self._condition.wait_for(
                lambda: self._report.sequence > after or self._closed, timeout
            )
            return self._report

    def send(self, command: SliderCommand) -> bool:
        """Keeps a command; returns whether the connection is open."""
        if not self._closed:
            self.sent.append(command)
        return not self._closed

    def get_status(self) -> RobotStatus:
        """Returns how the connection is doing."""
        return RobotStatus(
            connected=not self._closed and self._report.sequence >= 0,
            problem="closed" if self._closed else "",
            writes=not self._closed,
            missed=self._report.missed,
        )

    def close(self) -> None:
        """Ends the connection; harmless if it has ended."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()


class NullConnection:
    """Receives nothing and sends nothing."""

    def get_report(self) -> RobotReport:
        """Returns an empty report, of sequence -1."""
        return RobotReport()

    def wait_for_report(self, *, after: int, timeout: float) -> RobotReport:
        """Returns at once what `get_report` returns."""
        return RobotReport()

    def send(self, command: SliderCommand) -> bool:
        """Drops a command and returns False."""
        return False

    def get_status(self) -> RobotStatus:
        """Returns that there is no robot."""
        return RobotStatus(problem="no robot")

    def close(self) -> None:
        """Does nothing."""
