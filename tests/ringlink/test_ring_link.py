import dataclasses as dc
import socket
import threading
import time
import unittest

import numpy as np
from paper_cell import make_rings

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_address import SerialAddress, UdpAddress
from tofssm_drake.ringlink.ring_device import (
    PtySender,
    UdpSender,
    make_frame,
)
from tofssm_drake.ringlink.ring_frame import encode_frame
import tofssm_drake.ringlink.ring_link as mut
from tofssm_drake.ringlink.ring_receiver import RingDecoder, RingLinkConfig

_BUDGET = 0.020


def make_decoder(**changes):
    config = RingLinkConfig(settle_time=0.0, max_earliness=1.0)
    return RingDecoder(
        config=dc.replace(config, **changes),
        rings=make_rings(),
    )


def make_scan(sequence, distance=0.5):
    time = 0.001 * (sequence + 1)
    return RingScan(
        sequence=sequence,
        time=time,
        sensor_time=np.full(8, time - 0.010),
        distance=np.full(8, distance),
        status=np.zeros(8, dtype=np.uint8),
    )


def make_example(ring, sequence, distance=0.5):
    return make_frame(
        make_scan(sequence, distance), ring=ring, timing_budget=_BUDGET
    )


def wait_for(condition, timeout=120.0):
    """Returns whether a condition came true."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.001)
    return True


def find_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class LinkTest(unittest.TestCase):
    def setUp(self):
        before = set(threading.enumerate())
        self.addCleanup(
            lambda: self.assertEqual(set(threading.enumerate()), before)
        )

    def open_link(self, *addresses, **options):
        link = mut.RingLink(
            addresses=addresses, decoder=make_decoder(), **options
        )
        self.addCleanup(link.close)
        return link


class TestUdp(LinkTest):
    def setUp(self):
        super().setUp()
        self.address = UdpAddress(
            host="127.0.0.1", port=find_port(), senders=("127.0.0.1",)
        )

    def open_sender(self, address=None):
        sender = UdpSender(address or self.address)
        self.addCleanup(sender.close)
        return sender

    def test_three_rings_on_one_port(self):
        link = self.open_link(self.address)
        self.assertFalse(link.wait_for_scans(0.01))
        sender = self.open_sender()
        before = time.monotonic()
        for ring in range(3):
            self.assertTrue(sender.send(make_example(ring, 0, 0.1 * ring)))
        self.assertTrue(link.wait_for_scans(5.0))
        after = time.monotonic()
        for ring, scan in enumerate(link.get_scans()):
            np.testing.assert_allclose(scan.distance, 0.1 * ring, atol=1e-9)
            self.assertEqual(scan.sequence, 0)
            self.assertLessEqual(before, scan.time)
            self.assertLessEqual(scan.time, after)
        status = link.get_status()
        self.assertEqual(status.error, "")
        self.assertEqual(status.source, f"udp://127.0.0.1:{self.address.port}")

    def test_all_frames_arrive_in_order(self):
        tapped = []
        link = self.open_link(
            self.address, tap=lambda *piece: tapped.append(piece)
        )
        sender = self.open_sender()
        sent = [make_example(i % 3, i // 3) for i in range(300)]
        for i, frame in enumerate(sent):
            sender.send(frame)
            if i % 50 == 49:
                time.sleep(0.002)
        self.assertTrue(wait_for(lambda: link.get_scans()[2].sequence == 99))
        counts = link.get_status().counts
        for ring in ("base", "elbow", "tool"):
            self.assertEqual(counts[ring].received, 100)
            self.assertEqual(counts[ring].lost, 0)
        self.assertEqual(
            [data for _, _, data in tapped], [encode_frame(f) for f in sent]
        )
        self.assertEqual(
            {source for _, source, _ in tapped},
            {f"udp://127.0.0.1:{self.address.port}"},
        )
        times = [arrival for arrival, _, _ in tapped]
        self.assertEqual(times, sorted(times))

    def test_foreign_datagrams_are_dropped_and_counted(self):
        link = self.open_link(self.address)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreign:
            foreign.bind(("127.0.0.2", 0))
            for i in range(5):
                foreign.sendto(
                    encode_frame(make_example(0, i)),
                    ("127.0.0.1", self.address.port),
                )
        self.assertTrue(wait_for(lambda: link.get_status().foreign == 5))
        self.assertEqual(link.get_scans()[0].sequence, -1)
        self.assertEqual(link.get_status().counts["base"].received, 0)
        self.open_sender().send(make_example(0, 0))
        self.assertTrue(wait_for(lambda: link.get_scans()[0].sequence == 0))
        self.assertIn("5 foreign", link.get_status().describe(0.0))

    def test_a_named_sender(self):
        address = dc.replace(self.address, senders=("127.0.0.3",))
        link = self.open_link(address)
        self.open_sender().send(make_example(0, 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as named:
            named.bind(("127.0.0.3", 0))
            named.sendto(
                encode_frame(make_example(1, 0)), ("127.0.0.1", address.port)
            )
        self.assertTrue(wait_for(lambda: link.get_scans()[1].sequence == 0))
        self.assertTrue(wait_for(lambda: link.get_status().foreign == 1))
        self.assertEqual(link.get_scans()[0].sequence, -1)

    def test_only_the_named_interface_is_bound(self):
        self.open_link(self.address)
        other = dc.replace(self.address, host="127.0.0.4")
        # The port is free on another interface.
        self.open_link(other)

    def test_an_interface_by_its_name(self):
        link = self.open_link(dc.replace(self.address, interface="lo"))
        self.open_sender().send(make_example(0, 0))
        self.assertTrue(wait_for(lambda: link.get_scans()[0].sequence == 0))
        with self.assertRaisesRegex(UserError, "listen there: No such device"):
            self.open_link(dc.replace(self.address, interface="none0"))

    def test_two_devices_with_one_number_are_reported(self):
        link = mut.LoopbackRingLink(decoder=make_decoder())
        for i in range(200):
            for sequence in (1000 + i, i):
                data = encode_frame(make_example(1, sequence))
                link.put_datagram(data, 100.0 + 0.001 * i)
        status = link.get_status()
        self.assertEqual(status.error, "two devices have the number of elbow")
        self.assertIn("two devices", status.describe(101.0))

    def test_damage_is_counted(self):
        link = self.open_link(self.address)
        sender = self.open_sender()
        data = encode_frame(make_example(0, 0))
        for damaged in (b"", b"x", data[:-1], data + b"x", b"y" + data[1:]):
            sender.send_bytes(damaged)
        sender.send_bytes(bytes(60_000))
        sender.send(make_example(9, 0))
        sender.send_bytes(data)
        self.assertTrue(wait_for(lambda: link.get_scans()[0].sequence == 0))
        status = link.get_status()
        self.assertEqual(status.corrupt, 6)
        self.assertEqual(status.unknown, 1)

    def test_a_port_that_is_there_twice_is_reported(self):
        other = dc.replace(self.address, senders=("127.0.0.2",))
        with self.assertRaisesRegex(UserError, "is given twice"):
            self.open_link(self.address, other)

    def test_a_port_in_use_is_reported(self):
        self.open_link(self.address)
        with self.assertRaisesRegex(UserError, "cannot listen there: Address"):
            self.open_link(self.address)

    def test_an_address_of_another_machine_is_reported(self):
        address = UdpAddress(host="192.0.2.1", port=5005, senders=())
        with self.assertRaisesRegex(UserError, "udp://192.0.2.1:5005: cannot"):
            self.open_link(address)

    def test_a_failing_reader_says_so_and_delivers_nothing_more(self):
        def fail(arrival, source, data):
            raise RuntimeError("disk full")

        link = self.open_link(self.address, tap=fail)
        self.open_sender().send(make_example(0, 0))
        self.assertTrue(wait_for(lambda: link.get_status().error != ""))
        self.assertIn("disk full", link.get_status().error)
        self.assertIn("disk full", mut.explain_silence(link.get_status()))
        self.assertEqual(link.get_scans()[0].sequence, -1)

    def test_close_twice(self):
        link = self.open_link(self.address)
        link.close()
        link.close()
        with self.open_link(self.address):
            pass

    def test_explains_silence(self):
        link = self.open_link(self.address)
        sender = self.open_sender()
        sender.send(make_example(1, 0))
        sender.send(
            make_frame(
                RingScan(
                    sequence=0,
                    time=0.0,
                    sensor_time=np.zeros(16),
                    distance=np.zeros(16),
                    status=np.zeros(16, dtype=np.uint8),
                ),
                ring=2,
                timing_budget=0.0,
            )
        )
        self.assertTrue(
            wait_for(lambda: link.get_status().counts["tool"].received == 1)
        )
        self.assertEqual(
            mut.explain_silence(link.get_status()),
            f"rings: no scan of base, tool from {self.address}; frames "
            "received: base 0, elbow 1, tool 1 (1 of another size); 0 "
            "corrupt, 0 foreign, 0 of unknown rings",
        )


class TestSerial(LinkTest):
    def open_line(self):
        sender = PtySender()
        link = self.open_link(SerialAddress(path=sender.path))
        return sender, link

    def test_frames_in_pieces_and_damaged(self):
        sender, link = self.open_line()
        self.addCleanup(sender.close)
        self.assertEqual(sender.target, link.get_status().source)
        for i in range(20):
            for ring in range(3):
                sender.send(make_example(ring, i))
            sender.send_bytes(b"\x05garbage\0")
        self.assertTrue(wait_for(lambda: link.get_scans()[2].sequence == 19))
        status = link.get_status()
        self.assertEqual(sum(c.lost for c in status.counts.values()), 0)
        self.assertTrue(wait_for(lambda: link.get_status().corrupt == 20))

    def test_a_line_that_breaks_is_reported_and_opened_again(self):
        import os
        import pathlib
        import tempfile

        sender = PtySender()
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        path = pathlib.Path(folder.name) / "ttyRing"
        path.symlink_to(sender.path)
        link = self.open_link(SerialAddress(path=str(path)))
        sender.send(make_example(0, 0))
        sender.send(make_example(0, 1))
        self.assertTrue(wait_for(lambda: link.get_scans()[0].sequence >= 0))
        scan = link.get_scans()[0]
        sender.close()
        path.unlink()
        self.assertTrue(wait_for(lambda: "is gone" in link.get_status().error))
        self.assertIs(link.get_scans()[0], scan)
        again = PtySender()
        self.addCleanup(again.close)
        os.symlink(again.path, path)
        self.assertTrue(wait_for(lambda: link.get_status().error == ""))
        again.send(make_example(0, 5))
        again.send(make_example(0, 6))
        self.assertTrue(
            wait_for(lambda: link.get_scans()[0].sequence > scan.sequence)
        )

    def test_what_lay_in_the_buffer_is_thrown_away(self):
        sender = PtySender()
        self.addCleanup(sender.close)
        sender.send(make_example(0, 0))
        link = self.open_link(SerialAddress(path=sender.path))
        sender.send_bytes(b"\0")
        sender.send(make_example(1, 0))
        self.assertTrue(wait_for(lambda: link.get_scans()[1].sequence == 0))
        self.assertEqual(link.get_scans()[0].sequence, -1)

    def test_a_missing_line_is_reported(self):
        with self.assertRaisesRegex(UserError, "cannot open it: No such file"):
            self.open_link(SerialAddress(path="/dev/there-is-none"))

    def test_what_is_not_a_line_is_reported_plainly(self):
        with self.assertRaisesRegex(
            UserError, "^serial:///etc/passwd: .*: it is not a serial line$"
        ):
            self.open_link(SerialAddress(path="/etc/passwd"))

    def test_a_line_that_is_in_use_is_reported(self):
        sender, _ = self.open_line()
        self.addCleanup(sender.close)
        with self.assertRaisesRegex(UserError, "another program has it"):
            self.open_link(SerialAddress(path=sender.path))


class TestOtherLinks(unittest.TestCase):
    def test_loopback(self):
        link = mut.LoopbackRingLink(decoder=make_decoder())
        self.assertFalse(link.wait_for_scans(10.0))
        for ring in range(3):
            self.assertTrue(
                link.put_datagram(encode_frame(make_example(ring, 0)), 7.0)
            )
        self.assertTrue(link.wait_for_scans(10.0))
        self.assertEqual([s.time for s in link.get_scans()], [7.0] * 3)
        # Half the timing budget and a millisecond on the way.
        self.assertAlmostEqual(link.get_status().measured["tool"], 6.989)
        self.assertEqual(
            link.get_status().describe(7.05),
            "base 61 ms, elbow 61 ms, tool 61 ms",
        )
        link.close()

    def test_a_sample_of_unknown_age_does_not_count(self):
        scan = RingScan(sensor_time=np.array([3.0, -np.inf, 2.5]))
        self.assertEqual(mut.calc_measured_time(scan), 2.5)
        for scan in (RingScan(), RingScan(sensor_time=np.full(3, -np.inf))):
            self.assertEqual(mut.calc_measured_time(scan), -np.inf)

    def test_a_link_beyond_its_budget_is_reported(self):
        """Frames of 24 ms that come half a second late at once."""
        link = mut.LoopbackRingLink(decoder=make_decoder())
        for i in range(200):
            frame = dc.replace(make_example(1, i), time_us=24_000 * i)
            delay = 0.5 if i >= 100 else 0.0
            link.put_datagram(encode_frame(frame), 100.0 + 0.024 * i + delay)
        status = link.get_status()
        problem = "samples 511 ms old on arrival, 34 ms allowed"
        self.assertEqual(status.problem["elbow"], problem)
        self.assertIn(
            f"elbow 511 ms, tool -; elbow: {problem} (period 24.0 ms, 0 % lost",
            status.describe(100.0 + 0.024 * 199 + 0.5),
        )

    def test_null(self):
        link = mut.NullRingLink(decoder=make_decoder())
        self.assertFalse(link.wait_for_scans(10.0))
        self.assertEqual([s.sequence for s in link.get_scans()], [-1] * 3)
        self.assertEqual(
            link.get_status().describe(0.0), "base -, elbow -, tool -"
        )
        link.close()


if __name__ == "__main__":
    unittest.main()
