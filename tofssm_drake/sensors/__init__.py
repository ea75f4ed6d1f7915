"""The world's side of sensing: Time-of-Flight rings, planar lidar."""

from tofssm_drake.sensors.cone_sensor import ConeSensor
from tofssm_drake.sensors.custom_sensor import CustomSensor
from tofssm_drake.sensors.lidar_2d import Lidar2d, Lidar2dConfig
from tofssm_drake.sensors.range_sensor import RangeSensor, SensorTraits
from tofssm_drake.sensors.ring import Ring
from tofssm_drake.sensors.tof_rings import TofRings
from tofssm_drake.sensors.vl53l1x import Vl53l1x

__all__ = [
    "ConeSensor",
    "CustomSensor",
    "Lidar2d",
    "Lidar2dConfig",
    "RangeSensor",
    "Ring",
    "SensorTraits",
    "TofRings",
    "Vl53l1x",
]
