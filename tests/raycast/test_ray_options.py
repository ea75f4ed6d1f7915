"""Where rays begin and end, hollow shapes, and what is left out."""

import tempfile
import threading
import unittest

import numpy as np
from pydrake.geometry import (
    Box,
    GeometryInstance,
    HalfSpace,
    Mesh,
    MeshcatCone,
    PerceptionProperties,
    ProximityProperties,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform
import ray_oracle as oracle
from solids import CUBE_QUADS, CUBE_VERTICES, make_mesh, make_torus, write_obj

from tofssm_drake.errors import UserError
from tofssm_drake.raycast import ray_kernels
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster

CONVEX_KINDS = (*oracle.KINDS, "convex")


def cast_slowly(scene, caster, p, n, min_range, max_range, *, hollow):
    """The nearest point of a shape, or of its surface, from min_range on."""
    best = np.full(len(p), np.inf)
    p, n = p.astype(oracle.LONG), n.astype(oracle.LONG)
    shapes, X_WG = scene.shapes_in_order(caster.geometry_ids)
    for shape, X in zip(shapes, X_WG, strict=True):
        R = X.rotation().matrix().astype(oracle.LONG)
        p_G = (p - X.translation().astype(oracle.LONG)) @ R
        intervals = oracle.solve_shape(shape, p_G, n @ R)
        good = [first <= last for first, last in intervals]
        first = np.min(
            [
                np.where(g, i[0], np.inf)
                for g, i in zip(good, intervals, strict=True)
            ],
            0,
        )
        last = np.max(
            [
                np.where(g, i[1], -np.inf)
                for g, i in zip(good, intervals, strict=True)
            ],
            0,
        )
        if hollow:
            t = np.where(first >= min_range, first, last)
        else:
            t = np.maximum(first, min_range)
        t = np.where((first <= last) & (last >= min_range), t, np.inf)
        best = np.minimum(best, t)
    return np.where(best <= max_range, best, np.inf).astype(float)


class TestRanges(unittest.TestCase):
    def setUp(self):
        self.rng = np.random.default_rng(21)

    def assert_close(self, actual, want):
        """But for rays that graze: one in a thousand."""
        with np.errstate(invalid="ignore"):
            bad = ~((actual == want) | (np.abs(actual - want) < 1e-10))
        self.assertLess(bad.mean(), 1e-3, np.flatnonzero(bad)[:5])

    def check(self, *, hollow, later):
        for _ in range(4):
            scene = oracle.make_random_scene(self.rng, CONVEX_KINDS)
            dut = RayCaster(scene.inspector, surface_only=hollow)
            X_WF = dut.poses_from_query_object(scene.query_object())
            p = self.rng.uniform(-1.0, 1.0, (3000, 3))
            n = oracle.make_unit_vectors(self.rng, 3000)
            low = self.rng.uniform(0.0, 1.0, 3000) * later
            high = low + self.rng.uniform(0.0, 3.0, 3000)
            want = cast_slowly(scene, dut, p, n, low, high, hollow=hollow)
            hits = dut.cast(X_WF, p, n, high, min_range=low)
            self.assert_close(hits[0], want)
            np.testing.assert_array_equal(hits[1] >= 0, np.isfinite(hits[0]))
            self.assertTrue((hits[0] >= low).all())
            self.check_normals(dut, X_WF, p, n, low, *hits)
            self.check_bundles(scene, hollow, later)

    def check_normals(self, dut, X_WF, p, n, low, distance, index):
        normals = dut.calc_normals(X_WF, p, n, distance, index, min_range=low)
        seen = np.isfinite(distance) & (distance > low)
        np.testing.assert_allclose(
            np.linalg.norm(normals[seen], axis=1), 1.0, atol=1e-12
        )
        self.assertTrue(np.isnan(normals[~seen]).all())
        self.assertTrue(((normals[seen] * n[seen]).sum(1) < 1e-12).all())

    def check_bundles(self, scene, hollow, later):
        caster = RayCaster(scene.inspector, surface_only=hollow)
        low = self.rng.uniform(0.0, 1.0, 30) * later
        bundles = caster.make_bundles(
            frame_id=scene.frame_ids[0],
            X_FS=[oracle.make_random_pose(self.rng) for _ in range(30)],
            fan_S=make_cone_fan(1.0, 40),
            max_range=low + 1.0,
            min_range=low,
            excluded=[[caster.geometry_ids[i % 3]] for i in range(30)],
        )
        X_WF = caster.poses_from_query_object(scene.query_object())
        distance, index = caster.cast_bundles(bundles, X_WF)
        p_WR, n_WR = caster.calc_rays(bundles, X_WF)
        for i in range(30):
            want, want_index = caster.cast(
                X_WF,
                p_WR[i],
                n_WR[i],
                low[i] + 1.0,
                min_range=low[i],
                excluded=[caster.geometry_ids[i % 3]],
            )
            np.testing.assert_allclose(distance[i], want, rtol=0, atol=1e-9)
            same = index[i] == want_index
            self.assertTrue((same | (want == low[i])).all())

    def test_solid_shapes(self):
        self.check(hollow=False, later=0.0)
        self.check(hollow=False, later=1.0)

    def test_hollow_shapes(self):
        self.check(hollow=True, later=0.0)
        self.check(hollow=True, later=1.0)

    def test_one_range_for_each_ray(self):
        scene = oracle.Scene()
        scene.add(Sphere(1.0))
        dut = RayCaster(scene.inspector)
        query_object = scene.query_object()
        p, n = np.tile([-3.0, 0, 0], (4, 1)), np.tile([1.0, 0, 0], (4, 1))
        distance, index = dut.cast(query_object, p, n, [1.0, 2.0, 3.0, 0.0])
        np.testing.assert_array_equal(distance, [np.inf, 2.0, 2.0, np.inf])
        np.testing.assert_array_equal(index, [-1, 0, 0, -1])
        for name in ("max_range", "min_range"):
            for bad, message in (
                ([1.0, 2.0], rf"{name}: shape \(2,\) is neither"),
                ([1.0, -2.0, 1.0, 1.0], rf"{name}: .* is not >= 0"),
                (np.nan, rf"{name}: nan is not >= 0"),
                ("far", rf"{name}: .* are not real numbers"),
            ):
                with self.assertRaisesRegex(ValueError, message):
                    dut.cast(query_object, p, n, **{name: bad})

    def test_worked_numbers(self):
        """A ball of radius 1 at the origin, from within and from outside."""
        scene = oracle.Scene()
        scene.add(Sphere(1.0))
        query_object = scene.query_object()
        p = [[0.0, 0, 0], [0.5, 0, 0], [-3.0, 0, 0], [1.0, 0, 0]]
        n = [[1.0, 0, 0]] * 4
        for hollow, low, expected in (
            (False, 0.0, [0.0, 0.0, 2.0, 0.0]),
            (True, 0.0, [1.0, 0.5, 2.0, 0.0]),
            # Within the ball at that range, or not any more.
            (False, 0.75, [0.75, np.inf, 2.0, np.inf]),
            (True, 0.75, [1.0, np.inf, 2.0, np.inf]),
            (False, 2.5, [np.inf, np.inf, 2.5, np.inf]),
            (True, 2.5, [np.inf, np.inf, 4.0, np.inf]),
        ):
            dut = RayCaster(scene.inspector, surface_only=hollow)
            distance, _ = dut.cast(query_object, p, n, min_range=low)
            np.testing.assert_allclose(distance, expected, atol=1e-15)

    def test_hollow_mesh(self):
        rng = np.random.default_rng(22)
        text = write_obj(*make_torus())
        scene = oracle.Scene()
        scene.add(make_mesh(text))
        p = rng.uniform(-0.7, 0.7, (2000, 3)) * [1, 1, 0.2]
        n = oracle.make_unit_vectors(rng, 2000)
        query_object = scene.query_object()
        solid = RayCaster(scene.inspector).cast(query_object, p, n)[0]
        dut = RayCaster(scene.inspector, surface_only=True)
        distance, index = dut.cast(query_object, p, n)
        inside = solid == 0.0
        self.assertGreater(inside.sum(), 300)
        np.testing.assert_array_equal(distance[~inside], solid[~inside])
        self.assertTrue((distance[inside] > 0.0).all())
        self.assertTrue((distance[inside] < 1.5).all())
        # There and back again.
        hit = p + distance[:, None] * n
        back, _ = dut.cast(
            query_object, hit[inside], -n[inside], min_range=1e-9
        )
        self.assertTrue((back > 0.0).all())
        X_WF = dut.poses_from_query_object(query_object)
        normals = dut.calc_normals(X_WF, p, n, distance, index)
        seen = np.isfinite(distance)
        self.assertTrue(((normals[seen] * n[seen]).sum(1) < 0.0).all())

    def test_hollow_half_space_from_below(self):
        scene = oracle.Scene()
        scene.add(HalfSpace())
        dut = RayCaster(scene.inspector, surface_only=True)
        distance, _ = dut.cast(
            scene.query_object(),
            [[0, 0, -2.0]] * 3,
            [[0, 0, 1.0], [0, 0, -1.0], [1.0, 0, 0]],
        )
        np.testing.assert_array_equal(distance, [2.0, np.inf, np.inf])


class TestInside(unittest.TestCase):
    def test_which_geometries_have_an_inside(self):
        scene = oracle.Scene()
        open_box = write_obj(CUBE_VERTICES, CUBE_QUADS[1:])
        expected = {
            scene.add(Box(1, 1, 1)): True,
            scene.add(make_mesh(open_box)): False,
            scene.add(make_mesh(write_obj(CUBE_VERTICES, CUBE_QUADS))): True,
            scene.add(HalfSpace()): True,
        }
        dut = RayCaster(scene.inspector)
        self.assertEqual(
            dict(zip(dut.geometry_ids, dut.has_inside, strict=True)), expected
        )
        dut.has_inside[:] = False
        self.assertTrue(dut.has_inside.any())
        dut = RayCaster(scene.inspector, surface_only=True)
        self.assertFalse(dut.has_inside.any())


class TestSkipUnsupported(unittest.TestCase):
    def test_what_is_left_out_is_listed(self):
        scene = oracle.Scene(Role.kProximity)
        wanted = scene.add(Sphere(0.1), RigidTransform([1.0, 0, 0]))
        jelly = GeometryInstance(RigidTransform(), Sphere(0.1), "jelly")
        jelly.set_proximity_properties(ProximityProperties())
        jelly = scene.scene_graph.RegisterDeformableGeometry(
            scene.source_id, scene.scene_graph.world_frame_id(), jelly, 0.1
        )
        with self.assertRaisesRegex(UserError, "jelly"):
            RayCaster(scene.inspector, role=Role.kProximity)
        dut = RayCaster(
            scene.inspector, role=Role.kProximity, skip_unsupported=True
        )
        self.assertEqual(dut.geometry_ids, [wanted])
        self.assertEqual(list(dut.skipped), [jelly])
        self.assertRegex(dut.skipped[jelly], "'jelly': a deformable")

    def test_shapes_and_files(self):
        scene = oracle.Scene()
        horn = scene.add(MeshcatCone(1.0), name="horn")
        wanted = scene.add(Sphere(0.1), RigidTransform([1.0, 0, 0]))
        with tempfile.TemporaryDirectory() as folder:
            lost = scene.add(Mesh(f"{folder}/lost.obj"), name="lost")
        dut = RayCaster(scene.inspector, skip_unsupported=True)
        self.assertEqual(dut.geometry_ids, [wanted])
        self.assertEqual(set(dut.skipped), {horn, lost})
        self.assertRegex(dut.skipped[horn], "'horn': a MeshcatCone cannot")
        self.assertRegex(dut.skipped[lost], "'lost'.*cannot be read")
        query_object = scene.query_object()
        distance, _ = dut.cast(query_object, [[0.0, 0, 0]], [[1.0, 0, 0]])
        self.assertAlmostEqual(distance[0], 0.9)
        dut.check_geometry(query_object.inspector())
        # What comes later is still noticed.
        late = GeometryInstance(RigidTransform(), Sphere(0.1), "late")
        late.set_perception_properties(PerceptionProperties())
        scene.scene_graph.RegisterGeometry(
            scene.context,
            scene.source_id,
            scene.inspector.world_frame_id(),
            late,
        )
        with self.assertRaisesRegex(RuntimeError, "'late'.*was added"):
            dut.poses_from_query_object(scene.query_object())
        dut = RayCaster(scene.inspector, geometry_ids=[wanted])
        self.assertEqual(dut.skipped, {})


class TestThreads(unittest.TestCase):
    def test_other_threads_go_on(self):
        """Compiled code that holds the interpreter would stop them."""
        for kernel in ("cast_bundles", "cast_rays", "calc_normals"):
            options = getattr(ray_kernels, kernel).targetoptions
            self.assertTrue(options.get("nogil"), kernel)

    def test_threads_share_a_caster(self):
        rng = np.random.default_rng(23)
        scene = oracle.make_random_scene(rng, oracle.ALL_KINDS)
        dut = RayCaster(scene.inspector)
        X_WF = dut.poses_from_query_object(scene.query_object())
        rays = [
            (rng.uniform(-1, 1, (5000, 3)), oracle.make_unit_vectors(rng, 5000))
            for _ in range(4)
        ]
        expected = [dut.cast(X_WF, *r)[0] for r in rays]
        found = [None] * len(rays)

        def work(i):
            found[i] = dut.cast(X_WF, *rays[i])[0]

        threads = [
            threading.Thread(target=work, args=(i,)) for i in range(len(rays))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        np.testing.assert_array_equal(found, expected)


if __name__ == "__main__":
    unittest.main()
