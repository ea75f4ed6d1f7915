import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.messages import Reading, SensorFault
import tofssm_drake.perception.memory as mut

CLEAR, VALID, MASKED, FAULTED, HELD = Reading
NONE, BUS, SIGMA, DEAD = (
    SensorFault.NONE,
    SensorFault.BUS,
    SensorFault.SIGMA,
    SensorFault.DEAD,
)


class Sensor:
    """One sensor, sample by sample."""

    def __init__(self, clear_samples=2, sigma_samples=2):
        self.settings = clear_samples, sigma_samples
        self.reading = CLEAR
        self.counts = np.zeros((3, 1), dtype=int)

    def take(
        self,
        reading,
        fault=NONE,
        *,
        is_new=True,
        is_proven=True,
        has_lag=False,
        is_other=False,
    ):
        """Returns the reading and whether it is held at 0 m."""
        readings = np.array([reading], dtype=np.uint8)
        is_nearest = mut.hold_obstacles(
            readings,
            np.array([fault]),
            np.array([is_new]),
            np.array([is_proven]),
            np.array([has_lag]),
            np.array([is_other]),
            np.array([self.reading in (VALID, HELD)]),
            self.counts,
            *self.settings,
        )
        self.reading = Reading(readings[0])
        return self.reading, bool(is_nearest[0])


class TestHoldObstacles(unittest.TestCase):
    def check(self, dut, *steps):
        for sample, expected in steps:
            sample = sample if isinstance(sample, tuple) else (sample,)
            self.assertEqual(dut.take(*sample)[0], expected)

    def test_clear_must_be_confirmed_by_a_sensor_that_saw_something(self):
        self.check(
            Sensor(),
            (CLEAR, CLEAR),
            (VALID, VALID),
            (CLEAR, HELD),
            (CLEAR, CLEAR),
            (VALID, VALID),
            (CLEAR, HELD),
            (VALID, VALID),
            (CLEAR, HELD),
            # The robot is seen where it must be: nothing is in front of it.
            (MASKED, MASKED),
            (CLEAR, CLEAR),
        )

    def test_the_same_sample_again_confirms_nothing(self):
        dut = Sensor()
        dut.take(VALID)
        dut.take(CLEAR)
        for _ in range(5):
            self.assertEqual(dut.take(CLEAR, is_new=False)[0], HELD)
        self.assertEqual(dut.take(CLEAR)[0], CLEAR)

    def test_a_ring_that_does_not_see_the_robot_confirms_nothing(self):
        dut = Sensor()
        dut.take(VALID)
        for _ in range(5):
            self.assertEqual(dut.take(CLEAR, is_proven=False)[0], HELD)
        self.assertEqual(dut.take(CLEAR)[0], HELD)
        self.assertEqual(dut.take(CLEAR)[0], CLEAR)
        # It must not have seen anything for that to matter.
        self.assertEqual(dut.take(CLEAR, is_proven=False)[0], CLEAR)

    def test_a_fault_holds_what_was_there_and_nothing_else(self):
        self.check(
            Sensor(),
            ((FAULTED, BUS), FAULTED),
            (VALID, VALID),
            *[((FAULTED, BUS), HELD)] * 50,
            # A fault between two samples without return: not in a row.
            (CLEAR, HELD),
            ((FAULTED, BUS), HELD),
            (CLEAR, HELD),
            (CLEAR, CLEAR),
            ((FAULTED, BUS), FAULTED),
        )

    def test_target_without_a_distance_is_the_nearest_possible(self):
        dut = Sensor()
        self.assertEqual(dut.take(FAULTED, SIGMA), (FAULTED, False))
        self.assertEqual(dut.take(FAULTED, SIGMA), (HELD, True))
        # From then on it closes in from there.
        self.assertEqual(dut.take(FAULTED, SIGMA), (HELD, False))
        dut = Sensor()
        dut.take(VALID)
        self.assertEqual(dut.take(FAULTED, SIGMA), (HELD, False))

    def test_one_lost_return_between_two_of_them_changes_nothing(self):
        dut = Sensor()
        dut.take(FAULTED, SIGMA)
        self.assertEqual(dut.take(CLEAR), (CLEAR, False))
        self.assertEqual(dut.take(FAULTED, SIGMA), (HELD, True))
        dut = Sensor()
        dut.take(FAULTED, SIGMA)
        dut.take(CLEAR)
        dut.take(CLEAR)
        self.assertEqual(dut.take(FAULTED, SIGMA), (FAULTED, False))

    def test_a_sensor_that_failed_lately_is_not_clear(self):
        dut = Sensor()
        dut.take(VALID)
        for _ in range(5):
            self.assertEqual(dut.take(CLEAR, has_lag=True)[0], HELD)
        self.assertEqual(dut.take(CLEAR)[0], CLEAR)
        # It must not have seen anything for that to matter.
        self.assertEqual(dut.take(CLEAR, has_lag=True)[0], CLEAR)

    def test_another_obstacle_must_be_seen_twice(self):
        dut = Sensor()
        dut.take(VALID)
        dut.counts[2] = 1
        self.assertEqual(dut.take(VALID, is_other=True)[0], HELD)
        dut.counts[2] = 2
        self.assertEqual(dut.take(VALID, is_other=True)[0], VALID)

    def test_a_dead_sensor_holds_nothing(self):
        dut = Sensor()
        dut.take(VALID)
        self.assertEqual(dut.take(VALID, DEAD), (FAULTED, False))

    samples = st.lists(
        st.tuples(
            st.sampled_from([CLEAR, FAULTED]),
            st.sampled_from([f for f in SensorFault if f not in (NONE, DEAD)]),
            st.booleans(),
        ),
        max_size=40,
    )

    @settings(deadline=None)
    @given(samples=samples, clear_samples=st.integers(1, 4))
    def test_an_obstacle_ends_with_good_samples_only(
        self, samples, clear_samples
    ):
        dut = Sensor(clear_samples)
        dut.take(VALID)
        in_a_row = 0
        for reading, fault, is_new in samples:
            if reading == CLEAR:
                in_a_row += is_new
                dut.take(CLEAR, is_new=is_new)
            else:
                in_a_row = 0
                dut.take(FAULTED, fault, is_new=is_new)
            if in_a_row >= clear_samples:
                return
            self.assertEqual(dut.reading, HELD)


class TestConfig(unittest.TestCase):
    def test_check(self):
        mut.SensorMemoryConfig().check("here")
        for name in ("clear_samples", "sigma_samples"):
            for bad in (0, 101, 1.5):
                with self.assertRaisesRegex(UserError, f"here.{name}: .*use"):
                    mut.SensorMemoryConfig(**{name: bad}).check("here")


class TestHealthyTime(unittest.TestCase):
    def run_samples(self, works, period=0.024):
        """Returns the lag after each sample of a sensor, s."""
        healthy, before, lags = -np.inf, -np.inf, []
        for i, is_good in enumerate(works):
            time = period * i
            if is_good:
                healthy = mut.calc_healthy_time(healthy, time, before, 5.0, 0.5)
            before = time
            lags.append(time - healthy)
        return lags

    def test_one_lost_sample_is_forgotten_after_five(self):
        lags = self.run_samples([1, 1, 0, 1, 1, 1, 1, 1, 1])
        np.testing.assert_allclose(
            lags,
            0.024 * np.array([0, 0, 1, 0.8, 0.6, 0.4, 0.2, 0, 0]),
            atol=1e-12,
        )

    def test_a_sensor_that_mostly_fails_never_looks_healthy(self):
        for pattern in ([0] * 11 + [1], [0, 1], [0, 0, 1, 1]):
            lags = self.run_samples([1, *(pattern * 60)])
            self.assertGreater(min(lags[len(lags) // 2 :]), 0.3, pattern)

    def test_one_in_ten_is_tolerable(self):
        lags = self.run_samples([1, *([1] * 9 + [0]) * 100])
        self.assertLess(max(lags), 0.03)

    def test_no_lag_is_longer_than_the_longest(self):
        lags = self.run_samples([1, *[0] * 1000, *[1] * 106])
        self.assertAlmostEqual(lags[1001], 0.5)
        self.assertAlmostEqual(lags[-1], 0.0, places=9)

    def test_a_pause_is_not_work(self):
        healthy = mut.calc_healthy_time(1.0, 5.0, 1.2, 5.0, 0.5)
        self.assertAlmostEqual(healthy, 4.5)


class TestOtherObstacles(unittest.TestCase):
    def setUp(self):
        self.others = np.zeros(1, dtype=int)

    def find(self, distance, time=0.024, *, is_changed=True, has_lag=False):
        """An obstacle at 0.4 m at 0 s; returns what a later sample shows."""
        (is_other,) = mut.find_other_obstacles(
            np.array([VALID]),
            np.array([True]),
            np.array([distance]),
            np.array([time]),
            np.array([[0.4], [0.0]]),
            np.array([is_changed]),
            np.array([has_lag]),
            np.array([3.3, 0.05]),
            self.others,
        )
        return bool(is_other), int(self.others[0])

    def test_nothing_recedes_that_fast(self):
        # 0.4 m + 0.05 m + 3.3 m/s * 24 ms
        self.assertEqual(self.find(0.529), (False, 0))
        self.assertEqual(self.find(0.530), (True, 1))
        self.assertEqual(self.find(1.3, 0.048), (True, 2))

    def test_the_very_same_value_again_does_not_count(self):
        self.assertEqual(self.find(1.3), (True, 1))
        # After 0.3 s something could be that far away, if not it alone said so.
        for i in range(2, 30):
            found = self.find(1.3, 0.024 * i, is_changed=False)
            self.assertEqual(found, (True, 1))
        self.assertEqual(self.find(1.301, 0.8), (True, 2))

    def test_what_comes_back_ends_it(self):
        self.find(1.3)
        self.assertEqual(self.find(0.41, 0.048), (False, 0))

    def test_a_sensor_that_failed_lately_is_not_believed(self):
        self.assertEqual(self.find(1.3, has_lag=True), (True, 0))
        # However long ago the obstacle was seen.
        self.assertEqual(self.find(1.3, 5.0, has_lag=True), (True, 0))
        self.assertEqual(self.find(1.3, 5.0), (False, 0))


if __name__ == "__main__":
    unittest.main()
