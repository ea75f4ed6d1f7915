"""Exact ray casting against the geometry of a Drake SceneGraph.

Drake's QueryObject answers distance queries, but has no ray cast
(RobotLocomotion/drake#15260). `RayCaster` adds one for anything that measures
along lines: range finders, lidars, visibility.
"""

from collections.abc import Collection, Sequence
import copy
import dataclasses as dc

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    FrameId,
    GeometryId,
    HalfSpace,
    QueryObject,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform

from tofssm_drake.errors import UserError
from tofssm_drake.geometry import ray_kernels

_UNIT_TOLERANCE = 1e-6


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RayBundles:
    """Rays that start in m points and are fixed in moving frames.

    Made by `RayCaster.make_bundles`, and good for that caster only.
    """

    num_bundles: int
    """m."""
    fan_S: np.ndarray
    """Unit directions of each bundle's rays in its frame S, shape (k, 3)."""
    X_FS: np.ndarray
    """Poses of the bundles in their frames, shape (m, 3, 4)."""
    frame_index: np.ndarray
    """Each bundle's frame as index into `RayCaster.frame_ids`, shape (m,)."""
    max_range: np.ndarray
    """Length of each bundle's rays, m, shape (m,)."""
    active: np.ndarray
    """Whether a bundle is cast against a geometry, shape (m, geometries)."""
    _packed: np.ndarray = dc.field(repr=False)
    _fan: np.ndarray = dc.field(repr=False)


class RayCaster:
    """Casts rays against the geometries of one role, exactly.

    The shapes are read once, at construction. A query then takes their poses,
    either through a QueryObject or as an array (`frame_ids` tells the order),
    and any number of rays.

    Conventions:
      - A distance is the smallest t >= 0 at which the ray is in a shape. A
        shape contains its surface, so a ray that starts inside of or on a
        shape has distance 0.
      - inf (and index -1) means: nothing within the range. A hit at exactly
        the range counts.
      - Of several shapes at the same distance the first in `geometry_ids` is
        reported.

    Supported are Sphere, Ellipsoid, Capsule, Cylinder, Box and HalfSpace.
    """

    def __init__(
        self,
        inspector: SceneGraphInspector,
        *,
        role: Role = Role.kPerception,
        geometry_ids: Collection[GeometryId] | None = None,
    ):
        """Reads the shapes.

        Args:
            inspector: Of the SceneGraph or of a QueryObject; not kept.
            role: Which geometries are seen: those with this role.
            geometry_ids: If given, only these of them are seen.

        Raises:
            UserError: If a geometry's shape can not be cast; names it.
            ValueError: If a geometry of `geometry_ids` has not the role.
        """
        self._role = role
        with_role = inspector.GetAllGeometryIds(role)
        self._is_subset = geometry_ids is not None
        if geometry_ids is None:
            self._geometry_ids = with_role
        else:
            wanted = set(geometry_ids)
            self._geometry_ids = [g for g in with_role if g in wanted]
            for stranger in wanted.difference(with_role):
                raise ValueError(
                    f"geometry_ids: '{inspector.GetName(stranger)}' has not"
                    f" the role {_name(role)}"
                )
        self._geometry_row = {g: i for i, g in enumerate(self._geometry_ids)}
        self._world_frame_id = inspector.world_frame_id()
        self._frame_ids: list[FrameId] = []
        self._frame_row: dict[FrameId, int] = {}
        self._posed_frame_ids: list[FrameId] = []
        self._world_row = -1

        n = len(self._geometry_ids)
        self._shape_int = np.zeros((n, ray_kernels.SHAPE_INTS), dtype=np.int64)
        self._shape_float = np.zeros((n, ray_kernels.SHAPE_FLOATS))
        for i, geometry_id in enumerate(self._geometry_ids):
            kind, floats = _read_geometry(inspector, geometry_id)
            frame = self._find_frame(inspector.GetFrameId(geometry_id))
            self._shape_int[i] = (kind, frame)
            self._shape_float[i] = floats
        self._remember_version(inspector)

    @property
    def role(self) -> Role:
        """The role of the geometries that are seen."""
        return self._role

    @property
    def geometry_ids(self) -> list[GeometryId]:
        """The geometries that are seen; indices in results point here."""
        return self._geometry_ids

    @property
    def frame_ids(self) -> list[FrameId]:
        """The frames whose poses a query needs, in this order.

        Those of the geometries, the world frame included where it is used,
        then those that `make_bundles` has added.
        """
        return self._frame_ids

    def poses_from_query_object(self, query_object: QueryObject) -> np.ndarray:
        """Returns the frames' poses X_WF, shape (num_frames, 3, 4).

        Args:
            query_object: Of the same SceneGraph, freshly evaluated.

        Raises:
            RuntimeError: If geometries of the role were added, removed or
                changed since this caster was made: it would see the old ones.
                Drake counts no version of perception geometry while the
                SceneGraph has no renderer; then only a change of their number
                is noticed here, the rest by `check_geometry`.
        """
        inspector = query_object.inspector()
        if not (
            inspector.geometry_version().IsSameAs(self._version, self._role)
            and inspector.NumGeometriesWithRole(self._role)
            == self._num_with_role
        ):
            # A new Context counts as a new version: look closer.
            self.check_geometry(inspector)
            self._remember_version(inspector)
        if not self._frame_ids:
            return np.empty((0, 3, 4))
        # Mapped bound methods: half the cost of a comprehension.
        poses = list(
            map(
                RigidTransform.GetAsMatrix34,
                map(query_object.GetPoseInWorld, self._posed_frame_ids),
            )
        )
        if self._world_row >= 0:
            poses.insert(self._world_row, _IDENTITY)
        return np.concatenate(poses).reshape(-1, 3, 4)

    def check_geometry(self, inspector: SceneGraphInspector) -> None:
        """Compares the geometry with what was read at construction.

        Args:
            inspector: Of the same SceneGraph or of one of its QueryObjects.

        Raises:
            RuntimeError: If it is not the same; names the first difference.
        """
        advice = "make a new RayCaster after the last change of geometry"
        now = set(inspector.GetAllGeometryIds(self._role))
        for i, geometry_id in enumerate(self._geometry_ids):
            if geometry_id not in now:
                raise RuntimeError(
                    f"a geometry with the role {_name(self._role)} was"
                    f" removed; {advice}"
                )
            now.remove(geometry_id)
            kind, floats = _read_geometry(inspector, geometry_id)
            if kind != self._shape_int[i, ray_kernels.KIND] or not (
                np.array_equal(floats, self._shape_float[i])
            ):
                raise RuntimeError(
                    f"geometry '{inspector.GetName(geometry_id)}' was changed"
                    f"; {advice}"
                )
        if now and not self._is_subset:
            raise RuntimeError(
                f"geometry '{inspector.GetName(now.pop())}' with the role"
                f" {_name(self._role)} was added; {advice}"
            )

    def make_bundles(
        self,
        *,
        frame_id: FrameId | Sequence[FrameId],
        X_FS: Sequence[RigidTransform] | np.ndarray,
        fan_S: np.ndarray,
        max_range: float | np.ndarray,
        excluded: Sequence[Collection[GeometryId]] | None = None,
    ) -> RayBundles:
        """Prepares m bundles of rays that are cast again and again.

        A frame that carries no seen geometry is added to `frame_ids`, so
        make all bundles before the first query.

        Args:
            frame_id: The frame F in which the bundles are fixed: one for all
                of them, or one for each.
            X_FS: Poses of the bundles in F: m RigidTransforms, or an array of
                shape (m, 3, 4). Rays start in the origin of S.
            fan_S: Directions of the rays of each bundle, in S, unit vectors,
                shape (k, 3).
            max_range: Length of the rays, m: for all, or for each bundle.
            excluded: For each bundle, the geometries that it does not see,
                such as the housing that it is in; others than those of the
                caster are ignored. None: each sees everything.

        Raises:
            ValueError: If shapes of arrays do not fit, if a direction is not
                a unit vector, or if a number is NaN.
        """
        X_FS = np.array(
            [
                X.GetAsMatrix34() if isinstance(X, RigidTransform) else X
                for X in X_FS
            ],
            dtype=float,
        )
        m = len(X_FS)
        if X_FS.shape != (m, 3, 4) or not np.isfinite(X_FS).all():
            raise ValueError("X_FS: not m finite poses of shape (3, 4)")
        fan_S = _make_unit_vectors("fan_S", fan_S)
        if len(fan_S) == 0:
            raise ValueError("fan_S: has no ray")
        max_range = np.array(
            np.broadcast_to(np.asarray(max_range, dtype=float), m)
        )
        if not (max_range >= 0.0).all():
            raise ValueError(f"max_range: {max_range} is not >= 0")
        frame_ids = (
            [frame_id] * m if isinstance(frame_id, FrameId) else list(frame_id)
        )
        if len(frame_ids) != m:
            raise ValueError(
                f"frame_id: {len(frame_ids)} frames for {m} bundles"
            )
        active = np.ones((m, len(self._geometry_ids)), dtype=bool)
        if excluded is not None:
            if len(excluded) != m:
                raise ValueError(
                    f"excluded: {len(excluded)} collections for {m} bundles"
                )
            for row, unseen in zip(active, excluded, strict=True):
                for geometry_id in unseen:
                    index = self._geometry_row.get(geometry_id)
                    if index is not None:
                        row[index] = False
        frame_index = np.array(
            [self._find_frame(f) for f in frame_ids], dtype=np.int64
        )
        bundles = RayBundles(
            num_bundles=m,
            fan_S=fan_S,
            X_FS=X_FS,
            frame_index=frame_index,
            max_range=max_range,
            active=active,
            _packed=np.hstack([X_FS.reshape(m, 12), max_range[:, None]]),
            _fan=np.vstack([fan_S, _calc_cone(fan_S)]),
        )
        for field in dc.fields(bundles):
            value = getattr(bundles, field.name)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
        return bundles

    def cast_bundles(
        self, bundles: RayBundles, X_WF: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts all rays of the bundles.

        Shapes that are clear of the cone around a bundle's rays are left out
        as a whole, so a query costs what the bundles can see.

        Args:
            bundles: Made by this caster.
            X_WF: Poses of the frames, shape (num_frames, 3, 4); see
                `poses_from_query_object`.

        Returns:
            (distance, geometry_index): both of shape (m, k); inf and -1 where
            nothing is within range, else the index into `geometry_ids`.

        Raises:
            ValueError: If the bundles or poses do not fit, or a pose is not
                finite.
        """
        self._check_poses(X_WF)
        if bundles.active.shape[1] != len(self._geometry_ids):
            raise ValueError("bundles: made by another RayCaster")
        status, distance, index = ray_kernels.cast_bundles(
            X_WF,
            self._shape_int,
            self._shape_float,
            bundles.frame_index,
            bundles._packed,
            bundles.active,
            bundles._fan,
        )
        if status != ray_kernels.OK:
            raise ValueError("X_WF: a pose is not finite")
        return distance, index

    def cast(
        self,
        poses: QueryObject | np.ndarray,
        p_WR: np.ndarray,
        n_WR: np.ndarray,
        max_range: float = np.inf,
        *,
        excluded: Collection[GeometryId] = (),
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts rays that are given in the world.

        Args:
            poses: A QueryObject, or the frames' poses X_WF of shape
                (num_frames, 3, 4).
            p_WR: Origins of the n rays, shape (n, 3), m.
            n_WR: Their directions, unit vectors, shape (n, 3).
            max_range: Length of the rays, m.
            excluded: Geometries that none of them sees.

        Returns:
            (distance, geometry_index): as `cast_bundles`, shape (n,).

        Raises:
            ValueError: If shapes of arrays do not fit, if a direction is not
                a unit vector, or if a number is not finite.
            RuntimeError: See `poses_from_query_object`.
        """
        if isinstance(poses, np.ndarray):
            X_WF = poses
            self._check_poses(X_WF)
        else:
            X_WF = self.poses_from_query_object(poses)
        p_WR = np.ascontiguousarray(p_WR, dtype=float)
        n_WR = np.ascontiguousarray(n_WR, dtype=float)
        if p_WR.ndim != 2 or p_WR.shape[1] != 3 or p_WR.shape != n_WR.shape:
            raise ValueError(
                f"p_WR {p_WR.shape} and n_WR {n_WR.shape}: not both (n, 3)"
            )
        if not max_range >= 0.0:
            raise ValueError(f"max_range: {max_range} is not >= 0")
        active = np.ones(len(self._geometry_ids), dtype=bool)
        for geometry_id in excluded:
            index = self._geometry_row.get(geometry_id)
            if index is not None:
                active[index] = False
        status, distance, index = ray_kernels.cast_rays(
            X_WF,
            self._shape_int,
            self._shape_float,
            active,
            p_WR,
            n_WR,
            float(max_range),
        )
        if status == ray_kernels.BAD_POSE:
            raise ValueError("X_WF: a pose is not finite")
        if status == ray_kernels.BAD_RAY:
            raise ValueError(
                "p_WR, n_WR: an origin is not finite, or a direction is not a"
                " unit vector"
            )
        return distance, index

    def _remember_version(self, inspector: SceneGraphInspector) -> None:
        self._version = copy.copy(inspector.geometry_version())
        self._num_with_role = inspector.NumGeometriesWithRole(self._role)

    def _find_frame(self, frame_id: FrameId) -> int:
        """Returns the row of a frame in X_WF, a new one if need be."""
        row = self._frame_row.get(frame_id)
        if row is None:
            row = len(self._frame_ids)
            self._frame_ids.append(frame_id)
            self._frame_row[frame_id] = row
            if frame_id == self._world_frame_id:
                self._world_row = row
            else:
                self._posed_frame_ids.append(frame_id)
        return row

    def _check_poses(self, X_WF: np.ndarray) -> None:
        if X_WF.shape != (len(self._frame_ids), 3, 4):
            raise ValueError(
                f"X_WF: shape {X_WF.shape} is not"
                f" ({len(self._frame_ids)}, 3, 4)"
            )


_IDENTITY = np.eye(3, 4)


def _name(role: Role) -> str:
    return role.name.removeprefix("k").lower()


def _make_unit_vectors(where: str, vectors: np.ndarray) -> np.ndarray:
    """Returns a copy with unit vectors exact to the last digits."""
    vectors = np.array(vectors, dtype=float)
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise ValueError(f"{where}: shape {vectors.shape} is not (k, 3)")
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (np.abs(length - 1.0) <= _UNIT_TOLERANCE).all():
        raise ValueError(f"{where}: not unit vectors")
    return vectors / length


def _calc_cone(fan_S: np.ndarray) -> np.ndarray:
    """Returns axis and (cos, sin, 0) of a cone around directions, (2, 3)."""
    axis = fan_S.mean(axis=0)
    length = np.linalg.norm(axis)
    if length < 1e-3:
        # Spread all around: no cone narrower than everything.
        return np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    axis = axis / length
    # The sine from the cross product: near 0 the cosine has no digits left.
    sin = np.linalg.norm(np.cross(fan_S, axis), axis=1)
    angle = np.arctan2(sin, fan_S @ axis).max()
    return np.array([axis, [np.cos(angle), np.sin(angle), 0.0]])


def _read_geometry(
    inspector: SceneGraphInspector, geometry_id: GeometryId
) -> tuple[int, np.ndarray]:
    """Returns a geometry's kind and its row of shape_float."""
    name = inspector.GetName(geometry_id)
    if inspector.IsDeformableGeometry(geometry_id):
        raise UserError(
            f"geometry '{name}': a deformable geometry can not be seen by"
            " rays; leave it out"
        )
    kind, size, p_GC, radius = _describe_shape(
        inspector.GetShape(geometry_id), name
    )
    X_FG = inspector.GetPoseInFrame(geometry_id)
    return kind, np.concatenate(
        [X_FG.GetAsMatrix34().ravel(), size, X_FG @ p_GC, [radius]]
    )


def _describe_shape(shape, name: str):
    """Returns (kind, sizes, centre p_GC and radius of a bounding sphere)."""
    origin = np.zeros(3)
    if isinstance(shape, Sphere):
        radius = shape.radius()
        return ray_kernels.SPHERE, [radius, 0.0, 0.0], origin, radius
    if isinstance(shape, Capsule):
        radius, half = shape.radius(), 0.5 * shape.length()
        return ray_kernels.CAPSULE, [radius, half, 0.0], origin, radius + half
    if isinstance(shape, Cylinder):
        radius, half = shape.radius(), 0.5 * shape.length()
        return (
            ray_kernels.CYLINDER,
            [radius, half, 0.0],
            origin,
            np.hypot(radius, half),
        )
    if isinstance(shape, Box):
        half = 0.5 * np.asarray(shape.size())
        return ray_kernels.BOX, half, origin, np.linalg.norm(half)
    if isinstance(shape, HalfSpace):
        return ray_kernels.HALF_SPACE, [0.0, 0.0, 0.0], origin, np.inf
    if isinstance(shape, Ellipsoid):
        axes = [shape.a(), shape.b(), shape.c()]
        return ray_kernels.ELLIPSOID, axes, origin, max(axes)
    raise UserError(
        f"geometry '{name}': a {type(shape).__name__} can not be seen by rays"
    )
