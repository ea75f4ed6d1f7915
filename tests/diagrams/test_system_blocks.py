"""Every documented system block equals the ports of the real system."""

import importlib
import inspect
import pkgutil
import re
import unittest

import numpy as np
from paper_cell import RINGS, find_kinematics, make_rings
from pydrake.geometry import Meshcat, MeshcatParams, SceneGraph
from pydrake.systems.framework import Diagram, LeafSystem
from robot_room import make_path
import yaml

import tofssm_drake
import tofssm_drake.arms.sim_arm as sim_arm
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.diagrams.hardware_station import make_hardware_station
from tofssm_drake.diagrams.held_connections import HeldRobot
from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.ring_world import make_ring_world
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.diagrams.viewer_process import make_viewer
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.laws.sensing_problem import SensingProblem
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.metrics.ground_truth import GroundTruth, TruthModel
from tofssm_drake.people.moving_box import MovingBox, MovingBoxSystem
from tofssm_drake.people.skeleton import PELVIS
from tofssm_drake.perception.fusion import SeparationFusion
from tofssm_drake.perception.ideal_separation import (
    IdealSeparation,
    IdealSeparationConfig,
)
from tofssm_drake.perception.lidar_separation import (
    LidarSeparation,
    LidarSeparationConfig,
)
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.raycast.ray_caster_sensor import RayCasterSensor
from tofssm_drake.ringlink.ring_link import NullRingLink
from tofssm_drake.ringlink.ring_receiver import RingDecoder, RingLinkConfig
from tofssm_drake.ringlink.ring_systems import (
    RingInterfaceSystem,
    RingSubscriberSystem,
)
from tofssm_drake.robots.robot_connection import NullConnection
import tofssm_drake.rtde.rtde_systems as rtde_systems
from tofssm_drake.sensors.lidar_2d import (
    Lidar2d,
    Lidar2dConfig,
    make_lidar_bundle,
)
from tofssm_drake.visualization.frames import FrameReader, FrameSender

_MARKER = ".. pydrake_system::"


def read_block(docstring):
    """Returns the system block of a docstring as plain values."""
    lines = inspect.cleandoc(docstring).splitlines()
    start = lines.index(_MARKER) + 1
    block = []
    for line in lines[start:]:
        if line and not line.startswith(" "):
            break
        block.append(line)
    return yaml.safe_load("\n".join(block))


def get_ports(system):
    return {
        "input_ports": [
            system.get_input_port(i).get_name()
            for i in range(system.num_input_ports())
        ],
        "output_ports": [
            system.get_output_port(i).get_name()
            for i in range(system.num_output_ports())
        ],
    }


def make_pattern(names):
    """Returns a regex of ports; `scan_<ring>` stands for one of each ring."""
    parts = []
    for name in names:
        beginning, placeholder, _ = name.partition("<")
        one = re.escape(beginning) + (r"\w+" if placeholder else "")
        parts.append(f"{one}( {one})*" if placeholder else one)
    return f"^{' '.join(parts)}$"


def find_systems(diagram):
    for system in diagram.GetSystems():
        yield system
        if isinstance(system, Diagram):
            yield from find_systems(system)


def find_public_leaf_systems():
    for module in pkgutil.walk_packages(tofssm_drake.__path__, "tofssm_drake."):
        loaded = importlib.import_module(module.name)
        for name, value in vars(loaded).items():
            if (
                inspect.isclass(value)
                and issubclass(value, LeafSystem)
                and value.__module__ == module.name
                and not name.startswith("_")
            ):
                yield value


class TestSystemBlocks(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario()
        cls.meshcat = Meshcat(MeshcatParams(host="localhost"))
        cls.workcell = make_workcell(cls.scenario, meshcat=cls.meshcat)

    def check(self, system, docstring):
        block = read_block(docstring)
        self.assertLessEqual(
            set(block), {"name", "input_ports", "output_ports"}
        )
        ports = get_ports(system)
        for key, names in ports.items():
            self.assertRegex(
                " ".join(names), make_pattern(block.get(key, [])), block["name"]
            )

    def make_systems_beside_the_loop(self):
        """Public systems that the workcell does not use."""
        station = self.workcell.station
        model = TruthModel(
            plant=station.plant,
            inspector=station.scene_graph.model_inspector(),
            radii=station.people.radii,
            pelvis=PELVIS,
            kinematics=find_kinematics(station.plant),
        )
        lidar_config = Lidar2dConfig()
        caster = RayCaster(station.scene_graph.model_inspector())
        bundle = make_lidar_bundle(config=lidar_config, caster=caster)
        lidar = Lidar2d(config=lidar_config, caster=caster, bundle=bundle)
        kinematics = find_kinematics(station.plant)
        ideal_separation = IdealSeparation(
            name=RINGS,
            config=IdealSeparationConfig(),
            kinematics=kinematics,
            radii=station.people.radii,
        )
        lidar_separation = LidarSeparation(
            config=LidarSeparationConfig(),
            kinematics=kinematics,
            background=np.full(720, np.inf),
        )
        connection = NullConnection()
        interface = RingInterfaceSystem(
            connection=NullRingLink(
                decoder=RingDecoder(config=RingLinkConfig(), rings=make_rings())
            )
        )
        return [
            GroundTruth(model=model),
            lidar,
            RayCasterSensor(caster=caster, bundles=bundle),
            ideal_separation,
            lidar_separation,
            rtde_systems.RtdeInterfaceSystem(connection=connection),
            rtde_systems.RtdeSubscriberSystem(connection=connection),
            rtde_systems.RtdePublisherSystem(connection=connection),
            rtde_systems.RobotReportReceiver(path=make_path()),
            rtde_systems.SliderControl(),
            SensingProblem(deadline=0.1),
            SeparationFusion([("one",), ("two",)], name=("one", "two")),
            MovingBoxSystem(
                scene_graph=SceneGraph(),
                config=MovingBox(waypoints=[[0.0, 0.0]]),
                name="box",
            ),
            interface,
            RingSubscriberSystem(name=RINGS, connection=interface.connection),
            FrameSender(send=print, num_joints=6, num_objects=0, rings=RINGS),
            FrameReader(num_joints=6, num_objects=0, rings=RINGS),
        ]

    def test_every_public_system(self):
        seen = set()
        for system in (
            *find_systems(self.workcell.diagram),
            *self.make_systems_beside_the_loop(),
        ):
            if type(system).__module__.startswith("tofssm_drake."):
                with self.subTest(system=type(system).__name__):
                    self.check(system, type(system).__doc__)
                seen.add(type(system))
        missing = {s.__name__ for s in find_public_leaf_systems()} - {
            s.__name__ for s in seen
        }
        self.assertEqual(missing, set())

    def test_every_made_diagram(self):
        robot, _ = sim_arm.make_sim_arm(
            config=self.scenario.driver,
            arm=UrArm(),
            initial_position=[0.0] * 6,
        )
        controller = robot.GetSubsystemByName("inverse_dynamics_controller")
        for make, diagram in (
            (make_station, self.workcell.station.diagram),
            (
                make_hardware_station,
                make_hardware_station(self.scenario, robot=HeldRobot()).diagram,
            ),
            (make_monitor, make_monitor(self.scenario)),
            (
                TriSsm.make,
                TriSsm().make(
                    links=("tool",), offset=np.zeros(1), period=0.008
                ),
            ),
            (make_ring_world, make_ring_world(self.scenario)),
            (make_viewer, make_viewer(self.scenario, self.meshcat)),
            (sim_arm.make_sim_arm, robot),
            (sim_arm.make_inverse_dynamics_controller, controller),
        ):
            with self.subTest(make=make.__name__):
                self.check(diagram, make.__doc__)
                self.assertEqual(
                    read_block(make.__doc__)["name"], diagram.get_name()
                )
