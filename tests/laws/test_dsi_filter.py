import dataclasses as dc
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from tofssm_drake.errors import UserError
from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.laws.distances import make_link_constants
import tofssm_drake.laws.dsi_filter as mut
from tofssm_drake.laws.tri_ssm import TriSsmState, classify_index
from tofssm_drake.messages import (
    RingHealth,
    RobotState,
    SafetyIndex,
    Separation,
    make_empty_separation,
)

INF = np.inf


def make_separation(
    *,
    sequence=0,
    time=0.0,
    distance=INF,
    link_speed=0.0,
    k_l=0.0,
    k_o=0.0,
    health=RingHealth.HEALTHY,
    name=RINGS,
):
    m = len(name)

    def full(value, dtype=float):
        return np.broadcast_to(np.asarray(value, dtype=dtype), m).copy()

    return Separation(
        name=name,
        sequence=full(sequence, int),
        time=full(time),
        distance=full(distance),
        sensor=np.full(m, -1),
        direction=np.full((m, 3), np.nan),
        link_speed=full(link_speed),
        k_l=full(k_l),
        k_o=full(k_o),
        health=full(health, int),
        count=np.zeros((m, 4), dtype=int),
    )


class TestFilterIndex(unittest.TestCase):
    def test_worked_trace(self):
        samples = [
            0.02,
            0.04,
            0.10,
            0.18,
            0.25,
            0.10,
            0.04,
            0.02,
            0.02,
            0.02,
            0.02,
        ]
        expected = [
            0.020000,
            0.036000,
            0.087200,
            0.161440,
            0.250000,
            0.205000,
            0.155500,
            0.114850,
            0.086395,
            0.066476,
            0.052534,
        ]
        dsi, filtered, states = np.inf, [], []
        for sample in samples:
            dsi = mut.filter_index(sample, dsi, 0.2, 0.3, 0.8)
            filtered.append(dsi)
            states.append(classify_index(dsi, 0.2, 0.05, False))
        np.testing.assert_allclose(filtered, expected, rtol=0, atol=5.1e-7)
        self.assertEqual(states, [2, 2, 1, 1, 0, 0, 1, 1, 1, 1, 1])

    @given(
        st.floats(0, 1e5),
        st.floats(0, 1e5) | st.just(np.inf),
        st.floats(0, 1e5),
    )
    def test_critical_sample_is_critical_at_once(self, dsi, previous, dsi_C):
        result = mut.filter_index(dsi, previous, dsi_C, 0.3, 0.8)
        if dsi >= dsi_C:
            self.assertGreaterEqual(result, dsi_C)

    @given(
        st.floats(0, 1e5),
        st.integers(0, 3),
        st.floats(0, 1),
    )
    def test_falling_is_never_below_the_sample(self, dsi, ulps, alpha_I):
        """Also if only the last digits differ."""
        previous = dsi
        for _ in range(ulps):
            previous = np.nextafter(previous, np.inf)
        self.assertGreaterEqual(
            mut.filter_index(dsi, previous, dsi, alpha_I, 0.8), dsi
        )

    @given(st.floats(0, 1e5), st.floats(0, 1e5), st.floats(0, 1e5))
    def test_stays_between(self, dsi, previous, dsi_C):
        result = mut.filter_index(dsi, previous, dsi_C, 0.3, 0.8)
        low, high = sorted((dsi, previous))
        self.assertTrue(low * (1 - 1e-15) <= result <= high * (1 + 1e-15))


class TestCalcSafetyIndex(unittest.TestCase):
    def setUp(self):
        self.state = mut.make_initial_filter_state(3)
        self.config = SsmConfig()

    def calc(self, separation):
        return mut.calc_safety_index(
            constants=make_link_constants(self.config, RINGS),
            state=self.state,
            separation=separation,
        )

    def step(self, separation, robot_state):
        index = self.calc(separation)
        before = self.state.copy()
        changed = mut.advance_filter_state(
            self.state, index.sequence, index.dsi, robot_state
        )
        self.assertEqual(changed, (self.state != before).any())
        return index

    def test_nothing_yet(self):
        index = self.calc(make_empty_separation(RINGS))
        self.assertTrue((index.health == RingHealth.FAULTED).all())
        self.assertTrue((index.dsi >= index.dsi_C).all())
        self.assertTrue(np.isnan(index.dsi_raw).all())
        self.assertTrue((index.d_C == INF).all())

    def test_first_sample_initialises(self):
        index = self.calc(make_separation(distance=[0.6, 1.2, INF]))
        np.testing.assert_allclose(index.dsi_raw, [0.25, 0.0625, 0.0])
        np.testing.assert_array_equal(index.dsi, index.dsi_raw)
        self.assertTrue((index.health == RingHealth.HEALTHY).all())

    def test_one_step_per_sample(self):
        self.step(make_separation(distance=0.6), 2)
        separation = make_separation(sequence=1, distance=INF)
        for _ in range(5):
            index = self.step(separation, 2)
            np.testing.assert_allclose(index.dsi, 0.7 * 0.25)

    def test_rings_are_stepped_one_by_one(self):
        self.step(make_separation(distance=0.6), 2)
        index = self.step(
            make_separation(sequence=[0, 1, 0], distance=[0.3, INF, 0.3]), 2
        )
        np.testing.assert_allclose(index.dsi, [0.25, 0.175, 0.25])

    def test_thresholds_take_the_last_ticks_robot_state(self):
        separation = make_separation(sequence=0)
        d_R = [self.step(separation, 2).d_R[0] for _ in range(3)]
        # The sample came while the robot stood: 0.995 + 2 * 0.17.
        np.testing.assert_allclose(d_R, 1.335)
        separation = make_separation(sequence=1)
        d_R = [self.step(separation, 1).d_R[0] for _ in range(3)]
        np.testing.assert_allclose(d_R, 0.995)
        separation = make_separation(sequence=2)
        np.testing.assert_allclose(self.step(separation, 0).d_R, 1.165)

    def test_unknown_robot_state_is_stop(self):
        for robot_state in (np.nan, INF, -1.0, 0.5, 3.0):
            self.step(make_separation(), robot_state)
            self.assertEqual(self.state[-1], RobotState.STOP)

    def test_configuration_chooses_the_speed(self):
        separation = make_separation(k_l=0.5, k_o=1.6)
        for configuration, d_C in (
            ("vo", 0.165 + 0.32 + 0.5),
            ("vr", 0.085 + 0.1 + 0.5),
            ("sm", 0.5),
        ):
            self.config = SsmConfig(configuration=configuration)
            np.testing.assert_allclose(self.calc(separation).d_C, d_C)

    def test_blind_or_faulted_holds_the_index(self):
        self.step(make_separation(distance=0.6), 2)
        for i, health in enumerate((RingHealth.BLIND, RingHealth.FAULTED)):
            index = self.step(make_separation(sequence=1 + i, health=health), 2)
            np.testing.assert_allclose(index.dsi, 0.25)
            self.assertTrue(np.isnan(index.dsi_raw).all())
            self.assertTrue((index.health == health).all())
        index = self.step(make_separation(sequence=3), 2)
        np.testing.assert_allclose(index.dsi, 0.175)

    def test_first_healthy_sample_initialises_after_a_blind_one(self):
        index = self.step(make_separation(health=RingHealth.BLIND), 2)
        self.assertTrue((index.dsi == INF).all())
        index = self.step(make_separation(sequence=1, distance=0.6), 2)
        np.testing.assert_allclose(index.dsi, 0.25)

    def test_not_a_number_is_a_fault(self):
        for field in ("distance", "k_o", "link_speed"):
            index = self.calc(make_separation(**{field: [np.nan, 1.0, 1.0]}))
            np.testing.assert_array_equal(
                index.health,
                [RingHealth.FAULTED, RingHealth.HEALTHY, RingHealth.HEALTHY],
                err_msg=field,
            )
        index = self.calc(make_separation(k_l=np.nan))
        self.assertTrue((index.health == RingHealth.HEALTHY).all())
        self.config = SsmConfig(configuration="sm")
        index = self.calc(make_separation(k_l=np.nan, link_speed=np.nan))
        self.assertTrue((index.health == RingHealth.HEALTHY).all())

    def test_touching_or_inside_is_finite_and_recovers(self):
        self.step(make_separation(distance=[0.0, -0.5, 1e-9]), 2)
        index = self.calc(make_separation(distance=[0.0, -0.5, 1e-9]))
        np.testing.assert_allclose(index.dsi, 9.0e4)
        for sequence in range(1, 60):
            index = self.step(make_separation(sequence=sequence), 2)
        self.assertTrue((index.dsi < index.dsi_R).all())

    def test_a_sequence_that_restarts_is_a_new_sample(self):
        self.step(make_separation(sequence=17, distance=0.6), 2)
        index = self.calc(make_separation(sequence=0, distance=INF))
        np.testing.assert_allclose(index.dsi, 0.175)

    @settings(max_examples=50)
    @given(st.data())
    def test_critical_distance_stops_in_the_same_sample(self, data):
        """Whatever came before: DSI >= DSI_C, or ||D|| <= d_C, is a stop."""
        self.setUp()
        self.config = SsmConfig(
            configuration=data.draw(st.sampled_from(("vo", "vr", "sm")))
        )
        for sequence in range(data.draw(st.integers(1, 8))):
            distance, link_speed, k = (
                data.draw(st.lists(values, min_size=3, max_size=3))
                for values in (
                    st.floats(0.05, 3.0) | st.just(INF),
                    st.floats(0, 2),
                    st.floats(-4, 4),
                )
            )
            index = self.step(
                make_separation(
                    sequence=sequence,
                    distance=distance,
                    link_speed=link_speed,
                    k_l=k,
                    k_o=k,
                ),
                data.draw(st.sampled_from((0, 1, 2))),
            )
            for i in range(3):
                psi = classify_index(
                    index.dsi[i], index.dsi_C[i], index.dsi_R[i], False
                )
                if (
                    index.dsi_raw[i] >= index.dsi_C[i]
                    or distance[i] <= index.d_C[i]
                ):
                    self.assertEqual(psi, RobotState.STOP)

    @settings(max_examples=50)
    @given(
        st.lists(st.floats(0.05, 3.0) | st.just(INF), min_size=3, max_size=3),
        st.lists(
            st.tuples(
                st.lists(st.booleans(), min_size=3, max_size=3),
                st.floats(0.05, 3.0),
                st.sampled_from((0, 1, 2)),
            ),
            max_size=6,
        ),
    )
    def test_idempotent(self, distance, steps):
        """Checks that asking again after the update gives the same."""
        self.setUp()
        sequence = np.zeros(3, dtype=int)
        self.step(make_separation(distance=distance), 2)
        for is_new, one_distance, robot_state in steps:
            sequence = sequence + is_new
            separation = make_separation(
                sequence=sequence, distance=one_distance
            )
            before = self.step(separation, robot_state)
            after = self.calc(separation)
            for field in ("d_C", "d_R", "dsi", "dsi_C", "dsi_R"):
                np.testing.assert_array_equal(
                    getattr(before, field), getattr(after, field)
                )


class TestDsiFilter(unittest.TestCase):
    def setUp(self):
        self.dut = mut.DsiFilter(name=RINGS)
        self.context = self.dut.CreateDefaultContext()

    def fix(self, separation=None, robot_state=None):
        if separation is not None:
            self.dut.GetInputPort("separation").FixValue(
                self.context, Value(separation)
            )
        if robot_state is not None:
            self.dut.GetInputPort("robot_state").FixValue(
                self.context, [robot_state]
            )

    def eval(self):
        return self.dut.GetOutputPort("dsi").Eval(self.context)

    def update(self):
        self.context.SetDiscreteState(
            self.dut.EvalUniquePeriodicDiscreteUpdate(self.context)
        )

    def test_feedthrough(self):
        """The robot state must not close a loop through this system."""
        self.assertTrue(self.dut.HasDirectFeedthrough(0, 0))
        self.assertFalse(self.dut.HasDirectFeedthrough(1, 0))

    def test_new_sample_shows_at_once_and_once(self):
        self.fix(make_separation(distance=0.6), 2)
        np.testing.assert_allclose(self.eval().dsi, 0.25)
        self.update()
        np.testing.assert_allclose(self.eval().dsi, 0.25)
        self.fix(make_separation(sequence=1))
        np.testing.assert_allclose(self.eval().dsi, 0.175)
        for _ in range(3):
            self.update()
            np.testing.assert_allclose(self.eval().dsi, 0.175)
        np.testing.assert_allclose(self.eval().d_R, 0.995)

    def test_same_index_until_something_is_new(self):
        """Storing a sample changes the state, but not the index."""
        self.fix(make_separation(distance=0.6), 2)
        index = self.eval()
        self.update()
        self.assertIs(self.eval(), index)
        # The robot state alone matters only for the next sample.
        self.fix(robot_state=1)
        self.update()
        self.assertIs(self.eval(), index)
        self.fix(make_separation(sequence=1))
        after = self.eval()
        self.assertIsNot(after, index)
        self.update()
        self.assertIs(self.eval(), after)
        np.testing.assert_allclose(after.d_R, 1.165)

    def test_changed_sample_is_calculated_again(self):
        """Also if it has the number of the stored one."""
        separation = make_separation(distance=0.6)
        for change in (
            {"health": np.full(3, RingHealth.FAULTED)},
            {"k_o": np.full(3, 1.6)},
            {"link_speed": np.full(3, 1.0)},
            {"distance": np.array([np.nan, 0.6, 0.6])},
            {"time": np.full(3, -1.0)},
            {"sequence": np.array([0, 1, 0]), "distance": np.full(3, 0.3)},
        ):
            with self.subTest(change):
                self.setUp()
                self.fix(separation, 2)
                self.eval()
                self.update()
                before = self.eval()
                changed = dc.replace(separation, **change)
                self.fix(changed)
                self.check_is_calculated(changed)
                # And back.
                self.fix(separation)
                self.check_is_calculated(separation)
                np.testing.assert_array_equal(self.eval().dsi, before.dsi)

    def test_state_set_by_hand_is_calculated_again(self):
        separation = make_separation(distance=1.0)
        self.fix(separation, 2)
        self.eval()
        self.update()
        stored = self.context.get_discrete_state_vector().value().copy()
        self.eval()
        for i in range(len(stored)):
            for value in (-1.0, 0.0, 1.0, 2.0, 3.0):
                state = stored.copy()
                state[i] = value
                self.context.SetDiscreteState(state)
                self.check_is_calculated(separation)
        self.context.SetDiscreteState(stored)
        self.check_is_calculated(separation)

    def check_is_calculated(self, separation):
        """Compares the output with that of a new filter."""
        expected = mut.calc_safety_index(
            constants=make_link_constants(SsmConfig(), RINGS),
            state=self.context.get_discrete_state_vector().value(),
            separation=separation,
        )
        index = self.eval()
        for field in dc.fields(SafetyIndex):
            np.testing.assert_array_equal(
                getattr(index, field.name),
                getattr(expected, field.name),
                err_msg=field.name,
            )

    def test_other_control_ticks(self):
        for period in (0.002, 0.016):
            dut = mut.DsiFilter(name=RINGS, period=period)
            simulator = Simulator(dut)
            context = simulator.get_mutable_context()
            dut.GetInputPort("separation").FixValue(
                context, Value(make_separation(sequence=5))
            )
            dut.GetInputPort("robot_state").FixValue(context, [2.0])
            simulator.AdvanceTo(0.5 * period)
            state = context.get_discrete_state_vector()
            self.assertEqual(state[0], 5)
            dut.GetInputPort("separation").FixValue(
                context, Value(make_separation(sequence=6))
            )
            simulator.AdvanceTo(0.99 * period)
            self.assertEqual(state[0], 5)
            simulator.AdvanceTo(1.01 * period)
            self.assertEqual(state[0], 6)

    def test_contexts_are_independent(self):
        self.fix(make_separation(distance=0.6), 2)
        self.update()
        other = self.context.Clone()
        self.fix(make_separation(sequence=1))
        self.update()
        np.testing.assert_allclose(
            self.dut.GetOutputPort("dsi").Eval(other).dsi, 0.25
        )

    def test_wrong_links(self):
        self.fix(make_separation(name=("lidar",)))
        with self.assertRaisesRegex(ValueError, "links.*lidar"):
            self.eval()

    def test_one_link(self):
        dut = mut.DsiFilter(
            config=SsmConfig(configuration="sm"), name=("lidar",)
        )
        context = dut.CreateDefaultContext()
        dut.GetInputPort("separation").FixValue(
            context, Value(make_separation(name=("lidar",), distance=0.6))
        )
        np.testing.assert_allclose(
            dut.GetOutputPort("dsi").Eval(context).dsi, [0.25]
        )

    def test_bad_config(self):
        with self.assertRaises(UserError):
            mut.DsiFilter(name=RINGS, config=SsmConfig(alpha_I=2.0))

    def test_tick_must_last(self):
        for period in (0.0, -0.008, np.nan, np.inf):
            with self.assertRaisesRegex(UserError, "period"):
                mut.DsiFilter(name=RINGS, period=period)

    def test_loop_with_the_state(self):
        """Checks hysteresis in the closed loop of filter and state.

        At 1.2 m and rest the robot is reduced when it comes from stop
        (d_R 1.335 m) and stays so (d_R 1.165 m is nearer: normal) only until
        the next sample.
        """
        builder = DiagramBuilder()
        dut = builder.AddSystem(self.dut)
        tri_ssm = builder.AddSystem(TriSsmState(name=RINGS))
        builder.Connect(dut.GetOutputPort("dsi"), tri_ssm.GetInputPort("dsi"))
        builder.Connect(
            tri_ssm.GetOutputPort("robot_state"),
            dut.GetInputPort("robot_state"),
        )
        builder.ExportInput(dut.GetInputPort("separation"), "separation")
        builder.ExportOutput(tri_ssm.GetOutputPort("robot_state"), "psi")
        diagram = builder.Build()
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        port = diagram.GetInputPort("separation")
        states = []
        for tick in range(6):
            port.FixValue(
                context,
                Value(
                    make_separation(
                        sequence=tick // 3, time=0.008 * tick, distance=1.2
                    )
                ),
            )
            simulator.AdvanceTo(0.008 * tick + 0.004)
            states.append(
                diagram.GetOutputPort("psi").Eval(context)[0],
            )
        self.assertEqual(states, [1, 1, 1, 2, 2, 2])
