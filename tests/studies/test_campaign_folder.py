"""The folder of a campaign, here of the paper's."""

import json
import math
from pathlib import Path
import subprocess
import sys
import tempfile
import unittest

import pyarrow.parquet as pq
from synthetic_campaign import make_plan

from tofssm_drake.errors import UserError
from tofssm_drake.recording.columns import UNITS, read_description
from tofssm_drake.studies.campaign import describe_plan
import tofssm_drake.studies.campaign_folder as mut
from tofssm_drake.studies.results import make_results, make_row


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

    def test_one_campaign_at_a_time(self):
        holder = (
            "import sys, tofssm_drake.studies.campaign_folder as mut\n"
            "with mut.lock_folder(sys.argv[1]):\n"
            "    print(flush=True)\n"
            "    sys.stdin.read()\n"
        )
        with subprocess.Popen(
            [sys.executable, "-c", holder, self.folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as process:
            process.stdout.readline()
            with self.assertRaises(UserError) as caught:
                mut.lock_folder(self.folder).__enter__()
            process.kill()
        self.assertRegex(
            str(caught.exception),
            rf"used by another campaign, process {process.pid} on .* since .*;"
            " wait for it, or give another folder",
        )
        # What a kill leaves does not stand in the way.
        self.assertTrue((self.folder / ".lock").exists())
        with mut.lock_folder(self.folder):
            pass

    def test_a_lock_leaves_no_empty_folder(self):
        with mut.lock_folder(self.folder):
            self.assertTrue(self.folder.is_dir())
        self.assertFalse(self.folder.exists())
        with mut.lock_folder(self.folder):
            mut.open_folder(self.folder, make_plan())
        self.assertTrue(self.folder.exists())

    def test_an_altered_row_is_refused(self):
        plan = make_plan(variants=["literal"])
        run = plan.list_runs()[0]
        mut.open_folder(self.folder, plan)
        mut.store_run(self.folder, run, make_row(run, {"task_time_s": 3.0}), {})
        self.assertEqual(len(mut.read_rows(self.folder, plan)), 1)
        path = mut.get_run_folder(self.folder, run) / "row.parquet"
        table = pq.read_table(path)
        i = table.column_names.index("task_time_s")
        column = [[2.0]]
        pq.write_table(table.set_column(i, table.field(i), column), path)
        with self.assertRaisesRegex(UserError, "not as it was written; remove"):
            mut.read_rows(self.folder, plan)

    def test_what_is_no_plan(self):
        self.folder.mkdir()
        for text in ("{", "[]", "{}", "3", "[" * 100_000):
            (self.folder / "campaign.json").write_text(text)
            with self.subTest(text[:9]), self.assertRaises(UserError) as caught:
                mut.enter_folder(self.folder, make_plan())
            self.assertIn("is not a campaign's plan", str(caught.exception))

    def test_runs_without_their_plan_are_nobodys(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        run = plan.list_runs()[3]
        mut.store_run(self.folder, run, make_row(run, {"a": 1.0}), {})
        mut.enter_folder(self.folder, plan)
        (self.folder / "campaign.json").unlink()
        with self.assertRaises(UserError) as caught:
            mut.enter_folder(self.folder, plan)
        self.assertIn("not their campaign.json", str(caught.exception))

    def test_a_row_of_another_run_is_told(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        one, other = plan.list_runs()[3:5]
        mut.store_run(self.folder, one, make_row(other, {"a": 1.0}), {})
        with self.assertRaises(UserError) as caught:
            mut.read_rows(self.folder, plan)
        self.assertRegex(
            str(caught.exception), r"is of another run \(run, .*\)"
        )

    def test_each_column_has_a_unit_and_a_meaning(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        run = plan.list_runs()[3]
        row = make_row(run, {"task_time_s": 3.0})
        mut.store_run(self.folder, run, row, {})
        results = make_results(plan, {run.key: row})
        for path in (
            mut.get_run_folder(self.folder, run) / "row.parquet",
            mut.write_results(self.folder, plan, results),
        ):
            for field in pq.read_schema(path):
                column = read_description(field)
                self.assertIn(column.unit, UNITS, field.name)
                self.assertTrue(column.meaning, field.name)

    def test_rows_come_back_as_they_were(self):
        plan = make_plan()
        mut.open_folder(self.folder, plan)
        run = plan.list_runs()[3]
        row = make_row(
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

    def test_the_plan_is_plain(self):
        plan = make_plan(variants=["literal"])
        text = json.dumps(describe_plan(plan))
        self.assertEqual(json.loads(text), describe_plan(plan))


if __name__ == "__main__":
    unittest.main()
