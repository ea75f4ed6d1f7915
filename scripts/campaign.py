"""Runs a campaign: what is missing, in parallel, with a progress bar."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
import dataclasses as dc
import hashlib
from pathlib import Path
import signal
import sys
import time
from typing import Generic

from distributed import Client
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from tofssm_drake.diagrams.campaign_run import execute, make_run_scenario
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.errors import prefix_errors, require
from tofssm_drake.people.bvh import BvhRecording, make_bvh_motion
from tofssm_drake.scripts.cluster import call_all, connect
from tofssm_drake.studies.campaign import CellT, Plan, PlannedRun
from tofssm_drake.studies.campaign_folder import (
    check_folder,
    enter_folder,
    get_scratch,
    lock_folder,
    open_folder,
    read_rows,
    store_run,
)
from tofssm_drake.studies.results import make_results


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Campaign(Generic[CellT]):
    """What to run, and where its results go."""

    out: Path
    """The folder."""
    plan: Plan[CellT]
    scenarios: Mapping[CellT, Scenario]
    """What the runs of each cell have in common."""
    recordings: Mapping[str, bytes]
    """Recordings of people by file name."""
    write_report: Callable[["Campaign", list[dict], dict[str, str]], Path]
    """Writes the tables and the report of the finished runs, given all rows
    and the reason by the label of the run that failed; returns the report's
    path."""
    is_long: Callable[[PlannedRun[CellT]], bool] = lambda run: False
    """Whether a run takes longer than others. Those are made first, so that
    all workers finish at the same time."""

    def check(self) -> None:
        """Raises UserError unless every run can be made."""
        for run in self.plan.list_runs():
            self._make_scenario(run).check(run.key)

    def _make_scenario(self, run):
        motion = self.plan.find_motion(run)
        return make_run_scenario(self.scenarios[run.cell], run.trial, motion)

    def make_call(self, run: PlannedRun[CellT]) -> tuple:
        """Returns the arguments of `execute` for a run."""
        people = self._make_scenario(run).people.values()
        files = [p.filename for p in people if isinstance(p, BvhRecording)]
        return (
            self.scenarios[run.cell],
            run,
            self.plan.find_motion(run),
            {file: self.recordings[file] for file in files},
        )


def run_and_report(
    campaign: Campaign, scheduler: str | None, workers: int | None
) -> int:
    """Makes the runs that are not finished yet, and the report.

    Args:
        campaign: The campaign.
        scheduler: See `connect`.
        workers: See `connect`.

    Returns:
        The exit code.

    Raises:
        UserError: A run cannot be made, or the folder cannot be used.
    """
    campaign.check()
    require(
        workers is None or 1 <= workers <= 1000,
        f"--workers: {workers} must be from 1 to 1000",
    )
    check_folder(campaign.out, campaign.plan)
    try:
        with interrupt_on_sigterm(), lock_folder(campaign.out):
            enter_folder(campaign.out, campaign.plan)
            failures = run_campaign(campaign, scheduler, workers)
            report = write_all(campaign, failures)
    except KeyboardInterrupt:
        print(
            "tofssm: interrupted; run the same command again to continue",
            file=sys.stderr,
        )
        return 130
    return tell(report, failures)


def run_campaign(
    campaign: Campaign, scheduler: str | None, workers: int | None
) -> dict[str, str]:
    """Makes the runs that are not finished yet.

    Args:
        campaign: The campaign.
        scheduler: See `connect`.
        workers: See `connect`.

    Returns:
        What went wrong, by the label of the run.
    """
    out, plan = campaign.out, campaign.plan
    rows = read_rows(out, plan)
    missing = [r for r in plan.list_runs() if r.key not in rows]
    if not missing:
        return {}
    with connect(
        scheduler, workers=workers, scratch=get_scratch(out)
    ) as client:
        open_folder(out, plan)
        return run_missing(client, campaign, missing)


@contextlib.contextmanager
def interrupt_on_sigterm() -> Iterator[None]:
    """Treats SIGTERM as Ctrl-C, so that no half-written file is left."""

    def interrupt(number, frame):
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def write_all(campaign: Campaign, failures: dict[str, str]) -> Path:
    """Writes the table and the report of the finished runs.

    Args:
        campaign: The campaign.
        failures: Reason by the label of the run that failed.

    Returns:
        The report's path.
    """
    with Console(stderr=True).status("writing the report"):
        rows = read_rows(campaign.out, campaign.plan)
        results = make_results(campaign.plan, rows)
        return campaign.write_report(campaign, results, failures)


def read_motions(folder: Path | None, period: float) -> dict[str, bytes]:
    """Returns the recordings in a folder by file name.

    Args:
        folder: None: no recordings.
        period: Control tick, s.

    Raises:
        UserError: There are none, or nobody walks in one of them.
    """
    if folder is None:
        return {}
    require(folder.is_dir(), f"--human-motions: there is no folder {folder}")
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".bvh")
    require(len(paths) > 0, f"--human-motions: no .bvh files are in {folder}")
    for path in paths:
        # Reading a pipe would block.
        require(path.is_file(), f"--human-motions: {path} is not a file")
        with prefix_errors("--human-motions"):
            make_bvh_motion(BvhRecording(filename=str(path)), period)
    return {path.name: path.read_bytes() for path in paths}


def calc_digests(contents: Mapping[str, bytes]) -> dict[str, str]:
    """Returns a digest of each file."""
    return {
        name: hashlib.sha256(content).hexdigest()
        for name, content in contents.items()
    }


def run_missing(
    client: Client, campaign: Campaign, missing: list[PlannedRun]
) -> dict[str, str]:
    """Makes runs and stores each one as it comes.

    Args:
        client: From `connect`.
        campaign: The campaign.
        missing: The runs to do.

    Returns:
        What went wrong, by the label of the run.
    """
    plan = campaign.plan
    total = len(plan.list_runs())
    calls = {
        planned.key: campaign.make_call(planned)
        for planned in sorted(missing, key=lambda r: not campaign.is_long(r))
    }
    by_key = {planned.key: planned for planned in missing}
    failures = {}
    start = time.perf_counter()
    simulated = 0.0
    with make_progress_bar() as bar:
        task = bar.add_task(
            "", total=total, completed=total - len(missing), speed=0.0
        )

        def tell(line):
            bar.console.print(line, markup=False, highlight=False)

        for key, outcome, error in call_all(client, execute, calls, tell=tell):
            planned = by_key[key]
            if error is None:
                store_run(campaign.out, planned, outcome.row, outcome.files)
                simulated += outcome.simulated
            else:
                reason = " ".join(str(error).split()) or type(error).__name__
                failures[planned.label] = reason
                tell(f"failed: {planned.label}: {reason}")
            speed = simulated / (time.perf_counter() - start)
            bar.update(task, advance=1, speed=speed)
    return failures


def make_progress_bar() -> Progress:
    """Returns a progress bar of runs with the time left."""
    return Progress(
        TextColumn("runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]:.0f} simulated s per s"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        speed_estimate_period=600.0,
    )


def tell(report: Path, failures: dict[str, str]) -> int:
    """Prints where the report is; returns the exit code."""
    for label, reason in failures.items():
        print(f"tofssm: failed: {label}: {reason}", file=sys.stderr)
    print(report.resolve())
    return 1 if failures else 0
