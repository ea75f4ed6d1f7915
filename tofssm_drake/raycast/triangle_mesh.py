"""Triangles of Drake's Mesh shapes.

Drake's distance queries replace most meshes by their convex hulls. A ray sees
the surface itself, so it is read here: STL and COLLADA by
trimesh, tetrahedral VTK by Drake, OBJ and glTF by readers that are stricter
than either (see `obj_file`, `gltf_file`).
"""

from collections.abc import Callable, Iterator
import dataclasses as dc
import hashlib
import os
from pathlib import Path
import re
from urllib.parse import unquote

import numpy as np
from pydrake.geometry import (
    AddRigidHydroelasticProperties,
    GeometryInstance,
    Mesh,
    MeshSource,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform

from tofssm_drake.errors import UserError
from tofssm_drake.raycast.gltf_file import read_gltf
from tofssm_drake.raycast.gltf_references import check_references
from tofssm_drake.raycast.mesh_parts import check_corners, orient_faces
from tofssm_drake.raycast.obj_file import (
    check_obj,
    read_obj,
    read_obj_vertices,
)
from tofssm_drake.raycast.triangle_tree import (
    TriangleTree,
    make_triangle_tree,
)
from tofssm_drake.raycast.vtk_file import check_vtk
from tofssm_drake.user_files import MEGABYTE, decode_json, read_file

_LARGEST = 1000 * MEGABYTE
# Keys of an OBJ's materials that name a picture.
_PICTURE = rb"(?:map_\w+|bump|disp|decal|refl)"


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TriangleMesh:
    """What rays see of a Mesh, and what they can start inside of."""

    surface: TriangleTree
    """All triangles."""
    solid: TriangleTree | None
    """Those that bound volumes; the same tree if all do, None if none do."""


def make_triangle_mesh(vertices: np.ndarray, faces: np.ndarray):
    """Makes a TriangleMesh.

    Args:
        vertices: Positions in G, shape (v, 3), m.
        faces: Indices of each triangle's corners, shape (n, 3).

    Raises:
        ValueError: If there is no triangle, a corner is not a vertex, or a
            vertex is not finite.
    """
    vertices = np.asarray(vertices, dtype=float)
    faces = np.asarray(faces, dtype=np.int64)
    if len(faces) == 0:
        raise ValueError("it has no triangle")
    check_corners(vertices, faces)
    faces, is_solid, welded = orient_faces(vertices, faces)
    surface = make_triangle_tree(vertices, faces)
    solid = surface if is_solid.any() else None
    if solid and not (is_solid.all() and welded is vertices):
        solid = make_triangle_tree(welded, faces[is_solid])
    return TriangleMesh(surface=surface, solid=solid)


def describe_mesh_source(mesh) -> str:
    """Returns a text that identifies the file and the scale."""
    source: MeshSource = mesh.source()
    if source.is_path():
        what = str(source.path())
    else:
        memory = source.in_memory()
        digest = hashlib.sha256(memory.mesh_file.contents())
        for _, file in sorted(memory.supporting_files.items()):
            try:
                digest.update(_read_supporting_file(file))
            except OSError:
                # The reader that needs the file names it.
                digest.update(b"missing")
        what = digest.hexdigest()
    scale = np.asarray(mesh.scale3(), dtype=float)
    return f"{what} {mesh.extension()} {scale.tolist()}"


def read_mesh(mesh: Mesh, name: str) -> TriangleMesh:
    """Reads the surface of a Mesh shape, with its scale.

    Args:
        mesh: Of a file or in memory: .obj, .gltf, .stl, .dae or tetrahedral
            .vtk.
        name: Of the geometry, for messages.

    Raises:
        UserError: If the file cannot be read or has no surface.
    """
    readers = {
        ".obj": _read_obj,
        ".gltf": _read_gltf,
        ".stl": _read_stl,
        ".dae": _read_dae,
        ".vtk": _read_vtk,
    }
    reader = readers.get(mesh.extension().lower())
    where = _name_mesh(mesh, name)
    if reader is None:
        raise UserError(
            f"{where}: '{mesh.extension()}' is not one of {', '.join(readers)}"
        )
    try:
        return make_triangle_mesh(*reader(mesh))
    except (AttributeError, TypeError) as error:
        raise UserError(
            f"{where} cannot be read: it is not as its format demands: {error}"
        ) from error
    except (
        OSError,
        RuntimeError,
        ValueError,
        LookupError,
        SyntaxError,
    ) as error:
        reason = str(error).splitlines()[0] if str(error) else repr(error)
        raise UserError(f"{where} cannot be read: {reason}") from error


def check_mesh_file(mesh: Mesh) -> None:
    """Checks what of a mesh Drake's own readers do not bear.

    Args:
        mesh: Of a file: .obj, .gltf or .vtk.

    Raises:
        ValueError: It cannot be read, an index is not one of its vertices, a
            number is not finite, or it refers to what is outside its folder.
    """
    extension = mesh.extension().lower()
    try:
        if extension == ".obj":
            contents = _read_source(mesh.source())
            check_obj(contents)
            if mesh.source().is_path():
                _check_materials(Path(mesh.source().path()), contents)
        elif extension == ".vtk":
            check_vtk(_read_source(mesh.source()))
        elif extension == ".gltf":
            _read_gltf(mesh)
            check_references(
                decode_json(_read_source(mesh.source())), _make_loader(mesh)
            )
    except OSError as error:
        raise ValueError(f"{error.filename}: {error.strerror}") from error
    except (AttributeError, LookupError, TypeError) as error:
        raise ValueError(str(error)) from error


def check_hull_source(shape, name: str) -> None:
    """Checks the file that Drake makes a convex hull of, if it is an OBJ.

    Drake takes 0 for a coordinate that is not a number.

    Args:
        shape: A Convex.
        name: Of the geometry, for messages.

    Raises:
        UserError: If it cannot be read, or a vertex is not three numbers.
    """
    if shape.extension().lower() != ".obj":
        return
    try:
        read_obj_vertices(_read_source(shape.source()))
    except (OSError, ValueError) as error:
        raise UserError(
            f"{_name_mesh(shape, name)} cannot be read: {error}"
        ) from error


def _name_mesh(mesh, name: str) -> str:
    return f"geometry '{name}': mesh '{mesh.source().description()}'"


def _read_source(source: MeshSource) -> bytes:
    if source.is_path():
        return _read_file(Path(source.path()))
    return source.in_memory().mesh_file.contents()


def _read_file(path: Path) -> bytes:
    return read_file(path, most=_LARGEST)


def _read_supporting_file(file) -> bytes:
    return _read_file(file) if isinstance(file, Path) else file.contents()


def _read_obj(mesh: Mesh):
    vertices, faces = read_obj(_read_source(mesh.source()))
    return vertices * mesh.scale3(), faces


def _read_gltf(mesh: Mesh):
    contents = _read_source(mesh.source())
    vertices, faces = read_gltf(contents, _make_loader(mesh))
    return vertices * mesh.scale3(), faces


def _make_loader(mesh: Mesh) -> Callable[[str], bytes]:
    """Returns what loads the files that a glTF file refers to."""
    source = mesh.source()

    def load(uri: str) -> bytes:
        if source.is_path():
            return _read_file(_find_beside(Path(source.path()), unquote(uri)))
        files = source.in_memory().supporting_files
        if uri not in files:
            raise ValueError(f"its file '{uri}' is missing")
        return _read_supporting_file(files[uri])

    return load


def _find_beside(path: Path, name: str) -> Path:
    """Returns the path of a file that belongs to another one.

    Raises:
        ValueError: It is not in that one's folder or below.
    """
    folder = path.parent.absolute()
    found = Path(os.path.normpath(folder / name))
    if not found.is_relative_to(os.path.normpath(folder)):
        raise ValueError(f"'{name}' is outside of its folder")
    return found


def _check_materials(path: Path, contents: bytes) -> None:
    """Checks the materials of an OBJ file, and the pictures that they name.

    Those that are not there are left to whoever draws.

    Raises:
        ValueError, OSError: One is outside of the folder, or not a file.
    """
    for name in _find_words(contents, b"mtllib"):
        library = _find_beside(path, name)
        if not library.exists():
            continue
        materials = _read_file(library)
        for picture in _find_words(materials, _PICTURE):
            found = _find_beside(library, picture)
            if found.exists() and not found.is_dir():
                _read_file(found)


def _find_words(contents: bytes, key: bytes) -> Iterator[str]:
    """Yields the words after a key, and all of them as one name."""
    for line in re.findall(rb"^[ \t]*" + key + rb"[ \t]+(.*)$", contents, re.M):
        text = line.decode(errors="replace").strip()
        yield from dict.fromkeys([text, *text.split()])


def _read_stl(mesh: Mesh):
    # Only for such files: their reader takes long to import.
    from tofssm_drake.raycast.trimesh_files import read_stl

    vertices, faces = read_stl(_read_source(mesh.source()))
    return vertices * mesh.scale3(), faces


def _read_dae(mesh: Mesh):
    """Reads COLLADA, in its own unit of length. Its axes stay as they are."""
    # As above.
    from tofssm_drake.raycast.trimesh_files import read_dae

    vertices, faces, unit = read_dae(_read_source(mesh.source()))
    return vertices * (unit * mesh.scale3()), faces


def _read_vtk(mesh):
    # The surface of a tetrahedral mesh is what Drake makes of it for rigid
    # contact; its reader has no Python binding of its own.
    check_vtk(_read_source(mesh.source()))
    scene_graph = SceneGraph()
    instance = GeometryInstance(RigidTransform(), mesh, "mesh")
    properties = ProximityProperties()
    AddRigidHydroelasticProperties(1.0, properties)
    instance.set_proximity_properties(properties)
    try:
        geometry_id = scene_graph.RegisterAnchoredGeometry(
            scene_graph.RegisterSource("reader"), instance
        )
    except SystemExit as error:
        # What pydrake makes of an assertion that fails: bad binary cells.
        raise ValueError(f"it is not as its format demands: {error}") from error
    inspector = scene_graph.model_inspector()
    return _unpack_surface(inspector.maybe_get_hydroelastic_mesh(geometry_id))


def _unpack_surface(surface):
    faces = [
        (t.vertex(0), t.vertex(1), t.vertex(2)) for t in surface.triangles()
    ]
    return np.array(surface.vertices()), np.array(faces).reshape(-1, 3)
