from types import SimpleNamespace
import unittest

import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import (
    Box,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    PerceptionProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.ring_mount import RingMount
import tofssm_drake.sensors.tof_rings as mut
from tofssm_drake.sensors.vl53l1x import CONSTANT_DRAWS, NOISE_DRAWS, Vl53l1x

SPEED = 0.5
RADIUS = 0.1


class MovingSphere(LeafSystem):
    """A sphere on the x axis: its near side is at 1 m - SPEED t."""

    def __init__(self, scene_graph):
        super().__init__()
        self.source_id = scene_graph.RegisterSource("sphere")
        self.frame_id = scene_graph.RegisterFrame(
            self.source_id, GeometryFrame("sphere")
        )
        geometry = GeometryInstance(RigidTransform(), Sphere(RADIUS), "sphere")
        geometry.set_perception_properties(PerceptionProperties())
        scene_graph.RegisterGeometry(self.source_id, self.frame_id, geometry)
        self.DeclareAbstractOutputPort(
            "pose",
            Value(FramePoseVector()).Clone,
            self.calc_pose,
            prerequisites_of_calc={self.time_ticket()},
        )

    def calc_pose(self, context, output):
        poses = FramePoseVector()
        x = 1.0 + RADIUS - SPEED * context.get_time()
        poses.set_value(self.frame_id, RigidTransform([x, 0.0, 0.0]))
        output.set_value(poses)


def make_X_WS(n=8, radius=0.0):
    rotations = [
        RotationMatrix.MakeZRotation(2 * np.pi * i / n) for i in range(n)
    ]
    return [RigidTransform(R, R @ [radius, 0, 0]) for R in rotations]


def make_mount(name, frame_id, *, X_FS=None, excluded=()):
    X_FS = make_X_WS() if X_FS is None else X_FS
    return RingMount(
        name=name,
        frame_id=frame_id,
        X_FS=X_FS,
        X_LS=X_FS,
        geometry_ids=list(excluded),
    )


def make_cell(config, *, phase=0.0, constants=None, noise=0.0, housing=False):
    """A ring at the world's origin and a sphere that comes along x."""
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    sphere = builder.AddSystem(MovingSphere(scene_graph))
    builder.Connect(
        sphere.GetOutputPort("pose"),
        scene_graph.get_source_pose_port(sphere.source_id),
    )
    excluded = []
    if housing:
        box = GeometryInstance(RigidTransform(), Box(0.2, 0.2, 0.2), "housing")
        box.set_perception_properties(PerceptionProperties())
        excluded.append(
            scene_graph.RegisterGeometry(
                sphere.source_id, scene_graph.world_frame_id(), box
            )
        )
    caster = RayCaster(scene_graph.model_inspector())
    bundles = mut.make_ring_bundles(
        config=config,
        caster=caster,
        mounts=[
            make_mount("base", scene_graph.world_frame_id(), excluded=excluded)
        ],
    )
    ring = builder.AddNamedSystem(
        "ring",
        mut.TofRings(
            config=config,
            caster=caster,
            bundles=bundles,
            constants=constants,
            phase=phase,
            noise_scans=np.size(noise),
            name=("base",),
        ),
    )
    builder.Connect(
        scene_graph.get_query_output_port(), ring.GetInputPort("geometry_query")
    )
    if noise is not None:
        source = builder.AddSystem(
            ConstantVectorSource(np.repeat(noise, 8 * NOISE_DRAWS))
        )
        builder.Connect(source.get_output_port(), ring.GetInputPort("noise"))
    builder.ExportOutput(ring.GetOutputPort("scan_base"), "scan")
    return builder.Build()


def make_ideal(**settings):
    return Vl53l1x(ideal=True, readout_time=0.005, **settings)


class Counter(LeafSystem):
    """A frame that moves by 0.1 mm along x at each of its steps."""

    def __init__(self, scene_graph, period):
        super().__init__()
        self.source_id = scene_graph.RegisterSource("counter")
        self.frame_id = scene_graph.RegisterFrame(
            self.source_id, GeometryFrame("counter")
        )
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self.update)
        self.DeclareAbstractOutputPort(
            "pose",
            Value(FramePoseVector()).Clone,
            self.calc_pose,
            prerequisites_of_calc={self.xd_ticket()},
        )

    def update(self, context, discrete_state):
        count = context.get_discrete_state_vector()[0]
        discrete_state.set_value([count + 1.0])

    def calc_pose(self, context, output):
        poses = FramePoseVector()
        x = 1e-4 * context.get_discrete_state_vector()[0]
        poses.set_value(self.frame_id, RigidTransform([x, 0.0, 0.0]))
        output.set_value(poses)


class XCaster:
    """A caster whose one ray is as long as its frame's x."""

    def __init__(self, frame_id=None):
        self.frame_id = frame_id

    def poses_from_query_object(self, query_object):
        return query_object.GetPoseInWorld(self.frame_id).GetAsMatrix34()

    def cast_bundles(self, bundles, X_WF):
        return X_WF[:1, 3:4].copy(), None


class TestConfig(unittest.TestCase):
    def test_defaults(self):
        dut = Vl53l1x()
        dut.check("rings")
        self.assertAlmostEqual(dut.period, 0.024)
        self.assertAlmostEqual(dut.latency, 0.015)

    def test_loads_and_checks(self):
        dut = yaml_load_typed(
            schema=Vl53l1x,
            data="{fov_deg: 15, timing_budget: 0.033}",
        )
        self.assertAlmostEqual(dut.period, 0.037)
        for name, bad in (
            ("fov_deg", 0.0),
            ("rays_per_sensor", 0),
            ("period_overhead", -0.1),
            ("readout_time", np.inf),
        ):
            with self.assertRaisesRegex(UserError, f"here.{name}: .*use"):
                Vl53l1x(**{name: bad}).check("here")
        dut.dropout = 2.0
        with self.assertRaisesRegex(UserError, r"here\.dropout"):
            dut.check("here")


class TestTofRings(unittest.TestCase):
    def run_until(self, diagram, times):
        simulator = Simulator(diagram)
        port = diagram.GetOutputPort("scan")
        scans = []
        for time in times:
            simulator.AdvanceTo(time)
            scans.append(port.Eval(simulator.get_context()))
        return scans

    def test_nothing_before_the_first_delivery(self):
        scans = self.run_until(
            make_cell(make_ideal(), noise=None), [0.0, 0.0389, 0.0391]
        )
        self.assertEqual([s.sequence for s in scans], [-1, -1, 0])
        self.assertIsInstance(scans[0], RingScan)

    def test_scan_shows_what_was_there_at_its_own_time(self):
        for phase in (0.0, 0.008):
            scans = self.run_until(
                make_cell(make_ideal(), phase=phase, noise=None),
                np.arange(1, 100) * 0.005 + 1e-4,
            )
            seen = {s.sequence: s for s in scans if s.sequence >= 0}
            self.assertEqual(list(seen), list(range(len(seen))))
            for sequence, scan in seen.items():
                # The first without a phase comes after one period.
                time = (phase or 0.024) + 0.024 * sequence
                np.testing.assert_allclose(
                    scan.sensor_time, time, rtol=0, atol=2e-9
                )
                self.assertAlmostEqual(scan.time, time + 0.015, delta=2e-9)
                self.assertAlmostEqual(
                    scan.distance[0], 1.0 - SPEED * time, delta=2e-9
                )
                self.assertEqual(scan.status[0], 0)
                self.assertTrue((scan.status[1:] == 2).all())

    def test_latency_may_exceed_the_period(self):
        config = make_ideal()
        config.readout_time = 0.060
        step = 0.004
        times = np.arange(1, 100) * step + 1e-4
        scans = self.run_until(make_cell(config, noise=None), times)
        for time, scan in zip(times, scans, strict=True):
            # The newest that was taken a latency ago.
            taken = int(np.floor((time - 0.070) / 0.024))
            self.assertEqual(scan.sequence, max(taken, 0) - 1)
            if scan.sequence >= 0:
                self.assertAlmostEqual(scan.sensor_time[0], 0.024 * taken)

    def test_capture_and_delivery_at_the_same_time(self):
        for readout, behind in ((0.014, 1), (0.038, 2)):
            config = make_ideal()
            config.readout_time = readout
            scans = self.run_until(
                make_cell(config, noise=None), 0.024 * np.arange(5, 15) + 1e-4
            )
            self.assertEqual(
                [s.sequence for s in scans],
                list(range(4 - behind, 14 - behind)),
            )

    def test_sample_at_a_plant_step_shows_the_world_before_it(self):
        """Rounding must not decide: 0.008 + 6 * 0.024 > 19 * 0.008."""
        builder = DiagramBuilder()
        scene_graph = builder.AddSystem(SceneGraph())
        counter = builder.AddSystem(Counter(scene_graph, 0.008))
        builder.Connect(
            counter.get_output_port(),
            scene_graph.get_source_pose_port(counter.source_id),
        )
        sampler = builder.AddSystem(
            mut.TofRings(
                config=make_ideal(),
                caster=XCaster(counter.frame_id),
                bundles=SimpleNamespace(num_bundles=1),
                phase=0.008,
                name=("base",),
            )
        )
        builder.Connect(
            scene_graph.get_query_output_port(),
            sampler.GetInputPort("geometry_query"),
        )
        builder.ExportOutput(sampler.GetOutputPort("scan_base"), "scan")
        for i, scan in enumerate(
            self.run_until(builder.Build(), 0.030 + 0.024 * np.arange(100))
        ):
            self.assertEqual(scan.sequence, i)
            # Steps at 0, 0.008, ..: the one at the sample's time is not yet.
            self.assertAlmostEqual(scan.distance[0], 1e-4 * (1 + 3 * i))

    def test_starting_late_delivers_nothing_early(self):
        config = make_ideal()
        config.readout_time = 0.060
        diagram = make_cell(config, noise=None)
        simulator = Simulator(diagram)
        simulator.get_mutable_context().SetTime(0.1)
        simulator.Initialize()
        port = diagram.GetOutputPort("scan")
        for time in np.arange(0.101, 0.4, 0.003):
            simulator.AdvanceTo(time)
            scan = port.Eval(simulator.get_context())
            if scan.sequence >= 0:
                self.assertGreaterEqual(
                    time - scan.sensor_time[0], 0.070 - 1e-6
                )
                self.assertLess(time - scan.sensor_time[0], 0.094 + 0.003)
        self.assertGreater(scan.sequence, 5)

    def test_does_not_see_its_own_housing(self):
        scan = self.run_until(
            make_cell(make_ideal(), noise=None, housing=True), [0.04]
        )[0]
        self.assertAlmostEqual(scan.distance[0], 0.988)
        self.assertTrue((scan.status[1:] == 2).all())

    def test_several_rings_are_as_each_alone(self):
        """Sensor by sensor, with noise and errors, on moving links."""
        config = Vl53l1x()
        n = 8
        rng = np.random.default_rng(1)
        noise = rng.standard_normal((3 * n, NOISE_DRAWS))
        constants = rng.standard_normal((3 * n, CONSTANT_DRAWS))
        builder = DiagramBuilder()
        scene_graph = builder.AddSystem(SceneGraph())
        sphere = builder.AddSystem(MovingSphere(scene_graph))
        builder.Connect(
            sphere.GetOutputPort("pose"),
            scene_graph.get_source_pose_port(sphere.source_id),
        )
        world_frame_id = scene_graph.world_frame_id()
        wall = GeometryInstance(
            RigidTransform([0.0, 0.7, 0.0]), Box(4.0, 0.1, 4.0), "wall"
        )
        wall.set_perception_properties(PerceptionProperties())
        scene_graph.RegisterGeometry(sphere.source_id, world_frame_id, wall)
        inspector = scene_graph.model_inspector()
        caster = RayCaster(inspector)
        mounts = [
            make_mount("base", world_frame_id),
            make_mount(
                "elbow",
                sphere.frame_id,
                excluded=inspector.GetGeometries(sphere.frame_id),
            ),
            make_mount(
                "tool",
                world_frame_id,
                X_FS=[
                    RigidTransform([0.5, -0.4, 0.0]) @ X for X in make_X_WS()
                ],
            ),
        ]

        def add(name, members, sensors):
            rings = builder.AddSystem(
                mut.TofRings(
                    config=config,
                    caster=caster,
                    bundles=mut.make_ring_bundles(
                        config=config, caster=caster, mounts=members
                    ),
                    constants=constants[sensors],
                    phase=0.008,
                    name=tuple(mount.name for mount in members),
                )
            )
            source = builder.AddSystem(
                ConstantVectorSource(noise[sensors].ravel())
            )
            builder.Connect(
                source.get_output_port(), rings.GetInputPort("noise")
            )
            builder.Connect(
                scene_graph.get_query_output_port(),
                rings.GetInputPort("geometry_query"),
            )
            self.assertEqual(rings.num_sensors, n * len(members))
            for mount in members:
                builder.ExportOutput(
                    rings.GetOutputPort(f"scan_{mount.name}"),
                    f"{name}_{mount.name}",
                )

        add("all", mounts, slice(0, 3 * n))
        for i, mount in enumerate(mounts):
            add("one", [mount], slice(n * i, n * i + n))
        diagram = builder.Build()
        simulator = Simulator(diagram)
        seen = np.zeros((3, n), dtype=bool)
        for k in range(20):
            simulator.AdvanceTo(0.030 + 0.024 * k)
            for i, mount in enumerate(mounts):
                together, alone = (
                    diagram.GetOutputPort(f"{name}_{mount.name}").Eval(
                        simulator.get_context()
                    )
                    for name in ("all", "one")
                )
                self.assertEqual(together.sequence, k)
                self.assertEqual(alone.sequence, k)
                self.assertEqual(together.time, alone.time)
                for field in ("sensor_time", "distance", "status"):
                    np.testing.assert_array_equal(
                        getattr(together, field), getattr(alone, field)
                    )
                    self.assertEqual(getattr(together, field).shape, (n,))
                seen[i] |= alone.status == 0
        # Every ring saw something, and not the same.
        self.assertTrue(seen.any(axis=1).all())
        self.assertFalse((seen[0] == seen[1]).all())
        self.assertFalse((seen[0] == seen[2]).all())

    def test_ports(self):
        dut = mut.TofRings(
            name=RINGS,
            config=make_ideal(),
            caster=XCaster(),
            bundles=SimpleNamespace(num_bundles=24),
        )
        self.assertEqual(
            [
                dut.get_input_port(i).get_name()
                for i in range(dut.num_input_ports())
            ],
            ["geometry_query", "noise"],
        )
        self.assertEqual(
            [
                dut.get_output_port(i).get_name()
                for i in range(dut.num_output_ports())
            ],
            ["scan_base", "scan_elbow", "scan_tool"],
        )
        # Ideal sensors need none.
        self.assertEqual(dut.GetInputPort("noise").size(), 0)

    def test_rejects_rays_that_do_not_suit_the_rings(self):
        for num_bundles in (0, 8, 2):
            with self.assertRaisesRegex(
                ValueError, f"{num_bundles} for 3 rings"
            ):
                mut.TofRings(
                    name=RINGS,
                    config=make_ideal(),
                    caster=XCaster(),
                    bundles=SimpleNamespace(num_bundles=num_bundles),
                )

    def test_real_sensors_use_noise_and_errors(self):
        config = Vl53l1x()
        constants = np.tile([0.01 / config.bias_sigma, 0.0], (8, 1))
        scan = self.run_until(
            make_cell(config, constants=constants, noise=0.0), [0.04]
        )[0]
        self.assertAlmostEqual(scan.distance[0], 0.998)
        noisy = self.run_until(
            make_cell(config, constants=constants, noise=1.0), [0.04]
        )[0]
        self.assertAlmostEqual(noisy.distance[0], 1.000, delta=1e-9)

    def test_scans_take_their_noise_in_turn(self):
        scans = self.run_until(
            make_cell(Vl53l1x(), noise=[0.0, 1.0, 0.5]),
            0.024 * np.arange(2, 9),
        )
        still = self.run_until(
            make_cell(Vl53l1x(), noise=0.0), 0.024 * np.arange(2, 9)
        )
        np.testing.assert_allclose(
            [
                (a.distance[0] - b.distance[0]) * 1000.0
                for a, b in zip(scans, still, strict=True)
            ],
            [0.0, 2.0, 1.0, 0.0, 2.0, 1.0, 0.0],
            atol=1e-9,
        )

    def test_noise_is_for_one_scan_at_least(self):
        with self.assertRaisesRegex(ValueError, "noise_scans"):
            make_cell(Vl53l1x(), noise=[])

    def test_noise_must_be_connected_unless_ideal(self):
        with self.assertRaisesRegex(RuntimeError, "noise"):
            self.run_until(make_cell(Vl53l1x(), noise=None), [0.04])

    def test_rejects_errors_of_another_ring(self):
        with self.assertRaisesRegex(ValueError, "8 sensors"):
            make_cell(
                make_ideal(),
                constants=np.zeros((16, CONSTANT_DRAWS)),
            )

    def test_rejects_bad_phase(self):
        with self.assertRaisesRegex(UserError, "phase"):
            make_cell(make_ideal(), phase=-0.1)

    def test_scan_is_state(self):
        diagram = make_cell(make_ideal(), noise=None)
        ring = diagram.GetSubsystemByName("ring")
        self.assertFalse(ring.HasAnyDirectFeedthrough())


if __name__ == "__main__":
    unittest.main()
