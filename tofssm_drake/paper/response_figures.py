"""The paper's Fig. 11: how the tool speed answers the distance."""

import matplotlib
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from tofssm_drake.metrics.run_metrics import calc_nearest_distances
from tofssm_drake.paper.cell_style import (
    NARROW,
    SENSING_COLOUR,
    SENSING_TEXT,
    WIDE,
    find_configurations,
    find_sensings,
    find_window,
)
from tofssm_drake.paper.cells import Cell
from tofssm_drake.recording.samples import Samples
from tofssm_drake.reports.figures import GREY, ORANGE, STYLE, thin


def make_response_figure(
    samples: dict[Cell, Samples], *, narrow: bool = False
) -> Figure:
    """Draws Fig. 11 as time series: tool speed and measured distance.

    Args:
        samples: One run each of the cells to show; in the wide figure the
            columns are sensings and the rows configurations.
        narrow: For a phone: one below the other.
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = _make_grid(samples, narrow, height=1.75)
        for cell, ax in axes.items():
            _draw_response(ax, cell, samples[cell], narrow)
        if axes:
            figure.legend(
                handles=[
                    Patch(color=ORANGE, alpha=0.45, label="tool speed"),
                    Line2D([], [], color=GREY, label="measured distance"),
                ],
                loc="outside upper left",
                ncols=2,
            )
    return figure


def _draw_response(ax, cell, run, narrow):
    rows = find_window(run)
    t = run["t"][rows]
    centre, _ = calc_nearest_distances(run)
    centre = np.where(np.isfinite(centre), centre, np.nan)[rows]
    time, _, _, speed = thin(t, run["tcp_speed"][rows], 500)
    ax.fill_between(time, 0, speed, color=ORANGE, alpha=0.45, linewidth=0)
    ax.set_ylim(0, 1.8)
    ax.set_title(cell.label, color=SENSING_TEXT[cell.sensing])
    twin = ax.twinx()
    time, distance, _, _ = thin(t, centre, 700)
    colour = SENSING_COLOUR[cell.sensing]
    twin.plot(time, distance, color=colour, linewidth=1.2)
    twin.set_ylim(0, 2.4)
    twin.grid(False)
    twin.spines["right"].set_visible(True)
    if len(t) > 1:
        ax.set_xlim(t[0], t[-1])
    ax.set_ylabel("tool (m/s)" if _is_left(ax) or narrow else "")
    right = narrow or _is_right(ax)
    twin.set_ylabel("distance (m)" if right else "")
    if not right:
        twin.tick_params(labelright=False)
    if narrow or _is_bottom(ax):
        ax.set_xlabel("time (s)")


def make_phase_figure(
    samples: dict[Cell, Samples], *, narrow: bool = False
) -> Figure:
    """Draws Fig. 11 as phase plots: share of time by distance and speed.

    Args:
        samples: As for `make_response_figure`.
        narrow: For a phone.
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = _make_grid(samples, narrow, height=2.1, share=True)
        image = None
        for cell, ax in axes.items():
            run = samples[cell]
            centre, _ = calc_nearest_distances(run)
            known = np.isfinite(centre)
            speed = run["tcp_speed"]
            counts, x, y = np.histogram2d(
                centre[known],
                speed[known],
                bins=(48, 36),
                range=((0.0, 2.4), (0.0, 1.8)),
            )
            share = 100 * counts.T / max(len(speed), 1)
            image = ax.pcolormesh(
                x,
                y,
                np.where(share > 0, share, np.nan),
                cmap="cividis_r",
                norm=LogNorm(0.005, 5.0),
                rasterized=True,
            )
            ax.set_title(cell.label, color=SENSING_TEXT[cell.sensing])
            if narrow or _is_left(ax):
                ax.set_ylabel("tool (m/s)")
            if narrow or _is_bottom(ax):
                ax.set_xlabel("measured distance (m)")
        if image is not None:
            bar = figure.colorbar(
                image,
                ax=list(axes.values()),
                location="bottom",
                shrink=0.6 if not narrow else 1.0,
                aspect=40,
                pad=0.01,
            )
            bar.set_label("share of the run's time (%)")
            bar.outline.set_visible(False)
    return figure


def _make_grid(samples, narrow, *, height, share=False):
    """Returns a figure and its axes by cell."""
    cells = list(samples)
    sensings = find_sensings(cells)
    configurations = find_configurations(cells)
    if narrow:
        figure = Figure(
            figsize=(NARROW, height * max(len(cells), 1) + 0.8),
            layout="constrained",
        )
        column = figure.subplots(max(len(cells), 1), 1, squeeze=False)[:, 0]
        return figure, dict(zip(cells, column, strict=False))
    figure = Figure(
        figsize=(WIDE, height * max(len(configurations), 1) + 0.9),
        layout="constrained",
    )
    grid = figure.subplots(
        max(len(configurations), 1),
        max(len(sensings), 1),
        squeeze=False,
        sharex=share,
        sharey=True,
    )
    axes = {}
    for i, c in enumerate(configurations):
        for j, s in enumerate(sensings):
            cell = Cell(sensing=s, configuration=c)
            if cell in samples:
                axes[cell] = grid[i, j]
            else:
                grid[i, j].set_axis_off()
    return figure, axes


def _is_left(ax):
    return ax.get_subplotspec().is_first_col()


def _is_right(ax):
    return ax.get_subplotspec().is_last_col()


def _is_bottom(ax):
    return ax.get_subplotspec().is_last_row()
