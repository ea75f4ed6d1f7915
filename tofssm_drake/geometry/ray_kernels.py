"""Compiled kernels of the ray caster: one ray or fan against the shapes.

All shapes are cast in their own frame G, the canonical frame of Drake's
shape specifications. A shape is a closed set of points: the distance along a
ray is the smallest t >= 0 with p + t d in the shape, hence 0 for an origin
that is inside or on the surface.

The scene is handed over as the poses of its f frames, X_WF (f, 3, 4), and a
tuple of a few tables, since each array costs a fraction of a microsecond on
the way into compiled code; whole numbers are therefore kept as floats, too:

  shapes     (n, 23)  one row for each shape, see the columns below
  planes     (., 4)   (n, h) of all polytopes: the points with n.x <= h
  nodes      (., 8)   of all meshes, see TriangleMesh
  triangles  (., 9)   of all meshes, see TriangleMesh
"""

from numba import njit
import numpy as np

from tofssm_drake.geometry.mesh_kernels import (
    STACK,
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

POSE = 0
"""Columns of shapes: X_FG row by row (12)."""
SIZE = 12
"""Sizes, according to the kind (3)."""
CENTRE = 15
"""Centre p_FC of the bounding sphere (3)."""
RADIUS = 18
"""Its radius."""
KIND = 19
"""What it is."""
FRAME = 20
"""Row of its frame in X_WF."""
DATA = 21
"""Where the data of a polytope or mesh are (2)."""
SHAPE_COLUMNS = 23

BUNDLE_RANGE = 12
"""Columns of bundles: X_FS row by row (12), the range."""
BUNDLE_FRAME = 13
"""Row of its frame in X_WF."""
BUNDLE_COLUMNS = 14

OK = 0
BAD_POSE = 1
BAD_RAY = 2

# How far a rotation may be from one.
_TOLERANCE = 1e-6
# Rounding must not drop a shape that is only touched.
_MARGIN = 1e-9


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
def _cast_sphere(px, py, pz, dx, dy, dz, radius):
    along = -(px * dx + py * dy + pz * dz)
    if along < 0.0:
        return np.inf
    qx, qy, qz = px + along * dx, py + along * dy, pz + along * dz
    across = np.sqrt(qx * qx + qy * qy + qz * qz)
    return max(_enter_circle(along, across, radius), 0.0)


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
def _cast_box(px, py, pz, dx, dy, dz, hx, hy, hz):
    enter, leave = _clip_slab(px, dx, hx, 0.0, np.inf)
    enter, leave = _clip_slab(py, dy, hy, enter, leave)
    enter, leave = _clip_slab(pz, dz, hz, enter, leave)
    return enter if enter <= leave else np.inf


@njit(cache=True, error_model="numpy", forceinline=True)
def _cast_half_space(pz, dz):
    return -pz / dz if dz < 0.0 else np.inf


@njit(cache=True, error_model="numpy", forceinline=True)
def _is_in_primitive(kind, x, y, z, a, b, c):
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


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
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
def _calc_centres(X_WF, shapes):
    """Returns the centres of the bounding spheres in the world, (3, n)."""
    p_WC = np.empty((3, shapes.shape[0]))
    for s in range(shapes.shape[0]):
        f = int(shapes[s, FRAME])
        x = shapes[s, CENTRE]
        y = shapes[s, CENTRE + 1]
        z = shapes[s, CENTRE + 2]
        for i in range(3):
            p_WC[i, s] = (
                X_WF[f, i, 0] * x
                + X_WF[f, i, 1] * y
                + X_WF[f, i, 2] * z
                + X_WF[f, i, 3]
            )
    return p_WC


@njit(cache=True, error_model="numpy")
def are_poses(X_WF):
    """Returns whether poses are finite and their rotations rotations."""
    good = True
    for i in range(X_WF.shape[0]):
        X = X_WF[i]
        # Anything times zero is zero, unless it is not finite.
        good &= (X[0, 3] + X[1, 3] + X[2, 3]) * 0.0 == 0.0
        for j in range(3):
            k = (j + 1) % 3
            length = X[j, 0] * X[j, 0] + X[j, 1] * X[j, 1] + X[j, 2] * X[j, 2]
            cosine = X[j, 0] * X[k, 0] + X[j, 1] * X[k, 1] + X[j, 2] * X[k, 2]
            good &= (
                abs(length - 1.0) <= _TOLERANCE and abs(cosine) <= _TOLERANCE
            )
        # Not a mirror.
        good &= (
            X[0, 0] * (X[1, 1] * X[2, 2] - X[1, 2] * X[2, 1])
            + X[0, 1] * (X[1, 2] * X[2, 0] - X[1, 0] * X[2, 2])
            + X[0, 2] * (X[1, 0] * X[2, 1] - X[1, 1] * X[2, 0])
        ) > 0.0
    return good


@njit(cache=True, error_model="numpy", forceinline=True)
def _cone_misses(along, gap2, radius, cos, sin):
    """Returns whether a ball is clear of a cone of rays.

    Without a square root, as nearly all balls are clear.

    Args:
        along: How far the ball's centre is along the axis, from the tip.
        gap2: Squared distance of the centre from the tip, which is outside
            of the ball.
        radius: Radius of the ball.
        cos: Cosine of half the opening angle; 0 or less: any direction.
        sin: Its sine.
    """
    if cos <= 0.0:
        return False
    across2 = gap2 - along * along
    # Whether the tip is the cone's point nearest to the ball.
    if along < 0.0 and across2 * (sin * sin) <= along * along * (cos * cos):
        return True
    # The ball touches the edge of the cone: across cos = radius + along sin.
    rest = radius + along * sin
    return rest < 0.0 or (
        across2 * (cos * cos) > rest * rest + _MARGIN * (gap2 + rest * rest)
    )


@njit(cache=True, error_model="numpy")
def _pose_bundle(shapes, s, X_WF, X_WS, X_WG, p_GS, R_GS, q):
    """Writes origin and rotation of a bundle in shape s to row q."""
    _compose(X_WF[int(shapes[s, FRAME])], shapes[s], X_WG)
    x = X_WS[0, 3] - X_WG[0, 3]
    y = X_WS[1, 3] - X_WG[1, 3]
    z = X_WS[2, 3] - X_WG[2, 3]
    for i in range(3):
        p_GS[q, i] = X_WG[0, i] * x + X_WG[1, i] * y + X_WG[2, i] * z
        for j in range(3):
            R_GS[q, i, j] = (
                X_WG[0, i] * X_WS[0, j]
                + X_WG[1, i] * X_WS[1, j]
                + X_WG[2, i] * X_WS[2, j]
            )


@njit(cache=True, error_model="numpy")
def cast_bundles(X_WF, scene, bundles, active, which, fan, cones):
    """Casts m bundles of k rays each; see RayCaster.cast_bundles.

    Args:
        X_WF: See the module.
        scene: See the module.
        bundles: See the columns above, shape (m, 14).
        active: Whether bundle i is cast against shape s, bool, (m, n).
        which: Whether bundle i is cast at all, bool, (m,).
        fan: Unit directions in S, sorted into groups, and the place of each
            ray in the results, shape (k, 4).
        cones: Axis, cosine and sine of half the opening angle of a cone
            around all rays, then of one around each group of rays, with the
            first ray and the one behind the last, shape (1 + groups, 7).

    Returns:
        (status, distance (m, k), index (m, k)).
    """
    shapes, planes, nodes, triangles = scene
    m, n, k = bundles.shape[0], shapes.shape[0], fan.shape[0]
    groups = cones.shape[0] - 1
    distance = np.empty((m, k))
    index = np.empty((m, k), dtype=np.int64)
    if not are_poses(X_WF):
        return BAD_POSE, distance, index
    p_WC = _calc_centres(X_WF, shapes)
    X_WS = np.empty((3, 4))
    X_WG = np.empty((3, 4))
    # Of the bundle's rays, sorted: the nearest hit so far.
    best = np.empty(k)
    hit = np.empty(k, dtype=np.int64)
    # Of the shapes that the bundle may see: number; squared distance of the
    # centre; centre in S; the least that a ray which hits goes towards it.
    near_shape = np.empty(n, dtype=np.int64)
    near_gap2 = np.empty(n)
    near_centre = np.empty((n, 3))
    near_tangent = np.empty(n)
    # Not posed yet (0), or the origin is outside (1) or inside (2).
    near_state = np.empty(n, dtype=np.int64)
    p_GS = np.empty((n, 3))
    R_GS = np.empty((n, 3, 3))
    stack = np.empty((2, STACK))
    for i in range(m):
        if not which[i]:
            distance[i] = np.inf
            index[i] = -1
            continue
        _compose(X_WF[int(bundles[i, BUNDLE_FRAME])], bundles[i], X_WS)
        reach = bundles[i, BUNDLE_RANGE]
        ox, oy, oz = X_WS[0, 3], X_WS[1, 3], X_WS[2, 3]
        ax, ay, az = cones[0, 0], cones[0, 1], cones[0, 2]
        cos, sin = cones[0, 3], cones[0, 4]
        ux = X_WS[0, 0] * ax + X_WS[0, 1] * ay + X_WS[0, 2] * az
        uy = X_WS[1, 0] * ax + X_WS[1, 1] * ay + X_WS[1, 2] * az
        uz = X_WS[2, 0] * ax + X_WS[2, 1] * ay + X_WS[2, 2] * az
        near = 0
        for s in range(n):
            if not active[i, s]:
                continue
            x, y, z = p_WC[0, s] - ox, p_WC[1, s] - oy, p_WC[2, s] - oz
            gap2 = x * x + y * y + z * z
            radius = shapes[s, RADIUS]
            if gap2 > radius * radius:
                if gap2 > (reach + radius) * (reach + radius) or _cone_misses(
                    x * ux + y * uy + z * uz, gap2, radius, cos, sin
                ):
                    continue
                near_tangent[near] = np.sqrt(
                    gap2 - radius * radius
                ) - _MARGIN * np.sqrt(gap2)
            else:
                near_tangent[near] = -np.inf
            near_shape[near] = s
            near_gap2[near] = gap2
            near_state[near] = 0
            for j in range(3):
                near_centre[near, j] = (
                    X_WS[0, j] * x + X_WS[1, j] * y + X_WS[2, j] * z
                )
            near += 1
        # A hit at exactly the range counts, hence the next number.
        best[:] = np.nextafter(reach, np.inf)
        hit[:] = -1
        for g in range(1, 1 + groups):
            first, last = int(cones[g, 5]), int(cones[g, 6])
            for q in range(near):
                s = near_shape[q]
                cx, cy, cz = (
                    near_centre[q, 0],
                    near_centre[q, 1],
                    near_centre[q, 2],
                )
                tangent = near_tangent[q]
                if (
                    groups > 1
                    and tangent > -np.inf
                    and _cone_misses(
                        cx * cones[g, 0] + cy * cones[g, 1] + cz * cones[g, 2],
                        near_gap2[q],
                        shapes[s, RADIUS],
                        cones[g, 3],
                        cones[g, 4],
                    )
                ):
                    continue
                kind = int(shapes[s, KIND])
                a = shapes[s, SIZE]
                b = shapes[s, SIZE + 1]
                c = shapes[s, SIZE + 2]
                part, parts = int(shapes[s, DATA]), int(shapes[s, DATA + 1])
                if near_state[q] == 0:
                    _pose_bundle(shapes, s, X_WF, X_WS, X_WG, p_GS, R_GS, q)
                    inside = False
                    if tangent == -np.inf:
                        if kind == CONVEX:
                            inside = is_inside_convex(
                                planes, part, parts, p_GS[q]
                            )
                        elif kind == MESH:
                            inside = parts == 1 and is_inside_mesh(
                                nodes, triangles, part, p_GS[q]
                            )
                        else:
                            inside = _is_in_primitive(
                                kind,
                                p_GS[q, 0],
                                p_GS[q, 1],
                                p_GS[q, 2],
                                a,
                                b,
                                c,
                            )
                    near_state[q] = 2 if inside else 1
                if near_state[q] == 2:
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
                    if cx * x + cy * y + cz * z < tangent:
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
                    # No function of the whole scene: handing its tables over
                    # for each ray would cost more than the primitives do.
                    if kind == CONVEX:
                        t, _ = cast_convex(
                            planes, part, parts, p_GS[q], dx, dy, dz
                        )
                    elif kind == MESH:
                        t, _ = cast_mesh(
                            nodes,
                            triangles,
                            part,
                            p_GS[q],
                            dx,
                            dy,
                            dz,
                            best[j],
                            stack,
                        )
                    else:
                        t = _cast_primitive(
                            kind, px, py, pz, dx, dy, dz, a, b, c
                        )
                    if t < best[j]:
                        best[j] = t
                        hit[j] = s
        for j in range(k):
            place = int(fan[j, 3])
            index[i, place] = hit[j]
            distance[i, place] = best[j] if hit[j] >= 0 else np.inf
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
    shapes, planes, nodes, triangles = scene
    rays, n = p_WR.shape[0], shapes.shape[0]
    distance = np.full(rays, np.inf)
    index = np.full(rays, -1, dtype=np.int64)
    if not are_poses(X_WF):
        return BAD_POSE, distance, index
    p_WC = _calc_centres(X_WF, shapes)
    X_WG = np.empty((n, 3, 4))
    radius2 = np.empty(n)
    limit2 = np.empty(n)
    for s in range(n):
        _compose(X_WF[int(shapes[s, FRAME])], shapes[s], X_WG[s])
        radius = shapes[s, RADIUS]
        # No ball is smaller than nothing.
        radius2[s] = radius * radius if active[s] else -np.inf
        limit2[s] = (reach + radius) * (reach + radius)
    p_GR = np.empty(3)
    may_hit = np.empty(n, dtype=np.bool_)
    stack = np.empty((2, STACK))
    limit = np.nextafter(reach, np.inf)
    for i in range(rays):
        ox, oy, oz = p_WR[i, 0], p_WR[i, 1], p_WR[i, 2]
        ex, ey, ez = n_WR[i, 0], n_WR[i, 1], n_WR[i, 2]
        length = np.sqrt(ex * ex + ey * ey + ez * ez)
        if not (abs(length - 1.0) <= 1e-6 and np.isfinite(ox + oy + oz)):
            return BAD_RAY, distance, index
        ex, ey, ez = ex / length, ey / length, ez / length
        # Without branches, which lets the compiler use vectors.
        for s in range(n):
            x, y, z = p_WC[0, s] - ox, p_WC[1, s] - oy, p_WC[2, s] - oz
            gap2 = x * x + y * y + z * z
            along = max(x * ex + y * ey + z * ez, 0.0)
            may_hit[s] = (
                gap2 * (1.0 - _MARGIN) - along * along <= radius2[s]
            ) & (gap2 <= limit2[s])
        best = limit
        hit = -1
        for s in range(n):
            if not may_hit[s]:
                continue
            x = ox - X_WG[s, 0, 3]
            y = oy - X_WG[s, 1, 3]
            z = oz - X_WG[s, 2, 3]
            px = X_WG[s, 0, 0] * x + X_WG[s, 1, 0] * y + X_WG[s, 2, 0] * z
            py = X_WG[s, 0, 1] * x + X_WG[s, 1, 1] * y + X_WG[s, 2, 1] * z
            pz = X_WG[s, 0, 2] * x + X_WG[s, 1, 2] * y + X_WG[s, 2, 2] * z
            dx = X_WG[s, 0, 0] * ex + X_WG[s, 1, 0] * ey + X_WG[s, 2, 0] * ez
            dy = X_WG[s, 0, 1] * ex + X_WG[s, 1, 1] * ey + X_WG[s, 2, 1] * ez
            dz = X_WG[s, 0, 2] * ex + X_WG[s, 1, 2] * ey + X_WG[s, 2, 2] * ez
            x, y, z = p_WC[0, s] - ox, p_WC[1, s] - oy, p_WC[2, s] - oz
            is_near = x * x + y * y + z * z <= radius2[s]
            inside = False
            t = np.inf
            kind = int(shapes[s, KIND])
            if kind < CONVEX:
                a = shapes[s, SIZE]
                b = shapes[s, SIZE + 1]
                c = shapes[s, SIZE + 2]
                inside = is_near and _is_in_primitive(kind, px, py, pz, a, b, c)
                if not inside:
                    t = _cast_primitive(kind, px, py, pz, dx, dy, dz, a, b, c)
            else:
                part, parts = int(shapes[s, DATA]), int(shapes[s, DATA + 1])
                p_GR[0], p_GR[1], p_GR[2] = px, py, pz
                if kind == CONVEX:
                    inside = is_near and is_inside_convex(
                        planes, part, parts, p_GR
                    )
                    if not inside:
                        t, _ = cast_convex(
                            planes, part, parts, p_GR, dx, dy, dz
                        )
                else:
                    inside = (
                        is_near
                        and parts == 1
                        and is_inside_mesh(nodes, triangles, part, p_GR)
                    )
                    if not inside:
                        t, _ = cast_mesh(
                            nodes,
                            triangles,
                            part,
                            p_GR,
                            dx,
                            dy,
                            dz,
                            best,
                            stack,
                        )
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
def _find_normal(kind, a, b, c, x, y, z, dx, dy, dz):
    """Returns the direction of a primitive's normal at (x, y, z), in G.

    On an edge there are several; the one that faces the ray most is taken.
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


@njit(cache=True, error_model="numpy")
def _find_triangle_normal(triangles, i, dx, dy, dz):
    """Returns the direction of a triangle's normal that faces a ray."""
    ux = triangles[i, 3] - triangles[i, 0]
    uy = triangles[i, 4] - triangles[i, 1]
    uz = triangles[i, 5] - triangles[i, 2]
    vx = triangles[i, 6] - triangles[i, 0]
    vy = triangles[i, 7] - triangles[i, 1]
    vz = triangles[i, 8] - triangles[i, 2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    if x * dx + y * dy + z * dz > 0.0:
        return -x, -y, -z
    return x, y, z


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
    shapes, planes, nodes, triangles = scene
    rays = p_WR.shape[0]
    normals = np.full((rays, 3), np.nan)
    X = np.empty((3, 4))
    p = np.empty(3)
    stack = np.empty((2, STACK))
    for i in range(rays):
        s = index[i]
        t = distance[i]
        if s < 0 or not t > 0.0:
            continue
        _compose(X_WF[int(shapes[s, FRAME])], shapes[s], X)
        _pose_in_shape(X, p_WR[i], p)
        dx = X[0, 0] * n_WR[i, 0] + X[1, 0] * n_WR[i, 1] + X[2, 0] * n_WR[i, 2]
        dy = X[0, 1] * n_WR[i, 0] + X[1, 1] * n_WR[i, 1] + X[2, 1] * n_WR[i, 2]
        dz = X[0, 2] * n_WR[i, 0] + X[1, 2] * n_WR[i, 1] + X[2, 2] * n_WR[i, 2]
        kind = int(shapes[s, KIND])
        first, last = int(shapes[s, DATA]), int(shapes[s, DATA + 1])
        if kind == CONVEX:
            _, part = cast_convex(planes, first, last, p, dx, dy, dz)
            if part < 0:
                continue
            x, y, z = planes[part, 0], planes[part, 1], planes[part, 2]
        elif kind == MESH:
            _, part = cast_mesh(
                nodes, triangles, first, p, dx, dy, dz, np.inf, stack
            )
            if part < 0:
                continue
            x, y, z = _find_triangle_normal(triangles, part, dx, dy, dz)
        else:
            x, y, z = _find_normal(
                kind,
                shapes[s, SIZE],
                shapes[s, SIZE + 1],
                shapes[s, SIZE + 2],
                p[0] + t * dx,
                p[1] + t * dy,
                p[2] + t * dz,
                dx,
                dy,
                dz,
            )
        length = np.sqrt(x * x + y * y + z * z)
        for j in range(3):
            normals[i, j] = (X[j, 0] * x + X[j, 1] * y + X[j, 2] * z) / length
    return normals
