import unittest

import numpy as np

from tofssm_drake.messages import RobotReport
from tofssm_drake.rtde.robot_clock import RobotClock

_PERIOD = 0.008


def report(timestamp, time, session=0):
    return RobotReport(
        sequence=0, session=session, timestamp=timestamp, time=time
    )


class TestRobotClock(unittest.TestCase):
    def test_begins_at_zero_and_hits_the_ticks(self):
        clock = RobotClock(period=_PERIOD)
        for k in range(1000):
            # A sum accumulates rounding errors, as a robot's clock may.
            timestamp = 54.321 + sum([_PERIOD] * k)
            self.assertEqual(
                clock.update(report(timestamp, 900.0 + timestamp)), k * _PERIOD
            )

    def test_between_ticks_stays_there(self):
        clock = RobotClock(period=_PERIOD)
        times = [
            clock.update(report(5.0 + 0.002 * k, 1.0 + 0.002 * k))
            for k in range(6)
        ]
        for k, time in enumerate(times):
            self.assertAlmostEqual(time, 0.002 * k, places=12)
        self.assertEqual(times[4], _PERIOD)

    def test_missed_packages_are_time_as_well(self):
        clock = RobotClock(period=_PERIOD)
        clock.update(report(5.0, 1.0))
        self.assertEqual(clock.update(report(5.08, 1.08)), 10 * _PERIOD)

    def test_new_session_takes_the_hosts_time(self):
        clock = RobotClock(period=_PERIOD)
        clock.update(report(500.0, 1.0))
        clock.update(report(500.008, 1.008))
        # The robot has restarted: its clock is back at zero after 2 s.
        time = clock.update(report(0.5, 3.008, session=1))
        self.assertAlmostEqual(time, 2.008)
        self.assertAlmostEqual(
            clock.update(report(0.508, 3.016, session=1)), 2.016
        )

    def test_never_goes_back(self):
        clock = RobotClock(period=_PERIOD)
        clock.update(report(5.0, 1.0))
        clock.update(report(5.08, 1.08))
        self.assertEqual(clock.update(report(5.04, 1.09)), 0.08)

    def test_lateness_counts_from_the_fastest(self):
        clock = RobotClock(period=_PERIOD)
        for k in range(10):
            clock.update(report(k * _PERIOD, 1.0 + k * _PERIOD))
        self.assertAlmostEqual(clock.lateness, 0.0)
        clock.update(report(10 * _PERIOD, 1.3 + 10 * _PERIOD))
        self.assertAlmostEqual(clock.lateness, 0.3, places=3)
        # The offset stays that of the fast ones.
        self.assertAlmostEqual(clock.offset, -1.0, places=4)


class TestRate(unittest.TestCase):
    def run_clock(self, *, rate=1.0, late=lambda t: 0.0, seconds=10.0):
        """Returns the known rates, one per report."""
        clock = RobotClock(period=_PERIOD)
        rates = []
        for k in range(round(seconds / _PERIOD)):
            t = k * _PERIOD
            clock.update(report(50.0 + rate * t, 900.0 + t + late(t)))
            rates.append(clock.rate.rate)
        self.newest = clock.rate.newest
        return rates

    def test_known_after_four_seconds(self):
        for rate in (2.0, 1.1, 1.021, 1.0, 0.979, 0.5):
            with self.subTest(rate=rate):
                rates = self.run_clock(rate=rate, seconds=4.1)
                self.assertAlmostEqual(rates[-1], rate, places=3)
                self.assertAlmostEqual(self.newest, rate, places=3)
                self.assertEqual(rates[round(1.9 / _PERIOD)], 1.0)

    def test_late_reports_are_no_rate(self):
        random = np.random.default_rng(1)
        for late in (
            lambda t: 0.24 * (3.0 < t < 4.5),
            lambda t: 0.24 * (t < 3.3),
            lambda t: 0.1 * (t % 2.0 < 0.9),
            lambda t: 0.24 * random.random(),
            lambda t: 0.05 * (t - 3.0) if 3.0 < t < 5.0 else 0.0,
        ):
            rates = self.run_clock(late=late)
            self.assertLess(max(abs(r - 1.0) for r in rates), 0.02)

    def test_each_session_has_its_own(self):
        clock = RobotClock(period=_PERIOD)
        for k in range(600):
            clock.update(report(50.0 + 2.0 * k * _PERIOD, k * _PERIOD))
        self.assertAlmostEqual(clock.rate.rate, 2.0, places=3)
        clock.update(report(1.0, 600 * _PERIOD, session=1))
        self.assertEqual(clock.rate.rate, 1.0)
