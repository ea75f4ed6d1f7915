import unittest

import numpy as np
from paper_cell import RINGS, find_kinematics, make_plant

from tofssm_drake.arms.cell_plant import make_cell_plant
import tofssm_drake.arms.kinematics as mut
from tofssm_drake.errors import UserError


class TestRingKinematics(unittest.TestCase):
    def setUp(self):
        self.plant = make_plant()
        self.dut = find_kinematics(self.plant)

    def test_against_plant(self):
        plant = self.plant
        context = plant.CreateDefaultContext()
        generator = np.random.default_rng(0)
        frames = [plant.GetFrameByName(f"{name}_ring") for name in RINGS]
        tcp = plant.GetFrameByName("tcp")
        for _ in range(30):
            q = generator.uniform(-2 * np.pi, 2 * np.pi, 6)
            qd = generator.uniform(-3, 3, 6)
            plant.SetPositions(context, q)
            plant.SetVelocities(context, qd)
            p_WL, R_WL, v_WL = self.dut.calc(q, qd)
            for i, frame in enumerate(frames):
                X_WL = frame.CalcPoseInWorld(context)
                np.testing.assert_allclose(
                    p_WL[i], X_WL.translation(), atol=1e-9
                )
                np.testing.assert_allclose(
                    R_WL[i], X_WL.rotation().matrix(), atol=1e-9
                )
                V_WL = frame.CalcSpatialVelocityInWorld(context)
                np.testing.assert_allclose(
                    v_WL[i], V_WL.translational(), atol=1e-9
                )
            np.testing.assert_allclose(
                self.dut.calc_tcp_pose(q),
                tcp.CalcPoseInWorld(context).GetAsMatrix34(),
                atol=1e-9,
            )
            V_WT = tcp.CalcSpatialVelocityInWorld(context)
            self.assertAlmostEqual(
                np.linalg.norm(self.dut.calc_sites(q, qd)[1][-1]),
                np.linalg.norm(V_WT.translational()),
                delta=1e-9,
            )

    def test_link_index(self):
        np.testing.assert_array_equal(self.dut.site_link, [2, 3, 6, 6])

    def test_without_rings(self):
        dut = mut.RingKinematics.from_plant(make_cell_plant())
        self.assertEqual(dut.calc(np.zeros(6), np.zeros(6))[0].shape, (0, 3))

    def test_what_is_missing_is_named(self):
        plant = make_cell_plant()
        with self.assertRaisesRegex(UserError, "base_ring"):
            find_kinematics(plant)
        with self.assertRaisesRegex(UserError, "knee_joint"):
            mut.RingKinematics.from_plant(plant, joints=("knee_joint",))


class TestToolDown(unittest.TestCase):
    def setUp(self):
        self.kinematics = mut.RingKinematics.from_plant(make_plant())

    def test_round_trip(self):
        """Checks that the tool is where it should be, points down, and that
        the elbow is above the line from shoulder to wrist."""
        generator = np.random.default_rng(1)
        plant = make_plant()
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
