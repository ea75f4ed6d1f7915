import unittest

import numpy as np
from pydrake.geometry import Role
from pydrake.math import RigidTransform
import ray_oracle as oracle

from tofssm_drake.raycast import ray_kernels
import tofssm_drake.raycast.ball_tree as mut
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster


class TestBallTree(unittest.TestCase):
    def setUp(self):
        rng = np.random.default_rng(0)
        self.n = 300
        self.frames = np.repeat([0, 1, 2], [240, 55, 5])
        self.centres = rng.normal(size=(self.n, 3))
        # Many in one place cannot be split by position.
        self.centres[100:130] = self.centres[99]
        self.radii = rng.uniform(0.01, 0.3, self.n)
        self.radii[[3, 297]] = np.inf
        self.table = mut.make_ball_tree(self.frames, self.centres, self.radii)

    def walk(self, row):
        """Returns the shapes within a ball; checks what is in between."""
        ball = self.table[row]
        first = int(ball[ray_kernels.BALL_FIRST])
        count = int(ball[ray_kernels.BALL_COUNT])
        if count == 0:
            return [first]
        shapes = [
            shape
            for child in range(first, first + count)
            for shape in self.walk(child)
        ]
        if row == 0:
            return shapes
        for shape in shapes:
            self.assertEqual(ball[ray_kernels.BALL_FRAME], self.frames[shape])
            gap = np.linalg.norm(ball[:3] - self.centres[shape])
            self.assertLessEqual(
                gap + self.radii[shape],
                ball[ray_kernels.BALL_RADIUS] * (1 + 1e-12),
            )
        return shapes

    def test_each_shape_is_there_once_and_within_its_balls(self):
        self.assertEqual(sorted(self.walk(0)), list(range(self.n)))

    def test_leaves_are_the_shapes_own_balls(self):
        leaves = self.table[1:][self.table[1:, ray_kernels.BALL_COUNT] == 0]
        shape = leaves[:, ray_kernels.BALL_FIRST].astype(int)
        np.testing.assert_array_equal(
            leaves[:, ray_kernels.BALL_RADIUS], self.radii[shape]
        )
        bounded = np.isfinite(self.radii[shape])
        np.testing.assert_array_equal(
            leaves[bounded, :3], self.centres[shape[bounded]]
        )

    def test_few_are_at_the_top(self):
        # A tree for each of two frames, five small ones, the unbounded.
        top = self.table[0, ray_kernels.BALL_COUNT]
        self.assertEqual(top, 2 + 4 + 2)

    def test_nothing(self):
        table = mut.make_ball_tree(
            np.empty(0, int), np.empty((0, 3)), np.empty(0)
        )
        self.assertEqual(table[0, ray_kernels.BALL_COUNT], 0)


class TestCulling(unittest.TestCase):
    """Many shapes: in a tree, or each for itself, all is seen."""

    def setUp(self):
        rng = np.random.default_rng(1)
        kinds = ("sphere", "capsule", "cylinder", "box", "ellipsoid") * 40
        poses = [oracle.make_random_pose(rng, 4.0) for _ in kinds]
        shapes = [oracle.make_random_shape(rng, kind) for kind in kinds]
        self.casters = []
        for moving in (False, True):
            scene = oracle.Scene(Role.kPerception)
            for shape, X in zip(shapes, poses, strict=True):
                if moving:
                    scene.add(shape, frame_id=scene.add_frame(X))
                else:
                    scene.add(shape, X)
            caster = RayCaster(scene.inspector)
            bundles = [
                caster.make_bundles(
                    frame_id=caster.world_frame_id,
                    X_FS=[oracle.make_random_pose(rng_pose, 4.0)],
                    fan_S=make_cone_fan(fov, 40),
                    max_range=max_range,
                )
                for rng_pose in [np.random.default_rng(2)]
                for fov in (0.1, 0.4, 1.5, 3.1)
                for max_range in (0.5, 2.0, np.inf)
                for _ in range(4)
            ]
            X_WF = caster.poses_from_query_object(scene.query_object())
            self.casters.append((scene, caster, bundles, X_WF))

    def test_bundles(self):
        hits = 0
        for scene, caster, bundles, X_WF in self.casters:
            order = scene.shapes_in_order(caster.geometry_ids)
            for bundle in bundles:
                p_WR, n_WR = caster.calc_rays(bundle, X_WF)
                expected, which = oracle.cast(
                    *order,
                    p_WR.reshape(-1, 3),
                    n_WR.reshape(-1, 3),
                    bundle.max_range[0],
                )
                distance, index = caster.cast_bundles(bundle, X_WF)
                np.testing.assert_allclose(
                    distance.ravel(), expected.astype(float), atol=1e-9
                )
                np.testing.assert_array_equal(index.ravel(), which)
                hits += np.isfinite(distance).sum()
        self.assertGreater(hits, 500)

    def test_single_rays(self):
        rng = np.random.default_rng(3)
        p_WR = rng.uniform(-4.0, 4.0, (300, 3))
        n_WR = oracle.make_unit_vectors(rng, 300)
        results = []
        for scene, caster, _, X_WF in self.casters:
            expected, which = oracle.cast(
                *scene.shapes_in_order(caster.geometry_ids), p_WR, n_WR
            )
            distance, index = caster.cast(X_WF, p_WR, n_WR)
            np.testing.assert_allclose(
                distance, expected.astype(float), atol=1e-9
            )
            np.testing.assert_array_equal(index, which)
            results.append(distance)
        np.testing.assert_allclose(*results, atol=1e-12)

    def test_of_equal_distances_the_first_geometry_counts(self):
        """However the tree has sorted them."""
        scene = oracle.Scene(Role.kPerception)
        shape = oracle.make_random_shape(np.random.default_rng(4), "box")
        for i in range(30):
            scene.add(shape, RigidTransform([0.0, 0.0, float(i % 10)]))
        caster = RayCaster(scene.inspector)
        X_WF = caster.poses_from_query_object(scene.query_object())
        for z in range(10):
            _, index = caster.cast(X_WF, [[3.0, 0, z]], [[-1.0, 0, 0]])
            expected, which = oracle.cast(
                *scene.shapes_in_order(caster.geometry_ids),
                [[3.0, 0, z]],
                [[-1.0, 0, 0]],
            )
            self.assertTrue(np.isfinite(expected).all())
            self.assertEqual(index[0], which[0])


if __name__ == "__main__":
    unittest.main()
