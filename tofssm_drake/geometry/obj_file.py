"""The triangles of a Wavefront OBJ file.

Drake's reader hands out one triangle of a face with five corners, takes 0 for
a coordinate that is not a number, and crashes on an index out of range;
trimesh cuts a face that is not convex outside of it, and counts relative
indices from the end of the file. So it is read here.
"""

import itertools
import math
import re

import numpy as np

from tofssm_drake.geometry.polygons import cut_polygons

_NUMBER = re.compile(rb"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
# Only these are in numbers; what numpy reads beside them is none.
_NUMBERS = re.compile(rb"[-+.0-9eE\s]*")
_INTEGERS = re.compile(rb"[-+0-9\s]*")


def read_obj(contents: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices, (v, 3), and triangles of indices into them, (n, 3).

    Faces of more than three corners are cut into triangles, also where they
    are not convex. Texture, normals and materials are ignored, and so is
    everything but `v` and `f`.

    Raises:
        ValueError: If a vertex is not three finite numbers, or a face's
            corner is not a vertex; tells the line.
    """
    lines = _split_lines(contents)
    vertices = _read_vertices(lines)
    corners, counts = _read_faces(lines, len(vertices))
    return vertices, cut_polygons(vertices, corners, counts)


def read_obj_vertices(contents: bytes) -> np.ndarray:
    """Returns the vertices alone, shape (v, 3).

    Raises:
        ValueError: If one is not three finite numbers; tells the line.
    """
    return _read_vertices(_split_lines(contents))


def _split_lines(contents: bytes) -> list[list[bytes]]:
    """Returns the fields of all lines, without comments."""
    lines = contents.splitlines()
    if b"#" in contents:
        lines = [line.partition(b"#")[0] for line in lines]
    return [line.split() for line in lines]


def _read_vertices(lines: list[list[bytes]]) -> np.ndarray:
    rows = [fields for fields in lines if fields and fields[0] == b"v"]
    if not rows:
        return np.empty((0, 3))
    if min(map(len, rows)) > 3:
        text = b" ".join(itertools.chain.from_iterable(r[1:4] for r in rows))
        # Beyond the third, colours and weights are numbers, too.
        rest = b" ".join(itertools.chain.from_iterable(r[4:] for r in rows))
        if _NUMBERS.fullmatch(text) and _NUMBERS.fullmatch(rest):
            try:
                numbers = np.array(text.split(), dtype=bytes).astype(float)
            except ValueError:
                numbers = np.array([np.nan])
            if np.isfinite(numbers).all():
                return numbers.reshape(-1, 3)
    _raise_bad_vertex(lines)


def _raise_bad_vertex(lines: list[list[bytes]]):
    for number, fields in enumerate(lines, start=1):
        if fields[:1] != [b"v"]:
            continue
        if len(fields) < 4 or not all(map(_is_number, fields[1:])):
            text = b" ".join(fields).decode(errors="replace")
            raise ValueError(
                f"line {number}: '{text}' is not a vertex of three finite"
                " numbers"
            )
    raise ValueError("it has a vertex that is not three finite numbers")


def _is_number(field: bytes) -> bool:
    return bool(_NUMBER.fullmatch(field)) and math.isfinite(float(field))


def _read_faces(
    lines: list[list[bytes]], num_vertices: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners of all faces, and how many each face has."""
    rows = [fields for fields in lines if fields and fields[0] == b"f"]
    counts = np.array(list(map(len, rows)), dtype=np.int64) - 1
    if len(rows) == 0:
        return np.empty(0, dtype=np.int64), counts
    text = b" ".join(itertools.chain.from_iterable(row[1:] for row in rows))
    if b"/" in text:
        text = re.sub(rb"/\S*", b"", text)
    fields = text.split()
    bad = counts.min() < 3 or len(fields) != counts.sum()
    if bad or not _INTEGERS.fullmatch(text):
        _raise_bad_face(lines, num_vertices)
    try:
        corners = np.array(fields, dtype=bytes).astype(np.int64)
    except (ValueError, OverflowError):
        _raise_bad_face(lines, num_vertices)
    is_relative = corners < 0
    if is_relative.any():
        is_vertex = [fields[:1] == [b"v"] for fields in lines]
        is_face = [fields[:1] == [b"f"] for fields in lines]
        so_far = np.cumsum(is_vertex)[np.flatnonzero(is_face)]
        corners = corners + is_relative * (np.repeat(so_far, counts) + 1)
    corners -= 1
    if corners.min() < 0 or corners.max() >= num_vertices:
        _raise_bad_face(lines, num_vertices)
    return corners, counts


def _raise_bad_face(lines: list[list[bytes]], num_vertices: int):
    so_far = 0
    for number, fields in enumerate(lines, start=1):
        so_far += fields[:1] == [b"v"]
        if fields[:1] != [b"f"]:
            continue
        corners = [field.partition(b"/")[0] for field in fields[1:]]
        good = len(corners) > 2 and all(
            re.fullmatch(rb"[-+]?[0-9]{1,18}", corner)
            and -so_far <= int(corner) <= num_vertices
            and int(corner) != 0
            for corner in corners
        )
        if not good:
            text = b" ".join(fields).decode(errors="replace")
            raise ValueError(
                f"line {number}: '{text}' is not a face of at least three of"
                f" the {num_vertices} vertices"
            )
    raise ValueError("it has a face that is not of its vertices")
