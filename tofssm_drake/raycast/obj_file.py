"""The triangles of a Wavefront OBJ file.

Drake's reader returns one triangle of a face with five corners, takes 0 for a
coordinate that is not a number, and crashes on an index out of range. trimesh
cuts a non-convex face outside of it, and counts relative indices from the end
of the file. So it is read here.
"""

import math
import re

import numpy as np

from tofssm_drake.raycast.polygons import cut_polygons

_NUMBER = rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_INTEGER = rb"[+-]?[0-9]{1,18}"
# Rows of three, possessive: backtracking would make long texts slow.
_THREE_NUMBERS = re.compile(
    rb"(?>[ \t]*+(?:" + _NUMBER + rb"[ \t]++){2}" + _NUMBER + rb"[ \t]*+\n)*+"
)
_THREE_INTEGERS = re.compile(
    rb"(?>[ \t]*+(?:" + _INTEGER + rb"[ \t]++){2}" + _INTEGER + rb"[ \t]*+\n)*+"
)


def read_obj(contents: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices, (v, 3), and triangles of indices into them, (n, 3).

    Faces of more than three corners are cut into triangles, also where they
    are not convex. Texture, normals and materials are ignored, and so is
    everything but `v` and `f`.

    Raises:
        ValueError: If a vertex is not three finite numbers, or a face's
            corner is not a vertex; names the line.
    """
    contents = _clean(contents)
    vertices = _read_vertices(contents)
    corners, counts = _read_faces(contents, len(vertices))
    return vertices, cut_polygons(vertices, corners, counts)


def check_obj(contents: bytes) -> None:
    """Checks vertices and faces.

    Raises:
        ValueError: See `read_obj`.
    """
    contents = _clean(contents)
    _read_faces(contents, len(_read_vertices(contents)))


def read_obj_vertices(contents: bytes) -> np.ndarray:
    """Returns the vertices alone, shape (v, 3).

    Raises:
        ValueError: If one is not three finite numbers; names the line.
    """
    return _read_vertices(_clean(contents))


def _clean(contents: bytes) -> bytes:
    """Returns the text without comments, its lines ended by newlines."""
    if b"\r" in contents:
        contents = contents.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"#" in contents:
        contents = re.sub(rb"#.*", b"", contents)
    return contents


def _find_rows(contents: bytes, kind: bytes) -> list[bytes]:
    """Returns what follows in the lines of a kind."""
    return re.findall(
        rb"^[ \t]*+" + kind + rb"(?![^ \t\n])(.*)$", contents, re.M
    )


def _read_vertices(contents: bytes) -> np.ndarray:
    rows = _find_rows(contents, b"v")
    if not rows:
        return np.empty((0, 3))
    text = b"\n".join(rows) + b"\n"
    if not _THREE_NUMBERS.fullmatch(text):
        # Perhaps followed by colours or weights.
        fields = [row.split() for row in rows]
        if not all(
            len(row) > 2 and all(map(_is_number, row)) for row in fields
        ):
            _raise_bad_vertex(contents)
        text = b" ".join(field for row in fields for field in row[:3])
    numbers = np.fromstring(text, dtype=float, sep=" ")
    if not np.isfinite(numbers).all():
        _raise_bad_vertex(contents)
    return numbers.reshape(-1, 3)


def _raise_bad_vertex(contents: bytes):
    for number, line in enumerate(contents.split(b"\n"), start=1):
        fields = line.split()
        if fields[:1] != [b"v"]:
            continue
        if len(fields) < 4 or not all(map(_is_number, fields[1:])):
            text = line.decode(errors="replace").strip()
            raise ValueError(
                f"line {number}: '{text}' is not a vertex of three finite"
                " numbers"
            )
    raise ValueError("it has a vertex that is not three finite numbers")


def _is_number(field: bytes) -> bool:
    return bool(re.fullmatch(_NUMBER, field)) and math.isfinite(float(field))


def _read_faces(
    contents: bytes, num_vertices: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners of all faces, and how many each face has."""
    rows = _find_rows(contents, b"f")
    if not rows:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    text = b"\n".join(rows) + b"\n"
    if b"/" in text:
        # Only the first number of each corner is the vertex.
        text = re.sub(rb"(?<=[0-9])/[^ \t\n]*+", b"", text)
    if _THREE_INTEGERS.fullmatch(text):
        counts = np.full(len(rows), 3)
    else:
        counts = np.array([len(row.split()) for row in rows])
        good = re.fullmatch(rb"(?:" + _INTEGER + rb"\s++)*+", text.lstrip())
        if not good or counts.min() < 3:
            _raise_bad_face(contents, num_vertices)
    corners = np.fromstring(text, dtype=np.int64, sep=" ")
    if corners.min() < 0:
        corners = _resolve_relative(contents, corners, counts)
    corners -= 1
    if corners.min() < 0 or corners.max() >= num_vertices:
        _raise_bad_face(contents, num_vertices)
    return corners, counts


def _resolve_relative(contents, corners, counts) -> np.ndarray:
    """Returns indices from 1 on where some count back from their line."""
    kinds = np.array(re.findall(rb"^[ \t]*+([vf])(?![^ \t\n])", contents, re.M))
    so_far = np.cumsum(kinds == b"v")[kinds == b"f"]
    return np.where(
        corners < 0, corners + np.repeat(so_far, counts) + 1, corners
    )


def _raise_bad_face(contents: bytes, num_vertices: int):
    so_far = 0
    for number, line in enumerate(contents.split(b"\n"), start=1):
        fields = line.split()
        so_far += fields[:1] == [b"v"]
        if fields[:1] != [b"f"]:
            continue
        corners = [field.partition(b"/")[0] for field in fields[1:]]
        good = len(corners) > 2 and all(
            re.fullmatch(_INTEGER, corner)
            and -so_far <= int(corner) <= num_vertices
            and int(corner) != 0
            for corner in corners
        )
        if not good:
            text = line.decode(errors="replace").strip()
            raise ValueError(
                f"line {number}: '{text}' is not a face of at least three of"
                f" the {num_vertices} vertices"
            )
    raise ValueError("it has a face that is not of its vertices")
