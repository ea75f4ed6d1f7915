"""Rays along axes, tangents, faces and edges, and rays that are none."""

import unittest

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform
import ray_oracle as oracle
from solids import (
    CUBE_FACES,
    CUBE_QUADS,
    CUBE_VERTICES,
    make_mesh,
    make_torus,
    write_obj,
)

from tofssm_drake.errors import UserError
from tofssm_drake.raycast.ray_caster import RayCaster

TINY = np.nextafter(0.0, 1.0)


def make_cube(kind, faces=CUBE_FACES):
    """A cube from -1 to 1."""
    return make_mesh(
        write_obj(CUBE_VERTICES, faces), scale=(2, 2, 2), kind=kind
    )


def cast(shape, p, n):
    """Returns the distance of one ray, cast alone and as a bundle."""
    scene = oracle.Scene()
    scene.add(shape)
    caster = RayCaster(scene.inspector)
    query_object = scene.query_object()
    n = np.array(n, dtype=float)
    n /= np.linalg.norm(n)
    alone = caster.cast(query_object, [p], [n])[0][0]
    bundles = caster.make_bundles(
        frame_id=caster.world_frame_id,
        X_FS=[RigidTransform(p)],
        fan_S=[n],
        max_range=np.inf,
    )
    X_WF = caster.poses_from_query_object(query_object)
    bundled = caster.cast_bundles(bundles, X_WF)[0][0, 0]
    return alone, bundled


class TestDegenerateRays(unittest.TestCase):
    """On unturned shapes, where a ray can be exactly so."""

    def check(self, shape, cases):
        for p, n, expected in cases:
            with self.subTest(shape=shape, p=p, n=n):
                for actual in cast(shape, p, n):
                    self.assertAlmostEqual(actual, expected, delta=1e-14)

    def test_box(self):
        self.check(
            Box(2, 2, 2),
            [
                ([-3, 0, 0], [1, 0, 0], 2.0),
                ([-3, 0, 0], [-1, 0, 0], np.inf),
                ([-3, 1, 0], [1, 0, 0], 2.0),  # Along a face.
                ([-3, 1, 1], [1, 0, 0], 2.0),  # Along an edge.
                ([-3, 1 + 1e-9, 0], [1, 0, 0], np.inf),
                ([-3, 0, 2], [1, 0, -0.0], np.inf),
                ([1, 0, 0], [1, 0, 0], 0.0),  # Starts on a face.
                ([1, 0, 0], [0, 1, 0], 0.0),
                ([-2, -2, -2], [1, 1, 1], np.sqrt(3)),  # Through a corner.
                ([-1, -3, 1], [0, 1, 0], 2.0),
            ],
        )

    def test_sphere(self):
        self.check(
            Sphere(1),
            [
                ([-3, 0, 0], [1, 0, 0], 2.0),
                ([-3, 1, 0], [1, 0, 0], 3.0),  # Tangent.
                ([-3, 1 + 1e-9, 0], [1, 0, 0], np.inf),
                ([-1, 0, 0], [1, 0, 0], 0.0),
                ([-1, 0, 0], [0, 1, 0], 0.0),  # Touches where it starts.
                ([-1, 0, 0], [-1, 0, 0], 0.0),
                ([0, 0, 0], [0, 0, 1], 0.0),
            ],
        )

    def test_capsule(self):
        self.check(
            Capsule(1, 2),
            [
                ([0, 0, 5], [0, 0, -1], 3.0),  # Along the axis.
                ([0.6, 0, 5], [0, 0, -1], 3.2),
                ([0.6, 0, -5], [0, 0, 1], 3.2),
                ([1, 0, 5], [0, 0, -1], 4.0),  # Along the tube.
                ([1 + 1e-9, 0, 5], [0, 0, -1], np.inf),
                ([0, 0, 5], [0, 0, 1], np.inf),
                ([0, 0, 3], [1e-12, 0, -1], 1.0),
                ([-3, 0, 0], [1, 0, 0], 2.0),
                ([-3, 0, 1], [1, 0, 0], 2.0),  # At the seam.
                ([-3, 1, 0], [1, 0, 0], 3.0),  # Tangent.
                ([-3, 0, 2], [1, 0, 0], 3.0),  # Tangent at the tip.
                ([0, 0, 2], [0, 0, 1], 0.0),
                ([0, 0.8, 1.7], [0, 0, 1], np.inf),
            ],
        )

    def test_cylinder(self):
        self.check(
            Cylinder(1, 2),
            [
                ([0, 0, 5], [0, 0, -1], 4.0),
                ([1, 0, 5], [0, 0, -1], 4.0),  # Along the tube.
                ([1 + 1e-9, 0, 5], [0, 0, -1], np.inf),
                ([-3, 0, 0], [1, 0, 0], 2.0),
                ([-3, 0, 1], [1, 0, 0], 2.0),  # In the end's plane.
                ([-3, 0, 1 + 1e-9], [1, 0, 0], np.inf),
                ([-3, 1, 0], [1, 0, 0], 3.0),  # Tangent.
                ([0, 0, 1], [0, 0, 1], 0.0),
                ([0, 0, 5], [1e-13, 0, -1], 4.0),
                ([-2, 0, 2], [1, 0, -1], np.sqrt(2)),  # Through the rim.
            ],
        )

    def test_half_space(self):
        self.check(
            HalfSpace(),
            [
                ([0, 0, 2], [0, 0, -1], 2.0),
                ([0, 0, 2], [0, 0, 1], np.inf),
                ([0, 0, 2], [1, 0, 0], np.inf),  # Parallel.
                ([0, 0, 0], [1, 0, 0], 0.0),
                ([0, 0, -1], [0, 0, 1], 0.0),
            ],
        )

    def test_ellipsoid(self):
        self.check(
            Ellipsoid(1, 2, 3),
            [
                ([-3, 0, 0], [1, 0, 0], 2.0),
                ([0, -3, 0], [0, 1, 0], 1.0),
                ([0, 0, 5], [0, 0, -1], 2.0),
                ([-3, 2, 0], [1, 0, 0], 3.0),  # Tangent.
                ([-3, 0, 3], [1, 0, 0], 3.0),
                ([1, -4, 0], [0, 1, 0], 4.0),
                ([-3, 2 + 1e-9, 0], [1, 0, 0], np.inf),
                ([0, 0, 3], [0, 0, 1], 0.0),  # On the surface.
                ([0, 0, 3], [1, 0, 0], 0.0),
                ([0, 0, 0], [1, 0, 0], 0.0),
                ([0, 0, 4], [0, 0, 1], np.inf),
            ],
        )

    def test_cube_as_mesh_and_as_convex(self):
        for kind in (Mesh, Convex):
            for faces in (CUBE_FACES, CUBE_QUADS):
                self.check(
                    make_cube(kind, faces),
                    [
                        # Through an edge between two triangles.
                        ([-3, 0, 0], [1, 0, 0], 2.0),
                        ([0, 3, 0], [0, -1, 0], 2.0),
                        ([0, 0, -3], [0, 0, 1], 2.0),
                        ([-3, 0, 0], [-1, 0, 0], np.inf),
                        ([-3, 1, 0], [1, 0, 0], 2.0),  # Along a face.
                        ([-3, 1, 1], [1, 0, 0], 2.0),  # Along an edge.
                        ([-3, 1 + 1e-9, 0], [1, 0, 0], np.inf),
                        ([-3, 0, 2], [1, 0, -0.0], np.inf),
                        ([1, 0.2, 0.1], [-1, 0, 0], 0.0),  # On a face.
                        ([-1, 0.2, 0.1], [-1, 0, 0], 0.0),
                        ([0, 0.2, 0.1], [0, 1, 0], 0.0),  # Inside.
                        ([-2, -2, -2], [1, 1, 1], np.sqrt(3)),  # A corner.
                    ],
                )

    def test_hardly_a_slope(self):
        """Components so small that their inverse overflows."""
        for shape in (
            Box(2, 2, 2),
            Sphere(1),
            Cylinder(1, 2),
            Capsule(1, 2),
            Ellipsoid(1, 1, 1),
            make_cube(Mesh),
            make_cube(Convex),
        ):
            self.check(
                shape,
                [
                    ([-3, 0, 0], [1, TINY, -TINY], 2.0),
                    ([-3, 0.0, 0.0], [1, 1e-200, 1e-300], 2.0),
                    ([-3, 0.0, 3.0], [1, 1e-200, -1e-300], np.inf),
                ],
            )
        self.check(
            HalfSpace(),
            [
                ([0, 0, 2], [1, 0, -TINY], np.inf),
                ([0, 0, -0.0], [1, 0, TINY], 0.0),
            ],
        )

    def test_sphere_as_capsule_without_length(self):
        scene = oracle.Scene()
        rng = np.random.default_rng(0)
        scene.add(Sphere(0.5))
        scene.add(Capsule(0.5, 1e-300), role=Role.kProximity)
        p = rng.uniform(-2, 2, (500, 3))
        n = oracle.make_unit_vectors(rng, 500)
        query_object = scene.query_object()
        sphere = RayCaster(scene.inspector).cast(query_object, p, n)
        capsule = RayCaster(scene.inspector, role=Role.kProximity).cast(
            query_object, p, n
        )
        np.testing.assert_allclose(sphere[0], capsule[0], atol=1e-12)

    def test_range_of_nothing(self):
        """A range of 0 sees what the ray starts in, and nothing else."""
        scene = oracle.Scene()
        scene.add(Sphere(1.0))
        dut = RayCaster(scene.inspector)
        X_WF = dut.poses_from_query_object(scene.query_object())
        p = [[0.0, 0, 0], [1.0, 0, 0], [1.0 + 1e-9, 0, 0]]
        distance, index = dut.cast(X_WF, p, [[-1.0, 0, 0]] * 3, 0.0)
        np.testing.assert_array_equal(distance, [0.0, 0.0, np.inf])
        np.testing.assert_array_equal(index, [0, 0, -1])


class TestRaysFromTheSurfaceOfAMesh(unittest.TestCase):
    """They start on it, so their distance is 0, wherever they look."""

    def setUp(self):
        self.rng = np.random.default_rng(8)
        self.poses = (
            RigidTransform(),
            oracle.make_random_pose(self.rng),
            RigidTransform(
                oracle.make_random_pose(self.rng).rotation(), [90, -200, 50]
            ),
        )

    def make_points(self, vertices, faces, count):
        """Returns points on faces, edges and corners, and their normals."""
        weights = self.rng.dirichlet([1, 1, 1], count)
        weights[::3, 0] = 0.0
        weights[::6] = [0.0, 0.0, 1.0]
        weights /= weights.sum(axis=1, keepdims=True)
        corners = vertices[faces[self.rng.integers(len(faces), size=count)]]
        a, b, c = corners.transpose(1, 0, 2)
        return np.einsum("ni,nij->nj", weights, corners), np.cross(b - a, c - a)

    def make_directions(self, normals):
        """Returns any directions, every fourth one within the surface."""
        n = oracle.make_unit_vectors(self.rng, len(normals))
        n[::4] = np.cross(normals, n)[::4]
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    def cast(self, shape, X, p, n):
        """Returns the distances of rays in G, cast alone and as bundles."""
        scene = oracle.Scene()
        frame_id = scene.add_frame(X)
        scene.add(shape, None, frame_id)
        dut = RayCaster(scene.inspector)
        bundles = dut.make_bundles(
            frame_id=dut.world_frame_id,
            X_FS=[RigidTransform(X @ point) for point in p],
            fan_S=n[:20] @ X.rotation().matrix().T,
            max_range=np.inf,
        )
        X_WF = dut.poses_from_query_object(scene.query_object())
        return (
            dut.cast(X_WF, (X @ p.T).T, n @ X.rotation().matrix().T)[0],
            dut.cast_bundles(bundles, X_WF)[0],
        )

    def check_zero(self, vertices, faces):
        shape = make_mesh(write_obj(vertices, faces))
        for X in self.poses:
            p, normals = self.make_points(vertices, faces, 400)
            for distance in self.cast(
                shape, X, p, self.make_directions(normals)
            ):
                np.testing.assert_array_equal(distance, 0.0)
                self.assertFalse(np.signbit(distance).any())

    def test_closed_mesh(self):
        self.check_zero(CUBE_VERTICES, CUBE_FACES)
        self.check_zero(*make_torus(12))

    def test_slivers(self):
        """Their planes are known worse than their corners."""
        for flat in (1e-3, 1e-6):
            self.check_zero(CUBE_VERTICES * [1.0, flat, 1.0], CUBE_FACES)

    def test_open_mesh(self):
        self.check_zero(CUBE_VERTICES, CUBE_FACES[:-1])

    def test_beside_the_surface_is_not_on_it(self):
        """Outwards there is nothing, inwards the surface itself."""
        step = 1e-12
        for faces in (CUBE_FACES, CUBE_FACES[:-2]):
            shape = make_mesh(write_obj(CUBE_VERTICES, faces))
            p, normals = self.make_points(CUBE_VERTICES, CUBE_FACES[:4], 400)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            # Not on the edges, where out is another way.
            p = 0.9 * p + 0.05 * normals
            n = oracle.make_unit_vectors(self.rng, 400)
            n *= np.sign((n * normals).sum(axis=1, keepdims=True))
            for side, expected in ((1.0, np.inf), (-1.0, step)):
                cosine = (n * normals).sum(axis=1)
                alone, _ = self.cast(
                    shape, self.poses[0], p + step * normals, side * n
                )
                np.testing.assert_allclose(
                    alone * cosine, expected, rtol=0, atol=2e-16
                )

    def test_no_ray_slips_in_from_next_to_the_surface(self):
        """What is outside by less than rounding may see nothing or 0."""
        vertices, faces = make_torus(12)
        shape = make_mesh(write_obj(vertices, faces))
        for X in self.poses[:2]:
            p, normals = self.make_points(vertices, faces, 2000)
            p += self.rng.choice([-1, 1], (2000, 3)) * np.spacing(p)
            n = oracle.make_unit_vectors(self.rng, 2000)
            inwards = (n * normals).sum(axis=1) < 0.0
            alone, _ = self.cast(shape, X, p[inwards], n[inwards])
            self.assertLess(alone.max(), 1e-15)


class TestFarOrigins(unittest.TestCase):
    def test_all_that_are_no_error_see_what_is_there(self):
        for shape in (
            Sphere(1),
            Ellipsoid(1, 1, 1),
            Capsule(1, 2),
            Cylinder(1, 2),
            Box(2, 2, 2),
            HalfSpace(),
            make_cube(Mesh),
            make_cube(Convex),
        ):
            for far in (1e20, 1e60, 0.99e100):
                with self.subTest(shape=shape, far=far):
                    for distance in cast(shape, [0, 0, far], [0, 0, -1.0]):
                        self.assertAlmostEqual(distance / far, 1.0)

    def test_bundles_and_poses(self):
        scene = oracle.Scene()
        scene.add(Sphere(1.0), frame_id=scene.add_frame())
        dut = RayCaster(scene.inspector)
        good = dict(
            frame_id=dut.world_frame_id, fan_S=[[1.0, 0, 0]], max_range=np.inf
        )
        for far in (1e100, 1e150, 1e300):
            with self.assertRaisesRegex(ValueError, "X_FS"):
                dut.make_bundles(X_FS=[RigidTransform([0, far, 0])], **good)
        bundles = dut.make_bundles(X_FS=[RigidTransform()], **good)
        X_WF = dut.poses_from_query_object(scene.query_object())
        X_WF[0, 0, 3] = 1e150
        with self.assertRaisesRegex(ValueError, r"nearer than 1e\+100 m"):
            dut.cast_bundles(bundles, X_WF)

    def test_shapes(self):
        for shape, X in (
            (Sphere(1.0), RigidTransform([0, 0, -1e150])),
            (Sphere(1e150), None),
            (make_mesh(write_obj(CUBE_VERTICES * 1e150, CUBE_FACES)), None),
        ):
            scene = oracle.Scene()
            scene.add(shape, X, name="moon")
            with self.assertRaisesRegex(
                UserError, r"'moon': .*not below 1e\+100 m"
            ):
                RayCaster(scene.inspector)


class TestRaysThatAreNone(unittest.TestCase):
    """Bad input is an error, never a wrong number."""

    def setUp(self):
        self.scene = oracle.Scene()
        self.scene.add(Sphere(0.1))
        self.dut = RayCaster(self.scene.inspector)
        self.query_object = self.scene.query_object()

    def check(self, p, n, message):
        """Checks one bad ray, also amid good ones."""
        good_p, good_n = [-1.0, 0, 0], [1.0, 0, 0]
        for ps, ns in (
            ([p], [n]),
            ([good_p, p, good_p], [good_n, n, good_n]),
        ):
            with self.assertRaisesRegex(ValueError, message):
                self.dut.cast(self.query_object, ps, ns)

    def check_fan(self, n):
        with self.assertRaisesRegex(ValueError, "fan_S: not unit vectors"):
            self.dut.make_bundles(
                frame_id=self.dut.world_frame_id,
                X_FS=[RigidTransform()],
                fan_S=[[1.0, 0, 0], n],
                max_range=1.0,
            )

    def test_direction_of_no_length(self):
        for n in ([0.0, 0, 0], [-0.0, 0, 0], [1e-300, 0, 0], [TINY, 0, 0]):
            self.check([0.0, 0, 0], n, "not a unit vector")
            self.check_fan(n)

    def test_direction_that_is_no_unit_vector(self):
        for n in (
            [1.0, 1.0, 0],
            [2.0, 0, 0],
            [0.5, 0, 0],
            [1.0 + 1e-5, 0, 0],
            [1e100, 0, 0],
        ):
            self.check([0.0, 0, 0], n, "not a unit vector")
            self.check_fan(n)

    def test_direction_that_is_not_finite(self):
        for n in (
            [np.nan, 0, 0],
            [1.0, np.nan, 0],
            [np.inf, 0, 0],
            [0, 0, -np.inf],
        ):
            self.check([0.0, 0, 0], n, "not a unit vector")
            self.check_fan(n)

    def test_origin_that_is_not_finite(self):
        for bad in (np.nan, np.inf, -np.inf):
            for i in range(3):
                p = [0.0, 0, 0]
                p[i] = bad
                self.check(p, [1.0, 0, 0], "not finite")
        self.check([np.inf, -np.inf, 0], [1.0, 0, 0], "not finite")

    def test_origin_that_is_too_far(self):
        """Its square overflows, and it would miss."""
        for far in (1e100, -1e150, 1e154, 1e300):
            for i in range(3):
                p = [0.0, 0, 0]
                p[i] = far
                self.check(p, -np.sign(p), r"not nearer than 1e\+100 m")

    def test_unit_vector_but_for_rounding(self):
        """It is made one, so the distance is in metres."""
        for length in (1.0 - 5e-7, 1.0 + 5e-7):
            distance, _ = self.dut.cast(
                self.query_object, [[-1.0, 0, 0]], [[length, 0, 0]]
            )
            self.assertAlmostEqual(distance[0], 0.9, delta=1e-15)

    def test_arrays_that_are_no_rays(self):
        p, n = [[0.0, 0, 0]], [[1.0, 0, 0]]
        for args, message in (
            ((p, n * 2), "not both"),
            ((p[0], n[0]), "not both"),
            (([[0.0, 0]], [[1.0, 0]]), "not both"),
            ((p, n, np.nan), "max_range"),
            ((p, n, -1.0), "max_range"),
            (([[0j, 0, 0]], n), "p_WR: complex128 are not real numbers"),
            ((p, np.array(n) + 0j), "n_WR: complex128 are not real"),
            ((np.ma.masked_array(p, True), n), "p_WR: a masked array"),
            ((p, np.ma.masked_array(n)), "n_WR: a masked array"),
            (([np.ma.masked_array(p[0], True)], n), "p_WR: a masked array"),
            ((p, (np.ma.masked_array(n[0]),)), "n_WR: a masked array"),
            (([[0.0, 0, np.ma.masked_array(0, True)]], n), "p_WR: a masked"),
            (([["0", "0", "0"]], n), "p_WR: .* are not real numbers"),
            (([[0.0, 0], [0.0]], n), "inhomogeneous"),
        ):
            with (
                self.subTest(args=args),
                self.assertRaisesRegex(ValueError, message),
            ):
                self.dut.cast(self.query_object, *args)

    def test_no_rays(self):
        distance, index = self.dut.cast(
            self.query_object, np.empty((0, 3)), np.empty((0, 3))
        )
        self.assertEqual((distance.shape, index.shape), ((0,), (0,)))


if __name__ == "__main__":
    unittest.main()
