import unittest

import numpy as np
from paper_cell import RINGS, find_kinematics, make_plant
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, FixedOffsetFrame
from robots import CHAINS, make_urdf

from tofssm_drake.arms.cell_plant import make_cell_plant
import tofssm_drake.arms.kinematics as mut
from tofssm_drake.errors import UserError


class TestArmKinematics(unittest.TestCase):
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
        dut = mut.ArmKinematics.from_plant(make_cell_plant())
        self.assertEqual(dut.calc(np.zeros(6), np.zeros(6))[0].shape, (0, 3))

    def test_what_is_missing_is_named(self):
        plant = make_cell_plant()
        with self.assertRaisesRegex(UserError, "base_ring"):
            find_kinematics(plant)
        with self.assertRaisesRegex(UserError, "no frame named flange"):
            mut.ArmKinematics.from_plant(plant, tcp="flange")
        with self.assertRaisesRegex(UserError, "no joint moves frame box"):
            mut.ArmKinematics.from_plant(plant, tcp="box")


class TestAnyChain(unittest.TestCase):
    def make(self, text, kind="urdf"):
        plant = MultibodyPlant(0.0)
        Parser(plant).AddModelsFromString(text, kind)
        if kind == "urdf":
            plant.WeldFrames(
                plant.world_frame(),
                plant.GetFrameByName("link_0"),
                RigidTransform(RollPitchYaw([0.3, -0.4, 0.5]), [1, 2, 3]),
            )
        frames = []
        for i, body in enumerate(self.list_bodies(plant)):
            frame = FixedOffsetFrame(
                f"site_{i}_ring",
                body.body_frame(),
                RigidTransform(RollPitchYaw([i, 2, 3]), [0.1, -0.2, 0.1 * i]),
            )
            plant.AddFrame(frame)
            frames.append(frame.name().removesuffix("_ring"))
        plant.Finalize()
        return plant, tuple(frames)

    def list_bodies(self, plant):
        return [
            plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())
        ]

    def compare(self, plant, rings):
        """Compares poses and velocities of all sites with the plant's."""
        dut = mut.ArmKinematics.from_plant(
            plant, links={ring: f"{ring}_ring" for ring in rings}
        )
        n = plant.num_positions()
        self.assertEqual(dut.num_joints, n)
        self.assertEqual(dut.X_WB.shape, (3, 4))
        context = plant.CreateDefaultContext()
        generator = np.random.default_rng(0)
        names = [*(f"{ring}_ring" for ring in rings), "tcp"]
        for _ in range(10):
            q, qd = generator.uniform(-2, 2, (2, n))
            plant.SetPositions(context, q)
            plant.SetVelocities(context, qd)
            X_WS, v_WS = dut.calc_sites(q, qd)
            for i, name in enumerate(names):
                frame = plant.GetFrameByName(name)
                np.testing.assert_allclose(
                    X_WS[i],
                    frame.CalcPoseInWorld(context).GetAsMatrix34(),
                    atol=1e-9,
                )
                V_WS = frame.CalcSpatialVelocityInWorld(context)
                np.testing.assert_allclose(
                    v_WS[i], V_WS.translational(), atol=1e-9
                )
        return dut

    def test_urdf(self):
        for name, joints in CHAINS.items():
            with self.subTest(name):
                plant, rings = self.make(
                    make_urdf(joints, tool=f"link_{len(joints)}")
                )
                self.compare(plant, rings)

    def test_limits_and_names(self):
        plant, _ = self.make(make_urdf(CHAINS["tilted"], tool="link_6"))
        dut = mut.ArmKinematics.from_plant(plant)
        names = [f"joint_{i}" for i in (1, 3, 4, 5)]
        self.assertEqual(list(dut.joint_name), names)
        self.assertEqual(list(dut.chain.slides), [1, 0, 1, 0])
        np.testing.assert_array_equal(dut.lower, [-2, -2, -2, -np.inf])
        np.testing.assert_array_equal(dut.upper, [1.5, 1.5, 1.5, np.inf])

    def test_mjcf(self):
        """Joints of MuJoCo's models have their own places in the links."""
        plant, rings = self.make(
            """
<mujoco model="arm"><worldbody>
  <body name="link_0" pos="0.1 0.2 0.3">
    <geom type="sphere" size="0.1"/>
    <body name="link_1" pos="0 0 0.4" euler="10 20 30">
      <joint name="a" type="hinge" axis="1 0 0" pos="0.1 0.05 0"/>
      <geom type="sphere" size="0.1"/>
      <body name="tcp" pos="0.3 0 0">
        <joint name="b" type="slide" axis="0 1 1"/>
        <geom type="sphere" size="0.1"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>""",
            "xml",
        )
        self.compare(plant, rings)

    def test_other_joints_are_named(self):
        urdf = make_urdf(CHAINS["one joint"], tool="link_1")
        plant = MultibodyPlant(0.0)
        Parser(plant).AddModelsFromString(urdf, "urdf")
        plant.Finalize()
        with self.assertRaisesRegex(UserError, "floating.*base welded"):
            mut.ArmKinematics.from_plant(plant)
