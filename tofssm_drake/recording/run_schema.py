"""JSON schemas of a run's record, in the subset that Foxglove understands.

They depend on the run: it names the watched links and what its law says of
each.

Foxglove derives the list of what can be plotted from a channel's schema, and
does not show the channel if it cannot read the schema: each property has one
type, never null; an object has properties; an array has items of one type.
Numbers with names (`oneOf` of constants) are shown by name.
"""

import enum

import numpy as np

from tofssm_drake.messages import (
    RingScan,
    RobotReport,
    RobotState,
    SliderCommand,
)
from tofssm_drake.rtde.arm_obedience import ArmConfig
from tofssm_drake.rtde.slider import SliderPhase

_NUMBER = {"type": "number"}
_INTEGER = {"type": "integer"}
_STRING = {"type": "string"}
_BOOLEAN = {"type": "boolean"}
_NUMBERS = {"type": "array", "items": _NUMBER}
_INTEGERS = {"type": "array", "items": _INTEGER}
_STRINGS = {"type": "array", "items": _STRING}


def _make_object(optional=(), **properties):
    return {
        "type": "object",
        "properties": properties,
        "required": [name for name in properties if name not in optional],
    }


def _describe(value):
    """Returns the schema of a field with this default."""
    if isinstance(value, np.ndarray):
        return _INTEGERS if value.dtype.kind in "iu" else _NUMBERS
    if isinstance(value, str):
        return _STRING
    return _INTEGER if isinstance(value, int) else _NUMBER


def _make_message(message, **more):
    """Returns the schema of a message, in which NaN may be left out."""
    fields = {name: _describe(v) for name, v in vars(message).items()}
    optional = [
        name for name, s in fields.items() if s not in (_INTEGER, _INTEGERS)
    ]
    return _make_object(optional, **more, **fields)


def _make_enum(kind: type[enum.IntEnum]):
    return {
        "oneOf": [{"title": member.name, "const": member} for member in kind]
    }


def _make_states(names):
    """Returns the schema of a state of a link, given the states' names."""
    return {
        "oneOf": [
            {"title": name, "const": number}
            for number, name in enumerate(names)
        ]
    }


_SCANS = {
    "type": "array",
    "items": _make_message(RingScan(), ring=_INTEGER),
}

_RUN = _make_object(
    ("slider_limit",),
    version=_INTEGER,
    epoch=_NUMBER,
    command=_STRING,
    scenario=_make_object(),
    links=_STRINGS,
    law=_make_object(),
    virtual_rings=_BOOLEAN,
    dry_run=_BOOLEAN,
    minimum_fraction=_NUMBER,
    slider_limit=_NUMBER,
    arm=_make_object(**dict.fromkeys(vars(ArmConfig()), _NUMBER)),
)


def make_schemas(
    *,
    links: tuple[str, ...],
    states: tuple[str, ...],
    signals: tuple[str, ...],
) -> dict[str, dict]:
    """Returns a schema by topic; the other topics are bytes.

    Args:
        links: Names of the watched links.
        states: Names of the law's states of a link; empty: it has none.
        signals: Names of the law's signals.
    """
    return {
        "/run": _RUN,
        "/tick": _make_tick(signals),
        "/monitor": _make_monitor(links, states, signals),
    }


def _make_tick(signals):
    return _make_object(
        ("sent",),
        time=_NUMBER,
        clock_offset=_NUMBER,
        report=_make_message(RobotReport()),
        scans=_SCANS,
        command=_make_message(SliderCommand()),
        state=_make_object(
            robot_state=_make_enum(RobotState),
            ring_states=_INTEGERS,
            reason=_STRING,
            target=_NUMBER,
            deciding_link=_STRING,
            signals=_make_object(**dict.fromkeys(signals, _NUMBERS)),
            speed_fraction=_NUMBER,
            slider_phase=_make_enum(SliderPhase),
            slider_reason=_STRING,
            distance=_NUMBERS,
            problem=_STRINGS,
            sample_time=_NUMBERS,
        ),
        sent=_NUMBER,
        busy=_NUMBER,
    )


def _make_monitor(links, states, signals):
    # A value is left out where there is none.
    of_links = _make_object(links, **dict.fromkeys(links, _NUMBER))
    ring_state = {}
    if states:
        kinds = dict.fromkeys(links, _make_states(states))
        ring_state = {"ring_state": _make_object(**kinds)}
    return _make_object(
        (
            *("q", "qd", "slider_echoed", "speed_scaling", "tcp_speed"),
            "answer_time",
        ),
        time=_NUMBER,
        robot_state=_make_enum(RobotState),
        **ring_state,
        reason=_STRING,
        target=_NUMBER,
        deciding_link=_STRING,
        law=_make_object(**dict.fromkeys(signals, of_links)),
        distance=of_links,
        problem=_make_object(**dict.fromkeys(links, _STRING)),
        sample_age=of_links,
        speed_fraction=_NUMBER,
        slider_commanded=_NUMBER,
        slider_echoed=_NUMBER,
        slider_phase=_make_enum(SliderPhase),
        slider_reason=_STRING,
        q=_NUMBERS,
        qd=_NUMBERS,
        speed_scaling=_NUMBER,
        tcp_speed=_NUMBER,
        runtime_state=_INTEGER,
        safety_mode=_INTEGER,
        products_placed=_INTEGER,
        missed=_INTEGER,
        answer_time=_NUMBER,
        busy=_NUMBER,
    )
