"""Compiled kernels of the ray caster: bundles or single rays against a scene.

The scene is passed as the poses of its f frames, X_WF (f, 3, 4), and a
tuple of a few tables, since each array costs a fraction of a microsecond on
the way into compiled code; integers are therefore stored as floats, too:

  shapes     (n, 25)  one row for each shape, see the columns below
  balls      (., 7)   bounding balls of shapes and of groups of them, see below
  faces               a tuple of three more:
    planes     (., 4)   (n, h) of all polytopes: the points with n.x <= h
    nodes      (., 8)   of all meshes, see TriangleTree
    triangles  (., 9)   of all meshes, see TriangleTree

What a bundle or ray cannot see is ruled out in three steps: by the balls, by
the box around each shape, and, beyond the nearest hit so far, by the least
distance at which that box can be met.
"""

from typing import NamedTuple

import numpy as np

from tofssm_drake.kernels import njit
from tofssm_drake.raycast.mesh_kernels import (
    ON,
    STACK,
    cast_convex,
    cast_mesh,
    is_in_mesh,
    is_inside_convex,
    leave_convex,
)
from tofssm_drake.raycast.shape_kernels import (
    BOX,
    CAPSULE,
    CYLINDER,
    HALF_SPACE,
    SPHERE,
    cast_box,
    cast_capsule,
    cast_cylinder,
    cast_ellipsoid,
    cast_half_space,
    cast_primitive,
    cast_sphere,
    find_normal,
    is_in_primitive,
    leave_primitive,
)

CONVEX = 6
"""Kinds above those of shape_kernels. Data: first plane, number of planes."""
MESH = 7
"""Data: root node of all triangles, and of those that bound a volume, or -1."""

POSE = 0
"""Columns of shapes: X_FG row by row (12)."""
SIZE = 12
"""Sizes, according to the kind (3)."""
LOW = 15
"""Lower corner of a box around the shape in G, may be infinite (3)."""
HIGH = 18
"""Its upper corner (3)."""
KIND = 21
"""What it is."""
FRAME = 22
"""Row of its frame in X_WF."""
DATA = 23
"""Where the data of a polytope or mesh are (2)."""
SHAPE_COLUMNS = 25

BALL_CENTRE = 0
"""Columns of balls: centre in its frame F (3)."""
BALL_RADIUS = 3
"""Radius, inf for what has no bounds."""
BALL_FRAME = 4
"""Row of its frame in X_WF."""
BALL_FIRST = 5
"""A shape; or with a count, the first ball within this one."""
BALL_COUNT = 6
"""How many balls are within this one. Row 0 is around everything: its balls,
rows 1 and following, are tested for each bundle and ray."""
BALL_COLUMNS = 7

BUNDLE_RANGE = 12
"""Columns of bundles: X_FS row by row (12), the range."""
BUNDLE_FRAME = 13
"""Row of its frame in X_WF."""
BUNDLE_COLUMNS = 14

NEAR_P = 0
"""Columns of the shapes that a bundle may see: origin of its rays in G (3)."""
NEAR_R = 3
"""Its rotation R_GS, row by row (9)."""
NEAR_COLUMNS = 12

FAR = 1e100
"""Coordinates from here on are errors: their squares would overflow, m."""

OK = 0
BAD_POSE = 1
BAD_RAY = 2

# How far a rotation may be from orthonormal, or a direction from unit length.
_TOLERANCE = 1e-6
# Rounding must not drop a shape that is only touched.
_MARGIN = 1e-9
# Ciura's steps, for lists as long as a scene has shapes.
_GAPS = (1750, 701, 301, 132, 57, 23, 10, 4, 1)


class _Near(NamedTuple):
    """The shapes that a bundle may see, and scratch space to find them."""

    shape: np.ndarray
    """Their numbers."""
    enter: np.ndarray
    """The least distances, negative where the bundle starts inside, m."""
    posed: np.ndarray
    """Origin and rotation of the bundle in them, see NEAR_P."""
    order: np.ndarray
    """Rows of the above, the nearest first."""
    pending: np.ndarray
    """Balls that are still to be looked at."""
    X_WG: np.ndarray
    """A shape's pose."""
    stack: np.ndarray
    """For the trees of meshes, shape (2, STACK)."""


class _Rays(NamedTuple):
    """What is known of a bundle's rays, in their sorted order."""

    best: np.ndarray
    """The nearest hit so far, m."""
    hit: np.ndarray
    """Its shape, -1: none."""
    t: np.ndarray
    """Distance to the shape at hand, m."""
    d: np.ndarray
    """Their directions in this shape, (3, k)."""


class _Cone(NamedTuple):
    """The cone around a bundle's rays, in the world."""

    ox: float
    """Its tip (3)."""
    oy: float
    oz: float
    ux: float
    """Its axis, a unit vector (3)."""
    uy: float
    uz: float
    cos2: float
    """Squared cosine of half the opening angle; 0: any direction."""
    sin: float
    """Its sine."""
    floor: float
    """How far along the axis a ball must reach: 0, or -inf for any direction.
    """
    reach: float
    """Length of the rays, m."""


class _Ray(NamedTuple):
    """A single ray in the world."""

    ox: float
    """Its origin (3)."""
    oy: float
    oz: float
    ex: float
    """Its direction, a unit vector (3)."""
    ey: float
    ez: float


@njit(cache=True, error_model="numpy", forceinline=True)
def _compose(X_WF, f, table, row, X):
    """Writes X = X_WF[f] X_FG; X_FG is in a row of a table, row by row."""
    for i in range(3):
        for j in range(4):
            X[i, j] = (
                X_WF[f, i, 0] * table[row, j]
                + X_WF[f, i, 1] * table[row, 4 + j]
                + X_WF[f, i, 2] * table[row, 8 + j]
            )
        X[i, 3] += X_WF[f, i, 3]


@njit(cache=True, error_model="numpy", forceinline=True)
def _pose_ball(X_WF, balls, b):
    """Returns x, y, z of a ball's centre in the world."""
    f = int(balls[b, BALL_FRAME])
    x, y, z = balls[b, 0], balls[b, 1], balls[b, 2]
    return (
        X_WF[f, 0, 0] * x
        + X_WF[f, 0, 1] * y
        + X_WF[f, 0, 2] * z
        + X_WF[f, 0, 3],
        X_WF[f, 1, 0] * x
        + X_WF[f, 1, 1] * y
        + X_WF[f, 1, 2] * z
        + X_WF[f, 1, 3],
        X_WF[f, 2, 0] * x
        + X_WF[f, 2, 1] * y
        + X_WF[f, 2, 2] * z
        + X_WF[f, 2, 3],
    )


@njit(cache=True, error_model="numpy")
def are_poses(X_WF):
    """Returns whether all poses are within FAR and their rotations valid."""
    good = True
    for i in range(X_WF.shape[0]):
        # NaN fails each comparison.
        good &= (
            abs(X_WF[i, 0, 3]) + abs(X_WF[i, 1, 3]) + abs(X_WF[i, 2, 3]) < FAR
        )
        xx, xy, xz = X_WF[i, 0, 0], X_WF[i, 0, 1], X_WF[i, 0, 2]
        yx, yy, yz = X_WF[i, 1, 0], X_WF[i, 1, 1], X_WF[i, 1, 2]
        zx, zy, zz = X_WF[i, 2, 0], X_WF[i, 2, 1], X_WF[i, 2, 2]
        good &= abs(xx * xx + xy * xy + xz * xz - 1.0) <= _TOLERANCE
        good &= abs(yx * yx + yy * yy + yz * yz - 1.0) <= _TOLERANCE
        good &= abs(zx * zx + zy * zy + zz * zz - 1.0) <= _TOLERANCE
        good &= abs(xx * yx + xy * yy + xz * yz) <= _TOLERANCE
        good &= abs(yx * zx + yy * zy + yz * zz) <= _TOLERANCE
        good &= abs(zx * xx + zy * xy + zz * xz) <= _TOLERANCE
        # Not a reflection.
        good &= (
            xx * (yy * zz - yz * zy)
            + xy * (yz * zx - yx * zz)
            + xz * (yx * zy - yy * zx)
        ) > 0.0
    return good


@njit(cache=True, error_model="numpy")
def _pose_balls(X_WF, balls):
    """Returns centres x, y, z in the world and radii of the first balls.

    Shape (4, n) for the n balls within ball 0.
    """
    n = int(balls[0, BALL_COUNT])
    posed = np.empty((4, n))
    for b in range(n):
        x, y, z = _pose_ball(X_WF, balls, 1 + b)
        posed[0, b], posed[1, b], posed[2, b] = x, y, z
        posed[3, b] = balls[1 + b, BALL_RADIUS]
    return posed


@njit(cache=True, error_model="numpy")
def _make_mask(n):
    """Returns n flags, and a view of them in words of eight."""
    flags = np.zeros(8 * ((n + 7) // 8), dtype=np.uint8)
    return flags, flags.view(np.uint64)


@njit(cache=True, error_model="numpy", forceinline=True)
def _make_cone(X_WS, cones, reach):
    """Returns the cone around all rays of a bundle with this pose."""
    ax, ay, az = cones[0, 0], cones[0, 1], cones[0, 2]
    cos, sin = max(cones[0, 3], 0.0), cones[0, 4]
    return _Cone(
        X_WS[0, 3],
        X_WS[1, 3],
        X_WS[2, 3],
        X_WS[0, 0] * ax + X_WS[0, 1] * ay + X_WS[0, 2] * az,
        X_WS[1, 0] * ax + X_WS[1, 1] * ay + X_WS[1, 2] * az,
        X_WS[2, 0] * ax + X_WS[2, 1] * ay + X_WS[2, 2] * az,
        cos * cos,
        sin,
        0.0 if cos > 0.0 else -np.inf,
        reach,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _may_see_ball(cone, x, y, z, radius):
    """Returns whether a cone of rays may meet a ball, centre in the world.

    Without a branch or square root, as nearly all balls are out of view.
    """
    x, y, z = x - cone.ox, y - cone.oy, z - cone.oz
    gap2 = x * x + y * y + z * z
    along = x * cone.ux + y * cone.uy + z * cone.uz
    # The ball touches the edge of the cone: across cos = radius + along sin.
    edge = radius + along * cone.sin
    rest2 = edge * edge
    far = cone.reach + radius
    return (
        (gap2 * (1.0 - _MARGIN) <= far * far)
        & (along + radius * (1.0 + _MARGIN) >= cone.floor)
        & (
            (gap2 - along * along) * cone.cos2
            <= rest2 + _MARGIN * (gap2 + rest2)
        )
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _clip_cone(p, a, cos, sin, low, high, enter, leave):
    """Clips distances [enter, leave] along all rays of a cone to a slab.

    Args:
        p: Where the rays start, along the slab's normal.
        a: The same component of the cone's axis.
        cos: Cosine of half the opening angle; 0 or less: any direction.
        sin: Its sine.
        low: Where the slab begins.
        high: Where it ends.
        enter: No ray is in the previous slabs before this distance.
        leave: Nor beyond this one.
    """
    steepest, flattest = 1.0, -1.0
    if cos > 0.0:
        turn = np.sqrt(max(1.0 - a * a, 0.0)) * sin + _MARGIN
        if a < cos:
            steepest = a * cos + turn
        if a > -cos:
            flattest = a * cos - turn
    pad = _MARGIN * (1.0 + abs(p))
    low, high = low - pad - p, high + pad - p
    if low > 0.0:
        enter = max(enter, low / steepest if steepest > 0.0 else np.inf)
    elif steepest < 0.0:
        leave = min(leave, low / steepest)
    if high < 0.0:
        enter = max(enter, high / flattest if flattest < 0.0 else np.inf)
    elif flattest > 0.0:
        leave = min(leave, high / flattest)
    return enter, leave


@njit(cache=True, error_model="numpy", forceinline=True)
def _enter_shape_box(shapes, s, near, q, cones, g, reach):
    """Returns the least distance at which a cone may meet a shape, inf: none.

    Args:
        shapes: See the module.
        s: The shape.
        near: See NEAR_P.
        q: The shape's row there.
        cones: See cast_bundles.
        g: Row of the cone.
        reach: Length of the rays.
    """
    ax, ay, az = cones[g, 0], cones[g, 1], cones[g, 2]
    cos, sin = cones[g, 3], cones[g, 4]
    enter, leave = 0.0, reach
    for i in range(3):
        enter, leave = _clip_cone(
            near[q, NEAR_P + i],
            near[q, NEAR_R + 3 * i] * ax
            + near[q, NEAR_R + 3 * i + 1] * ay
            + near[q, NEAR_R + 3 * i + 2] * az,
            cos,
            sin,
            shapes[s, LOW + i],
            shapes[s, HIGH + i],
            enter,
            leave,
        )
    return enter if enter <= leave else np.inf


@njit(cache=True, error_model="numpy", forceinline=True)
def _pose_bundle(X_WF, shapes, s, X_WS, X_WG, near, q):
    """Writes origin and rotation of a bundle in shape s."""
    _compose(X_WF, int(shapes[s, FRAME]), shapes, s, X_WG)
    x = X_WS[0, 3] - X_WG[0, 3]
    y = X_WS[1, 3] - X_WG[1, 3]
    z = X_WS[2, 3] - X_WG[2, 3]
    for i in range(3):
        near[q, NEAR_P + i] = X_WG[0, i] * x + X_WG[1, i] * y + X_WG[2, i] * z
        for j in range(3):
            near[q, NEAR_R + 3 * i + j] = (
                X_WG[0, i] * X_WS[0, j]
                + X_WG[1, i] * X_WS[1, j]
                + X_WG[2, i] * X_WS[2, j]
            )


@njit(cache=True, error_model="numpy", forceinline=True)
def _is_in_box(shapes, s, x, y, z):
    """Returns whether a point in G is in the box around shape s."""
    return (
        (x >= shapes[s, LOW])
        & (x <= shapes[s, HIGH])
        & (y >= shapes[s, LOW + 1])
        & (y <= shapes[s, HIGH + 1])
        & (z >= shapes[s, LOW + 2])
        & (z <= shapes[s, HIGH + 2])
    )


@njit(cache=True, error_model="numpy")
def _sort(order, key, n):
    """Sorts the first n numbers in `order` by their key (Shell's method)."""
    for gap in _GAPS:
        for i in range(gap, n):
            this = order[i]
            j = i
            while j >= gap and key[order[j - gap]] > key[this]:
                order[j] = order[j - gap]
                j -= gap
            order[j] = this


@njit(cache=True, error_model="numpy", nogil=True)
def cast_bundles(
    X_WF, scene, bundles, active, which, fan, cones, distance, index
):
    """Casts m bundles of k rays each; see RayCaster.cast_bundles.

    Args:
        X_WF: See the module.
        scene: See the module.
        bundles: See the columns above, shape (m, 14).
        active: Whether bundle i is cast against shape s, bool, (m, n).
        which: Whether bundle i is cast at all, bool, (m,).
        fan: Unit directions in S (x, y, z), sorted into groups, and the place
            of each ray in the results, shape (4, k).
        cones: Axis, cosine and sine of half the opening angle of a cone
            around all rays, then of one around each group of rays, with the
            first ray and the one behind the last, shape (1 + groups, 7).
        distance: Written, shape (m, k).
        index: Written, int64, shape (m, k).

    Returns:
        Status.
    """
    if not are_poses(X_WF):
        return BAD_POSE
    balls = scene[1]
    posed = _pose_balls(X_WF, balls)
    seen = _make_mask(posed.shape[1])
    X_WS = np.empty((3, 4))
    near = _make_near(scene)
    rays = _make_rays(fan.shape[1])
    for i in range(bundles.shape[0]):
        if not which[i]:
            distance[i] = np.inf
            index[i] = -1
            continue
        _compose(X_WF, int(bundles[i, BUNDLE_FRAME]), bundles, i, X_WS)
        cone = _make_cone(X_WS, cones, bundles[i, BUNDLE_RANGE])
        _mark_balls(posed, cone, seen[0])
        count = _find_near(
            X_WF, scene, active[i], seen, X_WS, cones, cone, near
        )
        _cast_near(scene, near, count, fan, cones, cone.reach, rays)
        for j in range(fan.shape[1]):
            place = int(fan[3, j])
            index[i, place] = rays.hit[j]
            # Not -0.0.
            distance[i, place] = (
                abs(rays.best[j]) if rays.hit[j] >= 0 else np.inf
            )
    return OK


@njit(cache=True, error_model="numpy", forceinline=True)
def _make_near(scene):
    """Returns the scratch space for a scene's near shapes."""
    shapes, balls, _ = scene
    n = shapes.shape[0]
    return _Near(
        np.empty(n, dtype=np.int64),
        np.empty(n),
        np.empty((n, NEAR_COLUMNS)),
        np.empty(n, dtype=np.int64),
        np.empty(balls.shape[0], dtype=np.int64),
        np.empty((3, 4)),
        np.empty((2, STACK)),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _make_rays(k):
    """Returns the scratch space for k rays of a bundle."""
    return _Rays(
        np.empty(k), np.empty(k, dtype=np.int64), np.empty(k), np.empty((3, k))
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _mark_balls(posed, cone, flags):
    """Marks the balls that a bundle may see.

    Args:
        posed: See _pose_balls.
        cone: Around the bundle's rays.
        flags: Written: one for each ball.
    """
    for b in range(posed.shape[1]):
        flags[b] = _may_see_ball(
            cone, posed[0, b], posed[1, b], posed[2, b], posed[3, b]
        )


@njit(cache=True, error_model="numpy", forceinline=True)
def _find_near(X_WF, scene, active, seen, X_WS, cones, cone, near):
    """Finds the shapes that a bundle may see, the nearest first.

    Args:
        X_WF: See the module.
        scene: See the module.
        active: Whether it is cast against shape s, bool, shape (n,).
        seen: Flags of the balls that it may see, see _make_mask.
        X_WS: Pose of the bundle.
        cones: See cast_bundles.
        cone: Around all rays, in the world.
        near: Written, see _Near.

    Returns:
        How many they are.
    """
    shapes, balls, faces = scene
    flags, words = seen
    pending = near.pending
    far = max(abs(cone.ox), max(abs(cone.oy), abs(cone.oz)))
    count = 0
    for w in range(words.shape[0]):
        if words[w] == 0:
            continue
        for b in range(8 * w, min(8 * w + 8, int(balls[0, BALL_COUNT]))):
            if flags[b] == 0:
                continue
            pending[0] = 1 + b
            top = 1
            while top > 0:
                top -= 1
                first = int(balls[pending[top], BALL_FIRST])
                members = int(balls[pending[top], BALL_COUNT])
                for c in range(first, first + members):
                    x, y, z = _pose_ball(X_WF, balls, c)
                    if _may_see_ball(cone, x, y, z, balls[c, BALL_RADIUS]):
                        pending[top] = c
                        top += 1
                if members > 0 or not active[first]:
                    continue
                _pose_bundle(
                    X_WF, shapes, first, X_WS, near.X_WG, near.posed, count
                )
                enter = _enter_shape_box(
                    shapes, first, near.posed, count, cones, 0, cone.reach
                )
                if enter == np.inf:
                    continue
                if enter == 0.0 and _is_in_shape(
                    shapes,
                    faces,
                    first,
                    near.posed[count],
                    far,
                    False,
                    near.stack,
                ):
                    enter = -1.0
                near.shape[count] = first
                near.enter[count] = enter
                near.order[count] = count
                count += 1
    _sort(near.order, near.enter, count)
    return count


@njit(cache=True, error_model="numpy", forceinline=True)
def _cast_near(scene, near, count, fan, cones, reach, rays):
    """Casts a bundle's rays, group by group, at the shapes it may see.

    Args:
        scene: See the module.
        near: See _Near.
        count: How many shapes are there.
        fan: See cast_bundles.
        cones: See cast_bundles.
        reach: Length of the rays.
        rays: Written, see _Rays.
    """
    shapes, _, faces = scene
    best, hit, t, d = rays
    groups = cones.shape[0] - 1
    # A hit at exactly the range counts, hence the next number.
    best[:] = np.nextafter(reach, np.inf)
    hit[:] = -1
    for g in range(1, 1 + groups):
        # Unsigned: Numba need not check for indices from the end.
        first, last = np.uint64(cones[g, 5]), np.uint64(cones[g, 6])
        for o in range(count):
            q = near.order[o]
            s = near.shape[q]
            if near.enter[q] < 0.0:
                for j in range(first, last):
                    t[j] = 0.0
            else:
                worst = 0.0
                for j in range(first, last):
                    worst = max(worst, best[j])
                if near.enter[q] > worst:
                    break
                if groups > 1 and (
                    _enter_shape_box(shapes, s, near.posed, q, cones, g, worst)
                    == np.inf
                ):
                    continue
                p = near.posed[q]
                for j in range(first, last):
                    x, y, z = fan[0, j], fan[1, j], fan[2, j]
                    d[0, j] = p[3] * x + p[4] * y + p[5] * z
                    d[1, j] = p[6] * x + p[7] * y + p[8] * z
                    d[2, j] = p[9] * x + p[10] * y + p[11] * z
                if int(shapes[s, KIND]) < CONVEX:
                    _cast_group(shapes, s, p, d, first, last, t)
                else:
                    _cast_group_at_faces(
                        shapes, faces, s, p, rays, first, last, near.stack
                    )
            for j in range(first, last):
                nearer = (t[j] < best[j]) | ((t[j] == best[j]) & (s < hit[j]))
                best[j] = t[j] if nearer else best[j]
                hit[j] = s if nearer else hit[j]


@njit(cache=True, error_model="numpy", forceinline=True)
def _cast_group(shapes, s, p, d, first, last, t):
    """Casts a group of rays at a primitive shape.

    One loop for each kind, so that the compiler can vectorize it.

    Args:
        shapes: See the module.
        s: The shape.
        p: Common origin of the rays in G, shape (3+,).
        d: Their directions in G, shape (3, k).
        first: The first ray.
        last: The one behind the last.
        t: Written: their distances, shape (k,).
    """
    kind = int(shapes[s, KIND])
    a, b, c = shapes[s, SIZE], shapes[s, SIZE + 1], shapes[s, SIZE + 2]
    x, y, z = p[0], p[1], p[2]
    if kind == SPHERE:
        for j in range(first, last):
            t[j] = cast_sphere(x, y, z, d[0, j], d[1, j], d[2, j], a)
    elif kind == CAPSULE:
        for j in range(first, last):
            t[j] = cast_capsule(x, y, z, d[0, j], d[1, j], d[2, j], a, b)
    elif kind == CYLINDER:
        for j in range(first, last):
            t[j] = cast_cylinder(x, y, z, d[0, j], d[1, j], d[2, j], a, b)
    elif kind == BOX:
        for j in range(first, last):
            t[j] = cast_box(x, y, z, d[0, j], d[1, j], d[2, j], a, b, c)
    elif kind == HALF_SPACE:
        for j in range(first, last):
            t[j] = cast_half_space(z, d[2, j])
    else:
        for j in range(first, last):
            t[j] = cast_ellipsoid(x, y, z, d[0, j], d[1, j], d[2, j], a, b, c)


@njit(cache=True, error_model="numpy", forceinline=True)
def _cast_group_at_faces(shapes, faces, s, p, rays, first, last, stack):
    """Casts a group of rays at a polytope or mesh.

    Args:
        shapes: See the module.
        faces: See the module.
        s: The shape.
        p: Common origin of the rays in G, shape (3+,).
        rays: Their distances t are written, see _Rays; what is farther than
            the best one does not count.
        first: The first ray.
        last: The one behind the last.
        stack: Scratch space, shape (2, STACK).
    """
    planes, nodes, triangles = faces
    best, _, t, d = rays
    part, parts = int(shapes[s, DATA]), int(shapes[s, DATA + 1])
    if int(shapes[s, KIND]) == CONVEX:
        for j in range(first, last):
            t[j], _ = cast_convex(
                planes, part, parts, p, d[0, j], d[1, j], d[2, j]
            )
        return
    for j in range(first, last):
        # The next number: an equal hit may count.
        limit = np.nextafter(best[j], np.inf)
        x, y, z = d[0, j], d[1, j], d[2, j]
        t[j], _ = cast_mesh(nodes, triangles, part, p, x, y, z, limit, stack)


@njit(cache=True, error_model="numpy")
def _pose_in_shape(X_WG, p_WR, p_GR):
    """Writes a point of the world in G."""
    x = p_WR[0] - X_WG[0, 3]
    y = p_WR[1] - X_WG[1, 3]
    z = p_WR[2] - X_WG[2, 3]
    for row in range(3):
        p_GR[row] = X_WG[0, row] * x + X_WG[1, row] * y + X_WG[2, row] * z


@njit(cache=True, error_model="numpy", forceinline=True)
def _may_hit_ball(ray, x, y, z, radius, reach):
    """Returns whether a ray may hit a ball, centre in the world.

    Without a branch, as nearly all balls are missed.
    """
    x, y, z = x - ray.ox, y - ray.oy, z - ray.oz
    gap2 = x * x + y * y + z * z
    along = max(x * ray.ex + y * ray.ey + z * ray.ez, 0.0)
    far = reach + radius
    return (gap2 * (1.0 - _MARGIN) - along * along <= radius * radius) & (
        gap2 * (1.0 - _MARGIN) <= far * far
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _turn_ray(X_WG, s, ray):
    """Returns a ray's origin (3) and direction (3) in shape s."""
    px, dx = _rotate(X_WG, s, 0, ray)
    py, dy = _rotate(X_WG, s, 1, ray)
    pz, dz = _rotate(X_WG, s, 2, ray)
    return px, py, pz, dx, dy, dz


@njit(cache=True, error_model="numpy", forceinline=True)
def _rotate(X_WG, s, axis, ray):
    """Returns a component of a ray's origin and direction in shape s."""
    a, b, c = X_WG[s, 0, axis], X_WG[s, 1, axis], X_WG[s, 2, axis]
    x = ray.ox - X_WG[s, 0, 3]
    y = ray.oy - X_WG[s, 1, 3]
    z = ray.oz - X_WG[s, 2, 3]
    return a * x + b * y + c * z, a * ray.ex + b * ray.ey + c * ray.ez


@njit(cache=True, error_model="numpy")
def _leave_shape(shapes, planes, s, p, dx, dy, dz, far):
    """Returns where a ray that starts inside shape s leaves it.

    0 if it starts on the surface, within rounding. Not for meshes, whose
    triangles are seen from both sides.
    """
    kind = int(shapes[s, KIND])
    a, b, c = shapes[s, SIZE], shapes[s, SIZE + 1], shapes[s, SIZE + 2]
    part, parts = int(shapes[s, DATA]), int(shapes[s, DATA + 1])
    within = ON * max(far, max(a, max(b, c)))
    if kind == CONVEX:
        if is_inside_convex(planes, part, parts, p, within):
            return leave_convex(planes, part, parts, p, dx, dy, dz)[0]
        return 0.0
    if kind == HALF_SPACE:
        is_deep = p[2] <= -within
    else:
        is_deep = is_in_primitive(
            kind, p[0], p[1], p[2], a - within, b - within, c - within
        )
    if not is_deep:
        return 0.0
    return leave_primitive(kind, p[0], p[1], p[2], dx, dy, dz, a, b, c)


@njit(cache=True, error_model="numpy", forceinline=True)
def _is_in_shape(shapes, faces, s, p, far, hollow, stack):
    """Returns whether a point in G is in shape s or on its surface.

    Args:
        shapes: See the module.
        faces: See the module.
        s: The shape.
        p: The point, shape (3,).
        far: Its largest coordinate in the world.
        hollow: Whether meshes have no inside.
        stack: Scratch space, shape (2, STACK).
    """
    planes, nodes, triangles = faces
    x, y, z = p[0], p[1], p[2]
    if not _is_in_box(shapes, s, x, y, z):
        return False
    kind = int(shapes[s, KIND])
    part, parts = int(shapes[s, DATA]), int(shapes[s, DATA + 1])
    if kind == CONVEX:
        return is_inside_convex(planes, part, parts, p, 0.0)
    if kind == MESH:
        solid = -1 if hollow else parts
        return is_in_mesh(nodes, triangles, part, solid, p, far, stack)
    a, b, c = shapes[s, SIZE], shapes[s, SIZE + 1], shapes[s, SIZE + 2]
    return is_in_primitive(kind, x, y, z, a, b, c)


@njit(cache=True, error_model="numpy", nogil=True)
def cast_rays(X_WF, scene, active, row, p_WR, n_WR, max_range, hollow):
    """Casts rays, each with its own origin; see RayCaster.cast.

    Args:
        X_WF: See the module.
        scene: See the module.
        active: Whether shape s is cast against, bool, shape (groups, n).
        row: Which row of `active` is a ray's, int64, shape (rays,).
        p_WR: Origins, shape (rays, 3).
        n_WR: Directions, shape (rays, 3), unit vectors to 1e-6.
        max_range: Range of each ray, shape (rays,).
        hollow: Whether shapes have no inside.

    Returns:
        (status, distance (rays,), index (rays,)).
    """
    # In one piece: a helper that takes arrays within these loops doubles the
    # time, as Numba counts the references of each array at each call.
    shapes, balls, (planes, nodes, triangles) = scene
    rays, n = p_WR.shape[0], shapes.shape[0]
    distance = np.full(rays, np.inf)
    index = np.full(rays, -1, dtype=np.int64)
    if not are_poses(X_WF):
        return BAD_POSE, distance, index
    posed = _pose_balls(X_WF, balls)
    flags, words = _make_mask(posed.shape[1])
    pending = np.empty(balls.shape[0], dtype=np.int64)
    X, X_WG = np.empty((3, 4)), np.empty((n, 3, 4))
    is_posed = np.zeros(n, dtype=np.bool_)
    p, stack = np.empty(3), np.empty((2, STACK))
    for i in range(rays):
        is_good, ray = _make_ray(p_WR, n_WR, i)
        if not is_good:
            return BAD_RAY, distance, index
        reach = max_range[i]
        far = max(abs(ray.ox), max(abs(ray.oy), abs(ray.oz)))
        for b in range(posed.shape[1]):
            x, y, z, r = posed[0, b], posed[1, b], posed[2, b], posed[3, b]
            flags[b] = _may_hit_ball(ray, x, y, z, r, reach)
        # A hit at exactly the range counts, hence the next number.
        best, hit = np.nextafter(reach, np.inf), -1
        for w in range(words.shape[0]):
            if words[w] == 0:
                continue
            for b in range(8 * w, min(8 * w + 8, posed.shape[1])):
                if flags[b] == 0:
                    continue
                pending[0] = 1 + b
                top = 1
                while top > 0:
                    top -= 1
                    s = int(balls[pending[top], BALL_FIRST])
                    count = int(balls[pending[top], BALL_COUNT])
                    for c in range(s, s + count):
                        x, y, z = _pose_ball(X_WF, balls, c)
                        r = balls[c, BALL_RADIUS]
                        if _may_hit_ball(ray, x, y, z, r, best):
                            pending[top] = c
                            top += 1
                    if count > 0 or not active[row[i], s]:
                        continue
                    if not is_posed[s]:
                        _compose(X_WF, int(shapes[s, FRAME]), shapes, s, X)
                        X_WG[s] = X
                        is_posed[s] = True
                    px, py, pz, dx, dy, dz = _turn_ray(X_WG, s, ray)
                    may_be_inside = _is_in_box(shapes, s, px, py, pz)
                    kind, size, part, parts = _read_shape(shapes, s)
                    if kind < CONVEX:
                        t = _cast_primitive(
                            kind, size, px, py, pz, dx, dy, dz, may_be_inside
                        )
                    elif kind == CONVEX:
                        p[0], p[1], p[2] = px, py, pz
                        if may_be_inside and is_inside_convex(
                            planes, part, parts, p, 0.0
                        ):
                            t = 0.0
                        else:
                            t, _ = cast_convex(
                                planes, part, parts, p, dx, dy, dz
                            )
                    else:
                        p[0], p[1], p[2] = px, py, pz
                        solid = -1 if hollow else parts
                        if may_be_inside and is_in_mesh(
                            nodes, triangles, part, solid, p, far, stack
                        ):
                            t = 0.0
                        else:
                            # The next number: an equal hit may count.
                            limit = np.nextafter(best, np.inf)
                            t, _ = cast_mesh(
                                nodes, triangles, part, p, dx, dy, dz, limit,
                                stack,
                            )  # fmt: skip
                    if hollow and t == 0.0 and kind != MESH:
                        p[0], p[1], p[2] = px, py, pz
                        t = _leave_shape(shapes, planes, s, p, dx, dy, dz, far)
                    if t < best or (t == best and s < hit):
                        best, hit = t, s
        if hit >= 0:
            distance[i] = abs(best)  # Not -0.0.
            index[i] = hit
    return OK, distance, index


@njit(cache=True, error_model="numpy", forceinline=True)
def _make_ray(p_WR, n_WR, i):
    """Returns (is_good, ray): whether ray i is valid, and it, normalized."""
    ox, oy, oz = p_WR[i, 0], p_WR[i, 1], p_WR[i, 2]
    ex, ey, ez = n_WR[i, 0], n_WR[i, 1], n_WR[i, 2]
    length = np.sqrt(ex * ex + ey * ey + ez * ez)
    # NaN fails each comparison.
    is_good = (abs(length - 1.0) <= _TOLERANCE) & (
        abs(ox) + abs(oy) + abs(oz) < FAR
    )
    return is_good, _Ray(ox, oy, oz, ex / length, ey / length, ez / length)


@njit(cache=True, error_model="numpy", forceinline=True)
def _read_shape(shapes, s):
    """Returns kind, sizes (3) and data (2) of a shape."""
    a, b, c = shapes[s, SIZE], shapes[s, SIZE + 1], shapes[s, SIZE + 2]
    return (
        int(shapes[s, KIND]),
        (a, b, c),
        int(shapes[s, DATA]),
        int(shapes[s, DATA + 1]),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _cast_primitive(kind, size, px, py, pz, dx, dy, dz, may_be_inside):
    """Returns the distance to a primitive shape along a ray, see _turn_ray."""
    a, b, c = size
    if may_be_inside and is_in_primitive(kind, px, py, pz, a, b, c):
        return 0.0
    return cast_primitive(kind, px, py, pz, dx, dy, dz, a, b, c)


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


@njit(cache=True, error_model="numpy", nogil=True)
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
    shapes, _, faces = scene
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
        _compose(X_WF, int(shapes[s, FRAME]), shapes, s, X)
        _pose_in_shape(X, p_WR[i], p)
        dx = X[0, 0] * n_WR[i, 0] + X[1, 0] * n_WR[i, 1] + X[2, 0] * n_WR[i, 2]
        dy = X[0, 1] * n_WR[i, 0] + X[1, 1] * n_WR[i, 1] + X[2, 1] * n_WR[i, 2]
        dz = X[0, 2] * n_WR[i, 0] + X[1, 2] * n_WR[i, 1] + X[2, 2] * n_WR[i, 2]
        x, y, z = _find_hit_normal(shapes, faces, s, p, (dx, dy, dz), t, stack)
        length = np.sqrt(x * x + y * y + z * z)
        for j in range(3):
            normals[i, j] = (X[j, 0] * x + X[j, 1] * y + X[j, 2] * z) / length
    return normals


@njit(cache=True, error_model="numpy", forceinline=True)
def _find_hit_normal(shapes, faces, s, p, d, t, stack):
    """Returns the direction of a shape's normal, in G, that faces a ray.

    NaN if there is no hit. A ray that starts inside a shape other than a
    mesh, and hits it farther on, leaves it there.

    Args:
        shapes: See the module.
        faces: See the module.
        s: The shape.
        p: Origin of the ray in G, shape (3,).
        d: Its direction in G, a tuple (3).
        t: Distance of the hit, m.
        stack: Scratch space, shape (2, STACK).
    """
    dx, dy, dz = d
    kind, size, part, parts = _read_shape(shapes, s)
    if kind == MESH:
        _, nodes, triangles = faces
        _, found = cast_mesh(
            nodes, triangles, part, p, dx, dy, dz, np.inf, stack
        )
        if found < 0:
            return np.nan, np.nan, np.nan
        return _find_triangle_normal(triangles, found, dx, dy, dz)
    inside = _is_in_shape(shapes, faces, s, p, 0.0, True, stack)
    side = -1.0 if inside else 1.0
    if kind == CONVEX:
        planes, _, _ = faces
        if inside:
            _, found = leave_convex(planes, part, parts, p, dx, dy, dz)
        else:
            _, found = cast_convex(planes, part, parts, p, dx, dy, dz)
        if found < 0:
            return np.nan, np.nan, np.nan
        x, y, z = planes[found, 0], planes[found, 1], planes[found, 2]
    else:
        x, y, z = p[0] + t * dx, p[1] + t * dy, p[2] + t * dz
        a, b, c = size
        x, y, z = find_normal(
            kind, a, b, c, x, y, z, side * dx, side * dy, side * dz
        )
    return side * x, side * y, side * z
