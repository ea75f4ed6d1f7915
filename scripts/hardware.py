"""`tofssm hardware`: runs the monitor on a real robot."""

import contextlib
import dataclasses as dc
import math
from pathlib import Path
import shlex
import sys
import time
from typing import Annotated

from rich.console import Console
import typer

from tofssm_drake.diagrams.hardware_loop import HardwareLoop, TickResult
from tofssm_drake.diagrams.hardware_run import (
    HardwareRun,
    JointLimits,
    hold_robot,
    require_control_period,
    require_ready,
    run_in_real_time,
    set_control_period,
    wait_for_robot,
)
from tofssm_drake.diagrams.monitor import tell_self_hit_coverage
from tofssm_drake.diagrams.ring_decoder import make_ring_decoder
from tofssm_drake.diagrams.scenario import (
    NoHuman,
    dump_scenario,
    load_scenario,
)
from tofssm_drake.diagrams.simulation import Progress
from tofssm_drake.errors import UserError, require
from tofssm_drake.evaluation.report import count_of
from tofssm_drake.hardware.model_match import describe_tool
from tofssm_drake.hardware.ring_address import (
    parse_ring_address,
    require_distinct,
)
from tofssm_drake.hardware.ring_link import RingLink
from tofssm_drake.hardware.robot_connection import RtdeStatus
from tofssm_drake.hardware.rtde_client import RtdeClient
from tofssm_drake.hardware.run_record import RunRecorder
from tofssm_drake.hardware.slider import SliderConfig, find_operator_limit
from tofssm_drake.robot.kinematics import RingKinematics
from tofssm_drake.scripts.hardware_status import HardwareStatus
import tofssm_drake.scripts.options as options
from tofssm_drake.scripts.simulate import (
    catch_stop,
    interrupt_on_stop,
    make_display,
    make_folder,
    override,
    summarize,
    write_results,
)

_VIRTUAL = "virtual"
_TOO_EARLY = "interrupted before the start"
# An echo of the slider below that is 0.
_AT_ZERO = 0.005
# So long a refusal waits for a robot that it may put to 0, s.
_RECONNECT = 1.0

_NO_PRIORITY = (
    "--real-time: the system does not grant a real-time priority (see "
    "docs/hardware.md)"
)

# What a summary tells only where it is known where people truly were.
_OF_A_PERSON = (
    "contact_while_moving_events",
    "contact_while_moving_max_mps",
    "contacts",
    "late_stops",
    "stop_due_s",
)

# Each message is one line, however long, and printed as it is.
_console = Console(
    stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False
)


def hardware(
    robot_host: Annotated[
        str, typer.Option(help="Address of the robot, real or simulated.")
    ],
    rings: Annotated[
        list[str],
        typer.Option(
            help="Where the rings' frames come from; may be given again. "
            "virtual simulates them around the real robot.",
            metavar="udp://ADDRESS:PORT|serial:///dev/NAME|virtual",
        ),
    ],
    robot_port: options.RobotPort = 30004,
    robot_text: options.RobotText = "",
    allow_remote: Annotated[
        bool,
        typer.Option(help="Let --rings listen on every interface (0.0.0.0)."),
    ] = False,
    scenario_file: options.ScenarioFile = None,
    scenario_name: options.ScenarioName = "Default",
    scenario_text: options.ScenarioText = "",
    ssm: options.Ssm = None,
    sensors_per_ring: options.SensorsPerRing = None,
    human_motion: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="A BVH recording whose gait the person of virtual rings "
            "walks with.",
            metavar="FILE.bvh",
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of virtual sensors' errors.")
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Write nothing to the robot."),
    ] = False,
    any_pose: Annotated[
        bool,
        typer.Option(
            "--any-pose",
            help="Start anywhere within the joints' limits, not only near "
            "the scenario's program.",
        ),
    ] = False,
    allow_no_pose: Annotated[
        bool,
        typer.Option(
            "--allow-no-pose",
            help="Start although the robot does not report its tool's pose, "
            "so that nothing tells whether it is the modelled one.",
        ),
    ] = False,
    checks_text: options.ChecksText = "",
    minimum_fraction: Annotated[
        float,
        typer.Option(help="Where a stop leaves the slider, 0 to 0.1."),
    ] = 0.0,
    slider_limit: Annotated[
        float | None,
        typer.Option(
            help="Up to where the slider may go, until a person moves it. "
            "Without it no further than where it stands at the start.",
        ),
    ] = None,
    control_period: Annotated[
        float | None,
        typer.Option(
            help="Control tick, s; a multiple of the robot's cycle. Without "
            "it there is a tick for each of the robot's reports."
        ),
    ] = None,
    wait: Annotated[
        float, typer.Option(help="Longest wait for robot and for rings, s.")
    ] = 30.0,
    duration: Annotated[
        float,
        typer.Option(help="For how long, s; 0: until all is placed."),
    ] = 0.0,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time",
            help="Go before all other programs of this computer, where the "
            "system lets you.",
        ),
    ] = False,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Watch the twin in a browser.")
    ] = False,
    record: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="Record everything.",
            metavar="FILE.mcap",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="Folder for a report at the end.",
            metavar="DIR",
        ),
    ] = None,
) -> int:
    """Slow a real robot down when somebody is near.

    Not a safety function: see docs/robot_link.md. Whatever ends the run puts
    the robot's speed slider to 0.
    """
    require(
        0.0 < wait <= 3600.0,
        f"--wait: must be above 0 and at most 3600 s, got {wait:g}",
    )
    require(duration >= 0.0, f"--duration: must be 0 or more, got {duration:g}")
    require_control_period(control_period)
    is_virtual = rings == [_VIRTUAL]
    require(
        is_virtual or _VIRTUAL not in rings,
        f"--rings: {_VIRTUAL} stands alone, got {', '.join(rings)}",
    )
    for option, value in (("--human-motion", human_motion), ("--seed", seed)):
        require(
            is_virtual or value is None,
            f"{option}: is only for --rings {_VIRTUAL}, got --rings "
            f"{', '.join(rings)}",
        )
    addresses = (
        []
        if is_virtual
        else [parse_ring_address(r, allow_remote=allow_remote) for r in rings]
    )
    require_distinct(addresses)
    scenario = load_scenario(
        filename=scenario_file, name=scenario_name, text=scenario_text
    )
    override(
        scenario,
        ssm=ssm,
        sensors_per_ring=sensors_per_ring,
        human_motion=human_motion,
        seed=seed,
    )
    require(
        scenario.sensing == "tof",
        f"sensing: {scenario.sensing!r} is for simulations, must be 'tof'",
    )
    if not is_virtual:
        scenario.human = NoHuman()
    checks = options.make_robot_checks(checks_text, allow_no_pose=allow_no_pose)
    slider = _make_slider_config(minimum_fraction, slider_limit, scenario)
    slider.arm = checks.arm
    robot_config = options.make_robot_config(
        robot_host, robot_port, robot_text, write=not dry_run
    )
    run_options = {
        "virtual_rings": is_virtual,
        "minimum_fraction": minimum_fraction,
        "dry_run": dry_run,
        "arm": dc.asdict(checks.arm),
        "command": shlex.join(["tofssm", *sys.argv[1:]]),
    }
    with contextlib.ExitStack() as stack:
        # Nothing may end the process before 0 has been sent.
        stopped = stack.enter_context(catch_stop(until_end=True))
        with interrupt_on_stop(stopped, _TOO_EARLY):
            # Once in vain: what can not be made must not be found out after
            # a robot was stopped for it, nor may it wait for a compiler.
            HardwareLoop(scenario=scenario, virtual_rings=is_virtual)
            coverage = tell_self_hit_coverage(scenario)
        if out is not None:
            stack.enter_context(_made_folder(out))
        recorder = None
        if record is not None:
            recorder = stack.enter_context(RunRecorder(record))
        link = None
        if addresses:
            link = stack.enter_context(
                RingLink(
                    addresses=addresses,
                    decoder=make_ring_decoder(
                        scenario, control_period=control_period
                    ),
                    tap=None if recorder is None else recorder.add_ring_bytes,
                )
            )
        robot = RtdeClient(
            robot_config,
            tap=None if recorder is None else recorder.add_robot_bytes,
        )
        # Closed first of all: that puts the slider to 0.
        stack.enter_context(robot)
        stack.enter_context(_tell_slider(robot, dry_run))
        waiting = {
            "timeout": wait,
            "tell": _console.print,
            "is_stopped": lambda: bool(stopped),
        }
        if not wait_for_robot(robot, **waiting):
            raise KeyboardInterrupt(_TOO_EARLY)
        # What a person allows is to be seen before 0 is written.
        slider.operator_limit = find_operator_limit(
            slider, robot.get_report().target_speed_fraction
        )
        if slider.operator_limit is not None:
            run_options["slider_limit"] = slider.operator_limit
        hold_robot(robot, slider.minimum_fraction)
        status = robot.get_status()
        set_control_period(
            scenario,
            frequency=status.frequency,
            control_period=control_period,
        )
        display = make_display() if meshcat else None
        if display is not None:
            print(f"watch at {display.web_url()}", flush=True)
        with interrupt_on_stop(stopped, _TOO_EARLY):
            loop = HardwareLoop(
                scenario=scenario,
                virtual_rings=is_virtual,
                send=None if dry_run else robot.send,
                slider=slider,
                meshcat=display,
                with_samples=out is not None,
            )
        if real_time and not stack.enter_context(run_in_real_time()):
            _console.print(_NO_PRIORITY)
        plant = loop.workcell.station.plant
        kinematics = RingKinematics.from_plant(plant)
        run = HardwareRun(
            loop=loop,
            robot=robot,
            rings=link,
            period=scenario.control_period,
            record=recorder,
            limits=JointLimits.from_plant(plant),
            kinematics=kinematics,
            checks=checks,
            lowest=slider.minimum_fraction,
        )
        first = run.wait(**waiting)
        if first is None:
            raise KeyboardInterrupt(_TOO_EARLY)
        require_ready(
            first,
            scenario,
            plant,
            max_deviation=math.inf if any_pose else 0.5,
            model=checks.model,
        )
        if recorder is not None:
            recorder.add_run(
                {"scenario": dump_scenario(scenario), **run_options}
            )
        _console.print(describe_robot(status, scenario.control_period))
        tool = describe_tool(checks.model, kinematics, first)
        if tool:
            _console.print(tool)
        for line in coverage:
            _console.print(f"note: {line}")
        end = _run(run, robot, link, stopped, duration, dry_run)
        robot.close()
        # The terminal may be gone.
        with contextlib.suppress(OSError):
            print(f"{end.reason}; {_describe_slider(robot, dry_run)}")
            sys.stdout.flush()
    if out is not None and end.result is not None:
        _write_report(
            loop,
            scenario,
            end,
            out,
            {
                "scenario_name": scenario_name,
                "command": run_options["command"],
                "self_hit_coverage": coverage,
            },
            is_real=not is_virtual,
        )
    return end.code


def _make_slider_config(minimum_fraction, slider_limit, scenario):
    """Returns how to use the slider, checked; blames the options."""
    config = SliderConfig(
        minimum_fraction=minimum_fraction, operator_limit=slider_limit
    )
    option = {
        "slider.minimum_fraction": "--minimum-fraction",
        "slider.operator_limit": "--slider-limit",
    }
    with options.blame(option):
        config.check("slider")
    reduced = scenario.ssm.rho_reduced
    require(
        minimum_fraction < reduced,
        f"--minimum-fraction: must be below ssm.rho_reduced, {reduced:g}, "
        f"got {minimum_fraction:g}",
    )
    config.reduced_fraction = reduced
    return config


@dc.dataclass
class _End:
    """How a run ended."""

    reason: str
    code: int
    result: TickResult | None = None
    wall_time: float = 0.0


def _run(run, robot, link, stopped, duration, dry_run):
    """Runs until something ends it; closes the robot before it tells."""
    result, has_begun = None, False
    begin = time.monotonic()
    status = HardwareStatus(robot=robot, link=link, dry_run=dry_run)
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
                    # The number may be that of the program's run before.
                    has_begun = has_begun or not result.task_done
                    if has_begun and result.task_done:
                        end = _End("all products are placed", 0)
                        break
                if duration and elapsed >= duration:
                    end = _End(f"ran for {duration:g} s", 0)
                    break
    except Exception as error:
        # Whatever it is: the robot must not go on.
        text = str(error)
        if not isinstance(error, UserError):
            text = f"{type(error).__name__}: {' '.join(text.split())}"
        end = _End(f"stopped: {text}", 1)
        if stopped:
            # It was told to stop, and something went wrong just then.
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


def describe_robot(status: RtdeStatus, control_period: float) -> str:
    """Returns the line that tells what robot answered, and the tick.

    Args:
        status: Of the connection.
        control_period: Control tick, s.
    """
    version = ".".join(str(part) for part in status.controller[:3])
    return (
        f"robot: software {version}, {status.frequency:g} Hz; control tick "
        f"{1e3 * control_period:g} ms"
    )


@contextlib.contextmanager
def _made_folder(folder):
    """Makes a folder, and takes it away if that was in vain."""
    is_new = not folder.exists()
    make_folder(folder)
    try:
        yield
    except BaseException:
        if is_new:
            # What is not empty stays.
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


@contextlib.contextmanager
def _tell_slider(robot, dry_run):
    """Adds what became of the slider to what ends a run before its start."""
    try:
        yield
    except (UserError, KeyboardInterrupt) as error:
        if robot.get_report().sequence < 0:
            # There was no robot.
            raise
        # While the twin was made the connection may have been lost.
        robot.wait_for_report(
            after=robot.get_report().sequence, timeout=_RECONNECT
        )
        robot.close()
        raise type(error)(
            f"{error}; {_describe_slider(robot, dry_run)}"
        ) from None


def _describe_slider(robot, dry_run):
    if dry_run:
        return "nothing was written (dry run)"
    if robot.get_report().target_speed_fraction < _AT_ZERO:
        return "slider set to 0"
    return "slider not seen at 0: its own watchdog must stop the robot"


def _write_report(loop, scenario, end, out, metadata, is_real):
    """Writes what a simulation writes: report, summary, samples."""
    samples = loop.workcell.recorder.make_samples(loop.context)
    samples.metadata |= {"interrupted": end.code != 0, **metadata}
    summary = summarize(
        scenario,
        samples,
        Progress(
            time=end.result.time,
            products_placed=end.result.products_placed,
            wall_time=end.wall_time,
            real_time_factor=end.result.time / max(end.wall_time, 1e-9),
            finished=end.code == 0,
        ),
    )
    if is_real:
        # Nothing that is compared with a person's truth means anything.
        samples.metadata["human"] = "not known: real rings"
        summary |= {
            "person_is_known": False,
            "ghost_s_by_ring": {},
            **dict.fromkeys(_OF_A_PERSON),
        }
    write_results(samples, summary, out)
    print(
        f"{count_of(end.result.products_placed, 'product')} placed in "
        f"{end.result.time:.1f} s; report: {out / 'report.html'}"
    )
