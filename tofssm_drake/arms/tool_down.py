"""Inverse kinematics for tasks: the tool at a point, pointing down."""

from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
)

from tofssm_drake.arms.kinematics import ArmKinematics, calc_link_poses
from tofssm_drake.errors import UserError

_PRIMES = np.array([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0])
_NEWTON_STEPS = 20


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
    kinematics: ArmKinematics,
    p_WT: np.ndarray,
    yaw: float,
    guess: np.ndarray | None = None,
) -> np.ndarray:
    """Inverse kinematics with the tool pointing down.

    The same arguments give the same joints, bit for bit.

    Args:
        kinematics: Of the robot; a UR arm's base must stand upright.
        p_WT: Tool centre point in world, m, (3,).
        yaw: Direction of the tool's x axis about the base's z axis, rad.
        guess: Where to search from, rad or m, (n,), for other arms than UR's:
            the solution near it is taken, e.g. that of the point before. By
            default the middle of the joints' ranges. A UR arm's solution is in
            closed form and takes no guess.

    Returns:
        Joint positions, rad or m, (n,), within the arm's limits.

    Raises:
        UserError: If the point is out of reach.
    """
    lengths = find_ur_lengths(kinematics)
    if lengths is not None:
        return calc_ur_tool_down_joints(kinematics, lengths, p_WT, yaw)
    return search_tool_down_joints(kinematics, p_WT, yaw, guess)


def calc_ur_tool_down_joints(
    kinematics: ArmKinematics,
    lengths: UrLengths,
    p_WT: np.ndarray,
    yaw: float,
) -> np.ndarray:
    """Inverse kinematics of a UR arm with the tool pointing down.

    Of the eight solutions it takes the one that reaches forward over its own
    shoulder with the elbow up and wrist 1 between base and tool.

    Args:
        kinematics: Of the robot; its base must stand upright.
        lengths: Of the robot.
        p_WT: Tool centre point in world, m, (3,).
        yaw: Direction of the tool's x axis about the base's z axis, rad.

    Returns:
        Joint angles, rad, (6,): first and last in (-pi, pi].

    Raises:
        UserError: If the point is out of reach.
    """
    d1, a2, a3, d4, d5, d6 = lengths
    R_WB = kinematics.X_WB[:, :3]
    if not np.allclose(R_WB[:, 2], [0, 0, 1]):
        raise UserError("robot model: the robot's base must stand upright")
    p_BT = R_WB.T @ (np.asarray(p_WT, dtype=float) - kinematics.X_WB[:, 3])
    if kinematics.site_link[-1] != kinematics.num_joints:
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


def search_tool_down_joints(
    kinematics: ArmKinematics,
    p_WT: np.ndarray,
    yaw: float,
    guess: np.ndarray | None = None,
) -> np.ndarray:
    """Inverse kinematics of any arm with the tool pointing down.

    Drake's InverseKinematics searches for the joints nearest to the guess, and
    Newton's method on the arm's own kinematics makes them exact. Where the
    search fails it is repeated from some other places.

    Args:
        kinematics: Of the robot.
        p_WT: Tool centre point in world, m, (3,).
        yaw: Direction of the tool's x axis about the base's z axis, rad.
        guess: Where to search from, rad or m, (n,); by default the middle of
            the joints' ranges.

    Returns:
        Joint positions, rad or m, (n,), within the limits; the tool is within
        1e-9 m and 1e-9 rad of where it should be.

    Raises:
        UserError: If no search succeeds.
    """
    p_WT = np.asarray(p_WT, dtype=float)
    c, s = np.cos(yaw), np.sin(yaw)
    R_BT = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    X_WT = np.column_stack([kinematics.X_WB[:, :3] @ R_BT, p_WT])
    plant = make_chain_plant(kinematics)
    for start in _list_starts(kinematics, guess):
        q = _search(plant, X_WT, start)
        if q is not None:
            q = _refine(kinematics, X_WT, q)
        if q is not None:
            return q
    raise UserError(
        f"point {np.round(p_WT, 4).tolist()}: no joints within the robot's "
        "limits bring the tool there, pointing down"
    )


def _list_starts(kinematics, guess):
    """Returns where to search from, (k, n), the best first."""
    low = np.maximum(kinematics.lower, -np.pi)
    high = np.minimum(kinematics.upper, np.pi)
    middle = 0.5 * (low + high)
    first = middle if guess is None else np.asarray(guess, dtype=float)
    first = np.clip(first, kinematics.lower, kinematics.upper)
    # Places spread evenly over the ranges: multiples of square roots of primes.
    step = np.resize(np.sqrt(_PRIMES), len(middle))
    others = np.outer(np.arange(1, 20), step) % 1.0
    return np.vstack([first, middle, low + others * (high - low)])


def make_chain_plant(kinematics: ArmKinematics) -> MultibodyPlant:
    """Returns a plant with an arm's joints alone, and the frame `tcp`.

    Args:
        kinematics: Of the arm.
    """
    plant = MultibodyPlant(0.0)
    chain = kinematics.chain
    parent = plant.world_body()
    X_PA = [_make_transform(X) for X in chain.X_PA]
    X_PA[0] = _make_transform(chain.X_WB).multiply(X_PA[0])
    # Masses have no effect on kinematics.
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    for i, name in enumerate(kinematics.joint_name):
        body = plant.AddRigidBody(f"link_{i + 1}", inertia)
        frame = plant.AddFrame(
            FixedOffsetFrame(f"at_{i + 1}", parent.body_frame(), X_PA[i])
        )
        kind = PrismaticJoint if chain.slides[i] else RevoluteJoint
        joint = plant.AddJoint(
            kind(name, frame, body.body_frame(), np.array([0.0, 0.0, 1.0]))
        )
        joint.set_position_limits(
            kinematics.lower[i : i + 1], kinematics.upper[i : i + 1]
        )
        parent = body
    # The tool is behind the last joint.
    plant.AddFrame(
        FixedOffsetFrame(
            "tcp",
            parent.body_frame(),
            _make_transform(kinematics.X_AS[-1]),
        )
    )
    plant.Finalize()
    return plant


def _make_transform(X):
    return RigidTransform(RotationMatrix(X[:, :3]), X[:, 3])


def _search(plant, X_WT, start):
    """Returns joints that put the tool about there, or None."""
    # Only for these arms: the solvers take long to import.
    from pydrake.multibody.inverse_kinematics import InverseKinematics
    from pydrake.solvers import Solve

    search = InverseKinematics(plant, with_joint_limits=True)
    tool, world = plant.GetFrameByName("tcp"), plant.world_frame()
    p_WT = X_WT[:, 3]
    search.AddPositionConstraint(
        tool, np.zeros(3), world, p_WT - 1e-5, p_WT + 1e-5
    )
    search.AddOrientationConstraint(
        world, RotationMatrix(X_WT[:, :3]), tool, RotationMatrix(), 1e-3
    )
    program, q = search.prog(), search.q()
    program.AddQuadraticErrorCost(np.eye(len(start)), start, q)
    program.SetInitialGuess(q, start)
    result = Solve(program)
    return result.GetSolution(q) if result.is_success() else None


def _refine(kinematics, X_WT, q):
    """Returns joints that put the tool exactly there, or None.

    Newton's method: each step is the shortest that undoes the error.
    """
    for _ in range(_NEWTON_STEPS):
        error = _calc_error(kinematics.calc_tcp_pose(q), X_WT)
        if np.linalg.norm(error) < 1e-11:
            break
        step, *_ = np.linalg.lstsq(_calc_jacobian(kinematics, q), error)
        q = np.clip(q + step, kinematics.lower, kinematics.upper)
    error = _calc_error(kinematics.calc_tcp_pose(q), X_WT)
    return q if np.linalg.norm(error) < 1e-9 else None


def _calc_error(X_WA, X_WT):
    """Returns the motion from one pose to another, m and rad, (6,)."""
    # Small angles: the sines of the turns about the axes.
    turn = 0.5 * np.cross(X_WA[:, :3].T, X_WT[:, :3].T).sum(axis=0)
    return np.concatenate([X_WT[:, 3] - X_WA[:, 3], turn])


def _calc_jacobian(kinematics, q):
    """Returns the tool's velocities, m/s and rad/s, per joint speed, (6, n)."""
    X_WA = np.empty((len(q) + 1, 3, 4))
    calc_link_poses(kinematics.chain, q, X_WA)
    axes = X_WA[1:, :, 2]
    slides = kinematics.chain.slides[:, None]
    p_WT = kinematics.calc_tcp_pose(q)[:, 3]
    across = np.cross(axes, p_WT - X_WA[1:, :, 3])
    linear = np.where(slides, axes, across)
    angular = np.where(slides, 0.0, axes)
    return np.hstack([linear, angular]).T
