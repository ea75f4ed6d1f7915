"""Writes docs/ray_caster_speed.md and its plot from measurements."""

import importlib.metadata
import os
from pathlib import Path
import platform
import tempfile
import textwrap

import jinja2
import matplotlib as mpl
from matplotlib.figure import Figure
import numpy as np
from ray_comparison import (
    HOLD,
    compare,
    find_missing_peers,
    find_ratios,
    format_table,
)
from ray_growth import measure_rays, measure_shapes, measure_triangles
from ray_scene import NUM_STATES, Scene

_HERE = Path(__file__).parent
_DOCS = _HERE.parent / "docs"
_ROUNDS = 6
# Okabe and Ito, with markers and dashes of their own.
_STYLES = (
    {"color": "#0072B2", "marker": "o"},
    {"color": "#D55E00", "marker": "s"},
    {"color": "#009E73", "marker": "^"},
)
_GROWTHS = (
    (
        "Rays",
        "Sensors strewn over a room with 64 moving shapes. More sensors cost"
        " what they add, more rays in the same cones less, since what a cone"
        " cannot see is ruled out once for all of them. Rays with an origin"
        " of their own (`cast`) have nothing to share.",
        measure_rays,
    ),
    (
        "Shapes",
        "24 sensors with 25 rays each in a room of 8 m by 8 m by 3 m that"
        " fills up. Shapes that share a frame are in a tree, which is made"
        " once: all that is fixed in the world, all that is on one link. The"
        " cost then grows far less than their number. Where each shape has a"
        " frame of its own, it grows as their number does, since nothing is"
        " known of a pose before the query: each one is checked and applied"
        " once for all sensors (a fifth of the time for 2000 shapes), and the"
        " shape's bounding sphere is tested against each sensor's cone (about"
        " one nanosecond). To sort the spheres again at each query, so that"
        " fewer need a test, would itself grow as their number does.",
        measure_shapes,
    ),
    (
        "Triangles",
        "24 sensors with 25 rays each around one bumpy ball, which most rays"
        " hit.",
        measure_triangles,
    ),
)


def main():
    """Measures and writes."""
    missing = find_missing_peers()
    if missing:
        raise SystemExit(
            f"not installed: {', '.join(missing)}; pip install"
            " 'tofssm-drake[peers]'"
        )
    comparisons, held = _compare_all()
    growths = [(title, text, measure()) for title, text, measure in _GROWTHS]
    template = jinja2.Template(
        (_HERE / "ray_caster_speed.md.jinja").read_text(),
        keep_trailing_newline=True,
    )
    page = template.render(
        machine=_describe_machine(),
        states=NUM_STATES,
        rounds=_ROUNDS,
        versions={
            name: importlib.metadata.version(name)
            for name in ("mujoco", "pybullet")
        },
        comparisons=comparisons,
        held=held,
        growths=[
            {
                "title": title,
                "text": textwrap.fill(text, 79),
                "table": _format_curves(curves),
            }
            for title, text, curves in growths
        ],
    )
    _write(_DOCS / "images" / "ray_caster_growth.svg", _plot(growths))
    _write(_DOCS / "ray_caster_speed.md", page)


def _compare_all() -> tuple[list[dict], list[dict]]:
    """Returns a table for each scene, and which ratios hold."""
    comparisons, held = [], []
    for meshes in (False, True):
        for sensors in (8, 16):
            scene = Scene(sensors=sensors, meshes=meshes)
            rows = compare(scene, meshes=meshes, rounds=_ROUNDS)
            rays = 3 * sensors * len(scene.bundles.fan_S)
            comparisons.append(
                {
                    "title": f"{rays} rays, {_describe(scene, meshes)}",
                    "table": format_table(rows),
                }
            )
            for caster, libraries in HOLD[meshes].items():
                ratios = find_ratios(rows, caster)
                for library, wanted in libraries.items():
                    held.append(
                        {
                            "what": f"{caster} against {library},"
                            f" {rays} rays, {'meshes' if meshes else 'shapes'}",
                            "wanted": f"{wanted:g} x",
                            "measured": f"{ratios[library]:.1f} x"
                            + ", not reached" * (ratios[library] < wanted),
                        }
                    )
    return comparisons, held


def _describe(scene, meshes) -> str:
    count = len(scene.caster.geometry_ids)
    if not meshes:
        return f"{count} primitive shapes"
    return (
        f"{count} shapes, of which robot and person are meshes of"
        f" {scene.count_triangles()} triangles"
    )


def _describe_machine() -> str:
    system = f"{platform.system()} {platform.machine()}"
    return f"a machine with {os.cpu_count()} cores ({system})"


def _format_curves(curves) -> str:
    names = [curve.name for curve in curves]
    lines = [
        f"| | {' | '.join(names)} |",
        "|---" * (1 + len(curves)) + "|",
    ]
    for i, size in enumerate(curves[0].sizes):
        cells = [f"{curve.times[i]:.1f} us" for curve in curves]
        lines.append(f"| {size} | {' | '.join(cells)} |")
    steepest = [f"{curve.find_steepest():.2f}" for curve in curves]
    lines.append(f"| steepest step (1 is linear) | {' | '.join(steepest)} |")
    return "\n".join(lines)


def _plot(growths) -> str:
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "growth"}):
        figure = Figure(figsize=(10.5, 3.8), layout="constrained")
        axes = figure.subplots(1, len(growths), sharey=True)
        for ax, (title, _, curves) in zip(axes, growths, strict=True):
            for curve, style in zip(curves, _STYLES, strict=False):
                ax.loglog(
                    curve.sizes,
                    curve.times,
                    label=curve.name,
                    markersize=4,
                    linewidth=1.5,
                    **style,
                )
            sizes = np.array(curves[0].sizes, dtype=float)
            start = 0.7 * min(curve.times[0] for curve in curves)
            # Up to where the slowest curve ends.
            end = min(sizes[-1], sizes[0] * max(curves[-1].times) / start)
            ax.loglog(
                [sizes[0], end],
                [start, start * end / sizes[0]],
                color="0.45",
                linestyle="--",
                linewidth=1.2,
                label="linear",
            )
            ax.set_xlabel(f"number of {title.lower()}")
            ax.grid(which="major", color="0.88", linewidth=0.6)
            ax.legend(fontsize=8, frameon=False, loc="upper left")
        axes[0].set_ylabel("time of one query, µs")
        axes[0].set_ylim(bottom=3.0, top=3e4)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "growth.svg"
            figure.savefig(path, metadata={"Date": None})
            return path.read_text()


def _write(path: Path, text: str):
    """Writes a file atomically."""
    part = path.with_suffix(".part")
    part.write_text(text)
    part.replace(path)


if __name__ == "__main__":
    main()
