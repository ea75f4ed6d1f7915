"""What in a glTF file refers to something else is checked."""

import json
import os
from pathlib import Path

from parsers import DATA_URI, make_gltf
from pydrake.geometry import Mesh
import pytest

from tofssm_drake.raycast.triangle_mesh import check_mesh_file

_MATERIAL = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}


def make(folder, change=lambda gltf: None):
    """Returns a mesh of one triangle with a picture, changed."""
    gltf = json.loads(make_gltf(DATA_URI))
    gltf["images"] = [{"uri": "picture.png"}]
    gltf["textures"] = [{"source": 0}]
    gltf["materials"] = [_MATERIAL]
    gltf["meshes"][0]["primitives"][0]["material"] = 0
    change(gltf)
    (folder / "picture.png").write_bytes(b"")
    path = folder / "mesh.gltf"
    path.write_text(json.dumps(gltf))
    return Mesh(str(path))


def test_a_picture_beside_it_is_right(tmp_path):
    check_mesh_file(make(tmp_path))


def set_primitive(**values):
    return lambda gltf: gltf["meshes"][0]["primitives"][0].update(values)


def set_top(**values):
    return lambda gltf: gltf.update(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        # These two ended the process in Drake's reader.
        (set_primitive(material=99), r"\.material: 99 is not one of 1"),
        (
            set_primitive(attributes={"POSITION": 0, "NORMAL": 55}),
            r"attributes\.NORMAL: 55 is not one of 1",
        ),
        (set_primitive(targets=[{"POSITION": 999}]), "a rigid mesh cannot"),
        (set_top(skins=[{"joints": [55]}]), "skins, which a rigid mesh"),
        (set_top(animations=[{}]), "animations, which a rigid mesh cannot"),
        (set_top(nodes=[{"mesh": 0, "camera": 5}]), r"camera: 5 is not one"),
        (set_top(textures=[]), r"baseColorTexture\.index: 0 is not one of 0"),
        (set_top(images=[]), r"textures\[0\]\.source: 0 is not one of 0"),
        (set_top(images=[{"bufferView": 9}]), r"bufferView: 9 is not one of 1"),
        # The viewer read this without end.
        (set_top(images=[{"uri": "/dev/zero"}]), "outside of its folder"),
        (set_top(images=[{"uri": "../a.png"}]), "outside of its folder"),
        (set_top(images=[{"uri": "fifo"}]), "fifo: it is not a regular file"),
        (set_top(extensionsUsed=["KHR_lights_punctual"]), "the extension KHR"),
        (
            lambda gltf: gltf["accessors"].append({"count": 1}),
            "componentType",
        ),
        (
            lambda gltf: gltf["accessors"].append(
                gltf["accessors"][0] | {"count": 4}
            ),
            r"accessors\[1\]: its bufferView is too short",
        ),
    ],
)
def test_references_that_lead_nowhere(tmp_path, change, message):
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(ValueError, match=message):
        check_mesh_file(make(tmp_path, change))


@pytest.mark.parametrize(
    ("library", "materials", "message"),
    [
        ("/dev/zero", "", "outside of its folder"),
        ("../secret.mtl", "", "outside of its folder"),
        ("fifo", "", "fifo: it is not a regular file"),
        ("a.mtl", "map_Kd /dev/zero", "outside of its folder"),
        ("a.mtl", "map_Kd -s 1 1 1 fifo", "fifo: it is not a regular file"),
        ("a.mtl", "map_Kd gone.png", ""),
        ("gone.mtl", "", ""),
    ],
)
def test_materials_of_an_obj(tmp_path, library, materials, message):
    os.mkfifo(tmp_path / "fifo")
    Path(tmp_path / "a.mtl").write_text(f"newmtl a\n{materials}\n")
    path = tmp_path / "mesh.obj"
    path.write_text(f"mtllib {library}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    if not message:
        check_mesh_file(Mesh(str(path)))
        return
    with pytest.raises(ValueError, match=message):
        check_mesh_file(Mesh(str(path)))
