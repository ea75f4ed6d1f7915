import unittest

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    Capsule,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    HalfSpace,
    PerceptionProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
import ray_oracle as oracle

from tofssm_drake.raycast.fan import make_cone_fan
import tofssm_drake.raycast.frame_poses as mut
from tofssm_drake.raycast.ray_caster import RayCaster


class TestFramePoses(unittest.TestCase):
    def setUp(self):
        """Five free bodies and four frames of another source, interleaved."""
        self.rng = np.random.default_rng(0)
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(
            builder, 0.01
        )
        inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
        self.bodies = [
            self.plant.AddRigidBody(f"body_{i}", inertia) for i in range(5)
        ]
        self.plant.RegisterVisualGeometry(
            self.plant.world_body(), RigidTransform(), HalfSpace(), "floor",
            [1.0] * 4,
        )  # fmt: skip
        for i in (3, 0, 1):
            self.plant.RegisterVisualGeometry(
                self.bodies[i],
                oracle.make_random_pose(self.rng, 0.1),
                Sphere(0.2),
                "ball",
                [1.0] * 4,
            )
        self.plant.Finalize()
        self.source = self.scene_graph.RegisterSource("other")
        self.frame_ids = []
        for i in range(4):
            frame_id = self.scene_graph.RegisterFrame(
                self.source, GeometryFrame(f"limb_{i}")
            )
            self.frame_ids.append(frame_id)
            if i == 2:
                continue
            instance = GeometryInstance(
                oracle.make_random_pose(self.rng, 0.1), Capsule(0.1, 0.4), "x"
            )
            instance.set_perception_properties(PerceptionProperties())
            self.scene_graph.RegisterGeometry(self.source, frame_id, instance)
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        self.caster = RayCaster(self.scene_graph.model_inspector())

    def frame_of(self, i):
        return self.plant.GetBodyFrameIdOrThrow(self.bodies[i].index())

    def move(self):
        """Returns (query object, body poses, poses of the other frames)."""
        plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        for body in self.bodies:
            self.plant.SetFreeBodyPose(
                plant_context, body, oracle.make_random_pose(self.rng)
            )
        other = [oracle.make_random_pose(self.rng) for _ in self.frame_ids]
        poses = FramePoseVector()
        for frame_id, pose in zip(self.frame_ids, other, strict=True):
            poses.set_value(frame_id, pose)
        scene_context = self.scene_graph.GetMyMutableContextFromRoot(
            self.context
        )
        self.scene_graph.get_source_pose_port(self.source).FixValue(
            scene_context, Value(poses)
        )
        return (
            self.scene_graph.get_query_output_port().Eval(scene_context),
            self.plant.get_body_poses_output_port().Eval(plant_context),
            np.array([X.GetAsMatrix34() for X in other]),
        )

    def test_same_poses_and_distances_as_through_the_query_object(self):
        bundles = self.caster.make_bundles(
            frame_id=[self.frame_of(4), self.frame_of(0), self.frame_ids[2]],
            X_FS=[RigidTransform([0.3, 0, 0])] * 3,
            fan_S=make_cone_fan(3.0, 200),
            max_range=3.0,
        )
        dut = mut.FramePoses(
            caster=self.caster, plant=self.plant, frame_ids=self.frame_ids
        )
        hits = 0
        for _ in range(20):
            query_object, X_WB, X_WF = self.move()
            expected = self.caster.poses_from_query_object(query_object)
            actual = dut.calc(X_WB=X_WB, X_WF=X_WF)
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
            distance, index = self.caster.cast_bundles(bundles, actual)
            want, want_index = self.caster.cast_bundles(bundles, expected)
            np.testing.assert_allclose(distance, want, rtol=0, atol=1e-12)
            np.testing.assert_array_equal(index, want_index)
            hits += np.isfinite(distance).sum()
        self.assertGreater(hits, 1000)

    def test_array_comes_before_the_plant(self):
        dut = mut.FramePoses(
            caster=self.caster,
            plant=self.plant,
            frame_ids=[*self.frame_ids, self.frame_of(3)],
        )
        _, X_WB, X_WF = self.move()
        mine = RigidTransform([1, 2, 3]).GetAsMatrix34()
        actual = dut.calc(X_WB=X_WB, X_WF=np.concatenate([X_WF, [mine]]))
        row = self.caster.frame_ids.index(self.frame_of(3))
        np.testing.assert_array_equal(actual[row], mine)

    def test_only_one_body_or_no_plant(self):
        ids = [*self.frame_ids, self.frame_of(3), self.frame_of(1)]
        _, X_WB, X_WF = self.move()
        two = np.array([np.eye(3, 4)] * 2)
        dut = mut.FramePoses(
            caster=self.caster, plant=self.plant, frame_ids=ids
        )
        actual = dut.calc(X_WB=X_WB, X_WF=np.concatenate([X_WF, two]))
        row = self.caster.frame_ids.index(self.frame_of(0))
        np.testing.assert_allclose(
            actual[row], X_WB[self.bodies[0].index()].GetAsMatrix34()
        )
        ids.append(self.frame_of(0))
        dut = mut.FramePoses(caster=self.caster, frame_ids=ids)
        three = np.array([np.eye(3, 4)] * 3)
        dut.calc(X_WF=np.concatenate([X_WF, three]))

    def test_result_is_not_shared(self):
        dut = mut.FramePoses(
            caster=self.caster, plant=self.plant, frame_ids=self.frame_ids
        )
        _, X_WB, X_WF = self.move()
        first = dut.calc(X_WB=X_WB, X_WF=X_WF)
        kept = first.copy()
        _, X_WB, X_WF = self.move()
        dut.calc(X_WB=X_WB, X_WF=X_WF)
        np.testing.assert_array_equal(first, kept)

    def test_wrong_arguments(self):
        with self.assertRaisesRegex(ValueError, "nothing poses the frame"):
            mut.FramePoses(caster=self.caster, plant=self.plant)
        with self.assertRaisesRegex(ValueError, "nothing poses the frame"):
            mut.FramePoses(caster=self.caster, frame_ids=self.frame_ids)
        with self.assertRaisesRegex(ValueError, "twice"):
            mut.FramePoses(
                caster=self.caster,
                plant=self.plant,
                frame_ids=[*self.frame_ids, self.frame_ids[0]],
            )
        dut = mut.FramePoses(
            caster=self.caster, plant=self.plant, frame_ids=self.frame_ids
        )
        _, X_WB, X_WF = self.move()
        with self.assertRaisesRegex(ValueError, "X_WF: shape"):
            dut.calc(X_WB=X_WB, X_WF=X_WF[:-1])
        with self.assertRaisesRegex(ValueError, "X_WF: shape"):
            dut.calc(X_WB=X_WB)
        with self.assertRaises(IndexError):
            dut.calc(X_WF=X_WF)
