"""The paper's figures 9 to 12, from a campaign's results and samples.

Colour (Okabe and Ito's) and hatching show the sensing, marker and line the
configuration, so that neither depends on seeing colours. Every figure comes in
two widths: wide, and narrow for a phone.
"""

import math
from typing import Any

import matplotlib
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse as EllipsePatch
from matplotlib.patches import Patch
import numpy as np

from tofssm_drake.metrics.run_metrics import calc_nearest_distances
from tofssm_drake.paper.campaign import Cell
from tofssm_drake.paper.claims import SAFETY
from tofssm_drake.paper.results import Results
from tofssm_drake.recording.samples import Samples
from tofssm_drake.reports.figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    STYLE,
    VERMILLION,
    add_legend,
    thin,
)
from tofssm_drake.studies.statistics import calc_confidence_ellipse

SENSING_COLOUR = {
    "tof": BLUE,
    "ideal": GREEN,
    "lidar": VERMILLION,
    "tof16": PURPLE,
}
SENSING_TEXT = {
    "tof": BLUE,
    "ideal": "#00795A",
    "lidar": "#A84700",
    "tof16": "#95466F",
}
"""The same, dark enough for letters on white paper."""
SENSING_NAME = {
    "tof": "Real (8 sensors per ring)",
    "ideal": "Ideal",
    "lidar": "Lidar",
    "tof16": "Real-16",
}
_SHORT_NAME = SENSING_NAME | {"tof": "Real"}
_HATCH = {"tof": "////", "ideal": "", "lidar": "xxxx", "tof16": "...."}
CONFIGURATION_NAME = {"vo": "Vo", "vr": "Vr", "sm": "SM"}
_MARKER = {"vo": "o", "vr": "^", "sm": "s"}

PAPER_RMSE = {"ideal": 0.009, "tof": 0.063, "lidar": 0.128}
"""Errors that the paper reports, m."""

_WIDE, _NARROW = 10.6, 4.3
SPAN = 30.0
"""Length of the part of a run that is shown where all is too dense, s."""


def _find_sensings(cells):
    return list(dict.fromkeys(cell.sensing for cell in cells))


def _find_configurations(cells):
    known = {cell.configuration for cell in cells}
    return [c for c in CONFIGURATION_NAME if c in known]


def _list_plain(results):
    return [cell for cell in results.cells if not cell.variant]


def find_window(samples: Samples, span: float = SPAN) -> slice:
    """Finds the stretch of a run in which the person is nearest on average.

    Args:
        samples: The run.
        span: Length of the stretch, s.

    Returns:
        Its rows; all of them if the run is shorter.
    """
    t = samples["t"]
    rows = int(np.searchsorted(t, t[0] + span)) if len(t) else 0
    if rows >= len(t):
        return slice(0, len(t))
    distance = np.clip(samples["true_distance"], 0.0, 3.0)
    total = np.concatenate([[0.0], np.cumsum(distance)])
    start = int(np.argmin(total[rows:] - total[:-rows]))
    return slice(start, start + rows)


def make_distance_figure(
    results: Results, samples: dict[Cell, Samples], *, narrow: bool = False
) -> Figure:
    """Draws Fig. 9: distances against the ground truth, and their errors.

    Args:
        results: Of the campaign.
        samples: One run each of the cells to show over time.
        narrow: For a phone.
    """
    sensings = _find_sensings(_list_plain(results))
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(_NARROW, 2.1 * len(samples) + 3.4)
            if narrow
            else (_WIDE, 1.75 * len(samples) + 3.0),
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
        for cell in _list_plain(results):
            if cell.sensing != sensing:
                continue
            for metric in _ERROR_METRICS:
                if results.estimate(cell, metric).count:
                    _draw_error_bar(ax, x, results, cell, metric, rng)
                    x += _BAR
            ticks.append(x - 1.5 * _BAR)
            names.append(CONFIGURATION_NAME[cell.configuration])
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
        hatch=_HATCH[cell.sensing] if shade == 1.0 else None,
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
        _SHORT_NAME[sensing],
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
    cells = _list_plain(results)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(_NARROW, 5.4) if narrow else (8.6, 5.6),
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
    marker = _MARKER[cell.configuration]
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
            marker=_MARKER[c],
            color=GREY,
            markeredgecolor=BLACK,
            markersize=8,
            linestyle="none",
            label=CONFIGURATION_NAME[c],
        )
        for c in _find_configurations(cells)
    ]


def _sensing_handles(cells):
    return [
        Patch(color=SENSING_COLOUR[s], label=_SHORT_NAME[s])
        for s in _find_sensings(cells)
    ]


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
    sensings = _find_sensings(cells)
    configurations = _find_configurations(cells)
    if narrow:
        figure = Figure(
            figsize=(_NARROW, height * max(len(cells), 1) + 0.8),
            layout="constrained",
        )
        column = figure.subplots(max(len(cells), 1), 1, squeeze=False)[:, 0]
        return figure, dict(zip(cells, column, strict=False))
    figure = Figure(
        figsize=(_WIDE, height * max(len(configurations), 1) + 0.9),
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
    cells = _list_plain(results)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(_NARROW, 15.0) if narrow else (_WIDE, 9.6),
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


def make_audit_figure(results: Results, *, narrow: bool = False) -> Figure:
    """Draws by how much the law keeps less distance than ISO/TS 15066 asks.

    Args:
        results: Of the campaign.
        narrow: For a phone.
    """
    cells = _list_plain(results)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(
                _NARROW if narrow else _WIDE,
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
