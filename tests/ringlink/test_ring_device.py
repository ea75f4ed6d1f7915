import os
import socket
import unittest

import numpy as np

from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_address import UdpAddress
import tofssm_drake.ringlink.ring_device as mut
from tofssm_drake.ringlink.ring_frame import (
    FrameError,
    decode_frame,
    encode_frame,
)


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
        # The device does not know its period.
        self.assertEqual(frame.period_ms.tolist(), [0] * 8)
        encode_frame(frame)

    def test_period(self):
        for period, expected in ((0.024, 24), (0.3, 255)):
            frame = mut.make_frame(
                make_scan(), ring=2, timing_budget=0.020, period=period
            )
            self.assertEqual(frame.period_ms.tolist(), [expected] * 8)

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


if __name__ == "__main__":
    unittest.main()
