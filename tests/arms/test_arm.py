from pathlib import Path
import tempfile
import unittest
import xml.etree.ElementTree as ElementTree

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Mesh,
    Role,
    SceneGraph,
    Sphere,
)
from robots import CHAINS, PANDA, make_panda, make_urdf
import trimesh

import tofssm_drake.arms.arm as mut
from tofssm_drake.arms.arm_file import find_model_file
from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.errors import UserError
from tofssm_drake.metrics.ground_truth import RobotCapsules
from tofssm_drake.poses import Pose
from tofssm_drake.raycast.ray_caster import RayCaster

SHAPES = {
    "perception": Cylinder,
    "proximity": Box,
    "capsules": Capsule | Sphere,
}


def make_scene(arm):
    """Returns the arm's plant with shapes, and the inspector."""
    scene_graph = SceneGraph()
    plant = make_cell_plant(arm=arm, scene_graph=scene_graph, workcell="")
    return plant, scene_graph.model_inspector()


class TestArm(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def make(self, joints="seven joints", **settings):
        urdf = make_urdf(CHAINS[joints], tool=f"link_{len(CHAINS[joints])}")
        path = self.folder / "arm.urdf"
        path.write_text(urdf)
        n = sum(row[0] != "fixed" for row in CHAINS[joints])
        return mut.Arm(
            **{
                "file": str(path),
                "tool": "",
                "joint_acceleration": [5.0] * n,
            }
            | settings
        )

    def test_limits(self):
        arm = self.make("tilted", joint_speed=[1.0, 2.0, 3.0, 4.0])
        arm.check("robot")
        limits = arm.read_limits()
        self.assertEqual(
            limits.joint_name, ("joint_1", "joint_3", "joint_4", "joint_5")
        )
        np.testing.assert_array_equal(limits.speed, [1, 2, 3, 4])
        np.testing.assert_array_equal(limits.acceleration, [5] * 4)
        np.testing.assert_array_equal(limits.effort, [50] * 4)
        np.testing.assert_array_equal(limits.lower, [-2, -2, -2, -np.inf])
        arm = self.make("tilted", joint_effort=[1.0, 2.0, 3.0, 4.0])
        np.testing.assert_array_equal(arm.read_limits().effort, [1, 2, 3, 4])

    def test_where_it_stands(self):
        arm = self.make(
            base_frame="link_1",
            flange_frame="link_6",
            X_WB=Pose(translation=[1, 2, 3], rpy_deg=[0, 90, 0]),
        )
        plant = mut.make_arm_plant(arm)
        context = plant.CreateDefaultContext()
        X_WB = plant.GetFrameByName("link_1").CalcPoseInWorld(context)
        np.testing.assert_allclose(X_WB.translation(), [1, 2, 3])

    def test_gripper(self):
        arm = self.make(tool=mut.GRIPPER)
        urdf = Path(arm.file).read_text()
        Path(arm.file).write_text(
            urdf.replace('<frame name="tcp"', '<frame name="point"')
        )
        arm.check("robot")
        plant = mut.make_arm_plant(arm)
        context = plant.CreateDefaultContext()
        p_FT = (
            plant.GetFrameByName("tcp")
            .CalcPose(context, plant.GetFrameByName("link_7"))
            .translation()
        )
        np.testing.assert_allclose(p_FT, [0, 0, 0.2], atol=1e-12)

    def test_sensed(self):
        """Sensors see what they should; distances are to capsules."""
        for sensed, shapes in SHAPES.items():
            with self.subTest(sensed):
                plant, inspector = make_scene(
                    self.make(sensed=sensed, flange_frame="link_7")
                )
                for role, kinds in (
                    (Role.kPerception, shapes),
                    (Role.kProximity, Capsule | Sphere),
                    (Role.kIllustration, Cylinder),
                ):
                    found = inspector.GetAllGeometryIds(role)
                    self.assertGreaterEqual(len(found), 8)
                    for geometry_id in found:
                        self.assertIsInstance(
                            inspector.GetShape(geometry_id), kinds
                        )
                robot = RobotCapsules.from_plant(plant, inspector)
                self.assertEqual(len(robot.body_names), 8)
                # A box of 0.1 x 0.2 x 0.3 m.
                self.assertGreaterEqual(robot.radius.min(), 0.05)
                RayCaster(inspector)

    def test_own_capsules_are_kept(self):
        arm = self.make()
        urdf = Path(arm.file).read_text()
        Path(arm.file).write_text(
            urdf.replace('<box size="0.1 0.2 0.3"/>', '<sphere radius="0.1"/>')
        )
        plant, inspector = make_scene(arm)
        robot = RobotCapsules.from_plant(plant, inspector)
        np.testing.assert_array_equal(robot.radius, np.full(8, 0.1))

    def test_links_with_one_kind_of_shapes(self):
        """Each is seen and measured to by what it has."""
        for kind in ("visual", "collision"):
            for sensed in SHAPES:
                arm = self.make("one joint", sensed=sensed)
                root = ElementTree.fromstring(Path(arm.file).read_text())
                link = root.find("link")
                link.remove(link.find(kind))
                text = ElementTree.tostring(root, encoding="unicode")
                Path(arm.file).write_text(text)
                plant, inspector = make_scene(arm)
                frame_id = plant.GetBodyFrameIdOrThrow(
                    plant.GetBodyByName("link_0").index()
                )
                for role in (Role.kPerception, Role.kProximity):
                    self.assertGreater(
                        inspector.NumGeometriesForFrameWithRole(frame_id, role),
                        0,
                        (kind, sensed, role),
                    )
                robot = RobotCapsules.from_plant(plant, inspector)
                self.assertIn("link_0", robot.body_names)

    def test_foreign_meshes(self):
        """STL, which Drake does not read, next to the URDF, scaled."""
        mesh = trimesh.creation.box([100, 200, 900])
        mesh.export(self.folder / "tube.stl")
        arm = self.make(sensed="proximity")
        urdf = Path(arm.file).read_text()
        Path(arm.file).write_text(
            urdf.replace(
                '<box size="0.1 0.2 0.3"/>',
                '<mesh filename="tube.stl" scale="0.001 0.001 0.001"/>',
            )
        )
        plant, inspector = make_scene(arm)
        for geometry_id in inspector.GetAllGeometryIds(Role.kPerception):
            shape = inspector.GetShape(geometry_id)
            self.assertIsInstance(shape, Mesh)
            hull = shape.GetConvexHull()
            top = max(hull.vertex(i)[2] for i in range(hull.num_vertices()))
            self.assertAlmostEqual(top, 0.45)
        robot = RobotCapsules.from_plant(plant, inspector)
        corner = np.array([0.05, 0.1, 0.45])
        for i in np.flatnonzero(robot.link == 0):
            axis = robot.p_AQ[i] - robot.p_AP[i]
            t = np.clip(
                (corner - robot.p_AP[i]) @ axis / max(axis @ axis, 1e-12), 0, 1
            )
            distance = np.linalg.norm(corner - robot.p_AP[i] - t * axis)
            if distance <= robot.radius[i] + 1e-9:
                break
        else:
            self.fail("a corner is in no capsule")

    def test_mistakes_are_named(self):
        for settings, says in (
            ({"file": ""}, r"^robot\.file: names no"),
            ({"file": "no.urdf"}, r"^robot\.file: there is no file no\.urdf"),
            ({"file": "package://no/a.urdf"}, "no package 'no'; known are"),
            ({"sensed": "lidar"}, r"^robot\.sensed: 'lidar' is unknown"),
            ({"base_frame": "foot"}, r"base_frame: .* has no frame 'foot'"),
            ({"flange_frame": "end"}, r"flange_frame: .* has no frame 'end'"),
            ({"fixed_joints": {"j": 0.0}}, "fixed_joints: .* no joint 'j'"),
            (
                {"joint_acceleration": []},
                r"^robot\.joint_acceleration: the model has no limit for "
                r"joint_1, joint_2, .* its 7 joints$",
            ),
            ({"tool": mut.GRIPPER}, r"^robot\.tool: .*leave this empty"),
            ({"joint_speed": [1.0]}, r"joint_speed: has 1 values"),
            ({"joint_effort": [-1.0] * 7}, "joint_effort: must be greater"),
        ):
            with self.subTest(says), self.assertRaisesRegex(UserError, says):
                self.make(**settings).check("robot")

    def test_joints_beyond_the_tool(self):
        arm = self.make(flange_frame="link_3")
        urdf = Path(arm.file).read_text()
        Path(arm.file).write_text(urdf.replace('name="tcp"', 'name="point"'))
        says = r"^robot\.fixed_joints: joint_4, joint_5, .* is not between"
        with self.assertRaisesRegex(UserError, says):
            arm.check("robot")

    def test_fixed_joints(self):
        arm = self.make(
            flange_frame="link_6",
            fixed_joints={"joint_7": 0.5, "joint_2": -0.3},
            joint_acceleration=[5.0] * 5,
        )
        arm.check("robot")
        free = mut.make_arm_plant(self.make())
        fixed = mut.make_arm_plant(arm)
        self.assertEqual(fixed.num_positions(), 5)
        context = free.CreateDefaultContext()
        free.SetPositions(context, [0.1, -0.3, 0.2, 0.3, 0.4, 0.5, 0.5])
        other = fixed.CreateDefaultContext()
        fixed.SetPositions(other, [0.1, 0.2, 0.3, 0.4, 0.5])
        np.testing.assert_allclose(
            fixed.GetFrameByName("link_7")
            .CalcPoseInWorld(other)
            .GetAsMatrix34(),
            free.GetFrameByName("link_7")
            .CalcPoseInWorld(context)
            .GetAsMatrix34(),
            atol=1e-12,
        )


MJCF = """
<mujoco model="arm"><worldbody>
  <body name="foot" pos="0.1 0.2 0.3">
    <geom type="box" size="0.1 0.1 0.1"/>
    <body name="post" pos="0 0 0.4">
      <joint name="a" type="hinge" axis="0 0 1" range="-90 90"/>
      <geom type="cylinder" size="0.05 0.2"/>
      <body name="hand" pos="0.3 0 0">
        <joint name="b" type="slide" axis="1 0 0" range="-0.1 0.1"/>
        <geom type="ellipsoid" size="0.1 0.1 0.1"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>
"""

SDF = """
<sdf version="1.9"><model name="arm">
  <link name="foot"><collision name="c"><geometry><box>
    <size>0.2 0.2 0.2</size></box></geometry></collision></link>
  <link name="post"><pose relative_to="a"/><collision name="c"><geometry>
    <cylinder><radius>0.05</radius><length>0.4</length></cylinder>
    </geometry></collision></link>
  <link name="hand"><pose relative_to="b"/></link>
  <joint name="fixed" type="fixed"><parent>world</parent><child>foot</child>
  </joint>
  <joint name="a" type="revolute"><pose relative_to="foot">0 0 0.4 0 0 0</pose>
    <parent>foot</parent><child>post</child><axis><xyz>0 0 1</xyz><limit>
    <lower>-1.5</lower><upper>1.5</upper><velocity>2</velocity>
    <effort>30</effort></limit></axis></joint>
  <joint name="b" type="prismatic"><pose relative_to="post">0.3 0 0 0 0 0
    </pose><parent>post</parent><child>hand</child><axis><xyz>1 0 0</xyz>
    <limit><lower>-0.1</lower><upper>0.1</upper><velocity>1</velocity>
    <effort>20</effort></limit></axis></joint>
</model></sdf>
"""


class TestOtherFormats(unittest.TestCase):
    """The same arm in MuJoCo's format and in SDF, placed by themselves."""

    def check(self, name, text):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_text(text)
            arm = mut.Arm(
                file=str(path),
                tool="",
                joint_speed=[1.0, 0.5],
                joint_acceleration=[5.0, 2.0],
                sensed="proximity",
                X_WB=Pose(translation=[1.0, 0.0, 0.5]),
            )
            arm.check("robot")
            self.assertEqual(arm.read_limits().joint_name, ("a", "b"))
            plant, inspector = make_scene(arm)
        kinematics = ArmKinematics.from_plant(plant)
        X_WT = kinematics.calc_tcp_pose(np.array([np.pi / 2, 0.1]))
        np.testing.assert_allclose(X_WT[:, 3], [1.0, 0.4, 0.9], atol=1e-9)
        robot = RobotCapsules.from_plant(plant, inspector)
        self.assertEqual(robot.body_names[:2], ["foot", "post"])

    def test_mjcf(self):
        self.check("arm.xml", MJCF)

    def test_sdf(self):
        self.check("arm.sdf", SDF)


class TestPanda(unittest.TestCase):
    """A public description: COLLADA, STL, fingers, no transmissions."""

    @classmethod
    def setUpClass(cls):
        cls.arm = make_panda()
        cls.plant, cls.inspector = make_scene(cls.arm)

    def test_joints(self):
        self.arm.check("robot")
        limits = self.arm.read_limits()
        self.assertEqual(
            limits.joint_name, tuple(f"panda_joint{i}" for i in range(1, 8))
        )
        np.testing.assert_array_equal(limits.effort, [87] * 4 + [12] * 3)
        np.testing.assert_array_equal(limits.speed, [2.175] * 4 + [2.61] * 3)

    def test_kinematics(self):
        dut = ArmKinematics.from_plant(self.plant)
        context = self.plant.CreateDefaultContext()
        tcp = self.plant.GetFrameByName("panda_hand_tcp")
        for q in np.random.default_rng(0).uniform(-1, 1, (10, 7)):
            self.plant.SetPositions(context, q)
            np.testing.assert_allclose(
                dut.calc_tcp_pose(q),
                tcp.CalcPoseInWorld(context).GetAsMatrix34(),
                atol=1e-9,
            )

    def test_capsules_cover_the_meshes(self):
        found = self.arm.calc_coverage()
        self.assertEqual(len(found), 11)
        for link, coverage in found.items():
            with self.subTest(link):
                self.assertEqual(coverage.share_inside, 1.0)
                self.assertLess(coverage.farthest_outside, 1e-9)
                self.assertLess(coverage.farthest_excess, 0.09)

    def test_shapes(self):
        robot = RobotCapsules.from_plant(self.plant, self.inspector)
        self.assertEqual(len(robot.body_names), 11)
        ids = self.inspector.GetAllGeometryIds(Role.kPerception)
        self.assertEqual(len(ids), len(robot.radius))

    def test_file(self):
        self.assertTrue(find_model_file(PANDA).is_file())
