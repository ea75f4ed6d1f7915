"""Tables of a campaign: cells or pairs of cells by metrics."""

from collections.abc import Sequence
import dataclasses as dc
import math

from tofssm_drake.studies.results import Results
from tofssm_drake.studies.statistics import Estimate, format_estimate


@dc.dataclass(frozen=True, kw_only=True)
class Metric:
    """A column of the tables."""

    name: str
    """Of the results' column."""
    label: str
    unit: str
    digits: int = 2
    scale: float = 1.0
    is_worst: bool = False
    """Whether to show the greatest value of all runs, not the mean."""
    is_count: bool = False
    """Whether to show the sum and the runs with any, not the mean."""
    whole: str = ""
    """Column of which this one counts a part; shown as `part of whole`."""


def make_cell_table(
    results: Results, cells: Sequence, metrics: Sequence[Metric]
) -> dict:
    """Returns a table with a row per cell: mean with interval.

    Args:
        results: Of the campaign.
        cells: Rows.
        metrics: Columns.

    Returns:
        `head`, pairs (label, unit), and `rows`, pairs (cell, texts).
    """

    def write(cell, metric):
        value = results.estimate(cell, metric.name)
        if metric.is_count and value.count:
            return _count_in_runs(results, cell, metric)
        if metric.whole and value.count:
            whole = results.estimate(cell, metric.whole)
            return f"{value.mean:.0f} of {whole.mean:.0f}"
        if metric.is_worst and value.count:
            known = results.values(cell, metric.name).values()
            worst = max(v for v in known if math.isfinite(v))
            value = Estimate(mean=worst, half_width=math.nan, count=1)
        return format_metric(value, metric)

    return {
        "head": [(m.label, m.unit) for m in metrics],
        "rows": [(cell, [write(cell, m) for m in metrics]) for cell in cells],
    }


def count(number: int, noun: str) -> str:
    """Returns `1 run`, `2 runs`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _count_in_runs(results, cell, metric):
    """Returns `6 in 2 of 5 runs`: counts have no symmetric interval."""
    known = results.values(cell, metric.name).values()
    known = [value for value in known if math.isfinite(value)]
    if not sum(known):
        return f"0 in {count(len(known), 'run')}"
    some = sum(value > 0.0 for value in known)
    return f"{sum(known):.0f} in {some} of {count(len(known), 'run')}"


def make_difference_table(
    results: Results,
    pairs: Sequence[tuple],
    metrics: Sequence[Metric],
    labels: Sequence[str] | None = None,
) -> dict:
    """Returns a table of paired differences.

    Args:
        results: Of the campaign.
        pairs: (first, second) cells; a row is first - second.
        metrics: Columns.
        labels: Of the rows; None: the names of both cells.

    Returns:
        `head` as in `make_cell_table`, and `rows`, pairs (label, entries).
        An entry is (text, whether 0 is outside the interval).
    """
    if labels is None:
        labels = [f"{a.label} \u2212 {b.label}" for a, b in pairs]
    rows = []
    for label, (first, second) in zip(labels, pairs, strict=True):
        entries = []
        for m in metrics:
            value = results.difference(first, second, m.name)
            clear = value.low > 0.0 or value.high < 0.0
            entries.append((format_metric(value, m, sign=True), clear))
        rows.append((label, entries))
    # A difference of shares in % is not a share of anything.
    units = {"%": "points", "in all runs": "per run"}
    head = [(m.label, units.get(m.unit, m.unit)) for m in metrics]
    return {"head": head, "rows": rows}


def format_metric(
    value: Estimate, metric: Metric, *, sign: bool = False
) -> str:
    """Returns an estimate of a metric in the metric's unit."""
    return format_estimate(
        value.scale(metric.scale), digits=metric.digits, sign=sign
    )
