"""STL and COLLADA files, read by trimesh."""

import io
import struct
from xml.etree import ElementTree
from xml.parsers import expat

from collada import Collada
from collada.common import DaeBrokenRefError, DaeError, DaeUnsupportedError
import numpy as np
import trimesh

from tofssm_drake.raycast.mesh_parts import check_corners

# What a COLLADA file may have besides its surface, such as lost textures.
_IGNORED = [DaeBrokenRefError, DaeUnsupportedError]


def read_stl(contents: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices and triangles, as they are in the file.

    Raises:
        ValueError: If it is not an STL file, or not whole.
    """
    _check_stl(contents)
    return _read(contents, "stl")


def _check_stl(contents: bytes) -> None:
    """Checks that a binary file is as long as its number of triangles says."""
    if contents.lstrip()[:5].lower() == b"solid" and b"facet" in contents:
        # It is text.
        return
    if len(contents) < 84:
        raise ValueError("it is neither text nor a whole binary STL file")
    (count,) = struct.unpack_from("<I", contents, 80)
    if len(contents) != 84 + 50 * count:
        raise ValueError(
            f"byte 80: {count} triangles take {84 + 50 * count} bytes, but it "
            f"has {len(contents)}"
        )


def read_dae(contents: bytes) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns vertices and triangles of a COLLADA file, and its unit, m.

    Raises:
        ValueError: If it is not a COLLADA file, or one with broken parts.
    """
    _check_dae(contents)
    return (*_read(contents, "dae"), _find_dae_unit(contents))


def _check_dae(contents: bytes) -> None:
    """Checks vertices and indices: trimesh drops a broken part silently."""
    _refuse_entities(contents)
    try:
        document = Collada(io.BytesIO(contents), ignore=_IGNORED)
    except DaeError as error:
        raise ValueError(f"it is not as its format demands: {error}") from error
    for geometry in document.geometries:
        for primitive in geometry.primitives:
            if primitive.vertex_index is not None:
                check_corners(primitive.vertex, primitive.vertex_index)
    # pycollada takes 0 for NaN.
    for mesh in ElementTree.fromstring(contents).iterfind(".//{*}mesh"):
        inputs = mesh.iterfind("./{*}vertices/{*}input[@semantic='POSITION']")
        for source in [i.get("source", "").removeprefix("#") for i in inputs]:
            numbers = mesh.findtext(
                f"./{{*}}source[@id='{source}']/{{*}}float_array", ""
            )
            if not np.isfinite(np.array(numbers.split(), dtype=float)).all():
                raise ValueError("it has a vertex that is not finite")


def _refuse_entities(contents: bytes) -> None:
    """Refuses what may grow without end, or stand for another file."""

    def refuse(*_):
        raise ValueError(
            f"line {parser.CurrentLineNumber}: it has a DOCTYPE, which may "
            "define entities; remove it"
        )

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(contents, True)
    except expat.ExpatError as error:
        raise ValueError(f"it is not as its format demands: {error}") from error


def _find_dae_unit(contents: bytes) -> float:
    """Returns the length of a COLLADA file's unit, m."""
    unit = ElementTree.fromstring(contents).find("./{*}asset/{*}unit")
    return 1.0 if unit is None else float(unit.get("meter", 1.0))


def _read(contents: bytes, file_type: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        scene = trimesh.load_scene(
            io.BytesIO(contents),
            file_type=file_type,
            process=False,
            maintain_order=True,
        )
        surface = scene.to_mesh()
    except Exception as error:
        # A broken file may raise anything.
        raise ValueError(f"it is not as its format demands: {error}") from error
    return surface.vertices, surface.faces
