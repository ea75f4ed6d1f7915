"""A made-up campaign: rows as a real one has them, at no cost."""

import numpy as np

from tofssm_drake.metrics.audit import calc_audit
from tofssm_drake.metrics.run_metrics import calc_run_metrics
import tofssm_drake.paper.cells as cells
from tofssm_drake.paper.cells import Cell
from tofssm_drake.recording.samples import Samples
from tofssm_drake.studies.campaign import Plan
from tofssm_drake.studies.results import make_row


def make_plan(**changes):
    """Returns a plan of four cells with two trials."""
    options = {
        "seed": 0,
        "trials": 2,
        "sensings": ["tof", "lidar"],
        "configurations": ["vo", "sm"],
        "variants": [],
        "scenario": {"law": {"C_dC": 0.3}},
        "motions": {},
        "versions": {"drake": "1.51.1"},
    }
    return cells.make_plan(**(options | changes))


def make_small_plan(trials=3, *, variants=(), sensings=None) -> Plan:
    return cells.make_plan(
        seed=0,
        trials=trials,
        sensings=list(sensings or ("tof", "ideal", "lidar", "tof16")),
        configurations=["vo", "vr", "sm"],
        variants=list(variants),
        scenario={"random_seed": 0},
        versions={"drake": "1.51.1"},
    )


def make_values(run: Samples) -> dict[str, float]:
    """Returns the metrics of a made-up run, with a made-up audit."""
    metrics = calc_run_metrics(run)
    audit = calc_audit(run)
    return metrics | ({} if audit is None else audit.make_row())


def make_rows(plan: Plan, metrics: dict, change=None) -> dict[str, dict]:
    """Returns rows by key of run.

    Args:
        plan: Of the campaign.
        metrics: Of every run.
        change: Returns what differs, called with cell and trial number.
    """
    rows = {}
    for run in plan.list_runs():
        row = make_row(run, metrics)
        if change is not None and run.trial is not None:
            row |= change(run.cell, run.trial.number)
        rows[run.key] = row
    return rows


def make_means(means: dict[tuple[str, str], float], metric: str):
    """Returns a `change` with means by (sensing, configuration).

    Trials scatter about them by up to 0.02, the same in every cell, and by
    0.001 on their own.
    """

    def change(cell: Cell, trial: int):
        mean = means.get((cell.sensing, cell.configuration), 0.0)
        rng = np.random.default_rng([trial, sum(cell.key.encode())])
        own = 0.001 * rng.uniform(-1, 1)
        return {metric: mean + 0.02 * np.cos(trial) + own}

    return change
