import dataclasses as dc
import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value

from tofssm_drake.errors import UserError
from tofssm_drake.laws.config import SsmConfig
import tofssm_drake.laws.tri_ssm as mut
from tofssm_drake.messages import (
    RingHealth,
    RobotState,
    SafetyIndex,
    make_empty_safety_index,
)

# Thresholds of all at rest, "vo", psi = 2.
D_C, D_R = 0.665, 0.995


def make_index(
    *,
    distance=(np.inf, np.inf, np.inf),
    measured=None,
    sequence=(0, 0, 0),
    time=(0.0, 0.0, 0.0),
    d_C=D_C,
    d_R=D_R,
    health=(0, 0, 0),
):
    measured = distance if measured is None else measured
    return SafetyIndex(
        name=RINGS,
        sequence=np.array(sequence),
        time=np.array(time),
        d_C=np.full(3, d_C),
        d_R=np.full(3, d_R),
        dsi_raw=(0.3 / np.array(measured)) ** 2,
        dsi=(0.3 / np.array(distance)) ** 2,
        dsi_C=np.full(3, (0.3 / d_C) ** 2),
        dsi_R=np.full(3, (0.3 / d_R) ** 2),
        health=np.array(health),
    )


class TestClassifyIndex(unittest.TestCase):
    def test_bounds(self):
        """Critical at DSI_C itself, normal at DSI_R itself."""
        for dsi, psi in (
            (0.0, 2),
            (0.1, 2),
            (np.nextafter(0.1, 1), 1),
            (np.nextafter(0.2, 0), 1),
            (0.2, 0),
            (9.0, 0),
            (np.inf, 0),
            (np.nan, 0),
        ):
            for literal in (False, True):
                self.assertEqual(
                    mut.classify_index(dsi, 0.2, 0.1, literal), psi
                )

    def test_order_of_the_tests(self):
        """If d_R < d_C only the paper's order calls it normal."""
        self.assertEqual(mut.classify_index(0.5, 0.416233, 1.108033, False), 0)
        self.assertEqual(mut.classify_index(0.5, 0.416233, 1.108033, True), 2)

    def test_unknown_threshold_stops(self):
        for dsi_C, dsi_R in ((np.nan, 0.1), (np.nan, np.nan), (0.0, 0.0)):
            self.assertEqual(
                mut.classify_index(0.05, dsi_C, dsi_R, False), RobotState.STOP
            )

    @given(st.floats(0, 10), st.floats(0, 10), st.floats(0, 10))
    def test_safe_is_never_faster_than_literal(self, dsi, dsi_C, dsi_R):
        self.assertLessEqual(
            mut.classify_index(dsi, dsi_C, dsi_R, False),
            mut.classify_index(dsi, dsi_C, dsi_R, True),
        )

    @given(st.floats(0, 10), st.floats(0, 10), st.floats(0, 10))
    def test_nearer_is_never_faster(self, dsi, more, dsi_C):
        self.assertLessEqual(
            mut.classify_index(dsi + more, dsi_C, 0.5 * dsi_C, False),
            mut.classify_index(dsi, dsi_C, 0.5 * dsi_C, False),
        )


class TestStates(unittest.TestCase):
    config = SsmConfig()

    def states(self, index, now=0.0):
        return mut.calc_ring_states(
            index=index, now=now, config=self.config
        ).tolist()

    def reason(self, index, now=0.0):
        return mut.calc_reason(index=index, now=now, config=self.config)

    def test_normal(self):
        index = make_index(distance=(1.0, np.inf, 2.0))
        self.assertEqual(self.states(index), [2, 2, 2])
        self.assertEqual(self.reason(index), "normal")

    def test_distances(self):
        index = make_index(distance=(0.7, 0.6, 2.0))
        self.assertEqual(self.states(index), [1, 0, 2])
        self.assertEqual(
            self.reason(index), "stop: elbow at 0.600 m <= d_C 0.665 m"
        )
        index = make_index(distance=(0.9, np.inf, 0.8))
        self.assertEqual(
            self.reason(index), "reduced: tool at 0.800 m < d_R 0.995 m"
        )

    def test_filtered_distance_is_reported(self):
        index = make_index(distance=(0.6, 2.0, 2.0), measured=(0.9, 2.0, 2.0))
        self.assertEqual(
            self.reason(index),
            "stop: base at 0.600 m (filtered; measured 0.900 m) <= d_C 0.665 m",
        )
        index = make_index(
            distance=(0.6, 2.0, 2.0), measured=(np.inf, 2.0, 2.0)
        )
        self.assertIn("measured clear", self.reason(index))

    def test_no_sample(self):
        index = make_index(sequence=(3, -1, 4))
        self.assertEqual(self.states(index), [2, 0, 2])
        self.assertEqual(self.reason(index), "stop: elbow has no sample yet")
        self.assertEqual(self.states(make_empty_safety_index(RINGS)), [0, 0, 0])

    def test_deadline(self):
        index = make_index(time=(1.0, 1.0, 0.95))
        self.assertEqual(self.states(index, 1.049), [2, 2, 2])
        self.assertEqual(self.states(index, 1.051), [2, 2, 0])
        self.assertEqual(
            self.reason(index, 1.06),
            "stop: tool sample is 0.110 s old, deadline 0.100 s",
        )
        self.assertEqual(self.states(index, 1.2), [0, 0, 0])

    def test_sample_of_another_clock(self):
        """A sample from far in the future would never grow too old."""
        index = make_index(time=(0.0, 0.05, 0.2))
        self.assertEqual(self.states(index), [2, 2, 0])
        for time in (-np.inf, np.inf, np.nan):
            self.assertEqual(
                self.states(make_index(time=(time, 0, 0))), [0, 2, 2]
            )

    def test_faulted(self):
        index = make_index(health=(0, 0, RingHealth.FAULTED))
        self.assertEqual(self.states(index), [2, 2, 0])
        self.assertEqual(self.reason(index), "stop: tool is faulted")
        self.assertEqual(self.states(make_index(health=(7, 0, 0))), [0, 2, 2])

    def test_blind_is_at_most_reduced(self):
        blind = int(RingHealth.BLIND)
        index = make_index(
            distance=(2.0, 0.8, 0.6), health=(blind, blind, blind)
        )
        self.assertEqual(self.states(index), [1, 1, 0])
        self.assertEqual(
            self.reason(index), "stop: tool at 0.600 m <= d_C 0.665 m"
        )
        index = make_index(health=(0, blind, 0))
        self.assertEqual(self.states(index), [2, 1, 2])
        self.assertEqual(self.reason(index), "reduced: elbow is blind")

    def test_blind_from_the_beginning_is_reduced(self):
        index = dc.replace(
            make_index(health=(int(RingHealth.BLIND),) * 3),
            dsi=np.full(3, np.inf),
        )
        self.assertEqual(self.states(index), [1, 1, 1])

    def test_literal(self):
        index = make_index(distance=(0.4, 2.0, 2.0), d_C=0.465, d_R=0.285)
        self.assertEqual(self.states(index), [0, 2, 2])
        states = mut.calc_ring_states(
            index=index, now=0.0, config=SsmConfig(literal=True)
        )
        self.assertEqual(states.tolist(), [2, 2, 2])

    @given(
        st.lists(
            st.tuples(
                st.floats(0.01, 5.0) | st.just(np.inf),
                st.floats(0.01, 5.0) | st.just(np.inf) | st.just(np.nan),
                st.integers(-1, 2),
                st.floats(-1, 1) | st.just(-np.inf) | st.just(np.nan),
                st.integers(0, 2),
            ),
            min_size=3,
            max_size=3,
        )
    )
    def test_reason_is_one_line_of_the_state(self, links):
        distance, measured, sequence, time, health = zip(*links, strict=True)
        index = make_index(
            distance=distance,
            measured=measured,
            sequence=sequence,
            time=time,
            health=health,
        )
        psi = min(self.states(index))
        reason = self.reason(index)
        self.assertNotIn("\n", reason)
        self.assertTrue(
            reason.startswith(("stop: ", "reduced: ", "normal")[int(psi)])
        )
        if psi < 2:
            self.assertTrue(any(name in reason for name in RINGS))
        self.assertNotIn("nan m", reason)


class TestTriSsmState(unittest.TestCase):
    def setUp(self):
        self.dut = mut.TriSsmState(name=RINGS)
        self.context = self.dut.CreateDefaultContext()

    def fix(self, index):
        self.dut.GetInputPort("dsi").FixValue(self.context, Value(index))

    def eval(self, name):
        return self.dut.GetOutputPort(name).Eval(self.context)

    def test_outputs(self):
        self.fix(make_index(distance=(0.9, 2.0, np.inf)))
        self.assertEqual(self.eval("robot_state").tolist(), [1])
        self.assertEqual(self.eval("ring_states").tolist(), [1, 2, 2])
        self.assertEqual(
            self.eval("reason"), "reduced: base at 0.900 m < d_R 0.995 m"
        )

    def test_starts_stopped(self):
        self.fix(make_empty_safety_index(RINGS))
        self.assertEqual(self.eval("robot_state").tolist(), [0])
        self.assertEqual(self.eval("reason"), "stop: base has no sample yet")

    def test_time_alone_stops(self):
        """No new message, only time: the outputs must not be stale."""
        self.fix(make_index())
        self.assertEqual(self.eval("robot_state").tolist(), [2])
        self.context.SetTime(0.101)
        self.assertEqual(self.eval("robot_state").tolist(), [0])
        self.assertEqual(self.eval("ring_states").tolist(), [0, 0, 0])
        self.assertIn("old", self.eval("reason"))

    def test_config_is_copied_and_checked(self):
        config = SsmConfig(deadline=0.5)
        dut = mut.TriSsmState(name=RINGS, config=config)
        config.deadline = 0.01
        context = dut.CreateDefaultContext()
        context.SetTime(0.4)
        dut.GetInputPort("dsi").FixValue(context, Value(make_index()))
        self.assertEqual(
            dut.GetOutputPort("robot_state").Eval(context).tolist(), [2]
        )
        with self.assertRaises(UserError):
            mut.TriSsmState(name=RINGS, config=SsmConfig(deadline=0.0))


class TestTriSsmDecision(unittest.TestCase):
    def decide(self, index, *, states=None, time=0.0, **options):
        dut = mut.TriSsmDecision(name=RINGS, **options)
        context = dut.CreateDefaultContext()
        context.SetTime(time)
        if states is None:
            states = mut.calc_ring_states(
                index=index, now=time, config=SsmConfig()
            )
        dut.GetInputPort("dsi").FixValue(context, Value(index))
        dut.GetInputPort("ring_states").FixValue(context, states)
        return dut.GetOutputPort("decision").Eval(context)

    def test_lowest_state_gives_the_target(self):
        for distance, target, link in (
            ((2.0, 2.0, 2.0), 1.0, ""),
            ((2.0, 0.9, 2.0), 0.5, "elbow"),
            ((0.6, 0.9, 2.0), 0.0, "base"),
        ):
            index = make_index(distance=distance)
            decision = self.decide(index)
            self.assertEqual((decision.target, decision.link), (target, link))
            self.assertEqual(decision.robot_state, decision.state.min())
            self.assertEqual(
                decision.reason,
                mut.calc_reason(index=index, now=0.0, config=SsmConfig()),
            )
            for name in mut.SIGNALS:
                np.testing.assert_array_equal(
                    decision.signal[name], getattr(index, name)
                )

    def test_reduced_fraction_is_a_setting(self):
        decision = self.decide(
            make_index(distance=(0.9, 2.0, 2.0)),
            config=SsmConfig(rho_reduced=0.25),
        )
        self.assertEqual(decision.target, 0.25)

    def test_unknown_state_stops(self):
        for psi in (np.nan, np.inf, -1.0, 0.5, 3.0):
            index = make_index(distance=(2.0, 2.0, 2.0))
            decision = self.decide(index, states=np.array([2.0, psi, 2.0]))
            self.assertEqual((decision.target, decision.link), (0.0, "elbow"))
            self.assertEqual(decision.state.tolist(), [2, 0, 2])

    def test_time_alone_stops(self):
        decision = self.decide(make_index(), time=0.101)
        self.assertEqual((decision.target, decision.link), (0.0, "base"))
        self.assertIn("sample is 0.101 s old", decision.reason)

    def test_same_decision_until_something_is_new(self):
        dut = mut.TriSsmDecision(name=RINGS)
        context = dut.CreateDefaultContext()
        index = make_index(distance=(2.0, 0.9, 2.0))

        def decide(time, index, states):
            context.SetTime(time)
            dut.GetInputPort("dsi").FixValue(context, Value(index))
            dut.GetInputPort("ring_states").FixValue(context, states)
            return dut.GetOutputPort("decision").Eval(context)

        first = decide(0.0, index, [2.0, 1.0, 2.0])
        self.assertIs(decide(0.008, index, [2.0, 1.0, 2.0]), first)
        self.assertEqual(decide(0.016, index, [0.0, 1.0, 2.0]).target, 0.0)
        again = decide(0.024, index, [2.0, 1.0, 2.0])
        self.assertEqual((again.target, again.reason), (0.5, first.reason))
        nearer = make_index(distance=(2.0, 0.8, 2.0))
        self.assertIn("0.800 m", decide(0.032, nearer, [2.0, 1.0, 2.0]).reason)
        # The reason tells the age of a sample that is too old.
        for time in (0.101, 0.109):
            self.assertIn(
                f"sample is {time:.3f} s old",
                decide(time, nearer, [0.0, 0.0, 0.0]).reason,
            )
        self.assertIn("0.800 m", decide(0.04, nearer, [2.0, 1.0, 2.0]).reason)

    def test_reason_of_a_link_measured_from_farther_away(self):
        """The index is that of 1.12 m: the reason gives the distance."""
        index = dc.replace(
            make_index(distance=(np.inf, 1.3, np.inf), d_C=1.485, d_R=1.8),
            dsi=np.array([0.0, (1.12 / 1.3) ** 2, 0.0]),
            dsi_raw=np.array([0.0, (1.12 / 1.3) ** 2, 0.0]),
            dsi_C=np.full(3, (1.12 / 1.485) ** 2),
            dsi_R=np.full(3, (1.12 / 1.8) ** 2),
        )
        decision = self.decide(index, offset=np.array([0.0, 0.82, 0.0]))
        self.assertEqual(
            decision.reason, "stop: elbow at 1.300 m <= d_C 1.485 m"
        )
