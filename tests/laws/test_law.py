"""The three systems in their loop, as the monitor wires them."""

import functools
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from tofssm_drake.laws.dsi_filter import DsiFilter
from tofssm_drake.laws.speed_fraction import SpeedFractionTrajectory
from tofssm_drake.laws.tri_ssm import TriSsmDecision, TriSsmState
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.messages import RingHealth, Separation

PERIOD = 0.008
FAR, NEAR, CLOSE = 2.9, 1.1, 0.5


def make_separation(*, tick, distance, health=RingHealth.HEALTHY, k=0.0):
    """Returns the output of three rings at a third of the tick rate."""
    return Separation(
        name=RINGS,
        sequence=(tick - np.arange(3)) // 3,
        time=np.full(3, PERIOD * tick - 0.011),
        distance=np.array([np.inf, distance, np.inf]),
        sensor=np.array([-1, 3, -1]),
        direction=np.full((3, 3), np.nan),
        link_speed=np.zeros(3),
        k_l=np.full(3, k),
        k_o=np.full(3, k),
        health=np.array([0, health, 0]),
        count=np.zeros((3, 4), dtype=int),
    )


@functools.cache
def make_law(configuration):
    builder = DiagramBuilder()
    choice = TriSsm(configuration=configuration)
    law = builder.AddSystem(
        choice.make(links=RINGS, offset=np.zeros(3), period=PERIOD)
    )
    trajectory = builder.AddSystem(
        SpeedFractionTrajectory(name=RINGS, ramp=choice.traits.ramp)
    )
    builder.Connect(
        law.GetOutputPort("decision"), trajectory.GetInputPort("decision")
    )
    builder.ExportInput(law.GetInputPort("separation"), "in")
    builder.ExportOutput(law.GetOutputPort("decision"), "decision")
    builder.ExportOutput(trajectory.GetOutputPort("speed_fraction"), "rho")
    return builder.Build()


class Law:
    """The loop, stepped by one control tick at a time."""

    def __init__(self, configuration="vo"):
        self.diagram = make_law(configuration)
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.tick = 0
        self.sample = {"distance": np.inf}

    def eval(self, name):
        return self.diagram.GetOutputPort(name).Eval(self.context)

    @property
    def decision(self):
        return self.eval("decision")

    @property
    def index(self):
        law = self.diagram.GetSubsystemByName("tri_ssm_law")
        dsi_filter = law.GetSubsystemByName("dsi_filter")
        return dsi_filter.GetOutputPort("dsi").Eval(
            dsi_filter.GetMyContextFromRoot(self.context)
        )

    def is_sampled(self):
        """Returns whether the elbow ring has a new sample at this tick."""
        return (self.tick - 1) % 3 == 0

    def step(self, separation=None, **kwargs):
        """Returns psi and rho after a tick; rho is that of the next one."""
        if separation is None:
            if self.is_sampled():
                self.sample = kwargs
            separation = make_separation(tick=self.tick, **self.sample)
        self.diagram.GetInputPort("in").FixValue(
            self.context, Value(separation)
        )
        self.simulator.AdvanceTo(PERIOD * self.tick + 0.004)
        self.tick += 1
        return float(self.decision.robot_state), self.eval("rho")[0]

    def run(self, ticks, **kwargs):
        return np.array([self.step(**kwargs) for _ in range(ticks)])


class TestLaw(unittest.TestCase):
    def setUp(self):
        self.dut = Law()

    def test_starts_at_rest_and_gets_going(self):
        self.assertEqual(self.dut.eval("rho")[0], 0.0)
        values = self.dut.run(60, distance=FAR)
        self.assertEqual(values[-1].tolist(), [2.0, 1.0])
        self.assertEqual(self.dut.decision.reason, "normal")

    def test_stops_in_time(self):
        self.dut.run(60, distance=FAR)
        while not self.dut.is_sampled():
            self.dut.step(distance=FAR)
        values = self.dut.run(50, distance=CLOSE)
        self.assertTrue((values[:, 0] == 0.0).all())
        self.assertGreater(values[-2, 1], 0.0)
        self.assertEqual(values[-1, 1], 0.0)
        self.assertRegex(
            self.dut.decision.reason, "^stop: elbow at 0.500 m <= d_C 0.665 m$"
        )

    def test_reduces(self):
        self.dut.run(60, distance=FAR)
        values = self.dut.run(60, distance=NEAR)
        self.assertEqual(values[-1].tolist(), [2.0, 1.0])
        values = self.dut.run(60, distance=0.9)
        self.assertEqual(values[-1].tolist(), [1.0, 0.5])
        # The recovery distance: what was normal before is reduced now.
        values = self.dut.run(60, distance=NEAR)
        self.assertEqual(values[-1].tolist(), [1.0, 0.5])
        values = self.dut.run(60, distance=FAR)
        self.assertEqual(values[-1].tolist(), [2.0, 1.0])

    def test_silence_stops(self):
        self.dut.run(60, distance=FAR)
        frozen = make_separation(tick=self.dut.tick, distance=FAR)
        values = self.dut.run(13, separation=frozen)
        # 0.011 s of age when fresh, and 0.1 s is the deadline.
        self.assertTrue((values[:11, 0] == 2.0).all())
        self.assertEqual(values[12, 0], 0.0)
        values = self.dut.run(60, separation=frozen)
        self.assertEqual(values[-1].tolist(), [0.0, 0.0])
        self.assertIn("sample is", self.dut.decision.reason)

    def test_blind_reduces_and_faulted_stops(self):
        self.dut.run(60, distance=FAR)
        for health, end in (
            (RingHealth.BLIND, [1.0, 0.5]),
            (RingHealth.FAULTED, [0.0, 0.0]),
            (RingHealth.HEALTHY, [2.0, 1.0]),
        ):
            values = self.dut.run(60, distance=np.inf, health=health)
            self.assertEqual(values[-1].tolist(), end)

    def test_same_inputs_same_values(self):
        def run():
            dut = Law()
            random = np.random.default_rng(1)
            return np.array(
                [dut.step(distance=d) for d in random.uniform(0.4, 2.0, 50)]
            )

        np.testing.assert_array_equal(run(), run())

    @settings(max_examples=20)
    @given(
        st.sampled_from(("vo", "vr", "sm")),
        st.lists(
            st.tuples(
                st.floats(0.1, 3.0) | st.just(np.inf),
                st.floats(-4.0, 4.0),
                st.sampled_from(tuple(RingHealth)),
                st.integers(1, 6),
            ),
            max_size=12,
        ),
    )
    def test_invariants(self, configuration, schedule):
        dut = Law(configuration)
        previous_rho = 0.0
        for distance, k, health, ticks in schedule:
            for _ in range(ticks):
                psi, rho = dut.step(distance=distance, k=k, health=health)
                index = dut.index
                if (index.dsi_raw >= index.dsi_C).any():
                    self.assertEqual(psi, 0)
                if (index.health == RingHealth.FAULTED).any():
                    self.assertEqual(psi, 0)
                if (index.health == RingHealth.BLIND).any():
                    self.assertLessEqual(psi, 1)
                self.assertEqual(psi, dut.decision.state.min())
                for name, values in dut.decision.signal.items():
                    self.assertIs(values, getattr(index, name))
                if psi == 0:
                    self.assertLessEqual(rho, previous_rho)
                if psi == 1:
                    self.assertLessEqual(rho, max(previous_rho, 0.5))
                self.assertTrue(0.0 <= rho <= 1.0)
                previous_rho = rho


class TestPorts(unittest.TestCase):
    def test_names(self):
        for dut, inputs, outputs in (
            (DsiFilter(name=RINGS), ["separation", "robot_state"], ["dsi"]),
            (
                TriSsmState(name=RINGS),
                ["dsi"],
                ["robot_state", "ring_states", "reason"],
            ),
            (
                TriSsmDecision(name=RINGS),
                ["dsi", "ring_states"],
                ["decision"],
            ),
            (
                TriSsm().make(links=RINGS, offset=np.zeros(3), period=PERIOD),
                ["separation"],
                ["decision"],
            ),
            (
                SpeedFractionTrajectory(name=RINGS),
                ["decision"],
                ["speed_fraction"],
            ),
        ):
            self.assertEqual(
                [
                    dut.get_input_port(i).get_name()
                    for i in range(dut.num_input_ports())
                ],
                inputs,
            )
            self.assertEqual(
                [
                    dut.get_output_port(i).get_name()
                    for i in range(dut.num_output_ports())
                ],
                outputs,
            )
