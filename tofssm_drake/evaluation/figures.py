"""Figures of a run, from its samples.

Colours are Okabe and Ito's, which people with the usual colour deficiencies
tell apart; the robot state is also told by hatching and by its own step line,
so that a grey print reads the same. Every figure comes in two widths: wide,
and narrow for a phone.
"""

import base64
import io

import matplotlib
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
import numpy as np

from tofssm_drake.evaluation.metrics import StateEvent, find_contacts
from tofssm_drake.evaluation.samples import Samples
from tofssm_drake.messages import Reading, RobotState

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
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

_STYLE = {
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
    with matplotlib.rc_context(_STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    # A browser's sans-serif is the fallback where DejaVu is not installed.
    return buffer.getvalue().replace(
        "'DejaVu Sans'", "'DejaVu Sans', Verdana, Arial, sans-serif"
    )


def to_data_uri(figure: Figure) -> str:
    """Returns the figure as a data URI that an <img> can show."""
    data = base64.b64encode(to_svg(figure).encode()).decode()
    return f"data:image/svg+xml;base64,{data}"


def find_spans(
    t: np.ndarray, values: np.ndarray
) -> list[tuple[float, float, int]]:
    """Returns where a stepwise signal is constant.

    Args:
        t: Times, s, (k,).
        values: Integers, (k,).

    Returns:
        (start, end, value) of each stretch, in order; the last ends at the
        last time.
    """
    if not len(t):
        return []
    change = np.flatnonzero(np.diff(values)) + 1
    first = np.concatenate(([0], change))
    last = np.append(change, len(t) - 1)
    return [
        (float(t[i]), float(t[j]), int(values[i]))
        for i, j in zip(first, last, strict=True)
    ]


def find_deciding_ring(samples: Samples) -> np.ndarray:
    """Returns the index of the ring that decides at each tick, (k,).

    The ring with the lowest state; among equals the one whose measured
    distance is nearest to its critical distance, or least far beyond it;
    among rings that see nothing, the one with the longest critical distance.
    """
    state = samples.ring("state").astype(float)
    measured = samples.ring("measured_distance")
    critical = np.nan_to_num(samples.ring("d_C"), posinf=1e3)
    # Far beyond any range, so that what sees something comes first.
    margin = np.where(np.isfinite(measured), measured, 1e4) - critical
    return np.argmin(state * 1e6 + margin, axis=1)


def pick(samples: Samples, name: str, ring: np.ndarray) -> np.ndarray:
    """Returns column `name` of the given ring at each tick, (k,)."""
    return np.take_along_axis(
        samples.ring(name), np.asarray(ring)[:, None], axis=1
    )[:, 0]


def _finite(values):
    return np.where(np.isfinite(values), values, np.nan)


def _shade(ax, samples):
    """Shades the axes where the robot is stopped or reduced."""
    spans = find_spans(samples["t"], samples["robot_state"])
    for state, (tint, hatch, line) in _SHADE.items():
        ranges = [(a, b - a) for a, b, value in spans if value == state]
        if ranges:
            ax.broken_barh(
                ranges,
                (0, 1),
                transform=ax.get_xaxis_transform(),
                facecolor=tint,
                edgecolor=line,
                hatch=hatch,
                linewidth=0,
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


def _legend(ax, handles=None, columns=4):
    options = {"handles": handles} if handles else {}
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=columns,
        borderaxespad=0.1,
        handlelength=2.2,
        columnspacing=1.4,
        **options,
    )


def _limit_distance(*series):
    """Returns a top for a distance axis that shows what matters."""
    top = [np.nanmax(s) for s in series if np.isfinite(s).any()]
    return float(np.clip(max(top, default=1.5) * 1.05, 1.5, 3.2))


def make_timeline(samples: Samples, *, narrow: bool = False) -> Figure:
    """State, tool speed and the deciding ring's distance over time."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(
            figsize=(4.3, 7.4) if narrow else (10.6, 6.6),
            layout="constrained",
        )
        axes = figure.subplots(
            3, 1, sharex=True, height_ratios=[0.55, 1.3, 2.2]
        )
        _draw_state(axes[0], samples)
        _draw_speed(axes[1], samples, columns=2 if narrow else 4)
        _draw_distance(axes[2], samples, columns=2 if narrow else 4)
        contacts = find_contacts(samples)
        _mark_contacts(axes, contacts)
        axes[2].set_xlabel("time (s)")
        t = samples["t"]
        axes[2].set_xlim(t[0], max(t[-1], t[0] + 1e-3))
    return figure


def make_closeup(
    samples: Samples,
    time: float,
    *,
    before: float = 1.5,
    after: float = 2.5,
    narrow: bool = False,
) -> Figure:
    """The same as `make_timeline` around one instant, s."""
    t = samples["t"]
    rows = (t >= time - before) & (t <= time + after)
    part = Samples(
        column={name: values[rows] for name, values in samples.column.items()},
        metadata=samples.metadata,
    )
    figure = make_timeline(part, narrow=narrow)
    for ax in figure.axes:
        ax.axvline(time, color=BLACK, linewidth=0.9, linestyle=(0, (1, 2)))
    return figure


def _draw_state(ax, samples):
    _shade(ax, samples)
    ax.step(
        samples["t"],
        samples["robot_state"],
        where="post",
        color=BLACK,
        linewidth=1.4,
    )
    ax.set_yticks([0, 1, 2], ["stopped", "reduced", "normal"])
    ax.set_ylim(-0.35, 2.35)
    ax.grid(axis="x")
    ax.set_title("Robot state")


def _draw_speed(ax, samples, columns):
    _shade(ax, samples)
    t = samples["t"]
    ax.plot(t, samples["tcp_speed"], color=BLUE, label="tool speed")
    top = max(1.8, float(np.max(samples["tcp_speed"], initial=0)) * 1.05)
    ax.set_ylim(0, top)
    ax.set_ylabel("tool speed (m/s)")
    twin = ax.twinx()
    twin.spines["right"].set_visible(True)
    twin.plot(
        t,
        100 * samples["speed_fraction"],
        color=BLACK,
        linestyle=(0, (4, 2)),
        linewidth=1.0,
    )
    twin.set_ylim(0, 100 * top / 1.7)
    twin.set_yticks([0, 50, 100])
    twin.set_ylabel("speed fraction (%)")
    twin.grid(False)
    handles = [
        Line2D([], [], color=BLUE, label="tool speed"),
        Line2D(
            [],
            [],
            color=BLACK,
            linestyle=(0, (4, 2)),
            linewidth=1.0,
            label="speed fraction",
        ),
        *_state_handles(),
    ]
    _legend(ax, handles, columns)


def _draw_distance(ax, samples, columns):
    _shade(ax, samples)
    t = samples["t"]
    ring = find_deciding_ring(samples)
    measured = _finite(pick(samples, "measured_distance", ring))
    critical = _finite(pick(samples, "d_C", ring))
    reduced = _finite(pick(samples, "d_R", ring))
    true = _finite(samples["true_distance"])
    ax.plot(
        t,
        reduced,
        color=ORANGE,
        linewidth=1.0,
        drawstyle="steps-post",
        label="slow below $d_R$",
    )
    ax.plot(
        t,
        critical,
        color=VERMILLION,
        linewidth=1.0,
        drawstyle="steps-post",
        label="stop below $d_C$",
    )
    ax.plot(
        t,
        measured,
        color=BLUE,
        linewidth=1.7,
        drawstyle="steps-post",
        label="measured by the rings",
    )
    ax.plot(
        t,
        true,
        color=BLACK,
        linewidth=1.1,
        linestyle=(0, (5, 1.5)),
        label="true, surface to surface",
    )
    ax.set_ylim(0, _limit_distance(reduced, measured))
    ax.set_ylabel("distance to the person (m)")
    handles = ax.get_legend_handles_labels()[0]
    if find_contacts(samples):
        handles.append(
            Line2D([], [], color=PURPLE, label="contact while moving")
        )
    _legend(ax, handles, columns)


def make_plan(samples: Samples, *, narrow: bool = False) -> Figure:
    """The cell from above with the paths of tool and person."""
    with matplotlib.rc_context(_STYLE):
        size = (4.3, 5.4) if narrow else (7.4, 6.6)
        figure = Figure(figsize=size, layout="constrained")
        ax = figure.subplots()
        plan = samples.metadata.get("plan", {})
        for item in plan.get("outlines", []):
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
                x, y = outline[:, 0].min(), outline[:, 1].max()
                ax.annotate(
                    item["label"],
                    (x, y),
                    xytext=(4, -4),
                    textcoords="offset points",
                    ha="left",
                    va="top",
                    fontsize=8,
                    color="#5A6069",
                    zorder=1.5,
                )
        ax.plot(
            samples["tcp_x"],
            samples["tcp_y"],
            color=GREY,
            linewidth=1.2,
            zorder=2,
        )
        state = samples["robot_state"]
        x, y = samples["person_x"], samples["person_y"]
        for s, e, value in _find_index_spans(state):
            part = slice(s, e + 1)
            colour = STATE_COLOUR[RobotState(value)]
            dash = {0: "solid", 1: (0, (3, 1)), 2: "solid"}[value]
            width = {0: 4.5, 1: 3.0, 2: 1.4}[value]
            ax.plot(
                x[part],
                y[part],
                color=colour,
                linewidth=width,
                linestyle=dash,
                solid_capstyle="butt",
                dash_capstyle="butt",
                zorder=3 + (value == 0),
            )
        base = plan.get("robot", [0.0, 0.0])
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
        known = np.flatnonzero(np.isfinite(x))
        handles = [
            Line2D([], [], color=GREY, linewidth=1.2, label="path of the tool")
        ]
        if len(known):
            i = known[0]
            ax.plot(x[i], y[i], "o", color=BLACK, markersize=5, zorder=6)
            ax.annotate(
                "person starts",
                (x[i], y[i]),
                xytext=(6, 6),
                textcoords="offset points",
                fontsize=8,
                zorder=6,
            )
            handles += [
                Line2D(
                    [],
                    [],
                    color=STATE_COLOUR[s],
                    linewidth=w,
                    linestyle=dash,
                    label=f"person, robot {STATE_NAME[s]}",
                )
                for s, w, dash in (
                    (RobotState.NORMAL, 1.4, "solid"),
                    (RobotState.REDUCED, 3.0, (0, (3, 1))),
                    (RobotState.STOP, 4.5, "solid"),
                )
            ]
        distance = samples["true_distance"]
        if np.isfinite(distance).any():
            i = int(np.argmin(distance))
            px, py = samples["person_point_x"][i], samples["person_point_y"][i]
            rx, ry = samples["robot_point_x"][i], samples["robot_point_y"][i]
            ax.plot([rx, px], [ry, py], color=BLACK, linewidth=1.2, zorder=6)
            ax.plot(
                (rx + px) / 2,
                (ry + py) / 2,
                marker="D",
                color="white",
                markeredgecolor=BLACK,
                markersize=6,
                linestyle="none",
                zorder=7,
            )
            handles.append(
                Line2D(
                    [],
                    [],
                    marker="D",
                    color="white",
                    markeredgecolor=BLACK,
                    linestyle="none",
                    label=f"closest, t = {samples['t'][i]:.1f} s",
                )
            )
        contacts = find_contacts(samples)
        if contacts:
            rows = np.searchsorted(samples["t"], [c.time for c in contacts])
            ax.plot(
                samples["robot_point_x"][rows],
                samples["robot_point_y"][rows],
                marker="X",
                color=PURPLE,
                markeredgecolor=BLACK,
                markersize=9,
                linestyle="none",
                zorder=8,
            )
            handles.append(
                Line2D(
                    [],
                    [],
                    marker="X",
                    color=PURPLE,
                    markeredgecolor=BLACK,
                    linestyle="none",
                    label="contact while moving",
                )
            )
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("x (m)")
        ax.set_ylabel("y (m)")
        _legend(ax, handles, columns=2 if narrow else 3)
    return figure


def _find_index_spans(values):
    change = np.flatnonzero(np.diff(values)) + 1
    first = np.concatenate(([0], change)).astype(int)
    last = np.append(change, max(len(values) - 1, 0)).astype(int)
    if not len(values):
        return []
    return [
        (int(s), int(e), int(values[s]))
        for s, e in zip(first, last, strict=True)
    ]


def make_rings(samples: Samples, *, narrow: bool = False) -> Figure:
    """What each ring measured: its distance, and every sensor's readings."""
    rings = samples.rings
    t = samples["t"]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(
            figsize=(4.3, 3.4 * len(rings)) if narrow else (10.6, 3.1 * 3),
            layout="constrained",
        )
        figure.get_layout_engine().set(h_pad=0.02, hspace=0.0)
        axes = figure.subplots(
            2 * len(rings),
            1,
            sharex=True,
            height_ratios=[1.25, 1.0] * len(rings),
            squeeze=False,
        )[:, 0]
        image = None
        for i, ring in enumerate(rings):
            columns = 0 if i else 2 if narrow else 4
            _draw_ring_distance(axes[2 * i], samples, ring, columns)
            image = _draw_readings(axes[2 * i + 1], samples, ring) or image
        axes[0].set_xlim(t[0], max(t[-1], t[0] + 1e-3))
        axes[-1].set_xlabel("time (s)")
        if image is not None:
            bar = figure.colorbar(
                image,
                ax=axes.tolist(),
                location="bottom",
                shrink=0.5,
                aspect=36,
                pad=0.01,
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
        _mark_contacts(axes, find_contacts(samples))
    return figure


def _draw_ring_distance(ax, samples, ring, columns):
    t = samples["t"]
    _shade(ax, samples)
    true = _finite(samples[f"{ring}_true_distance"])
    measured = _finite(samples[f"{ring}_measured_distance"])
    reduced = _finite(samples[f"{ring}_d_R"])
    ax.plot(
        t,
        reduced,
        color=ORANGE,
        linewidth=0.9,
        label="$d_R$",
        drawstyle="steps-post",
    )
    ax.plot(
        t,
        _finite(samples[f"{ring}_d_C"]),
        color=VERMILLION,
        linewidth=0.9,
        label="$d_C$",
        drawstyle="steps-post",
    )
    ax.plot(
        t,
        true,
        color=BLACK,
        linewidth=1.0,
        linestyle=(0, (5, 1.5)),
        label="true, from link centre",
    )
    ax.plot(
        t,
        measured,
        color=BLUE,
        linewidth=1.6,
        drawstyle="steps-post",
        label="measured",
    )
    ax.set_ylim(0, _limit_distance(measured, reduced))
    ax.set_ylabel("m")
    if columns:
        _legend(ax, columns=columns)
    ax.set_title(f"{ring} ring", pad={0: 6, 2: 34, 4: 20}[columns])


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
    rank = np.array([0, 3, 1, 2])  # Clear, valid, masked, faulted.
    for c in range(columns):
        a, b = first[c], last[c]
        if a == b:
            if not a:
                continue
            a -= 1
        part = reading[a:b]
        row = np.argmax(rank[part], axis=0)
        out_reading[:, c] = part[row, np.arange(n)]
        valid = np.where(part == Reading.VALID, distance[a:b], np.inf)
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
    # Grey with a weave of two tones: reads as hatched at any zoom.
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
    """A ring seen along its axis: its beams, and where the person was."""
    with matplotlib.rc_context(_STYLE):
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
    """Returns the instant most worth looking at, and what it is.

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
