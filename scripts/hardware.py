"""`tofssm hardware`: options of the monitor on a real robot."""

import dataclasses as dc
import math
from pathlib import Path
import shlex
import sys
from typing import Annotated

import typer

from tofssm_drake.diagrams.drivers import find_real_cell
from tofssm_drake.diagrams.drivers.real_cell import VIRTUAL
from tofssm_drake.diagrams.hardware_run import require_control_period
from tofssm_drake.diagrams.hardware_station import make_slider_config
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.errors import require
from tofssm_drake.scripts.hardware_session import SessionSettings, run_session
import tofssm_drake.scripts.options as options
from tofssm_drake.scripts.simulate import override


def hardware(
    robot_host: Annotated[
        str | None,
        typer.Option(
            help="Address of the UR robot, real or simulated; default: the "
            "scenario's."
        ),
    ] = None,
    rings: Annotated[
        list[str] | None,
        typer.Option(
            help="Where the rings' frames come from; can be repeated. "
            "virtual simulates the rings around the real robot. Default: the "
            "scenario's.",
            metavar="udp://ADDRESS:PORT|serial:///dev/NAME|virtual",
        ),
    ] = None,
    robot_port: options.RobotPort = None,
    robot_text: options.RobotText = "",
    allow_remote: Annotated[
        bool,
        typer.Option(help="Let --rings listen on every interface (0.0.0.0)."),
    ] = False,
    scenario_file: options.ScenarioFile = None,
    scenario_name: options.ScenarioName = "Default",
    scenario_text: options.ScenarioText = "",
    ssm: options.Ssm = None,
    human_motion: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="BVH recording that gives the gait of the person around "
            "virtual rings.",
            metavar="FILE.bvh",
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the virtual sensors' errors.")
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Write nothing to the robot."),
    ] = False,
    any_pose: Annotated[
        bool,
        typer.Option(
            "--any-pose",
            help="Start anywhere within the joint limits, not only near the "
            "scenario's program.",
        ),
    ] = False,
    allow_no_pose: Annotated[
        bool,
        typer.Option(
            "--allow-no-pose",
            help="Start even if the robot does not report its tool's pose, so "
            "that it cannot be compared with the model.",
        ),
    ] = False,
    checks_text: options.ChecksText = "",
    minimum_fraction: Annotated[
        float | None,
        typer.Option(
            help="Slider position when stopped, 0 to 0.1; default: the "
            "scenario's."
        ),
    ] = None,
    slider_limit: Annotated[
        float | None,
        typer.Option(
            help="Highest slider position, until a person moves the slider. "
            "Default: the scenario's, or where it stands at the start.",
        ),
    ] = None,
    control_period: Annotated[
        float | None,
        typer.Option(
            help="Control tick, s; a multiple of the robot's cycle. "
            "Default: one tick for each of the robot's reports."
        ),
    ] = None,
    wait: Annotated[
        float, typer.Option(help="Longest wait for robot and for rings, s.")
    ] = 30.0,
    duration: Annotated[
        float,
        typer.Option(help="Longest run, s; 0: until the task is done."),
    ] = 0.0,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time",
            help="Run with real-time priority, if the system allows it.",
        ),
    ] = False,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Watch the twin in a browser.")
    ] = False,
    record: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="Record the whole run.",
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
    """Slow a real robot down when a person is near.

    Not a safety function: see docs/robot_link.md. However the run ends, the
    robot's speed slider is set to 0.
    """
    require(
        0.0 < wait <= 3600.0,
        f"--wait: must be above 0 and at most 3600 s, got {wait:g}",
    )
    require(duration >= 0.0, f"--duration: must be 0 or more, got {duration:g}")
    require_control_period(control_period)
    scenario = load_scenario(
        filename=scenario_file, name=scenario_name, text=scenario_text
    )
    scenario.driver = driver = dc.replace(find_real_cell(scenario.driver))
    driver.allow_remote |= allow_remote
    addresses = _take_rings(driver, rings, human_motion=human_motion, seed=seed)
    override(
        scenario,
        ssm=ssm,
        human_motion=human_motion,
        seed=seed,
    )
    rings_here = find_rings(scenario.sensors)
    for name, sensor in scenario.sensors.items():
        require(
            name in rings_here,
            f"sensors.{name}: !{type(sensor).__name__} is for simulations; "
            "the ring link has rings only",
        )
    if not driver.is_virtual:
        scenario.people = {}
    driver.checks = options.make_robot_checks(
        checks_text, allow_no_pose=allow_no_pose, base=driver.checks
    )
    options.change_robot(
        driver, host=robot_host, port=robot_port, text=robot_text
    )
    _change_slider(driver, minimum_fraction, slider_limit, scenario)
    return run_session(
        SessionSettings(
            scenario=scenario,
            scenario_name=scenario_name,
            addresses=addresses,
            driver=driver,
            slider=make_slider_config(scenario),
            is_dry_run=dry_run or not driver.writes,
            max_deviation=math.inf if any_pose else driver.max_deviation,
            control_period=control_period,
            wait=wait,
            duration=duration,
            in_real_time=real_time,
            with_meshcat=meshcat,
            record=record,
            out=out,
            command=shlex.join(["tofssm", *sys.argv[1:]]),
        )
    )


def _take_rings(driver, rings, **virtual_only):
    """Takes --rings, if given; returns the addresses of the rings.

    Args:
        driver: Of the cell; changed.
        rings: --rings.
        **virtual_only: Options that are for simulated rings.

    Raises:
        UserError: There are none, one is wrong, or options clash.
    """
    where = "driver.rings"
    if rings:
        driver.rings, where = rings, "--rings"
    require(
        bool(driver.rings),
        "--rings: nothing says where the rings' frames come from; give an "
        f"address, or --rings {VIRTUAL} to simulate them",
    )
    driver.check_rings(where)
    for name, value in virtual_only.items():
        require(
            driver.is_virtual or value is None,
            f"--{name.replace('_', '-')}: is only for --rings {VIRTUAL}, got "
            f"{where} {', '.join(driver.rings)}",
        )
    return driver.parse_rings(where)


def _change_slider(driver, minimum_fraction, slider_limit, scenario):
    """Sets what the options say of the slider; errors name the options."""
    given = {
        "minimum_fraction": minimum_fraction,
        "operator_limit": slider_limit,
    }
    driver.slider = dc.replace(
        driver.slider, **{k: v for k, v in given.items() if v is not None}
    )
    option = {
        "slider.minimum_fraction": "--minimum-fraction",
        "slider.operator_limit": "--slider-limit",
    }
    with options.blame(option):
        driver.slider.check("slider")
    lowest = driver.slider.minimum_fraction
    reduced = scenario.law.traits.reduced_fraction
    require(
        lowest < reduced,
        "--minimum-fraction: must be below the law's reduced speed fraction, "
        f"{reduced:g}, got {lowest:g}",
    )
