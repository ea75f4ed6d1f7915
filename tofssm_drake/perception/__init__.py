"""The monitor's side of sensing: from scans to a separation."""

from tofssm_drake.perception.fusion import SeparationFusion
from tofssm_drake.perception.ideal_separation import (
    IdealSeparation,
    IdealSeparationConfig,
)
from tofssm_drake.perception.lidar_separation import (
    LidarSeparation,
    LidarSeparationConfig,
)
from tofssm_drake.perception.occlusion_mask import (
    OcclusionMask,
    OcclusionMaskConfig,
)
from tofssm_drake.perception.self_hit_watch import SelfHitStop, SelfHitWatch
from tofssm_drake.perception.separation import SeparationConfig, TofSeparation

__all__ = [
    "IdealSeparation",
    "IdealSeparationConfig",
    "LidarSeparation",
    "LidarSeparationConfig",
    "OcclusionMask",
    "OcclusionMaskConfig",
    "SelfHitStop",
    "SelfHitWatch",
    "SeparationConfig",
    "SeparationFusion",
    "TofSeparation",
]
