import dataclasses as dc
import itertools
import math
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotReport
import tofssm_drake.rtde.slider as mut
from tofssm_drake.rtde.slider import SliderPhase

_PERIOD = 0.008


class Robot:
    """A robot whose slider shows a written value `delay` reports later."""

    def __init__(self, *, delay=1, slider=1.0):
        self.delay = delay
        self.queue = []
        self.slider = slider
        self.modes = {"robot_mode": 7, "safety_mode": 1, "runtime_state": 2}
        self.obeys = True
        self.speed = 0.0
        self.sequence = -1
        self.session = 0
        self.timestamp = 100.0
        self.reports = []

    def report(self):
        self.sequence += 1
        self.timestamp += _PERIOD
        if len(self.queue) >= self.delay:
            command = self.queue.pop(0)
            if command.mask and self.obeys:
                self.slider = command.speed_fraction
        return RobotReport(
            sequence=self.sequence,
            session=self.session,
            timestamp=self.timestamp,
            velocity=np.full(6, self.speed),
            target_speed_fraction=self.slider,
            **self.modes,
        )


def run(robot, wanted, *, cycles, state=None, config=None):
    """Runs slider and robot; returns all states, the newest last."""
    config = config or mut.SliderConfig()
    state = state or mut.SliderState()
    states = []
    for _ in range(cycles):
        state = mut.step_slider(config, state, robot.report(), wanted)
        robot.queue.append(state.command)
        states.append(state)
    return states


def settle(robot, wanted=0.8, **settings):
    """Runs until the slider follows; returns the state."""
    state = run(robot, wanted, cycles=200, **settings)[-1]
    assert state.phase == SliderPhase.FOLLOWING, state
    assert abs(robot.slider - wanted) < 1e-9
    return state


class TestStart(unittest.TestCase):
    def test_nothing_is_sent_before_a_report(self):
        dut = mut.step_slider(
            mut.SliderConfig(), mut.SliderState(), RobotReport(), 1.0
        )
        self.assertEqual(dut.command.sequence, -1)
        self.assertEqual(dut.phase, SliderPhase.WAITING)

    def test_first_to_the_lowest_then_slowly_up(self):
        robot = Robot()
        states = run(robot, 1.0, cycles=150)
        self.assertEqual(states[0].phase, SliderPhase.WAITING)
        self.assertEqual(states[0].command.mask, 1)
        self.assertEqual(states[0].command.speed_fraction, 0.0)
        self.assertEqual(states[1].phase, SliderPhase.RECOVERING)
        written = [state.command.speed_fraction for state in states]
        steps = [b - a for a, b in itertools.pairwise(written)]
        self.assertLessEqual(max(steps), 2.0 * _PERIOD + 1e-9)
        self.assertGreaterEqual(min(steps), 0.0)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)
        self.assertEqual(robot.slider, 1.0)

    def test_same_report_changes_nothing(self):
        robot = Robot()
        report = robot.report()
        config = mut.SliderConfig()
        first = mut.step_slider(config, mut.SliderState(), report, 1.0)
        again = mut.step_slider(config, first, report, 0.2)
        self.assertIs(again, first)


class TestWithoutEcho(unittest.TestCase):
    """A brand that does not report its fraction, and one that should."""

    def run_blind(self, *, has_echo, speed=0.0, wanted=1.0):
        robot = Robot(slider=math.nan)
        robot.obeys = False
        robot.speed = speed
        config = mut.SliderConfig(has_echo=has_echo)
        states = run(robot, 1.0, cycles=200, config=config)
        robot.speed = 1.0 if speed == 0.0 else speed
        return states + run(
            robot, wanted, cycles=200, state=states[-1], config=config
        )

    def test_an_echo_that_is_missing_is_a_fault(self):
        states = self.run_blind(has_echo=True)
        self.assertEqual({s.phase for s in states}, {SliderPhase.FAULT})
        self.assertEqual({s.command.speed_fraction for s in states}, {0.0})

    def test_where_there_is_none_the_arm_is_followed(self):
        states = self.run_blind(has_echo=False)
        self.assertEqual(states[0].command.speed_fraction, 0.0)
        self.assertEqual(states[199].command.speed_fraction, 1.0)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)

    def test_an_arm_that_does_not_slow_is_a_fault(self):
        states = self.run_blind(has_echo=False, wanted=0.0)
        self.assertEqual(states[-1].phase, SliderPhase.FAULT)
        self.assertIn("arm does not slow", states[-1].reason)
        beats = {s.command.heartbeat for s in states[-50:]}
        self.assertEqual(len(beats), 1)

    def test_an_arm_that_already_moves_is_stopped_first(self):
        """It is not confirmed at rest, so nothing rises."""
        states = self.run_blind(has_echo=False, speed=1.0)
        self.assertEqual({s.command.speed_fraction for s in states}, {0.0})

    def test_nobody_limits_it(self):
        config = mut.SliderConfig(has_echo=False)
        self.assertEqual(mut.find_operator_limit(config, math.nan), 1.0)


class TestFollowing(unittest.TestCase):
    def test_mask_only_where_needed(self):
        robot = Robot(delay=2)
        state = settle(robot)
        states = run(robot, 0.8, cycles=20, state=state)
        self.assertEqual({s.command.mask for s in states}, {0})
        states = run(robot, 0.3, cycles=20, state=states[-1])
        self.assertEqual(states[0].command.mask, 1)
        self.assertEqual(states[0].command.speed_fraction, 0.3)
        self.assertEqual({s.command.mask for s in states[1:]}, {0})

    def test_heartbeat_counts_every_report(self):
        robot = Robot()
        beats = [s.command.heartbeat for s in run(robot, 1.0, cycles=50)]
        self.assertEqual(beats, list(range(beats[0], beats[0] + 50)))
        state = dc.replace(
            mut.SliderState(),
            command=dc.replace(mut.SliderState().command, heartbeat=2**31 - 1),
        )
        (state,) = run(robot, 1.0, cycles=1, state=state)
        self.assertEqual(state.command.heartbeat, 0)

    def test_stops_at_once(self):
        robot = Robot()
        state = settle(robot)
        (state,) = run(robot, 0.0, cycles=1, state=state)
        self.assertEqual(state.command.mask, 1)
        self.assertEqual(state.command.speed_fraction, 0.0)

    def test_not_a_number_stops(self):
        for wanted, expected in (
            (math.nan, 0.0),
            (-1.0, 0.0),
            (-math.inf, 0.0),
            (math.inf, 1.0),
        ):
            with self.subTest(wanted=wanted):
                robot = Robot()
                state = settle(robot)
                dut = run(robot, wanted, cycles=1, state=state)[-1]
                self.assertEqual(dut.command.speed_fraction, expected)

    def test_minimum(self):
        config = mut.SliderConfig(minimum_fraction=0.02)
        robot = Robot()
        states = run(robot, 0.0, cycles=10, config=config)
        self.assertEqual(robot.slider, 0.02)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)

    def test_echo_may_be_rounded(self):
        class Rounding(Robot):
            def report(self):
                report = super().report()
                return dc.replace(
                    report,
                    target_speed_fraction=round(
                        report.target_speed_fraction, 2
                    ),
                )

        states = run(Rounding(), 1 / 3, cycles=200)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)
        self.assertEqual({s.command.mask for s in states[100:]}, {0})

    @given(
        st.lists(st.floats(0, 1), min_size=5, max_size=60), st.integers(1, 4)
    )
    @settings(max_examples=100, deadline=None)
    def test_an_honest_robot_is_never_at_fault(self, fractions, delay):
        """Whatever is wanted, and however often it changes."""
        robot = Robot(delay=delay)
        state = mut.SliderState()
        for wanted in fractions:
            states = run(robot, wanted, cycles=1 + delay, state=state)
            state = states[-1]
            for dut in states:
                self.assertNotEqual(dut.phase, SliderPhase.FAULT)
                self.assertLessEqual(dut.command.speed_fraction, wanted)
                self.assertEqual(dut.operator_fraction, 1.0)


class TestFault(unittest.TestCase):
    def test_lost_write_is_written_again(self):
        robot = Robot()
        state = settle(robot)
        robot.obeys = False
        states = run(robot, 0.2, cycles=6, state=state)
        robot.obeys = True
        states += run(robot, 0.2, cycles=20, state=states[-1])
        masks = [s.command.mask for s in states]
        self.assertEqual(masks[0], 1)
        self.assertEqual(masks[1:6], [0] * 5)
        self.assertEqual(masks[6], 1)
        self.assertNotIn(SliderPhase.FAULT, [s.phase for s in states])
        self.assertEqual(robot.slider, 0.2)

    def test_frozen_slider_is_a_fault(self):
        for cycles in (1, 5, 20):
            with self.subTest(confirm_cycles=cycles):
                config = mut.SliderConfig(confirm_cycles=cycles)
                robot = Robot()
                state = settle(robot)
                robot.obeys = False
                states = run(
                    robot,
                    0.2,
                    cycles=2 * cycles + 4,
                    state=state,
                    config=config,
                )
                phases = [s.phase for s in states]
                first = phases.index(SliderPhase.FAULT)
                # Twice the time to confirm, plus the reports at its ends.
                self.assertLessEqual(first, 2 * cycles + 2)
                self.assertGreaterEqual(first, 2 * cycles)
                self.assertIn("slider does not obey", states[-1].reason)

    def test_in_a_fault_zero_is_written_and_the_heartbeat_stands(self):
        robot = Robot()
        state = settle(robot)
        robot.obeys = False
        states = run(robot, 0.2, cycles=40, state=state)
        fault = [s for s in states if s.phase == SliderPhase.FAULT]
        self.assertGreater(len(fault), 20)
        self.assertEqual(len({s.command.heartbeat for s in fault}), 1)
        self.assertEqual(
            {(s.command.mask, s.command.speed_fraction) for s in fault},
            {(1, 0.0)},
        )
        # It ends when 0 is seen, and the speed recovers slowly.
        robot.obeys = True
        states = run(robot, 1.0, cycles=150, state=states[-1])
        phases = list(dict.fromkeys(s.phase for s in states))
        self.assertEqual(
            phases,
            [
                SliderPhase.FAULT,
                SliderPhase.RECOVERING,
                SliderPhase.RISING,
                SliderPhase.FOLLOWING,
            ],
        )
        written = [s.command.speed_fraction for s in states]
        self.assertLessEqual(
            max(b - a for a, b in itertools.pairwise(written)),
            2.0 * _PERIOD + 1e-9,
        )

    def test_no_echo_is_a_fault(self):
        robot = Robot()
        state = settle(robot)
        robot.slider = math.nan
        robot.obeys = False
        (state,) = run(robot, 0.8, cycles=1, state=state)
        self.assertEqual(state.phase, SliderPhase.FAULT)

    def test_an_echo_that_can_not_be_is_a_fault_and_nobodys_hand(self):
        config = mut.SliderConfig(operator_limit=0.3)
        for echo in (5.0, math.inf, -0.5, -math.inf, math.nan):
            with self.subTest(echo=echo):
                robot = Robot()
                states = run(robot, 1.0, cycles=200, config=config)
                self.assertEqual(robot.slider, 0.3)
                robot.slider = echo
                states += run(
                    robot, 1.0, cycles=300, state=states[-1], config=config
                )
                self.assertEqual(states[200].phase, SliderPhase.FAULT)
                self.assertEqual(robot.slider, 0.3)
                fractions = [s.command.speed_fraction for s in states]
                self.assertEqual((min(fractions), max(fractions)), (0.0, 0.3))

    def test_at_first_it_is_not_known_where_the_slider_stands(self):
        """A person may have set it anywhere: at most 0, until one moves it."""
        for echo in (math.nan, -0.5):
            with self.subTest(echo=echo):
                robot = Robot(slider=echo)
                (state,) = run(robot, 1.0, cycles=1)
                robot.slider = 0.3
                state = run(robot, 1.0, cycles=200, state=state)[-1]
                self.assertEqual(robot.slider, 0.0)
                self.assertEqual(state.phase, SliderPhase.YIELDING)
                robot.slider = 0.3
                run(robot, 1.0, cycles=200, state=state)
                self.assertEqual(robot.slider, 0.3)


class TestLateComputer(unittest.TestCase):
    def test_only_every_twentieth_report_is_seen(self):
        """Being late is neither disobedience nor a jump upwards."""
        config = mut.SliderConfig()
        robot = Robot()
        state = mut.SliderState()
        before = 0.0
        for i in range(200):
            wanted = 1.0 if i % 40 < 35 else 0.0
            for _ in range(19):
                robot.report()
            state = mut.step_slider(config, state, robot.report(), wanted)
            robot.queue.append(state.command)
            self.assertNotEqual(state.phase, SliderPhase.FAULT)
            self.assertEqual(state.operator_fraction, 1.0)
            if i < 9:
                fraction = state.command.speed_fraction
                self.assertLessEqual(fraction - before, 0.1 + 1e-9)
                before = fraction


class TestOperator(unittest.TestCase):
    def test_lower_holds(self):
        robot = Robot()
        state = settle(robot)
        robot.slider = 0.3
        states = run(robot, 0.8, cycles=50, state=state)
        self.assertEqual({s.phase for s in states}, {SliderPhase.YIELDING})
        self.assertEqual({s.command.mask for s in states}, {0})
        self.assertIn("someone has set the slider to 0.30", states[0].reason)
        # The law may want even less, and then more again.
        states = run(robot, 0.1, cycles=10, state=states[-1])
        self.assertEqual(robot.slider, 0.1)
        states = run(robot, 0.8, cycles=10, state=states[-1])
        self.assertEqual(robot.slider, 0.3)
        # Until the person allows more.
        robot.slider = 0.6
        states = run(robot, 0.8, cycles=10, state=states[-1])
        self.assertEqual(robot.slider, 0.6)
        robot.slider = 1.0
        states = run(robot, 0.8, cycles=10, state=states[-1])
        self.assertEqual(robot.slider, 0.8)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)

    def test_higher_is_set_back_at_once(self):
        robot = Robot()
        state = settle(robot, 0.2)
        robot.slider = 0.9
        states = run(robot, 0.2, cycles=10, state=state)
        self.assertEqual(states[0].command.mask, 1)
        self.assertEqual(states[0].command.speed_fraction, 0.2)
        self.assertIn("moved to 0.90, is set to 0.20", states[0].reason)
        self.assertEqual(robot.slider, 0.2)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)

    def test_lower_is_set_back_if_asked_to(self):
        config = mut.SliderConfig(yield_to_operator=False)
        robot = Robot()
        state = settle(robot, config=config)
        robot.slider = 0.3
        run(robot, 0.8, cycles=10, state=state, config=config)
        self.assertEqual(robot.slider, 0.8)

    def test_zero_holds_against_a_minimum(self):
        config = mut.SliderConfig(minimum_fraction=0.02)
        robot = Robot()
        state = settle(robot, config=config)
        robot.slider = 0.0
        run(robot, 0.8, cycles=10, state=state, config=config)
        self.assertEqual(robot.slider, 0.0)


class TestHold(unittest.TestCase):
    def test_reasons(self):
        for modes, reason in (
            ({"robot_mode": 3}, "robot mode: power off"),
            ({"robot_mode": 99}, "robot mode: unknown (99)"),
            ({"safety_mode": 3}, "safety mode: protective stop"),
            ({"safety_mode": 7}, "safety mode: robot emergency stop"),
            ({"safety_mode": 77}, "safety mode: unknown (77)"),
            ({"safety_mode": -1}, "safety mode: unknown"),
            ({"safety_status": 5}, "safety mode: safeguard stop"),
            ({"runtime_state": 4}, "program: paused"),
            ({"runtime_state": 1}, "program: stopped"),
            ({"runtime_state": -1}, "program: unknown (-1)"),
            # Contradicts the modes; 0 means that nothing is reported.
            ({"safety_status_bits": 5}, "safety status bits: 0x5"),
            ({"safety_status_bits": 1 << 10}, "safety status bits: 0x400"),
            ({"safety_status_bits": 3}, ""),
            ({"safety_status_bits": 0}, ""),
            ({"safety_mode": 2}, ""),
            ({"safety_status": 1}, ""),
        ):
            with self.subTest(modes=modes):
                robot = Robot()
                robot.modes |= modes
                self.assertEqual(mut.find_hold(robot.report()), reason)

    def test_lowest_while_it_lasts_then_slowly_up(self):
        robot = Robot()
        state = settle(robot)
        robot.modes["runtime_state"] = 4
        states = run(robot, 0.8, cycles=20, state=state)
        self.assertEqual(states[0].phase, SliderPhase.HOLDING)
        self.assertEqual(states[0].command.speed_fraction, 0.0)
        self.assertEqual(states[0].reason, "program: paused")
        # The heartbeat goes on: the link is fine.
        self.assertNotEqual(
            states[-1].command.heartbeat, states[-2].command.heartbeat
        )
        robot.modes["runtime_state"] = 2
        states = run(robot, 0.8, cycles=200, state=states[-1])
        self.assertEqual(states[0].phase, SliderPhase.RECOVERING)
        self.assertIn("program: paused", states[0].reason)
        self.assertLess(states[10].command.speed_fraction, 0.2)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)

    def test_pause_that_resets_the_slider(self):
        robot = Robot()
        state = settle(robot)
        robot.modes["runtime_state"] = 4
        robot.slider = 1.0
        states = run(robot, 0.8, cycles=20, state=state)
        self.assertEqual(robot.slider, 0.0)
        self.assertNotIn(SliderPhase.FAULT, {s.phase for s in states})

    def test_protective_stop_after_zero_is_reported(self):
        robot = Robot()
        state = settle(robot)
        states = run(robot, 0.0, cycles=10, state=state)
        states = run(robot, 0.8, cycles=3, state=states[-1])
        robot.modes["safety_mode"] = 3
        states = run(robot, 0.8, cycles=300, state=states[-1])
        for dut in states[0], states[-1]:
            self.assertIn("protective stop, right after", dut.reason)
        # One with another cause is not blamed on that.
        robot = Robot()
        state = settle(robot)
        robot.modes["safety_mode"] = 3
        (dut,) = run(robot, 0.8, cycles=1, state=state)
        self.assertEqual(dut.reason, "safety mode: protective stop")


class TestRest(unittest.TestCase):
    def test_a_robot_that_moves_must_stand_still_first(self):
        robot = Robot()
        robot.speed = 1.5
        states = run(robot, 1.0, cycles=50)
        self.assertEqual({s.command.speed_fraction for s in states}, {0.0})
        self.assertEqual(states[-1].phase, SliderPhase.WAITING)
        self.assertIn("until the robot stands still", states[-1].reason)
        robot.speed = math.nan
        state = run(robot, 1.0, cycles=50, state=states[-1])[-1]
        self.assertEqual(state.command.speed_fraction, 0.0)
        robot.speed = 0.0
        settle(robot, 1.0, state=state)

    def test_creeping_at_the_minimum_is_rest(self):
        config = mut.SliderConfig(minimum_fraction=0.02)
        robot = Robot()
        robot.speed = 0.02 * 3.14
        settle(robot, config=config)


class TestLateEcho(unittest.TestCase):
    def test_is_not_taken_for_a_person(self):
        """20 cycles late, while the law takes the robot down."""
        robot = Robot()
        state = settle(robot, 1.0)
        robot.delay = 20
        phases = set()
        for i in range(60):
            wanted = max(1.0 - 0.025 * i, 0.0)
            (state,) = run(robot, wanted, cycles=1, state=state)
            self.assertEqual(state.operator_fraction, 1.0)
            phases.add(state.phase)
        self.assertIn(SliderPhase.FAULT, phases)
        robot.delay = 1
        robot.queue.clear()
        run(robot, 0.0, cycles=20, state=state)
        self.assertEqual(robot.slider, 0.0)


class TestRecovery(unittest.TestCase):
    """After any problem, speed recovers through the reduced fraction."""

    def setUp(self):
        self.robot = Robot()

    def go(self, wanted, cycles, state, problem=""):
        """Returns the states of a number of reports."""
        states = []
        for _ in range(cycles):
            state = mut.step_slider(
                mut.SliderConfig(), state, self.robot.report(), wanted, problem
            )
            self.robot.queue.append(state.command)
            states.append(state)
        return states

    def assert_reduced_first(self, states):
        """0.5 s at one half, never more before, and 1 in the end."""
        fractions = [s.command.speed_fraction for s in states]
        above = next(i for i, f in enumerate(fractions) if f > 0.5)
        at = [f == 0.5 for f in fractions[:above]]
        self.assertGreaterEqual(sum(at) * _PERIOD, 0.5)
        self.assertLessEqual(sum(at) * _PERIOD, 0.5 + 4 * _PERIOD)
        # Without a gap, right before.
        self.assertTrue(all(at[-sum(at) :]))
        self.assertEqual(fractions[-1], 1.0)
        self.assertEqual(states[-1].phase, SliderPhase.FOLLOWING)
        self.assertEqual(states[-1].reason, "")

    def test_after_a_problem_that_stopped_the_robot(self):
        state = settle(self.robot, 1.0)
        states = self.go(0.0, 50, state, "elbow is faulted")
        self.assertEqual(states[-1].phase, SliderPhase.RECOVERING)
        self.assertTrue(states[-1].reason.endswith("at most 0.50 for now"))
        self.assertEqual(self.robot.slider, 0.0)
        states = self.go(1.0, 200, states[-1])
        # It is over.
        self.assertTrue(
            states[20].reason.endswith("for now, after: elbow is faulted")
        )
        self.assert_reduced_first(states)

    def test_after_a_problem_too_short_to_stop_it(self):
        state = settle(self.robot, 1.0)
        states = self.go(1.0, 1, state, "tool is faulted")
        states += self.go(1.0, 200, states[-1])
        fractions = [s.command.speed_fraction for s in states]
        lowest = fractions.index(0.5)
        # Down at the law's rate.
        steps = [b - a for a, b in itertools.pairwise([1.0, *fractions])]
        self.assertGreaterEqual(min(steps), -10 / 3 * _PERIOD - 1e-9)
        self.assertLessEqual(lowest * _PERIOD, 0.16)
        self.assert_reduced_first(states[lowest:])

    def test_each_problem_restarts_it(self):
        state = settle(self.robot, 1.0)
        for _ in range(5):
            state = self.go(0.0, 1, state, "base sample is too old")[-1]
            states = self.go(1.0, 60, state)
            state = states[-1]
            self.assertEqual(state.command.speed_fraction, 0.5)

    def test_a_person_near_does_not_count_as_time_that_was_well(self):
        """Only the time at the reduced fraction counts."""
        state = settle(self.robot, 1.0)
        state = self.go(0.0, 50, state, "elbow is faulted")[-1]
        state = self.go(0.0, 500, state)[-1]
        self.assert_reduced_first(self.go(1.0, 200, state))

    def test_after_an_ordinary_stop_the_law_is_followed(self):
        state = settle(self.robot, 1.0)
        state = self.go(0.0, 50, state)[-1]
        (state,) = self.go(1.0, 1, state)
        self.assertEqual(state.command.speed_fraction, 1.0)
        self.assertEqual(state.phase, SliderPhase.FOLLOWING)

    @given(
        st.lists(
            st.tuples(
                st.sampled_from(["", "", "", "a fault"]),
                st.sampled_from([0.0, 0.5, 1.0]),
                st.integers(1, 60),
            ),
            max_size=20,
        )
    )
    @settings(max_examples=50, deadline=None)
    def test_never_faster_without_half_a_second_of_health(self, pieces):
        self.robot = Robot()
        state, well = mut.SliderState(), 0
        for problem, wanted, cycles in pieces:
            for _ in range(cycles):
                before = state.fraction
                (state,) = self.go(wanted, 1, state, problem)
                well = 0 if problem else well + 1
                fraction = state.command.speed_fraction
                if well * _PERIOD < 0.5 and fraction > 0.5:
                    # It may be on its way down.
                    self.assertLessEqual(fraction, before)


class TestSession(unittest.TestCase):
    def test_new_connection_starts_again(self):
        robot = Robot()
        state = settle(robot)
        beat = state.command.heartbeat
        robot.session, robot.timestamp = 1, 5.0
        robot.queue.clear()
        states = run(robot, 0.8, cycles=200, state=state)
        self.assertEqual(states[0].phase, SliderPhase.WAITING)
        self.assertEqual(states[0].command.mask, 1)
        self.assertEqual(states[0].command.speed_fraction, 0.0)
        self.assertEqual(states[0].command.heartbeat, beat + 1)
        self.assertEqual(states[1].phase, SliderPhase.RECOVERING)
        self.assertIn("new session", states[1].reason)
        self.assertEqual(robot.slider, 0.8)

    def reconnect(self, robot):
        robot.session += 1
        robot.queue.clear()

    def test_what_a_person_allows_outlives_the_session(self):
        robot = Robot()
        state = settle(robot)
        robot.slider = 0.3
        state = run(robot, 0.8, cycles=50, state=state)[-1]
        for _ in range(2):
            self.reconnect(robot)
            states = run(robot, 1.0, cycles=400, state=state)
            state = states[-1]
            written = [s.command.speed_fraction for s in states]
            self.assertEqual(max(written), 0.3)
            self.assertEqual(robot.slider, 0.3)
            self.assertEqual(state.phase, SliderPhase.YIELDING)
        # A person who raises it meanwhile is ignored, but not afterwards.
        robot.slider = 0.9
        self.reconnect(robot)
        state = run(robot, 1.0, cycles=400, state=state)[-1]
        self.assertEqual(robot.slider, 0.3)
        robot.slider = 1.0
        run(robot, 1.0, cycles=400, state=state)
        self.assertEqual(robot.slider, 1.0)

    def test_lowered_while_there_was_no_connection(self):
        robot = Robot()
        state = settle(robot)
        robot.slider = 0.2
        self.reconnect(robot)
        run(robot, 1.0, cycles=400, state=state)
        self.assertEqual(robot.slider, 0.2)

    def test_what_was_still_on_its_way_is_nobodys_hand(self):
        robot = Robot(delay=4)
        state = settle(robot, 0.5)
        state = run(robot, 1.0, cycles=2, state=state)[-1]
        self.assertEqual(robot.slider, 0.5)
        self.reconnect(robot)
        run(robot, 1.0, cycles=400, state=state)
        self.assertEqual(robot.slider, 1.0)


class TestLimit(unittest.TestCase):
    """Where the slider stands at the start is the person's limit."""

    def test_low_at_the_start(self):
        robot = Robot(slider=0.1)
        states = run(robot, 1.0, cycles=400)
        self.assertEqual(max(s.command.speed_fraction for s in states), 0.1)
        self.assertEqual(states[-1].phase, SliderPhase.YIELDING)
        self.assertIn("set the slider to 0.10", states[-1].reason)
        robot.slider = 1.0
        run(robot, 1.0, cycles=400, state=states[-1])
        self.assertEqual(robot.slider, 1.0)

    def test_zero_says_what_to_do_and_gives_way(self):
        robot = Robot(slider=0.0)
        state = run(robot, 1.0, cycles=400)[-1]
        self.assertEqual(robot.slider, 0.0)
        self.assertEqual(state.phase, SliderPhase.YIELDING)
        self.assertIn("stands at 0", state.reason)
        self.assertIn("raise it on the pendant", state.reason)
        robot.slider = 0.7
        run(robot, 1.0, cycles=400, state=state)
        self.assertEqual(robot.slider, 0.7)

    def test_a_limit_that_is_given_counts_instead(self):
        for slider, limit in ((0.0, 1.0), (0.1, 0.6), (1.0, 0.4)):
            with self.subTest(slider=slider, limit=limit):
                robot = Robot(slider=slider)
                config = mut.SliderConfig(operator_limit=limit)
                run(robot, 1.0, cycles=400, config=config)
                self.assertEqual(robot.slider, limit)

    def test_limit_by_where_it_stands(self):
        for echo, limit in (
            (0.3, 0.3),
            (1.0, 1.0),
            (0.995, 1.0),
            (0.0, None),
            (math.nan, None),
            (5.0, None),
            (-0.3, None),
        ):
            with self.subTest(echo=echo):
                dut = mut.find_operator_limit(mut.SliderConfig(), echo)
                self.assertEqual(dut, limit)

    def test_a_person_is_not_minded_if_so_asked(self):
        robot = Robot(slider=0.1)
        config = mut.SliderConfig(yield_to_operator=False)
        run(robot, 1.0, cycles=400, config=config)
        self.assertEqual(robot.slider, 1.0)


class TestConfig(unittest.TestCase):
    def test_settings_are_checked(self):
        for settings_, message in (
            ({"confirm_cycles": 0}, "slider.confirm_cycles"),
            ({"tolerance": 0.0}, "slider.tolerance"),
            ({"minimum_fraction": 0.2}, "slider.minimum_fraction"),
            ({"minimum_fraction": math.nan}, "slider.minimum_fraction"),
            ({"rise_rate": 0.0}, "slider.rise_rate"),
            ({"fall_rate": math.nan}, "slider.fall_rate"),
            ({"reduced_fraction": 1.0}, "slider.reduced_fraction"),
            ({"reduced_fraction": 0.0}, "slider.reduced_fraction"),
            ({"recovery_time": -1.0}, "slider.recovery_time"),
            ({"operator_limit": 0.0}, "slider.operator_limit"),
            ({"operator_limit": math.nan}, "slider.operator_limit"),
        ):
            with (
                self.subTest(settings=settings_),
                self.assertRaisesRegex(UserError, message),
            ):
                mut.SliderConfig(**settings_).check("slider")
