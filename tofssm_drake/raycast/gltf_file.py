"""The triangles of a glTF file.

trimesh reads glTF, too, but silently takes the wrong vertices where an index is
out of range, stretches by rotations that are not unit quaternions and leaves
out triangle fans (version 5.2). A sensor must see exactly the file's surface,
so it is read and checked here.
"""

import base64
from collections.abc import Callable

import numpy as np

from tofssm_drake.user_files import decode_json

_UNSIGNED = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32}
_FLOAT = {5126: np.float32}
_COMPONENTS = {"SCALAR": 1, "VEC3": 3}
_POINTS_AND_LINES = (0, 1, 2, 3)
_TRIANGLES, _TRIANGLE_STRIP, _TRIANGLE_FAN = 4, 5, 6
# Of a rotation's length: files round their numbers.
_UNIT_TOLERANCE = 1e-3


def read_gltf(
    contents: bytes, load: Callable[[str], bytes]
) -> tuple[np.ndarray, np.ndarray]:
    """Reads all triangles of a glTF file's scene (specification 2.0).

    Args:
        contents: Of the file.
        load: Returns the contents of another file by its uri.

    Returns:
        Vertices, (v, 3), with z up, and triangles of indices into them,
        (n, 3).

    Raises:
        ValueError, LookupError, AttributeError, TypeError: If it
            violates the specification, or uses what is not supported.
    """
    gltf = decode_json(contents)
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
    return np.column_stack([x, -z, y]), np.vstack(faces)


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
        raise ValueError(f"{index!r} is not one of its {len(entries)} {kind}")
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
            raise ValueError(f"its nodes are not a tree: two lead to {index}")
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
            f"the index {indices.max()} is not one of a"
            f" primitive's {len(p_NV)} vertices"
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
            raise ValueError(
                f"{len(indices)} corners do not make whole triangles"
            )
        return indices.reshape(-1, 3)
    if len(indices) < 3:
        raise ValueError(f"{len(indices)} corners do not make a triangle")
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
