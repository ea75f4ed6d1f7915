"""The controller's side of RTDE: serves a simulated robot to many clients.

One thread does everything: it steps the robot on its own clock, answers
clients and streams. A slow client misses packages, and one with many requests
takes turns with the others; neither delays the robot or another client. A
second port offers the part of UR's dashboard that starts and stops programs,
and takes the faults to inject.
"""

import collections
from collections.abc import Callable
import dataclasses as dc
import math
import selectors
import socket
import time
from typing import cast

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RTDE_JOINTS
from tofssm_drake.robots.robot_modes import (
    RobotMode,
    RuntimeState,
    SafetyMode,
)
import tofssm_drake.rtde.rtde_protocol as rtde
from tofssm_drake.rtde.rtde_protocol import PackageType, RtdeError
from tofssm_drake.rtde.simulated_ur import SimulatedUr

# Bytes that may wait for a slow client before packages are skipped, and how
# long a client may read nothing before it is dropped, s.
_BACKLOG = 1 << 16
_PATIENCE = 10.0
# Bytes that may wait for a client that does not read its answers.
_MOST_UNREAD = 1 << 18
# Bytes that are read in one turn of a client and of a console: either is
# handled in about a millisecond.
_BYTES_PER_TURN = 1 << 12
_CONSOLE_BYTES_PER_TURN = 1 << 7
# Most connections to a port at a time, and most files that select can watch.
_MOST_CLIENTS = 100
_MOST_FILES = 1024
# How much robot time is caught up at once after the process slept, s.
_LARGEST_LAG = 1.0


@dc.dataclass(kw_only=True)
class Faults:
    """How the server misbehaves; changed while it runs."""

    # A text message before each reply and before every tenth data package.
    text_messages: bool = False
    # Leave out every n-th data package; 0: none.
    skip_every: int = 0
    # Send at most this many bytes at once; 0: no limit.
    fragment: int = 0
    # Hold data packages back until there are this many.
    coalesce: int = 1
    # No data packages until then, s on the monotonic clock.
    stalled_until: float = 0.0
    # Data packages still to leave out.
    skip_next: int = 0
    # Send each data package twice.
    duplicate: bool = False


def _get_socket(key: selectors.SelectorKey) -> socket.socket:
    """Returns what was registered: nothing but sockets."""
    return cast(socket.socket, key.fileobj)


class _Session:
    """One client: what it requested and what waits to be sent."""

    def __init__(self, connection: socket.socket):
        self.connection = connection
        self.reader = rtde.PackageReader()
        self.requests: collections.deque[tuple[int, bytes]] = (
            collections.deque()
        )
        self.version = 1
        self.outputs: rtde.Recipe | None = None
        self.divider = 1
        self.started = False
        self.inputs: list[rtde.Recipe] = []
        self.outgoing = bytearray()
        self.held: list[bytes] = []
        self.count = 0
        self.last_cycle = -1
        self.last_progress = time.monotonic()


class RtdeServer:
    """Serves a simulated robot.

    Args:
        robot: The robot; only this object steps it.
        host: Address to listen on.
        port: TCP port of RTDE; 0 takes a free one.
        dashboard_port: TCP port of the dashboard; 0 takes a free one, None
            has none.
        faults: How it misbehaves at first.

    Raises:
        UserError: It cannot listen on the address.
    """

    def __init__(
        self,
        *,
        robot: SimulatedUr,
        host: str = "127.0.0.1",
        port: int = 30004,
        dashboard_port: int | None = None,
        faults: Faults | None = None,
    ):
        self.robot = robot
        self.faults = Faults() if faults is None else faults
        self._sessions: dict[socket.socket, _Session] = {}
        self._claims: dict[str, object] = {}
        self._consoles: dict[socket.socket, bytearray] = {}
        # Connections with something to handle, in the order of their turns.
        self._turns: dict[socket.socket, Callable] = {}
        # Not epoll: its timeouts are whole milliseconds.
        self._selector = selectors.SelectSelector()
        self._listeners: list[socket.socket] = []
        try:
            self.address = self._listen(host, port, self._accept_client)
            """Host and port of RTDE."""
            self.dashboard_address = None
            """Host and port of the dashboard, or None."""
            if dashboard_port is not None:
                self.dashboard_address = self._listen(
                    host, dashboard_port, self._accept_console
                )
        except BaseException:
            self.close()
            raise

    def run(self, is_stopped: Callable[[], bool]) -> None:
        """Serves until stopped, then closes everything.

        Args:
            is_stopped: Called at least once per control cycle.
        """
        period = 1.0 / self.robot.rate
        tick = time.monotonic() + period
        try:
            while not is_stopped():
                self._wait(tick)
                now = time.monotonic()
                if now >= tick:
                    cycles = 1 + int((now - tick) / period)
                    tick += cycles * period
                    # A controller skips packages rather than send them late.
                    for _ in range(min(cycles, int(_LARGEST_LAG / period))):
                        self.robot.step()
                    self._stream()
        finally:
            self.close()

    def close(self) -> None:
        """Closes all connections."""
        for key in list(self._selector.get_map().values()):
            _get_socket(key).close()
        self._selector.close()
        self._sessions.clear()
        self._consoles.clear()
        self._turns.clear()

    def drop_clients(self) -> None:
        """Closes the connections of all clients."""
        for session in list(self._sessions.values()):
            self._drop(session)

    def claim(self, names: list[str]) -> None:
        """Claims inputs, as a fieldbus does: clients find them in use."""
        for name in names:
            self._claims[name] = self

    def release(self) -> None:
        """Releases the claimed inputs."""
        self._claims = {
            name: owner
            for name, owner in self._claims.items()
            if owner is not self
        }

    def _listen(self, host, port, accept):
        try:
            listener = socket.create_server((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(
                f"cannot listen at {host}:{port}: {reason}"
            ) from None
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, accept)
        return listener.getsockname()[:2]

    def _wait(self, tick):
        """Waits for sockets at most until the tick, and serves them."""
        for session in self._sessions.values():
            events = selectors.EVENT_READ
            if session.outgoing:
                events |= selectors.EVENT_WRITE
            key = self._selector.get_key(session.connection)
            if key.events != events:
                self._selector.modify(session.connection, events, key.data)
        seconds = 0.0 if self._turns else max(tick - time.monotonic(), 0.0)
        for key, events in self._selector.select(seconds):
            connection = _get_socket(key)
            if connection in self._sessions and events & selectors.EVENT_WRITE:
                self._flush(self._sessions[connection])
            if events & selectors.EVENT_READ:
                # A waiting connection keeps its place.
                self._turns.setdefault(connection, key.data)
        self._take_turns(tick)

    def _take_turns(self, tick):
        """Gives one turn to each waiting connection, while there is time.

        The others come first the next time. At least one turn is given, so that
        the clients of a slow computer are not cut off.
        """
        for _ in range(len(self._turns)):
            connection = next(iter(self._turns))
            deal_with = self._turns.pop(connection)
            # A connection dropped meanwhile is closed.
            if connection.fileno() >= 0:
                deal_with(connection)
            if time.monotonic() >= tick:
                return

    def _accept_client(self, listener):
        connection = _accept(listener, len(self._sessions))
        if connection is None:
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sessions[connection] = _Session(connection)
        self._selector.register(
            connection, selectors.EVENT_READ, self._serve_client
        )

    def _serve_client(self, connection):
        """Handles one request of a client; reads if none is left."""
        session = self._sessions[connection]
        if not session.requests:
            data = _receive(connection, _BYTES_PER_TURN)
            if data is None:
                return
            if not data:
                self._drop(session)
                return
            session.requests.extend(session.reader.feed(data))
        waiting = len(session.outgoing)
        if session.requests:
            try:
                self._answer(session, *session.requests.popleft())
            except RtdeError as error:
                self._tell(session, str(error), rtde.TextLevel.WARNING)
            except Exception as error:
                # One client's input must not stop the server for the others.
                self._tell(session, repr(error), rtde.TextLevel.EXCEPTION)
                self._drop(session)
                return
        # Data packages have their own bound; this one is for answers.
        if len(session.outgoing) > max(waiting, _MOST_UNREAD):
            self._drop(session)
            return
        if session.requests:
            self._turns[connection] = self._serve_client
            return
        try:
            session.reader.check()
        except RtdeError:
            self._drop(session)

    def _drop(self, session):
        self._sessions.pop(session.connection, None)
        self._selector.unregister(session.connection)
        session.connection.close()
        self._claims = {
            name: owner
            for name, owner in self._claims.items()
            if owner is not session
        }

    def _answer(self, session, kind, payload):
        if kind == PackageType.DATA_PACKAGE:
            self._take_inputs(session, payload)
            return
        if kind == PackageType.TEXT_MESSAGE:
            return
        reply = None
        if kind == PackageType.REQUEST_PROTOCOL_VERSION:
            version = rtde.decode_version_request(payload)
            # Packages of the other version have another size.
            accepted = version in (1, 2) and (
                version == session.version or not session.started
            )
            reply = rtde.encode_accepted(kind, accepted)
        elif kind == PackageType.GET_URCONTROL_VERSION:
            reply = rtde.encode_controller_version(self.robot.version)
        elif kind == PackageType.SETUP_OUTPUTS:
            reply = self._set_up_outputs(session, payload)
        elif kind == PackageType.SETUP_INPUTS:
            reply = self._set_up_inputs(session, payload)
        elif kind == PackageType.START:
            session.started = session.outputs is not None
            reply = rtde.encode_accepted(kind, session.started)
        elif kind == PackageType.PAUSE:
            session.started = False
            session.held.clear()
            reply = rtde.encode_accepted(kind, True)
        else:
            raise RtdeError(f"unknown package type {kind}")
        if self.faults.text_messages:
            self._tell(session, "before a reply")
        self._send(session, reply)
        if kind == PackageType.REQUEST_PROTOCOL_VERSION and accepted:
            session.version = version

    def _set_up_outputs(self, session, payload):
        frequency, names = rtde.decode_output_setup(
            payload, version=session.version
        )
        rate = self.robot.rate
        frequency = rate if frequency is None else frequency
        known = self.robot.output_types
        types = tuple(known.get(name, rtde.NOT_FOUND) for name in names)
        session.outputs = None
        session.started = False
        session.held.clear()
        # NaN is out of range, too.
        if names and rtde.NOT_FOUND not in types and 1 <= frequency <= rate:
            session.outputs = rtde.Recipe(names, types, 1)
            session.divider = calc_divider(rate, frequency)
        return rtde.encode_output_setup_reply(
            rtde.Setup(0 if session.outputs is None else 1, types),
            version=session.version,
        )

    def _set_up_inputs(self, session, payload):
        names = rtde.decode_input_setup(payload)
        types = []
        for name in names:
            if name not in self.robot.input_types:
                types.append(rtde.NOT_FOUND)
            elif self._claims.get(name, session) is not session:
                types.append(rtde.IN_USE)
            else:
                types.append(self.robot.input_types[name])
        number = 0
        if (
            names
            and not {rtde.NOT_FOUND, rtde.IN_USE} & set(types)
            and len(session.inputs) < 255
        ):
            number = len(session.inputs) + 1
            session.inputs.append(rtde.Recipe(names, types, number))
            self._claims |= dict.fromkeys(names, session)
        return rtde.encode_input_setup_reply(rtde.Setup(number, tuple(types)))

    def _take_inputs(self, session, payload):
        number = payload[0] if payload else 0
        if not 1 <= number <= len(session.inputs):
            raise RtdeError(f"unknown input recipe {number}")
        recipe = session.inputs[number - 1]
        values = recipe.decode(payload)
        self.robot.receive(dict(zip(recipe.names, values, strict=True)))

    def _tell(self, session, text, level=rtde.TextLevel.INFO):
        message = rtde.TextMessage(text, "RTDE", level)
        self._send(session, rtde.encode_text(message, version=session.version))

    def _stream(self):
        """Sends this cycle's outputs to every client."""
        faults = self.faults
        now = time.monotonic()
        # Read once: another thread may set it while this one sends.
        is_skipping = faults.skip_next > 0
        for session in list(self._sessions.values()):
            if session.outgoing and now - session.last_progress > _PATIENCE:
                self._drop(session)
                continue
            cycle = self.robot.cycle
            outputs = session.outputs
            if (
                outputs is None
                or not session.started
                or cycle - session.last_cycle < session.divider
            ):
                continue
            session.last_cycle = cycle
            session.count += 1
            if (
                now < faults.stalled_until
                or len(session.outgoing) > _BACKLOG
                or (faults.skip_every and not session.count % faults.skip_every)
                or is_skipping
            ):
                continue
            if faults.text_messages and session.count % 10 == 0:
                self._tell(session, "in the stream")
            values = [self.robot.outputs[n] for n in outputs.names]
            try:
                package = outputs.encode(values, version=session.version)
            except RtdeError:
                self._drop(session)
                continue
            session.held.append(package * (2 if faults.duplicate else 1))
            if len(session.held) >= faults.coalesce:
                self._send(session, b"".join(session.held))
                session.held.clear()
        if is_skipping:
            faults.skip_next -= 1

    def _send(self, session, data):
        if not session.outgoing:
            session.last_progress = time.monotonic()
        session.outgoing += data
        self._flush(session)

    def _flush(self, session):
        limit = self.faults.fragment or len(session.outgoing)
        try:
            sent = session.connection.send(session.outgoing[:limit])
        except BlockingIOError:
            return
        except OSError:
            # Reading shows that it is gone.
            session.outgoing.clear()
            return
        del session.outgoing[:sent]
        session.last_progress = time.monotonic()

    def _accept_console(self, listener):
        connection = _accept(listener, len(self._consoles))
        if connection is None:
            return
        self._consoles[connection] = bytearray()
        self._selector.register(
            connection, selectors.EVENT_READ, self._read_console
        )
        _send_line(connection, "Connected: Universal Robots Dashboard Server")

    def _read_console(self, connection):
        data = _receive(connection, _CONSOLE_BYTES_PER_TURN)
        if data is None:
            return
        buffer = self._consoles[connection]
        buffer += data
        *lines, rest = bytes(buffer).split(b"\n")
        buffer[:] = rest[:1024]
        for line in lines:
            text = line.decode("ascii", "replace").strip()
            _send_line(connection, self.do(text))
            if text == "quit":
                data = b""
        if not data:
            self._selector.unregister(connection)
            del self._consoles[connection]
            connection.close()

    def do(self, line: str) -> str:
        """Executes a line of the dashboard and returns the answer.

        UR's own commands: play, pause, stop, running, robotmode, safetymode,
        programState, PolyscopeVersion, unlock protective stop, quit. Those
        that only a simulated robot has:

            simulate slider 0.5       a person moves the slider
            simulate slider-frozen on clients cannot move it any more
            simulate arm-ignores-slider on  it moves, the arm ignores it
            simulate arm-slow 0.6     the arm gets no slower than that
            simulate joint-offset 1 0.1  joint 1 is reported off by 0.1 rad
            simulate joints-late 0.05 delay of the reported joints, s
            simulate tcp-offset 0 0 0.3  the tool is set up there, m
            simulate clock-rate 2     the clock runs twice as fast
            simulate safety 3         safety mode, here a protective stop
            simulate stall 0.5        no data packages for that long, s
            simulate skip 5           leave out the next data packages
            simulate skip-every 10    leave out every tenth; 0: none
            simulate duplicate on     each data package twice
            simulate fragment 7       at most 7 bytes at once; 0: all
            simulate coalesce 4       four data packages at once
            simulate text on          text messages in between
            simulate drop             close all connections
            simulate restart          the same, and the clock starts at 0
            simulate clock 5          the clock jumps by 5 s
            simulate claim NAME,NAME  inputs held by a fieldbus
            simulate release          and released

        Args:
            line: As typed.

        Returns:
            One line.
        """
        robot = self.robot
        if line.startswith("simulate "):
            return self._simulate(*line.split(maxsplit=2)[1:])
        if line == "play":
            return (
                "Starting program"
                if robot.play()
                else "Failed to execute: play"
            )
        if line == "pause":
            robot.pause()
            return "Pausing program"
        if line == "stop":
            robot.stop()
            return "Stopped"
        if line == "unlock protective stop":
            if robot.safety_mode == SafetyMode.PROTECTIVE_STOP:
                robot.set_safety_mode(SafetyMode.NORMAL)
            return "Protective stop releasing"
        if line == "running":
            return f"Program running: {str(robot.is_program_running()).lower()}"
        if line == "robotmode":
            return f"Robotmode: {RobotMode(robot.outputs['robot_mode']).name}"
        if line == "safetymode":
            return f"Safetymode: {SafetyMode(robot.safety_mode).name}"
        if line == "programState":
            state = {
                RuntimeState.STOPPED: "STOPPED",
                RuntimeState.PAUSED: "PAUSED",
            }.get(robot.runtime_state, "PLAYING")
            return f"{state} pick_and_place.urp"
        if line == "PolyscopeVersion":
            return "URSoftware " + ".".join(map(str, robot.version))
        if line == "quit":
            return "Disconnected"
        return f"could not understand: '{line}'"

    def _simulate(self, what="", value=""):
        """Executes what only a simulated robot understands."""
        try:
            if what in _ROBOT_FAULTS:
                name, parse = _ROBOT_FAULTS[what]
                setattr(self.robot, name, parse(value))
            elif what in _STREAM_FAULTS:
                name, parse = _STREAM_FAULTS[what]
                setattr(self.faults, name, parse(value))
            elif not self._act(what, value):
                return f"could not understand: 'simulate {what}'"
        except (KeyError, ValueError, OverflowError):
            return f"could not understand: 'simulate {what} {value}'"
        return f"simulating {what} {value}".strip()

    def _act(self, what, value):
        """Simulates an event; returns whether there is such an event."""
        robot = self.robot
        match what:
            case "slider":
                robot.move_slider(_parse_number(value))
            case "joint-offset":
                joint, offset = _parse_joint_offset(value)
                robot.joint_offset[joint] = offset
            case "tcp-offset":
                robot.tcp_offset[:3] = _parse_position(value)
            case "safety":
                robot.set_safety_mode(SafetyMode(int(value)))
            case "stall":
                end = time.monotonic() + _parse_number(value)
                self.faults.stalled_until = end
            case "clock":
                robot.shift_clock(_parse_number(value))
            case "claim":
                self.claim(value.split(","))
            case "release":
                self.release()
            case "drop":
                self.drop_clients()
            case "restart":
                self.drop_clients()
                robot.restart_clock()
            case _:
                return False
        return True


def _parse_switch(value):
    return {"on": True, "off": False}[value]


def _parse_number(value):
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(value)
    return number


def _parse_fraction(value):
    return _parse_within(value, 0.0, 1.0)


def _parse_clock_rate(value):
    return _parse_within(value, 0.1, 10.0)


def _parse_within(value, low, high):
    number = _parse_number(value)
    if not low <= number <= high:
        raise ValueError(value)
    return number


def _parse_count(value):
    count = int(value)
    if count < 0:
        raise ValueError(value)
    return count


def _parse_joint_offset(value):
    """Returns a joint's index and its offset, rad."""
    joint, offset = value.split()
    if not 1 <= int(joint) <= RTDE_JOINTS:
        raise ValueError(value)
    return int(joint) - 1, _parse_number(offset)


def _parse_position(value):
    position = [_parse_number(v) for v in value.split()]
    if len(position) != 3:
        raise ValueError(value)
    return position


# Attribute of the robot, and of `Faults`, by the dashboard's word for it.
_ROBOT_FAULTS = {
    "slider-frozen": ("slider_frozen", _parse_switch),
    "arm-ignores-slider": ("ignores_slider", _parse_switch),
    "arm-slow": ("slowest_fraction", _parse_fraction),
    "joints-late": ("joints_late", _parse_fraction),
    "clock-rate": ("clock_rate", _parse_clock_rate),
}
_STREAM_FAULTS = {
    "skip": ("skip_next", _parse_count),
    "skip-every": ("skip_every", _parse_count),
    "duplicate": ("duplicate", _parse_switch),
    "fragment": ("fragment", _parse_count),
    "coalesce": ("coalesce", _parse_count),
    "text": ("text_messages", _parse_switch),
}


def calc_divider(rate: float, frequency: float) -> int:
    """Returns the number of control cycles per package.

    Packages come at least as often as requested. A whole divider stays exact:
    rate / (rate / k) may be slightly less than k.

    Args:
        rate: Control cycles per second.
        frequency: Packages per second that a client requests, 1 to rate.
    """
    return int(rate / frequency * (1.0 + 1e-9))


def _accept(listener, connected) -> socket.socket | None:
    """Returns a new connection; None: there are too many, or it is gone."""
    try:
        connection, _ = listener.accept()
    except OSError:
        return None
    if connected >= _MOST_CLIENTS or connection.fileno() >= _MOST_FILES:
        connection.close()
        return None
    connection.setblocking(False)
    return connection


def _receive(connection, most) -> bytes | None:
    """Returns received bytes; b"" at the end; None if there are none yet."""
    try:
        return connection.recv(most)
    except BlockingIOError:
        return None
    except OSError:
        return b""


def _send_line(connection, text):
    try:
        connection.send(text.encode("ascii", "replace") + b"\n")
    except OSError:
        # The client has gone.
        return
