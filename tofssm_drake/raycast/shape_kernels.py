"""Compiled queries of one ray against one primitive shape.

All shapes are cast in their own frame G, the canonical frame of Drake's
shape specifications. A shape is a closed set of points: the distance along a
ray is the smallest t >= 0 with p + t d in the shape. The casts expect an
origin outside the shape; inf is a miss.

They select values instead of branching, so that the compiler can cast several
rays at a time.
"""

import numpy as np

from tofssm_drake.kernels import njit

SPHERE = 0
"""Sizes: radius, -, -."""
CAPSULE = 1
"""Sizes: radius, half the length of the axis, -; along z."""
CYLINDER = 2
"""Sizes: radius, half the length, -; along z."""
BOX = 3
"""Sizes: half width, half depth, half height."""
HALF_SPACE = 4
"""The points with z <= 0; no sizes."""
ELLIPSOID = 5
"""Sizes: the semi-axes a, b, c."""

# A ray this steep runs along the axis: it cannot leave the tube sideways.
_PARALLEL = 1e-290
_MARGIN = 1e-9


@njit(cache=True, error_model="numpy", forceinline=True)
def cast_sphere(px, py, pz, dx, dy, dz, radius):
    """Returns the distance to a sphere about the origin."""
    along = -(px * dx + py * dy + pz * dz)
    # Of the ray's point nearest the centre: this keeps its digits where the
    # ray grazes.
    qx, qy, qz = px + along * dx, py + along * dy, pz + along * dz
    rest = radius * radius - (qx * qx + qy * qy + qz * qz)
    t = max(along - np.sqrt(max(rest, 0.0)), 0.0)
    return np.inf if (along < 0.0) | (rest < 0.0) else t


@njit(cache=True, error_model="numpy", forceinline=True)
def cast_ellipsoid(px, py, pz, dx, dy, dz, a, b, c):
    """Returns the distance to an ellipsoid with these semi-axes."""
    # Scaled to the unit sphere; the direction then no longer has unit length.
    ex, ey, ez = dx / a, dy / b, dz / c
    scale = np.sqrt(ex * ex + ey * ey + ez * ez)
    return (
        cast_sphere(
            px / a, py / b, pz / c, ex / scale, ey / scale, ez / scale, 1.0
        )
        / scale
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _clip_tube(px, py, dx, dy, radius):
    """Returns (enter, leave, hits, parallel) of a tube along z.

    Enter and leave may be negative. A parallel ray is always in the tube
    (hits) or never; enter and leave are then meaningless.
    """
    slope2 = dx * dx + dy * dy
    parallel = slope2 < _PARALLEL
    slope2 = 1.0 if parallel else slope2
    slope = np.sqrt(slope2)
    across = abs(px * dy - py * dx)
    across = np.sqrt(px * px + py * py) if parallel else across
    # The factored form keeps its digits where the ray grazes.
    rest = (radius * slope - across) * (radius * slope + across)
    half = np.sqrt(max(rest, 0.0))
    along = -(px * dx + py * dy)
    return (
        (along - half) / slope2,
        (along + half) / slope2,
        rest >= 0.0,
        parallel,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def cast_capsule(px, py, pz, dx, dy, dz, radius, half):
    """Returns the distance to a capsule along z."""
    t, _, hits, parallel = _clip_tube(px, py, dx, dy, radius)
    z = -dz if parallel else pz + t * dz
    # If the tube is entered beyond one end, only that end can be met.
    end = half if z > 0.0 else -half
    t_end = cast_sphere(px, py, pz - end, dx, dy, dz, radius)
    # Behind the origin: the ray has left the (convex) shape.
    t = t if t >= 0.0 else np.inf
    t = t if (abs(z) <= half) & (not parallel) else t_end
    return t if hits else np.inf


@njit(cache=True, error_model="numpy", forceinline=True)
def _clip_slab(p, d, half, enter, leave):
    """Clips the interval [enter, leave] of a ray to |p + t d| <= half."""
    # The general formula has 0 * inf; the ray is always in the slab or never.
    never = (d == 0.0) & (abs(p) > half)
    always = (d == 0.0) & (abs(p) <= half)
    first = (-half - p) / d
    second = (half - p) / d
    low = -np.inf if always else min(first, second)
    high = np.inf if always else max(first, second)
    high = -np.inf if never else high
    return max(enter, low), min(leave, high)


@njit(cache=True, error_model="numpy", forceinline=True)
def cast_cylinder(px, py, pz, dx, dy, dz, radius, half):
    """Returns the distance to a cylinder along z."""
    enter, leave = _clip_slab(pz, dz, half, 0.0, np.inf)
    first, last, hits, parallel = _clip_tube(px, py, dx, dy, radius)
    enter = enter if parallel else max(enter, first)
    leave = leave if parallel else min(leave, last)
    return enter if (enter <= leave) & hits else np.inf


@njit(cache=True, error_model="numpy", forceinline=True)
def cast_box(px, py, pz, dx, dy, dz, hx, hy, hz):
    """Returns the distance to a box with these half sizes."""
    enter, leave = _clip_slab(px, dx, hx, 0.0, np.inf)
    enter, leave = _clip_slab(py, dy, hy, enter, leave)
    enter, leave = _clip_slab(pz, dz, hz, enter, leave)
    return enter if enter <= leave else np.inf


@njit(cache=True, error_model="numpy", forceinline=True)
def cast_half_space(pz, dz):
    """Returns the distance to the half-space below z = 0."""
    return -pz / dz if dz < 0.0 else np.inf


@njit(cache=True, error_model="numpy")
def is_in_primitive(kind, x, y, z, a, b, c):
    """Returns whether a point in G is inside a shape or on its surface."""
    if kind == SPHERE:
        return np.sqrt(x * x + y * y + z * z) <= a
    if kind == CAPSULE:
        z = max(abs(z) - b, 0.0)
        return np.sqrt(x * x + y * y + z * z) <= a
    if kind == CYLINDER:
        return abs(z) <= b and np.sqrt(x * x + y * y) <= a
    if kind == BOX:
        return abs(x) <= a and abs(y) <= b and abs(z) <= c
    if kind == HALF_SPACE:
        return z <= 0.0
    x, y, z = x / a, y / b, z / c
    return np.sqrt(x * x + y * y + z * z) <= 1.0


@njit(cache=True, error_model="numpy")
def cast_primitive(kind, px, py, pz, dx, dy, dz, a, b, c):
    """Returns the distance along a ray that starts outside, inf: miss."""
    if kind == SPHERE:
        return cast_sphere(px, py, pz, dx, dy, dz, a)
    if kind == CAPSULE:
        return cast_capsule(px, py, pz, dx, dy, dz, a, b)
    if kind == CYLINDER:
        return cast_cylinder(px, py, pz, dx, dy, dz, a, b)
    if kind == BOX:
        return cast_box(px, py, pz, dx, dy, dz, a, b, c)
    if kind == HALF_SPACE:
        return cast_half_space(pz, dz)
    return cast_ellipsoid(px, py, pz, dx, dy, dz, a, b, c)


@njit(cache=True, error_model="numpy")
def leave_primitive(kind, px, py, pz, dx, dy, dz, a, b, c):
    """Returns the distance at which a ray that starts inside leaves."""
    if kind == SPHERE:
        return _leave_sphere(px, py, pz, dx, dy, dz, a)
    if kind == CAPSULE:
        # Of the tube between the ends, and of the ends.
        t = _leave_cylinder(px, py, pz, dx, dy, dz, a, b)
        t = max(t, _leave_sphere(px, py, pz - b, dx, dy, dz, a))
        return max(t, _leave_sphere(px, py, pz + b, dx, dy, dz, a))
    if kind == CYLINDER:
        return _leave_cylinder(px, py, pz, dx, dy, dz, a, b)
    if kind == BOX:
        _, leave = _clip_slab(px, dx, a, 0.0, np.inf)
        _, leave = _clip_slab(py, dy, b, 0.0, leave)
        _, leave = _clip_slab(pz, dz, c, 0.0, leave)
        return max(leave, 0.0)
    if kind == HALF_SPACE:
        return -pz / dz if dz > 0.0 else np.inf
    ex, ey, ez = dx / a, dy / b, dz / c
    scale = np.sqrt(ex * ex + ey * ey + ez * ez)
    t = _leave_sphere(
        px / a, py / b, pz / c, ex / scale, ey / scale, ez / scale, 1.0
    )
    return t / scale


@njit(cache=True, error_model="numpy")
def _leave_sphere(px, py, pz, dx, dy, dz, radius):
    """Returns where a ray leaves a sphere about the origin, 0 if never."""
    along = -(px * dx + py * dy + pz * dz)
    qx, qy, qz = px + along * dx, py + along * dy, pz + along * dz
    rest = radius * radius - (qx * qx + qy * qy + qz * qz)
    return max(along + np.sqrt(rest), 0.0) if rest >= 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _leave_cylinder(px, py, pz, dx, dy, dz, radius, half):
    """Returns where a ray leaves a cylinder along z, 0 if never."""
    enter, leave = _clip_slab(pz, dz, half, 0.0, np.inf)
    first, last, hits, parallel = _clip_tube(px, py, dx, dy, radius)
    enter = enter if parallel else max(enter, first)
    leave = leave if parallel else min(leave, last)
    return max(leave, 0.0) if hits & (enter <= leave) else 0.0


@njit(cache=True, error_model="numpy")
def find_normal(kind, a, b, c, x, y, z, dx, dy, dz):
    """Returns the direction of a primitive's normal at (x, y, z), in G.

    On an edge there are several: returns the one that faces the ray most.
    """
    if kind == SPHERE:
        return x, y, z
    if kind == CAPSULE:
        return x, y, z - min(max(z, -b), b)
    if kind == ELLIPSOID:
        return x / (a * a), y / (b * b), z / (c * c)
    if kind == CYLINDER:
        tube = np.sqrt(x * x + y * y)
        side, end = tube - a, abs(z) - b
        up = np.copysign(1.0, z)
        if abs(side - end) < _MARGIN * (a + b):
            is_end = up * dz < (x * dx + y * dy) / tube
        else:
            is_end = end > side
        return (0.0, 0.0, up) if is_end else (x, y, 0.0)
    if kind == BOX:
        # How far the ray goes against each side's normal; the sides that the
        # point is not on do not count.
        ux, uy, uz = (
            np.copysign(1.0, x),
            np.copysign(1.0, y),
            np.copysign(1.0, z),
        )
        rx, ry, rz = abs(x) - a, abs(y) - b, abs(z) - c
        on = max(rx, max(ry, rz)) - _MARGIN * (a + b + c)
        fx = -dx * ux if rx >= on else -np.inf
        fy = -dy * uy if ry >= on else -np.inf
        fz = -dz * uz if rz >= on else -np.inf
        if fx >= fy and fx >= fz:
            return ux, 0.0, 0.0
        if fy >= fz:
            return 0.0, uy, 0.0
        return 0.0, 0.0, uz
    return 0.0, 0.0, 1.0
