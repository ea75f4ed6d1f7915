"""Does the arm do what its slider says?"""

import dataclasses as dc
import math
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from robot_room import make_robot

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotReport
from tofssm_drake.robots.robot_modes import RuntimeState
import tofssm_drake.rtde.arm_obedience as mut
from tofssm_drake.rtde.slider import (
    SliderConfig,
    SliderPhase,
    SliderState,
    step_slider,
)

_PERIOD = 0.008
_FASTEST = (2.0944, 2.0944, *4 * (3.1416,))
# A law's fall from 1 to 0, 1/s.
_FALL = 10.0 / 3.0


class Watch:
    """Steps an arm's state through time."""

    def __init__(self, **settings):
        self.config = mut.ArmConfig(**settings)
        self.state = mut.ArmState()
        self.time = 100.0

    def run(
        self, seconds, *, allowed, speed=0.0, joint=0, lowest=0.0, judged=True
    ):
        """Returns the problem at the end, and when it began, s from now."""
        velocity = np.zeros(6)
        velocity[joint] = speed
        began = math.nan
        for i in range(round(seconds / _PERIOD)):
            self.time += _PERIOD
            self.state = mut.step_arm(
                self.config,
                self.state,
                RobotReport(timestamp=self.time, velocity=velocity),
                allowed=allowed,
                lowest=lowest,
                joint_speeds=_FASTEST,
                is_judged=judged,
            )
            if self.state.problem and math.isnan(began):
                began = i * _PERIOD
        return self.state.problem, began


class TestStepArm(unittest.TestCase):
    def test_faster_than_the_slider_allows(self):
        """2.0944 * 0.25 = 0.52 rad/s; 0.3 s ramp and 0.1 s to be sure."""
        dut = Watch()
        self.assertEqual(dut.run(1.0, allowed=1.0, speed=2.05)[0], "")
        problem, began = dut.run(0.6, allowed=0.25, speed=2.05)
        self.assertEqual(
            problem,
            "arm does not slow: joint 1 at 2.05 rad/s, the slider allows 0.52",
        )
        self.assertAlmostEqual(began, 0.4, delta=2 * _PERIOD)

    def test_margin(self):
        """Joint 3: 3.1416 * (0.5 + 0.1) = 1.885 rad/s."""
        for speed, is_wrong in ((1.88, False), (-1.88, False), (-1.89, True)):
            with self.subTest(speed=speed):
                dut = Watch()
                dut.run(1.0, allowed=0.5, joint=2)
                problem, _ = dut.run(0.2, allowed=0.5, speed=speed, joint=2)
                self.assertEqual(bool(problem), is_wrong)

    def test_at_rest_after_the_slider_is_at_0(self):
        dut = Watch()
        dut.run(1.0, allowed=1.0, speed=0.15)
        problem, began = dut.run(1.0, allowed=0.0, speed=0.15)
        self.assertEqual(
            problem,
            "arm does not slow: joint 1 at 0.15 rad/s, the slider allows 0.00",
        )
        self.assertAlmostEqual(began, 0.6, delta=2 * _PERIOD)
        dut = Watch()
        dut.run(1.0, allowed=1.0, speed=0.15)
        self.assertEqual(dut.run(5.0, allowed=0.0, speed=0.049)[0], "")

    def test_lowest_fraction_at_which_the_arm_creeps(self):
        """0.05 + 0.02 * 2.0944 = 0.092 rad/s."""
        for speed, is_wrong in ((0.09, False), (0.10, True)):
            with self.subTest(speed=speed):
                dut = Watch()
                dut.run(1.0, allowed=0.02, lowest=0.02)
                problem, _ = dut.run(
                    1.0, allowed=0.02, lowest=0.02, speed=speed
                )
                self.assertEqual(bool(problem), is_wrong)

    def test_what_is_short_is_nothing(self):
        dut = Watch()
        dut.run(1.0, allowed=0.0)
        for _ in range(20):
            self.assertEqual(dut.run(0.09, allowed=0.0, speed=3.0)[0], "")
            dut.run(_PERIOD, allowed=0.0)

    def test_a_speed_that_is_no_number_is_too_fast(self):
        dut = Watch()
        dut.run(1.0, allowed=1.0)
        problem, _ = dut.run(0.2, allowed=1.0, speed=math.nan, joint=4)
        self.assertIn("joint 5 at nan rad/s", problem)
        self.assertTrue(dut.run(1.0, allowed=0.0, speed=math.nan)[0])

    def test_not_judged(self):
        """Nor does earlier motion count against the arm afterwards."""
        dut = Watch()
        dut.run(1.0, allowed=0.0)
        self.assertEqual(
            dut.run(3.0, allowed=0.0, speed=3.0, judged=False)[0], ""
        )
        self.assertEqual(dut.run(0.3, allowed=0.0, speed=3.0)[0], "")
        self.assertNotEqual(dut.run(0.2, allowed=0.0, speed=3.0)[0], "")

    def test_ends_after_half_a_second_at_rest(self):
        dut = Watch()
        dut.run(1.0, allowed=0.0)
        dut.run(0.2, allowed=0.0, speed=1.0)
        for _ in range(3):
            # The program waits for its gripper.
            self.assertTrue(dut.run(0.4, allowed=0.0)[0])
            self.assertTrue(dut.run(0.05, allowed=0.0, speed=1.0)[0])
        self.assertEqual(dut.run(0.52, allowed=0.0)[0], "")

    def test_state_does_not_grow(self):
        dut = Watch()
        for i in range(500):
            dut.run(_PERIOD, allowed=1.0 - i / 500, speed=0.01)
        self.assertLessEqual(len(dut.state.allowed), 0.5 / _PERIOD + 2)
        dut.run(1.0, allowed=1.0)
        self.assertEqual(len(dut.state.allowed), 1)

    def test_settings(self):
        for name, value in (
            ("ramp_time", 0.0),
            ("ramp_time", 0.6),
            ("rest_time", 11.0),
            ("rest_speed", -1.0),
            ("speed_margin", math.nan),
            ("confirm_time", 1.1),
        ):
            with self.subTest(name=name, value=value):
                config = dc.replace(mut.ArmConfig(), **{name: value})
                with self.assertRaisesRegex(UserError, r"^arm\.\w+: must"):
                    config.check("arm")


class Loop:
    """A simulated robot at its program, and what moves its slider.

    Args:
        path_time: Where the program is, s.
        start: Speed fraction wanted at first.
    """

    def __init__(self, *, path_time=0.0, start=1.0):
        self.robot = make_robot(loop=True)
        self.robot.path_time = path_time
        self.config = SliderConfig(operator_limit=1.0)
        self.state = SliderState()
        self.sequence = 0
        self.time = 0.0
        self.run(1.5, start)
        assert self.robot.slider == start, self.state

    def run(self, seconds, wanted, *, fall=math.inf, until=lambda: False):
        """Runs for some time or until a condition; returns whether it holds."""
        for _ in range(round(seconds / _PERIOD)):
            floor = self.state.command.speed_fraction - fall * _PERIOD
            self.step(max(wanted, floor))
            if until():
                return True
        return False

    def step(self, wanted):
        robot = self.robot
        robot.step()
        self.time += _PERIOD
        out = robot.outputs
        self.sequence += 1
        report = RobotReport(
            sequence=self.sequence,
            session=0,
            timestamp=out["timestamp"],
            velocity=np.array(out["actual_qd"]),
            **{
                name: out[name]
                for name in (
                    "robot_mode",
                    "safety_mode",
                    "safety_status",
                    "safety_status_bits",
                    "robot_status_bits",
                    "runtime_state",
                    "target_speed_fraction",
                )
            },
        )
        self.state = step_slider(self.config, self.state, report, wanted)
        command = self.state.command
        robot.receive(
            {
                "speed_slider_mask": command.mask,
                "speed_slider_fraction": command.speed_fraction,
                "input_int_register_24": command.heartbeat,
            }
        )


_FRACTIONS = st.sampled_from((0.0, 0.0, 0.25, 0.5, 1.0, 1.0))
_ACTS = st.tuples(
    st.sampled_from(("law", "jump", "hand", "pause", "late pause")),
    _FRACTIONS,
    st.floats(0.01, 1.5),
)


class TestSimulatedRobot(unittest.TestCase):
    @settings(max_examples=40, deadline=None)
    @given(
        path_time=st.floats(0.0, 12.0),
        acts=st.lists(_ACTS, min_size=1, max_size=8),
    )
    def test_no_false_alarm_whatever_the_slider_does(self, path_time, acts):
        """A robot that follows within its ramp of 0.2 s is never blamed."""
        dut = Loop(path_time=path_time)
        for act, fraction, seconds in acts:
            if act == "hand":
                dut.robot.move_slider(fraction)
            if "pause" in act:
                dut.robot.pause()
            is_wrong = dut.run(
                seconds,
                fraction,
                fall=_FALL if act == "law" else math.inf,
                until=lambda: bool(dut.state.arm.problem),
            )
            self.assertFalse(is_wrong, dut.state.arm)
            dut.robot.play()

    @settings(max_examples=40, deadline=None)
    @given(
        path_time=st.floats(0.0, 12.0),
        slowest=st.floats(0.1, 1.0),
        fall=st.sampled_from((_FALL, math.inf)),
    )
    def test_an_arm_that_does_not_stop_is_always_found(
        self, path_time, slowest, fall
    ):
        """0.6 s after the slider is at 0, or 0.1 s after the arm moves on."""
        dut = Loop(path_time=path_time)
        dut.robot.slowest_fraction = slowest
        dut.run(1.0, 0.0, fall=fall, until=lambda: dut.robot.slider == 0.0)
        zero = at_rest = dut.time
        while not dut.state.arm.problem:
            dut.step(0.0)
            if abs(dut.robot.velocity).max() <= 0.05:
                at_rest = dut.time
            latest = max(zero + 0.5, at_rest) + 0.1
            self.assertLess(dut.time, latest + 3 * _PERIOD)
        self.assertEqual(dut.state.phase, SliderPhase.FAULT)
        self.assertIn("arm does not slow", dut.state.reason)

    def test_reduced_speed_that_is_ignored(self):
        """Found as soon as a joint is faster than 0.6 of its greatest speed."""
        dut = Loop(path_time=0.0)
        dut.robot.ignores_slider = True
        found = dut.run(
            6.0, 0.5, fall=_FALL, until=lambda: dut.state.arm.problem
        )
        self.assertTrue(found)
        self.assertIn("the slider allows 1.05", dut.state.reason)

    def test_fault_lets_the_watchdog_act_and_returns_as_any_other(self):
        dut = Loop()
        dut.robot.ignores_slider = True
        self.assertTrue(dut.run(3, 0.0, until=lambda: dut.state.arm.problem))
        heartbeat = dut.state.command.heartbeat
        # It pauses for its gripper now and then, which is not obedience.
        dut.run(4.0, 1.0)
        self.assertEqual(dut.state.phase, SliderPhase.FAULT)
        self.assertEqual(dut.state.command.heartbeat, heartbeat)
        self.assertEqual((dut.state.command.mask, dut.robot.slider), (1, 0.0))
        # Somebody stops the program, as the watchdog would.
        dut.robot.stop()
        dut.run(0.1, 1.0)
        self.assertTrue(dut.state.arm.problem)
        dut.run(1.0, 1.0)
        self.assertEqual(dut.state.phase, SliderPhase.HOLDING)
        self.assertGreater(dut.state.command.heartbeat, heartbeat)
        dut.robot.ignores_slider = False
        dut.robot.play()
        is_fast = dut.run(0.7, 1.0, until=lambda: dut.robot.slider > 0.5)
        self.assertFalse(is_fast)
        self.assertEqual(dut.state.phase, SliderPhase.RECOVERING)
        dut.run(1.0, 1.0)
        self.assertEqual(dut.state.phase, SliderPhase.FOLLOWING)

    def push(self, dut, seconds=2.0, speed=1.5):
        """Moves the joints by hand; returns whether that was a fault."""
        original = dut.robot.step

        def step():
            original()
            dut.robot.outputs["actual_qd"] = (speed,) * 6

        dut.robot.step = step
        found = dut.run(seconds, 1.0, until=lambda: bool(dut.state.arm.problem))
        dut.robot.step = original
        return found

    def test_pushed_by_hand(self):
        for what, act in (
            ("program stopped", lambda robot: robot.stop()),
            ("program paused", lambda robot: robot.pause()),
            ("protective stop", lambda robot: robot.set_safety_mode(3)),
        ):
            with self.subTest(what):
                dut = Loop()
                act(dut.robot)
                self.assertFalse(self.push(dut))
        dut = Loop(start=0.5)
        self.assertTrue(self.push(dut, speed=2.5))

    def test_freedrive(self):
        """As long as someone presses the button behind the pendant."""
        dut = Loop(start=0.5)
        write = dut.robot._write_outputs

        def write_with_button(change):
            write(change)
            dut.robot.outputs["robot_status_bits"] |= 4

        dut.robot._write_outputs = write_with_button
        self.assertFalse(self.push(dut, speed=2.5))
        self.assertEqual(dut.robot.runtime_state, RuntimeState.PLAYING)


if __name__ == "__main__":
    unittest.main()
