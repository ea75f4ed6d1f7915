import unittest

from hypothesis import given
from hypothesis import strategies as st

from tofssm_drake.errors import UserError
from tofssm_drake.studies.campaign import make_trials
import tofssm_drake.studies.trials as mut


class TestTrials(unittest.TestCase):
    @given(st.integers(0, 2**32 - 1), st.integers(1, 1000))
    def test_within_what_is_promised(self, seed, number):
        trial = mut.make_trial(seed, number)
        self.assertEqual(trial, mut.make_trial(seed, number))
        self.assertTrue(0 <= trial.seed < 2**32)
        self.assertTrue(1.0 <= trial.speed <= 1.4)
        self.assertTrue(1.6 <= trial.stature <= 1.9)
        self.assertTrue(0.0 <= trial.start <= 1.0)
        self.assertTrue(all(abs(c) <= 0.1 for c in trial.centre))
        self.assertTrue(0.95 <= trial.half_length <= 1.05)
        self.assertTrue(0.95 <= trial.half_width <= 1.05)

    def test_differ_from_each_other(self):
        trials = [mut.make_trial(0, i + 1) for i in range(50)]
        trials += [mut.make_trial(1, i + 1) for i in range(50)]
        self.assertEqual(len({trial.seed for trial in trials}), 100)
        self.assertEqual(len({trial.speed for trial in trials}), 100)
        self.assertEqual({trial.reverse for trial in trials}, {True, False})

    def test_do_not_depend_on_how_many_there_are(self):
        few, many = make_trials(0, 2, where=""), make_trials(0, 9, where="")
        self.assertEqual(few, many[:2])

    def test_mistakes(self):
        for seed, trials, message in (
            (0, 0, "x: trials: 0 must be from 1"),
            (-1, 1, "x: seed: -1 must be from 0"),
        ):
            with self.subTest(message), self.assertRaises(UserError) as caught:
                make_trials(seed, trials, where="x: ")
            self.assertIn(message, str(caught.exception))


if __name__ == "__main__":
    unittest.main()
