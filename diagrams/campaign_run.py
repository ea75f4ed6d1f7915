"""Makes and executes one run of a campaign, on any machine."""

from collections.abc import Iterator, Mapping
import contextlib
import copy
import dataclasses as dc
from pathlib import Path
import tempfile

from tofssm_drake.diagrams.people import Person
from tofssm_drake.diagrams.run_metadata import describe_scenario
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.metrics.audit import calc_audit
from tofssm_drake.metrics.run_metrics import calc_run_metrics
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.custom_motion import CustomMotion
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.recording.samples import write_samples
from tofssm_drake.studies.campaign import PlannedRun
from tofssm_drake.studies.results import make_row
from tofssm_drake.studies.trials import Trial, make_trial


@dc.dataclass(frozen=True, kw_only=True)
class Outcome:
    """Results of a run."""

    row: dict
    files: dict[str, bytes]
    """Contents by file name."""
    simulated: float
    """Simulated time, s."""


def make_run_scenario(
    cell: Scenario, trial: Trial | None, motion: str | None = None
) -> Scenario:
    """Returns the scenario of one run of a campaign.

    Args:
        cell: The scenario of the cell; not changed.
        trial: None: nobody is there.
        motion: File name of the recording to replay instead of the people's
            own gait; it keeps its own speed and stature.
    """
    scenario = copy.deepcopy(cell)
    if trial is None:
        scenario.people = {}
        return scenario
    scenario.random_seed = trial.seed
    scenario.people = {
        name: vary_person(
            person, make_trial(trial.seed, i) if i else trial, motion
        )
        for i, (name, person) in enumerate(scenario.people.items())
    }
    return scenario


def vary_person(
    person: Person, trial: Trial, motion: str | None = None
) -> Person:
    """Returns a person as a trial has it.

    A walk gets the trial's speed, stature and way. A recording gets the way;
    it keeps its speed and stature. A motion of one's own gets the trial's seed
    if it has a parameter `seed`. Anybody else stays as they are.

    Args:
        person: Of the scenario; not changed.
        trial: Who walks how.
        motion: See `make_run_scenario`.
    """
    if isinstance(person, CustomMotion):
        parameters = dict(person.parameters)
        if "seed" in parameters:
            parameters["seed"] = float(trial.seed)
        return dc.replace(person, parameters=parameters)
    if not isinstance(person, GeneratedWalk | BvhRecording):
        return person
    path = copy.deepcopy(person.figure_eight)
    path.start = trial.start
    path.reverse = trial.reverse
    path.centre = [
        c + shift for c, shift in zip(path.centre, trial.centre, strict=True)
    ]
    path.half_length *= trial.half_length
    path.half_width *= trial.half_width
    if motion is not None:
        return BvhRecording(filename=motion, figure_eight=path)
    if isinstance(person, BvhRecording):
        return dc.replace(person, figure_eight=path)
    return dc.replace(
        person, speed=trial.speed, stature=trial.stature, figure_eight=path
    )


def execute(
    cell: Scenario,
    run: PlannedRun,
    motion: str | None = None,
    recordings: Mapping[str, bytes] | None = None,
) -> Outcome:
    """Runs one run of a campaign to its end.

    It neither needs files of the calling machine nor leaves any.

    Args:
        cell: See `make_run_scenario`.
        run: Cell and trial.
        motion: See `make_run_scenario`.
        recordings: Contents of the recordings that are replayed, by file name.
    """
    scenario = make_run_scenario(cell, run.trial, motion)
    scenario.check()
    with tempfile.TemporaryDirectory(prefix="tofssm-") as folder:
        with _place_recordings(scenario, recordings or {}, Path(folder)):
            simulation = Run(
                workcell=make_workcell(scenario), scenario=scenario
            )
            progress = simulation.advance()
            while not progress.finished:
                progress = simulation.advance()
            samples = simulation.make_samples()
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


@contextlib.contextmanager
def _place_recordings(
    scenario: Scenario, recordings: Mapping[str, bytes], folder: Path
) -> Iterator[None]:
    """Lets people replay copies of their recordings; names are put back.

    The paths on this machine are of no use elsewhere.
    """
    moved = []
    for i, person in enumerate(scenario.people.values()):
        if isinstance(person, BvhRecording):
            path = folder / f"{i}_{Path(person.filename).name}"
            path.write_bytes(recordings[person.filename])
            moved.append((person, person.filename))
            person.filename = str(path)
    try:
        yield
    finally:
        for recording, filename in moved:
            recording.filename = filename
