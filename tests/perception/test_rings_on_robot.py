"""The rings on the UR10 in its cell: ring, mask and separation together."""

import functools
import unittest

import numpy as np
from paper_cell import RINGS, find_kinematics, make_twin_plant
from pydrake.geometry import (
    GeometryInstance,
    PerceptionProperties,
    Role,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from tofssm_drake.errors import UserError
from tofssm_drake.messages import Reading, RingHealth
from tofssm_drake.perception.occlusion_mask import (
    OcclusionMask,
    OcclusionMaskConfig,
    make_mask_bundles,
)
from tofssm_drake.perception.readings import (
    calc_ring_health,
    calc_self_interval,
    classify_readings,
)
from tofssm_drake.perception.separation import (
    SeparationConfig,
    TofSeparation,
    make_ring_geometry,
)
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.range_sensor import draw_constants
import tofssm_drake.sensors.ring_mount as mut
from tofssm_drake.sensors.tof_rings import (
    TofRings,
    make_ring_bundles,
)
from tofssm_drake.sensors.vl53l1x import (
    NOISE_DRAWS,
    Vl53l1x,
    make_sensor_errors,
    measure,
)
from tofssm_drake.tasks.products import calc_object_positions
from tofssm_drake.tasks.program import PickAndPlace, make_program_path


class Twin:
    """The monitor's copy of robot and cell."""

    def __init__(self, sensors_per_ring=8):
        scene_graph = SceneGraph()
        self.plant = make_twin_plant(scene_graph, count=sensors_per_ring)
        inspector = scene_graph.model_inspector()
        self.caster = RayCaster(inspector)
        self.mounts = [
            mut.find_ring_mount(self.plant, inspector, ring) for ring in RINGS
        ]
        self.kinematics = find_kinematics(self.plant)
        config = PickAndPlace()
        self.path = make_program_path(config, self.kinematics)
        self.bundles = make_mask_bundles(
            config=OcclusionMaskConfig(),
            sensor=Vl53l1x().traits,
            caster=self.caster,
            mounts=self.mounts,
        )
        self.poses = TwinPoses.from_plant(
            self.plant,
            objects=self.path.objects,
            frame_ids=self.caster.frame_ids,
        )

    def calc_self_distance(self, time):
        """Returns what all rings' sensors see, (rings, 8, k)."""
        q = self.path.calc_motion(time)[0]
        X_WF = self.poses.calc(q, self.path.calc_carried_objects(time))
        distance, _ = self.caster.cast_bundles(self.bundles, X_WF)
        return distance.reshape(len(RINGS), 8, -1)


@functools.cache
def make_twin():
    return Twin()


class TestRingMount(unittest.TestCase):
    def test_reads_the_models(self):
        for n in (8, 16):
            scene_graph = SceneGraph()
            plant = make_twin_plant(scene_graph, count=n)
            for ring, link in zip(
                RINGS,
                ("upper_arm_link", "forearm_link", "wrist_3_link"),
                strict=True,
            ):
                dut = mut.find_ring_mount(
                    plant, scene_graph.model_inspector(), ring
                )
                self.assertEqual(len(dut.X_FS), n)
                geometry = make_ring_geometry(dut.X_LS)
                self.assertTrue(0.05 < geometry.radius < 0.09)
                body = plant.GetBodyFromFrameId(dut.frame_id)
                self.assertEqual(body.name(), link)
                self.assertEqual(
                    set(dut.geometry_ids),
                    set(
                        scene_graph.model_inspector().GetGeometries(
                            dut.frame_id, Role.kPerception
                        )
                    ),
                )
                self.assertGreater(len(dut.geometry_ids), 0)

    def test_says_what_is_missing(self):
        twin = make_twin()
        scene_graph = SceneGraph()
        plant = MultibodyPlant(0.0)
        plant.RegisterAsSourceForSceneGraph(scene_graph)
        plant.Finalize()
        with self.assertRaisesRegex(UserError, "'knee'.*knee_ring_0"):
            mut.find_ring_mount(plant, scene_graph.model_inspector(), "knee")
        self.assertEqual(len(twin.mounts), 3)


class TestReadingsOfTheRobotItself(unittest.TestCase):
    def test_robot_alone_is_never_valid_and_rings_stay_healthy(self):
        """Over the whole task, with noise and any sensors."""
        twin = make_twin()
        config = Vl53l1x()
        mask = OcclusionMaskConfig()
        seen = 0
        for seed, time in enumerate(np.linspace(0.0, twin.path.duration, 200)):
            for ring, rays in enumerate(twin.calc_self_distance(time)):
                generator = np.random.default_rng(seed)
                distance, status = measure(
                    config,
                    ray_distance=rays,
                    noise=generator.standard_normal((8, NOISE_DRAWS)),
                    errors=make_sensor_errors(
                        config,
                        draw_constants(
                            config.traits, sensors=8, seed=seed, ring=ring
                        ),
                    ),
                )
                nearest, farthest = calc_self_interval(rays)
                reading, fault, _ = classify_readings(
                    distance,
                    status,
                    np.zeros(8),
                    nearest,
                    farthest,
                    config.traits.tolerance,
                    config.traits.min_range,
                    config.traits.max_range,
                    mask.calc_max_age(config.traits),
                )
                self.assertNotIn(Reading.VALID, reading)
                self.assertEqual(
                    calc_ring_health(reading, fault, np.zeros(8), 0.3),
                    RingHealth.HEALTHY,
                )
                seen += (reading == Reading.MASKED).sum()
        # The robot does see itself and its cell, or this would test nothing.
        self.assertGreater(seen, 300)


class Robot(LeafSystem):
    """Follows the program's path; the world shows what it does."""

    def __init__(self, twin, start):
        super().__init__()
        self.twin = twin
        self.start = start
        self.everything = self.DeclareVectorOutputPort(
            "everything", 98, self.calc, {self.time_ticket()}
        )
        for name, part in (
            ("robot_report", slice(0, 22)),
            ("positions", slice(22, 98)),
        ):
            self.DeclareVectorOutputPort(
                name,
                part.stop - part.start,
                functools.partial(self.calc_part, part=part),
                {self.time_ticket()},
            )

    def calc(self, context, output):
        twin = self.twin
        time = self.start + context.get_time()
        q, qd, _ = twin.path.calc_motion(time)
        carried = twin.path.calc_carried_objects(time)
        products = calc_object_positions(
            objects=twin.path.objects,
            kinematics=twin.kinematics,
            q=q,
            carried=carried,
        )
        output.SetFromVector(
            np.concatenate(
                [
                    q,
                    qd,
                    carried,
                    *(q, products.ravel()),
                ]
            )
        )

    def calc_part(self, context, output, part):
        output.SetFromVector(self.everything.Eval(context)[part])


class Noise(LeafSystem):
    """Standard normal draws that are a function of time."""

    def __init__(self, size, seed):
        super().__init__()
        self.size = size
        self.seed = seed
        self.DeclareVectorOutputPort(
            "noise", size, self.calc, {self.time_ticket()}
        )

    def calc(self, context, output):
        tick = round(context.get_time() / 1e-3)
        draws = np.random.default_rng([self.seed, tick])
        output.SetFromVector(draws.standard_normal(self.size))


def make_diagram(*, start, phases, mask_config, person=None, seed=0):
    """Rings, masks and separation on a robot that follows its path."""
    twin = make_twin()
    config = Vl53l1x()
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    plant = make_twin_plant(scene_graph)
    if person is not None:
        geometry = GeometryInstance(
            RigidTransform(person), Sphere(0.1), "person"
        )
        geometry.set_perception_properties(PerceptionProperties())
        scene_graph.RegisterGeometry(
            scene_graph.RegisterSource("person"),
            scene_graph.world_frame_id(),
            geometry,
        )
    robot = builder.AddSystem(Robot(twin, start))
    pose = builder.AddSystem(MultibodyPositionToGeometryPose(plant))
    builder.Connect(robot.GetOutputPort("positions"), pose.get_input_port())
    builder.Connect(
        pose.get_output_port(),
        scene_graph.get_source_pose_port(plant.get_source_id()),
    )
    caster = RayCaster(scene_graph.model_inspector())
    separation = builder.AddSystem(
        TofSeparation(
            name=RINGS,
            config=SeparationConfig(),
            kinematics=twin.kinematics,
            geometries=[make_ring_geometry(m.X_LS) for m in twin.mounts],
        )
    )
    mask = builder.AddSystem(
        OcclusionMask(
            name=RINGS,
            config=mask_config,
            sensor=config.traits,
            caster=twin.caster,
            bundles=twin.bundles,
            twin=twin.poses,
        )
    )
    builder.Connect(
        robot.GetOutputPort("robot_report"), mask.GetInputPort("robot_report")
    )
    for phase in sorted(set(phases)):
        index = [i for i, p in enumerate(phases) if p == phase]
        names = tuple(RINGS[i] for i in index)
        rings = builder.AddSystem(
            TofRings(
                config=config,
                caster=caster,
                bundles=make_ring_bundles(
                    config=config,
                    caster=caster,
                    mounts=[
                        mut.find_ring_mount(
                            plant, scene_graph.model_inspector(), ring
                        )
                        for ring in names
                    ],
                ),
                constants=np.concatenate(
                    [
                        draw_constants(
                            config.traits, sensors=8, seed=seed, ring=i
                        )
                        for i in index
                    ]
                ),
                phase=phase,
                name=names,
            )
        )
        builder.Connect(
            scene_graph.get_query_output_port(),
            rings.GetInputPort("geometry_query"),
        )
        noise = builder.AddSystem(
            Noise(rings.GetInputPort("noise").size(), seed + index[0])
        )
        builder.Connect(noise.get_output_port(), rings.GetInputPort("noise"))
        for ring in names:
            builder.Connect(
                rings.GetOutputPort(f"scan_{ring}"),
                mask.GetInputPort(f"scan_{ring}"),
            )
            builder.Connect(
                mask.GetOutputPort(f"masked_scan_{ring}"),
                separation.GetInputPort(f"masked_scan_{ring}"),
            )
    builder.ExportOutput(separation.GetOutputPort("separation"), "separation")
    return builder.Build()


def run(diagram, duration):
    simulator = Simulator(diagram)
    port = diagram.GetOutputPort("separation")
    separations = []
    for time in np.arange(0.05, duration, 0.008) + 1e-4:
        simulator.AdvanceTo(time)
        separations.append(port.Eval(simulator.get_context()))
    return separations


class TestTogether(unittest.TestCase):
    def find_fast_part(self):
        """Returns when the robot sweeps with a product in its gripper."""
        twin = make_twin()
        times = np.arange(0.0, 7.0, 0.02)
        speed = [
            abs(twin.path.calc_motion(t)[1][0])
            * twin.path.calc_gripper_closed(t)
            for t in times
        ]
        return times[int(np.argmax(speed))] - 0.4

    def test_moving_robot_alone_sees_nobody(self):
        # Phases off the control tick, so that joints are interpolated; rings
        # that sample together.
        for phases in (
            (0.0, 0.008, 0.016),
            (0.003, 0.011, 0.019),
            (0.003, 0.003, 0.003),
        ):
            diagram = make_diagram(
                start=self.find_fast_part(),
                phases=phases,
                mask_config=OcclusionMaskConfig(),
            )
            separations = run(diagram, 0.9)
            for separation in separations:
                self.assertTrue((separation.distance == np.inf).all())
                self.assertTrue((separation.health == RingHealth.HEALTHY).all())
            self.assertGreater(
                sum(s.count[:, Reading.MASKED].sum() for s in separations), 0
            )
            self.assertGreater(max(s.link_speed.max() for s in separations), 1)
            self.assertGreater(separations[-1].sequence.min(), 30)

    def test_without_the_mask_the_robot_sees_itself(self):
        diagram = make_diagram(
            start=self.find_fast_part(),
            phases=(0.0, 0.008, 0.016),
            mask_config=OcclusionMaskConfig(enabled=False),
        )
        nearest = min(s.distance.min() for s in run(diagram, 0.4))
        self.assertLess(nearest, 1.0)

    def test_someone_in_the_way_is_seen_and_comes_nearer(self):
        twin = make_twin()
        start = self.find_fast_part()
        q, qd, _ = twin.path.calc_motion(start + 0.3)
        p_WL, _, v_WL = twin.kinematics.calc(q, qd)
        ahead = v_WL[1] / np.linalg.norm(v_WL[1])
        person = p_WL[1] + 0.6 * ahead
        diagram = make_diagram(
            start=start,
            phases=(0.0, 0.008, 0.016),
            mask_config=OcclusionMaskConfig(),
            person=person,
        )
        elbow = [
            (s.distance[1], s.k_o[1], s.k_l[1], s.direction[1])
            for s in run(diagram, 0.3)
            if np.isfinite(s.distance[1])
        ]
        self.assertGreater(len(elbow), 5)
        distance, k_o, k_l, direction = elbow[-1]
        self.assertLess(distance, 0.7)
        self.assertGreater(k_l, 0.3)
        # The person stands still: what closes is the robot's own motion.
        self.assertAlmostEqual(k_o, k_l, delta=0.5)
        self.assertGreater(direction @ ahead, 0.8)


if __name__ == "__main__":
    unittest.main()
