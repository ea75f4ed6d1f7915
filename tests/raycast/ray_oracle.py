"""An independent closed form in extended precision, and scenes to try it on.

Nothing here shares a formula with the caster: every shape is the union of
intervals along the ray, found from the textbook quadratic with 64 bits of
mantissa.
"""

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    HalfSpace,
    IllustrationProperties,
    Mesh,
    PerceptionProperties,
    ProximityProperties,
    Role,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from solids import (
    find_hull_planes,
    make_mesh,
    make_stone,
    read_mesh,
    write_obj,
)

LONG = np.longdouble


def solve_quadratic(a, b, c):
    """Returns where a t^2 + 2 b t + c <= 0, as (first, last), inf if never.

    For a ball or tube, so a >= 0, and a == 0 means parallel.
    """
    first = np.full(np.broadcast(a, b, c).shape, LONG("inf"))
    last = -first
    rest = b * b - a * c
    with np.errstate(all="ignore"):
        good = (a > 0) & (rest >= 0)
        first = np.where(good, (-b - np.sqrt(rest)) / a, first)
        last = np.where(good, (-b + np.sqrt(rest)) / a, last)
    always = (a == 0) & (c <= 0)
    first = np.where(always, -LONG("inf"), first)
    last = np.where(always, LONG("inf"), last)
    return first, last


def solve_slab(p, d, low, high):
    with np.errstate(all="ignore"):
        t_low, t_high = (low - p) / d, (high - p) / d
    first, last = np.minimum(t_low, t_high), np.maximum(t_low, t_high)
    within = (p >= low) & (p <= high)
    first = np.where(d == 0, np.where(within, -np.inf, np.inf), first)
    last = np.where(d == 0, np.where(within, np.inf, -np.inf), last)
    return first, last


def intersect(*intervals):
    return (
        np.max([i[0] for i in intervals], axis=0),
        np.min([i[1] for i in intervals], axis=0),
    )


def solve_ball(p, d, centre, radius):
    v = p - np.asarray(centre, dtype=LONG)
    return solve_quadratic(
        (d * d).sum(-1), (v * d).sum(-1), (v * v).sum(-1) - LONG(radius) ** 2
    )


def solve_tube(p, d, radius):
    return solve_ball(p[..., :2], d[..., :2], [0, 0], radius)


def solve_convex(shape, p, d):
    planes = find_hull_planes(read_mesh(shape)[0]).astype(LONG)
    gap = planes[:, 3] - p @ planes[:, :3].T
    slope = d @ planes[:, :3].T
    with np.errstate(all="ignore"):
        t = gap / slope
    parallel = np.where(gap >= 0, -LONG("inf"), LONG("inf"))
    first = np.where(slope < 0, t, np.where(slope == 0, parallel, -np.inf))
    return first.max(-1), np.where(slope > 0, t, np.inf).min(-1)


def solve_mesh(shape, p, d):
    """Cramer's rule for each triangle; an odd number of crossings: inside."""
    vertices, faces = read_mesh(shape)
    a, b, c = (vertices[faces[:, i]].astype(LONG) for i in range(3))
    nearest = np.full(len(p), LONG("inf"))
    crossings = np.zeros(len(p), dtype=int)
    for i in range(len(faces)):
        # p + t d = a + u (b - a) + v (c - a)
        ab, ac, ap = b[i] - a[i], c[i] - a[i], p - a[i]
        normal = np.cross(ab, ac)
        with np.errstate(all="ignore"):
            det = -(d @ normal)
            moment = np.cross(ap, d)
            t = (ap @ normal) / det
            u = (moment @ ac) / det
            v = -(moment @ ab) / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)
        crossings += hit
        nearest = np.where(hit & (t < nearest), t, nearest)
    inside = crossings % 2 == 1
    return (
        np.where(inside, -LONG("inf"), nearest),
        np.where(inside | np.isfinite(nearest), LONG("inf"), -LONG("inf")),
    )


def solve_shape(shape, p, d):
    """Returns the intervals of rays (p, d in G) that make up a shape."""
    if isinstance(shape, Sphere):
        return [solve_ball(p, d, [0, 0, 0], shape.radius())]
    if isinstance(shape, Ellipsoid):
        axes = np.array([shape.a(), shape.b(), shape.c()], dtype=LONG)
        return [solve_ball(p / axes, d / axes, [0, 0, 0], 1)]
    if isinstance(shape, Capsule | Cylinder):
        half = LONG(shape.length()) / 2
        middle = intersect(
            solve_tube(p, d, shape.radius()),
            solve_slab(p[..., 2], d[..., 2], -half, half),
        )
        if isinstance(shape, Cylinder):
            return [middle]
        return [
            middle,
            solve_ball(p, d, [0, 0, half], shape.radius()),
            solve_ball(p, d, [0, 0, -half], shape.radius()),
        ]
    if isinstance(shape, Box):
        half = np.asarray(shape.size(), dtype=LONG) / 2
        return [
            intersect(
                *(
                    solve_slab(p[..., i], d[..., i], -half[i], half[i])
                    for i in range(3)
                )
            )
        ]
    if isinstance(shape, Convex):
        return [solve_convex(shape, p, d)]
    if isinstance(shape, Mesh):
        return [solve_mesh(shape, p, d)]
    assert isinstance(shape, HalfSpace)
    return [solve_slab(p[..., 2], d[..., 2], -LONG("inf"), LONG(0))]


def cast(shapes, X_WG, p_WR, n_WR, max_range=np.inf):
    """Returns (distance, index) of rays against posed shapes."""
    p_WR = np.asarray(p_WR, dtype=LONG)
    n_WR = np.asarray(n_WR, dtype=LONG)
    n_WR = n_WR / np.sqrt((n_WR * n_WR).sum(-1, keepdims=True))
    distance = np.full(len(p_WR), LONG("inf"))
    index = np.full(len(p_WR), -1)
    for i, (shape, X) in enumerate(zip(shapes, X_WG, strict=True)):
        R = X.rotation().matrix().astype(LONG)
        p = (p_WR - X.translation().astype(LONG)) @ R
        d = n_WR @ R
        for first, last in solve_shape(shape, p, d):
            hit = (first <= last) & (last >= 0)
            t = np.where(hit, np.maximum(first, 0), np.inf)
            nearer = (t < distance) & (t <= max_range)
            distance = np.where(nearer, t, distance)
            index = np.where(nearer, i, index)
    return distance, index


def calc_slope(scene, caster, p_WR, n_WR, distance, index):
    """Returns how steeply rays meet the surface: 1 square, 0 tangent."""
    shapes, X_WG = scene.shapes_in_order(caster.geometry_ids)
    slope = np.ones(len(p_WR))
    for i, (shape, X) in enumerate(zip(shapes, X_WG, strict=True)):
        rows = np.flatnonzero((index == i) & (distance > 0))
        if len(rows) == 0:
            continue
        p = X.inverse() @ (p_WR[rows] + distance[rows, None] * n_WR[rows]).T
        d = X.rotation().inverse() @ n_WR[rows].T
        normal = calc_normal(shape, p.T)
        slope[rows] = np.abs((normal * d.T).sum(-1))
    return slope


def calc_normal(shape, p):
    """Returns outward normals at points on a shape, in G."""
    if isinstance(shape, Sphere):
        n = p
    elif isinstance(shape, Capsule):
        half = shape.length() / 2
        n = p - np.clip(p[:, 2:], -half, half) * [0, 0, 1]
    elif isinstance(shape, Cylinder):
        side = np.linalg.norm(p[:, :2], axis=1) - shape.radius()
        end = np.abs(p[:, 2]) - shape.length() / 2
        n = np.where(
            (side > end)[:, None], p * [1, 1, 0], np.sign(p) * [0, 0, 1]
        )
    elif isinstance(shape, Box):
        excess = np.abs(p) - np.asarray(shape.size()) / 2
        n = np.eye(3)[np.argmax(excess, axis=1)] * np.sign(p)
    elif isinstance(shape, HalfSpace):
        n = np.tile([0.0, 0.0, 1.0], (len(p), 1))
    elif isinstance(shape, Convex):
        planes = find_hull_planes(read_mesh(shape)[0])
        gap = p @ planes[:, :3].T - planes[:, 3]
        n = planes[np.argmax(gap, axis=1), :3]
    elif isinstance(shape, Mesh):
        n = calc_mesh_normal(shape, p)
    else:
        n = p / np.array([shape.a(), shape.b(), shape.c()]) ** 2
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def calc_mesh_normal(shape, p):
    """Returns the normals of the triangles that points are on."""
    vertices, faces = read_mesh(shape)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    area2 = np.linalg.norm(normal, axis=1)
    normal /= area2[:, None]
    gap = np.abs(((p[:, None] - a) * normal).sum(-1))
    for first, second in ((a, b), (b, c), (c, a)):
        within = np.cross(normal, second - first)
        within /= np.linalg.norm(within, axis=1, keepdims=True)
        gap = np.maximum(gap, -((p[:, None] - first) * within).sum(-1))
    return normal[np.argmin(gap, axis=1)]


def assert_same_hits(scene, caster, p_WR, n_WR, distance, index, expected):
    """Distances agree to 1e-12, but where the ray only grazes.

    There the distance is as uncertain as rounding over the slope, and hit or
    miss may differ.
    """
    want, want_index = expected
    want = want.astype(float)
    slope = np.minimum(
        calc_slope(scene, caster, p_WR, n_WR, distance, index),
        calc_slope(scene, caster, p_WR, n_WR, want, want_index),
    )
    clear = slope > 1e-3
    np.testing.assert_allclose(distance[clear], want[clear], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(index[clear], want_index[clear])
    grazing = ~clear & (slope > 1e-6)
    error = np.abs(distance[grazing] - want[grazing])
    np.testing.assert_array_less(error, 1e-14 / slope[grazing] + 1e-12)
    assert clear.mean() > 0.95


def make_random_pose(rng, spread=1.0):
    return RigidTransform(
        RotationMatrix(Quaternion(_unit(rng.normal(size=4)))),
        rng.uniform(-spread, spread, 3),
    )


def make_unit_vectors(rng, n):
    return _unit(rng.normal(size=(n, 3)))


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def make_random_shape(rng, kind):
    size = rng.uniform(0.05, 0.4, 3)
    return {
        "sphere": lambda: Sphere(size[0]),
        "capsule": lambda: Capsule(size[0], 2 * size[1]),
        "cylinder": lambda: Cylinder(size[0], 2 * size[1]),
        "box": lambda: Box(*size),
        "ellipsoid": lambda: Ellipsoid(*size),
        "half_space": HalfSpace,
        "convex": lambda: make_mesh(
            write_obj(make_unit_vectors(rng, 12), [[0, 1, 2]]),
            scale=size,
            kind=Convex,
        ),
        "mesh": lambda: make_mesh(
            write_obj(*make_stone(rng)), scale=rng.uniform(0.7, 1.4, 3)
        ),
    }[kind]()


KINDS = ("sphere", "capsule", "cylinder", "box", "ellipsoid", "half_space")
ALL_KINDS = (*KINDS, "convex", "mesh")


class Scene:
    """A SceneGraph with shapes on moving frames and on the world."""

    def __init__(self, role=Role.kPerception):
        self.role = role
        self.scene_graph = SceneGraph()
        self.source_id = self.scene_graph.RegisterSource("scene")
        self.frame_ids = []
        self.poses = {}
        self.shapes = []
        self.geometry_ids = []
        self.X_FG = []
        self.parents = []
        self.context = None

    def add_frame(self, X_WF=None):
        name = f"frame_{len(self.frame_ids)}"
        frame_id = self.scene_graph.RegisterFrame(
            self.source_id, GeometryFrame(name)
        )
        self.frame_ids.append(frame_id)
        self.poses[frame_id] = RigidTransform() if X_WF is None else X_WF
        return frame_id

    def add(self, shape, X_FG=None, frame_id=None, role="same", name=None):
        X_FG = RigidTransform() if X_FG is None else X_FG
        name = name or f"shape_{len(self.shapes)}"
        instance = GeometryInstance(X_FG, shape, name)
        role = self.role if role == "same" else role
        if role == Role.kPerception:
            instance.set_perception_properties(PerceptionProperties())
        elif role == Role.kProximity:
            instance.set_proximity_properties(ProximityProperties())
        elif role == Role.kIllustration:
            instance.set_illustration_properties(IllustrationProperties())
        if frame_id is None:
            geometry_id = self.scene_graph.RegisterAnchoredGeometry(
                self.source_id, instance
            )
        else:
            geometry_id = self.scene_graph.RegisterGeometry(
                self.source_id, frame_id, instance
            )
        self.shapes.append(shape)
        self.geometry_ids.append(geometry_id)
        self.X_FG.append(X_FG)
        self.parents.append(frame_id)
        return geometry_id

    @property
    def inspector(self):
        return self.scene_graph.model_inspector()

    def query_object(self):
        if self.context is None:
            self.context = self.scene_graph.CreateDefaultContext()
        poses = FramePoseVector()
        for frame_id, X_WF in self.poses.items():
            poses.set_value(frame_id, X_WF)
        self.scene_graph.get_source_pose_port(self.source_id).FixValue(
            self.context, Value(poses)
        )
        return self.scene_graph.get_query_output_port().Eval(self.context)

    def move(self, rng):
        for frame_id in self.poses:
            self.poses[frame_id] = make_random_pose(rng)

    def X_WG(self):
        return [
            X_FG if frame_id is None else self.poses[frame_id] @ X_FG
            for frame_id, X_FG in zip(self.parents, self.X_FG, strict=True)
        ]

    def shapes_in_order(self, geometry_ids):
        """Returns (shapes, X_WG) in a caster's order."""
        rows = [self.geometry_ids.index(g) for g in geometry_ids]
        X_WG = self.X_WG()
        return [self.shapes[i] for i in rows], [X_WG[i] for i in rows]


def make_random_scene(rng, kinds, role=Role.kPerception):
    """Half of the shapes are anchored, half on two moving frames."""
    scene = Scene(role)
    frames = [scene.add_frame(make_random_pose(rng)) for _ in range(2)]
    for i, kind in enumerate(kinds):
        if kind == "half_space":
            X_FG = make_random_pose(rng, 0.1)
            X_FG.set_translation(
                X_FG.translation() - 1.5 * X_FG.rotation().matrix()[:, 2]
            )
            scene.add(make_random_shape(rng, kind), X_FG)
            continue
        scene.add(
            make_random_shape(rng, kind),
            make_random_pose(rng),
            frames[i // 2 % 2] if i % 2 else None,
        )
    return scene
