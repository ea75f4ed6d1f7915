"""Times at which a robot's program is looked at."""

import math

import numpy as np


def list_times(duration: float, *, step: float, most: int) -> np.ndarray:
    """Returns times at which to look at a path, s, in order.

    Args:
        duration: Of the path, s; that of a robot without a task is very long.
        step: Between two of them, s.
        most: If there were more, so many are spread over the path, in a way
            that does not keep step with its rounds (golden ratio).
    """
    if duration <= most * step:
        return np.arange(0.0, duration, step)
    golden = 0.5 * (math.sqrt(5.0) - 1.0)
    return np.sort(duration * (golden * np.arange(most) % 1.0))
