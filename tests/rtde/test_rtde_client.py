import math
import socket
import threading
import time
import unittest

import numpy as np
from odd_server import POSITION, OddServer
from robot_room import make_robot, serve

from tofssm_drake.errors import UserError
from tofssm_drake.messages import SliderCommand
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.rtde.rtde_fields import OUTPUT_TYPES
import tofssm_drake.rtde.rtde_protocol as rtde
from tofssm_drake.rtde.rtde_protocol import PackageType
from tofssm_drake.rtde.rtde_server import Faults


def connect(server, **settings):
    """Connects quickly, for tests."""
    settings = {
        "port": getattr(server, "port", None) or server.address[1],
        "reply_timeout": 1.0,
        "retry_first": 0.01,
        "retry_last": 0.02,
    } | settings
    return RtdeClient(RtdeConfig(**settings))


def wait_until(condition, timeout=120.0):
    """Waits until a condition holds; returns whether it does."""
    deadline = time.monotonic() + timeout
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.002)
    return condition()


class TestStream(unittest.TestCase):
    def test_report_is_what_was_sent(self):
        class Server(OddServer):
            def stream(self):
                self.send(
                    self.make_package(
                        100.0,
                        actual_qd=(1, 2, 3, 4, 5, 6),
                        target_qdd=(7,) * 6,
                        actual_TCP_pose=(8,) * 6,
                        actual_TCP_speed=(9,) * 6,
                        actual_digital_input_bits=1 << 17,
                        actual_digital_output_bits=3,
                        robot_mode=-1,
                        safety_mode=3,
                        safety_status=4,
                        robot_status_bits=5,
                        safety_status_bits=6,
                        runtime_state=4,
                        speed_scaling=0.5,
                        target_speed_fraction=0.25,
                        output_int_register_24=2,
                    )
                )

        before = time.monotonic()
        with Server() as server, connect(server) as dut:
            report = dut.wait_for_report(after=-1, timeout=120)
            self.assertEqual(report.sequence, 0)
            self.assertEqual(report.session, 0)
            self.assertEqual(report.timestamp, 100.0)
            self.assertLess(before, report.time)
            self.assertLess(report.time, time.monotonic())
            for name, value in (
                ("position", POSITION),
                ("velocity", (1, 2, 3, 4, 5, 6)),
                ("acceleration_commanded", (7,) * 6),
                ("tcp_pose", (8,) * 6),
                ("tcp_velocity", (9,) * 6),
            ):
                np.testing.assert_array_equal(getattr(report, name), value)
                self.assertFalse(getattr(report, name).flags.writeable)
            self.assertEqual(report.digital_inputs, 1 << 17)
            self.assertEqual(report.digital_outputs, 3)
            self.assertEqual(report.robot_mode, -1)
            self.assertEqual(report.safety_mode, 3)
            self.assertEqual(report.safety_status, 4)
            self.assertEqual(report.robot_status_bits, 5)
            self.assertEqual(report.safety_status_bits, 6)
            self.assertEqual(report.runtime_state, 4)
            self.assertEqual(report.speed_scaling, 0.5)
            self.assertEqual(report.target_speed_fraction, 0.25)
            self.assertEqual(report.products_placed, 2)

    def test_any_cuts_and_texts_anywhere(self):
        """Every byte alone, and all together."""

        class Server(OddServer):
            piece = 1

            def send(self, data):
                text = rtde.encode_text(
                    rtde.TextMessage("x" * 200), version=self.version
                )
                data = text + data + text
                self.connection.setsockopt(
                    socket.IPPROTO_TCP, socket.TCP_NODELAY, 1
                )
                for i in range(0, len(data), self.piece):
                    self.connection.sendall(data[i : i + self.piece])

            def stream(self):
                self.send(
                    b"".join(self.make_package(100 + i) for i in range(5))
                )

        for piece in (1, 10000):
            Server.piece = piece
            with (
                self.subTest(piece=piece),
                Server() as server,
                connect(server, stream_timeout=1.0, clock_jump=2.0) as dut,
            ):
                self.assertTrue(
                    wait_until(lambda d=dut: d.get_report().sequence >= 4)
                )
                status = dut.get_status()
                self.assertEqual(status.rejected, 0)
                self.assertGreaterEqual(status.texts, 10)
                self.assertEqual(status.last_text, "x" * 200)

    def test_gaps_are_counted_by_the_robots_clock(self):
        class Server(OddServer):
            def stream(self):
                for k in (0, 1, 2, 5, 6, 6, 10):
                    self.send(self.make_package(100 + 0.008 * k))

        with Server() as server, connect(server, stream_timeout=10) as dut:
            self.assertTrue(wait_until(lambda: dut.get_report().sequence == 5))
            status = dut.get_status()
            self.assertEqual(dut.get_report().missed, 5)
            self.assertEqual(status.missed, 5)
            self.assertEqual(status.packages, 6)
            self.assertEqual(status.repeated, 1)

    def test_robots_clock_going_back_or_jumping_is_a_new_session(self):
        class Server(OddServer):
            def stream(self):
                for t in (100.0, 100.008, 3.0, 3.008, 50.0):
                    self.send(self.make_package(t))

        with Server() as server, connect(server, stream_timeout=10) as dut:
            self.assertTrue(wait_until(lambda: dut.get_report().sequence == 4))
            self.assertEqual(dut.get_report().session, 2)
            self.assertEqual(dut.get_report().missed, 0)

    def test_robots_clock_gaining_on_the_hosts_is_a_new_session(self):
        """Though each step is one that a robot can make."""

        class Server(OddServer):
            def stream(self):
                for t in (100.0, 100.2, 100.5, 101.4):
                    self.send(self.make_package(t))
                time.sleep(0.3)
                # As much went by here.
                self.send(self.make_package(101.7))

        with Server() as server, connect(server, stream_timeout=10) as dut:
            self.assertTrue(wait_until(lambda: dut.get_report().sequence == 4))
            self.assertEqual(dut.get_report().session, 2)

    def test_bad_packages_are_counted_and_dropped(self):
        class Server(OddServer):
            def stream(self):
                good = self.make_package(100.0)
                for bad in (
                    self.make_package(100.008, number=2),
                    rtde.encode_package(PackageType.DATA_PACKAGE, b"\x01"),
                    rtde.encode_package(PackageType.DATA_PACKAGE),
                    self.make_package(math.nan),
                    self.make_package(
                        100.008, actual_q=(0, 0, 0, math.inf, 0, 0)
                    ),
                    rtde.encode_package(200, b"whatever"),
                    rtde.encode_package(PackageType.TEXT_MESSAGE, b"\x05"),
                ):
                    self.send(bad)
                self.send(good)

        with Server() as server, connect(server, stream_timeout=10) as dut:
            report = dut.wait_for_report(after=-1, timeout=120)
            self.assertEqual(report.timestamp, 100.0)
            self.assertEqual(dut.get_status().rejected, 5)
            self.assertEqual(dut.get_status().texts, 1)

    def test_says_that_it_rejects_all_data(self):
        class Server(OddServer):
            def stream(self):
                self.send(self.make_package(100.0, number=2))

        with Server() as server, connect(server, reply_timeout=0.3) as dut:
            for why in (
                "data are rejected: data package of recipe 2: expected 1",
                "no package for 0.1 s; data are rejected: data package of",
            ):
                self.assertTrue(
                    wait_until(lambda why=why: why in dut.get_status().problem),
                    dut.get_status(),
                )

    def test_silence_and_frozen_clock_end_the_connection(self):
        class Silent(OddServer):
            pass

        class Frozen(OddServer):
            def stream(self):
                deadline = time.monotonic() + 1.0
                while time.monotonic() < deadline:
                    self.send(self.make_package(100.0))
                    time.sleep(0.008)

        for server_class in (Silent, Frozen):
            with (
                self.subTest(server=server_class.__name__),
                server_class() as server,
                connect(server) as dut,
            ):
                self.assertTrue(wait_until(lambda s=server: s.connections >= 3))
                report = dut.get_report()
                self.assertGreaterEqual(report.session, 1)
                self.assertTrue(
                    wait_until(
                        lambda d=dut: (
                            "no package for 0.1 s" in d.get_status().problem
                        )
                    )
                )

    def test_size_below_header_ends_the_connection(self):
        class Server(OddServer):
            def stream(self):
                super().stream()
                self.send(b"\x00\x02U")

        with Server() as server, connect(server, stream_timeout=10) as dut:
            self.assertTrue(wait_until(lambda: server.streams >= 3))
            self.assertGreaterEqual(dut.get_status().connections, 2)

    def test_damaged_streams_never_end_the_thread(self):
        """Random bytes for data: it reconnects and reads on."""
        random = np.random.default_rng(5)

        class Server(OddServer):
            def stream(self):
                if self.streams % 2:
                    self.send(random.bytes(random.integers(1, 3000)))
                    self.connection.shutdown(socket.SHUT_RDWR)
                else:
                    super().stream()
                    self.connection.shutdown(socket.SHUT_RDWR)

        with Server() as server, connect(server) as dut:
            self.assertTrue(wait_until(lambda: server.streams >= 20))
            self.assertGreaterEqual(dut.get_report().sequence, 40)


class TestHandshake(unittest.TestCase):
    def check_problem(self, server_class, message, **settings):
        with server_class() as server, connect(server, **settings) as dut:
            self.assertTrue(
                wait_until(lambda: message in dut.get_status().problem),
                dut.get_status().problem,
            )
            self.assertFalse(dut.get_status().connected)
            self.assertEqual(dut.get_report().sequence, -1)
            # It tries again.
            self.assertTrue(wait_until(lambda: server.connections >= 2))

    def test_version_1(self):
        class Server(OddServer):
            def on_version(self, version):
                if version == 1:
                    return super().on_version(1)
                return rtde.encode_accepted(
                    PackageType.REQUEST_PROTOCOL_VERSION, False
                )

        with Server() as server, connect(server) as dut:
            report = dut.wait_for_report(after=-1, timeout=120)
            np.testing.assert_array_equal(report.position, POSITION)

    def test_neither_version(self):
        class Server(OddServer):
            def on_version(self, version):
                return rtde.encode_accepted(
                    PackageType.REQUEST_PROTOCOL_VERSION, False
                )

        self.check_problem(Server, "neither RTDE version 2 nor 1")

    def test_data_before_the_answer_to_start(self):
        class Server(OddServer):
            def answer(self, kind, payload):
                if kind == PackageType.START:
                    self.send(self.make_package(99.0))
                return super().answer(kind, payload)

        with (
            Server() as server,
            connect(server, clock_jump=5.0) as dut,
        ):
            report = dut.wait_for_report(after=-1, timeout=120)
            self.assertEqual(report.session, 0)
            self.assertTrue(wait_until(lambda: dut.get_report().sequence >= 5))

    def test_optional_outputs_are_left_out(self):
        class Server(OddServer):
            known = {  # noqa: RUF012
                name: kind
                for name, kind in OUTPUT_TYPES.items()
                if name
                not in ("safety_status", "actual_TCP_pose", "speed_scaling")
            }

        with Server() as server, connect(server) as dut:
            report = dut.wait_for_report(after=-1, timeout=120)
            self.assertEqual(report.safety_status, -1)
            self.assertTrue(np.isnan(report.tcp_pose).all())
            self.assertTrue(math.isnan(report.speed_scaling))
            np.testing.assert_array_equal(report.position, POSITION)
            self.assertEqual(report.runtime_state, 2)
            self.assertNotIn("safety_status", dut.get_status().types)

    def test_required_outputs_are_not(self):
        class Server(OddServer):
            known = {  # noqa: RUF012
                name: kind
                for name, kind in OUTPUT_TYPES.items()
                if name not in ("actual_qd", "safety_mode")
            }

        self.check_problem(
            Server, "does not know the outputs actual_qd, safety_mode"
        )

    def test_refused_setups(self):
        class WrongType(OddServer):
            known = OUTPUT_TYPES | {"robot_mode": "DOUBLE"}

        class ZeroRecipe(OddServer):
            def on_outputs(self, names):
                types = tuple(OUTPUT_TYPES[name] for name in names)
                return rtde.encode_output_setup_reply(rtde.Setup(0, types))

        class TooFew(OddServer):
            def on_outputs(self, names):
                return rtde.encode_output_setup_reply(
                    rtde.Setup(1, ("DOUBLE",))
                )

        class Names(OddServer):
            def on_outputs(self, names):
                return rtde.encode_output_setup_reply(rtde.Setup(1, names))

        class NoStart(OddServer):
            def answer(self, kind, payload):
                if kind == PackageType.START:
                    return rtde.encode_accepted(kind, False)
                return super().answer(kind, payload)

            def stream(self):
                pass

        class Mute(OddServer):
            def on_outputs(self, names):
                return None

        for server_class, message in (
            (WrongType, "unexpected types: robot_mode is DOUBLE"),
            (ZeroRecipe, "refused 125 Hz or the outputs"),
            (TooFew, "18 outputs, 1 answered"),
            (Names, "unexpected types"),
            (NoStart, "refused to start"),
            (Mute, "no answer to SETUP_OUTPUTS"),
        ):
            with self.subTest(server=server_class.__name__):
                self.check_problem(server_class, message, reply_timeout=0.1)

    def test_refused_inputs(self):
        class Server(OddServer):
            types = ()
            number = 1

            def on_inputs(self, names):
                return rtde.encode_input_setup_reply(
                    rtde.Setup(self.number, self.types)
                )

        for types, number, message in (
            (
                ("IN_USE", "IN_USE", "INT32"),
                0,
                "speed_slider_mask, speed_slider_fraction in use: a fieldbus",
            ),
            (
                ("UINT32", "DOUBLE", "NOT_FOUND"),
                0,
                "does not know the inputs input_int_register_24",
            ),
            (("UINT32", "DOUBLE", "INT32"), 0, "refused the inputs"),
            (("UINT32", "DOUBLE"), 1, "unexpected types of inputs"),
        ):
            Server.types, Server.number = types, number
            with self.subTest(message=message):
                self.check_problem(Server, message)

    def test_lenient(self):
        class Server(OddServer):
            """Answers names, numbers all recipes 0, knows four fields."""

            known = {  # noqa: RUF012
                name: name
                for name in ("timestamp", "actual_q", "actual_qd", "robot_mode")
            }

            def on_outputs(self, names):
                types = tuple(self.known.get(n, rtde.NOT_FOUND) for n in names)
                return rtde.encode_output_setup_reply(rtde.Setup(0, types))

            def on_inputs(self, names):
                return rtde.encode_input_setup_reply(rtde.Setup(0, names))

            def stream(self):
                for i in range(5):
                    self.send(
                        self.make_package(1.0 + i, number=9, robot_mode=0)
                    )

        with (
            Server() as server,
            connect(server, lenient=True, clock_jump=2) as dut,
        ):
            report = dut.wait_for_report(after=-1, timeout=120)
            np.testing.assert_array_equal(report.position, POSITION)
            self.assertEqual(report.robot_mode, 0)
            self.assertEqual(report.safety_mode, -1)
            self.assertTrue(dut.get_status().writes)
        self.check_problem(Server, "does not know the outputs")

    def test_nobody_there(self):
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
        with RtdeClient(RtdeConfig(port=port, retry_first=0.01)) as dut:
            self.assertTrue(
                wait_until(
                    lambda: "Connection refused" in dut.get_status().problem
                )
            )
            self.assertEqual(
                dut.wait_for_report(after=-1, timeout=0.01).sequence, -1
            )
        self.assertEqual(dut.get_status().problem, "closed")

    def test_settings_are_checked(self):
        for settings, message in (
            ({"port": 0}, "robot.port: must be from 1 to 65535, got 0"),
            ({"host": ""}, "robot.host"),
            ({"frequency": 501.0}, "robot.frequency"),
            ({"frequency": math.nan}, "robot.frequency"),
            ({"heartbeat_register": 48}, "robot.heartbeat_register"),
            ({"stream_timeout": 0.0}, "robot.stream_timeout"),
            ({"retry_last": 0.01}, "robot.retry_last"),
        ):
            with (
                self.subTest(settings=settings),
                self.assertRaisesRegex(UserError, message),
            ):
                RtdeClient(RtdeConfig(**settings))


class TestWriting(unittest.TestCase):
    def test_bytes_and_goodbye(self):
        class Server(OddServer):
            def stream(self):
                self.send(self.make_package(100.0, target_speed_fraction=0.0))

        with Server() as server:
            with connect(server, stream_timeout=10) as dut:
                dut.wait_for_report(after=-1, timeout=120)
                self.assertFalse(dut.send(SliderCommand()))
                command = SliderCommand(
                    sequence=0, mask=1, speed_fraction=0.25, heartbeat=7
                )
                self.assertTrue(dut.send(command))
                with self.assertRaises(ValueError):
                    dut.send(SliderCommand(sequence=0, speed_fraction=math.nan))
            self.assertTrue(wait_until(lambda: server.goodbyes == 1))
        self.assertEqual(
            [payload.hex() for _, payload in server.received],
            [
                "01000000013fd000000000000000000007",
                # A client that leaves stops the robot.
                "01000000010000000000000000" + "00000007",
            ],
        )
        self.assertFalse(dut.send(command))

    def test_read_only_never_writes(self):
        with (
            serve() as server,
            connect(server, write=False) as dut,
        ):
            dut.wait_for_report(after=-1, timeout=120)
            self.assertFalse(dut.send(SliderCommand(sequence=0, mask=1)))
            self.assertFalse(dut.get_status().writes)
        self.assertEqual(server.robot.slider, 1.0)

    def test_robot_that_does_not_read(self):
        """Sending never blocks: the connection is given up instead."""

        class Server(OddServer):
            def stream(self):
                self.connection.setsockopt(
                    socket.SOL_SOCKET, socket.SO_RCVBUF, 4096
                )
                k = 0
                while not self._closed:
                    k += 1
                    self.send(self.make_package(100 + 0.008 * k))
                    time.sleep(0.008)

        with Server() as server, connect(server) as dut:
            report = dut.wait_for_report(after=-1, timeout=120)
            command = SliderCommand(sequence=report.sequence)
            longest = 0.0
            sent = True
            deadline = time.monotonic() + 20
            while sent and time.monotonic() < deadline:
                before = time.thread_time()
                sent = dut.send(command)
                longest = max(longest, time.thread_time() - before)
            self.assertFalse(sent)
            self.assertTrue(wait_until(lambda: server.connections >= 2))

    def test_tap_sees_everything(self):
        seen = []
        with serve() as server:
            client = RtdeClient(
                RtdeConfig(port=server.address[1]),
                tap=lambda *package: seen.append(package),
            )
            with client:
                report = client.wait_for_report(after=-1, timeout=120)
                client.send(
                    SliderCommand(sequence=report.sequence, heartbeat=3)
                )
        sent = [p for _, is_sent, p in seen if is_sent]
        received = [p for _, is_sent, p in seen if not is_sent]
        self.assertEqual(sent[0], bytes.fromhex("0005560002"))
        self.assertEqual(received[0], bytes.fromhex("00045601"))
        self.assertIn(
            bytes.fromhex("0014 55 01 00000000 0000000000000000 00000003"),
            sent,
        )


class TestWithSimulatedRobot(unittest.TestCase):
    def test_in_use_is_reported_and_retried(self):
        with serve() as server, connect(server) as first:
            first.wait_for_report(after=-1, timeout=120)
            with connect(server) as dut:
                self.assertTrue(
                    wait_until(lambda: "in use" in dut.get_status().problem)
                )
                first.close()
                self.assertGreaterEqual(
                    dut.wait_for_report(after=-1, timeout=120).sequence, 0
                )
                self.assertTrue(dut.get_status().writes)

    def test_all_faults_at_once(self):
        faults = Faults(
            text_messages=True, skip_every=7, fragment=11, duplicate=True
        )
        with (
            serve(faults=faults) as server,
            connect(server, stream_timeout=10) as dut,
        ):
            self.assertTrue(wait_until(lambda: dut.get_report().sequence > 60))
            status = dut.get_status()
            self.assertGreaterEqual(status.missed, 8)
            self.assertGreaterEqual(status.repeated, 50)
            self.assertEqual(status.rejected, 0)
            self.assertEqual(status.connections, 1)

    def test_a_pause_of_the_reader_is_no_silence(self):
        """Data that came meanwhile are read before the robot counts as gone."""
        pauses = iter([0.3])
        was_paused = threading.Event()

        def pause_once(arrival, was_sent, package):
            if package[2] == PackageType.DATA_PACKAGE:
                for duration in pauses:
                    time.sleep(duration)
                    was_paused.set()

        with (
            serve() as server,
            RtdeClient(
                RtdeConfig(port=server.address[1]), tap=pause_once
            ) as dut,
        ):
            self.assertTrue(was_paused.wait(5.0))
            before = dut.get_report().sequence
            self.assertTrue(
                wait_until(lambda: dut.get_report().sequence > before + 5)
            )
            self.assertEqual(dut.get_report().session, 0)
            self.assertEqual(dut.get_status().connections, 1)

    def test_drop_restart_and_stall(self):
        with serve() as server, connect(server) as dut:
            for fault in (
                "simulate drop",
                "simulate restart",
                "simulate stall 0.3",
            ):
                with self.subTest(fault=fault):
                    report = dut.wait_for_report(
                        after=dut.get_report().sequence, timeout=5
                    )
                    before = report.session
                    threads = threading.active_count()
                    server.do(fault)
                    self.assertTrue(
                        wait_until(
                            lambda b=before: dut.get_report().session > b
                        )
                    )
                    self.assertTrue(
                        dut.send(
                            SliderCommand(
                                sequence=dut.get_report().sequence,
                                mask=1,
                                speed_fraction=0.5,
                            )
                        )
                    )
                    self.assertTrue(
                        wait_until(
                            lambda: (
                                dut.get_report().target_speed_fraction == 0.5
                            )
                        )
                    )
                    self.assertEqual(threading.active_count(), threads)

    def test_what_answers_a_report_of_before_is_not_sent(self):
        """Otherwise a slow tick could move a robot that has restarted."""
        robot = make_robot()
        with serve(robot) as server, connect(server) as dut:
            old = dut.wait_for_report(after=-1, timeout=120)
            server.drop_clients()
            self.assertTrue(
                wait_until(lambda: dut.get_report().session > old.session)
            )
            for report, was_sent in ((old, False), (dut.get_report(), True)):
                command = SliderCommand(sequence=report.sequence)
                self.assertEqual(dut.send(command), was_sent)

    def test_closing_waits_for_a_robot_that_was_just_lost(self):
        robot = make_robot()
        with serve(robot) as server:
            with connect(server, retry_first=0.05, retry_last=0.05) as dut:
                dut.wait_for_report(after=-1, timeout=120)
                server.drop_clients()
                self.assertTrue(
                    wait_until(lambda: not dut.get_status().connected)
                )
            self.assertTrue(wait_until(lambda: robot.slider == 0.0, 1.0))

    def test_closing_leaves_the_robot_stopped(self):
        robot = make_robot()
        with serve(robot) as server:
            with connect(server) as dut:
                dut.wait_for_report(after=-1, timeout=120)
            self.assertEqual(robot.slider, 0.0)
            self.assertTrue(wait_until(lambda: not server._claims))
