"""The binary frame in which a ring sends its samples: encoding and decoding.

One frame holds one scan of one ring. A datagram carries it as it is; a serial
line carries it in COBS (consistent overhead byte stuffing) followed by a zero
byte, so that a reader finds the next frame after any damage. All numbers
are little-endian; docs/ring_link.md is the specification.

| offset   | size | field                                                   |
|----------|------|---------------------------------------------------------|
| 0        | 2    | magic "TR"                                              |
| 2        | 1    | version, 2                                              |
| 3        | 1    | number of the ring                                      |
| 4        | 1    | n, number of sensors: 1 to 64                           |
| 5        | 1    | flags                                                   |
| 6        | 2    | sequence of the ring, wraps                             |
| 8        | 4    | device time at the end of the scan, us, wraps           |
| 12       | 5 n  | per sensor: mm (2), status (1), age (1), period (1), ms |
| 12 + 5 n | 2    | CRC-16/CCITT-FALSE of all bytes before                  |
"""

import binascii
import dataclasses as dc
import struct

from cobs import cobs
import numpy as np

MOST_SENSORS = 64
"""Largest number of sensors of a ring."""

FLAG_RESTARTED = 0x01
"""The device has restarted since its last frame."""
FLAG_ODD = 0x02
"""The odd sensors' turn, if even and odd ones take turns."""
FLAG_BUS_ERROR = 0x04
"""A sensor did not answer on the I2C bus."""
FLAG_SELF_TEST = 0x80
"""Numbers made up by the device, not measured."""
_KNOWN_FLAGS = FLAG_RESTARTED | FLAG_ODD | FLAG_BUS_ERROR | FLAG_SELF_TEST

SEQUENCE_BITS = 16
TIME_BITS = 32

_HEADER = struct.Struct("<2sBBBBHI")
_CRC = struct.Struct("<H")
_SAMPLE = np.dtype(
    [("mm", "<u2"), ("status", "u1"), ("age", "u1"), ("period", "u1")]
)
_MAGIC = b"TR"
_VERSION = 2


def calc_frame_size(sensors: int) -> int:
    """Returns the size of a frame of n sensors in bytes, without COBS."""
    return _HEADER.size + _SAMPLE.itemsize * sensors + _CRC.size


# COBS adds one byte to each block of 254; the delimiter is not counted.
_LONGEST_PIECE = calc_frame_size(MOST_SENSORS) + (
    calc_frame_size(MOST_SENSORS) // 254 + 1
)


class FrameError(ValueError):
    """Bytes that are not a frame.

    Attributes:
        kind: What is wrong: "cobs", "length", "magic", "version", "flags" or
            "crc".
    """

    def __init__(self, kind: str):
        super().__init__(f"not a ring frame: wrong {kind}")
        self.kind = kind


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingFrame:
    """One scan of one ring as it travels; n sensors."""

    ring: int
    """Number of the ring."""
    flags: int = 0
    """FLAG_... bits."""
    sequence: int
    """Counts the ring's scans modulo 2^16."""
    time_us: int
    """Device's time at the end of the scan, microseconds modulo 2^32."""
    mm: np.ndarray
    """Measured distances, mm, (n,), uint16."""
    status: np.ndarray
    """Range status of each sensor (ST API numbers), (n,), uint8."""
    age_ms: np.ndarray
    """From the end of each sensor's integration to `time_us`, ms, (n,), uint8;
    255: that or more."""
    period_ms: np.ndarray
    """Each sensor's own period as the device measured it, ms, (n,), uint8; 0:
    not known yet, 255: that or more."""


def calc_crc(data: bytes) -> int:
    """Returns CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode_frame(frame: RingFrame) -> bytes:
    """Returns the bytes of a frame, without COBS.

    Raises:
        ValueError: A field does not fit into its bytes, or the number of
            sensors is not from 1 to MOST_SENSORS.
    """
    n = len(frame.mm)
    if not 0 < n <= MOST_SENSORS:
        raise ValueError(f"frame of {n} sensors; use 1 to {MOST_SENSORS}")
    if frame.flags & ~_KNOWN_FLAGS:
        raise ValueError(f"flags 0x{frame.flags:02x} are not all known")
    samples = np.empty(n, _SAMPLE)
    for name, values in (
        ("mm", frame.mm),
        ("status", frame.status),
        ("age", frame.age_ms),
        ("period", frame.period_ms),
    ):
        values = np.asarray(values)
        limit = np.iinfo(_SAMPLE[name]).max
        if (
            values.shape != (n,)
            or not ((values >= 0) & (values <= limit)).all()
        ):
            raise ValueError(f"{name}: needs {n} numbers from 0 to {limit}")
        samples[name] = values
    try:
        header = _HEADER.pack(
            _MAGIC,
            _VERSION,
            frame.ring,
            n,
            frame.flags,
            frame.sequence,
            frame.time_us,
        )
    except struct.error as error:
        raise ValueError(f"frame header: {error}") from None
    data = header + samples.tobytes()
    return data + _CRC.pack(calc_crc(data))


def peek_ring(data: bytes) -> int | None:
    """Returns the ring's number if the bytes begin like a frame; else None.

    It costs a hundredth of decoding the frame, and proves nothing.
    """
    if len(data) < _HEADER.size or data[:3] != _MAGIC + bytes([_VERSION]):
        return None
    return data[3]


def decode_frame(data: bytes) -> RingFrame:
    """Decodes a frame; the bytes must be exactly one.

    Raises:
        FrameError: They are not a frame.
    """
    size = len(data)
    if size < _HEADER.size:
        raise FrameError("length")
    magic, version, ring, n, flags, sequence, time_us = _HEADER.unpack_from(
        data
    )
    if magic != _MAGIC:
        raise FrameError("magic")
    if version != _VERSION:
        raise FrameError("version")
    if not 0 < n <= MOST_SENSORS or size != calc_frame_size(n):
        raise FrameError("length")
    (crc,) = _CRC.unpack_from(data, size - _CRC.size)
    if crc != calc_crc(data[: -_CRC.size]):
        raise FrameError("crc")
    if flags & ~_KNOWN_FLAGS:
        raise FrameError("flags")
    samples = np.frombuffer(data, _SAMPLE, n, _HEADER.size)
    return RingFrame(
        ring=ring,
        flags=flags,
        sequence=sequence,
        time_us=time_us,
        mm=samples["mm"],
        status=samples["status"],
        age_ms=samples["age"],
        period_ms=samples["period"],
    )


def encode_serial(frame: RingFrame) -> bytes:
    """Returns the bytes of a frame on a serial line."""
    return cobs.encode(encode_frame(frame)) + b"\0"


def _decode_cobs(piece):
    try:
        return cobs.decode(piece)
    except cobs.DecodeError:
        raise FrameError("cobs") from None


class FrameStream:
    """Finds the frames in the bytes of a serial line, however they are split.

    A damaged frame is dropped and counted; reading resumes at the next
    delimiter. Memory is bounded, whatever comes.

    Attributes:
        errors: Number of pieces that were not a frame, by `FrameError.kind`.
            What comes before the first delimiter is not counted: a reader
            may start in the middle of a frame.
    """

    def __init__(self):
        self.errors: dict[str, int] = {}
        self._rest = b""
        self._is_first = True

    def push(self, data: bytes) -> list[RingFrame]:
        """Returns the frames that these bytes complete, oldest first."""
        *pieces, rest = (self._rest + data).split(b"\0")
        # A piece that is too long is cut; it stays too long.
        self._rest = rest[: _LONGEST_PIECE + 1]
        frames = []
        for piece in pieces:
            is_first, self._is_first = self._is_first, False
            if not piece:
                continue
            try:
                if len(piece) > _LONGEST_PIECE:
                    raise FrameError("length")
                frames.append(decode_frame(_decode_cobs(piece)))
            except FrameError as error:
                if not is_first:
                    count = self.errors.get(error.kind, 0)
                    self.errors[error.kind] = count + 1
        return frames


def unwrap(value: int, near: int, bits: int) -> int:
    """Returns the number with the given low bits that is nearest to another.

    Args:
        value: The low bits, from a counter that wraps.
        near: The other number.
        bits: Number of bits of the counter.
    """
    half = 1 << (bits - 1)
    return near + (value - near + half) % (2 * half) - half
