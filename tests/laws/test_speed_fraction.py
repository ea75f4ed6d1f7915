import unittest
from unittest import mock

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from ruckig import Result

from tofssm_drake.errors import UserError
import tofssm_drake.laws.speed_fraction as mut
from tofssm_drake.messages import SpeedDecision

TARGETS = (0.0, 0.5, 1.0)
MAX_RATE = 10.0 / 3.0
MAX_ACCELERATION = 100.0 / 3.0
PERIOD = 0.008

# Runs of (psi, ticks): most are shorter than a full ramp.
schedules = st.lists(
    st.tuples(st.sampled_from((0, 1, 2)), st.integers(1, 40)), max_size=12
)


def run(states, *, rho=0.0, rate=0.0, literal=False, period=PERIOD):
    """Returns rho and its rate after each tick, the start included."""
    ramp = mut.SpeedRamp(literal=literal)
    values = [(rho, rate)]
    for psi in states:
        rho, rate = mut.calc_next_speed_fraction(
            ramp=ramp,
            period=period,
            rho=rho,
            rate=rate,
            target=TARGETS[psi],
        )
        values.append((rho, rate))
    return np.array(values)


def expand(schedule):
    return [psi for psi, ticks in schedule for _ in range(ticks)]


def integrate(rho):
    return np.trapezoid(rho, dx=PERIOD)


class TestCalcNextSpeedFraction(unittest.TestCase):
    def test_normal_to_stop(self):
        """0.400 s and an integral of 0.200 s: 0.34 m at 1.7 m/s."""
        for literal in (False, True):
            rho = run([0] * 60, rho=1.0, literal=literal)[:, 0]
            self.assertGreater(rho[49], 0.0)
            self.assertEqual(rho[50], 0.0)
            self.assertAlmostEqual(integrate(rho), 0.2, delta=1e-9)

    def test_normal_to_reduced(self):
        rho = run([1] * 60, rho=1.0)[:, 0]
        # 0.250 s is 31.25 ticks.
        self.assertGreater(rho[31], 0.5)
        self.assertEqual(rho[32], 0.5)
        self.assertAlmostEqual(integrate(rho - 0.5), 0.0625, delta=1e-6)

    def test_ramps_are_exact(self):
        """Checks against the closed form of a stop from normal."""
        t = PERIOD * np.arange(51)
        expected = np.where(
            t <= 0.1,
            1.0 - MAX_ACCELERATION * t**2 / 2.0,
            np.where(
                t <= 0.3,
                1.0 - MAX_RATE * (t - 0.05),
                MAX_ACCELERATION * (0.4 - t) ** 2 / 2.0,
            ),
        )
        np.testing.assert_allclose(
            run([0] * 50, rho=1.0)[:, 0], expected, rtol=0.0, atol=1e-9
        )

    def test_other_control_ticks(self):
        """Any tick steps along the same ramp."""
        for period in (0.001, 0.002, 0.016):
            ticks = round(0.4 / period)
            rho = run([0] * (ticks + 1), rho=1.0, period=period)[:, 0]
            t = period * np.arange(ticks + 1)
            expected = np.interp(
                t,
                PERIOD * np.arange(51),
                run([0] * 50, rho=1.0)[:, 0],
            )
            # Within the error of linear interpolation of the 8 ms ramp.
            np.testing.assert_allclose(
                rho[:-1],
                expected,
                rtol=0.0,
                atol=MAX_ACCELERATION * PERIOD**2 / 8.0 + 1e-9,
            )
            self.assertGreater(rho[ticks - 1], 0.0)
            self.assertAlmostEqual(rho[ticks], 0.0, delta=1e-9)
            self.assertEqual(rho[ticks + 1], 0.0)

    def test_stays_where_it_is(self):
        for psi, rho in enumerate(TARGETS):
            np.testing.assert_array_equal(
                run([psi] * 5, rho=rho), np.tile([rho, 0.0], (6, 1))
            )

    def test_arrives_exactly(self):
        for start in TARGETS:
            for psi, target in enumerate(TARGETS):
                end = run([psi] * 60, rho=start)[-1]
                self.assertEqual(tuple(end), (target, 0.0))

    @settings(max_examples=60)
    @given(schedules, st.booleans())
    def test_limits(self, schedule, literal):
        states = expand(schedule)
        rho, rate = run(states, literal=literal).T
        self.assertTrue(((rho >= 0.0) & (rho <= 1.0)).all())
        self.assertTrue((np.abs(rate) <= MAX_RATE + 1e-9).all())
        change = np.diff(rate)
        limit = MAX_ACCELERATION * PERIOD + 1e-6
        self.assertTrue((change <= limit).all())
        if not literal:
            # A rise may be cut.
            change = change[~((rate[:-1] > 0.0) & (change < 0.0))]
        self.assertTrue((change >= -limit).all())
        # rho is the integral of the rate.
        if literal:
            self.assertTrue(
                (
                    np.abs(np.diff(rho) - PERIOD * (rate[1:] + rate[:-1]) / 2)
                    < MAX_ACCELERATION * PERIOD**2 / 4 + 1e-9
                ).all()
            )

    @settings(max_examples=60)
    @given(schedules)
    def test_never_rises_above_its_target(self, schedule):
        """In particular it never rises while psi is stop."""
        states = expand(schedule)
        rho = run(states)[:, 0]
        target = np.array([TARGETS[psi] for psi in states])
        self.assertTrue(
            (rho[1:] <= np.maximum(rho[:-1], target)).all(),
        )

    @settings(max_examples=60)
    @given(schedules)
    def test_every_stop_is_as_short_as_from_normal(self, schedule):
        """T_stop and the braking distance hold from any state."""
        rho, rate = run(expand(schedule))[-1]
        rho = run([0] * 60, rho=rho, rate=rate)[:, 0]
        self.assertEqual(rho[50], 0.0)
        self.assertLessEqual(integrate(rho), 0.2 + 1e-9)

    def test_literal_stop_during_a_rise_takes_longer(self):
        rise = run([2] * 26, literal=True)
        rho, rate = rise[-1]
        self.assertAlmostEqual(rate, MAX_RATE)
        literal = run([0] * 80, rho=rho, rate=rate, literal=True)[:, 0]
        self.assertGreater(literal.max(), rho + 0.15)
        safe = run([0] * 80, rho=rho, rate=rate)[:, 0]
        self.assertEqual(safe.max(), rho)
        self.assertGreater(integrate(literal), integrate(safe) + 0.05)

    @settings(max_examples=30)
    @given(schedules)
    def test_nothing_is_remembered(self, schedule):
        """Checks that a fresh object continues in the same way."""
        states = expand(schedule)
        half = len(states) // 2
        whole = run(states)
        first = run(states[:half])
        second = run(states[half:], rho=first[-1, 0], rate=first[-1, 1])
        np.testing.assert_array_equal(whole[half:], second)

    def test_fails_to_zero(self):
        for rho, rate, target in (
            (np.nan, 0.0, 1.0),
            (0.5, np.nan, 1.0),
            (0.5, 0.0, np.nan),
            (np.inf, 0.0, 1.0),
        ):
            self.assertEqual(
                mut.calc_next_speed_fraction(
                    ramp=mut.SpeedRamp(),
                    period=PERIOD,
                    rho=rho,
                    rate=rate,
                    target=target,
                ),
                (0.0, 0.0),
            )

    def test_fails_to_zero_when_ruckig_does(self):
        for result in (Result.Error, Result.ErrorExecutionTimeCalculation):
            with mock.patch.object(mut, "_make_planner") as make_planner:
                otg = mock.Mock()
                otg.calculate.return_value = result
                make_planner.return_value = otg, mock.Mock(), mock.Mock()
                self.assertEqual(
                    mut.calc_next_speed_fraction(
                        ramp=mut.SpeedRamp(),
                        period=PERIOD,
                        rho=0.5,
                        rate=0.0,
                        target=1.0,
                    ),
                    (0.0, 0.0),
                )


class TestSpeedFractionTrajectory(unittest.TestCase):
    def setUp(self):
        self.dut = mut.SpeedFractionTrajectory(name=RINGS)
        self.simulator = Simulator(self.dut)
        self.context = self.simulator.get_mutable_context()
        self.tick = 0
        self.period = PERIOD

    def advance(self, psi, ticks):
        """Returns the output after each tick."""
        return self.advance_to(TARGETS[psi], ticks)

    def advance_to(self, target, ticks):
        self.dut.GetInputPort("decision").FixValue(
            self.context, Value(SpeedDecision(name=RINGS, target=target))
        )
        result = []
        for _ in range(ticks):
            self.simulator.AdvanceTo(self.period * (self.tick + 0.5))
            self.tick += 1
            result.append(
                self.dut.GetOutputPort("speed_fraction").Eval(self.context)[0]
            )
        return np.array(result)

    def test_starts_at_zero(self):
        self.assertEqual(
            self.dut.GetOutputPort("speed_fraction").Eval(self.context), [0.0]
        )

    def test_no_feedthrough(self):
        self.assertFalse(self.dut.HasAnyDirectFeedthrough())

    def test_targets(self):
        for psi, target, ticks in ((2, 1.0, 50), (1, 0.5, 32), (0, 0.0, 32)):
            rho = self.advance(psi, ticks)
            self.assertNotEqual(rho[-2], target)
            self.assertEqual(rho[-1], target)

    def test_other_control_ticks(self):
        for self.period, ticks in ((0.002, 200), (0.016, 25)):
            self.dut = mut.SpeedFractionTrajectory(
                name=RINGS, period=self.period
            )
            self.simulator = Simulator(self.dut)
            self.context = self.simulator.get_mutable_context()
            self.tick = 0
            rho = np.concatenate(
                [self.advance(2, ticks), self.advance(0, ticks)]
            )
            self.assertLess(rho[ticks - 2], 1.0)
            self.assertAlmostEqual(rho[ticks - 1], 1.0)
            self.assertGreater(rho[-2], 0.0)
            self.assertAlmostEqual(rho[-1], 0.0)
            self.assertAlmostEqual(
                np.diff(rho).max() / self.period, MAX_RATE, delta=0.1
            )

    def test_unknown_target_stops(self):
        for target in (np.nan, np.inf, -np.inf, -1.0, -0.1, 1.001, 3.0):
            self.advance(2, 60)
            rho = self.advance_to(target, 50)
            self.assertTrue((np.diff(rho) <= 0.0).all())
            self.assertEqual(rho[-1], 0.0)

    def test_any_target_is_reached(self):
        for target in (0.25, 0.1, 0.85, 0.3):
            rho = self.advance_to(target, 60)
            self.assertEqual(rho[-1], target)

    def test_follows_a_target_that_moves(self):
        """As of a law that goes by the distance: within the ramp's limits."""
        t = PERIOD * np.arange(1000)
        target = np.clip(0.5 + 0.6 * np.sin(2.0 * t), 0.0, 1.0)
        rho = np.array([self.advance_to(x, 1)[0] for x in target.tolist()])
        rise = np.diff(rho)
        self.assertTrue((np.abs(rise) <= PERIOD * MAX_RATE + 1e-9).all())
        # It lags, but it never rises above where it was told to go.
        self.assertLess(np.abs(rho - target)[100:].max(), 0.12)
        rising = rise > 0.0
        self.assertTrue((rho[1:] <= target[1:] + 1e-9)[rising].all())

    def test_bad_settings(self):
        for name in ("max_rate", "max_acceleration"):
            with self.assertRaisesRegex(UserError, rf"^ramp\.{name}: "):
                mut.SpeedFractionTrajectory(
                    name=RINGS, ramp=mut.SpeedRamp(**{name: -1.0})
                )

    def test_tick_must_last(self):
        for period in (0.0, -0.008, np.nan, np.inf):
            with self.assertRaisesRegex(UserError, "period"):
                mut.SpeedFractionTrajectory(name=RINGS, period=period)
