import unittest

from paper_cell import RINGS

from tofssm_drake.diagrams.hardware_station import make_hardware_station
from tofssm_drake.diagrams.held_connections import HeldRings, HeldRobot
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station


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


class TestHardwareStation(unittest.TestCase):
    def test_ports_are_those_of_the_simulated_station(self):
        scenario = load_scenario()
        simulated = describe_ports(make_station(scenario).diagram)
        virtual = make_hardware_station(scenario, robot=HeldRobot())
        inputs, outputs = describe_ports(virtual.diagram)
        self.assertEqual(inputs[:-1], simulated[0])
        self.assertEqual(inputs[-1][0], "separation")
        self.assertEqual(outputs, simulated[1])
        # A real person is unknown.
        nobody = load_scenario(text="{people: {visitor: null}}")
        simulated = describe_ports(make_station(nobody).diagram)
        real = make_hardware_station(
            scenario, robot=HeldRobot(), rings=HeldRings(RINGS)
        )
        inputs, outputs = describe_ports(real.diagram)
        self.assertEqual(inputs[:-1], simulated[0])
        self.assertEqual(inputs[-1][0], "separation")
        self.assertEqual(outputs, simulated[1])
