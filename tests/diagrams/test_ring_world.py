import unittest

from paper_cell import RINGS, change_rings
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from tofssm_drake.diagrams.ring_world import make_ring_world
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station


class TestRingWorld(unittest.TestCase):
    def test_sees_what_the_stations_rings_see(self):
        """Of the same report of a robot, bit by bit."""
        scenario = load_scenario(text=change_rings("{sensor: {ideal: true}}"))
        builder = DiagramBuilder()
        station = builder.AddSystem(make_station(scenario).diagram)
        world = builder.AddSystem(make_ring_world(scenario))
        speed = builder.AddSystem(ConstantVectorSource([1.0]))
        builder.Connect(
            speed.get_output_port(), station.GetInputPort("speed_fraction")
        )
        for name in ("position_measured", "carried_objects"):
            builder.Connect(
                station.GetOutputPort(name), world.GetInputPort(name)
            )
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(1.5)
        context = simulator.get_context()
        seen = 0
        for ring in RINGS:
            expected, dut = (
                system.GetOutputPort(f"scan_{ring}").Eval(
                    system.GetMyContextFromRoot(context)
                )
                for system in (station, world)
            )
            self.assertGreater(dut.sequence, 50)
            self.assertEqual(dut.sequence, expected.sequence)
            for name in ("distance", "status", "sensor_time"):
                self.assertEqual(
                    getattr(dut, name).tobytes(),
                    getattr(expected, name).tobytes(),
                )
            seen += (dut.status == 0).sum()
        self.assertGreater(seen, 0)


if __name__ == "__main__":
    unittest.main()
