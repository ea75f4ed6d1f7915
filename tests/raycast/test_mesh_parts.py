import unittest

import numpy as np
import ray_oracle as oracle
from solids import CUBE_FACES, CUBE_VERTICES, make_mesh, make_torus, write_obj

from tofssm_drake.raycast.mesh_parts import orient_faces
from tofssm_drake.raycast.ray_caster import RayCaster


def calc_volume(vertices, faces):
    """Returns the volume that triangles enclose, turned out."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return (a * np.cross(b, c)).sum() / 6.0


def join(*meshes):
    """Returns (vertices, faces) of several meshes in one."""
    count, vertices, faces = 0, [], []
    for v, f in meshes:
        vertices.append(v)
        faces.append(np.add(f, count))
        count += len(v)
    return np.vstack(vertices), np.vstack(faces)


def cube(centre=(0, 0, 0), size=1.0, *, inside_out=False):
    faces = CUBE_FACES[:, ::-1] if inside_out else CUBE_FACES
    return size * CUBE_VERTICES + centre, faces


def turn_over(faces, rows):
    faces = faces.copy()
    faces[rows] = faces[rows, ::-1]
    return faces


def find_inside(vertices, faces, p):
    """Returns whether a ray from each point has distance 0."""
    scene = oracle.Scene()
    scene.add(make_mesh(write_obj(vertices, faces)))
    dut = RayCaster(scene.inspector)
    n = np.tile([[0.6, 0.0, 0.8]], (len(p), 1))
    return dut.cast(scene.query_object(), p, n)[0] == 0.0


class TestOrientFaces(unittest.TestCase):
    def setUp(self):
        self.rng = np.random.default_rng(12)

    def check_all_solid(self, vertices, faces, volume):
        oriented, is_solid, _ = orient_faces(vertices, faces)
        self.assertTrue(is_solid.all())
        self.assertAlmostEqual(calc_volume(vertices, oriented), volume)
        # The same triangles in the same order.
        np.testing.assert_array_equal(
            np.sort(oriented, axis=1), np.sort(faces, axis=1)
        )

    def test_good_mesh_stays_as_it_is(self):
        for vertices, faces in (cube(), make_torus()):
            if calc_volume(vertices, faces) < 0.0:
                faces = faces[:, ::-1]
            oriented, is_solid, _ = orient_faces(vertices, faces)
            np.testing.assert_array_equal(oriented, faces)
            self.assertTrue(is_solid.all())

    def test_any_triangles_turned_over(self):
        vertices, faces = cube()
        for count in range(13):
            rows = self.rng.permutation(12)[:count]
            self.check_all_solid(vertices, turn_over(faces, rows), 1.0)

    def test_vertices_of_each_face_by_itself(self):
        vertices, faces = cube()
        apart = vertices[faces].reshape(-1, 3)
        faces = turn_over(np.arange(36).reshape(-1, 3), [0, 5, 6])
        self.check_all_solid(apart, faces, 1.0)

    def test_parts_inside_out(self):
        for second in (cube([2, 0, 0]), cube([0.5, 0.2, 0.1])):
            self.check_all_solid(*join(cube(inside_out=True), second), 2.0)

    def test_hollows(self):
        """What runs against the part around it is one, whichever way the
        part itself runs; also in a solid in a hollow."""
        for turned in (False, True):
            for flipped in ([], [1, 13, 25]):
                vertices, faces = join(
                    cube(inside_out=turned),
                    cube(size=0.6, inside_out=not turned),
                    cube(size=0.2, inside_out=turned),
                    cube([3, 0, 0], inside_out=not turned),
                )
                faces = turn_over(faces, flipped)
                self.check_all_solid(
                    vertices, faces, 1.0 - 0.6**3 + 0.2**3 + 1.0
                )

    def test_part_in_another_one_that_runs_likewise(self):
        self.check_all_solid(*join(cube(), cube(size=0.5)), 1.125)

    def test_stray_triangles_bound_nothing(self):
        stray = np.array([[0, 0, 0], [1, 0, 0], [0, 3, 0.0]]), [[0, 1, 2]]
        vertices, faces = join(cube(), stray)
        oriented, is_solid, _ = orient_faces(vertices, faces)
        np.testing.assert_array_equal(is_solid, [True] * 12 + [False])
        np.testing.assert_array_equal(oriented, faces)
        # A fin: one edge has three triangles.
        vertices = np.vstack([CUBE_VERTICES, [[2.0, 2.0, 2.0]]])
        faces = np.vstack(
            [turn_over(CUBE_FACES, [2]), [[*CUBE_FACES[4, :2], 8]]]
        )
        oriented, is_solid, _ = orient_faces(vertices, faces)
        np.testing.assert_array_equal(is_solid, [True] * 12 + [False])
        self.assertAlmostEqual(calc_volume(vertices, oriented[:12]), 1.0)

    def test_triangles_that_are_lines_do_no_harm(self):
        faces = np.vstack([CUBE_FACES, [[0, 1, 1], [2, 2, 2]]])
        self.assertTrue(orient_faces(CUBE_VERTICES, faces)[1].all())
        self.assertFalse(orient_faces(np.eye(3), faces[-2:] * 0)[1].any())

    def test_open_surfaces_bound_nothing(self):
        for faces in (CUBE_FACES[1:], CUBE_FACES[:1]):
            oriented, is_solid, _ = orient_faces(CUBE_VERTICES, faces)
            np.testing.assert_array_equal(oriented, faces)
            self.assertFalse(is_solid.any())

    def test_surface_with_one_side_bounds_nothing(self):
        """Five triangles around a Moebius strip."""
        angle = 0.4 * np.pi * np.arange(5)
        vertices = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        vertices[:, 2] = self.rng.uniform(-0.1, 0.1, 5)
        faces = np.array([[i, (i + 1) % 5, (i + 2) % 5] for i in range(5)])
        self.assertFalse(orient_faces(vertices, faces)[1].any())

    def test_cubes_that_share_a_face(self):
        """Each edge of it has four triangles: closed as the cubes run, but
        if one of them is turned over there, that is ambiguous."""
        vertices, faces = join(cube(), cube([1, 0, 0]))
        self.check_all_solid(vertices, faces, 2.0)
        inside = find_inside(
            vertices, faces, [[0.1, 0, 0.2], [0.9, 0, 0.2], [1.6, 0, 0.2]]
        )
        np.testing.assert_array_equal(inside, [True, True, False])
        shared = np.flatnonzero((vertices[faces][:, :, 0] == 0.5).all(axis=1))
        self.assertEqual(len(shared), 4)
        _, is_solid, _ = orient_faces(vertices, turn_over(faces, shared[:1]))
        self.assertFalse(is_solid.any())

    def test_cubes_that_share_an_edge_or_corner(self):
        for centre in ([1, 1, 0], [1, 1, 1]):
            vertices, faces = join(cube(), cube(centre, inside_out=True))
            self.check_all_solid(vertices, turn_over(faces, [3, 17, 18]), 2.0)

    def test_inside_as_rays_see_it(self):
        """Of shuffled, turned triangles of overlapping parts with a fin."""
        vertices, faces = join(
            cube(),
            cube([0.7, 0, 0], inside_out=True),
            (
                np.array([[0, 0, 0], [0, 0, 3], [3, 0, 3.0]]),
                np.array([[0, 1, 2]]),
            ),
        )
        faces = turn_over(faces, [0, 14])[self.rng.permutation(len(faces))]
        p = self.rng.uniform(-1.5, 1.5, (3000, 3))
        want = (np.abs(p) < 0.5).all(axis=1) | (
            np.abs(p - [0.7, 0, 0]) < 0.5
        ).all(axis=1)
        np.testing.assert_array_equal(find_inside(vertices, faces, p), want)
        self.assertGreater(want.sum(), 100)

    def check_inside(self, vertices, faces, want, p):
        np.testing.assert_array_equal(find_inside(vertices, faces, p), want)

    def test_corners_that_differ_by_rounding(self):
        """Each face with corners of its own, as exporters write them."""
        vertices, faces = cube([0.3, 0.2, 0.1])
        p = self.rng.uniform(-0.5, 1.0, (2000, 3))
        want = (np.abs(p - [0.3, 0.2, 0.1]) < 0.5).all(axis=1)
        self.assertGreater(want.sum(), 100)
        for size in (1e-15, 1e-12, 1e-9, 1e-7):
            apart = vertices[faces].reshape(-1, 3)
            apart = apart + size * self.rng.uniform(-1, 1, apart.shape)
            faces_apart = turn_over(np.arange(36).reshape(-1, 3), [0, 5, 6])
            oriented, is_solid, welded = orient_faces(apart, faces_apart)
            self.assertTrue(is_solid.all())
            self.assertAlmostEqual(calc_volume(welded, oriented), 1.0, 5)
            self.assertLess(np.abs(welded - apart).max(), 4e-6)
            self.check_inside(apart, faces_apart, want, p)

    def test_a_real_gap_is_not_closed(self):
        apart = cube()[0][CUBE_FACES].reshape(-1, 3) * (1 + 1e-12)
        apart[:6] += [1e-3, 0, 0]
        _, is_solid, _ = orient_faces(apart, np.arange(36).reshape(-1, 3))
        self.assertFalse(is_solid.any())

    def test_faces_that_are_there_twice(self):
        p = self.rng.uniform(-1, 1, (1000, 3))
        want = (np.abs(p) < 0.5).all(axis=1)
        vertices, faces = cube()
        for more in (
            faces[3:4],
            faces[3:4, ::-1],
            faces[[3, 3, 7]][:, [1, 2, 0]],
            # A double layer, and one that is turned over, too.
            faces,
            faces[:, ::-1],
        ):
            both = np.vstack([faces, more])
            oriented, is_solid, _ = orient_faces(vertices, both)
            self.assertTrue(is_solid[:12].all())
            self.assertAlmostEqual(calc_volume(vertices, oriented[:12]), 1.0)
            self.check_inside(vertices, both, want, p)
        # The second one by vertices of its own, that are not quite there.
        both = join((vertices, faces), (vertices * (1 + 1e-9), faces[3:4]))
        self.check_inside(*both, want, p)


if __name__ == "__main__":
    unittest.main()
