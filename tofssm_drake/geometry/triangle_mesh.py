"""Triangles of Drake's Mesh shapes, and a bounding volume hierarchy of them.

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
from tofssm_drake.kernels import njit

_LEAF_SIZE = 4
_BINS = 16
# From here on lists are halved, which bounds the stack of a traversal.
_DEEP = 64

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
    """Triangles, sorted into a tree of axis-aligned boxes.

    A row of `nodes` is a box and two whole numbers (first, count). With a
    count it is a leaf and has so many triangles from the first on, else it
    has the nodes first and first + 1 as children. Node 0 is the root.
    """

    triangles: np.ndarray
    """The three corners of each triangle in G, shape (n, 9), m."""
    nodes: np.ndarray
    """Lower and upper corner of the box, m, first, count: shape (., 8). The
    boxes are a trace larger than what they hold."""
    is_closed: bool
    """Whether it bounds a volume, so that a point can be inside."""


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
    corners = vertices[faces]
    order, bounds, links = _build_tree(
        corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1)
    )
    # A ray along a box's face must not be lost to rounding.
    margin = 1e-12 * np.abs(bounds[0]).max()
    bounds += margin * np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    return TriangleMesh(
        triangles=np.ascontiguousarray(corners[order].reshape(-1, 9)),
        nodes=np.hstack([bounds, links]),
        is_closed=is_closed(vertices, faces),
    )


def is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Returns whether a surface has an inside.

    That is so if every edge is shared by equally many triangles that run
    along it in either direction. Vertices at the same place count as one,
    since files repeat them where a surface has a crease.
    """
    places = np.unique(vertices + 0.0, axis=0, return_inverse=True)[1]
    corners = places.reshape(-1)[faces]
    # A triangle that is only a line or point bounds nothing.
    real = (
        (corners[:, 0] != corners[:, 1])
        & (corners[:, 1] != corners[:, 2])
        & (corners[:, 2] != corners[:, 0])
    )
    corners = corners[real]
    if len(corners) == 0:
        return False
    edges = np.vstack([corners[:, [i, (i + 1) % 3]] for i in range(3)])
    sign = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    key = np.sort(edges, axis=1) @ np.array([len(vertices), 1])
    _, edge = np.unique(key, return_inverse=True)
    return not np.bincount(edge.reshape(-1), weights=sign).any()


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
            vertices.append(p_NV @ X_GN[:3, :3].T + X_GN[:3, 3])
            faces.append(_make_faces(indices, mode) + count)
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
    while stack:
        index, X_GP = stack.pop()
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


@njit(cache=True, error_model="numpy")
def _half_area(low, high):
    x, y, z = high[0] - low[0], high[1] - low[1], high[2] - low[2]
    return x * y + y * z + z * x


@njit(cache=True, error_model="numpy")
def _find_split(low, high, centre, order, start, end):
    """Returns (axis, plane) of the cheapest split, axis -1 if there is none.

    The surface area heuristic over equal bins of the triangles' centres.
    """
    best_axis, best_plane, best_cost = -1, 0.0, np.inf
    for axis in range(3):
        first, last = np.inf, -np.inf
        for i in range(start, end):
            first = min(first, centre[order[i], axis])
            last = max(last, centre[order[i], axis])
        if not last > first:
            continue
        count = np.zeros(_BINS, dtype=np.int64)
        bin_low = np.full((_BINS, 3), np.inf)
        bin_high = np.full((_BINS, 3), -np.inf)
        scale = _BINS / (last - first)
        for i in range(start, end):
            k = order[i]
            b = min(int((centre[k, axis] - first) * scale), _BINS - 1)
            count[b] += 1
            for j in range(3):
                bin_low[b, j] = min(bin_low[b, j], low[k, j])
                bin_high[b, j] = max(bin_high[b, j], high[k, j])
        right = np.full(_BINS, np.inf)
        box_low, box_high = np.full(3, np.inf), np.full(3, -np.inf)
        total = 0
        for b in range(_BINS - 1, 0, -1):
            total += count[b]
            for j in range(3):
                box_low[j] = min(box_low[j], bin_low[b, j])
                box_high[j] = max(box_high[j], bin_high[b, j])
            if total > 0:
                right[b] = total * _half_area(box_low, box_high)
        box_low[:] = np.inf
        box_high[:] = -np.inf
        total = 0
        for b in range(_BINS - 1):
            total += count[b]
            for j in range(3):
                box_low[j] = min(box_low[j], bin_low[b, j])
                box_high[j] = max(box_high[j], bin_high[b, j])
            if total == 0:
                continue
            cost = total * _half_area(box_low, box_high) + right[b + 1]
            if cost < best_cost:
                best_axis = axis
                best_plane = first + (b + 1) / scale
                best_cost = cost
    return best_axis, best_plane


@njit(cache=True, error_model="numpy")
def _build_tree(low, high, centre):
    """Returns (order of the triangles, node bounds, node links)."""
    n = low.shape[0]
    order = np.arange(n)
    bounds = np.empty((2 * n, 6))
    links = np.empty((2 * n, 2), dtype=np.int64)
    starts = np.empty(2 * n, dtype=np.int64)
    ends = np.empty(2 * n, dtype=np.int64)
    depth = np.zeros(2 * n, dtype=np.int64)
    starts[0], ends[0] = 0, n
    used = 1
    node = 0
    while node < used:
        start, end = starts[node], ends[node]
        for j in range(3):
            bounds[node, j] = np.inf
            bounds[node, 3 + j] = -np.inf
        for i in range(start, end):
            for j in range(3):
                bounds[node, j] = min(bounds[node, j], low[order[i], j])
                bounds[node, 3 + j] = max(
                    bounds[node, 3 + j], high[order[i], j]
                )
        links[node, 0], links[node, 1] = start, end - start
        if end - start > _LEAF_SIZE:
            axis, plane, middle = -1, 0.0, start
            if depth[node] < _DEEP:
                axis, plane = _find_split(low, high, centre, order, start, end)
            if axis >= 0:
                for i in range(start, end):
                    if centre[order[i], axis] < plane:
                        order[i], order[middle] = order[middle], order[i]
                        middle += 1
            if middle == start or middle == end:
                # No plane parts the centres: halve the list as it is.
                middle = (start + end) // 2
            links[node, 0], links[node, 1] = used, 0
            starts[used], ends[used] = start, middle
            starts[used + 1], ends[used + 1] = middle, end
            depth[used] = depth[used + 1] = depth[node] + 1
            used += 2
        node += 1
    return order, bounds[:used].copy(), links[:used].copy()
