"""Checks everything in a glTF file that refers to something else.

Sensors see triangles only, but Drake's viewers read the whole file, and end the
process where an index is out of range.
"""

from collections.abc import Callable, Iterator
from typing import Any

_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
"""Bytes of a component (specification 2.0, section 3.6.2.2)."""
_COMPONENTS = {
    "SCALAR": 1,
    "VEC2": 2,
    "VEC3": 3,
    "VEC4": 4,
    "MAT2": 4,
    "MAT3": 9,
    "MAT4": 16,
}
_TEXTURES = (
    "pbrMetallicRoughness.baseColorTexture",
    "pbrMetallicRoughness.metallicRoughnessTexture",
    "normalTexture",
    "occlusionTexture",
    "emissiveTexture",
)
# What is an index of what. [] stands for each of a list, * for each value.
_REFERENCES = (
    ("scene", "scenes"),
    ("scenes[].nodes[]", "nodes"),
    ("nodes[].children[]", "nodes"),
    ("nodes[].mesh", "meshes"),
    ("nodes[].camera", "cameras"),
    ("meshes[].primitives[].attributes.*", "accessors"),
    ("meshes[].primitives[].indices", "accessors"),
    ("meshes[].primitives[].material", "materials"),
    *((f"materials[].{texture}.index", "textures") for texture in _TEXTURES),
    ("textures[].source", "images"),
    ("textures[].sampler", "samplers"),
    ("images[].bufferView", "bufferViews"),
    ("accessors[].bufferView", "bufferViews"),
    ("bufferViews[].buffer", "buffers"),
)
# What a rigid body cannot have, and viewers would act upon.
_NOT_RIGID = (
    "skins",
    "animations",
    "nodes[].skin",
    "meshes[].primitives[].targets",
)
# Extensions only change how a surface looks; these refer to more.
_UNCHECKED = "EXT_", "KHR_draco", "KHR_lights", "MSFT_", "KHR_texture_basisu"


def check_references(gltf: Any, load: Callable[[str], bytes]) -> None:
    """Checks a file of which the triangles have been read.

    Args:
        gltf: The decoded JSON.
        load: Returns the contents of another file by its uri.

    Raises:
        ValueError, LookupError, AttributeError, TypeError, OSError: A
            reference leads nowhere, a file cannot be loaded, or there is
            something that the mesh of a rigid body cannot have.
    """
    for path in _NOT_RIGID:
        if any(value for _, value in _find(gltf, path)):
            raise ValueError(f"it has {path}, which a rigid mesh cannot have")
    for name in gltf.get("extensionsUsed", []):
        if str(name).startswith(_UNCHECKED):
            raise ValueError(f"it uses the extension {name}")
    for path, kind in _REFERENCES:
        count = len(gltf.get(kind, []))
        for where, index in _find(gltf, path):
            if type(index) is not int or not 0 <= index < count:
                raise ValueError(f"{where}: {index!r} is not one of {count}")
    for where, view in _find(gltf, "bufferViews[]"):
        _check_view(where, view, gltf["buffers"])
    for where, accessor in _find(gltf, "accessors[]"):
        _check_accessor(where, accessor, gltf)
    for where, attributes in _find(gltf, "meshes[].primitives[].attributes"):
        counts = {gltf["accessors"][i]["count"] for i in attributes.values()}
        if len(counts) > 1:
            raise ValueError(f"{where}: they differ in number")
    for _, uri in _find(gltf, "images[].uri"):
        if not uri.startswith("data:"):
            load(uri)


def _find(value: Any, path: str, where: str = "") -> Iterator[tuple[str, Any]]:
    """Yields what is at a path, with its own path; what is not there is not."""
    if not path:
        yield where, value
        return
    step, _, rest = path.partition(".")
    key = step.removesuffix("[]")
    here = f"{where}.{key}" if where else key
    if key == "*":
        for name, child in value.items():
            yield from _find(child, rest, f"{where}.{name}")
    elif key in value and key == step:
        yield from _find(value[key], rest, here)
    elif key in value:
        for i, child in enumerate(value[key]):
            yield from _find(child, rest, f"{here}[{i}]")


def _check_view(where, view, buffers):
    first = _get_count(where, view, "byteOffset", 0)
    end = first + _get_count(where, view, "byteLength")
    if end > _get_count(where, buffers[view["buffer"]], "byteLength"):
        raise ValueError(f"{where}: its buffer is too short for it")


def _check_accessor(where, accessor, gltf):
    if "sparse" in accessor:
        raise ValueError(f"{where}: is sparse")
    size = _SIZES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
    count = _get_count(where, accessor, "count")
    if "bufferView" not in accessor:
        raise ValueError(f"{where}: has no bufferView")
    view = gltf["bufferViews"][accessor["bufferView"]]
    stride = _get_count(where, view, "byteStride", size) or size
    first = _get_count(where, accessor, "byteOffset", 0)
    if stride < size:
        raise ValueError(f"{where}: byteStride {stride} is less than {size} B")
    if count and first + (count - 1) * stride + size > view["byteLength"]:
        raise ValueError(f"{where}: its bufferView is too short for it")


def _get_count(where, entry, key, default=None):
    count = entry.get(key, default)
    if type(count) is not int or count < 0:
        raise ValueError(f"{where}.{key}: {count!r} is not a whole number >= 0")
    return count
