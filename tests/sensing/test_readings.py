import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.messages import Reading, RingHealth
import tofssm_drake.sensing.readings as mut

CLEAR, VALID, MASKED, FAULTED = Reading


def classify(
    distance,
    status=0,
    *,
    age=0.02,
    self_nearest=np.inf,
    self_farthest=-np.inf,
    tolerance=0.03,
):
    reading, reckoned = mut.classify_readings(
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
    return Reading(reading[0]), reckoned[0]


class TestClassify(unittest.TestCase):
    def test_status(self):
        for status in range(256):
            reading, _ = classify(0.5, status)
            if status in (0, 3):
                expected = VALID
            elif status in (2, 4, 7):
                expected = CLEAR
            else:
                expected = FAULTED
            self.assertEqual(reading, expected, status)

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

    def test_nearer_than_can_be_measured_is_the_nearest_possible(self):
        for distance, status in ((0.5, 3), (0.039, 0), (0.0, 0)):
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
        # Something nearer than can be measured is not the robot at 0.5 m.
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
        reading, reckoned = classify(
            distance,
            self_nearest=nearest,
            self_farthest=nearest + width,
            tolerance=tolerance,
        )
        within = nearest - tolerance <= distance <= nearest + width + tolerance
        self.assertEqual(reading, MASKED if within else VALID)
        self.assertEqual(reckoned, distance)


class TestSelfInterval(unittest.TestCase):
    def test_interval(self):
        nearest, farthest = mut.calc_self_interval(
            np.array([[0.4, np.inf, 0.9], [np.inf] * 3, [0.2, 0.2, 0.1]])
        )
        np.testing.assert_array_equal(nearest, [0.4, np.inf, 0.1])
        np.testing.assert_array_equal(farthest, [0.9, -np.inf, 0.2])


class TestRingHealth(unittest.TestCase):
    def test_rule(self):
        for clear, valid, masked, faulted, expected in (
            (8, 0, 0, 0, RingHealth.HEALTHY),
            (0, 0, 8, 0, RingHealth.BLIND),
            (1, 0, 7, 0, RingHealth.HEALTHY),
            (0, 1, 7, 0, RingHealth.HEALTHY),
            (0, 0, 6, 2, RingHealth.BLIND),
            (6, 0, 0, 2, RingHealth.HEALTHY),
            (5, 0, 0, 3, RingHealth.FAULTED),
            (0, 5, 0, 3, RingHealth.FAULTED),
            (0, 0, 5, 3, RingHealth.FAULTED),
            (0, 0, 0, 8, RingHealth.FAULTED),
            (0, 0, 0, 1, RingHealth.FAULTED),
            (0, 0, 0, 0, RingHealth.FAULTED),
        ):
            count = np.array([clear, valid, masked, faulted])
            self.assertEqual(mut.calc_ring_health(count, 2), expected, count)

    def test_count(self):
        reading = np.array([0, 3, 1, 2, 2, 3, 3, 0], dtype=np.uint8)
        np.testing.assert_array_equal(mut.count_readings(reading), [2, 1, 2, 3])


if __name__ == "__main__":
    unittest.main()
