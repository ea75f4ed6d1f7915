"""Which triangles of a mesh bound volumes, and how they are oriented.

A point is inside a surface if the surface winds around it. That needs
consistently oriented triangles, which files do not always have: single
triangles are turned over, parts are inside out, or a stray triangle bounds
nothing.
"""

import itertools

import numpy as np

from tofssm_drake.kernels import njit
from tofssm_drake.raycast.mesh_kernels import STACK, is_in_mesh
from tofssm_drake.raycast.triangle_tree import make_triangle_tree

# Corners this near to each other are one, in units of the largest coordinate:
# several roundings of single precision (*assumed*: what exporters leave).
_WELD = 1e-6


def check_corners(vertices: np.ndarray, corners: np.ndarray) -> None:
    """Checks that all vertices are finite and all corners are vertices."""
    bad = corners[(corners < 0) | (corners >= len(vertices))]
    if bad.size > 0:
        raise ValueError(
            f"the index {bad.flat[0]} is not one of its"
            f" {len(vertices)} vertices"
        )
    if not np.isfinite(vertices[corners]).all():
        raise ValueError("it has a vertex that is not finite")


def orient_faces(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orients the triangles of a mesh consistently.

    Triangles that share an edge with no third one are in one part. A part is
    closed if each of its edges is used equally often in either direction,
    after single triangles were turned over to match the majority. Other
    triangles that share edges are a part, too, if they are closed with the
    orientation of the file. All others bound nothing.

    Vertices at the same place count as one, since files repeat them where a
    surface has a crease. Of several triangles with the same corners one
    counts, unless it takes all of them to close a part. What is still open is
    tried again with corners welded that differ by rounding.

    A part encloses what is inside it, whatever its orientation. But a part
    wholly within another one, and of opposite orientation, is a hollow in it.

    Args:
        vertices: Positions, shape (v, 3), m.
        faces: Indices of each triangle's corners, shape (n, 3).

    Returns:
        (faces, is_solid, welded): the faces, some turned over; whether each
        is of a closed part, shape (n,); and the vertices to take for the
        closed parts, which are `vertices` itself if no part was welded.
    """
    places = _number_rows(vertices)
    everything = np.ones(len(faces), dtype=bool)
    turned, part = _find_closed_parts(places[faces], everything)
    is_open = (part < 0) & ~_are_repeated(places[faces], part)
    welded = vertices
    if is_open.any():
        near = _weld(vertices, faces[is_open], places)
        again, more = _find_closed_parts(near[faces], is_open)
        is_new = more >= 0
        if is_new.any():
            turned, part = turned | again, np.where(is_new, more, part)
            welded = _move_to_places(vertices, faces[is_new], near)
    is_closed = part >= 0
    if not is_closed.any():
        return faces, is_closed, vertices
    faces = faces.copy()
    faces[turned] = faces[turned, ::-1]
    inverted = _find_inverted_parts(welded, faces, part)
    over = inverted[part] & is_closed
    faces[over] = faces[over, ::-1]
    # Degenerate triangles do no harm: no ray crosses them.
    return faces, is_closed | ~_are_real(places[faces]), welded


def _number_rows(rows: np.ndarray) -> np.ndarray:
    """Returns a number for each row, the same for equal ones, from 0 on."""
    order = np.lexsort(rows.T)
    is_new = np.ones(len(rows), dtype=bool)
    is_new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    numbers = np.empty(len(rows), dtype=np.int64)
    numbers[order] = np.cumsum(is_new) - 1
    return numbers


def _weld(vertices, faces, places) -> np.ndarray:
    """Returns the places of vertices, one for those that are near each other.

    Only corners of the given faces are welded.
    """
    used, first = np.unique(places[faces], return_index=True)
    points = vertices[faces.reshape(-1)[first]]
    group = _group_near(points, _WELD * np.abs(points).max())
    welded = np.arange(places.max() + 1)
    welded[used] = used[group]
    return welded[places]


def _group_near(points: np.ndarray, within: float) -> np.ndarray:
    """Returns a number for each point, the same for those near each other.

    They are sorted into cells of twice the distance, in each dimension once
    shifted by half a cell and once not, so that near ones share one of them.
    """
    if not within > 0.0:
        return np.zeros(len(points), dtype=np.int64)
    first, second = [], []
    for shift in itertools.product((0.0, 0.5), repeat=3):
        cells = np.floor(points / (2.0 * within) + shift)
        order = np.lexsort(cells.T)
        same = (cells[order[1:]] == cells[order[:-1]]).all(axis=1)
        first.append(order[:-1][same])
        second.append(order[1:][same])
    group, _, _ = _join(
        len(points),
        np.concatenate(first),
        np.concatenate(second),
        np.zeros(sum(map(len, first)), dtype=bool),
    )
    return group


def _move_to_places(vertices, faces, places) -> np.ndarray:
    """Returns the vertices, with equal values for those at the same place.

    Only corners of the given faces are moved.
    """
    used = np.unique(faces)
    _, first, index = np.unique(
        places[used], return_index=True, return_inverse=True
    )
    moved = vertices.copy()
    moved[used] = vertices[used[first]][index.reshape(-1)]
    return moved


def _find_closed_parts(corners, is_open):
    """Returns which triangles to turn over, and each one's part, -1: none.

    Args:
        corners: Place of each triangle's corners, shape (n, 3).
        is_open: Which triangles are looked at, bool, shape (n,).
    """
    # A triangle that is only a line or point bounds nothing.
    is_open = is_open & _are_real(corners)
    turned, part = np.zeros(len(corners), dtype=bool), np.full(len(corners), -1)
    rows = np.flatnonzero(is_open)
    if len(rows) == 0:
        return turned, part
    # One of those with the same corners.
    numbers = _number_rows(np.sort(corners[rows], axis=1))
    single = rows[np.sort(np.unique(numbers, return_index=True)[1])]
    turned[single], group = _find_even_parts(corners[single])
    part[single] = np.where(group >= 0, single[group], -1)
    # The rest is tried as oriented in the file, repeated triangles included.
    rest = np.flatnonzero(is_open & (part < 0) & ~_are_repeated(corners, part))
    if len(rest) > 0:
        group = _find_balanced_parts(corners[rest])
        part[rest] = np.where(group >= 0, rest[group], -1)
    return turned, part


def _are_repeated(corners, part):
    """Returns whether a triangle has the same corners as one of a part."""
    if (part >= 0).all() or not (part >= 0).any():
        return np.zeros(len(corners), dtype=bool)
    numbers = _number_rows(np.sort(corners, axis=1))
    is_closed = np.zeros(numbers.max() + 1, dtype=bool)
    is_closed[numbers[part >= 0]] = True
    return is_closed[numbers] & (part < 0)


def _are_real(corners):
    """Returns whether triangles have three different corners."""
    return (
        (corners[:, 0] != corners[:, 1])
        & (corners[:, 1] != corners[:, 2])
        & (corners[:, 2] != corners[:, 0])
    )


def _list_edges(corners):
    """Returns edges' numbers, their triangles, and which way they run."""
    edges = np.vstack([corners[:, [i, (i + 1) % 3]] for i in range(3)])
    owner = np.tile(np.arange(len(corners)), 3)
    sign = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    key = np.sort(edges, axis=1) @ np.array([corners.max() + 1, 1])
    _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
    return edge.reshape(-1), owner, sign, count


def _pair_up(edge, count, most):
    """Returns rows of `edge`, pairwise equal, with at most `most` equal."""
    order = np.argsort(edge, kind="stable")
    # Neighbours in this list share an edge.
    first, second = order[:-1], order[1:]
    shares = (edge[first] == edge[second]) & (count[edge[first]] <= most)
    return first[shares], second[shares]


def _find_even_parts(corners):
    """Finds parts whose edges have two triangles; any may be turned over.

    Returns:
        (turned, part): which triangles to turn over, and the number of each
        one's part, the row of a triangle, -1 if it is not closed.
    """
    n = len(corners)
    edge, owner, sign, count = _list_edges(corners)
    first, second = _pair_up(edge, count, 2)
    group, turned, is_orientable = _join(
        n, owner[first], owner[second], sign[first] == sign[second]
    )
    # To match the majority of the part.
    most = np.bincount(group, turned, n) > 0.5 * np.bincount(group, None, n)
    turned ^= most[group]
    is_closed = is_orientable & _are_balanced(
        group[owner], edge, np.where(turned[owner], -sign, sign), n
    )
    part = np.where(is_closed[group], group, -1)
    return turned & (part >= 0), part


def _find_balanced_parts(corners):
    """Finds parts that are closed as oriented; returns each triangle's part.

    Any number of triangles may share an edge.
    """
    n = len(corners)
    edge, owner, sign, count = _list_edges(corners)
    first, second = _pair_up(edge, count, n * 3)
    nothing = np.zeros(len(first), dtype=bool)
    group, _, _ = _join(n, owner[first], owner[second], nothing)
    is_closed = _are_balanced(group[owner], edge, sign, n)
    return np.where(is_closed[group], group, -1)


def _are_balanced(group, edge, sign, num_groups):
    """Returns whether each group uses its edges equally in either direction."""
    keys, index = np.unique(
        group * (edge.max() + 1) + edge, return_inverse=True
    )
    excess = np.bincount(index.reshape(-1), weights=sign) != 0.0
    good = np.ones(num_groups, dtype=bool)
    good[keys[excess] // (edge.max() + 1)] = False
    return good


@njit(cache=True)
def _join(n, first, second, differ):
    """Joins items pairwise into groups.

    Args:
        n: Number of items.
        first: One item of each pair.
        second: The other one.
        differ: Whether one of the two must be turned over, bool.

    Returns:
        (group, turned, is_consistent): each item's group, a number below n,
        whether it is turned over, and whether that could be done for the
        group of this number; shape (n,).
    """
    parent = np.arange(n)
    turned = np.zeros(n, dtype=np.bool_)
    size = np.ones(n, dtype=np.int64)
    is_consistent = np.ones(n, dtype=np.bool_)
    for k in range(len(first)):
        a, b, flip = first[k], second[k], differ[k]
        while parent[a] != a:
            flip ^= turned[a]
            a = parent[a]
        while parent[b] != b:
            flip ^= turned[b]
            b = parent[b]
        if a == b:
            is_consistent[a] &= not flip
            continue
        if size[a] < size[b]:
            a, b = b, a
        parent[b] = a
        turned[b] = flip
        size[a] += size[b]
        is_consistent[a] &= is_consistent[b]
    group = np.empty(n, dtype=np.int64)
    total = np.empty(n, dtype=np.bool_)
    for i in range(n):
        a, flip = i, False
        while parent[a] != a:
            flip ^= turned[a]
            a = parent[a]
        group[i], total[i] = a, flip
    return group, total, is_consistent


def _find_inverted_parts(vertices, faces, part):
    """Returns for each part's number whether the whole part is inside out."""
    p = vertices[faces] - vertices[faces[0, 0]]
    volume = np.bincount(
        part[part >= 0],
        np.einsum("ni,ni->n", p[:, 0], np.cross(p[:, 1], p[:, 2]))[part >= 0],
        len(faces),
    )
    inverted = volume < 0.0
    numbers = np.unique(part[part >= 0])
    if not inverted.any() or inverted[numbers].all():
        return inverted
    # Only some are: one within another keeps its orientation relative to it.
    numbers = numbers[np.argsort(-np.abs(volume[numbers]), kind="stable")]
    order = np.argsort(part, kind="stable")
    starts, ends = np.searchsorted(part[order], [numbers, numbers + 1])
    parts = [
        faces[order[start:end]] for start, end in zip(starts, ends, strict=True)
    ]
    places = [np.unique(part_faces) for part_faces in parts]
    low = np.array([vertices[i].min(axis=0) for i in places])
    high = np.array([vertices[i].max(axis=0) for i in places])
    trees = {}
    for j, number in enumerate(numbers):
        fits = (low[:j] <= low[j]).all(axis=1) & (high[:j] >= high[j]).all(
            axis=1
        )
        # The smallest enclosing one comes last.
        for i in np.flatnonzero(fits)[::-1]:
            if i not in trees:
                trees[i] = make_triangle_tree(vertices, parts[i])
            tree = trees[i]
            if _are_in(tree.nodes, tree.triangles, vertices[places[j]]):
                inverted[number] = inverted[numbers[i]]
                break
    return inverted


@njit(cache=True)
def _are_in(nodes, triangles, points):
    """Returns whether all points are inside a closed mesh or on it."""
    stack = np.empty((2, STACK))
    for i in range(len(points)):
        if not is_in_mesh(nodes, triangles, 0, 0, points[i], 0.0, stack):
            return False
    return True
