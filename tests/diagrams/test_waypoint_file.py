"""A program of waypoints in a file of its own."""

import dataclasses as dc

import pytest

from tofssm_drake.diagrams.scenario import dump_scenario, load_scenario
from tofssm_drake.errors import UserError

_PROGRAM = """
waypoints:
- {joints: [0, -1.5, 1.5, 0, 0, 0], speed: 0.3}
- {point: [0.6, 0.2, 1.0], dwell: 0.5, gripper: close}
objects:
- {point: [0.6, 0.2, 1.0]}
"""


def load(folder, program=_PROGRAM, more=""):
    folder.joinpath("program.yaml").write_text(program)
    scenario = folder / "mine.yaml"
    scenario.write_text(
        f"Mine:\n  task: !Waypoints {{file: program.yaml, rounds: 2{more}}}\n"
    )
    return load_scenario(filename=scenario, name="Mine")


def test_is_as_written_in_the_scenario(tmp_path):
    """A relative path is that of the scenario's file."""
    scenario = load(tmp_path)
    inline = load_scenario(
        text="{task: !Waypoints {rounds: 2, waypoints: ["
        "{joints: [0, -1.5, 1.5, 0, 0, 0], speed: 0.3}, "
        "{point: [0.6, 0.2, 1.0], dwell: 0.5, gripper: close}], "
        "objects: [{point: [0.6, 0.2, 1.0]}]}}"
    )
    assert dc.asdict(scenario.task) == dc.asdict(inline.task)
    # A record of the run needs no other file.
    assert dump_scenario(scenario)["task"]["file"] == ""


@pytest.mark.parametrize(
    ("program", "more", "message"),
    [
        ("waypoints: [", "", r"Mine: task\.file: .*program\.yaml:1: not YAML"),
        ("waypoint: []", "", r"program\.yaml:1: program\.waypoint: .*mean"),
        ("rounds: 3", "", r"program\.rounds: unknown key"),
        ("waypoints: [{joints: [0]}]", "", "task.waypoints: must be two"),
        (
            "waypoints: [{speed: 2.0, joints: [0]}, {joints: [1]}]",
            "",
            r"task\.waypoints\[0\]\.speed: 2",
        ),
        (
            _PROGRAM,
            ", waypoints: [{joints: [0]}]",
            r"task\.file: give either a file or",
        ),
    ],
)
def test_mistakes(tmp_path, program, more, message):
    with pytest.raises(UserError, match=message) as caught:
        load(tmp_path, program, more)
    assert "\n" not in str(caught.value)


def test_no_such_file():
    with pytest.raises(
        UserError, match=r"^--scenario-text: task\.file: .*gone\.yaml: No such"
    ):
        load_scenario(text="{task: !Waypoints {file: gone.yaml}}")
