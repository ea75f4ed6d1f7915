import functools
from pathlib import Path
import tempfile
import unittest

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LogVectorOutput,
    TrajectorySource,
)
from pydrake.trajectories import PiecewisePolynomial
from robots import CHAINS, make_panda, make_urdf

from tofssm_drake.arms.arm import Arm, make_arm_plant
from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
import tofssm_drake.arms.sim_arm as mut
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.errors import UserError
from tofssm_drake.tasks.program import (
    PickAndPlace,
    TaskProgram,
    make_program_path,
)

LIMIT = np.array([330, 330, 150, 56, 56, 56])


@functools.cache
def make_kinematics():
    return ArmKinematics.from_plant(make_cell_plant())


@functools.cache
def make_robot():
    return mut.make_sim_arm(
        config=mut.Simulated(), arm=UrArm(), initial_position=np.zeros(6)
    )[0]


def run(duration, *, time_step=0.004, fraction=1.0):
    """Returns logs of position commanded, measured, velocity, torque."""
    builder = DiagramBuilder()
    program = builder.AddSystem(
        TaskProgram(path=make_program_path(PickAndPlace(), make_kinematics()))
    )
    robot, _ = mut.make_sim_arm(
        config=mut.Simulated(time_step=time_step),
        arm=UrArm(),
        initial_position=program.path.calc_motion(0.0)[0],
    )
    builder.AddSystem(robot)
    source = builder.AddSystem(ConstantVectorSource([fraction]))
    builder.Connect(source.get_output_port(), program.get_input_port())
    builder.Connect(
        program.GetOutputPort("motion_commanded"),
        robot.GetInputPort("motion_commanded"),
    )
    logs = [
        LogVectorOutput(robot.GetOutputPort(name), builder, 0.008)
        for name in (
            "position_commanded",
            "position_measured",
            "velocity_measured",
            "torque_commanded",
        )
    ]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    context = simulator.get_context()
    return [log.FindLog(context).data().T.copy() for log in logs]


class TestSimUr10(unittest.TestCase):
    def test_ports(self):
        dut = make_robot()
        self.assertEqual(dut.get_input_port(0).get_name(), "motion_commanded")
        self.assertEqual(dut.num_input_ports(), 1)
        self.assertEqual(
            [
                dut.get_output_port(i).get_name()
                for i in range(dut.num_output_ports())
            ],
            [
                "position_commanded",
                "position_measured",
                "velocity_measured",
                "torque_commanded",
                "body_poses",
                "body_spatial_velocities",
            ],
        )
        for name in ("position_measured", "velocity_measured", "body_poses"):
            self.assertFalse(
                dut.HasDirectFeedthrough(dut.GetOutputPort(name).get_index())
            )

    def test_no_continuous_state(self):
        """A discrete plant alone needs no integrator."""
        dut = make_robot()
        context = dut.CreateDefaultContext()
        self.assertFalse(context.has_only_continuous_state())
        self.assertEqual(context.num_continuous_states(), 0)

    def test_tracks_the_task(self):
        """Checks one product, with both time steps: the tool stays within
        0.3 mm of where it should be, well under the torque limits."""
        for time_step in (0.004, 0.008):
            commanded, measured, velocity, torque = run(
                4.6, time_step=time_step
            )
            kinematics = make_kinematics()
            error = [
                np.linalg.norm(
                    kinematics.calc_tcp_pose(a)[:, 3]
                    - kinematics.calc_tcp_pose(b)[:, 3]
                )
                for a, b in zip(commanded, measured, strict=True)
            ]
            self.assertLess(max(error), 0.0003)
            speed = [
                np.linalg.norm(kinematics.calc_sites(q, qd)[1][-1])
                for q, qd in zip(measured, velocity, strict=True)
            ]
            self.assertAlmostEqual(max(speed), 1.7, delta=0.005)
            self.assertLess((np.abs(torque) / LIMIT).max(), 0.8)

    def test_stands_still(self):
        commanded, measured, velocity, _ = run(0.2, fraction=0.0)
        np.testing.assert_allclose(measured, commanded, atol=1e-9)
        np.testing.assert_allclose(velocity, 0, atol=1e-9)

    def test_repeats_exactly(self):
        first, second = run(0.5), run(0.5)
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a, b)

    def test_torque_is_limited(self):
        """A wild command gets no more than the motors have."""
        dut = make_robot()
        context = dut.CreateDefaultContext()
        wild = np.concatenate([np.full(6, 3.0), np.zeros(12)])
        dut.GetInputPort("motion_commanded").FixValue(context, wild)
        torque = dut.GetOutputPort("torque_commanded").Eval(context)
        self.assertTrue(np.all(np.abs(torque) <= LIMIT))
        self.assertEqual(torque[0], 330)

    def test_wrong_settings_are_named(self):
        for settings, name in (
            ({"time_step": 0.0}, "time_step"),
            ({"time_step": 0.02}, "time_step"),
            ({"stiffness": 1000.0}, "stiffness"),
        ):
            with self.assertRaisesRegex(UserError, rf"robot\.{name}: "):
                mut.Simulated(**settings).check("robot")


class TestAnyArm(unittest.TestCase):
    """A seven-joint arm, and one whose motors have no limit."""

    def follow(self, arm, start, goal):
        """Returns the error at the end of a smooth motion, and torques."""
        builder = DiagramBuilder()
        robot, _ = mut.make_sim_arm(
            config=mut.Simulated(), arm=arm, initial_position=start
        )
        builder.AddSystem(robot)
        # Speed and acceleration are zero at both ends.
        path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            [0.0, 0.5, 1.0],
            np.column_stack([start, 0.5 * (start + goal), goal]),
            np.zeros(len(start)),
            np.zeros(len(start)),
        )
        source = builder.AddSystem(
            TrajectorySource(path, 2, zero_derivatives_beyond_limits=True)
        )
        builder.Connect(
            source.get_output_port(), robot.GetInputPort("motion_commanded")
        )
        log = LogVectorOutput(
            robot.GetOutputPort("torque_commanded"), builder, 0.008
        )
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(1.2)
        context = robot.GetMyContextFromRoot(simulator.get_context())
        q = robot.GetOutputPort("position_measured").Eval(context)
        torque = log.FindLog(simulator.get_context()).data()
        return np.abs(q - goal).max(), np.abs(torque).max(axis=1)

    def test_seven_joints(self):
        arm = make_panda()
        start = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785])
        goal = start + np.array([0.3, 0.2, -0.2, 0.3, 0.1, -0.2, 0.3])
        error, torque = self.follow(arm, start, goal)
        self.assertLess(error, 1e-3)
        self.assertTrue(np.all(torque <= arm.read_limits().effort))
        self.assertGreater(torque[1], 5.0)

    def test_ur5e_does_the_task(self):
        """Pick and place nearer to the base than the UR10's, one product."""
        arm = UrArm(model="ur5e")
        kinematics = ArmKinematics.from_plant(make_arm_plant(arm))
        config = PickAndPlace(
            products=1,
            hover_radius=0.55,
            sweep_speed=1.0,
            approach_speed=0.6,
            pick_center=[0.0, -0.55, 0.7275],
            place_center=[0.0, 0.55, 0.7335],
        )
        path = make_program_path(config, kinematics)
        limits = arm.read_limits()
        motions = np.array(
            [path.calc_motion(s) for s in np.arange(0, path.duration, 0.02)]
        )
        self.assertTrue(np.all(np.abs(motions[:, 1]) <= limits.speed))
        self.assertTrue(np.all(motions[:, 0] >= limits.lower))
        self.assertTrue(np.all(motions[:, 0] <= limits.upper))
        builder = DiagramBuilder()
        program = builder.AddSystem(
            TaskProgram(path=make_program_path(config, kinematics))
        )
        robot, _ = mut.make_sim_arm(
            config=mut.Simulated(),
            arm=arm,
            initial_position=path.calc_motion(0.0)[0],
        )
        builder.AddSystem(robot)
        source = builder.AddSystem(ConstantVectorSource([1.0]))
        builder.Connect(source.get_output_port(), program.get_input_port())
        builder.Connect(
            program.GetOutputPort("motion_commanded"),
            robot.GetInputPort("motion_commanded"),
        )
        logs = [
            LogVectorOutput(robot.GetOutputPort(name), builder, 0.008)
            for name in (
                "position_commanded",
                "position_measured",
                "torque_commanded",
            )
        ]
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(path.duration)
        commanded, measured, torque = (
            log.FindLog(simulator.get_context()).data().T for log in logs
        )
        for a, b in zip(commanded[::5], measured[::5], strict=True):
            np.testing.assert_allclose(
                kinematics.calc_tcp_pose(a)[:, 3],
                kinematics.calc_tcp_pose(b)[:, 3],
                atol=5e-4,
            )
        self.assertTrue(np.all(np.abs(torque) < limits.effort))

    def test_without_limit(self):
        urdf = make_urdf(CHAINS["tilted"], tool="link_6")
        urdf = urdf.replace(' effort="50"', "")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(urdf)
            arm = Arm(file=str(path), tool="", joint_acceleration=[5.0] * 4)
            arm.check("robot")
            self.assertTrue(np.isinf(arm.read_limits().effort).all())
            error, torque = self.follow(
                arm, np.zeros(4), np.array([0.2, -0.3, 0.1, 0.4])
            )
        self.assertLess(error, 1e-3)
        self.assertTrue(np.isfinite(torque).all())

    def test_motors_in_another_order(self):
        """Torques go to the joints, however the description lists motors."""
        urdf = make_urdf(CHAINS["seven joints"], tool="link_7")
        motors = "".join(
            f"<transmission name='t{i}'><type>transmission_interface/"
            f"SimpleTransmission</type><joint name='joint_{i}'/>"
            f"<actuator name='m{i}'/></transmission>"
            for i in (3, 1, 2, 7, 5, 6, 4)
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(urdf.replace("</robot>", motors + "</robot>"))
            arm = Arm(
                file=str(path),
                tool="",
                joint_acceleration=[5.0] * 7,
                joint_effort=[500.0, 501.0, 502.0, 503.0, 504.0, 505.0, 506.0],
            )
            np.testing.assert_array_equal(
                arm.read_limits().effort, arm.joint_effort
            )
            error, _ = self.follow(arm, np.zeros(7), np.full(7, 0.2))
        self.assertLess(error, 1e-3)
