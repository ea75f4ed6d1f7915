import unittest

import numpy as np
from paper_cell import make_plant, make_twin_plant
from pydrake.geometry import Role, SceneGraph
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

import tofssm_drake.arms.cell_plant as mut
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.errors import UserError
from tofssm_drake.poses import Pose
from tofssm_drake.sensors.ring import Ring
from tofssm_drake.tasks.program import PickAndPlace, make_program_path


class TestCellPlant(unittest.TestCase):
    def test_positions(self):
        plant = make_twin_plant(SceneGraph())
        self.assertEqual(plant.num_positions(), 6 + 70)
        names = plant.GetPositionNames()
        self.assertTrue(names[0].startswith("ur10_shoulder_pan"))
        for i in range(10):
            self.assertTrue(names[6 + 7 * i].startswith(f"product_{i}_"))

    def test_body_order_does_not_depend_on_products(self):
        """Body poses of the plant that moves and of the one that is seen may
        be mixed up: their bodies must agree."""
        plain = make_plant()
        seen = make_twin_plant(SceneGraph())
        for instance in range(plain.num_model_instances()):
            index = ModelInstanceIndex(instance)
            for body in plain.GetBodyIndices(index):
                self.assertEqual(
                    plain.get_body(body).scoped_name().get_full(),
                    seen.get_body(body).scoped_name().get_full(),
                )

    def test_without_cell(self):
        plant = mut.make_cell_plant(workcell="")
        context = plant.CreateDefaultContext()
        X_WB = plant.GetFrameByName("base").CalcPoseInWorld(context)
        np.testing.assert_allclose(X_WB.translation(), [0, 0, 0.72])
        self.assertFalse(plant.HasBodyNamed("box"))

    def test_ring_looks(self):
        """Checks that rings are there to look at and are not seen."""
        scene_graph = SceneGraph()
        make_plant(scene_graph=scene_graph)
        inspector = scene_graph.model_inspector()
        for role, count in (
            (Role.kIllustration, 3 + 24),
            (Role.kPerception, 0),
            (Role.kProximity, 0),
        ):
            names = [
                inspector.GetName(geometry_id)
                for geometry_id in inspector.GetAllGeometryIds(role)
            ]
            self.assertEqual(sum("_ring_" in name for name in names), count)

    def test_looks_of_sensors_at_poses_of_their_own(self):
        """They have windows, and no band to sit on."""
        ring = Ring(parent="ur10::tool0", poses=[Pose(), Pose()])
        scene_graph = SceneGraph()
        mut.make_cell_plant(sensors={"a": ring}, scene_graph=scene_graph)
        inspector = scene_graph.model_inspector()
        names = [
            inspector.GetName(geometry_id)
            for geometry_id in inspector.GetAllGeometryIds(Role.kIllustration)
        ]
        self.assertEqual(
            [name for name in names if "_ring_" in name],
            ["a_ring_window_0", "a_ring_window_1"],
        )

    def test_ring_without_a_frame_to_carry_it(self):
        ring = Ring(parent="ur10::upper_arm")
        with self.assertRaisesRegex(
            UserError, r"sensors.a.parent: .* no frame 'ur10::upper_arm'"
        ):
            mut.make_cell_plant(sensors={"a": ring})


class TestPathIsClear(unittest.TestCase):
    def test_robot_touches_nothing(self):
        """Checks the whole nominal motion for collisions of the robot and
        its gripper with the cell and with itself."""
        builder = DiagramBuilder()
        scene_graph = builder.AddSystem(SceneGraph())
        plant = make_plant(scene_graph=scene_graph)
        poses = builder.AddSystem(MultibodyPositionToGeometryPose(plant))
        builder.Connect(
            poses.get_output_port(),
            scene_graph.get_source_pose_port(plant.get_source_id()),
        )
        builder.ExportInput(poses.get_input_port(), "positions")
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        inspector = scene_graph.model_inspector()
        path = make_program_path(
            PickAndPlace(), ArmKinematics.from_plant(plant)
        )
        nearest = np.inf
        for s in np.arange(0, path.duration, 0.05):
            diagram.GetInputPort("positions").FixValue(
                context, path.calc_motion(s)[0]
            )
            query = scene_graph.get_query_output_port().Eval(
                scene_graph.GetMyContextFromRoot(context)
            )
            for pair in query.ComputeSignedDistancePairwiseClosestPoints(0.05):
                nearest = min(nearest, pair.distance)
                self.assertGreater(
                    pair.distance,
                    0.003,
                    (
                        inspector.GetName(pair.id_A),
                        inspector.GetName(pair.id_B),
                        s,
                    ),
                )
        self.assertLess(nearest, 0.05)
