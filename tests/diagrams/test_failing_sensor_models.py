"""What no sensor may say never counts as clear, whoever wrote the model."""

import sys

import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.sensors.range_status import STATUS_VALID

MODULE = "failing_sensor_model"
TEXT = """
from tofssm_drake.sensors.vl53l1x import Vl53l1x

class Failing:
    def __init__(self, distance, status, count):
        self.said, self.count = (float(distance), float(status)), count
        self.model = Vl53l1x()
        self.traits = self.model.traits

    def measure(self, rays, noise, constants):
        distance, status = self.model.measure(rays, noise, constants)
        status = status.astype(float)
        distance[: self.count], status[: self.count] = self.said
        return distance, status
"""
ALONE = """
people: {visitor: null}
simulation_duration: 1.5
sensors:
  base: null
  tool: null
  elbow: {sensor: !CustomSensor {factory: "%s:Failing", parameters: %s}}
"""


@pytest.fixture(autouse=True)
def own_module(tmp_path, monkeypatch):
    (tmp_path / f"{MODULE}.py").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    yield
    sys.modules.pop(MODULE, None)


def run(distance, status, count):
    parameters = (
        f"{{distance: '{distance}', status: '{status}', count: {count}}}"
    )
    scenario = load_scenario(text=ALONE % (MODULE, parameters))
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    while not run.advance().finished:
        pass
    return run.make_samples()


def test_a_good_one_moves():
    """Or the others would prove nothing."""
    samples = run(0.5, STATUS_VALID, 0)
    assert samples["speed_fraction"][-1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("distance", "status"),
    [
        ("nan", 0),  # Valid, but not a distance.
        ("nan", 2),  # "Nothing came back".
        ("0.5", 99),  # Unknown.
        ("0.5", 258),  # 2 in eight bits.
        ("0.5", "nan"),
    ],
)
def test_a_ring_that_says_so_stops(distance, status):
    samples = run(distance, status, 8)
    assert (samples["target_fraction"] == 0.0).all()
    assert samples["speed_fraction"].max() == 0.0


def test_a_single_sensor_that_says_so_stops():
    samples = run("nan", 2, 1)
    late = samples["t"] > 0.5
    assert (samples["target_fraction"][late] == 0.0).all()
