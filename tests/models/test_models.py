import importlib.resources
import unittest

import numpy as np
import paper_cell
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Role,
    Sphere,
)
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

import tofssm_drake.models as mut

# UR's DH table: a, d, alpha.
DH = np.array(
    [
        (0.0, 0.1273, np.pi / 2),
        (-0.612, 0.0, 0.0),
        (-0.5723, 0.0, 0.0),
        (0.0, 0.163941, np.pi / 2),
        (0.0, 0.1157, -np.pi / 2),
        (0.0, 0.0922, 0.0),
    ]
)


def make_plant(*urls):
    """Parses models strictly; returns (diagram, plant, scene_graph)."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    parser = mut.make_parser(plant)
    for url in urls:
        parser.AddModelsFromUrl(f"package://{mut.PACKAGE}/{url}")
    plant.Finalize()
    return builder.Build(), plant, scene_graph


def calc_dh(q):
    X = np.eye(4)
    for angle, (a, d, alpha) in zip(q, DH, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        ca, sa = np.cos(alpha), np.sin(alpha)
        X = X @ np.array(
            [
                [c, -s * ca, s * sa, a * c],
                [s, c * ca, -c * sa, a * s],
                [0, sa, ca, d],
                [0, 0, 0, 1],
            ]
        )
    return X


class TestModels(unittest.TestCase):
    def test_every_model_parses_strictly(self):
        root = importlib.resources.files("tofssm_drake.models")
        found = [
            f"{folder.name}/{path.name}"
            for folder in root.iterdir()
            if folder.is_dir() and not folder.name.startswith("_")
            for path in folder.iterdir()
            if path.name.endswith((".urdf", ".sdf"))
        ]
        self.assertGreaterEqual(len(found), 6)
        for url in found:
            with self.subTest(url=url):
                make_plant(url)

    def test_kinematics_equal_dh_table(self):
        diagram, plant, _ = make_plant("workcell/workcell.dmd.yaml")
        context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
        base = plant.GetFrameByName("base")
        tool0 = plant.GetFrameByName("tool0")
        generator = np.random.default_rng(0)
        for _ in range(20):
            q = generator.uniform(-2 * np.pi, 2 * np.pi, 6)
            plant.SetPositions(context, q)
            actual = tool0.CalcPose(context, base).GetAsMatrix4()
            np.testing.assert_allclose(actual, calc_dh(q), atol=1e-9)

    def test_limits_and_masses(self):
        _, plant, _ = make_plant("ur10/ur10.urdf")
        np.testing.assert_allclose(
            plant.GetVelocityUpperLimits()[-6:],
            np.deg2rad([120, 120, 180, 180, 180, 180]),
        )
        np.testing.assert_array_equal(
            plant.GetEffortUpperLimits(), [330, 330, 150, 56, 56, 56]
        )
        np.testing.assert_allclose(
            plant.GetPositionUpperLimits()[-6:], np.full(6, 2 * np.pi)
        )
        mass = sum(
            plant.GetBodyByName(name).default_mass()
            for name in (
                "shoulder_link",
                "upper_arm_link",
                "forearm_link",
                "wrist_1_link",
                "wrist_2_link",
                "wrist_3_link",
            )
        )
        self.assertAlmostEqual(mass, 28.435)

    def test_dynamics(self):
        """Checks the bare arm at q = 0 against figures of UR's description,
        rounded as published: diagonal of the mass matrix, gravity torque."""
        plant = MultibodyPlant(0.0)
        parser = mut.make_parser(plant)
        parser.AddModelsFromUrl(f"package://{mut.PACKAGE}/ur10/ur10.urdf")
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
        plant.Finalize()
        context = plant.CreateDefaultContext()
        M = plant.CalcMassMatrix(context)
        np.testing.assert_allclose(
            np.diag(M)[:3], [12.2, 11.7, 2.24], rtol=0.01
        )
        gravity = plant.CalcGravityGeneralizedForces(context)
        np.testing.assert_allclose(
            np.abs(gravity[1:3]), [119.2, 38.4], atol=0.1
        )

    def test_shapes_seen(self):
        """Robot and gripper are seen as capsules and spheres, the cell as
        shapes the ray caster knows; nothing is meant for both eyes."""
        for url, allowed in (
            ("ur10/ur10.urdf", (Capsule, Sphere)),
            ("gripper/gripper.urdf", (Capsule, Sphere)),
            ("workcell/cell.dmd.yaml", (Box, Cylinder, HalfSpace)),
            ("workcell/product.urdf", (Box,)),
        ):
            _, _, scene_graph = make_plant(url)
            inspector = scene_graph.model_inspector()
            for role in (Role.kPerception, Role.kProximity):
                ids = inspector.GetAllGeometryIds(role)
                self.assertGreater(len(ids), 0)
                for geometry_id in ids:
                    shape = inspector.GetShape(geometry_id)
                    self.assertIsInstance(shape, allowed, url)
            looks = inspector.GetAllGeometryIds(Role.kIllustration)
            self.assertGreater(len(looks), 0)

    def test_ring_frames(self):
        """Sensors sit evenly on their ring and look outwards."""
        radius = {"base": 0.075, "elbow": 0.065, "tool": 0.07}
        for n in (8, 16):
            plant = paper_cell.make_plant(count=n)
            context = plant.CreateDefaultContext()
            for name, r in radius.items():
                ring = plant.GetFrameByName(f"{name}_ring")
                for j in range(n):
                    sensor = plant.GetFrameByName(f"{name}_ring_{j}")
                    X_LS = sensor.CalcPose(context, ring)
                    angle = 2 * np.pi * j / n
                    beam = np.array([np.cos(angle), np.sin(angle), 0])
                    np.testing.assert_allclose(
                        X_LS.translation(), r * beam, atol=1e-8
                    )
                    np.testing.assert_allclose(
                        X_LS.rotation().matrix()[:, 0], beam, atol=1e-8
                    )
                    np.testing.assert_allclose(
                        X_LS.rotation().matrix()[:, 2], [0, 0, 1], atol=1e-8
                    )
                self.assertFalse(plant.HasFrameNamed(f"{name}_ring_{n}"))
