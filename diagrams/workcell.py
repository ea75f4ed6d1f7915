"""Station and monitor in a closed loop, and the record."""

import dataclasses as dc
import math

from pydrake.common import RandomGenerator
from pydrake.geometry import (
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
)
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.run_metadata import make_run_metadata
from tofssm_drake.diagrams.scenario import Scenario, get_links
from tofssm_drake.diagrams.station import Station, make_station
from tofssm_drake.messages import RINGS
from tofssm_drake.metrics.ground_truth import TruthModel
from tofssm_drake.perception.lidar_mount import make_lidar_kinematics
from tofssm_drake.recording.recorder import SampleRecorder
from tofssm_drake.sensors.vl53l1x import calc_cast_range
from tofssm_drake.visualization.recording import FPS, set_scene
from tofssm_drake.visualization.ring_rays import RingRays
from tofssm_drake.visualization.state_light import StateLight


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Workcell:
    """The closed loop and the parts of it that a run reads."""

    diagram: Diagram
    station: Station
    recorder: SampleRecorder | None
    """None: no samples are kept."""

    def make_context(self, random_seed: int) -> Context:
        """Returns a Context whose random sources start from a seed."""
        context = self.diagram.CreateDefaultContext()
        self.diagram.SetRandomContext(context, RandomGenerator(random_seed))
        return context


def make_workcell(
    scenario: Scenario,
    *,
    station: Station | None = None,
    meshcat: Meshcat | None = None,
    with_samples: bool = True,
) -> Workcell:
    """Makes the closed loop of a scenario.

    Args:
        scenario: Checked settings.
        station: Of the same scenario; None makes a simulated one.
        meshcat: Where to show the cell; None shows nothing.
        with_samples: Keep samples for a report; they grow with the run.

    Returns:
        The Diagram, ready for a Simulator, and its parts.
    """
    builder = DiagramBuilder()
    if station is None:
        station = make_station(scenario)
    builder.AddSystem(station.diagram)
    avatar = station.avatar
    monitor = builder.AddSystem(
        make_monitor(
            scenario,
            person_radii=[] if avatar is None else avatar.radii,
        )
    )
    for i in range(monitor.num_input_ports()):
        port = monitor.get_input_port(i)
        builder.Connect(station.diagram.GetOutputPort(port.get_name()), port)
    for i in range(station.diagram.num_input_ports()):
        port = station.diagram.get_input_port(i)
        builder.Connect(monitor.GetOutputPort(port.get_name()), port)
    recorder = None
    if with_samples:
        recorder = _add_recorder(builder, scenario, station, monitor)
    if meshcat is not None:
        _add_display(builder, scenario, station, monitor, meshcat)
    diagram = builder.Build()
    diagram.set_name("workcell")
    return Workcell(diagram=diagram, station=station, recorder=recorder)


def _add_recorder(builder, scenario, station, monitor):
    avatar = station.avatar
    truth = _make_truth(scenario, station)
    has_rings = scenario.sensing == "tof"
    recorder = builder.AddNamedSystem(
        "recorder",
        SampleRecorder(
            truth=truth,
            motion=None if avatar is None else avatar.motion,
            period=scenario.control_period,
            rings=get_links(scenario),
            num_sensors=scenario.sensors_per_ring if has_rings else 0,
            metadata=make_run_metadata(scenario, station, truth.body_names),
        ),
    )
    for port, name in (
        ("position", "position_measured"),
        ("velocity", "velocity_measured"),
        ("products_placed", "products_placed"),
    ):
        builder.Connect(
            station.diagram.GetOutputPort(name), recorder.GetInputPort(port)
        )
    for name in (
        "speed_fraction",
        "ring_states",
        "reason",
        "separation",
        "dsi",
        *(f"masked_scan_{ring}" for ring in RINGS if has_rings),
    ):
        builder.Connect(
            monitor.GetOutputPort(name), recorder.GetInputPort(name)
        )
    return recorder


def _make_truth(scenario, station):
    """Makes the truth of the links that the sensing watches."""
    options = {}
    if scenario.sensing == "lidar":
        config = scenario.lidar_separation
        options = {
            "kinematics": make_lidar_kinematics(
                scenario.lidar, ArmKinematics.from_plant(station.plant)
            ),
            # What the distance rule subtracts, so that the two are comparable.
            "link_offset": config.workspace_radius - config.threshold_offset,
        }
    return TruthModel(
        plant=station.plant,
        inspector=station.scene_graph.model_inspector(),
        radii=[] if station.avatar is None else station.avatar.radii,
        **options,
    )


def _add_display(builder, scenario, station, monitor, meshcat):
    """Shows robot, cell, person, beams and state."""
    set_scene(meshcat)
    period = 1.0 / FPS
    MeshcatVisualizer.AddToBuilder(
        builder,
        station.diagram.GetOutputPort("geometry_query"),
        meshcat,
        MeshcatVisualizerParams(role=Role.kIllustration, publish_period=period),
    )
    light = builder.AddNamedSystem(
        "state_light", StateLight(meshcat=meshcat, period=period)
    )
    builder.Connect(
        monitor.GetOutputPort("robot_state"), light.GetInputPort("robot_state")
    )
    if scenario.sensing != "tof":
        return
    rays = builder.AddNamedSystem(
        "ring_rays",
        RingRays(
            meshcat=meshcat,
            plant=station.plant,
            fov=math.radians(scenario.rings.fov_deg),
            max_range=calc_cast_range(scenario.rings.sensor),
            sensors_per_ring=scenario.sensors_per_ring,
            period=period,
        ),
    )
    builder.Connect(
        station.diagram.GetOutputPort("position_measured"),
        rays.GetInputPort("position"),
    )
    for name in RINGS:
        port = f"masked_scan_{name}"
        builder.Connect(monitor.GetOutputPort(port), rays.GetInputPort(port))
