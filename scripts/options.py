"""Command line options that several commands share."""

from collections.abc import Iterator
import contextlib
import dataclasses as dc
from pathlib import Path
from typing import Annotated

import typer

from tofssm_drake.diagrams.drivers import RealCell
from tofssm_drake.diagrams.scenario import change_settings
from tofssm_drake.errors import UserError, require
from tofssm_drake.laws.config import CONFIGURATIONS
from tofssm_drake.rtde.robot_checks import RobotChecks


def parse_path(text: str) -> Path:
    """Returns the path; an empty one would mean the current folder."""
    if not str(text):
        raise typer.BadParameter("must not be empty")
    return Path(text)


ScenarioFile = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        help="YAML file of scenarios; default: the shipped ones.",
        metavar="FILE.yaml",
    ),
]
ScenarioName = Annotated[str, typer.Option(help="Which scenario of the file.")]
ScenarioText = Annotated[
    str,
    typer.Option(help="Settings to change, as YAML, e.g. '{a: {b: 1}}'."),
]
SAFETY_LAWS = f"{', '.join(CONFIGURATIONS[:-1])} or {CONFIGURATIONS[-1]}"

Ssm = Annotated[
    str | None,
    typer.Option(
        help=f"Safety law: {SAFETY_LAWS}.",
        metavar="|".join(CONFIGURATIONS),
    ),
]
HumanMotion = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        help="BVH recording that gives the person's gait.",
        metavar="FILE.bvh",
    ),
]
Seed = Annotated[int | None, typer.Option(help="Seed of the sensors' errors.")]
RobotPort = Annotated[
    int | None,
    typer.Option(help="The UR robot's RTDE port; default: the scenario's."),
]
RobotText = Annotated[
    str,
    typer.Option(
        help="Settings of the RTDE connection to change, as YAML, e.g. "
        "'{heartbeat_register: 25}'; see docs/robot_link.md."
    ),
]
ChecksText = Annotated[
    str,
    typer.Option(
        help="Settings of the robot checks to change, as YAML, e.g. "
        "'{arm: {ramp_time: 0.25}}'; see docs/robot_link.md."
    ),
]


def make_robot_checks(
    text: str, *, allow_no_pose: bool, base: RobotChecks
) -> RobotChecks:
    """Returns the settings of the robot's checks, validated.

    Args:
        text: --checks-text.
        base: What it changes: the scenario's.
        allow_no_pose: --allow-no-pose.

    Raises:
        UserError: A setting is unknown, out of range or has its own option.
    """
    checks = change_settings(base, text, source="--checks-text", where="checks")
    require(
        checks.model.allow_no_pose == base.model.allow_no_pose,
        "--checks-text: checks.model.allow_no_pose: use --allow-no-pose",
    )
    checks.model.allow_no_pose |= allow_no_pose
    checks.check("checks")
    return checks


def change_robot(
    driver: RealCell, *, host: str | None, port: int | None, text: str
) -> None:
    """Sets what the options say of the connection to the robot.

    Args:
        driver: Of the cell; changed. It takes the options if it has settings
            `robot` with host and port.
        host: --robot-host; None: the driver's own.
        port: --robot-port; likewise.
        text: --robot-text.

    Raises:
        UserError: A setting is unknown, out of range or has its own option, or
            the driver has no such settings.
    """
    base = vars(driver).get("robot")
    if base is None:
        for option, value in (
            ("--robot-host", host),
            ("--robot-port", port),
            ("--robot-text", text or None),
        ):
            require(
                value is None,
                f"{option}: is not for the driver !{type(driver).__name__}; "
                "use --scenario-text '{driver: {parameters: {...}}}'",
            )
        return
    settings = change_settings(base, text, source="--robot-text", where="robot")
    for name, option in (
        ("host", "--robot-host"),
        ("port", "--robot-port"),
        ("write", "--dry-run"),
    ):
        require(
            getattr(settings, name) == getattr(base, name),
            f"--robot-text: robot.{name}: use {option}",
        )
    settings = dc.replace(
        settings,
        host=base.host if host is None else host,
        port=base.port if port is None else port,
    )
    with blame({"robot.host": "--robot-host", "robot.port": "--robot-port"}):
        settings.check("robot")
    vars(driver)["robot"] = settings


@contextlib.contextmanager
def blame(option: dict[str, str]) -> Iterator[None]:
    """Names the option, not the setting, where a setting is refused.

    Args:
        option: Option by the setting that the message begins with.
    """
    try:
        yield
    except UserError as error:
        setting, colon, reason = str(error).partition(":")
        name = option.get(setting, setting)
        raise UserError(f"{name}{colon}{reason}") from None
