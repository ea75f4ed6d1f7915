"""`tofssm simulated-ur` and `simulated-rings` before they are ready."""

import contextlib
import io
import os
import signal
import time
import unittest
from unittest import mock

from tofssm_drake.messages import RobotReport
from tofssm_drake.robots.robot_connection import RobotStatus
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.simulated_ur import SimulatedUr
from tofssm_drake.scripts import simulated_rings
from tofssm_drake.scripts.main import run


class TestMessages(unittest.TestCase):
    def test_what_is_wrong_with_the_robot_is_a_line(self):
        problem = "robot.local: [no] " + 20 * "reason " + ":cat:"

        def stop(*_, **__):
            os.kill(os.getpid(), signal.SIGTERM)
            return RobotReport()

        err = io.StringIO()
        with (
            mock.patch.object(
                RtdeClient, "get_status", lambda _: RobotStatus(problem=problem)
            ),
            mock.patch.object(RtdeClient, "wait_for_report", stop),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(err),
        ):
            run(["simulated-rings", "--pty", "--robot-port", "1"])
        self.assertEqual(err.getvalue(), f"robot: {problem}\n")

    def test_a_task_out_of_reach_says_what_to_do(self):
        err = io.StringIO()
        with contextlib.redirect_stderr(err):
            code = run(["simulated-ur", "--model", "ur5e", "--port", "0"])
        self.assertEqual(code, 2)
        (line,) = err.getvalue().splitlines()
        self.assertIn("out of the robot's reach; the task must fit", line)
        self.assertIn("examples/my_arm.yaml --scenario-name UR5e", line)

    def test_another_brand_has_no_simulated_ur(self):
        err = io.StringIO()
        with contextlib.redirect_stderr(err):
            code = run(
                [
                    *("simulated-ur", "--scenario-text"),
                    "{driver: !CustomDriver "
                    "{factory: 'examples.my_driver:Toy'}}",
                ]
            )
        self.assertEqual(code, 2)
        (line,) = err.getvalue().splitlines()
        self.assertIn("!CustomDriver is another brand's", line)


class TestInterrupt(unittest.TestCase):
    def test_while_kernels_are_compiled(self):
        for owner, name, arguments in (
            (SimulatedUr, "step", ("simulated-ur", "--port", "0")),
            (
                simulated_rings,
                "SimulatedRings",
                ("simulated-rings", "--to", "udp://127.0.0.1:5005"),
            ),
        ):
            for number in (signal.SIGINT, signal.SIGTERM):

                def compile_long(*_, number=number, **__):
                    os.kill(os.getpid(), number)
                    time.sleep(30.0)

                out, err = io.StringIO(), io.StringIO()
                with (
                    self.subTest(arguments=arguments, number=number),
                    mock.patch.object(owner, name, compile_long),
                    contextlib.redirect_stdout(out),
                    contextlib.redirect_stderr(err),
                ):
                    self.assertEqual(run(list(arguments)), 130)
                    self.assertEqual(out.getvalue(), "")
                    self.assertEqual(
                        err.getvalue(),
                        "tofssm: interrupted before the start\n",
                    )
