import unittest

import numpy as np

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
import tofssm_drake.arms.tool_down as mut
from tofssm_drake.errors import UserError


class TestToolDown(unittest.TestCase):
    def setUp(self):
        self.kinematics = ArmKinematics.from_plant(make_cell_plant())

    def test_round_trip(self):
        """Checks that the tool is where it should be, points down, and that
        the elbow is above the line from shoulder to wrist."""
        generator = np.random.default_rng(1)
        plant = make_cell_plant()
        context = plant.CreateDefaultContext()
        for _ in range(50):
            azimuth, yaw = generator.uniform(-np.pi, np.pi, 2)
            radius = generator.uniform(0.5, 0.95)
            z = generator.uniform(0.72, 1.1)
            p_WT = np.array(
                [radius * np.cos(azimuth), radius * np.sin(azimuth), z]
            )
            q = mut.calc_tool_down_joints(self.kinematics, p_WT, yaw)
            X_WT = self.kinematics.calc_tcp_pose(q)
            np.testing.assert_allclose(X_WT[:, 3], p_WT, atol=1e-9)
            np.testing.assert_allclose(X_WT[:, 2], [0, 0, -1], atol=1e-9)
            np.testing.assert_allclose(
                X_WT[:, 0], [np.cos(yaw), np.sin(yaw), 0], atol=1e-9
            )
            plant.SetPositions(context, q)
            elbow, shoulder, wrist = (
                plant.GetFrameByName(name)
                .CalcPoseInWorld(context)
                .translation()[2]
                for name in ("forearm_link", "upper_arm_link", "wrist_1_link")
            )
            self.assertGreater(elbow, max(shoulder, wrist))

    def test_out_of_reach(self):
        for p_WT in ([1.6, 0, 0.9], [0.05, 0, 0.9]):
            with self.assertRaisesRegex(UserError, "point"):
                mut.calc_tool_down_joints(self.kinematics, p_WT, 0.0)
