"""Faces of more than three corners."""

import unittest

import numpy as np
from pydrake.geometry import Mesh
import ray_oracle as oracle
from solids import CUBE_QUADS, CUBE_VERTICES, make_mesh, write_obj

from tofssm_drake.errors import UserError
import tofssm_drake.raycast.polygons as mut
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.raycast.triangle_mesh import read_mesh


def calc_areas(vertices, faces):
    """Returns the signed area of each triangle as seen from above."""
    a, b, c = (vertices[faces[:, i], :2] for i in range(3))
    u, v = b - a, c - a
    return 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def calc_polygon_area(points):
    x, y = np.asarray(points, float)[:, :2].T
    return 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()


def is_in_polygon(points, p):
    """Even-odd rule, written independently."""
    inside = np.zeros(len(p), dtype=bool)
    for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
        crosses = (a[1] > p[:, 1]) != (b[1] > p[:, 1])
        with np.errstate(all="ignore"):
            x = a[0] + (p[:, 1] - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
        inside ^= crosses & (p[:, 0] < x)
    return inside


PENTAGON = [[0, 0], [1, 0], [1.3, 1], [0.5, 1.7], [-0.3, 1]]
DENT = [[0, 0], [2, 0], [2, 2], [1, 0.5], [0, 2]]
ARROW = [[0, 0], [1, 0.2], [2, 0], [1, 2]]
COMB = [
    *([0, 0], [5, 0], [5, 3], [4, 3], [4, 1], [3, 1], [3, 3], [2, 3]),
    *([2, 1], [1, 1], [1, 3], [0, 3]),
]
# Two corners in the middle of sides.
STRAIGHT = [[0, 0], [1, 0], [2, 0], [2, 2], [1, 2], [0, 2]]


class TestCutPolygons(unittest.TestCase):
    def setUp(self):
        self.rng = np.random.default_rng(3)

    def check(self, outline):
        """All that is inside is covered once, and nothing else is."""
        outline = np.asarray(outline, dtype=float)
        for points in (outline, outline[::-1]):
            for start in range(len(points)):
                vertices = np.column_stack(
                    [np.roll(points, start, axis=0), np.zeros(len(points))]
                )
                faces = mut.cut_polygons(
                    vertices, np.arange(len(points)), np.array([len(points)])
                )
                self.assertEqual(faces.shape, (len(points) - 2, 3))
                areas = calc_areas(vertices, faces)
                total = calc_polygon_area(vertices)
                self.assertTrue((areas * np.sign(total) >= 0.0).all())
                self.assertAlmostEqual(areas.sum(), total)

    def test_outlines(self):
        for outline in (PENTAGON, DENT, ARROW, COMB, STRAIGHT, PENTAGON[:4]):
            self.check(outline)

    def test_random_stars(self):
        for count in (4, 5, 7, 12, 40):
            for _ in range(10):
                angle = 2.0 * np.pi * np.arange(count) / count
                radius = self.rng.uniform(0.2, 1.0, count)
                self.check(
                    np.column_stack(
                        [radius * np.cos(angle), radius * np.sin(angle)]
                    )
                )

    def test_shorter_diagonal(self):
        for corners, expected in (
            ([0, 1, 2, 3], [[1, 2, 3], [1, 3, 0]]),
            ([1, 2, 3, 0], [[1, 2, 3], [1, 3, 0]]),
        ):
            vertices = np.array([[0, 0, 0], [2, 0, 0], [3, 1, 0], [1, 1, 0.0]])
            faces = mut.cut_polygons(vertices, corners, [4])
            np.testing.assert_array_equal(faces, expected)

    def test_outlines_without_area_end(self):
        for outline in (
            np.zeros((6, 3)),
            np.column_stack([np.arange(6.0), np.zeros((6, 2))]),
            # It crosses itself.
            [[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0], [0.5, 2, 0]],
        ):
            count = len(outline)
            faces = mut.cut_polygons(
                np.asarray(outline), np.arange(count), [count]
            )
            self.assertEqual(faces.shape, (count - 2, 3))

    def test_none(self):
        faces = mut.cut_polygons(np.eye(3), np.empty(0), np.empty(0))
        self.assertEqual(faces.shape, (0, 3))


class TestObjFaces(unittest.TestCase):
    def cast_down(self, shape, p, X=None):
        scene = oracle.Scene()
        scene.add(shape, X)
        dut = RayCaster(scene.inspector)
        n = np.tile([0.0, 0.0, -1.0], (len(p), 1))
        if X is not None:
            p, n = (X @ p.T).T, (X.rotation().matrix() @ n.T).T
        return dut.cast(scene.query_object(), p, n)[0]

    def test_rays_see_the_whole_face_and_nothing_else(self):
        """Drake's reader makes one triangle of the pentagon."""
        rng = np.random.default_rng(4)
        for outline in (PENTAGON, DENT, ARROW, COMB):
            points = np.column_stack([outline, np.zeros(len(outline))])
            mesh = make_mesh(write_obj(points, [np.arange(len(outline))]))
            p = rng.uniform(-1, 6, (4000, 3))
            p[:, 2] = 1.0
            for X in (None, oracle.make_random_pose(rng)):
                distance = self.cast_down(mesh, p, X)
                inside = is_in_polygon(points, p)
                self.assertGreater(inside.sum(), 100)
                np.testing.assert_array_equal(np.isfinite(distance), inside)
                np.testing.assert_allclose(distance[inside], 1.0, atol=1e-12)

    def test_prism_with_a_dent_has_an_inside(self):
        n = len(DENT)
        points = np.array([[*p, z] for z in (0.0, 1.0) for p in DENT])
        sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
        text = write_obj(points, [range(n), range(n, 2 * n), *sides])
        scene = oracle.Scene()
        scene.add(make_mesh(text))
        dut = RayCaster(scene.inspector)
        np.testing.assert_array_equal(dut.has_inside, [True])
        p = np.random.default_rng(5).uniform(-0.5, 2.5, (2000, 3))
        p[:, 2] = 0.5
        distance, _ = dut.cast(
            scene.query_object(), p, np.tile([0.6, 0.0, 0.8], (2000, 1))
        )
        np.testing.assert_array_equal(
            distance == 0.0, is_in_polygon(np.array(DENT), p)
        )

    def test_relative_indices_count_from_their_line(self):
        text = (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 5\nf -1/7/2 2//1 1/1"
        )
        triangles = read_mesh(make_mesh(text), "it").surface.triangles
        expected = [[0, 0, 0, 1, 0, 0, 0, 1, 0], [0, 0, 5, 1, 0, 0, 0, 0, 0]]
        self.assertEqual(
            sorted(triangles.tolist()),
            sorted(np.array(expected, float).tolist()),
        )

    def test_numbers_are_read_to_the_last_digit(self):
        points = np.random.default_rng(6).normal(size=(3, 3))
        mesh = read_mesh(make_mesh(write_obj(points, [[0, 1, 2]])), "it")
        np.testing.assert_array_equal(
            mesh.surface.triangles[0], points.reshape(-1)
        )

    def test_faces_that_are_none_are_named(self):
        vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
        for bad in (
            "f 1 2 99999999999",
            "f 1 2 99999999999999999999",
            "f 1 2 4",
            "f 0 1 2",
            "f 1 2 -4",
            "f 1 2",
            "f",
            "f 1 2 x",
            "f 1 2 1.5",
            "f 1 2 /3",
            "f 1 2 1-2",
        ):
            text = vertices + "f 1 2 3\n" + bad + "\nf 3 2 1\n"
            with (
                self.subTest(bad=bad),
                self.assertRaisesRegex(
                    UserError,
                    "^geometry 'horn': mesh 'memory' cannot be read: line 5:"
                    f" '{bad}' is not a face of at least three of the 3",
                ),
            ):
                read_mesh(make_mesh(text), "horn")

    def test_a_device_is_not_read(self):
        with self.assertRaisesRegex(UserError, "horn.*'/dev/zero.obj' cannot"):
            read_mesh(Mesh("/dev/zero.obj"), "horn")

    def test_cube_of_quadrangles(self):
        mesh = read_mesh(make_mesh(write_obj(CUBE_VERTICES, CUBE_QUADS)), "it")
        self.assertEqual(len(mesh.surface.triangles), 12)
        self.assertIs(mesh.solid, mesh.surface)


if __name__ == "__main__":
    unittest.main()
