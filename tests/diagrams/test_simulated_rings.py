import itertools
from types import SimpleNamespace
import unittest

import numpy as np
from paper_cell import RINGS
import pytest

from tofssm_drake.diagrams.scenario import load_scenario
import tofssm_drake.diagrams.simulated_rings as mut
from tofssm_drake.ringlink.ring_device import DeviceClock
from tofssm_drake.ringlink.ring_fault_injection import parse_ring_fault
from tofssm_drake.ringlink.ring_frame import encode_frame
from tofssm_drake.ringlink.ring_link import LoopbackRingLink
from tofssm_drake.ringlink.ring_receiver import RingDecoder, RingLinkConfig

_HOST = 900.0
"""Host's time when the world's is 0, s."""

COUNTS = dict.fromkeys(RINGS, 8)


def make_report(time=0.0, position=(0.0, -1.6, 1.0, -1.0, -1.57, 0.0)):
    return SimpleNamespace(
        sequence=0,
        time=_HOST + time,
        position=np.array(position),
        velocity=np.zeros(6),
        digital_outputs=0,
        products_placed=0,
    )


class TestCarryOn(unittest.TestCase):
    def test_a_little_and_no_more(self):
        report = make_report(1.0)
        report.velocity = np.array([1.0, -2.0, 0.0, 0.0, 0.0, 0.0])
        for age, expected in (
            *((0.005, 0.005), (1.0, 0.02)),
            *((-0.03, -0.03), (-1.0, -0.1)),
        ):
            np.testing.assert_allclose(
                mut.carry_on(report, _HOST + 1.0 + age) - report.position,
                expected * report.velocity,
            )


class TestWakeTimes(unittest.TestCase):
    def test_samples_and_scans_in_turn(self):
        times = mut.iterate_wake_times(load_scenario())
        np.testing.assert_allclose(
            list(itertools.islice(times, 4)),
            np.array([0.024, 0.039, 0.048, 0.063]) + 1e-6,
        )

    def test_rings_in_turns(self):
        scenario = load_scenario(
            text="{sensors: {elbow: {phase: 0.008}, tool: {phase: 0.016}}}"
        )
        times = list(itertools.islice(mut.iterate_wake_times(scenario), 100))
        self.assertEqual(times, sorted(times))
        np.testing.assert_allclose(
            times[:3], np.array([0.008, 0.016, 0.023]) + 1e-6
        )


class TestSimulatedRings(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario()

    def run_rings(self, *, seconds, link, **options):
        """Returns (time, frame, whether to damage it) of all sent frames."""
        sent = []

        def send(frame, is_damaged):
            sent.append((self.now, frame, is_damaged))
            link.put_datagram(encode_frame(frame), _HOST + self.now)
            return True

        rings = mut.SimulatedRings(scenario=self.scenario, send=send, **options)
        for time in mut.iterate_wake_times(self.scenario):
            if time > seconds:
                break
            self.now = time
            rings.advance(time, make_report(time - 0.003), _HOST + time)
        return rings, sent

    def make_link(self):
        return LoopbackRingLink(
            decoder=RingDecoder(
                config=RingLinkConfig(min_delay=0.0),
                rings=self.scenario.sensors,
            )
        )

    def test_what_arrives_is_what_the_rings_saw(self):
        link = self.make_link()
        rings, sent = self.run_rings(
            seconds=1.0,
            link=link,
            clocks=[DeviceClock(start=100.0 * i) for i in range(3)],
        )
        # The first is delivered after a period and its latency.
        count = int((1.0 - 0.015) / 0.024)
        self.assertEqual(rings.sent, dict.fromkeys(RINGS, count))
        self.assertEqual(len(sent), 3 * count)
        for ring, scan in enumerate(link.get_scans()):
            counts = link.get_status().counts[RINGS[ring]]
            self.assertEqual((counts.lost, counts.received), (0, count))
            self.assertGreater(counts.delivered, 0)
            *_, (_, frame, _) = (s for s in sent if s[1].ring == ring)
            np.testing.assert_array_equal(
                np.rint(1e3 * scan.distance), frame.mm
            )
            np.testing.assert_array_equal(scan.status, frame.status)
            np.testing.assert_allclose(
                scan.sensor_time - _HOST, 0.024 * count, rtol=0, atol=0.0011
            )

    def test_faults_come_when_they_shall(self):
        link = self.make_link()
        _, sent = self.run_rings(
            seconds=0.6,
            link=link,
            faults=[
                parse_ring_fault("silent:base@0.2-0.4", COUNTS),
                parse_ring_fault("corrupt:tool@0.3", COUNTS),
            ],
        )
        base = [time for time, frame, _ in sent if frame.ring == 0]
        self.assertFalse(any(0.2 <= t < 0.4 for t in base))
        self.assertGreater(len(base), 10)
        elbow = [damaged for _, frame, damaged in sent if frame.ring == 1]
        self.assertFalse(any(elbow))
        for time, frame, damaged in sent:
            if frame.ring == 2:
                self.assertEqual(damaged, time > 0.3)

    def test_links_beyond_their_budget(self):
        self.check_problems(
            ("latency30", "samples 4[6-9] ms old on arrival, 34 ms allowed"),
            ("slow48", "sensor 0: period .* ms, configured 24 ms"),
        )

    @pytest.mark.long
    def test_links_beyond_their_budget_in_other_ways(self):
        self.check_problems(
            ("latency1000", "samples 10.. ms old on arrival"),
            ("loss10", "% of frames lost in the last 2 s"),
            ("period37", "^period .* ms, configured 24 ms"),
            ("clockfast", "^clock .* % fast"),
            ("clockslow", "samples 3. ms old|clock .* % slow"),
            ("slow72", "sensor 0: period .* ms, configured 24 ms"),
        )

    def check_problems(self, *cases):
        for kind, says in cases:
            with self.subTest(kind=kind):
                link = self.make_link()
                self.run_rings(
                    seconds=6.0,
                    link=link,
                    faults=[parse_ring_fault(f"{kind}:tool@1.5", COUNTS)],
                )
                base, elbow, tool = link.get_scans()
                self.assertRegex(tool.problem, says)
                self.assertEqual((base.problem, elbow.problem), ("", ""))

    def test_another_seed_is_another_noise(self):
        frames = []
        for seed in (0, 1):
            self.scenario.random_seed = seed
            _, sent = self.run_rings(seconds=0.1, link=self.make_link())
            frames.append([frame.mm.tolist() for _, frame, _ in sent])
        self.scenario.random_seed = 0
        self.assertNotEqual(*frames)


if __name__ == "__main__":
    unittest.main()
