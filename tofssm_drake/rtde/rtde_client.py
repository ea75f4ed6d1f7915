"""RTDE client: reads whole packages and writes slider and heartbeat."""

from collections.abc import Callable
import contextlib
import dataclasses as dc
import functools
import math
import socket
import time

from tofssm_drake.robots.robot_client import LinkLostError, RobotClient
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.rtde.rtde_link import LinkEvent, RtdeLink
from tofssm_drake.rtde.rtde_protocol import RtdeError

# Bytes that may wait for the robot to read them.
_SEND_BUFFER = 4096


class RtdeClient(RobotClient):
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
        super().__init__(
            where=f"{config.host}:{config.port}",
            retry_first=config.retry_first,
            retry_last=config.retry_last,
        )

    @property
    def config(self) -> RtdeConfig:
        """A copy of the settings."""
        return dc.replace(self._config)

    def _write(self, link, command):
        """Writes a package; returns whether all of it was handed over."""
        package = link.inputs.encode(
            (command.mask, command.speed_fraction, command.heartbeat)
        )
        try:
            sent = link.writer.send(package)
        except OSError:
            sent = 0
        if sent != len(package):
            # The robot does not read, and half a package would garble all
            # that follow. The thread notices and reconnects.
            with contextlib.suppress(OSError):
                link.writer.shutdown(socket.SHUT_RDWR)
            return False
        self.record_package(time.monotonic(), True, package)
        return True

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
            except RtdeError as error:
                raise LinkLostError(f"{self._where}: {error}") from None
            finally:
                self._end_stream()
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
        write = None
        if link.inputs is not None:
            write = functools.partial(self._write, link)
        self._begin_stream(report, write)
        while True:
            self._publish(report)
            report = link.read_report(
                before=report, session=report.session, last=report.timestamp
            )

    # What the link calls.

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
