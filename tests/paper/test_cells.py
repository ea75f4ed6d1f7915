import unittest

from synthetic_campaign import make_plan, make_small_plan

from tofssm_drake.errors import UserError
import tofssm_drake.paper.cells as mut
from tofssm_drake.studies.campaign import PlannedRun
from tofssm_drake.studies.trials import make_trial


class TestPlan(unittest.TestCase):
    def test_the_papers_experiment(self):
        plan = make_small_plan(5, sensings=["tof", "ideal", "lidar"])
        runs = plan.list_runs()
        self.assertEqual(len(runs), 1 + 45)
        self.assertEqual(runs[0].key, mut.ALONE)
        self.assertIsNone(runs[0].trial)
        self.assertEqual(len({run.key for run in runs}), 46)

    def test_all_cells_meet_the_same_people(self):
        people = {}
        for run in make_small_plan(3).list_runs()[1:]:
            people.setdefault(run.cell, []).append(run.trial)
        first = next(iter(people.values()))
        self.assertEqual(len(people), 12)
        self.assertTrue(all(trials == first for trials in people.values()))

    def test_names(self):
        cell = mut.Cell(sensing="tof16", configuration="vr")
        self.assertEqual((cell.key, cell.label), ("tof16-vr", "Real-16 Vr"))
        literal = mut.Cell(sensing="tof", configuration="sm", variant="literal")
        self.assertEqual(literal.key, "tof-sm-literal")
        self.assertEqual(literal.label, "Real SM (literal law)")
        run = PlannedRun(cell=cell, trial=make_trial(0, 3))
        self.assertEqual(run.key, "tof16-vr-3")
        self.assertIn(str(run.trial.seed), run.label)

    def test_variants_are_run_where_they_belong(self):
        plan = make_plan(variants=["literal", "subtracted"])
        keys = [cell.key for cell in plan.cells]
        self.assertEqual(
            keys,
            [
                *("tof-vo", "tof-sm", "lidar-vo", "lidar-sm"),
                *("tof-vo-literal", "tof-sm-literal"),
                *("lidar-vo-subtracted", "lidar-sm-subtracted"),
            ],
        )

    def test_recordings_take_turns(self):
        plan = make_plan(trials=3, motions={"a.bvh": "1", "b.bvh": "2"})
        names = [plan.find_motion(run) for run in plan.list_runs()]
        self.assertIsNone(names[0])
        self.assertEqual(names[1::4], ["a.bvh", "b.bvh", "a.bvh"])
        self.assertIsNone(make_plan().find_motion(make_plan().list_runs()[1]))

    def test_mistakes(self):
        for changes, message in (
            ({"sensings": ["radar"]}, "--sensing: 'radar' is unknown, use"),
            ({"configurations": ["vx"]}, "--ssm: 'vx' is unknown"),
            ({"variants": ["odd"]}, "--variant: 'odd' is unknown"),
            ({"sensings": ["tof", "tof"]}, "--sensing: tof, tof names one"),
            (
                {"variants": ["late"]},
                "--variant: late needs one of the sensings",
            ),
            ({"trials": 0}, "--trials: 0 must be from 1"),
            ({"seed": -1}, "--seed: -1 must be from 0"),
        ):
            with self.subTest(message), self.assertRaises(UserError) as caught:
                make_plan(**changes)
            self.assertIn(message, str(caught.exception))

    def test_words_of_the_sensings(self):
        self.assertEqual(list(mut.SENSINGS), ["tof", "ideal", "lidar", "tof16"])
        self.assertEqual(mut.SENSINGS["tof"].name, "Real (8 sensors per ring)")


if __name__ == "__main__":
    unittest.main()
