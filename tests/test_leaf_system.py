"""The base class is Drake's LeafSystem in all but what it costs."""

import unittest

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import EventStatus
from pydrake.systems.framework import LeafSystem as DrakeLeafSystem

from tofssm_drake.leaf_system import LeafSystem


class Counter(LeafSystem):
    def __init__(self):
        super().__init__()
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self._update)

    def _update(self, context, discrete_state):
        discrete_state.get_mutable_value(0)[0] += 1.0
        return EventStatus.Succeeded()


class Watched(Counter):
    """Overrides what the base class names, as anyone may."""

    asked = 0

    def DoGetWitnessFunctions(self, context):
        self.asked += 1
        return []


class TestLeafSystem(unittest.TestCase):
    def run_for(self, dut):
        simulator = Simulator(dut)
        simulator.Initialize()
        simulator.AdvanceTo(0.1 + 1e-6)
        state = simulator.get_context().get_discrete_state_vector()
        self.assertEqual(state.value()[0], 11.0)

    def test_runs(self):
        dut = Counter()
        self.assertIsInstance(dut, DrakeLeafSystem)
        self.run_for(dut)

    def test_witness_functions_can_still_be_declared(self):
        dut = Watched()
        self.run_for(dut)
        self.assertGreater(dut.asked, 0)


if __name__ == "__main__":
    unittest.main()
