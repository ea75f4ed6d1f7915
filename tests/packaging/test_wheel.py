"""The wheel holds all it needs and works from any folder."""

import os
from pathlib import Path
import shutil
import subprocess
import sys
import zipfile

import pytest

_ROOT = Path(__file__).parents[2]
_SOURCES = ("tofssm_drake", "diagrams", "models", "scripts")

_USE = """
import importlib.resources
import sys
import tofssm_drake.scripts.main
from tofssm_drake.diagrams.scenario import load_scenario, list_scenarios
from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.ur_data import list_ur_models
from pydrake.geometry import SceneGraph

assert tofssm_drake.__file__.startswith(sys.argv[1]), tofssm_drake.__file__
assert len(list_scenarios()) > 3
assert len(list_ur_models()) == 9
scenario = load_scenario()
for name in ("Default", "SixteenSensors"):
    plant = make_cell_plant(
        sensors=load_scenario(name=name).sensors,
        products=scenario.task.num_objects,
        scene_graph=SceneGraph(),
    )
    print(plant.num_bodies(), plant.num_positions())
assert tofssm_drake.scripts.main.run(["simulate", "--help"]) == 0
assert tofssm_drake.scripts.main.run(["simulated-ur", "--help"]) == 0
watchdog = importlib.resources.files("tofssm_drake.rtde")
assert (watchdog / "tofssm_watchdog.script").is_file()
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Builds the wheel of a clean copy, so that nothing old gets into it."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info", "*.pyc")
    for name in _SOURCES:
        shutil.copytree(_ROOT / name, source / name, ignore=ignore)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(_ROOT / name, source / name)
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "--disable-pip-version-check"),
            *("wheel", "--quiet", "--no-deps", "--no-build-isolation"),
            *("--no-index", "--wheel-dir", folder, source),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    # As it says of folders that are not named in pyproject.toml.
    assert "absent from" not in done.stdout + done.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_everything_is_inside(wheel):
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    expected = set()
    for name in _SOURCES:
        package = name if name == "tofssm_drake" else f"tofssm_drake/{name}"
        for path in (_ROOT / name).rglob("*"):
            if (
                path.is_file()
                and "__pycache__" not in path.parts
                # Shell scripts serve the checkout only.
                and path.suffix not in (".pyc", ".sh")
            ):
                expected.add(
                    f"{package}/{path.relative_to(_ROOT / name).as_posix()}"
                )
    for kind in (".urdf", ".sdf", ".yaml", ".xml", ".jinja", ".py"):
        assert any(name.endswith(kind) for name in expected), kind
    assert expected - inside == set()
    others = {name for name in inside - expected if ".dist-info/" not in name}
    assert others == set()


def test_it_works_from_another_folder(wheel, tmp_path):
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", _USE, site],
        cwd=elsewhere,
        env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "--scenario-name" in done.stdout
    assert list(elsewhere.iterdir()) == []


def test_it_tells_what_it_is(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (n for n in names if n.endswith(".dist-info/METADATA"))
        (points,) = (n for n in names if n.endswith("entry_points.txt"))
        text = archive.read(metadata).decode()
        assert "Name: tofssm-drake" in text
        assert "License-Expression: BSD-3-Clause" in text
        assert (
            "tofssm = tofssm_drake.scripts.main:main"
            in archive.read(points).decode()
        )
        assert any(n.endswith("licenses/LICENSE") for n in names)
