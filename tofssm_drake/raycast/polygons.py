"""Polygons of three and more corners, cut into triangles."""

import numpy as np

from tofssm_drake.kernels import njit


def cut_polygons(
    vertices: np.ndarray, corners: np.ndarray, counts: np.ndarray
) -> np.ndarray:
    """Cuts polygons into triangles that cover them and nothing else.

    A polygon need not be convex; its triangles keep its orientation. A
    quadrangle is cut along its shorter diagonal, if that is inside it.
    One whose outline crosses itself is cut arbitrarily.

    Args:
        vertices: Positions, shape (v, 3), m.
        corners: Indices of the corners, one polygon after the other.
        counts: How many corners each polygon has, 3 or more, shape (p,).

    Returns:
        Indices of the triangles' corners, int64, shape (n, 3).
    """
    if len(counts) == 0:
        return np.empty((0, 3), dtype=np.int64)
    return _cut_polygons(
        np.ascontiguousarray(vertices, dtype=float),
        np.ascontiguousarray(corners, dtype=np.int64),
        np.ascontiguousarray(counts, dtype=np.int64),
    )


@njit(cache=True)
def _cut_polygons(vertices, corners, counts):
    faces = np.empty((corners.shape[0] - 2 * counts.shape[0], 3), np.int64)
    first, used = 0, 0
    for count in counts:
        polygon = corners[first : first + count]
        cuts = faces[used : used + count - 2]
        if count == 3:
            cuts[0] = polygon
        else:
            x, y = _flatten(vertices, polygon)
            if count == 4:
                _cut_quadrangle(vertices, polygon, x, y, cuts)
            else:
                _clip_ears(polygon, x, y, cuts)
        first += count
        used += count - 2
    return faces


@njit(cache=True)
def _flatten(vertices, polygon):
    """Returns x and y of corners, seen so that they run counter-clockwise.

    The coordinate closest to the polygon's normal is dropped, so that the two
    others keep all their digits.
    """
    nx, ny, nz = 0.0, 0.0, 0.0
    last = vertices[polygon[0]]
    a = vertices[polygon[-1]] - last
    for corner in polygon:
        b = vertices[corner] - last
        nx += a[1] * b[2] - a[2] * b[1]
        ny += a[2] * b[0] - a[0] * b[2]
        nz += a[0] * b[1] - a[1] * b[0]
        a = b
    first, second, up = 0, 1, nz
    if abs(nx) >= abs(ny) and abs(nx) >= abs(nz):
        first, second, up = 1, 2, nx
    elif abs(ny) >= abs(nz):
        first, second, up = 2, 0, ny
    if up < 0.0:
        first, second = second, first
    x = np.empty(len(polygon))
    y = np.empty(len(polygon))
    for i in range(len(polygon)):
        x[i] = vertices[polygon[i], first]
        y[i] = vertices[polygon[i], second]
    return x, y


@njit(cache=True)
def _turn(x, y, a, b, c):
    """Returns twice the area of a triangle, > 0: counter-clockwise."""
    return (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])


@njit(cache=True)
def _cut_quadrangle(vertices, polygon, x, y, cuts):
    """Writes two triangles."""
    across = vertices[polygon[2]] - vertices[polygon[0]]
    along = vertices[polygon[3]] - vertices[polygon[1]]
    start = 0 if (across * across).sum() < (along * along).sum() else 1
    # The diagonal from a dent is inside, the other one is not.
    for i in range(4):
        if _turn(x, y, (i - 1) % 4, i, (i + 1) % 4) < 0.0:
            start = i
    for i in range(2):
        cuts[i, 0] = polygon[start]
        cuts[i, 1] = polygon[(start + 1 + i) % 4]
        cuts[i, 2] = polygon[(start + 2 + i) % 4]


@njit(cache=True)
def _clip_ears(polygon, x, y, cuts):
    """Writes the triangles of a polygon, which are cut off one by one."""
    n = len(polygon)
    before = np.arange(n) - 1
    before[0] = n - 1
    after = np.arange(n) + 1
    after[n - 1] = 0
    i, tried = 0, 0
    for k in range(n - 2):
        left = n - k
        # Straight corners, which have no area, only if there are no others;
        # then any, if the outline crosses itself.
        while tried < 2 * left and not _is_ear(
            x, y, before, after, i, left, tried < left
        ):
            i, tried = after[i], tried + 1
        a, c = before[i], after[i]
        cuts[k, 0], cuts[k, 1], cuts[k, 2] = polygon[a], polygon[i], polygon[c]
        after[a], before[c] = c, a
        i, tried = c, 0


@njit(cache=True)
def _is_ear(x, y, before, after, i, left, is_strict):
    """Returns whether a corner can be cut off: no other corner is within it."""
    a, c = before[i], after[i]
    area = _turn(x, y, a, i, c)
    if area < 0.0 or (is_strict and area == 0.0):
        return False
    j = after[c]
    for _ in range(left - 3):
        is_within = (
            _turn(x, y, a, i, j) >= 0.0
            and _turn(x, y, i, c, j) >= 0.0
            and _turn(x, y, c, a, j) >= 0.0
        )
        if is_within and not (
            (x[j] == x[a] and y[j] == y[a])
            or (x[j] == x[i] and y[j] == y[i])
            or (x[j] == x[c] and y[j] == y[c])
        ):
            return False
        j = after[j]
    return True
