"""The report of a made-up study."""

import math

import pytest

from tofssm_drake.reports import figures
from tofssm_drake.reports.study_figure import make_study_figure
import tofssm_drake.reports.study_report as mut
from tofssm_drake.studies.results import make_results, make_row
from tofssm_drake.studies.study import (
    CellSettings,
    Study,
    StudyCell,
    add_time_lost,
    make_study_plan,
    make_study_results,
)

CELLS = [
    StudyCell(name="First"),
    StudyCell(name="Second"),
    StudyCell(name="Second", variant="late"),
]


def make_study(**options):
    cells = {"First": CellSettings(), "Second": CellSettings(text="{a: 1}")}
    return Study(title="Mine & yours", cells=cells, **options)


def make_rows(plan, change=None):
    """Returns rows; cells differ by 0.1 in productivity, trials by 0.01."""
    rows = {}
    for run in plan.list_runs():
        number = run.trial.number if run.trial else 0
        i = CELLS.index(run.cell)
        # One trial is a little off, so that there are intervals.
        off = 0.001 * i * (number == 2)
        metrics = {
            "productivity": 0.8 - 0.1 * i - 0.01 * number + off,
            "task_time_s": 50.0 + number,
            "contacts_while_moving": 0.0,
            "finished": 1.0,
        }
        if change and run.trial:
            metrics |= change(run.cell, number)
        rows[run.key] = make_row(run, metrics)
    return add_time_lost(make_results(plan, rows))


def write(folder, *, trials=3, change=None, **options):
    plan = make_study_plan(CELLS, seed=0, trials=trials)
    path = mut.write_study_report(
        folder,
        plan=plan,
        study=make_study(),
        rows=make_rows(plan, change),
        command="tofssm experiments --study x.yaml",
        **options,
    )
    return path.read_text("utf-8")


def test_tells_everything(tmp_path):
    page = write(tmp_path)
    assert page.rstrip().endswith("</html>")
    assert "http" not in page.replace("http://www.w3.org", "")
    for words in (
        *("Mine &amp; yours", "touched nobody in 9 runs", "First", "Second"),
        *("Second \u2212 First", "Second (late) \u2212 Second", "+10.0"),
        *("with <code>{a: 1}</code>", "tofssm experiments --study x.yaml"),
        "50.0 s in First",
    ):
        assert words in page, words
    assert "Second (late) \u2212 First" not in page
    names = {p.name for p in (tmp_path / "figures").iterdir()}
    assert names == {"study.svg", "study.png"}


def test_what_went_wrong_is_told(tmp_path):
    def change(cell, number):
        if cell.name == "First" and number == 1:
            return {"contacts_while_moving": 2.0, "finished": 0.0}
        return {}

    page = write(tmp_path, change=change, failures={"First, trial 9": "<x>"})
    assert "In 1 of 9 runs the moving robot touched somebody." in page
    assert "In 1 of 9 runs the task was not finished" in page
    assert "1 of 10 runs failed" in page
    assert "First, trial 9: &lt;x&gt;" in page


def test_one_trial_decides_nothing(tmp_path):
    page = write(tmp_path, trials=1)
    assert "no difference can be decided" in page
    assert "<strong>" not in page


def test_time_lost_is_the_rest_of_productivity():
    plan = make_study_plan(CELLS[:1], seed=0, trials=2)
    rows = make_rows(plan)
    assert rows[1]["time_lost_share"] == pytest.approx(0.21)
    # Each cell has a run without people of its own.
    assert rows[0]["run"] == "First-alone"
    assert rows[1]["productivity_measured"] == pytest.approx(50 / 51)
    results = make_study_results(rows)
    assert results.cells == CELLS[:1]
    assert list(results.references) == ["First-alone"]


def test_pairs():
    first, second, late = CELLS
    assert mut.list_study_pairs(CELLS, "First") == [
        (second, first),
        (late, second),
    ]
    assert mut.list_study_pairs(CELLS, "Second")[0] == (first, second)
    # What failed altogether is compared with nothing.
    assert mut.list_study_pairs([late], "First") == []


@pytest.mark.parametrize("narrow", [False, True])
def test_figure(narrow):
    plan = make_study_plan(CELLS, seed=0, trials=3)
    results = make_study_results(
        make_rows(
            plan, lambda c, n: {"productivity": math.nan} if n == 3 else {}
        )
    )
    figure = make_study_figure(results, narrow=narrow)
    lost, contacts = figure.axes
    assert "time lost" in lost.get_xlabel()
    assert "contacts" in contacts.get_xlabel()
    labels = [text.get_text() for text in lost.get_yticklabels()]
    assert labels == ["First", "Second", "Second (late)"]
    points = [line for line in lost.get_lines() if line.get_marker() == "o"]
    assert points[0].get_xdata() == pytest.approx([21.0, 22.0])
    assert "Second (late)" in figures.to_svg(figure)


def test_a_study_without_results():
    figure = make_study_figure(make_study_results([]))
    assert len(figure.axes) == 2
    figures.to_svg(figure)
