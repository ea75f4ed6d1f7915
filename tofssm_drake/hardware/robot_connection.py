"""What a connection to a robot is, and two that need no robot."""

import dataclasses as dc
import math
import threading
from typing import Protocol

from tofssm_drake.messages import RobotReport, SliderCommand


@dc.dataclass(frozen=True, kw_only=True)
class RtdeStatus:
    """How a connection is doing."""

    connected: bool = False
    """Packages stream in, and writing was granted if it was asked for."""
    problem: str = "not started"
    """Why not, in one line; empty while connected."""
    controller: tuple[int, ...] = ()
    """Its version: major, minor, bugfix, build."""
    frequency: float = math.nan
    """Packages per second that were asked for."""
    types: dict[str, str] = dc.field(default_factory=dict)
    """Fields that stream in, with the controller's types."""
    writes: bool = False
    """Whether the slider is ours."""
    connections: int = 0
    """How often packages began to stream."""
    packages: int = 0
    """Received and good."""
    missed: int = 0
    """Never came, by the robot's clock."""
    rejected: int = 0
    """Of a wrong size or recipe, or with values that cannot be."""
    repeated: int = 0
    """With the timestamp of the one before."""
    texts: int = 0
    """Text messages from the controller."""
    last_text: str = ""
    """The last of them."""


class RobotConnection(Protocol):
    """What systems and run loop need of a connection to a robot.

    `RtdeClient` is the real one; the two here are without any robot.
    """

    def get_report(self) -> RobotReport:
        """Returns the newest report; its sequence is -1 if there is none."""

    def wait_for_report(self, *, after: int, timeout: float) -> RobotReport:
        """Waits for a report newer than sequence `after`, at most that long.

        Returns:
            The newest report, which is not newer if the time is over.
        """

    def send(self, command: SliderCommand) -> bool:
        """Sends a command; returns whether it was handed over.

        That it was handed over does not mean that it arrives.
        """

    def get_status(self) -> RtdeStatus:
        """Returns how the connection is doing."""

    def close(self) -> None:
        """Ends the connection; harmless if it has ended."""


class LoopbackConnection:
    """Whoever holds it is the robot: for tests and for replays."""

    def __init__(self):
        self._condition = threading.Condition()
        self._report = RobotReport()
        self._closed = False
        self.sent: list[SliderCommand] = []
        """Every command that was sent, the oldest first."""

    def put(self, report: RobotReport) -> None:
        """Lets a report arrive."""
        with self._condition:
            self._report = report
            self._condition.notify_all()

    def get_report(self) -> RobotReport:
        """Returns the newest report; its sequence is -1 if there is none."""
        return self._report

    def wait_for_report(self, *, after: int, timeout: float) -> RobotReport:
        """Waits for a report newer than sequence `after`, at most that long.

        Returns:
            The newest report, which is not newer if the time is over.
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

    def get_status(self) -> RtdeStatus:
        """Returns how the connection is doing."""
        return RtdeStatus(
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
    """Nothing ever comes and nothing is ever sent."""

    def get_report(self) -> RobotReport:
        """Returns a report of sequence -1: there is none."""
        return RobotReport()

    def wait_for_report(self, *, after: int, timeout: float) -> RobotReport:
        """Returns at once what `get_report` returns."""
        return RobotReport()

    def send(self, command: SliderCommand) -> bool:
        """Drops a command and returns False."""
        return False

    def get_status(self) -> RtdeStatus:
        """Returns that there is no robot."""
        return RtdeStatus(problem="no robot")

    def close(self) -> None:
        """Does nothing."""
