"""Inverse kinematics for tasks: the tool at a point, pointing down."""

from typing import NamedTuple

import numpy as np

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.errors import UserError


class UrLengths(NamedTuple):
    """Denavit-Hartenberg lengths of a UR arm, m, with UR's signs."""

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float


def find_ur_lengths(kinematics: ArmKinematics) -> UrLengths | None:
    """Returns the lengths if the arm's joints lie as those of a UR arm.

    Args:
        kinematics: Of any arm. Its base must be UR's own base frame.

    Returns:
        The lengths; None: it is no UR arm.
    """
    chain = kinematics.chain
    if kinematics.num_joints != 6 or chain.slides.any():
        return None
    X = chain.X_PA
    lengths = UrLengths(
        d1=X[0, 2, 3],
        a2=X[2, 0, 3],
        a3=X[3, 0, 3],
        d4=X[3, 2, 3],
        d5=-X[4, 1, 3],
        d6=X[5, 1, 3],
    )
    if min(lengths.d1, lengths.d4, lengths.d5, lengths.d6) <= 0.0:
        return None
    if max(lengths.a2, lengths.a3) >= 0.0:
        return None
    # A model may write pi / 2 with a few digits.
    is_ur = np.allclose(X, calc_ur_joint_poses(lengths), atol=1e-5)
    return lengths if is_ur else None


def calc_ur_joint_poses(lengths: UrLengths) -> np.ndarray:
    """Returns the pose of each joint of a UR arm in the joint before it.

    The frames are those of UR's Denavit-Hartenberg table, but each at its own
    link's beginning: they turn about z, and the last one is the flange.

    Args:
        lengths: Of the arm.

    Returns:
        X_PA at zero angles, (6, 3, 4).
    """
    X = np.tile(np.eye(3, 4), (6, 1, 1))
    # About x by 90, 90 and -90 degrees.
    X[1, :, :3] = X[4, :, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    X[5, :, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    X[0, 2, 3] = lengths.d1
    X[2, 0, 3] = lengths.a2
    X[3, :, 3] = lengths.a3, 0.0, lengths.d4
    X[4, 1, 3] = -lengths.d5
    X[5, 1, 3] = lengths.d6
    return X


def calc_tool_down_joints(
    kinematics: ArmKinematics, p_WT: np.ndarray, yaw: float
) -> np.ndarray:
    """Inverse kinematics of a UR arm with the tool pointing down.

    Of the eight solutions it takes the one that reaches forward over its own
    shoulder with the elbow up and wrist 1 between base and tool.

    Args:
        kinematics: Of the robot; its base must stand upright.
        p_WT: Tool centre point in world, m, (3,).
        yaw: Direction of the tool's x axis about the base's z axis, rad.

    Returns:
        Joint angles, rad, (6,): first and last in (-pi, pi].

    Raises:
        UserError: If the point is out of reach.
    """
    lengths = find_ur_lengths(kinematics)
    if lengths is None:
        raise UserError("robot model: is no UR arm")
    d1, a2, a3, d4, d5, d6 = lengths
    R_WB = kinematics.X_WB[:, :3]
    if not np.allclose(R_WB[:, 2], [0, 0, 1]):
        raise UserError("robot model: the robot's base must stand upright")
    p_BT = R_WB.T @ (np.asarray(p_WT, dtype=float) - kinematics.X_WB[:, 3])
    if kinematics.site_link[-1] != 6:
        raise UserError("robot model: the tool must sit on the flange")
    X_6T = kinematics.X_AS[-1]
    c, s = np.cos(yaw), np.sin(yaw)
    R_BT = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    R_B6 = R_BT @ X_6T[:, :3].T
    if not np.allclose(R_B6[:, 2], [0, 0, -1]):
        raise UserError("robot model: the tool must point out of the flange")
    p_B6 = p_BT - R_B6 @ X_6T[:, 3]
    # Wrist centre: where the axes of wrist 2 and wrist 3 meet.
    x, y = p_B6[0], p_B6[1]
    z = p_B6[2] + d6 - d1
    reach = np.hypot(x, y)
    where = f"point {np.round(np.asarray(p_WT, dtype=float), 4).tolist()}"
    if reach <= d4:
        raise UserError(f"{where}: too near to the robot's axis")
    azimuth = np.arctan2(y, x)
    q0 = azimuth + np.arcsin(d4 / reach)
    r = np.sqrt(reach**2 - d4**2) - d5
    # Two-bar linkage in the arm's plane. The lengths are negative in UR's
    # table: a bar at angle q points to angle q + pi.
    a2, a3 = -a2, -a3
    cosine = (r * r + z * z - a2 * a2 - a3 * a3) / (2 * a2 * a3)
    if abs(cosine) > 1:
        raise UserError(f"{where}: out of the robot's reach")
    q2 = -np.arccos(cosine)
    shoulder = np.arctan2(z, r) - np.arctan2(
        a3 * np.sin(q2), a2 + a3 * np.cos(q2)
    )
    q1 = shoulder - np.pi
    q3 = -1.5 * np.pi - q1 - q2
    q4 = 0.5 * np.pi
    # With the tool down the flange's x axis points along q0 - pi/2 - q5.
    flange_yaw = np.arctan2(R_B6[1, 0], R_B6[0, 0])
    q5 = q0 - 0.5 * np.pi - flange_yaw
    q = np.array([q0, q1, q2, q3, q4, q5])
    for i in (0, 5):
        q[i] = np.pi - (np.pi - q[i]) % (2 * np.pi)
    return q
