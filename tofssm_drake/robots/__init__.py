"""Any brand of robot: its reports, connection and driver."""

from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.robots.driver import (
    Driver,
    DriverTraits,
    read_carried_objects,
)
from tofssm_drake.robots.link_client import LinkClient, RobotLink
from tofssm_drake.robots.robot_connection import RobotConnection, RobotStatus
from tofssm_drake.robots.robot_modes import RobotMode, RuntimeState, SafetyMode

__all__ = [
    "Driver",
    "DriverTraits",
    "LinkClient",
    "RobotConnection",
    "RobotLink",
    "RobotMode",
    "RobotReport",
    "RobotStatus",
    "RuntimeState",
    "SafetyMode",
    "SliderCommand",
    "read_carried_objects",
]
