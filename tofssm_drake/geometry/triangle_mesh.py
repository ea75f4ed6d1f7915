"""Triangles of Drake's Mesh shapes.

Drake's distance queries replace many a mesh by its convex hull. What is seen
along a ray is the surface itself, so it is read here: OBJ and tetrahedral VTK
by Drake's own readers, glTF by a small one.
"""

import base64
import dataclasses as dc
import hashlib
import json
import math
from pathlib import Path
import re
import tempfile
from urllib.parse import unquote

import numpy as np
from pydrake.geometry import (
    AddRigidHydroelasticProperties,
    GeometryInstance,
    Mesh,
    MeshSource,
    ProximityProperties,
    ReadObjToTriangleSurfaceMesh,
    SceneGraph,
)
from pydrake.math import RigidTransform

from tofssm_drake.errors import UserError
from tofssm_drake.geometry.mesh_parts import orient_faces
from tofssm_drake.geometry.triangle_tree import (
    TriangleTree,
    make_triangle_tree,
)

_UNSIGNED = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32}
_FLOAT = {5126: np.float32}
_COMPONENTS = {"SCALAR": 1, "VEC3": 3}
_POINTS_AND_LINES = (0, 1, 2, 3)
_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN = 4, 5, 6
# Of a rotation's length: files round their numbers.
_UNIT_TOLERANCE = 1e-3
_OBJ_NUMBER = re.compile(rb"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


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
        ValueError: If there is no triangle, or a vertex is not finite.
    """
    vertices = np.asarray(vertices, dtype=float)
    faces = np.asarray(faces, dtype=np.int64)
    if len(faces) == 0:
        raise ValueError("it has no triangle")
    if not np.isfinite(vertices[faces]).all():
        raise ValueError("it has a vertex that is not finite")
    faces, is_solid = orient_faces(vertices, faces)
    surface = make_triangle_tree(vertices, faces)
    solid = surface if is_solid.any() else None
    if solid and not is_solid.all():
        solid = make_triangle_tree(vertices, faces[is_solid])
    return TriangleMesh(surface=surface, solid=solid)


def describe_mesh_source(mesh) -> str:
    """Returns a text that differs when another file or scale is used."""
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
                # Who needs the file tells which mesh lacks it.
                digest.update(b"missing")
        what = digest.hexdigest()
    scale = np.asarray(mesh.scale3(), dtype=float)
    return f"{what} {mesh.extension()} {scale.tolist()}"


def read_mesh(mesh: Mesh, name: str) -> TriangleMesh:
    """Reads the surface of a Mesh shape, with its scale.

    Args:
        mesh: Of a file or in memory: .obj, .gltf or tetrahedral .vtk.
        name: Of the geometry, for messages.

    Raises:
        UserError: If the file can not be read or has no surface.
    """
    readers = {".obj": _read_obj, ".gltf": _read_gltf, ".vtk": _read_vtk}
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
            f"{where} can not be read: it is not as its format demands: {error}"
        ) from error
    except (OSError, RuntimeError, ValueError, LookupError) as error:
        reason = str(error).splitlines()[0] if str(error) else repr(error)
        raise UserError(f"{where} can not be read: {reason}") from error


def check_hull_source(shape, name: str) -> None:
    """Checks the file that Drake makes a convex hull of, if it is an OBJ.

    Args:
        shape: A Convex.
        name: Of the geometry, for messages.

    Raises:
        UserError: If it can not be read, or a vertex is no three numbers.
    """
    if shape.extension().lower() != ".obj":
        return
    try:
        _check_obj_vertices(_read_source(shape.source()))
    except (OSError, ValueError) as error:
        raise UserError(
            f"{_name_mesh(shape, name)} can not be read: {error}"
        ) from error


def _name_mesh(mesh, name: str) -> str:
    return f"geometry '{name}': mesh '{mesh.source().description()}'"


def _read_source(source: MeshSource) -> bytes:
    if source.is_path():
        return Path(source.path()).read_bytes()
    return source.in_memory().mesh_file.contents()


def _read_obj(mesh):
    source = mesh.source()
    contents = _read_source(source)
    _check_obj_vertices(contents)
    if source.is_path():
        surface = ReadObjToTriangleSurfaceMesh(source.path(), mesh.scale3())
    else:
        # Drake's reader takes file names only.
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.obj"
            path.write_bytes(contents)
            surface = ReadObjToTriangleSurfaceMesh(path, mesh.scale3())
    return _unpack_surface(surface)


def _check_obj_vertices(contents: bytes) -> None:
    """Checks an OBJ's vertices: Drake's reader takes 0 for what it is not."""
    for number, line in enumerate(contents.splitlines(), start=1):
        fields = line.partition(b"#")[0].split()
        if not fields or fields[0] != b"v":
            continue
        if len(fields) < 4 or not all(map(_is_obj_number, fields[1:])):
            text = line.decode(errors="replace").strip()
            raise ValueError(
                f"line {number}: '{text}' is not a vertex of three finite"
                " numbers"
            )


def _is_obj_number(field: bytes) -> bool:
    return bool(_OBJ_NUMBER.fullmatch(field)) and math.isfinite(float(field))


def _read_vtk(mesh):
    # The surface of a tetrahedral mesh is what Drake makes of it for rigid
    # contact; its reader is not bound by itself.
    scene_graph = SceneGraph()
    instance = GeometryInstance(RigidTransform(), mesh, "mesh")
    properties = ProximityProperties()
    AddRigidHydroelasticProperties(1.0, properties)
    instance.set_proximity_properties(properties)
    geometry_id = scene_graph.RegisterAnchoredGeometry(
        scene_graph.RegisterSource("reader"), instance
    )
    inspector = scene_graph.model_inspector()
    return _unpack_surface(inspector.maybe_get_hydroelastic_mesh(geometry_id))


def _unpack_surface(surface):
    faces = [
        (t.vertex(0), t.vertex(1), t.vertex(2)) for t in surface.triangles()
    ]
    return np.array(surface.vertices()), np.array(faces).reshape(-1, 3)


def _read_gltf(mesh):
    """Reads all triangles of a glTF file's scene (specification 2.0)."""
    source = mesh.source()
    if source.is_path():
        folder = Path(source.path()).parent

        def load(uri):
            return (folder / unquote(uri)).read_bytes()
    else:
        memory = source.in_memory()

        def load(uri):
            if uri not in memory.supporting_files:
                raise ValueError(f"its buffer '{uri}' is missing")
            return _read_supporting_file(memory.supporting_files[uri])

    gltf = json.loads(_read_source(source))
    required = gltf.get("extensionsRequired", [])
    if required:
        raise ValueError(f"it needs the extensions {', '.join(required)}")
    buffers = [_load_buffer(buffer, load) for buffer in gltf.get("buffers", [])]
    vertices, faces, count = [], [], 0
    for node, X_GN in _walk_gltf_nodes(gltf):
        if "mesh" not in node:
            continue
        for primitive in _find(gltf, "meshes", node["mesh"])["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode in _POINTS_AND_LINES:
                continue
            p_NV, indices = _read_primitive(gltf, buffers, primitive)
            corners = _make_faces(indices, mode)
            if np.linalg.det(X_GN[:3, :3]) < 0.0:
                corners = corners[:, ::-1]  # A mirror turns them inside out.
            vertices.append(p_NV @ X_GN[:3, :3].T + X_GN[:3, 3])
            faces.append(corners + count)
            count += len(p_NV)
    if not faces:
        raise ValueError("it has no triangle")
    # As Drake does: a file's y axis points up, a geometry's z axis.
    x, y, z = np.vstack(vertices).T
    return np.column_stack([x, -z, y]) * mesh.scale3(), np.vstack(faces)


def _read_supporting_file(file) -> bytes:
    return (
        Path(file).read_bytes() if hasattr(file, "parts") else (file.contents())
    )


def _load_buffer(buffer, load) -> bytes:
    if "uri" not in buffer:
        raise ValueError("a buffer has no uri")
    uri = buffer["uri"]
    if uri.startswith("data:"):
        data = base64.b64decode(uri.split(",", 1)[1])
    else:
        data = load(uri)
    length = _get_count(buffer, "byteLength")
    if length > len(data):
        raise ValueError(f"a buffer is too short: {len(data)} of {length} B")
    return data[:length]


def _find(gltf, kind: str, index):
    """Returns an entry by its index, which does not count from the end."""
    entries = gltf.get(kind, [])
    if type(index) is not int or not 0 <= index < len(entries):
        raise ValueError(f"{index!r} is none of its {len(entries)} {kind}")
    return entries[index]


def _get_count(entry, key: str, default: int | None = None) -> int:
    count = entry.get(key, default)
    if type(count) is not int or count < 0:
        raise ValueError(f"{key}: {count!r} is not a whole number >= 0")
    return count


def _get_numbers(entry, key: str, default: list[float]) -> np.ndarray:
    numbers = np.asarray(entry.get(key, default), dtype=float)
    if numbers.shape != np.shape(default) or not np.isfinite(numbers).all():
        raise ValueError(
            f"{key}: {entry[key]} are not {len(default)} finite numbers"
        )
    return numbers


def _walk_gltf_nodes(gltf):
    """Yields each node of the scene with its pose and scale, (4, 4)."""
    nodes = gltf.get("nodes", [])
    if "scenes" in gltf:
        roots = _find(gltf, "scenes", gltf.get("scene", 0)).get("nodes", [])
    else:
        children = {c for n in nodes for c in n.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    stack = [(root, np.eye(4)) for root in roots]
    seen = set()
    while stack:
        index, X_GP = stack.pop()
        if index in seen:
            raise ValueError(f"its nodes are no tree: two lead to {index}")
        seen.add(index)
        node = _find(gltf, "nodes", index)
        X_GN = X_GP @ _calc_node_transform(node)
        yield node, X_GN
        stack.extend((child, X_GN) for child in node.get("children", []))


def _calc_node_transform(node) -> np.ndarray:
    if "matrix" in node:
        X = _get_numbers(node, "matrix", list(np.eye(4).ravel()))
        X = X.reshape(4, 4).T
        if not np.array_equal(X[3], [0.0, 0.0, 0.0, 1.0]):
            raise ValueError(f"matrix: {node['matrix']} is not affine")
        return X
    X = np.eye(4)
    rotation = _get_numbers(node, "rotation", [0.0, 0.0, 0.0, 1.0])
    length = np.linalg.norm(rotation)
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:
        raise ValueError(
            f"rotation: {node['rotation']} is not a unit quaternion"
        )
    x, y, z, w = rotation / length
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    X[:3, :3] = R * _get_numbers(node, "scale", [1.0, 1.0, 1.0])
    X[:3, 3] = _get_numbers(node, "translation", [0.0, 0.0, 0.0])
    return X


def _read_primitive(gltf, buffers, primitive):
    """Returns vertices, (v, 3), and the indices of corners into them, (n,)."""
    p_NV = _read_accessor(
        gltf, buffers, primitive["attributes"]["POSITION"], "VEC3", _FLOAT
    ).astype(float)
    if "indices" not in primitive:
        return p_NV, np.arange(len(p_NV))
    indices = _read_accessor(
        gltf, buffers, primitive["indices"], "SCALAR", _UNSIGNED
    )[:, 0].astype(np.int64)
    # The vertices of the next primitive come after these.
    if indices.max(initial=-1) >= len(p_NV):
        raise ValueError(
            f"the index {indices.max()} is none of a primitive's"
            f" {len(p_NV)} vertices"
        )
    return p_NV, indices


def _read_accessor(gltf, buffers, index, kind, component_types) -> np.ndarray:
    """Returns an accessor's elements, shape (count, components)."""
    accessor = _find(gltf, "accessors", index)
    if "sparse" in accessor or accessor.get("normalized", False):
        raise ValueError("it has sparse or normalized accessors")
    component_type = accessor["componentType"]
    if accessor["type"] != kind or component_type not in component_types:
        raise ValueError(
            f"an accessor is {accessor['type']} of {component_type}, not"
            f" {kind} of {' or '.join(map(str, component_types))}"
        )
    dtype = np.dtype(component_types[component_type]).newbyteorder("<")
    components = _COMPONENTS[kind]
    count = _get_count(accessor, "count")
    view = _find(gltf, "bufferViews", accessor["bufferView"])
    data = _find({"buffers": buffers}, "buffers", view["buffer"])
    first = _get_count(view, "byteOffset", 0)
    length = _get_count(view, "byteLength")
    if first + length > len(data):
        raise ValueError("a buffer is too short for its bufferView")
    offset = _get_count(accessor, "byteOffset", 0)
    size = components * dtype.itemsize
    stride = _get_count(view, "byteStride", size)
    if stride < size:
        raise ValueError(f"byteStride: {stride} is less than {size} B")
    if count and offset + (count - 1) * stride + size > length:
        raise ValueError("a bufferView is too short for its accessor")
    return np.ndarray(
        (count, components),
        dtype,
        data,
        first + offset,
        (stride, dtype.itemsize),
    )


def _make_faces(indices: np.ndarray, mode: int) -> np.ndarray:
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise ValueError(f"{len(indices)} corners are no whole triangles")
        return indices.reshape(-1, 3)
    if len(indices) < 3:
        raise ValueError(f"{len(indices)} corners are no triangle")
    if mode == _TRIANGLE_FAN:
        return np.column_stack(
            [
                np.full(len(indices) - 2, indices[0]),
                indices[1:-1],
                indices[2:],
            ]
        )
    if mode != _TRIANGLE_STRIP:
        raise ValueError(f"it has primitives of the unknown mode {mode}")
    faces = np.column_stack([indices[:-2], indices[1:-1], indices[2:]])
    faces[1::2] = faces[1::2, ::-1]  # Every second one runs the other way.
    return faces
