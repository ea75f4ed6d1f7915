import unittest

import numpy as np
from pydrake.geometry import Capsule, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder
import trimesh

import tofssm_drake.arms.capsule_fit as fit
import tofssm_drake.arms.capsules as mut


def make_elbow():
    """Returns two tubes at a right angle."""
    one = trimesh.creation.cylinder(0.05, 0.6, sections=24)
    other = trimesh.creation.cylinder(0.05, 0.6, sections=24)
    other.apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    )
    one.apply_translation([0, 0, 0.3])
    other.apply_translation([0.3, 0, 0])
    return trimesh.util.concatenate([one, other])


class TestFittedCapsule(unittest.TestCase):
    def test_distance_against_drake(self):
        dut = mut.FittedCapsule(
            p=np.array([0.1, 0.2, 0.3]),
            q=np.array([0.4, -0.2, 0.9]),
            radius=0.1,
        )
        builder = DiagramBuilder()
        scene_graph = builder.AddSystem(SceneGraph())
        axis = dut.q - dut.p
        X_WG = RigidTransform(
            RotationMatrix.MakeFromOneVector(axis, 2), 0.5 * (dut.p + dut.q)
        )
        self.register(scene_graph, X_WG, Capsule(0.1, np.linalg.norm(axis)))
        context = scene_graph.CreateDefaultContext()
        query = scene_graph.get_query_output_port().Eval(context)
        points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
        for point, distance in zip(
            points, dut.calc_distance(points), strict=True
        ):
            (found,) = query.ComputeSignedDistanceToPoint(point)
            self.assertAlmostEqual(found.distance, distance, delta=1e-9)

    def register(self, scene_graph, X_WG, shape):
        from pydrake.geometry import GeometryInstance, ProximityProperties

        geometry = GeometryInstance(X_WG, shape, "capsule")
        geometry.set_proximity_properties(ProximityProperties())
        scene_graph.RegisterAnchoredGeometry(
            scene_graph.RegisterSource("test"), geometry
        )

    def test_volume(self):
        dut = mut.FittedCapsule(
            p=np.zeros(3), q=np.array([0, 0, 2.0]), radius=1
        )
        self.assertAlmostEqual(dut.volume, np.pi * (2 + 4 / 3))


class TestFit(unittest.TestCase):
    def test_a_capsule_is_found_again(self):
        mesh = trimesh.convex.convex_hull(
            np.vstack(
                [
                    0.1 * trimesh.creation.icosphere(3).vertices + offset
                    for offset in ([0.3, 0.2, 0.1], [0.8, -0.2, 0.5])
                ]
            )
        )
        (found,) = fit.fit_capsules(mesh)
        self.assertAlmostEqual(found.radius, 0.1, delta=2e-3)
        ends = sorted([found.p.tolist(), found.q.tolist()])
        np.testing.assert_allclose(
            ends, [[0.3, 0.2, 0.1], [0.8, -0.2, 0.5]], atol=0.01
        )

    def test_cover(self):
        """Nothing of the surface is outside, whatever the shape."""
        for mesh in (
            make_elbow(),
            trimesh.creation.box([0.2, 0.3, 0.9]),
            trimesh.creation.annulus(0.2, 0.3, 0.1),
            trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
        ):
            capsules = fit.fit_capsules(mesh)
            found = fit.calc_coverage(mesh, capsules)
            self.assertEqual(found.share_inside, 1.0)
            self.assertLess(found.farthest_outside, 1e-9)
            surface, _ = trimesh.sample.sample_surface(mesh, 3000, seed=1)
            outside = np.min(
                [c.calc_distance(surface) for c in capsules], axis=0
            )
            self.assertLess(outside.max(), 1e-9)

    def test_bent_shapes_get_more_than_one(self):
        mesh = make_elbow()
        (one,) = fit.fit_capsules(mesh, most=1)
        several = fit.fit_capsules(mesh)
        self.assertGreaterEqual(len(several), 2)
        self.assertLessEqual(len(several), 4)
        self.assertLess(sum(c.volume for c in several), 0.3 * one.volume)

    def test_coverage_tells_what_is_left_out(self):
        mesh = trimesh.creation.box([0.2, 0.2, 2.0])
        short = mut.FittedCapsule(
            p=np.array([0, 0, -1.0]), q=np.array([0, 0, 0.0]), radius=0.2
        )
        found = fit.calc_coverage(mesh, [short])
        self.assertAlmostEqual(found.share_inside, 0.5)
        # The corner at (0.1, 0.1, 1) is sqrt(1.02) m from the axis' end.
        self.assertAlmostEqual(found.farthest_outside, np.sqrt(1.02) - 0.2)
        # Below the box, the capsule ends 0.2 m under its lower side.
        self.assertAlmostEqual(found.farthest_excess, 0.2, delta=0.02)
