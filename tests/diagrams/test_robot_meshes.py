"""The setting `robot_meshes` reaches the world and the monitor's twin."""

import importlib.metadata

from pydrake.geometry import Mesh, Role

import tofssm_drake.arms.meshes as meshes
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.diagrams.workcell import make_workcell
import tofssm_drake.scripts.main as main


def count_meshes(scenario):
    inspector = make_station(scenario).scene_graph.model_inspector()
    return sum(
        isinstance(inspector.GetShape(geometry_id), Mesh)
        for geometry_id in inspector.GetAllGeometryIds(Role.kPerception)
    )


def test_the_world_has_the_real_surfaces_if_asked_for():
    assert count_meshes(load_scenario()) == 0
    text = "{robot_meshes: true}"
    assert count_meshes(load_scenario(text=text)) >= 7


def test_the_mask_knows_them_too():
    """With nobody there, every reading of the robot's surface is masked.

    A twin of capsules would fail: they stand out by centimetres.
    """
    scenario = load_scenario(
        name="NoHuman",
        text="{robot_meshes: true, simulation_duration: 4.0}",
    )
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    while not run.advance().finished:
        pass
    samples = run.make_samples()
    for ring in samples.rings:
        assert samples[f"{ring}_valid"].max() == 0
        assert samples[f"{ring}_masked"].max() > 0


def test_without_the_extra_it_says_what_to_install(
    monkeypatch, capfd, tmp_path
):
    def find_none(name):
        raise importlib.metadata.PackageNotFoundError(name)

    meshes.find_ur10_urdf.cache_clear()
    monkeypatch.setattr(importlib.metadata, "files", find_none)
    check_told(capfd, tmp_path / "out")


def check_told(capfd, out):
    meshes._find_mesh_files.cache_clear()
    code = main.run(
        [
            *("simulate", "--no-recording", "--out", str(out)),
            *("--scenario-text", "{robot_meshes: true}"),
        ]
    )
    assert code == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "robot_meshes" in line
    assert "tofssm-drake[meshes]" in line
    assert not out.exists()
