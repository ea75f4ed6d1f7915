import dataclasses as dc
import math
from pathlib import Path
import tempfile
import unittest

import pyarrow.parquet as pq
from synthetic_campaign import make_plan, make_rows

from tofssm_drake.paper.results import Results
from tofssm_drake.studies.campaign_folder import write_results
import tofssm_drake.studies.results as mut


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
            path = write_results(
                Path(folder), self.plan, [{"a": 1.0}, {"a": 2.0, "b": 3.0}]
            )
            table = pq.read_table(path).to_pylist()
        self.assertEqual(table, [{"a": 1.0, "b": None}, {"a": 2.0, "b": 3.0}])

    def test_table(self):
        results = mut.make_results(self.plan, self.rows)
        with tempfile.TemporaryDirectory() as folder:
            path = write_results(Path(folder), self.plan, results)
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


if __name__ == "__main__":
    unittest.main()
