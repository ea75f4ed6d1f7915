"""Stretches of a record."""

import numpy as np


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
