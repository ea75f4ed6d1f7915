"""What Meshcat shows of a workcell."""

from collections.abc import Mapping
import math

from pydrake.geometry import (
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort

from tofssm_drake.diagrams.scenario import Scenario, find_lidars, find_links
from tofssm_drake.diagrams.sensors.rings import find_rings, group_rings
from tofssm_drake.sensors.lidar_2d import calc_lidar_angles
from tofssm_drake.visualization.lidar_field import draw_lidar
from tofssm_drake.visualization.recording import FPS, set_scene
from tofssm_drake.visualization.ring_rays import RingRays
from tofssm_drake.visualization.state_light import StateLight

_PERIOD = 1.0 / FPS


def find_display_ports(
    scenario: Scenario, station: Diagram, monitor: Diagram
) -> dict[str, OutputPort]:
    """Returns the ports of a workcell that `add_display` needs, by name."""
    rings = find_rings(scenario.sensors)
    return {
        name: system.GetOutputPort(name)
        for system, names in (
            (station, ("geometry_query", "position_measured")),
            (monitor, ("decision", *(f"masked_scan_{r}" for r in rings))),
        )
        for name in names
    }


def add_display(
    builder: DiagramBuilder,
    scenario: Scenario,
    plant: MultibodyPlant,
    ports: Mapping[str, OutputPort],
    meshcat: Meshcat,
) -> None:
    """Shows robot, cell, person, beams and state.

    Args:
        builder: Of a Diagram with these ports.
        scenario: Checked settings.
        plant: The cell's, with the frames of the sensors.
        ports: `geometry_query`, `position_measured`, `decision` and
            `masked_scan_<ring>` of each ring, by name.
        meshcat: Where to show them.
    """
    set_scene(meshcat)
    MeshcatVisualizer.AddToBuilder(
        builder,
        ports["geometry_query"],
        meshcat,
        MeshcatVisualizerParams(
            role=Role.kIllustration, publish_period=_PERIOD
        ),
    )
    light = builder.AddNamedSystem(
        "state_light",
        StateLight(meshcat=meshcat, links=find_links(scenario), period=_PERIOD),
    )
    builder.Connect(ports["decision"], light.GetInputPort("decision"))
    for i, group in enumerate(group_rings(find_rings(scenario.sensors))):
        _add_rays(builder, i, group, plant, ports, meshcat)
    _draw_lidars(scenario, plant, meshcat)


def _add_rays(builder, i, group, plant, ports, meshcat):
    """Shows the beams of the i-th group of alike rings."""
    sensor = group.traits
    rays = builder.AddNamedSystem(
        f"ring_rays_{i}" if i else "ring_rays",
        RingRays(
            meshcat=meshcat,
            plant=plant,
            fov=math.radians(sensor.fov_deg),
            max_range=sensor.cast_range,
            rings=group.name,
            sensors_per_ring=group.one.num_sensors,
            period=_PERIOD,
        ),
    )
    builder.Connect(ports["position_measured"], rays.GetInputPort("position"))
    for name in group.name:
        port = f"masked_scan_{name}"
        builder.Connect(ports[port], rays.GetInputPort(port))


def _draw_lidars(scenario, plant, meshcat):
    """Shows where the planar lidars are; they do not move."""
    context = plant.CreateDefaultContext()
    for name, lidar in find_lidars(scenario).items():
        frame = plant.GetFrameByName(f"{name}_scanner")
        draw_lidar(
            meshcat,
            f"lidars/{name}",
            X_WS=frame.CalcPoseInWorld(context),
            angles=calc_lidar_angles(lidar.sensor),
            max_range=lidar.sensor.max_range,
        )
