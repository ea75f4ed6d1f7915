"""Which triangles of a mesh bound volumes, and which way they are turned.

A point is inside a surface if the surface winds around it. That needs
triangles that all run the same way around, which files do not always give:
single triangles are turned over, parts are inside out, or a stray triangle
bounds nothing.
"""

import numpy as np

from tofssm_drake.geometry.mesh_kernels import STACK, is_in_mesh
from tofssm_drake.geometry.triangle_tree import make_triangle_tree
from tofssm_drake.kernels import njit


def orient_faces(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turns the triangles of a mesh so that they run the same way around.

    Triangles that share an edge with no third one are in one part. A part is
    closed if each of its edges has as many of its triangles on either side,
    after single ones were turned over as most of the part runs. Triangles
    that are not in such a part, but share edges with one another, are a part,
    too, if they are closed the way they run. All others bound nothing.

    A part then encloses what is inside of it, whichever way it runs. But a
    part that is wholly within another one, and runs the other way, is a
    hollow in it. Vertices at the same place count as one, since files repeat
    them where a surface has a crease.

    Args:
        vertices: Positions, shape (v, 3), m.
        faces: Indices of each triangle's corners, shape (n, 3).

    Returns:
        (faces, is_solid): the faces, some turned over, and whether each is of
        a closed part, shape (n,).
    """
    places = np.unique(vertices + 0.0, axis=0, return_inverse=True)[1]
    corners = places.reshape(-1)[faces]
    # A triangle that is only a line or point bounds nothing.
    is_real = (
        (corners[:, 0] != corners[:, 1])
        & (corners[:, 1] != corners[:, 2])
        & (corners[:, 2] != corners[:, 0])
    )
    real = np.flatnonzero(is_real)
    if len(real) == 0:
        return faces, is_real
    turned, part = _find_closed_parts(corners[real], len(vertices))
    if not (part >= 0).any():
        return faces, np.zeros(len(faces), dtype=bool)
    faces = faces.copy()
    faces[real[turned]] = faces[real[turned], ::-1]
    inverted = _find_inverted_parts(vertices, faces[real], part)
    over = real[inverted[part] & (part >= 0)]
    faces[over] = faces[over, ::-1]
    # Nor does a line or point do harm: no ray crosses it.
    is_solid = ~is_real
    is_solid[real[part >= 0]] = True
    return faces, is_solid


def _find_closed_parts(corners, num_vertices):
    """Returns which triangles to turn over, and each one's part, -1: none."""
    n = len(corners)
    edges = np.vstack([corners[:, [i, (i + 1) % 3]] for i in range(3)])
    owner = np.tile(np.arange(n), 3)
    sign = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    key = np.sort(edges, axis=1) @ np.array([num_vertices, 1])
    _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    order = np.argsort(edge, kind="stable")
    # Neighbours in this list share an edge.
    first, second = order[:-1], order[1:]
    shares = edge[first] == edge[second]
    pairs = shares & (count[edge[first]] == 2)
    group, turned, is_orientable = _join(
        n,
        owner[first[pairs]],
        owner[second[pairs]],
        sign[first[pairs]] == sign[second[pairs]],
    )
    # As most of the part runs.
    most = np.bincount(group, turned, n) > 0.5 * np.bincount(group, None, n)
    turned ^= most[group]
    is_closed = is_orientable & _are_balanced(
        group[owner], edge, np.where(turned[owner], -sign, sign), n
    )
    part = np.where(is_closed[group], group, -1)
    rest = part < 0
    turned[rest] = False
    if rest.any():
        pairs = shares & rest[owner[first]] & rest[owner[second]]
        group, _, _ = _join(
            n,
            owner[first[pairs]],
            owner[second[pairs]],
            np.zeros(np.count_nonzero(pairs), dtype=bool),
        )
        mine = rest[owner]
        is_closed = _are_balanced(group[owner][mine], edge[mine], sign[mine], n)
        part = np.where(rest & is_closed[group], group, part)
    return turned, part


def _are_balanced(group, edge, sign, num_groups):
    """Returns whether each group's edges are run along equally either way."""
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
    """Returns for each number of a part whether all of it is to be turned."""
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
    # Some are: each within another one keeps how it runs beside that.
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
        # The smallest one around it comes last.
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
