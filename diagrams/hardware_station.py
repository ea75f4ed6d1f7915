"""The real robot's side of the cell, with the simulated station's ports."""

import dataclasses as dc

from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.limits import ArmLimits
from tofssm_drake.diagrams.drivers import find_real_cell
from tofssm_drake.diagrams.held_connections import HeldRings, HeldRobot
from tofssm_drake.diagrams.ring_world import add_ring_world, make_scene
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.diagrams.station import Station
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.errors import require
from tofssm_drake.laws.sensing_problem import SensingProblem
from tofssm_drake.ringlink.ring_systems import (
    RingInterfaceSystem,
    RingSubscriberSystem,
)
from tofssm_drake.rtde.rtde_systems import (
    RobotReportReceiver,
    RtdeInterfaceSystem,
    RtdePublisherSystem,
    RtdeSubscriberSystem,
    SliderControl,
)
from tofssm_drake.rtde.slider import SliderConfig

# Ports of the receiver that are the station's, in order.
_REPORTED = (
    "position_measured",
    "velocity_measured",
    "carried_objects",
    "products_placed",
    "task_done",
)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class HardwareStation(Station):
    """A station with a real robot, and the parts that its loop uses."""

    robot: HeldRobot
    """Shows the report that the monitor sees."""
    rings: HeldRings | None
    """Shows the scans; None: the rings are virtual."""


def make_hardware_station(
    scenario: Scenario,
    *,
    robot: HeldRobot,
    rings: HeldRings | None = None,
    slider: SliderConfig | None = None,
) -> HardwareStation:
    """Makes the real cell: robot and rings as reported, and a twin for display.

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

    The ports and their order are those of `make_station`. The slider's control
    sees from `separation` whether the sensing is fresh and healthy. A real
    person is unknown: the scene has none, and `skeleton` is empty.

    Commands are sent only in forced publish events of `robot_publisher`: once
    per report, after the monitor has seen it.

    Args:
        scenario: Checked settings; rings on the arm.
        robot: Where reports come from and commands go.
        rings: Where scans come from; None simulates them in the twin, around
            the real robot and with the scenario's person.
        slider: Settings of the slider; None: the scenario's.

    Returns:
        The station.

    Raises:
        UserError: The driver is not for such an arm.
    """
    builder = DiagramBuilder()
    seen = scenario
    if rings is not None:
        # Nobody is simulated whom the twin could see.
        seen = dc.replace(scenario, people={}, obstacles={})
    scene_graph, plant = make_scene(builder, seen)
    kinematics = ArmKinematics.from_plant(plant)
    driver = find_real_cell(scenario.driver)
    require(
        driver.traits.joints in (None, kinematics.num_joints),
        f"robot: {driver.traits.name} is for arms of {driver.traits.joints} "
        f"joints, this one has {kinematics.num_joints}",
    )
    path = make_task_path(scenario.task, kinematics, scenario.robot)
    subscriber, receiver, commanded = _add_robot(
        builder,
        robot,
        RobotReportReceiver(
            path=path,
            joints=kinematics.num_joints,
            find_carried_objects=driver.find_carried_objects,
        ),
    )
    if rings is not None:
        _add_rings(builder, rings, tuple(find_rings(scenario.sensors)))
    world = add_ring_world(
        builder,
        scenario=seen,
        scene_graph=scene_graph,
        plant=plant,
        position_measured=receiver.GetOutputPort("position_measured"),
        objects=path.objects,
        carried_objects=receiver.GetOutputPort("carried_objects"),
        with_sensors=rings is None,
    )
    slider = dc.replace(
        make_slider_config(scenario) if slider is None else slider,
        joint_speeds=tuple(ArmLimits.from_plant(plant).speed.tolist()),
    )
    _add_slider(
        builder, subscriber, commanded, slider, scenario.law.traits.deadline
    )
    for name in _REPORTED:
        builder.ExportOutput(receiver.GetOutputPort(name), name)
    builder.ExportOutput(scene_graph.get_query_output_port(), "geometry_query")
    builder.ExportOutput(world.people.skeleton, "skeleton")
    diagram = builder.Build()
    diagram.set_name("station")
    return HardwareStation(
        diagram=diagram,
        plant=plant,
        scene_graph=scene_graph,
        people=world.people,
        path=path,
        robot=robot,
        rings=rings,
    )


def make_slider_config(scenario: Scenario) -> SliderConfig:
    """Returns the scenario's settings of the slider.

    The joints' speeds are not yet those of its robot.

    Args:
        scenario: Checked settings.
    """
    driver = find_real_cell(scenario.driver)
    return SliderConfig(
        **vars(driver.slider),
        arm=driver.checks.arm,
        has_echo=driver.traits.has_echo,
        reduced_fraction=scenario.law.traits.reduced_fraction,
    )


def _add_robot(builder, robot, receiver):
    """Adds the systems that read the robot.

    Returns:
        Subscriber, receiver, and the connection for commands.
    """
    interface = builder.AddNamedSystem(
        "robot_interface", RtdeInterfaceSystem(connection=robot)
    )
    subscriber = builder.AddNamedSystem(
        "robot_subscriber",
        RtdeSubscriberSystem(connection=interface.connection, wait_timeout=0.0),
    )
    builder.AddNamedSystem("robot_report_receiver", receiver)
    builder.Connect(
        subscriber.GetOutputPort("report"), receiver.GetInputPort("report")
    )
    return subscriber, receiver, interface.connection


def _add_rings(builder, rings, name):
    """Adds the systems that read the rings, and exports the scans."""
    interface = builder.AddNamedSystem(
        "ring_interface", RingInterfaceSystem(connection=rings)
    )
    subscriber = builder.AddNamedSystem(
        "ring_subscriber",
        RingSubscriberSystem(
            connection=interface.connection, wait_timeout=0.0, name=name
        ),
    )
    # The scans are on the Diagram's clock; one that is ahead of it must wait.
    builder.Connect(
        builder.AddNamedSystem(
            "clock_offset", ConstantVectorSource([0.0])
        ).get_output_port(),
        subscriber.GetInputPort("clock_offset"),
    )
    for ring in name:
        builder.ExportOutput(
            subscriber.GetOutputPort(f"scan_{ring}"), f"scan_{ring}"
        )


def _add_slider(builder, subscriber, robot, config, deadline):
    """Adds the systems that control the slider."""
    problem = builder.AddNamedSystem(
        "sensing_problem", SensingProblem(deadline=deadline)
    )
    control = builder.AddNamedSystem(
        "slider_control", SliderControl(config=config, connection=robot)
    )
    builder.Connect(
        subscriber.GetOutputPort("report"), control.GetInputPort("report")
    )
    builder.Connect(
        problem.GetOutputPort("problem"), control.GetInputPort("problem")
    )
    publisher = builder.AddNamedSystem(
        "robot_publisher", RtdePublisherSystem(connection=robot)
    )
    builder.Connect(
        control.GetOutputPort("command"), publisher.GetInputPort("command")
    )
    builder.ExportInput(
        control.GetInputPort("speed_fraction"), "speed_fraction"
    )
    builder.ExportInput(problem.GetInputPort("separation"), "separation")
