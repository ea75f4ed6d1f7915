import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.geometry import Capsule, Role, Sphere
from pydrake.math import RigidTransform, RotationMatrix
import ray_oracle as oracle

import tofssm_drake.metrics.distance as mut

coordinate = st.floats(-2, 2)
point = st.tuples(coordinate, coordinate, coordinate)


def calc_segment_distance(a, b, c, d):
    """The same by search: the distance is convex along the first segment."""

    def calc_gap(s):
        p = a + s * (b - a)
        t = (p - c) @ (d - c) / ((d - c) @ (d - c))
        return np.linalg.norm(c + np.clip(t, 0, 1) * (d - c) - p)

    low, high = 0.0, 1.0
    while high - low > 1e-9:
        first, second = (2 * low + high) / 3, (low + 2 * high) / 3
        if calc_gap(first) < calc_gap(second):
            high = second
        else:
            low = first
    return calc_gap(0.5 * (low + high))


def closest(a_p, a_q, a_r, b_p, b_q, b_r):
    return mut.closest_capsules(
        *(np.asarray(x, dtype=float) for x in (a_p, a_q, a_r, b_p, b_q, b_r))
    )


class TestClosestCapsules(unittest.TestCase):
    def test_against_a_search(self):
        rng = np.random.default_rng(0)
        for _ in range(300):
            ends = rng.uniform(-1, 1, (4, 3))
            distance, i, j, p_A, p_B = closest(
                ends[:1], ends[1:2], [0.0], ends[2:3], ends[3:], [0.0]
            )
            self.assertEqual((i, j), (0, 0))
            self.assertAlmostEqual(
                distance, calc_segment_distance(*ends), delta=1e-9
            )
            self.assertAlmostEqual(
                np.linalg.norm(p_A - p_B), distance, delta=1e-12
            )

    @settings(deadline=None)
    @given(point, point, point, point)
    def test_is_a_minimum(self, a, b, c, d):
        a, b, c, d = map(np.array, (a, b, c, d))
        distance, _, _, p_A, p_B = closest([a], [b], [0.0], [c], [d], [0.0])
        u = np.linspace(0, 1, 21)[:, None]
        on_a, on_b = a + u * (b - a), c + u * (d - c)
        sampled = np.linalg.norm(on_a[:, None] - on_b[None], axis=2).min()
        self.assertLessEqual(distance, sampled + 1e-12)
        self.assertAlmostEqual(np.linalg.norm(p_A - p_B), distance, delta=1e-9)
        flipped = closest([d], [c], [0.0], [b], [a], [0.0])[0]
        self.assertAlmostEqual(distance, flipped, delta=1e-9)

    def test_nearly_parallel_segments_that_cross(self):
        up = np.array([0.0, 0.0, 0.5])
        for angle in (1e-3, 1e-5, 1e-7, 1e-9, 1e-12, 0.0):
            with self.subTest(angle=angle):
                far = np.array([np.cos(angle), np.sin(angle), 0.0])
                distance = closest(
                    [[-1.0, 0, 0]], [[1.0, 0, 0]], [0.0],
                    [up - far], [up + far], [0.0],
                )[0]  # fmt: skip
                self.assertAlmostEqual(distance, 0.5, delta=1e-15)

    def test_signed_distance_and_witness_points_against_drake(self):
        rng = np.random.default_rng(1)
        scene = oracle.Scene(Role.kProximity)
        segments = []
        for _ in range(12):
            frame = scene.add_frame()
            scene.add(Capsule(0.1, 0.5), frame_id=frame)
            segments.append(frame)
        for _ in range(20):
            scene.move(rng)
            query_object = scene.query_object()
            p = [scene.poses[f] @ [0, 0, 0.25] for f in segments]
            q = [scene.poses[f] @ [0, 0, -0.25] for f in segments]
            r = np.full(12, 0.1)
            for i in range(6):
                distance, _, j, p_A, p_B = closest(
                    p[i : i + 1], q[i : i + 1], r[:1], p[6:], q[6:], r[6:]
                )
                self.assertAlmostEqual(
                    (p_A - p_B) @ (p_A - p_B), distance**2, delta=1e-12
                )
                for point, other in ((p_A, i), (p_B, 6 + j)):
                    on_it = [
                        x.distance
                        for x in query_object.ComputeSignedDistanceToPoint(
                            point
                        )
                        if x.id_G == scene.geometry_ids[other]
                    ]
                    self.assertAlmostEqual(on_it[0], 0.0, delta=1e-12)
                pair = query_object.ComputeSignedDistancePairClosestPoints(
                    scene.geometry_ids[i], scene.geometry_ids[6 + j]
                )
                # Drake iterates here, to about 1e-4.
                self.assertAlmostEqual(pair.distance, distance, delta=1e-3)

    def test_spheres_among_capsules(self):
        distance, i, j, p_A, p_B = closest(
            [[0.0, 0, 0], [0, 0, 3]],
            [[0.0, 0, 0], [0, 0, 4]],
            [0.5, 0.25],
            [[1.0, -1, 3.5]],
            [[1.0, 1, 3.5]],
            [0.25],
        )
        self.assertEqual((distance, i, j), (0.5, 1, 0))
        np.testing.assert_allclose(p_A, [0.25, 0, 3.5])
        np.testing.assert_allclose(p_B, [0.75, 0, 3.5])

    def test_overlap_is_negative(self):
        distance, _, _, p_A, p_B = closest(
            [[0.0, 0, 0]], [[0.0, 0, 1]], [0.3],
            [[0.1, 0, 0.5]], [[1.0, 0, 0.5]], [0.2],
        )  # fmt: skip
        self.assertAlmostEqual(distance, -0.4)
        np.testing.assert_allclose(p_A, [0.3, 0, 0.5])
        np.testing.assert_allclose(p_B, [-0.1, 0, 0.5])

    def test_axes_that_cross_or_coincide(self):
        zero = [0.0, 0, 0]
        for b_p, b_q in (
            ([-1.0, 0, 0.5], [1.0, 0, 0.5]),
            ([0.0, 0, 0.2], [0.0, 0, 0.8]),
            ([0.0, 0, 0.5], [0.0, 0, 0.5]),
        ):
            distance, _, _, p_A, p_B = closest(
                [zero], [[0.0, 0, 1]], [0.3], [b_p], [b_q], [0.2]
            )
            self.assertAlmostEqual(distance, -0.5)
            self.assertAlmostEqual(np.linalg.norm(p_A - p_B), 0.5)
        _, _, _, p_A, _ = closest([zero], [zero], [0.3], [zero], [zero], [0.2])
        self.assertAlmostEqual(np.linalg.norm(p_A), 0.3)

    def test_nothing_to_compare(self):
        none, one = np.empty((0, 3)), [[0.0, 0, 0]]
        distance, i, j, p_A, p_B = closest(one, one, [0.1], none, none, [])
        self.assertEqual((distance, i, j), (np.inf, -1, -1))
        self.assertTrue(np.isnan(p_A).all() and np.isnan(p_B).all())

    def test_nan_is_not_far(self):
        good = ([[0.0, 0, 0]], [[0.0, 0, 1]], [0.1]) * 2
        for i in range(6):
            for k in range(3):
                bad = [np.array(x) for x in good]
                bad[i].flat[min(k, bad[i].size - 1)] = np.nan
                # Last of several.
                bad = [
                    np.concatenate([x, y])
                    for x, y in zip(good, bad, strict=True)
                ]
                with self.subTest(i=i, k=k):
                    self.assertTrue(np.isnan(closest(*bad)[0]))


class TestPointToCapsules(unittest.TestCase):
    def test_against_drake(self):
        rng = np.random.default_rng(2)
        scene = oracle.Scene(Role.kProximity)
        p, q = rng.uniform(-1, 1, (2, 8, 3))
        r = rng.uniform(0.05, 0.3, 8)
        for a, b, radius in zip(p, q, r, strict=True):
            X = RigidTransform(
                RotationMatrix.MakeFromOneVector(b - a, 2), (a + b) / 2
            )
            scene.add(Capsule(radius, np.linalg.norm(b - a)), X)
        p = np.vstack([p, [[0.5, 0.5, 0.5]]])
        q = np.vstack([q, [[0.5, 0.5, 0.5]]])
        r = np.append(r, 0.2)
        scene.add(Sphere(0.2), RigidTransform([0.5, 0.5, 0.5]))
        points = rng.uniform(-1.5, 1.5, (200, 3))
        dut = mut.point_to_capsules(points, p, q, r)
        query_object = scene.query_object()
        expected = [
            min(
                x.distance
                for x in query_object.ComputeSignedDistanceToPoint(point)
            )
            for point in points
        ]
        self.assertTrue((dut < 0).any() and (dut > 0).any())
        np.testing.assert_allclose(dut, expected, atol=1e-12)

    def test_nothing_and_nan(self):
        none = np.empty((0, 3))
        points = np.array([[0.0, 0, 0], [np.nan, 0, 0]])
        dut = mut.point_to_capsules(points, none, none, np.empty(0))
        np.testing.assert_array_equal(dut, [np.inf, np.inf])
        one = np.array([[0.0, 0, 1]])
        dut = mut.point_to_capsules(points, one, one, np.array([0.25]))
        np.testing.assert_array_equal(dut, [0.75, np.nan])
        two = np.vstack([one, one])
        for i in range(2):
            ends = [two, two.copy()]
            ends[i] = two.copy()
            ends[i][1, 2] = np.nan
            dut = mut.point_to_capsules(points, *ends, np.full(2, 0.25))
            self.assertTrue(np.isnan(dut).all())
