"""The person in the scene, as a LeafSystem on the SceneGraph."""

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    Capsule,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    MakePhongIllustrationProperties,
    PerceptionProperties,
    Rgba,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

from tofssm_drake.people.motion import HumanMotion, capsule_ends
from tofssm_drake.people.skeleton import CAPSULES, COLOURS, calc_capsule_poses

SHIRTS = (
    COLOURS["shirt"],
    (0.00, 0.45, 0.70, 1.0),
    (0.80, 0.47, 0.65, 1.0),
    (0.94, 0.89, 0.26, 1.0),
    (0.34, 0.71, 0.91, 1.0),
    (0.10, 0.10, 0.10, 1.0),
)
"""Shirts by which several people are told apart, RGBA: high-visibility orange,
then Okabe and Ito's blue, purple, yellow and sky, and black."""

_SHORTEST_CAPSULE = 1e-3
"""m; a shorter piece is registered as a sphere."""


class HumanAvatar(LeafSystem):
    """Moves a person of capsules through the scene.

    .. pydrake_system::

        name: HumanAvatar
        output_ports:
        - geometry_pose
        - skeleton

    One frame per capsule, in the order of skeleton.CAPSULES: its origin is
    the capsule's centre, its z axis goes from end A to end B. The geometry
    has the perception and the illustration role. It has no proximity role: a
    person is something to be sensed and measured, and a MultibodyPlant would
    take it for a body in contact that it does not know.

    `geometry_pose` (FramePoseVector) belongs on the SceneGraph's
    `get_source_pose_port(source_id)`; `skeleton` is the vector of capsule
    ends [p_A, p_B] in W, capsule by capsule, m, 6 c values.

    Attributes:
        motion: The motion.
        source_id: Of the geometry on the SceneGraph.
        frame_ids: One per capsule.
        geometry_ids: One per capsule.
        radii: Of the capsules, m, shape (c,).
    """

    def __init__(
        self,
        *,
        scene_graph: SceneGraph,
        motion: HumanMotion,
        name: str = "human",
        shirt: tuple[float, float, float, float] = COLOURS["shirt"],
    ):
        """Registers the person's frames and geometry.

        Args:
            scene_graph: Where to register; the caller connects the port.
            motion: How the person moves.
            name: Of the source, and the prefix of frames and geometries.
            shirt: Its colour, RGBA.
        """
        super().__init__()
        self.set_name(name)
        self.motion = motion
        self.radii = motion.radii
        self.shirt = shirt
        self.source_id = scene_graph.RegisterSource(name)
        colours = COLOURS | {"shirt": shirt}
        self.frame_ids = []
        self.geometry_ids = []
        for capsule, radius, length in zip(
            CAPSULES, motion.radii, motion.lengths, strict=True
        ):
            frame_name = f"{name}_{capsule.name}"
            frame_id = scene_graph.RegisterFrame(
                self.source_id, GeometryFrame(frame_name)
            )
            if length < _SHORTEST_CAPSULE:
                shape = Sphere(radius)
            else:
                shape = Capsule(radius, length)
            colour = colours[capsule.colour]
            instance = GeometryInstance(RigidTransform(), shape, frame_name)
            instance.set_illustration_properties(
                MakePhongIllustrationProperties(colour)
            )
            perception = PerceptionProperties()
            perception.AddProperty("phong", "diffuse", Rgba(*colour))
            instance.set_perception_properties(perception)
            self.frame_ids.append(frame_id)
            self.geometry_ids.append(
                scene_graph.RegisterGeometry(self.source_id, frame_id, instance)
            )
        self._geometry_pose = self.DeclareAbstractOutputPort(
            "geometry_pose",
            alloc=lambda: Value(FramePoseVector()),
            calc=self._calc_geometry_pose,
            prerequisites_of_calc={self.time_ticket()},
        )
        self._skeleton = self.DeclareVectorOutputPort(
            "skeleton",
            6 * len(CAPSULES),
            self._calc_skeleton,
            prerequisites_of_calc={self.time_ticket()},
        )

    def _calc_geometry_pose(self, context, output):
        ends = capsule_ends(self.motion, context.get_time())
        poses = np.empty((len(ends), 3, 4))
        calc_capsule_poses(ends, poses)
        set_value = output.get_mutable_value().set_value
        # Orthonormal by construction; the check would take most of the time.
        make_pose = RigidTransform.MakeUnchecked
        for frame_id, pose in zip(self.frame_ids, poses, strict=True):
            set_value(frame_id, make_pose(pose))

    def _calc_skeleton(self, context, output):
        ends = capsule_ends(self.motion, context.get_time())
        output.SetFromVector(ends.ravel())
