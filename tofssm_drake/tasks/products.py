"""The product that tasks carry, and what poses the products of a cell."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.carried_objects import CarriableObjects
from tofssm_drake.kernels import njit

HALF_PRODUCT = 0.0275
"""From a product's middle to its faces, m (models/workcell/product.urdf)."""

X_TO = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
)
"""Pose of a carried product in the tool's frame, m, (3, 4).

Its middle is at the tool centre point; it is turned by half a turn about the
tool's x axis, so that its z points up when the tool points down.
"""
X_TO.setflags(write=False)


def make_upright_pose(point: np.ndarray, yaw: float) -> np.ndarray:
    """Returns the pose of a product that stands upright, m, (3, 4).

    Args:
        point: Its middle in world, m, (3,).
        yaw: Its orientation about the world's z, rad.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [c, -s, 0.0, point[0]],
            [s, c, 0.0, point[1]],
            [0.0, 0.0, 1.0, point[2]],
        ]
    )


@njit(cache=True)
def write_free_body_positions(X, positions):
    """Writes poses as quaternion (w, x, y, z) and position.

    Args:
        X: Poses, (n, 3, 4).
        positions: Written, (n, 7).
    """
    for i in range(X.shape[0]):
        # Dividing by the largest of the four components is well conditioned.
        r = X[i]
        trace = r[0, 0] + r[1, 1] + r[2, 2]
        largest = 0
        value = trace
        for k in range(3):
            if r[k, k] > value:
                value = r[k, k]
                largest = k + 1
        if largest == 0:
            w = np.sqrt(1.0 + trace) / 2
            x = (r[2, 1] - r[1, 2]) / (4 * w)
            y = (r[0, 2] - r[2, 0]) / (4 * w)
            z = (r[1, 0] - r[0, 1]) / (4 * w)
        elif largest == 1:
            x = np.sqrt(1.0 + r[0, 0] - r[1, 1] - r[2, 2]) / 2
            w = (r[2, 1] - r[1, 2]) / (4 * x)
            y = (r[0, 1] + r[1, 0]) / (4 * x)
            z = (r[0, 2] + r[2, 0]) / (4 * x)
        elif largest == 2:
            y = np.sqrt(1.0 - r[0, 0] + r[1, 1] - r[2, 2]) / 2
            w = (r[0, 2] - r[2, 0]) / (4 * y)
            x = (r[0, 1] + r[1, 0]) / (4 * y)
            z = (r[1, 2] + r[2, 1]) / (4 * y)
        else:
            z = np.sqrt(1.0 - r[0, 0] - r[1, 1] + r[2, 2]) / 2
            w = (r[1, 0] - r[0, 1]) / (4 * z)
            x = (r[0, 2] + r[2, 0]) / (4 * z)
            y = (r[1, 2] + r[2, 1]) / (4 * z)
        norm = np.sqrt(w * w + x * x + y * y + z * z)
        positions[i, 0] = w / norm
        positions[i, 1] = x / norm
        positions[i, 2] = y / norm
        positions[i, 3] = z / norm
        positions[i, 4] = r[0, 3]
        positions[i, 5] = r[1, 3]
        positions[i, 6] = r[2, 3]


def calc_object_positions(
    *,
    objects: CarriableObjects,
    kinematics: ArmKinematics,
    q: np.ndarray,
    carried: np.ndarray,
) -> np.ndarray:
    """Returns the positions of the objects as of free bodies.

    Args:
        objects: The task's.
        kinematics: Of the robot; gives the pose of its tool.
        q: Joint positions, rad or m, (n,).
        carried: Place of each object, or ON_TOOL, (p,).

    Returns:
        Quaternion (w, x, y, z) and position in world, m, (p, 7).
    """
    X_WO = objects.calc_poses(carried, kinematics.calc_tcp_pose(q))
    positions = np.empty((len(objects), 7))
    write_free_body_positions(X_WO, positions)
    return positions


class ObjectCarrier(LeafSystem):
    """Outputs where the carriable objects are, as positions of free bodies.

    .. pydrake_system::

        name: ObjectCarrier
        input_ports:
        - position_measured
        - carried_objects
        output_ports:
        - object_positions

    `object_positions` holds, per object, a quaternion (w, x, y, z) and a
    position in world, m: the order of a MultibodyPlant's free bodies.

    Args:
        objects: The task's.
        kinematics: Of the robot.
    """

    def __init__(self, *, objects: CarriableObjects, kinematics: ArmKinematics):
        super().__init__()
        self._objects = objects
        self._kinematics = kinematics
        self._position = self.DeclareVectorInputPort(
            "position_measured", kinematics.num_joints
        )
        self._carried = self.DeclareVectorInputPort(
            "carried_objects", len(objects)
        )
        self.DeclareVectorOutputPort(
            "object_positions",
            7 * len(objects),
            self._calc_object_positions,
            {self._position.ticket(), self._carried.ticket()},
        )

    def _calc_object_positions(
        self, context: Context, output: BasicVector
    ) -> None:
        positions = calc_object_positions(
            objects=self._objects,
            kinematics=self._kinematics,
            q=self._position.Eval(context),
            carried=self._carried.Eval(context),
        )
        output.SetFromVector(positions.reshape(-1))
