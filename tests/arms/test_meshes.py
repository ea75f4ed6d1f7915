import unittest

import numpy as np
from paper_cell import make_plant
from pydrake.geometry import Capsule, Mesh, Role, SceneGraph, Sphere

from tofssm_drake.arms.cell_plant import make_cell_plant
import tofssm_drake.arms.meshes as mut


def calc_distance(shape, X_LG, points):
    """Returns signed distances of points (n, 3) to a capsule or sphere."""
    half = shape.length() / 2 if isinstance(shape, Capsule) else 0.0
    axis = X_LG.rotation().matrix()[:, 2]
    offset = points - X_LG.translation()
    along = np.clip(offset @ axis, -half, half)
    return (
        np.linalg.norm(offset - along[:, None] * axis, axis=1) - shape.radius()
    )


class TestMeshes(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.scene_graph = SceneGraph()
        cls.plant = make_cell_plant(scene_graph=cls.scene_graph, workcell="")
        cls.meshes = mut.read_collision_meshes(cls.plant)

    def test_capsules_cover_the_meshes(self):
        """Checks that the primitives leave no part of the real robot out by
        more than 25 mm, and themselves stand out by less than 40 mm."""
        inspector = self.scene_graph.model_inspector()
        generator = np.random.default_rng(0)
        direction = generator.normal(size=(500, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        for link, mesh in self.meshes.items():
            body = self.plant.GetBodyByName(link)
            vertices = np.asarray(mesh.vertices)
            uncovered = np.full(len(vertices), np.inf)
            surface = mesh.sample(5000, seed=0)
            for geometry_id in self.plant.GetCollisionGeometriesForBody(body):
                shape = inspector.GetShape(geometry_id)
                self.assertIsInstance(shape, Capsule | Sphere)
                X_LG = inspector.GetPoseInFrame(geometry_id)
                distance = calc_distance(shape, X_LG, vertices)
                uncovered = np.minimum(uncovered, distance)
                points = direction * shape.radius()
                if isinstance(shape, Capsule):
                    points[:, 2] += np.copysign(
                        shape.length() / 2, direction[:, 2]
                    )
                points = X_LG.multiply(points.T).T
                gap = np.linalg.norm(
                    points[:, None] - surface[None, ::5], axis=2
                ).min(axis=1)
                lower, upper = mesh.bounds
                outside = np.any((points < lower) | (points > upper), axis=1)
                if link == "base":
                    # Above and below are the shoulder and the pedestal.
                    outside &= np.abs(points[:, 2] - 0.019) < 0.019
                self.assertLess(gap[outside].max(initial=0.0), 0.045, link)
            self.assertLess(uncovered.max(), 0.025, link)

    def test_tubes_carry_the_rings(self):
        """Checks that the rings are centred on the real tubes."""
        plant = make_plant(workcell="")
        context = plant.CreateDefaultContext()
        for ring, link in (
            ("base", "upper_arm_link"),
            ("elbow", "forearm_link"),
        ):
            p_AL = (
                plant.GetFrameByName(f"{ring}_ring")
                .CalcPose(context, plant.GetFrameByName(link))
                .translation()
            )
            section = self.meshes[link].section(
                plane_origin=p_AL, plane_normal=[1, 0, 0]
            )
            middle = section.bounds.mean(axis=0)
            np.testing.assert_allclose(middle, p_AL, atol=5e-4)

    def test_replace(self):
        scene_graph = SceneGraph()
        plant = make_plant(scene_graph=scene_graph)
        inspector = scene_graph.model_inspector()
        before = len(inspector.GetAllGeometryIds(Role.kProximity))
        mut.replace_robot_shapes(plant, scene_graph)
        names = {
            inspector.GetName(geometry_id)
            for geometry_id in inspector.GetAllGeometryIds(Role.kIllustration)
        }
        self.assertIn("elbow_ring_band", names)
        self.assertEqual(
            len(inspector.GetAllGeometryIds(Role.kProximity)), before
        )
        for link in mut._LINKS:
            body = plant.GetBodyByName(link)
            frame_id = plant.GetBodyFrameIdOrThrow(body.index())
            for role, extension in (
                (Role.kPerception, ".obj"),
                (Role.kIllustration, ".gltf"),
            ):
                (geometry_id,) = (
                    geometry_id
                    for geometry_id in inspector.GetGeometries(frame_id, role)
                    if "_ring_" not in inspector.GetName(geometry_id)
                )
                shape = inspector.GetShape(geometry_id)
                self.assertIsInstance(shape, Mesh)
                self.assertEqual(shape.extension(), extension)
                # What Drake reads has the mesh's own bounds: not turned.
                hull = shape.GetConvexHull()
                vertices = np.array(
                    [hull.vertex(i) for i in range(hull.num_vertices())]
                )
                np.testing.assert_allclose(
                    [vertices.min(axis=0), vertices.max(axis=0)],
                    self.meshes[link].bounds,
                    atol=0.005 if role == Role.kPerception else 0.03,
                    err_msg=f"{link} {role}",
                )

    def test_only_what_is_asked_for(self):
        scene_graph = SceneGraph()
        plant = make_cell_plant(scene_graph=scene_graph, workcell="")
        inspector = scene_graph.model_inspector()
        before = inspector.GetAllGeometryIds(Role.kPerception)
        mut.replace_robot_shapes(plant, scene_graph, perception=False)
        self.assertEqual(inspector.GetAllGeometryIds(Role.kPerception), before)
