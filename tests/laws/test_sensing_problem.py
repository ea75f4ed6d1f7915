import dataclasses as dc
import unittest

import numpy as np
from paper_cell import RINGS

from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.laws.sensing_problem import (
    SensingProblem,
    find_sensing_problem,
)
from tofssm_drake.laws.tri_ssm import calc_ring_states
from tofssm_drake.messages import (
    RingHealth,
    make_empty_safety_index,
    make_empty_separation,
)


def make_index(**changes):
    """Makes an index of three links, all well and clear at 5 s."""
    index = make_empty_safety_index(("base", "elbow", "tool"))
    return dc.replace(
        index,
        **{
            "sequence": np.full(3, 7),
            "time": np.full(3, 4.95),
            "health": np.full(3, RingHealth.HEALTHY),
            "dsi": np.zeros(3),
            "dsi_C": np.full(3, 0.2),
            "dsi_R": np.full(3, 0.1),
        }
        | changes,
    )


def find(**changes):
    return find_sensing_problem(
        index=make_index(**changes), now=5.0, deadline=0.1
    )


class TestFindSensingProblem(unittest.TestCase):
    def test_all_well(self):
        self.assertEqual(find(), "")
        blind = np.array([RingHealth.BLIND] * 3)
        self.assertEqual(find(health=blind), "")
        # A person who is near is not a problem of the sensing.
        self.assertEqual(find(dsi=np.full(3, 9.0)), "")

    def test_names_what_is_wrong(self):
        for changes, text in (
            ({"sequence": np.array([7, -1, 7])}, "elbow has no sample yet"),
            ({"health": np.array([0, 0, 2])}, "tool is faulted"),
            ({"health": np.array([9, 0, 0])}, "base is faulted"),
            ({"time": np.array([4.8, 5.0, 5.0])}, "base sample is too old"),
            ({"time": np.array([5.0, 5.2, 5.0])}, "elbow sample is too old"),
            ({"time": np.array([5.0, 5.0, np.nan])}, "tool sample is too old"),
            ({"time": np.array([-np.inf, 5, 5])}, "base sample is too old"),
        ):
            with self.subTest(text=text):
                self.assertEqual(find(**changes), text)

    def test_the_law_stops_for_each_of_them(self):
        generator = np.random.default_rng(0)
        for _ in range(300):
            index = make_index(
                sequence=generator.choice([-1, 0, 5, 6, 7, 8], 3),
                health=generator.choice([0, 0, 0, 1, 2], 3),
                time=5.0 + generator.choice([0, -0.05, -0.09, -0.2, 0.2], 3),
            )
            problem = find_sensing_problem(index=index, now=5.0, deadline=0.1)
            states = calc_ring_states(
                index=index, now=5.0, config=SsmConfig(deadline=0.1)
            )
            # With clear rings nothing else stops it.
            self.assertEqual(states.min() == 0, bool(problem), problem)


class TestSensingProblem(unittest.TestCase):
    def test_grows_old_with_time(self):
        dut = SensingProblem(deadline=0.1)
        context = dut.CreateDefaultContext()
        port = dut.get_output_port()
        separation = make_empty_separation(RINGS)
        dut.get_input_port().FixValue(context, separation)
        self.assertEqual(port.Eval(context), "base has no sample yet")
        n = len(separation.name)
        dut.get_input_port().FixValue(
            context,
            dc.replace(
                separation,
                sequence=np.full(n, 1),
                time=np.full(n, 5.0),
                health=np.full(n, RingHealth.HEALTHY),
            ),
        )
        context.SetTime(5.1 - 1e-9)
        self.assertEqual(port.Eval(context), "")
        context.SetTime(5.101)
        self.assertEqual(port.Eval(context), "base sample is too old")


if __name__ == "__main__":
    unittest.main()
