"""Compiled ray queries against triangle meshes and convex polytopes.

The test of ray and triangle is the watertight one of Woop, Benthin and Wald
(Journal of Computer Graphics Techniques 2(1), 2013): neighbours evaluate their
common edge with the same products, so no ray slips through between them.
Meshes come as one pool of nodes and triangles (see `TriangleTree`).
"""

import numpy as np

from tofssm_drake.kernels import njit

STACK = 128
"""Entries of a traversal's stack; trees are less deep."""

ON = 1e-14
"""Points this near a surface are on it, in units of the largest coordinate."""

# Of a product of three lengths.
_ROUNDING = 2e-15


@njit(cache=True, error_model="numpy", forceinline=True)
def _invert(d):
    """Returns 1 / d, but finite: 0 * inf would be NaN in the slab test."""
    if abs(d) > 1e-290:
        return 1.0 / d
    return np.copysign(1e290, d)


@njit(cache=True, error_model="numpy", forceinline=True)
def _enter_box(nodes, node, px, py, pz, ix, iy, iz, limit):
    """Returns where a ray enters a node's box, inf if not before limit."""
    a, b = (nodes[node, 0] - px) * ix, (nodes[node, 3] - px) * ix
    enter, leave = min(a, b), max(a, b)
    a, b = (nodes[node, 1] - py) * iy, (nodes[node, 4] - py) * iy
    enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    a, b = (nodes[node, 2] - pz) * iz, (nodes[node, 5] - pz) * iz
    enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    enter = max(enter, 0.0)
    if enter <= leave and enter <= limit:
        return enter
    return np.inf


@njit(cache=True, error_model="numpy", forceinline=True)
def _shear(dx, dy, dz):
    """Returns the axes (x, y, z) and shear that turn the ray into +z."""
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    if az >= ax and az >= ay:
        return 0, 1, 2, dx / dz, dy / dz, 1.0 / dz
    if ax >= ay:
        return 1, 2, 0, dy / dx, dz / dx, 1.0 / dx
    return 2, 0, 1, dz / dy, dx / dy, 1.0 / dy


@njit(cache=True, error_model="numpy", forceinline=True)
def _cross_triangle(triangles, i, p, kx, ky, kz, sx, sy, sz):
    """Returns (distance, side) where a line crosses triangle i.

    The side is 0 for a miss, else the sign of the projected area, which
    separates front from back. The distance may be negative.
    """
    az = triangles[i, kz] - p[kz]
    bz = triangles[i, 3 + kz] - p[kz]
    cz = triangles[i, 6 + kz] - p[kz]
    ax = triangles[i, kx] - p[kx] - sx * az
    ay = triangles[i, ky] - p[ky] - sy * az
    bx = triangles[i, 3 + kx] - p[kx] - sx * bz
    by = triangles[i, 3 + ky] - p[ky] - sy * bz
    cx = triangles[i, 6 + kx] - p[kx] - sx * cz
    cy = triangles[i, 6 + ky] - p[ky] - sy * cz
    u = cx * by - cy * bx
    v = ax * cy - ay * cx
    w = bx * ay - by * ax
    if (u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0):
        return np.inf, 0
    area = u + v + w
    if area == 0.0:
        return np.inf, 0
    return (u * az + v * bz + w * cz) * sz / area, 1 if area > 0.0 else -1


@njit(cache=True, error_model="numpy")
def cast_mesh(nodes, triangles, root, p, dx, dy, dz, limit, stack):
    """Returns (distance, triangle) of the first hit before limit.

    Args:
        nodes: See TriangleTree, shape (., 8).
        triangles: Corners, shape (n, 9).
        root: The mesh's root node.
        p: Origin of the ray in G, shape (3,).
        dx: Its direction, a unit vector: x.
        dy: The same, y.
        dz: The same, z.
        limit: Hits from here on do not count.
        stack: Scratch space, shape (2, STACK).

    Returns:
        inf and -1 if there is none.
    """
    ix, iy, iz = _invert(dx), _invert(dy), _invert(dz)
    kx, ky, kz, sx, sy, sz = _shear(dx, dy, dz)
    best, found = limit, -1
    stack[0, 0] = root
    stack[1, 0] = _enter_box(nodes, root, p[0], p[1], p[2], ix, iy, iz, best)
    top = 1
    while top > 0:
        top -= 1
        if not stack[1, top] < best:
            continue
        node = int(stack[0, top])
        first, count = int(nodes[node, 6]), int(nodes[node, 7])
        if count > 0:
            for i in range(first, first + count):
                t, side = _cross_triangle(
                    triangles, i, p, kx, ky, kz, sx, sy, sz
                )
                if side != 0 and 0.0 <= t < best:
                    best, found = t, i
            continue
        near, far = first, first + 1
        a = _enter_box(nodes, near, p[0], p[1], p[2], ix, iy, iz, best)
        b = _enter_box(nodes, far, p[0], p[1], p[2], ix, iy, iz, best)
        if b < a:
            near, far = far, near
            a, b = b, a
        if b < best:
            stack[0, top], stack[1, top] = far, b
            top += 1
        if a < best:
            stack[0, top], stack[1, top] = near, a
            top += 1
    if found < 0:
        return np.inf, -1
    return best, found


@njit(cache=True, error_model="numpy")
def _count_turns(nodes, triangles, root, p, dx, dy, dz, stack):
    """Returns how many times a closed mesh encloses a point.

    Counts the surface's crossings along a ray, out less in.
    """
    ix, iy, iz = _invert(dx), _invert(dy), _invert(dz)
    kx, ky, kz, sx, sy, sz = _shear(dx, dy, dz)
    turns = 0
    stack[0, 0] = root
    top = 1
    while top > 0:
        top -= 1
        node = int(stack[0, top])
        if (
            _enter_box(nodes, node, p[0], p[1], p[2], ix, iy, iz, np.inf)
            == np.inf
        ):
            continue
        first, count = int(nodes[node, 6]), int(nodes[node, 7])
        if count > 0:
            for i in range(first, first + count):
                t, side = _cross_triangle(
                    triangles, i, p, kx, ky, kz, sx, sy, sz
                )
                if side != 0 and t >= 0.0:
                    turns += side
            continue
        stack[0, top], stack[0, top + 1] = first, first + 1
        top += 2
    return turns


@njit(cache=True, error_model="numpy")
def _encloses(nodes, triangles, root, p, stack):
    """Returns whether a closed mesh encloses a point.

    A ray through an edge counts it twice. So odd directions are taken, and the
    majority of three counts.
    """
    first = _count_turns(
        nodes, triangles, root, p, 0.4836, 0.3271, 0.8118, stack
    )
    second = _count_turns(
        nodes, triangles, root, p, -0.6123, 0.7481, 0.2559, stack
    )
    if (first != 0) == (second != 0):
        return first != 0
    third = _count_turns(
        nodes, triangles, root, p, 0.2087, -0.5312, -0.8211, stack
    )
    return third != 0


@njit(cache=True, error_model="numpy", forceinline=True)
def _is_near_edge(ax, ay, az, ex, ey, ez, within):
    """Returns whether the origin is near the edge from a to a + e."""
    length2 = ex * ex + ey * ey + ez * ez
    s = -(ax * ex + ay * ey + az * ez) / length2 if length2 > 0.0 else 0.0
    s = min(max(s, 0.0), 1.0)
    x, y, z = ax + s * ex, ay + s * ey, az + s * ez
    return x * x + y * y + z * z <= within * within


@njit(cache=True, error_model="numpy", forceinline=True)
def _is_near_triangle(triangles, i, p, within):
    """Returns whether a point is near triangle i, or closer than rounding.

    The slimmer a sliver, the less certain its plane.
    """
    # The corners and edges, from the point.
    ax, ay, az = (
        triangles[i, 0] - p[0],
        triangles[i, 1] - p[1],
        triangles[i, 2] - p[2],
    )
    ux, uy, uz = (
        triangles[i, 3] - triangles[i, 0],
        triangles[i, 4] - triangles[i, 1],
        triangles[i, 5] - triangles[i, 2],
    )
    vx, vy, vz = (
        triangles[i, 6] - triangles[i, 0],
        triangles[i, 7] - triangles[i, 1],
        triangles[i, 8] - triangles[i, 2],
    )
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = np.sqrt(nx * nx + ny * ny + nz * nz)
    u2 = ux * ux + uy * uy + uz * uz
    v2 = vx * vx + vy * vy + vz * vz
    a2 = ax * ax + ay * ay + az * az
    height = abs(ax * nx + ay * ny + az * nz)
    if height > within * area + _ROUNDING * np.sqrt(u2 * v2 * a2):
        return False
    # Where the point's foot is: its coordinates along u and v, times n^2.
    cx, cy, cz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    s = -(cx * vx + cy * vy + cz * vz)
    t = cx * ux + cy * uy + cz * uz
    if s >= 0.0 and t >= 0.0 and s + t <= area * area:
        return True
    return (
        _is_near_edge(ax, ay, az, ux, uy, uz, within)
        or _is_near_edge(ax, ay, az, vx, vy, vz, within)
        or _is_near_edge(
            ax + ux, ay + uy, az + uz, vx - ux, vy - uy, vz - uz, within
        )
    )


@njit(cache=True, error_model="numpy")
def _is_on_mesh(nodes, triangles, root, p, within, stack):
    """Returns whether a point is within a distance of any triangle."""
    stack[0, 0] = root
    top = 1
    while top > 0:
        top -= 1
        node = int(stack[0, top])
        if (
            p[0] < nodes[node, 0] - within
            or p[1] < nodes[node, 1] - within
            or p[2] < nodes[node, 2] - within
            or p[0] > nodes[node, 3] + within
            or p[1] > nodes[node, 4] + within
            or p[2] > nodes[node, 5] + within
        ):
            continue
        first, count = int(nodes[node, 6]), int(nodes[node, 7])
        if count > 0:
            for i in range(first, first + count):
                if _is_near_triangle(triangles, i, p, within):
                    return True
            continue
        stack[0, top], stack[0, top + 1] = first, first + 1
        top += 2
    return False


@njit(cache=True, error_model="numpy")
def is_in_mesh(nodes, triangles, root, solid, p, far, stack):
    """Returns whether a point is inside a mesh or on its surface.

    On the surface is what is nearer than 1e-14 of the largest coordinate:
    with less, rounding might let a ray neither start inside nor cross the
    surface.

    Args:
        nodes: See TriangleTree, shape (., 8).
        triangles: Corners, shape (n, 9).
        root: The mesh's root node.
        solid: The root node of what bounds a volume, -1 if nothing does.
        p: The point in G, shape (3,).
        far: Its largest coordinate in the world.
        stack: Scratch space, shape (2, STACK).
    """
    for j in range(6):
        far = max(far, abs(nodes[root, j]))
    if _is_on_mesh(nodes, triangles, root, p, ON * far, stack):
        return True
    if solid < 0:
        return False
    for j in range(3):
        if p[j] < nodes[solid, j] or p[j] > nodes[solid, 3 + j]:
            return False
    return _encloses(nodes, triangles, solid, p, stack)


@njit(cache=True, error_model="numpy")
def cast_convex(planes, first, count, p, dx, dy, dz):
    """Returns (distance, plane) of a ray from outside, inf and -1: miss.

    The polytope is the set with n.x <= h for its planes (n, h), rows first
    to first + count of planes, shape (n, 4).
    """
    enter, leave, found = 0.0, np.inf, -1
    for i in range(first, first + count):
        slope = planes[i, 0] * dx + planes[i, 1] * dy + planes[i, 2] * dz
        gap = planes[i, 3] - (
            planes[i, 0] * p[0] + planes[i, 1] * p[1] + planes[i, 2] * p[2]
        )
        if slope < 0.0:
            t = gap / slope
            if t >= enter:
                enter, found = t, i
        elif slope > 0.0:
            leave = min(leave, gap / slope)
        elif gap < 0.0:
            return np.inf, -1
        if enter > leave:
            return np.inf, -1
    return enter, found


@njit(cache=True, error_model="numpy")
def leave_convex(planes, first, count, p, dx, dy, dz):
    """Returns (distance, plane) at which a ray from inside leaves."""
    leave, found = np.inf, -1
    for i in range(first, first + count):
        slope = planes[i, 0] * dx + planes[i, 1] * dy + planes[i, 2] * dz
        if slope > 0.0:
            gap = planes[i, 3] - (
                planes[i, 0] * p[0] + planes[i, 1] * p[1] + planes[i, 2] * p[2]
            )
            t = max(gap / slope, 0.0)
            if t < leave:
                leave, found = t, i
    return leave, found


@njit(cache=True, error_model="numpy")
def is_inside_convex(planes, first, count, p, within):
    """Returns whether a point is inside a polytope or on its surface.

    With `within` above 0: at least that far inside.
    """
    for i in range(first, first + count):
        if (
            planes[i, 0] * p[0] + planes[i, 1] * p[1] + planes[i, 2] * p[2]
            > planes[i, 3] - within
        ):
            return False
    return True
