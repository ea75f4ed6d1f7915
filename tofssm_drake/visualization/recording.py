"""Replay of a run that any browser opens, offline."""

import html
import importlib.resources
import logging
from pathlib import Path

import jinja2
import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams

from tofssm_drake.messages import RobotState
from tofssm_drake.recording.samples import Samples, write_atomically
from tofssm_drake.recording.spans import find_spans
import tofssm_drake.visualization.palette as palette

FPS = 16.0
"""Frames per second of a recording; the player interpolates between them."""


def make_display() -> Meshcat:
    """Makes a Meshcat that only this machine can reach.

    It does not write its address to stderr.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        return Meshcat(MeshcatParams(host="localhost"))
    finally:
        logger.setLevel(level)


def set_scene(meshcat: Meshcat) -> None:
    """Sets background, grid and camera so that the whole cell is seen."""
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.80, 0.82, 0.85])
    meshcat.SetCameraPose([3.0, -1.9, 2.2], [0.35, 0.0, 0.95])


def start_recording(meshcat: Meshcat, *, fps: float = FPS, live: bool = False):
    """Starts to record what is drawn.

    Args:
        meshcat: Where it is drawn.
        fps: Frames per second; the same as of the systems that draw.
        live: Whether to draw in connected browsers meanwhile.
    """
    meshcat.StartRecording(
        frames_per_second=fps, set_visualizations_while_recording=live
    )


def write_recording(
    meshcat: Meshcat,
    path: Path,
    *,
    samples: Samples | None = None,
    title: str = "Speed and separation monitoring",
) -> None:
    """Ends the recording and writes it as one HTML file.

    The page has a legend, and below a strip of the robot's states in which
    one can click; `recording.html#t=12.5` opens at 12.5 s, or at the first
    frame after it.

    Args:
        meshcat: Where the run was drawn.
        path: The HTML file.
        samples: The run, for the strip and the read-out; without it the page
            has the legend only.
        title: Of the page.

    Raises:
        UserError: if the file cannot be written.
    """
    meshcat.StopRecording()
    meshcat.PublishRecording()
    page = add_overlay(meshcat.StaticHtml(), samples=samples, title=title)
    meshcat.DeleteRecording()
    write_atomically(Path(path), lambda p: p.write_text(page, "utf-8"))


def add_overlay(
    page: str,
    *,
    samples: Samples | None = None,
    title: str = "",
    fps: float = FPS,
) -> str:
    """Returns Meshcat's static page with legend and time strip.

    Args:
        page: From `Meshcat.StaticHtml`.
        samples: See `write_recording`.
        title: See `write_recording`.
        fps: Frames per second of the recording.
    """
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    template = environment.from_string(
        importlib.resources.files("tofssm_drake.visualization")
        .joinpath("overlay.html.jinja")
        .read_text(encoding="utf-8")
    )
    overlay = template.render(
        title=title,
        beam={
            reading.name: palette.to_hex(rgba)
            for reading, rgba in palette.BEAM.items()
        },
        state=[palette.to_hex(palette.STATE[s]) for s in RobotState],
        word=[palette.STATE_WORD[s] for s in RobotState],
        run=make_run_data(samples),
        people=list_shirts(samples),
        fps=fps,
        has_beams=samples is None
        or samples.metadata.get("sensing", "rings") in ("rings", "mixed"),
    )
    head, end, tail = page.rpartition("</body>")
    head = head.replace(
        "<title>Drake MeshCat</title>", f"<title>{html.escape(title)}</title>"
    )
    return f"{head}{overlay}{end}{tail}"


def make_run_data(samples: Samples | None) -> dict | None:
    """Returns what the page's read-out needs of a run, small.

    Args:
        samples: The run; None gives None.

    Returns:
        `end`, s; `tick`, s; `spans`, [start, end, state]; `step`, s, between
        the elements of `speed` (tool, m/s) and `distance` (true, m; None:
        nobody); `who` is nearest, of several people.
    """
    if samples is None or len(samples) < 2:
        return None
    t = samples["t"]
    stride = max(round(0.04 / (t[1] - t[0])), 1)
    distance = np.maximum(samples["true_distance"][::stride], 0.0)
    return {
        "end": float(t[-1]),
        "tick": float(t[1] - t[0]),
        "spans": [
            [round(a, 3), round(b, 3), state]
            for a, b, state in find_spans(t, samples["robot_state"])
        ],
        "step": float(stride * (t[1] - t[0])),
        "speed": np.round(samples["tcp_speed"][::stride], 2).tolist(),
        "distance": [
            round(float(d), 2) if np.isfinite(d) else None for d in distance
        ],
        "who": (
            [
                samples.find_nearest_person(i)
                for i in range(0, len(samples), stride)
            ]
            if len(samples.metadata.get("people", ())) > 1
            else []
        ),
    }


def list_shirts(samples: Samples | None) -> list[tuple[str, str]]:
    """Returns name and colour of the shirt of each of several people.

    Args:
        samples: The run.
    """
    if samples is None or len(samples.metadata.get("people", ())) < 2:
        return []
    return list(samples.metadata.get("shirts", {}).items())
