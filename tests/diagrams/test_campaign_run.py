import copy
import io
from pathlib import Path
import tempfile
import unittest

from bvh_writer import write_bvh
import numpy as np
import pyarrow.parquet as pq

import tofssm_drake.diagrams.campaign_run as mut
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.custom_motion import CustomMotion
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.studies.campaign import PlannedRun
from tofssm_drake.studies.study import StudyCell
from tofssm_drake.studies.trials import make_trial


def make_run(number=1):
    return PlannedRun(cell=StudyCell(name="Mine"), trial=make_trial(0, number))


class TestScenario(unittest.TestCase):
    def setUp(self):
        self.base = load_scenario()

    def test_a_walk_gets_the_trials_speed_stature_and_way(self):
        trial = make_trial(0, 1)
        scenario = mut.make_run_scenario(self.base, trial)
        scenario.check()
        (person,) = scenario.people.values()
        self.assertEqual(scenario.random_seed, trial.seed)
        self.assertEqual(person.speed, trial.speed)
        self.assertEqual(person.stature, trial.stature)
        self.assertEqual(person.figure_eight.start, trial.start)
        self.assertAlmostEqual(
            person.figure_eight.centre[0], 1.15 + trial.centre[0]
        )
        self.assertEqual(self.base, load_scenario())

    def test_two_people_differ(self):
        self.base.people["other"] = GeneratedWalk()
        scenario = mut.make_run_scenario(self.base, make_trial(0, 1))
        one, other = scenario.people.values()
        self.assertNotEqual(one.speed, other.speed)
        # The first one is as if alone.
        alone = mut.make_run_scenario(load_scenario(), make_trial(0, 1))
        self.assertEqual(one, alone.people["visitor"])

    def test_a_motion_of_ones_own_gets_the_seed_if_it_asks_for_it(self):
        trial = make_trial(0, 1)
        plain = CustomMotion(factory="a:b", parameters={"swing": 0.1})
        self.assertEqual(mut.vary_person(plain, trial), plain)
        asks = CustomMotion(factory="a:b", parameters={"seed": 0.0})
        person = mut.vary_person(asks, trial)
        self.assertEqual(person.parameters, {"seed": trial.seed})
        self.assertEqual(asks.parameters, {"seed": 0.0})

    def test_any_other_person_stays_as_they_are(self):
        class Standing:
            """A kind of person with settings of its own."""

        person = Standing()
        self.assertIs(mut.vary_person(person, make_trial(0, 1)), person)

    def test_nobody_there(self):
        scenario = mut.make_run_scenario(self.base, None)
        self.assertEqual(scenario.people, {})
        self.assertEqual(scenario.random_seed, self.base.random_seed)

    def test_recording(self):
        base = copy.deepcopy(self.base)
        base.people["visitor"].figure_eight.half_length = 1.4
        trial = make_trial(0, 1)
        scenario = mut.make_run_scenario(base, trial, "walk.bvh")
        person = scenario.people["visitor"]
        self.assertEqual(person.filename, "walk.bvh")
        self.assertAlmostEqual(
            person.figure_eight.half_length, 1.4 * trial.half_length
        )
        # One that the scenario has itself keeps its settings.
        base.people["visitor"] = BvhRecording(filename="a.bvh", speed=1.1)
        (person,) = mut.make_run_scenario(base, trial).people.values()
        self.assertEqual((person.filename, person.speed), ("a.bvh", 1.1))
        self.assertEqual(person.figure_eight.start, trial.start)


class TestExecute(unittest.TestCase):
    def setUp(self):
        self.base = load_scenario(text="{simulation_duration: 0.4}")

    def read(self, outcome, name="samples.parquet"):
        return pq.read_table(io.BytesIO(outcome.files[name]))

    def test_the_same_run_twice(self):
        first = mut.execute(self.base, make_run())
        again = mut.execute(self.base, make_run())
        self.assertEqual(repr(first.row), repr(again.row))
        self.assertEqual(first.files, again.files)
        self.assertEqual(first.row["run"], "Mine-1")
        self.assertEqual(first.row["seed"], make_trial(0, 1).seed)
        self.assertAlmostEqual(first.row["simulated_s"], 0.4, delta=0.0081)
        self.assertIn("shortfall_walking_in_p50_m", first.row)
        self.assertEqual(self.read(first).num_rows, 51)

    def test_people_and_their_places_do_not_depend_on_the_cell(self):
        places = [
            np.array(self.read(mut.execute(base, make_run()))["person_x"])
            for base in (
                load_scenario(name=name, text="{simulation_duration: 0.4}")
                for name in ("MotionCapture", "PlanarLidar")
            )
        ]
        np.testing.assert_array_equal(*places)

    def test_a_recording_needs_no_file_here(self):
        with tempfile.TemporaryDirectory() as folder:
            path = write_bvh(Path(folder) / "walk.bvh")
            content = Path(path).read_bytes()
        recordings = {"walk.bvh": content}
        outcome, again = (
            mut.execute(self.base, make_run(), "walk.bvh", recordings)
            for _ in range(2)
        )
        # Not even the temporary file's name is left.
        self.assertEqual(outcome.files, again.files)


if __name__ == "__main__":
    unittest.main()
