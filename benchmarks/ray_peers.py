"""The same scene in other ray casters, each used in its fastest way.

What they could prepare beforehand is prepared: poses in their own format,
which bodies have moved since the last state, and the rays in the world where
they have to be handed over.
"""

import numpy as np
from pydrake.geometry import Box, Capsule, HalfSpace, Mesh, Sphere
from pydrake.math import RotationMatrix
from ray_scene import Scene

from tofssm_drake.raycast.triangle_mesh import read_mesh


def list_shapes(scene: Scene):
    """Returns (shape, row of its frame, X_FG) of all geometries."""
    inspector = scene.scene_graph.model_inspector()
    row = {f: i for i, f in enumerate(scene.caster.frame_ids)}
    return [
        (
            inspector.GetShape(g),
            row[inspector.GetFrameId(g)],
            inspector.GetPoseInFrame(g),
        )
        for g in scene.caster.geometry_ids
    ]


def read_triangles(mesh: Mesh):
    """Returns (vertices, faces)."""
    corners = read_mesh(mesh, "mesh").surface.triangles.reshape(-1, 3)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)


def make_quaternion(X) -> np.ndarray:
    """Returns w, x, y, z of a pose (3, 4)."""
    return RotationMatrix(np.array(X)[:, :3]).ToQuaternion().wxyz()


class MujocoScene:
    """MuJoCo: a frame that moves is a mocap body, posed by mj_kinematics."""

    def __init__(self, scene: Scene):
        import mujoco

        self._mujoco = mujoco
        moves = np.ptp(scene.X_WF, axis=0).max(axis=(1, 2)) > 1e-12
        spec = mujoco.MjSpec()
        bodies = [
            spec.worldbody.add_body(
                name=f"frame_{f}",
                pos=X[:, 3],
                quat=make_quaternion(X),
                mocap=bool(moves[f]),
            )
            for f, X in enumerate(scene.X_WF[0])
        ]
        for i, (shape, f, X_FG) in enumerate(list_shapes(scene)):
            geom = bodies[f].add_geom(
                pos=X_FG.translation(),
                quat=X_FG.rotation().ToQuaternion().wxyz(),
            )
            self._set_shape(spec, geom, shape, f"mesh_{i}")
        self._add_sensors(spec, bodies, scene)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        rows = np.flatnonzero(moves)
        self._mocap = [
            (
                X_WF[rows, :, 3].copy(),
                np.array([make_quaternion(X) for X in X_WF[rows]]),
            )
            for X_WF in scene.X_WF
        ]
        self._max_range = scene.max_range

    def _set_shape(self, spec, geom, shape, name):
        mujoco = self._mujoco
        if isinstance(shape, Sphere):
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.size = [shape.radius(), 0, 0]
        elif isinstance(shape, Capsule):
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            geom.size = [shape.radius(), shape.length() / 2, 0]
        elif isinstance(shape, Box):
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size = np.array(shape.size()) / 2
        elif isinstance(shape, HalfSpace):
            geom.type = mujoco.mjtGeom.mjGEOM_PLANE
            geom.size = [0, 0, 1]
        else:
            vertices, faces = read_triangles(shape)
            mesh = spec.add_mesh(name=name)
            mesh.uservert = vertices.ravel()
            mesh.userface = faces.ravel()
            # As it is, whether it encloses a volume or not.
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = name

    def _add_sensors(self, spec, bodies, scene):
        """Does nothing: rays are passed at each call."""

    def prepare(self, i: int):
        """Does nothing: no state depends on the previous one."""

    def update(self, i: int):
        """Moves the scene into state i."""
        self._data.mocap_pos[:], self._data.mocap_quat[:] = self._mocap[i]
        self._mujoco.mj_kinematics(self._model, self._data)

    def get_distances(self, result) -> np.ndarray:
        """Returns what a cast has found, (m, k), inf: nothing in range."""
        bad = (result < 0.0) | (result > self._max_range)
        return np.where(bad, np.inf, result)


class MujocoMultiRay(MujocoScene):
    """One mj_multiRay per sensor, which takes one origin for all of its rays.

    The own link is left out by `bodyexclude`, what is out of range by
    `cutoff`.
    """

    name = "MuJoCo, mj_multiRay"

    def __init__(self, scene: Scene):
        super().__init__(scene)
        m, k = scene.bundles.num_bundles, len(scene.bundles.fan_S)
        self._distance = np.empty((m, k))
        ids = np.empty((m, k), dtype=np.int32)
        own = [
            self._model.body(f"frame_{f}").id for f in scene.bundles.frame_index
        ]
        self._calls = [
            [
                (
                    *(p_WR[s, 0].copy(), n_WR[s].ravel().copy(), None, True),
                    *(own[s], ids[s], self._distance[s], None, k),
                    self._max_range,
                )
                for s in range(m)
            ]
            for p_WR, n_WR in scene.rays
        ]

    def cast(self, i: int):
        """Casts the rays of state i."""
        cast, model, data = self._mujoco.mj_multiRay, self._model, self._data
        for call in self._calls[i]:
            cast(model, data, *call)
        return self._distance


class MujocoRangefinders(MujocoScene):
    """A rangefinder for each ray, all evaluated by one mj_sensorPos.

    A rangefinder does not see the body that it is fixed to.
    """

    name = "MuJoCo, rangefinders"

    def _add_sensors(self, spec, bodies, scene):
        bundles = scene.bundles
        self._shape = bundles.num_bundles, len(bundles.fan_S)
        for s in range(bundles.num_bundles):
            X_FS = bundles.X_FS[s]
            for j, n_S in enumerate(bundles.fan_S):
                R_FR = RotationMatrix.MakeFromOneVector(X_FS[:, :3] @ n_S, 2)
                name = f"ray_{s}_{j}"
                bodies[bundles.frame_index[s]].add_site(
                    name=name,
                    pos=X_FS[:, 3],
                    quat=R_FR.ToQuaternion().wxyz(),
                )
                sensor = spec.add_sensor(
                    name=name,
                    type=self._mujoco.mjtSensor.mjSENS_RANGEFINDER,
                    objtype=self._mujoco.mjtObj.mjOBJ_SITE,
                    objname=name,
                )
                what = list(sensor.intprm)
                what[0] = 1 << int(self._mujoco.mjtRayDataField.mjRAYDATA_DIST)
                sensor.intprm = what

    def cast(self, i: int):
        """Casts the rays, which are fixed to their bodies."""
        self._mujoco.mj_sensorPos(self._model, self._data)
        return self._data.sensordata.reshape(self._shape)


class PybulletCaster:
    """PyBullet: rayTestBatch on one thread, only what has moved is moved.

    A frame's shapes are one body. A ring's rays are cast in one call, which
    leaves out their own link by its collision group.
    """

    name = "PyBullet, rayTestBatch"

    def __init__(self, scene: Scene):
        import pybullet

        self._bullet = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        by_frame = [[] for _ in scene.caster.frame_ids]
        for shape, f, X_FG in list_shapes(scene):
            by_frame[f].append((shape, X_FG))
        carriers = list(dict.fromkeys(scene.bundles.frame_index.tolist()))
        self._bodies = []
        for f, shapes in enumerate(by_frame):
            body = pybullet.createMultiBody(
                0.0, self._make_shape(shapes), physicsClientId=self._client
            )
            group = 1
            if f in carriers:
                group = 2 << carriers.index(f)
            pybullet.setCollisionFilterGroupMask(
                *(body, -1, group, -1), physicsClientId=self._client
            )
            self._bodies.append(body)
        self._poses = [
            [(X[:, 3], np.roll(make_quaternion(X), -1)) for X in X_WF]
            for X_WF in scene.X_WF
        ]
        self._moved = [
            [
                (self._bodies[f], *self._poses[i][f])
                for f in range(len(X_WF))
                if np.abs(X_WF[f] - scene.X_WF[i - 1, f]).max() > 1e-12
            ]
            for i, X_WF in enumerate(scene.X_WF)
        ]
        self.prepare(0)
        self._calls = []
        for p_WR, n_WR in scene.rays:
            end = p_WR + scene.max_range * n_WR
            self._calls.append([])
            for j, f in enumerate(carriers):
                rows = scene.bundles.frame_index == f
                self._calls[-1].append(
                    {
                        "rayFromPositions": p_WR[rows].reshape(-1, 3).copy(),
                        "rayToPositions": end[rows].reshape(-1, 3).copy(),
                        "numThreads": 1,
                        "collisionFilterMask": ~(2 << j),
                        "physicsClientId": self._client,
                    }
                )
        self._max_range = scene.max_range
        self._shape = scene.rays[0][1].shape[:2]

    def _make_shape(self, shapes):
        bullet = self._bullet
        shape = shapes[0][0]
        if isinstance(shape, HalfSpace):
            return bullet.createCollisionShape(
                bullet.GEOM_PLANE, physicsClientId=self._client
            )
        if isinstance(shape, Mesh):
            vertices, faces = read_triangles(shape)
            return bullet.createCollisionShape(
                bullet.GEOM_MESH,
                vertices=vertices.tolist(),
                indices=faces.ravel().tolist(),
                # As it is: without the flag it would be the convex hull.
                flags=bullet.GEOM_FORCE_CONCAVE_TRIMESH,
                physicsClientId=self._client,
            )
        kinds = {
            Sphere: bullet.GEOM_SPHERE,
            Capsule: bullet.GEOM_CAPSULE,
            Box: bullet.GEOM_BOX,
        }
        return bullet.createCollisionShapeArray(
            shapeTypes=[kinds[type(s)] for s, _ in shapes],
            radii=[getattr(s, "radius", float)() for s, _ in shapes],
            lengths=[getattr(s, "length", float)() for s, _ in shapes],
            halfExtents=[
                [x / 2 for x in s.size()] if isinstance(s, Box) else [0.0] * 3
                for s, _ in shapes
            ],
            collisionFramePositions=[X.translation() for _, X in shapes],
            collisionFrameOrientations=[
                np.roll(X.rotation().ToQuaternion().wxyz(), -1)
                for _, X in shapes
            ],
            physicsClientId=self._client,
        )

    def _move(self, body, p, q):
        self._bullet.resetBasePositionAndOrientation(
            body, p, q, physicsClientId=self._client
        )

    def prepare(self, i: int):
        """Moves the scene into the state preceding i."""
        for body, pose in zip(self._bodies, self._poses[i - 1], strict=True):
            self._move(body, *pose)

    def update(self, i: int):
        """Moves what has moved since the previous state."""
        for body, p, q in self._moved[i]:
            self._move(body, p, q)

    def cast(self, i: int):
        """Casts the rays of state i."""
        cast = self._bullet.rayTestBatch
        return [cast(**call) for call in self._calls[i]]

    def get_distances(self, result) -> np.ndarray:
        """Returns what a cast has found, (m, k), inf: nothing in range."""
        hits = [hit for part in result for hit in part]
        distance = np.array([hit[2] for hit in hits]) * self._max_range
        distance[[hit[0] < 0 for hit in hits]] = np.inf
        return distance.reshape(self._shape)


_KINDS = Sphere, Capsule, Box, HalfSpace


class NumpyCaster:
    """Closed forms in NumPy, for all pairs of bundle and shape at once.

    What is outside a bundle's cone is skipped. No meshes.
    """

    name = "NumPy"

    def __init__(self, scene: Scene):
        self._scene = scene
        bundles = scene.bundles
        shapes = list_shapes(scene)
        self._frame = np.array([f for _, f, _ in shapes])
        self._X_FG = np.array([X.GetAsMatrix34() for _, _, X in shapes])
        self._kind = np.array(
            [
                (Sphere, Capsule, Box, HalfSpace).index(type(s))
                for s, *_ in shapes
            ]
        )
        self._size = np.array([self._read_size(s) for s, *_ in shapes])
        self._radius = np.where(
            self._kind == 2,
            np.linalg.norm(self._size, axis=1),
            self._size[:, 0] + self._size[:, 1] * (self._kind == 1),
        )
        self._radius[self._kind == 3] = np.inf
        self._fan = bundles.fan_S.T.copy()
        cos = bundles.fan_S[:, 0].min()
        self._cos, self._sin = cos, np.sqrt(1.0 - cos * cos)

    @staticmethod
    def _read_size(shape):
        if isinstance(shape, Box):
            return np.array(shape.size()) / 2
        if isinstance(shape, Capsule):
            return [shape.radius(), shape.length() / 2, 0.0]
        return [getattr(shape, "radius", float)(), 0.0, 0.0]

    def prepare(self, i: int):
        """Does nothing: no state depends on the previous one."""

    def update(self, i: int):
        """Poses shapes and bundles in state i."""
        X_WF = self._scene.calc_poses(i)
        bundles = self._scene.bundles
        self._R_WG, self._p_WG = _compose(X_WF[self._frame], self._X_FG)
        self._R_WS, self._p_WS = _compose(
            X_WF[bundles.frame_index], bundles.X_FS
        )

    def cast(self, i: int):
        """Casts the rays."""
        v = self._p_WG - self._p_WS[:, None]
        gap2 = (v * v).sum(axis=2)
        along = (v @ self._R_WS[:, :, :1])[:, :, 0]
        rest = self._radius + along * self._sin
        across = self._cos * np.sqrt(np.maximum(gap2 - along * along, 0.0))
        far = self._radius + self._scene.max_range
        bundle, shape = np.nonzero(
            (across <= rest) & (gap2 <= far * far) & self._scene.bundles.active
        )
        R_GW = self._R_WG[shape].transpose(0, 2, 1)
        p = -(R_GW @ v[bundle, shape][:, :, None])
        d = (R_GW @ self._R_WS[bundle]) @ self._fan
        t = np.empty((len(shape), d.shape[2]))
        kind = self._kind[shape]
        casts = _cast_balls, _cast_capsules, _cast_boxes, _cast_half_spaces
        for k, cast in enumerate(casts):
            rows = kind == k
            if rows.any():
                size = self._size[shape[rows]][:, :, None]
                t[rows] = cast(p[rows], d[rows], size)
        result = np.full((len(self._p_WS), d.shape[2]), np.inf)
        starts = np.flatnonzero(np.diff(bundle, prepend=-1))
        result[bundle[starts]] = np.minimum.reduceat(t, starts)
        return result

    def get_distances(self, result) -> np.ndarray:
        """Returns what a cast has found, (m, k), inf: nothing in range."""
        return np.where(result <= self._scene.max_range, result, np.inf)


def _compose(X_AB, X_BC):
    R_AB = X_AB[:, :, :3]
    p = (R_AB @ X_BC[:, :, 3:])[:, :, 0] + X_AB[:, :, 3]
    return R_AB @ X_BC[:, :, :3], p


def _solve(b, rest, a=1.0):
    """Returns where a t^2 + 2 b t + .. = 0 first, with b^2 - a c = rest."""
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-b - np.sqrt(rest)) / a
    return np.where(t >= 0.0, t, np.inf)


def _cast_balls(p, d, size):
    b = (p * d).sum(axis=1)
    c = (p * p).sum(axis=1) - size[:, 0] ** 2
    return np.where(c <= 0.0, 0.0, _solve(b, b * b - c))


def _cast_capsules(p, d, size):
    radius, half = size[:, 0], size[:, 1]
    px, py, pz = p[:, 0], p[:, 1], p[:, 2]
    dx, dy, dz = d[:, 0], d[:, 1], d[:, 2]
    a = dx * dx + dy * dy
    b = px * dx + py * dy
    c = px * px + py * py - radius * radius
    tube = _solve(b, b * b - a * c, a)
    with np.errstate(invalid="ignore"):
        tube[~(np.abs(pz + tube * dz) <= half)] = np.inf
    t = tube
    for end in (half, -half):
        q = np.concatenate([p[:, :2], p[:, 2:] - end[:, None]], axis=1)
        t = np.minimum(t, _cast_balls(q, d, size))
    inside = (c <= 0.0) & (np.abs(pz) <= half)
    return np.where(inside, 0.0, t)


def _cast_boxes(p, d, size):
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-size - p) / d, (size - p) / d
    enter = np.minimum(first, second).max(axis=1)
    leave = np.maximum(first, second).min(axis=1)
    enter = np.maximum(enter, 0.0)
    return np.where(enter <= leave, enter, np.inf)


def _cast_half_spaces(p, d, size):
    with np.errstate(divide="ignore"):
        t = np.where(d[:, 2] < 0.0, -p[:, 2] / d[:, 2], np.inf)
    return np.where(p[:, 2] <= 0.0, 0.0, t)
