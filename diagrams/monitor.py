"""The monitor: from scans and the robot's own report to a speed fraction."""

import math

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Multiplexer

from tofssm_drake.arms.cell_plant import make_twin_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.scenario import (
    Scenario,
    find_dead_sensors,
    get_links,
    make_law,
)
from tofssm_drake.laws.dsi_filter import DsiFilter
from tofssm_drake.laws.speed_fraction import SpeedFractionTrajectory
from tofssm_drake.laws.tri_ssm import TriSsmState
from tofssm_drake.messages import RINGS
from tofssm_drake.perception.ideal_separation import IdealSeparation
from tofssm_drake.perception.lidar_mount import (
    make_base_lidar_bundle,
    scan_background,
)
from tofssm_drake.perception.lidar_separation import LidarSeparation
from tofssm_drake.perception.occlusion_mask import (
    OcclusionMask,
    make_mask_bundles,
    make_proof_bundles,
)
from tofssm_drake.perception.self_hit_coverage import (
    calc_verifiable_share,
    tell_coverage,
)
from tofssm_drake.perception.self_hit_watch import (
    SelfHitModel,
    SelfHitStop,
    SelfHitWatch,
    make_self_hit_model,
)
from tofssm_drake.perception.separation import TofSeparation, make_ring_geometry
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.ring_mount import find_ring_mount
from tofssm_drake.tasks.products import ProductLayout
from tofssm_drake.tasks.program import make_program_path

# Ports and their sizes, in the order of OcclusionMask's `robot_report`.
_ROBOT_REPORT = {
    "position_measured": 6,
    "velocity_measured": 6,
    "gripper_closed": 1,
    "products_placed": 1,
}
_JOINTS = ("position_measured", "velocity_measured")


def make_monitor(
    scenario: Scenario,
    *,
    person_radii: np.ndarray | None = None,
) -> Diagram:
    """Makes the monitor, the same for a simulated and for a real cell.

    .. pydrake_system::

        name: monitor
        input_ports:
        - scan_base
        - scan_elbow
        - scan_tool
        - position_measured
        - velocity_measured
        - gripper_closed
        - products_placed
        output_ports:
        - speed_fraction
        - robot_state
        - ring_states
        - reason
        - separation
        - dsi
        - masked_scan_base
        - masked_scan_elbow
        - masked_scan_tool
        - self_hit_health

    It sees only what real hardware provides: the rings' scans, the joints, a
    digital output (gripper) and a register (products placed). It has its own
    model of the cell, the twin.

    Without rings it has another port in place of `scan_...`: with `lidar`
    `scan_lidar`, with `ideal` the true person, `skeleton`. Then it has neither
    gripper and products nor `masked_scan_...` and `self_hit_health` (which also
    needs the rings to be watched).

    Args:
        scenario: Checked settings.
        person_radii: Radii of the capsules of the person in `skeleton`, m,
            (c,); used only by the sensing `ideal`.

    Returns:
        The Diagram.

    Raises:
        UserError: If the lidar has no free view.
    """
    builder = DiagramBuilder()
    separation, masked_scans = _add_sensing(builder, scenario, person_radii)
    _add_law(builder, scenario, separation)
    for port in masked_scans:
        builder.ExportOutput(port, port.get_name())
    diagram = builder.Build()
    diagram.set_name("monitor")
    return diagram


def _add_sensing(builder, scenario, person_radii):
    """Adds the sensing with its inputs.

    Returns:
        The system with the separation, and the further outputs.
    """
    # The twin's SceneGraph only provides the shapes, once: it is not in the
    # Diagram, and poses are computed by TwinPoses.
    scene_graph = SceneGraph()
    plant = make_twin_plant(
        scene_graph=scene_graph,
        sensors_per_ring=scenario.sensors_per_ring,
        products=scenario.program.products,
        meshes=scenario.robot_meshes,
    )
    kinematics = ArmKinematics.from_plant(plant)
    if scenario.sensing == "ideal":
        return _add_ideal(builder, scenario, kinematics, person_radii), []
    if scenario.sensing == "lidar":
        return (
            _add_lidar(builder, scenario, scene_graph, plant, kinematics),
            [],
        )
    return _add_rings(builder, scenario, scene_graph, plant, kinematics)


def _add_law(builder, scenario, separation):
    """Adds filter, states and speed fraction; exports all their signals."""
    law, links = make_law(scenario), get_links(scenario)
    dsi_filter = builder.AddNamedSystem(
        "dsi_filter",
        DsiFilter(config=law, period=scenario.control_period, name=links),
    )
    state = builder.AddNamedSystem(
        "tri_ssm", TriSsmState(config=law, name=links)
    )
    trajectory = builder.AddNamedSystem(
        "speed_fraction",
        SpeedFractionTrajectory(config=law, period=scenario.control_period),
    )
    builder.Connect(
        separation.GetOutputPort("separation"),
        dsi_filter.GetInputPort("separation"),
    )
    builder.Connect(dsi_filter.GetOutputPort("dsi"), state.GetInputPort("dsi"))
    for system in (dsi_filter, trajectory):
        builder.Connect(
            state.GetOutputPort("robot_state"),
            system.GetInputPort("robot_state"),
        )
    for system, names in (
        (trajectory, ("speed_fraction",)),
        (state, ("robot_state", "ring_states", "reason")),
        (separation, ("separation",)),
        (dsi_filter, ("dsi",)),
    ):
        for name in names:
            builder.ExportOutput(system.GetOutputPort(name), name)


def _add_ideal(builder, scenario, kinematics, person_radii):
    """Adds the ideal separation with its inputs."""
    if person_radii is None:
        raise ValueError("person_radii: ideal sensing needs the person's")
    separation = builder.AddNamedSystem(
        "separation",
        IdealSeparation(
            config=scenario.ideal,
            k_max=scenario.ssm.k_omax,
            kinematics=kinematics,
            radii=person_radii,
        ),
    )
    for name in (*_JOINTS, "skeleton"):
        builder.ExportInput(separation.GetInputPort(name), name)
    return separation


def _add_lidar(builder, scenario, scene_graph, plant, kinematics):
    """Adds the lidar's separation with its inputs.

    Its background is a scan of the twin, in which there are no people.
    """
    inspector = scene_graph.model_inspector()
    caster = RayCaster(inspector)
    bundle = make_base_lidar_bundle(
        config=scenario.lidar,
        caster=caster,
        plant=plant,
        inspector=inspector,
        kinematics=kinematics,
    )
    twin = TwinPoses.from_plant(
        plant,
        layout=ProductLayout.from_config(scenario.program),
        frame_ids=caster.frame_ids,
        kinematics=kinematics,
    )
    path = make_program_path(scenario.program, kinematics)
    separation = builder.AddNamedSystem(
        "separation",
        LidarSeparation(
            config=scenario.lidar_separation,
            k_max=scenario.ssm.k_omax,
            kinematics=kinematics,
            background=scan_background(
                caster=caster,
                bundle=bundle,
                twin=twin,
                q=path.calc_motion(0.0)[0],
            ),
            period=scenario.control_period,
        ),
    )
    builder.ExportInput(separation.GetInputPort("scan"), "scan_lidar")
    for name in _JOINTS:
        builder.ExportInput(separation.GetInputPort(name), name)
    return separation


def _add_rings(builder, scenario, scene_graph, plant, kinematics):
    """Adds mask, self-hit watch and separation of the rings.

    Returns:
        The system with the final separation, and the ports of the masked scans
        and of the watch.
    """
    mask, report, geometries = _add_mask(
        builder,
        scenario,
        scene_graph,
        plant,
        kinematics,
    )
    separation = builder.AddNamedSystem(
        "separation",
        TofSeparation(
            config=scenario.separation,
            k_max=scenario.ssm.k_omax,
            kinematics=kinematics,
            geometries=geometries,
        ),
    )
    ports = [mask.GetOutputPort(f"masked_scan_{name}") for name in RINGS]
    for port in ports:
        builder.Connect(port, separation.GetInputPort(port.get_name()))
    if not scenario.self_hits.enabled:
        return separation, ports
    watch = builder.AddNamedSystem(
        "self_hit_watch",
        SelfHitWatch(
            model=make_scenario_self_hits(
                scenario, scene_graph, plant, kinematics
            ),
            period=_calc_look_period(scenario),
        ),
    )
    for port in ports:
        builder.Connect(port, watch.GetInputPort(port.get_name()))
    builder.Connect(report, watch.GetInputPort("robot_report"))
    stop = builder.AddNamedSystem("self_hit_stop", SelfHitStop())
    health = watch.GetOutputPort("self_hit_health")
    builder.Connect(health, stop.GetInputPort("self_hit_health"))
    builder.Connect(
        separation.GetOutputPort("separation"), stop.GetInputPort("separation")
    )
    return stop, [*ports, health]


def _calc_look_period(scenario):
    """Returns the time between looks, a multiple of the control tick."""
    wanted = scenario.self_hits.scans_per_look * scenario.rings.period
    tick = scenario.control_period
    return max(1, math.ceil(wanted / tick - 1e-6)) * tick


def make_scenario_self_hits(
    scenario: Scenario,
    scene_graph: SceneGraph,
    plant: MultibodyPlant,
    kinematics: ArmKinematics,
) -> SelfHitModel:
    """Makes the model of what a scenario's rings should see of the robot.

    Args:
        scenario: Checked settings.
        scene_graph: Of the twin.
        plant: From `make_twin_plant`.
        kinematics: Of the plant's robot.
    """
    inspector = scene_graph.model_inspector()
    caster = RayCaster(inspector)
    return make_self_hit_model(
        config=scenario.self_hits,
        mask_config=scenario.mask,
        ring_config=scenario.rings,
        caster=caster,
        mounts=[find_ring_mount(plant, inspector, name) for name in RINGS],
        # All rings' frames carry visible geometry: no bundle adds a frame.
        twin=TwinPoses.from_plant(
            plant,
            layout=ProductLayout.from_config(scenario.program),
            frame_ids=caster.frame_ids,
            kinematics=kinematics,
        ),
        is_dead=find_dead_sensors(scenario),
    )


def tell_self_hit_coverage(scenario: Scenario) -> list[str]:
    """Returns lines that say what self-hits cannot verify of the rings.

    Args:
        scenario: Checked settings.

    Returns:
        Lines to show at the start, see `tell_coverage`; empty if there are no
        rings, or they are not watched.
    """
    if scenario.sensing != "tof" or not scenario.self_hits.enabled:
        return []
    scene_graph = SceneGraph()
    plant = make_twin_plant(
        scene_graph=scene_graph,
        sensors_per_ring=scenario.sensors_per_ring,
        products=scenario.program.products,
        meshes=scenario.robot_meshes,
    )
    kinematics = ArmKinematics.from_plant(plant)
    model = make_scenario_self_hits(scenario, scene_graph, plant, kinematics)
    path = make_program_path(scenario.program, kinematics)
    return tell_coverage(model, calc_verifiable_share(model, path))


def _add_mask(builder, scenario, scene_graph, plant, kinematics):
    """Adds the mask with its inputs; returns it, the report, the rings."""
    inspector = scene_graph.model_inspector()
    caster = RayCaster(inspector)
    mounts = [find_ring_mount(plant, inspector, name) for name in RINGS]
    mask = builder.AddNamedSystem(
        "mask",
        OcclusionMask(
            config=scenario.mask,
            caster=caster,
            period=scenario.control_period,
            proof_bundles=make_proof_bundles(
                config=scenario.mask,
                ring_config=scenario.rings,
                caster=caster,
                mounts=mounts,
            )
            if scenario.self_hits.enabled
            else None,
            is_dead=find_dead_sensors(scenario),
            bundles=make_mask_bundles(
                config=scenario.mask,
                ring_config=scenario.rings,
                caster=caster,
                mounts=mounts,
            ),
            # After the bundles, which may add frames to the caster's.
            twin=TwinPoses.from_plant(
                plant,
                layout=ProductLayout.from_config(scenario.program),
                frame_ids=caster.frame_ids,
                kinematics=kinematics,
            ),
        ),
    )
    for name in RINGS:
        builder.ExportInput(mask.GetInputPort(f"scan_{name}"), f"scan_{name}")
    report = builder.AddNamedSystem(
        "robot_report", Multiplexer(list(_ROBOT_REPORT.values()))
    )
    for i, name in enumerate(_ROBOT_REPORT):
        builder.ExportInput(report.get_input_port(i), name)
    builder.Connect(report.get_output_port(), mask.GetInputPort("robot_report"))
    geometries = [make_ring_geometry(mount.X_LS) for mount in mounts]
    return mask, report.get_output_port(), geometries
