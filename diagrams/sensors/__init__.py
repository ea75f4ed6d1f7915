"""Sensors of a cell: one file for each kind.

To add a kind, write its file, and name it in `Sensor` and in the two functions
below.
"""

from collections.abc import Mapping

from tofssm_drake.diagrams.sensors.motion_capture import (
    MotionCapture,
    add_motion_capture_to_monitor,
)
from tofssm_drake.diagrams.sensors.parts import Monitor, Sensing, World
from tofssm_drake.diagrams.sensors.planar_lidar import (
    PlanarLidar,
    add_lidar_to_monitor,
    add_lidar_to_world,
)
from tofssm_drake.diagrams.sensors.rings import (
    add_rings_to_monitor,
    add_rings_to_world,
    find_rings,
)
from tofssm_drake.errors import require
from tofssm_drake.sensors.ring import Ring

Sensor = Ring | PlanarLidar | MotionCapture


def add_sensors_to_world(world: World, sensors: Mapping[str, Sensor]) -> None:
    """Adds the simulated sensors; exports `scan_<name>` of each."""
    add_rings_to_world(world, find_rings(sensors))
    for name, sensor in sensors.items():
        if isinstance(sensor, PlanarLidar):
            add_lidar_to_world(world, name, sensor)


def add_sensors_to_monitor(
    monitor: Monitor, sensors: Mapping[str, Sensor]
) -> list[Sensing]:
    """Adds what turns the sensors' scans into separations."""
    sensing = add_rings_to_monitor(monitor, find_rings(sensors))
    for name, sensor in sensors.items():
        if isinstance(sensor, PlanarLidar):
            sensing.append(add_lidar_to_monitor(monitor, name, sensor))
        elif isinstance(sensor, MotionCapture):
            sensing.append(add_motion_capture_to_monitor(monitor, name, sensor))
    return sensing


def find_link_frames(sensors: Mapping[str, Sensor]) -> dict[str, str]:
    """Returns the frame of each watched link, by link, in order of sensors.

    Raises:
        UserError: If two sensors give their links the same name.
    """
    frames: dict[str, str] = {}
    for name, sensor in sensors.items():
        for link, frame in sensor.find_link_frames(name).items():
            require(
                link not in frames,
                f"sensors.{name}: another sensor has a link called {link!r}",
            )
            frames[link] = frame
    return frames
