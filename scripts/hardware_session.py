"""A run of the monitor on a real robot, from its connections to its report."""

import contextlib
import dataclasses as dc
from pathlib import Path
import sys
import time

from rich.console import Console

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.drivers import RealCell
from tofssm_drake.diagrams.hardware_loop import HardwareLoop, TickResult
from tofssm_drake.diagrams.hardware_run import (
    HardwareRun,
    JointLimits,
    hold_robot,
    require_ready,
    run_in_real_time,
    set_control_period,
    wait_for_robot,
)
from tofssm_drake.diagrams.monitor import tell_self_hit_coverage
from tofssm_drake.diagrams.ring_decoder import make_ring_decoder
from tofssm_drake.diagrams.scenario import (
    Scenario,
    dump_scenario,
    find_links,
)
from tofssm_drake.diagrams.simulation import Progress
from tofssm_drake.diagrams.viewer import Viewer, ViewerSettings
from tofssm_drake.errors import UserError
from tofssm_drake.laws.law import describe_law
from tofssm_drake.recording.run_record import RunRecorder
from tofssm_drake.ringlink.ring_address import SerialAddress, UdpAddress
from tofssm_drake.ringlink.ring_link import RingLink
from tofssm_drake.robots.robot_connection import RobotStatus
from tofssm_drake.rtde.model_match import describe_tool
from tofssm_drake.rtde.slider import SliderConfig, find_operator_limit
from tofssm_drake.scripts.hardware_status import HardwareStatus
from tofssm_drake.scripts.simulate import (
    catch_stop,
    describe_outcome,
    interrupt_on_stop,
    make_folder,
    summarize,
    write_results,
)

_TOO_EARLY = "interrupted before the start"
# An echo of the slider below this is 0.
_AT_ZERO = 0.005
# How long a refusal waits for a robot in order to set its slider to 0, s.
_RECONNECT = 1.0

_NO_PRIORITY = (
    "--real-time: the system does not grant a real-time priority (see "
    "docs/hardware.md)"
)

# Parts of a summary that need the true positions of people.
_OF_A_PERSON = (
    "contact_while_moving_events",
    "contact_while_moving_max_mps",
    "contacts",
    "late_stops",
    "stop_due_s",
)

# Each message is one line, however long, and printed unchanged.
_console = Console(
    stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False
)


@dc.dataclass(frozen=True, kw_only=True)
class SessionSettings:
    """What to run, and on what; checked."""

    scenario: Scenario
    scenario_name: str
    addresses: tuple[UdpAddress | SerialAddress, ...]
    """Of the rings; empty: they are simulated around the real robot."""
    driver: RealCell
    slider: SliderConfig
    is_dry_run: bool
    """Nothing is written to the robot."""
    max_deviation: float
    """How far from the program the robot may start, rad."""
    control_period: float | None
    """s; None: one tick per report."""
    wait: float
    """Longest wait for robot and rings, s."""
    duration: float
    """s; 0: until the task is done."""
    in_real_time: bool
    with_meshcat: bool
    record: Path | None
    out: Path | None
    command: str
    """As the user typed it."""

    @property
    def is_virtual(self) -> bool:
        """Whether the rings are simulated."""
        return not self.addresses


def run_session(settings: SessionSettings) -> int:
    """Runs the monitor until something ends it.

    However it ends, the robot's speed slider is set to 0.

    Returns:
        The exit code.

    Raises:
        UserError: Robot or rings are missing or not as expected.
        KeyboardInterrupt: Stopped before the start.
    """
    with contextlib.ExitStack() as stack:
        # The process must not end before 0 has been sent.
        stopped = stack.enter_context(catch_stop(until_end=True))
        with interrupt_on_stop(stopped, _TOO_EARLY):
            coverage = _try_out(settings)
        if settings.out is not None:
            stack.enter_context(_made_folder(settings.out))
        recorder = None
        if settings.record is not None:
            recorder = stack.enter_context(RunRecorder(settings.record))
        link = _open_rings(stack, settings, recorder)
        robot = _open_robot(stack, settings, recorder)
        if not wait_for_robot(
            robot,
            timeout=settings.wait,
            tell=_console.print,
            is_stopped=lambda: bool(stopped),
        ):
            raise KeyboardInterrupt(_TOO_EARLY)
        _hold_slider(settings, robot)
        # Before anything else is waited for: it may be another robot.
        _require_ready(
            settings,
            make_cell_plant(arm=settings.scenario.robot),
            robot.get_report(),
        )
        with interrupt_on_stop(stopped, _TOO_EARLY):
            loop = _make_loop(stack, settings, robot)
        if settings.in_real_time and not stack.enter_context(
            run_in_real_time()
        ):
            _console.print(_NO_PRIORITY)
        run = _make_run(settings, loop, robot, link, recorder)
        first = run.wait(
            timeout=settings.wait,
            tell=_console.print,
            is_stopped=lambda: bool(stopped),
        )
        if first is None:
            raise KeyboardInterrupt(_TOO_EARLY)
        _begin(settings, loop, robot, first, recorder)
        for line in coverage:
            _console.print(f"note: {line}")
        placed = "placed" if loop.workcell.station.path.open_time else ""
        end = _run(settings, run, robot, link, stopped, placed)
        robot.close()
        # The terminal may be gone.
        with contextlib.suppress(OSError):
            print(f"{end.reason}; {_describe_slider(robot, settings)}")
            sys.stdout.flush()
    if settings.out is not None and end.result is not None:
        _write_report(settings, loop, end, coverage)
    return end.code


def _try_out(settings):
    """Makes the loop once, before a robot is stopped for it.

    It finds bad settings and compiles the kernels.

    Returns:
        Lines that say what self-hits cannot verify.
    """
    HardwareLoop(scenario=settings.scenario, virtual_rings=settings.is_virtual)
    return tell_self_hit_coverage(settings.scenario)


def _open_rings(stack, settings, recorder):
    """Returns the link to real rings; None: they are simulated."""
    if settings.is_virtual:
        return None
    decoder = make_ring_decoder(
        settings.scenario, control_period=settings.control_period
    )
    return stack.enter_context(
        RingLink(
            addresses=settings.addresses,
            decoder=decoder,
            tap=None if recorder is None else recorder.add_ring_bytes,
        )
    )


def _open_robot(stack, settings, recorder):
    """Returns the connection to the robot, which the stack closes first."""
    robot = settings.driver.open(
        write=not settings.is_dry_run,
        tap=None if recorder is None else recorder.add_robot_bytes,
    )
    # It sets the slider to 0.
    stack.callback(robot.close)
    stack.enter_context(_tell_slider(robot, settings))
    return robot


def _hold_slider(settings, robot):
    """Reads the limit set by a person, then sets the slider to its lowest."""
    slider = settings.slider
    slider.operator_limit = find_operator_limit(
        slider, robot.get_report().target_speed_fraction
    )
    hold_robot(robot, slider.minimum_fraction)


def _make_loop(stack, settings, robot):
    """Makes the loop at the robot's rate, and its viewer."""
    set_control_period(
        settings.scenario,
        frequency=robot.get_status().frequency,
        control_period=settings.control_period,
    )
    viewer = None
    if settings.with_meshcat:
        viewer = stack.enter_context(_make_viewer(settings))
        viewer.start()
    return HardwareLoop(
        scenario=settings.scenario,
        virtual_rings=settings.is_virtual,
        send=None if settings.is_dry_run else robot.send,
        slider=settings.slider,
        show=None if viewer is None else viewer.send,
        with_samples=settings.out is not None,
    )


def _make_viewer(settings):
    """Makes the viewer of the twin; a real person is unknown."""
    seen = settings.scenario
    if not settings.is_virtual:
        seen = dc.replace(seen, people={}, obstacles={})
    return Viewer(
        ViewerSettings(scenario=seen, is_watched=True, with_health=True)
    )


def _make_run(settings, loop, robot, link, recorder):
    plant = loop.workcell.station.plant
    return HardwareRun(
        loop=loop,
        robot=robot,
        rings=link,
        period=settings.scenario.control_period,
        record=recorder,
        limits=JointLimits.from_plant(plant),
        kinematics=ArmKinematics.from_plant(plant),
        checks=settings.driver.checks,
        lowest=settings.slider.minimum_fraction,
    )


def _require_ready(settings, plant, report):
    """Raises UserError unless it is the modelled robot, ready to start."""
    require_ready(
        report,
        settings.scenario,
        plant,
        max_deviation=settings.max_deviation,
        model=settings.driver.checks.model,
    )


def _begin(settings, loop, robot, first, recorder):
    """Checks the robot's first report; records and prints what is run."""
    plant = loop.workcell.station.plant
    scenario, checks = settings.scenario, settings.driver.checks
    # It may have moved while the rings were waited for.
    _require_ready(settings, plant, first)
    if recorder is not None:
        limit = settings.slider.operator_limit
        recorder.add_run(
            {
                "scenario": dump_scenario(scenario),
                "links": find_links(scenario),
                "law": describe_law(scenario.law),
                "virtual_rings": settings.is_virtual,
                "minimum_fraction": settings.slider.minimum_fraction,
                "dry_run": settings.is_dry_run,
                "arm": dc.asdict(checks.arm),
                "command": settings.command,
                **({} if limit is None else {"slider_limit": limit}),
            }
        )
    _console.print(describe_robot(robot.get_status(), scenario.control_period))
    tool = describe_tool(checks.model, ArmKinematics.from_plant(plant), first)
    if tool:
        _console.print(tool)


@dc.dataclass
class _End:
    """How a run ended."""

    reason: str
    code: int
    result: TickResult | None = None
    wall_time: float = 0.0


def _run(settings, run, robot, link, stopped, placed):
    """Runs until something ends it; closes the robot before saying so."""
    result, has_begun = None, False
    begin = time.monotonic()
    duration = settings.duration
    status = HardwareStatus(
        robot=robot, link=link, dry_run=settings.is_dry_run, placed=placed
    )
    try:
        with status, _ending(status, robot):
            while True:
                result = run.step() or result
                status.show(result)
                elapsed = time.monotonic() - begin
                if stopped:
                    end = _End("interrupted", 130)
                    break
                if result is not None:
                    # The number may be left from the program's previous run.
                    has_begun = has_begun or not result.task_done
                    if has_begun and result.task_done:
                        end = _End("the task is done", 0)
                        break
                if duration and elapsed >= duration:
                    end = _End(f"ran for {duration:g} s", 0)
                    break
    except Exception as error:
        # Whatever happened, the robot must not go on.
        text = str(error)
        if not isinstance(error, UserError):
            text = f"{type(error).__name__}: {' '.join(text.split())}"
        end = _End(f"stopped: {text}", 1)
        if stopped:
            # Stopping it has failed.
            end = _End("interrupted", 130)
    end.result = result
    end.wall_time = time.monotonic() - begin
    return end


@contextlib.contextmanager
def _ending(status, robot):
    """Closes the robot at the end, before anything waits for a terminal."""
    try:
        yield
    finally:
        status.end()
        robot.close()


def describe_robot(status: RobotStatus, control_period: float) -> str:
    """Returns the line about the robot that answered, and the tick.

    Args:
        status: Of the connection.
        control_period: Control tick, s.
    """
    version = ".".join(str(part) for part in status.controller[:3])
    software = f"software {version}, " if version else ""
    return (
        f"robot: {software}{status.frequency:g} Hz; control tick "
        f"{1e3 * control_period:g} ms"
    )


@contextlib.contextmanager
def _made_folder(folder):
    """Makes a folder; removes it afterwards if it is empty."""
    is_new = not folder.exists()
    make_folder(folder)
    try:
        yield
    except BaseException:
        if is_new:
            # A folder with content stays.
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


@contextlib.contextmanager
def _tell_slider(robot, settings):
    """Adds the slider's state to an error that ends a run before its start."""
    try:
        yield
    except (UserError, KeyboardInterrupt) as error:
        if robot.get_report().sequence < 0:
            # There was no robot.
            raise
        # The connection may have been lost while the twin was made.
        robot.wait_for_report(
            after=robot.get_report().sequence, timeout=_RECONNECT
        )
        robot.close()
        raise type(error)(
            f"{error}; {_describe_slider(robot, settings)}"
        ) from None


def _describe_slider(robot, settings):
    if settings.is_dry_run:
        return "nothing was written (dry run)"
    if not settings.driver.traits.has_echo:
        return "speed fraction set to 0, which this robot does not confirm"
    if robot.get_report().target_speed_fraction < _AT_ZERO:
        return "slider set to 0"
    return "slider not seen at 0: its own watchdog must stop the robot"


def _write_report(settings, loop, end, coverage):
    """Writes what a simulation writes: report, summary, samples."""
    samples = loop.workcell.recorder.make_samples(loop.context)
    samples.metadata |= {
        "interrupted": end.code != 0,
        "scenario_name": settings.scenario_name,
        "command": settings.command,
        "self_hit_coverage": coverage,
    }
    summary = summarize(
        settings.scenario,
        samples,
        Progress(
            time=end.result.time,
            steps_done=end.result.products_placed,
            wall_time=end.wall_time,
            real_time_factor=end.result.time / max(end.wall_time, 1e-9),
            finished=end.code == 0,
        ),
    )
    if not settings.is_virtual:
        # The true positions of people are unknown.
        samples.metadata["human"] = "not known: real rings"
        summary |= {
            "person_is_known": False,
            "ghost_s_by_ring": {},
            **dict.fromkeys(_OF_A_PERSON),
        }
    write_results(samples, summary, settings.out)
    print(
        f"{describe_outcome(summary)}; report: {settings.out / 'report.html'}"
    )
