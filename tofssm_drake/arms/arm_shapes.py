"""Which shapes of an arm are seen, shown and measured to.

A description has visual shapes (roles perception and illustration) and
collision shapes (role proximity). Here sensors see the ones that the user
chose, and distances are measured to capsules and spheres: the description's
own, if it has no others, or capsules fitted around each link's collision
shapes. A link with only one kind of shapes is seen and measured to by these.
Drake cannot read STL and COLLADA; such meshes are read by trimesh
(`arm_surfaces`).
"""

import dataclasses as dc

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    Capsule,
    GeometryInstance,
    IllustrationProperties,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    ProximityProperties,
    Role,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.arm_file import ForeignMesh
from tofssm_drake.arms.capsules import Coverage, FittedCapsule
from tofssm_drake.arms.chain import list_arm_bodies
from tofssm_drake.errors import require


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Piece:
    """One shape of a body."""

    shape: Shape
    X_BG: RigidTransform
    is_foreign: bool
    """Whether it is not in the SceneGraph yet."""

    def is_simple(self) -> bool:
        """Returns whether distances to it are closed-form."""
        return isinstance(self.shape, Capsule | Sphere)


def set_arm_shapes(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    *,
    sensed: str,
    foreign: tuple[ForeignMesh, ...] = (),
) -> None:
    """Gives an arm's shapes their roles.

    Args:
        plant: Finalized and registered with the SceneGraph.
        scene_graph: Before its context is made.
        sensed: What the sensors see: "perception", "proximity" or "capsules".
        foreign: Meshes of arm and tool that Drake could not read.

    Raises:
        UserError: No body has a shape, or a mesh cannot be read.
    """
    inspector = scene_graph.model_inspector()
    any_shape = False
    for body in list_arm_bodies(plant):
        visual, collision = _find_pieces(plant, inspector, body, foreign)
        if not (visual or collision):
            continue
        any_shape = True
        roles = _Roles(plant, scene_graph, body)
        for piece in visual:
            if piece.is_foreign:
                roles.add(piece, Role.kIllustration)
        capsules = _make_capsules(collision or visual)
        if sensed == "perception" and visual:
            seen = [piece for piece in visual if piece.is_foreign]
        else:
            roles.remove(Role.kPerception)
            seen = capsules if sensed == "capsules" else collision or visual
        for piece in seen:
            roles.add(piece, Role.kPerception)
        if capsules is not collision:
            roles.remove(Role.kProximity)
            for piece in capsules:
                roles.add(piece, Role.kProximity)
    require(any_shape, "robot.file: no body of the arm has a shape")


def _make_capsules(pieces):
    """Returns shapes, if all have closed-form distances, or capsules around."""
    if all(piece.is_simple() for piece in pieces):
        return pieces
    # Only for these arms: what reads and fits meshes takes long to import.
    from tofssm_drake.arms.arm_surfaces import fit_shapes

    return [_make_piece(capsule) for capsule in fit_shapes(_place(pieces))]


def _place(pieces):
    """Returns pieces as `arm_surfaces` takes them."""
    return [(piece.shape, piece.X_BG) for piece in pieces]


def calc_arm_coverage(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    *,
    foreign: tuple[ForeignMesh, ...] = (),
) -> dict[str, Coverage]:
    """Returns how well fitted capsules cover each body's collision shapes.

    Args:
        plant: As in `set_arm_shapes`, before that is called.
        scene_graph: Its SceneGraph.
        foreign: Meshes of arm and tool that Drake could not read.

    Returns:
        By name of the body; those that keep their own capsules are left out.
    """
    from tofssm_drake.arms.arm_surfaces import calc_shape_coverage

    inspector = scene_graph.model_inspector()
    found = {}
    for body in list_arm_bodies(plant):
        visual, collision = _find_pieces(plant, inspector, body, foreign)
        collision = collision or visual
        if all(piece.is_simple() for piece in collision):
            continue
        found[body.name()] = calc_shape_coverage(_place(collision))
    return found


def _find_pieces(plant, inspector, body, foreign):
    """Returns a body's visual and its collision shapes."""
    found = []
    frame_id = plant.GetBodyFrameIdIfExists(body.index())
    model = plant.GetModelInstanceName(body.model_instance())
    for role, kind in (
        (Role.kPerception, "visual"),
        (Role.kProximity, "collision"),
    ):
        ids = inspector.GetGeometries(frame_id, role) if frame_id else []
        pieces = [
            _Piece(
                shape=inspector.GetShape(geometry_id),
                X_BG=inspector.GetPoseInFrame(geometry_id),
                is_foreign=False,
            )
            for geometry_id in sorted(ids, key=lambda x: x.get_value())
        ]
        pieces += [
            _read_foreign(mesh)
            for mesh in foreign
            if (mesh.kind, mesh.model, mesh.link) == (kind, model, body.name())
        ]
        found.append(pieces)
    return found


class _Roles:
    """Adds and removes roles of a body's shapes."""

    def __init__(self, plant, scene_graph, body):
        self._scene_graph = scene_graph
        self._source_id = plant.get_source_id()
        self._frame_id = plant.GetBodyFrameIdOrThrow(body.index())
        self._name = body.scoped_name().get_full()
        self._count = 0

    def add(self, piece, role):
        """Registers a shape of its own for a role."""
        self._count += 1
        geometry = GeometryInstance(
            piece.X_BG, piece.shape, f"{self._name}_{self._count}"
        )
        if role == Role.kPerception:
            geometry.set_perception_properties(PerceptionProperties())
        elif role == Role.kProximity:
            geometry.set_proximity_properties(ProximityProperties())
        else:
            geometry.set_illustration_properties(IllustrationProperties())
        self._scene_graph.RegisterGeometry(
            self._source_id, self._frame_id, geometry
        )

    def remove(self, role):
        """Takes a role from all shapes that the body has so far."""
        inspector = self._scene_graph.model_inspector()
        for geometry_id in inspector.GetGeometries(self._frame_id, role):
            self._scene_graph.RemoveRole(
                source_id=self._source_id, geometry_id=geometry_id, role=role
            )


def _read_foreign(mesh: ForeignMesh) -> _Piece:
    """Returns a mesh that Drake cannot read as one that it can."""
    from tofssm_drake.arms.arm_surfaces import convert_to_obj

    text = convert_to_obj(mesh.path, mesh.scale)
    return _Piece(
        shape=Mesh(
            InMemoryMesh(
                mesh_file=MemoryFile(text, ".obj", f"{mesh.path.stem}.obj")
            )
        ),
        X_BG=mesh.X_LG,
        is_foreign=True,
    )


def _make_piece(capsule: FittedCapsule) -> _Piece:
    """Returns a capsule as a shape."""
    axis = capsule.q - capsule.p
    length = float(np.linalg.norm(axis))
    centre = 0.5 * (capsule.p + capsule.q)
    if length < 1e-6:
        shape, X_BG = Sphere(capsule.radius + length), RigidTransform(centre)
    else:
        shape = Capsule(capsule.radius, length)
        X_BG = RigidTransform(RotationMatrix.MakeFromOneVector(axis, 2), centre)
    return _Piece(shape=shape, X_BG=X_BG, is_foreign=True)
