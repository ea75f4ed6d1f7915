"""The monitor: from scans and the robot's own report to a speed fraction."""

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Diagram, DiagramBuilder

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.scenario import (
    Scenario,
    find_links,
    find_threshold_offsets,
)
from tofssm_drake.diagrams.sensors import (
    Monitor,
    add_sensors_to_monitor,
    find_link_frames,
)
from tofssm_drake.diagrams.sensors.fusion import fuse
from tofssm_drake.diagrams.sensors.parts import MonitorSettings
from tofssm_drake.diagrams.sensors.rings import (
    find_rings,
    group_rings,
    make_group_self_hits,
)
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.laws.speed_fraction import SpeedFractionTrajectory
from tofssm_drake.perception.self_hit_coverage import (
    calc_verifiable_share,
    tell_coverage,
)

# A task is looked at where its robot is at so many times of its first minutes.
_POSTURES = 100
_LONGEST_ROUND = 200.0


def make_monitor(
    scenario: Scenario,
    *,
    person_radii: np.ndarray | None = None,
) -> Diagram:
    """Makes the monitor, the same for a simulated and for a real cell.

    .. pydrake_system::

        name: monitor
        input_ports:
        - position_measured
        - velocity_measured
        - carried_objects
        - scan_<ring>
        output_ports:
        - speed_fraction
        - decision
        - separation
        - masked_scan_<ring>
        - self_hit_health

    It sees only what real hardware provides: the sensors' scans, the joints,
    and which objects the tool carries (`CarriableObjects`). It has its own
    model of the cell, the twin.

    The ports are those of the paper's cell. Every sensor that scans has a port
    `scan_<sensor>`, every ring a `masked_scan_<ring>` too; motion capture adds
    the true person, `skeleton`. Without rings there are neither
    `carried_objects` nor `self_hit_health` (which also needs the rings to be
    watched).
    Rings that are not alike have a `self_hit_health_<i>` for each kind.

    Args:
        scenario: Checked settings.
        person_radii: Radii of the capsules of the person in `skeleton`, m,
            (c,); used only by motion capture.

    Returns:
        The Diagram.

    Raises:
        UserError: If a sensor cannot be mounted as the scenario says.
    """
    builder = DiagramBuilder()
    monitor = make_twin(builder, scenario, person_radii)
    sensing = add_sensors_to_monitor(monitor, scenario.sensors)
    _add_law(builder, scenario, fuse(monitor, sensing))
    for part in sensing:
        for name, port in part.outputs.items():
            builder.ExportOutput(port, name)
    diagram = builder.Build()
    diagram.set_name("monitor")
    return diagram


def make_twin(
    builder: DiagramBuilder,
    scenario: Scenario,
    person_radii: np.ndarray | None = None,
) -> Monitor:
    """Makes the monitor's model of the cell, the twin.

    Its SceneGraph only provides the shapes, once: it is not in the Diagram, and
    poses are computed by TwinPoses.

    Args:
        builder: Of the monitor, to which sensors will be added.
        scenario: Checked settings.
        person_radii: See `make_monitor`.
    """
    scene_graph = SceneGraph()
    plant = make_cell_plant(
        workcell=scenario.workcell,
        arm=scenario.robot,
        scene_graph=scene_graph,
        sensors=scenario.sensors,
        products=scenario.task.num_objects,
        meshes=scenario.robot_meshes,
    )
    kinematics = ArmKinematics.from_plant(
        plant, links=find_link_frames(scenario.sensors)
    )
    path = make_task_path(scenario.task, kinematics, scenario.robot)
    return Monitor(
        builder=builder,
        settings=MonitorSettings(
            control_period=scenario.control_period,
            k_max=scenario.law.traits.k_max,
            mask=scenario.mask,
            self_hits=scenario.self_hits,
            separation=scenario.separation,
            postures=_find_postures(path),
        ),
        scene_graph=scene_graph,
        plant=plant,
        kinematics=kinematics,
        objects=path.objects,
        person_radii=person_radii,
    )


def _find_postures(path):
    """Returns joints along the first minutes of a task, (k, n)."""
    times = np.linspace(0.0, min(path.duration, _LONGEST_ROUND), _POSTURES)
    return np.array([path.calc_motion(time)[0] for time in times])


def _add_law(builder, scenario, separation):
    """Adds the law and the speed fraction; exports what they say."""
    links = find_links(scenario)
    law = builder.AddNamedSystem(
        "law",
        scenario.law.make(
            links=links,
            offset=find_threshold_offsets(scenario),
            period=scenario.control_period,
        ),
    )
    trajectory = builder.AddNamedSystem(
        "speed_fraction",
        SpeedFractionTrajectory(
            name=links,
            ramp=scenario.law.traits.ramp,
            period=scenario.control_period,
        ),
    )
    builder.Connect(separation, law.GetInputPort("separation"))
    builder.Connect(
        law.GetOutputPort("decision"), trajectory.GetInputPort("decision")
    )
    for system, name in (
        (trajectory, "speed_fraction"),
        (law, "decision"),
    ):
        builder.ExportOutput(system.GetOutputPort(name), name)
    builder.ExportOutput(separation, "separation")


def tell_self_hit_coverage(scenario: Scenario) -> list[str]:
    """Returns lines that say what self-hits cannot verify of the rings.

    Args:
        scenario: Checked settings.

    Returns:
        Lines to show at the start, see `tell_coverage`; empty if there are no
        rings, or they are not watched.
    """
    rings = find_rings(scenario.sensors)
    if not rings or not scenario.self_hits.enabled:
        return []
    monitor = make_twin(DiagramBuilder(), scenario)
    path = make_task_path(scenario.task, monitor.kinematics, scenario.robot)
    return [
        line
        for group in group_rings(rings)
        for model in [make_group_self_hits(monitor, group)]
        for line in tell_coverage(model, calc_verifiable_share(model, path))
    ]
