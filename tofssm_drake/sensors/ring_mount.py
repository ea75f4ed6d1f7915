"""Where a ring is on a robot, read from the model."""

import dataclasses as dc

from pydrake.geometry import FrameId, GeometryId, Role, SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.errors import require


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingMount:
    """A ring of n sensors on a link of a MultibodyPlant."""

    name: str
    """The ring, e.g. "base"."""
    frame_id: FrameId
    """The frame F of the link that carries it."""
    X_FS: list[RigidTransform]
    """Poses of the sensors in F; x is the axis of the beam."""
    X_LS: list[RigidTransform]
    """The same in the ring's frame L, whose origin is the link's centre."""
    geometry_ids: list[GeometryId]
    """The link's own shapes, which its sensors do not see."""


def find_ring_mount(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    name: str,
    *,
    role: Role = Role.kPerception,
) -> RingMount:
    """Finds frame `<name>_ring` and its sensors `<name>_ring_0`, `_1`, ...

    Args:
        plant: finalized, registered with the inspector's SceneGraph.
        inspector: knows the shapes of the link.
        name: the ring.
        role: which shapes to use.

    Raises:
        UserError: if the model has no such frames, or they are on different
            links.
    """
    ring = f"{name}_ring"
    require(
        plant.HasFrameNamed(ring) and plant.HasFrameNamed(f"{ring}_0"),
        f"model: ring {name!r} needs frames {ring!r}, '{ring}_0', "
        f"'{ring}_1', ...",
    )
    frame_L = plant.GetFrameByName(ring)
    X_FL = frame_L.GetFixedPoseInBodyFrame()
    X_FS: list[RigidTransform] = []
    while plant.HasFrameNamed(f"{ring}_{len(X_FS)}"):
        frame_S = plant.GetFrameByName(f"{ring}_{len(X_FS)}")
        require(
            frame_S.body().index() == frame_L.body().index(),
            f"model: frame {frame_S.name()!r} is not on the link of {ring!r}",
        )
        X_FS.append(frame_S.GetFixedPoseInBodyFrame())
    frame_id = plant.GetBodyFrameIdOrThrow(frame_L.body().index())
    return RingMount(
        name=name,
        frame_id=frame_id,
        X_FS=X_FS,
        X_LS=[X_FL.InvertAndCompose(X) for X in X_FS],
        geometry_ids=inspector.GetGeometries(frame_id, role),
    )
