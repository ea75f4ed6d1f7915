"""From a ring device's clock to the host's.

A frame that left the device at its time t arrives at the host's time
t + offset + delay, with a delay of at least that of the fastest frames. Late
frames therefore say nothing about the offset, and early ones everything: the
offset is the least host minus device time, which may rise again no faster
than two clocks can drift apart. So a frame that was queued on the way shows as
an old sample, and cannot pass for a slow clock.
"""

import dataclasses as dc

# The drift is measured over at most this many seconds, in steps of one.
_SPAN = 30
# Below this span it is not known, s.
_LEAST_SPAN = 5.0


@dc.dataclass(frozen=True, kw_only=True)
class ClockMap:
    """What is known of a device's clock after some frames."""

    began: float
    """Host time of the first frame, s."""
    device: float
    """Device time of the last frame, s."""
    offset: float
    """Host minus device time for the fastest frames, s."""
    lateness: float
    """By how much the last frame came later than the fastest ones, s."""
    anchors: tuple[tuple[float, float], ...] = ()
    """Earlier device times and offsets, about a second apart."""

    @property
    def drift(self) -> float:
        """How much slower the device's clock is, s/s; 0: not known yet."""
        if not self.anchors:
            return 0.0
        device, offset = self.anchors[0]
        if self.device - device < _LEAST_SPAN:
            return 0.0
        return (self.offset - offset) / (self.device - device)

    def calc_host_time(self, device: float) -> float:
        """Returns the host's time at a device time, s.

        It is later than the truth by the delay of the fastest frames, which
        cannot be distinguished from an offset.
        """
        return device + self.offset


def start_clock_map(*, device: float, host: float) -> ClockMap:
    """Returns what is known after the first frame.

    Args:
        device: Device time in the frame, s.
        host: Host time of its arrival, s.
    """
    return ClockMap(
        began=host, device=device, offset=host - device, lateness=0.0
    )


def update_clock_map(
    clock: ClockMap,
    *,
    device: float,
    host: float,
    max_drift: float,
    is_late: bool = False,
) -> ClockMap:
    """Returns what is known after one more frame.

    Args:
        clock: What was known before.
        device: Device time in the frame, s; later than in the frame before.
        host: Host time of its arrival, s.
        max_drift: Greatest drift of the two clocks, s/s.
        is_late: Recent samples were too old. Then the clock is assumed to keep
            its measured rate; otherwise a lasting delay would gradually
            become an offset and its samples would seem young again.
    """
    elapsed = device - clock.device
    sample = host - device
    rate = min(clock.drift, max_drift) if is_late else max_drift
    offset = min(sample, clock.offset + rate * elapsed)
    anchors = clock.anchors
    # The first second may still be finding the fastest frames.
    if host - clock.began >= 1.0 and (
        not anchors or device - anchors[-1][0] >= 1.0
    ):
        anchors = (*anchors, (device, offset))[-_SPAN:]
    return dc.replace(
        clock,
        device=device,
        offset=offset,
        lateness=sample - offset,
        anchors=anchors,
    )


def calc_earliness(clock: ClockMap, *, device: float, host: float) -> float:
    """Returns by how much a frame comes too early, s; negative: it is late.

    While the clocks agree no frame is much faster than the fastest: a large
    value means that a clock jumped or that a queue is being emptied.
    """
    return clock.offset - (host - device)
