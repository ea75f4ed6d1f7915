"""`tofssm describe` lists columns with their units."""

from pathlib import Path

import numpy as np
import pytest

from tofssm_drake.recording.samples import Samples, write_samples
from tofssm_drake.scripts.main import run

_EARLIER = Path(__file__).parents[1] / "recording" / "earlier_run"


@pytest.fixture
def folder(tmp_path):
    samples = Samples(
        column={
            "t": np.zeros(3),
            "robot_state": np.zeros(3, dtype=np.int8),
        }
    )
    write_samples(samples, tmp_path)
    return tmp_path


def test_a_run(folder, capsys):
    assert run(["describe", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{folder / 'samples.parquet'}: 3 rows, 2 columns"
    assert lines[1].split()[:2] == ["t", "s"]
    assert lines[2].endswith("(stop, reduced, normal)")
    assert lines[3] == f"{folder / 'scans.parquet'}: 0 rows, 5 columns"


def test_one_table(folder, capsys):
    assert run(["describe", str(folder / "scans.parquet")]) == 0
    assert "samples.parquet" not in capsys.readouterr().out


def test_earlier_record_says_nothing_of_itself(capsys):
    assert run(["describe", str(_EARLIER)]) == 0
    line = capsys.readouterr().out.splitlines()[1]
    assert line.split() == ["t", "?", "?"]


def test_mistakes(tmp_path, capsys):
    assert run(["describe", str(tmp_path)]) == 2
    assert "there is no table" in capsys.readouterr().err
    (tmp_path / "x.parquet").write_text("nonsense")
    assert run(["describe", str(tmp_path)]) == 2
    assert "x.parquet: cannot be read" in capsys.readouterr().err
    assert run(["describe", str(tmp_path / "none")]) == 2
    assert "cannot be read" in capsys.readouterr().err
