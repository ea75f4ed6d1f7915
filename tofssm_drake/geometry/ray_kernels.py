"""Compiled kernels of the ray caster: one ray or fan against the shapes.

All shapes are cast in their own frame G, the canonical frame of Drake's
shape specifications. A shape is a closed set of points: the distance along a
ray is the smallest t >= 0 with p + t d in the shape, hence 0 for an origin
that is inside or on the surface.

The scene is handed over in a few arrays, since each one costs a fraction of
a microsecond on the way into compiled code. For the n shapes:

  shape_int   (n, 2)   kind, row of the shape's frame in X_WF
  shape_float (n, 19)  X_FG row by row (12), sizes (3), centre p_FC of the
                       bounding sphere (3), its radius
"""

from numba import njit
import numpy as np

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

KIND, FRAME = 0, 1
SHAPE_INTS = 2
SIZE, CENTRE, RADIUS = 12, 15, 18
SHAPE_FLOATS = 19

OK = 0
BAD_POSE = 1
BAD_RAY = 2


@njit(cache=True, error_model="numpy")
def _enter_circle(along, across, radius):
    """Returns how far a unit ray goes to a circle or sphere, inf for a miss.

    Args:
        along: Distance along the ray to the point nearest the centre.
        across: Distance of that point from the centre.
        radius: Radius of the circle or sphere.

    Returns:
        The distance of the entry point, negative behind the origin.
    """
    # The factored form keeps its digits where the ray grazes.
    rest = (radius - across) * (radius + across)
    if rest < 0.0:
        return np.inf
    return along - np.sqrt(rest)


@njit(cache=True, error_model="numpy")
def _cast_sphere(px, py, pz, dx, dy, dz, radius):
    along = -(px * dx + py * dy + pz * dz)
    if along < 0.0:
        return np.inf
    qx, qy, qz = px + along * dx, py + along * dy, pz + along * dz
    across = np.sqrt(qx * qx + qy * qy + qz * qz)
    return max(_enter_circle(along, across, radius), 0.0)


@njit(cache=True, error_model="numpy")
def _cast_ellipsoid(px, py, pz, dx, dy, dz, a, b, c):
    # Scaled to the unit sphere; the direction then is no longer a unit.
    ex, ey, ez = dx / a, dy / b, dz / c
    scale = np.sqrt(ex * ex + ey * ey + ez * ez)
    return (
        _cast_sphere(
            px / a, py / b, pz / c, ex / scale, ey / scale, ez / scale, 1.0
        )
        / scale
    )


@njit(cache=True, error_model="numpy")
def _cast_capsule(px, py, pz, dx, dy, dz, radius, half):
    slope = np.sqrt(dx * dx + dy * dy)
    if slope > 0.0:
        ux, uy = dx / slope, dy / slope
        t = _enter_circle(-(px * ux + py * uy), abs(px * uy - py * ux), radius)
        if t == np.inf:
            return np.inf
        t = t / slope
        z = pz + t * dz
        if abs(z) <= half:
            # Behind the origin: the ray has left the (convex) shape.
            return t if t >= 0.0 else np.inf
    else:
        if np.sqrt(px * px + py * py) > radius:
            return np.inf
        z = -dz
    # The tube is entered beyond one end, so only that end can be met.
    end = half if z > 0.0 else -half
    return _cast_sphere(px, py, pz - end, dx, dy, dz, radius)


@njit(cache=True, error_model="numpy")
def _clip_slab(p, d, half, enter, leave):
    """Clips the interval [enter, leave] of a ray to |p + t d| <= half."""
    if d == 0.0:
        # 0 * inf in the general formula; the ray is in the slab or never.
        if abs(p) > half:
            leave = -np.inf
        return enter, leave
    first = (-half - p) / d
    second = (half - p) / d
    return (
        max(enter, min(first, second)),
        min(leave, max(first, second)),
    )


@njit(cache=True, error_model="numpy")
def _cast_cylinder(px, py, pz, dx, dy, dz, radius, half):
    enter, leave = _clip_slab(pz, dz, half, 0.0, np.inf)
    slope = np.sqrt(dx * dx + dy * dy)
    if slope > 0.0:
        ux, uy = dx / slope, dy / slope
        along = -(px * ux + py * uy)
        t = _enter_circle(along, abs(px * uy - py * ux), radius)
        if t == np.inf:
            return np.inf
        enter = max(enter, t / slope)
        leave = min(leave, (2.0 * along - t) / slope)
    elif np.sqrt(px * px + py * py) > radius:
        return np.inf
    return enter if enter <= leave else np.inf


@njit(cache=True, error_model="numpy")
def _cast_box(px, py, pz, dx, dy, dz, hx, hy, hz):
    enter, leave = _clip_slab(px, dx, hx, 0.0, np.inf)
    enter, leave = _clip_slab(py, dy, hy, enter, leave)
    enter, leave = _clip_slab(pz, dz, hz, enter, leave)
    return enter if enter <= leave else np.inf


@njit(cache=True, error_model="numpy")
def _cast_half_space(pz, dz):
    return -pz / dz if dz < 0.0 else np.inf


@njit(cache=True, error_model="numpy")
def _is_inside(kind, px, py, pz, a, b, c):
    """Returns whether a point in G is inside a shape or on its surface."""
    if kind == SPHERE:
        return np.sqrt(px * px + py * py + pz * pz) <= a
    if kind == CAPSULE:
        z = max(abs(pz) - b, 0.0)
        return np.sqrt(px * px + py * py + z * z) <= a
    if kind == CYLINDER:
        return abs(pz) <= b and np.sqrt(px * px + py * py) <= a
    if kind == BOX:
        return abs(px) <= a and abs(py) <= b and abs(pz) <= c
    if kind == HALF_SPACE:
        return pz <= 0.0
    if kind == ELLIPSOID:
        x, y, z = px / a, py / b, pz / c
        return np.sqrt(x * x + y * y + z * z) <= 1.0
    return False


@njit(cache=True, error_model="numpy")
def _cast_shape(kind, px, py, pz, dx, dy, dz, a, b, c):
    """Returns the distance along a ray that starts outside, inf: miss."""
    if kind == SPHERE:
        return _cast_sphere(px, py, pz, dx, dy, dz, a)
    if kind == CAPSULE:
        return _cast_capsule(px, py, pz, dx, dy, dz, a, b)
    if kind == CYLINDER:
        return _cast_cylinder(px, py, pz, dx, dy, dz, a, b)
    if kind == BOX:
        return _cast_box(px, py, pz, dx, dy, dz, a, b, c)
    if kind == HALF_SPACE:
        return _cast_half_space(pz, dz)
    return _cast_ellipsoid(px, py, pz, dx, dy, dz, a, b, c)


@njit(cache=True, error_model="numpy")
def _compose(X_AB, X_BC, X_AC):
    """Writes X_AC = X_AB X_BC; X_BC has twelve numbers, row by row."""
    for i in range(3):
        for j in range(4):
            X_AC[i, j] = (
                X_AB[i, 0] * X_BC[j]
                + X_AB[i, 1] * X_BC[4 + j]
                + X_AB[i, 2] * X_BC[8 + j]
            )
        X_AC[i, 3] += X_AB[i, 3]


@njit(cache=True, error_model="numpy")
def _calc_centres(X_WF, shape_int, shape_float):
    """Returns the centres of the bounding spheres in the world, (n, 3)."""
    p_WC = np.empty((shape_int.shape[0], 3))
    for s in range(shape_int.shape[0]):
        X = X_WF[shape_int[s, FRAME]]
        x = shape_float[s, CENTRE]
        y = shape_float[s, CENTRE + 1]
        z = shape_float[s, CENTRE + 2]
        for i in range(3):
            p_WC[s, i] = X[i, 0] * x + X[i, 1] * y + X[i, 2] * z + X[i, 3]
    return p_WC


@njit(cache=True, error_model="numpy")
def _are_finite(X_WF):
    total = 0.0
    for i in range(X_WF.shape[0]):
        for j in range(3):
            for k in range(4):
                # Anything times zero is zero, unless it is not finite.
                total += X_WF[i, j, k] * 0.0
    return total == 0.0


@njit(cache=True, error_model="numpy")
def _cone_misses(vx, vy, vz, ax, ay, az, cos, sin, radius, reach):
    """Returns whether a ball is clear of a cone of rays.

    (vx, vy, vz) is the centre of the ball from the tip of the cone, (ax, ay,
    az) the unit vector of the cone's axis, (cos, sin) of half its opening
    angle; cos <= 0 means any direction. A ball of radius inf is never clear.
    The rays have the length `reach`.
    """
    gap2 = vx * vx + vy * vy + vz * vz
    if gap2 <= radius * radius:
        return False
    gap = np.sqrt(gap2)
    if gap - radius > reach:
        return True
    if cos <= 0.0:
        return False
    along = vx * ax + vy * ay + vz * az
    across = np.sqrt(max(gap2 - along * along, 0.0))
    # Distance from the cone's edge; nearest the tip it is the whole gap.
    if along * cos + across * sin <= 0.0:
        return True
    # Rounding must not drop a grazing shape.
    return across * cos - along * sin > radius + 1e-9 * gap


@njit(cache=True, error_model="numpy")
def cast_bundles(
    X_WF,
    shape_int,
    shape_float,
    bundle_frame,
    bundle_float,
    active,
    fan,
):
    """Casts m bundles of k rays each; see RayCaster.cast_bundles.

    Args:
        X_WF: Poses of the frames, shape (f, 3, 4).
        shape_int: See the module.
        shape_float: See the module.
        bundle_frame: Row of each bundle's frame in X_WF, shape (m,).
        bundle_float: X_FS row by row and the range, shape (m, 13).
        active: Whether bundle i is cast against shape s, bool, (m, n).
        fan: Unit directions in S, shape (k, 3), then, as two more rows, the
            axis of their cone and its (cos, sin, 0).

    Returns:
        (status, distance (m, k), index (m, k)).
    """
    m = bundle_frame.shape[0]
    n = shape_int.shape[0]
    k = fan.shape[0] - 2
    distance = np.empty((m, k))
    index = np.full((m, k), -1, dtype=np.int64)
    if not _are_finite(X_WF):
        return BAD_POSE, distance, index
    p_WC = _calc_centres(X_WF, shape_int, shape_float)
    X_WS = np.empty((3, 4))
    X_WG = np.empty((3, 4))
    R = np.empty((3, 3))
    axis = fan[k]
    cos, sin = fan[k + 1, 0], fan[k + 1, 1]
    for i in range(m):
        _compose(X_WF[bundle_frame[i]], bundle_float[i], X_WS)
        reach = bundle_float[i, 12]
        # A hit at exactly the range counts, hence the next number.
        best = distance[i]
        best[:] = np.nextafter(reach, np.inf)
        ax = X_WS[0, 0] * axis[0] + X_WS[0, 1] * axis[1] + X_WS[0, 2] * axis[2]
        ay = X_WS[1, 0] * axis[0] + X_WS[1, 1] * axis[1] + X_WS[1, 2] * axis[2]
        az = X_WS[2, 0] * axis[0] + X_WS[2, 1] * axis[1] + X_WS[2, 2] * axis[2]
        for s in range(n):
            if not active[i, s]:
                continue
            if _cone_misses(
                p_WC[s, 0] - X_WS[0, 3],
                p_WC[s, 1] - X_WS[1, 3],
                p_WC[s, 2] - X_WS[2, 3],
                ax,
                ay,
                az,
                cos,
                sin,
                shape_float[s, RADIUS],
                reach,
            ):
                continue
            _compose(X_WF[shape_int[s, FRAME]], shape_float[s], X_WG)
            vx = X_WS[0, 3] - X_WG[0, 3]
            vy = X_WS[1, 3] - X_WG[1, 3]
            vz = X_WS[2, 3] - X_WG[2, 3]
            px = X_WG[0, 0] * vx + X_WG[1, 0] * vy + X_WG[2, 0] * vz
            py = X_WG[0, 1] * vx + X_WG[1, 1] * vy + X_WG[2, 1] * vz
            pz = X_WG[0, 2] * vx + X_WG[1, 2] * vy + X_WG[2, 2] * vz
            kind = shape_int[s, KIND]
            a = shape_float[s, SIZE]
            b = shape_float[s, SIZE + 1]
            c = shape_float[s, SIZE + 2]
            if _is_inside(kind, px, py, pz, a, b, c):
                for j in range(k):
                    if best[j] > 0.0:
                        best[j] = 0.0
                        index[i, j] = s
                continue
            for row in range(3):
                for col in range(3):
                    R[row, col] = (
                        X_WG[0, row] * X_WS[0, col]
                        + X_WG[1, row] * X_WS[1, col]
                        + X_WG[2, row] * X_WS[2, col]
                    )
            for j in range(k):
                fx, fy, fz = fan[j, 0], fan[j, 1], fan[j, 2]
                t = _cast_shape(
                    kind,
                    px,
                    py,
                    pz,
                    R[0, 0] * fx + R[0, 1] * fy + R[0, 2] * fz,
                    R[1, 0] * fx + R[1, 1] * fy + R[1, 2] * fz,
                    R[2, 0] * fx + R[2, 1] * fy + R[2, 2] * fz,
                    a,
                    b,
                    c,
                )
                if t < best[j]:
                    best[j] = t
                    index[i, j] = s
        for j in range(k):
            if index[i, j] < 0:
                best[j] = np.inf
    return OK, distance, index


@njit(cache=True, error_model="numpy")
def cast_rays(X_WF, shape_int, shape_float, active, p_WR, n_WR, reach):
    """Casts n_r rays, each with its own origin; see RayCaster.cast.

    Args:
        X_WF: Poses of the frames, shape (f, 3, 4).
        shape_int: See the module.
        shape_float: See the module.
        active: Whether shape s is cast against, bool, shape (n,).
        p_WR: Origins, shape (n_r, 3).
        n_WR: Directions, shape (n_r, 3), unit vectors to 1e-6.
        reach: Range of all rays.

    Returns:
        (status, distance (n_r,), index (n_r,)).
    """
    rays = p_WR.shape[0]
    distance = np.full(rays, np.inf)
    index = np.full(rays, -1, dtype=np.int64)
    if not _are_finite(X_WF):
        return BAD_POSE, distance, index
    n = shape_int.shape[0]
    p_WC = _calc_centres(X_WF, shape_int, shape_float)
    X_WG = np.empty((n, 3, 4))
    for s in range(n):
        _compose(X_WF[shape_int[s, FRAME]], shape_float[s], X_WG[s])
    limit = np.nextafter(reach, np.inf)
    for i in range(rays):
        ox, oy, oz = p_WR[i, 0], p_WR[i, 1], p_WR[i, 2]
        ex, ey, ez = n_WR[i, 0], n_WR[i, 1], n_WR[i, 2]
        length = np.sqrt(ex * ex + ey * ey + ez * ez)
        if not (abs(length - 1.0) <= 1e-6 and np.isfinite(ox + oy + oz)):
            return BAD_RAY, distance, index
        ex, ey, ez = ex / length, ey / length, ez / length
        best = limit
        hit = -1
        for s in range(n):
            if not active[s]:
                continue
            if _cone_misses(
                p_WC[s, 0] - ox,
                p_WC[s, 1] - oy,
                p_WC[s, 2] - oz,
                ex,
                ey,
                ez,
                1.0,
                0.0,
                shape_float[s, RADIUS],
                best,
            ):
                continue
            X = X_WG[s]
            vx, vy, vz = ox - X[0, 3], oy - X[1, 3], oz - X[2, 3]
            px = X[0, 0] * vx + X[1, 0] * vy + X[2, 0] * vz
            py = X[0, 1] * vx + X[1, 1] * vy + X[2, 1] * vz
            pz = X[0, 2] * vx + X[1, 2] * vy + X[2, 2] * vz
            kind = shape_int[s, KIND]
            a = shape_float[s, SIZE]
            b = shape_float[s, SIZE + 1]
            c = shape_float[s, SIZE + 2]
            if _is_inside(kind, px, py, pz, a, b, c):
                best = 0.0
                hit = s
                break
            t = _cast_shape(
                kind,
                px,
                py,
                pz,
                X[0, 0] * ex + X[1, 0] * ey + X[2, 0] * ez,
                X[0, 1] * ex + X[1, 1] * ey + X[2, 1] * ez,
                X[0, 2] * ex + X[1, 2] * ey + X[2, 2] * ez,
                a,
                b,
                c,
            )
            if t < best:
                best = t
                hit = s
        if hit >= 0:
            distance[i] = best
            index[i] = hit
    return OK, distance, index
