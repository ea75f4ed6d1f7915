"""Real rings: frames, receiver, Drake systems, simulated devices."""

from tofssm_drake.ringlink.ring_address import parse_ring_address
from tofssm_drake.ringlink.ring_frame import (
    FrameError,
    FrameStream,
    RingFrame,
    decode_frame,
    encode_frame,
    encode_serial,
)
from tofssm_drake.ringlink.ring_link import RingLink
from tofssm_drake.ringlink.ring_receiver import RingLinkConfig, RingReceiver
from tofssm_drake.ringlink.ring_systems import (
    RingInterfaceSystem,
    RingSubscriberSystem,
)

__all__ = [
    "FrameError",
    "FrameStream",
    "RingFrame",
    "RingInterfaceSystem",
    "RingLink",
    "RingLinkConfig",
    "RingReceiver",
    "RingSubscriberSystem",
    "decode_frame",
    "encode_frame",
    "encode_serial",
    "parse_ring_address",
]
