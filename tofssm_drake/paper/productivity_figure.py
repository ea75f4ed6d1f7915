"""The paper's Fig. 10: productivity against safety."""

import math

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse as EllipsePatch
from matplotlib.patches import Patch
import numpy as np

from tofssm_drake.paper.cell_style import (
    MARKER,
    NARROW,
    SENSING_COLOUR,
    find_configurations,
    find_sensings,
    list_plain,
)
from tofssm_drake.paper.cells import CONFIGURATION_LABEL, SENSINGS
from tofssm_drake.paper.claim_parts import SAFETY
from tofssm_drake.paper.results import Results
from tofssm_drake.reports.figures import BLACK, GREY, STYLE, add_legend
from tofssm_drake.studies.statistics import calc_confidence_ellipse


def make_productivity_figure(
    results: Results,
    *,
    metric: str = "safety_mean_m2_per_mps",
    narrow: bool = False,
) -> Figure:
    """Draws Fig. 10: productivity against safety, with confidence ellipses.

    Args:
        results: Of the campaign.
        metric: The safety metric's average.
        narrow: For a phone.
    """
    cells = list_plain(results)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(NARROW, 5.4) if narrow else (8.6, 5.6),
            layout="constrained",
        )
        ax = figure.subplots()
        for cell in cells:
            _draw_productivity(ax, results, cell, metric)
        ax.set_xlabel(
            f"safety metric, {SAFETY[metric]} of "
            "$\\|D_{gt}\\|^2 / \\|V_{tool}\\|$ (m\u00b2/(m/s))"
        )
        ax.set_ylabel("productivity (%)")
        ax.set_ylim(0, 100)
        ax.set_xlim(left=0)
        _add_cell_legend(ax, cells, narrow)
    return figure


def _draw_productivity(ax, results, cell, metric):
    """Draws the trials of a cell, their mean and its confidence ellipse."""
    x = np.array(list(results.values(cell, metric).values()))
    y = 100 * np.array(list(results.values(cell, "productivity").values()))
    colour = SENSING_COLOUR[cell.sensing]
    marker = MARKER[cell.configuration]
    ax.plot(
        x, y, marker, color=colour, alpha=0.35, markersize=4, markeredgewidth=0
    )
    ellipse = calc_confidence_ellipse(x, y)
    if ellipse is not None:
        for style in (
            {"facecolor": colour, "alpha": 0.10, "linewidth": 0},
            {"facecolor": "none", "edgecolor": colour, "linewidth": 0.9},
        ):
            ax.add_patch(
                EllipsePatch(
                    ellipse.centre,
                    2 * ellipse.half_axes[0],
                    2 * ellipse.half_axes[1],
                    angle=math.degrees(ellipse.angle),
                    **style,
                )
            )
    ax.plot(
        np.nanmean(x) if np.isfinite(x).any() else np.nan,
        np.nanmean(y) if np.isfinite(y).any() else np.nan,
        marker,
        color=colour,
        markersize=9,
        markeredgecolor=BLACK,
        markeredgewidth=0.8,
        zorder=5,
    )


def _add_cell_legend(ax, cells, narrow):
    """Adds a legend, configurations and sensings in a row or column each."""
    groups = [_configuration_handles(cells), _sensing_handles(cells)]
    size = max(len(group) for group in groups)
    blank = Line2D([], [], linestyle="none", label=" ")
    groups = [group + [blank] * (size - len(group)) for group in groups]
    if not narrow:
        # A legend is filled column by column.
        groups = [list(pair) for pair in zip(*groups, strict=True)]
    handles = [handle for group in groups for handle in group]
    add_legend(ax, handles, columns=max(2 if narrow else size, 1))


def _configuration_handles(cells):
    return [
        Line2D(
            [],
            [],
            marker=MARKER[c],
            color=GREY,
            markeredgecolor=BLACK,
            markersize=8,
            linestyle="none",
            label=CONFIGURATION_LABEL[c],
        )
        for c in find_configurations(cells)
    ]


def _sensing_handles(cells):
    return [
        Patch(color=SENSING_COLOUR[s], label=SENSINGS[s].label)
        for s in find_sensings(cells)
    ]
