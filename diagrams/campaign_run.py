"""Makes and executes one run of a campaign, on any machine."""

import copy
import dataclasses as dc
from pathlib import Path
import tempfile

from tofssm_drake.diagrams.run_metadata import describe_scenario
from tofssm_drake.diagrams.scenario import (
    Scenario,
    change_scenario,
    load_scenario,
)
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.errors import UserError
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.metrics.audit import calc_audit
from tofssm_drake.metrics.run_metrics import calc_run_metrics
from tofssm_drake.paper.campaign import VARIANTS, PlannedRun, make_row
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.custom_motion import CustomMotion
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.recording.samples import write_samples


@dc.dataclass(frozen=True, kw_only=True)
class Outcome:
    """Results of a run."""

    row: dict
    files: dict[str, bytes]
    """Contents by file name."""
    simulated: float
    """Simulated time, s."""


def get_tri_ssm(scenario: Scenario, where: str = "law") -> TriSsm:
    """Returns the law, whose configurations a campaign compares.

    Args:
        scenario: The scenario.
        where: Path of keys, for the message.

    Raises:
        UserError: It is another law.
    """
    if not isinstance(scenario.law, TriSsm):
        raise UserError(
            f"{where}: must be !TriSsm, whose configurations the campaign "
            "compares"
        )
    return scenario.law


def make_run_scenario(
    base: Scenario, run: PlannedRun, motion: str | None = None
) -> Scenario:
    """Returns the scenario of one run of a campaign.

    Args:
        base: What all runs have in common; not changed. A generated walk or
            a recording in it sets what the trials do not: the place of the
            figure of eight.
        run: Cell and trial.
        motion: File name of the recording to replay instead of a generated
            walk; it keeps its own speed and stature.
    """
    scenario = copy.deepcopy(base)
    cell, trial = run.cell, run.trial
    get_tri_ssm(scenario).configuration = cell.configuration
    scenario.sensors = _choose_sensors(base, cell.sensing)
    if cell.variant:
        scenario = change_scenario(
            scenario, VARIANTS[cell.variant].changes, source=cell.key
        )
    if trial is None:
        scenario.people = {}
        return scenario
    scenario.random_seed = trial.seed
    ((name, person),) = scenario.people.items()
    if isinstance(person, CustomMotion):
        raise UserError(f"people.{name}: must walk a figure of eight")
    path = copy.deepcopy(person.figure_eight)
    path.start = trial.start
    path.reverse = trial.reverse
    path.centre = [
        c + shift for c, shift in zip(path.centre, trial.centre, strict=True)
    ]
    path.half_length *= trial.half_length
    path.half_width *= trial.half_width
    if motion is None:
        person = GeneratedWalk(
            speed=trial.speed, stature=trial.stature, figure_eight=path
        )
    else:
        person = BvhRecording(filename=motion, figure_eight=path)
    scenario.people = {name: person}
    return scenario


def _choose_sensors(base, sensing):
    """Returns the sensors of a cell.

    The rings are the base's, which may have changed; 16 sensors each if the
    cell says so.
    """
    if sensing == "ideal":
        return load_scenario(name="MotionCapture").sensors
    if sensing == "lidar":
        return load_scenario(name="PlanarLidar").sensors
    sensors = copy.deepcopy(base.sensors)
    if sensing == "tof16":
        for ring in find_rings(sensors).values():
            ring.count = 16
    return sensors


def _set_filename(scenario, filename):
    for person in scenario.people.values():
        if isinstance(person, BvhRecording):
            person.filename = filename


def execute(
    base: Scenario,
    run: PlannedRun,
    motion: tuple[str, bytes] | None = None,
) -> Outcome:
    """Runs one run of a campaign to its end.

    It neither needs files of the calling machine nor leaves any.

    Args:
        base: See `make_run_scenario`.
        run: Cell and trial.
        motion: Name and content of the recording to replay.
    """
    scenario = make_run_scenario(base, run, motion and motion[0])
    scenario.check()
    with tempfile.TemporaryDirectory(prefix="tofssm-") as folder:
        if motion is not None:
            path = Path(folder) / motion[0]
            path.write_bytes(motion[1])
            _set_filename(scenario, str(path))
        workcell = make_workcell(scenario)
        simulation = Run(workcell=workcell, scenario=scenario)
        progress = simulation.advance()
        while not progress.finished:
            progress = simulation.advance()
        samples = simulation.make_samples()
        if motion is not None:
            # The path on this machine is of no use elsewhere.
            _set_filename(scenario, motion[0])
            samples.metadata["scenario"] = describe_scenario(scenario)
        files = {
            path.name: path.read_bytes()
            for path in write_samples(samples, Path(folder))
        }
    metrics = calc_run_metrics(samples)
    audit = calc_audit(samples)
    if audit is not None:
        metrics |= audit.make_row()
    row = make_row(run, metrics)
    return Outcome(row=row, files=files, simulated=progress.time)
