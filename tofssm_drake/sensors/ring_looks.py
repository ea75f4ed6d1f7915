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
        j = 0
        while plant.HasFrameNamed(f"{ring}_ring_{j}"):
            sensor = plant.GetFrameByName(f"{ring}_ring_{j}")
            X_LS = sensor.CalcPose(context, frame)
            if j == 0:
                radius = np.linalg.norm(X_LS.translation()[:2])
                add(
                    frame_id,
                    X_BL,
                    Cylinder(radius - 0.004, 0.024),
                    f"{ring}_ring_band",
                    BAND,
                )
            add(
                frame_id,
                X_BL.multiply(X_LS).multiply(RigidTransform([-0.004, 0, 0])),
                Box(0.008, 0.014, 0.012),
                f"{ring}_ring_window_{j}",
                WINDOW,
            )
            j += 1
