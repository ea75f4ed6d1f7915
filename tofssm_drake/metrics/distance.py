"""Closest points between capsules, in closed form.

A capsule is a segment p-q with a radius; a sphere is a capsule whose segment
has no length. Everything is in one frame, in metres.
"""

from typing import NamedTuple

import numpy as np

from tofssm_drake.kernels import njit


class _Capsules(NamedTuple):
    """A set of n capsules."""

    p: np.ndarray
    """First ends, shape (n, 3)."""
    q: np.ndarray
    """Second ends, shape (n, 3)."""
    r: np.ndarray
    """Radii, shape (n,)."""


@njit(cache=True, error_model="numpy")
def _project_on_segment(x, y, z, p, q):
    """Returns the parameter in [0, 1] of the segment's point nearest x."""
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    length2 = ux * ux + uy * uy + uz * uz
    if length2 == 0.0:
        return 0.0
    along = (x - p[0]) * ux + (y - p[1]) * uy + (z - p[2]) * uz
    return min(max(along / length2, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def _subtract(p, q):
    return p[0] - q[0], p[1] - q[1], p[2] - q[2]


@njit(cache=True, error_model="numpy")
def _cross(ux, uy, uz, vx, vy, vz):
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, error_model="numpy")
def _gap2(a, b, s, t, c, d):
    """Returns the squared distance of the points at s on ab and t on cd."""
    total = 0.0
    for i in range(3):
        step = (c[i] + t * (d[i] - c[i])) - (a[i] + s * (b[i] - a[i]))
        total += step * step
    return total


@njit(cache=True, error_model="numpy")
def _closest_on_segments(a, b, c, d):
    """Returns (s, t, squared distance) of the closest points of ab and cd.

    Either the closest points are inside both segments, where the line
    between them is normal to both, or one of them is an end point. All
    candidates are tried, so parallel and degenerate segments need no threshold.
    """
    best_s = 0.0
    best_t = _project_on_segment(a[0], a[1], a[2], c, d)
    best = _gap2(a, b, 0.0, best_t, c, d)
    t = _project_on_segment(b[0], b[1], b[2], c, d)
    gap = _gap2(a, b, 1.0, t, c, d)
    if gap < best:
        best_s, best_t, best = 1.0, t, gap
    s = _project_on_segment(c[0], c[1], c[2], a, b)
    gap = _gap2(a, b, s, 0.0, c, d)
    if gap < best:
        best_s, best_t, best = s, 0.0, gap
    s = _project_on_segment(d[0], d[1], d[2], a, b)
    gap = _gap2(a, b, s, 1.0, c, d)
    if gap < best:
        best_s, best_t, best = s, 1.0, gap

    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = d[0] - c[0], d[1] - c[1], d[2] - c[2]
    # The cross product keeps its digits for nearly parallel segments, where
    # the difference of the squared products loses all of them.
    nx, ny, nz = _cross(ux, uy, uz, vx, vy, vz)
    n2 = nx * nx + ny * ny + nz * nz
    if n2 > 0.0:
        wx, wy, wz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        s = (
            (wy * vz - wz * vy) * nx
            + (wz * vx - wx * vz) * ny
            + (wx * vy - wy * vx) * nz
        ) / n2
        if 0.0 < s < 1.0:
            t = _project_on_segment(
                a[0] + s * ux, a[1] + s * uy, a[2] + s * uz, c, d
            )
            gap = _gap2(a, b, s, t, c, d)
            if gap < best:
                best_s, best_t, best = s, t, gap
    return best_s, best_t, best


@njit(cache=True, error_model="numpy")
def _calc_bounding_balls(p, q, r, ball):
    """Writes centre and radius of the ball around each capsule."""
    for i in range(r.shape[0]):
        size2 = 0.0
        for k in range(3):
            ball[i, k] = 0.5 * (p[i, k] + q[i, k])
            size2 += (0.5 * (q[i, k] - p[i, k])) ** 2
        # A hair of slack, so that rounding never rules a pair out wrongly.
        ball[i, 3] = r[i] + np.sqrt(size2) + 1e-12


@njit(cache=True, error_model="numpy")
def _bound_distances(a, b, bound):
    """Writes lower bounds of all pairs' distances, from their bounding balls.

    Args:
        a: Capsules A, see _Capsules.
        b: Capsules B.
        bound: Written, shape (n, m); up to the first NaN.

    Returns:
        (i, j): the pair with the lowest bound, or the first with a NaN, -1
        if there is none.
    """
    n, m = bound.shape
    a_ball, b_ball = np.empty((n, 4)), np.empty((m, 4))
    _calc_bounding_balls(a.p, a.q, a.r, a_ball)
    _calc_bounding_balls(b.p, b.q, b.r, b_ball)
    first_i, first_j = -1, -1
    nearest = np.inf
    for i in range(n):
        for j in range(m):
            x = a_ball[i, 0] - b_ball[j, 0]
            y = a_ball[i, 1] - b_ball[j, 1]
            z = a_ball[i, 2] - b_ball[j, 2]
            gap = np.sqrt(x * x + y * y + z * z)
            bound[i, j] = gap - a_ball[i, 3] - b_ball[j, 3]
            if np.isnan(bound[i, j]):
                return i, j
            if bound[i, j] < nearest or first_i < 0:
                first_i, first_j, nearest = i, j, bound[i, j]
    return first_i, first_j


@njit(cache=True, error_model="numpy")
def _find_closest_pair(a, b, bound, i, j):
    """Returns (distance, i, j, s, t) of the closest pair and its points.

    Args:
        a: Capsules A, see _Capsules.
        b: Capsules B.
        bound: Lower bounds of the distances, shape (n, m).
        i: With j, the pair that is measured first.
        j: See i.
    """
    best_i, best_j = first_i, first_j = i, j
    best_s, best_t, gap2 = _closest_on_segments(a.p[i], a.q[i], b.p[j], b.q[j])
    distance = np.sqrt(gap2) - a.r[i] - b.r[j]
    for i in range(bound.shape[0]):
        for j in range(bound.shape[1]):
            if bound[i, j] >= distance or (i == first_i and j == first_j):
                continue
            s, t, gap2 = _closest_on_segments(a.p[i], a.q[i], b.p[j], b.q[j])
            signed = np.sqrt(gap2) - a.r[i] - b.r[j]
            if signed < distance:
                distance = signed
                best_i, best_j, best_s, best_t = i, j, s, t
    return distance, best_i, best_j, best_s, best_t


@njit(cache=True, error_model="numpy")
def _find_square(ux, uy, uz, vx, vy, vz):
    """Returns (x, y, z, length) of a vector normal to two others, length > 0.

    If they are parallel, or one is zero, normal to the longer one.
    """
    x, y, z = _cross(ux, uy, uz, vx, vy, vz)
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        return x, y, z, length
    if ux * ux + uy * uy + uz * uz < vx * vx + vy * vy + vz * vz:
        ux, uy, uz = vx, vy, vz
    if abs(ux) < abs(uz):
        x, y, z = _cross(ux, uy, uz, 1.0, 0.0, 0.0)
    else:
        x, y, z = _cross(ux, uy, uz, 0.0, 0.0, 1.0)
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        return x, y, z, length
    return 1.0, 0.0, 0.0, 1.0


@njit(cache=True, error_model="numpy")
def closest_capsules(a_p, a_q, a_r, b_p, b_q, b_r):
    """Returns where two sets of capsules come closest (compiled).

    Args:
        a_p: First ends of the n capsules A, shape (n, 3).
        a_q: Second ends, shape (n, 3).
        a_r: Radii, shape (n,).
        b_p: First ends of the m capsules B, shape (m, 3).
        b_q: Second ends, shape (m, 3).
        b_r: Radii, shape (m,).

    Returns:
        (distance, i, j, p_A, p_B): the smallest signed distance over all
        pairs (negative: overlap), the pair, and its witness points on both
        surfaces, each of shape (3,). If a set is empty: inf, -1, -1, NaN.
        If a number is NaN, so is the distance. Where two axes cross there is
        no direction from one to the other: the witness points are then taken
        normal to both axes.
    """
    a, b = _Capsules(a_p, a_q, a_r), _Capsules(b_p, b_q, b_r)
    p_A, p_B = np.full(3, np.nan), np.full(3, np.nan)
    # The pair whose bounding balls are nearest is measured first: most of the
    # others are then ruled out by theirs.
    bound = np.empty((a_r.shape[0], b_r.shape[0]))
    i, j = _bound_distances(a, b, bound)
    if i < 0:
        return np.inf, i, j, p_A, p_B
    if np.isnan(bound[i, j]):
        # An unknown pair must not read as a far one.
        return np.nan, i, j, p_A, p_B
    distance, i, j, s, t = _find_closest_pair(a, b, bound, i, j)
    for k in range(3):
        p_A[k] = a_p[i, k] + s * (a_q[i, k] - a_p[i, k])
        p_B[k] = b_p[j, k] + t * (b_q[j, k] - b_p[j, k])
    x, y, z = _subtract(p_B, p_A)
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        ux, uy, uz = _subtract(a_q[i], a_p[i])
        vx, vy, vz = _subtract(b_q[j], b_p[j])
        x, y, z, length = _find_square(ux, uy, uz, vx, vy, vz)
    # From the axes to the surfaces.
    step = a_r[i] / length
    p_A[0] += step * x
    p_A[1] += step * y
    p_A[2] += step * z
    step = b_r[j] / length
    p_B[0] -= step * x
    p_B[1] -= step * y
    p_B[2] -= step * z
    return distance, i, j, p_A, p_B


@njit(cache=True, error_model="numpy")
def point_to_capsules(points, b_p, b_q, b_r):
    """Returns each point's signed distance to the nearest capsule (compiled).

    Args:
        points: Points, shape (m, 3).
        b_p: First ends of the capsules, shape (n, 3).
        b_q: Second ends, shape (n, 3).
        b_r: Radii, shape (n,).

    Returns:
        Distance to the nearest surface, negative inside, shape (m,); inf if
        there is no capsule; NaN if any number is.
    """
    result = np.full(points.shape[0], np.inf)
    for i in range(points.shape[0]):
        p = points[i]
        for j in range(b_r.shape[0]):
            t = _project_on_segment(p[0], p[1], p[2], b_p[j], b_q[j])
            gap2 = _gap2(p, p, 0.0, t, b_p[j], b_q[j])
            for k in range(3):
                # Comparisons hide a NaN; this brings it back.
                gap2 += 0.0 * (b_p[j, k] + b_q[j, k])
            signed = np.sqrt(gap2) - b_r[j]
            if np.isnan(signed):
                result[i] = np.nan
                break
            if signed < result[i]:
                result[i] = signed
    return result
