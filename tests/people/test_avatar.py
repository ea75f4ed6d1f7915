import unittest

import numpy as np
from pydrake.geometry import Capsule, Role, SceneGraph
from pydrake.systems.framework import DiagramBuilder
import yaml

import tofssm_drake.people.avatar as mut
from tofssm_drake.people.motion import capsule_ends
from tofssm_drake.people.skeleton import CAPSULES
from tofssm_drake.people.walk import GeneratedWalk, make_walk

_MOTION = make_walk(GeneratedWalk(), 0.008)


class HumanAvatarTest(unittest.TestCase):
    def setUp(self):
        builder = DiagramBuilder()
        self.scene_graph = builder.AddSystem(SceneGraph())
        self.dut = builder.AddSystem(
            mut.HumanAvatar(scene_graph=self.scene_graph, motion=_MOTION)
        )
        builder.Connect(
            self.dut.GetOutputPort("geometry_pose"),
            self.scene_graph.get_source_pose_port(self.dut.source_id),
        )
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        self.inspector = self.scene_graph.model_inspector()

    def _eval(self, port, t):
        self.context.SetTime(t)
        return self.dut.GetOutputPort(port).Eval(
            self.dut.GetMyContextFromRoot(self.context)
        )

    def test_registration(self):
        count = len(CAPSULES)
        self.assertEqual(len(self.dut.frame_ids), count)
        self.assertEqual(len(self.dut.geometry_ids), count)
        self.assertEqual(self.dut.radii.shape, (count,))
        for i, geometry_id in enumerate(self.dut.geometry_ids):
            roles = [
                self.inspector.GetProperties(geometry_id, role) is not None
                for role in (
                    Role.kPerception,
                    Role.kIllustration,
                    Role.kProximity,
                )
            ]
            self.assertEqual(roles, [True, True, False])
            shape = self.inspector.GetShape(geometry_id)
            self.assertIsInstance(shape, Capsule)
            self.assertEqual(shape.radius(), _MOTION.radii[i])
            self.assertEqual(shape.length(), _MOTION.lengths[i])
            self.assertEqual(
                self.inspector.GetFrameId(geometry_id), self.dut.frame_ids[i]
            )
            self.assertIn(CAPSULES[i].name, self.inspector.GetName(geometry_id))

    def test_skeleton(self):
        for t in (0.0, 1.2345, 50.0):
            ends = self._eval("skeleton", t).reshape(-1, 2, 3)
            np.testing.assert_array_equal(ends, capsule_ends(_MOTION, t))

    def test_geometry_is_where_the_skeleton_is(self):
        """Through the SceneGraph, as the rays see it."""
        for t in (0.0, 2.5):
            ends = self._eval("skeleton", t).reshape(-1, 2, 3)
            query_object = self.scene_graph.get_query_output_port().Eval(
                self.scene_graph.GetMyContextFromRoot(self.context)
            )
            for i, geometry_id in enumerate(self.dut.geometry_ids):
                X_WG = query_object.GetPoseInWorld(geometry_id)
                half = 0.5 * _MOTION.lengths[i]
                for end, sign in ((0, -1), (1, 1)):
                    np.testing.assert_allclose(
                        X_WG.multiply([0, 0, sign * half]),
                        ends[i, end],
                        atol=1e-9,
                    )

    def test_outputs_depend_on_time_alone(self):
        self.assertFalse(self.dut.HasAnyDirectFeedthrough())
        self.assertEqual(self.dut.num_input_ports(), 0)
        first = np.array(self._eval("skeleton", 0.4))
        self._eval("skeleton", 3.0)
        np.testing.assert_array_equal(self._eval("skeleton", 0.4), first)

    def test_two_people(self):
        mut.HumanAvatar(
            scene_graph=self.scene_graph, motion=_MOTION, name="visitor"
        )

    def test_docstring(self):
        block = mut.HumanAvatar.__doc__.split(".. pydrake_system::")[1]
        lines = block.split("\n\n")[1]
        info = yaml.safe_load(lines)
        self.assertEqual(info["name"], "HumanAvatar")
        self.assertEqual(
            info["output_ports"],
            [
                self.dut.get_output_port(i).get_name()
                for i in range(self.dut.num_output_ports())
            ],
        )


if __name__ == "__main__":
    unittest.main()
