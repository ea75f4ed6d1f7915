import unittest

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantValueSource,
    ConstantVectorSource,
)
from robot_room import make_path, make_robot, serve

from tofssm_drake.carried_objects import ON_TOOL
from tofssm_drake.diagrams.drivers import Rtde
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.robots.robot_connection import (
    LoopbackConnection,
    NullConnection,
)
from tofssm_drake.robots.robot_modes import RuntimeState
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig
import tofssm_drake.rtde.rtde_systems as mut
from tofssm_drake.rtde.slider import SliderPhase


def make_report(sequence, **changes):
    """Returns the report of a robot at work."""
    return RobotReport(
        **{
            "sequence": sequence,
            "session": 0,
            "timestamp": 50 + 0.008 * sequence,
            "position": np.full(6, 0.1 * sequence),
            "velocity": np.zeros(6),
            "robot_mode": 7,
            "safety_mode": 1,
            "runtime_state": 2,
            "target_speed_fraction": 0.0,
        }
        | changes
    )


class Loop:
    """All five systems on a connection, with a given speed fraction."""

    def __init__(self, connection, *, wait_timeout=1.0):
        self.connection = connection
        builder = DiagramBuilder()

        def add(name, system):
            setattr(self, name, builder.AddNamedSystem(name, system))

        add(
            "interface",
            mut.RtdeInterfaceSystem(
                connection=connection, url="rtde://192.0.2.1:30004"
            ),
        )
        add(
            "subscriber",
            mut.RtdeSubscriberSystem(
                connection=connection, wait_timeout=wait_timeout
            ),
        )
        add("receiver", mut.RobotReportReceiver(path=make_path()))
        add("control", mut.SliderControl())
        add("publisher", mut.RtdePublisherSystem(connection=connection))
        add("wanted", ConstantVectorSource([0.8]))
        report = self.subscriber.get_output_port()
        builder.Connect(report, self.receiver.get_input_port())
        builder.Connect(report, self.control.GetInputPort("report"))
        builder.Connect(
            self.wanted.get_output_port(),
            self.control.GetInputPort("speed_fraction"),
        )
        self.well = builder.AddSystem(ConstantValueSource(Value("")))
        builder.Connect(
            self.well.get_output_port(), self.control.GetInputPort("problem")
        )
        builder.Connect(
            self.control.GetOutputPort("command"),
            self.publisher.get_input_port(),
        )
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()

    def initialize(self):
        self.simulator.Initialize()
        self.context.SetTime(self.connection.get_report().timestamp)
        self.simulator.Initialize()

    def eval(self, system, port):
        return system.GetOutputPort(port).Eval(
            system.GetMyContextFromRoot(self.context)
        )

    def set_wanted(self, fraction):
        self.wanted.get_mutable_source_value(
            self.wanted.GetMyMutableContextFromRoot(self.context)
        ).SetFromVector([fraction])

    def step(self, report):
        self.simulator.AdvanceTo(report.timestamp)
        self.publisher.ForcedPublish(
            self.publisher.GetMyContextFromRoot(self.context)
        )


class TestSubscriber(unittest.TestCase):
    def test_waits_and_reports_if_nothing_comes(self):
        loop = Loop(LoopbackConnection(), wait_timeout=0.01)
        with self.assertRaisesRegex(
            UserError, "no report from the robot within 0.01 s: it is silent"
        ):
            loop.simulator.Initialize()
        with self.assertRaisesRegex(UserError, "wait_timeout"):
            mut.RtdeSubscriberSystem(
                connection=NullConnection(), wait_timeout=-1
            )

    def test_waits_for_a_new_report(self):
        connection = LoopbackConnection()
        connection.put(make_report(0))
        dut = mut.RtdeSubscriberSystem(connection=connection, wait_timeout=0.01)
        with self.assertRaises(UserError):
            Simulator(dut).Initialize()

    def test_output_changes_in_updates_only(self):
        connection = LoopbackConnection()
        dut = mut.RtdeSubscriberSystem(connection=connection, wait_timeout=0)
        simulator = Simulator(dut)
        simulator.Initialize()
        context = simulator.get_mutable_context()
        self.assertEqual(dut.get_output_port().Eval(context).sequence, -1)
        report = make_report(0)
        connection.put(report)
        self.assertEqual(dut.get_output_port().Eval(context).sequence, -1)
        clone = context.Clone()
        simulator.AdvanceTo(0.001)
        self.assertIs(dut.get_output_port().Eval(context), report)
        self.assertEqual(dut.get_output_port().Eval(clone).sequence, -1)

    def test_null(self):
        loop = Loop(NullConnection(), wait_timeout=0)
        loop.simulator.Initialize()
        loop.step(make_report(0))
        self.assertEqual(
            loop.eval(loop.control, "slider").phase, SliderPhase.WAITING
        )


class TestReceiver(unittest.TestCase):
    def calc(self, report, path=None, **settings):
        dut = mut.RobotReportReceiver(path=path or make_path(), **settings)
        context = dut.CreateDefaultContext()
        dut.get_input_port().FixValue(context, report)
        return {
            dut.get_output_port(i).get_name(): dut.get_output_port(i).Eval(
                context
            )
            for i in range(dut.num_output_ports())
        }

    def test_ports(self):
        six = np.arange(6.0)
        ports = self.calc(
            make_report(
                0,
                position=six,
                velocity=six + 1,
                acceleration_commanded=six + 2,
                tcp_pose=six + 3,
                tcp_velocity=six + 4,
                digital_outputs=0b1000,
                products_placed=4,
                target_speed_fraction=0.3,
                speed_scaling=0.9,
            ),
            find_carried_objects=Rtde(gripper_output=3).find_carried_objects,
            path=make_path(5),
        )
        for i, name in enumerate(
            (
                "position_measured",
                "velocity_measured",
                "acceleration_commanded",
                "tcp_pose_measured",
                "tcp_velocity_measured",
            )
        ):
            np.testing.assert_array_equal(ports[name], six + i)
        for name, value in (
            ("products_placed", 4.0),
            ("task_done", 0.0),
            ("target_speed_fraction", 0.3),
            ("speed_scaling", 0.9),
        ):
            with self.subTest(name=name):
                self.assertEqual(ports[name].tolist(), [value])
        np.testing.assert_array_equal(
            ports["carried_objects"], [1, 1, 1, 1, ON_TOOL]
        )

    def test_what_is_not_reported(self):
        ports = self.calc(RobotReport())
        self.assertTrue(np.isnan(ports["position_measured"]).all())
        np.testing.assert_array_equal(ports["carried_objects"], [0, 0])
        self.assertEqual(ports["products_placed"], [0])
        self.assertEqual(ports["task_done"], [0])

    def test_task_done_and_other_outputs(self):
        ports = self.calc(
            make_report(0, digital_outputs=0b110111, products_placed=2),
            find_carried_objects=Rtde(gripper_output=3).find_carried_objects,
        )
        np.testing.assert_array_equal(ports["carried_objects"], [1, 1])
        self.assertEqual(ports["task_done"], [1])


class TestLoop(unittest.TestCase):
    def test_commands_answer_the_report_of_their_step(self):
        """Each is sent once, in the step of its report."""
        connection = LoopbackConnection()
        loop = Loop(connection, wait_timeout=0)
        connection.put(make_report(0))
        loop.initialize()
        for i in range(1, 30):
            echo = connection.sent[-1].speed_fraction if i > 1 else 1.0
            report = make_report(i, target_speed_fraction=echo)
            connection.put(report)
            loop.step(report)
            self.assertEqual(len(connection.sent), i)
            self.assertEqual(connection.sent[-1].sequence, i)
            np.testing.assert_array_equal(
                loop.eval(loop.receiver, "position_measured"),
                report.position,
            )
        beats = [command.heartbeat for command in connection.sent]
        self.assertEqual(np.diff(beats).tolist(), [1] * 28)
        self.assertEqual(connection.sent[0].speed_fraction, 0.0)
        self.assertGreater(connection.sent[-1].speed_fraction, 0.3)

    def test_the_last_that_was_published_is_remembered(self):
        """Whatever was computed for a report before the law had seen it."""
        sent = []
        for others in (0, 3):
            connection = LoopbackConnection()
            loop = Loop(connection, wait_timeout=0)
            connection.put(make_report(0))
            loop.initialize()
            echo = 1.0
            for i in range(1, 300):
                report = make_report(i, target_speed_fraction=echo)
                connection.put(report)
                for k in range(others):
                    # Steps before the law's, with its old output.
                    loop.simulator.AdvanceTo(loop.context.get_time() + 0.0005)
                    loop.set_wanted(0.3 * k)
                loop.simulator.AdvanceTo(report.timestamp)
                loop.set_wanted(0.8 if i < 200 else 0.1)
                loop.publisher.ForcedPublish(
                    loop.publisher.GetMyContextFromRoot(loop.context)
                )
                echo = connection.sent[-1].speed_fraction
            sent.append([vars(command) for command in connection.sent])
        self.assertEqual(sent[0], sent[1])
        fractions = [command["speed_fraction"] for command in sent[0]]
        self.assertEqual(fractions[198], 0.8)
        self.assertEqual(fractions[199], 0.1)

    def test_nothing_is_sent_but_when_asked(self):
        connection = LoopbackConnection()
        loop = Loop(connection, wait_timeout=0)
        connection.put(make_report(0))
        loop.initialize()
        for i in range(1, 10):
            connection.put(make_report(i))
            loop.simulator.AdvanceTo(make_report(i).timestamp)
        self.assertEqual(connection.sent, [])
        connection.close()
        loop.step(make_report(10))
        self.assertEqual(connection.sent, [])

    def test_more_steps_than_reports(self):
        """Steps without a new report repeat nothing."""
        connection = LoopbackConnection()
        loop = Loop(connection, wait_timeout=0)
        connection.put(make_report(0))
        loop.initialize()
        connection.put(make_report(1))
        for _ in range(4):
            loop.simulator.AdvanceTo(loop.context.get_time() + 0.001)
        state = loop.eval(loop.control, "slider")
        self.assertEqual(state.command.sequence, 1)
        self.assertLessEqual(state.command.heartbeat, 2)

    def test_feedthrough(self):
        for dut, through in (
            (mut.RtdeSubscriberSystem(connection=NullConnection()), False),
            (mut.RobotReportReceiver(path=make_path()), True),
            (mut.SliderControl(), True),
        ):
            self.assertEqual(dut.HasAnyDirectFeedthrough(), through)

    def test_address_is_in_the_picture(self):
        loop = Loop(NullConnection(), wait_timeout=0)
        self.assertIn(
            "rtde_url=rtde://192.0.2.1:30004", loop.diagram.GetGraphvizString()
        )
        self.assertIs(loop.interface.connection, loop.connection)

    def test_fault_shows_on_its_port(self):
        connection = LoopbackConnection()
        loop = Loop(connection, wait_timeout=0)
        connection.put(make_report(0))
        loop.initialize()
        seen = []
        for i in range(1, 20):
            report = make_report(i, target_speed_fraction=0.9)
            connection.put(report)
            loop.step(report)
            seen.append(loop.eval(loop.control, "slider_obeys")[0])
        self.assertEqual(seen[0], 1.0)
        self.assertEqual(seen[-1], 0.0)


class TestWithRobot(unittest.TestCase):
    def setUp(self):
        self.sequence = -1

    def run_loop(self, loop, until, seconds=5.0):
        """Runs packet by packet; returns the robot's time it took, or fails."""
        start = loop.context.get_time()
        while loop.context.get_time() < start + seconds:
            report = loop.connection.wait_for_report(
                after=self.sequence, timeout=1
            )
            self.assertGreater(report.sequence, self.sequence)
            self.sequence = report.sequence
            loop.step(report)
            if until(report):
                return report.timestamp - start
        state = loop.eval(loop.control, "slider")
        raise AssertionError(f"gave up waiting: {report} {state}")

    def test_over_a_socket(self):
        """A whole loop: rises, is stopped, a person slows it, a pause."""
        robot = make_robot(ramp=0.05)
        with (
            serve(robot) as server,
            RtdeClient(RtdeConfig(port=server.address[1])) as client,
        ):
            loop = Loop(client)
            loop.initialize()

            def stands(report):
                return not report.velocity.any()

            def slider():
                return loop.eval(loop.control, "slider")

            self.run_loop(loop, stands)
            self.run_loop(loop, lambda r: r.target_speed_fraction == 0.8)
            self.run_loop(loop, lambda r: r.velocity.any())
            loop.set_wanted(0.0)
            self.run_loop(loop, stands, seconds=0.5)
            loop.set_wanted(1.0)
            self.run_loop(loop, lambda r: r.target_speed_fraction == 1.0)
            # Right after a change it would pass for a late echo.
            start = loop.context.get_time()
            self.run_loop(loop, lambda r: r.timestamp > start + 0.3)
            server.do("simulate slider 0.4")
            self.run_loop(
                loop, lambda _: slider().phase == SliderPhase.YIELDING
            )
            server.do("pause")
            self.run_loop(loop, lambda _: slider().reason == "program: paused")
            self.run_loop(loop, stands)
        self.assertEqual(robot.slider, 0.0)

    def test_slider_that_does_not_obey_ends_in_the_watchdog(self):
        """The heartbeat stands still, so the robot's program stops."""
        robot = make_robot(ramp=0.05, watchdog_timeout=0.2)
        with (
            serve(robot) as server,
            RtdeClient(RtdeConfig(port=server.address[1])) as client,
        ):
            loop = Loop(client)
            loop.initialize()
            self.run_loop(loop, lambda r: r.target_speed_fraction == 0.8)
            server.do("simulate slider-frozen on")
            loop.set_wanted(0.0)
            self.run_loop(
                loop,
                lambda _: loop.eval(loop.control, "slider_obeys")[0] == 0.0,
            )
            time_taken = self.run_loop(
                loop,
                lambda r: (
                    r.runtime_state == RuntimeState.STOPPED
                    and not r.velocity.any()
                ),
            )
            # 0.2 s for the watchdog and 0.2 s to stop, and a slow machine.
            self.assertLess(time_taken, 0.6)
            self.assertEqual(robot.slider, 0.8)


class TestDefaults(unittest.TestCase):
    def test_command_before_any_report_is_not_to_be_sent(self):
        self.assertEqual(SliderCommand().sequence, -1)
