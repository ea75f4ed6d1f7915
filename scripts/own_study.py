"""A study of one's own as a campaign."""

from pathlib import Path
import shlex
import sys

from tofssm_drake.diagrams.run_metadata import get_versions
from tofssm_drake.diagrams.study_file import (
    load_study,
    make_study_scenarios,
    read_recordings,
)
from tofssm_drake.reports.study_report import write_study_report
from tofssm_drake.scripts.campaign import (
    Campaign,
    calc_digests,
    read_motions,
)
from tofssm_drake.studies.campaign_folder import write_results
from tofssm_drake.studies.study import (
    StudyCell,
    add_time_lost,
    make_study_plan,
)


def make_own_campaign(
    filename: Path,
    *,
    out: Path,
    trials: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    human_motions: Path | None = None,
    scenario_text: str = "",
) -> Campaign[StudyCell]:
    """Makes the campaign of a study.

    Args:
        filename: The study's file, see `Study`.
        out: Folder for the results.
        trials: Instead of the study's.
        seed: Instead of the study's.
        duration: Instead of the scenarios' longest simulated time, s.
        human_motions: Folder of recordings; the trials use their gaits.
        scenario_text: Further settings of all cells, as YAML.

    Raises:
        UserError: The file or an option is wrong.
    """
    study = load_study(filename)
    scenarios = make_study_scenarios(
        study, filename, text=scenario_text, duration=duration
    )
    first = next(iter(scenarios.values()))
    motions = read_motions(human_motions, first.control_period)
    plan = make_study_plan(
        list(scenarios),
        seed=study.seed if seed is None else seed,
        trials=study.trials if trials is None else trials,
        motions=calc_digests(motions),
        versions=get_versions(),
    )
    command = shlex.join(["tofssm", *sys.argv[1:]])

    def write_report(campaign, rows, failures):
        rows = add_time_lost(rows)
        write_results(campaign.out, plan, rows)
        return write_study_report(
            campaign.out,
            plan=plan,
            study=study,
            rows=rows,
            command=command,
            failures=failures,
        )

    recordings = dict(motions)
    for scenario in scenarios.values():
        recordings |= read_recordings(scenario)
    return Campaign(
        out=out,
        plan=plan,
        scenarios=scenarios,
        recordings=recordings,
        write_report=write_report,
    )
