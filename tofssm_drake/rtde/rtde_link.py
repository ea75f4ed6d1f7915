"""One RTDE connection: handshake, stream of reports, farewell."""

import contextlib
import enum
import math
import socket
import time
from typing import Protocol

from tofssm_drake.messages import RobotReport
from tofssm_drake.robots.robot_client import FAREWELL, LinkLostError
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.rtde.rtde_fields import (
    ECHOED_TYPES,
    INPUT_TYPES,
    OUTPUT_TYPES,
)
import tofssm_drake.rtde.rtde_protocol as rtde
from tofssm_drake.rtde.rtde_protocol import PackageType, RtdeError
from tofssm_drake.rtde.rtde_report import (
    REQUIRED,
    REQUIRED_LENIENT,
    ReportMaker,
    list_outputs,
)


class LinkEvent(enum.Enum):
    """What happens on a link besides reports."""

    TEXT = "text"
    """The controller sent a text."""
    REJECTED = "rejected"
    """A data package could not be used."""
    REPEATED = "repeated"
    """A data package had the previous one's time."""


class LinkOwner(Protocol):
    """What a link needs from its client."""

    def is_closed(self) -> bool:
        """Returns whether the connection is to end."""

    def record_package(self, time: float, is_sent: bool, package: bytes):
        """Takes a package that was sent or received."""

    def note(self, event: LinkEvent, text: str) -> None:
        """Takes note of an event."""


class RtdeLink:
    """One connection with a controller, from handshake to its end.

    Not thread-safe; only `writer` may be used by another thread.

    Args:
        config: How to talk.
        connection: Connected; the caller closes it.
        owner: Is notified of everything but reports.
    """

    def __init__(
        self,
        config: RtdeConfig,
        connection: socket.socket,
        owner: LinkOwner,
    ):
        self._owner = owner
        self._config = config
        self._where = f"{config.host}:{config.port}"
        self._connection = connection
        self.writer = connection.dup()
        """The same connection, non-blocking: for the control loop."""
        self.writer.setblocking(False)
        self.inputs: rtde.Recipe | None = None
        """What may be written; None: nothing."""
        self._reader = rtde.PackageReader()
        self._waiting: list[tuple[int, bytes]] = []
        # When the last bytes arrived, s.
        self._arrival = -math.inf
        # The deadline that had passed at the last check; NaN: none had.
        self._overdue = math.nan
        self._version = 1
        # Why the newest package was rejected.
        self._rejection = ""
        # Empty until they are agreed.
        self._outputs = rtde.Recipe((), (), 0)
        # When the next report must be there, s.
        self._report_deadline = math.inf

    def shake_hands(self) -> dict:
        """Agrees on version, outputs and inputs, and starts the stream.

        Returns:
            `controller`, `frequency` and `types`, as in `RobotStatus`.

        Raises:
            LinkLostError: The controller does not agree or does not answer.
            RtdeError: Its answer is not RTDE.
            OSError: The connection is broken.
        """
        kind = PackageType.REQUEST_PROTOCOL_VERSION
        if self._ask(kind, rtde.encode_version_request(2), accepted=True):
            self._version = 2
        elif not self._ask(kind, rtde.encode_version_request(1), accepted=True):
            raise LinkLostError(
                "the controller speaks neither RTDE version 2 nor 1"
            )
        controller = rtde.decode_controller_version(
            self._ask(
                PackageType.GET_URCONTROL_VERSION,
                rtde.encode_package(PackageType.GET_URCONTROL_VERSION),
            )
        )
        frequency = self._config.frequency or (
            125 if controller[0] < 5 else 500
        )
        self._set_up_outputs(frequency)
        if self._config.write:
            self._set_up_inputs()
        # The stream may start before the answer arrives.
        self._make_report = ReportMaker(
            self._outputs,
            frequency=frequency,
            products_register=self._config.products_register,
            clock_jump=self._config.clock_jump,
        )
        if not self._ask(
            PackageType.START,
            rtde.encode_package(PackageType.START),
            accepted=True,
            or_data=True,
        ):
            raise LinkLostError("the controller refused to start the stream")
        # The first package may take as long as any answer.
        self._report_deadline = time.monotonic() + self._config.reply_timeout
        return {
            "controller": controller,
            "frequency": frequency,
            "types": dict(
                zip(self._outputs.names, self._outputs.types, strict=True)
            ),
        }

    def _set_up_outputs(self, frequency):
        config = self._config
        names = list_outputs(config.products_register)
        required = REQUIRED_LENIENT if config.lenient else REQUIRED
        known = OUTPUT_TYPES | ECHOED_TYPES
        while True:
            setup = rtde.decode_output_setup_reply(
                self._ask(
                    PackageType.SETUP_OUTPUTS,
                    rtde.encode_output_setup(
                        names, frequency=frequency, version=self._version
                    ),
                ),
                version=self._version,
            )
            types = setup.types
            if config.lenient and list(types) == names:
                types = tuple(known[name] for name in names)
            if len(types) != len(names):
                raise LinkLostError(
                    f"asked for {len(names)} outputs, {len(types)} answered"
                )
            missing = [
                name
                for name, kind in zip(names, types, strict=True)
                if kind == rtde.NOT_FOUND
            ]
            if not missing:
                break
            if required & set(missing):
                raise LinkLostError(
                    "the controller does not know the outputs "
                    + ", ".join(sorted(required & set(missing)))
                )
            names = [name for name in names if name not in missing]
        wrong = [
            f"{name} is {kind}"
            for name, kind in zip(names, types, strict=True)
            if kind != known[name]
        ]
        if wrong:
            raise LinkLostError("unexpected types: " + ", ".join(wrong))
        if setup.recipe_id == 0 and self._version >= 2 and not config.lenient:
            raise LinkLostError(
                f"the controller refused {frequency:g} Hz or the outputs"
            )
        self._outputs = rtde.Recipe(names, types, setup.recipe_id)

    def _set_up_inputs(self):
        names = [
            "speed_slider_mask",
            "speed_slider_fraction",
            f"input_int_register_{self._config.heartbeat_register}",
        ]
        setup = rtde.decode_input_setup_reply(
            self._ask(PackageType.SETUP_INPUTS, rtde.encode_input_setup(names))
        )
        types = setup.types
        expected = tuple(INPUT_TYPES[name] for name in names)
        if self._config.lenient and list(types) == names:
            types = expected
        answered = dict(zip(names, types, strict=False))
        used = [n for n, kind in answered.items() if kind == rtde.IN_USE]
        if used:
            raise LinkLostError(
                f"{', '.join(used)} in use: a fieldbus (EtherNet/IP, "
                "PROFINET, MODBUS), a URCap or another client has claimed it"
            )
        missing = [n for n, kind in answered.items() if kind == rtde.NOT_FOUND]
        if missing:
            raise LinkLostError(
                f"the controller does not know the inputs {', '.join(missing)}"
            )
        if types != expected:
            raise LinkLostError(
                f"unexpected types of inputs: {', '.join(types)}"
            )
        if setup.recipe_id == 0 and not self._config.lenient:
            raise LinkLostError("the controller refused the inputs")
        self.inputs = rtde.Recipe(names, types, setup.recipe_id)

    def _ask(self, kind, request, *, accepted=False, or_data=False):
        """Sends a request and returns the payload of its answer.

        Handles whatever else arrives in the meantime.

        Args:
            kind: Type of request and answer.
            request: The package.
            accepted: Return whether it was accepted, not the payload.
            or_data: A data package counts as acceptance too.
        """
        self._send(request)
        deadline = time.monotonic() + self._config.reply_timeout
        while True:
            while self._waiting:
                answer, payload = self._waiting.pop(0)
                if answer == kind:
                    return (
                        rtde.decode_accepted(payload) if accepted else payload
                    )
                if or_data and answer == PackageType.DATA_PACKAGE:
                    self._waiting.insert(0, (answer, payload))
                    return True
                self._take_note(answer, payload)
            self._receive(deadline, f"no answer to {kind.name}")

    def _send(self, package):
        self._connection.settimeout(self._config.reply_timeout)
        self._connection.sendall(package)
        self._owner.record_package(time.monotonic(), True, package)

    def _receive(self, deadline, otherwise):
        """Appends the next packages to the waiting ones."""
        remaining = deadline - time.monotonic()
        if self._owner.is_closed():
            raise LinkLostError("closed")
        is_over = remaining <= 0
        # This process may have been suspended: check once more.
        if is_over and self._overdue == deadline:
            raise LinkLostError(f"{self._where}: {otherwise}")
        self._overdue = deadline if is_over else math.nan
        try:
            self._reader.check()
        except RtdeError as error:
            raise LinkLostError(f"{self._where}: {error}") from None
        # Short enough to notice that the client was closed.
        self._connection.settimeout(min(max(remaining, 0.0), 0.25))
        try:
            data = self._connection.recv(1 << 16)
        except (TimeoutError, BlockingIOError):
            return
        self._arrival = time.monotonic()
        if not data:
            raise LinkLostError(f"{self._where}: the controller hung up")
        packages = self._reader.feed(data)
        for kind, payload in packages:
            package = rtde.encode_package(kind, payload)
            self._owner.record_package(self._arrival, False, package)
        self._waiting.extend(packages)

    def _take_note(self, kind, payload):
        """Handles what was not asked for."""
        if kind != PackageType.TEXT_MESSAGE:
            return
        try:
            message = rtde.decode_text(payload, version=self._version)
            text = f"{message.source}: {message.text}".strip(": ")
        except RtdeError as error:
            text = str(error)
        self._owner.note(LinkEvent.TEXT, text)

    def read_report(
        self, *, before: RobotReport, session: int, last: float
    ) -> RobotReport:
        """Waits for the next report.

        Args:
            before: The previous report, maybe of another connection.
            session: Of the new report, unless the robot's clock restarts.
            last: Timestamp of the stream's last package, s; NaN: none yet.

        Raises:
            LinkLostError: The stream ended or was silent for too long.
            OSError: The connection is broken.
        """
        while True:
            while self._waiting:
                kind, payload = self._waiting.pop(0)
                if kind != PackageType.DATA_PACKAGE:
                    self._take_note(kind, payload)
                    continue
                report = self._decode(payload, before, session, last)
                if report is not None:
                    self._report_deadline = (
                        self._arrival + self._config.stream_timeout
                    )
                    return report
            self._receive(
                self._report_deadline,
                f"no package for {self._config.stream_timeout:g} s"
                f"{self._rejection}",
            )

    def _decode(self, payload, before, session, last):
        """Returns the report of a data package; None if unusable."""
        try:
            flat = self._outputs.decode_flat(
                payload, version=self._version, any_id=self._config.lenient
            )
            report = self._make_report(
                flat,
                before=before,
                time=self._arrival,
                last=last,
                session=session,
            )
        except RtdeError as error:
            text = f"data are rejected: {error}"
            self._rejection = f"; {text}"
            self._owner.note(LinkEvent.REJECTED, text)
            return None
        self._rejection = ""
        if report.timestamp == last:
            self._owner.note(LinkEvent.REPEATED, "")
            return None
        return report

    def say_goodbye(self):
        """Asks the controller to stop streaming, and reads what is left.

        With unread bytes, closing would reset the connection, and the
        controller might not read what was sent last.
        """
        deadline = time.monotonic() + FAREWELL
        # The connection may be gone already.
        with contextlib.suppress(OSError):
            self._send(rtde.encode_package(PackageType.PAUSE))
            self._connection.shutdown(socket.SHUT_WR)
            self._connection.settimeout(FAREWELL)
            while time.monotonic() < deadline:
                if not self._connection.recv(1 << 16):
                    return

    def close(self):
        """Gives up the connection."""
        self.writer.close()
