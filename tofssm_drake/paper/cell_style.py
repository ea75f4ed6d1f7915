"""How the figures show cells, and which part of a run they show.

Colour (Okabe and Ito's) and hatching show the sensing, marker and line the
configuration, so that neither depends on seeing colours. Every figure comes in
two widths: wide, and narrow for a phone.
"""

from collections.abc import Iterable

import numpy as np

from tofssm_drake.paper.cells import CONFIGURATION_LABEL, Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.recording.samples import Samples
from tofssm_drake.reports.figures import BLUE, GREEN, PURPLE, VERMILLION

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
HATCH = {"tof": "////", "ideal": "", "lidar": "xxxx", "tof16": "...."}
MARKER = {"vo": "o", "vr": "^", "sm": "s"}


WIDE, NARROW = 10.6, 4.3
SPAN = 30.0
"""Length of the part of a run that is shown where all is too dense, s."""


def find_sensings(cells: Iterable[Cell]) -> list[str]:
    """Returns the sensings of cells, each once."""
    return list(dict.fromkeys(cell.sensing for cell in cells))


def find_configurations(cells: Iterable[Cell]) -> list[str]:
    """Returns the configurations of cells, each once."""
    known = {cell.configuration for cell in cells}
    return [c for c in CONFIGURATION_LABEL if c in known]


def list_plain(results: Results) -> list[Cell]:
    """Returns the cells without a variant."""
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
