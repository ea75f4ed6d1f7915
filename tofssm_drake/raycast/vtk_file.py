"""Checks of a legacy VTK file's points and cells.

Drake's reader ends the process where a cell has a corner that is not one of
the points, and drops cells with a point that is not finite. So both are
checked first.
"""

import numpy as np


def check_vtk(contents: bytes) -> None:
    """Checks the points and cells of a legacy VTK file in ASCII.

    Whatever else may be wrong with a file is left to its reader, and so are
    binary files.

    Raises:
        ValueError: If a point is not three finite numbers, or a cell's corner
            is not one of the points.
    """
    # The first two lines are the version and a title.
    lines = contents.split(b"\n", 2)
    words = lines[-1].split()
    if len(lines) < 3 or words[:1] != [b"ASCII"]:
        return
    try:
        _check_words(words)
    except IndexError:
        raise ValueError("it ends too early") from None


def _check_words(words) -> None:
    points = _find_numbers(words, b"POINTS", 3, 3)
    if points is None:
        return
    if not np.isfinite(points).all():
        i = int(np.flatnonzero(~np.isfinite(points))[0])
        raise ValueError(f"point {i // 3} is not three finite numbers")
    corners = _find_corners(words)
    num_points = len(points) // 3
    bad = corners[(corners < 0) | (corners >= num_points)]
    if len(bad) > 0:
        raise ValueError(
            f"a cell has the corner {bad[0]:.0f}, which is not one of its"
            f" {num_points} points"
        )


def _find_numbers(words, keyword: bytes, skip: int, per_item: int):
    """Returns the numbers of a section, None if there is no such section.

    Args:
        words: Of the file.
        keyword: At which the section starts; how many items follows.
        skip: From the keyword to the first number.
        per_item: How many numbers each item has.
    """
    if keyword not in words:
        return None
    start = words.index(keyword)
    count = per_item * int(words[start + 1])
    numbers = np.array(words[start + skip : start + skip + count], dtype=float)
    if len(numbers) < count:
        raise ValueError(
            f"{keyword.decode()}: {len(numbers)} of {count} numbers"
        )
    return numbers


def _find_corners(words) -> np.ndarray:
    """Returns the corners of all cells."""
    if b"CONNECTIVITY" in words:
        # Since version 5: CELLS offsets corners, then both lists.
        start = words.index(b"CONNECTIVITY") + 2
        count = int(words[words.index(b"CELLS") + 2])
        return np.array(words[start : start + count], dtype=float)
    if b"CELLS" not in words:
        return np.empty(0)
    # Before: CELLS cells numbers, then each cell's corners after their number.
    start = words.index(b"CELLS") + 3
    numbers = np.array(
        words[start : start + int(words[start - 1])], dtype=float
    )
    corners = []
    i = 0
    while i < len(numbers):
        end = i + 1 + max(int(numbers[i]), 0)
        corners.append(numbers[i + 1 : end])
        i = end
    return np.concatenate([np.empty(0), *corners])
