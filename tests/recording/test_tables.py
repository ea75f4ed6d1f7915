import random

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tofssm_drake.errors import UserError
import tofssm_drake.recording.tables as mut


def make_table():
    rng = np.random.default_rng(0)
    columns = {f"c{i}": rng.normal(size=500) for i in range(5)}
    return pa.table({**columns, "name": ["near", "far"] * 250})


def test_round_trip(tmp_path):
    path = tmp_path / "x.parquet"
    mut.write_table(make_table(), path)
    assert mut.read_table(path).equals(make_table())
    some = mut.read_table(path, ["c1", "other"])
    assert some.column_names == ["c1"]
    schema, rows = mut.read_schema(path)
    assert schema.names == make_table().column_names
    assert rows == 500
    # Others read it, too.
    assert pq.read_table(path).equals(make_table())


def test_a_damaged_table_never_has_other_values(tmp_path):
    """A flipped bit is an error, or is not of the values."""
    table, path = make_table(), tmp_path / "x.parquet"
    mut.write_table(table, path, compression="zstd")
    contents = path.read_bytes()
    dice = random.Random(0)
    refused = 0
    for _ in range(400):
        damaged = bytearray(contents)
        damaged[dice.randrange(len(damaged))] ^= 1 << dice.randrange(8)
        path.write_bytes(damaged)
        try:
            found = mut.read_table(path)
        except UserError as error:
            assert str(path) in str(error)
            assert "\n" not in str(error)
            refused += 1
            continue
        # A name may be damaged, which who asks for the column notices.
        for mine, its in zip(table.columns, found.columns, strict=True):
            assert mine.equals(its)
    assert refused > 350


@pytest.mark.parametrize("contents", [b"", b"PAR1", b"x" * 100])
def test_no_table(tmp_path, contents):
    path = tmp_path / "x.parquet"
    path.write_bytes(contents)
    for read in (mut.read_table, mut.read_schema):
        with pytest.raises(UserError, match="cannot be read"):
            read(path)
    with pytest.raises(UserError, match="cannot be read"):
        mut.read_table(tmp_path / "missing.parquet")
