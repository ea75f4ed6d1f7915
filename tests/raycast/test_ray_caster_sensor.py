"""Ray bundles in a Diagram, against the caster itself."""

import unittest

import numpy as np
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from tofssm_drake.raycast.fan import (
    make_cone_fan,
    make_lidar_fan,
    make_pinhole_fan,
    make_planar_fan,
)
from tofssm_drake.raycast.ray_caster import RayCaster
import tofssm_drake.raycast.ray_caster_sensor as mut

SPEED = 0.5


class Cell:
    """A ball that moves away along x from 2 m on, and a fixed box beside."""

    def __init__(self, pattern_S, min_range=0.0, **options):
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        ball = plant.AddRigidBody(
            "ball", SpatialInertia.SolidSphereWithMass(1.0, 0.5)
        )
        look = RigidTransform(), Sphere(0.5), "ball", np.ones(4)
        plant.RegisterVisualGeometry(ball, *look)
        X_WB = RigidTransform([0.0, 3.0, 0.0])
        plant.RegisterVisualGeometry(
            plant.world_body(), X_WB, Box(1, 1, 1), "box", np.ones(4)
        )
        joint = plant.AddJoint(
            PrismaticJoint(
                "x", plant.world_frame(), ball.body_frame(), [1.0, 0, 0]
            )
        )
        plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
        joint.set_default_translation(2.0)
        plant.Finalize()
        self.caster = RayCaster(scene_graph.model_inspector())
        self.bundles = self.caster.make_bundles(
            frame_id=self.caster.world_frame_id,
            X_FS=[RigidTransform()],
            fan_S=pattern_S.reshape(-1, 3),
            max_range=10.0,
            min_range=min_range,
        )
        self.dut = builder.AddSystem(
            mut.RayCasterSensor(
                caster=self.caster,
                bundles=self.bundles,
                shape=pattern_S.shape[:-1],
                **options,
            )
        )
        query_port = scene_graph.get_query_output_port()
        builder.Connect(query_port, self.dut.GetInputPort("geometry_query"))
        diagram = builder.Build()
        self.simulator = Simulator(diagram)
        self.context = self.simulator.get_mutable_context()
        joint.set_translation_rate(
            plant.GetMyMutableContextFromRoot(self.context), SPEED
        )
        self.scene_graph = scene_graph

    def read(self, name):
        context = self.dut.GetMyContextFromRoot(self.context)
        return self.dut.GetOutputPort(name).Eval(context)

    def query(self):
        context = self.scene_graph.GetMyContextFromRoot(self.context)
        return self.scene_graph.get_query_output_port().Eval(context)


ROW = make_planar_fan(np.radians(np.arange(-20.0, 111.0)))
AHEAD = 20


class TestRayCasterSensor(unittest.TestCase):
    def test_any_pattern_in_its_shape(self):
        lidar = make_lidar_fan(np.radians([0, 10, 90]), np.radians([-5, 0]))
        camera = make_pinhole_fan(
            width=8, height=6, focal_x=5.0, focal_y=5.0, center_x=3.5,
            center_y=2.5,
        )  # fmt: skip
        for pattern in (ROW, lidar, camera, make_cone_fan(0.4, 25)):
            cell = Cell(pattern)
            shape = pattern.shape[:-1]
            X_WF = cell.caster.poses_from_query_object(cell.query())
            distance, index = cell.caster.cast_bundles(cell.bundles, X_WF)
            rays = cell.caster.calc_rays(cell.bundles, X_WF)
            normals = cell.caster.calc_normals(X_WF, *rays, distance, index)
            self.assertTrue(np.isfinite(distance).any() or shape == (6, 8))
            for name, expected in (
                ("ranges", distance.reshape(shape)),
                ("geometry_index", index.reshape(shape)),
                ("normals", normals.reshape(*shape, 3)),
            ):
                actual = cell.read(name)
                self.assertEqual(actual.shape, expected.shape)
                np.testing.assert_array_equal(actual, expected)
        self.assertAlmostEqual(Cell(ROW).read("ranges")[AHEAD], 1.5)

    def test_present(self):
        cell = Cell(ROW)
        for time in (0.0, 0.3, 1.0):
            cell.simulator.AdvanceTo(time)
            self.assertEqual(cell.read("scan_time")[0], time)
            self.assertAlmostEqual(
                cell.read("ranges")[AHEAD], 1.5 + SPEED * time, places=6
            )

    def test_period(self):
        """Scans at 0.05 s and every 0.1 s from there, 0.02 s late."""
        cell = Cell(ROW, period=0.1, capture_offset=0.05, output_delay=0.02)
        for time, scanned in (
            (0.0, np.nan),
            (0.06, np.nan),
            (0.075, 0.05),
            (0.16, 0.05),
            (0.175, 0.15),
        ):
            cell.simulator.AdvanceTo(time)
            np.testing.assert_allclose(cell.read("scan_time"), [scanned])
            np.testing.assert_allclose(
                cell.read("ranges")[AHEAD], 1.5 + SPEED * scanned, atol=1e-6
            )
        self.assertTrue(np.isfinite(cell.read("normals")[AHEAD]).all())

    def test_nothing_is_known_before_the_first_scan(self):
        cell = Cell(ROW, period=0.1, capture_offset=0.05)
        cell.simulator.AdvanceTo(0.04)
        self.assertTrue(np.isnan(cell.read("ranges")).all())
        self.assertTrue((cell.read("geometry_index") == -1).all())
        self.assertTrue(np.isnan(cell.read("normals")).all())
        cell.simulator.AdvanceTo(0.051)
        self.assertFalse(np.isnan(cell.read("ranges")).any())

    def test_forced_updates_are_a_trigger(self):
        cell = Cell(ROW, period=np.inf)
        cell.simulator.AdvanceTo(0.2)
        self.assertTrue(np.isnan(cell.read("ranges")).all())
        context = cell.dut.GetMyMutableContextFromRoot(cell.context)
        cell.dut.CalcForcedUnrestrictedUpdate(
            context, context.get_mutable_state()
        )
        cell.simulator.AdvanceTo(0.4)
        self.assertEqual(cell.read("scan_time")[0], 0.2)
        self.assertAlmostEqual(cell.read("ranges")[AHEAD], 1.6, places=6)

    def test_normals_with_a_minimum_range(self):
        cell = Cell(ROW, min_range=2.0)
        self.assertEqual(cell.read("ranges")[AHEAD], 2.0)
        self.assertTrue(np.isnan(cell.read("normals")[AHEAD]).all())
        np.testing.assert_allclose(
            cell.read("normals")[AHEAD + 90], [0.0, -1.0, 0.0], atol=1e-12
        )

    def test_wrong_settings(self):
        for options, message in (
            (dict(period=0.0), "period: 0.0 is not > 0"),
            (dict(period=np.nan), "period: nan"),
            (dict(period=0.1, capture_offset=-1.0), "capture_offset: -1.0"),
            (dict(period=0.1, output_delay=0.1), "output_delay: 0.1"),
            (dict(output_delay=0.1), "need a period"),
        ):
            with self.assertRaisesRegex(ValueError, message):
                Cell(ROW, **options)
        cell = Cell(ROW)
        with self.assertRaisesRegex(ValueError, r"shape: \(3,\) does not have"):
            mut.RayCasterSensor(
                caster=cell.caster, bundles=cell.bundles, shape=(3,)
            )


class TestPatterns(unittest.TestCase):
    def test_planar(self):
        fan = make_planar_fan(np.radians([0, 90, -30]))
        expected = [[1, 0, 0], [0, 1, 0], [0.75**0.5, -0.5, 0]]
        np.testing.assert_allclose(fan, expected, atol=1e-15)

    def test_lidar(self):
        fan = make_lidar_fan(np.radians([0, 90]), np.radians([0, 30, -90]))
        self.assertEqual(fan.shape, (3, 2, 3))
        np.testing.assert_allclose(fan[1, 1], [0, 0.75**0.5, 0.5], atol=1e-15)
        np.testing.assert_allclose(fan[2, 0], [0, 0, -1], atol=1e-15)

    def test_pinhole_is_drakes(self):
        info = CameraInfo(width=64, height=48, fov_y=0.8)
        fan = make_pinhole_fan(
            width=info.width(),
            height=info.height(),
            focal_x=info.focal_x(),
            focal_y=info.focal_y(),
            center_x=info.center_x(),
            center_y=info.center_y(),
        )
        self.assertEqual(fan.shape, (48, 64, 3))
        np.testing.assert_allclose(np.linalg.norm(fan, axis=-1), 1.0)
        pixel = fan @ np.asarray(info.intrinsic_matrix()).T
        pixel = pixel[..., :2] / pixel[..., 2:]
        v, u = np.mgrid[:48, :64]
        np.testing.assert_allclose(pixel, np.stack([u, v], -1), atol=1e-9)


if __name__ == "__main__":
    unittest.main()
