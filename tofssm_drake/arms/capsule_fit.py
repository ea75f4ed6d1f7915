"""Fits capsules around a triangle mesh, see `capsules`."""

import numpy as np
from scipy.spatial import ConvexHull, KDTree, QhullError
import trimesh

from tofssm_drake.arms.capsules import Coverage, FittedCapsule

# Relative to a capsule's radius: what rounding may leave outside.
_MARGIN = 1e-9


def fit_capsules(
    mesh: trimesh.Trimesh, *, most: int = 4, gain: float = 1.0
) -> list[FittedCapsule]:
    """Fits capsules around a mesh.

    It begins with one capsule and shares out the triangles in the largest one
    to two, as long as that saves volume.

    Args:
        mesh: At least one triangle.
        most: How many capsules at most.
        gain: A cut must leave at most this share of a capsule's volume.

    Returns:
        At least one capsule.
    """
    # Small triangles can be shared out without cutting them.
    vertices, faces = trimesh.remesh.subdivide_to_size(
        mesh.vertices, mesh.faces, max_edge=float(max(mesh.extents)) / 12
    )
    triangles = vertices[faces]
    parts = [(triangles, _fit_capsule(triangles))]
    done: list[tuple[np.ndarray, FittedCapsule]] = []
    while parts and len(parts) + len(done) < most:
        parts.sort(key=lambda part: part[1].volume)
        whole, capsule = parts.pop()
        halves = _cut(whole)
        if halves and _sum_volumes(halves) <= gain * capsule.volume:
            parts += halves
        else:
            done.append((whole, capsule))
    return [capsule for _, capsule in done + parts]


def _sum_volumes(parts):
    return sum(capsule.volume for _, capsule in parts)


def _cut(triangles):
    """Returns the best cut of triangles in two parts, with their capsules."""
    centres = triangles.mean(axis=1)
    best: list[tuple[np.ndarray, FittedCapsule]] = []
    for axis in _find_axes(centres)[:3]:
        along = centres @ axis
        for share in (0.3, 0.5, 0.7):
            is_first = along < along.min() + share * np.ptp(along)
            if is_first.all() or not is_first.any():
                continue
            parts = [
                (half, _fit_capsule(half))
                for half in (triangles[is_first], triangles[~is_first])
            ]
            if not best or _sum_volumes(parts) < _sum_volumes(best):
                best = parts
    return best


def _fit_capsule(triangles):
    """Returns the smallest capsule of some directions around triangles."""
    points = _find_corners(triangles.reshape(-1, 3))
    axes = _find_axes(points)
    # Of each direction, two that are across it.
    _, _, frames = np.linalg.svd(axes[:, None])
    centres = _find_centres(np.einsum("kj,aij->aki", points, frames[:, 1:]))
    found = [
        _fit_along(points, axis, frame[1:], centre)
        for axis, frame, centre in zip(axes, frames, centres, strict=True)
    ]
    return min(found, key=lambda capsule: capsule.volume)


def _find_corners(points):
    """Returns the corners of the points' convex hull."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return points  # They lie in a plane.


def _find_axes(points):
    """Returns directions to try, (6, 3): the principal ones and the frame's."""
    _, _, principal = np.linalg.svd(points - points.mean(axis=0), False)
    return np.vstack([principal, np.eye(3)])


def _fit_along(points, axis, across, centre):
    """Returns the smallest capsule around points with its axis given."""
    distance = np.linalg.norm(points @ across.T - centre, axis=1)
    radius = float(distance.max())
    along = points @ axis
    # A point off the axis may be beyond the axis' end.
    beyond = np.sqrt(np.maximum(radius**2 - distance**2, 0.0))
    low, high = float((along + beyond).min()), float((along - beyond).max())
    if low > high:
        low = high = 0.5 * (low + high)
        radius = float(np.hypot(distance, along - low).max())
    origin = centre @ across
    return FittedCapsule(
        p=origin + low * axis,
        q=origin + high * axis,
        radius=max(radius, 1e-4) * (1.0 + _MARGIN),
    )


def _find_centres(points, steps=100):
    """Returns about the centres of the smallest circles around points.

    Steps towards the farthest point get ever smaller (Badoiu and Clarkson,
    2003); the circle around the result is slightly too large.

    Args:
        points: Of each of a circles, (a, k, 2).
        steps: How many.

    Returns:
        (a, 2).
    """
    rows = np.arange(len(points))
    centre = points.mean(axis=1)
    for i in range(1, steps + 1):
        distance = ((points - centre[:, None]) ** 2).sum(axis=2)
        farthest = points[rows, distance.argmax(axis=1)]
        centre = centre + (farthest - centre) / (i + 1)
    return centre


def calc_coverage(
    mesh: trimesh.Trimesh, capsules: list[FittedCapsule]
) -> Coverage:
    """Returns how well capsules cover a mesh.

    Args:
        mesh: Of a link.
        capsules: In the same frame, at least one.
    """
    vertices = np.asarray(mesh.vertices)
    outside = np.min([c.calc_distance(vertices) for c in capsules], axis=0)
    return Coverage(
        share_inside=float((outside <= 1e-9).mean()),
        farthest_outside=max(float(outside.max()), 0.0),
        farthest_excess=_calc_excess(mesh, capsules),
    )


def _calc_excess(mesh, capsules):
    """Returns how far the union of capsules stands out of a mesh, m."""
    surface, _ = trimesh.sample.sample_surface_even(mesh, 4000, seed=0)
    surface = np.vstack([surface, mesh.vertices])
    direction = np.asarray(trimesh.creation.icosphere(subdivisions=2).vertices)
    points = []
    for capsule in capsules:
        for t in np.linspace(0.0, 1.0, 9):
            centre = (1 - t) * capsule.p + t * capsule.q
            shell = centre + capsule.radius * direction
            inner = np.min([c.calc_distance(shell) for c in capsules], axis=0)
            points.append(shell[inner > -1e-6])
    tree = KDTree(surface)
    distance, _ = tree.query(np.vstack(points))
    return float(np.max(distance))
