from pathlib import Path
import tempfile
import unittest

import numpy as np
from pydrake.geometry import Capsule, Mesh, Role, SceneGraph, Sphere
import trimesh

from tofssm_drake.arms.arm import ArmModel, make_arm_plant
from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.tool_down import calc_tool_down_joints
import tofssm_drake.arms.ur_arm as mut
from tofssm_drake.arms.ur_data import list_ur_models, read_ur_data
from tofssm_drake.errors import UserError
from tofssm_drake.metrics.ground_truth import RobotCapsules
from tofssm_drake.poses import Pose

MODELS = [
    *("ur10", "ur10e", "ur12e", "ur16e", "ur20", "ur30"),
    *("ur3e", "ur5e", "ur7e"),
]

# By model: a2, a3, d1, d4, d5, d6 in mm, payload in kg, reach in mm, speed of
# base and last wrist in deg/s, as Universal Robots publishes them.
PUBLISHED = {
    "ur3e": (243.55, 213.2, 151.85, 131.05, 85.35, 92.1, 3, 500, 180, 360),
    "ur5e": (425, 392.2, 162.5, 133.3, 99.7, 99.6, 5, 850, 180, 180),
    "ur7e": (425, 392.2, 162.5, 133.3, 99.7, 99.6, 7.5, 850, 180, 180),
    "ur10": (612, 572.3, 127.3, 163.941, 115.7, 92.2, 10, 1300, 120, 180),
    "ur10e": (
        *(612.7, 571.55, 180.7, 174.15, 119.85, 116.55),
        *(12.5, 1300, 120, 180),
    ),
    "ur12e": (
        *(612.7, 571.55, 180.7, 174.15, 119.85, 116.55),
        *(12.5, 1300, 120, 180),
    ),
    "ur16e": (
        *(478.4, 360, 180.7, 174.15, 119.85, 116.55),
        *(16, 900, 120, 180),
    ),
    "ur20": (862, 728.7, 236.3, 201, 159.3, 154.3, 20, 1750, 120, 210),
    "ur30": (637, 503.7, 236.3, 201, 159.3, 154.3, 30, 1300, 120, 210),
}


def calc_dh(q, model):
    """Returns the flange in the base by the Denavit-Hartenberg table."""
    a2, a3, d1, d4, d5, d6, *_ = 1e-3 * np.array(PUBLISHED[model])
    X = np.eye(4)
    for theta, a, d, alpha in zip(
        q,
        (0, -a2, -a3, 0, 0, 0),
        (d1, 0, 0, d4, d5, d6),
        (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0),
        strict=True,
    ):
        c, s, ca, sa = (
            *(np.cos(theta), np.sin(theta)),
            *(np.cos(alpha), np.sin(alpha)),
        )
        X = X @ [
            [c, -s * ca, s * sa, a * c],
            [s, c * ca, -c * sa, a * s],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    return X


class TestUrArm(unittest.TestCase):
    def test_every_arm_is_there(self):
        self.assertEqual(list_ur_models(), MODELS)
        with self.assertRaisesRegex(UserError, r"robot\.model: 'ur6'.* ur10,"):
            mut.UrArm(model="ur6").check("robot")

    def test_forward_kinematics(self):
        generator = np.random.default_rng(0)
        for model in MODELS:
            arm = mut.UrArm(model=model, X_WB=Pose(), tool="")
            plant = make_arm_plant(arm)
            context = plant.CreateDefaultContext()
            kinematics = ArmKinematics.from_plant(plant)
            tool0 = plant.GetFrameByName("tool0")
            for q in generator.uniform(-6, 6, (10, 6)):
                plant.SetPositions(context, q)
                expected = calc_dh(q, model)
                np.testing.assert_allclose(
                    tool0.CalcPoseInWorld(context).GetAsMatrix4(),
                    expected,
                    atol=1e-9,
                )
                np.testing.assert_allclose(
                    kinematics.calc_tcp_pose(q), expected[:3], atol=1e-9
                )

    def test_figures(self):
        for model in MODELS:
            with self.subTest(model):
                payload, reach, first, last = PUBLISHED[model][6:]
                data = read_ur_data(model)
                self.assertEqual(data.payload, payload)
                self.assertAlmostEqual(data.reach, 1e-3 * reach)
                # Drawn out, the wrist is farther from the base's axis than
                # the reach, which UR states without the last wrist.
                tubes = -data.a2 - data.a3
                self.assertGreater(data.reach, tubes)
                self.assertLess(data.reach, tubes + data.d5 + 0.001)
                arm = mut.UrArm(model=model)
                arm.check("robot")
                limits = arm.read_limits()
                self.assertEqual(limits.joint_name, mut.UR_JOINTS)
                np.testing.assert_allclose(limits.upper, 2 * np.pi)
                np.testing.assert_allclose(
                    np.rad2deg(limits.speed[[0, -1]]), [first, last]
                )
                np.testing.assert_allclose(limits.effort, data.max_torque)
                np.testing.assert_allclose(
                    np.rad2deg(limits.acceleration), data.max_acceleration
                )

    def test_mass_and_gravity(self):
        """Drawn out to the side, each joint can carry arm and payload."""
        for model in MODELS:
            with self.subTest(model):
                data = read_ur_data(model)
                arm = mut.UrArm(model=model, tool="")
                plant = make_arm_plant(arm)
                context = plant.CreateDefaultContext()
                if data.mass:
                    self.assertAlmostEqual(
                        plant.CalcTotalMass(context),
                        sum(data.mass) + data.base_mass,
                    )
                torque = np.abs(plant.CalcGravityGeneralizedForces(context))
                load = 9.81 * data.payload * (data.reach - 0.12)
                self.assertLess(torque[1] + load, data.max_torque[1])
                self.assertGreater(
                    np.linalg.eigvalsh(plant.CalcMassMatrix(context)).min(), 0.0
                )

    def test_centres_of_mass(self):
        """In the Denavit-Hartenberg frames, as the table has them."""
        q = np.linspace(-2, 2, 6)
        data = read_ur_data("ur5e")
        arm = mut.UrArm(model="ur5e", X_WB=Pose(), tool="")
        plant = make_arm_plant(arm)
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, q)
        # The forearm's frame is at its end: a shift along its own x axis.
        body = plant.GetBodyByName("forearm_link")
        p_BC = body.CalcCenterOfMassInBodyFrame(context)
        np.testing.assert_allclose(
            p_BC, np.add(data.center_of_mass[2], [data.a3, 0, 0])
        )
        body = plant.GetBodyByName("wrist_2_link")
        x, y, z = data.center_of_mass[4]
        np.testing.assert_allclose(
            body.CalcCenterOfMassInBodyFrame(context), [x, z, -y], atol=1e-12
        )

    def test_tool_down(self):
        for model in MODELS:
            with self.subTest(model):
                data = read_ur_data(model)
                plant = make_arm_plant(mut.UrArm(model=model))
                kinematics = ArmKinematics.from_plant(plant)
                for azimuth in (-2.0, 0.3, 2.5):
                    p_WT = np.array(
                        [
                            0.6 * data.reach * np.cos(azimuth),
                            0.6 * data.reach * np.sin(azimuth),
                            0.75,
                        ]
                    )
                    q = calc_tool_down_joints(kinematics, p_WT, azimuth)
                    X_WT = kinematics.calc_tcp_pose(q)
                    np.testing.assert_allclose(X_WT[:, 3], p_WT, atol=1e-9)
                    np.testing.assert_allclose(
                        X_WT[:, 2], [0, 0, -1], atol=1e-9
                    )
                    np.testing.assert_allclose(
                        X_WT[:, 0],
                        [np.cos(azimuth), np.sin(azimuth), 0],
                        atol=1e-9,
                    )
                far = [data.reach + 0.3, 0.0, 0.75]
                with self.assertRaisesRegex(UserError, "point"):
                    calc_tool_down_joints(kinematics, far, 0.0)

    def test_shapes(self):
        """Capsules and spheres, without a gap from base to flange."""
        for model in MODELS:
            with self.subTest(model):
                scene_graph = SceneGraph()
                plant = make_cell_plant(
                    arm=mut.UrArm(model=model),
                    scene_graph=scene_graph,
                    workcell="",
                )
                inspector = scene_graph.model_inspector()
                for role in (Role.kPerception, Role.kProximity):
                    ids = inspector.GetAllGeometryIds(role)
                    self.assertGreaterEqual(len(ids), 14)
                    for geometry_id in ids:
                        self.assertIsInstance(
                            inspector.GetShape(geometry_id), Capsule | Sphere
                        )
                self.check_no_gap(plant, inspector)

    def check_no_gap(self, plant, inspector):
        """Every shape overlaps one of the link before or of its own."""
        context = plant.CreateDefaultContext()
        before = None
        for name in mut._LINKS:
            body = plant.GetBodyByName(name)
            X_WB = plant.EvalBodyPoseInWorld(context, body)
            axes = []
            for geometry_id in plant.GetCollisionGeometriesForBody(body):
                shape = inspector.GetShape(geometry_id)
                X = X_WB.multiply(inspector.GetPoseInFrame(geometry_id))
                half = shape.length() / 2 if isinstance(shape, Capsule) else 0.0
                t = np.linspace(-half, half, 40)
                points = X.translation() + np.outer(
                    t, X.rotation().matrix()[:, 2]
                )
                axes.append((points, shape.radius()))
            if before:
                gap = min(
                    np.linalg.norm(p[:, None] - q[None], axis=2).min() - r - s
                    for p, r in before
                    for q, s in axes
                )
                self.assertLess(gap, 0.0, name)
            before = axes

    def test_tool_with_meshes(self):
        """A tool's STL is seen, and measured to as capsules."""
        with tempfile.TemporaryDirectory() as folder:
            mesh = trimesh.creation.box([0.1, 0.05, 0.2])
            mesh.export(Path(folder) / "tool.stl")
            path = Path(folder) / "tool.urdf"
            geometry = '<geometry><mesh filename="tool.stl"/></geometry>'
            path.write_text(
                '<robot name="tool"><link name="tool"><inertial>'
                '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" '
                'ixz="0" iyz="0"/></inertial>'
                f"<visual>{geometry}</visual><collision>{geometry}"
                "</collision></link></robot>"
            )
            arm = mut.UrArm(model="ur3e", tool=str(path))
            arm.check("robot")
            scene_graph = SceneGraph()
            plant = make_cell_plant(arm=arm, scene_graph=scene_graph)
        inspector = scene_graph.model_inspector()
        body = plant.GetBodyByName("tool")
        frame_id = plant.GetBodyFrameIdOrThrow(body.index())
        (seen,) = inspector.GetGeometries(frame_id, Role.kPerception)
        self.assertIsInstance(inspector.GetShape(seen), Mesh)
        for geometry_id in inspector.GetGeometries(frame_id, Role.kProximity):
            self.assertIsInstance(
                inspector.GetShape(geometry_id), Capsule | Sphere
            )
        robot = RobotCapsules.from_plant(plant, inspector)
        self.assertIn("tool", robot.body_names)

    def test_ur10_is_the_hand_made_model(self):
        plant = make_cell_plant()
        self.assertTrue(plant.HasModelInstanceNamed("ur10"))
        self.assertTrue(plant.HasModelInstanceNamed("gripper"))
        context = plant.CreateDefaultContext()
        np.testing.assert_array_equal(
            plant.GetFrameByName("base")
            .CalcPoseInWorld(context)
            .GetAsMatrix34(),
            plant.GetFrameByName("robot_base")
            .CalcPoseInWorld(context)
            .GetAsMatrix34(),
        )

    def test_mount(self):
        arm = mut.UrArm(
            model="ur5e",
            X_WB=Pose(translation=[1, 2, 3], rpy_deg=[0, 0, 90]),
            tool="",
            X_FT=Pose(translation=[0, 0, 0.1]),
        )
        model: ArmModel = arm
        plant = make_arm_plant(model)
        context = plant.CreateDefaultContext()
        X_WB = plant.GetFrameByName("base").CalcPoseInWorld(context)
        np.testing.assert_allclose(X_WB.translation(), [1, 2, 3])
        np.testing.assert_allclose(
            X_WB.rotation().matrix()[:, 0], [0, 1, 0], atol=1e-12
        )
        X_FT = plant.GetFrameByName(arm.tool_frame).CalcPose(
            context, plant.GetFrameByName("tool0")
        )
        np.testing.assert_allclose(X_FT.translation(), [0, 0, 0.1], atol=1e-12)

    def test_wrong_settings_are_named(self):
        for settings, says in (
            (
                {"X_WB": Pose(rpy_deg=[0, 0])},
                r"robot\.X_WB\.rpy_deg: .* must be three",
            ),
            (
                {"X_WB": Pose(translation=[1e300, 0, 0])},
                r"robot\.X_WB\.translation: .* from -1000 to 1000",
            ),
            ({"tool": "none.urdf"}, r"robot\.tool: there is no file none"),
        ):
            with self.assertRaisesRegex(UserError, says):
                mut.UrArm(model="ur5e", **settings).check("robot")
