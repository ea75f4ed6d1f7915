"""The record of a run on hardware: an MCAP file, written as things happen.

Nothing is held back in chunks: what was written is in the file after the next
flush, at most half a second later, and whoever reads it comes as far as it
goes. So a process that is killed loses no more than that.

Each tick is one message on `/tick`: all that the monitor was handed, and what
it made of it. A number that is none is null there, and infinity is 1e999.
"""

from collections.abc import Iterator
import contextlib
import dataclasses as dc
import json
import math
import pathlib
import re
import struct
import threading
import time

from mcap.exceptions import McapError
import mcap.records
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
import numpy as np

from tofssm_drake.errors import UserError, require
from tofssm_drake.messages import RingScan, RobotReport, SliderCommand

_FLUSH_PERIOD = 0.5
_VERSION = 1
_TOKENS = re.compile(r'"(?:[^"\\]|\\.)*"|NaN|Infinity')
_REPLACED = {"NaN": "null", "Infinity": "1e999"}

_RUN, _TICK = "/run", "/tick"
_BYTES = {
    "/robot/received": "RTDE packages, each whole",
    "/robot/sent": "RTDE packages, each whole",
    "/rings/received": "ring frames as they came: datagrams or serial bytes",
}


def encode_json(values: dict) -> bytes:
    """Returns plain values, arrays and NumPy's numbers as JSON."""
    text = json.dumps(values, default=_make_plain, separators=(",", ":"))
    return _TOKENS.sub(
        lambda match: _REPLACED.get(match[0], match[0]), text
    ).encode()


def _make_plain(value):
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if dc.is_dataclass(value):
        return vars(value)
    raise TypeError(f"{type(value).__name__} is no plain value")


def _fill(cls, values):
    """Returns a message of a class from what JSON made of it."""
    fields = {}
    for name, default in vars(cls()).items():
        value = values[name]
        if isinstance(default, np.ndarray):
            value = np.array(
                [np.nan if v is None else v for v in value],
                dtype=default.dtype,
            )
            value.setflags(write=False)
        elif value is None:
            value = np.nan
        fields[name] = value
    return cls(**fields)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RecordedTick:
    """One tick of a record."""

    time: float
    """Diagram's time, s."""
    clock_offset: float
    """What the Diagram's clock shows more than the host's, s."""
    report: RobotReport
    scans: tuple[RingScan, ...]
    """Newest scan of each ring, on the host's clock; of virtual ones none."""
    command: SliderCommand
    """What was sent, or would have been in a dry run."""
    state: dict
    """What the monitor said: robot_state, ring_states, reason, ..."""


class RunRecorder:
    """Writes a record; a context manager, and safe to use from threads.

    A disk that is full or gone is told by the next `add_tick`: whoever hands
    in bytes has other things to do.

    Args:
        path: The file; what is there is replaced.
        run: Plain values to make the same monitor of again.

    Raises:
        UserError: The file can not be written.
    """

    def __init__(self, path: pathlib.Path, run: dict):
        self._path = path
        try:
            self._stream = path.open("wb")
        except OSError as error:
            raise UserError(
                f"--record: {path}: can not write it: {error.strerror}"
            ) from None
        self._lock = threading.Lock()
        self._closed = False
        self._error = ""
        self._writer = Writer(
            self._stream,
            compression=CompressionType.NONE,
            use_chunking=False,
        )
        self._writer.start(profile="", library="tofssm_drake")
        self._channels = {
            topic: self._add_json_channel(topic)
            for topic in (_RUN, _TICK, "/monitor")
        }
        for topic, description in _BYTES.items():
            self._channels[topic] = self._writer.register_channel(
                topic=topic,
                message_encoding="application/octet-stream",
                schema_id=0,
                metadata={"content": description},
            )
        self._scans: tuple[RingScan, ...] = ()
        self._flushed = -math.inf
        self._add(_RUN, encode_json({"version": _VERSION, **run}))
        if self._error:
            self.close()
        self._require_written()

    def __enter__(self) -> "RunRecorder":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def add_tick(self, tick: RecordedTick) -> None:
        """Writes a tick; of the scans only those that are new.

        Raises:
            UserError: Something could not be written, now or before.
        """
        scans = [
            scan
            if i >= len(self._scans) or scan is not self._scans[i]
            else None
            for i, scan in enumerate(tick.scans)
        ]
        self._scans = tick.scans
        values = vars(tick) | {"scans": scans}
        self._add(_TICK, encode_json(values))
        self._add("/monitor", encode_json({"time": tick.time, **tick.state}))
        self._require_written()

    def add_robot_bytes(
        self, arrival: float, was_sent: bool, data: bytes
    ) -> None:
        """Writes what went to or came from the robot."""
        self._add("/robot/sent" if was_sent else "/robot/received", data)

    def add_ring_bytes(self, arrival: float, source: str, data: bytes) -> None:
        """Writes what came from the rings."""
        self._add("/rings/received", data)

    def close(self) -> None:
        """Ends the file; may be called again."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            try:
                if not self._error:
                    self._writer.finish()
            except OSError as error:
                self._error = error.strerror
            # What is left in the buffer can not be written either.
            with contextlib.suppress(OSError):
                self._stream.close()

    def _add_json_channel(self, topic):
        schema = self._writer.register_schema(
            name=f"tofssm{topic.replace('/', '.')}",
            encoding="jsonschema",
            data=b'{"type":"object"}',
        )
        return self._writer.register_channel(
            topic=topic, message_encoding="json", schema_id=schema
        )

    def _add(self, topic, data):
        now = time.time_ns()
        with self._lock:
            if self._closed or self._error:
                return
            try:
                self._writer.add_message(
                    channel_id=self._channels[topic],
                    log_time=now,
                    publish_time=now,
                    data=data,
                )
                if time.monotonic() - self._flushed >= _FLUSH_PERIOD:
                    self._stream.flush()
                    self._flushed = time.monotonic()
            except OSError as error:
                self._error = error.strerror

    def _require_written(self):
        require(
            not self._error,
            f"--record: {self._path}: can not write it: {self._error}",
        )


class RunReader:
    """Reads a record as far as it goes.

    Attributes:
        run: The values that the recorder was given.

    Args:
        path: The file.

    Raises:
        UserError: It is no such record.
    """

    def __init__(self, path: pathlib.Path):
        self._path = path
        try:
            with path.open("rb") as stream:
                start = stream.read(1 << 20)
        except OSError as error:
            raise UserError(
                f"{path}: can not read it: {error.strerror}"
            ) from None
        if not start.startswith(b"\x89MCAP"):
            raise UserError(f"{path}: is no MCAP file")
        self.run = next(self._read(_RUN), None)
        if self.run is None or self.run.get("version") != _VERSION:
            raise UserError(
                f"{path}: is no record of `tofssm hardware`, or of another "
                "version"
            )

    def read_ticks(self) -> Iterator[RecordedTick]:
        """Yields the ticks in their order."""
        scans: tuple[RingScan, ...] = ()
        for values in self._read(_TICK):
            scans = tuple(
                scans[i] if scan is None else _fill(RingScan, scan)
                for i, scan in enumerate(values["scans"])
            )
            yield RecordedTick(
                time=values["time"],
                clock_offset=values["clock_offset"],
                report=_fill(RobotReport, values["report"]),
                scans=scans,
                command=_fill(SliderCommand, values["command"]),
                state=values["state"],
            )

    def _read(self, wanted):
        topics = {}
        with self._path.open("rb") as stream:
            try:
                for record in StreamReader(stream).records:
                    if isinstance(record, mcap.records.Channel):
                        topics[record.id] = record.topic
                    elif (
                        isinstance(record, mcap.records.Message)
                        and topics.get(record.channel_id) == wanted
                    ):
                        yield json.loads(record.data)
            except (McapError, EOFError, struct.error, ValueError):
                # It ends where the process that wrote it did.
                return
