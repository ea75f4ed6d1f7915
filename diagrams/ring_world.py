"""What rings or lidar see: the cell, posed from the robot's reports."""

import dataclasses as dc

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    OutputPort,
)
from pydrake.systems.primitives import (
    ConstantVectorSource,
    Multiplexer,
    PassThrough,
    RandomSource,
)
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.scenario import NoHuman, Scenario
from tofssm_drake.messages import RINGS
from tofssm_drake.people.avatar import HumanAvatar
from tofssm_drake.people.bvh import BvhRecording, make_bvh_motion
from tofssm_drake.people.walk import make_walk
from tofssm_drake.perception.lidar_mount import make_base_lidar_bundle
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.lidar_2d import Lidar2d
from tofssm_drake.sensors.ring_mount import find_ring_mount
from tofssm_drake.sensors.tof_rings import TofRings, make_ring_bundles
from tofssm_drake.sensors.vl53l1x import SensorErrors, draw_sensor_errors
from tofssm_drake.tasks.products import ProductCarrier, ProductLayout

# Noise is drawn for this many scans at a time.
_NOISE_SCANS = 16


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingWorld:
    """The cell as the rings see it, and its queries."""

    plant: MultibodyPlant
    """Robot, cell and products as registered with `scene_graph`."""
    scene_graph: SceneGraph
    avatar: HumanAvatar | None
    """The person; None: nobody is there."""
    skeleton: OutputPort
    """Where the person is."""


def make_scene(builder: DiagramBuilder, scenario: Scenario):
    """Adds the SceneGraph with robot, cell and products.

    Returns:
        The SceneGraph and the plant that is registered with it.
    """
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = make_cell_plant(
        sensors_per_ring=scenario.sensors_per_ring,
        products=scenario.program.products,
        scene_graph=scene_graph,
        meshes=scenario.robot_meshes,
    )
    return scene_graph, plant


def add_ring_world(
    builder: DiagramBuilder,
    *,
    scenario: Scenario,
    scene_graph: SceneGraph,
    plant: MultibodyPlant,
    position_measured: OutputPort,
    gripper_closed: OutputPort,
    products_placed: OutputPort,
) -> RingWorld:
    """Poses the scene from a robot's report and adds the sensors.

    Exports the scans of the scenario's sensing: `scan_base` to `scan_tool`,
    `scan_lidar`, or none.

    Args:
        builder: Of the Diagram.
        scenario: Checked settings.
        scene_graph: From `make_scene`.
        plant: From `make_scene`.
        position_measured: The robot's joints, rad.
        gripper_closed: More than 0.5 is closed.
        products_placed: Their number.
    """
    report = {
        "position_measured": position_measured,
        "gripper_closed": gripper_closed,
        "products_placed": products_placed,
    }
    layout = ProductLayout.from_config(scenario.program)
    _show_robot_and_products(builder, layout, scene_graph, plant, report)
    avatar = _add_avatar(builder, scenario, scene_graph)
    if avatar is None:
        person = builder.AddNamedSystem("nobody", ConstantVectorSource([]))
        skeleton = person.get_output_port()
    else:
        skeleton = avatar.GetOutputPort("skeleton")
    caster = RayCaster(scene_graph.model_inspector())
    if scenario.sensing == "tof":
        sensors = _add_rings(builder, scenario, scene_graph, plant, caster)
    elif scenario.sensing == "lidar":
        sensors = [_add_lidar(builder, scenario, scene_graph, plant, caster)]
    else:
        sensors = []
    for sensor in sensors:
        builder.Connect(
            scene_graph.get_query_output_port(),
            sensor.GetInputPort("geometry_query"),
        )
    return RingWorld(
        plant=plant, scene_graph=scene_graph, avatar=avatar, skeleton=skeleton
    )


def make_ring_world(scenario: Scenario) -> Diagram:
    """Makes the rings' world for a robot that is elsewhere.

    .. pydrake_system::

        name: ring_world
        input_ports:
        - position_measured
        - gripper_closed
        - products_placed
        output_ports:
        - scan_base
        - scan_elbow
        - scan_tool
        - geometry_query
        - skeleton

    Args:
        scenario: Checked settings.

    Returns:
        The Diagram.
    """
    builder = DiagramBuilder()
    scene_graph, plant = make_scene(builder, scenario)
    report = {}
    for name, size in (
        ("position_measured", 6),
        ("gripper_closed", 1),
        ("products_placed", 1),
    ):
        relay = builder.AddNamedSystem(name, PassThrough(size))
        builder.ExportInput(relay.get_input_port(), name)
        report[name] = relay.get_output_port()
    world = add_ring_world(
        builder,
        scenario=scenario,
        scene_graph=scene_graph,
        plant=plant,
        **report,
    )
    builder.ExportOutput(scene_graph.get_query_output_port(), "geometry_query")
    builder.ExportOutput(world.skeleton, "skeleton")
    diagram = builder.Build()
    diagram.set_name("ring_world")
    return diagram


def _show_robot_and_products(builder, layout, scene_graph, plant, report):
    """Poses the visible robot and products from the robot's report."""
    carrier = builder.AddNamedSystem(
        "products",
        ProductCarrier(
            layout=layout, kinematics=ArmKinematics.from_plant(plant)
        ),
    )
    for name, port in report.items():
        builder.Connect(port, carrier.GetInputPort(name))
    positions = builder.AddNamedSystem(
        "positions", Multiplexer([6, 7 * len(layout)])
    )
    builder.Connect(report["position_measured"], positions.get_input_port(0))
    builder.Connect(carrier.get_output_port(), positions.get_input_port(1))
    poses = builder.AddNamedSystem(
        "geometry_poses", MultibodyPositionToGeometryPose(plant)
    )
    builder.Connect(positions.get_output_port(), poses.get_input_port())
    builder.Connect(
        poses.get_output_port(),
        scene_graph.get_source_pose_port(plant.get_source_id()),
    )


def _add_avatar(builder, scenario, scene_graph):
    """Adds the person, if there is one."""
    if isinstance(scenario.human, NoHuman):
        return None
    if isinstance(scenario.human, BvhRecording):
        motion = make_bvh_motion(scenario.human, scenario.control_period)
    else:
        motion = make_walk(scenario.human, scenario.control_period)
    avatar = builder.AddNamedSystem(
        "human", HumanAvatar(scene_graph=scene_graph, motion=motion)
    )
    builder.Connect(
        avatar.GetOutputPort("geometry_pose"),
        scene_graph.get_source_pose_port(avatar.source_id),
    )
    return avatar


def _add_rings(builder, scenario, scene_graph, plant, caster):
    """Adds the rings with their noise, exports the scans, returns the rings.

    Rings of one phase sample together, in one system.
    """
    systems = []
    for phase in sorted(set(scenario.ring_phases)):
        index = [i for i, p in enumerate(scenario.ring_phases) if p == phase]
        names = [RINGS[i] for i in index]
        inspector = scene_graph.model_inspector()
        mounts = [find_ring_mount(plant, inspector, name) for name in names]
        rings = builder.AddNamedSystem(
            "rings_" + "_".join(names),
            TofRings(
                config=scenario.rings,
                caster=caster,
                bundles=make_ring_bundles(
                    config=scenario.rings, caster=caster, mounts=mounts
                ),
                errors=_draw_errors(scenario, index),
                phase=phase,
                noise_scans=_NOISE_SCANS,
                name=tuple(names),
            ),
        )
        noise = builder.AddNamedSystem(
            f"noise_{'_'.join(names)}",
            RandomSource(
                distribution=RandomDistribution.kGaussian,
                num_outputs=rings.GetInputPort("noise").size(),
                sampling_interval_sec=_NOISE_SCANS * scenario.rings.period,
            ),
        )
        builder.Connect(noise.get_output_port(), rings.GetInputPort("noise"))
        for name in names:
            port = f"scan_{name}"
            builder.ExportOutput(rings.GetOutputPort(port), port)
        systems.append(rings)
    return systems


def _draw_errors(scenario, index):
    """Returns the constant errors of all sensors of some rings."""
    errors = [
        draw_sensor_errors(
            scenario.rings.sensor,
            sensors=scenario.sensors_per_ring,
            seed=scenario.random_seed,
            ring=i,
        )
        for i in index
    ]
    return SensorErrors(
        bias=np.concatenate([e.bias for e in errors]),
        gain=np.concatenate([e.gain for e in errors]),
    )


def _add_lidar(builder, scenario, scene_graph, plant, caster):
    """Adds the lidar with its noise, exports its scan, returns it."""
    lidar = builder.AddNamedSystem(
        "lidar",
        Lidar2d(
            config=scenario.lidar,
            caster=caster,
            bundle=make_base_lidar_bundle(
                config=scenario.lidar,
                caster=caster,
                plant=plant,
                inspector=scene_graph.model_inspector(),
                kinematics=ArmKinematics.from_plant(plant),
            ),
        ),
    )
    noise = builder.AddNamedSystem(
        "noise_lidar",
        RandomSource(
            distribution=RandomDistribution.kGaussian,
            num_outputs=lidar.GetInputPort("noise").size(),
            sampling_interval_sec=scenario.lidar.period,
        ),
    )
    builder.Connect(noise.get_output_port(), lidar.GetInputPort("noise"))
    builder.ExportOutput(lidar.GetOutputPort("scan"), "scan_lidar")
    return lidar
