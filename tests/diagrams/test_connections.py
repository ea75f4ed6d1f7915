"""Station and monitor: their ports, and which signals reach which system."""

import unittest

import numpy as np
from paper_cell import RINGS
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.framework import Diagram

from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.diagrams.workcell import make_workcell

# What real hardware could give a monitor, and nothing else.
_REPORT = {
    "position_measured": 6,
    "velocity_measured": 6,
    "carried_objects": 10,
}
_SCANS = {f"scan_{ring}" for ring in RINGS}


def get_inputs(system):
    ports = map(system.get_input_port, range(system.num_input_ports()))
    return {port.get_name(): port for port in ports}


def get_outputs(system):
    ports = map(system.get_output_port, range(system.num_output_ports()))
    return {port.get_name(): port for port in ports}


def find_connections(diagram):
    """Returns (from system, its port, to system, its port) by names."""
    return {
        (
            source.get_name(),
            source.get_output_port(j).get_name(),
            sink.get_name(),
            sink.get_input_port(i).get_name(),
        )
        for (sink, i), (source, j) in diagram.connection_map().items()
    }


def find_reached(connections, start):
    """Returns the names of all systems reached by a signal of `start`."""
    reached, waiting = set(), [start]
    while waiting:
        system = waiting.pop()
        for source, _, sink, _ in connections:
            if source == system and sink not in reached:
                reached.add(sink)
                waiting.append(sink)
    return reached


class TestPorts(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario()
        cls.station = make_station(cls.scenario).diagram
        cls.monitor = make_monitor(cls.scenario)

    def test_station(self):
        self.assertEqual(
            set(get_inputs(self.station)), {"speed_fraction", "separation"}
        )
        self.assertEqual(
            set(get_outputs(self.station)),
            {
                *_SCANS,
                *_REPORT,
                *("products_placed", "task_done"),
                *("geometry_query", "skeleton"),
            },
        )

    def test_monitor(self):
        self.assertEqual(set(get_inputs(self.monitor)), {*_SCANS, *_REPORT})
        self.assertEqual(
            set(get_outputs(self.monitor)),
            {
                *("speed_fraction", "decision"),
                *("separation", "self_hit_health"),
                *(f"masked_scan_{ring}" for ring in RINGS),
            },
        )

    def test_sizes_fit(self):
        for name, size in _REPORT.items():
            with self.subTest(port=name):
                self.assertEqual(get_outputs(self.station)[name].size(), size)
                self.assertEqual(get_inputs(self.monitor)[name].size(), size)
        self.assertEqual(get_outputs(self.monitor)["speed_fraction"].size(), 1)

    def test_ports_do_not_depend_on_the_scenario(self):
        for name in ("NoHuman", "SixteenSensors", "IdealSensors"):
            with self.subTest(scenario=name):
                scenario = load_scenario(name=name)
                for made, expected in (
                    (make_station(scenario).diagram, self.station),
                    (make_monitor(scenario), self.monitor),
                ):
                    self.assertEqual(
                        list(get_inputs(made)), list(get_inputs(expected))
                    )
                    self.assertEqual(
                        list(get_outputs(made)), list(get_outputs(expected))
                    )

    def test_neither_has_feedthrough(self):
        # So that they can be connected in a loop, or over a network.
        self.assertFalse(self.monitor.HasAnyDirectFeedthrough())
        self.assertFalse(self.station.HasAnyDirectFeedthrough())


class TestConnections(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.workcell = make_workcell(
            load_scenario(), meshcat=Meshcat(MeshcatParams(host="localhost"))
        )
        cls.connections = find_connections(cls.workcell.diagram)

    def find_sources(self, system):
        return {
            sink_port: (source, port)
            for source, port, sink, sink_port in self.connections
            if sink == system
        }

    def test_monitor_gets_what_hardware_could_give_and_nothing_else(self):
        self.assertEqual(
            self.find_sources("monitor"),
            {name: ("station", name) for name in {*_SCANS, *_REPORT}},
        )

    def test_station_gets_speed_fraction_and_separation_only(self):
        names = ("speed_fraction", "separation")
        self.assertEqual(
            self.find_sources("station"),
            {name: ("monitor", name) for name in names},
        )

    def test_simulated_station_ignores_the_separation(self):
        connections = find_connections(self.workcell.station.diagram)
        self.assertEqual(find_reached(connections, "ignored_separation"), set())

    def test_observers_feed_nothing_back(self):
        systems = {s.get_name() for s in self.workcell.diagram.GetSystems()}
        observers = systems - {"station", "monitor"}
        self.assertIn("recorder", observers)
        self.assertGreaterEqual(len(observers), 4)
        for observer in observers:
            with self.subTest(observer=observer):
                reached = find_reached(self.connections, observer)
                self.assertFalse(reached & {"station", "monitor"})
        # The search finds a path if there is one.
        self.assertIn("monitor", find_reached(self.connections, "station"))
        self.assertIn("station", find_reached(self.connections, "station"))

    def test_truth_is_not_in_what_the_station_reports(self):
        """In the station the person reaches the rings but no report."""
        station = self.workcell.station.diagram
        connections = find_connections(station)
        reached = find_reached(connections, "visitor")
        self.assertEqual(
            reached,
            {"scene_graph", "rings_" + "_".join(RINGS)},
        )

    def test_monitor_has_a_model_of_its_own(self):
        def find_leaves(diagram):
            for system in diagram.GetSystems():
                if isinstance(system, Diagram):
                    yield from find_leaves(system)
                else:
                    yield system

        monitor = self.workcell.diagram.GetSubsystemByName("monitor")
        kinds = {type(system).__name__ for system in find_leaves(monitor)}
        self.assertEqual(
            kinds,
            {
                *("Multiplexer", "OcclusionMask", "TofSeparation", "DsiFilter"),
                *("TriSsmState", "TriSsmDecision", "SpeedFractionTrajectory"),
                *("SelfHitWatch", "SelfHitStop"),
            },
        )

    def test_all_inputs_that_are_read_are_connected(self):
        sinks = {(sink, port) for _, _, sink, port in self.connections}
        for name in ("station", "monitor", "recorder"):
            system = self.workcell.diagram.GetSubsystemByName(name)
            for port in get_inputs(system):
                with self.subTest(system=name, port=port):
                    self.assertIn((name, port), sinks)

    def test_seed_decides_the_noise(self):
        def draw(seed):
            context = self.workcell.make_context(seed)
            station = self.workcell.station.diagram
            noise = station.GetSubsystemByName("noise_" + "_".join(RINGS))
            return noise.get_output_port().Eval(
                noise.GetMyContextFromRoot(context)
            )

        np.testing.assert_array_equal(draw(3), draw(3))
        self.assertFalse((draw(3) == draw(4)).any())
