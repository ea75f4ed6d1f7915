"""The connection to real rings: sockets, serial lines, and one thread.

The thread reads everything as soon as it arrives and keeps the newest scan of
each ring. It never raises into its user: what goes wrong is reported in
`RingLinkStatus`, no new scans come, and the monitor's deadline stops the robot.
"""

from collections.abc import Callable, Sequence
import contextlib
import dataclasses as dc
import errno
import math
import os
import selectors
import socket
import threading
import time
from typing import Protocol

import numpy as np
import serial

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_address import (
    RingAddress,
    SerialAddress,
    UdpAddress,
    require_distinct,
)
from tofssm_drake.ringlink.ring_budget import LinkFigures
from tofssm_drake.ringlink.ring_receiver import RingCounts, RingDecoder

Tap = Callable[[float, str, bytes], None]
"""Called in the reader's thread with arrival time, s, source and bytes of the
rings' datagrams and of all that comes over serial lines, before it is decoded.
Datagrams that are no frames of a ring are only counted: a flood of them must
not fill a disk."""

_REOPEN_PERIOD = 0.5
_LONGEST_READ = 4096
# Size of the system's receive buffer, bytes; it may grant less.
_BUFFER = 1 << 20


@dc.dataclass(frozen=True, kw_only=True)
class RingLinkStatus:
    """How the link is doing; immutable."""

    source: str
    """Where the frames come from."""
    error: str = ""
    """Why nothing comes; empty: no known reason."""
    counts: dict[str, RingCounts]
    """What happened to each ring's frames."""
    corrupt: int = 0
    """Damaged frames."""
    foreign: int = 0
    """Datagrams of other senders."""
    unknown: int = 0
    """Frames of rings that are not ours."""
    measured: dict[str, float]
    """Host's time at which the oldest sample of each ring's newest scan was
    measured, s; -inf: none yet."""
    problem: dict[str, str] = dc.field(default_factory=dict)
    """What is wrong with each ring's link; empty: nothing."""
    figures: dict[str, LinkFigures] = dc.field(default_factory=dict)
    """What was measured of each ring's link."""

    def describe(self, now: float) -> str:
        """Says in one line how old the samples are and what went wrong.

        Args:
            now: Host's time, s.
        """
        ages = []
        for ring, measured in self.measured.items():
            age = 1e3 * (now - measured)
            ages.append(f"{ring} {age:.0f} ms" if age < 1e5 else f"{ring} -")
        faults = {"corrupt": self.corrupt, "foreign": self.foreign}
        faults["unknown"] = self.unknown
        for name in ("lost", "duplicated", "out_of_order", "restarts", "late"):
            faults[name] = sum(getattr(c, name) for c in self.counts.values())
        faults["wrong_size"] = sum(c.wrong_size for c in self.counts.values())
        faults["frozen"] = sum(c.frozen for c in self.counts.values())
        texts = [
            f"{ring}: {problem} ({describe_figures(self.figures[ring])})"
            for ring, problem in self.problem.items()
            if problem
        ]
        texts += [f"{n} {name}" for name, n in faults.items() if n]
        if self.error:
            texts.insert(0, self.error)
        return "; ".join([", ".join(ages), *texts])


def describe_figures(figures: LinkFigures) -> str:
    """Says in a few words what was measured of a link."""
    if math.isnan(figures.period):
        return "not measured yet"
    return (
        f"period {1e3 * figures.period:.1f} ms, "
        f"{100 * figures.lost:.0f} % lost, "
        f"{1e3 * figures.age:.0f} ms old on arrival"
    )


def calc_measured_time(scan: RingScan) -> float:
    """Returns when the oldest sample was measured, s; -inf: unknown.

    Samples of unknown age do not count.
    """
    is_known = np.isfinite(scan.sensor_time)
    if not is_known.any():
        return -math.inf
    return float(scan.sensor_time[is_known].min())


class RingConnection(Protocol):
    """What the systems need from a link."""

    def get_scans(self) -> tuple[RingScan, ...]:
        """Returns the newest scan of each ring, on the host's clock."""

    def get_status(self) -> RingLinkStatus:
        """Returns how the link is doing."""

    def wait_for_scans(self, timeout: float) -> bool:
        """Waits at most that long, s; returns whether every ring delivered."""

    def close(self) -> None:
        """Ends the link; may be called again."""


def make_status(
    decoder: RingDecoder, *, source: str, foreign: int = 0, error: str = ""
) -> RingLinkStatus:
    """Returns the status of a link with this decoder."""
    counts = decoder.counts
    texts = [f"two devices have the number of {r}" for r in decoder.contested]
    error = "; ".join([*texts, error] if error else texts)
    return RingLinkStatus(
        source=source,
        error=error,
        counts=counts,
        corrupt=sum(decoder.corrupt.values()),
        foreign=foreign,
        unknown=decoder.unknown,
        measured={
            ring: calc_measured_time(scan)
            for ring, scan in zip(counts, decoder.scans, strict=True)
        },
        problem={
            ring: scan.problem
            for ring, scan in zip(counts, decoder.scans, strict=True)
        },
        figures=decoder.figures,
    )


def explain_silence(status: RingLinkStatus) -> str:
    """Says in one line which rings never delivered, and what came instead."""
    missing = [
        ring for ring, counts in status.counts.items() if counts.delivered == 0
    ]
    came = ", ".join(
        f"{ring} {counts.received}"
        + (f" ({counts.wrong_size} of another size)" * bool(counts.wrong_size))
        for ring, counts in status.counts.items()
    )
    text = (
        f"rings: no scan of {', '.join(missing)} from {status.source}; frames "
        f"received: {came}; {status.corrupt} corrupt, {status.foreign} "
        f"foreign, {status.unknown} of unknown rings"
    )
    return f"{text}; {status.error}" if status.error else text


class UdpTransport:
    """A socket bound to one interface.

    Attributes:
        foreign: Number of datagrams of other senders, which are dropped.
        port: The bound port, also if 0 was asked for.
        pause: For how long nothing is read after what was of no use, s. In a
            flood many datagrams are then read at once, which takes a fraction
            of the processor's time.
    """

    pause = 0.001

    def __init__(self, address: UdpAddress):
        """Binds the socket.

        Raises:
            UserError: It cannot be bound.
        """
        self.source = str(address)
        self.foreign = 0
        self._senders = frozenset(address.senders)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            # A burst must not push out a ring's frame.
            self._socket.setsockopt(
                socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER
            )
            if address.interface:
                # An address alone accepts what comes in on any interface.
                self._socket.setsockopt(
                    socket.SOL_SOCKET,
                    socket.SO_BINDTODEVICE,
                    address.interface.encode() + b"\0",
                )
            self._socket.bind((address.host, address.port))
        except OSError as error:
            self._socket.close()
            raise UserError(
                f"{self.source}: cannot listen there: {error.strerror}"
            ) from None
        self.port = self._socket.getsockname()[1]

    def fileno(self) -> int:
        """Returns what a selector waits for."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Returns the waiting datagrams of our senders, oldest first."""
        datagrams = []
        # Bounded, so that a flood of one sender cannot starve the others.
        for _ in range(64):
            try:
                data, sender = self._socket.recvfrom(_LONGEST_READ)
            except BlockingIOError:
                break
            if sender[0] in self._senders:
                datagrams.append(data)
            else:
                self.foreign += 1
        return datagrams

    def is_of_a_ring(self, decoder: RingDecoder, data: bytes) -> bool:
        """Returns whether what `receive` returned may be a ring's."""
        return decoder.is_frame(data)

    def feed(self, decoder: RingDecoder, data: bytes, arrival: float) -> bool:
        """Decodes what `receive` returned; returns whether a scan came."""
        return decoder.receive_datagram(data, arrival)

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()


class SerialTransport:
    """An open serial line."""

    foreign = 0
    # The line is slow, and its frames come in pieces.
    pause = 0.0

    def __init__(self, address: SerialAddress):
        """Opens the line and discards what is in its buffer.

        Raises:
            UserError: It cannot be opened.
        """
        self.source = str(address)
        try:
            self._serial = serial.Serial(
                address.path, address.baud, timeout=0, exclusive=True
            )
            self._serial.reset_input_buffer()
        except (OSError, ValueError) as error:
            number = getattr(error, "errno", None)
            if number in (errno.EAGAIN, errno.EBUSY):
                reason = "another program has it"
            else:
                # It can be opened but not configured.
                reason = (
                    os.strerror(number)
                    if number and number != errno.ENOTTY
                    else "it is not a serial line"
                )
            raise UserError(
                f"{self.source}: cannot open it: {reason}"
            ) from None

    def fileno(self) -> int:
        """Returns what a selector waits for."""
        return self._serial.fileno()

    def receive(self) -> list[bytes]:
        """Returns the waiting bytes.

        Raises:
            OSError: The line is gone.
        """
        data = self._serial.read(_LONGEST_READ)
        return [data] if data else []

    def is_of_a_ring(self, decoder: RingDecoder, data: bytes) -> bool:
        """Returns True: frames come in pieces."""
        return True

    def feed(self, decoder: RingDecoder, data: bytes, arrival: float) -> bool:
        """Decodes what `receive` returned; returns whether a scan came."""
        return decoder.receive_serial(self.source, data, arrival)

    def close(self) -> None:
        """Closes the line."""
        self._serial.close()


def open_transport(address: RingAddress) -> UdpTransport | SerialTransport:
    """Opens an address.

    Raises:
        UserError: It cannot be opened.
    """
    if isinstance(address, UdpAddress):
        return UdpTransport(address)
    return SerialTransport(address)


class RingLink:
    """Receives frames over UDP and serial lines in one thread.

    A context manager: at its end the thread ends and all is closed. A serial
    line that breaks is reopened, and its rings start again.
    """

    def __init__(
        self,
        *,
        addresses: Sequence[RingAddress],
        decoder: RingDecoder,
        tap: Tap | None = None,
    ):
        """Opens all addresses and starts to read.

        Args:
            addresses: Where the rings' frames come from.
            decoder: Used by this link only.
            tap: Sees all that comes, e.g. to record it.

        Raises:
            UserError: An address cannot be opened, or is given twice.
        """
        require_distinct(addresses)
        self._decoder = decoder
        self._tap = tap
        self._changed = threading.Condition()
        self._error = ""
        self._closing = False
        self._scans = decoder.scans
        self._broken: dict[str, RingAddress] = {}
        self._addresses = {str(address): address for address in addresses}
        self._transports: dict[str, UdpTransport | SerialTransport] = {}
        self._foreign = 0
        self._wake, self._wake_end = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._wake_end, selectors.EVENT_READ)
        try:
            for source, address in self._addresses.items():
                self._open(source, address)
        except UserError:
            self._close_all()
            self._wake.close()
            raise
        self._thread = threading.Thread(
            target=self._run, name="ring link", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> "RingLink":
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    def get_scans(self) -> tuple[RingScan, ...]:
        """Returns the newest scan of each ring, on the host's clock."""
        return self._scans

    def get_status(self) -> RingLinkStatus:
        """Returns how the link is doing."""
        with self._changed:
            return make_status(
                self._decoder,
                source=", ".join(self._addresses),
                foreign=self._foreign,
                error=self._error,
            )

    def wait_for_scans(self, timeout: float) -> bool:
        """Waits at most that long, s; returns whether every ring delivered."""
        with self._changed:
            return self._changed.wait_for(
                lambda: all(scan.sequence >= 0 for scan in self._scans),
                timeout,
            )

    def close(self) -> None:
        """Ends the thread and closes everything; may be called again."""
        self._closing = True
        if self._thread.is_alive():
            # It may be about to end anyway: a frame has just come.
            with contextlib.suppress(OSError):
                self._wake.send(b"\0")
            self._thread.join()
        self._wake.close()

    def _open(self, source, address):
        transport = open_transport(address)
        self._transports[source] = transport
        self._selector.register(transport, selectors.EVENT_READ, source)

    def _run(self):
        try:
            reopen_time = 0.0
            while not self._closing:
                timeout = _REOPEN_PERIOD if self._broken else None
                for key, _ in self._selector.select(timeout):
                    if key.data is not None:
                        self._read(key.data)
                if self._broken and time.monotonic() >= reopen_time:
                    self._reopen()
                    reopen_time = time.monotonic() + _REOPEN_PERIOD
        except Exception as error:
            self._error = f"reader failed: {error!r}"
        finally:
            self._close_all()

    def _read(self, source):
        transport = self._transports[source]
        try:
            pieces = transport.receive()
        except OSError as error:
            self._break(source, str(error))
            return
        arrival = time.monotonic()
        if self._tap is not None:
            for data in pieces:
                if transport.is_of_a_ring(self._decoder, data):
                    self._tap(arrival, source, data)
        with self._changed:
            is_new = False
            for data in pieces:
                is_new |= transport.feed(self._decoder, data, arrival)
            self._foreign = sum(t.foreign for t in self._transports.values())
            if is_new:
                self._scans = self._decoder.scans
                self._changed.notify_all()
        if not is_new:
            time.sleep(transport.pause)

    def _break(self, source, reason):
        transport = self._transports.pop(source)
        self._selector.unregister(transport)
        transport.close()
        with self._changed:
            self._decoder.reopen_serial(source)
            self._broken[source] = self._addresses[source]
            self._error = f"{source} is gone: {reason}"

    def _reopen(self):
        for source, address in list(self._broken.items()):
            try:
                self._open(source, address)
            except UserError:
                continue
            with self._changed:
                del self._broken[source]
                if not self._broken:
                    self._error = ""

    def _close_all(self):
        for transport in self._transports.values():
            transport.close()
        self._selector.close()
        self._wake_end.close()


class LoopbackRingLink:
    """A link whose frames are handed in, for tests and replays."""

    def __init__(self, *, decoder: RingDecoder):
        self._decoder = decoder

    def put_datagram(self, data: bytes, arrival: float) -> bool:
        """Takes a datagram that came at that host time, s, never decreasing."""
        return self._decoder.receive_datagram(data, arrival)

    def put_serial(self, source: str, data: bytes, arrival: float) -> bool:
        """Takes bytes of a line that came at that host time, likewise."""
        return self._decoder.receive_serial(source, data, arrival)

    def get_scans(self) -> tuple[RingScan, ...]:
        """Returns the newest scan of each ring, on the host's clock."""
        return self._decoder.scans

    def get_status(self) -> RingLinkStatus:
        """Returns how the link is doing."""
        return make_status(self._decoder, source="loopback")

    def wait_for_scans(self, timeout: float) -> bool:
        """Returns at once whether every ring has delivered."""
        return all(scan.sequence >= 0 for scan in self._decoder.scans)

    def close(self) -> None:
        """Does nothing."""


class NullRingLink:
    """No rings: no scan ever comes, which is a fault for the monitor."""

    def __init__(self, *, decoder: RingDecoder):
        self._status = make_status(decoder, source="null")
        self._scans = tuple(RingScan() for _ in self._status.counts)

    def get_scans(self) -> tuple[RingScan, ...]:
        """Returns an empty scan of each ring."""
        return self._scans

    def get_status(self) -> RingLinkStatus:
        """Returns that nothing came."""
        return self._status

    def wait_for_scans(self, timeout: float) -> bool:
        """Returns False at once."""
        return False

    def close(self) -> None:
        """Does nothing."""
