"""Complete runs, made once for all tests that look at them."""

import functools

import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.evaluation.metrics import calc_summary


@functools.cache
def run_scenario(name="Default", text=""):
    """Runs a scenario to its end; returns its samples and its summary."""
    scenario = load_scenario(name=name, text=text)
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    while not run.advance().finished:
        pass
    samples = run.make_samples()
    return samples, calc_summary(samples, products=scenario.program.products)


@pytest.fixture(scope="session")
def run():
    return run_scenario
