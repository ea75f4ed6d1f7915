"""A controller that answers as a test wants, byte by byte."""

import contextlib
import socket
import threading

from tofssm_drake.rtde.rtde_fields import (
    INPUT_TYPES,
    OUTPUT_TYPES,
)
import tofssm_drake.rtde.rtde_protocol as rtde
from tofssm_drake.rtde.rtde_protocol import PackageType

POSITION = (0.0, -1.5, -1.7, -0.9, 1.57, 0.1)


def make_values(names, timestamp, **changes):
    """Returns values for a data package of a robot at work."""
    values = {
        "timestamp": timestamp,
        "actual_q": POSITION,
        "robot_mode": 7,
        "safety_mode": 1,
        "safety_status": 1,
        "runtime_state": 2,
        "target_speed_fraction": 1.0,
        "speed_scaling": 1.0,
    } | changes
    return [
        values.get(name, (0.0,) * 6 if OUTPUT_TYPES[name] == "VECTOR6D" else 0)
        for name in names
    ]


class OddServer:
    """Speaks RTDE properly; subclasses do not, in one way each.

    `streams` counts accepted START requests, `received` keeps what clients
    wrote.
    """

    known = OUTPUT_TYPES
    stream_first = False

    def __init__(self):
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.connections = 0
        self.streams = 0
        self.received = []
        self.goodbyes = 0
        self.connection = None
        self.names = ()
        self.version = 1
        self._closed = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self):
        self._closed = True
        # Wakes accept.
        with contextlib.suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(OSError, AttributeError):
            self.connection.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self.listener.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _run(self):
        while not self._closed:
            try:
                self.connection, _ = self.listener.accept()
            except OSError:
                return
            self.connections += 1
            self.version = 1
            with self.connection, contextlib.suppress(OSError):
                self._serve()

    def _serve(self):
        reader = rtde.PackageReader()
        while data := self.connection.recv(4096):
            for kind, payload in reader.feed(data):
                answer = self.answer(kind, payload)
                if answer is not None:
                    self.send(answer)
                if kind == PackageType.START:
                    self.streams += 1
                    self.stream()

    def send(self, data):
        self.connection.sendall(data)

    def answer(self, kind, payload):
        if kind == PackageType.REQUEST_PROTOCOL_VERSION:
            return self.on_version(rtde.decode_version_request(payload))
        if kind == PackageType.GET_URCONTROL_VERSION:
            return rtde.encode_controller_version((3, 15, 8, 106))
        if kind == PackageType.SETUP_OUTPUTS:
            _, self.names = rtde.decode_output_setup(
                payload, version=self.version
            )
            return self.on_outputs(self.names)
        if kind == PackageType.SETUP_INPUTS:
            return self.on_inputs(rtde.decode_input_setup(payload))
        if kind in (PackageType.START, PackageType.PAUSE):
            self.goodbyes += kind == PackageType.PAUSE
            return rtde.encode_accepted(kind, True)
        self.received.append((kind, payload))
        return None

    def on_version(self, version):
        self.version = version
        return rtde.encode_accepted(PackageType.REQUEST_PROTOCOL_VERSION, True)

    def on_outputs(self, names):
        types = [self.known.get(name, rtde.NOT_FOUND) for name in names]
        number = 0 if rtde.NOT_FOUND in types else 1
        return rtde.encode_output_setup_reply(
            rtde.Setup(number, tuple(types)), version=self.version
        )

    def on_inputs(self, names):
        types = tuple(INPUT_TYPES[name] for name in names)
        return rtde.encode_input_setup_reply(rtde.Setup(1, types))

    def stream(self):
        """Called after START: five packages by default."""
        for i in range(5):
            self.send(self.make_package(100 + 0.008 * i))

    def make_package(self, timestamp, number=1, **changes):
        names = self.names
        recipe = rtde.Recipe(
            names, [OUTPUT_TYPES[name] for name in names], number
        )
        return recipe.encode(
            make_values(names, timestamp, **changes), version=self.version
        )
