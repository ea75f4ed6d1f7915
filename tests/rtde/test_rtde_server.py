"""The simulated controller, checked byte by byte."""

import contextlib
import itertools
import math
import socket
import struct
import time
import unittest
from unittest import mock

import numpy as np
from robot_room import make_robot, serve

from tofssm_drake.errors import UserError
from tofssm_drake.rtde.rtde_fields import OUTPUT_TYPES
import tofssm_drake.rtde.rtde_protocol as rtde
from tofssm_drake.rtde.rtde_protocol import PackageType
import tofssm_drake.rtde.rtde_server as mut


class RawClient:
    """A socket with as thin a layer as possible."""

    def __init__(self, address):
        self.socket = socket.create_connection(address, 5.0)
        self.reader = rtde.PackageReader()
        self.waiting = []

    def close(self):
        self.socket.close()

    def send(self, kind, payload=b""):
        self.socket.sendall(
            struct.pack(">HB", 3 + len(payload), kind) + payload
        )

    def receive(self, timeout=120.0):
        """Returns the next package; None if none comes."""
        self.socket.settimeout(timeout)
        while not self.waiting:
            try:
                data = self.socket.recv(4096)
            except TimeoutError:
                return None
            if not data:
                raise EOFError
            self.waiting += self.reader.feed(data)
        return self.waiting.pop(0)

    def forget(self):
        """Drops unread data."""
        self.waiting.clear()
        self.socket.settimeout(0.0)
        with contextlib.suppress(BlockingIOError):
            while True:
                self.reader.feed(self.socket.recv(4096))

    def ask(self, kind, payload=b""):
        """Returns the next package of that type."""
        self.send(ord(kind), payload)
        while True:
            answer, payload = self.receive()
            if answer == ord(kind):
                return payload

    def set_up(self, names, frequency=125.0):
        return self.ask("O", struct.pack(">d", frequency) + names)


class TestServer(unittest.TestCase):
    def setUp(self):
        stack = contextlib.ExitStack()
        self.addCleanup(stack.close)
        self.robot = make_robot()
        self.server = stack.enter_context(serve(self.robot))
        self.stack = stack

    def connect(self, version=2):
        client = RawClient(self.server.address)
        self.stack.callback(client.close)
        if version == 2:
            self.assertEqual(client.ask("V", b"\x00\x02"), b"\x01")
        return client


class TestHandshake(TestServer):
    def test_versions(self):
        dut = self.connect(version=1)
        for version, accepted in ((0, 0), (3, 0), (300, 0), (1, 1), (2, 1)):
            with self.subTest(version=version):
                self.assertEqual(
                    dut.ask("V", struct.pack(">H", version)), bytes([accepted])
                )
        self.assertEqual(dut.ask("v"), struct.pack(">4I", 3, 15, 8, 106))

    def test_version_2_stream(self):
        dut = self.connect()
        self.assertEqual(
            dut.set_up(b"timestamp,actual_q,robot_mode,"),
            b"\x01DOUBLE,VECTOR6D,INT32",
        )
        self.assertEqual(dut.ask("S"), b"\x01")
        kind, payload = dut.receive()
        self.assertEqual(kind, PackageType.DATA_PACKAGE)
        number, _, *q, mode = struct.unpack(">Bd6di", payload)
        self.assertEqual((number, mode), (1, 7))
        self.assertAlmostEqual(q[1], -2.1, delta=1.5)

    def test_no_other_version_while_a_stream_runs(self):
        for version, other, names in (
            (1, 2, b"timestamp"),
            (2, 1, struct.pack(">d", 125.0) + b"timestamp"),
        ):
            with self.subTest(version=version):
                dut = self.connect(version=version)
                dut.ask("O", names)
                dut.ask("S")
                for asked, accepted in ((other, 0), (version, 1)):
                    self.assertEqual(
                        dut.ask("V", struct.pack(">H", asked)),
                        bytes([accepted]),
                    )
                    sizes = {len(dut.receive()[1]) for _ in range(3)}
                    self.assertEqual(sizes, {8 if version == 1 else 9})
                dut.ask("P")
                self.assertEqual(
                    dut.ask("V", struct.pack(">H", other)), b"\x01"
                )

    def test_version_1_stream(self):
        dut = self.connect(version=1)
        self.assertEqual(
            dut.ask("O", b"timestamp,actual_q"), b"DOUBLE,VECTOR6D"
        )
        self.assertEqual(dut.ask("S"), b"\x01")
        times = []
        for _ in range(30):
            kind, payload = dut.receive()
            self.assertEqual(kind, PackageType.DATA_PACKAGE)
            times.append(struct.unpack(">7d", payload)[0])
        # Whole rate; a busy computer leaves some out.
        self.assertAlmostEqual(np.diff(times).min(), 0.008, delta=1e-4)

    def test_unknown_outputs(self):
        dut = self.connect()
        reply = dut.set_up(b"timestamp,nonsense,ft_raw_wrench")
        self.assertEqual(reply[1:], b"DOUBLE,NOT_FOUND,NOT_FOUND")
        self.assertEqual(dut.ask("S"), b"\x00")
        self.assertIsNone(dut.receive(timeout=0.05))

    def test_frequencies(self):
        dut = self.connect()
        for frequency, divider in (
            (125.0, 1),
            (100.0, 1),
            (62.5, 2),
            (50.0, 2),
            (40.0, 3),
            (1.0, 125),
        ):
            with self.subTest(frequency=frequency):
                dut.set_up(b"timestamp", frequency)
                self.assertEqual(dut.ask("S"), b"\x01")
                if divider < 10:
                    times = [
                        struct.unpack(">xd", dut.receive()[1])[0]
                        for _ in range(4)
                    ]
                    steps = {
                        round((b - a) / 0.008)
                        for a, b in itertools.pairwise(times[1:])
                    }
                    # A late thread leaves out cycles, but never adds one.
                    self.assertGreaterEqual(min(steps), divider)
                    self.assertLessEqual(min(steps), divider + 2)
                self.assertEqual(dut.ask("P"), b"\x01")
        for frequency in (0.0, 0.9, 125.1, 500.0, -1.0, math.nan, math.inf):
            with self.subTest(frequency=frequency):
                dut.set_up(b"timestamp", frequency)
                self.assertEqual(dut.ask("S"), b"\x00")

    def test_start_and_pause_in_any_order(self):
        dut = self.connect()
        self.assertEqual(dut.ask("P"), b"\x01")
        self.assertEqual(dut.ask("S"), b"\x00")
        self.assertEqual(dut.set_up(b""), b"\x00")
        self.assertEqual(dut.ask("S"), b"\x00")
        dut.set_up(b"timestamp")
        for _ in range(2):
            self.assertEqual(dut.ask("S"), b"\x01")
            self.assertIsNotNone(dut.receive())
            self.assertEqual(dut.ask("S"), b"\x01")
            self.assertEqual(dut.ask("P"), b"\x01")
            self.assertIsNone(dut.receive(timeout=0.05))
            self.assertEqual(
                dut.ask("I", b"input_int_register_24"), dut_reply(dut)
            )
        # A new recipe replaces the previous one.
        dut.set_up(b"robot_mode")
        self.assertEqual(dut.ask("S"), b"\x01")
        self.assertEqual(dut.receive()[1], struct.pack(">Bi", 1, 7))


class TestDivider(unittest.TestCase):
    def test_whole_dividers(self):
        for rate in (125, 500):
            for divider in range(1, rate + 1):
                with self.subTest(rate=rate, divider=divider):
                    self.assertEqual(
                        mut.calc_divider(rate, rate / divider), divider
                    )

    def test_at_least_as_often_as_asked_for(self):
        for rate, frequency, divider in (
            (125, 100.0, 1),
            (125, 62.51, 1),
            (125, 62.5, 2),
            (125, 62.49, 2),
            (125, 8.34, 14),
            (500, 8.33, 60),
            (500, 300.0, 1),
        ):
            with self.subTest(rate=rate, frequency=frequency):
                self.assertEqual(mut.calc_divider(rate, frequency), divider)

    def test_of_a_stream(self):
        # One of the values that a plain floor gets wrong.
        with serve(make_robot(series="e")) as server:
            dut = RawClient(server.address)
            self.addCleanup(dut.close)
            dut.ask("V", b"\x00\x02")
            dut.set_up(b"timestamp", 500 / 29)
            dut.ask("S")
            times = [
                struct.unpack(">xd", dut.receive()[1])[0] for _ in range(5)
            ]
        # A late thread leaves out cycles, but never adds one.
        self.assertGreaterEqual(np.rint(np.diff(times) / 0.002).min(), 29)


_count = {}


def dut_reply(dut):
    """Inputs may be set up after START; their numbers count up."""
    _count[dut] = _count.get(dut, 0) + 1
    return bytes([_count[dut]]) + b"INT32"


class TestInputs(TestServer):
    def test_claims(self):
        first, second = self.connect(), self.connect()
        slider = b"speed_slider_mask,speed_slider_fraction"
        self.assertEqual(first.ask("I", slider), b"\x01UINT32,DOUBLE")
        # The same name in several recipes of one client.
        self.assertEqual(first.ask("I", b"speed_slider_mask,"), b"\x02UINT32")
        self.assertEqual(
            second.ask("I", slider + b",input_int_register_0"),
            b"\x00IN_USE,IN_USE,INT32",
        )
        # A refused input is not claimed.
        self.assertEqual(first.ask("I", b"input_int_register_0"), b"\x03INT32")
        self.assertEqual(
            second.ask("I", b"nonsense,speed_slider_mask"),
            b"\x00NOT_FOUND,IN_USE",
        )
        first.close()
        deadline = time.monotonic() + 5
        while second.ask("I", slider) != b"\x01UINT32,DOUBLE":
            self.assertLess(time.monotonic(), deadline)

    def test_fieldbus(self):
        dut = self.connect()
        self.server.do("simulate claim speed_slider_mask")
        self.assertEqual(dut.ask("I", b"speed_slider_mask"), b"\x00IN_USE")
        self.server.do("simulate release")
        self.assertEqual(dut.ask("I", b"speed_slider_mask"), b"\x01UINT32")

    def test_written_without_start(self):
        dut = self.connect()
        dut.ask("I", b"speed_slider_mask,speed_slider_fraction")
        dut.send(ord("U"), struct.pack(">BId", 1, 1, 0.25))
        dut.ask("v")
        self.assertEqual(self.robot.slider, 0.25)

    def test_echo_within_two_cycles(self):
        dut = self.connect()
        dut.set_up(b"timestamp,target_speed_fraction")
        dut.ask("I", b"speed_slider_mask,speed_slider_fraction")
        dut.ask("S")
        written, _ = struct.unpack(">xdd", dut.receive()[1])
        dut.send(ord("U"), struct.pack(">BId", 1, 1, 0.25))
        fraction = 1.0
        while fraction != 0.25:
            seen, fraction = struct.unpack(">xdd", dut.receive()[1])
        # One more than the two for a thread that is late.
        self.assertLess(seen - written, 3.5 * 0.008)

    def test_wrong_packages_are_reported_and_forgiven(self):
        dut = self.connect()
        dut.ask("I", b"speed_slider_mask,speed_slider_fraction")
        for kind, payload, text in (
            ("U", b"", "unknown input recipe 0"),
            ("U", b"\x02" + bytes(12), "unknown input recipe 2"),
            ("U", b"\x01" + bytes(11), "data package of 12 bytes"),
            ("X", b"", "unknown package type 88"),
            ("V", b"\x00", "version request of 1 bytes"),
            ("O", b"\x00", "output setup: too short"),
            ("I", b"\xff", "not ASCII"),
        ):
            with self.subTest(text=text):
                dut.send(ord(kind), payload)
                kind, payload = dut.receive()
                self.assertEqual(kind, PackageType.TEXT_MESSAGE)
                self.assertIn(text, rtde.decode_text(payload).text)
        # The robot ignores a client's own texts.
        dut.send(ord("M"), b"\x02hi\x00\x03")
        self.assertEqual(len(dut.ask("v")), 16)
        self.assertEqual(self.robot.slider, 1.0)

    def test_size_below_header_ends_the_connection(self):
        dut, other = self.connect(), self.connect()
        dut.socket.sendall(b"\x00\x02V")
        with self.assertRaises(EOFError):
            dut.receive()
        self.assertEqual(len(other.ask("v")), 16)


class TestBadClients(TestServer):
    """Whatever one client does, the others are served."""

    def assert_serves(self):
        other = self.connect()
        self.assertEqual(other.set_up(b"timestamp"), b"\x01DOUBLE")
        other.ask("S")
        self.assertEqual(other.receive()[0], ord("U"))
        other.close()

    def test_names_that_are_too_long(self):
        names = b",".join([b"actual_q"] * 1500)
        client = self.connect()
        client.send(ord("O"), struct.pack(">d", 125.0) + names)
        kind, payload = client.receive()
        self.assertEqual(kind, PackageType.TEXT_MESSAGE)
        self.assertIn("at most 2048", rtde.decode_text(payload).text)
        client.send(ord("I"), names)
        self.assertEqual(client.receive()[0], PackageType.TEXT_MESSAGE)
        self.assertEqual(client.ask("S"), b"\x00")
        # The longest that is allowed.
        names = b",".join([b"actual_q"] * 227)
        self.assertEqual(client.set_up(names)[:1], b"\x01")
        client.ask("S")
        kind, payload = client.receive()
        self.assertEqual((kind, len(payload)), (ord("U"), 1 + 227 * 48))
        self.assert_serves()

    def test_inputs_that_do_not_belong_together(self):
        client = self.connect()
        reply = client.ask("I", b"standard_digital_output_mask")
        self.assertEqual(reply, b"\x01UINT8")
        client.send(ord("U"), b"\x01\xff")
        with self.assertRaises((EOFError, ConnectionError)):
            while client.receive() is not None:
                pass
        self.assert_serves()

    def test_too_many(self):
        first = self.connect()
        for address in (self.server.address, self.server.dashboard_address):
            sockets = []
            for _ in range(120):
                sockets.append(socket.create_connection(address, 5.0))
                self.stack.callback(sockets[-1].close)
            sockets[-1].settimeout(5.0)
            with contextlib.suppress(ConnectionError):
                self.assertEqual(sockets[-1].recv(1), b"")
            self.assertEqual(first.set_up(b"timestamp"), b"\x01DOUBLE")
            for connection in sockets:
                connection.close()
        deadline = time.monotonic() + 5.0
        while True:
            try:
                self.assert_serves()
                return
            except (EOFError, ConnectionError):
                self.assertLess(time.monotonic(), deadline)

    def test_asks_and_never_reads(self):
        client, other = self.connect(), self.connect()
        client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        # Short names have long answers: 1000 times NOT_FOUND.
        names = struct.pack(">d", 125.0) + b",".join([b"q"] * 1000)
        with self.assertRaises(ConnectionError):
            for _ in range(3000):
                client.send(ord("O"), names)
        self.assertEqual(len(other.ask("v")), 16)
        self.assert_serves()

    def test_asks_a_lot_and_reads(self):
        client = self.connect()
        count = 20000
        client.socket.sendall(struct.pack(">HB", 3, ord("v")) * count)
        for _ in range(count):
            self.assertEqual(client.receive()[0], ord("v"))
        # In the order of the requests, up to the impossible one.
        client.socket.sendall(
            rtde.encode_package(ord("v"))
            + rtde.encode_version_request(1)
            + rtde.encode_package(ord("P"))
            + b"\x00\x02V"
        )
        kinds = [client.receive()[0] for _ in range(3)]
        self.assertEqual(bytes(kinds), b"vVP")
        with self.assertRaises(EOFError):
            client.receive()


class SlowTime:
    """A clock that advances by half a millisecond whenever it is read.

    For a server that reads it, work takes the same time on every computer.
    """

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        self.now += 0.0005
        return self.now


class TestFloods(unittest.TestCase):
    """The robot's cycles are on time even if a client floods the server."""

    def check(self, get_address, flood, clients=1):
        with contextlib.ExitStack() as stack:
            robot = make_robot()
            stack.enter_context(mock.patch.object(mut, "time", SlowTime()))
            server = mut.RtdeServer(robot=robot, port=0, dashboard_port=0)
            watcher = RawClient(server.address)
            stack.callback(watcher.close)
            watcher.send(ord("V"), b"\x00\x02")
            watcher.send(ord("O"), struct.pack(">d", 125.0) + b"timestamp")
            watcher.send(ord("S"))
            for _ in range(clients):
                client = socket.create_connection(get_address(server), 5.0)
                stack.callback(client.close)
                client.sendall(flood)
            # In this thread: it returns when that many cycles are done.
            server.run(lambda: robot.cycle >= 60)
            times = []
            with contextlib.suppress(EOFError):
                while True:
                    kind, payload = watcher.receive()
                    if kind == PackageType.DATA_PACKAGE:
                        times.append(struct.unpack(">xd", payload)[0])
        self.assertGreater(len(times), 30)
        return np.rint(np.diff(times) / 0.008).max()

    def test_of_requests(self):
        flood = struct.pack(">HB", 3, ord("v")) * 5000
        for clients in (1, 20):
            with self.subTest(clients=clients):
                gap = self.check(lambda s: s.address, flood, clients)
                self.assertEqual(gap, 1)

    def test_of_the_dashboard(self):
        # A line that reads the clock.
        flood = b"simulate stall 0\n" * 500
        gap = self.check(lambda s: s.dashboard_address, flood, 20)
        self.assertEqual(gap, 1)


class TestStreams(TestServer):
    def test_a_slow_client_holds_up_nobody(self):
        slow, fast = self.connect(), self.connect()
        names = ",".join(sorted(OUTPUT_TYPES)[:60]).encode()
        for dut in (slow, fast):
            dut.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.set_up(names)
        slow.ask("S")
        fast.set_up(b"timestamp")
        fast.ask("S")
        # Longer than the slow client's buffers last.
        first = struct.unpack(">xd", fast.receive()[1])[0]
        times = [first]
        while times[-1] - first < 2.0:
            times.append(struct.unpack(">xd", fast.receive()[1])[0])
        steps = np.rint(np.diff(times) / 0.008)
        self.assertEqual(np.median(steps), 1)

    def test_faults(self):
        dut = self.connect()
        dut.set_up(b"timestamp")
        dut.ask("S")

        def read(count):
            return [
                struct.unpack(">xd", payload)[0]
                for kind, payload in (dut.receive() for _ in range(count))
                if kind == PackageType.DATA_PACKAGE
            ]

        def steps(times):
            return [
                round((b - a) / 0.008) for a, b in itertools.pairwise(times)
            ]

        def do(line):
            self.server.do(f"simulate {line}")
            # Waiting packages are from before.
            dut.forget()

        times = read(2)
        do("skip 5")
        times += read(20)
        # Over all of them, as a busy computer may be late with any one.
        (passed,) = steps([times[0], times[-1]])
        self.assertGreaterEqual(passed - (len(times) - 1), 5)
        do("duplicate on")
        self.assertIn(0, steps(read(20)))
        do("duplicate off")
        do("skip-every 3")
        self.assertGreaterEqual(sum(s >= 2 for s in steps(read(30))), 8)
        do("skip-every 0")
        do("fragment 1")
        self.assertEqual(len(read(10)), 10)
        do("fragment 0")
        self.server.do("simulate coalesce 4")
        read(8)
        dut.socket.settimeout(5)
        while len(dut.socket.recv(4096)) % (4 * 12):
            pass
        self.server.do("simulate coalesce 1")
        times = read(2)
        do("clock 7")
        self.assertGreater(max(steps(times + read(2))) * 0.008, 6.9)
        before = time.monotonic()
        do("stall 0.2")
        read(2)
        self.assertGreater(time.monotonic() - before, 0.19)
        self.server.do("simulate drop")
        with self.assertRaises((EOFError, ConnectionError)):
            read(1000)

    def test_texts(self):
        self.server.do("simulate text on")
        dut = RawClient(self.server.address)
        self.stack.callback(dut.close)
        dut.send(ord("V"), b"\x00\x02")
        # Still in version 1's form.
        self.assertEqual(dut.receive(), (ord("M"), b"\x03before a reply"))
        self.assertEqual(dut.receive(), (ord("V"), b"\x01"))
        dut.set_up(b"timestamp")
        dut.ask("S")
        kinds = [dut.receive()[0] for _ in range(25)]
        self.assertGreaterEqual(kinds.count(PackageType.TEXT_MESSAGE), 2)


class TestDashboard(TestServer):
    def test_conversation(self):
        host, port = self.server.dashboard_address
        with socket.create_connection((host, port), 5.0) as console:
            lines = console.makefile("rw", newline="\n")

            def say(text):
                lines.write(text + "\n")
                lines.flush()
                return lines.readline().strip()

            self.assertEqual(
                lines.readline().strip(),
                "Connected: Universal Robots Dashboard Server",
            )
            for text, answer in (
                ("robotmode", "Robotmode: RUNNING"),
                ("safetymode", "Safetymode: NORMAL"),
                ("PolyscopeVersion", "URSoftware 3.15.8.106"),
                ("running", "Program running: true"),
                ("programState", "PLAYING pick_and_place.urp"),
                ("pause", "Pausing program"),
                ("running", "Program running: false"),
                ("play", "Starting program"),
                ("simulate safety 3", "simulating safety 3"),
                ("safetymode", "Safetymode: PROTECTIVE_STOP"),
                ("play", "Failed to execute: play"),
                ("unlock protective stop", "Protective stop releasing"),
                ("safetymode", "Safetymode: NORMAL"),
                ("stop", "Stopped"),
                ("simulate slider 0.5", "simulating slider 0.5"),
                ("nonsense", "could not understand: 'nonsense'"),
                ("simulate", "could not understand: 'simulate'"),
                ("simulate x", "could not understand: 'simulate x'"),
                (
                    "simulate slider high",
                    "could not understand: 'simulate slider high'",
                ),
                (
                    "simulate text maybe",
                    "could not understand: 'simulate text maybe'",
                ),
                (
                    "simulate fragment -1",
                    "could not understand: 'simulate fragment -1'",
                ),
                (
                    "simulate clock nan",
                    "could not understand: 'simulate clock nan'",
                ),
                (
                    "simulate slider 1 2",
                    "could not understand: 'simulate slider 1 2'",
                ),
                ("quit", "Disconnected"),
            ):
                with self.subTest(text=text):
                    self.assertEqual(say(text), answer)
            self.assertEqual(lines.readline(), "")
        self.assertEqual(self.robot.slider, 0.5)

    def test_faults_of_arm_and_robot(self):
        robot = self.server.robot
        for text, is_good in (
            ("arm-ignores-slider on", True),
            ("arm-ignores-slider 1", False),
            ("arm-slow 0.6", True),
            ("arm-slow 1.1", False),
            ("joint-offset 2 0.1", True),
            ("joint-offset 7 0.1", False),
            ("joint-offset 1", False),
            ("joint-offset 1 inf", False),
            ("joints-late 0.05", True),
            ("joints-late 2", False),
            ("tcp-offset 0 0.1 0.3", True),
            ("tcp-offset 0 0", False),
            ("tcp-offset 0 0 nan", False),
            ("clock-rate 2", True),
            ("clock-rate 0", False),
        ):
            with self.subTest(text=text):
                self.assertEqual(
                    self.server.do(f"simulate {text}"),
                    f"simulating {text}"
                    if is_good
                    else f"could not understand: 'simulate {text}'",
                )
        self.assertTrue(robot.ignores_slider)
        self.assertEqual(robot.slowest_fraction, 0.6)
        self.assertEqual(robot.joint_offset.tolist(), [0, 0.1, 0, 0, 0, 0])
        self.assertEqual(robot.joints_late, 0.05)
        self.assertEqual(robot.tcp_offset[:3].tolist(), [0, 0.1, 0.3])
        self.assertEqual(robot.clock_rate, 2.0)

    def test_frozen_slider(self):
        self.server.do("simulate slider-frozen on")
        dut = self.connect()
        dut.ask("I", b"speed_slider_mask,speed_slider_fraction")
        dut.send(ord("U"), struct.pack(">BId", 1, 1, 0.25))
        dut.ask("v")
        self.assertEqual(self.robot.slider, 1.0)


class TestAddress(unittest.TestCase):
    def test_taken(self):
        with socket.create_server(("127.0.0.1", 0)) as taken:
            host, port = taken.getsockname()
            with self.assertRaisesRegex(
                UserError, f"cannot listen at {host}:{port}: "
            ):
                mut.RtdeServer(robot=make_robot(), host=host, port=port)

    def test_nobodys(self):
        with self.assertRaisesRegex(UserError, "cannot listen"):
            mut.RtdeServer(robot=make_robot(), host="192.0.2.1", port=0)
