"""Where everything is that the rings can see, in one array."""

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import FrameId
from pydrake.systems.framework import Context, LeafSystem

from tofssm_drake.geometry.ray_caster import RayCaster
from tofssm_drake.human.skeleton import calc_capsule_poses
from tofssm_drake.kernels import njit
from tofssm_drake.robot.products import ProductLayout
from tofssm_drake.robot.twin import TwinPoses


class ScenePoses(LeafSystem):
    """Poses a ray caster's frames without a QueryObject.

    .. pydrake_system::

        name: ScenePoses
        input_ports:
        - position_measured
        - gripper_closed
        - products_placed
        - skeleton
        output_ports:
        - frame_poses

    `frame_poses` is X_WF, (f, 3, 4), of `caster.frame_ids`: the same poses as
    `caster.poses_from_query_object` reads, without Drake's update of the
    scene. Robot, cell and products follow from what the robot reports, the
    person from the avatar's `skeleton`.

    Args:
        caster: Of the SceneGraph that holds robot, cell, products, person.
        plant: Finalized; poses all frames but the person's.
        layout: Slots of the products.
        human_frame_ids: The person's frames, one per capsule of `skeleton`;
            none without a person.
    """

    def __init__(
        self,
        *,
        caster: RayCaster,
        plant,
        layout: ProductLayout,
        human_frame_ids: Sequence[FrameId] = (),
    ):
        super().__init__()
        row = {frame_id: i for i, frame_id in enumerate(caster.frame_ids)}
        self._human_rows = np.array([row[f] for f in human_frame_ids], int)
        others = [f for f in caster.frame_ids if f not in set(human_frame_ids)]
        self._poses = TwinPoses.from_plant(
            plant,
            layout=layout,
            frame_ids=others,
            rows=[row[f] for f in others],
        )
        self._num_frames = len(row)
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._gripper_closed = self.DeclareVectorInputPort("gripper_closed", 1)
        self._products_placed = self.DeclareVectorInputPort(
            "products_placed", 1
        )
        self._skeleton = self.DeclareVectorInputPort(
            "skeleton", 6 * len(human_frame_ids)
        )
        self.DeclareAbstractOutputPort(
            "frame_poses",
            lambda: Value(np.zeros((len(row), 3, 4))),
            self._calc_frame_poses,
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _calc_frame_poses(self, context: Context, output):
        X_WF = np.empty((self._num_frames, 3, 4))
        self._poses.calc(
            self._position.Eval(context),
            self._gripper_closed.Eval(context)[0],
            self._products_placed.Eval(context)[0],
            X_WF,
        )
        if len(self._human_rows):
            ends = self._skeleton.Eval(context).reshape(-1, 2, 3)
            _write_capsule_poses(ends, self._human_rows, X_WF)
        output.set_value(X_WF)


@njit(cache=True)
def _write_capsule_poses(ends, rows, X_WF):
    poses = np.empty((ends.shape[0], 3, 4))
    calc_capsule_poses(ends, poses)
    for i in range(rows.shape[0]):
        X_WF[rows[i]] = poses[i]
