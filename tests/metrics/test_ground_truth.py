from pathlib import Path
import tempfile
import unittest

import numpy as np
from paper_cell import RINGS, find_kinematics, make_plant
from pydrake.geometry import Box, Role, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from robots import CHAINS, make_panda, make_urdf

from tofssm_drake.arms.arm import Arm
from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.ur_arm import UrArm
import tofssm_drake.metrics.ground_truth as mut
from tofssm_drake.metrics.truth import TruthLayout
from tofssm_drake.models import make_parser

RADII = np.array([0.1, 0.15, 0.08])
LAYOUT = TruthLayout(3)
# Folded up, so that no link is near another's touching points.
Q = np.array([0.3, -1.2, 1.1, -1.4, -1.6, 0.2])


class TestGroundTruth(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        builder = DiagramBuilder()
        cls.scene_graph = builder.AddSystem(SceneGraph())
        cls.plant = make_plant(scene_graph=cls.scene_graph)
        builder.AddSystem(cls.plant)
        builder.Connect(
            cls.plant.get_geometry_pose_output_port(),
            cls.scene_graph.get_source_pose_port(cls.plant.get_source_id()),
        )
        cls.diagram = builder.Build()
        cls.inspector = cls.scene_graph.model_inspector()

    def setUp(self):
        self.rng = np.random.default_rng(7)
        self.root = self.diagram.CreateDefaultContext()
        self.plant_context = self.plant.GetMyContextFromRoot(self.root)
        self._build(RADII)

    def _build(self, radii):
        self.model = mut.TruthModel(
            plant=self.plant,
            inspector=self.inspector,
            radii=radii,
            kinematics=find_kinematics(self.plant),
            pelvis=1,
        )
        self.dut = mut.GroundTruth(model=self.model)
        self.context = self.dut.CreateDefaultContext()

    def _pose(self, q, v, ends):
        self.plant.SetPositions(self.plant_context, q)
        self.plant.SetVelocities(self.plant_context, v)
        for name, value in (
            ("position", q),
            ("velocity", v),
            ("skeleton", ends.ravel()),
        ):
            self.dut.GetInputPort(name).FixValue(self.context, value)

    def _eval(self, name):
        return self.dut.GetOutputPort(name).Eval(self.context)

    def _find_robot_distances(self, centre):
        """Signed distances of the robot's shapes to a point, by Drake."""
        query = self.scene_graph.get_query_output_port().Eval(
            self.scene_graph.GetMyContextFromRoot(self.root)
        )
        return {
            result.id_G: result.distance
            for result in query.ComputeSignedDistanceToPoint(centre)
            if self.inspector.GetName(result.id_G).startswith(
                ("ur10::", "gripper::")
            )
        }

    def _get_body(self, geometry_id):
        frame = self.inspector.GetFrameId(geometry_id)
        return self.plant.GetBodyFromFrameId(frame)

    def test_ports(self):
        dut = self.dut
        self.assertEqual(
            [dut.get_input_port(i).get_name() for i in range(3)],
            ["position", "velocity", "skeleton"],
        )
        self.assertEqual(
            [
                dut.get_output_port(i).get_name()
                for i in range(dut.num_output_ports())
            ],
            ["truth", "distance", "witness", "ring_distance", "contact_speed"],
        )

    def test_distance_equals_drake(self):
        """Drake's own point query, with a sphere for the person."""
        for _ in range(40):
            centre = self.rng.uniform([-1.2, -1.2, 0], [1.2, 1.2, 2])
            ends = np.full((3, 2, 3), 50.0)
            ends[2] = centre
            self._pose(
                self.rng.uniform(-2, 2, 6), self.rng.normal(size=6), ends
            )
            found = self._find_robot_distances(centre)
            nearest = min(found, key=found.get)
            truth = self._eval("truth")
            self.assertAlmostEqual(
                self._eval("distance")[0], found[nearest] - 0.08, delta=1e-9
            )
            self.assertEqual(truth[LAYOUT.person_part], 2)
            witness = self._eval("witness")
            self.assertAlmostEqual(np.linalg.norm(witness[3:] - centre), 0.08)
            if truth[LAYOUT.distance] > 0:
                self.assertAlmostEqual(
                    np.linalg.norm(witness[3:] - witness[:3]),
                    truth[LAYOUT.distance],
                )
                self.assertEqual(
                    self.model.body_names[int(truth[LAYOUT.robot_body])],
                    self._get_body(nearest).name(),
                )

    def test_every_robot_shape_is_read(self):
        geometry = sum(
            len(self.plant.GetCollisionGeometriesForBody(body))
            for model in ("ur10", "gripper")
            for body in map(
                self.plant.get_body,
                self.plant.GetBodyIndices(
                    self.plant.GetModelInstanceByName(model)
                ),
            )
        )
        robot = mut.RobotCapsules.from_plant(self.plant, self.inspector)
        self.assertEqual(len(robot.radius), geometry)
        self.assertIn("forearm_link", robot.body_names)
        self.assertIn("gripper", robot.body_names)

    def test_ring_distance_against_search(self):
        """The nearest point is searched for along the capsules' axes."""
        for _ in range(5):
            ends = self.rng.uniform(-2, 2, (3, 2, 3))
            self._pose(self.rng.uniform(-2, 2, 6), np.zeros(6), ends)
            truth = self._eval("truth")
            for k, ring in enumerate(RINGS):
                frame = self.plant.GetFrameByName(f"{ring}_ring")
                X_WL = frame.CalcPoseInWorld(self.plant_context)
                best = np.inf
                for (p, q), r in zip(ends, RADII, strict=True):
                    grid = np.linspace(0, 1, 2001)[:, None]
                    line = p + grid * (q - p) - X_WL.translation()
                    norm = np.linalg.norm(line, axis=1)
                    if norm.min() - r < best:
                        best = norm.min() - r
                        nearest = line[norm.argmin()]
                x, y, z = X_WL.rotation().inverse() @ nearest
                self.assertAlmostEqual(
                    truth[LAYOUT.ring_distance][k], best, delta=1e-5
                )
                self.assertAlmostEqual(
                    truth[LAYOUT.ring_azimuth][k],
                    np.arctan2(y, x),
                    delta=5e-3,
                )
                self.assertAlmostEqual(
                    truth[LAYOUT.ring_elevation][k],
                    np.arcsin(z / np.sqrt(x * x + y * y + z * z)),
                    delta=5e-3,
                )
            np.testing.assert_array_equal(
                self._eval("ring_distance"), truth[LAYOUT.ring_distance]
            )

    def test_tcp(self):
        q, v = self.rng.uniform(-2, 2, 6), self.rng.normal(size=6)
        self._pose(q, v, self.rng.uniform(2, 3, (3, 2, 3)))
        truth = self._eval("truth")
        frame = self.plant.GetFrameByName("tcp")
        velocity = frame.CalcSpatialVelocityInWorld(self.plant_context)
        np.testing.assert_allclose(
            truth[LAYOUT.p_WT],
            frame.CalcPoseInWorld(self.plant_context).translation(),
            atol=1e-12,
        )
        self.assertAlmostEqual(
            truth[LAYOUT.tcp_speed],
            np.linalg.norm(velocity.translational()),
        )

    def test_person(self):
        ends = self.rng.uniform(2, 3, (3, 2, 3))
        self._pose(Q, np.zeros(6), ends)
        np.testing.assert_allclose(
            self._eval("truth")[LAYOUT.person],
            ends[1].mean(axis=0)[:2],
        )

    def _make_touching_ends(self):
        """A sphere in the upper arm and one at the gripper's end."""
        self._pose(Q, np.zeros(6), np.full((3, 2, 3), 50.0))
        ends = np.full((3, 2, 3), 50.0)
        for part, name in ((0, "upper_arm_link"), (2, "tcp")):
            X_WF = self.plant.GetFrameByName(name).CalcPoseInWorld(
                self.plant_context
            )
            ends[part] = X_WF @ [0.0, 0.01, 0.05]
        return ends

    def test_contact_speed(self):
        """Of two touched bodies, the faster counts, at its own point."""
        ends = self._make_touching_ends()
        v = np.array([0.7, -0.4, 0.9, 0.2, -0.3, 0.5])
        self._pose(Q, v, ends)
        truth = self._eval("truth")
        self.assertLess(truth[LAYOUT.distance], 0.0)
        self.assertEqual(truth[LAYOUT.person_part], 2)
        # Oracle: rigid-body velocity of the touched body by the plant, over
        # the touching shapes' nearest points as Drake finds them.
        query = self.scene_graph.get_query_output_port().Eval(
            self.scene_graph.GetMyContextFromRoot(self.root)
        )
        speeds = []
        for part in (0, 2):
            centre = ends[part, 0]
            for result in query.ComputeSignedDistanceToPoint(centre):
                name = self.inspector.GetName(result.id_G)
                if not name.startswith(("ur10::", "gripper::")):
                    continue
                if result.distance > RADII[part]:
                    continue
                body = self._get_body(result.id_G)
                X_WB = self.plant.EvalBodyPoseInWorld(self.plant_context, body)
                X_WG = X_WB @ self.inspector.GetPoseInFrame(result.id_G)
                V_WB = self.plant.EvalBodySpatialVelocityInWorld(
                    self.plant_context, body
                )
                point = X_WG @ result.p_GN
                offset = point - X_WB.translation()
                speeds.append(
                    np.linalg.norm(V_WB.Shift(offset).translational())
                )
        self.assertGreater(len(speeds), 1)
        self.assertAlmostEqual(
            self._eval("contact_speed")[0], max(speeds), delta=1e-9
        )

    def test_contact_at_rest(self):
        self._pose(Q, np.zeros(6), self._make_touching_ends())
        self.assertLess(self._eval("distance")[0], 0.0)
        self.assertEqual(self._eval("contact_speed")[0], 0.0)
        self.assertGreaterEqual(self._eval("truth")[LAYOUT.robot_body], 0)

    def test_apart_has_no_contact_speed(self):
        self._pose(Q, np.ones(6), np.full((3, 2, 3), 5.0))
        self.assertEqual(self._eval("contact_speed")[0], 0.0)

    def test_nobody(self):
        self._build(np.empty(0))
        for name in ("position", "velocity"):
            self.dut.GetInputPort(name).FixValue(self.context, Q)
        truth = self._eval("truth")
        self.assertEqual(truth[LAYOUT.distance], np.inf)
        self.assertTrue(np.all(truth[LAYOUT.ring_distance] == np.inf))
        self.assertTrue(np.all(np.isnan(truth[LAYOUT.p_WH])))
        self.assertTrue(np.all(np.isnan(truth[LAYOUT.ring_azimuth])))
        self.assertTrue(np.all(np.isnan(truth[LAYOUT.person])))
        self.assertEqual(truth[LAYOUT.robot_body], -1)
        self.assertEqual(truth[LAYOUT.person_part], -1)
        self.assertEqual(truth[LAYOUT.contact_speed], 0.0)
        self.assertGreater(truth[LAYOUT.tcp_speed], 0.0)

    def test_rows_equal_the_port(self):
        """A whole record gives the numbers of the system, one by one."""
        k = 5
        q, v = self.rng.uniform(-2, 2, (2, k, 6))
        ends = self.rng.uniform(-1, 1, (k, 3, 2, 3))
        rows = self.model.calc(q=q, qd=v, skeleton=ends.reshape(k, -1))
        self.assertEqual(rows.shape, (k, LAYOUT.size))
        for i in range(k):
            self._pose(q[i], v[i], ends[i])
            np.testing.assert_array_equal(rows[i], self._eval("truth"))

    def test_feedthrough_is_declared(self):
        """Only the three inputs, hence no algebraic loop with the monitor."""
        for i in range(self.dut.num_output_ports()):
            for j in range(self.dut.num_input_ports()):
                self.assertTrue(self.dut.HasDirectFeedthrough(j, i))


class TestAnyArm(unittest.TestCase):
    """Distance and speed of contact against Drake's own plant."""

    def check(self, arm):
        builder = DiagramBuilder()
        scene_graph = builder.AddSystem(SceneGraph())
        plant = builder.AddSystem(
            make_cell_plant(
                arm=arm,
                scene_graph=scene_graph,
                workcell="",
            )
        )
        builder.Connect(
            plant.get_geometry_pose_output_port(),
            scene_graph.get_source_pose_port(plant.get_source_id()),
        )
        diagram = builder.Build()
        root = diagram.CreateDefaultContext()
        context = plant.GetMyContextFromRoot(root)
        dut = mut.TruthModel(
            plant=plant,
            inspector=scene_graph.model_inspector(),
            radii=np.array([0.15]),
            pelvis=0,
            kinematics=ArmKinematics.from_plant(plant),
        )
        n = dut.num_positions
        rng = np.random.default_rng(1)
        touched = 0
        for _ in range(30):
            q, qd = rng.uniform(-0.5, 0.5, (2, n))
            plant.SetPositions(context, q)
            plant.SetVelocities(context, qd)
            body = plant.GetBodyByName(rng.choice(dut.body_names[1:]))
            centre = plant.EvalBodyPoseInWorld(context, body).translation()
            centre = centre + rng.uniform(-0.4, 0.4, 3)
            query = scene_graph.get_query_output_port().Eval(
                scene_graph.GetMyContextFromRoot(root)
            )
            expected = min(
                result.distance
                for result in query.ComputeSignedDistanceToPoint(centre)
            )
            (truth,) = dut.calc(
                q=q[None], qd=qd[None], skeleton=np.tile(centre, 2)[None]
            )
            layout = dut.layout
            self.assertAlmostEqual(
                truth[layout.distance], expected - 0.15, delta=1e-9
            )
            if truth[layout.distance] > 0.0:
                continue
            touched += 1
            body = plant.GetBodyByName(
                dut.body_names[int(truth[layout.robot_body])]
            )
            speeds = self.list_speeds(plant, context, body, scene_graph, centre)
            self.assertLess(
                np.abs(speeds - truth[layout.contact_speed]).min(), 1e-9
            )
        self.assertGreater(touched, 3)

    def list_speeds(self, plant, context, body, scene_graph, centre):
        """Returns the speeds of a body at its capsules' nearest points."""
        V_WB = plant.EvalBodySpatialVelocityInWorld(context, body)
        X_WB = plant.EvalBodyPoseInWorld(context, body)
        speeds = []
        inspector = scene_graph.model_inspector()
        for geometry_id in inspector.GetGeometries(
            plant.GetBodyFrameIdOrThrow(body.index()), Role.kProximity
        ):
            p, q, r = mut._read_capsule(inspector, geometry_id)
            p, q = X_WB @ p, X_WB @ q
            axis = q - p
            t = np.clip((centre - p) @ axis / max(axis @ axis, 1e-12), 0.0, 1.0)
            nearest = p + t * axis
            towards = (centre - nearest) / np.linalg.norm(centre - nearest)
            p_BP = nearest + r * towards - X_WB.translation()
            speeds.append(np.linalg.norm(V_WB.Shift(p_BP).translational()))
        return np.array(speeds)

    def test_ur5e(self):
        self.check(UrArm(model="ur5e"))

    def test_seven_joints(self):
        self.check(make_panda())

    def test_sliding_joints(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(make_urdf(CHAINS["tilted"], tool="link_6"))
            self.check(
                Arm(file=str(path), tool="", joint_acceleration=[5.0] * 4)
            )


class TestRobotCapsules(unittest.TestCase):
    def test_unsupported_shape(self):
        scene_graph = SceneGraph()
        plant = MultibodyPlant(0.0)
        plant.RegisterAsSourceForSceneGraph(scene_graph)
        make_parser(plant).AddModelsFromUrl(
            "package://tofssm_drake_models/ur10/ur10_gripper.dmd.yaml"
        )
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
        plant.RegisterCollisionGeometry(
            plant.GetBodyByName("forearm_link"),
            RigidTransform(),
            Box(0.1, 0.1, 0.1),
            "bracket",
            CoulombFriction(0.5, 0.5),
        )
        plant.Finalize()
        with self.assertRaisesRegex(ValueError, r"ur10::bracket.*Box"):
            mut.RobotCapsules.from_plant(plant, scene_graph.model_inspector())

    def test_no_geometry(self):
        """A plant without a SceneGraph has no shapes to measure to."""
        plant = make_cell_plant()
        with self.assertRaisesRegex(ValueError, "no proximity geometry"):
            mut.RobotCapsules.from_plant(plant, SceneGraph().model_inspector())
