"""Closed-form kinematics of the UR10: where its rings and its tool are.

A MultibodyPlant answers the same questions (and the tests hold both to 1e-9
of each other); this module answers in a microsecond, as needed by a monitor
that asks for every sensor's own sample time.
"""

from collections.abc import Mapping, Sequence
import dataclasses as dc

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.errors import UserError
from tofssm_drake.kernels import njit

UR10_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""Joints in UR's order, base to flange."""

UR10_D1 = 0.1273
UR10_A2 = -0.612
UR10_A3 = -0.5723
UR10_D4 = 0.163941
UR10_D5 = 0.1157
UR10_D6 = 0.0922
"""Denavit-Hartenberg lengths as published by Universal Robots, m."""


@njit(cache=True)
def calc_link_poses(X_WB, X_PJ, q, X_WA):
    """Forward kinematics of a chain of joints that turn about their z axes.

    Args:
        X_WB: Pose of the base link in world, (3, 4).
        X_PJ: Pose of each joint's child link in its parent link at angle
            zero, (n, 3, 4).
        q: Joint angles, rad, (n,).
        X_WA: Written: poses of the links in world, base first, (n + 1, 3, 4).
    """
    for row in range(3):
        for column in range(4):
            X_WA[0, row, column] = X_WB[row, column]
    for i in range(q.shape[0]):
        c = np.cos(q[i])
        s = np.sin(q[i])
        for row in range(3):
            a0 = X_WA[i, row, 0]
            a1 = X_WA[i, row, 1]
            a2 = X_WA[i, row, 2]
            x = a0 * X_PJ[i, 0, 0] + a1 * X_PJ[i, 1, 0] + a2 * X_PJ[i, 2, 0]
            y = a0 * X_PJ[i, 0, 1] + a1 * X_PJ[i, 1, 1] + a2 * X_PJ[i, 2, 1]
            z = a0 * X_PJ[i, 0, 2] + a1 * X_PJ[i, 1, 2] + a2 * X_PJ[i, 2, 2]
            X_WA[i + 1, row, 0] = x * c + y * s
            X_WA[i + 1, row, 1] = y * c - x * s
            X_WA[i + 1, row, 2] = z
            X_WA[i + 1, row, 3] = (
                X_WA[i, row, 3]
                + a0 * X_PJ[i, 0, 3]
                + a1 * X_PJ[i, 1, 3]
                + a2 * X_PJ[i, 2, 3]
            )


@njit(cache=True)
def calc_sites(X_WB, X_PJ, site_link, X_AS, q, qd, X_WS, v_WS):
    """Poses and velocities of points that ride on the links of a chain.

    Args:
        X_WB: Pose of the base link in world, (3, 4).
        X_PJ: As in `calc_link_poses`, (n, 3, 4).
        site_link: Link of each site: 0 is the base, i the link behind joint
            i - 1, (s,).
        X_AS: Pose of each site in its link, (s, 3, 4).
        q: Joint angles, rad, (n,).
        qd: Joint speeds, rad/s, (n,).
        X_WS: Written: poses in world, (s, 3, 4).
        v_WS: Written: velocities of the origins in world, m/s, (s, 3).
    """
    X_WA = np.empty((q.shape[0] + 1, 3, 4))
    calc_link_poses(X_WB, X_PJ, q, X_WA)
    for s in range(site_link.shape[0]):
        link = site_link[s]
        for row in range(3):
            for column in range(4):
                total = 0.0
                for k in range(3):
                    total += X_WA[link, row, k] * X_AS[s, k, column]
                if column == 3:
                    total += X_WA[link, row, 3]
                X_WS[s, row, column] = total
        vx = 0.0
        vy = 0.0
        vz = 0.0
        for i in range(1, link + 1):
            # Joint i - 1 turns link i about the link's own z axis.
            wx = X_WA[i, 0, 2] * qd[i - 1]
            wy = X_WA[i, 1, 2] * qd[i - 1]
            wz = X_WA[i, 2, 2] * qd[i - 1]
            rx = X_WS[s, 0, 3] - X_WA[i, 0, 3]
            ry = X_WS[s, 1, 3] - X_WA[i, 1, 3]
            rz = X_WS[s, 2, 3] - X_WA[i, 2, 3]
            vx += wy * rz - wz * ry
            vy += wz * rx - wx * rz
            vz += wx * ry - wy * rx
        v_WS[s, 0] = vx
        v_WS[s, 1] = vy
        v_WS[s, 2] = vz


def _as_array(X) -> np.ndarray:
    return np.ascontiguousarray(X.GetAsMatrix34())


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingKinematics:
    """Poses and velocities of the watched links' centres and of the tool.

    Made by `from_plant`. The arrays may be handed to the kernels
    `calc_link_poses` and `calc_sites` from other compiled code; the sites are
    the links in the order of `name`, then the tool centre point.
    """

    name: tuple[str, ...]
    """The m watched links."""
    X_WB: np.ndarray
    """Pose of the robot's base in world, (3, 4)."""
    X_PJ: np.ndarray
    """Pose of each link in its parent at joint angle zero, (6, 3, 4)."""
    site_link: np.ndarray
    """Which link carries each site: 0 base, i behind joint i - 1, (m + 1,)."""
    X_AS: np.ndarray
    """Pose of each site in its link, (m + 1, 3, 4)."""

    @staticmethod
    def from_plant(
        plant: MultibodyPlant,
        *,
        links: Mapping[str, str] | None = None,
        tcp: str = "tcp",
        joints: tuple[str, ...] = UR10_JOINTS,
    ) -> "RingKinematics":
        """Reads the fixed transforms once from a finalized plant.

        Args:
            plant: Finalized; holds the robot, the links' frames and the tool
                frame.
            links: Name of each watched link and of the frame at its centre;
                a frame may also stand still in the cell. None: no links.
            tcp: Name of the tool's frame.
            joints: Names of the joints, base to flange.

        Raises:
            UserError: If a frame or joint is missing or is not where it
                should be.
        """
        context = plant.CreateDefaultContext()
        bodies = []
        X_PJ = np.empty((len(joints), 3, 4))
        for i, name in enumerate(joints):
            if not plant.HasJointNamed(name):
                raise UserError(f"robot model: no joint named {name}")
            joint = plant.GetJointByName(name)
            if i == 0:
                bodies.append(joint.parent_body().index())
            if joint.parent_body().index() != bodies[-1]:
                raise UserError(
                    f"robot model: joint {name} does not follow {joints[i - 1]}"
                )
            bodies.append(joint.child_body().index())
            X_PF = joint.frame_on_parent().CalcPoseInBodyFrame(context)
            X_CM = joint.frame_on_child().CalcPoseInBodyFrame(context)
            if not X_CM.IsNearlyIdentity(1e-12) or not np.allclose(
                joint.revolute_axis(), [0, 0, 1]
            ):
                raise UserError(
                    f"robot model: joint {name} must turn about the z axis "
                    "of its child link"
                )
            X_PJ[i] = _as_array(X_PF)
        for i in range(len(joints)):
            plant.GetJointByName(joints[i]).set_angle(context, 0.0)
        site_link = []
        X_AS = []
        links = links or {}
        for name in (*links.values(), tcp):
            if not plant.HasFrameNamed(name):
                raise UserError(f"robot model: no frame named {name}")
            frame = plant.GetFrameByName(name)
            link = _find_link(plant, frame.body(), bodies)
            body = plant.get_body(bodies[link])
            site_link.append(link)
            X_AS.append(_as_array(frame.CalcPose(context, body.body_frame())))
        base = plant.get_body(bodies[0]).body_frame()
        return RingKinematics(
            name=tuple(links),
            X_WB=_as_array(base.CalcPoseInWorld(context)),
            X_PJ=X_PJ,
            site_link=np.array(site_link, dtype=np.int64),
            X_AS=np.array(X_AS),
        )

    def select(self, links: Sequence[str]) -> "RingKinematics":
        """Returns the kinematics of some of the links, in the given order."""
        if tuple(links) == self.name:
            return self
        rows = [*(self.name.index(link) for link in links), -1]
        return dc.replace(
            self,
            name=tuple(links),
            site_link=self.site_link[rows],
            X_AS=self.X_AS[rows],
        )

    def calc(
        self, q: np.ndarray, qd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns where the links' centres and how they move.

        Args:
            q: Joint angles, rad, (6,).
            qd: Joint speeds, rad/s, (6,).

        Returns:
            p_WL: Centres in world, m, (m, 3).
            R_WL: Orientations in world, (m, 3, 3); column 2 is the ring's
                axis.
            v_WL: Velocities of the centres in world, m/s, (m, 3).
        """
        X_WS, v_WS = self.calc_sites(q, qd)
        return X_WS[:-1, :, 3], X_WS[:-1, :, :3], v_WS[:-1]

    def calc_sites(
        self, q: np.ndarray, qd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns X_WS (m + 1, 3, 4) and v_WS (m + 1, 3): rings, then tool."""
        X_WS = np.empty((len(self.site_link), 3, 4))
        v_WS = np.empty((len(self.site_link), 3))
        calc_sites(
            self.X_WB, self.X_PJ, self.site_link, self.X_AS, q, qd, X_WS, v_WS
        )
        return X_WS, v_WS

    def calc_tcp_pose(self, q: np.ndarray) -> np.ndarray:
        """Returns X_WT (3, 4), the pose of the tool centre point in world."""
        return self.calc_sites(q, np.zeros(len(q)))[0][-1]


def _find_link(plant: MultibodyPlant, body, bodies: list) -> int:
    """Returns which link of the chain a body is, or is welded to."""
    for index in (
        body.index(),
        *(b.index() for b in plant.GetBodiesWeldedTo(body)),
    ):
        if index in bodies:
            return bodies.index(index)
    raise UserError(
        f"robot model: body {body.name()} is not a part of the robot"
    )


def calc_tool_down_joints(
    kinematics: RingKinematics, p_WT: np.ndarray, yaw: float
) -> np.ndarray:
    """Inverse kinematics of the UR10 with the tool pointing down.

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
    z = p_B6[2] + UR10_D6 - UR10_D1
    reach = np.hypot(x, y)
    where = f"point {np.round(np.asarray(p_WT, dtype=float), 4).tolist()}"
    if reach <= UR10_D4:
        raise UserError(f"{where}: too near to the robot's axis")
    azimuth = np.arctan2(y, x)
    q0 = azimuth + np.arcsin(UR10_D4 / reach)
    r = np.sqrt(reach**2 - UR10_D4**2) - UR10_D5
    # Two-bar linkage in the arm's plane. The lengths are negative in UR's
    # table: a bar at angle q points to angle q + pi.
    a2, a3 = -UR10_A2, -UR10_A3
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
