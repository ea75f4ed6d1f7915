import math
import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from scipy import stats

import tofssm_drake.studies.statistics as mut


class TestEstimate(unittest.TestCase):
    def test_interval_is_students(self):
        values = [0.2, 0.5, 0.1, 0.9, 0.4]
        value = mut.calc_estimate(values)
        low, high = stats.t.interval(
            0.95, 4, loc=np.mean(values), scale=stats.sem(values)
        )
        self.assertAlmostEqual(value.low, low, places=7)
        self.assertAlmostEqual(value.high, high, places=7)
        self.assertEqual(value.count, 5)

    def test_few_values(self):
        none = mut.calc_estimate([math.nan])
        self.assertEqual(none.count, 0)
        self.assertTrue(math.isnan(none.mean))
        one = mut.calc_estimate([3.0, math.nan])
        self.assertEqual((one.mean, one.count), (3.0, 1))
        self.assertTrue(math.isnan(one.half_width))
        same = mut.calc_estimate([2.0, 2.0, 2.0])
        self.assertEqual((same.mean, same.count), (2.0, 3))
        # Their interval would have no width: that is no certainty.
        self.assertTrue(math.isnan(same.half_width))
        rounded = mut.calc_estimate([0.1 + 0.2, 0.3])
        self.assertTrue(math.isnan(rounded.half_width))
        self.assertGreater(mut.calc_estimate([0.3, 0.3001]).half_width, 0.0)

    def test_paired_difference_uses_the_trials_of_both(self):
        first = {1: 5.0, 2: 7.0, 3: 100.0}
        second = {2: 4.0, 1: 3.0, 4: -100.0}
        value = mut.calc_paired_difference(first, second)
        self.assertEqual((value.mean, value.count), (2.5, 2))

    @given(shift=st.floats(-5, 5), seed=st.integers(0, 99))
    def test_pairing_takes_out_what_trials_share(self, shift, seed):
        rng = np.random.default_rng(seed)
        people = dict(enumerate(rng.normal(0.0, 10.0, 5)))
        moved = {
            trial: value + shift + 0.001 * (trial % 2)
            for trial, value in people.items()
        }
        value = mut.calc_paired_difference(moved, people)
        self.assertAlmostEqual(value.mean, shift + 0.0004)
        self.assertLess(value.half_width, 0.001)


class TestEllipse(unittest.TestCase):
    def test_covers_the_mean_as_often_as_it_says(self):
        rng = np.random.default_rng(1)
        mix = np.array([[2.0, 0.5], [0.3, 0.1]])
        inside = 0
        for _ in range(1000):
            x, y = mix @ rng.normal(size=(2, 5)) + [[3.0], [-1.0]]
            ellipse = mut.calc_confidence_ellipse(x, y)
            dx, dy = 3.0 - ellipse.centre[0], -1.0 - ellipse.centre[1]
            c, s = math.cos(ellipse.angle), math.sin(ellipse.angle)
            u = (c * dx + s * dy) / ellipse.half_axes[0]
            v = (-s * dx + c * dy) / ellipse.half_axes[1]
            inside += u * u + v * v <= 1.0
        # Three standard deviations of a binomial count.
        self.assertAlmostEqual(inside / 1000, 0.95, delta=0.021)

    def test_axes(self):
        x = np.array([-2.0, 2.0, 0.0, 0.0])
        y = np.array([0.0, 0.0, -1.0, 1.0])
        ellipse = mut.calc_confidence_ellipse(x, y)
        self.assertEqual(ellipse.centre, (0.0, 0.0))
        self.assertAlmostEqual(math.sin(ellipse.angle), 0.0)
        f = stats.f.ppf(0.95, 2, 2)
        expected = math.sqrt(2 * 3 / (4 * 2) * f * np.var(x, ddof=1))
        self.assertAlmostEqual(ellipse.half_axes[0], expected)
        self.assertAlmostEqual(ellipse.half_axes[1], expected / 2)

    def test_too_few_pairs(self):
        nan = math.nan
        self.assertIsNone(mut.calc_confidence_ellipse([1, 2], [3, 4]))
        self.assertIsNone(mut.calc_confidence_ellipse([1, 2, nan], [3, 4, 5]))


class TestRateBound(unittest.TestCase):
    def test_worked_numbers(self):
        self.assertAlmostEqual(mut.calc_rate_bound(45), 0.064, places=3)
        self.assertAlmostEqual(mut.calc_rate_bound(299), 0.01, places=4)


class TestFormat(unittest.TestCase):
    def test_what_rounds_to_nothing_has_no_minus(self):
        value = mut.calc_estimate([-0.001, -0.002, -0.003])
        for digits, sign, text in (
            (1, False, "0.0 \u00b1 0.0"),
            (1, True, "+0.0 \u00b1 0.0"),
            (3, True, "\u22120.002 \u00b1 0.002"),
        ):
            with self.subTest(text):
                self.assertEqual(
                    mut.format_estimate(value, digits=digits, sign=sign), text
                )


if __name__ == "__main__":
    unittest.main()
