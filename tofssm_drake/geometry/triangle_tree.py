"""A bounding volume hierarchy of triangles."""

import dataclasses as dc

import numpy as np

from tofssm_drake.kernels import njit

_LEAF_SIZE = 4
_BINS = 16
# From here on lists are halved, which bounds the stack of a traversal.
_DEEP = 64


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TriangleTree:
    """Triangles, sorted into a tree of axis-aligned boxes.

    A row of `nodes` is a box and two whole numbers (first, count). With a
    count it is a leaf and has so many triangles from the first on, else it
    has the nodes first and first + 1 as children. Node 0 is the root.
    """

    triangles: np.ndarray
    """The three corners of each triangle in G, shape (n, 9), m."""
    nodes: np.ndarray
    """Lower and upper corner of the box, m, first, count: shape (., 8). The
    boxes are a trace larger than what they hold."""


def make_triangle_tree(vertices: np.ndarray, faces: np.ndarray) -> TriangleTree:
    """Makes a TriangleTree.

    Args:
        vertices: Positions in G, shape (v, 3), m.
        faces: Indices of each triangle's corners, shape (n, 3), n > 0.
    """
    corners = vertices[faces]
    order, bounds, links = _build_tree(
        corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1)
    )
    # A ray along a box's face must not be lost to rounding.
    margin = 1e-12 * np.abs(bounds[0]).max()
    bounds += margin * np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    return TriangleTree(
        triangles=np.ascontiguousarray(corners[order].reshape(-1, 9)),
        nodes=np.hstack([bounds, links]),
    )


@njit(cache=True, error_model="numpy")
def _half_area(low, high):
    x, y, z = high[0] - low[0], high[1] - low[1], high[2] - low[2]
    return x * y + y * z + z * x


@njit(cache=True, error_model="numpy")
def _find_split(low, high, centre, order, start, end):
    """Returns (axis, plane) of the cheapest split, axis -1 if there is none.

    The surface area heuristic over equal bins of the triangles' centres.
    """
    best_axis, best_plane, best_cost = -1, 0.0, np.inf
    for axis in range(3):
        first, last = np.inf, -np.inf
        for i in range(start, end):
            first = min(first, centre[order[i], axis])
            last = max(last, centre[order[i], axis])
        if not last > first:
            continue
        count = np.zeros(_BINS, dtype=np.int64)
        bin_low = np.full((_BINS, 3), np.inf)
        bin_high = np.full((_BINS, 3), -np.inf)
        scale = _BINS / (last - first)
        for i in range(start, end):
            k = order[i]
            b = min(int((centre[k, axis] - first) * scale), _BINS - 1)
            count[b] += 1
            for j in range(3):
                bin_low[b, j] = min(bin_low[b, j], low[k, j])
                bin_high[b, j] = max(bin_high[b, j], high[k, j])
        right = np.full(_BINS, np.inf)
        box_low, box_high = np.full(3, np.inf), np.full(3, -np.inf)
        total = 0
        for b in range(_BINS - 1, 0, -1):
            total += count[b]
            for j in range(3):
                box_low[j] = min(box_low[j], bin_low[b, j])
                box_high[j] = max(box_high[j], bin_high[b, j])
            if total > 0:
                right[b] = total * _half_area(box_low, box_high)
        box_low[:] = np.inf
        box_high[:] = -np.inf
        total = 0
        for b in range(_BINS - 1):
            total += count[b]
            for j in range(3):
                box_low[j] = min(box_low[j], bin_low[b, j])
                box_high[j] = max(box_high[j], bin_high[b, j])
            if total == 0:
                continue
            cost = total * _half_area(box_low, box_high) + right[b + 1]
            if cost < best_cost:
                best_axis = axis
                best_plane = first + (b + 1) / scale
                best_cost = cost
    return best_axis, best_plane


@njit(cache=True, error_model="numpy")
def _build_tree(low, high, centre):
    """Returns (order of the triangles, node bounds, node links)."""
    n = low.shape[0]
    order = np.arange(n)
    bounds = np.empty((2 * n, 6))
    links = np.empty((2 * n, 2), dtype=np.int64)
    starts = np.empty(2 * n, dtype=np.int64)
    ends = np.empty(2 * n, dtype=np.int64)
    depth = np.zeros(2 * n, dtype=np.int64)
    starts[0], ends[0] = 0, n
    used = 1
    node = 0
    while node < used:
        start, end = starts[node], ends[node]
        for j in range(3):
            bounds[node, j] = np.inf
            bounds[node, 3 + j] = -np.inf
        for i in range(start, end):
            for j in range(3):
                bounds[node, j] = min(bounds[node, j], low[order[i], j])
                bounds[node, 3 + j] = max(
                    bounds[node, 3 + j], high[order[i], j]
                )
        links[node, 0], links[node, 1] = start, end - start
        if end - start > _LEAF_SIZE:
            axis, plane, middle = -1, 0.0, start
            if depth[node] < _DEEP:
                axis, plane = _find_split(low, high, centre, order, start, end)
            if axis >= 0:
                for i in range(start, end):
                    if centre[order[i], axis] < plane:
                        order[i], order[middle] = order[middle], order[i]
                        middle += 1
            if middle == start or middle == end:
                # No plane parts the centres: halve the list as it is.
                middle = (start + end) // 2
            links[node, 0], links[node, 1] = used, 0
            starts[used], ends[used] = start, middle
            starts[used + 1], ends[used + 1] = middle, end
            depth[used] = depth[used + 1] = depth[node] + 1
            used += 2
        node += 1
    return order, bounds[:used].copy(), links[:used].copy()
