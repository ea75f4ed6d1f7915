"""Every shipped example runs."""

import importlib
from pathlib import Path
import struct

import numpy as np
from pydrake.lcm import DrakeLcm
import pytest

from tofssm_drake.diagrams.scenario import list_scenarios, load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.metrics.run_metrics import calc_run_metrics
from tofssm_drake.recording.samples import write_samples

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(ROOT)


def run(file, name, text=""):
    scenario = load_scenario(
        filename=Path("examples") / file, name=name, text=text
    )
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    while not (progress := run.advance()).finished:
        pass
    return run.make_samples(), progress


ALONE = "{simulation_duration: 14.0, people: {visitor: null}}"


@pytest.mark.long
def test_my_arm_ur5e():
    """Two rings and a lidar on a UR5e; nobody is there, nothing stops it."""
    samples, progress = run("my_arm.yaml", "UR5e", ALONE)
    assert samples.rings == ("upper_arm", "forearm", "low")
    assert progress.steps_done == 1
    assert (samples["robot_state"][samples["t"] > 0.2] == 2).all()


@pytest.mark.long
def test_my_arm_panda():
    """Seven joints from a public description, from waypoint to waypoint."""
    samples, progress = run("my_arm.yaml", "Panda", ALONE)
    assert progress.finished
    assert progress.time < 14.0
    assert "q_6" in samples
    assert np.ptp(samples["q_0"]) == pytest.approx(1.6, abs=0.01)
    assert (samples["robot_state"][samples["t"] > 0.2] == 2).all()


@pytest.mark.parametrize("name", ["UR5e", "Panda"])
def test_my_arm_stops_for_a_person(name):
    """Somebody stands in reach of the arm."""
    text = """{simulation_duration: 3.0, people: {visitor: !CustomMotion {
        factory: "examples.my_person:sway",
        parameters: {distance: 0.75, swing: 0.0}}}}"""
    samples, _ = run("my_arm.yaml", name, text)
    assert samples["robot_state"].min() == 0
    assert samples["robot_state"][-1] < 2


def test_my_sensor():
    """Nobody is there: a ring of one's own does not stop the robot."""
    text = "{simulation_duration: 4.0, people: {visitor: null}}"
    samples, _ = run("my_sensor.yaml", "Default", text)
    assert samples.rings == ("base", "elbow")
    assert (samples["robot_state"][samples["t"] > 0.2] == 2).all()


def test_my_sensor_measures():
    sensor = importlib.import_module("examples.my_sensor").Ultrasonic()
    n = 20000
    generator = np.random.default_rng(0)
    distance, status = sensor.measure(
        np.full((n, 1), 1.0),
        generator.standard_normal((n, 1)),
        generator.standard_normal((n, 1)),
    )
    assert (status == 0).all()
    assert distance.mean() == pytest.approx(1.0, abs=1e-3)
    assert np.abs(distance - 1.0).max() < sensor.traits.tolerance
    _, status = sensor.measure(
        np.full((1, 1), np.inf), np.zeros((1, 1)), np.zeros((1, 1))
    )
    assert status[0] == 2


@pytest.mark.long
def test_rings_and_lidar():
    """Three sensors, two ring models: nobody is there, nothing stops it."""
    samples, progress = run("rings_and_lidar.yaml", "Default", ALONE)
    assert samples.rings == ("upper_arm", "forearm", "low")
    assert progress.steps_done == 1
    assert (samples["robot_state"][samples["t"] > 0.2] == 2).all()


def test_rings_and_lidar_stop_for_a_person():
    text = """{simulation_duration: 3.0, people: {visitor: !CustomMotion {
        factory: "examples.my_person:sway",
        parameters: {distance: 0.75, swing: 0.0}}}}"""
    samples, _ = run("rings_and_lidar.yaml", "Default", text)
    assert samples["robot_state"].min() == 0
    seen = samples.ring("measured_distance")
    # The narrow beams and the lidar see somebody, each in its own way.
    assert np.isfinite(seen[:, 1:]).any(axis=0).all()


def test_my_person():
    samples, _ = run("my_person.yaml", "Sway", "{simulation_duration: 2.0}")
    assert np.ptp(samples["person_y"]) == pytest.approx(0.5, abs=0.02)
    # The landmarks' mean is there; the pelvis is a little behind it.
    assert samples["person_x"].mean() == pytest.approx(1.24, abs=0.01)


def test_publish_fraction():
    example = importlib.import_module("examples.publish_fraction")
    lcm = DrakeLcm("memq://")
    received = []
    lcm.Subscribe(channel="SPEED_FRACTION", handler=received.append)
    last = example.run(duration=1.0, lcm=lcm)
    while lcm.HandleSubscriptions(0):
        pass
    times, fractions = zip(
        *(struct.unpack(">dd", message) for message in received), strict=True
    )
    np.testing.assert_allclose(np.diff(times), 0.04, atol=1e-9)
    assert fractions[0] == 0.0
    assert max(fractions) <= 1.0
    assert last == pytest.approx(fractions[-1], abs=0.2)


def test_cast_rays():
    example = importlib.import_module("examples.cast_rays")
    distances = example.measure()
    assert distances[0] == pytest.approx(1.5)
    assert np.isinf(distances).sum() < len(distances)


def test_read_a_run(tmp_path):
    pytest.importorskip("pandas", reason="of the extra `examples`")
    example = importlib.import_module("examples.read_a_run")
    scenario = load_scenario(text="{simulation_duration: 2.4}")
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    while not run.advance().finished:
        pass
    samples = run.make_samples()
    write_samples(samples, tmp_path)
    table = example.read_run(tmp_path)
    assert table.attrs["unit"]["tcp_speed"] == "m/s"
    stops = example.count_stops(table)
    assert stops.sum() == calc_run_metrics(samples)["stop_events"] > 0
    assert all(reason.startswith("stop: ") for reason in stops.index)
    data = bytearray((tmp_path / "samples.parquet").read_bytes())
    data[2000] ^= 1
    (tmp_path / "samples.parquet").write_bytes(data)
    with pytest.raises(OSError, match="checksum"):
        example.read_run(tmp_path)
    least = example.find_least_distances(table)
    assert list(least.index) == list(samples.rings)
    assert least["true_distance [m]"]["tool"] == pytest.approx(
        samples["tool_true_distance"].min()
    )


def test_all_scenarios_of_examples_load():
    study = Path("examples/my_study.yaml")
    for file in sorted(set(Path("examples").glob("*.yaml")) - {study}):
        for name in list_scenarios(file):
            load_scenario(filename=file, name=name)
