"""The rows of a campaign, asked by cell and metric."""

import math

from tofssm_drake.paper.campaign import ALONE, Cell
from tofssm_drake.studies.statistics import (
    Estimate,
    calc_estimate,
    calc_paired_difference,
)


class Results:
    """Results of a campaign by cell, metric and trial.

    Args:
        rows: What `make_results` returned, or rows read from
            results.parquet.
    """

    def __init__(self, rows: list[dict]):
        self.alone: dict | None = None
        """The row of the run without a person; None: it is missing."""
        self._rows: dict[Cell, dict[int, dict]] = {}
        for row in rows:
            if row["run"] == ALONE:
                self.alone = row
                continue
            cell = Cell(
                sensing=row["sensing"],
                configuration=row["configuration"],
                variant=row["variant"],
            )
            self._rows.setdefault(cell, {})[row["trial"]] = row

    @property
    def cells(self) -> list[Cell]:
        """The cells that have a run, in the order of the rows."""
        return list(self._rows)

    @property
    def trials(self) -> list[int]:
        """Numbers of the trials that have a run."""
        return sorted({t for rows in self._rows.values() for t in rows})

    def count_runs(self) -> int:
        """Returns how many runs with a person there are."""
        return sum(len(rows) for rows in self._rows.values())

    def values(self, cell: Cell, metric: str) -> dict[int, float]:
        """Returns a metric by trial; empty: the cell was not run."""
        return {
            trial: float(row.get(metric, math.nan))
            for trial, row in self._rows.get(cell, {}).items()
        }

    def estimate(self, cell: Cell, metric: str) -> Estimate:
        """Estimates the mean of a metric in a cell."""
        return calc_estimate(self.values(cell, metric).values())

    def difference(self, first: Cell, second: Cell, metric: str) -> Estimate:
        """Estimates the mean of first - second, trial by trial."""
        return calc_paired_difference(
            self.values(first, metric), self.values(second, metric)
        )

    def total(self, metric: str, cells: list[Cell] | None = None) -> float:
        """Returns the sum of a metric over all runs of cells (None: all)."""
        return sum(
            value
            for cell in (self.cells if cells is None else cells)
            for value in self.values(cell, metric).values()
            if math.isfinite(value)
        )
