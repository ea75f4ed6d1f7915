"""A connection to a robot from a small link of one's own."""

from collections.abc import Callable
import dataclasses as dc
import math
import time
from typing import Protocol

from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.robots.robot_client import LinkLostError, RobotClient

# How much the robot's clock may gain on the host's from one report to the
# next, s: more is a new session.
_LEAP = 0.25


class RobotLink(Protocol):
    """One connection with a controller, already open."""

    @property
    def frequency(self) -> float:
        """Reports per second."""

    def read(self) -> RobotReport:
        """Waits for the next report.

        `timestamp`, `position` and `velocity` must be numbers; `sequence`,
        `session`, `missed` and `time` are filled in by `LinkClient`.

        Raises:
            OSError: It hung up, or was silent for too long (0.1 s, say).
            ValueError: What it sent cannot be understood.
        """

    def write(self, command: SliderCommand) -> None:
        """Sends a command; is called by another thread than `read`.

        Raises:
            OSError: It could not be sent at once.
        """

    def close(self) -> None:
        """Ends the connection."""


class LinkClient(RobotClient):
    """Keeps a link open, numbers its reports and leaves the robot at 0.

    A link that raises is closed and opened again. Each connection, and each
    jump of the robot's clock, is a new session. A report that repeats the last
    timestamp is dropped.

    Args:
        open_link: Connects and returns the link; raises OSError if it cannot.
        where: Address of the robot, for messages.
        write: Whether commands may be sent.
    """

    def __init__(
        self,
        open_link: Callable[[], RobotLink],
        *,
        where: str,
        write: bool = True,
    ):
        self._open_link = open_link
        self._write_allowed = write
        super().__init__(where=where, retry_first=0.1, retry_last=2.0)

    def _serve_connection(self):
        link = self._open_link()
        try:
            self._update(frequency=link.frequency)
            self._read_stream(link)
        except ValueError as error:
            raise LinkLostError(f"{self._where}: {error}") from None
        finally:
            self._end_stream()
            link.close()

    def _read_stream(self, link):
        """Publishes each report, until the link is lost."""
        session, last = self._report.session + 1, math.nan
        while True:
            report = self._number(link, link.read(), session, last)
            if self.is_closed():
                return
            if report.timestamp == last:
                continue
            if math.isnan(last):
                write = self._make_writer(link) if self._write_allowed else None
                self._begin_stream(report, write)
            elif self._write_allowed and self._writer is None:
                raise LinkLostError(f"{self._where}: it takes no commands")
            session, last = report.session, report.timestamp
            self._publish(report)

    def _number(self, link, report, session, last):
        """Returns a report with numbers and its time of arrival."""
        # A sum is finite only if all its numbers are.
        numbers = sum(report.position) + sum(report.velocity)
        if not math.isfinite(numbers + report.timestamp):
            raise ValueError("a joint or the time is not a number")
        before, now = self._report, time.monotonic()
        step, missed = report.timestamp - last, before.missed
        # All false for the first report: its step is NaN.
        if step < 0 or step - (now - before.time) > _LEAP:
            session += 1
        elif step > 0:
            missed += max(round(step * link.frequency) - 1, 0)
        return dc.replace(
            report,
            sequence=before.sequence + 1,
            session=session,
            missed=missed,
            time=now,
        )

    def _make_writer(self, link):
        def write(command):
            try:
                link.write(command)
            except OSError:
                return False
            return True

        return write
