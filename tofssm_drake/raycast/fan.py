"""Bundles of ray directions."""

import itertools
import math

import numpy as np

_RAYS_OF_FIRST_RING = 8


def count_rays_per_ring(rays: int) -> list[int]:
    """Returns how many rays each ring of a cone fan has, innermost first.

    The central ray is not counted. A ring's share grows with its angle, so
    that the rays are spread evenly: 25 rays are 1 + 8 + 16.

    Args:
        rays: Number of rays of the whole fan, the central one included.
    """
    around = rays - 1
    if around == 0:
        return []
    # n rings with shares 8, 16, .. 8 n hold 4 n (n + 1) rays.
    rings = (math.sqrt(1.0 + 8.0 * around / _RAYS_OF_FIRST_RING) - 1.0) / 2.0
    rings = max(1, math.floor(rings + 0.5))
    edges = [
        round(around * ring * (ring + 1) / (rings * (rings + 1)))
        for ring in range(rings + 1)
    ]
    return [after - before for before, after in itertools.pairwise(edges)]


def make_cone_fan(fov_rad: float, rays: int) -> np.ndarray:
    """Returns unit directions that fill a cone about the x axis.

    The first ray is the axis itself, the others lie on circles around it at
    equal steps of angle. The outermost circle lies on the edge of the cone:
    what enters a field of view enters through its edge, so a fan that stops
    short of it sees an approaching person later.

    Args:
        fov_rad: Full opening angle of the cone, rad, in (0, pi].
        rays: Number of directions, at least 1.

    Returns:
        Directions in the frame of the cone, shape (rays, 3).

    Raises:
        ValueError: If an argument is out of range.
    """
    if not 0.0 < fov_rad <= math.pi:
        raise ValueError(f"fov_rad: {fov_rad} is not in (0, pi]")
    if rays < 1:
        raise ValueError(f"rays: {rays} is not at least 1")
    fan = np.zeros((rays, 3))
    fan[0, 0] = 1.0
    counts = count_rays_per_ring(rays)
    start = 1
    for ring, count in enumerate(counts, start=1):
        angle = 0.5 * fov_rad * ring / len(counts)
        # Every second ring is turned by half a step, which leaves no
        # uncovered spokes.
        turn = 2.0 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        fan[start : start + count, 0] = np.cos(angle)
        fan[start : start + count, 1] = np.sin(angle) * np.cos(turn)
        fan[start : start + count, 2] = np.sin(angle) * np.sin(turn)
        start += count
    return fan


def make_planar_fan(azimuths: np.ndarray) -> np.ndarray:
    """Returns directions in the xy plane, as a planar lidar scans them.

    Args:
        azimuths: Angles about z from x, rad, shape (n,).

    Returns:
        Unit directions, shape (n, 3).
    """
    return make_lidar_fan(azimuths, np.zeros(1))[0]


def make_lidar_fan(azimuths: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """Returns the directions of a lidar with several rows.

    Args:
        azimuths: Angles about z from x, rad, shape (n,).
        elevations: Angles of the rows up from the xy plane, rad, shape (m,).

    Returns:
        Unit directions, shape (m, n, 3).
    """
    azimuth, elevation = np.meshgrid(azimuths, elevations)
    return np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=-1,
    )


def make_pinhole_fan(
    *,
    width: int,
    height: int,
    focal_x: float,
    focal_y: float,
    center_x: float,
    center_y: float,
) -> np.ndarray:
    """Returns the directions of a camera's pixels, see Drake's CameraInfo.

    The camera looks along z; x points to the right in the image and y down.
    Of a range along such a ray, the direction's z component times the range
    is the depth.

    Args:
        width: Pixels in a row.
        height: Pixels in a column.
        focal_x: Focal length, pixels.
        focal_y: Likewise.
        center_x: Principal point, pixels; whole numbers are pixel centres.
        center_y: Likewise.

    Returns:
        Unit directions, shape (height, width, 3).
    """
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack(
        [
            (u - center_x) / focal_x,
            (v - center_y) / focal_y,
            np.ones((height, width)),
        ],
        axis=-1,
    )
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
