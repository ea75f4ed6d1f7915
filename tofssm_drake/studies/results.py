"""The rows of a campaign, asked by cell and metric."""

from collections.abc import Callable, Hashable
import math

import numpy as np

from tofssm_drake.metrics.metric_columns import METRIC_COLUMNS
from tofssm_drake.recording.columns import Column
from tofssm_drake.studies.campaign import Plan, PlannedRun
from tofssm_drake.studies.statistics import (
    Estimate,
    calc_estimate,
    calc_paired_difference,
)

COLUMNS = METRIC_COLUMNS | {
    "run": Column(meaning="name of the run's folder"),
    "trial": Column(meaning="number of the trial, from 1; 0: no person"),
    "seed": Column(meaning="seed of the trial; 0: no person"),
    "speed": Column(unit="m/s", meaning="walking speed of the trial's person"),
    "stature": Column(unit="m", meaning="standing height of that person"),
    "productivity_measured": Column(
        meaning="task time of the run without a person over this one's"
    ),
    "time_lost_share": Column(meaning="1 - productivity"),
}
"""What the columns of a campaign's tables are; those of its cells are in
`Cell.COLUMNS`."""


def make_row(run: PlannedRun, metrics: dict) -> dict:
    """Returns the row of a run.

    Args:
        run: Which.
        metrics: Numbers that follow from its samples.
    """
    trial = run.trial
    about = {
        "run": run.key,
        **run.cell.describe(),
        "trial": trial.number if trial else 0,
        "seed": trial.seed if trial else 0,
        "speed": trial.speed if trial else np.nan,
        "stature": trial.stature if trial else np.nan,
    }
    return about | metrics


def make_results(plan: Plan, rows: dict[str, dict]) -> list[dict]:
    """Returns all rows in the order of the plan.

    Adds `productivity_measured`, t_NoHRI / t_HRI (the paper's Eq. 10a) with
    t_NoHRI from the cell's run without a person; NaN for a run that was not
    finished when its time was up. It checks `productivity`, which takes
    t_NoHRI from the run's own samples.

    Args:
        plan: The campaign's.
        rows: By the runs' keys; runs that failed are missing.
    """
    results = []
    for run in plan.list_runs():
        if run.key in rows:
            row = rows[run.key]
            alone = rows.get(run.cell.reference, {}).get("task_time_s", np.nan)
            measured = alone / row["task_time_s"]
            results.append(row | {"productivity_measured": measured})
    return results


class Results:
    """Results of a campaign by cell, metric and trial.

    Args:
        rows: What `make_results` returned, or rows read from
            results.parquet.
        read_cell: Returns the cell that a row is of.
    """

    def __init__(self, rows: list[dict], read_cell: Callable[[dict], Hashable]):
        self.references = {row["run"]: row for row in rows if not row["trial"]}
        """Rows of the runs without a person by their keys."""
        self._rows: dict[Hashable, dict[int, dict]] = {}
        for row in rows:
            if row["trial"]:
                of_cell = self._rows.setdefault(read_cell(row), {})
                of_cell[row["trial"]] = row

    @property
    def cells(self) -> list:
        """The cells that have a run, in the order of the rows."""
        return list(self._rows)

    @property
    def trials(self) -> list[int]:
        """Numbers of the trials that have a run."""
        return sorted({t for rows in self._rows.values() for t in rows})

    def count_runs(self) -> int:
        """Returns how many runs with a person there are."""
        return sum(len(rows) for rows in self._rows.values())

    def values(self, cell, metric: str) -> dict[int, float]:
        """Returns a metric by trial; empty: the cell was not run."""
        return {
            trial: float(row.get(metric, math.nan))
            for trial, row in self._rows.get(cell, {}).items()
        }

    def estimate(self, cell, metric: str) -> Estimate:
        """Estimates the mean of a metric in a cell."""
        return calc_estimate(self.values(cell, metric).values())

    def difference(self, first, second, metric: str) -> Estimate:
        """Estimates the mean of first - second, trial by trial."""
        return calc_paired_difference(
            self.values(first, metric), self.values(second, metric)
        )

    def total(self, metric: str, cells: list | None = None) -> float:
        """Returns the sum of a metric over all runs of cells (None: all)."""
        return sum(
            value
            for cell in (self.cells if cells is None else cells)
            for value in self.values(cell, metric).values()
            if math.isfinite(value)
        )
