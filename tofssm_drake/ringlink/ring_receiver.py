"""From a ring's frames to the scans that the monitor takes.

No clock, no socket: the scans follow from the bytes and their times of
arrival, so a recording of both gives the same scans again.
"""

from collections.abc import Mapping, Sequence
import dataclasses as dc

import numpy as np

from tofssm_drake.device_clock import (
    ClockMap,
    calc_earliness,
    start_clock_map,
    update_clock_map,
)
from tofssm_drake.errors import check_range, require
from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_budget import (
    FrameTiming,
    LinkFigures,
    LinkWatch,
    RingBudget,
    restart_watch,
    update_watch,
)
from tofssm_drake.ringlink.ring_faults import (
    FROZEN_SAMPLES,
    calc_frozen_samples,
    count_repeats,
    find_frozen_sensors,
)
from tofssm_drake.ringlink.ring_frame import (
    FLAG_RESTARTED,
    FLAG_SELF_TEST,
    SEQUENCE_BITS,
    TIME_BITS,
    FrameError,
    FrameStream,
    RingFrame,
    decode_frame,
    peek_ring,
    unwrap,
)
from tofssm_drake.sensors.range_status import (
    STATUS_BUS_FAILURE,
    STATUS_CONTESTED,
    STATUS_FROZEN,
    STATUS_NO_NEW_DATA,
    STATUS_NONE,
    STATUS_SELF_TEST,
)
from tofssm_drake.sensors.ring import Ring

_SATURATED_AGE = 255

# This many frames in a row from before the last one mean that the device has
# restarted, not that datagrams overtook each other.
_OLD_FRAMES = 3
# Old frames between good ones come from a second device with the same number.
# Each adds 1, a good frame takes off less; from the limit on it is certain.
_PER_GOOD_FRAME = 0.4
_CONTESTED = 8.0
_MOST_CONTESTED = 16.0


@dc.dataclass(kw_only=True)
class RingLinkConfig:
    """How the frames of real rings are received."""

    # Number of each ring in its frames, in the scenario's order; empty: 0, 1,
    # 2, ...
    ring_numbers: list[int] = dc.field(default_factory=list)

    # Greatest drift between a device's clock and the host's, s/s (*assumed*:
    # two crystals of 100 ppm). The samples of a clock that is slower look
    # ever older, which stops the robot. A wrong clock is reported from
    # RingBudget.max_clock_error on.
    max_drift: float = 200e-6

    # Least time from the end of a scan to the arrival of its frame, s
    # (*assumed*: 48 bytes at 921600 baud and a USB packet). It cannot be
    # measured; samples are taken to be that much older than they look.
    min_delay: float = 0.001

    # A device must deliver for this long before its scans count, s: until its
    # clock is known and old frames have drained from buffers.
    settle_time: float = 0.5

    # If a frame comes earlier than the fastest so far by this much, s, a clock
    # has jumped: the device counts as restarted.
    max_earliness: float = 0.02

    # A frame that comes this much after the fastest ones is counted as late,
    # s. It is only counted: its samples have their true age.
    late: float = 0.02

    # A sensor that repeats a distance bit for bit this often is frozen; if no
    # sensor of a ring changes and their repetitions add up to it, the device
    # is. null: as often as its model's noise and resolution cannot explain,
    # see `calc_frozen_samples`; 25 for a VL53L1X. 0: repetitions are fine.
    frozen_samples: int | None = None

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            len(self.ring_numbers) == len(set(self.ring_numbers))
            and all(
                isinstance(i, int) and 0 <= i <= 255 for i in self.ring_numbers
            ),
            f"{where}.ring_numbers: {self.ring_numbers} must be different "
            "numbers from 0 to 255",
        )
        for name, low, high in (
            ("max_drift", 0.0, 0.01),
            ("min_delay", 0.0, 0.1),
            ("settle_time", 0.0, 60.0),
            ("max_earliness", 0.0, 1.0),
            ("late", 0.0, 10.0),
        ):
            check_range(where, name, getattr(self, name), low, high)
        if self.frozen_samples is not None:
            check_range(where, "frozen_samples", self.frozen_samples, 0, 1000)


def find_ring_numbers(
    config: RingLinkConfig, rings: Sequence[str]
) -> dict[str, int]:
    """Returns the number of each ring in its frames.

    Args:
        config: Settings; without numbers the rings are 0, 1, 2, ...
        rings: Names of the rings.

    Raises:
        UserError: There is not one number for each ring.
    """
    numbers = config.ring_numbers or list(range(len(rings)))
    require(
        len(numbers) == len(rings),
        f"ring_link.ring_numbers: {numbers} must be one for each of the rings "
        f"{', '.join(rings)}",
    )
    return dict(zip(rings, numbers, strict=True))


@dc.dataclass(kw_only=True)
class RingCounts:
    """What happened to the frames of one ring."""

    received: int = 0
    """Undamaged frames of this ring."""
    delivered: int = 0
    """Those that became scans."""
    lost: int = 0
    """Missing in the sequence."""
    duplicated: int = 0
    """Repeated sequence and time."""
    out_of_order: int = 0
    """From before the last one."""
    restarts: int = 0
    """Restarts of the device, its clock or the link."""
    late: int = 0
    """See RingLinkConfig.late."""
    wrong_size: int = 0
    """Number of sensors is not the ring's."""
    frozen: int = 0
    """Scans with a frozen sensor."""
    self_test: int = 0
    """Scans of made-up numbers: faulted."""
    contested: int = 0
    """Scans while another device sent frames of the same ring: faulted."""


class RingReceiver:
    """Turns the frames of one ring into scans on the host's clock.

    A frame becomes a scan unless it is not newer than the last, has another
    number of sensors, or comes while the device's clock is not known well
    enough; then the sequence stands still and the monitor's deadline stops the
    robot. What the host itself finds wrong with a sample becomes its status:
    STATUS_FROZEN, STATUS_SELF_TEST or STATUS_CONTESTED. What exceeds the link's
    budget is put into each scan's `problem`. All these are faults for the
    monitor.

    Attributes:
        counts: RingCounts so far.
        scan: The newest scan; empty before the first.
        clock: What is known of the device's clock; None: nothing.
        watch: Compares the link with its budget.
    """

    def __init__(
        self,
        *,
        config: RingLinkConfig,
        num_sensors: int,
        timing_budget: float,
        frozen_samples: int = FROZEN_SAMPLES,
        budget: RingBudget,
    ):
        """Constructs the receiver.

        Args:
            config: Settings.
            num_sensors: n of the ring.
            timing_budget: Integration time of the sensors, s; its middle is a
                sample's time.
            frozen_samples: For `config.frozen_samples`, if that is null.
            budget: Limits of the link.
        """
        self._config = config
        self._budget = budget
        self._num_sensors = num_sensors
        self._half_budget = 0.5 * timing_budget
        self._frozen_samples = (
            frozen_samples
            if config.frozen_samples is None
            else config.frozen_samples
        )
        self.counts = RingCounts()
        self.scan = RingScan()
        self.clock: ClockMap | None = None
        self.watch = LinkWatch()
        self._sequence = 0
        self._time_us = 0
        self._arrival = 0.0
        self._old_frames = 0
        self._doubt = 0.0
        self._forget_samples()

    @property
    def is_contested(self) -> bool:
        """Whether another device seems to have the same number."""
        return self._doubt >= _CONTESTED

    def receive(self, frame: RingFrame, arrival: float) -> RingScan | None:
        """Returns the scan that a frame gives, or None.

        Args:
            frame: Of this ring.
            arrival: Host's monotonic time of arrival, s, never decreasing.
        """
        self.counts.received += 1
        if len(frame.mm) != self._num_sensors:
            self.counts.wrong_size += 1
            return None
        if not self._follow(frame, arrival) or self.clock is None:
            return None
        self._arrival = arrival
        self._old_frames = 0
        self._doubt = max(self._doubt - _PER_GOOD_FRAME, 0.0)
        is_frozen = self._watch_samples(frame)
        sensor_time = self._calc_sensor_time(frame, self.clock)
        self._watch_link(frame, arrival, sensor_time)
        if self.clock.lateness > self._config.late:
            self.counts.late += 1
        if arrival - self.clock.began < self._config.settle_time:
            return None
        self.counts.delivered += 1
        self.scan = RingScan(
            sequence=self.scan.sequence + 1,
            time=arrival,
            sensor_time=sensor_time,
            distance=1e-3 * frame.mm,
            status=self._judge_samples(frame, is_frozen),
            problem=self.watch.problem,
        )
        return self.scan

    def _follow(self, frame, arrival):
        """Follows sequence and clock; returns whether the frame is newer."""
        if self.clock is None:
            return self._restart(frame, arrival, is_first=True)
        sequence = unwrap(frame.sequence, self._sequence, SEQUENCE_BITS)
        # Where its clock should be by now, even after a long silence.
        elapsed_us = round(1e6 * (arrival - self._arrival))
        time_us = unwrap(frame.time_us, self._time_us + elapsed_us, TIME_BITS)
        device = 1e-6 * time_us
        if sequence == self._sequence and time_us == self._time_us:
            self.counts.duplicated += 1
            return False
        if frame.flags & FLAG_RESTARTED:
            return self._restart(frame, arrival)
        if sequence <= self._sequence or time_us <= self._time_us:
            self.counts.out_of_order += 1
            self._old_frames += 1
            self._doubt = min(self._doubt + 1.0, _MOST_CONTESTED)
            if self._old_frames < _OLD_FRAMES:
                return False
            return self._restart(frame, arrival)
        earliness = calc_earliness(self.clock, device=device, host=arrival)
        if earliness > self._config.max_earliness:
            return self._restart(frame, arrival)
        self.counts.lost += sequence - self._sequence - 1
        self._sequence = sequence
        self._time_us = time_us
        self.clock = update_clock_map(
            self.clock,
            device=device,
            host=arrival,
            max_drift=self._config.max_drift,
            is_late=self.watch.figures.late > 0.0,
        )
        return True

    def _restart(self, frame, arrival, *, is_first=False):
        if not is_first:
            self.counts.restarts += 1
        self._sequence = frame.sequence
        self._time_us = frame.time_us
        self.clock = start_clock_map(device=1e-6 * frame.time_us, host=arrival)
        self.watch = restart_watch(self.watch)
        self._forget_samples()
        return True

    def _forget_samples(self):
        n = self._num_sensors
        # No sample has these numbers, so the first is not a repetition.
        self._mm = np.full(n, -1)
        self._status = np.full(n, STATUS_NONE, dtype=np.uint8)
        self._repeats = np.zeros(n, dtype=int)

    def _watch_samples(self, frame):
        """Remembers the fresh samples; returns which sensors are frozen."""
        self._repeats = count_repeats(
            self._repeats,
            before=(self._mm, self._status),
            now=(frame.mm, frame.status),
            most=2 * self._frozen_samples,
        )
        is_fresh = frame.status != STATUS_NO_NEW_DATA
        self._mm = np.where(is_fresh, frame.mm, self._mm)
        self._status = np.where(is_fresh, frame.status, self._status)
        return find_frozen_sensors(
            self._repeats,
            status=self._status,
            frozen_samples=self._frozen_samples,
        )

    def _calc_sensor_time(self, frame, clock):
        """Returns the middle of each integration, host's time, s, (n,)."""
        end = clock.calc_host_time(1e-6 * self._time_us)
        sensor_time = (
            end
            - self._config.min_delay
            - 1e-3 * frame.age_ms
            - self._half_budget
        )
        # Its age is not known any more.
        sensor_time[frame.age_ms == _SATURATED_AGE] = -np.inf
        return sensor_time

    def _watch_link(self, frame, arrival, sensor_time):
        """Measures the link with a frame newer than the last."""
        is_new = np.isfinite(sensor_time) & ~np.isin(
            frame.status, (STATUS_NO_NEW_DATA, STATUS_BUS_FAILURE)
        )
        self.watch = update_watch(
            self.watch,
            FrameTiming(
                arrival=arrival,
                device=1e-6 * self._time_us,
                sequence=self._sequence,
                age=arrival - float(sensor_time[is_new].min(initial=arrival)),
                status=frame.status,
                period_ms=frame.period_ms,
            ),
            self._budget,
        )

    def _judge_samples(self, frame, is_frozen):
        """Returns each sample's status, with what the host found wrong."""
        # The host's own numbers have no meaning in a frame.
        is_unknown = (frame.status >= STATUS_FROZEN) & (
            frame.status < STATUS_BUS_FAILURE
        )
        status = np.where(is_unknown, STATUS_NONE, frame.status)
        if is_frozen.any():
            self.counts.frozen += 1
            status[is_frozen] = STATUS_FROZEN
        if frame.flags & FLAG_SELF_TEST:
            self.counts.self_test += 1
            status[:] = STATUS_SELF_TEST
        if self.is_contested:
            self.counts.contested += 1
            status[:] = STATUS_CONTESTED
        return status.astype(np.uint8)


class RingDecoder:
    """Turns received bytes into scans of all rings.

    Attributes:
        unknown: Frames of rings that are not ours.
    """

    def __init__(
        self,
        *,
        config: RingLinkConfig,
        rings: Mapping[str, Ring],
        budget: Mapping[str, RingBudget] | None = None,
    ):
        """Constructs the decoder.

        Args:
            config: Settings.
            rings: By name, in the order of `config.ring_numbers`.
            budget: Limits of each ring's link; None: the default ones.

        Raises:
            UserError: A setting is out of range.
        """
        budget = budget or dict.fromkeys(rings, RingBudget())
        config.check("ring_link")
        for ring in rings:
            budget[ring].check("ring_budget")
        numbers = find_ring_numbers(config, tuple(rings))
        self._receivers = {
            number: (
                ring,
                RingReceiver(
                    config=config,
                    num_sensors=rings[ring].num_sensors,
                    timing_budget=rings[ring].sensor.traits.integration_time,
                    frozen_samples=calc_frozen_samples(
                        rings[ring].sensor.traits
                    ),
                    budget=budget[ring],
                ),
            )
            for ring, number in numbers.items()
        }
        self._streams: dict[str, FrameStream] = {}
        self._closed_errors: dict[str, int] = {}
        self._datagram_errors: dict[str, int] = {}
        self.unknown = 0

    def is_frame(self, data: bytes) -> bool:
        """Returns whether a datagram is an undamaged frame of a ring."""
        if peek_ring(data) not in self._receivers:
            return False
        try:
            decode_frame(data)
        except FrameError:
            return False
        return True

    def receive_datagram(self, data: bytes, arrival: float) -> bool:
        """Takes one datagram; returns whether it gave a scan.

        Args:
            data: The datagram.
            arrival: Host's monotonic time, s, never decreasing.
        """
        # Cheap, so that a flood of them does not delay the rings' frames.
        ring = peek_ring(data)
        if ring is not None and ring not in self._receivers:
            self.unknown += 1
            return False
        try:
            frame = decode_frame(data)
        except FrameError as error:
            count = self._datagram_errors.get(error.kind, 0)
            self._datagram_errors[error.kind] = count + 1
            return False
        return self._receive(frame, arrival)

    def receive_serial(self, source: str, data: bytes, arrival: float) -> bool:
        """Takes bytes of a serial line; returns whether they gave a scan.

        Args:
            source: Name of the line.
            data: The next bytes, any number of them.
            arrival: Host's monotonic time, s, never decreasing.
        """
        stream = self._streams.setdefault(source, FrameStream())
        # All of them, though only the last is used: for the counts.
        given = [self._receive(frame, arrival) for frame in stream.push(data)]
        return any(given)

    def reopen_serial(self, source: str) -> None:
        """Forgets the unfinished frame of a line that was reopened."""
        stream = self._streams.pop(source, None)
        if stream is not None:
            for kind, count in stream.errors.items():
                count += self._closed_errors.get(kind, 0)
                self._closed_errors[kind] = count

    def _receive(self, frame, arrival):
        if frame.ring not in self._receivers:
            self.unknown += 1
            return False
        _, receiver = self._receivers[frame.ring]
        return receiver.receive(frame, arrival) is not None

    @property
    def corrupt(self) -> dict[str, int]:
        """Damaged frames by `FrameError.kind`."""
        total = dict(self._closed_errors)
        for errors in (
            self._datagram_errors,
            *(stream.errors for stream in self._streams.values()),
        ):
            for kind, count in errors.items():
                total[kind] = total.get(kind, 0) + count
        return total

    @property
    def scans(self) -> tuple[RingScan, ...]:
        """The newest scan of each ring, on the host's clock."""
        return tuple(r.scan for _, r in self._receivers.values())

    @property
    def counts(self) -> dict[str, RingCounts]:
        """What happened to the frames of each ring so far."""
        return {
            ring: dc.replace(r.counts) for ring, r in self._receivers.values()
        }

    @property
    def contested(self) -> tuple[str, ...]:
        """The rings that several devices claim to be."""
        return tuple(
            ring for ring, r in self._receivers.values() if r.is_contested
        )

    @property
    def clocks(self) -> dict[str, ClockMap | None]:
        """What is known of each device's clock."""
        return {ring: r.clock for ring, r in self._receivers.values()}

    @property
    def figures(self) -> dict[str, LinkFigures]:
        """What was measured of each ring's link."""
        return {ring: r.watch.figures for ring, r in self._receivers.values()}
