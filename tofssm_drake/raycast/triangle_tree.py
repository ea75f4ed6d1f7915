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
    count it is a leaf with that many triangles from the first on, else its
    children are the nodes first and first + 1. Node 0 is the root.
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
def _half_area(box):
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@njit(cache=True, error_model="numpy")
def _bin_centres(low, high, centre, order, start, end, bins):
    """Sorts triangles into equal bins along each axis.

    Args:
        low: Lower corners of the triangles' boxes, shape (n, 3).
        high: Upper corners.
        centre: Their centres.
        order: Which triangles there are, from start to end.
        start: See `order`.
        end: See `order`.
        bins: Written: per axis and bin the number of triangles, and their
            box, shape (3, _BINS, 7).

    Returns:
        (first, scale): for each axis the least centre, and bins per metre, 0
        if all centres are in one plane; shape (3,).
    """
    first, last = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(start, end):
        k = order[i]
        for axis in range(3):
            first[axis] = min(first[axis], centre[k, axis])
            last[axis] = max(last[axis], centre[k, axis])
    scale = np.zeros(3)
    for axis in range(3):
        if last[axis] > first[axis]:
            scale[axis] = _BINS / (last[axis] - first[axis])
    bins[:, :, 0] = 0.0
    bins[:, :, 1:4] = np.inf
    bins[:, :, 4:] = -np.inf
    for i in range(start, end):
        k = order[i]
        for axis in range(3):
            b = min(
                int((centre[k, axis] - first[axis]) * scale[axis]), _BINS - 1
            )
            bins[axis, b, 0] += 1.0
            for j in range(3):
                bins[axis, b, 1 + j] = min(bins[axis, b, 1 + j], low[k, j])
                bins[axis, b, 4 + j] = max(bins[axis, b, 4 + j], high[k, j])
    return first, scale


@njit(cache=True, error_model="numpy")
def _sweep(bins, right, box):
    """Returns (bin, cost) of the cheapest split behind a bin, -1 if none.

    The surface area heuristic.

    Args:
        bins: Of one axis, see `_bin_centres`, shape (_BINS, 7).
        right: Scratch space, shape (_BINS,).
        box: Scratch space, shape (6,).
    """
    right[:] = np.inf
    box[:3], box[3:] = np.inf, -np.inf
    total = 0.0
    for b in range(_BINS - 1, 0, -1):
        total += bins[b, 0]
        for j in range(3):
            box[j] = min(box[j], bins[b, 1 + j])
            box[3 + j] = max(box[3 + j], bins[b, 4 + j])
        if total > 0.0:
            right[b] = total * _half_area(box)
    box[:3], box[3:] = np.inf, -np.inf
    total = 0.0
    best, best_cost = -1, np.inf
    for b in range(_BINS - 1):
        total += bins[b, 0]
        for j in range(3):
            box[j] = min(box[j], bins[b, 1 + j])
            box[3 + j] = max(box[3 + j], bins[b, 4 + j])
        if total == 0.0:
            continue
        cost = total * _half_area(box) + right[b + 1]
        if cost < best_cost:
            best, best_cost = b, cost
    return best, best_cost


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
    bins = np.empty((3, _BINS, 7))
    right, box = np.empty(_BINS), np.empty(6)
    starts[0], ends[0] = 0, n
    used = 1
    node = 0
    while node < used:
        start, end = starts[node], ends[node]
        _bound(low, high, order, start, end, bounds[node])
        links[node, 0], links[node, 1] = start, end - start
        if end - start > _LEAF_SIZE:
            middle = start
            if depth[node] < _DEEP:
                first, scale = _bin_centres(
                    low, high, centre, order, start, end, bins
                )
                middle = _split(
                    centre, order, start, end, first, scale, bins, right, box
                )
            if middle == start or middle == end:
                # No plane separates the centres: halve the list as it is.
                middle = (start + end) // 2
            links[node, 0], links[node, 1] = used, 0
            starts[used], ends[used] = start, middle
            starts[used + 1], ends[used + 1] = middle, end
            depth[used] = depth[used + 1] = depth[node] + 1
            used += 2
        node += 1
    return order, bounds[:used].copy(), links[:used].copy()


@njit(cache=True, error_model="numpy")
def _bound(low, high, order, start, end, bounds):
    """Writes the box around triangles."""
    bounds[:3], bounds[3:] = np.inf, -np.inf
    for i in range(start, end):
        for j in range(3):
            bounds[j] = min(bounds[j], low[order[i], j])
            bounds[3 + j] = max(bounds[3 + j], high[order[i], j])


@njit(cache=True, error_model="numpy")
def _split(centre, order, start, end, first, scale, bins, right, box):
    """Sorts triangles to either side of the cheapest plane.

    Returns where the second side begins; the start if no plane separates them.
    """
    best_axis, best_plane, best_cost = -1, 0.0, np.inf
    for axis in range(3):
        if scale[axis] == 0.0:
            continue
        b, cost = _sweep(bins[axis], right, box)
        if cost < best_cost:
            best_axis, best_cost = axis, cost
            best_plane = first[axis] + (b + 1) / scale[axis]
    middle = start
    if best_axis >= 0:
        for i in range(start, end):
            if centre[order[i], best_axis] < best_plane:
                order[i], order[middle] = order[middle], order[i]
                middle += 1
    return middle
