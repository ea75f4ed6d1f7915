"""Exact ray casting against the geometry of a Drake SceneGraph.

Drake's QueryObject answers distance queries, but has no ray cast
(RobotLocomotion/drake#15260). `RayCaster` adds one for anything that measures
along lines: range finders, lidars, visibility.
"""

from collections.abc import Collection, Iterable, Sequence
import copy
from typing import NamedTuple

import numpy as np
from pydrake.geometry import (
    FrameId,
    GeometryId,
    GeometrySet,
    QueryObject,
    Role,
    SceneGraphInspector,
)
from pydrake.math import RigidTransform

from tofssm_drake.raycast.ray_arguments import (
    UNIT_TOLERANCE,
    as_packed,
    check_geometry_ids,
    copy_numbers,
    make_ranges,
    make_unit_vectors,
    show,
)
from tofssm_drake.raycast.ray_bundles import RayBundles, pack_bundles
import tofssm_drake.raycast.ray_kernels as ray_kernels
from tofssm_drake.raycast.scene_shapes import describe_geometry, read_shapes

_IDENTITY = np.eye(3, 4)
_BAD_POSE = (
    "X_WF: a pose is not finite, is not rigid, or is not nearer than"
    f" {ray_kernels.FAR:g} m"
)
_BAD_RAY = (
    "p_WR, n_WR: an origin is not finite or not nearer than"
    f" {ray_kernels.FAR:g} m, or a direction is not a unit vector"
)


class _Rays(NamedTuple):
    """n rays in the world."""

    row: np.ndarray
    """Each ray's group, by which geometries are excluded, shape (n,)."""
    p_WR: np.ndarray
    """Origins, shape (n, 3), m."""
    n_WR: np.ndarray
    """Directions, exactly unit vectors, shape (n, 3)."""
    min_range: np.ndarray
    """From where on each ray sees, shape (n,), m."""
    max_range: np.ndarray
    """Where it ends, shape (n,), m."""


class RayCaster:
    """Casts rays against the geometries of one role, exactly.

    The shapes are read once, at construction. A query then takes their poses,
    either through a QueryObject or as an array in the order of `frame_ids`, and
    any number of rays.

    Conventions:
      - A distance is the smallest t >= 0 at which the ray is in a shape. A
        shape contains its surface, so a ray that starts inside of or on a
        shape has distance 0.
      - inf (and index -1) means: nothing within the range. A hit at exactly
        the range counts.
      - Of several shapes at the same distance the first in `geometry_ids` is
        reported.

    Supported are Sphere, Ellipsoid, Capsule, Cylinder, Box, HalfSpace, Convex
    and Mesh (.obj, .gltf, .stl, .dae and tetrahedral .vtk, from files or
    memory). A Convex is the convex hull of its vertices. A Mesh is its
    triangles, whereas most of Drake's distance queries see its hull. Its
    closed parts have an inside (see `mesh_parts.orient_faces`); of the rest
    rays see only the surface, from both sides. Whether a ray starts on a
    triangle is decided to 1e-14 of the largest coordinate, of the mesh in its
    own frame or of the origin in the world. A ray that does not start on a
    triangle, and runs exactly in its plane, does not see it.
    """

    def __init__(
        self,
        inspector: SceneGraphInspector,
        *,
        role: Role = Role.kPerception,
        geometry_ids: Collection[GeometryId] | None = None,
        surface_only: bool = False,
        skip_unsupported: bool = False,
    ):
        """Reads the shapes.

        Args:
            inspector: Of the SceneGraph or of a QueryObject; not kept.
            role: Which geometries are seen: those with this role.
            geometry_ids: If given, only these of them are seen.
            surface_only: Whether shapes are hollow. No ray then starts inside
                anything: it sees a shape's surface from within.
            skip_unsupported: Whether geometries that cannot be cast are left
                out, see `skipped`, where they would be an error.

        Raises:
            UserError: If a geometry's shape cannot be cast, or has a size or
                place of 1e100 m or more; names it.
            ValueError: If the role is kUnassigned, or a geometry of
                `geometry_ids` does not have the role, is unknown or not a
                GeometryId.
        """
        if role == Role.kUnassigned:
            raise ValueError(
                "role: kUnassigned is not a role; use kProximity, kPerception"
                " or kIllustration"
            )
        self._role = role
        self._is_subset = geometry_ids is not None
        self._surface_only = surface_only
        self._world_frame_id = inspector.world_frame_id()
        self._known_frame_ids = set(inspector.GetAllFrameIds())
        self._frame_ids: list[FrameId] = []
        self._frame_row: dict[FrameId, int] = {}
        shapes = read_shapes(
            inspector,
            _select_geometries(inspector, role, geometry_ids),
            find_frame=self._find_frame,
            skip_unsupported=skip_unsupported,
        )
        self._geometry_ids = shapes.geometry_ids
        self._geometry_set = GeometrySet(self._geometry_ids)
        self._geometry_row = {g: i for i, g in enumerate(self._geometry_ids)}
        self._descriptions = shapes.descriptions
        self._scene = shapes.tables
        self._has_inside = shapes.has_inside & (not surface_only)
        self._skipped = shapes.skipped
        self._split_frames()
        self._remember_version(inspector)

    @property
    def role(self) -> Role:
        """The role of the geometries that are seen."""
        return self._role

    @property
    def geometry_ids(self) -> list[GeometryId]:
        """The geometries that are seen; indices in results point here.

        A new list each time.
        """
        return list(self._geometry_ids)

    @property
    def frame_ids(self) -> list[FrameId]:
        """The frames whose poses a query needs, in this order.

        Those of the geometries, the world frame included where it is used,
        then those that `make_bundles` has added. A new list each time. See
        also `FramePoses`.
        """
        return list(self._frame_ids)

    @property
    def has_inside(self) -> np.ndarray:
        """Whether rays can start inside of a geometry, bool, (geometries,).

        In the order of `geometry_ids`. False for a mesh that is not closed,
        and for all if only surfaces are seen.
        """
        return self._has_inside.copy()

    @property
    def skipped(self) -> dict[GeometryId, str]:
        """The geometries that `skip_unsupported` has left out, and why."""
        return dict(self._skipped)

    @property
    def world_frame_id(self) -> FrameId:
        """The world frame, whose pose is always the identity."""
        return self._world_frame_id

    def poses_from_query_object(self, query_object: QueryObject) -> np.ndarray:
        """Returns the frames' poses X_WF, shape (num_frames, 3, 4).

        Args:
            query_object: Of the same SceneGraph, freshly evaluated.

        Raises:
            RuntimeError: If the QueryObject was not evaluated from an output
                port, or if geometries of the role were added, removed or
                changed since this caster was made: it would see the old ones.
                Only `check_geometry` notices `ChangeShape` of a geometry that
                has the perception role alone while the SceneGraph has no
                renderer: Drake then keeps its version.
            TypeError: If it is a QueryObject of a scalar other than float.
        """
        if not isinstance(query_object, QueryObject):
            raise TypeError(
                f"query_object: {type(query_object).__name__} is not a"
                " QueryObject of floats"
            )
        # Raises if it was not evaluated from an output port; its inspector
        # would then end the process.
        query_object.GetPoseInWorld(self._world_frame_id)
        inspector = query_object.inspector()
        if not self._is_unchanged(inspector):
            # Perhaps other geometries were changed: look closer.
            self.check_geometry(inspector)
            self._remember_version(inspector)
        if not self._frame_ids:
            return np.empty((0, 3, 4))
        poses = map(query_object.GetPoseInWorld, self._moving_ids)
        matrices = list(map(RigidTransform.GetAsMatrix34, poses))
        if self._world_row is not None:
            matrices.insert(self._world_row, _IDENTITY)
        return np.concatenate(matrices).reshape(-1, 3, 4)

    def check_geometry(self, inspector: SceneGraphInspector) -> None:
        """Compares the geometry with what was read at construction.

        Args:
            inspector: Of the same SceneGraph or of one of its QueryObjects.

        Raises:
            RuntimeError: If it is not the same; names the first difference.
        """
        advice = "make a new RayCaster after the last change of geometry"
        now = set(inspector.GetAllGeometryIds(self._role))
        now.difference_update(self._skipped)
        for i, geometry_id in enumerate(self._geometry_ids):
            if geometry_id not in now:
                raise RuntimeError(
                    f"a geometry with the role {_name(self._role)} was"
                    f" removed; {advice}"
                )
            now.remove(geometry_id)
            _, description = describe_geometry(inspector, geometry_id)
            if description != self._descriptions[i]:
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
        min_range: float | np.ndarray = 0.0,
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
            min_range: From where on rays see, m: for all, or for each bundle;
                see `cast`.
            excluded: For each bundle, the geometries that it does not see,
                such as the housing that it is in; geometries unknown to the
                caster are ignored. None: each sees everything.

        Raises:
            ValueError: If shapes of arrays do not fit, if a direction is not
                a unit vector, if a number is NaN, if a range is negative, if
                the SceneGraph had no such frame when the caster was made, or
                if `excluded` holds anything but GeometryIds.
        """
        X_FS = copy_numbers(
            "X_FS",
            [
                X.GetAsMatrix34() if isinstance(X, RigidTransform) else X
                for X in X_FS
            ],
        )
        m = len(X_FS)
        if X_FS.shape != (m, 3, 4) or not ray_kernels.are_poses(X_FS):
            raise ValueError("X_FS: not m finite poses of shape (3, 4)")
        fan_S = make_unit_vectors("fan_S", fan_S)
        if len(fan_S) == 0:
            raise ValueError("fan_S: has no ray")
        bundles = pack_bundles(
            owner=self,
            fan_S=fan_S,
            X_FS=X_FS,
            max_range=make_ranges("max_range", max_range, m),
            min_range=make_ranges("min_range", min_range, m),
            active=self._find_active(excluded, m),
            frame_index=self._find_frames(frame_id, m),
        )
        self._split_frames()
        return bundles

    def cast_bundles(
        self,
        bundles: RayBundles,
        X_WF: np.ndarray,
        which: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts all rays of the bundles, or of some of them.

        Shapes that are clear of the cone around a bundle's rays are left out
        as a whole, so a query costs what the bundles can see.

        Args:
            bundles: Made by this caster.
            X_WF: Poses of the frames, shape (num_frames, 3, 4); see
                `poses_from_query_object`.
            which: Whether a bundle is cast, bool, shape (m,); None: all are.

        Returns:
            (distance, geometry_index): both of shape (m, k); inf and -1 where
            nothing is within range, or the bundle is not cast, else the index
            into `geometry_ids`.

        Raises:
            ValueError: If the bundles or poses do not fit, or a pose is not
                finite or not rigid.
        """
        X_WF = self._check_poses(X_WF)
        self._check_bundles(bundles)
        if which is None:
            which = bundles.everyone
        else:
            which = self._check_which(bundles, which)
        m, k = bundles.num_bundles, len(bundles.fan_S)
        # Allocated by compiled code they would cost microseconds.
        distance = np.empty((m, k))
        index = np.empty((m, k), dtype=np.int64)
        status = ray_kernels.cast_bundles(
            X_WF,
            self._scene,
            bundles.packed,
            bundles.active,
            which,
            bundles.sorted_fan,
            bundles.cones,
            distance,
            index,
        )
        if status != ray_kernels.OK:
            raise ValueError(_BAD_POSE)
        if self._surface_only or bundles.starts_later:
            p_WR, n_WR = self.calc_rays(bundles, X_WF)
            rays = _Rays(
                row=np.repeat(np.arange(m), k),
                p_WR=p_WR.reshape(-1, 3),
                n_WR=n_WR.reshape(-1, 3),
                min_range=np.repeat(bundles.min_range, k),
                max_range=np.repeat(bundles.max_range, k),
            )
            self._cast_again(
                X_WF,
                bundles.active,
                rays,
                distance.reshape(-1),
                index.reshape(-1),
            )
        return distance, index

    def cast(
        self,
        poses: QueryObject | np.ndarray,
        p_WR: np.ndarray,
        n_WR: np.ndarray,
        max_range: float | np.ndarray = np.inf,
        *,
        min_range: float | np.ndarray = 0.0,
        excluded: Collection[GeometryId] = (),
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts rays that are given in the world.

        Args:
            poses: A QueryObject, or the frames' poses X_WF of shape
                (num_frames, 3, 4).
            p_WR: Origins of the n rays, shape (n, 3), m.
            n_WR: Their directions, unit vectors, shape (n, 3).
            max_range: Length of the rays, m: for all, or shape (n,).
            min_range: From where on the rays see, m: for all, or shape (n,).
                The distance is then the smallest t >= min_range at which the
                ray is in a shape: what is nearer is not seen, and a ray that
                is inside a shape there has the distance min_range.
            excluded: Geometries that none of them sees; see also
                `get_geometry_ids`.

        Returns:
            (distance, geometry_index): as `cast_bundles`, shape (n,).

        Raises:
            ValueError: If shapes of arrays do not fit, if a direction is not
                a unit vector, if a pose is not rigid, if a number is not
                finite, if a range is negative, if an origin is 1e100 m or more
                away, or if `excluded` holds anything but GeometryIds.
            RuntimeError, TypeError: See `poses_from_query_object`.
        """
        if hasattr(poses, "GetPoseInWorld"):
            X_WF = self.poses_from_query_object(poses)
        else:
            X_WF = self._check_poses(poses)
        p_WR, n_WR = as_packed("p_WR", p_WR), as_packed("n_WR", n_WR)
        if p_WR.ndim != 2 or p_WR.shape[1] != 3 or p_WR.shape != n_WR.shape:
            raise ValueError(
                f"p_WR {p_WR.shape} and n_WR {n_WR.shape}: not both (n, 3)"
            )
        n = len(p_WR)
        max_range = make_ranges("max_range", max_range, n)
        min_range = make_ranges("min_range", min_range, n)
        active = np.ones((1, len(self._geometry_ids)), dtype=bool)
        active[0, self._find_rows("excluded", excluded)] = False
        row = np.zeros(n, dtype=np.int64)
        distance, index = self._cast_rays(
            X_WF, active, row, p_WR, n_WR, max_range, hollow=False
        )
        if self._surface_only or min_range.any():
            n_WR = n_WR / np.linalg.norm(n_WR, axis=1, keepdims=True)
            rays = _Rays(row, p_WR, n_WR, min_range, max_range)
            self._cast_again(X_WF, active, rays, distance, index)
        return distance, index

    def calc_rays(
        self, bundles: RayBundles, X_WF: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns where the rays of bundles are in the world.

        Args:
            bundles: Made by this caster.
            X_WF: Poses of the frames, shape (num_frames, 3, 4).

        Returns:
            (p_WR, n_WR): origins and unit directions, both (m, k, 3).

        Raises:
            ValueError: If the bundles or poses do not fit.
        """
        X_WF = self._check_values(self._check_poses(X_WF))
        self._check_bundles(bundles)
        R_WF = X_WF[bundles.frame_index, :, :3]
        R_WS = R_WF @ bundles.X_FS[:, :, :3]
        p_WS = X_WF[bundles.frame_index, :, 3] + np.einsum(
            "mij,mj->mi", R_WF, bundles.X_FS[:, :, 3]
        )
        n_WR = np.einsum("mij,kj->mki", R_WS, bundles.fan_S)
        return np.broadcast_to(p_WS[:, None], n_WR.shape), n_WR

    def calc_normals(
        self,
        X_WF: np.ndarray,
        p_WR: np.ndarray,
        n_WR: np.ndarray,
        distance: np.ndarray,
        geometry_index: np.ndarray,
        *,
        min_range: float | np.ndarray = 0.0,
    ) -> np.ndarray:
        """Returns the surface's normals where rays have hit.

        Args:
            X_WF: Poses of the frames, as the rays were cast with.
            p_WR: Origins of the rays, shape (..., 3).
            n_WR: Their unit directions, shape (..., 3); for bundles, see
                `calc_rays`.
            distance: What the cast has returned, shape (...).
            geometry_index: Likewise.
            min_range: As the rays were cast with; must broadcast to (...).

        Returns:
            Unit normals of the surface in the world, shape (..., 3), facing
            the rays; NaN where there is no hit or the ray starts
            inside.

        Raises:
            ValueError: If shapes of arrays do not fit, a pose is not rigid, a
                direction is not a unit vector, or an index is not one of this
                caster's.
        """
        X_WF = self._check_values(self._check_poses(X_WF))
        shape = np.shape(distance)
        if not (
            np.shape(geometry_index) == shape
            and np.shape(p_WR) == np.shape(n_WR) == (*shape, 3)
        ):
            raise ValueError(
                f"p_WR {np.shape(p_WR)}, n_WR {np.shape(n_WR)}, distance"
                f" {shape}, geometry_index {np.shape(geometry_index)}: do not"
                " belong together"
            )
        self._check_indices(geometry_index)
        p_WR = copy_numbers("p_WR", p_WR).reshape(-1, 3)
        n_WR = copy_numbers("n_WR", n_WR).reshape(-1, 3)
        length = np.linalg.norm(n_WR, axis=1)
        if not (
            (np.abs(p_WR) < ray_kernels.FAR).all()
            and (np.abs(length - 1.0) <= UNIT_TOLERANCE).all()
        ):
            raise ValueError(_BAD_RAY)
        distance = copy_numbers("distance", distance).reshape(-1)
        start = copy_numbers("min_range", min_range)
        if start.any():
            start = np.broadcast_to(start, shape).reshape(-1)
            p_WR += start[:, np.newaxis] * (n_WR / length[:, np.newaxis])
            distance -= start
        normals = ray_kernels.calc_normals(
            X_WF,
            self._scene,
            p_WR,
            n_WR,
            distance,
            np.array(geometry_index, dtype=np.int64).reshape(-1),
        )
        return normals.reshape(*shape, 3)

    def get_geometry_ids(self, geometry_index: np.ndarray) -> np.ndarray:
        """Returns the ids of the geometries that a cast has hit.

        Args:
            geometry_index: What the cast has returned, shape (...).

        Returns:
            GeometryIds, None where there is no hit; objects, shape (...).

        Raises:
            ValueError: If an index is not one of this caster's.
        """
        self._check_indices(geometry_index)
        # The index of no hit is -1, the last.
        return np.array([*self._geometry_ids, None], dtype=object)[
            geometry_index
        ]

    def _cast_rays(self, X_WF, active, row, p_WR, n_WR, max_range, *, hollow):
        """Casts rays one by one; see ray_kernels.cast_rays."""
        status, distance, index = ray_kernels.cast_rays(
            X_WF, self._scene, active, row, p_WR, n_WR, max_range, hollow
        )
        if status == ray_kernels.BAD_POSE:
            raise ValueError(_BAD_POSE)
        if status == ray_kernels.BAD_RAY:
            raise ValueError(_BAD_RAY)
        return distance, index

    def _cast_again(
        self,
        X_WF: np.ndarray,
        active: np.ndarray,
        rays: _Rays,
        distance: np.ndarray,
        index: np.ndarray,
    ) -> None:
        """Casts again those rays that saw something too near.

        Those are the rays that hit before their range begins and, if only
        surfaces are seen, those that start inside. Any other ray has met the
        first surface from outside.

        Args:
            X_WF: Poses of the frames, shape (num_frames, 3, 4).
            active: Whether a geometry is seen, bool, one row for each group.
            rays: The n rays.
            distance: As cast from the origins; changed, shape (n,).
            index: Likewise.
        """
        too_near = distance < rays.min_range
        if self._surface_only:
            too_near |= distance == 0.0
        again = np.flatnonzero(too_near)
        if len(again) == 0:
            return
        row, p_WR, n_WR, start, end = (array[again] for array in rays)
        t, index[again] = self._cast_rays(
            X_WF,
            active,
            row,
            p_WR + start[:, np.newaxis] * n_WR,
            n_WR,
            end - start,
            hollow=self._surface_only,
        )
        distance[again] = start + t

    def _check_values(self, X_WF: np.ndarray) -> np.ndarray:
        """Returns the poses; raises ValueError if one is not rigid."""
        if not ray_kernels.are_poses(X_WF):
            raise ValueError(_BAD_POSE)
        return X_WF

    def _check_indices(self, geometry_index: np.ndarray) -> None:
        indices = np.asarray(geometry_index)
        if indices.dtype.kind not in "iu":
            raise ValueError(
                f"geometry_index: {indices.dtype} are not whole numbers"
            )
        if not ((indices >= -1) & (indices < len(self._geometry_ids))).all():
            raise ValueError(
                "geometry_index: has an index that is neither -1 nor one of"
                f" {len(self._geometry_ids)} geometries"
            )

    def _is_unchanged(self, inspector: SceneGraphInspector) -> bool:
        """Returns whether nothing suggests a change; in 3 us."""
        version = inspector.geometry_version()
        if not (
            version.IsSameAs(self._version, self._role)
            and inspector.NumGeometriesWithRole(self._role)
            == self._num_with_role
        ):
            return False
        if self._role != Role.kPerception:
            return True
        # Without a renderer Drake keeps no version of this role, but it does
        # of the other roles that a geometry may have, and it raises an error
        # if one of a set is gone. None of them is without a role.
        try:
            return (
                version.IsSameAs(self._version, Role.kIllustration)
                and version.IsSameAs(self._version, Role.kProximity)
                and not inspector.GetGeometryIds(
                    self._geometry_set, Role.kUnassigned
                )
            )
        except RuntimeError:
            return False

    def _remember_version(self, inspector: SceneGraphInspector) -> None:
        self._version = copy.copy(inspector.geometry_version())
        self._num_with_role = inspector.NumGeometriesWithRole(self._role)

    def _split_frames(self) -> None:
        """Separates the world frame from those whose poses Drake provides."""
        world = self._world_frame_id
        self._moving_ids = [f for f in self._frame_ids if f != world]
        self._world_row = self._frame_row.get(world)

    def _find_frame(self, frame_id: FrameId) -> int:
        """Returns the row of a frame in X_WF, a new one if need be."""
        row = self._frame_row.get(frame_id)
        if row is None:
            row = len(self._frame_ids)
            self._frame_ids.append(frame_id)
            self._frame_row[frame_id] = row
        return row

    def _find_frames(self, frame_id, count: int) -> np.ndarray:
        """Returns the rows of one frame for each of `count` bundles."""
        frame_ids = (
            [frame_id] * count
            if isinstance(frame_id, FrameId)
            else list(frame_id)
        )
        if len(frame_ids) != count:
            raise ValueError(
                f"frame_id: {len(frame_ids)} frames for {count} bundles"
            )
        for stranger in set(frame_ids).difference(self._known_frame_ids):
            raise ValueError(
                f"frame_id: the SceneGraph had no {stranger} when the caster"
                " was made"
            )
        return np.array(list(map(self._find_frame, frame_ids)), dtype=np.int64)

    def _find_active(self, excluded, count: int) -> np.ndarray:
        """Returns whether each of `count` bundles sees a geometry."""
        active = np.ones((count, len(self._geometry_ids)), dtype=bool)
        if excluded is None:
            return active
        if not isinstance(excluded, Iterable):
            raise ValueError(
                f"excluded: {show(excluded)} is not a collection of"
                " GeometryIds for each bundle"
            )
        excluded = list(excluded)
        if len(excluded) != count:
            raise ValueError(
                f"excluded: {len(excluded)} collections for {count} bundles"
            )
        for i, unseen in enumerate(excluded):
            active[i, self._find_rows(f"excluded[{i}]", unseen)] = False
        return active

    def _find_rows(self, where: str, geometry_ids) -> list[int]:
        """Returns the rows of those geometries that this caster has."""
        rows = self._geometry_row
        return [
            rows[g]
            for g in check_geometry_ids(where, geometry_ids)
            if g in rows
        ]

    def _check_bundles(self, bundles: RayBundles) -> None:
        if bundles.owner is not self:
            raise ValueError("bundles: made by another RayCaster")

    def _check_which(self, bundles: RayBundles, which) -> np.ndarray:
        """Returns the flags as the kernels are compiled for."""
        which = np.asarray(which)
        if which.shape != (bundles.num_bundles,) or which.dtype != bool:
            raise ValueError(
                f"which: {which.dtype} of shape {which.shape} is not bool of"
                f" shape ({bundles.num_bundles},)"
            )
        if which.flags.c_contiguous and which.flags.writeable:
            return which
        return which.copy()

    def _check_poses(self, X_WF: np.ndarray) -> np.ndarray:
        """Returns the poses as the kernels are compiled for."""
        X_WF = as_packed("X_WF", X_WF)
        if X_WF.shape != (len(self._frame_ids), 3, 4):
            raise ValueError(
                f"X_WF: shape {X_WF.shape} is not"
                f" ({len(self._frame_ids)}, 3, 4)"
            )
        return X_WF


def _select_geometries(
    inspector: SceneGraphInspector,
    role: Role,
    geometry_ids: Collection[GeometryId] | None,
) -> list[GeometryId]:
    """Returns all geometries with a role, or the given ones of them."""
    with_role = inspector.GetAllGeometryIds(role)
    if geometry_ids is None:
        return with_role
    wanted = set(check_geometry_ids("geometry_ids", geometry_ids))
    for stranger in wanted.difference(with_role):
        raise ValueError(
            f"geometry_ids: {_name_geometry(inspector, stranger)} does not"
            f" have the role {_name(role)}"
        )
    return [g for g in with_role if g in wanted]


def _name_geometry(inspector: SceneGraphInspector, geometry_id) -> str:
    try:
        return f"'{inspector.GetName(geometry_id)}'"
    except RuntimeError:
        return f"{geometry_id}, which the SceneGraph does not know,"


def _name(role: Role) -> str:
    return role.name.removeprefix("k").lower()
