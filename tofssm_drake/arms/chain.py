"""The chain of joints between the world and an arm's tool, as in a plant."""

import dataclasses as dc

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Frame,
    Joint,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)
from pydrake.systems.framework import Context

from tofssm_drake.errors import UserError


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ArmChain:
    """The links of an arm in a plant; made by `find_chain`.

    Link 0 is the base, link i what moves with joint i - 1: one body and what
    is welded to it. A link's frame A has the joint's axis as its z axis; the
    base's is its body's own.
    """

    plant: MultibodyPlant
    """Finalized."""
    context: Context
    """Of the plant, with the arm's joints at zero."""
    joints: tuple[Joint, ...]
    """The n joints that move, base to tool."""
    bodies: tuple[RigidBody, ...]
    """One body of each link, next to the joint, (n + 1,)."""
    X_CA: tuple[RigidTransform, ...]
    """Pose of each link's frame in that body, (n + 1,)."""
    X_WB: np.ndarray
    """Pose of the base in world, (3, 4)."""
    X_PA: np.ndarray
    """Pose of each link's frame in the one before at zero, (n, 3, 4)."""
    slides: np.ndarray
    """Which joints are prismatic, (n,)."""

    link_of: dict
    """Link of each body that is a part of the arm, by `BodyIndex`. What is
    welded to a base that stands still is a part of the base."""

    def calc_pose_in_link(self, frame: Frame, link: int) -> RigidTransform:
        """Returns X_AF of a frame that rides on a link."""
        X_CF = frame.CalcPose(self.context, self.bodies[link].body_frame())
        return self.X_CA[link].InvertAndCompose(X_CF)


def find_chain(plant: MultibodyPlant, tcp: str = "tcp") -> ArmChain:
    """Finds what moves between the world and a tool.

    Args:
        plant: Finalized.
        tcp: Name of the tool's frame.

    Raises:
        UserError: If there is no such frame, nothing moves it, or a joint on
            the way neither turns nor slides.
    """
    if not plant.HasFrameNamed(tcp):
        raise UserError(f"robot model: no frame named {tcp}")
    joints = _find_joints(plant, tcp)
    context = plant.CreateDefaultContext()
    for joint in joints:
        _set_zero(joint, context)
    bodies = [joints[0].parent_body()]
    X_CA = [RigidTransform()]
    X_PA = []
    for joint in joints:
        X_MA = _calc_axis_frame(joint)
        X_CF = _calc_pose_in_body(joint.frame_on_parent(), bodies[-1], context)
        X_PA.append(_as_array(X_CA[-1].InvertAndCompose(X_CF).multiply(X_MA)))
        X_CM = joint.frame_on_child().CalcPoseInBodyFrame(context)
        X_CA.append(X_CM.multiply(X_MA))
        bodies.append(joint.child_body())
    return ArmChain(
        plant=plant,
        context=context,
        joints=tuple(joints),
        bodies=tuple(bodies),
        X_CA=tuple(X_CA),
        X_WB=_as_array(bodies[0].body_frame().CalcPoseInWorld(context)),
        X_PA=np.array(X_PA),
        slides=np.array([isinstance(j, PrismaticJoint) for j in joints]),
        link_of={
            other.index(): link
            for link, body in enumerate(bodies)
            for other in plant.GetBodiesWeldedTo(body)
        },
    )


def list_arm_bodies(plant: MultibodyPlant, tcp: str = "tcp") -> list[RigidBody]:
    """Returns the bodies of an arm and its tool, in the plant's order.

    Of what is welded to the base, those of its own model.

    Args:
        plant: Finalized.
        tcp: Name of the tool's frame.
    """
    links = find_chain(plant, tcp)
    base = links.bodies[0].model_instance()
    return [
        body
        for body in map(plant.get_body, sorted(links.link_of, key=int))
        if body.index() != plant.world_body().index()
        and (links.link_of[body.index()] or body.model_instance() == base)
    ]


def _find_joints(plant, tcp):
    """Returns the joints that move between world and tool, in that order."""
    joint_of = {
        joint.child_body().index(): joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
    }
    body = plant.GetFrameByName(tcp).body()
    joints: list[RevoluteJoint | PrismaticJoint] = []
    while body.index() != plant.world_body().index():
        joint = joint_of.get(body.index())
        if joint is None:
            raise UserError(
                f"robot model: no joint leads from {body.name()} to the world"
            )
        if isinstance(joint, RevoluteJoint | PrismaticJoint):
            joints.insert(0, joint)
        elif not isinstance(joint, WeldJoint):
            raise UserError(
                f"robot model: joint {joint.name()} is a {joint.type_name()} "
                "joint; an arm's joints must be revolute or prismatic, and "
                "its base welded"
            )
        body = joint.parent_body()
    if not joints:
        raise UserError(f"robot model: no joint moves frame {tcp}")
    return joints


def _set_zero(joint, context):
    if isinstance(joint, RevoluteJoint):
        joint.set_angle(context, 0.0)
    else:
        joint.set_translation(context, 0.0)


def _calc_axis_frame(joint):
    """Returns X_MA: turns the joint's frame so that z is its axis."""
    if isinstance(joint, RevoluteJoint):
        axis = joint.revolute_axis()
    else:
        axis = joint.translation_axis()
    if np.array_equal(axis, [0.0, 0.0, 1.0]):
        return RigidTransform()
    return RigidTransform(RotationMatrix.MakeFromOneVector(axis, 2), [0, 0, 0])


def _calc_pose_in_body(frame, body, context):
    """Returns X_BF of a frame on a body or on one welded to it."""
    if frame.body().index() == body.index():
        return frame.CalcPoseInBodyFrame(context)
    return frame.CalcPose(context, body.body_frame())


def _as_array(X):
    """Returns a pose as (3, 4)."""
    return np.ascontiguousarray(X.GetAsMatrix34())
