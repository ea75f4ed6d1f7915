"""Faults of rings and of their wires, injected on purpose."""

from collections.abc import Callable, Iterable, Mapping
import dataclasses as dc
import re

import numpy as np

from tofssm_drake.errors import UserError, require
from tofssm_drake.ringlink.ring_frame import (
    FLAG_BUS_ERROR,
    FLAG_RESTARTED,
    SEQUENCE_BITS,
    TIME_BITS,
    RingFrame,
)
from tofssm_drake.sensors.range_status import (
    STATUS_BUS_FAILURE,
    STATUS_NO_NEW_DATA,
    STATUS_SIGNAL_FAIL,
    STATUS_VALID,
)

_MAX_MM = np.iinfo(np.uint16).max
_MAX_BYTE = np.iinfo(np.uint8).max
_LATE_FRAMES = 8
_GLITCH_PERIOD = 50
_GLITCH_MM = 27
_CLOCK_ERROR = 0.01


@dc.dataclass(kw_only=True)
class _Memory:
    """What a fault remembers of the frames since it began."""

    first: RingFrame
    """The first one, undisturbed."""
    count: int = -1
    """Number of frames before this one."""
    held: list[RingFrame] = dc.field(default_factory=list)
    """Frames held back."""
    sent: int = 0
    """Number of frames that a slow device has sent."""
    random: np.random.Generator = dc.field(
        default_factory=lambda: np.random.default_rng(0)
    )


Change = Callable[[RingFrame, np.ndarray, _Memory], RingFrame | None]
"""Returns the frame after the fault; None: it does not come. The array says
which sensors are affected, (n,) bool."""


@dc.dataclass(frozen=True, kw_only=True)
class _Kind:
    """What a kind of fault does."""

    what: str
    """In words."""
    change: Change = lambda frame, hit, memory: frame
    per_sensor: bool = False
    """Whether it may affect a single sensor."""
    delay: float = 0.0
    """Delay of the frames, s."""
    damages: bool = False
    """Whether a bit of the frame is wrong."""


def _put(frame: RingFrame, hit: np.ndarray, **values) -> RingFrame:
    """Returns a frame with other values for some sensors."""
    return dc.replace(
        frame,
        **{
            name: np.where(hit, value, getattr(frame, name))
            for name, value in values.items()
        },
    )


def _fail(status: int) -> Change:
    def change(frame, hit, memory):
        if status in (STATUS_BUS_FAILURE, STATUS_NO_NEW_DATA):
            frame = _put(frame, hit, mm=0, age_ms=_MAX_BYTE)
        if status == STATUS_BUS_FAILURE:
            frame = dc.replace(frame, flags=frame.flags | FLAG_BUS_ERROR)
        return _put(frame, hit, status=status)

    return change


def _see(mm: int, status: int = STATUS_VALID) -> Change:
    return lambda frame, hit, memory: _put(frame, hit, mm=mm, status=status)


def _freeze(frame, hit, memory):
    first = memory.first
    return _put(
        frame,
        hit,
        mm=first.mm,
        status=first.status,
        age_ms=first.age_ms,
        period_ms=first.period_ms,
    )


def _hold(frame, hit, memory):
    memory.held.append(frame)
    return memory.held.pop(0) if len(memory.held) > _LATE_FRAMES else None


def _restart(frame, hit, memory):
    return dc.replace(frame, flags=frame.flags | FLAG_RESTARTED)


def _age(frame, hit, memory):
    return _put(frame, hit, age_ms=_MAX_BYTE)


def _glitch(frame, hit, memory):
    if memory.count % _GLITCH_PERIOD:
        return frame
    return _see(_GLITCH_MM)(frame, hit, memory)


def _lose(part: float) -> Change:
    def change(frame, hit, memory):
        return None if memory.random.random() < part else frame

    return change


def _run_clock(error: float) -> Change:
    def change(frame, hit, memory):
        elapsed = (frame.time_us - memory.first.time_us) % (1 << TIME_BITS)
        time_us = frame.time_us + round(error * elapsed)
        return dc.replace(frame, time_us=time_us % (1 << TIME_BITS))

    return change


def _slow_down(period: float) -> Change:
    """Sends the next frame once another period is over, and counts those."""

    def change(frame, hit, memory):
        elapsed = (frame.time_us - memory.first.time_us) % (1 << TIME_BITS)
        if elapsed < 1e6 * period * memory.sent:
            return None
        sequence = memory.first.sequence + memory.sent
        memory.sent += 1
        return dc.replace(
            frame,
            sequence=sequence % (1 << SEQUENCE_BITS),
            period_ms=np.full_like(frame.period_ms, round(1e3 * period)),
        )

    return change


def _skip(keep: int, period_ms: int) -> Change:
    def change(frame, hit, memory):
        frame = _put(frame, hit, period_ms=period_ms)
        if memory.count % keep == 0:
            return frame
        return _fail(STATUS_NO_NEW_DATA)(frame, hit, memory)

    return change


def _order(order: Callable[[np.ndarray], np.ndarray]) -> Change:
    def change(frame, hit, memory):
        return dc.replace(
            frame,
            **{
                name: order(getattr(frame, name))
                for name in ("mm", "status", "age_ms", "period_ms")
            },
        )

    return change


def _scale(gain: float, offset: float) -> Change:
    def change(frame, hit, memory):
        mm = np.rint(gain * np.asarray(frame.mm, float) + offset)
        return _put(frame, hit, mm=np.clip(mm, 0, _MAX_MM).astype(np.uint16))

    return change


_KINDS = {
    "silent": _Kind(what="no frames", change=_lose(1.0)),
    "corrupt": _Kind(what="one bit of each frame is wrong", damages=True),
    "duplicate": _Kind(
        what="the first frame again and again",
        change=lambda frame, hit, memory: memory.first,
    ),
    "frozen": _Kind(
        what="new sequence and time, but the first samples again and again",
        change=_freeze,
        per_sensor=True,
    ),
    "late": _Kind(what="each frame comes 8 frames later", change=_hold),
    "implausible": _Kind(
        what="valid distances of 65 m", change=_see(_MAX_MM), per_sensor=True
    ),
    "bus": _Kind(
        what="no sensor answers",
        change=_fail(STATUS_BUS_FAILURE),
        per_sensor=True,
    ),
    "restart": _Kind(
        what="the device restarts with each frame", change=_restart
    ),
    **{
        f"status{n}": _Kind(
            what=f"range status {n}", change=_fail(n), per_sensor=True
        )
        for n in (*range(1, 10), 12, 13, 14, 240, 253, 254, 255)
    },
    **{
        f"stuck{mm}": _Kind(
            what=f"a valid distance of {mm} mm",
            change=_see(mm),
            per_sensor=True,
        )
        for mm in (0, 27, 100, 300, 500)
    },
    "far": _Kind(
        what="a valid distance of 4000 mm, beyond the mode",
        change=_see(4000),
        per_sensor=True,
    ),
    "old": _Kind(
        what="samples of 255 ms or more", change=_age, per_sensor=True
    ),
    "glitch": _Kind(
        what="one valid distance of 27 mm in 50 samples",
        change=_glitch,
        per_sensor=True,
    ),
    "blind": _Kind(
        what="nothing returns, permanently",
        change=_see(_MAX_MM, STATUS_SIGNAL_FAIL),
        per_sensor=True,
    ),
    **{
        f"latency{ms}": _Kind(
            what=f"each frame comes {ms} ms later", delay=1e-3 * ms
        )
        for ms in (30, 45, 1000)
    },
    "loss10": _Kind(what="10 % of the frames lost", change=_lose(0.1)),
    "clockfast": _Kind(
        what="the device's clock 1 % fast", change=_run_clock(_CLOCK_ERROR)
    ),
    "clockslow": _Kind(
        what="the device's clock 1 % slow", change=_run_clock(-_CLOCK_ERROR)
    ),
    "period37": _Kind(
        what="at most one frame per 37 ms", change=_slow_down(0.037)
    ),
    **{
        f"slow{ms}": _Kind(
            what=f"new samples only in one frame of {keep}",
            change=_skip(keep, ms),
            per_sensor=True,
        )
        for keep, ms in ((2, 48), (3, 72), (4, 100))
    },
    "reversed": _Kind(
        what="the sensors are numbered backwards",
        change=_order(lambda values: values[::-1]),
    ),
    "shifted": _Kind(
        what="the sensors are numbered from the second one on",
        change=_order(lambda values: np.roll(values, -1)),
    ),
    "gain": _Kind(
        what="distances 1.5 times as long",
        change=_scale(1.5, 0.0),
        per_sensor=True,
    ),
    "offset": _Kind(
        what="distances 100 mm longer",
        change=_scale(1.0, 100.0),
        per_sensor=True,
    ),
}

FAULTS = {kind: entry.what for kind, entry in _KINDS.items()}
"""Kinds of faults and what they do."""

SENSOR_FAULTS = tuple(
    kind for kind, entry in _KINDS.items() if entry.per_sensor
)
"""Kinds that may affect a single sensor."""


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
    sensor: int | None = None
    """Index of the only sensor affected; None: all."""


def parse_ring_fault(
    text: str, rings: Mapping[str, int], where: str = "--fault"
) -> RingFault:
    """Reads a fault: KIND:RING[.SENSOR]@START[-END], s.

    Args:
        text: What the user wrote.
        where: Where the user wrote it.
        rings: Number of sensors of each ring, by name.

    Raises:
        UserError: It is not a fault.
    """
    form = (
        "use KIND:RING[.SENSOR]@START[-END], e.g. silent:elbow@20-25 or "
        "status253:tool.3@20"
    )
    match = re.fullmatch(
        r"([a-z]+\d*):(\w+)(?:\.(\d+))?@(\d+\.?\d*)(?:-(\d+\.?\d*))?", text
    )
    if match is None:
        raise UserError(f"{where}: {text!r} is not a fault; {form}")
    kind, ring, sensor, start, end = match.groups()
    require(
        kind in FAULTS,
        f"{where}: {kind!r} is unknown, use one of {', '.join(FAULTS)}",
    )
    require(
        ring in rings,
        f"{where}: there is no ring {ring!r}, use one of {', '.join(rings)}",
    )
    require(
        sensor is None or int(sensor) < rings[ring],
        f"{where}: there is no sensor {sensor}, use 0 to {rings[ring] - 1}",
    )
    require(
        sensor is None or kind in SENSOR_FAULTS,
        f"{where}: {kind!r} concerns a whole ring, write {kind}:{ring}@{start}",
    )
    fault = RingFault(
        kind=kind,
        ring=ring,
        start=float(start),
        end=np.inf if end is None else float(end),
        sensor=None if sensor is None else int(sensor),
    )
    require(
        fault.start < fault.end,
        f"{where}: {text!r} ends before it starts; {form}",
    )
    return fault


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Delivery:
    """A frame on its way."""

    time: float
    """When it arrives, s, on the clock of the faults."""
    frame: RingFrame
    is_damaged: bool = False


class FaultInjector:
    """Applies the faults of one ring to its frames.

    At the end of its fault a wrong clock shows the right time again, which may
    be a jump back: a real device restarts then.

    Attributes:
        faults: Of this ring.
    """

    def __init__(self, faults: Iterable[RingFault] = ()):
        """Takes the faults of one ring."""
        self.faults = tuple(faults)
        self._memories: dict[RingFault, _Memory] = {}
        self._deliveries: list[Delivery] = []

    def put(self, frame: RingFrame, time: float) -> None:
        """Takes a frame from the device.

        Args:
            frame: The frame.
            time: When, s, on the clock of the faults.
        """
        is_damaged, delay = False, 0.0
        for fault in self.faults:
            if not fault.start <= time < fault.end:
                continue
            kind = _KINDS[fault.kind]
            memory = self._memories.setdefault(fault, _Memory(first=frame))
            memory.count += 1
            n = len(frame.mm)
            hit = np.full(n, True)
            if fault.sensor is not None:
                hit = np.arange(n) == fault.sensor
            changed = kind.change(frame, hit, memory)
            if changed is None:
                return
            frame = changed
            is_damaged |= kind.damages
            delay += kind.delay
        self._deliveries.append(
            Delivery(time=time + delay, frame=frame, is_damaged=is_damaged)
        )

    def take(self, time: float) -> list[Delivery]:
        """Returns the frames that arrived since the last call, oldest first.

        Args:
            time: Now, s, on the clock of the faults.
        """
        due = [d for d in self._deliveries if d.time <= time]
        self._deliveries = [d for d in self._deliveries if d.time > time]
        return sorted(due, key=lambda delivery: delivery.time)


def damage(data: bytes) -> bytes:
    """Returns the bytes with one bit of the middle byte changed."""
    middle = len(data) // 2
    # Not to zero: on a serial line that would end the frame.
    bit = 0x40 if data[middle] != 0x40 else 0x20
    return data[:middle] + bytes([data[middle] ^ bit]) + data[middle + 1 :]
