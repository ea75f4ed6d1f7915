"""The figure of a study: each run, and what the cell is like on average."""

import math

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from tofssm_drake.reports.figures import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    STYLE,
    add_legend,
)
from tofssm_drake.studies.results import Results

_WIDE, _NARROW = 10.6, 4.3
_PANELS = (
    ("time_lost_share", 100.0, "time lost (%)", BLUE, 100.0),
    (
        "contacts_while_moving",
        1.0,
        "contacts while moving, per run",
        ORANGE,
        1.0,
    ),
)
"""Metric, factor to it, words, colour, least end of the axis."""


def make_study_figure(results: Results, *, narrow: bool = False) -> Figure:
    """Draws what safety costs and what is left of the danger, by cell.

    Args:
        results: Of the study.
        narrow: For a phone.
    """
    cells = results.cells
    height = 0.42 * max(len(cells), 1) + 1.2
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(_NARROW, 2 * height) if narrow else (_WIDE, height),
            layout="constrained",
        )
        shape = (2, 1) if narrow else (1, 2)
        axes = figure.subplots(*shape, sharey=not narrow, squeeze=False)
        for ax, (metric, scale, words, colour, least) in zip(
            axes.ravel(), _PANELS, strict=True
        ):
            for y, cell in enumerate(cells):
                values = results.values(cell, metric).values()
                value = results.estimate(cell, metric).scale(scale)
                _draw_values(ax, y, scale * np.array([*values]), colour)
                _draw_mean(ax, y, value)
            ax.set_xlabel(words)
            right = 1.04 * max(least, ax.dataLim.x1)
            ax.set_xlim(-0.02 * right, right)
            ax.set_yticks(range(len(cells)), [cell.label for cell in cells])
            ax.set_ylim(max(len(cells), 1) - 0.5, -0.5)
            ax.grid(axis="y", visible=False)
        _add_legend(axes[0, 0], columns=1 if narrow else 3)
    return figure


def _draw_values(ax: Axes, y: int, values: np.ndarray, colour: str):
    """Draws the runs of a cell as points, and their quartiles as a box."""
    values = values[np.isfinite(values)]
    if not len(values):
        return
    low, high = np.percentile(values, [25, 75])
    ax.barh(y, high - low, 0.5, left=low, color=colour, alpha=0.25)
    # Runs side by side, so that equal ones can be counted.
    offset = np.linspace(-0.18, 0.18, len(values)) if len(values) > 1 else 0.0
    ax.plot(
        values,
        y + offset,
        "o",
        color=colour,
        markersize=3.5,
        alpha=0.8,
        markeredgewidth=0,
    )


def _draw_mean(ax: Axes, y: int, value):
    """Draws the mean of a cell with its confidence interval."""
    if not value.count:
        return
    half = value.half_width if math.isfinite(value.half_width) else None
    ax.errorbar(
        value.mean, y, xerr=half, fmt="D", color=BLACK, markersize=4, capsize=3
    )


def _add_legend(ax: Axes, columns: int):
    handles = [
        Line2D([], [], color=GREY, marker="o", linestyle="none", label="a run"),
        Patch(color=GREY, alpha=0.25, label="middle half of the runs"),
        Line2D(
            [],
            [],
            color=BLACK,
            marker="D",
            markersize=4,
            label="mean with 95 % confidence",
        ),
    ]
    add_legend(ax, handles, columns=columns)
