"""What the columns of a run's tables are: unit, meaning, names of codes.

Each column of a file says it in its field's metadata: `unit`, `meaning` and,
if its values are codes, `codes`: a JSON list of the names, by code from 0.
"""

from collections.abc import Iterable, Mapping
import dataclasses as dc
import json

import pyarrow as pa

from tofssm_drake.messages import (
    FAULT_NAMES,
    LinkSignal,
    Reading,
    RingHealth,
    RobotState,
    SensorFault,
)
from tofssm_drake.user_files import decode_json

UNITS = ("1", "s", "m", "rad", "m/s", "rad/s", "m s", "1/min")
"""Units of the columns; "1" is dimensionless, as are counts and names. A law
may use others for its signals."""


@dc.dataclass(frozen=True, kw_only=True)
class Column:
    """What a column is."""

    unit: str = "1"
    """Empty: not known, as of a column of an earlier version."""
    meaning: str
    """In a few words, with the frame; empty: not known."""
    codes: tuple[str, ...] = ()
    """Names of its values by number, from 0; empty: they have none."""


def _list_names(kind):
    return tuple(member.name.lower() for member in kind)


_STATES = _list_names(RobotState)
_FAULTS = tuple(FAULT_NAMES[fault] or "none" for fault in SensorFault)

_OF_RUN = {
    "t": Column(
        unit="s", meaning="time of the tick; the row is what held just before"
    ),
    "tcp_speed": Column(
        unit="m/s", meaning="true speed of the tool centre point in world"
    ),
    "speed_fraction": Column(meaning="speed fraction in force, 0 to 1"),
    "robot_state": Column(
        meaning="what the law's target speed fraction amounts to",
        codes=_STATES,
    ),
    "products_placed": Column(meaning="number of products placed so far"),
    "true_distance": Column(
        unit="m",
        meaning="true distance between the surfaces of robot and person; "
        "negative: overlap, inf: no person",
    ),
    "contact_speed": Column(
        unit="m/s",
        meaning="true speed in world of the fastest robot point that touches "
        "the person; 0: none does",
    ),
    "target_fraction": Column(
        meaning="speed fraction that the law asks for, 0 to 1"
    ),
    "reason": Column(meaning="why, in the law's words"),
}

_OF_LINK = {
    "measured_distance": Column(
        unit="m",
        meaning="measured distance of the person from the link's centre; "
        "inf: clear, NaN: no sample yet",
    ),
    "true_distance": Column(
        unit="m",
        meaning="true distance of the person's surface from the link's "
        "centre; inf: no person",
    ),
    "closing_speed": Column(
        unit="m/s",
        meaning="speed at which link and person close in, as the monitor has "
        "it; positive: they come nearer",
    ),
    "link_closing_speed": Column(
        unit="m/s", meaning="the link's own part of the closing speed"
    ),
    "clear": Column(meaning="number of sensors that see nothing"),
    "valid": Column(meaning="number of sensors that see something"),
    "masked": Column(
        meaning="number of sensors that see the robot or its cell"
    ),
    "faulted": Column(meaning="number of sensors with a fault"),
    "sensor": Column(meaning="index of the sensor that decides; -1: none"),
    "health": Column(
        meaning="whether the link's sensing can be trusted",
        codes=_list_names(RingHealth),
    ),
    "sequence": Column(meaning="number of the link's sample; -1: none yet"),
    "sample_time": Column(
        unit="s", meaning="when the deciding sensor measured; -inf: never"
    ),
    "true_azimuth": Column(
        unit="rad",
        meaning="true direction of the person's nearest point about the z "
        "axis of the link's frame, from its x axis",
    ),
    "true_elevation": Column(
        unit="rad",
        meaning="true direction of the person's nearest point above the xy "
        "plane of the link's frame",
    ),
}

_POINTS = {
    "robot_point": "true point of the robot nearest to the person",
    "person_point": "true point of the person nearest to the robot",
    "tcp": "true position of the tool centre point",
    "person": "true position on the ground of the nearest person's pelvis",
}

SCAN_COLUMNS = {
    "t": Column(unit="s", meaning="tick at which the monitor got the scan"),
    "ring": Column(meaning="link that the ring is on"),
    "distance": Column(
        unit="m",
        meaning="distance of each sensor; inf: clear, NaN: fault, held: as "
        "last measured",
    ),
    "reading": Column(
        meaning="what each sensor's sample means", codes=_list_names(Reading)
    ),
    "fault": Column(
        meaning="why each sensor's sample cannot be used", codes=_FAULTS
    ),
}
"""Columns of the table of scans."""

_UNKNOWN = Column(unit="", meaning="")


def split_name(name: str, links: Iterable[str]) -> tuple[str, str]:
    """Returns the link that a column is of, empty for the run, and its kind.

    Args:
        name: The column's name.
        links: Names of the watched links.
    """
    if name not in _OF_RUN:
        # A link's name may begin with another's.
        for link in sorted(links, key=len, reverse=True):
            if name.startswith(f"{link}_"):
                return link, name.removeprefix(f"{link}_")
    return "", name


def describe_columns(
    names: Iterable[str],
    *,
    links: tuple[str, ...],
    signals: Mapping[str, LinkSignal],
    metadata: Mapping,
) -> dict[str, Column]:
    """Returns what the columns of a table of samples are, by name.

    Args:
        names: The columns.
        links: Names of the watched links.
        signals: The law's signals.
        metadata: Of the samples. It names the `law`'s states, the
            `robot_bodies`, the `people` and the `person_parts`, and has
            `joint_units`: of each joint "rad" or, if it slides, "m" (default:
            "rad").
    """
    of_run = _OF_RUN | _describe_places(links, metadata)
    of_link = _OF_LINK | {
        "state": Column(
            meaning="the law's state of the link, or what its target amounts "
            "to; null: not known",
            codes=tuple(metadata.get("law", {}).get("states") or _STATES),
        ),
        **{name: _describe_signal(name, s) for name, s in signals.items()},
    }
    described = {}
    for name in names:
        link, kind = split_name(name, links)
        if link:
            column = of_link.get(kind, _UNKNOWN)
            if column.meaning:
                meaning = f"{link}: {column.meaning}"
                column = dc.replace(column, meaning=meaning)
        else:
            column = of_run.get(name) or _describe_joint(name, metadata)
        described[name] = column
    return described


def _describe_places(links, metadata):
    """Returns the columns of points, and those with names from the run."""
    columns = {
        f"{point}_{axis}": Column(unit="m", meaning=f"{meaning}, in world")
        for point, meaning in _POINTS.items()
        for axis in "xyz"
    }
    columns |= {
        f"place_of_{person}_{axis}": Column(
            unit="m",
            meaning=f"true position on the ground of {person}'s pelvis, in "
            "world",
        )
        for person in metadata.get("people", ())
        for axis in "xy"
    }
    return columns | {
        "deciding_link": Column(
            meaning="link that decides the target; null: none",
            codes=tuple(links),
        ),
        "robot_body": Column(
            meaning="body of the robot that is truly nearest to the person",
            codes=tuple(metadata.get("robot_bodies", ())),
        ),
        "person_part": Column(
            meaning="part of the person that is truly nearest to the robot",
            codes=tuple(metadata.get("person_parts", ())),
        ),
    }


def _describe_signal(name, signal):
    return Column(
        unit=signal.unit or "1",
        meaning=signal.meaning or f"the law's signal {name}",
    )


def _describe_joint(name, metadata):
    """Returns what `q_0`, `qd_0`, ... are."""
    kind, _, number = name.rpartition("_")
    if kind not in ("q", "qd") or not number.isdecimal():
        return _UNKNOWN
    units = metadata.get("joint_units", ())
    joint = int(number)
    unit = units[joint] if joint < len(units) else "rad"
    if kind == "q":
        return Column(
            unit=unit,
            meaning=f"position of joint {joint}, counted from the base",
        )
    return Column(unit=f"{unit}/s", meaning=f"speed of joint {joint}")


def add_descriptions(
    table: pa.Table, columns: Mapping[str, Column]
) -> pa.Table:
    """Returns a table whose fields say what they are.

    Args:
        table: The table.
        columns: By name; nothing is said of columns that are not among them.
    """
    fields = []
    for field in table.schema:
        column = columns.get(field.name, _UNKNOWN)
        said = {"unit": column.unit, "meaning": column.meaning}
        if column.codes:
            said["codes"] = json.dumps(column.codes)
        fields.append(field.with_metadata(said))
    return table.cast(pa.schema(fields, metadata=table.schema.metadata))


def read_description(field: pa.Field) -> Column:
    """Returns what a field says of itself, which older ones do not."""
    said = {
        key.decode(errors="replace"): value.decode(errors="replace")
        for key, value in (field.metadata or {}).items()
    }
    try:
        codes = decode_json(said.get("codes", "[]"))
    except ValueError:
        codes = []
    return Column(
        unit=said.get("unit", ""),
        meaning=said.get("meaning", ""),
        codes=tuple(map(str, codes)) if isinstance(codes, list) else (),
    )
