"""A file that cannot be used is told with the setting that names it."""

import itertools

import pytest

from tofssm_drake.diagrams.scenario import Scenario, load_scenario
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.diagrams.study_file import load_study, make_study_scenarios
from tofssm_drake.errors import UserError

SETTINGS = {
    "workcell": "{workcell: FILE}",
    "robot.file": "{robot: !Arm {file: FILE}}",
    "robot.tool": "{robot: {tool: FILE}}",
    "people.visitor.filename": (
        "{people: {visitor: !BvhRecording {filename: FILE}}}"
    ),
}

CONTENTS = {
    "notes.txt": b"root:x:0:0\n",
    "bad.urdf": b"<robot name='a'><link",
    "empty.urdf": b"",
    "binary.sdf": bytes(range(256)),
    "mesh.urdf": b"<robot name='a'><link name='b'><visual><geometry>"
    b"<mesh filename='package://nowhere/a.stl'/></geometry></visual></link>"
    b"</robot>",
    "number.urdf": b"<robot name='a'><link name='b'><visual>"
    b"<origin xyz='a b c'/><geometry><mesh filename='a.stl'/></geometry>"
    b"</visual></link></robot>",
    "two.dmd.yaml": b"directives: []\n",
    "walk.bvh": b"HIERARCHY\nROOT Hips\n",
}


def use(text):
    """Does what a run does before anything is written."""
    make_station(load_scenario(text=text))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, content in CONTENTS.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder.urdf").mkdir()
    return tmp_path


FILES = [*CONTENTS, "gone.urdf", "folder.urdf", "package://gone/a.urdf"]


@pytest.mark.parametrize(
    ("setting", "file"),
    [
        pair
        for pair in itertools.product(SETTINGS, FILES)
        # An empty list of directives is a workcell.
        if pair != ("workcell", "two.dmd.yaml")
    ],
)
def test_says_setting_file_and_what_is_wrong(folder, setting, file):
    with pytest.raises(UserError) as caught:
        use(SETTINGS[setting].replace("FILE", file))
    text = str(caught.value)
    told = text.removeprefix("--scenario-text: ")
    assert told.startswith(f"{setting}: "), text
    assert file.rpartition("/")[2] in text or "package 'gone'" in text
    assert "\n" not in text


def test_a_workcell_may_be_empty(folder):
    # Nothing stands there: the products have no table.
    use("{workcell: two.dmd.yaml, task: !NoTask {}}")


def test_of_a_study(folder):
    study = folder / "study.yaml"
    study.write_text(
        "cells:\n  a: {text: 'people: {visitor: !BvhRecording "
        "{filename: walk.bvh}}'}\n"
    )
    with pytest.raises(
        UserError, match=r"cells\.a: people\.visitor\.filename: .*walk\.bvh"
    ):
        make_study_scenarios(load_study(study), study)


def test_two_people_at_one_place_are_named():
    text = "{people: {ben: !GeneratedWalk {speed: 1.0}}}"
    with pytest.raises(
        UserError, match=r"people\.ben: starts where people\.visitor does"
    ):
        load_scenario(text=text)
    text = "{people: {ben: !GeneratedWalk {figure_eight: {start: 0.75}}}}"
    assert isinstance(load_scenario(text=text), Scenario)
    text = (
        "{people: {visitor: null, "
        "a: !BvhRecording {filename: x, placement: in_place}, "
        "b: !BvhRecording {filename: y, placement: own_path}}}"
    )
    with pytest.raises(UserError, match=r"people\.b: .* people\.a does"):
        load_scenario(text=text)
