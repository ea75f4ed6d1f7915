"""Rays against any SceneGraph."""

from tofssm_drake.raycast.fan import (
    make_cone_fan,
    make_lidar_fan,
    make_pinhole_fan,
    make_planar_fan,
)
from tofssm_drake.raycast.frame_poses import FramePoses
from tofssm_drake.raycast.ray_bundles import RayBundles
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.raycast.ray_caster_sensor import RayCasterSensor

__all__ = [
    "FramePoses",
    "RayBundles",
    "RayCaster",
    "RayCasterSensor",
    "make_cone_fan",
    "make_lidar_fan",
    "make_pinhole_fan",
    "make_planar_fan",
]
