"""The self-hit watch in the default task, with each fault in the world."""

import functools
import math
import unittest

import numpy as np
from paper_cell import RINGS, make_twin_plant
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from tofssm_drake.carried_objects import ON_TOOL
from tofssm_drake.diagrams.monitor import (
    make_twin,
    tell_self_hit_coverage,
)
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.sensors.rings import (
    group_rings,
    make_group_self_hits,
)
from tofssm_drake.messages import (
    MaskedScan,
    Reading,
    RingHealth,
    RingScan,
    SelfHitHealth,
    SensorFault,
    make_empty_separation,
)
from tofssm_drake.people.avatar import HumanAvatar
from tofssm_drake.people.motion import capsule_ends
from tofssm_drake.people.skeleton import calc_capsule_poses
from tofssm_drake.people.walk import GeneratedWalk, make_walk
from tofssm_drake.perception.self_hit_coverage import tell_coverage
import tofssm_drake.perception.self_hit_watch as mut
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.range_sensor import draw_constants
from tofssm_drake.sensors.ring_mount import find_ring_mount
from tofssm_drake.sensors.vl53l1x import (
    NOISE_DRAWS,
    Vl53l1x,
    make_sensor_errors,
    measure,
)
from tofssm_drake.tasks.program import find_products, make_program_path

# Between two looks, s.
PERIOD = 0.072
SENSORS = 24


class World:
    """The true cell, with a person if wanted."""

    def __init__(self, human=False):
        scene_graph = SceneGraph()
        plant = make_twin_plant(scene_graph=scene_graph)
        self.motion = None
        human_frames = []
        if human:
            self.motion = make_walk(GeneratedWalk(), 0.008)
            avatar = HumanAvatar(scene_graph=scene_graph, motion=self.motion)
            human_frames = avatar.frame_ids
        inspector = scene_graph.model_inspector()
        self.caster = RayCaster(inspector)
        self.mounts = [find_ring_mount(plant, inspector, n) for n in RINGS]
        row = {f: i for i, f in enumerate(self.caster.frame_ids)}
        self.human_rows = [row[f] for f in human_frames]
        others = [f for f in row if f not in set(human_frames)]
        self.twin_rows = [row[f] for f in others]
        scenario = load_scenario()
        self.poses = TwinPoses.from_plant(
            plant,
            objects=find_products(scenario.task),
            frame_ids=others,
        )

    def make_bundles(self, turn=0.0, shift=0.0):
        """Returns the rays of rings turned by some rad and moved by some m."""
        config = Vl53l1x()
        return self.caster.make_bundles(
            frame_id=[m.frame_id for m in self.mounts for _ in m.X_FS],
            X_FS=[
                X
                for mount in self.mounts
                for X in mut.move_mount(mount, turn, shift)
            ],
            fan_S=make_cone_fan(
                math.radians(config.fov_deg), config.rays_per_sensor
            ),
            max_range=config.traits.cast_range,
            excluded=[m.geometry_ids for m in self.mounts for _ in m.X_FS],
        )

    def cast(self, bundles, q, carried, time):
        X_WF = np.empty((len(self.caster.frame_ids), 3, 4))
        X_WF[self.twin_rows] = self.poses.calc(q, carried)
        if self.motion is not None:
            ends = capsule_ends(self.motion, time)
            person = np.empty((len(ends), 3, 4))
            calc_capsule_poses(ends, person)
            X_WF[self.human_rows] = person
        return self.caster.cast_bundles(bundles, X_WF)[0]


@functools.cache
def make_world(human=False):
    return World(human)


@functools.cache
def make_model_and_path():
    """Returns the monitor's model, and the task."""
    scenario = load_scenario()
    twin = make_twin(DiagramBuilder(), scenario)
    (group,) = group_rings(scenario.sensors)
    return (
        make_group_self_hits(twin, group),
        make_program_path(scenario.task, twin.kinematics),
    )


def keep(distance, status):
    """A device without a fault."""
    return distance, status


def number(order):
    """A device with wrongly numbered sensors."""
    return lambda distance, status: (distance[order], status[order])


def blind(*sensors):
    """A device with some sensors that see nothing."""

    def change(distance, status):
        status = status.copy()
        status[list(sensors)] = 2
        return distance, status

    return change


def tape(sensor, distance):
    """A device with something stuck in front of one sensor."""

    def change(distances, status):
        distances, status = distances.copy(), status.copy()
        distances[sensor] = distance
        status[sensor] = 0
        return distances, status

    return change


def watch(
    *,
    duration,
    device=keep,
    ring=None,
    turn=0.0,
    shift=0.0,
    delay=0.0,
    offset=0.0,
    human=False,
    seed=0,
    start=0.0,
):
    """Runs the task at full speed until there is an alarm.

    Returns:
        When that was, s, and the health; None and the state without one.
    """
    world = make_world(human)
    model, path = make_model_and_path()
    state = mut.view_state(model, mut.make_state_vector(model))
    config = Vl53l1x()
    constants = [
        draw_constants(config.traits, sensors=8, seed=seed, ring=i)
        for i in range(3)
    ]
    errors = make_sensor_errors(config, np.concatenate(constants))
    generator = np.random.default_rng(seed)
    straight = world.make_bundles()
    moved = world.make_bundles(turn, shift)
    for look in range(int(duration / PERIOD)):
        time = start + look * PERIOD
        s = time % path.duration
        carried = path.calc_carried_objects(s)
        q, _, _ = path.calc_motion(s)
        rays = world.cast(straight, q, carried, time)
        if ring is not None:
            rows = slice(8 * ring, 8 * ring + 8)
            rays[rows] = world.cast(moved, q, carried, time)[rows]
        distance, status = device(
            *measure(
                config,
                ray_distance=rays,
                noise=generator.standard_normal((SENSORS, NOISE_DRAWS)),
                errors=errors,
            )
        )
        reported, qd, _ = path.calc_motion(max(s - delay, 0.0))
        reported[0] += offset
        state.sequence[:] = look
        mut.count_look(
            model,
            state,
            mut.Look(
                rings=(0, 1, 2),
                which=np.ones(SENSORS, dtype=bool),
                sampled=np.ones(SENSORS, dtype=bool),
                time=np.full(SENSORS, time),
                distance=distance,
                status=status,
                q=reported,
                qd=qd,
                spread=0.0,
                carried=carried,
            ),
        )
        if (
            state.sensor_alarm.any()
            or state.misfit_alarm.any()
            or state.ride_alarm.any()
        ):
            return look * PERIOD, mut.tell_health(model, state)
    return None, state


def swap(a, b):
    order = np.arange(SENSORS).reshape(3, 8)
    order[[a, b]] = order[[b, a]]
    return number(order.ravel())


def renumber(ring, order):
    result = np.arange(SENSORS)
    result[8 * ring : 8 * ring + 8] = 8 * ring + np.asarray(order)
    return number(result)


class TestFaults(unittest.TestCase):
    def check_found(self, within, at, words, **fault):
        time, health = watch(duration=within, **fault)
        self.assertIsNotNone(time, f"{fault}: not found in {within} s")
        self.assertRegex(health.problem[at], words, fault)

    def test_turned_rings(self):
        for ring in range(3):
            for degrees in (-45, -20, 20, 45):
                # The tool's ring sees the forearm nearly as well if it is
                # turned by -20 deg.
                within = 13.2 if (ring, degrees) == (2, -20) else 3.0
                self.check_found(
                    within,
                    ring,
                    "misplaced: .* turned by|unseen self-hit",
                    ring=ring,
                    turn=math.radians(degrees),
                )

    def test_rings_turned_by_5_deg(self):
        for ring in range(3):
            for degrees in (-5, 5):
                self.check_found(
                    40.0,
                    ring,
                    f"turned by {degrees} deg|unseen",
                    ring=ring,
                    turn=math.radians(degrees),
                )

    def test_numbered_otherwise(self):
        for ring in range(3):
            for order in (np.arange(8)[::-1], np.roll(np.arange(8), 1)):
                self.check_found(
                    2.0,
                    ring,
                    "misplaced|unseen",
                    device=renumber(ring, order),
                )

    def test_swapped(self):
        for a, b in ((0, 1), (0, 2), (1, 2)):
            time, health = watch(duration=6.6, device=swap(a, b))
            self.assertIsNotNone(time)
            self.assertRegex(
                " ".join(health.problem),
                f"misplaced: {RINGS[a]} and {RINGS[b]} rings fit if swapped"
                "|unseen",
            )

    def test_longer_tool(self):
        self.check_found(
            13.2, 2, "misplaced: tool .* 50 mm farther out", ring=2, shift=0.05
        )

    def test_joints(self):
        for fault, words in (
            ({"delay": 0.05}, "joints 50 ms late"),
            ({"offset": 0.1}, "-0.1 rad on joint 1"),
            ({"offset": -0.1}, "\\+0.1 rad on joint 1"),
        ):
            # All rings say so.
            for ring in range(3):
                self.check_found(
                    13.2,
                    ring,
                    f"robot model or joints do not fit: fits with {words}",
                    **fault,
                )

    def test_sees_nothing(self):
        for ring, sensors in (
            (0, [2]),
            (1, [10]),
            (2, [18]),
            (1, [9]),
            (0, range(8)),
            (1, range(8, 16)),
            (2, range(16, 24)),
        ):
            time, health = watch(duration=6.6, device=blind(*sensors))
            self.assertIsNotNone(time)
            # And not for misplaced.
            self.assertRegex(
                health.problem[ring],
                f"^unseen self-hit: {RINGS[ring]} sensor [0-9, ]+$",
            )
            self.assertIn(SensorFault.UNSEEN_SELF_HIT, health.fault[ring])
            others = [i for i in range(3) if i != ring]
            self.assertTrue((health.fault[others] == 0).all())

    def test_hit_that_rides_with_the_robot(self):
        # Those never see the robot. Near the base a metre takes longer.
        for sensor, within in ((0, 8.0), (12, 4.0), (19, 3.0), (23, 3.0)):
            time, health = watch(duration=within, device=tape(sensor, 0.9))
            self.assertIsNotNone(time, f"sensor {sensor}")
            ring, i = divmod(sensor, 8)
            self.assertEqual(
                health.problem[ring],
                f"{RINGS[ring]} sensor {i}: a hit at 0.90 m rides with the "
                "robot",
            )
            self.assertEqual(health.fault[ring, i], SensorFault.RIDING_HIT)
            self.assertEqual(np.count_nonzero(health.fault), 1)


class TestNoFault(unittest.TestCase):
    def test_robot_alone(self):
        for seed in range(3):
            time, state = watch(duration=70.0, seed=seed, start=7.0 * seed)
            self.assertIsNone(time)
            self.assertLess(state.misfit_sum.max(), 8.0)

    def test_person_does_not_count(self):
        """The robot goes through the person at full speed, again and again."""
        time, _ = watch(duration=140.0, human=True, seed=1)
        self.assertIsNone(time)

    def test_person_does_not_ride(self):
        """Nor does a short stretch of it come close."""
        time, state = watch(duration=7.2, human=True, seed=1, start=11.0)
        self.assertIsNone(time)
        self.assertLess(state.ride_travel.max(), 0.8)


class TestCoverage(unittest.TestCase):
    def test_default_scenario_shows_each_ring_something(self):
        lines = tell_self_hit_coverage(load_scenario())
        self.assertFalse([line for line in lines if "cannot" in line])
        # Single sensors see neither robot nor cell.
        self.assertEqual(len(lines), 3)
        self.assertRegex(lines[2], "^tool ring: self-hits verify 1 of 8 ")

    def test_ring_that_sees_nothing_is_named(self):
        model, _ = make_model_and_path()
        share = np.ones((3, 8))
        self.assertEqual(tell_coverage(model, share), [])
        share[1] = 0.01
        self.assertEqual(
            tell_coverage(model, share),
            ["elbow ring cannot be verified by self-hits"],
        )

    def test_other_sensings_have_nothing_to_report(self):
        scenario = load_scenario(name="PlanarLidar")
        self.assertEqual(tell_self_hit_coverage(scenario), [])


class TestLooks(unittest.TestCase):
    def make(self, times, position=0.0):
        times = np.array(times, dtype=float)
        n = len(times)
        scan = RingScan(
            sequence=1,
            time=2.0,
            sensor_time=times,
            distance=np.full(n, 0.5),
            status=np.zeros(n, dtype=np.uint8),
        )
        return MaskedScan(
            scan=scan,
            raw=scan,
            reading=np.full(n, Reading.VALID, dtype=np.uint8),
            position=np.full((n, 6), position) + times[:, None],
            velocity=np.ones((n, 6)),
        )

    def look(self, *masked_scans, counted=None, carried=(0.0, 0.0), dead=()):
        total = sum(len(scan.reading) for scan in masked_scans)
        is_dead = np.zeros(total, dtype=bool)
        is_dead[list(dead)] = True
        if counted is None:
            counted = np.full(total, -np.inf)
        return mut.make_looks(
            masked_scans, np.asarray(counted), np.array(carried), is_dead
        )

    def test_rings_that_sample_together_are_one_look(self):
        looks = self.look(
            self.make([1.0, 1.0]),
            self.make([1.0, 1.0]),
            self.make([1.1, 1.1]),
            carried=(1.0, ON_TOOL, 0.0),
        )
        self.assertEqual([look.rings for look in looks], [(0, 1), (2,)])
        self.assertEqual(looks[0].status.tolist(), [0, 0, 0, 0, 254, 254])
        np.testing.assert_allclose(looks[1].q, 1.1)
        self.assertEqual(looks[0].carried.tolist(), [1.0, ON_TOOL, 0.0])

    def test_samples_of_another_time_are_another_look(self):
        """A ring may fire its sensors in turns."""
        first, second = self.look(self.make([1.012, 1.002, 1.0, -np.inf]))
        self.assertEqual(first.status.tolist(), [254, 0, 0, 254])
        self.assertAlmostEqual(first.spread, 0.001)
        np.testing.assert_allclose(first.q, 1.001)
        self.assertEqual(second.status.tolist(), [0, 254, 254, 254])
        self.assertEqual(second.which.tolist(), [True] * 4)

    def test_each_sample_counts_once_and_none_of_the_dead(self):
        scan = self.make([1.0, 1.0, 1.0])
        (look,) = self.look(scan, counted=[1.0, 0.9, -np.inf], dead=[2])
        self.assertEqual(look.sampled.tolist(), [False, True, False])
        self.assertEqual(self.look(scan, counted=[1.0, 1.0, 1.0]), [])

    def test_no_sample_no_look(self):
        self.assertEqual(self.look(self.make([-np.inf, -np.inf])), [])
        self.assertEqual(self.look(MaskedScan(), MaskedScan()), [])


class Ride:
    """The watch of a turning robot; only tool sensor 6 sees something."""

    def __init__(self):
        model, path = make_model_and_path()
        self.dut = mut.SelfHitWatch(model=model, period=PERIOD)
        self.simulator = Simulator(self.dut)
        self.context = self.simulator.get_mutable_context()
        self.q = path.calc_motion(0.0)[0]
        self.sequence = 0

    def health(self):
        port = self.dut.GetOutputPort("self_hit_health")
        return port.Eval(self.context)

    def look(self, distance, status=0):
        time = self.context.get_time()
        self.q = self.q.copy()
        self.q[0] += 0.1 if self.sequence % 20 < 10 else -0.1
        self.dut.GetInputPort("robot_report").FixValue(
            self.context, np.concatenate([self.q, np.zeros(16)])
        )
        for name in RINGS:
            # The others have no sample.
            statuses = np.full(8, 254, dtype=np.uint8)
            if name == "tool":
                statuses[6] = status
            scan = RingScan(
                sequence=self.sequence,
                time=time,
                sensor_time=np.full(8, time),
                distance=np.full(8, distance),
                status=statuses,
            )
            masked = MaskedScan(
                scan=scan,
                raw=scan,
                position=np.tile(self.q, (8, 1)),
                velocity=np.zeros((8, 6)),
            )
            self.dut.GetInputPort(f"masked_scan_{name}").FixValue(
                self.context, Value(masked)
            )
        self.sequence += 1
        self.simulator.AdvanceTo(self.sequence * PERIOD)


class TestSystems(unittest.TestCase):
    def test_ring_that_sees_nothing_is_reported(self):
        model, path = make_model_and_path()
        q = path.calc_motion(0.0)[0]
        dut = mut.SelfHitWatch(model=model, period=PERIOD)
        simulator = Simulator(dut)
        context = simulator.get_mutable_context()
        dut.GetInputPort("robot_report").FixValue(
            context, np.concatenate([q, np.zeros(16)])
        )
        port = dut.GetOutputPort("self_hit_health")
        self.assertEqual(port.Eval(context).problem, ("", "", ""))
        for sequence in range(100):
            time = context.get_time()
            scan = RingScan(
                sequence=sequence,
                time=time,
                sensor_time=np.full(8, time),
                distance=np.zeros(8),
                status=np.full(8, 2, dtype=np.uint8),
            )
            masked = MaskedScan(
                scan=scan,
                raw=scan,
                position=np.tile(q, (8, 1)),
                velocity=np.zeros((8, 6)),
            )
            for name in RINGS:
                dut.GetInputPort(f"masked_scan_{name}").FixValue(
                    context, Value(masked)
                )
            simulator.AdvanceTo((sequence + 1) * PERIOD)
        health = port.Eval(context)
        for name, line in zip(RINGS, health.problem, strict=True):
            self.assertRegex(line, f"unseen self-hit: {name} sensor")
        # The very same message until something changes.
        self.assertIs(port.Eval(context), health)

    def test_hit_that_rides_is_reported_until_it_ends(self):
        rig = Ride()
        # 0.1 rad per look: about 5 cm of the tool's path.
        looks = 0
        while not rig.health().problem[2] and looks < 40:
            rig.look(0.9)
            looks += 1
        self.assertEqual(
            rig.health().problem,
            ("", "", "tool sensor 6: a hit at 0.90 m rides with the robot"),
        )
        # Neither a failed sample nor a lost one ends it. An empty room does.
        for status in (5, 2):
            rig.look(0.0, status=status)
            self.assertNotEqual(rig.health().problem[2], "")
        rig.look(0.0, status=2)
        self.assertEqual(rig.health().problem, ("", "", ""))

    def test_link_is_faulted(self):
        dut = mut.SelfHitStop(RINGS)
        context = dut.CreateDefaultContext()
        separation = make_empty_separation(RINGS)
        healthy = np.full(3, RingHealth.HEALTHY)
        separation = mut.dc.replace(separation, health=healthy)
        dut.GetInputPort("separation").FixValue(context, Value(separation))
        for problem, wanted in (
            (("", "", ""), [0, 0, 0]),
            (("", "misplaced: ...", ""), [0, 2, 0]),
        ):
            dut.GetInputPort("self_hit_health").FixValue(
                context,
                Value(
                    SelfHitHealth(
                        name=RINGS,
                        fault=np.zeros((3, 8), dtype=np.uint8),
                        problem=problem,
                    )
                ),
            )
            result = dut.GetOutputPort("separation").Eval(context)
            self.assertEqual(result.health.tolist(), wanted)


if __name__ == "__main__":
    unittest.main()
