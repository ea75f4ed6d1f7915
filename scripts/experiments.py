"""`tofssm experiments`: campaigns, the paper's and one's own."""

from pathlib import Path
from typing import Annotated

import typer

from tofssm_drake.errors import require
from tofssm_drake.scripts.campaign import Campaign, run_and_report
import tofssm_drake.scripts.options as options
from tofssm_drake.scripts.own_study import make_own_campaign
from tofssm_drake.scripts.paper_experiment import (
    VARIANTS,
    make_paper_campaign,
)


def experiments(
    study: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="YAML file of a study of your own, see docs/experiments.md. "
            "Default: the paper's experiment.",
            metavar="FILE.yaml",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(help="Trials per cell; default: 5, or the study's."),
    ] = None,
    sensing: Annotated[
        list[str] | None,
        typer.Option(
            help="Of the paper's cells: tof, ideal, lidar or tof16; can be "
            "repeated.",
            metavar="NAME",
        ),
    ] = None,
    ssm: Annotated[
        list[str] | None,
        typer.Option(
            help="Of the paper's cells, the safety law: "
            f"{options.SAFETY_LAWS}; can be repeated.",
            metavar="NAME",
        ),
    ] = None,
    variant: Annotated[
        list[str] | None,
        typer.Option(
            help="Also run the paper's cells with one thing changed, to see "
            f"its effect: all, none, or {', '.join(VARIANTS)}; can be "
            "repeated. Default: literal, if its cells are run.",
            metavar="NAME",
        ),
    ] = None,
    human_motions: Annotated[
        Path | None,
        typer.Option(
            parser=options.parse_path,
            help="Folder of BVH recordings; the trials use their gaits in "
            "turn. Default: people walk as the scenarios say.",
            metavar="DIR",
        ),
    ] = None,
    scenario_text: Annotated[
        str,
        typer.Option(help="Settings of all runs, as YAML."),
    ] = "",
    duration: Annotated[
        float | None,
        typer.Option(
            help="Longest simulated time of a run, s; default: 900, or that "
            "of the study's scenarios."
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of all trials; default: 0, or the study's."),
    ] = None,
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
    """Run a campaign, the paper's or your own, and write its report."""
    campaign: Campaign
    if study is None:
        campaign = make_paper_campaign(
            trials=5 if trials is None else trials,
            seed=0 if seed is None else seed,
            duration=900.0 if duration is None else duration,
            sensings=sensing,
            configurations=ssm,
            variants=variant,
            human_motions=human_motions,
            scenario_text=scenario_text,
            out=out,
        )
    else:
        for name, value in (
            ("--sensing", sensing),
            ("--ssm", ssm),
            ("--variant", variant),
        ):
            require(
                not value,
                f"{name}: chooses cells of the paper's experiment; a study of "
                "your own names its cells in its file",
            )
        campaign = make_own_campaign(
            study,
            trials=trials,
            seed=seed,
            duration=duration,
            human_motions=human_motions,
            scenario_text=scenario_text,
            out=out,
        )
    return run_and_report(campaign, scheduler, workers)
