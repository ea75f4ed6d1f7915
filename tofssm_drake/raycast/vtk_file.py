"""Checks a legacy VTK file of tetrahedra, as text or binary.

Drake's reader takes memory for any number that a file states, reads outside of
its points where a cell has another corner, and drops cells with a point that is
not finite. So it sees only what was found whole: points, cells and their types,
in this order, and nothing else.
"""

from collections.abc import Iterator
import itertools
import re

import numpy as np

_HEADER = re.compile(
    rb"# vtk DataFile Version (\d)\.\d[ \t]*\r?\n"
    # Drake's reader takes what follows the 255th byte for the next line.
    rb"[^\n]{0,254}\n"
    rb"[ \t]*(ASCII|BINARY)[ \t]*\r?\n",
    re.IGNORECASE,
)
_WORD = re.compile(rb"\S+")
_NUMBER = re.compile(
    rb"[+-]?(?:nan|inf|(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)", re.IGNORECASE
)
_INTEGER = re.compile(rb"[+-]?\d{1,18}")
_TYPES = {
    "double": ">f8",
    "float": ">f4",
    "int": ">i4",
    "long": ">i8",
    "vtktypeint32": ">i4",
    "vtktypeint64": ">i8",
}
_TETRAHEDRON = 10


def check_vtk(contents: bytes) -> None:
    """Checks points and cells.

    Raises:
        ValueError: If a number of items is not that of the file, a point is
            not three finite numbers, a cell's corner is not one of the
            points, or there is something else; says in which line or at
            which byte.
    """
    header = _HEADER.match(contents)
    if header is None:
        raise ValueError("line 1: it does not begin like a legacy VTK file")
    file = _File(
        contents, header.end(), is_binary=header[2].lower() != b"ascii"
    )
    file.require("dataset", "unstructured_grid")
    file.require("points")
    num_points = file.read_count()
    points = file.read_numbers(3 * num_points, file.read_type())
    _check_points(points)
    file.require("cells")
    read_cells = _read_new_cells if int(header[1]) >= 5 else _read_cells
    sizes, corners = read_cells(file)
    _check_corners(corners, num_points)
    file.require("cell_types")
    if file.read_count() != len(sizes):
        file.fail(f"there must be {len(sizes)} types, one for each cell")
    types = file.read_numbers(len(sizes), "int")
    if (sizes[types == _TETRAHEDRON] != 4).any():
        file.fail("a tetrahedron must have four corners")
    file.require_end()


class _File:
    """Reads word by word, and binary numbers where they must be."""

    def __init__(self, contents: bytes, start: int, *, is_binary: bool):
        self._contents = contents
        self._is_binary = is_binary
        self._words = self._find_words(start)
        # Where the last word begins and ends.
        self._at = self._end = start

    def _find_words(self, start) -> Iterator[re.Match]:
        return _WORD.finditer(self._contents, start)

    def fail(self, problem: str) -> None:
        """Raises ValueError that says where the last word is."""
        line = 1 + self._contents.count(b"\n", 0, self._at)
        where = f"byte {self._at}" if self._is_binary else f"line {line}"
        raise ValueError(f"{where}: {problem}")

    def read_word(self) -> str:
        """Returns the next word in lower case; empty: there is none."""
        word = next(self._words, None)
        if word is None:
            self._at = len(self._contents)
            return ""
        self._at, self._end = word.span()
        # It may be a megabyte of something else.
        return word[0][:40].decode(errors="replace").lower()

    def require(self, *expected: str) -> None:
        """Reads these words."""
        for name in expected:
            word = self.read_word()
            if not word:
                self.fail(f"it ends too early, before {name.upper()}")
            if word != name:
                self.fail(f"must be {name.upper()}, got {word!r}")

    def require_end(self) -> None:
        """Reads nothing but space."""
        word = self.read_word()
        if word:
            self.fail(f"must end after the cells' types, got {word!r}")

    def read_count(self) -> int:
        """Returns a number of items, never more than there are bytes."""
        word = self.read_word()
        if not (word.isascii() and word.isdigit()):
            self.fail(f"must be a number of items, got {word!r}")
        if int(word) > len(self._contents):
            self.fail(f"{word} items are more than the file can have")
        return int(word)

    def read_type(self) -> str:
        """Returns the name of a type of numbers."""
        word = self.read_word()
        if word not in _TYPES:
            self.fail(f"type {word!r} must be one of {', '.join(_TYPES)}")
        return word

    def read_numbers(self, count: int, kind: str) -> np.ndarray:
        """Returns the next numbers."""
        read = self._read_binary if self._is_binary else self._read_text
        return read(count, np.dtype(_TYPES[kind]))

    def _read_binary(self, count, dtype):
        # They begin in the next line.
        start = self._contents.find(b"\n", self._end) + 1
        size = count * dtype.itemsize
        if start == 0 or self._contents[self._end : start].strip():
            self.fail("must be followed by a new line")
        if len(self._contents) - start < size:
            self.fail(f"it ends too early, before {count} numbers")
        self._words = self._find_words(start + size)
        return np.frombuffer(self._contents, dtype, count, start)

    def _read_text(self, count, dtype):
        words = list(itertools.islice(self._words, count))
        if len(words) < count:
            self.fail(
                f"it ends too early, with {len(words)} of {count} numbers"
            )
        pattern = _NUMBER if dtype.kind == "f" else _INTEGER
        for word in words:
            if not pattern.fullmatch(word[0]):
                self._at = word.start()
                text = word[0][:40].decode(errors="replace")
                self.fail(f"{text!r} is not a number")
        return np.array([word[0] for word in words], float)


def _check_points(points) -> None:
    bad = np.flatnonzero(~np.isfinite(points))
    if len(bad) > 0:
        raise ValueError(f"point {bad[0] // 3} is not three finite numbers")


def _check_corners(corners, num_points) -> None:
    bad = corners[(corners < 0) | (corners >= num_points)]
    if len(bad) > 0:
        raise ValueError(
            f"a cell has the corner {bad[0]:.0f}, which is not one of its"
            f" {num_points} points"
        )


def _read_cells(file) -> tuple[np.ndarray, np.ndarray]:
    """Returns each cell's number of corners, and all corners.

    Before version 5: CELLS cells numbers, then each cell's corners after
    their number.
    """
    count = file.read_count()
    numbers = file.read_numbers(file.read_count(), "int")
    starts = np.zeros(count, int)
    at = 0
    for i in range(count):
        if at >= len(numbers) or not 0 < numbers[at] < len(numbers) - at:
            file.fail(f"cell {i} is not whole")
        starts[i] = at
        at += 1 + int(numbers[at])
    if at != len(numbers):
        file.fail(f"{count} cells have {at} numbers, not {len(numbers)}")
    return numbers[starts], np.delete(numbers, starts)


def _read_new_cells(file) -> tuple[np.ndarray, np.ndarray]:
    """Returns each cell's number of corners, and all corners.

    Since version 5: CELLS offsets corners, then both lists.
    """
    num_offsets, num_corners = file.read_count(), file.read_count()
    file.require("offsets")
    offsets = file.read_numbers(num_offsets, file.read_type())
    sizes = np.diff(offsets)
    ends = (offsets[0], offsets[-1]) if num_offsets else (0, -1)
    if ends != (0, num_corners) or (sizes < 0).any():
        file.fail(f"offsets must rise from 0 to {num_corners}")
    file.require("connectivity")
    return sizes, file.read_numbers(num_corners, file.read_type())
