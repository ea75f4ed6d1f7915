"""The robot's side of the cell, which the monitor watches and slows down."""

import dataclasses as dc

from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import PassThrough

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.sim_arm import Simulated, make_sim_arm
from tofssm_drake.diagrams.people import People
from tofssm_drake.diagrams.ring_world import add_ring_world, make_scene
from tofssm_drake.diagrams.scenario import Scenario, find_links
from tofssm_drake.diagrams.tasks import make_task_path, require_supported
from tofssm_drake.errors import UserError
from tofssm_drake.messages import make_empty_separation
from tofssm_drake.tasks.path import ProgramPath
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
    path: ProgramPath
    """The task's nominal motion."""
    program: TaskProgram | None = None
    """What follows it; None: a real robot's own program, of which only the
    gripper's actions are known."""

    @property
    def nominal_duration(self) -> float:
        """Duration of the task at full speed, s."""
        return self.path.duration


def make_station(scenario: Scenario) -> Station:
    """Makes the simulated cell: robot, program, rings, person, products.

    .. pydrake_system::

        name: station
        input_ports:
        - speed_fraction
        - separation
        output_ports:
        - scan_<ring>
        - position_measured
        - velocity_measured
        - carried_objects
        - products_placed
        - task_done
        - geometry_query
        - skeleton

    The monitor may read the scans and the robot's report (`position_measured`
    to `carried_objects`). `products_placed` and `task_done` say how far the
    task is; the last two ports are ground truth, for evaluation and display
    only.

    It ignores `separation`: the port is there since the station of a real robot
    (`make_hardware_station`) has it, and one may take the other's place.

    With the sensing `lidar` there is `scan_lidar` in place of the rings' scans;
    with `ideal` there are no scans.

    Args:
        scenario: Checked settings.

    Returns:
        The station.

    Raises:
        UserError: The scenario's driver is a real robot.
    """
    driver = scenario.driver
    if not isinstance(driver, Simulated):
        raise UserError(
            f"driver: !{type(driver).__name__} is a real robot: run it with "
            "tofssm hardware, or simulate the cell with --scenario-text "
            "'{driver: !Simulated {}}'"
        )
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
    _require_supported(scenario, program.path)
    robot, _ = make_sim_arm(
        config=driver,
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
        objects=program.path.objects,
        carried_objects=program.GetOutputPort("carried_objects"),
    )
    builder.ExportInput(
        program.GetInputPort("speed_fraction"), "speed_fraction"
    )
    ignored = builder.AddNamedSystem(
        "ignored_separation",
        PassThrough(Value(make_empty_separation(find_links(scenario)))),
    )
    builder.ExportInput(ignored.get_input_port(), "separation")
    for name in ("position_measured", "velocity_measured"):
        builder.ExportOutput(robot.GetOutputPort(name), name)
    for name in ("carried_objects", "products_placed", "task_done"):
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
        path=program.path,
        program=program,
    )


def _require_supported(scenario, path):
    """Raises UserError unless every product rests on something."""
    scene_graph = SceneGraph()
    cell = make_cell_plant(
        workcell=scenario.workcell,
        arm=scenario.robot,
        scene_graph=scene_graph,
    )
    require_supported(path.objects, cell, scene_graph, path.calc_motion(0.0)[0])
