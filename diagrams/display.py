"""What Meshcat shows of a workcell."""

import math

from pydrake.geometry import (
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
)
from pydrake.systems.framework import Diagram, DiagramBuilder

from tofssm_drake.diagrams.scenario import Scenario, find_links
from tofssm_drake.diagrams.sensors.rings import find_rings, group_rings
from tofssm_drake.diagrams.station import Station
from tofssm_drake.visualization.recording import FPS, set_scene
from tofssm_drake.visualization.ring_rays import RingRays
from tofssm_drake.visualization.state_light import StateLight


def add_display(
    builder: DiagramBuilder,
    scenario: Scenario,
    station: Station,
    monitor: Diagram,
    meshcat: Meshcat,
) -> None:
    """Shows robot, cell, person, beams and state.

    Args:
        builder: Of the workcell.
        scenario: Checked settings.
        station: Of that scenario.
        monitor: Likewise.
        meshcat: Where to show them.
    """
    set_scene(meshcat)
    period = 1.0 / FPS
    MeshcatVisualizer.AddToBuilder(
        builder,
        station.diagram.GetOutputPort("geometry_query"),
        meshcat,
        MeshcatVisualizerParams(role=Role.kIllustration, publish_period=period),
    )
    light = builder.AddNamedSystem(
        "state_light",
        StateLight(meshcat=meshcat, links=find_links(scenario), period=period),
    )
    builder.Connect(
        monitor.GetOutputPort("decision"), light.GetInputPort("decision")
    )
    groups = group_rings(find_rings(scenario.sensors))
    for i, group in enumerate(groups):
        sensor = group.traits
        rays = builder.AddNamedSystem(
            f"ring_rays_{i}" if i else "ring_rays",
            RingRays(
                meshcat=meshcat,
                plant=station.plant,
                fov=math.radians(sensor.fov_deg),
                max_range=sensor.cast_range,
                rings=group.name,
                sensors_per_ring=group.one.num_sensors,
                period=period,
            ),
        )
        builder.Connect(
            station.diagram.GetOutputPort("position_measured"),
            rays.GetInputPort("position"),
        )
        for name in group.name:
            port = f"masked_scan_{name}"
            builder.Connect(
                monitor.GetOutputPort(port), rays.GetInputPort(port)
            )
