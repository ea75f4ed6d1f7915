"""The robot's side of the cell: what the monitor watches and slows down."""

import dataclasses as dc

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    Multiplexer,
    RandomSource,
)
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from tofssm_drake.diagrams.scenario import NoHuman, Scenario
from tofssm_drake.geometry.ray_caster import RayCaster
from tofssm_drake.human.avatar import HumanAvatar
from tofssm_drake.human.bvh import BvhRecording, make_bvh_motion
from tofssm_drake.human.walk import make_walk
from tofssm_drake.messages import RINGS
from tofssm_drake.robot.kinematics import RingKinematics
from tofssm_drake.robot.products import ProductCarrier, ProductLayout
from tofssm_drake.robot.program import PickAndPlaceProgram
from tofssm_drake.robot.sim_ur10 import make_sim_ur10
from tofssm_drake.robot.twin import make_cell_plant
from tofssm_drake.sensing.lidar_2d import Lidar2d
from tofssm_drake.sensing.lidar_mount import make_base_lidar_bundle
from tofssm_drake.sensing.ring_mount import find_ring_mount
from tofssm_drake.sensing.scene_poses import ScenePoses
from tofssm_drake.sensing.tof_rings import TofRings, make_ring_bundles
from tofssm_drake.sensing.vl53l1x import SensorErrors, draw_sensor_errors

# Noise is drawn for so many scans at a time.
_NOISE_SCANS = 16


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Station:
    """A station's Diagram and what one has to know to read its ports."""

    diagram: Diagram
    plant: MultibodyPlant
    """Robot, cell and products as registered with `scene_graph`."""
    scene_graph: SceneGraph
    """The world that the rings see."""
    avatar: HumanAvatar | None
    """The person of the port `skeleton`; None: nobody is there."""
    nominal_duration: float
    """Time that the task takes at full speed, s."""


def make_station(scenario: Scenario) -> Station:
    """Makes the simulated cell: robot, program, rings, person, products.

    .. pydrake_system::

        name: station
        input_ports:
        - speed_fraction
        output_ports:
        - scan_base
        - scan_elbow
        - scan_tool
        - position_measured
        - velocity_measured
        - gripper_closed
        - products_placed
        - task_done
        - geometry_query
        - skeleton

    The monitor may look at the scans and at what the robot reports
    (`position_measured` to `products_placed`). The last two ports are the
    world's truth, for evaluation and display only.

    With the sensing `lidar` there is `scan_lidar` in the place of the rings'
    scans, with `ideal` there are no scans at all.

    Args:
        scenario: Checked settings.

    Returns:
        The station.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = make_cell_plant(
        sensors_per_ring=scenario.sensors_per_ring,
        products=scenario.program.products,
        scene_graph=scene_graph,
        meshes=scenario.robot_meshes,
    )
    kinematics = RingKinematics.from_plant(plant)

    program = builder.AddNamedSystem(
        "program",
        PickAndPlaceProgram(
            config=scenario.program,
            kinematics=kinematics,
            period=scenario.control_period,
        ),
    )
    robot, _ = make_sim_ur10(
        config=scenario.robot,
        initial_position=program.path.calc_motion(0.0)[0],
        sensors_per_ring=scenario.sensors_per_ring,
    )
    builder.AddSystem(robot)
    builder.Connect(
        program.GetOutputPort("motion_commanded"),
        robot.GetInputPort("motion_commanded"),
    )

    layout = ProductLayout.from_config(scenario.program)
    _show_robot_and_products(
        builder, layout, scene_graph, plant, kinematics, robot, program
    )
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
        sensors = _add_lidar(
            builder, scenario, scene_graph, plant, caster, kinematics
        )
    else:
        sensors = []
    if sensors:
        poses = builder.AddNamedSystem(
            "scene_poses",
            ScenePoses(
                caster=caster,
                plant=plant,
                layout=layout,
                human_frame_ids=[] if avatar is None else avatar.frame_ids,
            ),
        )
        for port, name in (
            (robot.GetOutputPort("position_measured"), "position_measured"),
            (program.GetOutputPort("gripper_closed"), "gripper_closed"),
            (program.GetOutputPort("products_placed"), "products_placed"),
            (skeleton, "skeleton"),
        ):
            builder.Connect(port, poses.GetInputPort(name))
        for sensor in sensors:
            builder.Connect(
                poses.get_output_port(), sensor.GetInputPort("frame_poses")
            )

    builder.ExportInput(
        program.GetInputPort("speed_fraction"), "speed_fraction"
    )
    for name in ("position_measured", "velocity_measured"):
        builder.ExportOutput(robot.GetOutputPort(name), name)
    for name in ("gripper_closed", "products_placed", "task_done"):
        builder.ExportOutput(program.GetOutputPort(name), name)
    builder.ExportOutput(scene_graph.get_query_output_port(), "geometry_query")
    builder.ExportOutput(skeleton, "skeleton")

    diagram = builder.Build()
    diagram.set_name("station")
    return Station(
        diagram=diagram,
        plant=plant,
        scene_graph=scene_graph,
        avatar=avatar,
        nominal_duration=program.path.duration,
    )


def _show_robot_and_products(
    builder, layout, scene_graph, plant, kinematics, robot, program
):
    """Poses what is seen of robot and products from what the robot reports."""
    carrier = builder.AddNamedSystem(
        "products",
        ProductCarrier(layout=layout, kinematics=kinematics),
    )
    builder.Connect(
        robot.GetOutputPort("position_measured"),
        carrier.GetInputPort("position_measured"),
    )
    for name in ("gripper_closed", "products_placed"):
        builder.Connect(program.GetOutputPort(name), carrier.GetInputPort(name))
    positions = builder.AddNamedSystem(
        "positions", Multiplexer([6, 7 * len(layout)])
    )
    builder.Connect(
        robot.GetOutputPort("position_measured"), positions.get_input_port(0)
    )
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
    inspector = scene_graph.model_inspector()
    systems = []
    for phase in sorted(set(scenario.ring_phases)):
        index = [i for i, p in enumerate(scenario.ring_phases) if p == phase]
        names = tuple(RINGS[i] for i in index)
        errors = [
            draw_sensor_errors(
                scenario.rings.sensor,
                sensors=scenario.sensors_per_ring,
                seed=scenario.random_seed,
                ring=i,
            )
            for i in index
        ]
        rings = builder.AddNamedSystem(
            "rings_" + "_".join(names),
            TofRings(
                config=scenario.rings,
                caster=caster,
                bundles=make_ring_bundles(
                    config=scenario.rings,
                    caster=caster,
                    mounts=[
                        find_ring_mount(plant, inspector, name)
                        for name in names
                    ],
                ),
                errors=SensorErrors(
                    bias=np.concatenate([e.bias for e in errors]),
                    gain=np.concatenate([e.gain for e in errors]),
                ),
                phase=phase,
                noise_scans=_NOISE_SCANS,
                name=names,
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
            builder.ExportOutput(
                rings.GetOutputPort(f"scan_{name}"), f"scan_{name}"
            )
        systems.append(rings)
    return systems


def _add_lidar(builder, scenario, scene_graph, plant, caster, kinematics):
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
                kinematics=kinematics,
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
    return [lidar]
