"""The same rays in MuJoCo; needs the extra `peers` (see tests/conftest.py)."""

import unittest

import mujoco
import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    Sphere,
)
import ray_oracle as oracle
from solids import find_hull_planes, read_mesh

from tofssm_drake.raycast.ray_caster import RayCaster

SCENES = 24
ORIGINS = 40
RAYS = 250


def find_hull_faces(points):
    """Returns the triangles of a hull whose faces are all triangles."""
    planes = find_hull_planes(points)
    gap = np.abs(points @ planes[:, :3].T - planes[:, 3]).T
    faces = np.argsort(gap, axis=1)[:, :3]
    a, b, c = (points[faces[:, i]] for i in range(3))
    turned = (np.cross(b - a, c - a) * planes[:, :3]).sum(-1) < 0
    faces[turned] = faces[turned][:, ::-1]
    return faces


def make_model(shapes, X_WG):
    """Returns a MuJoCo model with geom i for shape i."""
    spec = mujoco.MjSpec()
    for i, (shape, X) in enumerate(zip(shapes, X_WG, strict=True)):
        geom = spec.worldbody.add_geom(
            pos=X.translation(), quat=X.rotation().ToQuaternion().wxyz()
        )
        if isinstance(shape, Sphere):
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.size = [shape.radius(), 0, 0]
        elif isinstance(shape, Ellipsoid):
            geom.type = mujoco.mjtGeom.mjGEOM_ELLIPSOID
            geom.size = [shape.a(), shape.b(), shape.c()]
        elif isinstance(shape, Capsule | Cylinder):
            geom.type = (
                mujoco.mjtGeom.mjGEOM_CAPSULE
                if isinstance(shape, Capsule)
                else mujoco.mjtGeom.mjGEOM_CYLINDER
            )
            geom.size = [shape.radius(), shape.length() / 2, 0]
        elif isinstance(shape, Box):
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size = np.asarray(shape.size()) / 2
        elif isinstance(shape, HalfSpace):
            geom.type = mujoco.mjtGeom.mjGEOM_PLANE
            geom.size = [0, 0, 1]  # Without end.
        else:
            vertices, faces = read_mesh(shape)
            if isinstance(shape, Convex):
                faces = find_hull_faces(vertices)
            mesh = spec.add_mesh(name=f"mesh_{i}")
            mesh.uservert = vertices.ravel()
            mesh.userface = faces.ravel()
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = mesh.name
    return spec.compile()


def cast_in_mujoco(model, p_WR, n_WR):
    """Casts rays (m, k) from m origins.

    Returns:
        (distance, index) of shape (m, k), normals (m, k, 3).
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    m, k, _ = n_WR.shape
    distance = np.empty((m, k))
    index = np.empty((m, k), dtype=np.int32)
    normals = np.empty((m, k, 3))
    for i in range(m):
        mujoco.mj_multiRay(
            model, data, p_WR[i], n_WR[i].ravel(), None, True, -1,
            index[i], distance[i], normals[i].ravel(), k, 1e10,
        )  # fmt: skip
    distance[index < 0] = np.inf
    return distance, index, normals


class TestAgainstMujoco(unittest.TestCase):
    def test_random_scenes(self):
        """Distances to 1e-8, of meshes, in single precision there, to 1e-6.

        Both but for rays along the surface, where the distance is as
        uncertain as the vertices over the slope.
        """
        rng = np.random.default_rng(5)
        hits = dict.fromkeys(
            (
                Sphere,
                Capsule,
                Cylinder,
                Box,
                Ellipsoid,
                HalfSpace,
                Convex,
                Mesh,
            ),
            0,
        )
        rays = 0
        for number in range(SCENES):
            kinds = [
                oracle.ALL_KINDS[(number + 3 * i) % len(oracle.ALL_KINDS)]
                for i in range(4)
            ]
            scene = oracle.make_random_scene(rng, kinds)
            dut = RayCaster(scene.inspector)
            X_WF = dut.poses_from_query_object(scene.query_object())
            shapes, X_WG = scene.shapes_in_order(dut.geometry_ids)
            p_WR = rng.uniform(-1.5, 1.5, (ORIGINS, 3))
            n_WR = rng.uniform(-1.0, 1.0, (ORIGINS, RAYS, 3)) - p_WR[:, None]
            n_WR /= np.linalg.norm(n_WR, axis=2, keepdims=True)
            p_WR = np.broadcast_to(p_WR[:, None], n_WR.shape)
            hit = dut.cast(X_WF, p_WR.reshape(-1, 3), n_WR.reshape(-1, 3))
            distance, index = (x.reshape(ORIGINS, RAYS) for x in hit)
            normals = dut.calc_normals(X_WF, p_WR, n_WR, distance, index)
            want, want_index, want_normals = cast_in_mujoco(
                make_model(shapes, X_WG), p_WR[:, 0], n_WR
            )
            # MuJoCo's shapes are hollow.
            outside = (distance > 0).all(axis=1)
            self.assertGreater(outside.sum(), ORIGINS // 5)
            for i, shape in enumerate(shapes):
                is_mesh = isinstance(shape, Convex | Mesh)
                mine = (index == i) & outside[:, None]
                slope = np.abs((normals * n_WR).sum(-1))
                mine &= slope > (0.1 if is_mesh else 1e-3)
                np.testing.assert_array_equal(want_index[mine], i)
                np.testing.assert_allclose(
                    distance[mine],
                    want[mine],
                    rtol=0,
                    atol=1e-6 if is_mesh else 1e-8,
                )
                np.testing.assert_allclose(
                    normals[mine],
                    want_normals[mine],
                    rtol=0,
                    atol=1e-4 if is_mesh else 1e-6,
                )
                hits[type(shape)] += mine.sum()
            missed = (index < 0) & outside[:, None]
            # Along an edge that single precision has moved.
            self.assertLess(np.isfinite(want[missed]).mean(), 1e-4)
            rays += outside.sum() * RAYS
        self.assertGreater(rays, 100_000)
        self.assertGreater(min(hits.values()), 1000)


if __name__ == "__main__":
    unittest.main()
