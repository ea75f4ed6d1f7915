"""What rings or lidar see: the cell, posed from the robot's reports."""

import dataclasses as dc

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    OutputPort,
)
from pydrake.systems.primitives import (
    Multiplexer,
    PassThrough,
)
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.carried_objects import CarriableObjects
from tofssm_drake.diagrams.people import People, add_people
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.sensors import World, add_sensors_to_world
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.tasks.products import ObjectCarrier


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingWorld:
    """The cell as the rings see it, and its queries."""

    plant: MultibodyPlant
    """Robot, cell and products as registered with `scene_graph`."""
    scene_graph: SceneGraph
    people: People


def make_scene(builder: DiagramBuilder, scenario: Scenario):
    """Adds the SceneGraph with robot, cell and products.

    Returns:
        The SceneGraph and the plant that is registered with it.
    """
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = make_cell_plant(
        workcell=scenario.workcell,
        arm=scenario.robot,
        sensors=scenario.sensors,
        products=scenario.task.num_objects,
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
    objects: CarriableObjects,
    position_measured: OutputPort,
    carried_objects: OutputPort,
    with_sensors: bool = True,
) -> RingWorld:
    """Poses the scene from a robot's report and adds the sensors.

    Exports `scan_<sensor>` of each sensor that scans.

    Args:
        builder: Of the Diagram.
        scenario: Checked settings.
        scene_graph: From `make_scene`.
        plant: From `make_scene`.
        objects: What the task carries.
        position_measured: The robot's joints, rad or m.
        carried_objects: Where the objects are, see `CarriableObjects`.
        with_sensors: Whether to simulate the sensors.
    """
    report = {
        "position_measured": position_measured,
        "carried_objects": carried_objects,
    }
    _show_robot_and_objects(builder, objects, scene_graph, plant, report)
    people = add_people(
        builder,
        scene_graph,
        scenario.people,
        scenario.obstacles,
        scenario.control_period,
    )
    if with_sensors:
        world = World(
            builder=builder,
            scene_graph=scene_graph,
            plant=plant,
            caster=RayCaster(scene_graph.model_inspector()),
            random_seed=scenario.random_seed,
        )
        add_sensors_to_world(world, scenario.sensors)
    return RingWorld(plant=plant, scene_graph=scene_graph, people=people)


def make_ring_world(scenario: Scenario) -> Diagram:
    """Makes the rings' world for a robot that is elsewhere.

    .. pydrake_system::

        name: ring_world
        input_ports:
        - position_measured
        - carried_objects
        output_ports:
        - scan_<ring>
        - geometry_query
        - skeleton

    Args:
        scenario: Checked settings.

    Returns:
        The Diagram.
    """
    builder = DiagramBuilder()
    scene_graph, plant = make_scene(builder, scenario)
    kinematics = ArmKinematics.from_plant(plant)
    objects = make_task_path(scenario.task, kinematics, scenario.robot).objects
    report = {}
    for name, size in (
        ("position_measured", kinematics.num_joints),
        ("carried_objects", len(objects)),
    ):
        relay = builder.AddNamedSystem(name, PassThrough(size))
        builder.ExportInput(relay.get_input_port(), name)
        report[name] = relay.get_output_port()
    world = add_ring_world(
        builder,
        scenario=scenario,
        scene_graph=scene_graph,
        plant=plant,
        objects=objects,
        **report,
    )
    builder.ExportOutput(scene_graph.get_query_output_port(), "geometry_query")
    builder.ExportOutput(world.people.skeleton, "skeleton")
    diagram = builder.Build()
    diagram.set_name("ring_world")
    return diagram


def _show_robot_and_objects(builder, objects, scene_graph, plant, report):
    """Poses the visible robot and objects from the robot's report."""
    kinematics = ArmKinematics.from_plant(plant)
    carrier = builder.AddNamedSystem(
        "objects",
        ObjectCarrier(objects=objects, kinematics=kinematics),
    )
    for name, port in report.items():
        builder.Connect(port, carrier.GetInputPort(name))
    positions = builder.AddNamedSystem(
        "positions",
        Multiplexer([kinematics.num_joints, 7 * len(objects)]),
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
