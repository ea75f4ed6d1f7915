"""Options of the command line that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

ScenarioFile = Annotated[
    Path | None,
    typer.Option(help="YAML file of scenarios; default: those shipped."),
]
ScenarioName = Annotated[str, typer.Option(help="Which scenario of the file.")]
ScenarioText = Annotated[
    str,
    typer.Option(help="Settings to change, as YAML, e.g. '{a: {b: 1}}'."),
]
Ssm = Annotated[
    str | None,
    typer.Option(help="Safety law: vo, vr or sm.", metavar="vo|vr|sm"),
]
SensorsPerRing = Annotated[int | None, typer.Option(help="8 or 16.")]
HumanMotion = Annotated[
    Path | None,
    typer.Option(
        help="A BVH recording whose gait the person walks with.",
        metavar="FILE.bvh",
    ),
]
Seed = Annotated[int | None, typer.Option(help="Seed of the sensors' errors.")]
