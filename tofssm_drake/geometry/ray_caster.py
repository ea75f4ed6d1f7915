"""Exact ray casting against the geometry of a Drake SceneGraph.

Drake's QueryObject answers distance queries, but has no ray cast
(RobotLocomotion/drake#15260). `RayCaster` adds one for anything that measures
along lines: range finders, lidars, visibility.
"""

from collections.abc import Collection, Iterable, Sequence
import copy
import dataclasses as dc
import reprlib

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    FrameId,
    GeometryId,
    GeometrySet,
    HalfSpace,
    Mesh,
    QueryObject,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform

from tofssm_drake.errors import UserError
from tofssm_drake.geometry import ray_kernels, shape_kernels
from tofssm_drake.geometry.ball_tree import make_ball_tree
from tofssm_drake.geometry.pose_reader import PoseReader
from tofssm_drake.geometry.triangle_mesh import (
    check_hull_source,
    describe_mesh_source,
    read_mesh,
)
from tofssm_drake.geometry.triangle_tree import TriangleTree

_UNIT_TOLERANCE = 1e-6
# Rays that are checked together against bounding spheres, at most.
_GROUP_SIZE = 32

_BAD_POSE = (
    "X_WF: a pose is not finite or no rotation, or is not nearer than"
    f" {ray_kernels.FAR:g} m"
)
_BAD_RAY = (
    "p_WR, n_WR: an origin is not finite or not nearer than"
    f" {ray_kernels.FAR:g} m, or a direction is not a unit vector"
)


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
    _caster: "RayCaster" = dc.field(repr=False)
    _packed: np.ndarray = dc.field(repr=False)
    _all: np.ndarray = dc.field(repr=False)
    _fan: np.ndarray = dc.field(repr=False)
    _cones: np.ndarray = dc.field(repr=False)


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

    Supported are Sphere, Ellipsoid, Capsule, Cylinder, Box, HalfSpace, Convex
    and Mesh (.obj, .gltf and tetrahedral .vtk, from files or memory). A Convex
    is the convex hull of its vertices. A Mesh is its triangles, whereas most
    of Drake's distance queries see its hull. Its closed parts have an inside
    (see `mesh_parts.orient_faces`); of all else rays see the surface alone,
    from both sides. Whether a ray starts on a triangle is decided to 1e-14 of
    the largest coordinate, of the mesh in its own frame or of the origin in
    the world. One that does not, and runs exactly within a triangle's plane,
    does not see this triangle.
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
            UserError: If a geometry's shape can not be cast, or has a size or
                place of 1e100 m or more; names it.
            ValueError: If the role is none, or a geometry of `geometry_ids`
                has not the role, is unknown or no GeometryId.
        """
        if role == Role.kUnassigned:
            raise ValueError(
                "role: kUnassigned is none; use kProximity, kPerception or"
                " kIllustration"
            )
        self._role = role
        with_role = inspector.GetAllGeometryIds(role)
        self._is_subset = geometry_ids is not None
        if geometry_ids is None:
            self._geometry_ids = with_role
        else:
            wanted = set(_check_geometry_ids("geometry_ids", geometry_ids))
            self._geometry_ids = [g for g in with_role if g in wanted]
            for stranger in wanted.difference(with_role):
                raise ValueError(
                    f"geometry_ids: {_name_geometry(inspector, stranger)} has"
                    f" not the role {_name(role)}"
                )
        self._geometry_set = GeometrySet(self._geometry_ids)
        self._geometry_row = {g: i for i, g in enumerate(self._geometry_ids)}
        self._world_frame_id = inspector.world_frame_id()
        self._known_frame_ids = set(inspector.GetAllFrameIds())
        self._frame_ids: list[FrameId] = []
        self._frame_row: dict[FrameId, int] = {}

        n = len(self._geometry_ids)
        shapes = np.zeros((n, ray_kernels.SHAPE_COLUMNS))
        p_FC, radii = np.zeros((n, 3)), np.zeros(n)
        self._descriptions = []
        pool = _Pool()
        for i, geometry_id in enumerate(self._geometry_ids):
            shape, description = _describe_geometry(inspector, geometry_id)
            name = inspector.GetName(geometry_id)
            kind, size, data, low, high, radius = pool.add(shape, name)
            X_FG = inspector.GetPoseInFrame(geometry_id)
            extent = np.abs([X_FG.translation(), low, high])
            if (
                kind != shape_kernels.HALF_SPACE
                and not (extent < ray_kernels.FAR).all()
            ):
                raise UserError(
                    f"geometry '{name}': its size or place is not below"
                    f" {ray_kernels.FAR:g} m"
                )
            frame = self._find_frame(inspector.GetFrameId(geometry_id))
            self._descriptions.append(description)
            # In the order of the columns that ray_kernels names.
            shapes[i] = np.concatenate(
                [
                    X_FG.GetAsMatrix34().ravel(),
                    size,
                    low,
                    high,
                    [kind, frame, *data],
                ]
            )
            if np.isfinite(radius):
                p_FC[i] = X_FG @ (0.5 * (low + high))
            radii[i] = radius
        frames = shapes[:, ray_kernels.FRAME].astype(int)
        balls = make_ball_tree(frames, p_FC, radii)
        self._scene = (shapes, balls, *pool.merge())
        self._read_frames()
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
    def world_frame_id(self) -> FrameId:
        """The world frame, whose pose is always the identity."""
        return self._world_frame_id

    def poses_from_query_object(self, query_object: QueryObject) -> np.ndarray:
        """Returns the frames' poses X_WF, shape (num_frames, 3, 4).

        Args:
            query_object: Of the same SceneGraph, freshly evaluated.

        Raises:
            RuntimeError: If the QueryObject is no port's, or if geometries of
                the role were added, removed or changed since this caster was
                made: it would see the old ones. One change is not noticed
                here, but by `check_geometry`: `ChangeShape` of a geometry
                that has the perception role only, while the SceneGraph has
                no renderer. Drake counts no version then.
            TypeError: If it is a QueryObject of another scalar than float.
        """
        if not isinstance(query_object, QueryObject):
            raise TypeError(
                f"query_object: {type(query_object).__name__} is not a"
                " QueryObject of floats"
            )
        try:
            poses = self._pose_reader.read(query_object)
        except RuntimeError:
            query_object.GetPoseInWorld(self._world_frame_id)
            # A frame is gone, perhaps with its geometry: say which.
            self.check_geometry(query_object.inspector())
            raise
        inspector = query_object.inspector()
        if not self._is_unchanged(inspector):
            # Perhaps a change beside these geometries: look closer.
            self.check_geometry(inspector)
            self._remember_version(inspector)
            self._read_frames()
            poses = self._pose_reader.read(query_object)
        return poses

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
            _, description = _describe_geometry(inspector, geometry_id)
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
                a unit vector, if a number is NaN, if the SceneGraph had no
                such frame when the caster was made, or if `excluded` holds
                anything but GeometryIds.
        """
        X_FS = _copy_numbers(
            "X_FS",
            [
                X.GetAsMatrix34() if isinstance(X, RigidTransform) else X
                for X in X_FS
            ],
        )
        m = len(X_FS)
        if X_FS.shape != (m, 3, 4) or not ray_kernels.are_poses(X_FS):
            raise ValueError("X_FS: not m finite poses of shape (3, 4)")
        fan_S = _make_unit_vectors("fan_S", fan_S)
        if len(fan_S) == 0:
            raise ValueError("fan_S: has no ray")
        max_range = np.array(
            np.broadcast_to(_copy_numbers("max_range", max_range), m)
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
        for stranger in set(frame_ids).difference(self._known_frame_ids):
            raise ValueError(
                f"frame_id: the SceneGraph had no {stranger} when the caster"
                " was made"
            )
        active = np.ones((m, len(self._geometry_ids)), dtype=bool)
        if excluded is not None:
            if not isinstance(excluded, Iterable):
                raise ValueError(
                    f"excluded: {_show(excluded)} is not a collection of"
                    " GeometryIds for each bundle"
                )
            excluded = list(excluded)
            if len(excluded) != m:
                raise ValueError(
                    f"excluded: {len(excluded)} collections for {m} bundles"
                )
            for i, unseen in enumerate(excluded):
                active[i, self._find_rows(f"excluded[{i}]", unseen)] = False
        frame_index = np.array(
            [self._find_frame(f) for f in frame_ids], dtype=np.int64
        )
        self._read_frames()
        order, cones = _group_directions(fan_S)
        bundles = RayBundles(
            num_bundles=m,
            fan_S=fan_S,
            X_FS=X_FS,
            frame_index=frame_index,
            max_range=max_range,
            active=active,
            _caster=self,
            _packed=np.column_stack(
                [X_FS.reshape(m, 12), max_range, frame_index]
            ),
            _all=np.ones(m, dtype=bool),
            _fan=np.ascontiguousarray(np.vstack([fan_S[order].T, order])),
            _cones=cones,
        )
        for field in dc.fields(bundles):
            value = getattr(bundles, field.name)
            # Writable as a caller's: one and the same compiled kernel.
            if isinstance(value, np.ndarray) and field.name != "_all":
                value.flags.writeable = False
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
            ValueError: If the bundles or poses do not fit, or a pose is none:
                not finite, or its rotation is no rotation.
        """
        X_WF = self._check_poses(X_WF)
        self._check_bundles(bundles)
        if which is None:
            which = bundles._all
        else:
            which = self._check_which(bundles, which)
        shape = bundles.num_bundles, bundles._fan.shape[1]
        # As results of compiled code they would cost microseconds.
        distance = np.empty(shape)
        index = np.empty(shape, dtype=np.int64)
        status = ray_kernels.cast_bundles(
            X_WF,
            self._scene,
            bundles._packed,
            bundles.active,
            which,
            bundles._fan,
            bundles._cones,
            distance,
            index,
        )
        if status != ray_kernels.OK:
            raise ValueError(_BAD_POSE)
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
            excluded: Geometries that none of them sees; see also
                `get_geometry_ids`.

        Returns:
            (distance, geometry_index): as `cast_bundles`, shape (n,).

        Raises:
            ValueError: If shapes of arrays do not fit, if a direction is not
                a unit vector, if a pose is none, if a number is not finite,
                if an origin is 1e100 m or more away, or if `excluded` holds
                anything but GeometryIds.
            RuntimeError, TypeError: See `poses_from_query_object`.
        """
        if hasattr(poses, "GetPoseInWorld"):
            X_WF = self.poses_from_query_object(poses)
        else:
            X_WF = self._check_poses(poses)
        p_WR, n_WR = _as_packed("p_WR", p_WR), _as_packed("n_WR", n_WR)
        if p_WR.ndim != 2 or p_WR.shape[1] != 3 or p_WR.shape != n_WR.shape:
            raise ValueError(
                f"p_WR {p_WR.shape} and n_WR {n_WR.shape}: not both (n, 3)"
            )
        if not max_range >= 0.0:
            raise ValueError(f"max_range: {max_range} is not >= 0")
        active = np.ones(len(self._geometry_ids), dtype=bool)
        active[self._find_rows("excluded", excluded)] = False
        status, distance, index = ray_kernels.cast_rays(
            X_WF,
            self._scene,
            active,
            p_WR,
            n_WR,
            float(max_range),
        )
        if status == ray_kernels.BAD_POSE:
            raise ValueError(_BAD_POSE)
        if status == ray_kernels.BAD_RAY:
            raise ValueError(_BAD_RAY)
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
    ) -> np.ndarray:
        """Returns the surface's normals where rays have hit.

        Args:
            X_WF: Poses of the frames, as the rays were cast with.
            p_WR: Origins of the rays, shape (..., 3).
            n_WR: Their unit directions, shape (..., 3); for bundles, see
                `calc_rays`.
            distance: What the cast has returned, shape (...).
            geometry_index: Likewise.

        Returns:
            Outward unit normals in the world, shape (..., 3), which face the
            rays; NaN where there is no hit or the ray starts inside.

        Raises:
            ValueError: If shapes of arrays do not fit, a pose is none, a
                direction is not a unit vector, or an index is none of this
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
        p_WR = _copy_numbers("p_WR", p_WR).reshape(-1, 3)
        n_WR = _copy_numbers("n_WR", n_WR).reshape(-1, 3)
        length = np.linalg.norm(n_WR, axis=1)
        if not (
            (np.abs(p_WR) < ray_kernels.FAR).all()
            and (np.abs(length - 1.0) <= _UNIT_TOLERANCE).all()
        ):
            raise ValueError(_BAD_RAY)
        normals = ray_kernels.calc_normals(
            X_WF,
            self._scene,
            p_WR,
            n_WR,
            _copy_numbers("distance", distance).reshape(-1),
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
            ValueError: If an index is none of this caster's.
        """
        self._check_indices(geometry_index)
        # The index of no hit is -1, the last.
        return np.array([*self._geometry_ids, None], dtype=object)[
            geometry_index
        ]

    def _check_values(self, X_WF: np.ndarray) -> np.ndarray:
        """Returns poses that are finite and turn nothing but rigidly."""
        if not ray_kernels.are_poses(X_WF):
            raise ValueError(_BAD_POSE)
        return X_WF

    def _check_indices(self, geometry_index: np.ndarray) -> None:
        indices = np.asarray(geometry_index)
        if indices.dtype.kind not in "iu":
            raise ValueError(
                f"geometry_index: {indices.dtype} is no whole number"
            )
        if not ((indices >= -1) & (indices < len(self._geometry_ids))).all():
            raise ValueError(
                "geometry_index: has an index that is neither -1 nor one of"
                f" {len(self._geometry_ids)} geometries"
            )

    def _is_unchanged(self, inspector: SceneGraphInspector) -> bool:
        """Returns whether there is no sign of a change; in 3 us."""
        version = inspector.geometry_version()
        if not (
            version.IsSameAs(self._version, self._role)
            and inspector.NumGeometriesWithRole(self._role)
            == self._num_with_role
        ):
            return False
        if self._role != Role.kPerception:
            return True
        # Without a renderer Drake counts no versions of this role. But it
        # counts those of others that the geometry may have, too, and it raises
        # an error if one of a set is gone. None of them is without a role.
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

    def _read_frames(self) -> None:
        """Lets the poses of all frames be read."""
        self._pose_reader = PoseReader(
            self._frame_ids, world_frame_id=self._world_frame_id
        )

    def _find_frame(self, frame_id: FrameId) -> int:
        """Returns the row of a frame in X_WF, a new one if need be."""
        row = self._frame_row.get(frame_id)
        if row is None:
            row = len(self._frame_ids)
            self._frame_ids.append(frame_id)
            self._frame_row[frame_id] = row
        return row

    def _find_rows(self, where: str, geometry_ids) -> list[int]:
        """Returns the rows of those geometries that this caster has."""
        rows = self._geometry_row
        return [
            rows[g]
            for g in _check_geometry_ids(where, geometry_ids)
            if g in rows
        ]

    def _check_bundles(self, bundles: RayBundles) -> None:
        if bundles._caster is not self:
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
        X_WF = _as_packed("X_WF", X_WF)
        if X_WF.shape != (len(self._frame_ids), 3, 4):
            raise ValueError(
                f"X_WF: shape {X_WF.shape} is not"
                f" ({len(self._frame_ids)}, 3, 4)"
            )
        return X_WF


def _as_packed(where: str, array) -> np.ndarray:
    """Returns an array, or a copy, as the kernels are compiled for."""
    if type(array) is np.ndarray:
        flags = array.flags
        if flags.c_contiguous and flags.writeable and array.dtype == float:
            return array
    return _copy_numbers(where, array)


def _copy_numbers(where: str, array) -> np.ndarray:
    """Returns a copy, real numbers, unless they are none."""
    if _has_masked_array(array):
        raise ValueError(f"{where}: a masked array, which hides numbers")
    array = np.asarray(array)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{where}: {array.dtype} are no real numbers")
    return np.array(array, dtype=float, order="C")


def _has_masked_array(array) -> bool:
    """Returns whether it is a masked array, or a list with one in it."""
    if isinstance(array, np.ma.MaskedArray):
        return True
    if not isinstance(array, Sequence) or isinstance(array, str | bytes):
        return False
    # Few kinds are in many rows: numbers are not looked at one by one.
    kinds = set(map(type, array))
    if kinds <= {float, int, np.ndarray}:
        return False
    return any(map(_has_masked_array, array))


def _check_geometry_ids(where: str, geometry_ids) -> list[GeometryId]:
    """Returns a list of them, unless anything else is among them."""
    if not isinstance(geometry_ids, Iterable):
        raise ValueError(
            f"{where}: {_show(geometry_ids)} is not a collection of GeometryIds"
        )
    geometry_ids = list(geometry_ids)
    for stranger in geometry_ids:
        if not isinstance(stranger, GeometryId):
            raise ValueError(
                f"{where}: has {_show(stranger)}, a {type(stranger).__name__},"
                " which is no GeometryId; get_geometry_ids tells those of the"
                " indices that a cast returns"
            )
    return geometry_ids


def _show(thing) -> str:
    """Returns what it is in short, in one line."""
    return " ".join(reprlib.repr(thing).split())


def _name_geometry(inspector: SceneGraphInspector, geometry_id) -> str:
    try:
        return f"'{inspector.GetName(geometry_id)}'"
    except RuntimeError:
        return f"{geometry_id}, which the SceneGraph does not know,"


def _name(role: Role) -> str:
    return role.name.removeprefix("k").lower()


def _make_unit_vectors(where: str, vectors: np.ndarray) -> np.ndarray:
    """Returns a copy with unit vectors exact to the last digits."""
    vectors = _copy_numbers(where, vectors)
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise ValueError(f"{where}: shape {vectors.shape} is not (k, 3)")
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (np.abs(length - 1.0) <= _UNIT_TOLERANCE).all():
        raise ValueError(f"{where}: not unit vectors")
    return vectors / length


def _group_directions(fan_S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorts directions into narrow groups.

    Returns:
        (order, cones): which direction comes where, shape (k,), and a cone
        around all, then one around each group: axis, cosine and sine of half
        the opening angle, where the group begins, and where the next one
        does; shape (1 + groups, 7).
    """
    order = np.arange(len(fan_S))
    cones = [[*_calc_cone(fan_S), 0, len(fan_S)]]
    pending = [(0, len(fan_S))]
    while pending:
        first, last = pending.pop()
        directions = fan_S[order[first:last]]
        if last - first <= _GROUP_SIZE:
            cones.append([*_calc_cone(directions), first, last])
            continue
        axis = np.argmax(np.ptp(directions, axis=0))
        places = np.argsort(directions[:, axis], kind="stable")
        order[first:last] = order[first:last][places]
        middle = (first + last) // 2
        pending += [(middle, last), (first, middle)]
    return order, np.array(cones, dtype=float)


def _calc_cone(directions: np.ndarray) -> list[float]:
    """Returns axis, cos and sin of half the angle of a cone around them."""
    axis = directions.mean(axis=0)
    length = np.linalg.norm(axis)
    if length < 1e-3:
        # Spread all around: no cone narrower than everything.
        return [1.0, 0.0, 0.0, -1.0, 0.0]
    axis = axis / length
    # The sine from the cross product: near 0 the cosine has no digits left.
    sin = np.linalg.norm(np.cross(directions, axis), axis=1)
    angle = np.arctan2(sin, directions @ axis).max()
    return [*axis, np.cos(angle), np.sin(angle)]


def _describe_geometry(inspector: SceneGraphInspector, geometry_id):
    """Returns a geometry's shape and a text that tells it from others."""
    if inspector.IsDeformableGeometry(geometry_id):
        raise UserError(
            f"geometry '{inspector.GetName(geometry_id)}': a deformable"
            " geometry can not be seen by rays; leave it out"
        )
    shape = inspector.GetShape(geometry_id)
    pose = inspector.GetPoseInFrame(geometry_id).GetAsMatrix34()
    is_mesh = isinstance(shape, Convex | Mesh)
    source = describe_mesh_source(shape) if is_mesh else repr(shape)
    kind = type(shape).__name__
    return shape, f"{kind} {source} {pose.tobytes().hex()}"


class _Pool:
    """Collects the planes of polytopes and the triangles of meshes."""

    def __init__(self):
        self._planes = [np.empty((0, 4))]
        self._nodes = [np.empty((0, 8))]
        self._triangles = [np.empty((0, 9))]
        self._num_planes = self._num_nodes = self._num_triangles = 0
        self._known = {}

    def merge(self) -> tuple[np.ndarray, ...]:
        """Returns (planes, nodes, triangles)."""
        return tuple(
            np.concatenate(parts)
            for parts in (self._planes, self._nodes, self._triangles)
        )

    def add(self, shape, name: str):
        """Returns (kind, sizes, data, corners of a box, radius of a ball).

        The box is the smallest one around the shape, and the ball has its
        centre.

        Args:
            shape: Of the geometry.
            name: Of the geometry, for messages.

        Raises:
            UserError: If it can not be cast.
        """
        size = np.zeros(3)
        data = (0, 0)
        if isinstance(shape, Sphere):
            kind = shape_kernels.SPHERE
            size[0] = radius = shape.radius()
            high = np.full(3, radius)
        elif isinstance(shape, Capsule):
            kind = shape_kernels.CAPSULE
            size[:2] = shape.radius(), 0.5 * shape.length()
            radius = size.sum()
            high = np.array([size[0], size[0], radius])
        elif isinstance(shape, Cylinder):
            kind = shape_kernels.CYLINDER
            size[:2] = shape.radius(), 0.5 * shape.length()
            radius = np.linalg.norm(size)
            high = size[[0, 0, 1]]
        elif isinstance(shape, Box):
            kind = shape_kernels.BOX
            size[:] = 0.5 * np.asarray(shape.size())
            radius = np.linalg.norm(size)
            high = size
        elif isinstance(shape, HalfSpace):
            kind, radius = shape_kernels.HALF_SPACE, np.inf
            high = np.array([np.inf, np.inf, 0.0])
        elif isinstance(shape, Ellipsoid):
            kind = shape_kernels.ELLIPSOID
            size[:] = shape.a(), shape.b(), shape.c()
            radius = size.max()
            high = size
        elif isinstance(shape, Convex | Mesh):
            # Geometries often share a file.
            key = type(shape), describe_mesh_source(shape)
            if key not in self._known:
                add = self._add_mesh
                if isinstance(shape, Convex):
                    add = self._add_convex
                self._known[key] = add(shape, name)
            kind, data, low, high, radius = self._known[key]
        else:
            raise UserError(
                f"geometry '{name}': a {type(shape).__name__} can not be seen"
                " by rays"
            )
        if kind == shape_kernels.HALF_SPACE:
            low = np.full(3, -np.inf)
        elif kind <= shape_kernels.ELLIPSOID:
            low = -high
        # Rounding must not take a point of the shape out of its ball.
        return kind, size, data, low, high, radius * (1.0 + 1e-12)

    def _add_mesh(self, shape: Mesh, name: str):
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
        data = root, solid
        return ray_kernels.MESH, data, low - margin, high + margin, radius

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

    def _add_convex(self, shape: Convex, name: str):
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
        return ray_kernels.CONVEX, data, *_calc_bounds(vertices)


def _calc_bounds(points: np.ndarray):
    """Returns the corners of a box and the radius of a ball around points."""
    low, high = points.min(axis=0), points.max(axis=0)
    radius = np.linalg.norm(points - 0.5 * (low + high), axis=1).max()
    return low, high, radius
