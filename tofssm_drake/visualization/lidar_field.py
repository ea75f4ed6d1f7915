"""Where a planar lidar is and how far it sees, in Meshcat."""

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform

import tofssm_drake.visualization.palette as palette

_HOUSING = Rgba(0.15, 0.16, 0.18, 1.0)
_FIELD_OPACITY = 0.12


def make_field_mesh(
    angles: np.ndarray, max_range: float
) -> tuple[np.ndarray, np.ndarray]:
    """Makes the flat sector that a lidar sees.

    Args:
        angles: Its directions about z from x, rad, rising, (n,).
        max_range: Its radius, m.

    Returns:
        (vertices (3, v), faces (3, f)). It is closed to a disc if the gap
        between the last direction and the first is that of its neighbours.
    """
    rim = max_range * np.vstack(
        [np.cos(angles), np.sin(angles), np.zeros(len(angles))]
    )
    vertices = np.hstack([np.zeros((3, 1)), rim])
    i = np.arange(1, len(angles))
    faces = np.vstack([np.zeros(len(i), dtype=int), i, i + 1])
    gap = angles[0] + 2.0 * np.pi - angles[-1]
    if len(angles) > 1 and gap < 1.5 * (angles[-1] - angles[-2]):
        faces = np.hstack([faces, [[0], [len(angles)], [1]]])
    return vertices, faces


def draw_lidar(
    meshcat: Meshcat,
    path: str,
    *,
    X_WS: RigidTransform,
    angles: np.ndarray,
    max_range: float,
) -> None:
    """Draws a lidar's housing and the plane that it scans.

    Args:
        meshcat: Where to draw.
        path: Where in Meshcat's tree.
        X_WS: Pose of the scanner in world, m.
        angles: See `make_field_mesh`.
        max_range: Likewise.
    """
    beam = next(iter(palette.BEAM.values()))
    meshcat.SetObject(f"{path}/housing", Cylinder(0.06, 0.08), _HOUSING)
    meshcat.SetTriangleMesh(
        f"{path}/field",
        *make_field_mesh(angles, max_range),
        Rgba(beam.r(), beam.g(), beam.b(), _FIELD_OPACITY),
    )
    meshcat.SetTransform(path, X_WS)
