import subprocess

import numpy as np
import pytest
from synthetic_run import make_run

from tofssm_drake.errors import UserError
from tofssm_drake.people.skeleton import CAPSULES
import tofssm_drake.scripts.draw_docs as mut

_DOT = """digraph _917 {
rankdir=LR
subgraph cluster917diagram {
color=black
label=<<TABLE BORDER="0"><TR><TD>
<B>Diagram</B><BR/>
name=monitor
</TD></TR></TABLE>>;
s494 [label=<<B>tofssm_drake.laws.tri_ssm.TriSsmState</B><BR/>
name=x>]
s17 [label=<<B>Diagram</B>>]
s494:y0:e -> s17:u0:w [color=black]
"""


def test_simplify():
    assert (
        mut.simplify(_DOT)
        == """digraph _0 {
rankdir=LR
ranksep=0.4
subgraph cluster0diagram {
color=white
label=""
s1 [label=<<B>TriSsmState</B><BR/>
x>]
s2 [label=<<B>Diagram</B>>]
s1:y0:e -> s2:u0:w [color=black]
"""
    )


def test_instant_is_a_standstill_for_a_near_person():
    run = make_run(1.0)
    with pytest.raises(UserError, match="never stops"):
        mut.find_instant(run)
    run["robot_state"][50:] = 0
    run["true_distance"][:] = np.linspace(1.0, 0.0, len(run))
    instant = mut.find_instant(run)
    row = np.searchsorted(run["t"], instant)
    assert run["true_distance"][row] == pytest.approx(0.25, abs=0.01)
    assert run["true_distance"][row] > 0.25


class _FakeMeshcat:
    def __init__(self, paths):
        self.paths = set(paths)

    def HasPath(self, path):
        return path in self.paths

    def Delete(self, path):
        self.paths.remove(path)


def test_nobody_is_left_in_the_twin():
    people = [f"visualizer/anna_{capsule.name}" for capsule in CAPSULES]
    meshcat = _FakeMeshcat([*people, "visualizer/ur10"])
    mut.hide_people(meshcat, ["anna"])
    assert meshcat.paths == {"visualizer/ur10"}
    with pytest.raises(UserError, match="Meshcat has no visualizer/anna_"):
        mut.hide_people(meshcat, ["anna"])


def test_what_is_missing_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(mut.shutil, "which", lambda name: None)
    with pytest.raises(UserError, match="apt-get install graphviz chromium"):
        mut.draw_docs(tmp_path)


def test_browser_that_fails_leaves_nothing(tmp_path, monkeypatch):
    def fail(command, **_):
        raise subprocess.CalledProcessError(1, command[0])

    monkeypatch.setattr(mut.subprocess, "run", fail)
    with pytest.raises(UserError, match="took no picture"):
        mut.take_picture("browser", "page", tmp_path / "x.part")
    assert list(tmp_path.iterdir()) == []
