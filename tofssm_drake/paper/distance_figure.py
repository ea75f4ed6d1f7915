"""The paper's Fig. 9: distances against the ground truth."""

import math
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from tofssm_drake.metrics.run_metrics import calc_nearest_distances
from tofssm_drake.paper.cell_style import (
    HATCH,
    NARROW,
    SENSING_COLOUR,
    SENSING_TEXT,
    WIDE,
    find_sensings,
    find_window,
    list_plain,
)
from tofssm_drake.paper.cells import CONFIGURATION_LABEL, SENSINGS, Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.recording.samples import Samples
from tofssm_drake.reports.figures import BLACK, GREY, STYLE, add_legend

PAPER_RMSE = {"ideal": 0.009, "tof": 0.063, "lidar": 0.128}
"""Errors that the paper reports, m."""


def make_distance_figure(
    results: Results, samples: dict[Cell, Samples], *, narrow: bool = False
) -> Figure:
    """Draws Fig. 9: distances against the ground truth, and their errors.

    Args:
        results: Of the campaign.
        samples: One run each of the cells to show over time.
        narrow: For a phone.
    """
    sensings = find_sensings(list_plain(results))
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(NARROW, 2.1 * len(samples) + 3.4)
            if narrow
            else (WIDE, 1.75 * len(samples) + 3.0),
            layout="constrained",
        )
        axes = figure.subplots(
            len(samples) + 1,
            1,
            height_ratios=[1.0] * len(samples) + [1.5],
            squeeze=False,
        )[:, 0]
        for i, (cell, run) in enumerate(samples.items()):
            _draw_distance(axes[i], cell, run, narrow, first=i == 0)
        if samples:
            axes[len(samples) - 1].set_xlabel("time (s)")
        _draw_errors(axes[-1], results, sensings, narrow)
    return figure


def _draw_distance(ax, cell, run, narrow, first):
    rows = find_window(run)
    t = run["t"][rows]
    true = np.maximum(run["true_distance"][rows], 0.0)
    _, surface = calc_nearest_distances(run)
    surface = np.where(np.isfinite(surface), surface, np.nan)[rows]
    colour = SENSING_COLOUR[cell.sensing]
    label = "measured, from surface to surface"
    ax.plot(t, surface, color=colour, linewidth=1.3, label=label)
    ax.plot(
        t,
        np.where(np.isfinite(true), true, np.nan),
        color=BLACK,
        linewidth=1.1,
        linestyle=(0, (5, 1.5)),
        label="true",
    )
    ax.set_ylim(0, 2.0)
    if len(t) > 1:
        ax.set_xlim(t[0], t[-1])
    ax.set_ylabel("m" if narrow else "distance (m)")
    ax.set_title(
        cell.label, color=SENSING_TEXT[cell.sensing], pad=20 if first else 6
    )
    if first:
        handles = [
            Line2D([], [], color=GREY, label=label),
            ax.get_lines()[1],
        ]
        add_legend(ax, handles, columns=2)
        ax.get_legend().set_loc("lower right")
        ax.get_legend().set_bbox_to_anchor((1, 1.0), ax.transAxes)


_BAR = 0.26
"""Width of a bar of errors."""
_PAPER_STYLE: dict[str, Any] = {
    "color": BLACK,
    "linestyle": (0, (1, 1.2)),
    "linewidth": 2.0,
}
_ERROR_METRICS = {
    "distance_rmse_centre_m": 0.35,
    "distance_rmse_surface_m": 1.0,
}
"""Opacity of the bars by metric."""


def _draw_errors(ax, results, sensings, narrow):
    """Draws bars of the errors by sensing and configuration."""
    rng = np.random.default_rng(0)
    ticks, names = [], []
    x = 0.0
    for sensing in sensings:
        start = x
        for cell in list_plain(results):
            if cell.sensing != sensing:
                continue
            for metric in _ERROR_METRICS:
                if results.estimate(cell, metric).count:
                    _draw_error_bar(ax, x, results, cell, metric, rng)
                    x += _BAR
            ticks.append(x - 1.5 * _BAR)
            names.append(CONFIGURATION_LABEL[cell.configuration])
            x += 0.5 * _BAR
        _label_sensing(ax, sensing, start, x)
        x += 1.2 * _BAR
    ax.set_xticks(ticks, names)
    ax.grid(axis="x", visible=False)
    ax.set_ylabel("RMSE (m)")
    ax.set_title("Error against the true distance", pad=34 if narrow else 20)
    _add_error_legend(ax, columns=2 if narrow else 4)


def _draw_error_bar(ax, x, results, cell, metric, rng):
    """Draws the mean, its interval and the trials of one metric."""
    value = results.estimate(cell, metric)
    shade = _ERROR_METRICS[metric]
    ax.bar(
        x,
        value.mean,
        _BAR,
        color=SENSING_COLOUR[cell.sensing],
        alpha=shade,
        hatch=HATCH[cell.sensing] if shade == 1.0 else None,
        edgecolor="white",
        linewidth=0,
    )
    if math.isfinite(value.half_width):
        ax.errorbar(
            x,
            value.mean,
            value.half_width,
            color=BLACK,
            linewidth=1.0,
            capsize=2.5,
        )
    points = np.array(list(results.values(cell, metric).values()))
    ax.plot(
        x + 0.25 * _BAR * rng.uniform(-1, 1, len(points)),
        points,
        "o",
        color=BLACK,
        markersize=2.0,
        alpha=0.6,
    )


def _label_sensing(ax, sensing, start, end):
    """Writes a sensing below its bars; draws the paper's error over them."""
    paper = PAPER_RMSE.get(sensing)
    if paper is not None:
        ax.hlines(paper, start - 0.6 * _BAR, end - _BAR, **_PAPER_STYLE)
    ax.annotate(
        SENSINGS[sensing].label,
        ((start + end - 1.5 * _BAR) / 2, 0),
        xycoords=("data", "axes fraction"),
        xytext=(0, -20),
        textcoords="offset points",
        ha="center",
        va="top",
        color=SENSING_TEXT[sensing],
        fontweight="bold",
    )


def _add_error_legend(ax, columns):
    trials = Line2D(
        [],
        [],
        color=BLACK,
        marker="o",
        markersize=2.5,
        linestyle="none",
        label="trials",
    )
    handles = [
        Patch(color=GREY, alpha=0.35, label="from the link's centre"),
        Patch(color=GREY, label="minus its radius"),
        Line2D([], [], label="paper", **_PAPER_STYLE),
        trials,
    ]
    add_legend(ax, handles, columns=columns)
