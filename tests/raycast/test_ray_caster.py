import unittest

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    FrameId,
    GeometryId,
    GeometryInstance,
    HalfSpace,
    IllustrationProperties,
    MeshcatCone,
    PerceptionProperties,
    ProximityProperties,
    QueryObject,
    QueryObject_,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
import ray_oracle as oracle

from tofssm_drake.errors import UserError
from tofssm_drake.raycast.fan import make_cone_fan
import tofssm_drake.raycast.ray_caster as mut


class TestExactness(unittest.TestCase):
    def check(self, kinds, seed, rays=5000):
        rng = np.random.default_rng(seed)
        scene = oracle.make_random_scene(rng, kinds)
        dut = mut.RayCaster(scene.inspector)
        p_WR = rng.uniform(-1.5, 1.5, (rays, 3))
        n_WR = oracle.make_unit_vectors(rng, rays)
        distance, index = dut.cast(scene.query_object(), p_WR, n_WR, 4.0)
        self.assertTrue((distance == 0).any())
        self.assertTrue((distance == np.inf).any())
        self.assertTrue(np.isfinite(distance[distance > 0]).any())
        expected = oracle.cast(
            *scene.shapes_in_order(dut.geometry_ids), p_WR, n_WR, 4.0
        )
        oracle.assert_same_hits(
            scene, dut, p_WR, n_WR, distance, index, expected
        )

    def test_each_kind_against_the_closed_form(self):
        for seed, kind in enumerate(oracle.ALL_KINDS):
            with self.subTest(kind=kind):
                self.check([kind] * (1 if kind == "half_space" else 4), seed)

    def test_all_kinds_against_the_closed_form(self):
        for seed in range(3):
            with self.subTest(seed=seed):
                self.check(oracle.ALL_KINDS * 2, seed)


class TestBundles(unittest.TestCase):
    def setUp(self):
        self.rng = np.random.default_rng(3)
        self.scene = oracle.make_random_scene(self.rng, oracle.KINDS * 3)
        self.dut = mut.RayCaster(self.scene.inspector)
        self.fan = make_cone_fan(np.deg2rad(25), 25)

    def make(self, count, fan=None, **kwargs):
        X_FS = [oracle.make_random_pose(self.rng, 1.5) for _ in range(count)]
        frame_id = [self.scene.frame_ids[i % 2] for i in range(count)]
        bundles = self.dut.make_bundles(
            frame_id=frame_id,
            X_FS=X_FS,
            fan_S=self.fan if fan is None else fan,
            **kwargs,
        )
        X_WS = [
            self.scene.poses[f] @ X for f, X in zip(frame_id, X_FS, strict=True)
        ]
        return bundles, X_WS

    def rays(self, X_WS, fan=None):
        fan = self.fan if fan is None else fan
        p_WR = np.repeat([X.translation() for X in X_WS], len(fan), axis=0)
        n_WR = np.concatenate([fan @ X.rotation().matrix().T for X in X_WS])
        return p_WR, n_WR

    def check(self, fan, max_range):
        bundles, X_WS = self.make(300, fan, max_range=max_range)
        X_WF = self.dut.poses_from_query_object(self.scene.query_object())
        distance, index = self.dut.cast_bundles(bundles, X_WF)
        self.assertEqual(distance.shape, (300, len(fan)))
        p_WR, n_WR = self.rays(X_WS, fan)
        expected = oracle.cast(
            *self.scene.shapes_in_order(self.dut.geometry_ids),
            p_WR,
            n_WR,
            max_range,
        )
        oracle.assert_same_hits(
            self.scene,
            self.dut,
            p_WR,
            n_WR,
            distance.ravel(),
            index.ravel(),
            expected,
        )

    def test_narrow_and_wide_fans_see_the_same_as_the_closed_form(self):
        for degrees in (1, 25, 120, 179):
            fan = make_cone_fan(np.deg2rad(degrees), 25)
            for max_range in (0.5, 4.0):
                with self.subTest(degrees=degrees, max_range=max_range):
                    self.check(fan, max_range)

    def test_fan_all_around(self):
        angle = np.arange(0, 2 * np.pi, 0.05)
        fan = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        self.check(fan, 1.5)

    def test_single_ray(self):
        self.check(np.array([[0.0, 0.0, 1.0]]), 2.0)

    def test_own_housing_is_not_seen_when_excluded(self):
        scene = oracle.Scene()
        link = scene.add_frame(RigidTransform([0, 0, 1]))
        housing = scene.add(Capsule(0.1, 0.5), frame_id=link)
        wall = scene.add(Box(0.2, 10, 10), RigidTransform([1.1, 0, 0]))
        dut = mut.RayCaster(scene.inspector)
        bundles = dut.make_bundles(
            frame_id=link,
            X_FS=[RigidTransform([0.05, 0, 0])] * 2,
            fan_S=[[1.0, 0, 0]],
            max_range=1.5,
            excluded=[[], [housing]],
        )
        X_WF = dut.poses_from_query_object(scene.query_object())
        distance, index = dut.cast_bundles(bundles, X_WF)
        np.testing.assert_allclose(distance, [[0.0], [0.95]], atol=1e-15)
        self.assertEqual(
            [dut.geometry_ids[i] for i in index[:, 0]], [housing, wall]
        )

    def test_frame_without_geometry(self):
        scene = oracle.Scene()
        bare = scene.add_frame(RigidTransform([0, 0, 2]))
        scene.add(HalfSpace())
        dut = mut.RayCaster(scene.inspector)
        bundles = dut.make_bundles(
            frame_id=bare,
            X_FS=[RigidTransform(RollPitchYaw(0, np.pi / 2, 0), [0, 0, 0])],
            fan_S=[[1.0, 0, 0]],
            max_range=3.0,
        )
        self.assertIn(bare, dut.frame_ids)
        X_WF = dut.poses_from_query_object(scene.query_object())
        distance, _ = dut.cast_bundles(bundles, X_WF)
        np.testing.assert_allclose(distance, [[2.0]], atol=1e-15)

    def test_each_bundle_has_its_own_range(self):
        scene = oracle.Scene()
        scene.add(HalfSpace())
        dut = mut.RayCaster(scene.inspector)
        down = RigidTransform(RollPitchYaw(0, np.pi / 2, 0), [0, 0, 2])
        bundles = dut.make_bundles(
            frame_id=scene.inspector.world_frame_id(),
            X_FS=[down] * 3,
            fan_S=[[1.0, 0, 0]],
            max_range=[1.9, 2.0, 2.1],
        )
        X_WF = dut.poses_from_query_object(scene.query_object())
        distance, index = dut.cast_bundles(bundles, X_WF)
        np.testing.assert_array_equal(distance[:, 0], [np.inf, 2.0, 2.0])
        np.testing.assert_array_equal(index[:, 0], [-1, 0, 0])

    def test_wrong_arguments(self):
        pose = [RigidTransform()]
        good = dict(
            frame_id=self.scene.frame_ids[0],
            X_FS=pose,
            fan_S=self.fan,
            max_range=1.0,
        )
        for bad, message in (
            (dict(fan_S=[[0.0, 0, 0]]), "fan_S: not unit"),
            (dict(fan_S=[[2.0, 0, 0]]), "fan_S: not unit"),
            (dict(fan_S=[[np.nan, 0, 0]]), "fan_S: not unit"),
            (dict(fan_S=[[1.0, 0]]), "fan_S: shape"),
            (dict(fan_S=np.empty((0, 3))), "fan_S: has no ray"),
            (dict(max_range=np.nan), "max_range"),
            (dict(max_range=-1.0), "max_range"),
            (dict(X_FS=[np.full((3, 4), np.nan)]), "X_FS"),
            (dict(X_FS=[np.eye(4)]), "X_FS"),
            (dict(X_FS=[]), "X_FS"),
            (dict(X_FS=[2 * np.eye(3, 4)]), "X_FS"),
            (dict(X_FS=[np.diag([1.0, 1, -1, 1])[:3]]), "X_FS"),
            (dict(X_FS=[np.eye(3, 4)[[0, 1, 1]]]), "X_FS"),
            (dict(frame_id=self.scene.frame_ids), "frame_id: 2 frames for 1"),
            (dict(excluded=[[], []]), "excluded: 2 collections for 1"),
            (dict(X_FS=[np.eye(3, 4) + 0j]), "X_FS: complex128"),
            (dict(fan_S=[[1j, 0, 0]]), "fan_S: complex128"),
            (
                dict(X_FS=np.ma.masked_array([np.eye(3, 4)])),
                "X_FS: a masked array",
            ),
            (dict(fan_S=[np.ma.masked_array([1.0, 0, 0])]), "fan_S: a masked"),
            (dict(max_range="far"), "max_range: .* not real numbers"),
            (dict(frame_id=FrameId.get_new_id()), "frame_id: .* had no <Fra"),
        ):
            with (
                self.subTest(bad=bad),
                self.assertRaisesRegex(ValueError, message),
            ):
                self.dut.make_bundles(**(good | bad))

    def test_bundles_must_be_of_this_caster(self):
        bundles, _ = self.make(2, max_range=1.0)
        other = mut.RayCaster(self.scene.inspector)
        X_WF = other.poses_from_query_object(self.scene.query_object())
        for method in (other.cast_bundles, other.calc_rays):
            with self.assertRaisesRegex(ValueError, "another RayCaster"):
                method(bundles, X_WF)

    def test_poses_may_be_laid_out_in_any_way(self):
        bundles, _ = self.make(5, max_range=1.0)
        X_WF = self.dut.poses_from_query_object(self.scene.query_object())
        expected = self.dut.cast_bundles(bundles, X_WF)
        frozen = X_WF.copy()
        frozen.flags.writeable = False
        for poses in (frozen, np.asfortranarray(X_WF)):
            actual = self.dut.cast_bundles(bundles, poses)
            np.testing.assert_array_equal(actual[0], expected[0])
            np.testing.assert_array_equal(actual[1], expected[1])

    def test_lists_will_do(self):
        bundles, _ = self.make(3, max_range=1.0)
        X_WF = self.dut.poses_from_query_object(self.scene.query_object())
        which = np.array([True, False, True])
        expected = self.dut.cast_bundles(bundles, X_WF, which)
        actual = self.dut.cast_bundles(bundles, X_WF.tolist(), which.tolist())
        np.testing.assert_array_equal(actual[0], expected[0])
        ray = [[0.0, 0, 0]], [[1.0, 0, 0]]
        self.assertEqual(
            self.dut.cast(X_WF.tolist(), *ray), self.dut.cast(X_WF, *ray)
        )
        for bad in (None, "poses", [[1.0]], X_WF + 0j):
            with self.assertRaisesRegex(ValueError, "X_WF"):
                self.dut.cast_bundles(bundles, bad)
            with self.assertRaisesRegex(ValueError, "X_WF"):
                self.dut.cast(bad, *ray)

    def test_some_of_the_bundles(self):
        bundles, _ = self.make(40, max_range=2.0)
        X_WF = self.dut.poses_from_query_object(self.scene.query_object())
        every, every_index = self.dut.cast_bundles(bundles, X_WF)
        which = self.rng.random(40) < 0.5
        frozen = which.copy()
        frozen.flags.writeable = False
        for chosen in (which, frozen, np.repeat(which, 2)[::2]):
            distance, index = self.dut.cast_bundles(bundles, X_WF, chosen)
            np.testing.assert_array_equal(distance[which], every[which])
            np.testing.assert_array_equal(index[which], every_index[which])
            self.assertTrue((distance[~which] == np.inf).all())
            self.assertTrue((index[~which] == -1).all())
        # There was something to leave out.
        self.assertTrue(np.isfinite(every[~which]).any())
        for bad in (which[:-1], which.astype(int)):
            with self.assertRaisesRegex(ValueError, "which"):
                self.dut.cast_bundles(bundles, X_WF, bad)

    def test_poses_must_fit(self):
        bundles, _ = self.make(2, max_range=1.0)
        X_WF = self.dut.poses_from_query_object(self.scene.query_object())
        with self.assertRaisesRegex(ValueError, "X_WF: shape"):
            self.dut.cast_bundles(bundles, X_WF[:-1])
        good = X_WF[1].copy()
        for bad in (
            np.column_stack([good[:, :3], [0.0, 0.0, np.nan]]),
            np.column_stack([good[:, :3], [0.0, np.inf, 0.0]]),
            np.full((3, 4), np.nan),
            np.zeros((3, 4)),
            good * 1.001,
            good * [[-1.0], [1.0], [1.0]],  # A mirror.
            good + np.eye(3, 4, 1) * 1e-3,  # A shear.
        ):
            X_WF[1] = bad
            with self.assertRaisesRegex(ValueError, "not finite, is not rigid"):
                self.dut.cast_bundles(bundles, X_WF)
            with self.assertRaisesRegex(ValueError, "not finite, is not rigid"):
                self.dut.cast(X_WF, [[0.0, 0, 0]], [[1.0, 0, 0]])
        # What a product of many rotations has lost is not much.
        X_WF[1] = good * (1.0 + 1e-9)
        self.dut.cast_bundles(bundles, X_WF)


class TestNormals(unittest.TestCase):
    def test_each_kind_against_the_closed_form(self):
        rng = np.random.default_rng(11)
        scene = oracle.make_random_scene(rng, oracle.KINDS * 2)
        dut = mut.RayCaster(scene.inspector)
        X_WF = dut.poses_from_query_object(scene.query_object())
        p_WR = rng.uniform(-1.5, 1.5, (5000, 3))
        n_WR = oracle.make_unit_vectors(rng, 5000)
        distance, index = dut.cast(X_WF, p_WR, n_WR)
        normals = dut.calc_normals(X_WF, p_WR, n_WR, distance, index)
        seen = np.isfinite(distance) & (distance > 0)
        self.assertTrue(np.isnan(normals[~seen]).all())
        shapes, X_WG = scene.shapes_in_order(dut.geometry_ids)
        kinds = set()
        for i in np.flatnonzero(seen):
            X = X_WG[index[i]]
            shape = shapes[index[i]]
            p = X.inverse() @ (p_WR[i] + distance[i] * n_WR[i])
            want = X.rotation() @ oracle.calc_normal(shape, p[None])[0]
            np.testing.assert_allclose(normals[i], want, atol=1e-9)
            self.assertLess(normals[i] @ n_WR[i], 0)
            kinds.add(type(shape))
        self.assertEqual(len(kinds), len(oracle.KINDS))

    def test_bundles(self):
        scene = oracle.Scene()
        link = scene.add_frame(RigidTransform([0, 0, 2]))
        scene.add(HalfSpace())
        dut = mut.RayCaster(scene.inspector)
        bundles = dut.make_bundles(
            frame_id=link,
            X_FS=[RigidTransform(RollPitchYaw(0, np.pi / 2, 0), [0, 0, 0])],
            fan_S=make_cone_fan(1.0, 25),
            max_range=9.0,
        )
        X_WF = dut.poses_from_query_object(scene.query_object())
        hits = dut.cast_bundles(bundles, X_WF)
        normals = dut.calc_normals(X_WF, *dut.calc_rays(bundles, X_WF), *hits)
        self.assertEqual(normals.shape, (1, 25, 3))
        np.testing.assert_allclose(
            normals[0], np.tile([0, 0, 1.0], (25, 1)), atol=1e-15
        )

    def test_on_an_edge_the_side_that_faces_the_ray_counts(self):
        for shape, p, n, want in (
            (Box(2, 2, 2), [-3, 1, 0], [1, 0, 0], [-1, 0, 0]),
            (Box(2, 2, 2), [-3, 2, 0], [2, -1, 0], [-1, 0, 0]),
            (Box(2, 2, 2), [-2, 3, 0], [1, -2, 0], [0, 1, 0]),
            (Cylinder(1, 2), [-3, 0, 1], [1, 0, 0], [-1, 0, 0]),
            (Cylinder(1, 2), [1, 0, 5], [0, 0, -1], [0, 0, 1]),
            (Cylinder(1, 2), [0, 0.5, -5], [0, 0, 1], [0, 0, -1]),
        ):
            with self.subTest(p=p, n=n):
                scene = oracle.Scene()
                scene.add(shape)
                dut = mut.RayCaster(scene.inspector)
                X_WF = dut.poses_from_query_object(scene.query_object())
                p_WR, n_WR = [p], [np.array(n) / np.linalg.norm(n)]
                hits = dut.cast(X_WF, p_WR, n_WR)
                self.assertTrue(np.isfinite(hits[0][0]))
                normals = dut.calc_normals(X_WF, p_WR, n_WR, *hits)
                np.testing.assert_array_equal(normals[0], want)

    def test_wrong_arguments(self):
        scene = oracle.Scene()
        dut = mut.RayCaster(scene.inspector)
        X_WF = dut.poses_from_query_object(scene.query_object())
        three = np.zeros((3, 3))
        with self.assertRaisesRegex(ValueError, "do not belong together"):
            dut.calc_normals(X_WF, three, three, np.zeros(2), np.zeros(2))
        for bad in (0, -2):
            with self.assertRaisesRegex(ValueError, "geometry_index"):
                dut.calc_normals(X_WF, three, three, np.ones(3), [-1, bad, -1])
        with self.assertRaisesRegex(ValueError, "geometry_index"):
            dut.calc_normals(X_WF, three, three, np.ones(3), [-1, -0.5, -1])

    def test_numbers_that_are_none(self):
        scene = oracle.Scene()
        scene.add(Sphere(1.0))
        dut = mut.RayCaster(scene.inspector)
        X_WF = dut.poses_from_query_object(scene.query_object())
        p, n = np.array([[-3.0, 0, 0]]), np.array([[1.0, 0, 0]])
        hits = dut.cast(X_WF, p, n)
        dut.calc_normals(X_WF, p, n, *hits)
        bundles = dut.make_bundles(
            frame_id=dut.frame_ids[0],
            X_FS=[RigidTransform()],
            fan_S=n,
            max_range=5.0,
        )
        dut.calc_rays(bundles, X_WF)
        for bad in (2.0 * X_WF, np.nan * X_WF):
            with self.assertRaisesRegex(ValueError, "X_WF"):
                dut.calc_normals(bad, p, n, *hits)
            with self.assertRaisesRegex(ValueError, "X_WF"):
                dut.calc_rays(bundles, bad)
        for bad_p, bad_n in ((p + np.inf, n), (p, 2.0 * n), (p, np.nan * n)):
            with self.assertRaisesRegex(ValueError, "p_WR, n_WR"):
                dut.calc_normals(X_WF, bad_p, bad_n, *hits)


class TestRayCaster(unittest.TestCase):
    def test_roles_and_subsets(self):
        scene = oracle.Scene()
        seen = scene.add(Sphere(0.1), RigidTransform([1, 0, 0]))
        other = scene.add(Sphere(0.1), RigidTransform([2, 0, 0]))
        touched = scene.add(
            Sphere(0.1), RigidTransform([0.5, 0, 0]), role=Role.kProximity
        )
        scene.add(
            Sphere(0.1), RigidTransform([0.4, 0, 0]), role=Role.kIllustration
        )
        ray = ([[0.0, 0, 0]], [[1.0, 0, 0]])
        query_object = scene.query_object()
        for kwargs, expected in (
            (dict(), 0.9),
            (dict(geometry_ids=[other]), 1.9),
            (dict(role=Role.kProximity), 0.4),
            (dict(role=Role.kIllustration), 0.3),
            (dict(geometry_ids=[]), np.inf),
        ):
            dut = mut.RayCaster(scene.inspector, **kwargs)
            distance, _ = dut.cast(query_object, *ray)
            self.assertAlmostEqual(distance[0], expected, delta=1e-15)
        dut = mut.RayCaster(scene.inspector)
        self.assertEqual(set(dut.geometry_ids), {seen, other})
        self.assertAlmostEqual(
            dut.cast(query_object, *ray, excluded=[seen])[0][0], 1.9
        )
        with self.assertRaisesRegex(ValueError, "shape_2.*perception"):
            mut.RayCaster(scene.inspector, geometry_ids=[touched])
        with self.assertRaisesRegex(ValueError, "does not know.*perception"):
            mut.RayCaster(
                scene.inspector, geometry_ids=[seen, GeometryId.get_new_id()]
            )
        with self.assertRaisesRegex(ValueError, "role: kUnassigned"):
            mut.RayCaster(scene.inspector, role=Role.kUnassigned)

    def test_excluded_must_be_geometry_ids(self):
        """The index that a cast returns would exclude nothing."""
        scene = oracle.Scene()
        seen = scene.add(Sphere(0.1))
        frame = scene.add_frame()
        dut = mut.RayCaster(scene.inspector)
        ray = scene.query_object(), [[-1.0, 0, 0]], [[1.0, 0, 0]]
        _, index = dut.cast(*ray)
        bundle = dict(
            frame_id=dut.world_frame_id,
            X_FS=[RigidTransform()],
            fan_S=[[1.0, 0, 0]],
            max_range=1.0,
        )
        for bad, message in (
            ([0], "has 0, a int.*get_geometry_ids"),
            (index, "has .*0.*, a int64.*get_geometry_ids"),
            ("abc", "has 'a', a str"),
            ([frame], "has .*, a FrameId"),
            ([seen, None], "has None"),
            ([[seen]], "has .*, a list"),
            (np.zeros((2, 3)), "has .*, a ndarray"),
            (seen, "<GeometryId.* is not a collection of GeometryIds"),
            (0, "0 is not a collection"),
            (None, "None is not a collection"),
        ):
            with self.subTest(bad=bad):
                with self.assertRaisesRegex(
                    ValueError, f"^excluded: {message}"
                ) as caught:
                    dut.cast(*ray, excluded=bad)
                self.assertEqual(len(str(caught.exception).splitlines()), 1)
                with self.assertRaisesRegex(
                    ValueError, rf"^excluded\[0\]: {message}"
                ):
                    dut.make_bundles(**bundle, excluded=[bad])
        with self.assertRaisesRegex(ValueError, "excluded: 0 is not"):
            dut.make_bundles(**bundle, excluded=0)
        with self.assertRaisesRegex(ValueError, "geometry_ids: has 0, a int"):
            mut.RayCaster(scene.inspector, geometry_ids=[0])
        for good in ([seen], {seen}, dut.get_geometry_ids(index), iter([seen])):
            self.assertEqual(dut.cast(*ray, excluded=good)[1][0], -1)
        stranger = GeometryId.get_new_id()
        self.assertEqual(dut.cast(*ray, excluded=[stranger])[1][0], 0)
        bundles = dut.make_bundles(**bundle, excluded=[{seen, stranger}])
        self.assertEqual(bundles.active.tolist(), [[False]])

    def test_lists_of_ids_are_the_callers_own(self):
        """Sorting or emptying them does not change what is seen."""
        scene = oracle.Scene()
        for _ in range(2):
            scene.add(Sphere(0.1), None, scene.add_frame())
        dut = mut.RayCaster(scene.inspector)
        geometry_ids, frame_ids = [*dut.geometry_ids], [*dut.frame_ids]
        dut.geometry_ids.reverse()
        dut.frame_ids.clear()
        self.assertEqual(dut.geometry_ids, geometry_ids)
        self.assertEqual(dut.frame_ids, frame_ids)
        self.assertEqual(
            dut.get_geometry_ids(np.arange(len(geometry_ids))).tolist(),
            geometry_ids,
        )

    def test_unsupported_shape_is_named(self):
        scene = oracle.Scene()
        scene.add(MeshcatCone(1.0), name="horn")
        with self.assertRaisesRegex(UserError, "horn.*MeshcatCone"):
            mut.RayCaster(scene.inspector)

    def test_deformable_geometry_is_named(self):
        scene = oracle.Scene(Role.kProximity)
        seen = scene.add(Sphere(0.1))
        jelly = GeometryInstance(RigidTransform(), Sphere(0.1), "jelly")
        jelly.set_proximity_properties(ProximityProperties())
        scene.scene_graph.RegisterDeformableGeometry(
            scene.source_id, scene.scene_graph.world_frame_id(), jelly, 0.1
        )
        with self.assertRaisesRegex(UserError, "'jelly': a deformable"):
            mut.RayCaster(scene.inspector, role=Role.kProximity)
        dut = mut.RayCaster(
            scene.inspector, role=Role.kProximity, geometry_ids=[seen]
        )
        self.assertEqual(dut.geometry_ids, [seen])

    def test_geometry_ids_of_hits(self):
        scene = oracle.Scene()
        ids = [
            scene.add(Sphere(0.1), RigidTransform([0, y, 0])) for y in (0, 1)
        ]
        dut = mut.RayCaster(scene.inspector)
        p_WR = [[-1.0, 1, 0], [-1, 0, 0], [-1, 2, 0], [-1, 1, 0]]
        _, index = dut.cast(scene.query_object(), p_WR, [[1.0, 0, 0]] * 4)
        expected = [ids[1], ids[0], None, ids[1]]
        actual = dut.get_geometry_ids(index.reshape(2, 2))
        self.assertEqual(actual.shape, (2, 2))
        self.assertEqual(actual.ravel().tolist(), expected)
        for bad in ([2], [-2]):
            with self.assertRaisesRegex(ValueError, "geometry_index"):
                dut.get_geometry_ids(np.array(bad))

    def test_query_object_of_nobody(self):
        """Drake's own inspector of it ends the process."""
        for moving in (False, True):
            scene = oracle.Scene()
            scene.add(Sphere(0.1), None, scene.add_frame() if moving else None)
            dut = mut.RayCaster(scene.inspector)
            with self.assertRaisesRegex(RuntimeError, "invalid QueryObject"):
                dut.poses_from_query_object(QueryObject())

    def test_query_object_of_another_scalar(self):
        scene = oracle.Scene()
        scene.add(Sphere(0.1))
        dut = mut.RayCaster(scene.inspector)
        ray = [[1.0, 0, 0]], [[1.0, 0, 0]]
        for function in (
            dut.poses_from_query_object,
            lambda query_object: dut.cast(query_object, *ray),
        ):
            with self.assertRaisesRegex(TypeError, "AutoDiffXd.*of floats"):
                function(QueryObject_[AutoDiffXd]())

    def test_query_object_of_another_scene_graph(self):
        for moving in (False, True):
            scenes = [oracle.Scene() for _ in range(2)]
            for scene in scenes:
                scene.add(
                    Sphere(0.1), None, scene.add_frame() if moving else None
                )
            dut = mut.RayCaster(scenes[0].inspector)
            with self.assertRaisesRegex(RuntimeError, "removed; make a new"):
                dut.poses_from_query_object(scenes[1].query_object())

    def test_geometry_that_came_or_went_is_noticed(self):
        for role in (Role.kPerception, Role.kProximity, Role.kIllustration):
            with self.subTest(role=role):
                scene = oracle.Scene(role)
                scene.add(Sphere(0.1))
                dut = mut.RayCaster(scene.inspector, role=role)
                dut.poses_from_query_object(scene.query_object())
                gone = scene.add(Sphere(0.2), name="late")
                scene.context = None
                for _ in range(2):
                    with self.assertRaisesRegex(RuntimeError, "'late'.*added"):
                        dut.poses_from_query_object(scene.query_object())
                dut = mut.RayCaster(scene.inspector, role=role)
                scene.scene_graph.RemoveGeometry(
                    scene.context, scene.source_id, gone
                )
                with self.assertRaisesRegex(RuntimeError, "removed"):
                    dut.poses_from_query_object(scene.query_object())

    def test_geometry_that_changed_is_noticed(self):
        scene = oracle.Scene(Role.kProximity)
        changed = scene.add(Sphere(0.1))
        dut = mut.RayCaster(scene.inspector, role=Role.kProximity)
        dut.poses_from_query_object(scene.query_object())
        scene.scene_graph.ChangeShape(
            scene.context, scene.source_id, changed, Sphere(0.2)
        )
        with self.assertRaisesRegex(RuntimeError, "shape_0' was changed"):
            dut.poses_from_query_object(scene.query_object())

    def test_geometry_that_was_swapped_is_noticed(self):
        """As many as before, and without a renderer Drake counts no version."""
        for subset in (False, True):
            with self.subTest(subset=subset):
                scene = oracle.Scene()
                scene.add(Box(1, 1, 1))
                gone = scene.add(Sphere(0.1))
                geometry_ids = [gone] if subset else None
                dut = mut.RayCaster(scene.inspector, geometry_ids=geometry_ids)
                dut.poses_from_query_object(scene.query_object())
                scene.scene_graph.RemoveGeometry(
                    scene.context, scene.source_id, gone
                )
                late = GeometryInstance(RigidTransform(), Sphere(0.2), "late")
                late.set_perception_properties(PerceptionProperties())
                scene.scene_graph.RegisterGeometry(
                    scene.context,
                    scene.source_id,
                    scene.inspector.world_frame_id(),
                    late,
                )
                for _ in range(2):
                    with self.assertRaisesRegex(RuntimeError, "was removed"):
                        dut.poses_from_query_object(scene.query_object())

    def test_changed_geometry_of_two_roles_is_noticed(self):
        """Visuals that a plant registers have both roles."""
        scene = oracle.Scene()
        changed = scene.add(Sphere(0.1))
        scene.scene_graph.AssignRole(
            scene.source_id, changed, IllustrationProperties()
        )
        dut = mut.RayCaster(scene.inspector)
        dut.poses_from_query_object(scene.query_object())
        scene.scene_graph.ChangeShape(
            scene.context, scene.source_id, changed, Sphere(0.2)
        )
        with self.assertRaisesRegex(RuntimeError, "shape_0' was changed"):
            dut.poses_from_query_object(scene.query_object())

    def test_change_beside_a_subset_is_none(self):
        scene = oracle.Scene()
        wanted = scene.add(Sphere(0.1))
        dut = mut.RayCaster(scene.inspector, geometry_ids=[wanted])
        scene.add(Sphere(0.2))
        dut.poses_from_query_object(scene.query_object())

    def test_geometry_of_another_role_does_not_matter(self):
        scene = oracle.Scene()
        scene.add(Sphere(0.1))
        dut = mut.RayCaster(scene.inspector)
        scene.add(Sphere(0.2), role=Role.kProximity)
        dut.poses_from_query_object(scene.query_object())

    def test_scene_without_shapes(self):
        scene = oracle.Scene()
        dut = mut.RayCaster(scene.inspector)
        distance, index = dut.cast(
            scene.query_object(), [[0.0, 0, 0]], [[1.0, 0, 0]]
        )
        self.assertEqual((distance[0], index[0]), (np.inf, -1))
