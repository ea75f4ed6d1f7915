import math
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.errors import UserError
import tofssm_drake.people.figure_eight as mut


class FigureEightTest(unittest.TestCase):
    def test_default_extent(self):
        dut = mut.FigureEightPath(config=mut.FigureEight())
        points = dut.calc_position(np.linspace(0, dut.length, 4001))
        np.testing.assert_allclose(points.min(0), [0.7, -1.5], atol=1e-3)
        np.testing.assert_allclose(points.max(0), [1.6, 1.5], atol=1e-3)
        np.testing.assert_allclose(points[0], [1.15, 1.5], atol=1e-3)

    @settings(max_examples=20, deadline=None)
    @given(
        st.floats(1.2, 3.0),
        st.floats(0.25, 0.5),
        st.floats(-180, 180),
        st.floats(0, 1),
        st.booleans(),
    )
    def test_closed_with_unit_speed(self, a, ratio, angle, start, reverse):
        config = mut.FigureEight(
            half_length=a,
            half_width=a * ratio,
            orientation_deg=angle,
            start=start,
            reverse=reverse,
        )
        dut = mut.FigureEightPath(config=config)
        s = np.linspace(0, dut.length, 500)
        h = 1e-2
        p = dut.calc_position(s)
        step = np.linalg.norm(dut.calc_position(s + h) - p, axis=-1)
        np.testing.assert_allclose(step, h, rtol=5e-3)
        np.testing.assert_allclose(
            dut.calc_position(s + dut.length), p, atol=1e-6
        )
        direction = dut.calc_direction(s, h)
        np.testing.assert_allclose(
            np.linalg.norm(direction, axis=-1), 1.0, atol=1e-12
        )
        difference = dut.calc_position(s + h) - dut.calc_position(s - h)
        self.assertTrue((np.sum(difference * direction, -1) > 0).all())

    def test_crosses_itself_once_in_each_direction(self):
        config = mut.FigureEight(start=0.0, orientation_deg=0.0, centre=[0, 0])
        dut = mut.FigureEightPath(config=config)
        middle = dut.calc_position(np.array([0.0, dut.length / 2]))
        np.testing.assert_allclose(middle, 0.0, atol=1e-6)
        direction = dut.calc_direction(np.array([0, dut.length / 2]), 1e-3)
        self.assertGreater(direction[0, 0], 0)
        self.assertLess(direction[1, 0], 0)

    def test_smallest_radius(self):
        """Against the circle through three near points of the path."""
        config = mut.FigureEight()
        dut = mut.FigureEightPath(config=config)
        s = np.linspace(0, dut.length, 3000)
        a, b, c = (dut.calc_position(s + h) for h in (-0.02, 0.0, 0.02))
        (x, y), (u, v) = (b - a).T, (c - a).T
        area = np.abs(x * v - y * u) / 2
        sides = [np.linalg.norm(v, axis=-1) for v in (b - a, c - b, c - a)]
        radius = np.prod(sides, axis=0) / np.maximum(4 * area, 1e-9)
        self.assertAlmostEqual(
            mut.calc_smallest_radius(config), radius.min(), delta=5e-3
        )

    def test_check(self):
        mut.FigureEight().check("walk")
        for name, value in (
            ("centre", [1.0]),
            ("centre", [1.0, math.nan]),
            ("centre", [1e200, 0.0]),
            ("centre", [0.0, -100.1]),
            ("orientation_deg", 1e300),
            ("half_length", -1.0),
            ("half_width", math.nan),
            ("half_width", 0.25),
            ("orientation_deg", math.inf),
            ("start", 1.5),
        ):
            with self.subTest(name=name, value=value):
                config = mut.FigureEight(**{name: value})
                with self.assertRaisesRegex(UserError, rf"^walk\.{name}: "):
                    config.check("walk")


if __name__ == "__main__":
    unittest.main()
