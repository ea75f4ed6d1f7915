"""The paper's Fig. 12: reaction, stops and separations."""

import math

import matplotlib
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
import numpy as np

from tofssm_drake.paper.cell_style import NARROW, SENSING_TEXT, WIDE, list_plain
from tofssm_drake.paper.results import Results
from tofssm_drake.reports.figures import BLACK, GREY, ORANGE, STYLE

RADARS = (
    ("Reaction time (s)", (("reaction_time_s", "reaction"),)),
    (
        "Time to stop and to reduce (s)",
        (("time_to_stop_s", "stop"), ("time_to_reduce_s", "reduce")),
    ),
    (
        "Tool speed at a stop event (m/s)",
        (("velocity_change_at_stop_mps", "stop"),),
    ),
    (
        "Separation at events (m)",
        (
            ("separation_at_stop_m", "stop"),
            ("separation_at_reduce_m", "reduce"),
        ),
    ),
)
"""The four radars of Fig. 12: title, and (metric, label) of their curves."""


def make_radar_figure(results: Results, *, narrow: bool = False) -> Figure:
    """Draws Fig. 12: four radars over the cells.

    Values below 0 lie inside the zero line, which is drawn bold. Areas on a
    radar mean nothing: read the table beside it.

    Args:
        results: Of the campaign.
        narrow: For a phone.
    """
    cells = list_plain(results)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(NARROW, 15.0) if narrow else (WIDE, 9.6),
            # A browser's letters are wider than those measured here.
            layout=ConstrainedLayoutEngine(w_pad=0.2),
        )
        shape = (4, 1) if narrow else (2, 2)
        axes = figure.subplots(
            *shape, squeeze=False, subplot_kw={"projection": "polar"}
        )
        for ax, (title, curves) in zip(axes.ravel(), RADARS, strict=True):
            _draw_radar(ax, results, cells, title, curves)
    return figure


def _draw_radar(ax, results, cells, title, curves):
    angle = 2 * np.pi * np.arange(len(cells)) / max(len(cells), 1)
    low, high = 0.0, 0.0
    for (metric, label), style in zip(
        curves,
        (
            {"color": BLACK, "linestyle": "-", "marker": "o"},
            {"color": ORANGE, "linestyle": (0, (4, 2)), "marker": "D"},
        ),
        strict=False,
    ):
        estimates = [results.estimate(cell, metric) for cell in cells]
        mean = np.array([e.mean for e in estimates])
        half = np.nan_to_num([e.half_width for e in estimates])
        _draw_radar_curve(ax, angle, mean, half, style, label)
        if np.isfinite(mean).any():
            low = min(low, float(np.nanmin(mean - half)))
            high = max(high, float(np.nanmax(mean + half)))
    span = max(high - low, 1e-3)
    ax.set_rlim(low - 0.12 * span, high + 0.06 * span)
    _label_radar(ax, angle, cells)
    ax.set_title(title, loc="center", pad=18)
    if len(curves) > 1:
        ax.legend(
            loc="upper left", bbox_to_anchor=(-0.3, 1.16), handlelength=2.4
        )


def _draw_radar_curve(ax, angle, mean, half, style, label):
    line = style | {"marker": None, "linewidth": 1.2, "label": label}
    ax.plot(np.append(angle, angle[:1]), np.append(mean, mean[:1]), **line)
    points = style | {"linestyle": "none", "markersize": 4}
    ax.plot(angle, mean, **points)
    for a, m, h in zip(angle, mean, half, strict=True):
        ax.plot(
            [a, a],
            [m - h, m + h],
            color=style["color"],
            linewidth=2.2,
            alpha=0.4,
        )


def _label_radar(ax, angle, cells):
    """Draws the zero line and writes a cell at each spoke."""
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_rlabel_position(180 / max(len(cells), 1))
    turn = np.linspace(0, 2 * np.pi, 181)
    ax.plot(turn, np.zeros_like(turn), color=GREY, linewidth=1.4, zorder=1)
    ax.set_xticks(angle, [cell.label for cell in cells])
    for tick, cell, a in zip(ax.get_xticklabels(), cells, angle, strict=True):
        tick.set_color(SENSING_TEXT[cell.sensing])
        side = round(math.sin(a), 6)
        tick.set_horizontalalignment(
            "center" if not side else "left" if side > 0 else "right"
        )
    ax.tick_params(axis="x", pad=2)
    ax.tick_params(axis="y", labelsize=7.5)
