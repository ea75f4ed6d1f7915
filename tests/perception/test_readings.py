import math
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from scipy.optimize import brentq

from tofssm_drake.messages import Reading, RingHealth, SensorFault
import tofssm_drake.perception.readings as mut

CLEAR, VALID, MASKED, FAULTED, HELD = Reading


def classify(
    distance,
    status=0,
    *,
    age=0.02,
    self_nearest=np.inf,
    self_farthest=-np.inf,
    tolerance=0.03,
):
    reading, _, counted = mut.classify_readings(
        np.array([distance], dtype=float),
        np.array([status], dtype=np.uint8),
        np.array([age]),
        np.array([self_nearest]),
        np.array([self_farthest]),
        tolerance,
        0.04,
        4.0,
        0.072,
    )
    return Reading(reading[0]), counted[0]


# What ST's manuals say of each status, and this project's own.
FAULT_OF_STATUS = {
    **dict.fromkeys((0, 2, 3, 4, 7, 13), SensorFault.NONE),
    **dict.fromkeys((1, 6, 9, 11, 12), SensorFault.SIGMA),
    240: SensorFault.FROZEN,
    241: SensorFault.SELF_TEST,
    242: SensorFault.CONTESTED,
    253: SensorFault.BUS,
    254: SensorFault.NO_DATA,
}


class TestClassify(unittest.TestCase):
    def test_status(self):
        for status in range(256):
            reading, _ = classify(0.5, status)
            if status in (0, 3, 13):
                expected = VALID
            elif status in (2, 4, 7):
                expected = CLEAR
            else:
                expected = FAULTED
            self.assertEqual(reading, expected, status)

    def test_fault_shows_the_cause(self):
        for status in range(256):
            self.assertEqual(
                mut.find_fault(status, 0.02, 0.072),
                FAULT_OF_STATUS.get(status, SensorFault.HARDWARE),
                status,
            )
        for status in (0, 1, 2, 3, 8):
            for age in (0.0721, np.inf, np.nan):
                self.assertEqual(
                    mut.find_fault(status, age, 0.072), SensorFault.LATE
                )

    def test_no_return_keeps_no_arbitrary_millimetres_from_being_clear(self):
        for distance in (0.0, 0.01, 3.9, 65.535):
            self.assertEqual(classify(distance, 2)[0], CLEAR)

    def test_stale_is_never_clear(self):
        for status in (0, 2, 3, 4, 7):
            self.assertEqual(classify(0.5, status, age=0.0719)[0] != FAULTED, 1)
            self.assertEqual(classify(0.5, status, age=0.0721)[0], FAULTED)
            self.assertEqual(classify(0.5, status, age=np.inf)[0], FAULTED)
            self.assertEqual(classify(0.5, status, age=np.nan)[0], FAULTED)

    def test_implausible_distance(self):
        for distance in (-0.001, np.nan, np.inf, -np.inf, 4.001, 65.535):
            self.assertEqual(classify(distance)[0], FAULTED, distance)
        self.assertEqual(classify(4.0)[0], VALID)

    def test_not_a_number_is_never_clear(self):
        for status in range(256):
            reading, counted = classify(np.nan, status)
            if status in (3, 13):
                # Too near for a number.
                self.assertEqual((reading, counted), (VALID, 0.0))
            else:
                self.assertEqual(reading, FAULTED, status)

    def test_nearer_than_can_be_measured_is_the_nearest_possible(self):
        for distance, status in ((0.5, 3), (0.5, 13), (0.039, 0), (0.0, 0)):
            self.assertEqual(classify(distance, status), (VALID, 0.0))
        self.assertEqual(classify(0.041), (VALID, 0.041))

    def test_mask_interval(self):
        hits = dict(self_nearest=0.5, self_farthest=0.7)
        for distance, expected in (
            (0.469, VALID),
            (0.471, MASKED),
            (0.6, MASKED),
            (0.729, MASKED),
            (0.731, VALID),
        ):
            self.assertEqual(classify(distance, **hits)[0], expected, distance)
        self.assertEqual(classify(0.6)[0], VALID)

    def test_mask_never_hides_no_return_or_fault(self):
        hits = dict(self_nearest=0.5, self_farthest=0.7)
        self.assertEqual(classify(0.6, 2, **hits)[0], CLEAR)
        self.assertEqual(classify(0.6, 1, **hits)[0], FAULTED)
        # Something too near to be measured is not the robot at 0.5 m.
        self.assertEqual(classify(0.6, 3, **hits)[0], VALID)

    def test_self_hit_nearer_than_can_be_measured(self):
        hits = dict(self_nearest=0.035, self_farthest=0.035)
        for distance, status, expected in (
            (0.5, 3, MASKED),
            (0.005, 0, MASKED),
            (0.065, 0, MASKED),
            (0.075, 0, VALID),
        ):
            self.assertEqual(
                classify(distance, status, **hits)[0], expected, distance
            )

    @settings(deadline=None)
    @given(
        distance=st.floats(0.04, 4.0),
        nearest=st.floats(0.04, 2.0),
        width=st.floats(0.0, 1.0),
        tolerance=st.floats(0.0, 0.1),
    )
    def test_masked_iff_within_interval(
        self, distance, nearest, width, tolerance
    ):
        reading, counted = classify(
            distance,
            self_nearest=nearest,
            self_farthest=nearest + width,
            tolerance=tolerance,
        )
        within = nearest - tolerance <= distance <= nearest + width + tolerance
        self.assertEqual(reading, MASKED if within else VALID)
        self.assertEqual(counted, distance)


class TestSelfInterval(unittest.TestCase):
    def test_interval(self):
        nearest, farthest = mut.calc_self_interval(
            np.array([[0.4, np.inf, 0.9], [np.inf] * 3, [0.2, 0.2, 0.1]])
        )
        np.testing.assert_array_equal(nearest, [0.4, np.inf, 0.1])
        np.testing.assert_array_equal(farthest, [0.9, -np.inf, 0.2])


class TestRingHealth(unittest.TestCase):
    def check(self, readings, expected, *, faulted_for=0.02, dead=0):
        """Tests a ring by numbers of clear, valid, masked, faulted sensors."""
        reading = np.repeat([CLEAR, VALID, MASKED, FAULTED], readings)
        fault = np.where(reading == FAULTED, SensorFault.BUS, SensorFault.NONE)
        times = np.where(reading == FAULTED, faulted_for, 0.02)
        reading = np.append(reading, [FAULTED] * dead).astype(np.uint8)
        fault = np.append(fault, [SensorFault.DEAD] * dead).astype(np.uint8)
        times = np.append(times, [np.inf] * dead)
        self.assertEqual(
            mut.calc_ring_health(reading, fault, times, 0.3), expected
        )

    def test_rule(self):
        for readings, expected in (
            ((8, 0, 0, 0), RingHealth.HEALTHY),
            ((0, 0, 8, 0), RingHealth.BLIND),
            ((1, 0, 7, 0), RingHealth.HEALTHY),
            ((0, 1, 7, 0), RingHealth.HEALTHY),
            ((0, 0, 6, 2), RingHealth.BLIND),
            ((4, 0, 0, 4), RingHealth.HEALTHY),
            ((3, 0, 0, 5), RingHealth.FAULTED),
            ((0, 0, 3, 5), RingHealth.FAULTED),
            ((0, 0, 0, 8), RingHealth.FAULTED),
            ((0, 0, 0, 0), RingHealth.FAULTED),
        ):
            with self.subTest(readings=readings):
                self.check(readings, expected)

    def test_one_sensor_faulted_for_too_long(self):
        for faulted_for, expected in (
            (0.299, RingHealth.HEALTHY),
            (0.301, RingHealth.FAULTED),
            (np.inf, RingHealth.FAULTED),
            (np.nan, RingHealth.FAULTED),
        ):
            self.check((7, 0, 0, 1), expected, faulted_for=faulted_for)

    def test_sensors_declared_dead(self):
        self.check((7, 0, 0, 0), RingHealth.DEGRADED, dead=1)
        self.check((0, 0, 7, 0), RingHealth.BLIND, dead=1)
        self.check((3, 0, 0, 4), RingHealth.FAULTED, dead=1)
        self.check((0, 0, 0, 0), RingHealth.FAULTED, dead=8)
        self.check((6, 0, 0, 1), RingHealth.FAULTED, dead=1, faulted_for=0.4)

    def test_count(self):
        reading = np.array([0, 3, 1, 2, 2, 3, 4, 0], dtype=np.uint8)
        np.testing.assert_array_equal(mut.count_readings(reading), [2, 2, 2, 2])

    def test_how_often_lost_samples_stop_the_robot(self):
        """The figures beside SeparationConfig.fault_time."""
        scans_per_s, sensors = 3 / 0.024, 8
        # A lag of 0.3 s of one sensor: a lost sample adds 24 ms, a good one
        # takes a fifth of it away. Bound of Cramer and Lundberg for how often
        # that walk gets from 1 to 12.5 steps.
        for lost, days in ((0.05, 1665.0), (0.07, 4.3)):
            exponent = brentq(
                lambda x, p=lost: (
                    p * math.exp(x) + (1 - p) * math.exp(-0.2 * x) - 1
                ),
                0.1,
                10.0,
            )
            rate = scans_per_s * sensors * lost * math.exp(-11.5 * exponent)
            self.assertAlmostEqual(days * 86400 * rate, 1.0, delta=0.01)
        # More than half of a ring at once.
        at_once = scans_per_s * sum(
            math.comb(8, k) * 0.01**k * 0.99 ** (8 - k) for k in range(5, 9)
        )
        self.assertAlmostEqual(1 / at_once / 86400, 17.0, places=1)


if __name__ == "__main__":
    unittest.main()
