"""How the cost of a query grows with rays, shapes and triangles."""

from collections.abc import Callable
import dataclasses as dc
import json
import time

import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    Capsule,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster

RAYS = 25
FOV = np.deg2rad(25.0)
_ROUNDS = 15
_BATCH_TIME = 2e-3


@dc.dataclass(frozen=True, kw_only=True)
class Curve:
    """Cost against size."""

    name: str
    sizes: list[int]
    times: list[float]
    """us."""

    def find_steepest(self) -> float:
        """Returns the largest slope of a step on logarithmic axes."""
        return float(
            np.max(np.diff(np.log(self.times)) / np.diff(np.log(self.sizes)))
        )


def measure_rays() -> list[Curve]:
    """More sensors, more rays in each, and rays of their own origin."""
    caster, X_WF = _make_clutter(64, frames=64)
    sizes = [150, 300, 600, 1200, 2500, 5000, 10000, 20000]
    more_sensors, finer_fans, single = [], [], []
    for n in sizes:
        bundles = _make_bundles(caster, n // RAYS, RAYS)
        more_sensors.append((caster.cast_bundles, bundles, X_WF))
        bundles = _make_bundles(caster, 24, round(n / 24))
        finer_fans.append((caster.cast_bundles, bundles, X_WF))
        p_WR, n_WR = caster.calc_rays(
            _make_bundles(caster, n // RAYS, RAYS), X_WF
        )
        rays = p_WR.reshape(-1, 3).copy(), n_WR.reshape(-1, 3).copy()
        single.append((caster.cast, X_WF, *rays, 1.36))
    return _measure(
        {
            "more sensors of 25 rays": (sizes, more_sensors),
            "more rays in 24 sensors": (sizes, finer_fans),
            "rays one by one": (sizes, single),
        }
    )


def measure_shapes() -> list[Curve]:
    """600 rays in a room of 8 m with more and more shapes in it."""
    sizes = [10, 20, 50, 100, 200, 500, 1000, 2000]
    calls = {}
    for name, frames in (
        ("fixed in the world", 0),
        ("on ten moving frames", 10),
        ("each on its own moving frame", max(sizes)),
    ):
        calls[name] = sizes, []
        for n in sizes:
            caster, X_WF = _make_clutter(n, frames=min(frames, n))
            bundles = _make_bundles(caster, 24, RAYS)
            calls[name][1].append((caster.cast_bundles, bundles, X_WF))
    return _measure(calls)


def measure_triangles() -> list[Curve]:
    """600 rays from around one mesh towards it."""
    sizes, calls = [], []
    for n in (1000, 3000, 10000, 30000, 100000, 300000, 1000000):
        mesh, triangles = make_bumpy_ball(n)
        scene_graph = SceneGraph()
        source = scene_graph.RegisterSource("ball")
        instance = GeometryInstance(RigidTransform(), mesh, "ball")
        instance.set_perception_properties(PerceptionProperties())
        scene_graph.RegisterAnchoredGeometry(source, instance)
        caster = RayCaster(scene_graph.model_inspector())
        turn = 2.0 * np.pi * np.arange(24) / 24
        X_FS = [
            RigidTransform(RotationMatrix.MakeZRotation(a), [0.0, 0.0, 0.0])
            @ RigidTransform(RollPitchYaw(0, 0, np.pi), [1.0, 0.0, 0.0])
            for a in turn
        ]
        bundles = caster.make_bundles(
            frame_id=caster.world_frame_id,
            X_FS=X_FS,
            fan_S=make_cone_fan(FOV, RAYS),
            max_range=1.36,
        )
        sizes.append(triangles)
        calls.append((caster.cast_bundles, bundles, np.eye(3, 4)[None].copy()))
    return _measure({"one mesh": (sizes, calls)})


def _measure(calls: dict[str, tuple[list[int], list[tuple]]]) -> list[Curve]:
    """Returns the curves; all sizes take turns, the least time counts.

    Disturbances only add to a measurement.
    """
    repeats = {}
    for name, (_, functions) in calls.items():
        for i, (function, *args) in enumerate(functions):
            function(*args)
            once = _time(function, args, 3)
            repeats[name, i] = max(1, int(_BATCH_TIME / once))
    best = dict.fromkeys(repeats, np.inf)
    for _ in range(_ROUNDS):
        for (name, i), count in repeats.items():
            function, *args = calls[name][1][i]
            best[name, i] = min(best[name, i], _time(function, args, count))
    return [
        Curve(
            name=name,
            sizes=sizes,
            times=[1e6 * best[name, i] for i in range(len(sizes))],
        )
        for name, (sizes, _) in calls.items()
    ]


def _time(function: Callable, args, count: int) -> float:
    """Returns the processor time of one call, s."""
    start = time.thread_time()
    for _ in range(count):
        function(*args)
    return (time.thread_time() - start) / count


def _make_clutter(n: int, *, frames: int):
    """Returns (caster, X_WF) of n shapes strewn over a room.

    They are on that many moving frames in turn, within half a metre from its
    origin; 0: fixed in the world.
    """
    rng = np.random.default_rng(0)
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("clutter")
    poses = FramePoseVector()
    frame_ids = []
    for i in range(n):
        X = RigidTransform(
            RollPitchYaw(rng.uniform(-np.pi, np.pi, 3)),
            rng.uniform(-1.0, 1.0, 3) * [4.0, 4.0, 1.5],
        )
        shape = (Sphere(0.08), Capsule(0.06, 0.3), Box(0.2, 0.15, 0.1))[i % 3]
        if i < frames:
            frame_ids.append(
                scene_graph.RegisterFrame(source, GeometryFrame(f"{i}"))
            )
            poses.set_value(frame_ids[i], X)
            X = RigidTransform()
        elif frames:
            X.set_translation(X.translation() * [0.125, 0.125, 0.3])
        instance = GeometryInstance(X, shape, f"{i}")
        instance.set_perception_properties(PerceptionProperties())
        if frames:
            scene_graph.RegisterGeometry(
                source, frame_ids[i % frames], instance
            )
        else:
            scene_graph.RegisterAnchoredGeometry(source, instance)
    caster = RayCaster(scene_graph.model_inspector())
    # Known before the poses are asked for: the sensors' frame.
    _make_bundles(caster, 1, RAYS)
    context = scene_graph.CreateDefaultContext()
    scene_graph.get_source_pose_port(source).FixValue(context, Value(poses))
    query_object = scene_graph.get_query_output_port().Eval(context)
    return caster, caster.poses_from_query_object(query_object)


def _make_bundles(caster, sensors: int, rays: int):
    """Returns sensors that are strewn over the same room."""
    rng = np.random.default_rng(1)
    return caster.make_bundles(
        frame_id=caster.world_frame_id,
        X_FS=[
            RigidTransform(
                RollPitchYaw(0.0, rng.uniform(-1, 1), rng.uniform(-3, 3)),
                rng.uniform(-1.0, 1.0, 3) * [3.0, 3.0, 1.0],
            )
            for _ in range(sensors)
        ],
        fan_S=make_cone_fan(FOV, rays),
        max_range=1.36,
    )


def make_bumpy_ball(triangles: int) -> tuple[Mesh, int]:
    """Returns a closed mesh of about that many triangles, and their number."""
    around = max(8, round(np.sqrt(triangles)))
    along = max(4, round(triangles / around / 2))
    polar = np.pi * np.arange(along + 1) / along
    turn = 2.0 * np.pi * np.arange(around) / around
    polar, turn = np.meshgrid(polar, turn, indexing="ij")
    radius = 0.4 * (1.0 + 0.1 * np.sin(7 * polar) * np.cos(9 * turn))
    across = np.sin(polar)
    across[-1] = 0.0  # Else it is open there.
    vertices = radius[:, :, None] * np.stack(
        [across * np.cos(turn), np.cos(polar), across * np.sin(turn)],
        axis=-1,
    )
    a = np.arange(along * around).reshape(along, around)
    b = np.roll(a, -1, axis=1)
    c, d = a + around, b + around
    faces = np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3)
    return _make_gltf(vertices.reshape(-1, 3), faces), len(faces)


def _make_gltf(vertices, faces) -> Mesh:
    """Returns an in-memory mesh that is read fast however large it is."""
    points = vertices.astype(np.float32).tobytes()
    indices = faces.astype(np.uint32).tobytes()
    gltf = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}
        ],
        "buffers": [
            {"byteLength": len(points) + len(indices), "uri": "ball.bin"}
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(points)},
            {
                "buffer": 0,
                "byteOffset": len(points),
                "byteLength": len(indices),
            },
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": 5125,
                "count": 3 * len(faces),
                "type": "SCALAR",
            },
        ],
    }
    return Mesh(
        InMemoryMesh(
            mesh_file=MemoryFile(json.dumps(gltf), ".gltf", "ball.gltf"),
            supporting_files={
                "ball.bin": MemoryFile(points + indices, ".bin", "ball.bin")
            },
        )
    )
