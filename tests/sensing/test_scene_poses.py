import unittest

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from tofssm_drake.geometry.ray_caster import RayCaster
from tofssm_drake.human.avatar import HumanAvatar
from tofssm_drake.human.walk import GeneratedWalk, make_walk
from tofssm_drake.robot.kinematics import RingKinematics
from tofssm_drake.robot.meshes import replace_robot_shapes
from tofssm_drake.robot.products import ProductLayout
from tofssm_drake.robot.program import ProgramConfig
from tofssm_drake.robot.twin import calc_twin_positions, make_twin_plant
import tofssm_drake.sensing.scene_poses as mut


class TestScenePoses(unittest.TestCase):
    def check(self, *, person, meshes=False):
        """Checks that poses and rays are those of the SceneGraph."""
        builder = DiagramBuilder()
        scene_graph = builder.AddSystem(SceneGraph())
        plant = make_twin_plant(scene_graph=scene_graph)
        if meshes:
            replace_robot_shapes(plant, scene_graph, illustration=False)
        avatar = None
        if person:
            avatar = builder.AddSystem(
                HumanAvatar(
                    scene_graph=scene_graph,
                    motion=make_walk(GeneratedWalk(), 0.008),
                )
            )
            builder.Connect(
                avatar.GetOutputPort("geometry_pose"),
                scene_graph.get_source_pose_port(avatar.source_id),
            )
        to_pose = builder.AddSystem(MultibodyPositionToGeometryPose(plant))
        builder.Connect(
            to_pose.get_output_port(),
            scene_graph.get_source_pose_port(plant.get_source_id()),
        )
        caster = RayCaster(scene_graph.model_inspector())
        layout = ProductLayout.from_config(ProgramConfig())
        dut = builder.AddSystem(
            mut.ScenePoses(
                caster=caster,
                plant=plant,
                layout=layout,
                human_frame_ids=avatar.frame_ids if person else [],
            )
        )
        if person:
            builder.Connect(
                avatar.GetOutputPort("skeleton"), dut.GetInputPort("skeleton")
            )
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        dut_context = dut.GetMyMutableContextFromRoot(context)
        if not person:
            dut.GetInputPort("skeleton").FixValue(dut_context, [])
        kinematics = RingKinematics.from_plant(plant)
        generator = np.random.default_rng(0)
        origins = np.repeat(generator.uniform(-1.0, 1.0, (200, 3)), 25, axis=0)
        directions = generator.normal(size=origins.shape)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        num_hits = 0
        for closed, placed in ((0.0, 0), (1.0, 0), (1.0, 9), (0.0, 10)):
            q = generator.uniform(-3.0, 3.0, 6)
            context.SetTime(generator.uniform(0.0, 30.0))
            to_pose.get_input_port().FixValue(
                to_pose.GetMyMutableContextFromRoot(context),
                calc_twin_positions(
                    layout=layout,
                    kinematics=kinematics,
                    q=q,
                    gripper_closed=closed,
                    products_placed=placed,
                ),
            )
            for name, value in (
                ("position_measured", q),
                ("gripper_closed", [closed]),
                ("products_placed", [placed]),
            ):
                dut.GetInputPort(name).FixValue(dut_context, value)
            X_WF = dut.GetOutputPort("frame_poses").Eval(dut_context)
            expected = caster.poses_from_query_object(
                scene_graph.get_query_output_port().Eval(
                    scene_graph.GetMyContextFromRoot(context)
                )
            )
            np.testing.assert_allclose(X_WF, expected, rtol=0, atol=1e-12)
            distance, index = caster.cast(X_WF, origins, directions)
            want, want_index = caster.cast(expected, origins, directions)
            np.testing.assert_allclose(distance, want, rtol=0, atol=1e-12)
            np.testing.assert_array_equal(index, want_index)
            num_hits += np.isfinite(distance).sum()
        self.assertGreater(num_hits, 2000)

    def test_with_a_person(self):
        self.check(person=True)

    def test_with_nobody(self):
        self.check(person=False)

    def test_with_the_real_surfaces_of_the_robot(self):
        self.check(person=True, meshes=True)


if __name__ == "__main__":
    unittest.main()
