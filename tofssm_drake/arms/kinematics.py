"""Closed-form kinematics of a serial arm: where its sites and its tool are.

A MultibodyPlant answers the same questions (and the tests hold both to 1e-9
of each other); this module answers in a microsecond, as needed by a monitor
that asks for every sensor's own sample time.
"""

from collections.abc import Mapping, Sequence
import dataclasses as dc
from typing import NamedTuple

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.chain import find_chain
from tofssm_drake.errors import UserError
from tofssm_drake.kernels import njit


class Chain(NamedTuple):
    """What the kernels take of an arm; Numba knows named tuples.

    Each of the n joints has a frame A that moves with it. It turns about, or
    slides along, its own z axis. A link is what moves with a joint.
    """

    X_WB: np.ndarray
    """Pose of the base in world, (3, 4)."""
    X_PA: np.ndarray
    """Pose of each joint's frame, at position zero, in the frame before it;
    the first in the base, (n, 3, 4)."""
    slides: np.ndarray
    """Which joints slide (prismatic); the others turn (revolute), (n,)."""


@njit(cache=True)
def calc_link_poses(chain, q, X_WA):
    """Forward kinematics of a chain of joints.

    Args:
        chain: A `Chain` of n joints.
        q: Joint positions, rad or m, (n,).
        X_WA: Written: poses of base and joint frames in world, (n + 1, 3, 4).
    """
    X_PA = chain.X_PA
    for row in range(3):
        for column in range(4):
            X_WA[0, row, column] = chain.X_WB[row, column]
    for i in range(q.shape[0]):
        slides = chain.slides[i]
        c = 1.0 if slides else np.cos(q[i])
        s = 0.0 if slides else np.sin(q[i])
        for row in range(3):
            a0 = X_WA[i, row, 0]
            a1 = X_WA[i, row, 1]
            a2 = X_WA[i, row, 2]
            x = a0 * X_PA[i, 0, 0] + a1 * X_PA[i, 1, 0] + a2 * X_PA[i, 2, 0]
            y = a0 * X_PA[i, 0, 1] + a1 * X_PA[i, 1, 1] + a2 * X_PA[i, 2, 1]
            z = a0 * X_PA[i, 0, 2] + a1 * X_PA[i, 1, 2] + a2 * X_PA[i, 2, 2]
            X_WA[i + 1, row, 0] = x * c + y * s
            X_WA[i + 1, row, 1] = y * c - x * s
            X_WA[i + 1, row, 2] = z
            X_WA[i + 1, row, 3] = (
                X_WA[i, row, 3]
                + a0 * X_PA[i, 0, 3]
                + a1 * X_PA[i, 1, 3]
                + a2 * X_PA[i, 2, 3]
            )
            if slides:
                X_WA[i + 1, row, 3] += z * q[i]


@njit(cache=True)
def calc_point_velocity(slides, X_WA, qd, link, p_WP, v_WP):
    """Velocity of a point that rides on a link.

    Args:
        slides: As in `Chain`.
        X_WA: From `calc_link_poses`.
        qd: Joint speeds, rad/s or m/s, (n,).
        link: 0 is the base, i the link behind joint i - 1.
        p_WP: The point, m, (3,).
        v_WP: Written: its velocity in world, m/s, (3,).
    """
    vx = 0.0
    vy = 0.0
    vz = 0.0
    for i in range(1, link + 1):
        # Joint i - 1 moves link i about, or along, that frame's own z axis.
        wx = X_WA[i, 0, 2] * qd[i - 1]
        wy = X_WA[i, 1, 2] * qd[i - 1]
        wz = X_WA[i, 2, 2] * qd[i - 1]
        if slides[i - 1]:
            vx += wx
            vy += wy
            vz += wz
            continue
        rx = p_WP[0] - X_WA[i, 0, 3]
        ry = p_WP[1] - X_WA[i, 1, 3]
        rz = p_WP[2] - X_WA[i, 2, 3]
        vx += wy * rz - wz * ry
        vy += wz * rx - wx * rz
        vz += wx * ry - wy * rx
    v_WP[0] = vx
    v_WP[1] = vy
    v_WP[2] = vz


@njit(cache=True)
def calc_sites(chain, site_link, X_AS, q, qd, X_WS, v_WS):
    """Poses and velocities of points that ride on the links of a chain.

    Args:
        chain: A `Chain` of n joints.
        site_link: Link of each site: 0 is the base, i the link behind joint
            i - 1, (s,).
        X_AS: Pose of each site in its link's frame, (s, 3, 4).
        q: Joint positions, rad or m, (n,).
        qd: Joint speeds, rad/s or m/s, (n,).
        X_WS: Written: poses in world, (s, 3, 4).
        v_WS: Written: velocities of the origins in world, m/s, (s, 3).
    """
    X_WA = np.empty((q.shape[0] + 1, 3, 4))
    calc_link_poses(chain, q, X_WA)
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
        calc_point_velocity(
            chain.slides, X_WA, qd, link, X_WS[s, :, 3], v_WS[s]
        )


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ArmKinematics:
    """Poses and velocities of the watched links' centres and of the tool.

    Made by `from_plant`, for any serial chain of revolute and prismatic
    joints. The arrays may be handed to the kernels `calc_link_poses` and
    `calc_sites` from other compiled code; the sites are the links in the
    order of `name`, then the tool centre point.
    """

    name: tuple[str, ...]
    """The m watched links."""
    chain: Chain
    """The arm's n joints."""
    joint_name: tuple[str, ...]
    """Their names, base to tool."""
    lower: np.ndarray
    """Least positions, rad or m, -inf if there is no limit, (n,)."""
    upper: np.ndarray
    """Greatest positions, rad or m, inf if there is no limit, (n,)."""
    site_link: np.ndarray
    """Which link carries each site: 0 base, i behind joint i - 1, (m + 1,)."""
    X_AS: np.ndarray
    """Pose of each site in its link's frame, (m + 1, 3, 4)."""

    @property
    def num_joints(self) -> int:
        """Number n of joints."""
        return len(self.joint_name)

    @property
    def X_WB(self) -> np.ndarray:
        """Pose of the arm's base in world, (3, 4)."""
        return self.chain.X_WB

    @staticmethod
    def from_plant(
        plant: MultibodyPlant,
        *,
        links: Mapping[str, str] | None = None,
        tcp: str = "tcp",
    ) -> "ArmKinematics":
        """Reads the fixed transforms once from a finalized plant.

        Args:
            plant: Finalized; holds the robot, the links' frames and the tool
                frame.
            links: Name of each watched link and of the frame at its centre;
                a frame may also stand still in the cell. None: no links.
            tcp: Name of the tool's frame. The arm is what moves between it
                and the world.

        Raises:
            UserError: If a frame is missing, or the chain of joints has one
                that neither turns nor slides.
        """
        links = links or {}
        chain = find_chain(plant, tcp)
        frames = [_find_frame(plant, name) for name in (*links.values(), tcp)]
        site_link, X_AS = [], []
        for frame in frames:
            link = chain.link_of.get(frame.body().index())
            if link is None:
                raise UserError(
                    f"robot model: body {frame.body().name()} is not a part "
                    "of the robot"
                )
            site_link.append(link)
            X_AS.append(chain.calc_pose_in_link(frame, link).GetAsMatrix34())
        return ArmKinematics(
            name=tuple(links),
            chain=Chain(X_WB=chain.X_WB, X_PA=chain.X_PA, slides=chain.slides),
            joint_name=tuple(joint.name() for joint in chain.joints),
            lower=np.array(
                [joint.position_lower_limit() for joint in chain.joints]
            ),
            upper=np.array(
                [joint.position_upper_limit() for joint in chain.joints]
            ),
            site_link=np.array(site_link, dtype=np.int64),
            X_AS=np.array(X_AS),
        )

    def select(self, links: Sequence[str]) -> "ArmKinematics":
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
        """Returns where the links' centres are and how they move.

        Args:
            q: Joint positions, rad or m, (n,).
            qd: Joint speeds, rad/s or m/s, (n,).

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
        calc_sites(self.chain, self.site_link, self.X_AS, q, qd, X_WS, v_WS)
        return X_WS, v_WS

    def calc_tcp_pose(self, q: np.ndarray) -> np.ndarray:
        """Returns X_WT (3, 4), the pose of the tool centre point in world."""
        return self.calc_sites(q, np.zeros(len(q)))[0][-1]

    def calc_link_poses_in_base(self, q: np.ndarray) -> np.ndarray:
        """Returns X_BA (n + 1, 3, 4): the base itself, then the links."""
        X_BA = np.empty((self.num_joints + 1, 3, 4))
        q = np.array(q, dtype=float)
        calc_link_poses(self.chain._replace(X_WB=np.eye(3, 4)), q, X_BA)
        return X_BA


def _find_frame(plant: MultibodyPlant, name: str):
    if not plant.HasFrameNamed(name):
        raise UserError(f"robot model: no frame named {name}")
    return plant.GetFrameByName(name)
