"""A fast way to pose a copy of the cell.

The monitor's occlusion mask has its own copy of the cell, the twin, and poses
it from measured joints at each sensor's own sample time. `TwinPoses` does
that without a plant context.
"""

import dataclasses as dc

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.chain import find_chain
from tofssm_drake.arms.kinematics import (
    ArmKinematics,
    Chain,
    calc_link_poses,
)
from tofssm_drake.carried_objects import CarriableObjects, calc_object_pose
from tofssm_drake.errors import UserError
from tofssm_drake.kernels import njit

_KIND = 12
"""Column of a frame's kind, after its pose row by row."""


@njit(cache=True)
def calc_twin_poses(chain, X_AT, X_TO, X_WO, frames, q, carried, X_WF):
    """Poses frames that stand still, ride on the robot or are on objects.

    What is fixed comes in few arrays: each one costs a fraction of a
    microsecond on the way into compiled code.

    Args:
        chain: The robot's, as in `calc_link_poses`.
        X_AT: Pose of the tool centre point in the last link, row by row,
            (12,).
        X_TO: Of `CarriableObjects`, as the next.
        X_WO: The objects' places.
        frames: Of each frame its pose in world, in its link, or in its
            object, row by row, and its kind: -1 stands still, 0 to n rides
            on that link, n + 1 + i is object i; (f, 13).
        q: Joint positions, rad or m, (n,).
        carried: Place of each object, or ON_TOOL, (p,).
        X_WF: Changed, (f, 3, 4).
    """
    n = q.shape[0]
    X_WA = np.empty((n + 1, 3, 4))
    calc_link_poses(chain, q, X_WA)
    X_WT = np.empty((3, 4))
    _multiply(X_WA[n], X_AT, X_WT)
    X_WP = np.empty((3, 4))
    for f in range(frames.shape[0]):
        kind = int(frames[f, _KIND])
        X_AF = frames[f]
        X_WF_f = X_WF[f]
        if kind < 0:
            for i in range(3):
                for j in range(4):
                    X_WF_f[i, j] = X_AF[4 * i + j]
        elif kind <= n:
            _multiply(X_WA[kind], X_AF, X_WF_f)
        else:
            i = kind - n - 1
            calc_object_pose(X_TO, X_WO, i, carried[i], X_WT, X_WP)
            _multiply(X_WP, X_AF, X_WF_f)


@njit(cache=True)
def _multiply(X_AB, X_BC, X_AC):
    """Writes X_AC; X_BC has its twelve numbers row by row."""
    for row in range(3):
        for column in range(4):
            total = X_AB[row, 3] if column == 3 else 0.0
            for k in range(3):
                total += X_AB[row, k] * X_BC[4 * k + column]
            X_AC[row, column] = total


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TwinPoses:
    """Poses the twin's frames from joints and carried objects.

    Made by `from_plant`; one compiled call per set of poses, no context.
    """

    chain: Chain
    """As in `calc_twin_poses`, like the next two."""
    X_AT: np.ndarray
    frames: np.ndarray
    objects: CarriableObjects
    """That the robot may carry."""

    @property
    def num_joints(self) -> int:
        """Number of the robot's joints."""
        return len(self.chain.slides)

    @property
    def num_objects(self) -> int:
        """Number of objects that the robot may carry."""
        return len(self.objects)

    @staticmethod
    def from_plant(
        plant: MultibodyPlant,
        *,
        objects: CarriableObjects,
        frame_ids: list | None = None,
        frames: list | None = None,
        kinematics: ArmKinematics | None = None,
    ) -> "TwinPoses":
        """Reads the fixed transforms once.

        Args:
            plant: Finalized, from `make_twin_plant`.
            objects: Those of the plant.
            frame_ids: SceneGraph frames to pose, e.g. a ray caster's; their
                plant must be registered with that SceneGraph.
            frames: Or plant frames to pose.
            kinematics: Of the plant's robot, if at hand.

        Raises:
            UserError: If a frame is neither fixed in the cell, nor a part of
                the robot, nor one of the objects.
        """
        kinematics = kinematics or ArmKinematics.from_plant(plant)
        if frames is None:
            frames = _find_frames(plant, frame_ids or [])
        return TwinPoses(
            chain=kinematics.chain,
            X_AT=kinematics.X_AS[-1].ravel(),
            frames=_fix_frames(plant, frames, len(objects)),
            objects=objects,
        )

    def calc(
        self,
        q: np.ndarray,
        carried: np.ndarray,
        X_WF: np.ndarray | None = None,
    ) -> np.ndarray:
        """Returns X_WF (f, 3, 4).

        Args:
            q: Joint positions, rad or m, (n,).
            carried: Place of each object, or ON_TOOL, (p,).
            X_WF: Where to write, if given.
        """
        if X_WF is None:
            X_WF = np.empty((len(self.frames), 3, 4))
        calc_twin_poses(
            self.chain,
            self.X_AT,
            self.objects.X_TO,
            self.objects.X_WO,
            self.frames,
            q,
            carried,
            X_WF,
        )
        return X_WF


def _find_frames(plant, frame_ids):
    """Returns the plant's frames of SceneGraph frames."""
    frames = []
    for frame_id in frame_ids:
        body = plant.GetBodyFromFrameId(frame_id)
        if body is None:
            raise UserError("twin: a frame belongs to no body of it")
        frames.append(body.body_frame())
    return frames


def _fix_frames(plant, frames, objects):
    """Returns `frames` as in `calc_twin_poses`."""
    links = find_chain(plant)
    n = len(links.joints)
    context = links.context
    object_of = _find_objects(plant, objects)
    rows = np.empty((len(frames), _KIND + 1))
    for row, frame in zip(rows, frames, strict=True):
        body = frame.body()
        link = links.link_of.get(body.index())
        if link:
            row[_KIND] = link
            X_AF = links.calc_pose_in_link(frame, link)
        elif body.index() in object_of:
            i = object_of[body.index()]
            row[_KIND] = n + 1 + i
            X_AF = frame.CalcPoseInBodyFrame(context)
        elif plant.IsAnchored(body):
            # The base stands still, as does everything welded to it.
            row[_KIND] = -1
            X_AF = frame.CalcPoseInWorld(context)
        else:
            raise UserError(
                f"twin: body {body.name()} is neither robot, cell nor object"
            )
        row[:_KIND] = X_AF.GetAsMatrix34().ravel()
    return rows


def _find_objects(plant, objects):
    """Returns the number of each object by its body's index."""
    return {
        plant.GetBodyByName(
            "product", plant.GetModelInstanceByName(f"product_{i}")
        ).index(): i
        for i in range(objects)
    }
