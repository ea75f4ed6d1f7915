"""`make audit`, without its database."""

import json
import os
from pathlib import Path
import subprocess
import sys
from unittest import mock

import audit as mut
import pytest

_FILE = Path(__file__).parents[2] / "constraints-3.11.txt"


def tell(stdout="", stderr="", code=1):
    return mock.patch.object(
        mut.subprocess,
        "run",
        return_value=subprocess.CompletedProcess([], code, stdout, stderr),
    )


def test_the_command_names_the_pinned_versions():
    command = mut.make_command(_FILE)
    assert command[:3] == [sys.executable, "-m", "pip_audit"]
    assert str(_FILE) in command


def test_pip_audit_takes_the_command():
    pytest.importorskip("pip_audit", reason="of the extra `audit`")
    command = [*mut.make_command(_FILE), "--dry-run"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    count = sum("==" in line for line in _FILE.read_text().splitlines())
    assert f"would have audited {count} packages" in done.stderr


def test_it_cannot_reach_its_database(tmp_path, capsys, monkeypatch):
    """Nobody listens on that port; nor is the command there everywhere."""
    for name in ("HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setitem(os.environ, name, "http://127.0.0.1:9")
    path = tmp_path / "constraints.txt"
    path.write_text("attrs==26.1.0\n")
    assert mut.audit(path) == 2
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("constraints.txt: not audited, pip-audit failed: ")


def test_says_what_is_known(capsys):
    packages = [
        {"name": "a", "version": "1", "vulns": []},
        {"name": "b", "skip_reason": "not on PyPI"},
    ]
    with tell(json.dumps({"dependencies": packages}), code=0):
        assert mut.audit(_FILE) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{_FILE.name}: unknown there: b",
        f"{_FILE.name}: no known fault",
    ]
    packages[0]["vulns"] = [{"id": "PYSEC-1", "fix_versions": ["2", "3"]}]
    with tell(json.dumps({"dependencies": packages})):
        assert mut.audit(_FILE) == 1
    assert (
        f"{_FILE.name}: a 1: PYSEC-1, mended in 2, 3" in capsys.readouterr().out
    )


def test_worst_of_all_files(monkeypatch):
    codes = iter((0, 2, 1))
    monkeypatch.setattr(mut, "audit", lambda path: next(codes))
    monkeypatch.setattr(sys, "argv", ["audit.py"])
    assert mut.main() == 2


def test_make_has_the_command():
    text = (_FILE.parent / "Makefile").read_text("utf-8")
    assert "$(BIN)/python tests/packaging/audit.py" in text
    assert "--editable '.[audit]'" in text
