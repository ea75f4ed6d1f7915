"""The person: skeleton, generated walk, recordings, avatar."""

from tofssm_drake.people.avatar import HumanAvatar
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.custom_motion import CustomMotion
from tofssm_drake.people.motion import HumanMotion, make_motion
from tofssm_drake.people.moving_box import MovingBox, MovingBoxSystem
from tofssm_drake.people.walk import GeneratedWalk

__all__ = [
    "BvhRecording",
    "CustomMotion",
    "GeneratedWalk",
    "HumanAvatar",
    "HumanMotion",
    "MovingBox",
    "MovingBoxSystem",
    "make_motion",
]
