"""Arms of Universal Robots as a choice of the scenario, by their figures.

The bodies' frames are at the joints' axes and turn about z; `base` is UR's
own base frame and `tool0` the flange, so joint positions of a controller are
used unchanged.
"""

import dataclasses as dc

import numpy as np
from pydrake.geometry import Capsule, SceneGraph, Shape, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    RevoluteJoint,
    RotationalInertia,
    SpatialInertia,
)

from tofssm_drake.arms.arm import (
    ArmMount,
    make_arm_plant,
)
from tofssm_drake.arms.arm_file import add_arm_file, read_foreign_meshes
from tofssm_drake.arms.arm_shapes import set_arm_shapes
from tofssm_drake.arms.limits import ArmLimits
from tofssm_drake.arms.tool_down import UrLengths, calc_ur_joint_poses
from tofssm_drake.arms.ur_data import UrData, read_ur_data

UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""Joints in UR's order, base to flange."""

_LINKS = (
    "base",
    "shoulder_link",
    "upper_arm_link",
    "forearm_link",
    "wrist_1_link",
    "wrist_2_link",
    "wrist_3_link",
)

_FLANGE = "tool0"
_GREY = np.array([0.7, 0.72, 0.74, 1.0])


@dc.dataclass(kw_only=True)
class UrArm(ArmMount):
    """An arm of Universal Robots."""

    # Which: ur3e, ur5e, ur7e, ur10 (CB3), ur10e, ur12e, ur16e, ur20 or ur30.
    # Its figures are in models/ur/.
    model: str = "ur10"

    @property
    def is_cb3(self) -> bool:
        """Whether its controller is a CB3; else it is an e-Series or newer."""
        return self.model == "ur10"

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        read_ur_data(self.model, f"{where}.model")
        self.check_mount(where)
        self.read_limits(where)

    def add_to_plant(self, plant: MultibodyPlant) -> None:
        """Adds arm and tool to a plant that is not finalized.

        The arm is a model instance of the name of its kind. If the plant is
        registered with a SceneGraph, it has its shapes, too.
        """
        data = read_ur_data(self.model)
        if data.file:
            add_arm_file(plant, data.file, "robot.model")
        else:
            _add_ur_bodies(plant, data, self.model)
        base = plant.GetFrameByName("base")
        plant.WeldFrames(plant.world_frame(), base, self.X_WB.to_transform())
        acceleration = np.deg2rad(data.max_acceleration)
        for name, limit in zip(UR_JOINTS, acceleration, strict=True):
            plant.GetJointByName(name).set_acceleration_limits(
                np.array([-limit]), np.array([limit])
            )
        self.add_tool(plant, _FLANGE)

    def add_geometry(
        self, plant: MultibodyPlant, scene_graph: SceneGraph
    ) -> None:
        """Completes the tool's shapes; the arm's are added with the bodies.

        Args:
            plant: Finalized and registered with the SceneGraph.
            scene_graph: Before its context is made.
        """
        set_arm_shapes(
            plant,
            scene_graph,
            sensed="perception",
            foreign=read_foreign_meshes(self.tool, "robot.tool"),
        )

    def read_limits(self, where: str = "robot") -> ArmLimits:
        """Returns what the joints can do."""
        return ArmLimits.from_plant(make_arm_plant(self), where=where)


def get_ur_lengths(data: UrData) -> UrLengths:
    """Returns the arm's Denavit-Hartenberg lengths."""
    return UrLengths(data.d1, data.a2, data.a3, data.d4, data.d5, data.d6)


def _add_ur_bodies(plant, data, name):
    """Adds an arm's bodies, joints, motors and shapes."""
    instance = plant.AddModelInstance(name)
    bodies = [
        plant.AddRigidBody(link, instance, inertia)
        for link, inertia in zip(_LINKS, _make_inertias(data), strict=True)
    ]
    poses = calc_ur_joint_poses(get_ur_lengths(data))
    turn = np.deg2rad(data.position_limit)
    for i, (joint_name, X_PA) in enumerate(zip(UR_JOINTS, poses, strict=True)):
        parent = plant.AddFrame(
            FixedOffsetFrame(
                f"{joint_name}_parent",
                bodies[i].body_frame(),
                RigidTransform(RotationMatrix(X_PA[:, :3]), X_PA[:, 3]),
                instance,
            )
        )
        joint = plant.AddJoint(
            RevoluteJoint(
                name=joint_name,
                frame_on_parent=parent,
                frame_on_child=bodies[i + 1].body_frame(),
                axis=[0, 0, 1],
                pos_lower_limit=-turn,
                pos_upper_limit=turn,
                damping=0.0,
            )
        )
        speed = np.deg2rad(data.max_speed[i : i + 1])
        joint.set_velocity_limits(-speed, speed)
        plant.AddJointActuator(
            joint_name.replace("_joint", "_motor"), joint, data.max_torque[i]
        )
    plant.AddFrame(
        FixedOffsetFrame(
            _FLANGE, bodies[-1].body_frame(), RigidTransform(), instance
        )
    )
    if plant.geometry_source_is_registered():
        for link, shapes in enumerate(make_ur_shapes(data)):
            for i, (shape, X_BG) in enumerate(shapes):
                _add_shape(plant, bodies[link], shape, X_BG, f"part_{i}")


def _add_shape(plant, body, shape, X_BG, name):
    """Adds a shape that is seen, shown and measured to."""
    plant.RegisterVisualGeometry(body, X_BG, shape, f"{name}_seen", _GREY)
    plant.RegisterCollisionGeometry(
        body, X_BG, shape, name, CoulombFriction(0.5, 0.5)
    )


def _make_inertias(data):
    """Returns the spatial inertias of base and links in their bodies."""
    radius = data.radius.base
    inertias = [SpatialInertia.SolidSphereWithMass(data.base_mass, radius)]
    frames = _calc_dh_frames(data)
    for mass, p_DC, row, X_BD in zip(
        data.mass, data.center_of_mass, data.inertia, frames, strict=True
    ):
        I_DC = RotationalInertia(*row)
        inertias.append(
            SpatialInertia.MakeFromCentralInertia(
                mass, X_BD @ np.array(p_DC), I_DC.ReExpress(X_BD.rotation())
            )
        )
    return inertias


def _calc_dh_frames(data):
    """Returns the pose of each link's Denavit-Hartenberg frame in its body.

    UR's table has a link's frame at its end: a body's is the same before the
    length a and the angle alpha.
    """
    quarter = np.pi / 2
    return [
        RigidTransform(RotationMatrix.MakeXRotation(alpha), [a, 0.0, 0.0])
        for a, alpha in (
            (0.0, quarter),
            (data.a2, 0.0),
            (data.a3, 0.0),
            (0.0, quarter),
            (0.0, -quarter),
            (0.0, 0.0),
        )
    ]


def make_ur_shapes(
    data: UrData,
) -> list[list[tuple[Shape, RigidTransform]]]:
    """Returns the capsules and spheres of base and links.

    They follow the links' axes: joint housings along the joints, tubes between
    them. Where the housings end is assumed in proportion to their radii, as
    measured on the meshes of CB3 arms.

    Args:
        data: Figures of the arm.

    Returns:
        Of each of the seven bodies, the shapes and their poses in it.
    """
    r = data.radius
    shoulder, elbow = data.shoulder_offset, data.elbow_offset
    middle = 0.5 * (shoulder + elbow)
    wrist = 0.5 * (elbow + data.d4) - 0.5 * r.wrist
    a2, a3 = data.a2, data.a3
    reach_1 = 0.5 * data.d5 - 0.6 * r.wrist
    reach_2 = 0.5 * data.d6 - 0.35 * r.wrist
    joint = ((0, 0, 0.4 * r.wrist), (0, 0, -0.5 * r.wrist), r.wrist)
    ends = (
        [((0, 0, 0.02), (0, 0, 0.02), r.base)],
        [
            (
                (0, 0, 0.35 * r.shoulder),
                (0, 0, min(r.shoulder - data.d1, -0.35 * r.shoulder)),
                r.shoulder,
            ),
            ((0, 0, 0), (0, -0.25 * shoulder, 0), r.shoulder),
        ],
        [
            (
                (0, 0, shoulder - 0.6 * r.shoulder),
                (0, 0, shoulder + 0.55 * r.shoulder),
                r.shoulder,
            ),
            ((0, 0, shoulder), (a2, 0, shoulder), r.upper_arm),
            ((a2, 0, middle), (a2, 0, shoulder + 0.55 * r.elbow), r.elbow),
        ],
        [
            ((0, 0, elbow - 0.6 * r.elbow), (0, 0, middle), r.elbow),
            ((0, 0, elbow), (a3, 0, elbow), r.forearm),
            ((a3, 0, elbow - 0.4 * r.wrist), (a3, 0, wrist), r.wrist),
        ],
        [joint, ((0, 0.45 * r.wrist, 0), (0, -reach_1, 0), r.wrist)],
        [joint, ((0, -0.45 * r.wrist, 0), (0, reach_2, 0), r.wrist)],
        [((0, 0, -0.43 * r.wrist), (0, 0, -0.43 * r.wrist), r.wrist)],
    )
    return [[_make_capsule(*row) for row in rows] for rows in ends]


def _make_capsule(p, q, radius):
    """Returns the shape from one end to the other, and its pose."""
    p, q = np.array(p, dtype=float), np.array(q, dtype=float)
    length = float(np.linalg.norm(q - p))
    if length < 1e-6:
        return Sphere(radius), RigidTransform(p)
    R = RotationMatrix.MakeFromOneVector(q - p, 2)
    return Capsule(radius, length), RigidTransform(R, 0.5 * (p + q))
