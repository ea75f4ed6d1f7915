"""Reads the shapes of a SceneGraph into the tables of the ray kernels."""

from collections.abc import Callable, Iterable
import dataclasses as dc

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    FrameId,
    GeometryId,
    HalfSpace,
    Mesh,
    SceneGraphInspector,
    Sphere,
)

from tofssm_drake.errors import UserError
from tofssm_drake.raycast.ball_tree import make_ball_tree
import tofssm_drake.raycast.ray_kernels as ray_kernels
import tofssm_drake.raycast.shape_kernels as shape_kernels
from tofssm_drake.raycast.triangle_mesh import (
    check_hull_source,
    describe_mesh_source,
    read_mesh,
)
from tofssm_drake.raycast.triangle_tree import TriangleTree


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SceneShapes:
    """The shapes of n geometries, as the ray kernels take them."""

    geometry_ids: list[GeometryId]
    """The geometries, in the order of the tables."""
    tables: tuple
    """See `ray_kernels`."""
    descriptions: list[str]
    """Each one's description when it was read, see `describe_geometry`."""
    has_inside: np.ndarray
    """Whether a ray can start inside of it, bool, shape (n,)."""
    skipped: dict[GeometryId, str]
    """What was left out, and why."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Entry:
    """One shape in its own frame G."""

    kind: int
    """See `shape_kernels` and `ray_kernels`."""
    low: np.ndarray
    """Lower corner of the smallest box around it, m; may be infinite."""
    high: np.ndarray
    """Its upper corner, m."""
    radius: float
    """Of a ball around it, with the centre of the box, m."""
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """According to the kind."""
    data: tuple[int, int] = (0, 0)
    """According to the kind."""
    has_inside: bool = True
    """Whether it is more than a surface."""


def read_shapes(
    inspector: SceneGraphInspector,
    geometry_ids: Iterable[GeometryId],
    *,
    find_frame: Callable[[FrameId], int],
    skip_unsupported: bool,
) -> SceneShapes:
    """Reads geometries.

    Args:
        inspector: Of their SceneGraph.
        geometry_ids: The geometries.
        find_frame: Returns the row of a frame in X_WF.
        skip_unsupported: Whether those that cannot be cast are left out.

    Raises:
        UserError: If one cannot be cast and is not to be left out; names it.
    """
    pool = _Pool()
    kept, skipped, descriptions, has_inside = [], {}, [], []
    shapes, p_FC, radii = [], [], []
    for geometry_id in geometry_ids:
        try:
            shape, description = describe_geometry(inspector, geometry_id)
            name = inspector.GetName(geometry_id)
            entry = pool.add(shape, name)
            X_FG = inspector.GetPoseInFrame(geometry_id)
            _check_extent(name, entry, X_FG.translation())
        except UserError as error:
            if not skip_unsupported:
                raise
            skipped[geometry_id] = str(error)
            continue
        kept.append(geometry_id)
        descriptions.append(description)
        has_inside.append(entry.has_inside)
        frame = find_frame(inspector.GetFrameId(geometry_id))
        shapes.append(_make_row(entry, X_FG, frame))
        is_bounded = np.isfinite(entry.radius)
        centre = 0.5 * (entry.low + entry.high) if is_bounded else np.zeros(3)
        p_FC.append(X_FG @ centre)
        radii.append(entry.radius)
    table = np.array(shapes).reshape(-1, ray_kernels.SHAPE_COLUMNS)
    balls = make_ball_tree(
        table[:, ray_kernels.FRAME].astype(int),
        np.reshape(p_FC, (-1, 3)),
        np.array(radii),
    )
    return SceneShapes(
        geometry_ids=kept,
        tables=(table, balls, pool.merge()),
        descriptions=descriptions,
        has_inside=np.array(has_inside, dtype=bool),
        skipped=skipped,
    )


def describe_geometry(inspector: SceneGraphInspector, geometry_id: GeometryId):
    """Returns a geometry's shape and a text that identifies shape and pose.

    Raises:
        UserError: If it is deformable.
    """
    if inspector.IsDeformableGeometry(geometry_id):
        raise UserError(
            f"geometry '{inspector.GetName(geometry_id)}': a deformable"
            " geometry cannot be seen by rays; leave it out"
        )
    shape = inspector.GetShape(geometry_id)
    pose = inspector.GetPoseInFrame(geometry_id).GetAsMatrix34()
    is_mesh = isinstance(shape, Convex | Mesh)
    source = describe_mesh_source(shape) if is_mesh else repr(shape)
    kind = type(shape).__name__
    return shape, f"{kind} {source} {pose.tobytes().hex()}"


def _check_extent(name: str, entry: _Entry, p_FG: np.ndarray) -> None:
    extent = np.abs([p_FG, entry.low, entry.high])
    if (
        entry.kind != shape_kernels.HALF_SPACE
        and not (extent < ray_kernels.FAR).all()
    ):
        raise UserError(
            f"geometry '{name}': its size or place is not below"
            f" {ray_kernels.FAR:g} m"
        )


def _make_row(entry: _Entry, X_FG, frame: int) -> np.ndarray:
    """Returns the row of the table, in the order that ray_kernels names."""
    return np.concatenate(
        [
            X_FG.GetAsMatrix34().ravel(),
            entry.size,
            entry.low,
            entry.high,
            [entry.kind, frame, *entry.data],
        ]
    )


class _Pool:
    """Collects the planes of polytopes and the triangles of meshes."""

    def __init__(self):
        self._planes = [np.empty((0, 4))]
        self._nodes = [np.empty((0, 8))]
        self._triangles = [np.empty((0, 9))]
        self._num_planes = self._num_nodes = self._num_triangles = 0
        self._known: dict[tuple, _Entry] = {}

    def merge(self) -> tuple[np.ndarray, ...]:
        """Returns (planes, nodes, triangles)."""
        return tuple(
            np.concatenate(parts)
            for parts in (self._planes, self._nodes, self._triangles)
        )

    def add(self, shape, name: str) -> _Entry:
        """Returns a shape's entry.

        Args:
            shape: Of the geometry.
            name: Of the geometry, for messages.

        Raises:
            UserError: If it cannot be cast.
        """
        if not isinstance(shape, Convex | Mesh):
            return _read_primitive(shape, name)
        # Geometries often share a file.
        key = type(shape), describe_mesh_source(shape)
        if key not in self._known:
            is_convex = isinstance(shape, Convex)
            add = self._add_convex if is_convex else self._add_mesh
            self._known[key] = add(shape, name)
        return self._known[key]

    def _add_mesh(self, shape: Mesh, name: str) -> _Entry:
        mesh = read_mesh(shape, name)
        root = solid = self._add_tree(mesh.surface)
        if mesh.solid is None:
            solid = -1
        elif mesh.solid is not mesh.surface:
            solid = self._add_tree(mesh.solid)
        corners = mesh.surface.triangles.reshape(-1, 3)
        low, high, radius = _calc_bounds(corners)
        # A ray that starts on the surface, but for rounding, is in the box.
        margin = 1e-9 * radius
        return _Entry(
            kind=ray_kernels.MESH,
            low=low - margin,
            high=high + margin,
            radius=_enlarge(radius),
            data=(root, solid),
            has_inside=mesh.solid is not None,
        )

    def _add_tree(self, tree: TriangleTree) -> int:
        """Returns the row of its root."""
        root = self._num_nodes
        nodes = tree.nodes.copy()
        is_leaf = nodes[:, 7] > 0
        nodes[is_leaf, 6] += self._num_triangles
        nodes[~is_leaf, 6] += root
        self._nodes.append(nodes)
        self._triangles.append(tree.triangles)
        self._num_nodes += len(nodes)
        self._num_triangles += len(tree.triangles)
        return root

    def _add_convex(self, shape: Convex, name: str) -> _Entry:
        check_hull_source(shape, name)
        try:
            hull = shape.GetConvexHull()
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise UserError(
                f"geometry '{name}': convex hull: {reason}"
            ) from error
        vertices = np.array(
            [hull.vertex(i) for i in range(hull.num_vertices())]
        )
        planes = np.empty((hull.num_faces(), 4))
        for i, plane in enumerate(planes):
            face = hull.element(i)
            corners = [face.vertex(j) for j in range(face.num_vertices())]
            plane[:3] = hull.face_normal(i)
            plane[3] = (vertices[corners] @ plane[:3]).max()
        data = self._num_planes, len(planes)
        self._planes.append(planes)
        self._num_planes += len(planes)
        low, high, radius = _calc_bounds(vertices)
        return _Entry(
            kind=ray_kernels.CONVEX,
            low=low,
            high=high,
            radius=_enlarge(radius),
            data=data,
        )


def _read_primitive(shape, name: str) -> _Entry:
    """Returns the entry of a shape with a closed form."""
    if isinstance(shape, HalfSpace):
        return _Entry(
            kind=shape_kernels.HALF_SPACE,
            low=np.full(3, -np.inf),
            high=np.array([np.inf, np.inf, 0.0]),
            radius=np.inf,
        )
    if isinstance(shape, Sphere):
        r = radius = shape.radius()
        kind, size, high = shape_kernels.SPHERE, (r, 0.0, 0.0), [r, r, r]
    elif isinstance(shape, Capsule):
        r, half = shape.radius(), 0.5 * shape.length()
        radius = r + half
        kind, size = shape_kernels.CAPSULE, (r, half, 0.0)
        high = [r, r, radius]
    elif isinstance(shape, Cylinder):
        r, half = shape.radius(), 0.5 * shape.length()
        radius = np.linalg.norm([r, half, 0.0])
        kind, size = shape_kernels.CYLINDER, (r, half, 0.0)
        high = [r, r, half]
    elif isinstance(shape, Box):
        high = [0.5 * size for size in shape.size()]
        radius = np.linalg.norm(high)
        kind, size = shape_kernels.BOX, tuple(high)
    elif isinstance(shape, Ellipsoid):
        high = [shape.a(), shape.b(), shape.c()]
        radius = max(high)
        kind, size = shape_kernels.ELLIPSOID, tuple(high)
    else:
        raise UserError(
            f"geometry '{name}': a {type(shape).__name__} cannot be seen by"
            " rays"
        )
    corner = np.array(high)
    return _Entry(
        kind=kind, low=-corner, high=corner, radius=_enlarge(radius), size=size
    )


def _enlarge(radius: float) -> float:
    """Rounding must not take a point of the shape out of its ball."""
    return radius * (1.0 + 1e-12)


def _calc_bounds(points: np.ndarray):
    """Returns the corners of a box and the radius of a ball around points."""
    low, high = points.min(axis=0), points.max(axis=0)
    radius = np.linalg.norm(points - 0.5 * (low + high), axis=1).max()
    return low, high, radius
