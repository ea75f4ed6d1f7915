"""How long an arm takes to stop at worst, as its manufacturer states."""

import numpy as np

STATED_FOR = "a UR10"
"""The arm whose times these are (CB3); the audit has none of other arms."""
STATED_SPEED = (1.0, 1.5, 2.0, 2.5, 3.0)
"""Speeds of the tool for which Universal Robots states stopping times, m/s."""
STATED_TIME = (0.45, 0.50, 0.55, 0.60, 0.65)
"""Worst-case times of a category-0 stop from these speeds, s."""


def calc_stated_stop_time(tcp_speed):
    """Returns the worst-case stopping time, s.

    Category-0 stop by the speed of the tool: 0.35 s plus 0.1 s per m/s, a line
    through the stated points.

    Args:
        tcp_speed: m/s, a number or an array.
    """
    return 0.35 + 0.1 * np.asarray(tcp_speed, dtype=float)
