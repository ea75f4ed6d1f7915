"""Faults of rings and of their wires, put in on purpose."""

from collections.abc import Iterable
import dataclasses as dc
import re

import numpy as np

from tofssm_drake.errors import UserError, require
from tofssm_drake.hardware.ring_frame import (
    FLAG_BUS_ERROR,
    FLAG_RESTARTED,
    RingFrame,
)
from tofssm_drake.messages import RINGS
from tofssm_drake.sensing.vl53l1x import STATUS_BUS_FAILURE, STATUS_VALID

FAULTS = {
    "silent": "no frames",
    "corrupt": "one bit of each frame is wrong",
    "duplicate": "the first frame again and again",
    "frozen": "new sequence and time, but the first samples again and again",
    "late": "each frame comes 8 frames later",
    "implausible": "valid distances of 65 m",
    "bus": "no sensor answers",
    "restart": "the device starts anew with each frame",
}
"""Kinds of faults and what they do."""

_LATE_FRAMES = 8


@dc.dataclass(frozen=True, kw_only=True)
class RingFault:
    """What goes wrong with a ring, and when."""

    kind: str
    """One of FAULTS."""
    ring: str
    """Name of the ring."""
    start: float
    """From when on, s."""
    end: float = np.inf
    """Until when, s."""


def parse_ring_fault(text: str, where: str = "--fault") -> RingFault:
    """Reads a fault: KIND:RING@START or KIND:RING@START-END, s.

    Raises:
        UserError: It is none.
    """
    form = "use KIND:RING@START[-END], e.g. silent:elbow@20-25"
    match = re.fullmatch(
        r"([a-z]+):([a-z]+)@(\d+\.?\d*)(?:-(\d+\.?\d*))?", text
    )
    if match is None:
        raise UserError(f"{where}: {text!r} is no fault; {form}")
    kind, ring, start, end = match.groups()
    require(
        kind in FAULTS,
        f"{where}: {kind!r} is unknown, use one of {', '.join(FAULTS)}",
    )
    require(
        ring in RINGS,
        f"{where}: there is no ring {ring!r}, use one of {', '.join(RINGS)}",
    )
    fault = RingFault(
        kind=kind,
        ring=ring,
        start=float(start),
        end=np.inf if end is None else float(end),
    )
    require(
        fault.start < fault.end,
        f"{where}: {text!r} ends before it starts; {form}",
    )
    return fault


class FaultInjector:
    """Does to one ring's frames what its faults do.

    Args:
        faults: Of this ring.
    """

    def __init__(self, faults: Iterable[RingFault] = ()):
        self._faults = tuple(faults)
        self._first: dict[RingFault, RingFrame] = {}
        self._held: list[RingFrame] = []

    def apply(
        self, frame: RingFrame, time: float
    ) -> tuple[RingFrame | None, bool]:
        """Returns the frame to send, if any, and whether to damage it.

        Args:
            frame: As the device made it.
            time: When, s, on the clock of the faults.
        """
        is_damaged = False
        for fault in self._faults:
            if frame is None or not fault.start <= time < fault.end:
                continue
            if fault.kind == "corrupt":
                is_damaged = True
            else:
                first = self._first.setdefault(fault, frame)
                frame = self._change(fault.kind, frame, first)
        return frame, is_damaged

    def _change(self, kind, frame, first):
        n = len(frame.mm)
        if kind == "duplicate":
            return first
        if kind == "frozen":
            return dc.replace(
                first, sequence=frame.sequence, time_us=frame.time_us
            )
        if kind == "late":
            self._held.append(frame)
            if len(self._held) <= _LATE_FRAMES:
                return None
            return self._held.pop(0)
        if kind == "implausible":
            return dc.replace(
                frame,
                mm=np.full(n, 65535),
                status=np.full(n, STATUS_VALID),
            )
        if kind == "bus":
            return dc.replace(
                frame,
                flags=frame.flags | FLAG_BUS_ERROR,
                status=np.full(n, STATUS_BUS_FAILURE),
            )
        if kind == "restart":
            return dc.replace(frame, flags=frame.flags | FLAG_RESTARTED)
        # "silent"
        return None


def damage(data: bytes) -> bytes:
    """Returns the bytes with one bit of the middle one changed."""
    middle = len(data) // 2
    # Not to zero: on a serial line that would end the frame.
    bit = 0x40 if data[middle] != 0x40 else 0x20
    return data[:middle] + bytes([data[middle] ^ bit]) + data[middle + 1 :]
