"""Poses that are read where Drake keeps them, against Drake's functions."""

import gc
import unittest
from unittest import mock

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.geometry import (
    FramePoseVector,
    GeometryFrame,
    QueryObject,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix

import tofssm_drake.geometry.pose_reader as mut


class Frames:
    """A SceneGraph with some frames."""

    def __init__(self, count):
        self.scene_graph = SceneGraph()
        self.source_id = self.scene_graph.RegisterSource("test")
        self.frame_ids = [self.add(f"frame_{i}") for i in range(count)]
        self.random = np.random.default_rng(7)

    def add(self, name):
        return self.scene_graph.RegisterFrame(
            self.source_id, GeometryFrame(name)
        )

    def make_context(self):
        return self.scene_graph.CreateDefaultContext()

    def query(self, context, frame_ids=None):
        """Poses all frames anew."""
        poses = FramePoseVector()
        for frame_id in self.frame_ids if frame_ids is None else frame_ids:
            q = self.random.normal(size=4)
            X = RigidTransform(
                RotationMatrix(Quaternion(q / np.linalg.norm(q))),
                self.random.normal(size=3),
            )
            poses.set_value(frame_id, X)
        self.scene_graph.get_source_pose_port(self.source_id).FixValue(
            context, Value(poses)
        )
        return self.scene_graph.get_query_output_port().Eval(context)


def ask_one_by_one(query_object, frame_ids):
    return np.array(
        [query_object.GetPoseInWorld(f).GetAsMatrix34() for f in frame_ids]
    ).reshape(-1, 3, 4)


class TestPoseReader(unittest.TestCase):
    def setUp(self):
        self.frames = Frames(9)
        self.world = self.frames.scene_graph.world_frame_id()
        ids = self.frames.frame_ids
        # Neither in order nor all of them.
        self.wanted = [ids[5], self.world, ids[0], ids[8], ids[3]]
        self.dut = mut.PoseReader(self.wanted, world_frame_id=self.world)

    def check(self, query_object, dut=None):
        poses = (self.dut if dut is None else dut).read(query_object)
        np.testing.assert_array_equal(
            poses, ask_one_by_one(query_object, self.wanted)
        )
        return poses

    def test_like_one_by_one(self):
        contexts = [self.frames.make_context() for _ in range(3)]
        contexts.append(contexts[0].Clone())
        for i in range(40):
            self.check(self.frames.query(contexts[i % len(contexts)]))

    def test_memory_is_what_is_read(self):
        """From the second query on Drake's poses are not converted."""
        context = self.frames.make_context()
        self.check(self.frames.query(context))
        query_object = self.frames.query(context)
        expected = ask_one_by_one(query_object, self.wanted)
        with mock.patch.object(mut, "_as_array", side_effect=AssertionError):
            np.testing.assert_array_equal(self.dut.read(query_object), expected)

    def test_result_is_a_copy(self):
        context = self.frames.make_context()
        self.frames.query(context)
        poses = [self.check(self.frames.query(context)) for _ in range(3)]
        kept = poses[1].copy()
        poses[2][:] = 0.0
        self.check(self.frames.query(context))
        np.testing.assert_array_equal(poses[1], kept)

    def test_contexts_that_come_and_go(self):
        """Their memory is used again, for other Contexts and other things."""
        for i in range(200):
            context = self.frames.make_context()
            others = [np.full(12 * 10, float(i)) for _ in range(i % 5)]
            self.check(self.frames.query(context))
            self.check(self.frames.query(context))
            del context, others
            gc.collect(0)

    def test_many_contexts(self):
        contexts = [self.frames.make_context() for _ in range(40)]
        for _ in range(2):
            for context in contexts:
                self.check(self.frames.query(context))

    def test_frames_that_came_later(self):
        old = self.frames.make_context()
        frame_ids = self.frames.frame_ids
        early = self.check(self.frames.query(old, frame_ids))
        for i in range(30):
            self.frames.frame_ids = [
                *self.frames.frame_ids,
                self.frames.add(f"late_{i}"),
            ]
            self.check(self.frames.query(self.frames.make_context()))
        late = self.check(self.frames.query(old, frame_ids))
        self.assertFalse(np.array_equal(early, late))
        dut = mut.PoseReader(self.frames.frame_ids, world_frame_id=self.world)
        dut.read(self.frames.query(self.frames.make_context()))
        # One that does not know them.
        for _ in range(2):
            with self.assertRaisesRegex(RuntimeError, "invalid frame id"):
                dut.read(self.frames.query(old, frame_ids))

    def test_other_memory_is_never_read(self):
        """What does not look as expected is left to Drake's functions."""
        for name, value in (
            # Rows for columns.
            ("_ORDER", np.hstack([mut._ORDER[:, :3].T, mut._ORDER[:, 3:]])),
            ("_ROTATION_BYTES", 64),
            ("_BYTES", 80),
        ):
            with self.subTest(name=name), mock.patch.object(mut, name, value):
                dut = mut.PoseReader(self.wanted, world_frame_id=self.world)
                context = self.frames.make_context()
                for _ in range(3):
                    self.check(self.frames.query(context), dut)
                self.assertEqual(dut._rows, set())

    def test_frames_in_another_order(self):
        """Clones of a SceneGraph share ids, and may go on differently."""
        base = Frames(1)
        both = [GeometryFrame("b"), GeometryFrame("c")]
        rooms = []
        for order in (both, both[::-1]):
            room = Frames(0)
            room.scene_graph, room.source_id = (
                base.scene_graph.Clone(),
                base.source_id,
            )
            for frame in order:
                room.scene_graph.RegisterFrame(base.source_id, frame)
            room.frame_ids = [*base.frame_ids, *(f.id() for f in both)]
            rooms.append((room, room.make_context()))
        self.wanted = rooms[0][0].frame_ids
        dut = mut.PoseReader(self.wanted, world_frame_id=self.world)
        for i in (0, 0, 1, 1, 0, 1):
            room, context = rooms[i]
            self.check(room.query(context), dut)

    def test_another_ones_query_object(self):
        """Its poses may be anywhere, and gone."""

        class Playback(QueryObject):
            x = 0.0

            def GetPoseInWorld(self, _):
                return RigidTransform([self.x, 0.0, 0.0])

        query_object = Playback()
        for query_object.x in (1.0, 2.0, 3.0, 4.0):
            self.check(query_object)

    def test_frames_that_do_not_move(self):
        query_object = self.frames.query(self.frames.make_context())
        for wanted in ([], [self.world]):
            dut = mut.PoseReader(wanted, world_frame_id=self.world)
            np.testing.assert_array_equal(
                dut.read(query_object), ask_one_by_one(query_object, wanted)
            )
            with self.assertRaisesRegex(RuntimeError, "invalid QueryObject"):
                dut.read(QueryObject())

    def test_wrong_query_objects(self):
        self.check(self.frames.query(self.frames.make_context()))
        other = Frames(9)
        for query_object, message in (
            (QueryObject(), "invalid QueryObject"),
            (other.query(other.make_context()), "invalid frame id"),
        ):
            with self.assertRaisesRegex(RuntimeError, message):
                self.dut.read(query_object)
