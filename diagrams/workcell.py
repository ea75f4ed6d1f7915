"""Station and monitor in a closed loop, and the record."""

from collections.abc import Callable
import dataclasses as dc

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.run_metadata import make_run_metadata
from tofssm_drake.diagrams.scenario import (
    Scenario,
    find_lidars,
    find_links,
)
from tofssm_drake.diagrams.sensors import find_link_frames
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.diagrams.station import Station, make_station
from tofssm_drake.metrics.ground_truth import TruthModel
from tofssm_drake.people.skeleton import PELVIS
from tofssm_drake.recording.recorder import SampleRecorder


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
    prebuild: Callable[[DiagramBuilder, Diagram, Diagram], None] | None = None,
) -> Workcell:
    """Makes the closed loop of a scenario.

    .. pydrake_system::

        name: workcell
        output_ports:
        - speed_fraction
        - decision
        - separation
        - position_measured
        - velocity_measured

    Args:
        scenario: Checked settings.
        station: Of the same scenario; None makes a simulated one.
        meshcat: Where to show the cell; None shows nothing. It listens to
            every program of this machine and can end the process: a viewer
            in a process of its own (`diagrams/viewer.py`) cannot.
        with_samples: Keep samples for a report; they grow with the run.
        prebuild: Called with the builder, the station and the monitor before
            the Diagram is built, to add systems of one's own.

    Returns:
        The Diagram, ready for a Simulator, and its parts.
    """
    builder = DiagramBuilder()
    if station is None:
        station = make_station(scenario)
    builder.AddSystem(station.diagram)
    monitor = builder.AddSystem(
        make_monitor(
            scenario,
            person_radii=station.people.radii,
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
        # Only here: what draws takes long to import.
        import tofssm_drake.diagrams.display as display

        display.add_display(
            builder,
            scenario,
            station.plant,
            display.find_display_ports(scenario, station.diagram, monitor),
            meshcat,
        )
    for name in ("speed_fraction", "decision", "separation"):
        builder.ExportOutput(monitor.GetOutputPort(name), name)
    for name in ("position_measured", "velocity_measured"):
        builder.ExportOutput(station.diagram.GetOutputPort(name), name)
    if prebuild is not None:
        prebuild(builder, station.diagram, monitor)
    diagram = builder.Build()
    diagram.set_name("workcell")
    return Workcell(diagram=diagram, station=station, recorder=recorder)


def _add_recorder(builder, scenario, station, monitor):
    truth = _make_truth(scenario, station)
    rings = find_rings(scenario.sensors)
    recorder = builder.AddNamedSystem(
        "recorder",
        SampleRecorder(
            truth=truth,
            motions=station.people.motions,
            period=scenario.control_period,
            rings=find_links(scenario),
            signals=tuple(scenario.law.traits.signals),
            num_sensors={n: ring.num_sensors for n, ring in rings.items()},
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
        "decision",
        "separation",
        *(f"masked_scan_{ring}" for ring in rings),
    ):
        builder.Connect(
            monitor.GetOutputPort(name), recorder.GetInputPort(name)
        )
    return recorder


def _make_truth(scenario, station):
    """Makes the truth of the links that the sensors watch."""
    frames = find_link_frames(scenario.sensors)
    offsets = dict.fromkeys(frames, 0.0)
    for name, lidar in find_lidars(scenario).items():
        # What the distance rule subtracts, so that the two are comparable.
        separation = lidar.separation
        offsets[name] = separation.workspace_radius - (
            separation.threshold_offset
        )
    return TruthModel(
        plant=station.plant,
        inspector=station.scene_graph.model_inspector(),
        radii=station.people.radii,
        pelvis=PELVIS,
        people=len(station.people.avatars),
        kinematics=ArmKinematics.from_plant(station.plant, links=frames),
        link_offsets=np.array(list(offsets.values())),
    )
