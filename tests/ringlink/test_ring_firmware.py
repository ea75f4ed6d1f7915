"""The sketch of a ring, compiled for a PC, with made-up sensors on a bus."""

from pathlib import Path
import shutil
import subprocess
import tempfile
import unittest

import numpy as np

from tofssm_drake.ringlink.ring_budget import RingBudget
from tofssm_drake.ringlink.ring_frame import FrameStream
from tofssm_drake.ringlink.ring_receiver import RingLinkConfig, RingReceiver

_HERE = Path(__file__).parent / "firmware"
_SKETCH = Path(__file__).parents[2] / "docs" / "firmware" / "tof_ring"
_COMPILER = shutil.which("c++") or shutil.which("g++")


@unittest.skipIf(_COMPILER is None, "no C++ compiler")
class TestSketch(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.program = Path(folder.name) / "run_sketch"
        subprocess.run(
            [
                *(_COMPILER, "-std=c++17", "-Wall", "-Wextra", "-Werror"),
                *(f"-I{_HERE}", f"-I{_SKETCH}", "-o", cls.program),
                _HERE / "run_sketch.cpp",
            ],
            check=True,
        )

    def test_frames_need_no_more_than_a_compiler_of_2011(self):
        subprocess.run(
            [
                *(_COMPILER, "-std=c++11", "-Wall", "-Werror"),
                *("-fsyntax-only", f"-I{_SKETCH}", "-x", "c++", "-"),
            ],
            input=b'#include "ring_frame.h"\n',
            check=True,
        )

    def run_sketch(self, *fates, seconds=3.0, slowness=1.0):
        """Returns times, s, and frames; fates are (sensor, fate, s)."""
        arguments = [
            str(value)
            for sensor, fate, time in fates
            for value in (sensor, fate, round(1e3 * time))
        ]
        done = subprocess.run(
            [self.program, f"{1e3 * seconds:.0f}", f"{slowness}", *arguments],
            capture_output=True,
            check=True,
        )
        # Never two at the shared address, none before it had booted.
        self.assertEqual(done.stderr.decode(), "0 collisions, 0 early\n")
        stream = FrameStream()
        frames = stream.push(done.stdout)
        self.assertEqual(stream.errors, {})
        sequence = [frame.sequence for frame in frames]
        self.assertEqual(sequence, list(range(len(frames))))
        # The clock shows 1 s at the start.
        times = np.array([1e-6 * frame.time_us for frame in frames]) - 1.0
        return times, frames

    def check_others(self, times, frames, *lost, start=1.0):
        """All but some sensors measure all the time, and frames come."""
        # A frame waits only while a sensor is being started.
        self.assertLess(np.diff(times).max(), 0.024)
        others = np.delete(np.arange(8), lost)
        status = np.array([frame.status for frame in frames])[:, others]
        self.assertLessEqual(set(np.unique(status[times > start])), {0, 254})
        for sensor in range(len(others)):
            fresh = times[(status[:, sensor] == 0) & (times > start)]
            self.assertLess(np.diff(fresh).max(), 0.050)

    def find_outage(self, times, frames, sensor, start=1.0):
        """Returns when a sensor was without a sample, first and last, s."""
        status = np.array([frame.status[sensor] for frame in frames])
        is_out = (status == 253) & (times > start)
        return times[is_out][0], times[is_out][-1]

    def test_all_start_one_after_another(self):
        times, frames = self.run_sketch()
        self.assertEqual(frames[0].flags & 1, 1)
        self.assertTrue(all(frame.flags & 1 == 0 for frame in frames[1:]))
        self.assertTrue((frames[0].status == 253).all())
        self.check_others(times, frames, start=0.4)
        self.assertAlmostEqual(np.diff(times[100:]).mean(), 0.012, delta=1e-3)

    def test_measures_each_period(self):
        for slowness, expected in ((1.0, 24), (1.5, 36), (2.0, 48), (10, 0)):
            _, frames = self.run_sketch(slowness=slowness)
            self.assertEqual(frames[5].period_ms.tolist(), [0] * 8)
            np.testing.assert_allclose(frames[-1].period_ms, expected, atol=1)

    def test_no_sample_is_called_younger_than_it_is(self):
        _, frames = self.run_sketch()
        ages = [f.age_ms[f.status == 0] for f in frames[50:]]
        # Two frames for each sample, and a round of the bus.
        self.assertLessEqual(np.concatenate(ages).max(), 16)

    def test_one_that_dies_comes_back_by_a_power_cycle(self):
        for sensor in (0, 5):
            times, frames = self.run_sketch((sensor, "dies", 1.5))
            self.check_others(times, frames, sensor)
            first, last = self.find_outage(times, frames, sensor)
            self.assertLess(first - 1.5, 0.015)
            self.assertLess(last - 1.5, 0.060)
            self.assertEqual(frames[-1].flags, 0)
            self.assertEqual(frames[-1].period_ms[sensor], 24)

    def test_one_that_never_comes_back(self):
        times, frames = self.run_sketch((3, "never", 1.5), seconds=6.0)
        self.check_others(times, frames, 3)
        for time, frame in zip(times, frames, strict=True):
            if time > 1.52:
                self.assertEqual(frame.status[3], 253)
                self.assertEqual(frame.flags & 4, 4)

    def test_one_that_hangs(self):
        """It answers, but has nothing new: 0.2 s, then a power cycle."""
        times, frames = self.run_sketch((6, "hangs", 1.5))
        self.check_others(times, frames, 6)
        first, last = self.find_outage(times, frames, 6)
        self.assertAlmostEqual(first - 1.5, 0.2, delta=0.03)
        self.assertLess(last - first, 0.060)
        self.assertIn(0, [f.status[6] for f in frames[-3:]])

    def test_several_at_once(self):
        """At the shared address there is never more than one."""
        times, frames = self.run_sketch(
            (1, "dies", 1.5),
            (4, "never", 1.5),
            (7, "brownout", 1.51),
            (2, "brownout", 1.52),
        )
        self.check_others(times, frames, 1, 2, 4, 7)
        for sensor in (1, 2, 7):
            _, last = self.find_outage(times, frames, sensor)
            self.assertLess(last, 1.75)

    def test_its_frames_are_within_the_budget(self):
        times, frames = self.run_sketch(seconds=10.0)
        receiver = RingReceiver(
            config=RingLinkConfig(),
            num_sensors=8,
            timing_budget=0.020,
            budget=RingBudget(),
        )
        scans = [
            receiver.receive(frame, time + 0.002)
            for time, frame in zip(times, frames, strict=True)
        ]
        problems = {scan.problem for scan in scans if scan is not None}
        self.assertEqual(problems, {""})
        self.assertLess(receiver.watch.figures.age, 0.030)
        times, frames = self.run_sketch(slowness=2.0)
        for time, frame in zip(times, frames, strict=True):
            receiver.receive(frame, time + 20.0)
        self.assertRegex(
            receiver.scan.problem, "sensor .: period .* ms, configured 24 ms"
        )


if __name__ == "__main__":
    unittest.main()
