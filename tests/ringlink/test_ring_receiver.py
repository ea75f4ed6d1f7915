import dataclasses as dc
import unittest
from unittest import mock

import numpy as np
from paper_cell import make_rings

from tofssm_drake.errors import UserError
from tofssm_drake.messages import Reading, RingScan
from tofssm_drake.perception.readings import classify_readings
from tofssm_drake.ringlink.ring_budget import RingBudget
from tofssm_drake.ringlink.ring_device import DeviceClock, make_frame
from tofssm_drake.ringlink.ring_frame import (
    FLAG_RESTARTED,
    FLAG_SELF_TEST,
    encode_frame,
    encode_serial,
)
import tofssm_drake.ringlink.ring_receiver as mut
from tofssm_drake.sensors.range_status import (
    STATUS_CONTESTED,
    STATUS_FROZEN,
    STATUS_SELF_TEST,
)

_PERIOD = 0.024
_BUDGET = 0.020
_HOST = 5000.0


def make_scan(sequence, *, status=0, seed=0):
    """A scan of 8 sensors with noise, delivered at sequence * 24 ms."""
    generator = np.random.default_rng([seed, sequence])
    time = _PERIOD * (sequence + 1)
    return RingScan(
        sequence=sequence,
        time=time,
        sensor_time=time - 0.5 * _BUDGET - 0.001 * np.arange(8),
        distance=0.8 + 0.0023 * generator.standard_normal(8),
        status=np.full(8, status, dtype=np.uint8),
    )


def make_receiver(**changes):
    return mut.RingReceiver(
        config=dc.replace(mut.RingLinkConfig(), **changes),
        num_sensors=8,
        timing_budget=_BUDGET,
        # The samples of these scans are up to 19 ms old on arrival.
        budget=RingBudget(),
    )


def run(receiver, sequences, *, delay=0.002, clock=None, change=None, seed=0):
    """Delivers frames; returns the resulting scans, or None."""
    result = []
    for sequence in sequences:
        scan = make_scan(sequence, seed=seed)
        frame = make_frame(scan, ring=0, timing_budget=_BUDGET, clock=clock)
        if change is not None:
            frame = change(frame)
        lag = delay(sequence) if callable(delay) else delay
        result.append(receiver.receive(frame, _HOST + scan.time + lag))
    return result


class TestRingReceiver(unittest.TestCase):
    def test_gives_the_scan_that_was_sent(self):
        """Distance, status, and every sensor's own time on the host's clock."""
        receiver = make_receiver()
        clock = DeviceClock(start=12.5, drift=50e-6)
        sequences = range(100, 300)
        # 1 to 3 ms on the way, of which 1 ms is known.
        scans = run(
            receiver,
            sequences,
            clock=clock,
            delay=lambda i: 0.001 + 0.001 * (i % 3),
        )
        for sequence, scan in zip(sequences, scans, strict=True):
            if scan is None:
                continue
            sent = make_scan(sequence)
            np.testing.assert_allclose(
                scan.distance, sent.distance, rtol=0, atol=0.0005 + 1e-9
            )
            np.testing.assert_array_equal(scan.status, sent.status)
            np.testing.assert_allclose(
                scan.sensor_time - _HOST, sent.sensor_time, rtol=0, atol=0.0006
            )
            self.assertAlmostEqual(
                scan.time - _HOST, sent.time + 0.001 * (1 + sequence % 3)
            )
        delivered = [scan for scan in scans if scan is not None]
        self.assertEqual(
            [scan.sequence for scan in delivered], list(range(len(delivered)))
        )
        self.assertFalse(delivered[0].distance.flags.writeable)
        counts = receiver.counts
        self.assertEqual((counts.received, counts.lost), (200, 0))
        self.assertEqual(counts.restarts + counts.late + counts.frozen, 0)

    def test_delivers_only_once_the_clock_is_known(self):
        scans = run(make_receiver(), range(40))
        first = next(i for i, scan in enumerate(scans) if scan is not None)
        self.assertEqual(first, int(np.ceil(0.5 / _PERIOD)))
        self.assertTrue(all(scan is not None for scan in scans[first:]))

    def test_counts_what_is_lost(self):
        receiver = make_receiver(settle_time=0.0)
        scans = run(receiver, [0, 1, 4, 5, 9])
        self.assertEqual(receiver.counts.lost, 5)
        self.assertEqual([s.sequence for s in scans], [0, 1, 2, 3, 4])

    def test_a_duplicate_is_no_new_scan(self):
        receiver = make_receiver(settle_time=0.0)
        run(receiver, range(5))
        last = receiver.scan
        frame = make_frame(make_scan(4), ring=0, timing_budget=_BUDGET)
        for i in range(30):
            self.assertIsNone(receiver.receive(frame, _HOST + 0.2 + 0.02 * i))
        self.assertIs(receiver.scan, last)
        self.assertEqual(receiver.counts.duplicated, 30)
        self.assertEqual(receiver.counts.restarts, 0)

    def test_what_overtook_each_other_is_not_new(self):
        receiver = make_receiver(settle_time=0.0)
        scans = run(receiver, [0, 2, 1, 3, 5, 4, 6])
        self.assertEqual(
            [scan is not None for scan in scans],
            [True, True, False, True, True, False, True],
        )
        self.assertEqual(receiver.counts.out_of_order, 2)
        self.assertEqual(receiver.counts.restarts, 0)

    def test_a_device_that_repeats_its_last_frames_never_delivers(self):
        """A buffer that is sent over and over: old sequences and times."""
        receiver = make_receiver()
        run(receiver, range(40))
        last = receiver.scan
        self.assertEqual(last.sequence, 18)
        for i in range(400):
            scan = make_scan(36 + i % 4)
            frame = make_frame(scan, ring=0, timing_budget=_BUDGET)
            receiver.receive(frame, _HOST + 1.0 + _PERIOD * i)
        self.assertIs(receiver.scan, last)

    def test_two_devices_with_one_number_are_a_fault(self):
        """Whichever is followed: it is unknown which of them it is."""
        for offset in (-1000, -5, 5, 1000):
            receiver = make_receiver()
            run(receiver, range(2000, 2100))
            self.assertFalse(receiver.is_contested)
            scans = []
            for k in range(2100, 2200):
                scans += run(receiver, [k])
                scan = make_scan(k, seed=1)
                frame = make_frame(
                    dc.replace(scan, sequence=k + offset),
                    ring=0,
                    timing_budget=_BUDGET,
                    clock=DeviceClock(start=_PERIOD * offset),
                )
                scans.append(receiver.receive(frame, _HOST + scan.time + 0.004))
            with self.subTest(offset=offset):
                # Within a second; before, the clock may be unknown.
                late = [scan for scan in scans[-120:] if scan is not None]
                self.assertGreater(len(late), 50)
                for scan in late:
                    np.testing.assert_array_equal(scan.status, STATUS_CONTESTED)
                self.assertTrue(receiver.is_contested)
                self.assertGreater(receiver.counts.contested, 50)
                # One of them is taken away.
                last = run(receiver, range(3200, 3300))
                self.assertFalse(receiver.is_contested)
                np.testing.assert_array_equal(last[-1].status, 0)

    def test_restart_by_flag_and_by_going_back(self):
        for flags in (FLAG_RESTARTED, 0):
            receiver = make_receiver()
            run(receiver, range(200, 240))
            sequence = receiver.scan.sequence
            # From 0 again, half a second later by the host's clock.
            start = _HOST + 240 * _PERIOD + 0.5
            scans = []
            for i in range(60):
                scan = make_scan(i)
                frame = make_frame(
                    scan,
                    ring=0,
                    timing_budget=_BUDGET,
                    flags=flags if i == 0 else 0,
                )
                scans.append(receiver.receive(frame, start + scan.time))
            with self.subTest(flags=flags):
                self.assertEqual(receiver.counts.restarts, 1)
                self.assertEqual(receiver.counts.lost, 0)
                # Not before the clock is known again.
                self.assertTrue(all(scan is None for scan in scans[:20]))
                self.assertEqual(scans[30].sequence, scans[29].sequence + 1)
                self.assertGreater(scans[30].sequence, sequence)
                self.assertAlmostEqual(
                    scans[-1].sensor_time[0],
                    start + make_scan(59).sensor_time[0] - 0.001,
                    delta=0.001,
                )

    def test_unwraps_sequence_and_time(self):
        """From sequence 65500 on, 100 frames before the clock wraps."""
        receiver = make_receiver()
        clock = DeviceClock(start=2**32 * 1e-6 - 65600 * _PERIOD)
        scans = run(receiver, range(65500, 65700), clock=clock)
        self.assertEqual(receiver.counts.lost, 0)
        self.assertEqual(receiver.counts.restarts, 0)
        for sequence, scan in zip(range(65530, 65700), scans[30:], strict=True):
            np.testing.assert_allclose(
                scan.sensor_time - _HOST,
                make_scan(sequence).sensor_time,
                rtol=0,
                atol=0.0016,
            )

    def test_a_silence_is_no_restart(self):
        """Otherwise a second of delay would pass for an offset of the clock."""
        for silence in (1.2, 600.0, 3600.0):
            frames = round(silence / _PERIOD)
            receiver = make_receiver()
            run(receiver, range(40))
            scans = run(receiver, range(40 + frames, 60 + frames))
            with self.subTest(silence=silence):
                self.assertEqual(receiver.counts.restarts, 0)
                for scan in filter(None, scans):
                    age = scan.time - scan.sensor_time[0]
                    self.assertAlmostEqual(age, 0.013, delta=0.002)

    def test_a_second_of_delay_that_comes_at_once_is_an_age(self):
        receiver = make_receiver()
        run(receiver, range(40))
        scans = run(receiver, range(40, 140), delay=1.0)
        self.assertEqual(receiver.counts.restarts, 0)
        for scan in scans:
            self.assertGreater(scan.time - scan.sensor_time[0], 1.0)
        self.assertRegex(scans[-1].problem, "samples 10.. ms old on arrival")

    def test_statuses_of_the_host_do_not_come_over_the_wire(self):
        receiver = make_receiver(settle_time=0.0)
        sent = np.array([239, 240, 241, 242, 252, 253, 254, 255])
        (scan,) = run(
            receiver,
            [0],
            change=lambda frame: dc.replace(frame, status=sent),
        )
        self.assertEqual(
            scan.status.tolist(), [239, 255, 255, 255, 255, 253, 254, 255]
        )
        self.assertEqual(scan.status.dtype, np.uint8)

    def test_a_clock_that_jumps_starts_again(self):
        receiver = make_receiver()
        run(receiver, range(40))
        scans = run(receiver, range(40, 80), clock=DeviceClock(start=3.0))
        self.assertEqual(receiver.counts.restarts, 1)
        self.assertIsNone(scans[5])
        self.assertIsNotNone(scans[-1])
        # Backward it is older than what was there: the same.
        scans = run(receiver, range(80, 120))
        self.assertEqual(receiver.counts.restarts, 2)
        self.assertEqual(receiver.counts.out_of_order, 3)
        self.assertIsNotNone(scans[-1])

    def test_what_lay_in_a_buffer_is_not_new(self):
        """50 old frames come at once, then the live ones."""
        receiver = make_receiver()
        flood = run(
            receiver, range(50), delay=lambda i: _PERIOD * (50 - i) + 0.002
        )
        self.assertTrue(all(scan is None for scan in flood))
        scans = run(receiver, range(50, 100))
        first = next(i for i, scan in enumerate(scans) if scan is not None)
        self.assertGreater(first, 19)
        np.testing.assert_allclose(
            scans[first].sensor_time - _HOST,
            make_scan(50 + first).sensor_time,
            rtol=0,
            atol=0.0016,
        )

    def test_late_frames_carry_their_true_age(self):
        receiver = make_receiver()
        run(receiver, range(40))
        (scan,) = run(receiver, [40], delay=0.1)
        self.assertAlmostEqual(
            scan.time - scan.sensor_time[0], 0.11, delta=0.002
        )
        self.assertEqual(receiver.counts.late, 1)
        # For the mask, samples of that age are faulted.
        reading, *_ = classify_readings(
            scan.distance,
            scan.status,
            scan.time - scan.sensor_time,
            np.full(8, np.inf),
            np.full(8, -np.inf),
            0.03,
            0.04,
            4.0,
            0.072,
        )
        self.assertTrue((reading == Reading.FAULTED).all())

    def test_saturated_age_is_stale_whatever_the_limit(self):
        receiver = make_receiver(settle_time=0.0)

        def change(frame):
            age = frame.age_ms.copy()
            age[2] = 255
            return dc.replace(frame, age_ms=age)

        (scan,) = run(receiver, [0], change=change)
        self.assertEqual(scan.sensor_time[2], -np.inf)
        self.assertTrue(np.isfinite(np.delete(scan.sensor_time, 2)).all())

    def test_frozen_sensor_is_faulted(self):
        receiver = make_receiver(frozen_samples=12)

        def change(frame):
            mm = frame.mm.copy()
            mm[3] = 777
            return dc.replace(frame, mm=mm)

        scans = run(receiver, range(40))
        scans = run(receiver, range(40, 60), change=change)
        for i, scan in enumerate(scans):
            expected = np.zeros(8)
            # The first one is not a repetition.
            expected[3] = STATUS_FROZEN if i >= 12 else 0
            np.testing.assert_array_equal(scan.status, expected)
        self.assertEqual(receiver.counts.frozen, 8)
        # It is trusted again after a few distances that differ.
        scans = run(receiver, range(60, 65))
        self.assertEqual(scans[0].status[3], STATUS_FROZEN)
        self.assertTrue((scans[-1].status == 0).all())

    def test_a_device_that_repeats_its_samples_is_faulted(self):
        """New sequence and time, but old samples; some clear."""
        receiver = make_receiver()
        sent = make_frame(make_scan(0), ring=0, timing_budget=_BUDGET)
        status = np.array([0, 2, 2, 2, 2, 2, 4, 2], dtype=np.uint8)

        def change(frame):
            return dc.replace(frame, mm=sent.mm, status=status)

        scans = run(receiver, range(40), change=change)
        self.assertTrue((scans[-1].status == STATUS_FROZEN).all())
        off = make_receiver(frozen_samples=0)
        scans = run(off, range(40), change=change)
        np.testing.assert_array_equal(scans[-1].status, status)

    def test_an_empty_room_is_not_frozen(self):
        """Devices report the same number whenever nothing came back."""
        receiver = make_receiver()

        def change(frame):
            return dc.replace(
                frame,
                mm=np.full(8, 65535),
                status=np.full(8, 2, dtype=np.uint8),
            )

        scans = run(receiver, range(100), change=change)
        self.assertTrue((scans[-1].status == 2).all())
        self.assertEqual(receiver.counts.frozen, 0)

    def test_self_test_numbers_are_no_measurement(self):
        receiver = make_receiver(settle_time=0.0)
        (scan,) = run(
            receiver,
            [0],
            change=lambda frame: dc.replace(frame, flags=FLAG_SELF_TEST),
        )
        self.assertTrue((scan.status == STATUS_SELF_TEST).all())
        self.assertEqual(receiver.counts.self_test, 1)

    def test_another_number_of_sensors_is_no_scan(self):
        receiver = make_receiver(settle_time=0.0)

        def change(frame):
            return dc.replace(
                frame,
                **{
                    name: np.tile(getattr(frame, name), 2)
                    for name in ("mm", "status", "age_ms", "period_ms")
                },
            )

        self.assertEqual(run(receiver, range(3), change=change), [None] * 3)
        self.assertEqual(receiver.counts.wrong_size, 3)
        self.assertEqual(receiver.scan.sequence, -1)


class TestRingDecoder(unittest.TestCase):
    def make_decoder(self, **changes):
        return mut.RingDecoder(
            config=mut.RingLinkConfig(settle_time=0.0, **changes),
            rings=make_rings(),
        )

    def make_frame(self, ring, sequence):
        return make_frame(make_scan(sequence), ring=ring, timing_budget=_BUDGET)

    def test_rings_by_their_numbers(self):
        decoder = self.make_decoder(ring_numbers=[7, 3, 0])
        for ring in (7, 3, 0, 1):
            is_ours = decoder.receive_datagram(
                encode_frame(self.make_frame(ring, ring)), _HOST
            )
            self.assertEqual(is_ours, ring != 1)
        self.assertEqual(decoder.unknown, 1)
        np.testing.assert_allclose(
            [scan.distance[0] for scan in decoder.scans],
            [make_scan(i).distance[0] for i in (7, 3, 0)],
            atol=0.00051,
        )
        self.assertEqual(list(decoder.counts), ["base", "elbow", "tool"])

    def test_a_flood_for_other_rings_is_not_even_decoded(self):
        """Decoded, 20 000 of them in a second cost a ring its own frames."""
        decoder = self.make_decoder()
        with mock.patch.object(mut, "decode_frame") as decode:
            for ring in (3, 255):
                data = encode_frame(self.make_frame(ring, 0))
                self.assertFalse(decoder.receive_datagram(data, _HOST))
            decode.assert_not_called()
        self.assertEqual((decoder.unknown, decoder.corrupt), (2, {}))

    def test_counts_damage_of_both_carriers(self):
        decoder = self.make_decoder()
        data = encode_frame(self.make_frame(0, 0))
        self.assertFalse(decoder.receive_datagram(data[:-1], _HOST))
        self.assertFalse(decoder.receive_datagram(data[:-1] + b"x", _HOST))
        line = encode_serial(self.make_frame(1, 0))
        self.assertFalse(decoder.receive_serial("a", b"\0", _HOST))
        self.assertFalse(decoder.receive_serial("a", line[:-2] + b"x\0", _HOST))
        self.assertEqual(decoder.corrupt, {"length": 1, "crc": 2})
        decoder.reopen_serial("a")
        self.assertEqual(decoder.corrupt, {"length": 1, "crc": 2})
        self.assertTrue(decoder.receive_serial("a", line, _HOST))

    def test_lines_do_not_mix(self):
        decoder = self.make_decoder()
        first = encode_serial(self.make_frame(0, 0))
        second = encode_serial(self.make_frame(1, 0))
        for i in range(0, len(first), 5):
            decoder.receive_serial("a", first[i : i + 5], _HOST)
            decoder.receive_serial("b", second[i : i + 5], _HOST)
        self.assertEqual([s.sequence for s in decoder.scans], [0, 0, -1])
        self.assertEqual(decoder.corrupt, {})

    def test_the_same_bytes_and_times_give_the_same_scans(self):
        """Which is what a replay needs."""
        pieces = []
        for i in range(100):
            data = encode_serial(self.make_frame(i % 3, i // 3))
            if i % 10 == 3:
                data = data[:20]
            pieces.append((data, _HOST + 0.008 * i))
        results = []
        for _ in range(2):
            decoder = self.make_decoder()
            trace = []
            for data, arrival in pieces:
                decoder.receive_serial("a", data, arrival)
                trace.append(
                    [
                        (s.sequence, s.time, s.sensor_time.tobytes())
                        for s in decoder.scans
                    ]
                )
            results.append((trace, decoder.counts, decoder.corrupt))
        self.assertEqual(*results)

    def test_rejects_settings(self):
        for changes, message in (
            ({"ring_numbers": [0, 1]}, "ring_numbers"),
            ({"ring_numbers": [0, 1, 1]}, "ring_numbers"),
            ({"ring_numbers": [0, 1, 256]}, "ring_numbers"),
            ({"max_drift": -1.0}, "max_drift"),
            ({"frozen_samples": -1}, "frozen_samples"),
            ({"max_earliness": float("nan")}, "max_earliness"),
        ):
            with self.assertRaisesRegex(UserError, message):
                self.make_decoder(**changes)
        self.make_decoder(ring_numbers=[7, 255, 0])

    def test_without_numbers_rings_are_counted(self):
        config = mut.RingLinkConfig()
        self.assertEqual(
            mut.find_ring_numbers(config, ("a", "b")), {"a": 0, "b": 1}
        )


if __name__ == "__main__":
    unittest.main()
