"""The paper's experiment as a campaign."""

import copy
from pathlib import Path
import shlex
import sys

from tofssm_drake.diagrams.run_metadata import get_versions
from tofssm_drake.diagrams.scenario import (
    Scenario,
    change_scenario,
    dump_scenario,
    find_lidars,
    find_threshold_offsets,
    load_scenario,
)
from tofssm_drake.errors import UserError, require
from tofssm_drake.laws.config import CONFIGURATIONS
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.paper.campaign_report import write_campaign_report
from tofssm_drake.paper.cells import (
    SENSINGS,
    VARIANTS,
    Cell,
    list_variants,
    make_plan,
)
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.scripts.campaign import (
    Campaign,
    calc_digests,
    read_motions,
)
import tofssm_drake.scripts.options as options
from tofssm_drake.studies.campaign import Plan
from tofssm_drake.studies.campaign_folder import write_results

__all__ = ["VARIANTS", "make_paper_campaign"]


def make_paper_campaign(
    *,
    out: Path,
    trials: int,
    seed: int,
    duration: float,
    sensings: list[str] | None,
    configurations: list[str] | None,
    variants: list[str] | None,
    human_motions: Path | None,
    scenario_text: str,
) -> Campaign[Cell]:
    """Makes the paper's campaign; the options are those of the command.

    Raises:
        UserError: An option is wrong.
    """
    scenario = load_scenario(text=scenario_text)
    scenario.simulation_duration = duration
    require_free(scenario)
    with options.blame({"simulation_duration": "--duration"}):
        scenario.check()
    recordings = read_motions(human_motions, scenario.control_period)
    sensings = sensings or list(SENSINGS)
    configurations = configurations or list(CONFIGURATIONS)
    chosen = choose_variants(variants, list_variants(sensings, configurations))
    plan = make_plan(
        seed=seed,
        trials=trials,
        sensings=sensings,
        configurations=configurations,
        variants=chosen,
        scenario=dump_scenario(scenario),
        motions=calc_digests(recordings),
        versions=get_versions(),
    )
    command = make_command(sys.argv[1:], variants, chosen)

    def write_report(campaign, rows, failures):
        write_results(campaign.out, plan, rows)
        return write_campaign_report(
            campaign.out,
            plan=plan,
            rows=rows,
            parameters=list_parameters(scenario, plan),
            command=command,
            failures=failures,
        )

    return Campaign(
        out=out,
        plan=plan,
        scenarios={
            cell: make_cell_scenario(scenario, cell) for cell in plan.cells
        },
        recordings=recordings,
        write_report=write_report,
        # A lidar at the base stops the robot most.
        is_long=lambda run: run.cell.sensing == "lidar",
    )


def make_cell_scenario(base: Scenario, cell: Cell) -> Scenario:
    """Returns the scenario of a cell of the paper.

    Args:
        base: What all cells have in common; not changed.
        cell: Which.
    """
    scenario = copy.deepcopy(base)
    source = SENSINGS[cell.sensing].sensors_of
    if source:
        scenario.sensors = load_scenario(name=source).sensors
    for changes in cell.changes:
        scenario = change_scenario(scenario, changes, source=cell.key)
    return scenario


def choose_variants(names: list[str] | None, possible: list[str]) -> list[str]:
    """Returns which variants are run.

    Args:
        names: As given; None: not given, which means the literal law.
        possible: Variants that have a cell in this campaign. `all` means
            these; a variant asked for by name is never left out.

    Raises:
        UserError: `none` is not alone, or a name is given twice.
    """
    if names is None:
        return [name for name in possible if name == "literal"]
    require(
        "none" not in names or names == ["none"],
        "--variant: none excludes any other variant",
    )
    if names == ["none"]:
        return []
    require(
        len(set(names)) == len(names),
        f"--variant: {', '.join(names)} names one of them twice",
    )
    if "all" not in names:
        return names
    others = [n for n in names if n != "all" and n not in possible]
    return [*possible, *others]


def make_command(
    arguments: list[str], asked: list[str] | None, variants: list[str]
) -> str:
    """Returns the command that makes the campaign again.

    Args:
        arguments: Of this command.
        asked: Variants that they name; None: none.
        variants: The variants that are run; always named in the result.
    """
    added = []
    if asked is None:
        added = [
            part for s in variants or ["none"] for part in ("--variant", s)
        ]
    return shlex.join(["tofssm", *arguments, *added])


def require_free(scenario: Scenario) -> None:
    """Raises UserError if the text changes what cells or trials decide."""
    default = load_scenario()
    people = copy.deepcopy(default.people)
    for name, person in people.items():
        changed = scenario.people.get(name)
        if isinstance(person, GeneratedWalk) and isinstance(
            changed, GeneratedWalk
        ):
            person.figure_eight = changed.figure_eight
    for name, same in {
        "sensors": [(n, type(s)) for n, s in scenario.sensors.items()]
        == [(n, type(s)) for n, s in default.sensors.items()],
        "random_seed": scenario.random_seed == default.random_seed,
        "law.configuration": get_law(scenario).configuration
        == get_law(default).configuration,
        "people": scenario.people == people,
    }.items():
        require(
            same,
            f"--scenario-text: {name}: is decided by the campaign's cells and "
            "trials; see --sensing, --ssm, --seed and --human-motions",
        )


def get_law(scenario: Scenario) -> TriSsm:
    """Returns the law of a scenario.

    Raises:
        UserError: It has no configurations that could be compared.
    """
    if not isinstance(scenario.law, TriSsm):
        raise UserError(
            "--scenario-text: law: must be !TriSsm, whose configurations the "
            "campaign compares"
        )
    return scenario.law


def list_parameters(
    scenario: Scenario, plan: Plan[Cell]
) -> list[tuple[str, dict[str, str]]]:
    """Returns the paper's table of parameters, as run.

    Returns:
        Rows (name, value by sensing).
    """
    scenarios = {
        cell.sensing: make_cell_scenario(scenario, cell)
        for cell in plan.cells
        if not cell.variant
    }
    laws = {
        sensing: get_law(s).grow(float(find_threshold_offsets(s)[0]))
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
