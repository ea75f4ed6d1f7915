"""A simulated arm: rigid-body dynamics under limits of effort.

The plant has no geometry: contact is not part of this simulation, so its
steps cost neither collision queries nor the poses of everything that moves
in the cell. What is seen of the robot is posed from `position_measured`, as
it is for a real robot.
"""

import dataclasses as dc

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import (
    Demultiplexer,
    MatrixGain,
    Multiplexer,
    Saturation,
    SharedPointerSystem,
)

from tofssm_drake.arms.arm import ArmModel, make_arm_plant
from tofssm_drake.errors import require


@dc.dataclass(kw_only=True)
class Simulated:
    """Dynamics and controller of the simulated robot."""

    # Time step of the dynamics, s. The control tick must be a multiple of it.
    time_step: float = 0.008

    # Natural frequency of the joint controller's error, rad/s, critically
    # damped (assumed: UR publishes nothing about its controller).
    stiffness: float = 40.0

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        require(
            1e-5 <= self.time_step <= 0.008,
            f"{where}.time_step: must be from 0.00001 to 0.008 s, "
            f"got {self.time_step:g}",
        )
        require(
            0 < self.stiffness * self.time_step <= 0.5,
            f"{where}.stiffness: must be within (0, "
            f"{0.5 / self.time_step:g}] rad/s at a time step of "
            f"{self.time_step:g} s, got {self.stiffness:g}",
        )


def make_inverse_dynamics_controller(
    *, plant: MultibodyPlant, stiffness: float, time_step: float = 0.0
) -> Diagram:
    """Makes a computed-torque controller without integral action.

    .. pydrake_system::

        name: inverse_dynamics_controller
        input_ports:
        - motion_commanded
        - state_estimated
        output_ports:
        - generalized_force

    vdd = qdd_d + 2 w (qd_s - qd) + w^2 (q_d - q), tau = inverse dynamics of
    vdd, where qd_s = qd_d - h/2 qdd_d: the velocity of a plant in discrete
    time is that of the last step, (q(t) - q(t - h)) / h. With qd_d instead the
    robot would run ahead of its command.

    Drake's InverseDynamicsController does the same, but also integrates the
    error in continuous state; without that state a simulation of a discrete
    plant needs no integrator.

    Args:
        plant: The robot alone, with what it carries.
        stiffness: Natural frequency w of the error, rad/s.
        time_step: h of the plant that is controlled, s; 0 is continuous.
    """
    n = plant.num_positions()
    builder = DiagramBuilder()
    one = np.eye(n)
    w = stiffness
    # Of [q_d, qd_d, qdd_d, q, qd].
    gain = np.hstack(
        [
            w * w * one,
            2 * w * one,
            (1 - w * time_step) * one,
            -w * w * one,
            -2 * w * one,
        ]
    )
    stack = builder.AddNamedSystem(
        "commanded_and_estimated", Multiplexer([3 * n, 2 * n])
    )
    feedback = builder.AddNamedSystem("acceleration", MatrixGain(D=gain))
    dynamics = builder.AddNamedSystem(
        "inverse_dynamics",
        InverseDynamics(
            plant, InverseDynamics.InverseDynamicsMode.kInverseDynamics
        ),
    )
    # InverseDynamics keeps a bare pointer: the Diagram keeps the plant alive.
    builder.AddNamedSystem("model", SharedPointerSystem(plant))
    builder.ExportInput(stack.get_input_port(0), "motion_commanded")
    builder.ExportInput(stack.get_input_port(1), "state_estimated")
    builder.ConnectInput(
        "state_estimated", dynamics.get_input_port_estimated_state()
    )
    builder.Connect(stack.get_output_port(), feedback.get_input_port())
    builder.Connect(
        feedback.get_output_port(),
        dynamics.get_input_port_desired_acceleration(),
    )
    builder.ExportOutput(dynamics.get_output_port(), "generalized_force")
    diagram = builder.Build()
    diagram.set_name("inverse_dynamics_controller")
    return diagram


def make_sim_arm(
    *,
    config: Simulated,
    arm: ArmModel,
    initial_position: np.ndarray,
) -> tuple[Diagram, MultibodyPlant]:
    """Makes the simulated robot.

    .. pydrake_system::

        name: sim_arm
        input_ports:
        - motion_commanded
        output_ports:
        - position_commanded
        - position_measured
        - velocity_measured
        - torque_commanded
        - body_poses
        - body_spatial_velocities

    Joint vectors have n elements, base to tool: rad, rad/s, Nm, or m, m/s, N
    of a joint that slides. `motion_commanded` is [q, qd, qdd] (3 n).
    `torque_commanded` is what the motors get, within their limits; a motor
    whose model has no limit gets all that is asked for. `body_poses` and
    `body_spatial_velocities` are of the arm and its tool alone, in the body
    order of the plant that is returned.

    Args:
        config: Settings; checked.
        arm: Checked.
        initial_position: Where the arm is at the start, at rest, (n,).

    Returns:
        The Diagram and the plant in it.
    """
    config.check("robot")
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem(
        "plant", make_arm_plant(arm, time_step=config.time_step)
    )
    n = plant.num_positions()
    plant.SetDefaultPositions(initial_position)
    controller = builder.AddSystem(
        make_inverse_dynamics_controller(
            plant=make_arm_plant(arm),
            stiffness=config.stiffness,
            time_step=config.time_step,
        )
    )
    limit = arm.read_limits().effort
    motors = builder.AddNamedSystem(
        "torque_limits", Saturation(min_value=-limit, max_value=limit)
    )
    measured = builder.AddNamedSystem("measured", Demultiplexer([n, n]))
    commanded = builder.AddNamedSystem("commanded", Demultiplexer([n, 2 * n]))

    builder.ExportInput(
        controller.GetInputPort("motion_commanded"), "motion_commanded"
    )
    builder.ConnectInput("motion_commanded", commanded.get_input_port())
    builder.Connect(
        plant.get_state_output_port(),
        controller.GetInputPort("state_estimated"),
    )
    builder.Connect(
        controller.GetOutputPort("generalized_force"), motors.get_input_port()
    )
    builder.Connect(
        _order_actuation(builder, plant, motors.get_output_port()),
        plant.get_actuation_input_port(),
    )
    builder.Connect(plant.get_state_output_port(), measured.get_input_port())

    builder.ExportOutput(commanded.get_output_port(0), "position_commanded")
    builder.ExportOutput(measured.get_output_port(0), "position_measured")
    builder.ExportOutput(measured.get_output_port(1), "velocity_measured")
    builder.ExportOutput(motors.get_output_port(), "torque_commanded")
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
    builder.ExportOutput(
        plant.get_body_spatial_velocities_output_port(),
        "body_spatial_velocities",
    )
    diagram = builder.Build()
    diagram.set_name("sim_arm")
    return diagram, plant


def _order_actuation(builder, plant, joint_efforts):
    """Returns the port of the efforts in the order of the plant's actuators.

    A description may list its motors in another order than its joints.
    """
    order = plant.MakeActuationMatrix().T
    if np.array_equal(order, np.eye(len(order))):
        return joint_efforts
    gain = builder.AddNamedSystem("actuator_order", MatrixGain(D=order))
    builder.Connect(joint_efforts, gain.get_input_port())
    return gain.get_output_port()
