"""Sentences from a campaign's numbers."""

from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.results import Results

PAPER_SENSINGS = ("tof", "ideal", "lidar")
"""What the paper compares."""


CONFIGURATIONS = ("vo", "vr", "sm")


def make_cell(sensing: str, configuration: str) -> Cell:
    """Returns a cell without a variant."""
    return Cell(sensing=sensing, configuration=configuration)


def make_cells(
    sensings=PAPER_SENSINGS, configurations=CONFIGURATIONS
) -> list[Cell]:
    """Returns the cells of some sensings with some configurations."""
    return [make_cell(s, c) for s in sensings for c in configurations]


def get_means(
    results: Results, metric: str, cells: list[Cell]
) -> dict[Cell, float]:
    """Returns the means of the cells that have one."""
    estimates = {cell: results.estimate(cell, metric) for cell in cells}
    return {cell: e.mean for cell, e in estimates.items() if e.count}


def list_means(
    results: Results,
    metric: str,
    cells: list[Cell],
    *,
    digits: int = 2,
    scale: float = 1.0,
) -> str:
    """Returns `Real Vo 0.53, ...` of the cells that have the metric."""
    means = get_means(results, metric, cells)
    return ", ".join(
        f"{cell.label} {format_number(scale * mean, digits)}"
        for cell, mean in means.items()
    )


def format_number(value: float, digits: int) -> str:
    """Returns a number with a minus sign for a reader."""
    return f"{value:.{digits}f}".replace("-", "\u2212")


def write_list(head: str, listed: str) -> str:
    """Returns a sentence; empty if there is nothing to list."""
    return f"{head}: {listed}." if listed else ""


def write_means(
    results: Results, head: str, metric: str, cells: list[Cell], **options
) -> str:
    """Returns a sentence that lists a metric's means by cell."""
    return write_list(head, list_means(results, metric, cells, **options))


def join(*sentences: str) -> str:
    """Returns the non-empty sentences as one text."""
    return " ".join(sentence for sentence in sentences if sentence)


def name_cells(cells: list[Cell]) -> str:
    """Returns the names of cells in one list."""
    return ", ".join(cell.label for cell in cells)
