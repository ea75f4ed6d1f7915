"""`tofssm hardware`: options of the monitor on a real robot."""

import math
from pathlib import Path
import shlex
import sys
from typing import Annotated

import typer

from tofssm_drake.diagrams.hardware_run import require_control_period
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.errors import require
from tofssm_drake.ringlink.ring_address import (
    parse_ring_address,
    require_distinct,
)
from tofssm_drake.rtde.slider import SliderConfig
from tofssm_drake.scripts.hardware_session import SessionSettings, run_session
import tofssm_drake.scripts.options as options
from tofssm_drake.scripts.simulate import override

_VIRTUAL = "virtual"
# The robot must start this close to the scenario's program, rad.
_NEAR_PROGRAM = 0.5


def hardware(
    robot_host: Annotated[
        str, typer.Option(help="Address of the robot, real or simulated.")
    ],
    rings: Annotated[
        list[str],
        typer.Option(
            help="Where the rings' frames come from; can be repeated. "
            "virtual simulates the rings around the real robot.",
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
        float,
        typer.Option(help="Slider position when stopped, 0 to 0.1."),
    ] = 0.0,
    slider_limit: Annotated[
        float | None,
        typer.Option(
            help="Highest slider position, until a person moves the slider. "
            "Default: where it stands at the start.",
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
        typer.Option(help="Longest run, s; 0: until all products are placed."),
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
    is_virtual = _check_rings(rings, human_motion=human_motion, seed=seed)
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
        human_motion=human_motion,
        seed=seed,
    )
    require(
        len(find_rings(scenario.sensors)) == len(scenario.sensors),
        "sensors: only rings are known to the ring link; others are for "
        "simulations",
    )
    if not is_virtual:
        scenario.people = {}
    checks = options.make_robot_checks(checks_text, allow_no_pose=allow_no_pose)
    slider = _make_slider_config(minimum_fraction, slider_limit, scenario)
    slider.arm = checks.arm
    return run_session(
        SessionSettings(
            scenario=scenario,
            scenario_name=scenario_name,
            addresses=tuple(addresses),
            robot=options.make_robot_config(
                robot_host, robot_port, robot_text, write=not dry_run
            ),
            slider=slider,
            checks=checks,
            is_dry_run=dry_run,
            max_deviation=math.inf if any_pose else _NEAR_PROGRAM,
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


def _check_rings(rings, **virtual_only):
    """Returns whether the rings are simulated; raises if options clash."""
    is_virtual = rings == [_VIRTUAL]
    require(
        is_virtual or _VIRTUAL not in rings,
        f"--rings: {_VIRTUAL} stands alone, got {', '.join(rings)}",
    )
    for name, value in virtual_only.items():
        require(
            is_virtual or value is None,
            f"--{name.replace('_', '-')}: is only for --rings {_VIRTUAL}, got "
            f"--rings {', '.join(rings)}",
        )
    return is_virtual


def _make_slider_config(minimum_fraction, slider_limit, scenario):
    """Returns checked settings of the slider; errors name the options."""
    config = SliderConfig(
        minimum_fraction=minimum_fraction, operator_limit=slider_limit
    )
    option = {
        "slider.minimum_fraction": "--minimum-fraction",
        "slider.operator_limit": "--slider-limit",
    }
    with options.blame(option):
        config.check("slider")
    reduced = scenario.law.traits.reduced_fraction
    require(
        minimum_fraction < reduced,
        "--minimum-fraction: must be below the law's reduced speed fraction, "
        f"{reduced:g}, got {minimum_fraction:g}",
    )
    config.reduced_fraction = reduced
    return config
