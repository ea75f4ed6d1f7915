"""The robot's side of the cell, which the monitor watches and slows down."""

import dataclasses as dc

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.sim_arm import make_sim_arm
from tofssm_drake.diagrams.people import People
from tofssm_drake.diagrams.ring_world import add_ring_world, make_scene
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.tasks import make_task_path, require_supported
from tofssm_drake.tasks.program import TaskProgram


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Station:
    """A station's Diagram and what is needed to read its ports."""

    diagram: Diagram
    plant: MultibodyPlant
    """Robot, cell and products as registered with `scene_graph`."""
    scene_graph: SceneGraph
    """The world that the rings see."""
    people: People
    """Those of the port `skeleton`."""
    nominal_duration: float
    """Duration of the task at full speed, s."""


def make_station(scenario: Scenario) -> Station:
    """Makes the simulated cell: robot, program, rings, person, products.

    .. pydrake_system::

        name: station
        input_ports:
        - speed_fraction
        output_ports:
        - scan_<ring>
        - position_measured
        - velocity_measured
        - gripper_closed
        - products_placed
        - task_done
        - geometry_query
        - skeleton

    The monitor may read the scans and the robot's report (`position_measured`
    to `products_placed`). The last two ports are ground truth, for evaluation
    and display only.

    With the sensing `lidar` there is `scan_lidar` in place of the rings' scans;
    with `ideal` there are no scans.

    Args:
        scenario: Checked settings.

    Returns:
        The station.
    """
    builder = DiagramBuilder()
    scene_graph, plant = make_scene(builder, scenario)
    kinematics = ArmKinematics.from_plant(plant)

    program = builder.AddNamedSystem(
        "program",
        TaskProgram(
            path=make_task_path(scenario.task, kinematics, scenario.robot),
            period=scenario.control_period,
        ),
    )
    _require_supported(scenario, program.path.calc_motion(0.0)[0])
    robot, _ = make_sim_arm(
        config=scenario.driver,
        arm=scenario.robot,
        initial_position=program.path.calc_motion(0.0)[0],
    )
    builder.AddSystem(robot)
    builder.Connect(
        program.GetOutputPort("motion_commanded"),
        robot.GetInputPort("motion_commanded"),
    )

    world = add_ring_world(
        builder,
        scenario=scenario,
        scene_graph=scene_graph,
        plant=plant,
        position_measured=robot.GetOutputPort("position_measured"),
        gripper_closed=program.GetOutputPort("gripper_closed"),
        products_placed=program.GetOutputPort("products_placed"),
    )
    builder.ExportInput(
        program.GetInputPort("speed_fraction"), "speed_fraction"
    )
    for name in ("position_measured", "velocity_measured"):
        builder.ExportOutput(robot.GetOutputPort(name), name)
    for name in ("gripper_closed", "products_placed", "task_done"):
        builder.ExportOutput(program.GetOutputPort(name), name)
    builder.ExportOutput(scene_graph.get_query_output_port(), "geometry_query")
    builder.ExportOutput(world.people.skeleton, "skeleton")

    diagram = builder.Build()
    diagram.set_name("station")
    return Station(
        diagram=diagram,
        plant=plant,
        scene_graph=scene_graph,
        people=world.people,
        nominal_duration=program.path.duration,
    )


def _require_supported(scenario, q):
    """Raises UserError unless every product rests on something."""
    scene_graph = SceneGraph()
    cell = make_cell_plant(arm=scenario.robot, scene_graph=scene_graph)
    require_supported(scenario.task, cell, scene_graph, q)
