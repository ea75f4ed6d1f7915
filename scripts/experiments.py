"""`tofssm experiments`: the paper's experiment, and its report."""

from collections.abc import Iterator
import contextlib
import copy
import dataclasses as dc
import hashlib
from pathlib import Path
import shlex
import signal
import sys
import time
from typing import Annotated

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
import typer

from tofssm_drake.diagrams.campaign_run import (
    execute,
    get_tri_ssm,
    make_run_scenario,
)
from tofssm_drake.diagrams.run_metadata import get_versions
from tofssm_drake.diagrams.scenario import (
    Scenario,
    dump_scenario,
    find_lidars,
    find_threshold_offsets,
    load_scenario,
)
from tofssm_drake.errors import require
from tofssm_drake.laws.config import CONFIGURATIONS
from tofssm_drake.paper.campaign import (
    SENSINGS,
    VARIANTS,
    Plan,
    PlannedRun,
    enter_folder,
    get_scratch,
    list_studies,
    make_plan,
    make_results,
    open_folder,
    read_rows,
    store_run,
    write_results,
)
from tofssm_drake.paper.campaign_report import write_campaign_report
from tofssm_drake.people.bvh import BvhRecording, make_bvh_motion
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.scripts.cluster import call_all, connect
import tofssm_drake.scripts.options as options


def experiments(
    trials: Annotated[int, typer.Option(help="Trials per cell.")] = 5,
    sensing: Annotated[
        list[str] | None,
        typer.Option(
            help="tof, ideal, lidar or tof16; can be repeated.",
            metavar="NAME",
        ),
    ] = None,
    ssm: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Safety law: {options.SAFETY_LAWS}; can be repeated.",
            metavar="NAME",
        ),
    ] = None,
    study: Annotated[
        list[str] | None,
        typer.Option(
            help="Also run cells with one thing changed, to see its effect: "
            f"all, none, or {', '.join(VARIANTS)}; can be repeated. "
            "Default: literal, if its cells are run.",
            metavar="NAME",
        ),
    ] = None,
    human_motions: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="Folder of BVH recordings; the trials use their gaits in "
            "turn. Default: generated walks.",
            metavar="DIR",
        ),
    ] = None,
    scenario_text: Annotated[
        str,
        typer.Option(help="Settings of all runs, as YAML."),
    ] = "",
    duration: Annotated[
        float, typer.Option(help="Longest simulated time of a run, s.")
    ] = 900.0,
    seed: Annotated[int, typer.Option(help="Seed of all trials.")] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="A Dask scheduler; default: the cores of this machine.",
            metavar="tcp://HOST:8786",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes on this machine; default: its cores."),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            parser=options.parse_path,
            help="Folder for the results; finished runs in it are not "
            "repeated.",
            metavar="DIR",
        ),
    ] = Path("out/experiments"),
) -> int:
    """Run the paper's experiment and write its tables, figures and report."""
    scenario = load_scenario(text=scenario_text)
    scenario.simulation_duration = duration
    require_free(scenario)
    with options.blame({"simulation_duration": "--duration"}):
        scenario.check()
    motions = read_motions(human_motions, scenario)
    sensings = sensing or list(SENSINGS)
    configurations = ssm or list(CONFIGURATIONS)
    studies = choose_studies(study, list_studies(sensings, configurations))
    plan = make_plan(
        seed=seed,
        trials=trials,
        sensings=sensings,
        configurations=configurations,
        variants=studies,
        scenario=dump_scenario(scenario),
        motions={
            name: hashlib.sha256(content).hexdigest()
            for name, content in motions.items()
        },
        versions=get_versions(),
    )
    for planned in plan.list_runs():
        make_run_scenario(scenario, planned).check(planned.key)
    require(
        workers is None or 1 <= workers <= 1000,
        f"--workers: {workers} must be from 1 to 1000",
    )
    campaign = Campaign(out=out, plan=plan, scenario=scenario, motions=motions)
    enter_folder(out, plan)
    command = make_command(sys.argv[1:], study, studies)
    try:
        with interrupt_on_sigterm():
            failures = run_campaign(campaign, scheduler, workers)
            report = write_all(campaign, failures, command=command)
    except KeyboardInterrupt:
        print(
            "tofssm: interrupted; run the same command again to continue",
            file=sys.stderr,
        )
        return 130
    return tell(report, failures)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Campaign:
    """What to run, and where its results go."""

    out: Path
    """The folder."""
    plan: Plan
    scenario: Scenario
    """What all runs have in common."""
    motions: dict[str, bytes]
    """Recordings by file name."""


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


def write_all(
    campaign: Campaign, failures: dict[str, str], *, command: str
) -> Path:
    """Writes the table and the report of the finished runs.

    Args:
        campaign: The campaign.
        failures: Reason by the label of the run that failed.
        command: What makes the campaign again.

    Returns:
        The report's path.
    """
    out, plan = campaign.out, campaign.plan
    with Console(stderr=True).status("writing the report"):
        results = make_results(plan, read_rows(out, plan))
        write_results(out, results)
        return write_campaign_report(
            out,
            plan=plan,
            rows=results,
            parameters=list_parameters(campaign.scenario, plan),
            command=command,
            failures=failures,
        )


def choose_studies(names: list[str] | None, possible: list[str]) -> list[str]:
    """Returns which studies are run.

    Args:
        names: As given; None: not given, which means the literal law.
        possible: Studies that have a cell in this campaign. `all` means
            these; a study asked for by name is never left out.

    Raises:
        UserError: `none` is not alone, or a name is given twice.
    """
    if names is None:
        return [name for name in possible if name == "literal"]
    require(
        "none" not in names or names == ["none"],
        "--study: none excludes any other study",
    )
    if names == ["none"]:
        return []
    require(
        len(set(names)) == len(names),
        f"--study: {', '.join(names)} names one of them twice",
    )
    if "all" not in names:
        return names
    others = [n for n in names if n != "all" and n not in possible]
    return [*possible, *others]


def make_command(
    arguments: list[str], asked: list[str] | None, studies: list[str]
) -> str:
    """Returns the command that makes the campaign again.

    Args:
        arguments: Of this command.
        asked: Studies that they name; None: none.
        studies: The studies that are run; always named in the result.
    """
    added = []
    if asked is None:
        added = [part for s in studies or ["none"] for part in ("--study", s)]
    return shlex.join(["tofssm", *arguments, *added])


def require_free(scenario: Scenario) -> None:
    """Raises UserError if the text changes what cells or trials decide."""
    default = load_scenario()
    law = get_tri_ssm(scenario, "--scenario-text: law")
    people = copy.deepcopy(default.people)
    for name, person in people.items():
        changed = scenario.people.get(name)
        walks = (GeneratedWalk, BvhRecording)
        if isinstance(person, walks) and isinstance(changed, walks):
            person.figure_eight = changed.figure_eight
    for name, same in {
        "sensors": [(n, type(s)) for n, s in scenario.sensors.items()]
        == [(n, type(s)) for n, s in default.sensors.items()],
        "random_seed": scenario.random_seed == default.random_seed,
        "law.configuration": law.configuration
        == get_tri_ssm(default).configuration,
        "people": scenario.people == people,
    }.items():
        require(
            same,
            f"--scenario-text: {name}: is decided by the campaign's cells and "
            "trials; see --sensing, --ssm, --seed and --human-motions",
        )


def read_motions(folder: Path | None, scenario: Scenario) -> dict[str, bytes]:
    """Returns the recordings in a folder by file name.

    Args:
        folder: None: no recordings.
        scenario: Has the control tick.

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
        make_bvh_motion(
            BvhRecording(filename=str(path)), scenario.control_period
        )
    return {path.name: path.read_bytes() for path in paths}


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
    calls = {}
    # The longest runs first, so that all workers finish at the same time: a
    # lidar at the base stops the robot most.
    for planned in sorted(missing, key=lambda r: r.cell.sensing != "lidar"):
        name = plan.find_motion(planned)
        motion = None if name is None else (name, campaign.motions[name])
        calls[planned.key] = campaign.scenario, planned, motion
    by_key = {planned.key: planned for planned in missing}
    failures = {}
    start = time.perf_counter()
    simulated = 0.0
    with make_progress_bar() as bar:
        task = bar.add_task(
            "", total=total, completed=total - len(missing), speed=0.0
        )
        for key, outcome, error in call_all(client, execute, calls):
            planned = by_key[key]
            if error is None:
                store_run(campaign.out, planned, outcome.row, outcome.files)
                simulated += outcome.simulated
            else:
                reason = " ".join(str(error).split()) or type(error).__name__
                failures[planned.label] = reason
                bar.console.print(
                    f"failed: {planned.label}: {reason}",
                    markup=False,
                    highlight=False,
                )
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


def list_parameters(
    scenario: Scenario, plan: Plan
) -> list[tuple[str, dict[str, str]]]:
    """Returns the paper's table of parameters, as run.

    Returns:
        Rows (name, value by sensing).
    """
    scenarios = {
        cell.sensing: make_run_scenario(scenario, PlannedRun(cell=cell))
        for cell in plan.cells
        if not cell.variant
    }
    laws = {
        sensing: get_tri_ssm(s).grow(float(find_threshold_offsets(s)[0]))
        for sensing, s in scenarios.items()
    }
    radii = {
        sensing: lidar.separation.workspace_radius
        for sensing, s in scenarios.items()
        for lidar in find_lidars(s).values()
    }

    def row(name, text):
        return name, {s: text(law) for s, law in laws.items()}

    return [
        row(
            "T_red, T_stop, T_R", lambda c: f"{c.T_red}, {c.T_stop}, {c.T_R} s"
        ),
        row("V_lmax", lambda c: f"{c.V_lmax} m/s"),
        row(
            "V_hmax (k_max of Vo less V_lmax)",
            lambda c: f"{round(c.k_omax - c.V_lmax, 9)} m/s",
        ),
        row("k_max of Vo, of Vr", lambda c: f"{c.k_omax}, {c.k_lmax} m/s"),
        (
            "r_o (in C_dC, d_C and d_R as the lidar's rule has it)",
            {s: f"{radii[s]} m" if s in radii else "\u2013" for s in laws},
        ),
        row("C_dC", lambda c: f"{c.C_dC} m"),
        row("B_min", lambda c: f"{c.B_min} m"),
        row("d_C, d_R of SM", lambda c: f"{c.d_C_sm}, {c.d_R_sm} m"),
        row("alpha_I, alpha_D", lambda c: f"{c.alpha_I}, {c.alpha_D}"),
        row(
            "speed fraction \u03c1: normal, reduced, stop",
            lambda c: f"1, {c.rho_reduced}, 0",
        ),
        row(
            "\u03c1's greatest rate and acceleration",
            lambda c: (
                f"{c.rho_max_rate:.3g} 1/s, "
                f"{c.rho_max_acceleration:.3g} 1/s\u00b2"
            ),
        ),
    ]


def tell(report: Path, failures: dict[str, str]) -> int:
    """Prints where the report is; returns the exit code."""
    for label, reason in failures.items():
        print(f"tofssm: failed: {label}: {reason}", file=sys.stderr)
    print(report.resolve())
    return 1 if failures else 0
