"""The rules by which claims are judged, and what a claim is.

The rules are the same for all and were fixed before any run:

- A claim that one cell exceeds others is *reproduced* if the paired
  difference to each of them is above 0 with 95 % confidence; *not
  reproduced* if the difference to any of them is below 0 with 95 %
  confidence; *undecided* otherwise.
- A claim that a value is about x is *reproduced* if the 95 % confidence
  interval of the mean lies within x +- 20 %; *not reproduced* if it lies
  outside; *undecided* otherwise.
- A claim of several parts is not reproduced if one of them is not, and
  reproduced if all of them are.
- *Not run*: the campaign lacks a cell of the claim.
- *No value*: all of them were run, but in one the event that the claim is
  about never happened, and no other part decides against the claim.
"""

from collections.abc import Sequence
import dataclasses as dc

from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.studies.statistics import Estimate

REPRODUCED = "reproduced"
NOT_REPRODUCED = "not reproduced"
UNDECIDED = "undecided"
NOT_RUN = "not run"
NO_VALUE = "no value"

TOLERANCE = 0.2
"""What "about" means, as a fraction."""


@dc.dataclass(frozen=True, kw_only=True)
class Evidence:
    """One number behind a verdict."""

    what: str
    """What it is, e.g. `Real Vr - Real Vo`."""
    estimate: Estimate
    verdict: str
    """Of this number alone."""


@dc.dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim of the paper with the result of this campaign."""

    key: str
    """Short name."""
    text: str
    """What the paper says, in our words."""
    verdict: str
    """REPRODUCED, NOT_REPRODUCED, UNDECIDED, NO_VALUE or NOT_RUN."""
    unit: str
    """Of the evidence."""
    evidence: tuple[Evidence, ...] = ()
    digits: int = 3
    """Of the evidence, after the decimal point."""
    note: str = ""
    """What else the reader should know."""
    why: str = ""
    """Why it is not reproduced or undecided, as far as the results show; empty
    if it is reproduced, or with too few trials to say anything."""


def judge_positive(difference: Estimate) -> str:
    """Judges the claim that a difference is above 0."""
    if not difference.count:
        return NOT_RUN
    if difference.low > 0.0:
        return REPRODUCED
    if difference.high < 0.0:
        return NOT_REPRODUCED
    return UNDECIDED


def judge_about(value: Estimate, target: float) -> str:
    """Judges the claim that a mean is about a positive target."""
    if not value.count:
        return NOT_RUN
    low, high = (1.0 - TOLERANCE) * target, (1.0 + TOLERANCE) * target
    if low <= value.low and value.high <= high:
        return REPRODUCED
    if value.high < low or value.low > high:
        return NOT_REPRODUCED
    return UNDECIDED


def combine(verdicts: list[str]) -> str:
    """Returns the verdict of a claim of several parts."""
    for verdict in (NOT_RUN, NOT_REPRODUCED, NO_VALUE, UNDECIDED):
        if verdict in verdicts:
            return verdict
    return REPRODUCED if verdicts else NOT_RUN


def check_run(results: Results, cells: Sequence[Cell], verdict: str) -> str:
    """Returns the verdict; "no value" if "not run" but all cells were run."""
    is_run = all(cell in results.cells for cell in cells)
    return NO_VALUE if verdict == NOT_RUN and is_run else verdict


def orient(
    pairs: Sequence[tuple[Cell, Cell]], least: bool
) -> list[tuple[Cell, Cell]]:
    """Returns the pairs so that the first one is claimed to have more."""
    return [(b, a) for a, b in pairs] if least else list(pairs)


def compare(
    results: Results,
    metric: str,
    pairs: Sequence[tuple[Cell, Cell]],
    *,
    least: bool = False,
    scale: float = 1.0,
) -> list[Evidence]:
    """Returns evidence that the first of each pair has more of the metric.

    Args:
        results: Of the campaign.
        metric: Column.
        pairs: (first, second) cells.
        least: Claims that the first has less instead.
        scale: From the column's unit to the claim's.
    """
    evidence = []
    for first, second in orient(pairs, least):
        difference = results.difference(first, second, metric).scale(scale)
        evidence.append(
            Evidence(
                what=f"{first.label} \u2212 {second.label}",
                estimate=difference,
                verdict=check_run(
                    results, (first, second), judge_positive(difference)
                ),
            )
        )
    return evidence


def list_about(
    results: Results,
    metric: str,
    targets: Sequence[tuple[Cell, float]],
    *,
    scale: float = 1.0,
) -> list[Evidence]:
    """Returns evidence that cells have about the value of the paper.

    Args:
        results: Of the campaign.
        metric: Column.
        targets: (cell, value in the claim's unit) pairs.
        scale: From the column's unit to the claim's.
    """
    evidence = []
    for cell, target in targets:
        value = results.estimate(cell, metric).scale(scale)
        evidence.append(
            Evidence(
                what=f"{cell.label} (paper: {target:g})",
                estimate=value,
                verdict=check_run(results, (cell,), judge_about(value, target)),
            )
        )
    return evidence
