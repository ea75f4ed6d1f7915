"""Poses for a ray caster without a QueryObject.

To make a QueryObject Drake updates everything that it knows of the scene. A
caller that poses the geometry itself already has the poses.
"""

from collections.abc import Sequence
import operator

import numpy as np
from pydrake.geometry import FrameId
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.raycast.ray_caster import RayCaster


class FramePoses:
    """Gathers the poses that a RayCaster needs.

    They come from a MultibodyPlant's `body_poses` output port and, for frames
    of any other source, from an array. Make it after the caster's bundles.
    """

    def __init__(
        self,
        *,
        caster: RayCaster,
        plant: MultibodyPlant | None = None,
        frame_ids: Sequence[FrameId] = (),
    ):
        """Assigns a source to each frame.

        Args:
            caster: Whose `frame_ids` are to be posed.
            plant: Poses the frames of its bodies, but for those in
                `frame_ids`.
            frame_ids: The frames that are posed by an array, in its order;
                those that the caster does not need are skipped.

        Raises:
            ValueError: If nothing poses a frame, or the array does so twice.
        """
        rows = {f: row for row, f in enumerate(frame_ids)}
        if len(rows) != len(frame_ids):
            raise ValueError("frame_ids: names a frame twice")
        self._num_given = len(frame_ids)
        bodies, self._body_rows = [], []
        self._given, self._given_rows = [], []
        self._X_WF = np.tile(np.eye(3, 4), (len(caster.frame_ids), 1, 1))
        for row, frame_id in enumerate(caster.frame_ids):
            if frame_id in rows:
                self._given.append(rows[frame_id])
                self._given_rows.append(row)
                continue
            if frame_id == caster.world_frame_id:
                continue
            body = plant and plant.GetBodyFromFrameId(frame_id)
            if not body:
                raise ValueError(
                    f"nothing poses the frame {frame_id}: it is not one of the"
                    f" {len(frame_ids)} frame_ids and"
                    " belongs to no body of the plant"
                )
            bodies.append(int(body.index()))
            self._body_rows.append(row)
        self._num_bodies = len(bodies)
        self._take_bodies = _make_taker(bodies)
        self._given = _as_slice(self._given)
        self._given_rows = _as_slice(self._given_rows)
        self._body_rows = _as_slice(self._body_rows)

    def calc(
        self,
        *,
        X_WB: Sequence[RigidTransform] = (),
        X_WF: np.ndarray | None = None,
    ) -> np.ndarray:
        """Returns the poses of the caster's frames, (num_frames, 3, 4).

        Args:
            X_WB: Value of the plant's `body_poses` port; not needed if the
                caster needs no body of a plant.
            X_WF: Poses of `frame_ids`, shape (n, 3, 4); not needed if there
                are none.

        Raises:
            ValueError: If X_WF has another shape.
            IndexError: If X_WB has too few bodies.
        """
        poses = self._X_WF.copy()
        if self._num_bodies:
            poses[self._body_rows] = np.concatenate(
                list(map(RigidTransform.GetAsMatrix34, self._take_bodies(X_WB)))
            ).reshape(-1, 3, 4)
        if self._num_given:
            shape = (self._num_given, 3, 4)
            if X_WF is None or np.shape(X_WF) != shape:
                given = () if X_WF is None else np.shape(X_WF)
                raise ValueError(f"X_WF: shape {given} is not {shape}")
            poses[self._given_rows] = X_WF[self._given]
        return poses


def _make_taker(indices: list[int]):
    """Returns a function that takes the items of a list."""
    if len(indices) == 1:
        return lambda items: (items[indices[0]],)
    return operator.itemgetter(*indices) if indices else tuple


def _as_slice(indices: list[int]):
    """Returns a slice if it does the same: it is copied in one go."""
    if indices and indices == list(
        range(indices[0], indices[0] + len(indices))
    ):
        return slice(indices[0], indices[0] + len(indices))
    return np.array(indices, dtype=np.intp)
