"""Station and monitor in a loop, with truth and record beside them."""

import dataclasses as dc

from pydrake.common import RandomGenerator
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.run_metadata import make_run_metadata
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.station import Station, make_station
from tofssm_drake.evaluation.ground_truth import GroundTruth
from tofssm_drake.evaluation.recorder import SampleRecorder
from tofssm_drake.messages import RINGS


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Workcell:
    """The closed loop and the parts of it that a run asks."""

    diagram: Diagram
    station: Station
    recorder: SampleRecorder

    def make_context(self, random_seed: int) -> Context:
        """Returns a Context whose random sources start from a seed."""
        context = self.diagram.CreateDefaultContext()
        self.diagram.SetRandomContext(context, RandomGenerator(random_seed))
        return context


def make_workcell(
    scenario: Scenario, *, meshcat: Meshcat | None = None
) -> Workcell:
    """Makes the closed loop of a scenario.

    Args:
        scenario: Checked settings.
        meshcat: Where to show the cell; None shows nothing.

    Returns:
        The Diagram, ready for a Simulator, and its parts.
    """
    builder = DiagramBuilder()
    station = make_station(scenario)
    builder.AddSystem(station.diagram)
    monitor = builder.AddSystem(make_monitor(scenario))
    for i in range(monitor.num_input_ports()):
        port = monitor.get_input_port(i)
        builder.Connect(station.diagram.GetOutputPort(port.get_name()), port)
    builder.Connect(
        monitor.GetOutputPort("speed_fraction"),
        station.diagram.GetInputPort("speed_fraction"),
    )
    truth = _add_ground_truth(builder, station)
    recorder = _add_recorder(builder, scenario, station, monitor, truth)
    if meshcat is not None:
        _add_display(builder, scenario, station, monitor, meshcat)
    diagram = builder.Build()
    diagram.set_name("workcell")
    return Workcell(diagram=diagram, station=station, recorder=recorder)


def _add_ground_truth(builder, station):
    avatar = station.avatar
    truth = builder.AddNamedSystem(
        "ground_truth",
        GroundTruth(
            plant=station.plant,
            inspector=station.scene_graph.model_inspector(),
            radii=[] if avatar is None else avatar.radii,
        ),
    )
    for port, name in (
        ("position", "position_measured"),
        ("velocity", "velocity_measured"),
        ("skeleton", "skeleton"),
    ):
        builder.Connect(
            station.diagram.GetOutputPort(name), truth.GetInputPort(port)
        )
    return truth


def _add_recorder(builder, scenario, station, monitor, truth):
    recorder = builder.AddNamedSystem(
        "recorder",
        SampleRecorder(
            period=scenario.control_period,
            num_sensors=scenario.sensors_per_ring,
            metadata=make_run_metadata(scenario, station, truth.body_names),
        ),
    )
    for port, source in (
        ("position", station.diagram.GetOutputPort("position_measured")),
        ("velocity", station.diagram.GetOutputPort("velocity_measured")),
        ("products_placed", station.diagram.GetOutputPort("products_placed")),
        ("truth", truth.GetOutputPort("truth")),
    ):
        builder.Connect(source, recorder.GetInputPort(port))
    for name in (
        "speed_fraction",
        "robot_state",
        "ring_states",
        "reason",
        "separation",
        "dsi",
        *(f"masked_scan_{ring}" for ring in RINGS),
    ):
        builder.Connect(
            monitor.GetOutputPort(name), recorder.GetInputPort(name)
        )
    return recorder


def _add_display(builder, scenario, station, monitor, meshcat):
    MeshcatVisualizer.AddToBuilder(
        builder, station.diagram.GetOutputPort("geometry_query"), meshcat
    )
