import dataclasses as dc
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.common.yaml import yaml_load_typed

from tofssm_drake.errors import UserError
from tofssm_drake.sensors.range_sensor import draw_constants
import tofssm_drake.sensors.vl53l1x as mut

QUIET = dict(
    range_falloff=0.0,
    noise_gain=0.0,
    bias_sigma=0.0,
    gain_sigma=0.0,
    min_range_error=0.0,
    dropout=0.0,
    resolution=0.0,
)


def measure(config, ray_distance, noise=None, errors=None, seed=0):
    ray_distance = np.asarray(ray_distance, dtype=float)
    n = len(ray_distance)
    if noise is None:
        noise = np.random.default_rng(seed).standard_normal(
            (n, mut.NOISE_DRAWS)
        )
    return mut.measure(
        config,
        ray_distance=ray_distance,
        noise=noise,
        errors=errors
        or mut.make_sensor_errors(config, np.zeros((n, mut.CONSTANT_DRAWS))),
    )


class TestConfig(unittest.TestCase):
    def test_loads_from_yaml(self):
        dut = yaml_load_typed(
            schema=mut.Vl53l1x,
            data="{ideal: true, usable_range: 1.5, return_model: mean}",
        )
        dut.check("sensor")
        self.assertTrue(dut.ideal)
        self.assertEqual(dut.usable_range, 1.5)

    def test_says_what_and_where(self):
        with self.assertRaisesRegex(
            UserError, r"rings\.sensor\.dropout: 1\.5 .* 0 to 1"
        ):
            mut.Vl53l1x(dropout=1.5).check("rings.sensor")
        with self.assertRaisesRegex(UserError, "'far' .* 'nearest' or 'mean'"):
            mut.Vl53l1x(return_model="far").check("sensor")

    def test_every_number_is_checked(self):
        for field in dc.fields(mut.Vl53l1x):
            if field.type is float:
                for bad in (-1.0, np.nan, 1e6):
                    config = mut.Vl53l1x(**{field.name: bad})
                    with self.assertRaisesRegex(UserError, field.name):
                        config.check("sensor")

    def test_cast_range(self):
        self.assertEqual(mut.Vl53l1x(ideal=True).traits.cast_range, 1.31)
        self.assertEqual(mut.Vl53l1x().traits.cast_range, 1.36)
        self.assertEqual(mut.Vl53l1x(usable_range=1.5).traits.cast_range, 1.5)

    def test_traits(self):
        dut = mut.Vl53l1x().traits
        dut.check("sensor")
        self.assertAlmostEqual(dut.period, 0.024)
        self.assertEqual(dut.delivery_time, 0.005)
        self.assertAlmostEqual(dut.max_range, 1.45)
        # More than the datasheet's +-25 mm.
        self.assertEqual(dut.tolerance, 0.030)
        self.assertEqual(mut.Vl53l1x(ideal=True).traits.noise_draws, 0)

    def test_surely_seen_range(self):
        """To within 2 in 1000, and never beyond the range."""
        n = 100000
        for changes in ({}, {"range_falloff": 0.1}, {"usable_range": 0.5}):
            config = mut.Vl53l1x(
                **{"dropout": 0.0, "sigma_limit": 0.0}, **changes
            )
            sure = config.traits.sure_range
            _, status = measure(config, np.full((n, 1), sure))
            self.assertAlmostEqual((status == 0).mean(), 0.998, delta=5e-4)
        self.assertEqual(mut.Vl53l1x(range_falloff=1.0).traits.sure_range, 0.0)
        self.assertGreater(mut.Vl53l1x().traits.sure_range, 0.9)


class TestMeasure(unittest.TestCase):
    def test_ideal_is_the_exact_nearest_and_reads_no_noise(self):
        rays = [[0.5123456, 0.7, np.inf], [np.inf] * 3, [0.0, 1.0, 1.0]]
        distance, status = measure(
            mut.Vl53l1x(ideal=True),
            rays,
            noise=np.full((3, mut.NOISE_DRAWS), np.nan),
        )
        self.assertEqual(distance[0], 0.5123456)
        self.assertEqual(distance[2], 0.0)
        np.testing.assert_array_equal(status, [0, 2, 0])

    def test_everything_switched_off_equals_ideal(self):
        rays = np.random.default_rng(1).uniform(0.001, 2.0, (500, 25))
        quiet = measure(mut.Vl53l1x(**QUIET), rays)
        ideal = measure(mut.Vl53l1x(ideal=True), rays)
        seen = ideal[1] == 0
        np.testing.assert_array_equal(quiet[1] == 0, seen)
        np.testing.assert_allclose(
            quiet[0][seen], ideal[0][seen], rtol=0, atol=1e-15
        )
        far = rays + 2.0
        self.assertTrue((measure(mut.Vl53l1x(**QUIET), far)[1] != 0).all())

    def test_noise_has_the_standard_deviation_of_the_datasheet(self):
        # 1.8 mm at 0.4 to 1.0 m and 33 ms; sqrt(33/20) more at 20 ms.
        n = 20000
        for budget, expected in ((0.033, 1.8e-3), (0.020, 2.3122e-3)):
            config = mut.Vl53l1x(
                **{**QUIET, "noise_gain": 1.0, "timing_budget": budget}
            )
            distance, status = measure(config, np.full((n, 1), 0.7))
            self.assertTrue((status == 0).all())
            self.assertAlmostEqual(distance.mean(), 0.7, delta=1e-4)
            self.assertAlmostEqual(distance.std() / expected, 1.0, delta=0.02)

    def test_bias_and_gain_are_constant_per_sensor(self):
        config = mut.Vl53l1x(**QUIET)
        errors = mut.SensorErrors(
            bias=np.array([0.01, -0.005]), gain=np.array([1.0, 1.002])
        )
        distance, _ = measure(config, [[0.5], [1.0]], errors=errors)
        np.testing.assert_allclose(distance, [0.51, 0.997], atol=1e-12)

    def test_errors_follow_the_seed(self):
        config = mut.Vl53l1x()

        def draw(seed, ring=0):
            return mut.make_sensor_errors(
                config,
                draw_constants(
                    config.traits, sensors=2000, seed=seed, ring=ring
                ),
            )

        one, same, other, ring = draw(3), draw(3), draw(4), draw(3, ring=1)
        np.testing.assert_array_equal(one.bias, same.bias)
        np.testing.assert_array_equal(one.gain, same.gain)
        self.assertFalse((one.bias == other.bias).all())
        self.assertFalse((one.bias == ring.bias).all())
        self.assertEqual(np.abs(one.bias).max(), 0.015)
        self.assertAlmostEqual(one.gain.std(), 0.002, delta=2e-4)

    def test_half_is_seen_at_the_usable_range(self):
        config = mut.Vl53l1x(**{**QUIET, "range_falloff": 0.05})
        n = 20000
        for d, expected in ((1.31, 0.5), (1.31 - 0.0655, 0.7311), (1.361, 0)):
            _, status = measure(config, np.full((n, 1), d))
            self.assertAlmostEqual((status == 0).mean(), expected, delta=0.015)
            # Too far is weak or out of bounds, never a broken sensor.
            self.assertLessEqual(set(status), {0, 2, 4, 7})

    def test_dropouts_have_the_shares_of_the_kinds(self):
        n = 40000
        config = mut.Vl53l1x(**{**QUIET, "dropout": 0.5})
        distance, status = measure(config, np.full((n, 1), 0.6))
        lost = status != 0
        self.assertAlmostEqual(lost.mean(), 0.5, delta=0.01)
        for kind, share in ((2, 0.70), (1, 0.15), (4, 0.10), (7, 0.05)):
            self.assertAlmostEqual(
                (status[lost] == kind).mean(), share, delta=0.01
            )
        # The millimetres are then independent of the target.
        self.assertLess(distance[lost].min(), 0.05)
        self.assertGreater(distance[lost].max(), 3.95)
        self.assertLess(abs(np.median(distance[lost]) - 2.0), 0.1)

    def test_nearer_than_the_minimum_is_detected_but_wrong(self):
        config = mut.Vl53l1x(**{**QUIET, "min_range_error": 0.03})
        distance, status = measure(config, np.full((4000, 1), 0.035))
        self.assertEqual(set(status), {0, 3})
        self.assertAlmostEqual((status == 3).mean(), 0.5, delta=0.05)
        self.assertGreater(np.ptp(distance), 0.055)
        self.assertLessEqual(np.abs(distance - 0.035).max(), 0.03 + 1e-12)

    def test_large_sigma_fails(self):
        config = mut.Vl53l1x(**{**QUIET, "noise_gain": 10.0})
        _, status = measure(config, np.full((100, 1), 0.7))
        self.assertEqual(set(status), {1})

    def test_mean_is_weighted_like_the_photons(self):
        config = mut.Vl53l1x(**{**QUIET, "return_model": "mean"})
        distance, _ = measure(config, [[0.5, 1.0, np.inf]])
        # (4 * 0.5 + 1 * 1.0) / 5
        self.assertAlmostEqual(distance[0], 0.6, delta=1e-12)
        config.noise_gain = 1.0
        config.spread_gain = 1.0
        _, status = measure(config, [[0.5, 1.0, np.inf]])
        self.assertEqual(status[0], mut.STATUS_SIGMA_FAIL)

    def test_whole_millimetres(self):
        config = mut.Vl53l1x()
        rays = np.random.default_rng(2).uniform(0.0, 2.0, (2000, 3))
        distance, _ = measure(config, rays)
        np.testing.assert_allclose(
            distance * 1e3, np.round(distance * 1e3), atol=1e-9
        )

    def test_wrapped_target_looks_near(self):
        config = mut.Vl53l1x(**{**QUIET, "wrap_probability": 1.0})
        distance, status = measure(config, [[2.0], [np.inf]])
        self.assertAlmostEqual(distance[0], 0.64)
        self.assertEqual(status[0], 0)
        self.assertNotEqual(status[1], 0)
        self.assertEqual(config.traits.cast_range, 4.0)

    @settings(deadline=None, max_examples=50)
    @given(
        rays=st.lists(
            st.one_of(st.just(np.inf), st.floats(0.0, 4.0)),
            min_size=1,
            max_size=6,
        ),
        draws=st.lists(
            st.floats(-8.0, 8.0),
            min_size=mut.NOISE_DRAWS,
            max_size=mut.NOISE_DRAWS,
        ),
        mean=st.booleans(),
    )
    def test_reports_something_a_device_could(self, rays, draws, mean):
        config = mut.Vl53l1x(
            return_model="mean" if mean else "nearest", dropout=0.2
        )
        distance, status = measure(config, [rays], np.array([draws]))
        self.assertTrue(0.0 <= distance[0] <= mut.SATURATED)
        self.assertIn(status[0], (0, 1, 2, 3, 4, 7))
        if min(rays) == np.inf:
            self.assertIn(status[0], (1, 2, 4, 7))


if __name__ == "__main__":
    unittest.main()
