"""UR robots: protocol, client, Drake systems, simulated robot."""

from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.rtde.rtde_systems import (
    RobotReportReceiver,
    RtdeInterfaceSystem,
    RtdePublisherSystem,
    RtdeSubscriberSystem,
    SliderControl,
)

__all__ = [
    "RobotReportReceiver",
    "RtdeClient",
    "RtdeConfig",
    "RtdeInterfaceSystem",
    "RtdePublisherSystem",
    "RtdeSubscriberSystem",
    "SliderControl",
]
