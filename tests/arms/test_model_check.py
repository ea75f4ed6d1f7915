"""Broken meshes in models, which Drake's readers do not bear."""

import json
import os

from pydrake.multibody.plant import MultibodyPlant
import pytest

from tofssm_drake.arms.arm_file import add_arm_file, add_workcell_file
from tofssm_drake.errors import UserError

_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
_VTK = (
    "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\n"
    "POINTS 4 double\n0 0 0 1 0 0 0 1 0 0 0 1\n"
    "CELLS 1 5\n4 0 1 2 {}\nCELL_TYPES 1\n10\n"
)


def write_urdf(folder, mesh, kind="collision"):
    path = folder / "arm.urdf"
    path.write_text(
        f'<robot name="arm"><link name="base"><{kind}><geometry>'
        f'<mesh filename="{mesh}"/></geometry></{kind}></link></robot>'
    )
    return path


def write_gltf(folder, uri):
    path = folder / "mesh.gltf"
    path.write_text(
        json.dumps(
            {
                "asset": {"version": "2.0"},
                "buffers": [{"uri": uri, "byteLength": 10}],
            }
        )
    )
    return path


@pytest.mark.parametrize("kind", ["collision", "visual"])
@pytest.mark.parametrize(
    ("face", "line"),
    [
        ("f 1 2 99999999999", "line 4: 'f 1 2 99999999999'"),
        ("f 1 2 -4", "line 4: 'f 1 2 -4'"),
        ("f 1 2 0", "line 4: 'f 1 2 0'"),
        ("v nan 0 0\nf 1 2 3", "line 4: 'v nan 0 0'"),
    ],
)
def test_obj(tmp_path, kind, face, line):
    (tmp_path / "mesh.obj").write_text(_TRIANGLE + face + "\n")
    file = str(write_urdf(tmp_path, "mesh.obj", kind))
    with pytest.raises(UserError) as info:
        add_arm_file(MultibodyPlant(0.0), file)
    assert str(tmp_path / "mesh.obj") in str(info.value)
    assert line in str(info.value)
    with pytest.raises(UserError, match="line 4"):
        add_workcell_file(MultibodyPlant(0.0), file)


@pytest.mark.parametrize("corner", [4, -1, 99999999999])
def test_vtk(tmp_path, corner):
    (tmp_path / "mesh.vtk").write_text(_VTK.format(corner))
    file = str(write_urdf(tmp_path, "mesh.vtk"))
    with pytest.raises(UserError, match=f"mesh.vtk: a cell has .* {corner}"):
        add_arm_file(MultibodyPlant(0.0), file)


def test_gltf_outside_its_folder(tmp_path):
    os.mkfifo(tmp_path / "pipe.bin")
    for uri, problem in (
        ("../secret.bin", "'../secret.bin' is outside of its folder"),
        ("/etc/passwd", "'/etc/passwd' is outside of its folder"),
        ("/dev/zero", "'/dev/zero' is outside of its folder"),
        ("pipe.bin", "not a regular file"),
        ("missing.bin", "No such file"),
    ):
        mesh = write_gltf(tmp_path, uri)
        file = str(write_urdf(tmp_path, mesh.name, "visual"))
        with pytest.raises(UserError) as info:
            add_arm_file(MultibodyPlant(0.0), file)
        assert problem in str(info.value)
        assert str(mesh) in str(info.value)


def test_meshes_of_included_models_are_checked(tmp_path):
    (tmp_path / "mesh.obj").write_text(_TRIANGLE + "f 1 2 9\n")
    urdf = write_urdf(tmp_path, "mesh.obj")
    directives = tmp_path / "cell.dmd.yaml"
    directives.write_text(
        f"directives:\n- add_model:\n    name: a\n    file: file://{urdf}\n"
    )
    with pytest.raises(UserError, match=r"cell.dmd.yaml: mesh .*mesh.obj"):
        add_workcell_file(MultibodyPlant(0.0), str(directives))


def test_mjcf_with_a_folder_of_meshes(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "m.obj").write_text(_TRIANGLE + "f 1 2 9\n")
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="m" '
        'file="m.obj"/></asset><worldbody><body><geom type="mesh" mesh="m"/>'
        "</body></worldbody></mujoco>"
    )
    with pytest.raises(UserError, match=r"m\.obj: line 4"):
        add_arm_file(MultibodyPlant(0.0), str(path))


def test_entities_in_a_model(tmp_path):
    """A thousand million laughs, and another file's contents."""
    names = "".join(
        f'<!ENTITY a{i} "{10 * f"&a{i - 1};"}">' for i in range(1, 11)
    )
    for first in ('"aaa"', 'SYSTEM "/etc/passwd"'):
        path = tmp_path / "arm.urdf"
        path.write_text(
            f"<!DOCTYPE robot [<!ENTITY a0 {first}>{names}]>"
            '<robot name="&a10;"><link name="base"/></robot>'
        )
        with pytest.raises(UserError, match=r"arm\.urdf") as info:
            add_arm_file(MultibodyPlant(0.0), str(path))
        assert "\n" not in str(info.value)
