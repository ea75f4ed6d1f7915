"""`tofssm hardware-demo` before it starts anything."""

from unittest import mock

import pytest

from tofssm_drake.scripts import hardware_demo
from tofssm_drake.scripts.main import run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--products", "11"), "--products: must be from 1 to 10, got 11"),
        (("--ssm", "zz"), "--ssm: 'zz' is unknown, use one of"),
        (("--duration", "-1"), "--duration: must be 0 or more, got -1"),
        (("--duration", "nan"), "--duration: must be 0 or more, got nan"),
        (("--out", "file"), "--out: cannot write into file: File exists"),
        (("--out", "file/out"), "--out: cannot write into file/out: Not a"),
        (("--out", 300 * "o"), f"--out: cannot write into {300 * 'o'}: File"),
        (("--out", "full"), "--out: full/run.mcap is a folder"),
    ],
)
def test_refuses_before_it_starts_anything(
    arguments, message, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "full" / "run.mcap").mkdir(parents=True)
    with mock.patch.object(hardware_demo.subprocess, "Popen") as start:
        assert run(["hardware-demo", *arguments]) == 2
    start.assert_not_called()
    captured = capfd.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith(f"tofssm: {message}")
    # Nor has it made its default folder.
    assert not (tmp_path / "out").exists()
