import unittest

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    RevoluteJoint,
    SpatialInertia,
)
from pydrake.systems.framework import DiagramBuilder

import tofssm_drake.evaluation.ground_truth as mut
from tofssm_drake.evaluation.truth import TruthLayout

_FRICTION = CoulombFriction(0.5, 0.5)


def _make_arm(builder, shape=None):
    """Three links, each 0.5 m along its x axis, turning about z, y, y."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    model = plant.AddModelInstance("arm")
    parent = plant.world_body()
    for i, axis in enumerate(([0, 0, 1], [0, 1, 0], [0, 1, 0])):
        link = plant.AddRigidBody(
            f"link_{i}", model, SpatialInertia.SolidSphereWithMass(1.0, 0.1)
        )
        x = 0.5 if i else 0.0
        plant.AddJoint(
            RevoluteJoint(
                f"joint_{i}",
                plant.AddFrame(
                    FixedOffsetFrame(
                        f"mount_{i}",
                        parent.body_frame(),
                        RigidTransform([x, 0, 0.1 * i]),
                    )
                ),
                link.body_frame(),
                axis,
            )
        )
        plant.RegisterCollisionGeometry(
            link,
            RigidTransform(RollPitchYaw(0, np.pi / 2, 0), [0.25, 0, 0]),
            shape or Capsule(0.05 + 0.01 * i, 0.5),
            "capsule",
            _FRICTION,
        )
        plant.RegisterCollisionGeometry(
            link, RigidTransform([0.1, 0.2, 0]), Sphere(0.04), "s", _FRICTION
        )
        parent = link
    floor = plant.AddRigidBody(
        "floor",
        plant.AddModelInstance("cell"),
        SpatialInertia.SolidSphereWithMass(1.0, 0.1),
    )
    plant.WeldFrames(plant.world_frame(), floor.body_frame())
    plant.RegisterCollisionGeometry(
        floor, RigidTransform([0, 0, -1]), Box(9, 9, 0.1), "box", _FRICTION
    )
    ring = [
        plant.AddFrame(
            FixedOffsetFrame(
                f"ring_{i}",
                plant.GetFrameByName(f"link_{i}"),
                RigidTransform(RollPitchYaw(0.3 * i, 0.2, 1), [0.3, 0, 0]),
            )
        )
        for i in range(3)
    ]
    tcp = plant.AddFrame(
        FixedOffsetFrame(
            "tcp", plant.GetFrameByName("link_2"), RigidTransform([0.6, 0, 0])
        )
    )
    plant.Finalize()
    return plant, scene_graph, model, ring, tcp


class TestGroundTruth(unittest.TestCase):
    RADII = np.array([0.1, 0.15, 0.08])

    def setUp(self):
        self.rng = np.random.default_rng(7)
        self._build(self.RADII)

    def _build(self, radii, shape=None):
        builder = DiagramBuilder()
        plant, scene_graph, model, ring, tcp = _make_arm(builder, shape)
        self.plant = plant
        self.ring = ring
        self.tcp = tcp
        self.inspector = scene_graph.model_inspector()
        self.dut = builder.AddSystem(
            mut.GroundTruth(
                plant=plant,
                inspector=self.inspector,
                models=[model],
                ring_frames=ring,
                tcp_frame=tcp,
                radii=radii,
                pelvis=1,
            )
        )
        builder.Connect(
            plant.get_body_poses_output_port(),
            self.dut.GetInputPort("body_poses"),
        )
        builder.Connect(
            plant.get_body_spatial_velocities_output_port(),
            self.dut.GetInputPort("body_spatial_velocities"),
        )
        self.diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()
        self.context = self.dut.GetMyContextFromRoot(self.root)
        self.plant_context = plant.GetMyContextFromRoot(self.root)
        self.layout = TruthLayout(3)

    def _pose(self, q, v, ends):
        self.plant.SetPositions(self.plant_context, q)
        self.plant.SetVelocities(self.plant_context, v)
        self.dut.GetInputPort("skeleton").FixValue(self.context, ends.ravel())

    def _eval(self, name):
        return self.dut.GetOutputPort(name).Eval(self.context)

    def test_ports(self):
        dut = self.dut
        self.assertEqual(
            [dut.get_input_port(i).get_name() for i in range(3)],
            ["body_poses", "body_spatial_velocities", "skeleton"],
        )
        self.assertEqual(
            [
                dut.get_output_port(i).get_name()
                for i in range(dut.num_output_ports())
            ],
            ["truth", "distance", "witness", "ring_distance", "contact_speed"],
        )

    def test_distance_equals_drake(self):
        """Spheres of Drake's own point query stand in for the person."""
        query_port = self.diagram.GetSubsystemByName(
            "scene_graph"
        ).get_query_output_port()
        scene_graph = self.diagram.GetSubsystemByName("scene_graph")
        for _ in range(20):
            centre = self.rng.uniform(-1.2, 1.2, 3)
            ends = np.full((3, 2, 3), 50.0)
            ends[2] = centre
            self._pose(
                self.rng.uniform(-2, 2, 3), self.rng.normal(size=3), ends
            )
            query = query_port.Eval(scene_graph.GetMyContextFromRoot(self.root))
            found = [
                result.distance
                for result in query.ComputeSignedDistanceToPoint(centre)
                if "arm" in self.inspector.GetName(result.id_G)
            ]
            self.assertEqual(len(found), 6)
            distance = self._eval("distance")[0]
            self.assertAlmostEqual(distance, min(found) - 0.08, delta=1e-9)
            witness = self._eval("witness")
            if distance > 0:
                self.assertAlmostEqual(
                    np.linalg.norm(witness[3:] - witness[:3]), distance
                )
                self.assertAlmostEqual(
                    np.linalg.norm(witness[3:] - centre), 0.08
                )
            truth = self._eval("truth")
            self.assertEqual(truth[self.layout.person_part], 2)

    def test_ring_distance_against_minimisation(self):
        """The nearest point is searched for along the capsules' axes."""
        for _ in range(5):
            ends = self.rng.uniform(-2, 2, (3, 2, 3))
            self._pose(self.rng.uniform(-2, 2, 3), np.zeros(3), ends)
            truth = self._eval("truth")
            for k, frame in enumerate(self.ring):
                X_WL = frame.CalcPoseInWorld(self.plant_context)
                best = np.inf
                for (p, q), r in zip(ends, self.RADII, strict=True):
                    grid = np.linspace(0, 1, 2001)[:, None]
                    line = p + grid * (q - p) - X_WL.translation()
                    norm = np.linalg.norm(line, axis=1)
                    if norm.min() - r < best:
                        best = norm.min() - r
                        nearest = line[norm.argmin()]
                x, y, z = X_WL.rotation().inverse() @ nearest
                self.assertAlmostEqual(
                    truth[self.layout.ring_distance][k], best, delta=1e-5
                )
                self.assertAlmostEqual(
                    truth[self.layout.ring_azimuth][k],
                    np.arctan2(y, x),
                    delta=5e-3,
                )
                self.assertAlmostEqual(
                    truth[self.layout.ring_elevation][k],
                    np.arcsin(z / np.sqrt(x * x + y * y + z * z)),
                    delta=5e-3,
                )
            np.testing.assert_array_equal(
                self._eval("ring_distance"), truth[self.layout.ring_distance]
            )

    def test_tcp(self):
        q, v = self.rng.uniform(-2, 2, 3), self.rng.normal(size=3)
        self._pose(q, v, self.rng.uniform(2, 3, (3, 2, 3)))
        truth = self._eval("truth")
        velocity = self.tcp.CalcSpatialVelocityInWorld(self.plant_context)
        np.testing.assert_allclose(
            truth[self.layout.p_WT],
            self.tcp.CalcPoseInWorld(self.plant_context).translation(),
            atol=1e-12,
        )
        self.assertAlmostEqual(
            truth[self.layout.tcp_speed],
            np.linalg.norm(velocity.translational()),
        )

    def test_person(self):
        ends = self.rng.uniform(2, 3, (3, 2, 3))
        self._pose(np.zeros(3), np.zeros(3), ends)
        np.testing.assert_allclose(
            self._eval("truth")[self.layout.person],
            ends[1].mean(axis=0)[:2],
        )

    def test_contact_speed(self):
        """Two parts are touched; the one farther out is touched faster."""
        ends = np.full((3, 2, 3), 20.0)
        ends[0] = [[0.1, 0.14, 0.5], [0.1, 0.14, -0.5]]
        ends[1] = [[0.3, 0.18, 0.5], [0.3, 0.18, -0.5]]
        self._pose(np.zeros(3), np.array([2.0, 0, 0]), ends)
        truth = self._eval("truth")
        self.assertLess(truth[self.layout.distance], 0.0)
        self.assertEqual(truth[self.layout.robot_body], 0)
        self.assertEqual(truth[self.layout.person_part], 1)
        # About z at 2 rad/s, the touching point is at (0.3, 0.05).
        self.assertAlmostEqual(
            self._eval("contact_speed")[0], 2 * np.hypot(0.3, 0.05)
        )

    def test_contact_at_rest(self):
        ends = np.full((3, 2, 3), 20.0)
        ends[0] = [[0.2, 0.14, 0.5], [0.2, 0.14, -0.5]]
        self._pose(np.zeros(3), np.zeros(3), ends)
        self.assertLess(self._eval("distance")[0], 0.0)
        self.assertEqual(self._eval("contact_speed")[0], 0.0)

    def test_apart_has_no_contact_speed(self):
        ends = np.full((3, 2, 3), 5.0)
        self._pose(np.zeros(3), np.ones(3), ends)
        self.assertEqual(self._eval("contact_speed")[0], 0.0)

    def test_nobody(self):
        self._build(np.empty(0))
        self.plant.SetPositions(self.plant_context, np.ones(3))
        truth = self._eval("truth")
        layout = self.layout
        self.assertEqual(truth[layout.distance], np.inf)
        self.assertTrue(np.all(truth[layout.ring_distance] == np.inf))
        self.assertTrue(np.all(np.isnan(truth[layout.p_WH])))
        self.assertTrue(np.all(np.isnan(truth[layout.ring_azimuth])))
        self.assertTrue(np.all(np.isnan(truth[layout.person])))
        self.assertEqual(truth[layout.robot_body], -1)
        self.assertEqual(truth[layout.person_part], -1)
        self.assertEqual(truth[layout.contact_speed], 0.0)

    def test_unsupported_shape(self):
        with self.assertRaisesRegex(ValueError, r"arm::capsule.*Box"):
            self._build(self.RADII, shape=Box(0.1, 0.1, 0.1))
