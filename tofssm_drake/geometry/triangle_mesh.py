"""Triangles of Drake's Mesh shapes.

Drake's distance queries replace many a mesh by its convex hull. What is seen
along a ray is the surface itself, so it is read here: OBJ and tetrahedral VTK
by Drake's own readers, glTF by a small one.
"""

import base64
import dataclasses as dc
import hashlib
import json
from pathlib import Path
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

_COMPONENT_TYPES = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_POINTS_AND_LINES = (0, 1, 2, 3)
_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN = 4, 5, 6


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
            digest.update(_read_supporting_file(file))
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
    source = mesh.source()
    reader = readers.get(mesh.extension().lower())
    where = f"geometry '{name}': mesh '{source.description()}'"
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


def _read_obj(mesh):
    source = mesh.source()
    if source.is_path():
        surface = ReadObjToTriangleSurfaceMesh(source.path(), mesh.scale3())
    else:
        # Drake's reader takes file names only.
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.obj"
            path.write_bytes(source.in_memory().mesh_file.contents())
            surface = ReadObjToTriangleSurfaceMesh(path, mesh.scale3())
    return _unpack_surface(surface)


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
        contents = Path(source.path()).read_bytes()

        def load(uri):
            return (folder / unquote(uri)).read_bytes()
    else:
        memory = source.in_memory()
        contents = memory.mesh_file.contents()

        def load(uri):
            return _read_supporting_file(memory.supporting_files[uri])

    gltf = json.loads(contents)
    required = gltf.get("extensionsRequired", [])
    if required:
        raise ValueError(f"it needs the extensions {', '.join(required)}")
    buffers = [_load_buffer(buffer, load) for buffer in gltf.get("buffers", [])]
    vertices, faces, count = [], [], 0
    for node, X_GN in _walk_gltf_nodes(gltf):
        if "mesh" not in node:
            continue
        for primitive in gltf["meshes"][node["mesh"]]["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode in _POINTS_AND_LINES:
                continue
            position = primitive["attributes"]["POSITION"]
            p_NV = _read_accessor(gltf, buffers, position).astype(float)
            if "indices" in primitive:
                indices = _read_accessor(gltf, buffers, primitive["indices"])
                indices = indices[:, 0].astype(np.int64)
            else:
                indices = np.arange(len(p_NV))
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
    uri = buffer["uri"]
    if uri.startswith("data:"):
        return base64.b64decode(uri.split(",", 1)[1])
    return load(uri)


def _walk_gltf_nodes(gltf):
    """Yields each node of the scene with its pose and scale, (4, 4)."""
    nodes = gltf.get("nodes", [])
    if "scenes" in gltf:
        roots = gltf["scenes"][gltf.get("scene", 0)].get("nodes", [])
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
        node = nodes[index]
        X_GN = X_GP @ _calc_node_transform(node)
        yield node, X_GN
        stack.extend((child, X_GN) for child in node.get("children", []))


def _calc_node_transform(node) -> np.ndarray:
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(float)
    X = np.eye(4)
    x, y, z, w = node.get("rotation", [0.0, 0.0, 0.0, 1.0])
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    X[:3, :3] = R * np.asarray(node.get("scale", [1.0, 1.0, 1.0]))
    X[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return X


def _read_accessor(gltf, buffers, index) -> np.ndarray:
    """Returns an accessor's elements, shape (count, components)."""
    accessor = gltf["accessors"][index]
    if "sparse" in accessor or accessor.get("normalized", False):
        raise ValueError("it has sparse or normalized accessors")
    dtype = np.dtype(_COMPONENT_TYPES[accessor["componentType"]])
    dtype = dtype.newbyteorder("<")
    components = _COMPONENTS[accessor["type"]]
    count = accessor["count"]
    view = gltf["bufferViews"][accessor["bufferView"]]
    offset = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    size = components * dtype.itemsize
    stride = view.get("byteStride", size)
    data = buffers[view["buffer"]]
    if count and offset + (count - 1) * stride + size > len(data):
        raise ValueError("a buffer is too short")
    return np.ndarray(
        (count, components), dtype, data, offset, (stride, dtype.itemsize)
    )


def _make_faces(indices: np.ndarray, mode: int) -> np.ndarray:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode == _TRIANGLE_FAN:
        return np.column_stack(
            [
                np.full(max(len(indices) - 2, 0), indices[0]),
                indices[1:-1],
                indices[2:],
            ]
        )
    if mode != _TRIANGLE_STRIP:
        raise ValueError(f"it has primitives of the unknown mode {mode}")
    faces = np.column_stack([indices[:-2], indices[1:-1], indices[2:]])
    faces[1::2] = faces[1::2, ::-1]  # Every second one runs the other way.
    return faces
