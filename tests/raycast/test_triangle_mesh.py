import base64
import json
from pathlib import Path
import tempfile
import unittest

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import Box, Convex, InMemoryMesh, Mesh, Role, Sphere
from pydrake.math import RigidTransform
import ray_oracle as oracle
from solids import (
    CUBE_FACES,
    CUBE_QUADS,
    CUBE_VERTICES,
    find_hull_planes,
    make_mesh,
    make_torus,
    write_obj,
)
import trimesh

from tofssm_drake.errors import UserError
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster
import tofssm_drake.raycast.triangle_mesh as mut


def cast(shape, p, n, max_range=np.inf, X=None):
    scene = oracle.Scene()
    scene.add(shape, X)
    dut = RayCaster(scene.inspector)
    return dut.cast(scene.query_object(), p, n, max_range)[0]


def make_rays(rng, count, spread=1.0):
    return (
        rng.uniform(-spread, spread, (count, 3)),
        oracle.make_unit_vectors(rng, count),
    )


def brute_force(vertices, faces, p, n):
    """Nearest crossing with any triangle, by solving for barycentrics."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    best = np.full(len(p), np.inf)
    for i in range(len(p)):
        A = np.stack([b - a, c - a, np.broadcast_to(-n[i], a.shape)], -1)
        good = np.abs(np.linalg.det(A)) > 1e-14
        x = np.linalg.solve(A[good], (p[i] - a[good])[..., None])[..., 0]
        hit = (x[:, :2] >= -1e-12).all(1) & (x[:, :2].sum(1) <= 1 + 1e-12)
        t = x[hit & (x[:, 2] >= 0), 2]
        best[i] = t.min(initial=np.inf)
    return best


def make_gltf(primitives, nodes, buffers):
    """A glTF file; primitives are (vertices, indices, mode)."""
    views, accessors, meshes, offset = [], [], [], 0
    data = b""
    for vertices, indices, mode in primitives:
        primitive = {"attributes": {"POSITION": len(accessors)}, "mode": mode}
        arrays = [np.asarray(vertices, np.float32)]
        if indices is not None:
            primitive["indices"] = len(accessors) + 1
            arrays.append(np.asarray(indices, np.uint16))
        for array in arrays:
            views.append(
                {
                    "buffer": 0,
                    "byteOffset": offset,
                    "byteLength": array.nbytes,
                }
            )
            accessors.append(
                {
                    "bufferView": len(views) - 1,
                    "componentType": 5126 if array.ndim == 2 else 5123,
                    "count": len(array),
                    "type": "VEC3" if array.ndim == 2 else "SCALAR",
                    "min": array.min(axis=0).tolist()
                    if array.ndim == 2
                    else [int(array.min())],
                    "max": array.max(axis=0).tolist()
                    if array.ndim == 2
                    else [int(array.max())],
                }
            )
            data += array.tobytes() + b"\0" * (-array.nbytes % 4)
            offset = len(data)
        meshes.append({"primitives": [primitive]})
    uri = buffers
    if uri is None:
        uri = (
            "data:application/octet-stream;base64,"
            + base64.b64encode(data).decode()
        )
    return (
        json.dumps(
            {
                "asset": {"version": "2.0"},
                "scene": 0,
                "scenes": [{"nodes": [0]}],
                "nodes": nodes,
                "meshes": meshes,
                "buffers": [{"byteLength": len(data), "uri": uri}],
                "bufferViews": views,
                "accessors": accessors,
            }
        ),
        data,
    )


def make_dae(vertices, faces, meter):
    """A COLLADA file whose node doubles and moves by (1, 2, 3)."""
    numbers = " ".join(f"{x:.17g}" for x in np.ravel(vertices))
    corners = " ".join(map(str, np.ravel(faces)))
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created>
<modified>2020-01-01T00:00:00</modified>
<unit name="u" meter="{meter}"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="positions"><float_array id="a" count="{3 * len(vertices)}">
{numbers}</float_array><technique_common>
<accessor source="#a" count="{len(vertices)}" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#positions"/></vertices>
<triangles count="{len(faces)}">
<input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n">
<translate>1 2 3</translate><scale>2 2 2</scale>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


VTK_POINTS = "0 0 0  1 0 0  0 1 0  0 0 1"


def make_vtk(cell="4 1 2 3 4", point="1 1 1"):
    """Two tetrahedra, the second one and its point as given."""
    return (
        "# vtk DataFile Version 3.0\nx\nASCII\n"
        "DATASET UNSTRUCTURED_GRID\n"
        f"POINTS 5 double\n{VTK_POINTS}  {point}\n"
        f"CELLS 2 10\n4 0 1 2 3\n{cell}\nCELL_TYPES 2\n10\n10\n"
    )


def make_vtk_5(cell):
    """The same as version 5 writes it."""
    return (
        "# vtk DataFile Version 5.1\nx\nASCII\n"
        "DATASET UNSTRUCTURED_GRID\n"
        f"POINTS 5 double\n{VTK_POINTS}  1 1 1\n"
        "CELLS 3 8\nOFFSETS vtktypeint64\n0 4 8\n"
        f"CONNECTIVITY vtktypeint64\n0 1 2 3 {' '.join(map(str, cell))}\n"
        "CELL_TYPES 2\n10\n10\n"
    )


def make_binary_vtk(corner):
    """One tetrahedron with a last corner as given."""
    points = np.array(VTK_POINTS.split(), dtype=">f8").tobytes()
    cell = np.array([4, 0, 1, 2, corner], dtype=">i4").tobytes()
    kind = np.array([10], dtype=">i4").tobytes()
    return (
        b"# vtk DataFile Version 3.0\nx\nBINARY\n"
        b"DATASET UNSTRUCTURED_GRID\nPOINTS 4 double\n" + points + b"\n"
        b"CELLS 1 5\n" + cell + b"\nCELL_TYPES 1\n" + kind + b"\n"
    )


def make_entities(first):
    """COLLADA with a name for a text or a file, and names for many of it."""
    names = f"<!ENTITY a0 {first}>" + "".join(
        f'<!ENTITY a{i} "{10 * f"&a{i - 1};"}">' for i in range(1, 11)
    )
    return (
        f'<?xml version="1.0"?>\n<!DOCTYPE x [{names}]>\n'
        "<COLLADA><asset>&a10;</asset></COLLADA>"
    )


def make_stl(vertices):
    """A cube in binary STL."""
    records = np.zeros(
        len(CUBE_FACES),
        dtype=[("n", "<f4", 3), ("v", "<f4", (3, 3)), ("", "<u2")],
    )
    records["v"] = vertices[CUBE_FACES]
    count = np.array(len(records), dtype="<u4").tobytes()
    return b"\0" * 80 + count + records.tobytes()


class TestMesh(unittest.TestCase):
    def test_cube_is_a_box(self):
        rng = np.random.default_rng(0)
        p, n = make_rays(rng, 20_000)
        X = oracle.make_random_pose(rng, 0.2)
        for scale in ((1.0, 1.0, 1.0), (0.5, 2.0, 1.0), (-1.0, 1.0, 0.7)):
            for kind in (Mesh, Convex):
                for faces in (CUBE_QUADS, CUBE_FACES):
                    with self.subTest(scale=scale, kind=kind):
                        mesh = make_mesh(
                            write_obj(CUBE_VERTICES, faces),
                            scale=scale,
                            kind=kind,
                        )
                        distance = cast(mesh, p, n, X=X)
                        want = cast(Box(*np.abs(scale)), p, n, X=X)
                        np.testing.assert_array_equal(
                            np.isfinite(distance), np.isfinite(want)
                        )
                        np.testing.assert_allclose(
                            distance, want, rtol=0, atol=1e-12
                        )
                        self.assertTrue((distance == 0).any())

    def test_torus_against_all_triangles(self):
        rng = np.random.default_rng(1)
        vertices, faces = make_torus()
        p, n = make_rays(rng, 3000)
        distance = cast(make_mesh(write_obj(vertices, faces)), p, n)
        inside = distance == 0
        want = brute_force(vertices, faces, p, n)
        np.testing.assert_allclose(
            distance[~inside], want[~inside], rtol=0, atol=1e-12
        )
        self.assertGreater(np.isfinite(want[~inside]).sum(), 300)

    def test_inside_and_surface_as_drake_sees_them(self):
        rng = np.random.default_rng(2)
        scene = oracle.Scene(Role.kProximity)
        for _ in range(2):
            scene.add(
                make_mesh(write_obj(*make_torus()), scale=(1, 1, 1.5)),
                oracle.make_random_pose(rng, 0.3),
                scene.add_frame(oracle.make_random_pose(rng, 0.3)),
            )
        dut = RayCaster(scene.inspector, role=Role.kProximity)
        query_object = scene.query_object()
        p, n = make_rays(rng, 1500)
        distance, index = dut.cast(query_object, p, n)
        inside = 0
        for i in range(len(p)):
            signed = min(
                r.distance
                for r in query_object.ComputeSignedDistanceToPoint(p[i])
            )
            self.assertEqual(signed < 0, distance[i] == 0)
            inside += signed < 0
            if 0 < distance[i] < np.inf:
                at_hit = {
                    r.id_G: r.distance
                    for r in query_object.ComputeSignedDistanceToPoint(
                        p[i] + distance[i] * n[i]
                    )
                }
                hit_id = dut.geometry_ids[index[i]]
                self.assertLess(abs(at_hit[hit_id]), 1e-9)
        self.assertGreater(inside, 50)

    def test_inner_shell_turned_in_leaves_a_hollow(self):
        vertices = np.vstack([CUBE_VERTICES, 0.5 * CUBE_VERTICES])
        faces = np.vstack([CUBE_FACES, CUBE_FACES[:, ::-1] + 8])
        mesh = make_mesh(write_obj(vertices, faces))
        n = [[1.0, 0, 0]]
        self.assertEqual(cast(mesh, [[0.4, 0.01, 0.02]], n)[0], 0.0)
        self.assertAlmostEqual(cast(mesh, [[0, 0.01, 0.02]], n)[0], 0.25)

    def test_inside_out_mesh_has_the_same_inside(self):
        mesh = make_mesh(write_obj(CUBE_VERTICES, CUBE_FACES[:, ::-1]))
        n = [[1.0, 0, 0]]
        self.assertEqual(cast(mesh, [[0.1, 0.01, 0.02]], n)[0], 0.0)
        self.assertAlmostEqual(cast(mesh, [[-2, 0.01, 0.02]], n)[0], 1.5)

    def test_open_surface_is_seen_from_both_sides_and_has_no_inside(self):
        mesh = make_mesh(write_obj(CUBE_VERTICES, CUBE_QUADS[1:]))
        for p, n, expected in (
            ([2, 0.1, 0.2], [-1.0, 0, 0], 1.5),
            ([0, 0.1, 0.2], [1.0, 0, 0], 0.5),
            ([0, 0.1, 0.2], [-1.0, 0, 0], np.inf),
            ([-2, 0.1, 0.2], [1.0, 0, 0], 2.5),
        ):
            self.assertAlmostEqual(cast(mesh, [p], [n])[0], expected)

    def test_no_ray_slips_through_between_triangles(self):
        """Rays at every vertex and along every edge of a closed surface."""
        vertices, faces = make_torus(12)
        rng = np.random.default_rng(3)
        edge = rng.uniform(size=(len(faces), 1))
        targets = np.vstack(
            [
                vertices,
                edge * vertices[faces[:, 0]]
                + (1 - edge) * vertices[faces[:, 1]],
                edge * vertices[faces[:, 0]]
                + (1 - edge) * vertices[faces[:, 2]],
            ]
        )
        # From within the tube: every direction is blocked.
        ring = targets * [1, 1, 0]
        p = 0.5 * ring / np.linalg.norm(ring, axis=1, keepdims=True)
        n = targets - p
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        # One triangle taken away, so that it has no inside.
        far = np.linalg.norm(vertices[faces].mean(1) - [0.7, 0, 0], axis=1)
        faces = np.delete(faces, np.argmin(far), axis=0)
        keep = np.linalg.norm(targets - [0.7, 0, 0], axis=1) > 0.3
        distance = cast(make_mesh(write_obj(vertices, faces)), p[keep], n[keep])
        self.assertTrue((distance > 0).all())
        self.assertLess(distance.max(), 0.6)

    def test_rays_along_axes_and_faces(self):
        mesh = make_mesh(write_obj(CUBE_VERTICES, CUBE_FACES), scale=(2, 2, 2))
        for p, n, expected in (
            ([-3, 0, 0], [1.0, 0, 0], 2.0),  # Through a diagonal edge.
            ([0, -3, 0], [0, 1.0, 0], 2.0),
            ([0, 0, 3], [0, 0, -1.0], 2.0),
            ([-3, 1, 0], [1.0, 0, 0], 2.0),  # Along a face.
            ([-3, 1, 1], [1.0, 0, 0], 2.0),  # Along an edge.
            ([-3, 0, 1.001], [1.0, 0, -0.0], np.inf),
            ([-2, -2, -2], np.full(3, 3**-0.5), 3**0.5),  # Into a corner.
        ):
            with self.subTest(p=p, n=n):
                self.assertAlmostEqual(
                    cast(mesh, [p], [n])[0], expected, delta=1e-14
                )

    def test_fans_see_the_same_as_single_rays(self):
        rng = np.random.default_rng(4)
        scene = oracle.Scene()
        for i in range(6):
            scene.add(
                make_mesh(
                    write_obj(*make_torus()),
                    scale=(0.5, 0.5, 0.5),
                    kind=Convex if i % 2 else Mesh,
                ),
                oracle.make_random_pose(rng),
                scene.add_frame(oracle.make_random_pose(rng, 0.1)),
            )
        scene.add(Sphere(0.2))
        dut = RayCaster(scene.inspector)
        X_WF = dut.poses_from_query_object(scene.query_object())
        bundles = dut.make_bundles(
            frame_id=scene.frame_ids[0],
            X_FS=[oracle.make_random_pose(rng) for _ in range(100)],
            fan_S=make_cone_fan(np.deg2rad(40), 50),
            max_range=1.5,
        )
        distance, index = dut.cast_bundles(bundles, X_WF)
        p_WR, n_WR = dut.calc_rays(bundles, X_WF)
        want, want_index = dut.cast(
            X_WF, p_WR.reshape(-1, 3), n_WR.reshape(-1, 3), 1.5
        )
        np.testing.assert_allclose(distance.ravel(), want, rtol=0, atol=1e-12)
        differ = index.ravel() != want_index
        self.assertTrue((want[differ] == 0).all())
        self.assertGreater(np.isfinite(want).mean(), 0.1)
        self.assertTrue((want == 0).any())

    def test_normals_face_the_ray(self):
        rng = np.random.default_rng(6)
        p, n = make_rays(rng, 500)
        X = oracle.make_random_pose(rng, 0.2)
        closed = write_obj(CUBE_VERTICES, CUBE_QUADS)
        # Turned at random: an open soup of triangles.
        soup = CUBE_FACES.copy()
        soup[::3] = soup[::3, ::-1]
        normals = []
        for shape in (
            Box(1, 1, 1),
            make_mesh(closed),
            make_mesh(closed, kind=Convex),
            make_mesh(write_obj(CUBE_VERTICES, soup)),
        ):
            scene = oracle.Scene()
            scene.add(shape, X)
            dut = RayCaster(scene.inspector)
            X_WF = dut.poses_from_query_object(scene.query_object())
            outside = np.abs(X.inverse() @ p.T).max(axis=0) > 0.5
            rays = p[outside], n[outside]
            hits = dut.cast(X_WF, *rays)
            normals.append(dut.calc_normals(X_WF, *rays, *hits))
        self.assertGreater(np.isfinite(normals[0]).all(axis=1).sum(), 50)
        for other in normals[1:]:
            np.testing.assert_allclose(other, normals[0], atol=1e-12)

    def test_changed_mesh_is_noticed(self):
        scene = oracle.Scene()
        text = write_obj(CUBE_VERTICES, CUBE_QUADS)
        changed = scene.add(make_mesh(text))
        dut = RayCaster(scene.inspector)
        dut.check_geometry(scene.query_object().inspector())
        for shape in (make_mesh(text, scale=(1, 1, 2)), make_mesh(text + "\n")):
            scene.scene_graph.ChangeShape(
                scene.context, scene.source_id, changed, shape
            )
            with self.assertRaisesRegex(RuntimeError, "shape_0' was changed"):
                dut.check_geometry(scene.query_object().inspector())

    def test_geometries_of_one_file_share_it(self):
        scene = oracle.Scene()
        mesh = make_mesh(write_obj(CUBE_VERTICES, CUBE_FACES))
        for i in range(3):
            scene.add(mesh, RigidTransform([2.0 * i, 0, 0]))
        dut = RayCaster(scene.inspector)
        self.assertEqual(len(dut._scene[-1][-1]), 12)
        distance, index = dut.cast(
            scene.query_object(),
            [[0.1, 0.2, 9], [2.1, 0.2, 9], [4.1, 0.2, 9]],
            [[0.0, 0, -1]] * 3,
        )
        np.testing.assert_allclose(distance, 8.5)
        self.assertEqual(len(set(index)), 3)


class TestConvex(unittest.TestCase):
    def test_against_the_planes_of_another_hull(self):
        rng = np.random.default_rng(5)
        points = oracle.make_unit_vectors(rng, 24) * [0.5, 0.3, 0.7]
        planes = find_hull_planes(points)
        self.assertEqual(len(planes), 2 * 24 - 4)
        shape = make_mesh(write_obj(points, [[0, 1, 2]]), kind=Convex)
        p, n = make_rays(rng, 20_000)
        slope = n @ planes[:, :3].T
        gap = p @ planes[:, :3].T - planes[:, 3]
        t = -gap / slope
        enter = np.where(slope < 0, t, -np.inf).max(1).clip(0)
        leave = np.where(slope > 0, t, np.inf).min(1)
        want = np.where(enter <= leave, enter, np.inf)
        distance = cast(shape, p, n)
        same = np.isfinite(distance) == np.isfinite(want)
        self.assertLess((~same).sum(), 3)  # Grazing an edge.
        steep = same & np.isfinite(want)
        np.testing.assert_allclose(
            distance[steep], want[steep], rtol=0, atol=1e-12
        )
        self.assertTrue((want == 0).any())

    def test_a_mesh_is_not_its_hull(self):
        text = write_obj(*make_torus(64))
        p, n = [[0.0, 0, 2]], [[0.0, 0, -1]]
        self.assertEqual(cast(make_mesh(text), p, n)[0], np.inf)
        self.assertAlmostEqual(cast(make_mesh(text, kind=Convex), p, n)[0], 1.8)


class TestReadMesh(unittest.TestCase):
    def setUp(self):
        self.vertices, self.faces = make_torus(10)
        # glTF has single precision.
        self.vertices = self.vertices.astype(np.float32).astype(float)

    def check_same(self, mesh, vertices, faces):
        actual = mut.read_mesh(mesh, "it").surface.triangles
        expected = np.asarray(vertices)[faces].reshape(-1, 9)
        self.assertEqual(len(actual), len(expected))
        sorted_actual = actual[np.lexsort(actual.T)]
        sorted_expected = expected[np.lexsort(expected.T)]
        np.testing.assert_allclose(sorted_actual, sorted_expected, atol=1e-7)

    def test_obj_file_and_memory(self):
        text = write_obj(self.vertices, self.faces)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "torus.obj"
            path.write_text(text)
            file = mut.read_mesh(Mesh(path, np.array([1.0, 2, 3])), "it")
        memory = mut.read_mesh(make_mesh(text, scale=(1, 2, 3)), "it")
        np.testing.assert_array_equal(
            file.surface.triangles, memory.surface.triangles
        )
        self.check_same(make_mesh(text), self.vertices, self.faces)

    def test_gltf_is_turned_and_scaled_as_drake_does(self):
        angle = 0.3
        nodes = [
            {"children": [1, 2], "translation": [1, 2, 3]},
            {
                "mesh": 0,
                "rotation": [0, np.sin(angle), 0, np.cos(angle)],
                "scale": [1, 2, 0.5],
            },
            {
                "mesh": 0,
                "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1],
            },
        ]
        text, _ = make_gltf(
            [(self.vertices, self.faces.ravel(), 4)], nodes, None
        )
        shape = make_mesh(text, ".gltf", scale=(1, 2, 3))
        triangles = mut.read_mesh(shape, "it").surface.triangles
        self.assertEqual(len(triangles), 2 * len(self.faces))
        hull = shape.GetConvexHull()
        own = triangles.reshape(-1, 3)
        drake = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        gap = np.linalg.norm(drake[:, None] - own, axis=2).min(axis=1)
        self.assertLess(gap.max(), 1e-4)
        np.testing.assert_allclose(own.min(0), drake.min(0), atol=1e-4)
        np.testing.assert_allclose(own.max(0), drake.max(0), atol=1e-4)

    def test_gltf_buffers_in_memory_and_in_files(self):
        text, data = make_gltf(
            [(self.vertices, self.faces.ravel(), 4)], [{"mesh": 0}], "a b.bin"
        )
        expected = np.column_stack(
            [self.vertices[:, 0], -self.vertices[:, 2], self.vertices[:, 1]]
        )
        shape = Mesh(
            InMemoryMesh(
                mesh_file=MemoryFile(text, ".gltf", "memory"),
                supporting_files={"a b.bin": MemoryFile(data, ".bin", "b")},
            )
        )
        self.check_same(shape, expected, self.faces)
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "a b.bin").write_bytes(data)
            path = Path(folder) / "torus.gltf"
            path.write_text(text.replace("a b.bin", "a%20b.bin"))
            self.check_same(Mesh(path), expected, self.faces)
            shape = Mesh(
                InMemoryMesh(
                    mesh_file=MemoryFile(text, ".gltf", "memory"),
                    supporting_files={"a b.bin": Path(folder) / "a b.bin"},
                )
            )
            self.check_same(shape, expected, self.faces)

    def test_gltf_strips_fans_and_plain_lists(self):
        v = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 1.0]])
        for mode, indices, faces in (
            (4, None, [[0, 1, 2]]),
            (4, [3, 4, 0, 2, 1, 0], [[3, 4, 0], [2, 1, 0]]),
            (5, [0, 1, 2, 3, 4], [[0, 1, 2], [3, 2, 1], [2, 3, 4]]),
            (6, [0, 1, 2, 3, 4], [[0, 1, 2], [0, 2, 3], [0, 3, 4]]),
        ):
            with self.subTest(mode=mode):
                text, _ = make_gltf(
                    [(v if indices else v[:3], indices, mode), (v, [0, 1], 1)],
                    [{"mesh": 0, "children": [1]}, {"mesh": 1}],
                    None,
                )
                self.check_same(
                    make_mesh(text, ".gltf"), v[:, [0, 2, 1]] * [1, -1, 1],
                    faces,
                )  # fmt: skip

    def test_gltf_with_a_mirrored_node(self):
        """The mirror turns nothing inside out: a cube in a cube fills it,
        unless its triangles run the other way."""
        inside_out = CUBE_FACES[:, ::-1]
        for mirror in (1.0, -1.0):
            for inner, expected in ((CUBE_FACES, 0.0), (inside_out, 0.25)):
                text, _ = make_gltf(
                    [
                        (CUBE_VERTICES, CUBE_FACES.ravel(), 4),
                        (CUBE_VERTICES, inner.ravel(), 4),
                    ],
                    [
                        {"mesh": 0, "children": [1]},
                        {"mesh": 1, "scale": [0.5, 0.5, 0.5 * mirror]},
                    ],
                    None,
                )
                mesh = make_mesh(text, ".gltf")
                n = [[1.0, 0, 0]]
                hit = cast(mesh, [[0, 0.01, 0.02], [0.4, 0.01, 0.02]], n * 2)
                np.testing.assert_allclose(hit, [expected, 0.0], atol=1e-15)

    def test_tetrahedra(self):
        mesh = mut.read_mesh(make_mesh(make_vtk(), ".vtk", (2, 2, 2)), "it")
        self.assertEqual(len(mesh.surface.triangles), 6)
        self.assertIs(mesh.solid, mesh.surface)
        self.assertEqual(mesh.surface.triangles.max(), 2.0)
        newer = mut.read_mesh(make_mesh(make_vtk_5([1, 2, 3, 4]), ".vtk"), "it")
        np.testing.assert_array_equal(
            2.0 * newer.surface.triangles, mesh.surface.triangles
        )

    def test_tetrahedra_with_bad_points_or_corners_are_named(self):
        for text, message in (
            (make_vtk("4 1 2 3 9"), "corner 9, which is not one of its 5 poi"),
            (make_vtk("4 1 2 3 5"), "corner 5, which is not one of its 5 poi"),
            (make_vtk("4 1 2 3 -1"), "corner -1, which is not one of its 5"),
            (make_vtk(point="nan 1 1"), "point 4 is not three finite numbers"),
            (make_vtk(point="1 1 -inf"), "point 4 is not three finite numbers"),
            (make_vtk(point="1 1"), "cannot be read"),
            (make_vtk(point="1 1 x"), "cannot be read"),
            (make_vtk_5([1, 2, 3, 5]), "corner 5, which is not one of its 5"),
            (make_vtk_5([1, 2, 3, -1]), "corner -1, which is not one of its 5"),
            (make_binary_vtk(9), "corner 9, which is not one of its 4 points"),
            (make_binary_vtk(-1), "corner -1, which is not one of its 4"),
        ):
            with (
                self.subTest(message=message),
                self.assertRaisesRegex(
                    UserError, f"geometry 'horn': mesh 'memory' .*{message}"
                ),
            ):
                mut.read_mesh(make_mesh(text, ".vtk"), "horn")
        mut.read_mesh(make_mesh(make_binary_vtk(3), ".vtk"), "horn")

    def test_files_of_tetrahedra_are_read_whole_or_not_at_all(self):
        """Drake's reader takes the memory for any number of items."""
        good, text = make_binary_vtk(3), make_vtk()
        for contents, message in (
            (good.replace(b"S 4", b"S 1000000000"), "byte 69: 1000000000 it"),
            (good.replace(b"S 4", b"S 40"), "byte 72: it ends too early, bef"),
            (good.replace(b"S 1 5", b"S 9 5"), "byte 183: cell 1 is not whole"),
            (good[:180], "byte 180: must be a number of items"),
            (good[:-9], "byte 206: must be CELL_TYPES, got 'cell_"),
            (good + b"POINTS 9", "byte 224: must end after the cells' types"),
            (good[:60], "byte 44: must be UNSTRUCTURED_GRID, got"),
            (b"x" + good, "line 1: it does not begin like a legacy VTK file"),
            (text.replace("S 5", "S 1000000000"), "line 5: 1000000000 items"),
            (text.replace("CELLS 2", "CELLS 3"), "line 7: cell 2 is not whole"),
            (text.replace("10\n10", "10"), "line 10: it ends too early"),
            (text + "CELL_DATA 2", "line 13: must end after the cells' types"),
            (text.replace("4 1 2", "3.5 1 2"), "line 9: '3.5' is not a num"),
            (
                make_vtk("3 1 2 4").replace("S 2 10", "S 2 9"),
                "a tetrahedron must have four corners",
            ),
            (make_vtk_5([1, 2]), "line 12: 'CELL_TYPES' is not a number"),
        ):
            with (
                self.subTest(message=message),
                self.assertRaisesRegex(
                    UserError, f"mesh 'memory' cannot be read: .*{message}"
                ),
            ):
                mut.read_mesh(make_mesh(contents, ".vtk"), "horn")

    def test_bad_vertices_and_corners_are_named(self):
        """In formats whose readers would drop or change them silently."""
        not_finite = CUBE_VERTICES.copy()
        not_finite[1, 0] = np.nan
        infinite = CUBE_VERTICES.copy()
        infinite[1, 0] = np.inf
        beyond, negative = CUBE_FACES.copy(), CUBE_FACES.copy()
        beyond[0, 0], negative[0, 0] = 8, -1
        gltf, _ = make_gltf(
            [(not_finite, CUBE_FACES.ravel(), 4)], [{"mesh": 0}], None
        )
        for text, extension, message in (
            (make_stl(not_finite), ".stl", "vertex that is not finite"),
            (make_stl(infinite), ".stl", "vertex that is not finite"),
            (gltf, ".gltf", "vertex that is not finite"),
            (make_dae(not_finite, CUBE_FACES, 1.0), ".dae", "not finite"),
            (make_dae(infinite, CUBE_FACES, 1.0), ".dae", "not finite"),
            (make_dae(CUBE_VERTICES, beyond, 1.0), ".dae", "maxindex=8"),
            (
                make_dae(CUBE_VERTICES, negative, 1.0),
                ".dae",
                "index -1 is not one of its 8 vertices",
            ),
        ):
            with (
                self.subTest(extension=extension, message=message),
                self.assertRaisesRegex(
                    UserError, f"geometry 'horn': mesh 'memory' .*{message}"
                ),
            ):
                mut.read_mesh(make_mesh(text, extension), "horn")

    def test_stl_binary_and_text(self):
        surface = trimesh.Trimesh(self.vertices, self.faces, process=False)
        for file_type in ("stl", "stl_ascii"):
            contents = surface.export(file_type=file_type)
            mesh = make_mesh(contents, ".STL", scale=(1, 2, 3))
            self.check_same(mesh, self.vertices * [1, 2, 3], self.faces)
            # Corners that are written once for each triangle are one.
            mesh = mut.read_mesh(mesh, "it")
            self.assertIs(mesh.solid, mesh.surface)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "torus.stl"
            surface.export(path)
            self.check_same(Mesh(path), self.vertices, self.faces)

    def test_collada_with_nodes_and_unit(self):
        """A node that moves and scales, in centimetres."""
        text = make_dae(self.vertices, self.faces, meter=0.01)
        expected = 0.01 * (2.0 * self.vertices + [1.0, 2.0, 3.0])
        self.check_same(make_mesh(text, ".dae"), expected, self.faces)

    def test_broken_stl_and_collada_are_named(self):
        good = make_dae(self.vertices, self.faces, meter=1.0)
        for text, extension, message in (
            ("solid x\nfacet", ".stl", "cannot be read"),
            ("", ".stl", "cannot be read"),
            ("\0" * 83, ".stl", "cannot be read"),
            (b"\xff" * 134, ".stl", ".*byte 80: 4294967295 triangles take"),
            (make_stl(CUBE_VERTICES)[:-50], ".stl", ".*byte 80: 12 triangles"),
            (make_stl(CUBE_VERTICES) + b"x", ".stl", ".*byte 80: 12 triangle"),
            (make_entities('"aaa"'), ".dae", ".*line 2: it has a DOCTYPE"),
            (make_entities('SYSTEM "/dev/zero"'), ".dae", ".*line 2: it has"),
            ("<COLLADA", ".dae", "cannot be read"),
            (good.replace("#positions", "#lost"), ".dae", "cannot be read"),
            (good[:-900], ".dae", "cannot be read"),
        ):
            with (
                self.subTest(text=text[:20]),
                self.assertRaisesRegex(
                    UserError, f"geometry 'horn': mesh 'memory' {message}"
                ),
            ):
                mut.read_mesh(make_mesh(text, extension), "horn")

    def test_unreadable_meshes_are_named(self):
        good, _ = make_gltf([(self.vertices, [0, 1, 2], 4)], [{"mesh": 0}], "x")
        dots, _ = make_gltf([(self.vertices, [0, 1], 0)], [{"mesh": 0}], None)
        needs = json.dumps({"extensionsRequired": ["KHR_draco"]})
        null = json.dumps(json.loads(dots) | {"buffers": None})
        circle = json.loads(dots) | {"nodes": [{"children": [0]}]}
        for shape, message in (
            (Mesh("/nowhere/none.obj"), "none.obj' cannot be read"),
            (Mesh("/nowhere/none.gltf"), "none.gltf' cannot be read"),
            (Mesh("/nowhere/none.vtk"), "none.vtk' cannot be read"),
            (Mesh("/nowhere/none.stl"), "none.stl' cannot be read"),
            (Mesh("/nowhere/a.ply"), "'.ply' is not one of .obj, .gltf, .stl"),
            (make_mesh("v 0 0 0"), "cannot be read"),
            (make_mesh("{", ".gltf"), "cannot be read"),
            (make_mesh(good, ".gltf"), "cannot be read: its file 'x' is"),
            (make_mesh(dots, ".gltf"), "no triangle"),
            (make_mesh(needs, ".gltf"), "needs the extensions KHR_draco"),
            (make_mesh("[]", ".gltf"), "memory.*not as its format demands"),
            (make_mesh(null, ".gltf"), "memory.*not as its format demands"),
            (
                make_mesh(json.dumps(circle), ".gltf"),
                "not a tree: two lead to 0",
            ),
        ):
            with (
                self.subTest(message=message),
                self.assertRaisesRegex(
                    UserError, f"geometry 'horn': mesh '.*{message}"
                ),
            ):
                mut.read_mesh(shape, "horn")

    def test_obj_vertex_that_is_no_point(self):
        """Drake's reader takes 0 for what is not a number."""
        good = ["v 0 0 1", "v\t+1. .5 -2E-1 # far", "v 1 0 0 1 1 1", "f 1 2 3"]
        for bad in (
            "v nan 0 0",
            "v 0 inf 0",
            "v 0 0 -INF",
            "v abc 0 0",
            "v 1,5 0 0",
            "v 1e400 0 0",
            "v 1_0 0 0",
            "v 1 0",
            "v",
            " v 0 0 # 0",
            "v 1 \\",
        ):
            text = "\n".join(["# A mesh.", good[0], bad, *good[1:]])
            message = r"line 3: '.*' is not a vertex of three finite numbers"
            for kind in (Mesh, Convex):
                with self.subTest(bad=bad, kind=kind):
                    scene = oracle.Scene()
                    scene.add(make_mesh(text, kind=kind), name="horn")
                    with self.assertRaisesRegex(
                        UserError,
                        f"^geometry 'horn': mesh 'memory' .*{message}",
                    ):
                        RayCaster(scene.inspector)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "horn.obj"
            path.write_text(text)
            with self.assertRaisesRegex(UserError, rf"horn\.obj' .*{message}"):
                mut.read_mesh(Mesh(path), "it")
        for end in ("\n", "\r\n"):
            mesh = make_mesh(end.join(["# v nan", "vn nan 0 0", *good]))
            self.check_same(
                mesh, [[0, 0, 1], [1, 0.5, -0.2], [1, 0, 0]], [[0, 1, 2]]
            )

    def test_gltf_that_is_broken_is_no_other_surface(self):
        """Two primitives in one buffer: what is beyond one is the other."""
        triangle = np.eye(3)
        text, data = make_gltf(
            [(triangle, [0, 1, 2], 4), (triangle + 5, [0, 1, 2], 4)],
            [{"mesh": 0, "children": [1]}, {"mesh": 1}],
            None,
        )
        mut.read_mesh(make_mesh(text, ".gltf"), "it")
        size = len(data)
        for where, value, message in (
            ("nodes/0/rotation", [0, 0, 1, 1], "not a unit quaternion"),
            ("nodes/0/rotation", [0, 0, 0, 0], "not a unit quaternion"),
            ("nodes/0/rotation", [0, 0, 0, np.nan], "4 finite numbers"),
            ("nodes/0/rotation", [0, 0, 1], "rotation: .* not 4 finite"),
            ("nodes/0/scale", [2], "scale: .* not 3 finite numbers"),
            ("nodes/0/translation", [2], "translation: .* not 3 finite"),
            ("nodes/0/matrix", [1] * 16, "matrix: .* is not affine"),
            ("nodes/0/mesh", -1, "-1 is not one of its 2 meshes"),
            ("nodes/0/mesh", 2, "2 is not one of its 2 meshes"),
            ("nodes/0/children", [-1], "-1 is not one of its 2 nodes"),
            ("scene", -1, "-1 is not one of its 1 scenes"),
            (
                "accessors/0/bufferView",
                -2,
                "-2 is not one of its 4 bufferViews",
            ),
            ("accessors/0/bufferView", 4, "4 is not one of its 4 bufferViews"),
            ("accessors/0/bufferView", True, "True is not one of"),
            ("accessors/0/byteOffset", -12, "byteOffset: -12 is not a whole"),
            ("accessors/0/byteOffset", 12, "bufferView is too short"),
            ("accessors/0/count", 4, "bufferView is too short"),
            ("accessors/0/count", 2.5, "count: 2.5 is not a whole number"),
            ("accessors/0/componentType", 5125, "VEC3 of 5125, not VEC3 of"),
            ("accessors/0/type", "SCALAR", "SCALAR of 5126, not VEC3"),
            ("accessors/1/componentType", 5122, "5122, not SCALAR of 5121 or"),
            ("accessors/1/count", 2, "2 corners do not make whole triangles"),
            ("bufferViews/0/buffer", -1, "-1 is not one of its 1 buffers"),
            ("bufferViews/0/byteOffset", -1, "byteOffset: -1 is not a whole"),
            ("bufferViews/0/byteLength", 35, "bufferView is too short"),
            ("bufferViews/0/byteLength", None, "byteLength: None"),
            ("bufferViews/0/byteLength", size + 1, "short for its bufferView"),
            ("bufferViews/0/byteStride", 4, "byteStride: 4 is less than 12 B"),
            ("buffers/0/byteLength", size + 1, f"short: {size} of {size + 1}"),
            ("buffers/0/byteLength", 40, "too short for its bufferView"),
            (
                "meshes/0/primitives/0/attributes/POSITION",
                -2,
                "-2 is not one of",
            ),
            ("meshes/0/primitives/0/indices", -1, "-1 is not one of its 4 acc"),
            ("meshes/0/primitives/0/mode", 7, "unknown mode 7"),
        ):
            gltf = json.loads(text)
            *path, key = where.split("/")
            entry = gltf
            for step in path:
                entry = entry[int(step) if step.isdigit() else step]
            entry[key] = value
            with (
                self.subTest(where=where, value=value),
                self.assertRaisesRegex(
                    UserError, f"^geometry 'horn': mesh 'memory' .*{message}"
                ),
            ):
                mut.read_mesh(make_mesh(json.dumps(gltf), ".gltf"), "horn")

    def test_gltf_indices_stay_in_their_primitive(self):
        triangle = np.eye(3)
        for indices, mode, message in (
            ([0, 1, 3], 4, "index 3 is not one of a primitive's 3 vertices"),
            ([0, 1, 2, 5], 5, "index 5 is not one"),
            ([0, 1, 2, 0], 4, "4 corners do not make whole triangles"),
            ([0, 1], 5, "2 corners do not make a triangle"),
            ([0, 1], 6, "2 corners do not make a triangle"),
        ):
            text, _ = make_gltf(
                [(triangle, indices, mode), (triangle + 5, [0, 1, 2], 4)],
                [{"mesh": 0, "children": [1]}, {"mesh": 1}],
                None,
            )
            with (
                self.subTest(indices=indices, mode=mode),
                self.assertRaisesRegex(UserError, f"'memory' .*{message}"),
            ):
                mut.read_mesh(make_mesh(text, ".gltf"), "it")

    def test_gltf_rotation_is_a_unit_quaternion_but_for_rounding(self):
        angle = 0.5 * 0.3
        rotation = [0, 0, np.sin(angle), np.cos(angle)]
        surfaces = []
        for factor in (1.0, 1.0005):
            nodes = [{"mesh": 0, "rotation": [factor * x for x in rotation]}]
            text, _ = make_gltf([(self.vertices, [0, 1, 2], 4)], nodes, None)
            mesh = mut.read_mesh(make_mesh(text, ".gltf"), "it")
            surfaces.append(mesh.surface.triangles)
        np.testing.assert_allclose(surfaces[1], surfaces[0], atol=1e-12)

    def test_missing_buffer_is_named_with_its_mesh(self):
        text, _ = make_gltf([(np.eye(3), [0, 1, 2], 4)], [{"mesh": 0}], "a.bin")
        gltf = json.loads(text)
        del gltf["buffers"][0]["uri"]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "horn.gltf"
            path.write_text(text)
            nameless = Path(folder) / "nameless.gltf"
            nameless.write_text(json.dumps(gltf))
            memory = InMemoryMesh(
                mesh_file=MemoryFile(text, ".gltf", "memory"),
                supporting_files={"a.bin": Path(folder) / "a.bin"},
            )
            for shape, message in (
                (Mesh(path), r"horn\.gltf' cannot be read: .*a\.bin"),
                (Mesh(nameless), r"nameless\.gltf' .*: a buffer has no uri"),
                (Mesh(memory), r"memory' cannot be read: .*a\.bin"),
            ):
                scene = oracle.Scene()
                scene.add(shape, name="horn")
                with (
                    self.subTest(message=message),
                    self.assertRaisesRegex(
                        UserError, f"^geometry 'horn': mesh '.*{message}"
                    ),
                ):
                    RayCaster(scene.inspector)


class TestMakeTriangleMesh(unittest.TestCase):
    def check_tree(self, vertices, faces):
        dut = mut.make_triangle_mesh(vertices, faces).surface
        seen = np.zeros(len(faces), dtype=int)
        corners = dut.triangles.reshape(-1, 3, 3)
        stack = [(0, 0)]
        deepest = 0
        while stack:
            node, depth = stack.pop()
            deepest = max(deepest, depth)
            low, high = dut.nodes[node, :6].reshape(2, 3)
            first, count = dut.nodes[node, 6:].astype(int)
            if count:
                seen[first : first + count] += 1
                inside = corners[first : first + count]
                self.assertTrue((inside >= low).all())
                self.assertTrue((inside <= high).all())
                continue
            for child in (first, first + 1):
                child_low, child_high = dut.nodes[child, :6].reshape(2, 3)
                self.assertTrue((child_low >= low).all())
                self.assertTrue((child_high <= high).all())
                stack.append((child, depth + 1))
        np.testing.assert_array_equal(seen, 1)
        self.assertLess(deepest, 100)

    def test_tree_holds_every_triangle_once(self):
        self.check_tree(*make_torus(20))
        self.check_tree(np.eye(3), [[0, 1, 2]])

    def test_tree_of_triangles_that_no_plane_parts(self):
        self.check_tree(np.eye(3), [[0, 1, 2]] * 1000)

    def test_tree_of_ever_smaller_triangles(self):
        scale = np.repeat(0.5 ** np.arange(600), 3)[:, None]
        vertices = np.tile(np.eye(3), (600, 1)) * scale
        self.check_tree(vertices, np.arange(1800).reshape(-1, 3))

    def test_wrong_arguments(self):
        with self.assertRaisesRegex(ValueError, "no triangle"):
            mut.make_triangle_mesh(np.eye(3), np.empty((0, 3)))
        for corner in (-1, 3):
            with self.assertRaisesRegex(ValueError, "not one of its 3 vert"):
                mut.make_triangle_mesh(np.eye(3), [[0, 1, corner]])
        with self.assertRaisesRegex(ValueError, "not finite"):
            mut.make_triangle_mesh(np.eye(3) * np.nan, [[0, 1, 2]])
