"""Compiled kernels of the ray caster: one ray or fan against the shapes.

All shapes are cast in their own frame G, the canonical frame of Drake's
shape specifications. A shape is a closed set of points: the distance along a
ray is the smallest t >= 0 with p + t d in the shape, hence 0 for an origin
that is inside or on the surface.

The scene is handed over as the poses of its f frames, X_WF (f, 3, 4), and a
tuple of a few arrays, since each one costs a fraction of a microsecond on the
way into compiled code. For n shapes:

  shape_int   (n, 4)     kind, row of the shape's frame in X_WF, and, for
                         polytopes and meshes, where their data are
  shape_float (n, 19)    X_FG row by row (12), sizes (3), centre p_FC of the
                         bounding sphere (3), its radius
  planes      (., 4)     (n, h) of all polytopes: the points with n.x <= h
  bounds, links, triangles  of all meshes, see TriangleMesh
"""

from numba import njit
import numpy as np

from tofssm_drake.geometry.mesh_kernels import (
    cast_convex,
    cast_mesh,
    is_inside_convex,
    is_inside_mesh,
)

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
CONVEX = 6
"""Data: first plane, number of planes."""
MESH = 7
"""Data: root node, whether it is closed."""

KIND, FRAME, DATA = 0, 1, 2
SHAPE_INTS = 4
SIZE, CENTRE, RADIUS = 12, 15, 18
SHAPE_FLOATS = 19

OK = 0
BAD_POSE = 1
BAD_RAY = 2

# Rounding must not drop a shape that is only touched.
_MARGIN = 1e-9


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
def _is_inside_primitive(kind, x, y, z, a, b, c):
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
def _cast_primitive(kind, px, py, pz, dx, dy, dz, a, b, c):
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
def _cone_misses(along, gap, radius, cos, sin):
    """Returns whether a ball is clear of a cone of rays.

    Args:
        along: How far the ball's centre is along the axis, from the tip.
        gap: Distance of the centre from the tip, which is outside the ball.
        radius: Radius of the ball.
        cos: Cosine of half the opening angle; 0 or less: any direction.
        sin: Its sine.
    """
    if cos <= 0.0:
        return False
    across = np.sqrt(max(gap * gap - along * along, 0.0))
    # Whether the tip is the cone's point nearest to the ball.
    if along * cos + across * sin <= 0.0:
        return True
    return across * cos - along * sin > radius + _MARGIN * gap


@njit(cache=True, error_model="numpy")
def cast_bundles(
    X_WF, scene, bundle_frame, bundle_float, active, fan, order, cones
):
    """Casts m bundles of k rays each; see RayCaster.cast_bundles.

    Args:
        X_WF: See the module.
        scene: See the module.
        bundle_frame: Row of each bundle's frame in X_WF, shape (m,).
        bundle_float: X_FS row by row and the range, shape (m, 13).
        active: Whether bundle i is cast against shape s, bool, (m, n).
        fan: Unit directions in S, sorted into groups, shape (k, 3).
        order: Column of each ray in the results, shape (k,).
        cones: A cone around each group of rays, see `_cone_misses`, and the
            first ray and the one behind the last, shape (groups, 7).

    Returns:
        (status, distance (m, k), index (m, k)).
    """
    shape_int, shape_float, planes, bounds, links, triangles = scene
    m = bundle_frame.shape[0]
    n = shape_int.shape[0]
    k = fan.shape[0]
    distance = np.empty((m, k))
    index = np.full((m, k), -1, dtype=np.int64)
    if not _are_finite(X_WF):
        return BAD_POSE, distance, index
    p_WC = _calc_centres(X_WF, shape_int, shape_float)
    X_WS = np.empty((3, 4))
    X_WG = np.empty((3, 4))
    # Of the bundle's rays, sorted: the nearest hit so far.
    best = np.empty(k)
    hit = np.empty(k, dtype=np.int64)
    # Of the shapes within range of a bundle:
    shape = np.empty(n, dtype=np.int64)
    v_S = np.empty((n, 3))
    gap = np.empty(n)
    tangent = np.empty(n)
    # 0: not posed yet, 1: the origin is outside, 2: it is inside.
    state = np.empty(n, dtype=np.int64)
    R_GS = np.empty((n, 3, 3))
    p_GS = np.empty((n, 3))
    for i in range(m):
        _compose(X_WF[bundle_frame[i]], bundle_float[i], X_WS)
        reach = bundle_float[i, 12]
        near = 0
        for s in range(n):
            if not active[i, s]:
                continue
            x = p_WC[s, 0] - X_WS[0, 3]
            y = p_WC[s, 1] - X_WS[1, 3]
            z = p_WC[s, 2] - X_WS[2, 3]
            gap2 = x * x + y * y + z * z
            radius = shape_float[s, RADIUS]
            if gap2 > radius * radius:
                gap[near] = np.sqrt(gap2)
                if gap[near] - radius > reach:
                    continue
                # A ray that meets the ball goes at least this far towards
                # its centre.
                tangent[near] = (
                    np.sqrt(gap2 - radius * radius) - _MARGIN * gap[near]
                )
            else:
                tangent[near] = -np.inf
            for row in range(3):
                v_S[near, row] = (
                    X_WS[0, row] * x + X_WS[1, row] * y + X_WS[2, row] * z
                )
            shape[near] = s
            state[near] = 0
            near += 1
        # A hit at exactly the range counts, hence the next number.
        best[:] = np.nextafter(reach, np.inf)
        hit[:] = -1
        for g in range(cones.shape[0]):
            ax, ay, az = cones[g, 0], cones[g, 1], cones[g, 2]
            cos, sin = cones[g, 3], cones[g, 4]
            first, last = int(cones[g, 5]), int(cones[g, 6])
            for q in range(near):
                s = shape[q]
                vx, vy, vz = v_S[q, 0], v_S[q, 1], v_S[q, 2]
                least = tangent[q]
                if least > -np.inf and _cone_misses(
                    vx * ax + vy * ay + vz * az,
                    gap[q],
                    shape_float[s, RADIUS],
                    cos,
                    sin,
                ):
                    continue
                kind = shape_int[s, KIND]
                a = shape_float[s, SIZE]
                b = shape_float[s, SIZE + 1]
                c = shape_float[s, SIZE + 2]
                part, parts = shape_int[s, DATA], shape_int[s, DATA + 1]
                if state[q] == 0:
                    _compose(X_WF[shape_int[s, FRAME]], shape_float[s], X_WG)
                    x = X_WS[0, 3] - X_WG[0, 3]
                    y = X_WS[1, 3] - X_WG[1, 3]
                    z = X_WS[2, 3] - X_WG[2, 3]
                    for row in range(3):
                        p_GS[q, row] = (
                            X_WG[0, row] * x
                            + X_WG[1, row] * y
                            + X_WG[2, row] * z
                        )
                        for col in range(3):
                            R_GS[q, row, col] = (
                                X_WG[0, row] * X_WS[0, col]
                                + X_WG[1, row] * X_WS[1, col]
                                + X_WG[2, row] * X_WS[2, col]
                            )
                    state[q] = 1
                    if least == -np.inf:
                        if kind == CONVEX:
                            inside = is_inside_convex(
                                planes, part, parts, p_GS[q]
                            )
                        elif kind == MESH:
                            inside = parts == 1 and is_inside_mesh(
                                bounds, links, triangles, part, p_GS[q]
                            )
                        else:
                            inside = _is_inside_primitive(
                                kind,
                                p_GS[q, 0],
                                p_GS[q, 1],
                                p_GS[q, 2],
                                a,
                                b,
                                c,
                            )
                        if inside:
                            state[q] = 2
                if state[q] == 2:
                    for j in range(first, last):
                        if best[j] > 0.0:
                            best[j] = 0.0
                            hit[j] = s
                    continue
                px, py, pz = p_GS[q, 0], p_GS[q, 1], p_GS[q, 2]
                if kind == HALF_SPACE and pz > reach:
                    continue
                for j in range(first, last):
                    x, y, z = fan[j, 0], fan[j, 1], fan[j, 2]
                    if vx * x + vy * y + vz * z < least:
                        continue
                    dx = (
                        R_GS[q, 0, 0] * x
                        + R_GS[q, 0, 1] * y
                        + R_GS[q, 0, 2] * z
                    )
                    dy = (
                        R_GS[q, 1, 0] * x
                        + R_GS[q, 1, 1] * y
                        + R_GS[q, 1, 2] * z
                    )
                    dz = (
                        R_GS[q, 2, 0] * x
                        + R_GS[q, 2, 1] * y
                        + R_GS[q, 2, 2] * z
                    )
                    if kind == CONVEX:
                        t, _ = cast_convex(
                            planes, part, parts, p_GS[q], dx, dy, dz
                        )
                    elif kind == MESH:
                        t, _ = cast_mesh(
                            bounds,
                            links,
                            triangles,
                            part,
                            p_GS[q],
                            dx,
                            dy,
                            dz,
                            best[j],
                        )
                    else:
                        t = _cast_primitive(
                            kind, px, py, pz, dx, dy, dz, a, b, c
                        )
                    if t < best[j]:
                        best[j] = t
                        hit[j] = s
        for j in range(k):
            index[i, order[j]] = hit[j]
            distance[i, order[j]] = best[j] if hit[j] >= 0 else np.inf
    return OK, distance, index


@njit(cache=True, error_model="numpy")
def _pose_in_shape(X_WG, p_WR, p_GR):
    """Writes a point of the world in G."""
    x = p_WR[0] - X_WG[0, 3]
    y = p_WR[1] - X_WG[1, 3]
    z = p_WR[2] - X_WG[2, 3]
    for row in range(3):
        p_GR[row] = X_WG[0, row] * x + X_WG[1, row] * y + X_WG[2, row] * z


@njit(cache=True, error_model="numpy")
def cast_rays(X_WF, scene, active, p_WR, n_WR, reach):
    """Casts rays, each with its own origin; see RayCaster.cast.

    Args:
        X_WF: See the module.
        scene: See the module.
        active: Whether shape s is cast against, bool, shape (n,).
        p_WR: Origins, shape (rays, 3).
        n_WR: Directions, shape (rays, 3), unit vectors to 1e-6.
        reach: Range of all rays.

    Returns:
        (status, distance (rays,), index (rays,)).
    """
    shape_int, shape_float, planes, bounds, links, triangles = scene
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
    p_GR = np.empty(3)
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
            x = p_WC[s, 0] - ox
            y = p_WC[s, 1] - oy
            z = p_WC[s, 2] - oz
            radius = shape_float[s, RADIUS]
            gap2 = x * x + y * y + z * z
            along = x * ex + y * ey + z * ez
            is_near = gap2 <= radius * radius
            if not is_near and (
                along < 0.0
                or along - radius > best
                or gap2 * (1.0 - _MARGIN) - along * along > radius * radius
            ):
                continue
            if not active[s]:
                continue
            X = X_WG[s]
            x, y, z = ox - X[0, 3], oy - X[1, 3], oz - X[2, 3]
            px = X[0, 0] * x + X[1, 0] * y + X[2, 0] * z
            py = X[0, 1] * x + X[1, 1] * y + X[2, 1] * z
            pz = X[0, 2] * x + X[1, 2] * y + X[2, 2] * z
            dx = X[0, 0] * ex + X[1, 0] * ey + X[2, 0] * ez
            dy = X[0, 1] * ex + X[1, 1] * ey + X[2, 1] * ez
            dz = X[0, 2] * ex + X[1, 2] * ey + X[2, 2] * ez
            kind = shape_int[s, KIND]
            inside = False
            if kind >= CONVEX:
                part, parts = shape_int[s, DATA], shape_int[s, DATA + 1]
                p_GR[0], p_GR[1], p_GR[2] = px, py, pz
                if kind == CONVEX:
                    if is_near:
                        inside = is_inside_convex(planes, part, parts, p_GR)
                    t, _ = cast_convex(planes, part, parts, p_GR, dx, dy, dz)
                else:
                    if is_near and parts == 1:
                        inside = is_inside_mesh(
                            bounds, links, triangles, part, p_GR
                        )
                    t, _ = cast_mesh(
                        bounds, links, triangles, part, p_GR, dx, dy, dz, best
                    )
            else:
                a = shape_float[s, SIZE]
                b = shape_float[s, SIZE + 1]
                c = shape_float[s, SIZE + 2]
                if is_near:
                    inside = _is_inside_primitive(kind, px, py, pz, a, b, c)
                t = _cast_primitive(kind, px, py, pz, dx, dy, dz, a, b, c)
            if inside:
                best = 0.0
                hit = s
                break
            if t < best:
                best = t
                hit = s
        if hit >= 0:
            distance[i] = best
            index[i] = hit
    return OK, distance, index


@njit(cache=True, error_model="numpy")
def _write_normal(kind, a, b, c, q, dx, dy, dz, n):
    """Writes the outward normal of a primitive at a point q of its surface.

    On an edge there are several; the one that faces the ray most is taken.
    """
    n[:] = 0.0
    if kind == SPHERE:
        n[:] = q
    elif kind == CAPSULE:
        n[:] = q
        n[2] -= min(max(q[2], -b), b)
    elif kind == ELLIPSOID:
        n[0], n[1], n[2] = q[0] / (a * a), q[1] / (b * b), q[2] / (c * c)
    elif kind == CYLINDER:
        tube = np.sqrt(q[0] * q[0] + q[1] * q[1])
        side, end = tube - a, abs(q[2]) - b
        up = 1.0 if q[2] > 0.0 else -1.0
        is_rim = abs(side - end) < _MARGIN * (a + b)
        if is_rim:
            is_end = up * dz < (q[0] * dx + q[1] * dy) / tube
        else:
            is_end = end > side
        if is_end:
            n[2] = up
        else:
            n[0], n[1] = q[0], q[1]
    elif kind == BOX:
        # The largest is 0 but for rounding; the others are negative.
        x, y, z = abs(q[0]) - a, abs(q[1]) - b, abs(q[2]) - c
        least = max(x, max(y, z)) - _MARGIN * (a + b + c)
        facing = np.inf
        axis = 0
        if x >= least and np.copysign(dx, q[0] * dx) < facing:
            axis, facing = 0, np.copysign(dx, q[0] * dx)
        if y >= least and np.copysign(dy, q[1] * dy) < facing:
            axis, facing = 1, np.copysign(dy, q[1] * dy)
        if z >= least and np.copysign(dz, q[2] * dz) < facing:
            axis = 2
        n[axis] = 1.0 if q[axis] > 0.0 else -1.0
    else:
        n[2] = 1.0
    length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
    for i in range(3):
        n[i] /= length


@njit(cache=True, error_model="numpy")
def calc_normals(X_WF, scene, p_WR, n_WR, distance, index):
    """Returns the surface normals at hits; see RayCaster.calc_normals.

    Args:
        X_WF: See the module.
        scene: See the module.
        p_WR: Origins, shape (rays, 3).
        n_WR: Directions, shape (rays, 3).
        distance: As cast, shape (rays,).
        index: As cast, shape (rays,).

    Returns:
        Normals in the world, shape (rays, 3).
    """
    shape_int, shape_float, planes, bounds, links, triangles = scene
    rays = p_WR.shape[0]
    normals = np.full((rays, 3), np.nan)
    X = np.empty((3, 4))
    p, q, n = np.empty(3), np.empty(3), np.empty(3)
    for i in range(rays):
        s = index[i]
        t = distance[i]
        if s < 0 or not t > 0.0:
            continue
        _compose(X_WF[shape_int[s, FRAME]], shape_float[s], X)
        _pose_in_shape(X, p_WR[i], p)
        dx = X[0, 0] * n_WR[i, 0] + X[1, 0] * n_WR[i, 1] + X[2, 0] * n_WR[i, 2]
        dy = X[0, 1] * n_WR[i, 0] + X[1, 1] * n_WR[i, 1] + X[2, 1] * n_WR[i, 2]
        dz = X[0, 2] * n_WR[i, 0] + X[1, 2] * n_WR[i, 1] + X[2, 2] * n_WR[i, 2]
        kind = shape_int[s, KIND]
        first, last = shape_int[s, DATA], shape_int[s, DATA + 1]
        if kind == CONVEX:
            _, part = cast_convex(planes, first, last, p, dx, dy, dz)
            if part < 0:
                continue
            n[:] = planes[part, :3]
        elif kind == MESH:
            _, part = cast_mesh(
                bounds, links, triangles, first, p, dx, dy, dz, np.inf
            )
            if part < 0:
                continue
            u = triangles[part, 3:6] - triangles[part, :3]
            v = triangles[part, 6:] - triangles[part, :3]
            n[0] = u[1] * v[2] - u[2] * v[1]
            n[1] = u[2] * v[0] - u[0] * v[2]
            n[2] = u[0] * v[1] - u[1] * v[0]
            length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            if n[0] * dx + n[1] * dy + n[2] * dz > 0.0:
                length = -length
            for j in range(3):
                n[j] /= length
        else:
            q[0], q[1], q[2] = p[0] + t * dx, p[1] + t * dy, p[2] + t * dz
            _write_normal(
                kind,
                shape_float[s, SIZE],
                shape_float[s, SIZE + 1],
                shape_float[s, SIZE + 2],
                q,
                dx,
                dy,
                dz,
                n,
            )
        for j in range(3):
            normals[i, j] = X[j, 0] * n[0] + X[j, 1] * n[1] + X[j, 2] * n[2]
    return normals
