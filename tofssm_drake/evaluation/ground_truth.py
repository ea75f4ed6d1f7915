"""True distance between robot and person, from the simulated world."""

import functools

from numba import njit
import numpy as np
from pydrake.geometry import Capsule, SceneGraphInspector, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, ModelInstanceIndex
from pydrake.systems.framework import LeafSystem

from tofssm_drake.evaluation.truth import TruthLayout
from tofssm_drake.geometry.distance import closest_capsules


class RobotCapsules:
    """The robot's surface as capsules fixed to its bodies.

    Attributes:
        bodies: Indices of the bodies with geometry in the plant, (n,).
        body_names: Their names.
        shape_body: For each of g capsules, position in `bodies`, (g,).
        p_BP: First end of each capsule in its body's frame, (g, 3).
        p_BQ: Second end, equal to the first for a sphere, (g, 3).
        radius: Radii, (g,).
    """

    def __init__(self, *, plant, inspector, models):
        """Reads the proximity geometry of the given model instances.

        Args:
            plant: Finalized plant, registered with a SceneGraph.
            inspector: That SceneGraph's model inspector.
            models: Model instances that make up the robot (arm, gripper).

        Raises:
            ValueError: if a shape is neither a sphere nor a capsule, or if
                there is none.
        """
        bodies, shape_body, p, q, radius = [], [], [], [], []
        for model in models:
            for index in plant.GetBodyIndices(model):
                body = plant.get_body(index)
                ids = plant.GetCollisionGeometriesForBody(body)
                if not ids:
                    continue
                for geometry_id in ids:
                    p_BP, p_BQ, r = _read_capsule(inspector, geometry_id)
                    shape_body.append(len(bodies))
                    p.append(p_BP)
                    q.append(p_BQ)
                    radius.append(r)
                bodies.append(int(index))
        if not bodies:
            raise ValueError("The robot has no proximity geometry.")
        self.bodies = np.array(bodies)
        self.body_names = [plant.get_body(BodyIndex(i)).name() for i in bodies]
        self.shape_body = np.array(shape_body)
        self.p_BP = np.array(p)
        self.p_BQ = np.array(q)
        self.radius = np.array(radius)


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
def _pose_point(X, p):
    x = np.empty(3)
    for i in range(3):
        x[i] = X[i, 0] * p[0] + X[i, 1] * p[1] + X[i, 2] * p[2] + X[i, 3]
    return x


@njit(cache=True)
def _pose_capsules(X_WB, shape_body, p_BP, p_BQ):
    g = shape_body.shape[0]
    p_WP = np.empty((g, 3))
    p_WQ = np.empty((g, 3))
    for i in range(g):
        X = X_WB[shape_body[i]]
        p_WP[i] = _pose_point(X, p_BP[i])
        p_WQ[i] = _pose_point(X, p_BQ[i])
    return p_WP, p_WQ


@njit(cache=True)
def _point_speed(X, V, p):
    """Speed of the point p (world) that is fixed to the body of X and V."""
    x, y, z = p[0] - X[0, 3], p[1] - X[1, 3], p[2] - X[2, 3]
    v0 = V[3] + V[1] * z - V[2] * y
    v1 = V[4] + V[2] * x - V[0] * z
    v2 = V[5] + V[0] * y - V[1] * x
    return np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)


@njit(cache=True)
def calc_distances(
    X_WB, shape_body, p_BP, p_BQ, radius, part_p, part_q, part_r, X_WL, out
):
    """Distance robot to person and link centres to person (compiled).

    Args:
        X_WB: Poses of the robot's bodies, (n, 3, 4).
        shape_body: Body of each robot capsule, (g,).
        p_BP: First ends of the robot's capsules in their bodies, (g, 3).
        p_BQ: Second ends, (g, 3).
        radius: Their radii, m, (g,).
        part_p: First ends of the person's capsules in world, (c, 3).
        part_q: Second ends, (c, 3).
        part_r: Their radii, m, (c,).
        X_WL: Poses of the link centres (ring frames), (m, 3, 4).
        out: Filled in: distance, p_WR (3), p_WH (3), robot capsule's body,
            person's capsule, then distance, azimuth and elevation of the
            person from each link centre (m each); 9 + 3 m values. The
            distance from a link centre is to the person's surface.
    """
    p_WP, p_WQ = _pose_capsules(X_WB, shape_body, p_BP, p_BQ)
    d, i, j, p_WR, p_WH = closest_capsules(
        p_WP, p_WQ, radius, part_p, part_q, part_r
    )
    out[0] = d
    out[1:4] = p_WR
    out[4:7] = p_WH
    out[7] = -1 if i < 0 else shape_body[i]
    out[8] = j
    m = X_WL.shape[0]
    point = np.empty((1, 3))
    zero = np.zeros(1)
    for k in range(m):
        X = X_WL[k]
        point[0] = X[:, 3]
        d, i, j, _, p = closest_capsules(
            point, point, zero, part_p, part_q, part_r
        )
        v0, v1, v2 = p[0] - X[0, 3], p[1] - X[1, 3], p[2] - X[2, 3]
        x = X[0, 0] * v0 + X[1, 0] * v1 + X[2, 0] * v2
        y = X[0, 1] * v0 + X[1, 1] * v1 + X[2, 1] * v2
        z = X[0, 2] * v0 + X[1, 2] * v1 + X[2, 2] * v2
        out[9 + k] = d
        out[9 + m + k] = np.arctan2(y, x)
        out[9 + 2 * m + k] = np.arctan2(z, np.hypot(x, y))


@njit(cache=True)
def _calc_truth(
    X_WB,
    V_WT,
    shape_body,
    p_BP,
    p_BQ,
    radius,
    ends,
    part_r,
    frame_body,
    X_BF,
    pelvis,
):
    """Fills TruthLayout's vector but for the contact speed.

    The frames are the m link centres and then the tool centre point.
    """
    m = frame_body.shape[0] - 1
    X_WF = np.empty((m + 1, 3, 4))
    for k in range(m + 1):
        X = X_WB[frame_body[k]]
        for i in range(3):
            for j in range(4):
                total = X[i, 3] if j == 3 else 0.0
                for h in range(3):
                    total += X[i, h] * X_BF[k, h, j]
                X_WF[k, i, j] = total
    out = np.empty(9 + 3 * m)
    part_p = np.ascontiguousarray(ends[:, 0])
    part_q = np.ascontiguousarray(ends[:, 1])
    calc_distances(
        X_WB,
        shape_body,
        p_BP,
        p_BQ,
        radius,
        part_p,
        part_q,
        part_r,
        X_WF[:m],
        out,
    )
    truth = np.empty(16 + 3 * m)
    truth[:9] = out[:9]
    truth[9] = 0.0
    truth[10:13] = X_WF[m, :, 3]
    truth[13] = _point_speed(X_WB[frame_body[m]], V_WT, X_WF[m, :, 3])
    if part_r.shape[0]:
        truth[14:16] = 0.5 * (part_p[pelvis, :2] + part_q[pelvis, :2])
    else:
        truth[14:16] = np.nan
    truth[16:] = out[9:]
    return truth


@njit(cache=True)
def calc_contact_speed(
    X_WB, V_WB, shape_body, p_BP, p_BQ, radius, part_p, part_q, part_r
):
    """Speed of the fastest robot point that touches the person (compiled).

    Args:
        X_WB: Poses of the robot's bodies, (n, 3, 4).
        V_WB: Spatial velocities of the bodies in world (rotational, then
            translational), (n, 6).
        shape_body: Body of each robot capsule, (g,).
        p_BP: First ends of the robot's capsules in their bodies, (g, 3).
        p_BQ: Second ends, (g, 3).
        radius: Their radii, m, (g,).
        part_p: First ends of the person's capsules in world, (c, 3).
        part_q: Second ends, (c, 3).
        part_r: Their radii, m, (c,).

    Returns:
        (speed, body, part): over all overlapping pairs, the largest speed of
        the robot's witness point, m/s, and that pair; 0, -1, -1 if nothing
        overlaps.
    """
    p_WP, p_WQ = _pose_capsules(X_WB, shape_body, p_BP, p_BQ)
    best, best_body, best_part = 0.0, -1, -1
    for i in range(radius.shape[0]):
        for j in range(part_r.shape[0]):
            d, _, _, p_WR, _ = closest_capsules(
                p_WP[i : i + 1],
                p_WQ[i : i + 1],
                radius[i : i + 1],
                part_p[j : j + 1],
                part_q[j : j + 1],
                part_r[j : j + 1],
            )
            if d <= 0.0:
                b = shape_body[i]
                speed = _point_speed(X_WB[b], V_WB[b], p_WR)
                if best_body < 0 or speed > best:
                    best, best_body, best_part = speed, b, j
    return best, best_body, best_part


class GroundTruth(LeafSystem):
    """True distance, contact and speed, which the monitor never sees.

    .. pydrake_system::

        name: GroundTruth
        input_ports:
        - body_poses
        - body_spatial_velocities
        - skeleton
        output_ports:
        - truth
        - distance
        - witness
        - ring_distance
        - contact_speed

    `body_poses` and `body_spatial_velocities` come from the simulated plant,
    `skeleton` (6 c numbers: both ends of each of c capsules, m, in world)
    from the avatar. The outputs: `truth`, everything at once, laid out as
    `TruthLayout` says; `distance` (1), least distance between the surfaces
    of robot and person, m, negative where they overlap; `witness` (6), the
    points p_WR and p_WH where it is attained; `ring_distance` (m), from each
    link centre to the person's surface, m; `contact_speed` (1), speed of the
    fastest robot point that touches the person, m/s, 0 if none does.

    While they touch, robot_body and person_part of `truth` name the pair
    whose robot point is the fastest. Without a person (no radii) distances
    are inf, points and angles NaN, and `skeleton` may stay unconnected.

    Args:
        plant: Finalized plant of the world.
        inspector: Its SceneGraph's model inspector, read once.
        models: Model instances of the robot (arm, gripper). Their proximity
            geometry must be capsules and spheres.
        ring_frames: Frames of the m watched link centres, z along the link.
        tcp_frame: Frame of the tool centre point.
        radii: Radii of the person's capsules, m, (c,).
        pelvis: Index of the capsule whose centre is the person's place.

    Raises:
        ValueError: if a robot shape is neither capsule nor sphere.
    """

    def __init__(
        self,
        *,
        plant: MultibodyPlant,
        inspector: SceneGraphInspector,
        models: list[ModelInstanceIndex],
        ring_frames: list[Frame],
        tcp_frame: Frame,
        radii: np.ndarray,
        pelvis: int = 0,
    ):
        super().__init__()
        robot = RobotCapsules(plant=plant, inspector=inspector, models=models)
        self.body_names = robot.body_names
        self._layout = TruthLayout(len(ring_frames))
        self._shapes = (
            robot.shape_body,
            robot.p_BP,
            robot.p_BQ,
            robot.radius,
        )
        self._radii = np.array(radii, dtype=float).ravel()
        self._pelvis = pelvis
        frames = [*ring_frames, tcp_frame]
        frame_bodies = [int(frame.body().index()) for frame in frames]
        # Robot bodies first, then what only carries a frame.
        extra = sorted(set(frame_bodies) - set(robot.bodies.tolist()))
        self._bodies = [*robot.bodies.tolist(), *extra]
        self._tcp_body = frame_bodies[-1]
        self._frame_body = np.array(
            [self._bodies.index(b) for b in frame_bodies]
        )
        self._X_BF = np.array(
            [f.GetFixedPoseInBodyFrame().GetAsMatrix34() for f in frames]
        )

        self._poses_port = self.DeclareAbstractInputPort(
            "body_poses", plant.get_body_poses_output_port().Allocate()
        )
        self._velocities_port = self.DeclareAbstractInputPort(
            "body_spatial_velocities",
            plant.get_body_spatial_velocities_output_port().Allocate(),
        )
        self._skeleton_port = self.DeclareVectorInputPort(
            "skeleton", 6 * len(self._radii)
        )
        inputs = {
            self._poses_port.ticket(),
            self._velocities_port.ticket(),
            self._skeleton_port.ticket(),
        }
        self._truth_port = self.DeclareVectorOutputPort(
            "truth",
            self._layout.size,
            self._calc_truth,
            prerequisites_of_calc=inputs,
        )
        layout = self._layout
        for name, where in (
            ("distance", slice(0, 1)),
            ("witness", slice(layout.p_WR.start, layout.p_WH.stop)),
            ("ring_distance", layout.ring_distance),
            (
                "contact_speed",
                slice(layout.contact_speed, layout.contact_speed + 1),
            ),
        ):
            self.DeclareVectorOutputPort(
                name,
                where.stop - where.start,
                functools.partial(self._calc_part, where=where),
                prerequisites_of_calc=inputs,
            )

    def _calc_part(self, context, output, where):
        output.SetFromVector(self._truth_port.Eval(context)[where])

    def _calc_truth(self, context, output):
        poses = self._poses_port.Eval(context)
        velocities = self._velocities_port.Eval(context)
        X_WB = np.array([poses[b].GetAsMatrix34() for b in self._bodies])
        V_WT = velocities[self._tcp_body].get_coeffs()
        if len(self._radii):
            skeleton = self._skeleton_port.Eval(context)
        else:
            skeleton = np.empty(0)
        truth = _calc_truth(
            X_WB,
            V_WT,
            *self._shapes,
            skeleton.reshape(-1, 2, 3),
            self._radii,
            self._frame_body,
            self._X_BF,
            self._pelvis,
        )
        layout = self._layout
        if truth[layout.distance] <= 0.0:
            # Rare, so that only then every body's velocity is converted.
            ends = skeleton.reshape(-1, 2, 3)
            speed, body, part = calc_contact_speed(
                X_WB,
                np.array([velocities[b].get_coeffs() for b in self._bodies]),
                *self._shapes,
                ends[:, 0],
                ends[:, 1],
                self._radii,
            )
            truth[layout.contact_speed] = speed
            truth[layout.robot_body] = body
            truth[layout.person_part] = part
        output.SetFromVector(truth)
