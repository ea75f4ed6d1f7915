import dataclasses as dc
import os
import socket
import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.hardware.ring_address import UdpAddress
import tofssm_drake.hardware.ring_device as mut
from tofssm_drake.hardware.ring_fault_injection import (
    FAULTS,
    FaultInjector,
    RingFault,
    damage,
    parse_ring_fault,
)
from tofssm_drake.hardware.ring_frame import (
    FrameError,
    FrameStream,
    decode_frame,
    encode_frame,
    encode_serial,
)
from tofssm_drake.messages import RingScan


def make_scan(sequence=3, time=10.0):
    return RingScan(
        sequence=sequence,
        time=time,
        sensor_time=time - 0.010 - np.array([0, 1, 2, 3, 4, 5, 245, 300]) / 1e3,
        distance=np.array([0.0, 0.0404, 0.0406, 1.3, 4.0, 65.535, 70.0, 0.5]),
        status=np.array([3, 0, 0, 2, 4, 255, 1, 254], dtype=np.uint8),
    )


class TestMakeFrame(unittest.TestCase):
    def test_fields(self):
        frame = mut.make_frame(make_scan(), ring=2, timing_budget=0.020)
        self.assertEqual((frame.ring, frame.sequence), (2, 3))
        self.assertEqual(frame.time_us, 10_000_000)
        self.assertEqual(
            frame.mm.tolist(), [0, 40, 41, 1300, 4000, 65535, 65535, 500]
        )
        self.assertEqual(frame.status.tolist(), [3, 0, 0, 2, 4, 255, 1, 254])
        self.assertEqual(frame.age_ms.tolist(), [0, 1, 2, 3, 4, 5, 245, 255])
        encode_frame(frame)

    def test_clock_and_sequence_wrap(self):
        clock = mut.DeviceClock(start=4294.0, drift=100e-6)
        frame = mut.make_frame(
            make_scan(sequence=65537), ring=0, timing_budget=0.02, clock=clock
        )
        self.assertEqual(frame.sequence, 1)
        self.assertEqual(frame.time_us, 4_304_001_000 - 2**32)


class TestSenders(unittest.TestCase):
    def test_udp_comes_from_the_named_address(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.5", 0))
            receiver.settimeout(5.0)
            address = UdpAddress(
                host="127.0.0.5",
                port=receiver.getsockname()[1],
                senders=("127.0.0.5",),
            )
            sender = mut.UdpSender(address)
            self.addCleanup(sender.close)
            frame = mut.make_frame(make_scan(), ring=0, timing_budget=0.02)
            self.assertTrue(sender.send(frame))
            data, (host, _) = receiver.recvfrom(1000)
            self.assertEqual(data, encode_frame(frame))
            self.assertEqual(host, "127.0.0.5")
            self.assertTrue(sender.send(frame, True))
            with self.assertRaises(FrameError):
                decode_frame(receiver.recv(1000))

    def test_a_pty_that_nobody_reads_does_not_block(self):
        sender = mut.PtySender()
        self.addCleanup(sender.close)
        frame = mut.make_frame(make_scan(), ring=0, timing_budget=0.02)
        sent = [sender.send(frame) for _ in range(1000)]
        self.assertTrue(sent[0])
        self.assertFalse(sent[-1])

    def test_a_pty_carries_any_byte(self):
        sender = mut.PtySender()
        self.addCleanup(sender.close)
        reader = os.open(sender.path, os.O_RDONLY | os.O_NOCTTY)
        self.addCleanup(os.close, reader)
        data = bytes(range(256))
        self.assertTrue(sender.send_bytes(data))
        received = b""
        while len(received) < 256:
            received += os.read(reader, 256)
        self.assertEqual(received, data)


class TestFaults(unittest.TestCase):
    def test_parse(self):
        self.assertEqual(
            parse_ring_fault("silent:elbow@20-25.5"),
            RingFault(kind="silent", ring="elbow", start=20.0, end=25.5),
        )
        self.assertEqual(parse_ring_fault("late:base@3").end, np.inf)
        for text, message in (
            ("", "no fault"),
            ("silent", "no fault"),
            ("silent:elbow", "no fault"),
            ("silent:elbow@", "no fault"),
            ("silent:elbow@-1", "no fault"),
            ("silent:elbow@nan", "no fault"),
            ("loud:elbow@1", "'loud' is unknown"),
            ("silent:wrist@1", "no ring 'wrist'"),
            ("silent:elbow@5-5", "ends before"),
        ):
            with self.subTest(text=text):
                with self.assertRaisesRegex(UserError, message):
                    parse_ring_fault(text)

    def run_fault(self, kind):
        """Frames 0 to 29; the fault is there from 10 to 20."""
        injector = FaultInjector(
            [RingFault(kind=kind, ring="base", start=1.0, end=2.0)]
        )
        result = []
        for i in range(30):
            scan = dc.replace(
                make_scan(sequence=i), distance=np.full(8, 0.5 + 0.01 * i)
            )
            frame = mut.make_frame(scan, ring=0, timing_budget=0.02)
            frame = dc.replace(frame, time_us=1000 * i)
            result.append((frame, *injector.apply(frame, 0.1 * i + 0.001)))
        for i in (*range(10), *range(20, 30)):
            self.assertIs(result[i][0], result[i][1])
            self.assertFalse(result[i][2])
        return result[10:20]

    def test_each_does_what_it_says(self):
        done = {kind: self.run_fault(kind) for kind in FAULTS}
        self.assertEqual([f for _, f, _ in done["silent"]], [None] * 10)
        self.assertTrue(all(damaged for _, _, damaged in done["corrupt"]))
        first = done["duplicate"][0][0]
        self.assertTrue(all(f is first for _, f, _ in done["duplicate"]))
        for sent, frame, _ in done["frozen"]:
            self.assertEqual(frame.sequence, sent.sequence)
            self.assertEqual(frame.time_us, sent.time_us)
            self.assertEqual(frame.mm.tolist(), [600] * 8)
        self.assertEqual([f for _, f, _ in done["late"][:8]], [None] * 8)
        self.assertIs(done["late"][8][1], done["late"][0][0])
        for _, frame, _ in done["implausible"]:
            self.assertEqual(frame.mm.tolist(), [65535] * 8)
            self.assertEqual(frame.status.tolist(), [0] * 8)
        for _, frame, _ in done["bus"]:
            self.assertEqual(frame.status.tolist(), [253] * 8)
        for _, frame, _ in done["restart"]:
            self.assertEqual(frame.flags, 1)
        for kind in ("frozen", "implausible", "bus", "restart"):
            for _, frame, _ in done[kind]:
                encode_frame(frame)

    @given(st.integers(0, 65535), st.integers(0, 2**32 - 1))
    def test_damage_is_always_seen(self, sequence, time_us):
        frame = mut.make_frame(make_scan(), ring=0, timing_budget=0.02)
        frame = dc.replace(frame, sequence=sequence, time_us=time_us)
        with self.assertRaises(FrameError):
            decode_frame(damage(encode_frame(frame)))
        stream = FrameStream()
        stream.push(b"\0")
        line = encode_serial(frame)
        self.assertEqual(stream.push(damage(line)), [])
        self.assertEqual(sum(stream.errors.values()), 1)
        self.assertEqual(len(stream.push(line)), 1)


if __name__ == "__main__":
    unittest.main()
