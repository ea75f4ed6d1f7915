"""A study is read, checked and made into scenarios."""

import hashlib
from pathlib import Path

from bvh_writer import write_bvh
import pytest

from tofssm_drake.diagrams.scenario import dump_scenario, load_scenario
import tofssm_drake.diagrams.study_file as mut
from tofssm_drake.errors import UserError
from tofssm_drake.studies.study import StudyCell


@pytest.fixture
def write(tmp_path):
    def write_study(text):
        path = tmp_path / "study.yaml"
        path.write_text(text)
        return path

    return write_study


def make_scenarios(path, **options):
    return mut.make_study_scenarios(mut.load_study(path), path, **options)


def test_cells_and_variants(write, tmp_path):
    (tmp_path / "mine.yaml").write_text("Other: {random_seed: 7}\n")
    path = write("""
cells:
  Mine:
    scenario: mine.yaml#Other
    text: "{task: {products: 2}}"
    variants: {slow: "{law: {configuration: sm}}"}
  Shipped: {scenario: "#MotionCapture"}
  Plain: {}
text: "{simulation_duration: 20.0, task: {products: 4}}"
""")
    scenarios = make_scenarios(path)
    mine, slow, shipped, plain = scenarios
    assert [c.key for c in scenarios] == [
        "Mine",
        "Mine-slow",
        "Shipped",
        "Plain",
    ]
    assert slow.label == "Mine (slow)"
    assert slow.plain == mine == StudyCell(name="Mine")
    assert scenarios[mine].random_seed == 7
    # What a cell says prevails over what is said of all.
    assert scenarios[mine].task.products == 2
    assert scenarios[plain].task.products == 4
    assert scenarios[mine].law.configuration == "vo"
    assert scenarios[slow].law.configuration == "sm"
    assert list(scenarios[shipped].sensors) == ["motion_capture"]
    assert {s.simulation_duration for s in scenarios.values()} == {20.0}
    assert shipped.scenario == dump_scenario(scenarios[shipped])
    # What the command line says prevails over all.
    more = make_scenarios(path, text="{task: {products: 1}}", duration=2.0)
    assert {s.task.products for s in more.values()} == {1}
    assert {s.simulation_duration for s in more.values()} == {2.0}


def test_an_empty_cell_is_the_default(write):
    ((cell, scenario),) = make_scenarios(write("cells: {A: {}}")).items()
    assert scenario == load_scenario()
    assert cell.reference == "A-alone"


def test_recordings_are_part_of_a_cell(write, tmp_path):
    walk = Path(write_bvh(tmp_path / "walk.bvh"))
    path = write(f"""
cells:
  A: {{text: "{{people: {{visitor: !BvhRecording {{filename: {walk}}}}}}}"}}
""")
    ((cell, scenario),) = make_scenarios(path).items()
    digest = hashlib.sha256(walk.read_bytes()).hexdigest()
    assert cell.recordings == {str(walk): digest}
    assert mut.read_recordings(scenario) == {str(walk): walk.read_bytes()}
    walk.unlink()
    with pytest.raises(UserError, match=r"cells\.A: people.* is not a file"):
        make_scenarios(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "study.yaml: cells: there is none"),
        ("cells: {A: {scenrio: x}}", "study.cells.A.scenrio: unknown key; did"),
        ("cells: {A: }", "study.cells.A: must be a mapping"),
        ("cells: {A: {text: {law: 1}}}", "study.cells.A.text: must be text"),
        ("cells: {a-b: {}}", "study.yaml: cells: 'a-b' must be a name"),
        (
            "cells: {A: {variants: {1: ''}}}",
            "study.yaml: cells.A.variants: '1' must be a name",
        ),
        (
            "{cells: {A: {}}, baseline: B}",
            "baseline: 'B' is no cell, use one of A",
        ),
        ("{cells: {A: {}}, trials: 0}", "study.yaml: trials: 0 must be from 1"),
        ("{cells: {A: {}}, trials: many}", "study.trials: must be a whole"),
        ("{cells: {A: {}}, seed: -1}", "study.yaml: seed: -1 must be from 0"),
        (
            "cells: {A: {scenario: gone.yaml}}",
            "study.yaml: cells.A.scenario: ",
        ),
        (
            "cells: {A: {scenario: '#Defalt'}}",
            "no scenario 'Defalt'; did you mean 'Default'?",
        ),
        (
            "cells: {A: {text: '{law: {C_dc: 1}}'}}",
            "study.yaml: cells.A.text:1: law.C_dc: unknown key; did you mean",
        ),
        (
            "cells: {A: {variants: {b: '{sensor: {}}'}}}",
            "study.yaml: cells.A.variants.b:1: sensor: unknown key",
        ),
        (
            "cells: {A: {text: '{random_seed: -1}'}}",
            "study.yaml: cells.A: random_seed: -1 must be from 0",
        ),
        (
            "{cells: {A: {}}, text: '{x: 1}'}",
            "study.yaml: text:1: x: unknown key",
        ),
    ],
)
def test_mistakes(write, text, message):
    with pytest.raises(UserError) as caught:
        make_scenarios(write(text))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UserError, match=r"gone\.yaml: cannot read the study"):
        mut.load_study(tmp_path / "gone.yaml")
