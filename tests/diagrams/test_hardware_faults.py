"""Each fault, on a robot at full speed: time to standstill, and recovery.

The times are counted in the robot's cycles, the same on every computer; `make
fault-table` measures what a real computer adds.
"""

import math
import unittest

from fault_rows import Moment, call_in_copy, make_cell
from lockstep import CYCLE, Cell
import pytest

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotState
from tofssm_drake.robots.robot_modes import (
    RuntimeState,
    SafetyMode,
)
from tofssm_drake.rtde.slider import SliderPhase


class TestFaults(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.cell = make_cell(Moment.ALONE)

    def check_copies(self, check, cases):
        """Checks cases, each in a copy of a robot at full speed."""
        for case in cases:
            with self.subTest(case):
                call_in_copy(lambda case=case: check(*case))

    def setUp(self):
        if self.cell.run.ticks:
            self.cell.wait_for_full_speed()

    def check(self, *, zero, still, health, duration=1.0):
        """Measures from now on; the limits are in s."""
        times = self.cell.measure(duration)
        self.assertLessEqual(times.zero, zero, times)
        self.assertLessEqual(times.still, still, times)
        self.assertRegex(times.health, health)
        return times

    def check_return(self):
        """Speed recovers through half a second at the reduced fraction."""
        cell = self.cell
        if not cell.robot.is_program_running():
            cell.robot.play()
        sliders, problems = [cell.robot.slider], [True]
        while sliders[-1] <= 0.5:
            result = cell.step()
            sliders.append(cell.robot.slider)
            problems.append(bool(result.problem))
            self.assertLess(len(sliders), 10 / CYCLE)
        self.assertEqual(sliders[0], 0.0)
        time_at_half = sum(s == 0.5 for s in sliders) * CYCLE
        self.assertGreaterEqual(time_at_half, 0.5)
        self.assertLessEqual(time_at_half, 0.6)
        # All of that time with fresh and healthy data.
        self.assertFalse(any(problems[-int(0.5 / CYCLE) :]))
        cell.wait_for_full_speed()
        self.assertEqual(cell.result.health, "")

    def test_without_a_scan_of_each_ring_it_does_not_move(self):
        cell = Cell()
        for _ in range(40):
            cell.step()
            self.assertEqual(cell.robot.path_time, 0.0)
        self.assertEqual(cell.result.robot_state, RobotState.STOP)
        self.assertIn("no sample yet", cell.result.health)

    # Longest times to 0, s. 0.4 s are the law's ramp from full speed, 0.1 s
    # its deadline for a sample, part of which has passed when the fault
    # begins; a frozen sensor takes 25 repetitions of 0.024 s.
    RINGS = (
        ("silent", "elbow", 0.52, "elbow sample is .* s old"),
        ("corrupt", "base", 0.52, "base sample is .* s old"),
        ("late", "tool", 0.52, "tool"),
        ("duplicate", "elbow", 0.54, "elbow sample is .* s old"),
        ("frozen", "base", 1.10, "base is faulted"),
        ("implausible", "tool", 0.45, "tool is faulted"),
        ("bus", "elbow", 0.45, "elbow is faulted"),
        ("restart", "base", 0.52, "base sample is .* s old"),
    )

    # The kinds of `make test`: no frame, a frame without news, a bad frame.
    OFTEN = ("silent", "frozen", "bus")

    def test_rings(self):
        self.check_rings(r for r in self.RINGS if r[0] in self.OFTEN)

    @pytest.mark.long
    def test_other_faults_of_rings(self):
        self.check_rings(r for r in self.RINGS if r[0] not in self.OFTEN)

    def check_rings(self, cases):
        for kind, ring, limit, why in cases:
            with self.subTest(kind=kind):
                self.cell.wait_for_full_speed()
                self.cell.inject(kind, ring)
                self.check(
                    zero=limit,
                    still=limit + 2 * CYCLE,
                    health=why,
                    duration=1.5,
                )
                self.cell.heal()
                self.check_return()

    def test_robot_whose_reports_stay_away(self):
        """Its slider stays where it was: its watchdog ends the program."""
        cell = self.cell
        cell.is_silent = True
        times = cell.measure(0.6)
        self.assertLessEqual(times.still, 0.2 + 0.2 + 4 * CYCLE)
        self.assertEqual(cell.robot.slider, 1.0)
        self.assertEqual(cell.robot.runtime_state, RuntimeState.STOPPED)
        cell.is_silent = False
        # The first command of the new session.
        self.check(zero=4 * CYCLE, still=CYCLE, health="program: stopped")
        self.check_return()

    def test_robot_whose_reports_are_late(self):
        cell = self.cell
        cell.delay = 0.15
        self.check(zero=0.66, still=0.66, health="sample is .* s old")
        cell.delay = 0.0
        self.check_return()

    def test_robot_whose_reports_are_very_late_or_gone_for_good(self):
        def check(fault, why):
            vars(self.cell).update(fault)
            with self.assertRaisesRegex(UserError, why):
                self.cell.measure(11.0)

        self.check_copies(
            check,
            (
                ({"delay": 0.3}, "reports come [23].. ms late"),
                ({"is_silent": True}, "no report for 10 s: it is silent"),
            ),
        )

    def test_slider_that_does_not_obey(self):
        """Together with a ring: otherwise there is nothing to obey."""
        cell = self.cell
        cell.robot.slider_frozen = True
        cell.inject("bus", "elbow")
        times = cell.measure(1.2)
        # 11 cycles until it is a fault, 0.2 s watchdog, 0.2 s to stop.
        self.assertLessEqual(times.still, 0.55)
        self.assertEqual(cell.robot.slider, 1.0)
        self.assertRegex(times.health, "slider does not obey: at 1.00, not")
        self.assertEqual(cell.result.slider.phase, SliderPhase.FAULT)
        cell.robot.slider_frozen = False
        cell.heal()
        cell.wait_until(lambda r: cell.robot.slider == 0.0)
        self.check_return()

    def test_arm_that_does_not_slow(self):
        """The echo obeys: only the joints' speed shows it."""
        # While the law slows down: 0.3 s ramp, 0.1 s to be sure.
        case = {"ignores_slider": True}, "1 at 2", 0.50
        self.check_copies(self.check_arm_that_does_not_slow, (case,))

    @pytest.mark.long
    def test_arm_that_slows_too_little(self):
        self.check_copies(
            self.check_arm_that_does_not_slow,
            (
                # After the law's 0.4 s to 0, and what is above the margin.
                ({"slowest_fraction": 0.6}, "[1-6] at [0-9]", 0.85),
                # After the law's 0.4 s to 0, 0.5 s to rest, 0.1 s to be sure.
                ({"slowest_fraction": 0.1}, "[1-6] at 0", 1.05),
            ),
        )

    def check_arm_that_does_not_slow(self, fault, joint, limit):
        cell = self.cell
        vars(cell.robot).update(fault)
        cell.inject("bus", "elbow")
        start = cell.time
        result = cell.wait_until(lambda r: r.slider.phase == SliderPhase.FAULT)
        self.assertLessEqual(cell.time - start, limit)
        self.assertRegex(
            result.health,
            f"arm does not slow: joint {joint}.* rad/s, the slider",
        )
        heartbeat = result.slider.command.heartbeat
        times = cell.measure(0.2 + 0.2 + 4 * CYCLE)
        # Its watchdog has acted.
        self.assertLess(times.still, math.inf)
        self.assertEqual(cell.robot.runtime_state, RuntimeState.STOPPED)
        self.assertEqual(cell.result.slider.command.heartbeat, heartbeat)
        cell.robot.ignores_slider = False
        cell.robot.slowest_fraction = 0.0
        cell.heal()
        cell.wait_until(lambda r: r.slider.phase != SliderPhase.FAULT)
        cell.robot.play()
        while cell.robot.slider != 0.0:
            cell.step()
        self.check_return()

    def test_robot_that_is_not_the_modelled_one(self):
        def check(act, limit, why):
            start = self.cell.time
            act(self.cell.robot)
            with self.assertRaisesRegex(UserError, f"^robot: .*{why}"):
                self.cell.measure(10.0)
            self.assertLessEqual(self.cell.time - start, limit)

        self.check_copies(
            check,
            (
                (
                    lambda r: r.joint_offset.__setitem__(0, 0.1),
                    0.3,
                    "5.7 deg from",
                ),
                (
                    lambda r: setattr(r, "joints_late", 0.05),
                    1.0,
                    "mm and .* from",
                ),
                (
                    lambda r: setattr(r, "clock_rate", 2.0),
                    4.2,
                    "its clock runs 2.000 times as fast",
                ),
                (
                    lambda r: setattr(r, "clock_rate", 1.03),
                    4.2,
                    "its clock runs 1.030 times as fast",
                ),
            ),
        )

    def test_tool_that_is_set_up_elsewhere_is_no_fault(self):
        def check():
            self.cell.robot.tcp_offset[2] += 0.1
            self.cell.measure(1.0)
            self.assertEqual(
                self.cell.result.slider.phase, SliderPhase.FOLLOWING
            )

        call_in_copy(check)

    def test_clock_that_jumps(self):
        for seconds in (5.0, -5.0):
            with self.subTest(seconds=seconds):
                self.cell.wait_for_full_speed()
                self.cell.robot.shift_clock(seconds)
                # Nothing else is wrong: it recovers at once.
                self.check(
                    zero=2 * CYCLE,
                    still=0.2 + 2 * CYCLE,
                    health="new session",
                    duration=0.2 + 0.5 * CYCLE,
                )
                self.check_return()

    def test_modes(self):
        cell = self.cell
        for act, why in (
            (
                lambda: cell.robot.set_safety_mode(SafetyMode.PROTECTIVE_STOP),
                "safety mode: protective stop",
            ),
            (cell.robot.pause, "program: paus"),
            (cell.robot.stop, "program: stop"),
        ):
            with self.subTest(why=why):
                cell.wait_for_full_speed()
                act()
                self.check(zero=4 * CYCLE, still=0.3, health=why, duration=0.4)
                cell.robot.set_safety_mode(SafetyMode.NORMAL)
                self.check_return()


if __name__ == "__main__":
    unittest.main()
