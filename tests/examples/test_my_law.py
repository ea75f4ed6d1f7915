"""A law of one's own, from the scenario to the report."""

import dataclasses as dc
import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from tofssm_drake.diagrams.scenario import (
    dump_scenario,
    load_scenario,
)
from tofssm_drake.errors import UserError
from tofssm_drake.laws.custom_law import Custom, make_unknown_separations
from tofssm_drake.messages import RobotState, make_empty_separation
from tofssm_drake.recording.samples import read_samples
from tofssm_drake.scripts.main import run

ROOT = Path(__file__).parents[2]
FILE = ROOT / "examples" / "my_law.yaml"


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture
def my_law(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    return importlib.import_module("examples.my_law")


def make_separation(distance, **changes):
    m = len(distance)
    links = tuple("abcdef"[:m])
    return dc.replace(
        make_empty_separation(links),
        **{
            "sequence": np.zeros(m, dtype=int),
            "time": np.zeros(m),
            "distance": np.array(distance),
            "health": np.zeros(m, dtype=int),
        }
        | changes,
    )


@pytest.mark.parametrize(
    ("distance", "target", "link"),
    [
        ((np.inf, 1.2), 1.0, ""),
        ((np.inf, 0.9), 0.5, "b"),
        ((0.75, 0.9), 0.25, "a"),
        ((0.6, 2.0), 0.0, "a"),
        ((2.0, 0.1), 0.0, "b"),
    ],
)
def test_worked_numbers(my_law, distance, target, link):
    decision = my_law.decide(make_separation(distance), 0.0, 0.6, 1.2)
    assert decision.target == pytest.approx(target, abs=1e-12)
    assert decision.link == link
    np.testing.assert_allclose(
        decision.signal["margin"], np.array(distance) - 0.6
    )


def test_unknown_is_slow_or_stopped(my_law):
    for case, separation in make_unknown_separations(("a", "b")):
        decision = my_law.decide(separation, 0.0, 0.6, 1.2)
        assert decision.safe_target <= 0.3, case
        assert decision.link == "b" or decision.reason.startswith("stop: ")
    old = make_separation((2.0, 2.0))
    assert my_law.decide(old, 0.11, 0.6, 1.2).target == 0.0


@pytest.mark.parametrize(
    "changed", ["stop: 1.2", "stop: 1.5", "slow: 1.0e+300"]
)
def test_distances_in_the_wrong_order_are_refused(changed):
    text = f"{{law: {{parameters: {{{changed}}}}}}}"
    with pytest.raises(UserError, match=r"law: .*must be below slow"):
        load_scenario(filename=FILE, text=text)


def test_scenario_survives_a_dump():
    scenario = load_scenario(filename=FILE)
    assert scenario.law == Custom(
        factory="examples.my_law:MyLaw",
        parameters={"stop": 0.6, "slow": 1.2},
    )
    values = dump_scenario(scenario)
    assert values["law"]["kind"] == "Custom"
    assert load_scenario(text=json.dumps(values)) == scenario


def test_run_and_its_report(tmp_path):
    options = ["--duration", "3", "--no-recording", "--out", str(tmp_path)]
    assert run(["simulate", "--scenario-file", str(FILE), *options]) == 0
    samples = read_samples(tmp_path)
    margin = samples.ring("margin")
    measured = samples.ring("measured_distance")
    known = np.isfinite(measured)
    np.testing.assert_allclose(margin[known], measured[known] - 0.6)
    assert "base_d_C" not in samples
    target = samples["target_fraction"]
    assert ((target > 0.0) & (target < 1.0)).sum() > 10
    np.testing.assert_array_equal(
        samples["robot_state"],
        np.where(
            target == 0.0,
            RobotState.STOP,
            np.where(target == 1.0, RobotState.NORMAL, RobotState.REDUCED),
        ),
    )
    report = (tmp_path / "report.html").read_text()
    assert "Nearer is slower" in report
    assert "What the law made of it" in report
