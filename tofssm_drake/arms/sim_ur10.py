"""A simulated UR10: rigid-body dynamics under torque limits.

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

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.errors import require


@dc.dataclass(kw_only=True)
class SimUr10Config:
    """Dynamics and controller of the simulated robot."""

    # Time step of the dynamics, s. The control tick must be a multiple of it.
    time_step: float = 0.008

    # Natural frequency of the joint controller's error, rad/s, critically
    # damped (assumed: UR publishes nothing about its controller).
    stiffness: float = 40.0

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        require(
            0 < self.time_step <= 0.008,
            f"{where}.time_step: must be within (0, 0.008] s, "
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


def make_sim_ur10(
    *,
    config: SimUr10Config,
    initial_position: np.ndarray,
) -> tuple[Diagram, MultibodyPlant]:
    """Makes the simulated robot.

    .. pydrake_system::

        name: sim_ur10
        input_ports:
        - motion_commanded
        output_ports:
        - position_commanded
        - position_measured
        - velocity_measured
        - torque_commanded
        - body_poses
        - body_spatial_velocities

    Joint vectors have six elements in UR's order: rad, rad/s, Nm.
    `motion_commanded` is [q, qd, qdd] (18). `torque_commanded` is what the
    motors get, within their limits. `body_poses` and
    `body_spatial_velocities` are of the robot and its gripper alone, in the
    body order of the plant that is returned.

    Args:
        config: Settings; checked.
        initial_position: Where the robot is at the start, at rest, rad, (6,).

    Returns:
        The Diagram and the plant in it.
    """
    config.check("robot")
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem(
        "plant",
        make_cell_plant(cell=False, time_step=config.time_step),
    )
    plant.SetDefaultPositions(initial_position)
    model = make_cell_plant(cell=False)
    controller = builder.AddSystem(
        make_inverse_dynamics_controller(
            plant=model,
            stiffness=config.stiffness,
            time_step=config.time_step,
        )
    )
    limit = plant.GetEffortUpperLimits()
    motors = builder.AddNamedSystem(
        "torque_limits", Saturation(min_value=-limit, max_value=limit)
    )
    measured = builder.AddNamedSystem("measured", Demultiplexer([6, 6]))
    commanded = builder.AddNamedSystem("commanded", Demultiplexer([6, 12]))
    robot = plant.GetModelInstanceByName("ur10")

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
        motors.get_output_port(), plant.get_actuation_input_port(robot)
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
    diagram.set_name("sim_ur10")
    return diagram, plant
