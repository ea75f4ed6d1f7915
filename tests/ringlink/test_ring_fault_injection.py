import dataclasses as dc
import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_device import make_frame
import tofssm_drake.ringlink.ring_fault_injection as mut
from tofssm_drake.ringlink.ring_frame import (
    FrameError,
    FrameStream,
    decode_frame,
    encode_frame,
    encode_serial,
)

_PERIOD = 0.024


def make_device_frame(sequence):
    """A frame of 8 sensors at sequence * 24 ms, all with a distance."""
    time = _PERIOD * sequence
    scan = RingScan(
        sequence=sequence,
        time=time,
        sensor_time=np.full(8, time - 0.015),
        distance=0.5 + 0.01 * sequence + 0.001 * np.arange(8),
        status=np.zeros(8, dtype=np.uint8),
    )
    return make_frame(scan, ring=0, timing_budget=0.02, period=_PERIOD)


def run(kind, count=10, *, sensor=None):
    """Returns each original frame with what came instead, or None."""
    fault = mut.RingFault(kind=kind, ring="base", start=0.0, sensor=sensor)
    injector = mut.FaultInjector([fault])
    result = []
    for i in range(count):
        frame = make_device_frame(100 + i)
        injector.put(frame, _PERIOD * i)
        came = injector.take(_PERIOD * i + 1e-6)
        assert len(came) <= 1
        result.append((frame, came[0].frame if came else None))
    return result


COUNTS = {"base": 8, "elbow": 8, "tool": 16}


class TestParse(unittest.TestCase):
    def test_reads(self):
        self.assertEqual(
            mut.parse_ring_fault("silent:elbow@20-25.5", COUNTS),
            mut.RingFault(kind="silent", ring="elbow", start=20.0, end=25.5),
        )
        self.assertEqual(
            mut.parse_ring_fault("status253:tool.3@20", COUNTS),
            mut.RingFault(kind="status253", ring="tool", start=20.0, sensor=3),
        )
        self.assertEqual(
            mut.parse_ring_fault("late:base@3", COUNTS).end, np.inf
        )

    def test_reports_mistakes(self):
        for text, message in (
            ("", "not a fault"),
            ("silent", "not a fault"),
            ("silent:elbow", "not a fault"),
            ("silent:elbow@", "not a fault"),
            ("silent:elbow@-1", "not a fault"),
            ("silent:elbow@nan", "not a fault"),
            ("loud:elbow@1", "'loud' is unknown"),
            ("status99:elbow@1", "'status99' is unknown"),
            ("silent:wrist@1", "no ring 'wrist'"),
            ("silent:elbow@5-5", "ends before"),
            ("bus:elbow.@1", "not a fault"),
            ("bus:elbow.8@1", "no sensor 8, use 0 to 7"),
            ("silent:elbow.1@1", "'silent' concerns a whole ring"),
        ):
            with self.subTest(text=text):
                with self.assertRaisesRegex(UserError, message):
                    mut.parse_ring_fault(text, COUNTS)


class TestFaults(unittest.TestCase):
    def test_only_from_start_to_end(self):
        for kind in mut.FAULTS:
            injector = mut.FaultInjector(
                [mut.RingFault(kind=kind, ring="base", start=1.0, end=2.0)]
            )
            for time in (0.5, 2.0):
                frame = make_device_frame(3)
                injector.put(frame, time)
                (delivery,) = injector.take(time)
                self.assertIs(delivery.frame, frame)
                self.assertFalse(delivery.is_damaged)

    def test_whatever_comes_can_be_sent(self):
        for kind in mut.FAULTS:
            for _, frame in run(kind, 60):
                if frame is not None:
                    encode_frame(frame)

    def test_of_one_sensor(self):
        for kind in mut.SENSOR_FAULTS:
            is_changed = False
            for sent, came in run(kind, sensor=3):
                for name in ("mm", "status", "age_ms", "period_ms"):
                    before, after = getattr(sent, name), getattr(came, name)
                    np.testing.assert_array_equal(
                        np.delete(before, 3), np.delete(after, 3), kind
                    )
                    is_changed |= before[3] != after[3]
                self.assertEqual(sent.sequence, came.sequence)
            self.assertTrue(is_changed, kind)

    def test_frames_that_do_not_come(self):
        self.assertEqual([c for _, c in run("silent")], [None] * 10)
        late = run("late")
        self.assertEqual([c for _, c in late[:8]], [None] * 8)
        self.assertIs(late[8][1], late[0][0])
        lost = [c is None for _, c in run("loss10", 2000)]
        self.assertAlmostEqual(np.mean(lost), 0.1, delta=0.02)
        # The same ones each time.
        self.assertEqual(lost, [c is None for _, c in run("loss10", 2000)])

    def test_frames_that_are_wrong(self):
        duplicate = run("duplicate")
        self.assertTrue(all(c is duplicate[0][0] for _, c in duplicate))
        self.assertTrue(all(c.flags == 1 for _, c in run("restart")))
        injector = mut.FaultInjector(
            [mut.RingFault(kind="corrupt", ring="base", start=0.0)]
        )
        injector.put(make_device_frame(0), 0.0)
        self.assertTrue(injector.take(0.0)[0].is_damaged)

    def test_samples(self):
        for kind, name, expected in (
            ("implausible", "mm", 65535),
            ("implausible", "status", 0),
            ("bus", "status", 253),
            ("bus", "flags", 4),
            ("far", "mm", 4000),
            ("stuck27", "mm", 27),
            ("stuck27", "status", 0),
            ("blind", "status", 2),
            ("old", "age_ms", 255),
            *((f"status{n}", "status", n) for n in (1, 2, 7, 9, 14, 254, 255)),
        ):
            for _, came in run(kind):
                values = np.unique(getattr(came, name)).tolist()
                self.assertEqual(values, [expected], kind)
        for sent, came in run("frozen"):
            self.assertEqual(came.time_us, sent.time_us)
            self.assertEqual(
                came.mm.tolist(), make_device_frame(100).mm.tolist()
            )
        for sent, came in run("gain"):
            np.testing.assert_allclose(came.mm, 1.5 * sent.mm, atol=0.51)
        for sent, came in run("offset"):
            self.assertEqual(came.mm.tolist(), (sent.mm + 100).tolist())
        for sent, came in run("reversed"):
            self.assertEqual(came.mm.tolist(), sent.mm[::-1].tolist())
        for sent, came in run("shifted"):
            self.assertEqual(came.mm[0], sent.mm[1])
            self.assertEqual(came.mm[7], sent.mm[0])

    def test_glitch(self):
        is_near = [c.mm[0] == 27 for _, c in run("glitch", 150)]
        self.assertEqual(np.flatnonzero(is_near).tolist(), [0, 50, 100])

    def test_slow_sensors(self):
        for kind, keep, period in (
            ("slow48", 2, 48),
            ("slow72", 3, 72),
            ("slow100", 4, 100),
        ):
            status = [c.status[0] for _, c in run(kind, 12)]
            expected = [0 if i % keep == 0 else 254 for i in range(12)]
            self.assertEqual(status, expected)
            self.assertEqual(run(kind)[5][1].period_ms[0], period)

    def test_slow_device(self):
        came = [c for _, c in run("period37", 1000) if c is not None]
        self.assertEqual(
            [c.sequence for c in came], list(range(100, 100 + len(came)))
        )
        elapsed = 1e-6 * (came[-1].time_us - came[0].time_us)
        self.assertAlmostEqual(elapsed / (len(came) - 1), 0.037, delta=1e-4)

    def test_clock(self):
        for kind, rate in (("clockfast", 1.01), ("clockslow", 0.99)):
            frames = run(kind, 200)
            first, last = frames[0], frames[-1]
            self.assertEqual(first[0].time_us, first[1].time_us)
            self.assertAlmostEqual(
                (last[1].time_us - first[1].time_us)
                / (last[0].time_us - first[0].time_us),
                rate,
            )

    def test_latency(self):
        for ms in (30, 45, 1000):
            injector = mut.FaultInjector(
                [mut.RingFault(kind=f"latency{ms}", ring="base", start=0.0)]
            )
            for i in range(3):
                injector.put(make_device_frame(i), 0.01 * i)
            self.assertEqual(injector.take(1e-3 * ms - 1e-6), [])
            came = injector.take(1e-3 * ms + 0.01)
            self.assertEqual([d.frame.sequence for d in came], [0, 1])
            np.testing.assert_allclose(
                [d.time for d in came], [1e-3 * ms, 1e-3 * ms + 0.01]
            )

    @given(st.integers(0, 65535), st.integers(0, 2**32 - 1))
    def test_damage_is_always_seen(self, sequence, time_us):
        frame = dc.replace(
            make_device_frame(0), sequence=sequence, time_us=time_us
        )
        with self.assertRaises(FrameError):
            decode_frame(mut.damage(encode_frame(frame)))
        stream = FrameStream()
        stream.push(b"\0")
        line = encode_serial(frame)
        self.assertEqual(stream.push(mut.damage(line)), [])
        self.assertEqual(sum(stream.errors.values()), 1)
        self.assertEqual(len(stream.push(line)), 1)


if __name__ == "__main__":
    unittest.main()
