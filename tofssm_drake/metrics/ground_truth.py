"""True distance between robot and person, from the simulated world."""

import dataclasses as dc
import functools
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Capsule, Role, SceneGraphInspector, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import LeafSystem

from tofssm_drake.arms.chain import find_chain, list_arm_bodies
from tofssm_drake.arms.kinematics import (
    ArmKinematics,
    Chain,
    calc_link_poses,
    calc_point_velocity,
    calc_sites,
)
from tofssm_drake.kernels import njit
from tofssm_drake.metrics.distance import closest_capsules
from tofssm_drake.metrics.truth import TruthLayout


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RobotCapsules:
    """The robot's surface as capsules that ride on its links."""

    link: np.ndarray
    """Link of each of g capsules: 0 base, i behind joint i - 1, (g,)."""
    p_AP: np.ndarray
    """First end of each in its link's frame, m, (g, 3)."""
    p_AQ: np.ndarray
    """Second end, equal to the first for a sphere, m, (g, 3)."""
    radius: np.ndarray
    """Radii, m, (g,)."""
    body: np.ndarray
    """Index of each capsule's body in `body_names`, (g,)."""
    body_names: list[str]
    """Names of the bodies that have geometry."""

    @staticmethod
    def from_plant(
        plant: MultibodyPlant,
        inspector: SceneGraphInspector,
        *,
        tcp: str = "tcp",
    ) -> "RobotCapsules":
        """Reads the proximity geometry of the robot and what it wears.

        Args:
            plant: Finalized plant, registered with a SceneGraph.
            inspector: Its SceneGraph's model inspector.
            tcp: Name of the tool's frame, at the arm's end.

        Raises:
            ValueError: if a shape is neither a sphere nor a capsule, or if
                there is none.
            UserError: if the plant has no arm.
        """
        links = find_chain(plant, tcp)
        link, p, q, radius, bodies = [], [], [], [], []
        names: list[str] = []
        for body in list_arm_bodies(plant, tcp):
            i = links.link_of[body.index()]
            ids = _find_shapes(plant, inspector, body)
            if not ids:
                continue
            X_AB = links.calc_pose_in_link(body.body_frame(), i)
            for geometry_id in ids:
                p_BP, p_BQ, r = _read_capsule(inspector, geometry_id)
                link.append(i)
                p.append(X_AB @ p_BP)
                q.append(X_AB @ p_BQ)
                radius.append(r)
                bodies.append(len(names))
            names.append(body.name())
        if not names:
            raise ValueError("The robot has no proximity geometry.")
        return RobotCapsules(
            link=np.array(link),
            p_AP=np.array(p),
            p_AQ=np.array(q),
            radius=np.array(radius),
            body=np.array(bodies),
            body_names=names,
        )


def _find_shapes(plant, inspector, body):
    """Returns a body's proximity geometry in the order of the model."""
    frame_id = plant.GetBodyFrameIdIfExists(body.index())
    if frame_id is None:
        return []
    return sorted(
        inspector.GetGeometries(frame_id, Role.kProximity),
        key=lambda geometry_id: geometry_id.get_value(),
    )


def _read_capsule(inspector, geometry_id):
    shape = inspector.GetShape(geometry_id)
    X_BG = inspector.GetPoseInFrame(geometry_id)
    if isinstance(shape, Sphere):
        centre = X_BG.translation()
        return centre, centre, shape.radius()
    if isinstance(shape, Capsule):
        half = np.array([0.0, 0.0, shape.length() / 2])
        return X_BG @ half, X_BG @ -half, shape.radius()
    raise ValueError(
        f"Geometry '{inspector.GetName(geometry_id)}' is a "
        f"{type(shape).__name__}: the robot's proximity geometry must be "
        "spheres and capsules."
    )


@njit(cache=True)
def _calc_point_speed(robot, X_WA, qd, link, p):
    """Speed of the point p (in world) that rides on a link, m/s."""
    v = np.empty(3)
    calc_point_velocity(robot.chain.slides, X_WA, qd, link, p, v)
    return np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True)
def _pose_point(X, p, out):
    for i in range(3):
        out[i] = X[i, 0] * p[0] + X[i, 1] * p[1] + X[i, 2] * p[2] + X[i, 3]


@njit(cache=True)
def _measure(a_p, a_q, a_r, i, b_p, b_q, b_r, j):
    d, _, _, p_A, _ = closest_capsules(
        a_p[i : i + 1],
        a_q[i : i + 1],
        a_r[i : i + 1],
        b_p[j : j + 1],
        b_q[j : j + 1],
        b_r[j : j + 1],
    )
    return d, p_A


@njit(cache=True)
def _find_nearest_axis_point(x, y, z, p, q, r):
    """Finds the axis point of the capsule whose surface is nearest.

    Returns:
        (distance to the surface, and the vector to the axis point); inf and
        NaN if there is no capsule.
    """
    best, best_x, best_y, best_z = np.inf, np.nan, np.nan, np.nan
    for j in range(r.shape[0]):
        ux, uy, uz = q[j, 0] - p[j, 0], q[j, 1] - p[j, 1], q[j, 2] - p[j, 2]
        vx, vy, vz = p[j, 0] - x, p[j, 1] - y, p[j, 2] - z
        length2 = ux * ux + uy * uy + uz * uz
        t = 0.0
        if length2 > 0.0:
            t = -(vx * ux + vy * uy + vz * uz) / length2
            t = min(max(t, 0.0), 1.0)
        vx, vy, vz = vx + t * ux, vy + t * uy, vz + t * uz
        d = np.sqrt(vx * vx + vy * vy + vz * vz) - r[j]
        if d < best:
            best, best_x, best_y, best_z = d, vx, vy, vz
    return best, best_x, best_y, best_z


class _Robot(NamedTuple):
    """What the kernels take of the robot; Numba knows named tuples."""

    chain: Chain
    """As in `ArmKinematics`, like the next two."""
    site_link: np.ndarray
    X_AS: np.ndarray
    link: np.ndarray
    """As in `RobotCapsules`, like the rest."""
    p_AP: np.ndarray
    p_AQ: np.ndarray
    radius: np.ndarray
    body: np.ndarray


@njit(cache=True)
def _calc_truth(robot, q, qd, ends, radii, person, truth):
    """Writes the vector that `TruthLayout` describes.

    Args:
        robot: A `_Robot`.
        q: Joint positions, rad or m, (n,).
        qd: Joint speeds, rad/s or m/s, (n,).
        ends: Both ends of the person's capsules in world, m, (c, 2, 3).
        radii: Their radii, m, (c,).
        person: Number of capsules of a person, and index of the one of them
            whose centre is the person's place, (2,).
        truth: Written, (16 + 3 m,).
    """
    X_WA = np.empty((q.shape[0] + 1, 3, 4))
    calc_link_poses(robot.chain, q, X_WA)
    # Loops instead of slices: they compile in a fraction of the time.
    c = radii.shape[0]
    p_WP = np.empty((c, 3))
    p_WQ = np.empty((c, 3))
    for j in range(c):
        for k in range(3):
            p_WP[j, k] = ends[j, 0, k]
            p_WQ[j, k] = ends[j, 1, k]
    _write_nearest(robot, X_WA, qd, p_WP, p_WQ, radii, truth)
    _write_sites(robot, q, qd, p_WP, p_WQ, radii, truth)
    truth[14] = np.nan
    truth[15] = np.nan
    if c:
        # Of several people the place is that of the nearest one.
        pelvis = int(truth[8]) // person[0] * person[0] + person[1]
        for k in range(2):
            truth[14 + k] = 0.5 * (p_WP[pelvis, k] + p_WQ[pelvis, k])


@njit(cache=True)
def _write_nearest(robot, X_WA, qd, p_WP, p_WQ, radii, truth):
    """Writes the distance between robot and person, and their contact."""
    g = robot.link.shape[0]
    p_WA = np.empty((g, 3))
    p_WB = np.empty((g, 3))
    for i in range(g):
        _pose_point(X_WA[robot.link[i]], robot.p_AP[i], p_WA[i])
        _pose_point(X_WA[robot.link[i]], robot.p_AQ[i], p_WB[i])
    d, i, j, p_WR, p_WH = closest_capsules(
        p_WA, p_WB, robot.radius, p_WP, p_WQ, radii
    )
    truth[0] = d
    for k in range(3):
        truth[1 + k] = p_WR[k]
        truth[4 + k] = p_WH[k]
    truth[7] = -1 if i < 0 else robot.body[i]
    truth[8] = j
    truth[9] = 0.0
    if d > 0.0:
        return
    # Of all pairs that touch, the one whose robot point is the fastest.
    touching = False
    for i in range(g):
        for j in range(radii.shape[0]):
            d, p_WR = _measure(
                p_WA, p_WB, robot.radius, i, p_WP, p_WQ, radii, j
            )
            if d <= 0.0:
                speed = _calc_point_speed(robot, X_WA, qd, robot.link[i], p_WR)
                if not touching or speed > truth[9]:
                    truth[7] = robot.body[i]
                    truth[8] = j
                    truth[9] = speed
                    touching = True


@njit(cache=True)
def _write_sites(robot, q, qd, p_WP, p_WQ, radii, truth):
    """Writes where the tool is, and the person as seen from each link."""
    m = robot.site_link.shape[0] - 1
    X_WS = np.empty((m + 1, 3, 4))
    v_WS = np.empty((m + 1, 3))
    calc_sites(robot.chain, robot.site_link, robot.X_AS, q, qd, X_WS, v_WS)
    for k in range(3):
        truth[10 + k] = X_WS[m, k, 3]
    vx, vy, vz = v_WS[m, 0], v_WS[m, 1], v_WS[m, 2]
    truth[13] = np.sqrt(vx * vx + vy * vy + vz * vz)
    for k in range(m):
        X = X_WS[k]
        # The surface's nearest point lies in the direction of the axis'.
        d, v0, v1, v2 = _find_nearest_axis_point(
            X[0, 3], X[1, 3], X[2, 3], p_WP, p_WQ, radii
        )
        x = X[0, 0] * v0 + X[1, 0] * v1 + X[2, 0] * v2
        y = X[0, 1] * v0 + X[1, 1] * v1 + X[2, 1] * v2
        z = X[0, 2] * v0 + X[1, 2] * v1 + X[2, 2] * v2
        truth[16 + k] = d
        truth[16 + m + k] = np.arctan2(y, x)
        truth[16 + 2 * m + k] = np.arctan2(z, np.sqrt(x * x + y * y))


@njit(cache=True)
def _calc_truth_rows(robot, q, qd, ends, radii, person, truth):
    """Writes one row (k, 16 + 3 m) for each of k instants."""
    for i in range(q.shape[0]):
        _calc_truth(robot, q[i], qd[i], ends[i], radii, person, truth[i])


class TruthModel:
    """Truth from the robot's joints and the person's capsules.

    One kernel serves one instant (`GroundTruth`) and a whole record
    (`SampleRecorder`). Poses come from the joints and not from the plant: the
    tests hold both equal, and it costs a tenth of reading them in Python.

    A product in the gripper does not count as part of the robot.

    Args:
        plant: Finalized plant with the robot, its ring frames and its tool
            frame, registered with a SceneGraph. The robot's proximity
            geometry must be capsules and spheres.
        inspector: Its SceneGraph's model inspector. Both are read once.
        radii: Radii of the person's capsules, m, (c,); empty: nobody.
        kinematics: Of the plant's robot, with the m watched links.
        pelvis: Index of the capsule whose centre is the person's place.
        people: Number of people, alike in their capsules.
        link_offsets: Subtracted from the links' distances to the person,
            which end at 0, m, (m,) or one for all. For a sensing that subtracts
            it as well.

    Attributes:
        layout: Where each quantity sits, a `TruthLayout`.
        body_names: Robot bodies that `layout.robot_body` counts.
        num_positions: Number n of joints.
        skeleton_size: 6 c.

    Raises:
        ValueError: if a robot shape is neither capsule nor sphere.
        UserError: if the plant lacks a joint or a frame.
    """

    def __init__(
        self,
        *,
        plant: MultibodyPlant,
        inspector: SceneGraphInspector,
        radii: np.ndarray,
        kinematics: ArmKinematics,
        pelvis: int,
        people: int = 1,
        link_offsets: np.ndarray | float = 0.0,
    ):
        robot = RobotCapsules.from_plant(plant, inspector)
        self._radii = np.array(radii, dtype=float).ravel()
        per_person = len(self._radii) // max(people, 1)
        self._person = np.array([max(per_person, 1), pelvis])
        self._link_offsets = np.broadcast_to(
            np.asarray(link_offsets, dtype=float), len(kinematics.name)
        )
        self._robot = _Robot(
            chain=kinematics.chain,
            site_link=kinematics.site_link,
            X_AS=kinematics.X_AS,
            link=robot.link,
            p_AP=robot.p_AP,
            p_AQ=robot.p_AQ,
            radius=robot.radius,
            body=robot.body,
        )
        self.layout = TruthLayout(len(kinematics.name))
        self.body_names = robot.body_names
        self.num_positions = kinematics.num_joints
        self.skeleton_size = 6 * len(self._radii)

    def calc(
        self, *, q: np.ndarray, qd: np.ndarray, skeleton: np.ndarray
    ) -> np.ndarray:
        """Returns the truth at k instants, (k, layout.size).

        Args:
            q: Joint positions, rad or m, (k, n).
            qd: Joint speeds, rad/s or m/s, (k, n).
            skeleton: Both ends of the person's capsules in world, m, (k, 6 c).
        """
        k = len(q)
        truth = np.empty((k, self.layout.size))
        _calc_truth_rows(
            self._robot,
            np.ascontiguousarray(q),
            np.ascontiguousarray(qd),
            np.ascontiguousarray(skeleton).reshape(k, -1, 2, 3)
            if self.skeleton_size
            else np.empty((k, 0, 2, 3)),
            self._radii,
            self._person,
            truth,
        )
        if self._link_offsets.any():
            links = truth[:, self.layout.ring_distance]
            links[:] = np.maximum(links - self._link_offsets, 0.0)
        return truth


class GroundTruth(LeafSystem):
    """True distance, contact and speed, which the monitor never sees.

    .. pydrake_system::

        name: GroundTruth
        input_ports:
        - position
        - velocity
        - skeleton
        output_ports:
        - truth
        - distance
        - witness
        - ring_distance
        - contact_speed

    `position` (rad) and `velocity` (rad/s) are the robot's true joints,
    `skeleton` (6 c numbers: both ends of each of c capsules, m, in world) is
    the avatar's. The outputs: `truth`, everything at once, laid out as
    `TruthLayout` says; `distance` (1), least distance between the surfaces
    of robot and person, m, negative where they overlap; `witness` (6), the
    points p_WR and p_WH where it is attained; `ring_distance` (m), from each
    link centre to the person's surface, m; `contact_speed` (1), speed of the
    fastest robot point that touches the person, m/s, 0 if none does.

    While they touch, robot_body and person_part of `truth` name the pair
    whose robot point is the fastest. Without a person (no radii) distances
    are inf, points and angles NaN, and `skeleton` may stay unconnected.

    Use it where the truth is needed while the simulation runs, as by a
    display or a `Simulator` monitor that ends a run at the first contact.
    The workcell has none: `SampleRecorder` computes the same numbers, from
    the same `TruthModel`, after the run.

    Args:
        model: What computes the truth.
    """

    def __init__(self, *, model: TruthModel):
        super().__init__()
        self._model = model
        layout = model.layout
        n = model.num_positions
        self._position_port = self.DeclareVectorInputPort("position", n)
        self._velocity_port = self.DeclareVectorInputPort("velocity", n)
        self._skeleton_port = self.DeclareVectorInputPort(
            "skeleton", model.skeleton_size
        )
        inputs = {
            self._position_port.ticket(),
            self._velocity_port.ticket(),
            self._skeleton_port.ticket(),
        }
        self._truth_port = self.DeclareVectorOutputPort(
            "truth",
            layout.size,
            self._calc_truth,
            prerequisites_of_calc=inputs,
        )
        for name, first, last in (
            ("distance", layout.distance, layout.distance + 1),
            ("witness", layout.p_WR.start, layout.p_WH.stop),
            (
                "ring_distance",
                layout.ring_distance.start,
                layout.ring_distance.stop,
            ),
            ("contact_speed", layout.contact_speed, layout.contact_speed + 1),
        ):
            self.DeclareVectorOutputPort(
                name,
                last - first,
                functools.partial(self._calc_part, where=slice(first, last)),
                prerequisites_of_calc=inputs,
            )

    def _calc_part(self, context, output, where):
        output.SetFromVector(self._truth_port.Eval(context)[where])

    def _calc_truth(self, context, output):
        if self._model.skeleton_size:
            skeleton = self._skeleton_port.Eval(context)
        else:
            skeleton = np.empty(0)
        truth = self._model.calc(
            q=self._position_port.Eval(context)[None],
            qd=self._velocity_port.Eval(context)[None],
            skeleton=skeleton[None],
        )
        output.SetFromVector(truth[0])
