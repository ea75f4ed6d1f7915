"""RTDE client: a thread that reads whole packages and keeps the newest.

Reading never waits for anyone and nobody waits for reading: the thread makes
one frozen `RobotReport` per package, with the time at which it arrived, and
replaces the one before. When the robot falls silent or hangs up, the thread
connects anew with the full handshake, more and more slowly, until it is
closed. Nothing that goes wrong is raised from the thread: it is told by
`get_status`.
"""

from collections.abc import Callable
import contextlib
import dataclasses as dc
import math
import socket
import threading
import time

from tofssm_drake.errors import require
from tofssm_drake.hardware.robot_connection import RtdeStatus
from tofssm_drake.hardware.rtde_fields import (
    ECHOED_TYPES,
    INPUT_TYPES,
    OUTPUT_TYPES,
)
import tofssm_drake.hardware.rtde_protocol as rtde
from tofssm_drake.hardware.rtde_protocol import PackageType, RtdeError
from tofssm_drake.hardware.rtde_report import (
    REQUIRED,
    REQUIRED_LENIENT,
    ReportMaker,
    list_outputs,
)
from tofssm_drake.messages import RobotReport, SliderCommand

# Bytes that may wait for the robot to read them.
_SEND_BUFFER = 4096
# How long closing may take in all of its parts, s.
_FAREWELL = 0.2
# How long it waits for a robot that was just lost, to stop it, s.
_RETURN = 0.5


@dc.dataclass(kw_only=True)
class RtdeConfig:
    """Where the robot is and how to talk to it."""

    # Name or address of the robot's controller, and its RTDE port.
    host: str = "127.0.0.1"
    port: int = 30004

    # Packages per second; 0: as many as the controller makes (125 before
    # software 5, 500 from then on).
    frequency: float = 0.0

    # Claim speed slider and heartbeat. Without it nothing is ever written.
    write: bool = True

    # input_int_register of the heartbeat (24 to 47 are for external clients)
    # and output_int_register in which the robot's program counts products.
    heartbeat_register: int = 24
    products_register: int = 24

    # Put up with servers that answer a setup with names instead of types, or
    # number their packages otherwise than announced, or know few fields.
    lenient: bool = False

    # Longest time to connect and for each answer, s.
    connect_timeout: float = 2.0
    reply_timeout: float = 2.0

    # Without a package for that long the connection counts as lost, s.
    stream_timeout: float = 0.1

    # If the robot's clock goes back, or forth by more than that, s, a new
    # session begins; also if it gains 0.25 s on the host's at once.
    clock_jump: float = 1.0

    # Pause before the next try, s: doubles from the first to the last.
    retry_first: float = 0.1
    retry_last: float = 2.0

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        require(bool(self.host), f"{where}.host: must not be empty")
        require(
            1 <= self.port <= 65535,
            f"{where}.port: must be from 1 to 65535, got {self.port}",
        )
        require(
            self.frequency == 0 or 1 <= self.frequency <= 500,
            f"{where}.frequency: must be from 1 to 500 Hz or 0, "
            f"got {self.frequency:g}",
        )
        for name in ("heartbeat_register", "products_register"):
            require(
                0 <= getattr(self, name) <= 47,
                f"{where}.{name}: must be from 0 to 47, "
                f"got {getattr(self, name)}",
            )
        for name in (
            "connect_timeout",
            "reply_timeout",
            "stream_timeout",
            "clock_jump",
            "retry_first",
            "retry_last",
        ):
            require(
                0 < getattr(self, name) <= 60,
                f"{where}.{name}: must be more than 0 s and at most 60, "
                f"got {getattr(self, name):g}",
            )
        require(
            self.retry_first <= self.retry_last,
            f"{where}.retry_last: must not be less than retry_first, "
            f"{self.retry_first:g} s, got {self.retry_last:g}",
        )


class _LostError(Exception):
    """The connection can not be used any more, and why."""


class RtdeClient:
    """Talks to a robot's controller until it is closed.

    A context manager: `with RtdeClient(config) as client`. It starts to
    connect at once, in a thread of its own.

    Args:
        config: Settings; checked.
        tap: Called with (time on the host's monotonic clock, whether it was
            sent, bytes of the package with its header) for everything that
            is received and sent, from the thread that does it: must return
            at once and never raise.

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
        # Counted apart: a new status for each package costs more than it.
        self._packages = 0
        self._closed = threading.Event()
        self._send_lock = threading.Lock()
        # Socket, input recipe and the connection's first report, while
        # writing is possible.
        self._writer: tuple[socket.socket, rtde.Recipe, int] | None = None
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
            Whether the package was handed to the system. That says nothing
            about the robot: the slider's echo does. False without a
            connection, without `write`, or if the command answers no report
            or one from before the connection: the robot may have started anew.
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
                # all that follow. The thread notices and connects anew.
                self._writer = None
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                return False
            self._heartbeat = command.heartbeat
        self._record_sent(package)
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
        """Sets the slider to 0 and waits a little until that is seen."""
        wait = _RETURN if self._writer is None else _FAREWELL
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
                after=report.sequence, timeout=_FAREWELL / 4
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
            except _LostError as problem:
                self._update(connected=False, problem=str(problem))
            except RtdeError as error:
                self._update(connected=False, problem=f"{self._where}: {error}")
            except OSError as error:
                self._update(
                    connected=False,
                    problem=f"{self._where}: {error.strerror or error}",
                )
            except Exception as error:  # The thread must live on.
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

    def _record_sent(self, package):
        if self._tap is not None:
            self._tap(time.monotonic(), True, package)

    def _serve_connection(self):
        """Connects, shakes hands and reads until something is wrong."""
        config = self._config
        with socket.create_connection(
            (config.host, config.port), config.connect_timeout
        ) as connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # A robot that does not read must not stay unnoticed for long.
            connection.setsockopt(
                socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER
            )
            link = _Link(self, connection)
            try:
                link.shake_hands()
                link.read_stream()
            finally:
                with self._send_lock:
                    self._writer = None
                if self._closed.is_set():
                    link.say_goodbye()
                link.close()


class _Link:
    """One connection of a client, from handshake to its end."""

    def __init__(self, client: RtdeClient, connection: socket.socket):
        self._client = client
        self._config = client._config
        self._connection = connection
        # Of the same connection, but never waits: it serves the control loop.
        self._writer = connection.dup()
        self._writer.setblocking(False)
        self._reader = rtde.PackageReader()
        self._waiting: list[tuple[int, bytes]] = []
        # When the last bytes came, s.
        self._arrival = -math.inf
        # The deadline that was over at the last look; NaN: it was not.
        self._overdue = math.nan
        self._version = 1
        # Of the newest package, if it was no good.
        self._rejection = ""
        self._outputs: rtde.Recipe | None = None
        self._inputs: rtde.Recipe | None = None

    def shake_hands(self):
        """Agrees on version, outputs and inputs, and starts the stream."""
        kind = PackageType.REQUEST_PROTOCOL_VERSION
        if self._ask(kind, rtde.encode_version_request(2), accepted=True):
            self._version = 2
        elif not self._ask(kind, rtde.encode_version_request(1), accepted=True):
            raise _LostError(
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
        # What can stream now is good, whether or not the answer is first.
        self._make_report = ReportMaker(
            self._outputs,
            frequency=frequency,
            products_register=self._config.products_register,
            clock_jump=self._config.clock_jump,
        )
        self._client._update(
            controller=controller,
            frequency=frequency,
            types=dict(
                zip(self._outputs.names, self._outputs.types, strict=True)
            ),
        )
        if not self._ask(
            PackageType.START,
            rtde.encode_package(PackageType.START),
            accepted=True,
            or_data=True,
        ):
            raise _LostError("the controller refused to start the stream")

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
                raise _LostError(
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
                raise _LostError(
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
            raise _LostError("unexpected types: " + ", ".join(wrong))
        if setup.recipe_id == 0 and self._version >= 2 and not config.lenient:
            raise _LostError(
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
            raise _LostError(
                f"{', '.join(used)} in use: a fieldbus (EtherNet/IP, "
                "PROFINET, MODBUS), a URCap or another client has claimed it"
            )
        missing = [n for n, kind in answered.items() if kind == rtde.NOT_FOUND]
        if missing:
            raise _LostError(
                f"the controller does not know the inputs {', '.join(missing)}"
            )
        if types != expected:
            raise _LostError(f"unexpected types of inputs: {', '.join(types)}")
        if setup.recipe_id == 0 and not self._config.lenient:
            raise _LostError("the controller refused the inputs")
        self._inputs = rtde.Recipe(names, types, setup.recipe_id)

    def _ask(self, kind, request, *, accepted=False, or_data=False):
        """Sends a request and returns the payload of its answer.

        Whatever else comes in the meantime is dealt with.

        Args:
            kind: Type of request and answer.
            request: The package.
            accepted: Return whether it was accepted instead of the payload.
            or_data: A data package counts as acceptance, too.
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
        self._client._record_sent(package)

    def _receive(self, deadline, otherwise):
        """Adds the next packages to those that wait."""
        remaining = deadline - time.monotonic()
        if self._client._closed.is_set():
            raise _LostError("closed")
        is_over = remaining <= 0
        # This process may have stood still: what has come meanwhile counts.
        if is_over and self._overdue == deadline:
            raise _LostError(f"{self._client._where}: {otherwise}")
        self._overdue = deadline if is_over else math.nan
        try:
            self._reader.check()
        except RtdeError as error:
            raise _LostError(f"{self._client._where}: {error}") from None
        # Short enough to notice that the client was closed.
        self._connection.settimeout(min(max(remaining, 0.0), 0.25))
        try:
            data = self._connection.recv(1 << 16)
        except (TimeoutError, BlockingIOError):
            return
        self._arrival = time.monotonic()
        if not data:
            raise _LostError(f"{self._client._where}: the controller hung up")
        packages = self._reader.feed(data)
        tap = self._client._tap
        if tap is not None:
            for kind, payload in packages:
                package = rtde.encode_package(kind, payload)
                tap(self._arrival, False, package)
        self._waiting.extend(packages)

    def _take_note(self, kind, payload):
        """Deals with what nobody asked for."""
        client = self._client
        if kind == PackageType.TEXT_MESSAGE:
            try:
                message = rtde.decode_text(payload, version=self._version)
                text = f"{message.source}: {message.text}".strip(": ")
            except RtdeError as error:
                text = str(error)
            client._update(texts=client._status.texts + 1, last_text=text)

    def read_stream(self):
        """Makes reports until the stream ends or is silent for too long."""
        client, config = self._client, self._config
        session = client._report.session + 1
        last = math.nan
        started = False
        # The first package may take as long as any answer.
        deadline = time.monotonic() + config.reply_timeout
        while True:
            while self._waiting:
                kind, payload = self._waiting.pop(0)
                if kind != PackageType.DATA_PACKAGE:
                    self._take_note(kind, payload)
                    continue
                arrived = self._arrival
                report = self._decode(payload, arrived, last, session)
                if report is None:
                    continue
                session, last = report.session, report.timestamp
                deadline = arrived + config.stream_timeout
                if not started:
                    started = True
                    self._begin()
                with client._condition:
                    client._report = report
                    client._condition.notify_all()
            self._receive(
                deadline,
                f"no package for {config.stream_timeout:g} s{self._rejection}",
            )

    def _begin(self):
        client = self._client
        if self._inputs is not None:
            with client._send_lock:
                first = client._report.sequence + 1
                client._writer = (self._writer, self._inputs, first)
        client._update(
            connected=True,
            problem="",
            writes=self._inputs is not None,
            connections=client._status.connections + 1,
        )

    def _decode(self, payload, arrived, last, session):
        """Returns the report of a data package, None if it is no good."""
        client = self._client
        status = client._status
        try:
            flat = self._outputs.decode_flat(
                payload, version=self._version, any_id=self._config.lenient
            )
            report = self._make_report(
                flat,
                before=client._report,
                time=arrived,
                last=last,
                session=session,
            )
        except RtdeError as error:
            client._update(rejected=status.rejected + 1)
            self._rejection = f"; data are rejected: {error}"
            if not status.connected:
                # Else it would be connecting for ever.
                client._update(problem=f"{client._where}{self._rejection}")
            return None
        self._rejection = ""
        if report.timestamp == last:
            client._update(repeated=status.repeated + 1)
            return None
        client._packages += 1
        return report

    def say_goodbye(self):
        """Tells the controller to stop streaming, and reads what is left.

        With bytes unread, closing would reset the connection, and the
        controller might never read what was sent last.
        """
        deadline = time.monotonic() + _FAREWELL
        # If it is gone already, that is as well.
        with contextlib.suppress(OSError):
            self._send(rtde.encode_package(PackageType.PAUSE))
            self._connection.shutdown(socket.SHUT_WR)
            self._connection.settimeout(_FAREWELL)
            while time.monotonic() < deadline:
                if not self._connection.recv(1 << 16):
                    return

    def close(self):
        """Lets go of the connection."""
        self._writer.close()
