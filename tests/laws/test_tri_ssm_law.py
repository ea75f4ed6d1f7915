import dataclasses as dc
import unittest

import numpy as np
from pydrake.common.value import Value

from tofssm_drake.laws.config import CONFIGURATIONS
import tofssm_drake.laws.tri_ssm_law as mut
from tofssm_drake.messages import RingHealth, make_empty_separation


def make_separation(links, distance):
    m = len(links)
    return dc.replace(
        make_empty_separation(links),
        sequence=np.zeros(m, dtype=int),
        time=np.zeros(m),
        distance=np.array(distance),
        health=np.full(m, int(RingHealth.HEALTHY)),
    )


def decide(law, links, offset, distance):
    system = law.make(links=links, offset=np.array(offset), period=0.008)
    context = system.CreateDefaultContext()
    system.GetInputPort("separation").FixValue(
        context, Value(make_separation(links, distance))
    )
    return system.GetOutputPort("decision").Eval(context)


class TestOffset(unittest.TestCase):
    def test_papers_lidar(self):
        """Constants of 1.12, 1.32 and 1.92 m (the paper's Table)."""
        law = mut.TriSsm().grow(0.82)
        self.assertIsInstance(law, mut.TriSsm)
        self.assertEqual((law.C_dC, law.d_C_sm, law.d_R_sm), (1.12, 1.32, 1.92))
        self.assertIs(law.grow(0.0), law)

    def test_links_of_both_kinds_in_one_cell(self):
        """Each is decided as in a cell of its own."""
        for configuration in CONFIGURATIONS:
            law = mut.TriSsm(configuration=configuration)
            alone = [
                decide(law, ("tool",), [0.0], [0.9]),
                decide(law, ("lidar",), [0.82], [1.5]),
            ]
            both = decide(law, ("tool", "lidar"), [0.0, 0.82], [0.9, 1.5])
            for name, values in both.signal.items():
                np.testing.assert_array_equal(
                    values, np.concatenate([a.signal[name] for a in alone])
                )
            self.assertEqual(both.state.tolist(), [a.state[0] for a in alone])
            self.assertEqual(both.target, min(a.target for a in alone))

    def test_fixed_distances_of_each_link(self):
        law = mut.TriSsm(configuration="sm")
        both = decide(law, ("a", "b"), [0.0, 0.3], [0.7, 0.7])
        np.testing.assert_array_equal(both.signal["d_C"], [0.5, 0.8])
        np.testing.assert_array_equal(both.signal["d_R"], [1.1, 1.4])
        self.assertEqual(both.state.tolist(), [1, 0])
        self.assertEqual(both.link, "b")
        self.assertEqual(both.reason, "stop: b at 0.700 m <= d_C 0.800 m")


class TestTraits(unittest.TestCase):
    def test_numbers_are_the_settings(self):
        traits = mut.TriSsm(
            deadline=0.2, T_R=0.15, k_omax=4.0, rho_reduced=0.3, literal=True
        ).traits
        self.assertEqual(
            (traits.deadline, traits.T_R, traits.k_max), (0.2, 0.15, 4.0)
        )
        self.assertEqual(traits.reduced_fraction, 0.3)
        self.assertTrue(traits.ramp.literal)

    def test_only_vo_monitors_the_person(self):
        for configuration in CONFIGURATIONS:
            traits = mut.TriSsm(configuration=configuration).traits
            self.assertEqual(traits.monitors_person, configuration == "vo")

    def test_signals_are_those_of_the_decision(self):
        decision = decide(mut.TriSsm(), ("a",), [0.0], [1.0])
        self.assertEqual(
            list(decision.signal), list(mut.TriSsm().traits.signals)
        )
