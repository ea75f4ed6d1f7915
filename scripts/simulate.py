"""`tofssm simulate`: runs a scenario in simulation and writes its results."""

from collections.abc import Callable, Iterator
import contextlib
import json
from pathlib import Path
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from typing import Annotated

from pydrake.systems.framework import Diagram
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as ProgressBar
import typer

from tofssm_drake.diagrams.monitor import tell_self_hit_coverage
from tofssm_drake.diagrams.run_metadata import describe_task
from tofssm_drake.diagrams.scenario import (
    Scenario,
    dump_scenario,
    load_scenario,
)
from tofssm_drake.diagrams.simulation import Progress, Run
from tofssm_drake.diagrams.viewer import (
    RecordingOrder,
    Viewer,
    ViewerSettings,
)
from tofssm_drake.diagrams.workcell import Workcell, make_workcell
from tofssm_drake.errors import UserError, require
from tofssm_drake.laws.config import CONFIGURATIONS
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.metrics.metrics import calc_summary, never_started
from tofssm_drake.metrics.task_progress import TaskSteps, read_task_steps
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.recording.samples import (
    Samples,
    write_atomically,
    write_samples,
)
from tofssm_drake.reports.report import count_of, write_report
import tofssm_drake.scripts.options as options

_STILL_COMPILING = (
    "tofssm: the run ends when its kernels are loaded, or in the first run "
    "compiled, which takes up to some minutes; a second signal ends it at once"
)

RESULTS = (
    "report.html",
    "recording.html",
    "summary.json",
    "samples.parquet",
    "scans.parquet",
)
"""Files that a run leaves in its folder."""


def simulate(
    scenario_file: options.ScenarioFile = None,
    scenario_name: options.ScenarioName = "Default",
    scenario_text: options.ScenarioText = "",
    ssm: options.Ssm = None,
    human_motion: options.HumanMotion = None,
    seed: options.Seed = None,
    duration: Annotated[
        float | None, typer.Option(help="Longest simulated time, s.")
    ] = None,
    meshcat: Annotated[
        bool,
        typer.Option(help="Watch live in a browser, in real time."),
    ] = False,
    recording: Annotated[
        bool, typer.Option(help="Write recording.html, a 3-D replay.")
    ] = True,
    graphviz: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="Also draw the Diagram: FILE.dot, or FILE.svg, FILE.png or "
            "FILE.pdf if Graphviz is installed.",
            metavar="FILE",
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            parser=options.parse_path,
            help="Folder for the results.",
            metavar="DIR",
        ),
    ] = Path("out"),
) -> int:
    """Simulate the cell and write summary, samples, report and recording."""
    scenario = load_scenario(
        filename=scenario_file, name=scenario_name, text=scenario_text
    )
    override(
        scenario,
        ssm=ssm,
        human_motion=human_motion,
        seed=seed,
        duration=duration,
    )
    require_drawable(graphviz)
    viewer = None
    if meshcat or recording:
        viewer = Viewer(
            ViewerSettings(
                scenario=scenario, is_watched=meshcat, is_recorded=recording
            )
        )
    with options.blame(_blame_motion(scenario, human_motion)):
        workcell = make_workcell(
            scenario, prebuild=None if viewer is None else viewer.connect
        )
    coverage = tell_self_hit_coverage(scenario)
    # All that a user can get wrong is checked by now; nothing is written
    # before.
    make_folder(out)
    for line in coverage:
        print(f"note: {line}", file=sys.stderr, flush=True)
    if graphviz:
        draw_diagram(workcell.diagram, graphviz)
    with viewer or contextlib.nullcontext():
        samples, progress = _run_in_view(workcell, scenario, viewer, meshcat)
        changes = {
            "scenario-text": scenario_text or None,
            "ssm": ssm and ssm.lower(),
            "human-motion": human_motion,
            "seed": seed,
            "duration": None if duration is None else f"{duration:g} s",
        }
        samples.metadata |= {
            "scenario_name": scenario_name,
            "title": describe_run(scenario_name, changes),
            "command": shlex.join(["tofssm", *sys.argv[1:]]),
            "self_hit_coverage": coverage,
        }
        summary = summarize(scenario, samples, progress)
        write_run(samples, summary, out, viewer=viewer if recording else None)
    tell(summary, out)
    return 130 if summary["interrupted"] else 0


def _run_in_view(workcell, scenario, viewer, live):
    """Runs a workcell; the viewer starts when all settings are checked."""
    try:
        if viewer is not None:
            viewer.start()
            if live:
                viewer.wait_until_ready()
        return run(workcell, scenario, live=live)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            "interrupted; nothing of this run was written"
        ) from None


def write_run(
    samples: Samples, summary: dict, out: Path, *, viewer: Viewer | None
) -> None:
    """Writes all results of a run into a folder.

    Args:
        samples: The run.
        summary: From `summarize`.
        out: The folder.
        viewer: What has recorded the run; None: no recording.
    """
    status = Console(stderr=True).status("writing the report")
    with tell_what_is_left(out), status:
        write_results(samples, summary, out, viewer=viewer)


def _record(viewer, out, title):
    """Lets a viewer write the recording; returns its name, None: none."""
    name = "recording.html"
    order = RecordingOrder(
        folder=out.absolute(), name=name, title=f"tofssm_drake: {title}"
    )
    if viewer.record(order):
        return name
    # It may have ended between writing and saying so.
    (out / name).unlink(missing_ok=True)
    return None


def describe_run(scenario_name: str, settings: dict) -> str:
    """Returns a title: the scenario and the changes on the command line.

    Args:
        scenario_name: Name of the scenario.
        settings: Values by name; None: not changed.
    """
    changes = [
        f"{name} {value.name if isinstance(value, Path) else value}"
        for name, value in settings.items()
        if value is not None
    ]
    return ", ".join([scenario_name, *changes])


def override(
    scenario: Scenario,
    *,
    ssm: str | None = None,
    human_motion: Path | None = None,
    seed: int | None = None,
    duration: float | None = None,
) -> None:
    """Applies the options of the command line to a scenario.

    Args:
        scenario: Changed in place; checked afterwards.
        ssm: Configuration of the safety law.
        human_motion: BVH file; other settings of a recording are kept.
        seed: Random seed.
        duration: Longest simulated time, s.

    Raises:
        UserError: A value is unknown or out of range.
    """
    if ssm is not None:
        law = scenario.law
        if not isinstance(law, TriSsm):
            raise UserError(
                "--ssm: is for the law !TriSsm, the scenario has "
                f"!{type(law).__name__}"
            )
        law.configuration = _choose("--ssm", ssm, CONFIGURATIONS)
    changed = {}
    if human_motion is not None:
        require(
            len(scenario.people) == 1,
            f"--human-motion: is for one person, the scenario has "
            f"{len(scenario.people)}",
        )
        ((name, person),) = scenario.people.items()
        if not isinstance(person, BvhRecording):
            person = BvhRecording()
        scenario.people = {name: person}
        person.filename = str(human_motion)
        changed[f"people.{name}.filename"] = "--human-motion"
    if seed is not None:
        scenario.random_seed = seed
        changed["random_seed"] = "--seed"
    if duration is not None:
        scenario.simulation_duration = duration
        changed["simulation_duration"] = "--duration"
    with options.blame(changed):
        scenario.check()


def _blame_motion(scenario, human_motion):
    """Returns the option that has set the recording, by setting."""
    names = [] if human_motion is None else scenario.people
    return {f"people.{name}.filename": "--human-motion" for name in names}


def _choose(option, value, known):
    """Returns a known value in lower case."""
    require(
        value.lower() in known,
        f"{option}: {value!r} is unknown, use one of {', '.join(known)}",
    )
    return value.lower()


def require_drawable(filename: Path | None) -> None:
    """Raises UserError if a picture of the Diagram cannot be made."""
    if filename is None:
        return
    require(
        filename.suffix in (".dot", ".svg", ".png", ".pdf"),
        f"--graphviz: {filename} must end in .dot, .svg, .png or .pdf",
    )
    require(
        filename.suffix == ".dot" or shutil.which("dot") is not None,
        f"--graphviz: {filename.suffix} needs Graphviz's program dot "
        "(apt-get install graphviz); a name ending in .dot does not",
    )
    require(
        filename.parent.is_dir(),
        f"--graphviz: there is no folder {filename.parent}",
    )
    require(not filename.is_dir(), f"--graphviz: {filename} is a folder")
    try:
        with tempfile.TemporaryFile(dir=filename.parent):
            pass
    except OSError as error:
        raise UserError(
            f"--graphviz: cannot write {filename}: {error.strerror}"
        ) from None


def draw_diagram(diagram: Diagram, filename: Path) -> None:
    """Draws a Diagram to a file, whole or not at all."""
    dot = diagram.GetGraphvizString(max_depth=2)

    def write(temporary):
        if filename.suffix == ".dot":
            temporary.write_text(dot)
        else:
            kind = filename.suffix[1:]
            subprocess.run(
                ["dot", f"-T{kind}", "-o", temporary],
                input=dot,
                text=True,
                check=True,
            )

    write_atomically(filename, write)


def make_folder(folder: Path) -> None:
    """Makes a folder, and checks that files can be written into it.

    Raises:
        UserError: They cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        for path in folder.iterdir():
            if path.name in RESULTS and path.is_dir():
                raise IsADirectoryError(0, f"{path.name} is a folder")
    except OSError as error:
        raise UserError(
            f"--out: cannot write into {folder}: {error.strerror}"
        ) from None


@contextlib.contextmanager
def catch_stop(
    *, until_end: bool = False, tell: Callable[[], str] | None = None
):
    """Turns Ctrl-C, SIGTERM and SIGHUP into a flag: no row is cut off.

    A terminal sends SIGHUP when it is closed. A signal that is ignored, as by
    `nohup`, stays ignored.

    Args:
        until_end: Whether to catch further signals too, until the end of the
            block. Otherwise the second one takes effect.
        tell: Returns what to print on stderr when the first one comes.

    Yields:
        A list that is empty until a signal comes.
    """
    stopped = []

    def stop(number, frame):
        stopped.append(number)
        if not until_end:
            signal.signal(number, previous[number])
        if tell is not None and len(stopped) == 1 and (text := tell()):
            # What was interrupted may itself have been printing.
            with contextlib.suppress(OSError, RuntimeError, ValueError):
                print(text, file=sys.stderr, flush=True)

    previous = _handle_stop(stop)
    try:
        yield stopped
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def interrupt_on_stop(stopped: list, message: str):
    """Lets the signals of `catch_stop` interrupt a long operation.

    Args:
        stopped: What `catch_stop` yielded.
        message: Of the KeyboardInterrupt that is raised.
    """

    def interrupt(number, frame):
        stopped.append(number)
        # A second one must not disturb what the first has begun.
        if len(stopped) == 1:
            raise KeyboardInterrupt

    previous = _handle_stop(interrupt)
    try:
        yield
    except BaseException:
        # A compiler may turn it into another exception.
        if not stopped:
            raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if stopped:
        raise KeyboardInterrupt(message)


def _handle_stop(handler):
    """Sets a handler; returns the previous ones by signal."""
    return {
        number: signal.signal(number, handler)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) != signal.SIG_IGN
    }


def run(
    workcell: Workcell, scenario: Scenario, *, live: bool = False
) -> tuple[Samples, Progress]:
    """Runs a workcell to its end, or until Ctrl-C, with a progress bar.

    Args:
        workcell: Made from the scenario.
        scenario: The scenario as run.
        live: Whether to run in real time, for watching.

    Returns:
        The samples, whose metadata say whether the run was interrupted, and
        how far it came.
    """
    progress = None

    def tell():
        return _STILL_COMPILING if progress is None else ""

    with catch_stop(tell=tell) as stopped, make_progress_bar() as bar:
        run = Run(
            workcell=workcell,
            scenario=scenario,
            real_time_rate=1.0 if live else 0.0,
        )
        # The first step loads the kernels, or compiles them for half a minute.
        counted = read_task_steps(
            {"task": describe_task(scenario, workcell.station)}
        )
        task = bar.add_task(
            "preparing (compiles in the first run)",
            total=counted.steps or scenario.simulation_duration,
            steps="",
            time=0.0,
            factor=0.0,
        )
        while True:
            progress = run.advance()
            bar.update(
                task,
                description="simulating",
                completed=(
                    progress.steps_done if counted.step else progress.time
                ),
                steps=counted.describe(progress.steps_done, with_total=True),
                time=progress.time,
                factor=progress.real_time_factor,
            )
            if progress.finished or stopped:
                break
    samples = run.make_samples()
    samples.metadata["interrupted"] = bool(stopped) and not progress.finished
    return samples, progress


def summarize(scenario: Scenario, samples: Samples, progress: Progress) -> dict:
    """Returns the content of summary.json."""
    metadata = samples.metadata
    return calc_summary(samples) | {
        "interrupted": metadata["interrupted"],
        "real_time_factor": progress.real_time_factor,
        "seed": scenario.random_seed,
        "scenario_name": metadata["scenario_name"],
        "scenario": dump_scenario(scenario),
        "versions": metadata["versions"],
    }


def write_results(
    samples: Samples, summary: dict, out: Path, *, viewer: Viewer | None = None
) -> None:
    """Writes summary, samples and report into a folder, each file whole.

    Those of an earlier run are removed first, so that no folder holds two.

    Args:
        samples: The run.
        summary: From `summarize`.
        out: The folder.
        viewer: What has recorded the run, and writes the replay to which the
            report links; None: there is none.
    """
    clear_results(out)
    write_samples(samples, out)
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    write_atomically(out / "summary.json", lambda p: p.write_text(text))
    recording = None
    if viewer is not None:
        recording = _record(viewer, out, samples.metadata["title"])
    write_report(samples, summary, out / "report.html", recording=recording)


def clear_results(folder: Path) -> None:
    """Removes the results of an earlier run from its folder."""
    # The report first: it links to the others.
    for name in RESULTS:
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise UserError(
                f"--out: cannot replace {folder / name}: {error.strerror}"
            ) from None


@contextlib.contextmanager
def tell_what_is_left(folder: Path) -> Iterator[None]:
    """Makes Ctrl-C while results are written say which of them exist."""
    try:
        yield
    except KeyboardInterrupt:
        left = [name for name in RESULTS if (folder / name).exists()]
        raise KeyboardInterrupt(
            "interrupted while the results were written; written into "
            f"{folder}: {', '.join(left) or 'nothing'}"
        ) from None


def describe_outcome(summary: dict) -> str:
    """Returns how far the task came in which time."""
    task = TaskSteps(step=summary["step"], steps=summary["steps"])
    done = task.describe(summary["steps_done"])
    time = f"{summary['simulated_s']:.1f} s"
    return f"{done} in {time}" if done else f"ran for {time}"


def _describe_stops(summary):
    if never_started(summary):
        return "it never started"
    return count_of(summary["stop_events"], "stop")


def tell(summary: dict, out: Path) -> None:
    """Prints the outcome and where the report is."""
    end = " until interrupted" if summary["interrupted"] else ""
    print(
        f"{describe_outcome(summary)}{end}; "
        f"{_describe_stops(summary)}, "
        f"{count_of(summary['contact_while_moving_events'], 'contact')} "
        "while moving; "
        f"{summary['real_time_factor']:.1f} x real time"
    )
    for name in ("report.html", "recording.html"):
        if (out / name).exists():
            print((out / name).resolve())


def make_progress_bar() -> ProgressBar:
    """Returns a bar of the task with simulated time and real-time factor."""
    return ProgressBar(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[steps]}"),
        TextColumn("{task.fields[time]:6.1f} s simulated"),
        TextColumn("{task.fields[factor]:5.1f} x real time"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
    )
