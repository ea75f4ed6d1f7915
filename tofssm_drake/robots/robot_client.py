"""What every connection to a robot has in common.

Reading and callers never wait for each other: a thread makes one frozen
`RobotReport` per package, with its time of arrival, and replaces the previous
one. When the robot falls silent or hangs up, the thread reconnects at growing
intervals, until it is closed. The thread raises nothing: `get_status` says
what is wrong.
"""

import abc
from collections.abc import Callable
import dataclasses as dc
import math
import threading
import time
from typing import Self

from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.robots.robot_connection import RobotStatus

FAREWELL = 0.2
"""How long each part of closing may take, s."""

# How long closing waits for a robot whose connection was just lost, in order
# to stop it, s.
_RETURN = 0.5
# The speed fraction is 0 if its echo is below this.
_AT_ZERO = 0.005


class LinkLostError(Exception):
    """The connection cannot be used any more, and why."""


class RobotClient(abc.ABC):
    """Talks to a robot until it is closed; a brand's client is derived from it.

    A context manager. It starts to connect at once, in its own thread.

    The derived class has `_serve_connection`, which runs in the thread: it
    connects, calls `_begin_stream` with the first report and `_publish` with
    each, `_end_stream` at the end, and raises what went wrong.

    Args:
        where: Address of the robot, for messages.
        retry_first: Pause before the second attempt to connect, s; doubles.
        retry_last: Longest pause, s.
    """

    def __init__(self, *, where: str, retry_first: float, retry_last: float):
        self._where = where
        self._retry_first = retry_first
        self._retry_last = retry_last
        self._condition = threading.Condition()
        self._report = RobotReport()
        self._status = RobotStatus(problem="connecting")
        # Counted separately: a new status for each package would cost more than
        # the package.
        self._packages = 0
        self._closed = threading.Event()
        self._send_lock = threading.Lock()
        # What writes a command, and the connection's first report, while
        # writing is possible.
        self._writer: tuple[Callable[[SliderCommand], bool], int] | None = None
        self._heartbeat = 0
        self._thread = threading.Thread(
            target=self._run, name="robot_reader", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_) -> None:
        self.close()

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
                lambda: self._report.sequence > after or self._closed.is_set(),
                timeout,
            )
            return self._report

    def send(self, command: SliderCommand) -> bool:
        """Sends a command.

        Returns:
            Whether it was handed to the system. Only the echo says whether the
            robot got it. False without a connection, if nothing may be
            written, or if the command answers no report or one from before the
            connection: the robot may have restarted.
        """
        if command.sequence < 0:
            return False
        if not math.isfinite(command.speed_fraction):
            raise ValueError("speed_fraction: not a number")
        with self._send_lock:
            if self._writer is None:
                return False
            write, first = self._writer
            if command.sequence < first:
                return False
            if not write(command):
                self._writer = None
                return False
            self._heartbeat = command.heartbeat
        return True

    def get_status(self) -> RobotStatus:
        """Returns how the connection is doing."""
        return dc.replace(
            self._status, packages=self._packages, missed=self._report.missed
        )

    def close(self) -> None:
        """Stops the robot if its slider is ours, and ends the connection."""
        self._leave_stopped()
        self._closed.set()
        with self._condition:
            self._condition.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def is_closed(self) -> bool:
        """Returns whether the connection is to end."""
        return self._closed.is_set()

    def _leave_stopped(self):
        """Sets the slider to 0 and waits briefly until the echo shows it."""
        wait = _RETURN if self._writer is None else FAREWELL
        deadline = time.monotonic() + wait
        while (
            self._status.writes
            and not self._closed.is_set()
            and time.monotonic() < deadline
        ):
            report = self._report
            was_sent = self.send(
                SliderCommand(
                    sequence=report.sequence, mask=1, heartbeat=self._heartbeat
                )
            )
            report = self.wait_for_report(
                after=report.sequence, timeout=FAREWELL / 4
            )
            if was_sent and report.target_speed_fraction < _AT_ZERO:
                return

    # What follows runs in the thread.

    @abc.abstractmethod
    def _serve_connection(self):
        """Connects and reads until something goes wrong, and raises that."""

    def _run(self):
        pause = self._retry_first
        while not self._closed.is_set():
            connections = self._status.connections
            try:
                self._serve_connection()
            except LinkLostError as problem:
                self._update(connected=False, problem=str(problem))
            except OSError as error:
                self._update(
                    connected=False,
                    problem=f"{self._where}: {error.strerror or error}",
                )
            except Exception as error:  # The thread must go on.
                self._update(connected=False, problem=f"{error!r}")
            if self._status.connections > connections:
                pause = self._retry_first
            self._closed.wait(pause)
            pause = min(2 * pause, self._retry_last)
        self._update(connected=False, problem="closed")

    def _update(self, **changes):
        self._status = dc.replace(self._status, **changes)

    def _begin_stream(self, report, write):
        """Says that a connection works, and lets commands through.

        Args:
            report: The connection's first.
            write: Takes a `SliderCommand` and returns whether it was handed to
                the system; None: nothing is written.
        """
        if write is not None:
            with self._send_lock:
                self._writer = (write, report.sequence)
        self._update(
            connected=True,
            problem="",
            writes=write is not None,
            connections=self._status.connections + 1,
        )

    def _end_stream(self):
        """Lets no more commands through."""
        with self._send_lock:
            self._writer = None

    def _publish(self, report):
        """Shows a report."""
        self._packages += 1
        with self._condition:
            self._report = report
            self._condition.notify_all()
