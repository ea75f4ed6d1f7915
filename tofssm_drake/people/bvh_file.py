"""Biovision hierarchy (BVH) files: text in, checked numbers out.

The format has a hierarchy of joints with offsets and channels, then one line
of channel values per frame. It does not fix units, axes or joint names;
`tofssm_drake.people.bvh` works those out.
"""

import dataclasses as dc
from pathlib import Path
import re
from typing import NoReturn

import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.user_files import MEGABYTE, read_file

_CHANNELS = {
    f"{axis}{kind}": (kind, index)
    for kind in ("position", "rotation")
    for index, axis in enumerate("xyz")
}
_LONGEST_FRAME_TIME = 1.0
"""s; a longer one is in the wrong unit."""

# Hours of a recording at 120 frames a second.
_LARGEST = 1000 * MEGABYTE

_LARGEST_NUMBER = 1e9
"""No recording in any unit has a larger one, nor nan or inf."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class BvhJoint:
    """One node of the hierarchy."""

    name: str
    parent: int
    """Index of the parent; -1 for the root."""
    offset: np.ndarray
    """From the parent, in the parent's axes, file units, shape (3,)."""
    channels: tuple[tuple[str, int], ...]
    """("position" | "rotation", axis 0..2) in the file's order."""
    first_channel: int
    """Column of the first channel."""
    is_end: bool
    """True for an End Site."""
    line: int
    """Where the file defines it."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class BvhFile:
    """A BVH file as it stands: its own axes, units and names."""

    path: str
    joints: tuple[BvhJoint, ...]
    """Parents come before children; the root is the first."""
    frames: np.ndarray
    """Channel values, degrees and file units, shape (T, channels)."""
    frame_time: float
    """s."""

    @property
    def duration(self) -> float:
        """From the first to the last frame, s."""
        return self.frame_time * (len(self.frames) - 1)


def _is_number(word):
    try:
        return abs(float(word)) < _LARGEST_NUMBER
    except ValueError:
        return False


class _Reader:
    """Walks through the lines and knows where it is."""

    def __init__(self, path, text):
        self.path = path
        self.lines = re.split(r"\r\n|\r|\n", text)
        self.line = 0
        self._parts = []

    def fail(self, message, line=None) -> NoReturn:
        where = self.line if line is None else line
        raise UserError(f"{self.path}:{max(where, 1)}: {message}")

    def next(self, expected):
        """Returns the next statement; braces stand alone."""
        while not self._parts:
            if self.line >= len(self.lines):
                self.fail(f"the file ends where {expected} should be")
            parts = re.split(r"([{}])", self.lines[self.line])
            self._parts = [part.strip() for part in parts if part.strip()]
            self.line += 1
        return self._parts.pop(0)

    def numbers(self, words, expected):
        if not all(_is_number(word) for word in words):
            self.fail(f"'{' '.join(words)[:60]}' should be {expected}")
        return [float(word) for word in words]


def _read_offset(reader):
    words = reader.next("OFFSET").split()
    if words[0].upper() != "OFFSET" or len(words) != 4:
        reader.fail(
            f"'{' '.join(words)[:60]}' should be OFFSET and three numbers"
        )
    offset = np.array(reader.numbers(words[1:], "three numbers"))
    offset.flags.writeable = False
    return offset


def _read_channels(reader, name):
    words = reader.next("CHANNELS").split()
    count = words[1] if len(words) > 1 else ""
    if words[0].upper() != "CHANNELS" or not count.isdecimal():
        reader.fail(
            f"'{' '.join(words)[:60]}' should be CHANNELS, their number and "
            "names"
        )
    if int(count) != len(words) - 2:
        reader.fail(f"CHANNELS {count} is followed by {len(words) - 2} names")
    for word in words[2:]:
        if word.lower() not in _CHANNELS:
            reader.fail(
                f"channel '{word[:60]}' should be Xposition, Yposition, "
                "Zposition, Xrotation, Yrotation or Zrotation"
            )
    channels = tuple(_CHANNELS[word.lower()] for word in words[2:])
    if len(set(channels)) != len(channels):
        reader.fail(f"a channel of {name} is named twice")
    return channels


def _open_joint(reader, name, *, parent, first_channel, is_end):
    """Reads a joint from its opening brace to its channels."""
    line = reader.line
    if reader.next("'{'") != "{":
        reader.fail(f"'{{' should follow {name or 'the joint'}")
    return BvhJoint(
        name=name,
        parent=parent,
        offset=_read_offset(reader),
        channels=() if is_end else _read_channels(reader, name),
        first_channel=first_channel,
        is_end=is_end,
        line=line,
    )


def _read_hierarchy(reader):
    """Returns the joints and the number of their channels."""
    joints: list[BvhJoint] = []
    stack: list[int] = []
    columns = 0

    def open_joint(name, is_end):
        nonlocal columns
        joint = _open_joint(
            reader,
            name,
            parent=stack[-1] if stack else -1,
            first_channel=columns,
            is_end=is_end,
        )
        columns += len(joint.channels)
        stack.append(len(joints))
        joints.append(joint)

    if reader.next("HIERARCHY").upper() != "HIERARCHY":
        reader.fail("a BVH file should begin with HIERARCHY")
    statement = reader.next("ROOT")
    keyword, _, name = statement.partition(" ")
    if keyword.upper() != "ROOT":
        reader.fail(f"'{statement[:60]}' should be ROOT and its name")
    open_joint(name.strip(), False)
    while stack:
        statement = reader.next("JOINT, End Site or '}'")
        keyword, _, name = statement.replace("\t", " ").partition(" ")
        if statement == "}":
            stack.pop()
        elif joints[stack[-1]].is_end:
            reader.fail(f"'{statement[:60]}' should be '}}' of the End Site")
        elif keyword.upper() == "JOINT":
            open_joint(name.strip(), False)
        elif keyword.upper() == "END":
            open_joint(f"{joints[stack[-1]].name} end", True)
        else:
            reader.fail(f"'{statement[:60]}' should be JOINT, End Site or '}}'")
    return tuple(joints), columns


def _read_header(reader: _Reader, pattern, expected):
    statement = reader.next(expected)
    match = re.fullmatch(pattern, statement, flags=re.IGNORECASE)
    if match is None:
        reader.fail(f"'{statement[:60]}' should be {expected}")
    return match.group(1) if match.groups() else statement


def _read_motion(reader, columns):
    statement = reader.next("MOTION")
    if statement.upper().startswith("ROOT"):
        reader.fail("a second ROOT: the file should hold one person")
    if statement.upper() != "MOTION":
        reader.fail(f"'{statement[:60]}' should be MOTION")
    count = _read_header(
        reader, r"frames\s*:\s*(\S+)", "'Frames:' and their number"
    )
    if not count.isdecimal() or int(count) < 1:
        reader.fail(f"'Frames: {count[:60]}' should be 1 or more")
    count = int(count)
    text = _read_header(
        reader, r"frame\s*time\s*:\s*(\S+)", "'Frame Time:' and seconds"
    )
    (frame_time,) = reader.numbers([text], "the time of a frame in seconds")
    if not 0.0 < frame_time <= _LONGEST_FRAME_TIME:
        reader.fail(
            f"'Frame Time: {text[:60]}' should be seconds, above 0 and up to "
            f"{_LONGEST_FRAME_TIME:g}"
        )
    return _read_frames(reader, count, columns), frame_time


def _read_frames(reader: _Reader, count, columns):
    """Returns the channel values, (count, columns)."""
    rows: list[np.ndarray] = []
    for index in range(reader.line, len(reader.lines)):
        words = reader.lines[index].split()
        if not words:
            continue
        reader.line = index + 1
        if len(rows) == count:
            reader.fail(f"more lines of values than the {count} frames")
        if len(words) != columns:
            reader.fail(
                f"frame {len(rows) + 1} has {len(words)} values, should have "
                f"{columns}"
            )
        try:
            row = np.array(words, dtype=float)
        except ValueError:
            row = None
        if row is None or not (np.abs(row) < _LARGEST_NUMBER).all():
            bad = next(word for word in words if not _is_number(word))
            reader.fail(
                f"frame {len(rows) + 1}: '{bad[:60]}' should be a number"
            )
        rows.append(row)
    if len(rows) != count:
        reader.fail(f"the file ends after {len(rows)} of {count} frames")
    return np.array(rows).reshape(count, columns)


def read_bvh(path: str | Path) -> BvhFile:
    """Reads a BVH file and checks it.

    Args:
        path: The file.

    Returns:
        What the file says, in its own axes, units and names.

    Raises:
        UserError: The file is missing, not text, cut short or malformed; the
            message names file and line.
    """
    try:
        data = read_file(path, most=_LARGEST)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise UserError(f"{path}: is a folder, should be a file") from None
    except OSError as e:
        raise UserError(f"{path}: cannot be read ({e.strerror})") from None
    if not data.strip():
        raise UserError(f"{path}:1: the file is empty")
    if b"\0" in data:
        raise UserError(f"{path}:1: not a BVH file: it is not text")
    # Names may be in any encoding; what matters is ASCII.
    reader = _Reader(path, data.decode("utf-8-sig", errors="replace"))
    joints, columns = _read_hierarchy(reader)
    frames, frame_time = _read_motion(reader, columns)
    frames.flags.writeable = False
    return BvhFile(
        path=str(path), joints=joints, frames=frames, frame_time=frame_time
    )
