import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

import tofssm_drake.raycast.fan as mut


class TestFan(unittest.TestCase):
    def test_twenty_five_rays(self):
        self.assertEqual(mut.count_rays_per_ring(25), [8, 16])
        fov = np.deg2rad(25)
        dut = mut.make_cone_fan(fov, 25)
        angle = np.arccos(np.clip(dut[:, 0], -1, 1))
        np.testing.assert_allclose(angle[0], 0, atol=1e-15)
        np.testing.assert_allclose(angle[1:9], fov / 4, atol=1e-12)
        np.testing.assert_allclose(angle[9:], fov / 2, atol=1e-12)

    @given(fov=st.floats(1e-3, np.pi), rays=st.integers(1, 500))
    def test_fills_the_cone_up_to_its_edge(self, fov, rays):
        dut = mut.make_cone_fan(fov, rays)
        self.assertEqual(dut.shape, (rays, 3))
        np.testing.assert_allclose(np.linalg.norm(dut, axis=1), 1.0, atol=1e-14)
        np.testing.assert_array_equal(dut[0], [1, 0, 0])
        angle = np.arctan2(np.linalg.norm(dut[:, 1:], axis=1), dut[:, 0])
        self.assertLess(angle.max(), fov / 2 + 1e-12)
        if rays > 1:
            counts = mut.count_rays_per_ring(rays)
            edge = np.abs(angle - fov / 2) < 1e-12
            self.assertEqual(edge.sum(), counts[-1])
            self.assertEqual(max(counts), counts[-1])
            self.assertEqual(sum(counts), rays - 1)

    def test_no_direction_of_the_cone_is_far_from_a_ray(self):
        fov = np.deg2rad(25)
        rng = np.random.default_rng(0)
        for rays, farthest in ((25, 0.29), (100, 0.15), (400, 0.08)):
            dut = mut.make_cone_fan(fov, rays)
            polar = fov / 2 * np.sqrt(rng.uniform(size=5000))
            turn = rng.uniform(0, 2 * np.pi, 5000)
            probe = np.column_stack(
                [
                    np.cos(polar),
                    np.sin(polar) * np.cos(turn),
                    np.sin(polar) * np.sin(turn),
                ]
            )
            gap = np.arccos(np.clip(probe @ dut.T, -1, 1)).min(axis=1)
            self.assertLess(gap.max(), farthest * fov)

    def test_wrong_arguments(self):
        for fov, rays in ((0.0, 25), (-1.0, 25), (4.0, 25), (np.nan, 25)):
            with self.assertRaisesRegex(ValueError, "fov_rad"):
                mut.make_cone_fan(fov, rays)
        with self.assertRaisesRegex(ValueError, "rays: 0"):
            mut.make_cone_fan(0.4, 0)
