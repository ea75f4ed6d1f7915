"""Stands in for a ring's microcontroller: sends frames of simulated scans."""

import dataclasses as dc
import errno
import os
import pty
import socket
import tty

import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_address import SerialAddress, UdpAddress
from tofssm_drake.ringlink.ring_fault_injection import damage
from tofssm_drake.ringlink.ring_frame import (
    SEQUENCE_BITS,
    TIME_BITS,
    RingFrame,
    encode_frame,
    encode_serial,
)

_MAX_MM = np.iinfo(np.uint16).max
_MAX_BYTE = np.iinfo(np.uint8).max


@dc.dataclass(frozen=True, kw_only=True)
class DeviceClock:
    """How a device's clock differs from the true one."""

    start: float = 0.0
    """What it shows at time 0, s."""
    drift: float = 0.0
    """How much faster it is, s/s."""

    def calc_time_us(self, time: float) -> int:
        """Returns the time shown, microseconds modulo 2^32.

        Args:
            time: True time, s.
        """
        shown = self.start + (1.0 + self.drift) * time
        return round(1e6 * shown) % (1 << TIME_BITS)


def make_frame(
    scan: RingScan,
    *,
    ring: int,
    timing_budget: float,
    period: float = 0.0,
    clock: DeviceClock | None = None,
    flags: int = 0,
) -> RingFrame:
    """Returns the frame in which a device would send a scan.

    Args:
        scan: With a sequence of 0 or more; its `time` is the end of the scan.
        ring: Number of the ring.
        timing_budget: Integration time, s: a sample is ready half of it after
            its `sensor_time`.
        period: Of all sensors, as the device measured it, s; 0: unknown.
        clock: The device's; None: it shows the true time.
        flags: FLAG_... bits.
    """
    clock = DeviceClock() if clock is None else clock
    age = scan.time - scan.sensor_time - 0.5 * timing_budget
    return RingFrame(
        ring=ring,
        flags=flags,
        sequence=scan.sequence % (1 << SEQUENCE_BITS),
        time_us=clock.calc_time_us(scan.time),
        mm=np.clip(np.rint(1e3 * scan.distance), 0, _MAX_MM).astype(np.uint16),
        status=scan.status,
        age_ms=np.clip(np.rint(1e3 * age), 0, _MAX_BYTE).astype(np.uint8),
        period_ms=np.full(
            len(scan.status), min(round(1e3 * period), _MAX_BYTE), np.uint8
        ),
    )


class UdpSender:
    """Sends each frame as one datagram."""

    def __init__(self, address: UdpAddress):
        """Makes the socket.

        Raises:
            UserError: There is no route to the address.
        """
        self.target = str(address)
        self._address = (address.host, address.port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            # Unbound, a datagram to 127.0.0.2 would come from 127.0.0.1.
            if address.senders == (address.host,):
                self._socket.bind((address.host, 0))
        except OSError as error:
            if error.errno != errno.EADDRNOTAVAIL:
                self._socket.close()
                raise UserError(
                    f"{self.target}: cannot send there: {error.strerror}"
                ) from None

    def send(self, frame: RingFrame, is_damaged: bool = False) -> bool:
        """Sends a frame, damaged on request; returns whether it left."""
        data = encode_frame(frame)
        return self.send_bytes(damage(data) if is_damaged else data)

    def send_bytes(self, data: bytes) -> bool:
        """Sends a datagram; returns whether it left."""
        try:
            self._socket.sendto(data, self._address)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()


class PtySender:
    """Sends frames over a pseudo terminal, as over a serial line.

    Attributes:
        target: The address for the other side, serial:///dev/pts/....
        path: The device's file.
    """

    def __init__(self):
        self._fd, self._other_end = pty.openpty()
        for fd in (self._fd, self._other_end):
            tty.setraw(fd)
        os.set_blocking(self._fd, False)
        self.path = os.ttyname(self._other_end)
        self.target = str(SerialAddress(path=self.path))

    def send(self, frame: RingFrame, is_damaged: bool = False) -> bool:
        """Sends a frame, damaged on request; returns whether all of it left."""
        data = encode_serial(frame)
        return self.send_bytes(damage(data) if is_damaged else data)

    def send_bytes(self, data: bytes) -> bool:
        """Sends bytes; returns whether all of them left."""
        try:
            return os.write(self._fd, data) == len(data)
        except BlockingIOError:
            # Nobody reads.
            return False

    def close(self) -> None:
        """Closes both ends of the line."""
        os.close(self._fd)
        os.close(self._other_end)
