"""What a run records: one table of samples and one of scans.

`samples.parquet` has one row per control tick, `scans.parquet` one per ring
scan. All metrics and figures are computed from these two files, so that a
recording of real hardware gives them as well.

Conventions, here and in the files:

- SI units; angles in radians; positions in world.
- `inf` means *nothing there*: a clear ring's `measured_distance`, a
  `true_distance` without a person, a threshold that no distance can exceed
  because there was no sample yet.
- `NaN` means *not known*: the `measured_distance` of a ring that has not
  delivered a scan yet, witness points and closing speeds without a person.
- Each column of the files says its unit and what it is (`columns`).
- States, readings and other codes are small integers here (`RobotState`,
  `RingHealth`, `Reading` of `tofssm_drake.messages`) and categories by name
  in the files; -1, there null, means *none* for indices, and for the state of
  a link *not known*.
- `robot_state` is what the law's target speed fraction amounts to. A link has
  the law's own state of it. If the law has none, the link that decides has
  the robot's, and while the robot may run at full speed, all have.
"""

import dataclasses as dc
import json
import os
from pathlib import Path
import tempfile

import numpy as np
import pyarrow as pa

from tofssm_drake.errors import UserError, require
from tofssm_drake.messages import LinkSignal
from tofssm_drake.recording.columns import (
    SCAN_COLUMNS,
    Column,
    add_descriptions,
    describe_columns,
    read_description,
    split_name,
)
from tofssm_drake.recording.tables import (
    read_schema,
    read_table,
    write_table,
)
from tofssm_drake.user_files import decode_json

_KEY = b"tofssm"

PARTS = ".*.part"
"""Names of files while they are written; a kill may leave them."""

_BEFORE_SIGNALS = (
    "state",
    "measured_distance",
    "true_distance",
    "closing_speed",
    "link_closing_speed",
)
_AFTER_SIGNALS = (
    "clear",
    "valid",
    "masked",
    "faulted",
    "sensor",
    "health",
    "sequence",
    "sample_time",
    "true_azimuth",
    "true_elevation",
)

# What records told of their law before they described its signals.
_FORMER_SIGNALS = {
    "d_C": LinkSignal(unit="m", meaning="critical distance", bound="stop"),
    "d_R": LinkSignal(unit="m", meaning="reduced distance", bound="slow"),
}

_INTEGERS: dict[str, type[np.signedinteger]] = {
    "robot_state": np.int8,
    "deciding_link": np.int8,
    "products_placed": np.int16,
    "robot_body": np.int16,
    "person_part": np.int16,
    "state": np.int8,
    "clear": np.int8,
    "valid": np.int8,
    "masked": np.int8,
    "faulted": np.int8,
    "sensor": np.int8,
    "health": np.int8,
    "sequence": np.int32,
}


_SCANNED = {"distance": np.float32, "reading": np.int8, "fault": np.int8}


@dc.dataclass(kw_only=True)
class Samples:
    """A run's recorded columns with the metadata to read them.

    Attributes:
        column: Arrays of equal length by name, one element per tick.
        scan: Per ring: `time` (k,), the tick at which the monitor got each
            of k scans, s; `distance` (k, n), m, inf where clear and NaN
            where faulted, where held as last measured; `reading` (k, n);
            `fault` (k, n), `SensorFault`, missing in older files.
        metadata: Plain values (JSON): `rings`, `robot_bodies`,
            `people`, `person_parts`, `scenario`, `seed`, ...; `law`, what a law
            says of itself (`describe_law`).
    """

    column: dict[str, np.ndarray]
    scan: dict[str, dict[str, np.ndarray]] = dc.field(default_factory=dict)
    metadata: dict = dc.field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.column[name]

    def __contains__(self, name: str) -> bool:
        return name in self.column

    def __len__(self) -> int:
        return len(self.column["t"])

    @property
    def rings(self) -> tuple[str, ...]:
        """Names of the watched links, in column order."""
        return tuple(self.metadata.get("rings") or _find_links(self.column))

    @property
    def signals(self) -> dict[str, LinkSignal]:
        """The law's signals by name; each is a column of every link."""
        law = self.metadata.get("law")
        if law is None:
            return {
                name: signal
                for name, signal in _FORMER_SIGNALS.items()
                if all(f"{link}_{name}" in self for link in self.rings)
            }
        return {
            name: LinkSignal(**signal)
            for name, signal in law["signals"].items()
        }

    @property
    def columns(self) -> dict[str, Column]:
        """What each column is, by name."""
        return describe_columns(
            self.column,
            links=self.rings,
            signals=self.signals,
            metadata=self.metadata,
        )

    def find_bound(self, bound: str) -> str:
        """Returns the signal that is such a bound, see `LinkSignal`.

        Args:
            bound: "stop" or "slow".

        Returns:
            Its name; empty if the law has none.
        """
        for name, signal in self.signals.items():
            if signal.bound == bound:
                return name
        return ""

    def find_nearest_person(self, tick: int) -> str:
        """Returns who is truly nearest to the robot.

        `metadata["people"]` names the people.

        Args:
            tick: Row.

        Returns:
            The name; empty: nobody is there, or nobody has a name.
        """
        people = self.metadata.get("people", ())
        parts = len(self.metadata.get("person_parts", ()))
        index = int(self["person_part"][tick])
        if not people or not 0 <= index < parts:
            return ""
        return people[index * len(people) // parts]

    def ring(self, name: str) -> np.ndarray:
        """Returns the column `name` of every ring, shape (rows, m)."""
        return np.stack(
            [self.column[f"{ring}_{name}"] for ring in self.rings], axis=1
        )


def get_link_columns(signals: tuple[str, ...]) -> tuple[str, ...]:
    """Returns the columns of each link, in order.

    In the table each has the link's name in front.

    Args:
        signals: Names of the law's signals.
    """
    return (*_BEFORE_SIGNALS, *signals, *_AFTER_SIGNALS)


def make_ring_metadata(
    *, azimuth, fov: float, radius: float, max_range: float
) -> dict:
    """Describes one ring for the report.

    Args:
        azimuth: Angle of each sensor's beam about the ring's axis, rad, (n,).
        fov: Full cone angle of one sensor, rad.
        radius: Radius of the circle on which the sensors sit, m.
        max_range: Distance that a sensor reports at most, m.

    Returns:
        A plain value for `Samples.metadata["ring_geometry"][ring]`.
    """
    return {
        "azimuth": [float(a) for a in np.ravel(azimuth)],
        "fov": float(fov),
        "radius": float(radius),
        "max_range": float(max_range),
    }


def narrow_type(kind: str, values: np.ndarray) -> np.ndarray:
    """Returns the values in the type in which such a column is stored.

    Args:
        kind: Name of the column, without the ring's name in front.
        values: Floating-point values.

    Returns:
        A copy: integers for states, counts and indices, in 32 bits where
        they are too many for the usual type (a lidar's rays).
    """
    if kind in _INTEGERS:
        whole = np.round(values)
        dtype = np.dtype(_INTEGERS[kind])
        if np.abs(whole).max(initial=0) > np.iinfo(dtype).max:
            dtype = np.dtype(np.int32)
        return whole.astype(dtype)
    return np.array(values)


def write_atomically(path: Path, write) -> None:
    """Calls `write(temporary)` and then moves the file to `path`.

    A reader of `path` sees the old file, the new file or none, never a part.

    Raises:
        UserError: if the folder cannot be written.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(
            prefix=f".{path.name}.", suffix=".part", dir=path.parent
        )
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        # mkstemp makes private files; a result is for everyone to read.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_samples(samples: Samples, folder: Path) -> list[Path]:
    """Writes `samples.parquet` and `scans.parquet` into the folder.

    Args:
        samples: What to write.
        folder: An existing folder.

    Returns:
        The two paths.

    Raises:
        UserError: if the folder cannot be written.
    """
    folder = Path(folder)
    metadata = {_KEY: json.dumps(samples.metadata, sort_keys=True).encode()}
    table = _make_table(samples).replace_schema_metadata(metadata)
    paths = [folder / "samples.parquet", folder / "scans.parquet"]
    write_atomically(paths[0], lambda p: _write_table(table, p))
    scans = _make_scan_table(samples).replace_schema_metadata(metadata)
    write_atomically(paths[1], lambda p: _write_table(scans, p))
    return paths


def read_samples(path: Path, kinds: tuple[str, ...] | None = None) -> Samples:
    """Reads what `write_samples` wrote.

    Args:
        path: `samples.parquet`, or the folder that holds it. A missing
            `scans.parquet` beside it leaves `scan` empty.
        kinds: Reads these columns only, of a link's columns those of every
            link, and no scans; None: everything.

    Returns:
        The samples.

    Raises:
        UserError: if the file is missing or is not such a table.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "samples.parquet"
    table = read_table(
        path, None if kinds is None else _list_wanted(path, kinds)
    )
    if "t" not in table.column_names:
        raise UserError(f"{path}: not a table of samples: no column `t`")
    metadata = _read_metadata(path, table.schema)
    links = metadata.get("rings") or _find_links(table.column_names)
    column = {
        field.name: _from_arrow(
            table[field.name], field, split_name(field.name, links)[1]
        )
        for field in table.schema
    }
    samples = Samples(column=column, metadata=metadata)
    scans = path.with_name("scans.parquet")
    if kinds is None and scans.exists():
        # Links that other sensors watch have no scans.
        rings = metadata.get("ring_geometry", samples.rings)
        samples.scan = _split_scan_table(read_table(scans), rings)
    return samples


def _find_links(names):
    """Returns the links that columns are of, if the metadata do not say."""
    end = "_measured_distance"
    return [name.removesuffix(end) for name in names if name.endswith(end)]


def _read_metadata(path, schema):
    """Returns what a table says of its run."""
    try:
        metadata = decode_json((schema.metadata or {}).get(_KEY, b"{}"))
    except ValueError as error:
        raise UserError(f"{path}: its metadata: {error}") from None
    require(
        isinstance(metadata, dict),
        f"{path}: its metadata must be a mapping",
    )
    return metadata


def _list_wanted(path, kinds):
    """Returns the names of the columns of some kinds, of every link."""
    schema, _ = read_schema(path)
    links = _read_metadata(path, schema).get("rings")
    links = links or _find_links(schema.names)
    return {"t", *kinds} | {f"{n}_{kind}" for n in links for kind in kinds}


def _write_table(table, path):
    # Hardly any measured number comes twice: to look for it takes half of the
    # time, and the file is a quarter larger.
    repeated = [
        f"{field.name}.list.element"
        if pa.types.is_list(field.type)
        else field.name
        for field in table.schema
        if not _is_measured(field.type)
    ]
    write_table(table, path, compression="zstd", use_dictionary=repeated)


def _is_measured(kind):
    if pa.types.is_list(kind):
        kind = kind.value_type
    return pa.types.is_floating(kind)


def _make_table(samples):
    columns = samples.columns
    table = pa.table(
        {
            name: _to_arrow(values, columns[name].codes)
            for name, values in samples.column.items()
        }
    )
    return add_descriptions(table, columns)


def _to_arrow(values, codes):
    """Returns values as a column; codes as categories by name."""
    if values.dtype == object:
        return pa.array(values, type=pa.string()).dictionary_encode()
    # Bodies may share a name, and a record may lack names: then the codes.
    is_named = len(set(codes)) == len(codes) > values.max(initial=-1)
    if not codes or not is_named:
        return pa.array(values)
    indices = pa.array(values, mask=values < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(codes))


def _from_arrow(column, field, kind):
    """Returns a column's values; of categories with codes the codes."""
    codes = read_description(field).codes
    if not (codes and pa.types.is_dictionary(column.type)):
        return np.asarray(column.to_numpy())
    return narrow_type(kind, _find_codes(column.combine_chunks(), codes))


def _find_codes(array, codes):
    """Returns the code of each element of categories; of null -1."""
    # A reader may have put the names into another order.
    names = array.dictionary.to_pylist()
    code = np.array([*(codes.index(name) for name in names), -1])
    return code[array.indices.fill_null(len(names)).to_numpy()]


def _make_scan_table(samples):
    times, ring, distance, reading, fault = [], [], [], [], []
    for name, scan in samples.scan.items():
        k = len(scan["time"])
        times.append(scan["time"])
        ring += [name] * k
        distance += list(scan["distance"])
        reading += list(scan["reading"])
        fault += list(scan.get("fault", np.zeros_like(scan["reading"])))
    time = np.concatenate(times) if times else np.empty(0)
    order = np.argsort(time, kind="stable")
    table = pa.table(
        {
            "t": time[order],
            "ring": pa.array(
                [ring[i] for i in order], type=pa.string()
            ).dictionary_encode(),
            "distance": _to_lists([distance[i] for i in order], np.float32),
            "reading": _to_lists(
                [reading[i] for i in order],
                np.int8,
                SCAN_COLUMNS["reading"].codes,
            ),
            "fault": _to_lists(
                [fault[i] for i in order],
                np.int8,
                SCAN_COLUMNS["fault"].codes,
            ),
        }
    )
    return add_descriptions(table, SCAN_COLUMNS)


def _to_lists(rows, dtype, codes=()):
    """Returns rows of numbers or codes as a column of lists."""
    ends = np.cumsum([0, *map(len, rows)], dtype=np.int32)
    values = np.concatenate(rows) if rows else np.empty(0)
    values = _to_arrow(values.astype(dtype), codes)
    return pa.ListArray.from_arrays(pa.array(ends), values)


def _split_scan_table(table, rings):
    ring = np.asarray(table["ring"].to_pylist(), dtype=object)
    time = table["t"].to_numpy()
    result = {}
    for name in rings:
        rows = np.flatnonzero(ring == name)
        part = table.take(rows)
        result[name] = {"time": time[rows]}
        for kind, dtype in _SCANNED.items():
            # Older files have no faults.
            if kind in part.column_names:
                codes = read_description(part.schema.field(kind)).codes
                result[name][kind] = _to_matrix(part[kind], dtype, codes)
    return result


def _to_matrix(column, dtype, codes):
    rows = len(column)
    flat = column.combine_chunks().flatten()
    if pa.types.is_dictionary(flat.type):
        flat = _find_codes(flat, codes)
    else:
        flat = flat.to_numpy(zero_copy_only=False)
    return np.asarray(flat, dtype=dtype).reshape(rows, -1 if rows else 0)
