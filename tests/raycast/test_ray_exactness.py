"""A million rays against every shape, compared with others' answers."""

import collections
import unittest

import numpy as np
from pydrake.geometry import Ellipsoid, Role
from pydrake.math import RigidTransform, RotationMatrix
import ray_oracle as oracle

from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster

SCENES = 40
SHAPES_PER_SCENE = 2
BUNDLES = 100
RAYS = 125


def make_scene(number, rng, role=Role.kPerception):
    """Shapes of different kinds, each of all kinds as often as the others."""
    kinds = [
        oracle.ALL_KINDS[(number + 3 * i) % len(oracle.ALL_KINDS)]
        for i in range(SHAPES_PER_SCENE)
    ]
    return kinds, oracle.make_random_scene(rng, kinds, role)


def make_rays(rng, count, X_WG):
    """Rays from anywhere to somewhere near a shape."""
    p_WR = rng.uniform(-1.5, 1.5, (count, 3))
    centres = np.array([X.translation() for X in X_WG])
    p_WT = centres[rng.integers(len(centres), size=count)]
    n_WR = p_WT + rng.uniform(-0.4, 0.4, (count, 3)) - p_WR
    return p_WR, n_WR / np.linalg.norm(n_WR, axis=1, keepdims=True)


def make_bundles(rng, scene, caster, X_WG):
    """Bundles on a moving frame that look to somewhere near a shape."""
    X_FW = scene.poses[scene.frame_ids[0]].inverse()
    return caster.make_bundles(
        frame_id=scene.frame_ids[0],
        X_FS=[
            X_FW @ RigidTransform(RotationMatrix.MakeFromOneVector(n, 0), p)
            for p, n in zip(*make_rays(rng, BUNDLES, X_WG), strict=True)
        ],
        fan_S=make_cone_fan(np.deg2rad(40), RAYS),
        max_range=2.0,
    )


class TestAgainstTheClosedForm(unittest.TestCase):
    def test_a_million_rays(self):
        """Half of them single rays, half of them in bundles, to 1e-12."""
        rng = np.random.default_rng(0)
        rays = hits = starts_inside = 0
        hits_of_kind = dict.fromkeys(oracle.ALL_KINDS, 0)
        for number in range(SCENES):
            kinds, scene = make_scene(number, rng)
            dut = RayCaster(scene.inspector)
            shapes, X_WG = scene.shapes_in_order(dut.geometry_ids)
            bundles = make_bundles(rng, scene, dut, X_WG)
            X_WF = dut.poses_from_query_object(scene.query_object())
            p_WR, n_WR = make_rays(rng, BUNDLES * RAYS, X_WG)
            for p, n, (distance, index) in (
                (p_WR, n_WR, dut.cast(X_WF, p_WR, n_WR, 2.0)),
                (
                    *dut.calc_rays(bundles, X_WF),
                    dut.cast_bundles(bundles, X_WF),
                ),
            ):
                p, n = p.reshape(-1, 3), n.reshape(-1, 3)
                distance, index = distance.ravel(), index.ravel()
                want = oracle.cast(shapes, X_WG, p, n, 2.0)
                oracle.assert_same_hits(scene, dut, p, n, distance, index, want)
                rays += len(distance)
                hits += np.isfinite(distance).sum()
                starts_inside += (distance == 0).sum()
                for i, geometry_id in enumerate(dut.geometry_ids):
                    kind = kinds[scene.geometry_ids.index(geometry_id)]
                    hits_of_kind[kind] += ((index == i) & (distance > 0)).sum()
        self.assertGreaterEqual(rays, 1_000_000)
        self.assertGreater(hits, 0.2 * rays)
        self.assertLess(hits, 0.8 * rays)
        self.assertGreater(starts_inside, 5_000)
        self.assertGreater(min(hits_of_kind.values()), 10_000)


class TestAgainstDrake(unittest.TestCase):
    def check(self, scene, rng, rays, tolerance):
        """Checks that hits are on the surface, and none was missed before.

        Args:
            tolerance: Of Drake's distances, by kind of shape.

        Returns:
            Drake's distances from the hits, m, by kind of shape.
        """
        dut = RayCaster(scene.inspector, role=Role.kProximity)
        query_object = scene.query_object()
        p_WR, n_WR = make_rays(rng, rays, scene.X_WG())
        distance, index = dut.cast(query_object, p_WR, n_WR)
        hit = np.isfinite(distance) & (distance > 0)
        errors = {}
        for p_WQ, hit_id in zip(
            p_WR[hit] + distance[hit, None] * n_WR[hit],
            dut.get_geometry_ids(index[hit]),
            strict=True,
        ):
            for near in query_object.ComputeSignedDistanceToPoint(p_WQ, 1e-3):
                kind = type(scene.inspector.GetShape(near.id_G))
                limit = tolerance.get(kind, 1e-9)
                self.assertGreaterEqual(near.distance, -limit)
                if near.id_G == hit_id:
                    self.assertLessEqual(near.distance, limit)
                    errors.setdefault(kind, []).append(abs(near.distance))
        self.assertEqual(sum(map(len, errors.values())), hit.sum())
        return errors

    def test_hits_lie_on_the_surface_that_drake_knows(self):
        """To 1e-9, but for small ellipsoids, where Drake itself iterates.

        Points that are on one by construction have distances of up to 3e-4
        in Drake, though few of them more than 5e-5.
        """
        rng = np.random.default_rng(1)
        hits = collections.Counter()
        ellipsoid_errors = []
        for number in range(SCENES):
            _, scene = make_scene(number, rng, Role.kProximity)
            errors = self.check(scene, rng, 3000, {Ellipsoid: 3e-4})
            ellipsoid_errors += errors.get(Ellipsoid, [])
            hits.update({kind: len(found) for kind, found in errors.items()})
        self.assertEqual(len(hits), len(oracle.ALL_KINDS))
        self.assertGreater(min(hits.values()), 1000)
        self.assertGreater(np.mean(np.array(ellipsoid_errors) < 5e-5), 0.98)

    def test_hits_lie_on_large_ellipsoids(self):
        """Where Drake is good to 5e-5 at every point."""
        rng = np.random.default_rng(2)
        for _ in range(10):
            scene = oracle.Scene(Role.kProximity)
            # Small compared with where the rays come from.
            scene.add(
                Ellipsoid(*rng.uniform(1.0, 2.0, 3)),
                RigidTransform(
                    oracle.make_random_pose(rng).rotation(), [3.0, 0.0, 0.0]
                ),
            )
            errors = self.check(scene, rng, 500, {Ellipsoid: 5e-5})
            self.assertGreater(len(errors[Ellipsoid]), 200)


if __name__ == "__main__":
    unittest.main()
