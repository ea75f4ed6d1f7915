"""The poses of many frames from a QueryObject in one go.

pydrake hands out one pose at a time, as a reference to where Drake keeps it,
and one more call turns it into an array. For the 43 frames of a robot's cell
that takes twice as long as to cast 600 rays. But a SceneGraph keeps the poses
of all frames of a Context in one row, in the order in which they were
registered, and brings all of them up to date when it is asked for any.

This is how Drake works inside and nothing that it promises. So it is looked
at, not taken for granted: how a pose lies in memory when a reader is made, and
the row when a Context is met for the first time. If anything is not as
expected, the poses are asked for one by one.
"""

from collections.abc import Sequence
import ctypes

import numpy as np
from pydrake.geometry import FrameId, QueryObject
from pydrake.math import RigidTransform, RollPitchYaw

# A RigidTransform in memory: rotation's columns, then translation.
_NUMBERS = 12
_BYTES = _NUMBERS * ctypes.sizeof(ctypes.c_double)
_ROTATION_BYTES = 9 * ctypes.sizeof(ctypes.c_double)
_ORDER = np.vstack([np.arange(9).reshape(3, 3), [9, 10, 11]]).T
# Contexts that are remembered, by two numbers each.
_MOST_ROWS = 1000


class PoseReader:
    """Reads the poses of some frames of a SceneGraph.

    Each query asks Drake for one pose, which updates all of them and tells by
    its address where they are.
    """

    def __init__(
        self, frame_ids: Sequence[FrameId], *, world_frame_id: FrameId
    ):
        """Takes the frames.

        Args:
            frame_ids: The frames. A SceneGraph never loses one.
            world_frame_id: The world frame, which may be one of them.
        """
        self._frame_ids = list(frame_ids)
        # Not the world frame, which has the same id in all SceneGraphs.
        self._probe = next(
            (i for i, f in enumerate(frame_ids) if f != world_frame_id), None
        )
        self._world_frame_id = world_frame_id
        self._is_readable = _is_layout_known()
        # Start and number of frames of each row that was looked at.
        self._rows: set[tuple[int, int]] = set()
        # Of the numbers in the row, and of the probe's pose, in bytes.
        self._indices: np.ndarray | None = None
        self._probe_offset = 0
        self._row_type = ctypes.c_double * 0

    def read(self, query_object: QueryObject) -> np.ndarray:
        """Returns the poses X_WF, shape (num_frames, 3, 4).

        Args:
            query_object: Of the SceneGraph that has the frames. (One that is
                another clone of the same SceneGraph, with the same frames in
                another order, is noticed but for one case: at the very place
                in memory of a Context that was read before and is gone.)

        Raises:
            RuntimeError: If the QueryObject is no port's, or does not know a
                frame.
        """
        if self._probe is None:
            query_object.GetPoseInWorld(self._world_frame_id)
            return np.tile(np.eye(3, 4), (len(self._frame_ids), 1, 1))
        if not self._is_readable or type(query_object) is not QueryObject:
            return _as_array(self._ask(query_object))
        probe = query_object.GetPoseInWorld(self._frame_ids[self._probe])
        start = _find_address(probe) - self._probe_offset
        num_frames = query_object.inspector().num_frames()
        if (start, num_frames) in self._rows:
            row = np.frombuffer(self._row_type.from_address(start))
            return row.take(self._indices)
        X_WF = self._ask(query_object)
        poses = _as_array(X_WF)
        self._look_at_row(X_WF, poses, num_frames)
        return poses

    def _ask(self, query_object) -> list[RigidTransform]:
        return list(map(query_object.GetPoseInWorld, self._frame_ids))

    def _look_at_row(self, X_WF, poses, num_frames):
        """Remembers where the poses are, if they are as they should be."""
        addresses = np.array([_find_address(X) for X in X_WF])
        start = int(addresses.min())
        places, rest = np.divmod(addresses - start, _BYTES)
        indices = _NUMBERS * places[:, np.newaxis, np.newaxis] + _ORDER
        count = _NUMBERS * (int(places.max()) + 1)
        row_type = ctypes.c_double * count
        self._is_readable = (
            not rest.any()
            and count <= _NUMBERS * num_frames
            and (
                self._indices is None or np.array_equal(indices, self._indices)
            )
            and np.array_equal(
                np.frombuffer(row_type.from_address(start)).take(indices),
                poses,
            )
        )
        if self._is_readable:
            self._indices, self._row_type = indices, row_type
            self._probe_offset = int(addresses[self._probe]) - start
            if len(self._rows) == _MOST_ROWS:
                self._rows.clear()
            self._rows.add((start, num_frames))


def _as_array(X_WF: Sequence[RigidTransform]) -> np.ndarray:
    """Returns the poses, shape (n, 3, 4)."""
    return np.concatenate(
        list(map(RigidTransform.GetAsMatrix34, X_WF))
    ).reshape(-1, 3, 4)


def _find_address(pose: RigidTransform) -> int:
    """Returns where a pose is; its translation is a view of the last part."""
    view = pose.translation().__array_interface__
    return view["data"][0] - _ROTATION_BYTES


def _is_layout_known() -> bool:
    """Returns whether a pose is in memory what this module reads there."""
    # No two of its numbers are equal.
    pose = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1.0, 2.0, 3.0])
    numbers = (ctypes.c_double * _NUMBERS).from_address(_find_address(pose))
    return np.array_equal(
        np.frombuffer(numbers).take(_ORDER), pose.GetAsMatrix34()
    )
