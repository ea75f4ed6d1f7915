"""What a ToF ring looks like: a band around the link, a window per sensor."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import (
    Box,
    Cylinder,
    GeometryInstance,
    MakePhongIllustrationProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

BAND = np.array([0.12, 0.13, 0.15, 1.0])
WINDOW = np.array([0.55, 0.78, 0.95, 1.0])

# How far the band is behind the sensors, and the depth of a window, m.
_DEPTH = 0.004
_WINDOW = 0.008


def add_ring_looks(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    *,
    rings: Sequence[str],
) -> None:
    """Adds illustration geometry for the rings; sensors do not see it.

    Args:
        plant: Finalized and registered with the SceneGraph, with frames
            `<ring>_ring` and `<ring>_ring_<j>`.
        scene_graph: Before its context is made.
        rings: Names of the rings.
    """
    context = plant.CreateDefaultContext()

    def add(frame_id, X_BG, shape, name, color):
        geometry = GeometryInstance(X_BG, shape, name)
        geometry.set_illustration_properties(
            MakePhongIllustrationProperties(color)
        )
        scene_graph.RegisterGeometry(plant.get_source_id(), frame_id, geometry)

    for ring in rings:
        frame = plant.GetFrameByName(f"{ring}_ring")
        body = frame.body()
        frame_id = plant.GetBodyFrameIdOrThrow(body.index())
        X_BL = frame.GetFixedPoseInBodyFrame()
        X_LS = _find_sensors(plant, context, frame, ring)
        radius = _find_radius(X_LS)
        if radius is not None:
            shape = Cylinder(radius - _DEPTH, 0.024)
            add(frame_id, X_BL, shape, f"{ring}_ring_band", BAND)
        for j, X in enumerate(X_LS):
            add(
                frame_id,
                X_BL @ X @ RigidTransform([-0.5 * _WINDOW, 0, 0]),
                Box(_WINDOW, 0.014, 0.012),
                f"{ring}_ring_window_{j}",
                WINDOW,
            )


def _find_sensors(plant, context, frame, ring):
    """Returns the poses of a ring's sensors in the ring's frame."""
    poses: list[RigidTransform] = []
    while plant.HasFrameNamed(f"{ring}_ring_{len(poses)}"):
        sensor = plant.GetFrameByName(f"{ring}_ring_{len(poses)}")
        poses.append(sensor.CalcPose(context, frame))
    return poses


def _find_radius(X_LS):
    """Returns the radius of the circle of the sensors, m; None: there is none.

    Sensors at poses of their own have no band to sit on.
    """
    radii = [np.linalg.norm(X.translation()[:2]) for X in X_LS]
    heights = [X.translation()[2] for X in X_LS]
    is_circle = np.ptp(radii) < 1e-6 and np.ptp(heights) < 1e-6
    return radii[0] if is_circle and radii[0] > _DEPTH else None
