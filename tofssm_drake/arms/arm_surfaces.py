"""Surfaces of an arm's shapes as triangle meshes, and capsules around them."""

from collections.abc import Sequence
import functools
import io
import pathlib

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
import trimesh

from tofssm_drake.arms.capsule_fit import calc_coverage, fit_capsules
from tofssm_drake.arms.capsules import Coverage, FittedCapsule
from tofssm_drake.errors import UserError, require
from tofssm_drake.user_files import MEGABYTE, read_file

_LARGEST = 1000 * MEGABYTE

Placed = tuple[Shape, RigidTransform]
"""A shape and its pose in its body."""


def convert_to_obj(path: pathlib.Path, scale: np.ndarray) -> str:
    """Returns the text of an OBJ file with the surface of another file.

    Args:
        path: Of a mesh that trimesh reads.
        scale: Factors of its coordinates, (3,).

    Raises:
        UserError: It cannot be read, or has no triangle.
    """
    surface = _read_mesh(path).copy()
    surface.apply_scale(scale)
    return str(surface.export(file_type="obj"))


def fit_shapes(shapes: Sequence[Placed]) -> list[FittedCapsule]:
    """Returns capsules around shapes, in the body's frame.

    Raises:
        UserError: There is none around a shape, or a mesh cannot be read.
    """
    mesh = _make_surface(shapes)
    triangles = np.ascontiguousarray(mesh.triangles)
    return _fit_triangles(triangles.tobytes())


def calc_shape_coverage(shapes: Sequence[Placed]) -> Coverage:
    """Returns how well fitted capsules cover shapes; raises as `fit_shapes`."""
    return calc_coverage(_make_surface(shapes), fit_shapes(shapes))


@functools.lru_cache(maxsize=256)
def _fit_triangles(contents: bytes) -> list[FittedCapsule]:
    """Fits once, however often an arm is put into a plant."""
    triangles = np.frombuffer(contents).reshape(-1, 3)
    faces = np.arange(len(triangles)).reshape(-1, 3)
    return fit_capsules(trimesh.Trimesh(triangles, faces, process=False))


@functools.lru_cache(maxsize=256)
def _read_mesh(path: pathlib.Path) -> trimesh.Trimesh:
    try:
        contents = io.BytesIO(read_file(path, most=_LARGEST))
        mesh = trimesh.load_mesh(
            contents, file_type=pathlib.Path(path).suffix.lower()[1:]
        )
    except Exception as error:
        # A broken file may raise anything.
        raise UserError(f"{path}: {' '.join(str(error).split())}") from None
    require(len(mesh.faces) > 0, f"{path}: has no triangle")
    mesh.merge_vertices()
    return mesh


def _make_surface(shapes):
    """Returns shapes as one trimesh.Trimesh in the body's frame."""
    parts = []
    for shape, X_BG in shapes:
        part = _make_trimesh(shape)
        part.apply_transform(X_BG.GetAsMatrix4())
        parts.append(part)
    return trimesh.util.concatenate(parts)


def _make_trimesh(shape):
    """Returns a shape in its own frame; round ones slightly too large."""
    if isinstance(shape, Box):
        return trimesh.creation.box(shape.size())
    if isinstance(shape, Cylinder):
        # The polygon is around the circle.
        radius = shape.radius() / np.cos(np.pi / 64)
        return trimesh.creation.cylinder(radius, shape.length(), sections=64)
    # The ball's flat faces are at most 0.5 % inside of a sphere.
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.01)
    if isinstance(shape, Ellipsoid):
        size = np.array([shape.a(), shape.b(), shape.c()])
        return trimesh.Trimesh(size * ball.vertices, ball.faces)
    if isinstance(shape, Sphere | Capsule):
        points = shape.radius() * np.asarray(ball.vertices)
        if isinstance(shape, Sphere):
            return trimesh.Trimesh(points, ball.faces)
        half = np.array([0.0, 0.0, shape.length() / 2])
        return trimesh.convex.convex_hull(
            np.vstack([points + half, points - half])
        )
    if isinstance(shape, Convex | Mesh):
        return _load_mesh(shape)
    raise UserError(
        f"robot.file: no capsule can be fitted around a shape of type "
        f"{type(shape).__name__}"
    )


def _load_mesh(shape):
    source = shape.source()
    if source.is_path():
        mesh = _read_mesh(source.path()).copy()
    else:
        mesh = trimesh.load_mesh(
            io.BytesIO(source.in_memory().mesh_file.contents()),
            file_type=shape.extension().removeprefix("."),
        )
    mesh.apply_scale(shape.scale3())
    return (
        trimesh.convex.convex_hull(mesh) if isinstance(shape, Convex) else mesh
    )
