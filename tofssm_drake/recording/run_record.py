"""The record of a run on hardware: an MCAP file, written during the run.

Nothing is held back in chunks: what was added is in the file a quarter of a
second later, and an incomplete file can be read as far as it goes. So a process
that is killed loses no more than that. A thread writes the file, so that a
slow disk does not delay the robot.

Each tick is one message on `/tick`: all inputs of the monitor and its results.
NaN is left out there, or null within an array, and infinity is 1e999.
`/monitor` is for plots. The schemas use only what Foxglove understands (see
run_schema.py).

A message's log time is when it was added; its publish time is when the bytes
arrived or were sent, and for a tick when its report arrived.
"""

import collections
from collections.abc import Iterator
import dataclasses as dc
import errno
import json
import math
import os
import pathlib
import stat
import struct
import threading
import time
from typing import IO, cast

from mcap.exceptions import McapError
import mcap.records
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.messages import (
    RingScan,
    RobotReport,
    SliderCommand,
)
from tofssm_drake.recording.run_schema import make_schemas
from tofssm_drake.user_files import MEGABYTE, decode_json

_MAGIC = b"\x89MCAP0\r\n"
_FLUSH_PERIOD = 0.25
_VERSION = 5
# Before 5 a record does not describe its law, and has no target.
_READABLE = (4, 5)
# Between two ticks, s: the run ends when the robot is silent for 10 s.
_LONGEST_GAP = 60.0
# Of one part of the file, bytes.
_LARGEST_PART = 100 * MEGABYTE

_RUN, _TICK, _MONITOR = "/run", "/tick", "/monitor"
_BYTES = {
    "/robot/received": "the robot's packages, one per message",
    "/robot/sent": "packages to the robot, one per message",
    "/rings/received": "ring frames as they came: datagrams or serial bytes",
}


def encode_json(values: dict) -> bytes:
    """Returns plain values, arrays and NumPy numbers as JSON."""
    text = json.dumps(values, default=_make_plain, separators=(",", ":"))
    if "NaN" in text or "Infinity" in text:
        text = _replace_special_numbers(text)
    return text.encode()


def _replace_special_numbers(text):
    """Replaces the numbers that JSON does not know; strings stay."""
    # Other spellings of the same, so that each quote begins or ends a string.
    text = text.replace(r"\\", r"\u005c").replace(r"\"", r"\u0022")
    parts = text.split('"')
    outside = '"'.join(parts[::2])
    outside = outside.replace("NaN", "null").replace("Infinity", "1e999")
    parts[::2] = outside.split('"')
    return '"'.join(parts)


def _make_plain(value):
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if dc.is_dataclass(value):
        return {n: v for n, v in vars(value).items() if not _is_none(v)}
    raise TypeError(f"{type(value).__name__} is not a plain value")


def _is_none(value):
    """Returns whether all of a value is NaN, so that it may be left out."""
    if isinstance(value, float):
        return math.isnan(value)
    return (
        isinstance(value, np.ndarray)
        and value.size > 0
        # An array whose first element is a number is written anyway.
        and math.isnan(value.flat[0])
        and bool(np.isnan(value).all())
    )


def _fill(cls, values):
    """Returns a message of a class from its decoded JSON."""
    fields = {}
    for name, default in vars(cls()).items():
        if name not in values:
            # Only NaN was left out.
            fields[name] = np.nan if isinstance(default, float) else default
            continue
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


def _update_scans(scans, new):
    """Adds new scans, as they were written, to the others; returns all."""
    for scan in new:
        scans[scan["ring"]] = _fill(RingScan, scan)
    return tuple(scans[i] for i in range(len(scans)))


def _check_tick(tick, before):
    """Raises ValueError if a tick cannot follow that of another time."""
    if not 0.0 <= tick.time - before <= _LONGEST_GAP:
        raise ValueError(f"its time is {tick.time:g} s")
    if not isinstance(tick.state, dict):
        raise ValueError("its state is not a mapping")


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RecordedTick:
    """One tick of a record."""

    time: float
    """Diagram's time, s."""
    clock_offset: float
    """Diagram's minus host's clock, s."""
    report: RobotReport
    scans: tuple[RingScan, ...]
    """Newest scan of each ring, on the host's clock; none of virtual rings."""
    command: SliderCommand
    """What was sent, or in a dry run would have been."""
    state: dict
    """The monitor's results: robot_state, reason, target, signals, ..."""
    sent: float = math.nan
    """Host's time at which the command was handed over, s; NaN: it was not."""
    busy: float = 0.0
    """Processor time of the program so far, s."""


def make_monitor_message(tick: RecordedTick, links: tuple[str, ...]) -> dict:
    """Returns a tick's message on `/monitor`: plain values, by name.

    Args:
        tick: The tick.
        links: Names of the watched links.
    """
    report, state = tick.report, tick.state

    def name_finite(values):
        return {
            link: value
            for link, value in zip(links, values, strict=True)
            if math.isfinite(value)
        }

    message = {
        "time": tick.time,
        "robot_state": state["robot_state"],
        "reason": state["reason"],
        "target": state["target"],
        "deciding_link": state["deciding_link"],
        "law": {
            name: name_finite(values)
            for name, values in state["signals"].items()
        },
        "distance": name_finite(state["distance"]),
        "problem": dict(zip(links, state["problem"], strict=False)),
        "sample_age": name_finite(tick.time - t for t in state["sample_time"]),
        "speed_fraction": state["speed_fraction"],
        "slider_commanded": tick.command.speed_fraction,
        "slider_phase": state["slider_phase"],
        "slider_reason": state["slider_reason"],
        "runtime_state": report.runtime_state,
        "safety_mode": report.safety_mode,
        "products_placed": report.products_placed,
        "missed": report.missed,
        "busy": tick.busy,
    }
    if state["ring_states"]:
        message["ring_state"] = dict(
            zip(links, state["ring_states"], strict=True)
        )
    for name, value in (
        ("q", report.position),
        ("qd", report.velocity),
        ("slider_echoed", report.target_speed_fraction),
        ("speed_scaling", report.speed_scaling),
        ("tcp_speed", math.hypot(*report.tcp_velocity[:3])),
        ("answer_time", tick.sent - report.time),
    ):
        if not _is_none(value):
            message[name] = value
    return message


class RunRecorder:
    """Writes a record; a context manager, thread-safe.

    What is added before `add_run` is written then: a run that never begins
    leaves the file as it was, or none.

    A disk that is full or gone is reported by the next `add_tick`, not to the
    threads that hand in bytes.

    Args:
        path: The file; an existing one is replaced when the run begins.
        run: See `add_run`; None: not known yet, `add_run` follows.

    Raises:
        UserError: The file cannot be written.
    """

    def __init__(self, path: pathlib.Path, run: dict | None = None):
        self._path = path
        self._error: OSError | None = None
        self._begun = False
        self._is_new = not path.exists()
        try:
            # Unbuffered: the buffer is here.
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            self._error = error
            self._raise_error()
        # What was added is formatted when there is time for it.
        self._added: collections.deque[tuple] = collections.deque()
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._stream = _Buffer()
        self._writer = Writer(
            # Writes, tells and flushes, and more is not called.
            cast(IO[bytes], self._stream),
            compression=CompressionType.NONE,
            use_chunking=False,
            enable_data_crcs=True,
        )
        self._writer.start(profile="", library="tofssm_drake")
        self._links: tuple[str, ...] = ()
        self._channels = {}
        for topic, description in _BYTES.items():
            self._channels[topic] = self._writer.register_channel(
                topic=topic,
                message_encoding="application/octet-stream",
                schema_id=0,
                metadata={"content": description},
            )
        self._scans: tuple[RingScan, ...] = ()
        self._epoch = time.time() - time.monotonic()
        if run is not None:
            try:
                self.add_run(run)
            except UserError:
                self._file.close()
                raise
        self._thread = threading.Thread(
            target=self._keep_flushing, name="run record", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> "RunRecorder":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def add_run(self, run: dict) -> None:
        """Writes what the monitor is made from; once, before the first tick.

        Args:
            run: Plain values from which the same monitor can be made again.
                Of them `links`, names of the watched links, and `law`, what
                the law says of itself (`describe_law`), also say what a tick
                has.

        Raises:
            UserError: The file cannot be written.
        """
        law = run["law"]
        self._links = tuple(run["links"])
        schemas = make_schemas(
            links=self._links,
            states=tuple(law["states"]),
            signals=tuple(law["signals"]),
        )
        with self._lock:
            for topic, schema in schemas.items():
                self._channels[topic] = self._add_json_channel(topic, schema)
        message = {"version": _VERSION, "epoch": self._epoch, **run}
        self._add(_RUN, encode_json(message), time.monotonic())
        try:
            # A pipe has no old content.
            if stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):
                self._file.truncate(0)
        except OSError as error:
            self._error = error
        self._begun = True
        self._flush()
        self._raise_error()

    def add_tick(self, tick: RecordedTick) -> None:
        """Writes a tick, with only those scans that are new.

        Raises:
            UserError: Something could not be written earlier.
        """
        self._raise_error()
        values = _make_plain(tick) | {"scans": self._list_new(tick.scans)}
        time = tick.report.time
        self._add(_TICK, encode_json(values), time)
        message = make_monitor_message(tick, self._links)
        self._add(_MONITOR, encode_json(message), time)
        with self._lock:
            self._format()

    def add_robot_bytes(
        self, arrival: float, was_sent: bool, data: bytes
    ) -> None:
        """Writes bytes sent to or received from the robot, and when, s."""
        topic = "/robot/sent" if was_sent else "/robot/received"
        self._add(topic, data, arrival)

    def add_ring_bytes(self, arrival: float, source: str, data: bytes) -> None:
        """Writes bytes received from the rings, and when, s."""
        self._add("/rings/received", data, arrival)

    def close(self) -> None:
        """Ends the file; may be called again."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._thread.join()
        with self._lock:
            self._format()
            self._writer.finish()
        self._flush()
        self._file.close()
        if self._is_new and not self._begun:
            self._path.unlink(missing_ok=True)

    def _list_new(self, scans):
        """Returns the scans that were not written yet, as plain values."""
        new = [
            {"ring": i, **_make_plain(scan)}
            for i, scan in enumerate(scans)
            if i >= len(self._scans) or scan is not self._scans[i]
        ]
        self._scans = scans or self._scans
        return new

    def _add_json_channel(self, topic, schema):
        schema = self._writer.register_schema(
            name=f"tofssm{topic.replace('/', '.')}",
            encoding="jsonschema",
            data=json.dumps(schema).encode(),
        )
        return self._writer.register_channel(
            topic=topic, message_encoding="json", schema_id=schema
        )

    def _add(self, topic, data, when):
        # Links call this before they handle what they receive and send.
        if not self._closed.is_set() and self._error is None:
            self._added.append((topic, data, time.time_ns(), when))

    def _format(self):
        """Formats what was added; the lock must be held."""
        while self._added:
            topic, data, now, when = self._added.popleft()
            self._writer.add_message(
                channel_id=self._channels[topic],
                log_time=now,
                # A tick without a report has no time.
                publish_time=int(1e9 * max(self._epoch + when, 0.0)),
                data=data,
            )

    def _keep_flushing(self):
        while not self._closed.wait(_FLUSH_PERIOD):
            self._flush()

    def _flush(self):
        """Writes what has been added to the file, once the run has begun."""
        if not self._begun:
            return
        with self._lock:
            self._format()
            data = memoryview(self._stream.take())
        try:
            while data and self._error is None:
                data = data[self._file.write(data) :]
            if os.fstat(self._file.fileno()).st_nlink == 0:
                raise OSError(errno.ENOENT, "the file was removed")
        except OSError as error:
            self._error = error

    def _raise_error(self):
        if self._error is not None:
            raise UserError(
                f"--record: {self._path}: cannot write it: "
                f"{self._error.strerror}"
            )


class _Buffer:
    """Holds what a Writer writes until it goes to the file."""

    def __init__(self):
        self._pieces = []
        self._size = 0

    def write(self, data) -> int:
        self._pieces.append(bytes(data))
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        pass

    def take(self) -> bytes:
        data = b"".join(self._pieces)
        self._pieces.clear()
        return data


class _BoundedStream:
    """Reads no more at once than a part of a record may have.

    The reader takes a size from the file, which may be gigabytes, or below
    zero for all that follows.
    """

    def __init__(self, stream: IO[bytes]):
        self._stream = stream

    def read(self, size: int) -> bytes:
        if not 0 <= size <= _LARGEST_PART:
            raise ValueError(f"a part of {size} bytes")
        return self._stream.read(size)


class RunReader:
    """Reads a record as far as it goes.

    Attributes:
        run: The values passed to the recorder.
        problem: Why and where reading stopped, or what is wrong with it;
            empty: no known problem.
        is_damaged: Whether more is wrong than an early end, as left by a
            process that was killed.

    Args:
        path: The file.

    Raises:
        UserError: It is not such a record.
    """

    def __init__(self, path: pathlib.Path):
        self._path = path
        self.problem = ""
        self.is_damaged = False
        try:
            with path.open("rb") as stream:
                start = stream.read(1 << 20)
        except OSError as error:
            raise UserError(
                f"{path}: cannot read it: {error.strerror}"
            ) from None
        if not start.startswith(b"\x89MCAP"):
            raise UserError(f"{path}: is not an MCAP file")
        run = next(self._read(_RUN), None)
        if run is None or run.get("version") not in _READABLE:
            raise UserError(
                f"{path}: is not a record of `tofssm hardware`, or of "
                "another version"
            )
        self.run: dict = run

    @property
    def is_of_this_version(self) -> bool:
        """Whether a tick has all results that one has today."""
        return self.run["version"] == _VERSION

    def read_ticks(self) -> Iterator[RecordedTick]:
        """Yields the ticks in order."""
        scans: dict[int, RingScan] = {}
        end, time = "its beginning", 0.0
        for values in self._read(_TICK):
            try:
                # An older record has scans that were taken slightly earlier.
                _update_scans(scans, values.get("early_scans", ()))
                tick = RecordedTick(
                    time=values["time"],
                    clock_offset=values["clock_offset"],
                    report=_fill(RobotReport, values["report"]),
                    scans=_update_scans(scans, values["scans"]),
                    command=_fill(SliderCommand, values["command"]),
                    state=values["state"],
                    sent=values.get("sent", math.nan),
                    busy=values["busy"],
                )
                _check_tick(tick, time)
                time = tick.time
                after = f"{time:.3f} s"
            except (LookupError, TypeError, ValueError, AttributeError) as why:
                self.is_damaged = True
                self.problem = f"an invalid tick: {why!r}"
                break
            end = after
            yield tick
        if self.problem:
            self.problem += f", after the tick at {end}"

    def _read(self, wanted):
        topics = {}
        good = 0
        with self._path.open("rb") as stream:
            # A record has no chunks, so none is decompressed.
            reader = StreamReader(
                cast(IO[bytes], _BoundedStream(stream)),
                validate_crcs=wanted == _TICK,
                emit_chunks=True,
                record_size_limit=_LARGEST_PART,
            )
            try:
                for record in reader.records:
                    if isinstance(record, mcap.records.Channel):
                        topics[record.id] = record.topic
                    elif (
                        isinstance(record, mcap.records.Message)
                        and topics.get(record.channel_id) == wanted
                    ):
                        yield decode_json(record.data)
                    elif isinstance(record, mcap.records.Chunk):
                        raise ValueError("a chunk")
                    good = stream.tell()
            except CRCValidationError:
                self.is_damaged = True
                self.problem = (
                    f"the checksum of its first {good} bytes is wrong"
                )
            except (McapError, EOFError, struct.error, ValueError):
                position = stream.tell()
                stream.seek(-min(len(_MAGIC), position), os.SEEK_END)
                is_whole = stream.read() == _MAGIC
                # The writing process ended there, or worse.
                self.is_damaged = is_whole or position < stream.tell()
                self.problem = (
                    f"byte {good} and what follows cannot be read"
                    if self.is_damaged
                    else f"it ends within a record, at byte {position}"
                )
