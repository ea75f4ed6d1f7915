"""Figures of a run, from its samples.

Colours are Okabe and Ito's, which people with the usual colour deficiencies
can distinguish. Hatching and a step line of its own also show the robot
state, so that it survives a grey print. Every figure comes in two widths:
wide, and narrow for a phone.
"""

import base64
import io
from typing import Any

import matplotlib
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path
import numpy as np

from tofssm_drake.messages import Reading, RobotState
from tofssm_drake.metrics.metrics import StateEvent, find_contacts
from tofssm_drake.recording.samples import Samples
from tofssm_drake.recording.spans import find_spans

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILLION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#8A8F98"

STATE_COLOUR = {
    RobotState.STOP: VERMILLION,
    RobotState.REDUCED: ORANGE,
    RobotState.NORMAL: GREEN,
}
STATE_NAME = {
    RobotState.STOP: "stopped",
    RobotState.REDUCED: "reduced",
    RobotState.NORMAL: "normal",
}
# Tint, hatching and its colour. Opaque, so that the hatching stays crisp.
_SHADE = {
    RobotState.STOP: ("#F9DDCB", "////", "#E2935C"),
    RobotState.REDUCED: ("#FCEFD0", None, "#FCEFD0"),
}

STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "tofssm",
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": "#5A6069",
    "axes.labelcolor": "#1F2328",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E3E6EA",
    "grid.linewidth": 0.6,
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.3,
    "xtick.color": "#3B4048",
    "ytick.color": "#3B4048",
    "path.simplify_threshold": 0.3,
}


def to_svg(figure: Figure) -> str:
    """Returns the figure as SVG text, the same for the same figure."""
    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    # A browser's sans-serif is the fallback where DejaVu is not installed.
    return buffer.getvalue().replace(
        "'DejaVu Sans'", "'DejaVu Sans', Verdana, Arial, sans-serif"
    )


def to_png(figure: Figure, *, dpi: int = 200) -> bytes:
    """Returns the figure as a PNG file's content."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def to_data_uri(figure: Figure) -> str:
    """Returns the figure as a data URI that an <img> can show."""
    return encode_svg(to_svg(figure))


def encode_svg(svg: str) -> str:
    """Returns SVG text as a data URI."""
    data = base64.b64encode(svg.encode()).decode()
    return f"data:image/svg+xml;base64,{data}"


def find_deciding_ring(samples: Samples) -> np.ndarray:
    """Returns the index of the ring that decides at each tick, (k,).

    The ring with the lowest known state; among equals the one whose measured
    distance is nearest to its stop distance, or least far beyond it; among
    rings that see nothing, the one with the longest stop distance. A law
    without stop distances counts as one of 0 m.
    """
    state = samples.ring("state").astype(float)
    state[state < 0] = float(max(RobotState))
    measured = samples.ring("measured_distance")
    stop = samples.find_bound("stop")
    stop_distance = 0.0
    if stop:
        stop_distance = np.nan_to_num(samples.ring(stop), posinf=1e3)
    # Far beyond any range, so that what sees something comes first.
    margin = np.where(np.isfinite(measured), measured, 1e4) - stop_distance
    return np.argmin(state * 1e6 + margin, axis=1)


def pick(samples: Samples, name: str, ring: np.ndarray) -> np.ndarray:
    """Returns column `name` of the given ring at each tick, (k,)."""
    return np.take_along_axis(
        samples.ring(name), np.asarray(ring)[:, None], axis=1
    )[:, 0]


_WATCHER = {
    "rings": "the rings",
    "motion capture": "motion capture",
    "planar lidar": "the lidar",
    "mixed": "the sensors",
}
_NOUN = {"rings": "ring", "motion capture": "link"}
# What follows a link's name where there are sensors of several kinds.
_SUFFIX = {
    "rings": " ring",
    "motion capture": " (motion capture)",
    "planar lidar": " (planar lidar)",
}


def get_watcher(samples: Samples) -> str:
    """Returns what watched the person, in words."""
    return _WATCHER[samples.metadata.get("sensing", "rings")]


def name_link(samples: Samples, link: str) -> str:
    """Returns the name of one of the watched links, e.g. "base ring"."""
    sensing = samples.metadata.get("sensing", "rings")
    if sensing == "mixed":
        kind = samples.metadata.get("link_kinds", {}).get(link, "")
        return link + _SUFFIX.get(kind, "")
    return f"{link} {_NOUN.get(sensing, '')}".strip()


def _finite(values):
    return np.where(np.isfinite(values), values, np.nan)


def _add_boxes(ax, spans, height, **style):
    """Draws boxes from the floor of the axes as one path, to stay small."""
    if not spans:
        return
    a, b = np.array(spans).T
    x = np.stack([a, a, b, b, a], axis=1)
    y = np.tile([0.0, height, height, 0.0, 0.0], (len(a), 1))
    codes = [Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY]
    path = Path(
        np.stack([x.ravel(), y.ravel()], axis=1), np.tile(codes, len(a))
    )
    ax.add_patch(
        PathPatch(
            path, transform=ax.get_xaxis_transform(), linewidth=0, **style
        )
    )


def _find_state_spans(samples):
    spans = find_spans(samples["t"], thin_states(samples["robot_state"]))
    return {
        state: [(a, b) for a, b, value in spans if value == state]
        for state in RobotState
    }


def thin_states(state: np.ndarray) -> np.ndarray:
    """Returns states of which no more can be told apart in a picture.

    Args:
        state: Of each sample, (n,).

    Returns:
        The same; of more samples than pixels the lowest state of those that
        share one, (n,).
    """
    if len(state) <= _MOST_STATES:
        return state
    edges = np.linspace(0, len(state), _MOST_STATES + 1).astype(int)
    lowest = np.minimum.reduceat(state, edges[:-1])
    return np.repeat(lowest, np.diff(edges))


def _shade(ax, samples):
    """Shades the axes where the robot is stopped or reduced."""
    spans = _find_state_spans(samples)
    for state, (tint, hatch, line) in _SHADE.items():
        _add_boxes(
            ax,
            spans[state],
            1.0,
            facecolor=tint,
            edgecolor=line,
            hatch=hatch,
            zorder=0,
        )


def _state_handles():
    return [
        Patch(
            facecolor=tint,
            edgecolor=line,
            hatch=hatch,
            linewidth=0,
            label=STATE_NAME[state],
        )
        for state, (tint, hatch, line) in _SHADE.items()
    ]


def _mark_contacts(axes, contacts):
    for ax in axes:
        for contact in contacts:
            ax.axvline(contact.time, color=PURPLE, linewidth=1.4, zorder=4)


def add_legend(ax, handles=None, columns=4):
    """Puts a legend above the axes, left, in that many columns."""
    options = {} if handles is None else {"handles": handles}
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=columns,
        borderaxespad=0.1,
        handlelength=2.2,
        columnspacing=1.4,
        **options,
    )


_MOST_ROWS = 4
# Twice as many as `_count_buckets`.
_MOST_STATES = 840
_BOUND = {"slow": ORANGE, "stop": VERMILLION}


def _draw_bounds(ax, samples, get, narrow):
    """Draws the distances at which the law slows and stops the robot.

    Args:
        ax: Where.
        samples: The run.
        get: Returns a signal's values by name, (k,).
        narrow: See `make_timeline`.

    Returns:
        The values of that at which it slows, m, (k,); NaN: there is none.
    """
    slowest = np.full(len(samples), np.nan)
    for bound, colour in _BOUND.items():
        name = samples.find_bound(bound)
        if name:
            values = _finite(get(name))
            label = f"{bound} below {_to_symbol(name)}"
            _draw_band(ax, samples["t"], values, colour, label, narrow)
            if bound == "slow":
                slowest = values
    return slowest


def _to_symbol(name):
    """Returns a signal's name as Matplotlib shows it: x_y with an index."""
    symbol, underscore, index = name.partition("_")
    if len(symbol) == 1 and underscore and "_" not in index:
        return f"${symbol}_{{{index}}}$" if len(index) > 1 else f"${name}$"
    return name


def _limit_distance(*series):
    """Returns an upper limit for a distance axis that shows what matters."""
    top = [np.nanmax(s) for s in series if np.isfinite(s).any()]
    return float(np.clip(max(top, default=1.5) * 1.05, 1.5, 3.2))


def thin(
    t: np.ndarray, y: np.ndarray, buckets: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns a signal's range and median over groups of samples.

    Args:
        t: Times, s, (k,).
        y: Values, NaN where there is none, (k,).
        buckets: Greatest number of groups of neighbouring samples.

    Returns:
        (time, least, median, greatest), (b,) each: the middle of each group
        and its values'; NaN where all of them are. If k is at most `buckets`,
        the signal itself, three times.
    """
    if len(t) <= buckets:
        return t, y, y, y
    edges = np.linspace(0, len(t), buckets + 1).astype(int)
    groups = np.add.reduceat(np.ones(len(t)), edges[:-1])
    least = np.fmin.reduceat(y, edges[:-1])
    greatest = np.fmax.reduceat(y, edges[:-1])
    time = np.add.reduceat(t, edges[:-1]) / groups
    median = np.array(
        [
            np.nan if np.isnan(part).all() else np.nanmedian(part)
            for part in np.split(y, edges[1:-1])
        ]
    )
    return time, least, median, greatest


def _count_buckets(narrow):
    return 170 if narrow else 420


def _draw_band(ax, t, y, colour, label, narrow):
    """Draws a noisy signal: its median, on the range that it covers."""
    time, least, median, greatest = thin(t, y, _count_buckets(narrow))
    if time is t:
        ax.plot(
            t,
            y,
            color=colour,
            linewidth=1.0,
            drawstyle="steps-post",
            label=label,
        )
        return
    ax.fill_between(
        time, least, greatest, color=colour, alpha=0.22, linewidth=0
    )
    ax.plot(time, median, color=colour, linewidth=0.9, label=label)


def _draw_least(ax, t, y, narrow, **style):
    """Draws a distance, as the least of the samples that share a pixel."""
    time, least, _, _ = thin(t, y, 2 * _count_buckets(narrow))
    drawstyle = "steps-post" if time is t else "default"
    ax.plot(time, least, drawstyle=drawstyle, **style)


def _draw_true(ax, t, true, narrow, **style):
    """Draws the true distance, if known: with real people it is not."""
    if np.isfinite(true).any():
        style |= {"color": BLACK, "linestyle": (0, (5, 1.5))}
        _draw_least(ax, t, true, narrow, **style)


def _is_close(samples):
    """Returns whether the time shown is short enough to see every sample."""
    return len(samples) <= _count_buckets(True) * 5


def make_timeline(samples: Samples, *, narrow: bool = False) -> Figure:
    """Draws state, tool speed and the deciding ring's distance over time.

    A long run is broken into rows of at most a minute, a very long one into
    four longer ones.
    """
    t = samples["t"]
    rows = min(max(int(np.ceil((t[-1] - t[0]) / 60.0)), 1), _MOST_ROWS)
    edges = np.linspace(t[0], max(t[-1], t[0] + 1e-3), rows + 1)
    columns = 2 if narrow else 4
    contacts = find_contacts(samples)
    top = None
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(
                (4.3, 1.8 + 5.0 * rows) if narrow else (10.6, 1.3 + 4.6 * rows)
            ),
            layout="constrained",
        )
        all_axes = figure.subplots(
            3 * rows, 1, height_ratios=[0.5, 1.3, 2.4] * rows
        )
        for row in range(rows):
            axes = all_axes[3 * row : 3 * row + 3]
            part = _cut(samples, edges[row], edges[row + 1])
            shown = columns if not row else 0
            _draw_state(axes[0], part)
            _draw_speed(axes[1], part, shown, narrow)
            top = _draw_distance(
                axes[2], part, shown, narrow, top, bool(contacts)
            )
            _mark_contacts(axes, contacts)
            for ax in axes:
                ax.set_xlim(edges[row], edges[row + 1])
            for ax in axes[:2]:
                ax.tick_params(labelbottom=False)
        all_axes[-1].set_xlabel("time (s)")
    return figure


def _cut(samples, start, end):
    rows = (samples["t"] >= start - 1e-9) & (samples["t"] <= end + 1e-9)
    return Samples(
        column={name: values[rows] for name, values in samples.column.items()},
        metadata=samples.metadata,
    )


def make_closeup(
    samples: Samples,
    time: float,
    *,
    before: float = 1.5,
    after: float = 2.5,
    narrow: bool = False,
) -> Figure:
    """Draws the same as `make_timeline` around one instant, s."""
    part = _cut(samples, time - before, time + after)
    figure = make_timeline(part, narrow=narrow)
    for ax in figure.axes:
        ax.axvline(time, color=BLACK, linewidth=0.9, linestyle=(0, (1, 2)))
    return figure


def _draw_state(ax, samples):
    spans = _find_state_spans(samples)
    for state in RobotState:
        _add_boxes(
            ax,
            spans[state],
            (3 - state) / 3,
            facecolor=STATE_COLOUR[state],
            edgecolor="none",
        )
    ax.set_ylim(0, 1)
    ax.set_yticks([1 / 3, 2 / 3, 1], ["normal", "reduced", "stopped"])
    ax.grid(False)


def _draw_speed(ax, samples, columns, narrow):
    _shade(ax, samples)
    t = samples["t"]
    speed = samples["tcp_speed"]
    top = max(1.8, float(np.max(speed, initial=0)) * 1.05)
    ax.set_ylim(0, top)
    ax.set_ylabel("tool (m/s)")
    handles = [
        Line2D([], [], color=BLUE, label="tool speed"),
        *_state_handles(),
    ]
    if _is_close(samples):
        ax.plot(t, speed, color=BLUE)
        twin = ax.twinx()
        twin.spines["right"].set_visible(True)
        style: dict[str, Any] = {
            "color": BLACK,
            "linestyle": (0, (4, 2)),
            "linewidth": 1.0,
        }
        twin.plot(t, 100 * samples["speed_fraction"], **style)
        twin.set_ylim(0, 100 * top / 1.7)
        twin.set_yticks([0, 50, 100])
        twin.set_ylabel("speed fraction (%)")
        twin.grid(False)
        handles.insert(1, Line2D([], [], label="speed fraction", **style))
    else:
        time, _, _, greatest = thin(t, speed, 2 * _count_buckets(narrow))
        ax.fill_between(time, 0, greatest, color=BLUE, alpha=0.25, linewidth=0)
        ax.plot(time, greatest, color=BLUE, linewidth=0.9)
    if columns:
        add_legend(ax, handles, columns)


def _draw_distance(ax, samples, columns, narrow, top, touched):
    _shade(ax, samples)
    t = samples["t"]
    ring = find_deciding_ring(samples)
    measured = _finite(pick(samples, "measured_distance", ring))
    true = np.maximum(_finite(samples["true_distance"]), 0.0)
    slowest = _draw_bounds(
        ax, samples, lambda name: pick(samples, name, ring), narrow
    )
    _draw_least(
        ax,
        t,
        measured,
        narrow,
        color=BLUE,
        linewidth=1.6,
        label=f"measured by {get_watcher(samples)}",
    )
    _draw_true(
        ax,
        t,
        true,
        narrow,
        linewidth=1.1,
        label="true, surface to surface",
    )
    top = top or _limit_distance(slowest, measured)
    ax.set_ylim(0, top)
    ax.set_ylabel("distance (m)")
    if not columns:
        return top
    handles = ax.get_legend_handles_labels()[0]
    if touched:
        handles.append(
            Line2D([], [], color=PURPLE, label="contact while moving")
        )
    add_legend(ax, handles, columns)
    return top


def make_plan(samples: Samples, *, narrow: bool = False) -> Figure:
    """Draws the cell from above with the paths of tool, people, obstacles."""
    with matplotlib.rc_context(STYLE):
        size = (4.3, 5.4) if narrow else (7.4, 6.6)
        figure = Figure(figsize=size, layout="constrained")
        ax = figure.subplots()
        plan = samples.metadata.get("plan", {})
        _draw_outlines(ax, plan.get("outlines", []))
        handles = _draw_tool_path(ax, samples)
        handles += _draw_obstacles(ax, plan.get("obstacles", []))
        handles += _draw_people(ax, samples)
        _draw_places(ax, samples)
        _draw_robot_base(ax, plan.get("robot", [0.0, 0.0]))
        handles += _make_place_handles(samples)
        handles += _draw_closest(ax, samples)
        handles += _draw_contacts(ax, samples)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("x (m)")
        ax.set_ylabel("y (m)")
        # Names and obstacles make the entries longer.
        longer = bool(list_people(samples) or plan.get("obstacles"))
        if longer and narrow:
            figure.set_figheight(size[1] + 0.15 * len(handles))
        add_legend(ax, handles, columns=(2 if narrow else 3) - longer)
    return figure


def _draw_outlines(ax, outlines):
    """Draws what stands in the cell, with its name in the corner."""
    for item in outlines:
        outline = np.array(item["outline"])
        ax.add_patch(
            Polygon(
                outline,
                facecolor="#ECEEF1",
                edgecolor="#B4BAC2",
                linewidth=0.8,
                zorder=1,
            )
        )
        if item.get("label"):
            ax.annotate(
                item["label"],
                (outline[:, 0].min(), outline[:, 1].max()),
                xytext=(4, -4),
                textcoords="offset points",
                ha="left",
                va="top",
                fontsize=8,
                color="#5A6069",
                zorder=1.5,
            )


def _draw_tool_path(ax, samples):
    """Draws the path of the tool; returns its legend, as the next do."""
    style: dict[str, Any] = {"color": GREY, "linewidth": 1.2}
    ax.plot(samples["tcp_x"], samples["tcp_y"], zorder=2, **style)
    return [Line2D([], [], label="path of the tool", **style)]


def _draw_places(ax, samples):
    """Draws where the person was, by what the robot did then."""
    # The people's own lines are drawn over them.
    alpha = 0.4 if list_people(samples) else 1.0
    for state, (x, y) in find_place_states(samples).items():
        style = _PLACE[state] | {"color": STATE_COLOUR[state], "alpha": alpha}
        ax.plot(x, y, linestyle="none", zorder=3, **style)


def _draw_robot_base(ax, base):
    ax.plot(*base, marker="s", color=BLACK, markersize=9, zorder=5)
    ax.annotate(
        "robot base",
        base,
        xytext=(0, -9),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=8,
        zorder=6,
    )


def _draw_obstacles(ax, obstacles):
    """Draws the boxes that move: where they are at first, and their way."""
    handles = []
    for i, item in enumerate(obstacles):
        hatch = _HATCHES[i % len(_HATCHES)]
        style: dict[str, Any] = {
            "facecolor": "#E3E6EA",
            "edgecolor": "#3B4048",
            "hatch": hatch,
            "linewidth": 1.0,
        }
        ax.add_patch(Polygon(np.array(item["outline"]), zorder=2, **style))
        way = np.array(item["way"])
        ax.plot(*way.T, color="#3B4048", linestyle=(0, (1, 1.5)), zorder=2)
        what = "at first, dotted: its way" if len(way) > 1 else "stands still"
        handles.append(Patch(label=f"{item['label']}, {what}", **style))
    return handles


def list_people(samples: Samples) -> list[str]:
    """Returns the people who are told apart; empty: there is one, or none."""
    people = samples.metadata.get("people", [])
    return [name for name in people if f"place_of_{name}_x" in samples]


def _draw_people(ax, samples):
    """Draws where people walked, each of several with a line of their own."""
    people = list_people(samples)
    if not people:
        _draw_start(ax, samples["person_x"], samples["person_y"], "person")
        return []
    handles = []
    for i, name in enumerate(people):
        colour, marker = _PERSON[i % len(_PERSON)]
        x, y = (samples[f"place_of_{name}_{axis}"] for axis in "xy")
        style: dict[str, Any] = {
            "color": colour,
            "marker": marker,
            "markersize": 4.5,
            "linewidth": 1.2,
        }
        # Over the marks of the robot's state, which would hide it.
        ax.plot(x, y, color=colour, linewidth=1.2, zorder=4)
        rows = np.searchsorted(samples["t"], _MARK_TIMES)
        rows = rows[rows < len(x)]
        ax.plot(x[rows], y[rows], zorder=4, **style | {"linestyle": "none"})
        _draw_start(ax, x, y, name, marker=marker, color=colour)
        handles.append(Line2D([], [], label=name, **style))
    return handles


def _draw_start(ax, x, y, name, *, marker="o", color=BLACK):
    known = np.flatnonzero(np.isfinite(x))
    if not len(known):
        return
    start = (x[known[0]], y[known[0]])
    ax.plot(
        *start,
        marker,
        color=color,
        markeredgecolor=BLACK,
        markersize=5 if marker == "o" else 7,
        zorder=6,
    )
    ax.annotate(
        f"{name} starts",
        start,
        xytext=(6, 6),
        textcoords="offset points",
        fontsize=8,
        zorder=6,
    )


def _make_place_handles(samples):
    """Returns the legend of the marks of the robot's state."""
    if not np.isfinite(samples["person_x"]).any():
        return []
    who = "nearest person" if list_people(samples) else "person"
    return [
        Line2D(
            [],
            [],
            color=STATE_COLOUR[state],
            linestyle="none",
            label=f"{who}, robot {STATE_NAME[state]}",
            **_PLACE[state],
        )
        for state in reversed(RobotState)
    ]


def _draw_closest(ax, samples):
    """Draws where robot and person were closest."""
    distance = samples["true_distance"]
    if not np.isfinite(distance).any():
        return []
    i = int(np.argmin(distance))
    px, py = samples["person_point_x"][i], samples["person_point_y"][i]
    rx, ry = samples["robot_point_x"][i], samples["robot_point_y"][i]
    ax.plot([rx, px], [ry, py], color=BLACK, linewidth=1.2, zorder=6)
    style: dict[str, Any] = {
        "marker": "D",
        "color": "white",
        "markeredgecolor": BLACK,
        "linestyle": "none",
    }
    ax.plot((rx + px) / 2, (ry + py) / 2, markersize=6, zorder=7, **style)
    label = f"closest, t = {samples['t'][i]:.1f} s"
    return [Line2D([], [], label=label, **style)]


def _draw_contacts(ax, samples):
    contacts = find_contacts(samples)
    if not contacts:
        return []
    rows = np.searchsorted(samples["t"], [c.time for c in contacts])
    style: dict[str, Any] = {
        "marker": "X",
        "color": PURPLE,
        "markeredgecolor": BLACK,
        "linestyle": "none",
    }
    ax.plot(
        samples["robot_point_x"][rows],
        samples["robot_point_y"][rows],
        markersize=9,
        zorder=8,
        **style,
    )
    return [Line2D([], [], label="contact while moving", **style)]


# Of each of several people: colour and mark.
_PERSON = (
    (BLUE, "o"),
    (PURPLE, "^"),
    (SKY, "P"),
    (BLACK, "v"),
    (GREY, "*"),
    (BLUE, "<"),
)
# Once a second at first, s: later the marks would cover one another.
_MARK_TIMES = np.arange(0.5, 15.0)
_HATCHES = ("xxx", "///", "...", "---")

_PLACE: dict[RobotState, dict[str, Any]] = {
    RobotState.STOP: {"marker": "s", "markersize": 5.0},
    RobotState.REDUCED: {"marker": "D", "markersize": 3.4},
    RobotState.NORMAL: {"marker": "o", "markersize": 2.0},
}


def find_place_states(
    samples: Samples, *, cell: float = 0.05
) -> dict[RobotState, tuple[np.ndarray, np.ndarray]]:
    """Finds the robot's most frequent state wherever the person was.

    A person who walks the same path again and again would otherwise cover
    the trace of the first time with that of the last.

    Args:
        samples: The run.
        cell: Side of the squares into which the floor is divided, m.

    Returns:
        For each state the places (x, y), m, of the squares in which it was
        the most frequent: the person's mean position in them.
    """
    x, y = samples["person_x"], samples["person_y"]
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    state = samples["robot_state"][known]
    squares = np.stack([np.floor(x / cell), np.floor(y / cell)], axis=1)
    _, where = np.unique(squares, axis=0, return_inverse=True)
    where = where.ravel()
    count = np.zeros((where.max(initial=-1) + 1, len(RobotState)))
    np.add.at(count, (where, state), 1)
    total = count.sum(axis=1)
    mean_x = np.bincount(where, x, len(total)) / total
    mean_y = np.bincount(where, y, len(total)) / total
    most = np.argmax(count, axis=1)
    return {
        value: (mean_x[most == value], mean_y[most == value])
        for value in RobotState
    }


def make_rings(samples: Samples, *, narrow: bool = False) -> Figure:
    """Draws each ring's distance and every sensor's readings.

    For a sensing that records no scans, draws the links' distances only.
    """
    rings = samples.rings
    t = samples["t"]
    is_all_rings = samples.metadata.get("sensing", "rings") == "rings"
    has_scans = [is_all_rings or ring in samples.scan for ring in rings]
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=_size_rings(has_scans, narrow),
            layout=ConstrainedLayoutEngine(h_pad=0.02, hspace=0.0),
        )
        heights = [h for has in has_scans for h in [1.25, 1.0][: 1 + has]]
        axes = figure.subplots(
            len(heights), 1, sharex=True, height_ratios=heights, squeeze=False
        )[:, 0]
        image = None
        strips = iter(axes)
        for i, ring in enumerate(rings):
            columns = 0 if i else 2 if narrow else 4
            _draw_ring_distance(next(strips), samples, ring, columns, narrow)
            if has_scans[i]:
                image = _draw_readings(next(strips), samples, ring) or image
        axes[0].set_xlim(t[0], max(t[-1], t[0] + 1e-3))
        axes[-1].set_xlabel("time (s)")
        if image is not None:
            _add_reading_legend(figure, axes.tolist(), image)
        _mark_contacts(axes, find_contacts(samples))
    return figure


def _add_reading_legend(figure, axes, image):
    bar = figure.colorbar(
        image, ax=axes, location="bottom", shrink=0.5, aspect=36, pad=0.01
    )
    bar.set_label("distance read by a sensor (m)")
    bar.outline.set_visible(False)
    figure.legend(
        handles=[
            Patch(facecolor="white", edgecolor=GREY, label="clear"),
            Patch(
                facecolor="#C9CDD3",
                edgecolor="#6C727B",
                hatch="xxxx",
                linewidth=0,
                label="masked (robot or cell)",
            ),
            Patch(facecolor=BLACK, label="fault"),
        ],
        loc="outside lower center",
        ncols=3,
    )


def _size_rings(has_scans, narrow):
    """Returns width and height of links with and without a second strip."""
    if not any(has_scans):
        n = len(has_scans)
        return (4.3, 1.0 + 2.3 * n) if narrow else (10.6, 0.8 + 2.2 * n)
    heights = (2.0, 3.4) if narrow else (1.8, 3.1)
    return (4.3 if narrow else 10.6, sum(heights[has] for has in has_scans))


def _draw_ring_distance(ax, samples, ring, columns, narrow):
    t = samples["t"]
    _shade(ax, samples)
    true = _finite(samples[f"{ring}_true_distance"])
    measured = _finite(samples[f"{ring}_measured_distance"])
    slowest = _draw_bounds(
        ax, samples, lambda name: samples[f"{ring}_{name}"], narrow
    )
    _draw_true(
        ax,
        t,
        true,
        narrow,
        linewidth=1.0,
        label="true, from link centre"
        if samples.metadata.get("sensing") != "planar lidar"
        else f"true, from the {ring}",
    )
    _draw_least(
        ax, t, measured, narrow, color=BLUE, linewidth=1.6, label="measured"
    )
    ax.set_ylim(0, _limit_distance(measured, slowest))
    ax.set_ylabel("m")
    if columns:
        add_legend(ax, columns=columns)
    ax.set_title(name_link(samples, ring), pad={0: 6, 2: 34, 4: 20}[columns])


def find_drawn_signals(samples: Samples) -> list[str]:
    """Returns the names of the law's signals that have a strip of their own."""
    return [
        name
        for name, signal in samples.signals.items()
        if signal.is_drawn and not signal.bound
    ]


def make_signals(samples: Samples, *, narrow: bool = False) -> Figure:
    """Draws what the law says of each link: a strip for each of its signals."""
    names = find_drawn_signals(samples)
    t = samples["t"]
    colours = (BLUE, PURPLE, BLACK, SKY)
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(4.3 if narrow else 10.6, 0.8 + 2.2 * len(names)),
            layout="constrained",
        )
        axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for ax, name in zip(axes, names, strict=True):
            signal = samples.signals[name]
            _shade(ax, samples)
            for i, link in enumerate(samples.rings):
                values = _finite(samples[f"{link}_{name}"])
                _draw_band(
                    ax, t, values, colours[i % len(colours)], link, narrow
                )
            ax.set_ylabel(signal.unit or "1")
            ax.set_title(
                f"{name}: {signal.meaning}" if signal.meaning else name, pad=20
            )
        add_legend(axes[0], columns=2 if narrow else 4)
        axes[-1].set_xlim(t[0], max(t[-1], t[0] + 1e-3))
        axes[-1].set_xlabel("time (s)")
    return figure


def make_reading_image(
    time: np.ndarray, distance: np.ndarray, reading: np.ndarray, edges
) -> tuple[np.ndarray, np.ndarray]:
    """Resamples a ring's scans to the columns of an image.

    Args:
        time: Times of the k scans, s, ascending, (k,).
        distance: Readings, m, (k, n).
        reading: `Reading` of each, (k, n).
        edges: Borders of the image's c columns in time, s, (c + 1,).

    Returns:
        (distance, reading): (n, c) each. A column shows, per sensor, the
        nearest valid reading within its time; without one, the worst of the
        others (fault, masked, clear), or else the last scan before it; where
        there was none yet, the reading is -1.
    """
    n = reading.shape[1]
    columns = len(edges) - 1
    first = np.searchsorted(time, edges[:-1])
    last = np.searchsorted(time, edges[1:])
    out_distance = np.full((n, columns), np.nan)
    out_reading = np.full((n, columns), -1, dtype=int)
    rank = np.array([0, 3, 1, 2, 4])  # Clear, valid, masked, faulted, held.
    for c in range(columns):
        a, b = first[c], last[c]
        if a == b:
            if not a:
                continue
            a -= 1
        part = reading[a:b]
        row = np.argmax(rank[part], axis=0)
        out_reading[:, c] = part[row, np.arange(n)]
        is_near = (part == Reading.VALID) | (part == Reading.HELD)
        valid = np.where(is_near, distance[a:b], np.inf)
        nearest = valid.min(axis=0)
        out_distance[:, c] = np.where(np.isfinite(nearest), nearest, np.nan)
    return out_distance, out_reading


def _draw_readings(ax, samples, ring):
    """Draws a strip per sensor; returns the image for the colour bar."""
    scan = samples.scan.get(ring)
    ax.set_ylabel("sensor")
    ax.grid(False)
    if scan is None or not len(scan["time"]):
        ax.set_yticks([])
        ax.annotate(
            "no scans recorded",
            (0.5, 0.5),
            xycoords="axes fraction",
            ha="center",
            va="center",
        )
        return None
    t = samples["t"]
    n = scan["reading"].shape[1]
    edges = np.linspace(t[0], t[-1], min(1600, max(len(t) - 1, 1)) + 1)
    distance, reading = make_reading_image(
        scan["time"], scan["distance"], scan["reading"], edges
    )
    extent = (t[0], t[-1], n - 0.5, -0.5)
    # Grey with a weave of two tones looks hatched at any zoom.
    weave = (np.add.outer(2 * np.arange(n), np.arange(len(edges) - 1)) // 4) % 2
    kind = np.full(reading.shape, np.nan)
    kind[reading == Reading.MASKED] = weave[reading == Reading.MASKED]
    kind[reading == Reading.FAULTED] = 2
    kind[reading == -1] = 3
    ax.imshow(
        kind,
        extent=extent,
        aspect="auto",
        interpolation="nearest",
        cmap=ListedColormap(["#D5D8DD", "#AEB4BC", BLACK, "#F4E9F0"]),
        norm=Normalize(0, 3),
    )
    image = ax.imshow(
        distance,
        extent=extent,
        aspect="auto",
        interpolation="nearest",
        cmap="viridis",
        norm=Normalize(0, 1.4),
    )
    ax.set_yticks(range(0, n, 1 if n <= 8 else 2))
    ax.hlines(np.arange(n - 1) + 0.5, t[0], t[-1], color="white", linewidth=1)
    return image


def make_ring_diagram(
    *, beam_azimuth, fov, radius, azimuth, distance, label: str
) -> Figure:
    """Draws a ring along its axis: its beams, and where the person was."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(2.6, 2.6), layout="constrained")
        ax = figure.subplots()
        ax.set_axis_off()
        reach = max(0.55, 1.25 * distance)
        for j, phi in enumerate(beam_azimuth):
            origin = radius * np.array([np.cos(phi), np.sin(phi)])
            fan = phi + np.linspace(-fov / 2, fov / 2, 9)
            edge = origin + reach * np.stack([np.cos(fan), np.sin(fan)], 1)
            ax.add_patch(
                Polygon(
                    np.vstack([origin, edge]),
                    facecolor=SKY,
                    alpha=0.45,
                    linewidth=0,
                )
            )
            ax.annotate(
                str(j),
                1.08 * (reach + radius) * np.array([np.cos(phi), np.sin(phi)]),
                ha="center",
                va="center",
                fontsize=8,
                color="#3B4048",
            )
        turn = np.linspace(0, 2 * np.pi, 60)
        ax.fill(radius * np.cos(turn), radius * np.sin(turn), color="#5A6069")
        ax.plot(
            max(distance, 0) * np.cos(azimuth),
            max(distance, 0) * np.sin(azimuth),
            marker="X",
            color=PURPLE,
            markeredgecolor=BLACK,
            markersize=11,
        )
        limit = 1.16 * (reach + radius)
        ax.set_xlim(-limit, limit)
        ax.set_ylim(-limit, limit)
        ax.set_aspect("equal")
        ax.set_title(label, loc="center")
    return figure


def find_closeup(
    events: list[StateEvent], contacts: list
) -> tuple[float, str] | None:
    """Returns the instant most worth a closer look, and what it is.

    The fastest contact while moving; else the stop from the highest tool
    speed; else the first reduction; None if nothing happened.
    """
    if contacts:
        contact = max(contacts, key=lambda c: c.max_speed)
        return contact.time, f"the contact at {contact.time:.2f} s"
    stops = [e for e in events if e.kind == "stop"]
    if stops:
        stop = max(stops, key=lambda e: e.tcp_speed)
        return stop.time, f"the stop at {stop.time:.2f} s"
    reductions = [e for e in events if e.kind == "reduce"]
    if reductions:
        return (
            reductions[0].time,
            f"the reduction at {reductions[0].time:.2f} s",
        )
    return None
