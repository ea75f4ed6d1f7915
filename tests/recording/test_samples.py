from pathlib import Path
import tempfile
import unittest

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tofssm_drake.errors import UserError
import tofssm_drake.recording.samples as mut
from tofssm_drake.recording.tables import write_table


def _make_samples(rows=5):
    return mut.Samples(
        column={
            "t": np.arange(rows) * 0.008,
            "robot_state": np.ones(rows, dtype=np.int8),
            "true_distance": np.full(rows, np.inf),
            "base_measured_distance": np.full(rows, np.nan),
            "tool_measured_distance": np.linspace(0, 1, rows),
            "reason": np.array(["tool: near"] * rows, dtype=object),
        },
        scan={
            "base": {
                "time": np.array([0.008, 0.016]),
                "distance": np.array(
                    [[0.5, np.inf], [np.nan, 0.25]], dtype=np.float32
                ),
                "reading": np.array([[1, 0], [3, 2]], dtype=np.int8),
            },
            "tool": {
                "time": np.array([0.0]),
                "distance": np.array([[0.5, 0.75]], dtype=np.float32),
                "reading": np.array([[1, 1]], dtype=np.int8),
            },
        },
        metadata={"rings": ["base", "tool"], "seed": 4, "scenario": "a: 1"},
    )


class TestSamples(unittest.TestCase):
    def setUp(self):
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.folder = Path(directory.name)

    def test_round_trip(self):
        samples = _make_samples()
        paths = mut.write_samples(samples, self.folder)
        self.assertEqual(
            [p.name for p in paths], ["samples.parquet", "scans.parquet"]
        )
        self.assertEqual(
            sorted(p.name for p in self.folder.iterdir()),
            ["samples.parquet", "scans.parquet"],
        )
        for path in (self.folder, paths[0]):
            back = mut.read_samples(path)
            self.assertEqual(back.metadata, samples.metadata)
            self.assertEqual(list(back.column), list(samples.column))
            for name, values in samples.column.items():
                np.testing.assert_array_equal(back[name], values)
                if values.dtype != object:
                    self.assertEqual(back[name].dtype, values.dtype)
            self.assertEqual(list(back.scan), ["base", "tool"])
            for ring, scan in samples.scan.items():
                for name, values in scan.items():
                    np.testing.assert_array_equal(back.scan[ring][name], values)

    def test_infinity_is_not_null(self):
        mut.write_samples(_make_samples(), self.folder)
        table = pq.read_table(self.folder / "samples.parquet")
        self.assertEqual(table["true_distance"].null_count, 0)
        self.assertTrue(np.isinf(table["true_distance"][0].as_py()))

    def test_empty(self):
        """An interrupted run may have no row at all."""
        samples = _make_samples(rows=0)
        samples.scan = {}
        mut.write_samples(samples, self.folder)
        back = mut.read_samples(self.folder)
        self.assertEqual(len(back), 0)
        self.assertEqual(back.scan["base"]["time"].shape, (0,))

    def test_ring(self):
        samples = _make_samples(rows=3)
        np.testing.assert_array_equal(
            samples.ring("measured_distance")[:, 1], [0, 0.5, 1]
        )

    def test_failed_write_leaves_the_old_file(self):
        path = self.folder / "samples.parquet"
        path.write_text("old")

        def fail(temporary):
            temporary.write_text("half")
            raise OSError("disk full")

        with self.assertRaisesRegex(
            UserError, r"samples\.parquet: cannot be written: disk full"
        ):
            mut.write_atomically(path, fail)
        self.assertEqual(path.read_text(), "old")
        self.assertEqual([p.name for p in self.folder.iterdir()], [path.name])

    def test_missing_folder(self):
        with self.assertRaisesRegex(UserError, "cannot be written"):
            mut.write_samples(_make_samples(), self.folder / "none")

    def test_missing_file(self):
        with self.assertRaisesRegex(UserError, r"samples\.parquet: cannot be"):
            mut.read_samples(self.folder)

    def test_not_a_table(self):
        path = self.folder / "samples.parquet"
        path.write_text("nonsense")
        with self.assertRaisesRegex(UserError, r"samples\.parquet: cannot be"):
            mut.read_samples(path)

    def test_metadata_in_another_encoding(self):
        path = self.folder / "samples.parquet"
        for of_table, of_column, is_read in (
            ({mut._KEY: b"\xff\xfe"}, None, False),
            (None, {b"unit": b"\xff", b"codes": b"\xff"}, True),
            (None, {b"\xff": b"s"}, True),
        ):
            field = pa.field("t", pa.float64(), metadata=of_column)
            schema = pa.schema([field], metadata=of_table)
            write_table(pa.table({"t": [0.5]}, schema=schema), path)
            if is_read:
                self.assertEqual(mut.read_samples(path)["t"], [0.5])
                continue
            with self.assertRaisesRegex(UserError, r"parquet: its metadata: "):
                mut.read_samples(path)

    def test_narrow_type(self):
        self.assertEqual(
            mut.narrow_type("state", np.array([2.0])).dtype, np.int8
        )
        self.assertEqual(
            mut.narrow_type("true_distance", np.array([2.0])).dtype, np.float64
        )
        # A lidar has more rays than eight bits count.
        many = mut.narrow_type("clear", np.array([2.0, 720.0]))
        self.assertEqual(many.tolist(), [2, 720])


class TestSignals(unittest.TestCase):
    def test_record_of_before_laws_described_them(self):
        column = {
            f"tool_{name}": np.zeros(1)
            for name in ("measured_distance", "d_C", "d_R", "dsi")
        }
        samples = mut.Samples(column=column)
        self.assertEqual(samples.rings, ("tool",))
        self.assertEqual(samples.find_bound("stop"), "d_C")
        self.assertEqual(samples.find_bound("slow"), "d_R")
        del column["tool_d_R"]
        self.assertEqual(samples.find_bound("slow"), "")
