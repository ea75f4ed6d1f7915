import dataclasses as dc
import unittest

from robots import make_panda

from tofssm_drake.diagrams.hardware_station import make_hardware_station
from tofssm_drake.diagrams.held_connections import HeldRings, HeldRobot
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.errors import UserError


def describe_ports(diagram):
    """Returns (name, type, size) of all inputs, then of all outputs."""
    inputs = [
        diagram.get_input_port(i) for i in range(diagram.num_input_ports())
    ]
    outputs = [
        diagram.get_output_port(i) for i in range(diagram.num_output_ports())
    ]
    return [
        [(p.get_name(), p.get_data_type(), p.size()) for p in ports]
        for ports in (inputs, outputs)
    ]


# Rings of two kinds, and a product that is moved along waypoints.
_OTHER_CELL = """
people: {visitor: null}
sensors:
  base: null
  elbow: null
  tool: null
  fore: !Ring {parent: "ur10::forearm_link", radius: 0.08, count: 6}
  wrist: !Ring {parent: "ur10::wrist_1_link", radius: 0.08, count: 8}
task: !Waypoints
  objects: [{point: [-0.1, -0.82, 0.7275]}]
  waypoints:
  - {point: [-0.1, -0.82, 0.7275], gripper: close}
  - {point: [0.1, -0.82, 0.7275], gripper: open}
"""


class TestHardwareStation(unittest.TestCase):
    def test_ports_are_those_of_the_simulated_station(self):
        for text in ("", _OTHER_CELL):
            with self.subTest(text=text):
                self.check_ports(load_scenario(text=text))

    def check_ports(self, scenario):
        simulated = describe_ports(make_station(scenario).diagram)
        virtual = make_hardware_station(scenario, robot=HeldRobot())
        self.assertEqual(describe_ports(virtual.diagram), simulated)
        # A real person is unknown.
        nobody = dc.replace(scenario, people={})
        simulated = describe_ports(make_station(nobody).diagram)
        real = make_hardware_station(
            scenario,
            robot=HeldRobot(),
            rings=HeldRings(tuple(scenario.sensors)),
        )
        self.assertEqual(describe_ports(real.diagram), simulated)

    def test_the_driver_does_not_change_them(self):
        simulated, real = (
            load_scenario(text=f"{{driver: {driver}}}")
            for driver in ("!Simulated {}", "!Rtde {gripper_output: 3}")
        )
        self.assertEqual(
            describe_ports(make_station(simulated).diagram),
            describe_ports(
                make_hardware_station(real, robot=HeldRobot()).diagram
            ),
        )

    def test_a_real_robot_is_not_simulated(self):
        scenario = load_scenario(text="{driver: !Rtde {}}")
        with self.assertRaisesRegex(UserError, "^driver: .* tofssm hardware"):
            make_station(scenario)

    def test_an_arm_of_seven_joints(self):
        scenario = load_scenario()
        scenario.robot = make_panda()
        scenario.sensors = {}
        with self.assertRaisesRegex(UserError, "arms of 6 joints.* has 7"):
            make_hardware_station(scenario, robot=HeldRobot())
