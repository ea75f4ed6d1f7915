"""Makes the pictures of the documentation again: `make images`.

It draws the Diagrams with Graphviz and runs the default scenario for the
pictures of the cell and of its twin, which a browser without a window takes. On
Debian: `apt-get install graphviz chromium`. The figure of the ray caster's cost
is measured: `python benchmarks/make_speed_page.py` draws it.
"""

from collections.abc import Iterable
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram

from tofssm_drake.diagrams.scenario import find_links, load_scenario
from tofssm_drake.diagrams.simulation import make_simulator
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.errors import UserError, require
from tofssm_drake.messages import RobotState
from tofssm_drake.people.skeleton import CAPSULES
from tofssm_drake.recording.samples import (
    Samples,
    read_samples,
    write_atomically,
)
from tofssm_drake.scripts.main import run
from tofssm_drake.visualization.health_board import OK, HealthBoard
from tofssm_drake.visualization.recording import make_display

# Graphviz's and a browser's.
_DOT = "dot"
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_SIZE = (1280, 760)
_TWIN_SIZE = (700, 620)
_NO_CONTROLS = "<style>.dg.main { display: none !important; }</style></head>"
# So long that the strip of states below the picture can be read, s.
_DURATION = 24.0
# The person is near, but does not hide the robot.
_NEAR = 0.25
# A software renderer takes long for the first frame.
_PATIENCE = 600.0


def simplify(dot: str) -> str:
    """Returns Drake's picture of a Diagram so that it fits on a page.

    Classes lose their modules, the frame around all and its title are not
    drawn, and the numbers of the systems, which differ in each process, are
    counted anew.
    """
    numbers: dict[str, int] = {}

    def count(match):
        number = numbers.setdefault(match[2], len(numbers))
        return f"{match[1]}{number}"

    dot = re.sub(r"\b(_|s|clusters?)(\d+)", count, dot)
    dot = re.sub(r"<B>[\w.]*\.(\w+)</B>", r"<B>\1</B>", dot)
    dot = dot.replace("<BR/>\nname=", "<BR/>\n")
    dot = re.sub(r"label=<<TABLE.*?>>;", 'label=""', dot, count=1, flags=re.S)
    dot = dot.replace("rankdir=LR", "rankdir=LR\nranksep=0.4", 1)
    return dot.replace("color=black", "color=white", 1)


def draw(diagram: Diagram, path: Path) -> None:
    """Draws a Diagram with its systems as an SVG."""
    dot = simplify(diagram.GetGraphvizString(max_depth=1))

    def write(temporary):
        subprocess.run(
            [_DOT, "-Tsvg", "-o", temporary], input=dot, text=True, check=True
        )

    write_atomically(path, write)


def draw_diagrams(folder: Path) -> None:
    """Draws the default scenario's workcell and its monitor."""
    workcell = make_workcell(load_scenario())
    draw(workcell.diagram, folder / "diagram.svg")
    monitor = workcell.diagram.GetSubsystemByName("monitor")
    draw(monitor, folder / "monitor.svg")


def find_instant(samples: Samples) -> float:
    """Returns when the robot stands still and a person is near, s."""
    distance = np.where(
        (samples["robot_state"] == RobotState.STOP)
        & (samples["tcp_speed"] < 0.01)
        & (samples["true_distance"] > _NEAR),
        samples["true_distance"],
        np.inf,
    )
    require(
        bool(np.isfinite(distance).any()), "the robot never stops for a person"
    )
    return float(samples["t"][np.argmin(distance)])


def photograph_cell(folder: Path, browser: str) -> float:
    """Runs the default scenario and takes a picture of its replay.

    Returns:
        When it stopped as in the picture, s.
    """
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        require(
            run(["simulate", f"--duration={_DURATION:g}", "--out", name]) == 0,
            "the default scenario did not run",
        )
        instant = find_instant(read_samples(out))
        page = f"{(out / 'recording.html').as_uri()}#t={instant:.2f}"
        write_atomically(
            folder / "cell.png", lambda p: take_picture(browser, page, p)
        )
    return instant


def photograph_twin(folder: Path, browser: str, instant: float) -> None:
    """Takes a picture of the twin that `tofssm hardware --meshcat` shows.

    It is the simulated cell at an instant, without the person, whom a real
    cell's twin does not know.
    """
    scenario = load_scenario()
    meshcat = make_display()
    workcell = make_workcell(scenario, meshcat=meshcat)
    names = (*find_links(scenario), "robot")
    HealthBoard(meshcat=meshcat, names=names).show(dict.fromkeys(names, OK))
    make_simulator(
        workcell.diagram, workcell.make_context(scenario.random_seed)
    ).AdvanceTo(instant)
    hide_people(meshcat, scenario.people)
    with tempfile.TemporaryDirectory() as name:
        page = Path(name) / "twin.html"
        # Without Meshcat's own controls over the board.
        html = meshcat.StaticHtml().replace("</head>", _NO_CONTROLS, 1)
        page.write_text(html, encoding="utf-8")
        write_atomically(
            folder / "twin.png",
            lambda p: take_picture(browser, page.as_uri(), p, size=_TWIN_SIZE),
        )


def hide_people(meshcat: Meshcat, people: Iterable[str]) -> None:
    """Takes people out of what is shown.

    Raises:
        UserError: One of them is not there.
    """
    for person in people:
        for capsule in CAPSULES:
            path = f"visualizer/{person}_{capsule.name}"
            require(meshcat.HasPath(path), f"Meshcat has no {path}")
            meshcat.Delete(path)


def take_picture(
    browser: str, page: str, path: Path, size: tuple[int, int] = _SIZE
) -> None:
    """Writes what a browser shows of a page as a PNG.

    Raises:
        UserError: It did not show it in time.
    """
    width, height = size
    # It takes the kind of picture from the name.
    picture = path.with_suffix(".png")
    command = [
        *(browser, "--headless", "--no-sandbox", "--hide-scrollbars"),
        # WebGL without a graphics card.
        *("--use-gl=angle", "--use-angle=swiftshader"),
        *("--enable-unsafe-swiftshader", "--virtual-time-budget=3000"),
        *(f"--window-size={width},{height}", f"--screenshot={picture}", page),
    ]
    try:
        subprocess.run(
            command, check=True, capture_output=True, timeout=_PATIENCE
        )
        picture.replace(path)
    except (subprocess.SubprocessError, OSError) as error:
        picture.unlink(missing_ok=True)
        raise UserError(f"{browser}: took no picture: {error}") from None


def draw_docs(folder: Path) -> None:
    """Makes all pictures.

    Args:
        folder: An existing folder; pictures in it are replaced.

    Raises:
        UserError: A program is missing, or a picture could not be made.
    """
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if shutil.which(_DOT) is None or browser is None:
        raise UserError(
            "Graphviz's program dot and Chromium are needed (apt-get install "
            "graphviz chromium)"
        )
    require(folder.is_dir(), f"there is no folder {folder}")
    draw_diagrams(folder)
    photograph_twin(folder, browser, photograph_cell(folder, browser))


if __name__ == "__main__":
    try:
        draw_docs(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images"))
    except UserError as error:
        sys.exit(f"draw_docs: {error}")
