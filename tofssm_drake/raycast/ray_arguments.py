"""Checks of the ray caster's arguments."""

from collections.abc import Iterable, Sequence
import reprlib

import numpy as np
from pydrake.geometry import GeometryId

UNIT_TOLERANCE = 1e-6
"""How far the length of a direction may be from 1."""


def as_packed(where: str, array) -> np.ndarray:
    """Returns an array, or a copy, as the kernels are compiled for."""
    if type(array) is np.ndarray:
        flags = array.flags
        if flags.c_contiguous and flags.writeable and array.dtype == float:
            return array
    return copy_numbers(where, array)


def copy_numbers(where: str, array) -> np.ndarray:
    """Returns a copy of real numbers; raises ValueError for others."""
    if _has_masked_array(array):
        raise ValueError(f"{where}: a masked array, which hides numbers")
    array = np.asarray(array)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{where}: {array.dtype} are not real numbers")
    return np.array(array, dtype=float, order="C")


def _has_masked_array(array) -> bool:
    """Returns whether it is a masked array, or a list with one in it."""
    if isinstance(array, np.ma.MaskedArray):
        return True
    if not isinstance(array, Sequence) or isinstance(array, str | bytes):
        return False
    # Many rows have few types: so numbers are not looked at one by one.
    kinds = set(map(type, array))
    if kinds <= {float, int, np.ndarray}:
        return False
    return any(map(_has_masked_array, array))


def check_geometry_ids(where: str, geometry_ids) -> list[GeometryId]:
    """Returns a list of them; raises ValueError for anything else."""
    if not isinstance(geometry_ids, Iterable):
        raise ValueError(
            f"{where}: {show(geometry_ids)} is not a collection of GeometryIds"
        )
    geometry_ids = list(geometry_ids)
    for stranger in geometry_ids:
        if not isinstance(stranger, GeometryId):
            raise ValueError(
                f"{where}: has {show(stranger)}, a {type(stranger).__name__},"
                " not a GeometryId; get_geometry_ids returns those of the"
                " indices that a cast returns"
            )
    return geometry_ids


def show(thing) -> str:
    """Returns a short description in one line."""
    return " ".join(reprlib.repr(thing).split())


def make_unit_vectors(where: str, vectors: np.ndarray) -> np.ndarray:
    """Returns a copy with unit vectors exact to the last digits."""
    vectors = copy_numbers(where, vectors)
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise ValueError(f"{where}: shape {vectors.shape} is not (k, 3)")
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (np.abs(length - 1.0) <= UNIT_TOLERANCE).all():
        raise ValueError(f"{where}: not unit vectors")
    return vectors / length


def make_ranges(where: str, ranges, count: int) -> np.ndarray:
    """Returns a copy: one number >= 0 for each of `count`, shape (count,)."""
    if type(ranges) is float and ranges >= 0.0:
        return np.full(count, ranges)
    ranges = copy_numbers(where, ranges)
    if ranges.shape not in ((), (count,)):
        raise ValueError(
            f"{where}: shape {ranges.shape} is neither () nor ({count},)"
        )
    if not (ranges >= 0.0).all():
        raise ValueError(f"{where}: {ranges} is not >= 0")
    return np.array(np.broadcast_to(ranges, count))
