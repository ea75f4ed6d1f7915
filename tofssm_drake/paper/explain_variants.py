"""What the variants that were run change of a claim."""

from collections.abc import Sequence
import dataclasses as dc

from tofssm_drake.paper.cells import VARIANTS, Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import join, write_list
from tofssm_drake.studies.statistics import (
    calc_paired_difference,
    format_estimate,
)


def explain_variants(
    results: Results,
    metric: str,
    cells: list[Cell],
    pairs: Sequence[tuple[Cell, Cell]] | None = None,
    *,
    digits: int = 2,
    scale: float = 1.0,
) -> str:
    """Lists by how much the variants that were run change what is claimed.

    A change whose interval contains 0 is not decided, which does not mean
    that there is no change.

    Args:
        results: Of the campaign.
        metric: Column.
        cells: The cells of the claim.
        pairs: (first, second) if the claim is about the difference first -
            second: then the change of that difference counts, not what
            changes both alike.
        digits: Of the changes.
        scale: From the column's unit to that of the text.
    """
    changes = (
        _list_changes(results, metric, cells)
        if pairs is None
        else _list_difference_changes(results, metric, pairs)
    )
    changes = [(n, v.scale(scale)) for n, v in changes if v.count > 1]
    decided = [c for c in changes if c[1].low > 0.0 or c[1].high < 0.0]
    rest = [change for change in changes if change not in decided]
    rest.sort(key=lambda change: -abs(change[1].mean))
    if not changes:
        return ""

    def write(listed):
        return "; ".join(
            f"{name} {format_estimate(value, digits=digits, sign=True)}"
            for name, value in listed
        )

    what = (
        "the number"
        if pairs is None
        else "the claimed difference, or of a cell where only that one of the "
        "two has the variant"
    )
    count = (
        "One comparison"
        if len(changes) == 1
        else f"{len(changes)} comparisons, without correction for their number"
    )
    shown = f" The {_SHOWN} largest" if len(rest) > _SHOWN else ""
    return join(
        f"What the variants change of {what} (95 % confidence; {count}).",
        write_list("Decided", write(decided)),
        f"{'Otherwise no' if decided else 'No'} change is decided by these "
        "trials, which does not mean that there is none."
        f"{shown or ' They are'}: "
        f"{write(rest[:_SHOWN])}."
        if rest
        else "",
    )


_SHOWN = 4
"""Number of undecided changes that are shown."""


def _list_changes(results, metric, cells):
    """Returns (name, change) of each cell with a variant."""
    return [
        (cell.label, results.difference(cell, plain, metric))
        for cell in results.cells
        if cell.variant and (plain := dc.replace(cell, variant="")) in cells
    ]


def _list_difference_changes(results, metric, pairs):
    """Returns (name, change) of each pair and variant, each change once.

    Where only one cell of a pair has the variant, its own change counts.
    """
    varied = [cell.variant for cell in results.cells if cell.variant]
    changes = {}
    for pair in pairs:
        for key in dict.fromkeys(varied):
            changed = [dc.replace(cell, variant=key) for cell in pair]
            known = [cell for cell in changed if cell in results.cells]
            if len(known) == 1:
                plain = dc.replace(known[0], variant="")
                changes[known[0].label] = results.difference(
                    known[0], plain, metric
                )
            elif known:
                name = " \u2212 ".join(cell.label for cell in pair)
                changes[f"{name} ({VARIANTS[key].label})"] = (
                    calc_paired_difference(
                        _get_difference(results, metric, *changed),
                        _get_difference(results, metric, *pair),
                    )
                )
    return list(changes.items())


def _get_difference(results, metric, first, second):
    """Returns first - second by trial."""
    one, other = results.values(first, metric), results.values(second, metric)
    return {trial: one[trial] - other[trial] for trial in one if trial in other}
