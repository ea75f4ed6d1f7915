"""The link's budget in simulated time: frames with made-up arrivals."""

import dataclasses as dc
import math
import unittest

import numpy as np
import pytest

from tofssm_drake.messages import RingScan
import tofssm_drake.ringlink.ring_budget as mut
from tofssm_drake.ringlink.ring_device import DeviceClock, make_frame
from tofssm_drake.ringlink.ring_frame import FLAG_RESTARTED
from tofssm_drake.ringlink.ring_receiver import RingLinkConfig, RingReceiver

_PERIOD = 0.024
_HOST = 5000.0
# From the middle of an integration to the frame; one ms more is assumed.
_AGE = 0.015


class Ring:
    """A ring whose frames come on time unless a test changes that.

    Attributes:
        time: True time of the newest frame, s.
        problem: What the newest scan says.
    """

    def __init__(self, *, seed=0, **changes):
        self.receiver = RingReceiver(
            config=RingLinkConfig(),
            num_sensors=8,
            timing_budget=0.020,
            budget=dc.replace(mut.RingBudget(), **changes),
        )
        self.random = np.random.default_rng(seed)
        self.time = 0.0
        self.clock = DeviceClock(start=100.0)
        self.period = _PERIOD
        self.delay = 0.002
        self.problem = ""
        self._sequence = -1

    def step(self, *, is_lost=False, change=lambda frame: frame, flags=0):
        """Lets a period pass."""
        self._sequence += 1
        self.time += self.period
        scan = RingScan(
            sequence=self._sequence,
            time=self.time,
            sensor_time=np.full(8, self.time - _AGE),
            distance=0.8 + 0.002 * self.random.standard_normal(8),
            status=np.zeros(8, dtype=np.uint8),
        )
        frame = make_frame(
            scan,
            ring=0,
            timing_budget=0.020,
            period=self.period,
            clock=self.clock,
            flags=flags,
        )
        if is_lost:
            return
        given = self.receiver.receive(
            change(frame), _HOST + self.time + self.delay
        )
        if given is not None:
            self.problem = given.problem

    def run(self, duration, **options):
        """Lets some time pass; returns whether there was a problem in it."""
        end, seen = self.time + duration, False
        while self.time < end:
            self.step(**options)
            seen |= bool(self.problem)
        return seen

    def measure(self, *, limit=10.0, step=None):
        """Returns the time until there is a problem, s; inf: never."""
        start = self.time
        while self.time < start + limit:
            (step or self.step)()
            if self.problem:
                return self.time - start
        return math.inf

    def set_drift(self, drift):
        """Makes the device's clock run faster from now on."""
        shown = self.clock.start + (1 + self.clock.drift) * self.time
        self.clock = DeviceClock(
            start=shown - (1 + drift) * self.time, drift=drift
        )

    def hide(self, sensor, keep):
        """Returns a change: a sensor is new only in every `keep`-th frame."""

        def change(frame):
            status = frame.status.copy()
            if frame.sequence % keep:
                status[sensor] = 254
            return dc.replace(frame, status=status)

        return change


def make_ring(**options):
    ring = Ring(**options)
    assert not ring.run(10.0), ring.problem
    return ring


class TestMaxAge(unittest.TestCase):
    def test_worked_numbers(self):
        """100 - 24 - 2 - 8 - 8 - 24 ms at 125 Hz; 33 ms are never in time."""
        times = {"monitor_time": 0.002, "brake_start": 0.024}
        for T_R, period, tick, expected in (
            (0.1, 0.024, 0.008, 0.034),
            (0.1, 0.024, 0.002, 0.046),
            (0.1, 0.037, 0.008, 0.021),
            (0.05, 0.024, 0.008, 0.0),
        ):
            age = mut.calc_max_age(
                T_R=T_R,
                period=period,
                control_period=tick,
                rtde_period=tick,
                **times,
            )
            self.assertAlmostEqual(age, expected)
        self.assertEqual(mut.RingBudget().max_age, 0.034)


class TestWithinTheBudget(unittest.TestCase):
    def test_figures(self):
        ring = make_ring()
        figures = ring.receiver.watch.figures
        self.assertAlmostEqual(figures.period, _PERIOD, delta=1e-6)
        self.assertEqual((figures.lost, figures.late), (0.0, 0.0))
        self.assertAlmostEqual(figures.age, _AGE + 0.001, delta=1e-4)
        np.testing.assert_allclose(figures.sensor_period, _PERIOD, atol=1e-6)
        self.assertAlmostEqual(figures.clock_error, 0.0, delta=1e-6)

    def test_single_frames_that_are_late_or_lost(self):
        ring = make_ring()
        for _ in range(10):
            self.assertFalse(ring.run(1.0))
            ring.step(is_lost=True)
            self.assertFalse(ring.run(1.0))
            ring.delay = 0.062
            self.assertFalse(ring.run(_PERIOD))
            ring.delay = 0.002

    def test_jitter_of_some_milliseconds(self):
        ring = make_ring()
        for _ in range(5000):
            ring.delay = 0.001 + ring.random.exponential(0.002)
            ring.step()
            self.assertEqual(ring.problem, "")

    def test_one_percent_of_independent_losses(self):
        """One alarm in five days of three rings; here a minute of one."""
        budget = mut.RingBudget()
        frames = int(budget.window / _PERIOD)
        most = int(budget.max_lost * budget.window / _PERIOD)
        # An alarm needs a loss with `most` others within the window.
        p = 0.01
        others = math.comb(frames - 1, most) * p**most
        rate = p * others * (1 - p) ** (frames - 1 - most) * 3 / _PERIOD
        self.assertGreater(1.0 / rate, 5 * 86400)
        self.assertLess(1.0 / rate, 10 * 86400)
        self.check_losses(2_500)

    @pytest.mark.long
    def test_one_percent_of_independent_losses_for_ten_minutes(self):
        self.check_losses(25_000)

    def check_losses(self, frames):
        ring = make_ring(seed=3)
        for is_lost in ring.random.random(frames) < 0.01:
            ring.step(is_lost=is_lost)
            self.assertEqual(ring.problem, "")

    def test_two_crystals(self):
        for drift in (-200e-6, 200e-6):
            ring = make_ring()
            ring.set_drift(drift)
            self.assertFalse(ring.run(120.0), ring.problem)

    def test_frames_twice_as_often_as_the_sensors_measure(self):
        """As the firmware sends them; each sensor is new in every other."""
        ring = Ring()
        ring.period = 0.012

        def change(frame):
            status = np.where((np.arange(8) + frame.sequence) % 2, 0, 254)
            return dc.replace(frame, status=status, period_ms=np.full(8, 24))

        self.assertFalse(ring.run(10.0, change=change), ring.problem)
        np.testing.assert_allclose(
            ring.receiver.watch.figures.sensor_period, 0.024, rtol=0.02
        )


class TestBeyondTheBudget(unittest.TestCase):
    def check(self, ring, *, within, says, step=None):
        elapsed = ring.measure(step=step)
        self.assertLess(elapsed, within)
        self.assertRegex(ring.problem, says)

    def test_latency_that_comes_at_once(self):
        for delay, age in ((0.030, 46), (0.045, 61), (0.9, 916)):
            ring = make_ring()
            ring.delay += delay
            self.check(
                ring,
                within=0.23,
                says=f"^samples {age} ms old on arrival, 34 ms allowed$",
            )

    def test_latency_does_not_become_an_offset(self):
        """The clock may drift by 200e-6: in 60 s by as much as 12 ms."""
        self.check_latency(drift=0.0)

    @pytest.mark.long
    def test_latency_does_not_become_an_offset_of_a_clock_that_drifts(self):
        for drift in (-100e-6, 100e-6):
            self.check_latency(drift=drift)

    def check_latency(self, *, drift):
        ring = make_ring()
        ring.set_drift(drift)
        self.assertFalse(ring.run(40.0))
        ring.delay += 0.030
        self.assertLess(ring.measure(), 0.23)
        for _ in range(100):
            self.assertTrue(ring.run(1.0))
            self.assertRegex(ring.problem, "old on arrival")

    def test_a_tenth_of_the_frames_lost(self):
        elapsed = []
        for seed in range(20):
            ring = make_ring(seed=seed)
            elapsed.append(
                ring.measure(
                    limit=60.0,
                    step=lambda r=ring: r.step(is_lost=r.random.random() < 0.1),
                )
            )
            self.assertRegex(
                ring.problem, r"^1[0-2] % of frames lost in the last 2 s$"
            )
        self.assertLess(np.median(elapsed), 4.0)
        self.assertLess(max(elapsed), 20.0)

    def test_every_other_frame_lost(self):
        ring = make_ring()

        def step():
            ring.step(is_lost=True)
            ring.step()

        self.check(ring, within=0.5, says="frames lost", step=step)

    def test_period(self):
        ring = make_ring()
        ring.period = 0.037
        self.check(ring, within=0.7, says="period .*, configured 24 ms")
        ring.run(3.0)
        self.assertEqual(ring.problem, "period 37.0 ms, configured 24 ms")

    def test_period_from_the_start(self):
        ring = Ring()
        ring.period = 0.037
        while ring.receiver.scan.sequence < 0:
            ring.step()
        self.assertEqual(ring.problem, "period 37.0 ms, configured 24 ms")

    def test_a_sensor_that_skips_samples(self):
        for keep, limit in ((2, 0.5), (3, 0.4), (4, 0.4)):
            ring = make_ring()
            change = ring.hide(5, keep)
            self.check(
                ring,
                within=limit,
                says="^sensor 5: period .* ms, configured 24 ms$",
                step=lambda r=ring, c=change: r.step(change=c),
            )
            ring.run(3.0, change=change)
            period = float(ring.problem.split()[3])
            self.assertAlmostEqual(period, 24.0 * keep, delta=0.03 * period)

    def test_a_sensor_that_says_it_is_slow(self):
        ring = make_ring()

        def change(frame):
            period = frame.period_ms.copy()
            period[3] = 48
            return dc.replace(frame, period_ms=period)

        self.check(
            ring,
            within=0.25,
            says="^sensor 3: period",
            step=lambda: ring.step(change=change),
        )

    def test_clock(self):
        for drift, limit, says in (
            (0.01, 3.5, r"^clock (1\.00|0\.99) % fast$"),
            (-0.01, 2.2, "^samples .* ms old on arrival"),
            (0.005, 3.5, r"^clock 0\.50 % fast$"),
            (-0.005, 4.5, r"^clock 0\.50 % slow|^samples"),
        ):
            with self.subTest(drift=drift):
                ring = make_ring()
                ring.set_drift(drift)
                self.check(ring, within=limit, says=says)
                ring.run(5.0)
                way = "fast" if drift > 0 else "slow"
                self.assertRegex(ring.problem, f"^clock .* % {way}")

    def test_clock_that_is_wrong_from_the_start(self):
        for drift, way in ((0.01, "fast"), (-0.01, "slow")):
            ring = Ring()
            ring.set_drift(drift)
            self.check(ring, within=6.0, says="clock|samples")
            ring.run(5.0)
            self.assertRegex(ring.problem, rf"^clock (1\.0[01]|0\.99) % {way}")

    def test_a_delay_that_comes_or_goes_is_no_clock(self):
        ring = make_ring()
        for delay in (0.030, -0.030):
            ring.delay += delay
            ring.run(10.0)
            self.assertNotIn("clock", ring.problem)


class TestEnd(unittest.TestCase):
    def test_lasts_until_all_was_well_for_a_window(self):
        ring = make_ring()
        ring.delay += 0.045
        ring.run(1.0)
        ring.delay -= 0.045
        start = ring.time
        while ring.problem:
            ring.step()
        # Until few late ones are left in the window, and one more window.
        self.assertGreater(ring.time - start, 2.0)
        self.assertLess(ring.time - start, 4.1)
        self.assertFalse(ring.run(10.0))

    def test_a_restart_ends_nothing(self):
        ring = make_ring()
        ring.period = 0.037
        ring.run(2.0)
        problem = ring.problem
        ring.period = _PERIOD
        ring.step(flags=FLAG_RESTARTED)
        start = ring.time
        while ring.time < start + 1.5:
            ring.step()
            self.assertEqual(ring.problem, problem)
        ring.run(1.0)
        self.assertEqual(ring.problem, "")


class TestSettings(unittest.TestCase):
    def test_rejects(self):
        for name in ("period", "window", "max_lost", "max_clock_error"):
            with self.assertRaisesRegex(ValueError, f"ring_budget.{name}"):
                dc.replace(mut.RingBudget(), **{name: -1.0}).check(
                    "ring_budget"
                )


if __name__ == "__main__":
    unittest.main()
