"""RTDE client: a thread that reads whole packages and keeps the newest.

Reading and callers never wait for each other: the thread makes one frozen
`RobotReport` per package, with its time of arrival, and replaces the previous
one. When the robot falls silent or hangs up, the thread reconnects with the
full handshake, at growing intervals, until it is closed. The thread raises
nothing: `get_status` says what is wrong.
"""

from collections.abc import Callable
import contextlib
import dataclasses as dc
import math
import socket
import threading
import time

from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.rtde.robot_connection import RtdeStatus
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.rtde.rtde_link import (
    FAREWELL,
    LinkEvent,
    LinkLostError,
    RtdeLink,
)
from tofssm_drake.rtde.rtde_protocol import Recipe, RtdeError

# Bytes that may wait for the robot to read them.
_SEND_BUFFER = 4096
# How long closing waits for a robot whose connection was just lost, in order
# to stop it, s.
_RETURN = 0.5


class RtdeClient:
    """Talks to a robot's controller until it is closed.

    A context manager: `with RtdeClient(config) as client`. It starts to
    connect at once, in its own thread.

    Args:
        config: Settings; checked.
        tap: Called with (time on the host's monotonic clock, whether it was
            sent, bytes of the package with its header) for everything that
            is received and sent, in the thread that does it; must return at
            once and never raise.

    Raises:
        UserError: A setting is out of range.
    """

    def __init__(
        self,
        config: RtdeConfig,
        *,
        tap: Callable[[float, bool, bytes], None] | None = None,
    ):
        config.check("robot")
        self._config = dc.replace(config)
        self._tap = tap
        self._condition = threading.Condition()
        self._report = RobotReport()
        self._status = RtdeStatus(problem="connecting")
        # Counted separately: a new status for each package would cost more than
        # the package.
        self._packages = 0
        self._closed = threading.Event()
        self._send_lock = threading.Lock()
        # Socket, input recipe and the connection's first report, while
        # writing is possible.
        self._writer: tuple[socket.socket, Recipe, int] | None = None
        self._heartbeat = 0
        self._thread = threading.Thread(
            target=self._run, name="rtde_reader", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> "RtdeClient":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    @property
    def config(self) -> RtdeConfig:
        """A copy of the settings."""
        return dc.replace(self._config)

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
        """Sends slider and heartbeat in one package.

        Returns:
            Whether the package was handed to the system. Only the slider's
            echo says whether the robot got it. False without a connection,
            without `write`, or if the command answers no report or one from
            before the connection: the robot may have restarted.
        """
        if command.sequence < 0:
            return False
        if not math.isfinite(command.speed_fraction):
            raise ValueError("speed_fraction: not a number")
        with self._send_lock:
            if self._writer is None:
                return False
            connection, recipe, first = self._writer
            if command.sequence < first:
                return False
            package = recipe.encode(
                (command.mask, command.speed_fraction, command.heartbeat)
            )
            try:
                sent = connection.send(package)
            except OSError:
                sent = 0
            if sent != len(package):
                # The robot does not read, and half a package would garble
                # all that follow. The thread notices and reconnects.
                self._writer = None
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                return False
            self._heartbeat = command.heartbeat
        self.record_package(time.monotonic(), True, package)
        return True

    def get_status(self) -> RtdeStatus:
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
            if was_sent and report.target_speed_fraction < 0.005:
                return

    # What follows runs in the thread.

    def _run(self):
        pause = self._config.retry_first
        while not self._closed.is_set():
            connections = self._status.connections
            try:
                self._serve_connection()
            except LinkLostError as problem:
                self._update(connected=False, problem=str(problem))
            except RtdeError as error:
                self._update(connected=False, problem=f"{self._where}: {error}")
            except OSError as error:
                self._update(
                    connected=False,
                    problem=f"{self._where}: {error.strerror or error}",
                )
            except Exception as error:  # The thread must go on.
                self._update(connected=False, problem=f"{error!r}")
            if self._status.connections > connections:
                pause = self._config.retry_first
            self._closed.wait(pause)
            pause = min(2 * pause, self._config.retry_last)
        self._update(connected=False, problem="closed")

    @property
    def _where(self):
        return f"{self._config.host}:{self._config.port}"

    def _update(self, **changes):
        self._status = dc.replace(self._status, **changes)

    def _serve_connection(self):
        """Connects, shakes hands and reads until something goes wrong."""
        config = self._config
        with socket.create_connection(
            (config.host, config.port), config.connect_timeout
        ) as connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # A robot that does not read must be noticed soon.
            connection.setsockopt(
                socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER
            )
            link = RtdeLink(config, connection, self)
            try:
                self._update(**link.shake_hands())
                self._read_stream(link)
            finally:
                with self._send_lock:
                    self._writer = None
                if self._closed.is_set():
                    link.say_goodbye()
                link.close()

    def _read_stream(self, link):
        """Publishes each report, until the link is lost."""
        report = link.read_report(
            before=self._report,
            session=self._report.session + 1,
            last=math.nan,
        )
        self._begin(link, report)
        while True:
            self._packages += 1
            with self._condition:
                self._report = report
                self._condition.notify_all()
            report = link.read_report(
                before=report, session=report.session, last=report.timestamp
            )

    def _begin(self, link, report):
        """Lets commands through from the first report on."""
        if link.inputs is not None:
            with self._send_lock:
                self._writer = (link.writer, link.inputs, report.sequence)
        self._update(
            connected=True,
            problem="",
            writes=link.inputs is not None,
            connections=self._status.connections + 1,
        )

    # What the link calls.

    def is_closed(self) -> bool:
        """Returns whether the connection is to end."""
        return self._closed.is_set()

    def record_package(self, time: float, is_sent: bool, package: bytes):
        """Hands a package to the tap."""
        if self._tap is not None:
            self._tap(time, is_sent, package)

    def note(self, event: LinkEvent, text: str) -> None:
        """Counts what happened on the link."""
        status = self._status
        if event == LinkEvent.TEXT:
            self._update(texts=status.texts + 1, last_text=text)
        elif event == LinkEvent.REPEATED:
            self._update(repeated=status.repeated + 1)
        else:
            self._update(rejected=status.rejected + 1)
            if not status.connected:
                # Otherwise the problem would stay "connecting".
                self._update(problem=f"{self._where}; {text}")
