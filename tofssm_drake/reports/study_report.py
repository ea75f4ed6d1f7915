"""The report of a study of one's own."""

from pathlib import Path
from typing import Any

from tofssm_drake.recording.samples import write_atomically
from tofssm_drake.reports import figures
from tofssm_drake.reports.page import Picture, render_page
from tofssm_drake.reports.study_figure import make_study_figure
from tofssm_drake.reports.tables import (
    Metric,
    make_cell_table,
    make_difference_table,
)
from tofssm_drake.studies.campaign import Plan
from tofssm_drake.studies.results import Results
from tofssm_drake.studies.statistics import calc_rate_bound
from tofssm_drake.studies.study import Study, StudyCell, make_study_results

_PERCENT: dict[str, Any] = {"unit": "%", "digits": 1, "scale": 100.0}

METRICS = {
    "Productivity": (
        Metric(name="time_lost_share", label="time lost", **_PERCENT),
        Metric(
            name="productivity_measured",
            label="productivity, measured",
            **_PERCENT,
        ),
        Metric(name="task_time_s", label="task time", unit="s", digits=1),
        Metric(name="stopped_s", label="stopped", unit="s", digits=1),
        Metric(name="reduced_s", label="reduced", unit="s", digits=1),
        Metric(
            name="state_changes_per_min",
            label="state changes",
            unit="per minute",
            digits=1,
        ),
    ),
    "Safety": (
        Metric(
            name="contacts_while_moving",
            label="contacts while moving",
            unit="in all runs",
            is_count=True,
        ),
        Metric(
            name="contact_speed_max_mps",
            label="fastest contact of all runs",
            unit="m/s",
            is_worst=True,
        ),
        Metric(name="min_true_distance_m", label="least distance", unit="m"),
        Metric(
            name="separation_at_stop_m", label="separation at stop", unit="m"
        ),
        Metric(
            name="velocity_change_at_stop_mps",
            label="velocity change at stop",
            unit="m/s",
        ),
    ),
    "What is seen": (
        Metric(
            name="detection_share",
            label="seen while in range",
            **_PERCENT,
        ),
        Metric(
            name="missed_events",
            label="approaches without a stop",
            unit="per run",
            digits=1,
        ),
        Metric(
            name="false_events",
            label="stops without an approach",
            unit="per run",
            digits=1,
        ),
    ),
}
"""Columns of the tables by title; docs/metrics.md says what they are."""

_COMPARED = (
    *METRICS["Productivity"][:1],
    *METRICS["Productivity"][3:],
    METRICS["Safety"][0],
    *METRICS["Safety"][2:],
    METRICS["What is seen"][0],
)


def write_study_report(
    folder: Path,
    *,
    plan: Plan,
    study: Study,
    rows: list[dict],
    command: str,
    failures: dict[str, str] | None = None,
) -> Path:
    """Writes report.html, and the figure as SVG and PNG, each file whole.

    Args:
        folder: The campaign's.
        plan: The campaign's.
        study: As it was read.
        rows: All that there are, see `add_time_lost`.
        command: What makes the campaign again.
        failures: Reason by the label of the run that failed.

    Returns:
        The report's path.

    Raises:
        UserError: The folder cannot be written.
    """
    results = make_study_results(rows)
    wide = make_study_figure(results)
    svg, png = figures.to_svg(wide), figures.to_png(wide)
    picture = Picture(
        wide=figures.encode_svg(svg),
        narrow=figures.to_data_uri(make_study_figure(results, narrow=True)),
        description="Time lost and contacts while moving by cell: every run, "
        "the middle half, and the mean with its confidence interval.",
    )
    page = make_study_report(
        plan=plan,
        study=study,
        results=results,
        picture=picture,
        command=command,
        failures=failures or {},
    )
    # Nothing is written before everything is made.
    folder = Path(folder)
    (folder / "figures").mkdir(exist_ok=True)
    for name, content in (
        ("figures/study.svg", svg.encode()),
        ("figures/study.png", png),
        ("report.html", page.encode()),
    ):
        write_atomically(
            folder / name, lambda p, content=content: p.write_bytes(content)
        )
    return folder / "report.html"


def make_study_report(
    *,
    plan: Plan,
    study: Study,
    results: Results,
    picture: Picture,
    command: str,
    failures: dict[str, str],
) -> str:
    """Returns the report as one HTML document.

    Args:
        plan: The campaign's.
        study: As it was read.
        results: Of the study.
        picture: The study's figure.
        command: What makes the campaign again.
        failures: Reason by the label of the run that failed.
    """
    cells = results.cells
    baseline = study.baseline or next(iter(study.cells))
    pairs = list_study_pairs(cells, baseline)
    return render_page(
        "study.html.jinja",
        title=study.title,
        cells=[(name, study.cells[name]) for name in study.cells],
        trials=len(results.trials),
        runs=results.count_runs(),
        contacts=_count_contacts(results),
        unfinished=results.count_runs() - round(results.total("finished")),
        baseline=baseline,
        picture=picture,
        tables={
            name: make_cell_table(results, cells, metrics)
            for name, metrics in METRICS.items()
        },
        differences=make_difference_table(results, pairs, _COMPARED),
        alone=[
            (cell.label, results.references[cell.reference]["task_time_s"])
            for cell in plan.cells
            if cell.reference in results.references
        ],
        text=study.text,
        command=command,
        plan=plan,
        failures=failures,
    )


def list_study_pairs(
    cells: list[StudyCell], baseline: str
) -> list[tuple[StudyCell, StudyCell]]:
    """Returns the pairs of cells that are compared.

    A variant is compared with the cell that it changes, any other cell with
    the baseline.

    Args:
        cells: Those that have a run.
        baseline: Name of the cell.
    """
    pairs = [
        (cell, cell.plain if cell.variant else StudyCell(name=baseline))
        for cell in cells
    ]
    return [(a, b) for a, b in pairs if a != b and b in cells]


def _count_contacts(results):
    """Returns how many runs had a contact, and what none says of the rate."""
    runs = results.count_runs()
    touched = sum(
        value > 0
        for cell in results.cells
        for value in results.values(cell, "contacts_while_moving").values()
    )
    bound = 100 * calc_rate_bound(runs) if runs else 100.0
    return {"runs": touched, "bound": bound}
