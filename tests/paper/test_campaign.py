import dataclasses as dc
import json
import math
from pathlib import Path
import tempfile
import unittest

from hypothesis import given
from hypothesis import strategies as st
import pyarrow.parquet as pq
from synthetic_campaign import make_rows, make_small_plan

from tofssm_drake.errors import UserError
import tofssm_drake.paper.campaign as mut
from tofssm_drake.paper.results import Results
from tofssm_drake.recording.columns import UNITS, read_description


def make_plan(**changes):
    options = {
        "seed": 0,
        "trials": 2,
        "sensings": ["tof", "lidar"],
        "configurations": ["vo", "sm"],
        "variants": [],
        "scenario": {"law": {"C_dC": 0.3}},
        "motions": {},
        "versions": {"drake": "1.51.1"},
    }
    return mut.make_plan(**(options | changes))


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
        few, many = make_plan(trials=2), make_plan(trials=9)
        self.assertEqual(few.trials, many.trials[:2])


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
        run = mut.PlannedRun(cell=cell, trial=mut.make_trial(0, 3))
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
            ({"variants": ["odd"]}, "--study: 'odd' is unknown"),
            ({"sensings": ["tof", "tof"]}, "--sensing: tof, tof names one"),
            ({"variants": ["late"]}, "--study: late needs one of the sensings"),
            ({"trials": 0}, "--trials: 0 must be from 1"),
            ({"seed": -1}, "--seed: -1 must be from 0"),
        ):
            with self.subTest(message), self.assertRaises(UserError) as caught:
                make_plan(**changes)
            self.assertIn(message, str(caught.exception))


class TestFolder(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name) / "campaign"

    def test_the_same_plan_is_welcome(self):
        plan = make_plan(variants=["literal"])
        mut.enter_folder(self.folder, plan)
        self.assertFalse(self.folder.exists())
        mut.open_folder(self.folder, plan)
        mut.enter_folder(self.folder, make_plan(variants=["literal"]))

    def test_a_plan_may_grow(self):
        mut.open_folder(self.folder, make_plan())
        bigger = make_plan(
            trials=4,
            sensings=["tof", "ideal", "lidar"],
            variants=["literal"],
        )
        mut.enter_folder(self.folder, bigger)
        mut.open_folder(self.folder, bigger)
        with self.assertRaises(UserError):
            mut.enter_folder(self.folder, make_plan())

    def test_another_plan_is_refused(self):
        mut.open_folder(self.folder, make_plan())
        for changes, message in (
            ({"scenario": {"law": {"C_dC": 0.4}}}, "scenario.law.C_dC: 0.3 th"),
            ({"scenario": {"law": {}}}, "scenario.law.C_dC is no longer"),
            ({"scenario": {"law": {"C_dC": 0.3}, "x": 1}}, "scenario.x is new"),
            ({"versions": {"drake": "2.0"}}, "versions.drake: '1.51.1' then"),
            ({"motions": {"a.bvh": "0"}}, "motions.a.bvh is new"),
            ({"sensings": ["tof"]}, "without cell lidar vo now"),
            ({"trials": 1}, "without trial 2"),
            ({"seed": 1}, "seed: 0 then, 1 now"),
        ):
            with self.subTest(message), self.assertRaises(UserError) as caught:
                mut.enter_folder(self.folder, make_plan(**changes))
            text = str(caught.exception)
            self.assertIn(message, text)
            self.assertIn("another campaign", text)
            self.assertNotIn("\n", text)

    def test_what_is_no_plan(self):
        self.folder.mkdir()
        for text in ("{", "[]", "{}", "3"):
            (self.folder / "campaign.json").write_text(text)
            with self.subTest(text), self.assertRaises(UserError) as caught:
                mut.enter_folder(self.folder, make_plan())
            self.assertIn("is not a campaign's plan", str(caught.exception))

    def test_runs_without_their_plan_are_nobodys(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        run = plan.list_runs()[3]
        mut.store_run(self.folder, run, mut.make_row(run, {"a": 1.0}), {})
        mut.enter_folder(self.folder, plan)
        (self.folder / "campaign.json").unlink()
        with self.assertRaises(UserError) as caught:
            mut.enter_folder(self.folder, plan)
        self.assertIn("not their campaign.json", str(caught.exception))

    def test_a_row_of_another_run_is_told(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        one, other = plan.list_runs()[3:5]
        mut.store_run(self.folder, one, mut.make_row(other, {"a": 1.0}), {})
        with self.assertRaises(UserError) as caught:
            mut.read_rows(self.folder, plan)
        self.assertRegex(
            str(caught.exception), r"is of another run \(run, .*\)"
        )

    def test_rows_come_back_as_they_were(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        run = plan.list_runs()[3]
        row = mut.make_row(
            run, {"a": 0.1 + 0.2, "b": math.nan, "c": math.inf, "d": -0.0}
        )
        self.assertEqual(mut.read_rows(self.folder, plan), {})
        mut.store_run(self.folder, run, row, {"samples.parquet": b"abc"})
        rows = mut.read_rows(self.folder, plan)
        self.assertEqual(list(rows), [run.key])
        self.assertEqual(repr(rows[run.key]), repr(row))
        where = mut.get_run_folder(self.folder, run)
        self.assertEqual(
            {path.name: path.stat().st_size > 0 for path in where.iterdir()},
            {"samples.parquet": True, "row.parquet": True},
        )

    def test_each_column_has_a_unit_and_a_meaning(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        run = plan.list_runs()[3]
        row = mut.make_row(run, {"task_time_s": 3.0})
        mut.store_run(self.folder, run, row, {})
        results = mut.make_results(plan, {run.key: row})
        for path in (
            mut.get_run_folder(self.folder, run) / "row.parquet",
            mut.write_results(self.folder, results),
        ):
            for field in pq.read_schema(path):
                column = read_description(field)
                self.assertIn(column.unit, UNITS, field.name)
                self.assertTrue(column.meaning, field.name)

    def test_without_its_row_a_run_is_not_finished(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        where = mut.get_run_folder(self.folder, plan.list_runs()[1])
        where.mkdir()
        (where / "samples.parquet").write_bytes(b"half")
        (where / ".row.parquet.1.part").write_bytes(b"half")
        self.assertEqual(mut.read_rows(self.folder, plan), {})

    def test_a_damaged_row_is_told(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        where = mut.get_run_folder(self.folder, plan.list_runs()[1])
        where.mkdir()
        (where / "row.parquet").write_bytes(b"half")
        with self.assertRaises(UserError) as caught:
            mut.read_rows(self.folder, plan)
        self.assertIn("remove it", str(caught.exception))

    def test_unwritable(self):
        self.folder.write_text("in the way")
        with self.assertRaises(UserError) as caught:
            mut.open_folder(self.folder, make_plan())
        self.assertIn("--out: cannot write", str(caught.exception))


class TestResults(unittest.TestCase):
    def setUp(self):
        self.plan = make_plan()

        def change(cell, trial):
            if cell.sensing == "lidar":
                return {"task_time_s": math.nan}
            return {"task_time_s": 60.0 + 10 * trial}

        self.rows = make_rows(self.plan, {"task_time_s": 60.0}, change)

    def test_productivity_is_measured(self):
        results = mut.make_results(self.plan, self.rows)
        self.assertEqual(
            [row["run"] for row in results],
            [run.key for run in self.plan.list_runs()],
        )
        by_key = {r["run"]: r["productivity_measured"] for r in results}
        self.assertEqual(by_key["alone"], 1.0)
        self.assertAlmostEqual(by_key["tof-vo-1"], 60 / 70)
        self.assertAlmostEqual(by_key["tof-sm-2"], 60 / 80)
        self.assertTrue(math.isnan(by_key["lidar-vo-1"]))

    def test_the_order_in_which_runs_end_does_not_matter(self):
        shuffled = dict(reversed(self.rows.items()))
        self.assertEqual(
            repr(mut.make_results(self.plan, self.rows)),
            repr(mut.make_results(self.plan, shuffled)),
        )

    def test_without_the_lone_run(self):
        del self.rows["alone"], self.rows["tof-vo-1"]
        results = mut.make_results(self.plan, self.rows)
        self.assertEqual(len(results), 7)
        self.assertTrue(
            all(math.isnan(r["productivity_measured"]) for r in results)
        )
        self.assertIsNone(Results(results).alone)

    def test_table_of_rows_old_and_new(self):
        """Nothing that only some rows have is lost."""
        with tempfile.TemporaryDirectory() as folder:
            path = mut.write_results(
                Path(folder), [{"a": 1.0}, {"a": 2.0, "b": 3.0}]
            )
            table = pq.read_table(path).to_pylist()
        self.assertEqual(table, [{"a": 1.0, "b": None}, {"a": 2.0, "b": 3.0}])

    def test_table(self):
        results = mut.make_results(self.plan, self.rows)
        with tempfile.TemporaryDirectory() as folder:
            path = mut.write_results(Path(folder), results)
            table = pq.read_table(path).to_pylist()
        self.assertEqual(repr(table), repr(results))

    def test_asked_by_cell(self):
        results = Results(mut.make_results(self.plan, self.rows))
        self.assertEqual(results.cells, list(self.plan.cells))
        self.assertEqual(results.trials, [1, 2])
        self.assertEqual(results.count_runs(), 8)
        vo, sm = self.plan.cells[:2]
        self.assertEqual(results.values(vo, "task_time_s"), {1: 70.0, 2: 80.0})
        self.assertEqual(results.estimate(vo, "task_time_s").mean, 75.0)
        self.assertEqual(results.difference(vo, sm, "task_time_s").mean, 0.0)
        self.assertEqual(results.total("task_time_s", [vo]), 150.0)
        self.assertEqual(results.total("task_time_s"), 300.0)
        other = dc.replace(vo, variant="literal")
        self.assertEqual(results.values(other, "task_time_s"), {})
        self.assertEqual(results.estimate(vo, "no such thing").count, 0)

    def test_the_plan_is_plain(self):
        text = json.dumps(mut.describe_plan(self.plan))
        self.assertEqual(json.loads(text), mut.describe_plan(self.plan))


if __name__ == "__main__":
    unittest.main()
