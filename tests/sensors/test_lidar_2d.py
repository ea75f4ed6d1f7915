import copy
import dataclasses as dc
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import (
    Box,
    Cylinder,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    PerceptionProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from tofssm_drake.errors import UserError
from tofssm_drake.messages import LidarScan
from tofssm_drake.raycast.ray_caster import RayCaster
import tofssm_drake.sensors.lidar_2d as mut

SPEED = 0.5
LEG = 0.06
QUIET = {"noise_sigma": 0.0, "resolution": 0.0}


class Cart(LeafSystem):
    """A frame that drives along x and carries what the test puts on it."""

    def __init__(self, scene_graph):
        super().__init__()
        self.source_id = scene_graph.RegisterSource("cart")
        self.frame_id = scene_graph.RegisterFrame(
            self.source_id, GeometryFrame("cart")
        )
        self.DeclareAbstractOutputPort(
            "pose",
            Value(FramePoseVector()).Clone,
            self.calc_pose,
            prerequisites_of_calc={self.time_ticket()},
        )

    @staticmethod
    def calc_X_WC(time):
        return RigidTransform([SPEED * time, 0.0, 0.0])

    def calc_pose(self, context, output):
        poses = FramePoseVector()
        poses.set_value(self.frame_id, self.calc_X_WC(context.get_time()))
        output.set_value(poses)


def make_scene(
    config,
    shapes,
    *,
    on_cart=False,
    X_FS=None,
    excluded=(),
    noise=None,
):
    """A lidar in the world or on a cart, shapes in the world or on it.

    Args:
        shapes: {name: (shape, pose)}; a name that starts with "cart" rides.
        excluded: names that the lidar does not see.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    cart = builder.AddSystem(Cart(scene_graph))
    builder.Connect(
        cart.GetOutputPort("pose"),
        scene_graph.get_source_pose_port(cart.source_id),
    )
    ids = {}
    for name, (shape, X) in shapes.items():
        geometry = GeometryInstance(RigidTransform(X), shape, name)
        geometry.set_perception_properties(PerceptionProperties())
        rides = name.startswith("cart")
        ids[name] = scene_graph.RegisterGeometry(
            cart.source_id,
            cart.frame_id if rides else scene_graph.world_frame_id(),
            geometry,
        )
    caster = RayCaster(scene_graph.model_inspector())
    bundle = mut.make_lidar_bundle(
        config=config,
        caster=caster,
        frame_id=cart.frame_id if on_cart else None,
        X_FS=X_FS,
        excluded=[ids[name] for name in excluded],
    )
    lidar = builder.AddNamedSystem(
        "lidar", mut.Lidar2d(config=config, caster=caster, bundle=bundle)
    )
    builder.Connect(
        scene_graph.get_query_output_port(),
        lidar.GetInputPort("geometry_query"),
    )
    if noise is not None:
        source = builder.AddSystem(
            ConstantVectorSource(np.broadcast_to(noise, len(lidar.angles)))
        )
        builder.Connect(source.get_output_port(), lidar.GetInputPort("noise"))
    builder.ExportOutput(lidar.GetOutputPort("scan"), "scan")
    return builder.Build()


def run_until(diagram, times):
    simulator = Simulator(diagram)
    port = diagram.GetOutputPort("scan")
    scans = []
    for time in times:
        simulator.AdvanceTo(time)
        scans.append(port.Eval(simulator.get_context()))
    return scans


def calc_ranges_to_circle(angles, x, radius):
    """From the origin to a circle about (x, 0) that does not hold it."""
    inside = radius**2 - (x * np.sin(angles)) ** 2
    seen = (inside >= 0.0) & (np.cos(angles) > 0.0)
    near = x * np.cos(angles) - np.sqrt(np.where(seen, inside, 0.0))
    return np.where(seen, near, np.inf)


class TestConfig(unittest.TestCase):
    def test_defaults(self):
        dut = mut.Lidar2dConfig()
        dut.check("lidar")
        self.assertEqual(len(mut.calc_lidar_angles(dut)), 720)

    def test_loads_from_yaml(self):
        dut = yaml_load_typed(
            schema=mut.Lidar2dConfig,
            data="{height: 0.2, angle_min_deg: -135, angle_max_deg: 135}",
        )
        dut.check("lidar")
        self.assertEqual(dut.height, 0.2)
        self.assertEqual(len(mut.calc_lidar_angles(dut)), 541)

    def test_every_number_is_checked(self):
        for field in dc.fields(mut.Lidar2dConfig):
            for bad in (-1e3, np.nan, 1e6, "far"):
                config = mut.Lidar2dConfig(**{field.name: bad})
                with (
                    self.subTest(field=field.name, bad=bad),
                    self.assertRaisesRegex(
                        UserError, rf"^here\.{field.name}: .*use"
                    ),
                ):
                    config.check("here")

    def test_directions_in_order(self):
        dut = mut.Lidar2dConfig(angle_min_deg=10.0, angle_max_deg=-10.0)
        with self.assertRaisesRegex(UserError, "here.angle_min_deg: 10"):
            dut.check("here")

    def test_a_scan_is_delivered_before_the_next_is_taken(self):
        dut = mut.Lidar2dConfig(period=0.03, latency=0.03)
        with self.assertRaisesRegex(UserError, "here.latency: 0.03 .*use"):
            dut.check("here")


class TestAngles(unittest.TestCase):
    def calc(self, low, high, step):
        return np.degrees(
            mut.calc_lidar_angles(
                mut.Lidar2dConfig(
                    angle_min_deg=low, angle_max_deg=high, angle_step_deg=step
                )
            )
        )

    def test_both_ends_are_looked_at(self):
        np.testing.assert_allclose(
            self.calc(-1.0, 1.0, 0.5), np.arange(5) / 2 - 1
        )
        # 0.3 is not exactly three steps of 0.1 in floating point.
        np.testing.assert_allclose(self.calc(0.0, 0.3, 0.1), [0, 0.1, 0.2, 0.3])

    def test_steps_that_do_not_fit(self):
        np.testing.assert_allclose(self.calc(-1.0, 1.0, 0.8), [-1, -0.2, 0.6])

    def test_one_ray(self):
        np.testing.assert_allclose(self.calc(5.0, 5.0, 1.0), [5.0])

    def test_a_whole_turn_has_no_direction_twice(self):
        for step in (90.0, 0.5, 0.1, 1.0 / 3.0, 0.7):
            angles = np.radians(self.calc(-180.0, 180.0, step))
            directions = np.column_stack([np.cos(angles), np.sin(angles)])
            nearest = (directions[1:] @ directions[0]).max()
            self.assertLess(nearest, np.cos(np.radians(0.09)))
        self.assertEqual(len(self.calc(-180.0, 180.0, 90.0)), 4)


class TestMeasureRanges(unittest.TestCase):
    def measure(self, distance, noise, **config):
        return mut.measure_ranges(
            mut.Lidar2dConfig(**config),
            distance=np.asarray(distance, dtype=float),
            noise=np.broadcast_to(noise, np.shape(distance)),
        )

    def test_noise_scales(self):
        np.testing.assert_allclose(
            self.measure(
                [1.0, 2.0], [2.0, -1.0], noise_sigma=0.03, resolution=0
            ),
            [1.06, 1.97],
        )

    def test_resolution(self):
        np.testing.assert_allclose(
            self.measure([1.234, 0.126], 0.0, resolution=0.05), [1.25, 0.15]
        )

    def test_nothing_stays_nothing_and_none_is_negative(self):
        np.testing.assert_array_equal(
            self.measure([np.inf, 0.01], -5.0, noise_sigma=0.1), [np.inf, 0.0]
        )

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=20, deadline=None)
    def test_error_is_as_large_as_set(self, seed):
        noise = np.random.default_rng(seed).standard_normal(4000)
        error = self.measure(np.full(4000, 5.0), noise, noise_sigma=0.02) - 5.0
        # Five standard deviations of the estimates.
        self.assertLess(abs(error.mean()), 5 * 0.02 / np.sqrt(4000))
        self.assertAlmostEqual(
            error.std(), 0.02, delta=5 * 0.02 / np.sqrt(8000)
        )


class TestLidar2d(unittest.TestCase):
    def test_cylinder(self):
        """A leg: the closed form of a circle."""
        config = mut.Lidar2dConfig(height=0.2, **QUIET)
        leg = Cylinder(LEG, 0.8), RigidTransform([2.0, 0.0, 0.4])
        scan = run_until(make_scene(config, {"leg": leg}), [0.07])[0]
        expected = calc_ranges_to_circle(scan.angles, 2.0, LEG)
        self.assertGreater(np.isfinite(expected).sum(), 5)
        np.testing.assert_allclose(scan.ranges, expected, rtol=0, atol=1e-12)

    def test_wall_and_range(self):
        """A wall at x = 3 m is 3 m / cos(angle) away, up to the range."""
        config = mut.Lidar2dConfig(max_range=5.0, **QUIET)
        wall = Box(1.0, 100.0, 4.0), RigidTransform([3.5, 0.0, 0.0])
        scan = run_until(make_scene(config, {"wall": wall}), [0.07])[0]
        cosine = np.cos(scan.angles)
        with np.errstate(divide="ignore"):
            expected = np.where(cosine > 0.0, 3.0 / cosine, np.inf)
        expected[expected > 5.0] = np.inf
        self.assertGreater(np.isfinite(expected).sum(), 200)
        np.testing.assert_allclose(scan.ranges, expected, rtol=0, atol=1e-12)

    def test_room(self):
        """Four walls of a box around: the farther coordinate decides."""
        config = mut.Lidar2dConfig(
            angle_min_deg=-90.0, angle_max_deg=45.0, **QUIET
        )
        shapes = {}
        for i, (size, centre) in enumerate(
            [
                ((1.0, 9.0, 2.0), (4.5, 0.0, 0.0)),
                ((1.0, 9.0, 2.0), (-4.5, 0.0, 0.0)),
                ((9.0, 1.0, 2.0), (0.0, 3.5, 0.0)),
                ((9.0, 1.0, 2.0), (0.0, -3.5, 0.0)),
            ]
        ):
            shapes[f"wall{i}"] = Box(*size), RigidTransform(centre)
        scan = run_until(make_scene(config, shapes), [0.07])[0]
        c, s = np.cos(scan.angles), np.sin(scan.angles)
        self.assertEqual(len(scan.ranges), 271)
        expected = 1.0 / np.maximum(np.abs(c) / 4.0, np.abs(s) / 3.0)
        np.testing.assert_allclose(scan.ranges, expected, rtol=0, atol=1e-12)

    def test_only_its_plane_is_seen(self):
        shape = {"ball": (Sphere(0.2), RigidTransform([1.0, 0.0, 0.5]))}
        for height, seen in ((0.29, False), (0.31, True), (0.71, False)):
            config = mut.Lidar2dConfig(height=height, **QUIET)
            scan = run_until(make_scene(config, shape), [0.07])[0]
            self.assertEqual(np.isfinite(scan.ranges).any(), seen)

    def test_pose_of_the_scanner(self):
        """Upside down and turned: the sense of the angles is its own."""
        config = mut.Lidar2dConfig(angle_step_deg=30.0, **QUIET)
        X_WS = RigidTransform(
            RollPitchYaw(np.pi, 0.0, np.pi / 2), [1.0, 2.0, 3.0]
        )
        ball = (
            Sphere(0.1),
            X_WS @ RigidTransform([np.cos(np.pi / 3), np.sin(np.pi / 3), 0.0]),
        )
        scan = run_until(make_scene(config, {"ball": ball}, X_FS=X_WS), [0.07])[
            0
        ]
        self.assertEqual(np.isfinite(scan.ranges).sum(), 1)
        nearest = np.argmin(scan.ranges)
        self.assertAlmostEqual(scan.angles[nearest], np.pi / 3)
        self.assertAlmostEqual(scan.ranges[nearest], 0.9)

    def test_rides_on_a_frame_and_does_not_see_its_housing(self):
        config = mut.Lidar2dConfig(angle_step_deg=90.0, **QUIET)
        shapes = {
            "wall": (Box(1.0, 9.0, 9.0), RigidTransform([3.5, 0.0, 0.0])),
            "cart_housing": (Sphere(0.5), RigidTransform()),
        }
        diagram = make_scene(
            config, shapes, on_cart=True, excluded=["cart_housing"]
        )
        for k, scan in enumerate(
            run_until(diagram, 0.04 * np.arange(1, 20) + 0.021)
        ):
            self.assertEqual(scan.sequence, k)
            self.assertAlmostEqual(scan.time, 0.04 * (k + 1), delta=2e-9)
            ahead = scan.ranges[np.argmin(np.abs(scan.angles))]
            self.assertAlmostEqual(ahead, 3.0 - SPEED * scan.time, delta=1e-12)
            self.assertEqual(np.isinf(scan.ranges).sum(), 3)
        within = run_until(make_scene(config, shapes, on_cart=True), [0.07])[0]
        np.testing.assert_array_equal(within.ranges, 0.0)

    def test_when_a_scan_is_there(self):
        scans = run_until(
            make_scene(mut.Lidar2dConfig(**QUIET), {}),
            [0.0, 0.0399, 0.0599, 0.0601, 0.0999, 0.1001],
        )
        self.assertEqual([s.sequence for s in scans], [-1, -1, -1, 0, 0, 1])
        self.assertIsInstance(scans[0], LidarScan)
        self.assertEqual(len(scans[0].ranges), 0)
        self.assertTrue(np.isinf(scans[-1].ranges).all())

    def test_latency_from_none_to_a_period(self):
        for latency in (0.0, 0.039):
            config = mut.Lidar2dConfig(latency=latency, **QUIET)
            scans = run_until(
                make_scene(config, {}),
                0.04 * np.arange(1, 30) + latency + 1e-4,
            )
            self.assertEqual([s.sequence for s in scans], list(range(29)))

    def test_starting_late_delivers_nothing_old(self):
        diagram = make_scene(mut.Lidar2dConfig(**QUIET), {})
        simulator = Simulator(diagram)
        simulator.get_mutable_context().SetTime(0.05)
        simulator.Initialize()
        port = diagram.GetOutputPort("scan")
        simulator.AdvanceTo(0.07)
        self.assertEqual(port.Eval(simulator.get_context()).sequence, -1)
        simulator.AdvanceTo(0.11)
        scan = port.Eval(simulator.get_context())
        self.assertEqual(scan.sequence, 0)
        self.assertAlmostEqual(scan.time, 0.08, delta=2e-9)

    def test_noise(self):
        wall = {"wall": (Box(1.0, 9.0, 9.0), RigidTransform([3.5, 0.0, 0.0]))}
        config = mut.Lidar2dConfig(
            angle_min_deg=0.0, angle_max_deg=2.0, angle_step_deg=1.0
        )
        noise = np.array([1.0, -2.0, 0.0])
        scan = run_until(make_scene(config, wall, noise=noise), [0.07])[0]
        exact = 3.0 / np.cos(np.radians([0.0, 1.0, 2.0]))
        np.testing.assert_allclose(
            scan.ranges, np.round(exact + 0.01 * noise, 3), rtol=0, atol=1e-9
        )

    def test_noise_must_be_connected_unless_there_is_none(self):
        with self.assertRaisesRegex(RuntimeError, "noise"):
            run_until(make_scene(mut.Lidar2dConfig(), {}), [0.07])

    def test_message_and_ports(self):
        diagram = make_scene(mut.Lidar2dConfig(**QUIET), {})
        lidar = diagram.GetSubsystemByName("lidar")
        self.assertFalse(lidar.HasAnyDirectFeedthrough())
        self.assertEqual(lidar.GetInputPort("noise").size(), 720)
        scan = run_until(diagram, [0.07])[0]
        self.assertIs(copy.deepcopy(scan), scan)
        with self.assertRaises(ValueError):
            scan.ranges[0] = 0.0

    def test_rejects_what_does_not_suit(self):
        config = mut.Lidar2dConfig()
        caster = RayCaster(SceneGraph().model_inspector())
        bundle = mut.make_lidar_bundle(config=config, caster=caster)
        for other in (
            mut.Lidar2dConfig(angle_step_deg=1.0),
            mut.Lidar2dConfig(angle_min_deg=-179.5),
        ):
            with self.assertRaisesRegex(ValueError, "^bundle: 1 of 720 rays"):
                mut.Lidar2d(config=other, caster=caster, bundle=bundle)
        shorter = mut.Lidar2dConfig(max_range=2.0)
        with self.assertRaisesRegex(ValueError, "^bundle: reaches 10 m"):
            mut.Lidar2d(config=shorter, caster=caster, bundle=bundle)
        bad = mut.Lidar2dConfig(angle_step_deg=0.0)
        with self.assertRaisesRegex(UserError, "lidar.angle_step_deg"):
            mut.make_lidar_bundle(config=bad, caster=caster)
        with self.assertRaisesRegex(UserError, "lidar.angle_step_deg"):
            mut.Lidar2d(config=bad, caster=caster, bundle=bundle)


if __name__ == "__main__":
    unittest.main()
