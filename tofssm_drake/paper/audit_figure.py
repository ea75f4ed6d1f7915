"""What the standards ask, against what the law keeps."""

import math
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from tofssm_drake.paper.cell_style import (
    NARROW,
    SENSING_COLOUR,
    SENSING_TEXT,
    WIDE,
    list_plain,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.reports.figures import BLACK, BLUE, GREY, STYLE, add_legend


def make_audit_figure(results: Results, *, narrow: bool = False) -> Figure:
    """Draws by how much the law keeps less distance than ISO/TS 15066 asks.

    Args:
        results: Of the campaign.
        narrow: For a phone.
    """
    cells = list_plain(results)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(
                NARROW if narrow else WIDE,
                0.36 * max(len(cells), 1) + 1.5,
            ),
            layout="constrained",
        )
        ax = figure.subplots()
        for i, cell in enumerate(cells):
            _draw_shortfalls(ax, i, results, cell)
        ax.axvline(0.0, color=BLACK, linewidth=1.2)
        ax.set_yticks(range(len(cells)), [cell.label for cell in cells])
        ax.set_ylim(len(cells) - 0.4, -0.6)
        for tick, cell in zip(ax.get_yticklabels(), cells, strict=True):
            tick.set_color(SENSING_TEXT[cell.sensing])
        ax.grid(axis="y", visible=False)
        ax.set_xlabel(
            "shortfall $S_p - d_C$ (m)"
            if narrow
            else "shortfall $S_p - d_C$ (m): right of 0 the law keeps less "
            "than the standard asks"
        )
        _add_shortfall_legend(ax, columns=1 if narrow else 3)
    return figure


def _add_shortfall_legend(ax, columns):
    stroke: dict[str, Any] = {
        "marker": "|",
        "markersize": 9,
        "markeredgewidth": 2,
    }
    handles = [
        Patch(color=BLUE, alpha=0.45, label="walking in at 1.6 m/s"),
        Patch(color=GREY, alpha=0.45, label="as Vo monitored it"),
        Patch(
            facecolor="none",
            edgecolor=GREY,
            label="the same, links that measure",
        ),
        Line2D(
            [],
            [],
            color=BLACK,
            linestyle="none",
            label="median; bar: 5 % to 95 % of the time",
            **stroke,
        ),
        Line2D(
            [],
            [],
            color=BLACK,
            marker=">",
            linestyle="none",
            label="worst tick of all trials",
        ),
    ]
    add_legend(ax, handles, columns=columns)


def _draw_shortfalls(ax, i, results, cell):
    """Draws the shortfalls of a cell in row i."""
    colour = SENSING_COLOUR[cell.sensing]
    _draw_shortfall(ax, i - 0.1, results, cell, "walking_in", colour)
    if cell.configuration == "vo":
        _draw_shortfall(ax, i + 0.18, results, cell, "as_reckoned", GREY)
        _draw_shortfall(
            ax, i + 0.38, results, cell, "measuring", GREY, is_outline=True
        )


def _draw_shortfall(ax, y, results, cell, name, colour, *, is_outline=False):
    low, middle, high = (
        results.estimate(cell, f"shortfall_{name}_p{q}_m").mean
        for q in ("05", "50", "95")
    )
    worst = results.values(cell, f"shortfall_{name}_max_m").values()
    if not math.isfinite(middle):
        return
    style = (
        {"facecolor": "none", "edgecolor": colour}
        if is_outline
        else {"color": colour, "alpha": 0.45}
    )
    height = 0.16 if cell.configuration == "vo" else 0.28
    ax.barh(y, max(high - low, 0.004), height, left=low, **style)
    ax.plot(
        middle,
        y,
        "|",
        color=BLACK,
        markersize=9,
        markeredgewidth=2,
    )
    ax.plot(np.nanmax(list(worst)), y, ">", color=colour, markersize=5)
