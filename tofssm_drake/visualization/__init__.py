"""What a person sees in Meshcat: rays, skeleton, state, recording."""

from tofssm_drake.visualization.frames import FrameReader, FrameSender
from tofssm_drake.visualization.ring_rays import RingRays
from tofssm_drake.visualization.state_light import StateLight

__all__ = ["FrameReader", "FrameSender", "RingRays", "StateLight"]
