import unittest

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from robots import CHAINS, make_panda, make_urdf

from tofssm_drake.arms.arm import make_arm_plant
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


class TestAnyArm(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.plant = make_arm_plant(make_panda())
        cls.kinematics = ArmKinematics.from_plant(cls.plant)

    def list_points(self):
        generator = np.random.default_rng(0)
        for _ in range(20):
            azimuth, yaw = generator.uniform(-2.5, 2.5, 2)
            radius = generator.uniform(0.35, 0.6)
            z = generator.uniform(0.75, 1.0)
            yield (
                np.array(
                    [radius * np.cos(azimuth), radius * np.sin(azimuth), z]
                ),
                yaw,
            )

    def test_seven_joints(self):
        """Against the description's own plant; limits are kept."""
        context = self.plant.CreateDefaultContext()
        tcp = self.plant.GetFrameByName("tcp")
        for p_WT, yaw in self.list_points():
            q = mut.calc_tool_down_joints(self.kinematics, p_WT, yaw)
            self.assertTrue(np.all(q >= self.kinematics.lower))
            self.assertTrue(np.all(q <= self.kinematics.upper))
            self.plant.SetPositions(context, q)
            X_WT = tcp.CalcPoseInWorld(context).GetAsMatrix34()
            np.testing.assert_allclose(X_WT[:, 3], p_WT, atol=1e-9)
            np.testing.assert_allclose(
                X_WT[:, 0], [np.cos(yaw), np.sin(yaw), 0], atol=1e-9
            )
            np.testing.assert_allclose(X_WT[:, 2], [0, 0, -1], atol=1e-9)

    def test_repeats_exactly(self):
        p_WT, yaw = next(self.list_points())
        np.testing.assert_array_equal(
            mut.calc_tool_down_joints(self.kinematics, p_WT, yaw),
            mut.calc_tool_down_joints(self.kinematics, p_WT, yaw),
        )

    def test_stays_near_the_guess(self):
        """Along a line of points the joints do not jump."""
        q = None
        for x in np.linspace(0.35, 0.55, 11):
            before = q
            q = mut.calc_tool_down_joints(
                self.kinematics, np.array([x, 0.2, 0.9]), 0.0, guess=q
            )
            if before is not None:
                self.assertLess(np.abs(q - before).max(), 0.2)

    def test_out_of_reach(self):
        with self.assertRaisesRegex(UserError, r"point \[2.0, 0.0, 1.0\]: no"):
            mut.calc_tool_down_joints(
                self.kinematics, np.array([2.0, 0.0, 1.0]), 0.0
            )

    def test_chain_plant(self):
        """The plant that is searched is the same arm, sliding joints, too."""
        for joints in CHAINS.values():
            plant = MultibodyPlant(0.0)
            urdf = make_urdf(joints, tool=f"link_{len(joints)}")
            Parser(plant).AddModelsFromString(urdf, "urdf")
            plant.WeldFrames(
                plant.world_frame(),
                plant.GetFrameByName("link_0"),
                RigidTransform(RollPitchYaw([0.1, 0.2, 0.3]), [1, 2, 3]),
            )
            plant.Finalize()
            kinematics = ArmKinematics.from_plant(plant)
            dut = mut.make_chain_plant(kinematics)
            context = dut.CreateDefaultContext()
            q = np.linspace(-1, 1, kinematics.num_joints)
            dut.SetPositions(context, q)
            np.testing.assert_allclose(
                dut.GetFrameByName("tcp")
                .CalcPoseInWorld(context)
                .GetAsMatrix34(),
                kinematics.calc_tcp_pose(q),
                atol=1e-12,
            )
            np.testing.assert_array_equal(
                dut.GetPositionLowerLimits(), kinematics.lower
            )

    def test_other_arms_are_no_ur_arms(self):
        self.assertIsNone(mut.find_ur_lengths(self.kinematics))
