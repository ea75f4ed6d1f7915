"""The report of a campaign: a single file that any browser opens, offline."""

import dataclasses as dc
import math
from pathlib import Path

from tofssm_drake.errors import UserError, require
from tofssm_drake.paper import campaign_figures
from tofssm_drake.paper.cell_style import SPAN
from tofssm_drake.paper.cells import SENSINGS, VARIANTS, Cell
from tofssm_drake.paper.claims import check_claims
from tofssm_drake.paper.columns import (
    AUDIT_METRICS,
    BY_NAME,
    COMPARED,
    METRICS,
    MONITORED_METRICS,
    add_count,
)
from tofssm_drake.paper.radar_figure import RADARS
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import join
from tofssm_drake.paper.verdict import make_claim_row, make_verdict
from tofssm_drake.recording.samples import (
    Samples,
    read_samples,
    write_atomically,
)
from tofssm_drake.reports import figures, tables
from tofssm_drake.reports.page import Picture, render_page
from tofssm_drake.reports.tables import Metric, make_cell_table
from tofssm_drake.studies.campaign import Plan
from tofssm_drake.studies.campaign_folder import get_run_folder

_NONE = "\u2013"
_PLAIN = ("tcp_speed", "true_distance")
_KINDS = (*_PLAIN, "measured_distance")


def make_difference_table(
    results: Results, pairs: list[tuple[Cell, Cell]], metrics: list[Metric]
) -> dict:
    """Returns a table of paired differences, see `tables`.

    A cell against itself without its variant is called by its own name: the
    table is about the variant.
    """
    labels = [
        second.label
        if first == dc.replace(second, variant=first.variant)
        else f"{first.label} \u2212 {second.label}"
        for first, second in pairs
    ]
    return tables.make_difference_table(results, pairs, metrics, labels)


def list_pairs(results: Results) -> dict[str, list[tuple[Cell, Cell]]]:
    """Returns the pairs of cells worth comparing, by what differs.

    Only pairs that were both run.
    """
    cells = results.cells
    plain = [cell for cell in cells if not cell.variant]

    def known(pairs):
        return [(a, b) for a, b in pairs if a in cells and b in cells]

    return {
        "sensing": known(
            (cell, dc.replace(cell, sensing="tof"))
            for cell in plain
            if cell.sensing in ("ideal", "lidar")
        ),
        "configuration": known(
            (cell, dc.replace(cell, configuration="vo"))
            for cell in plain
            if cell.configuration != "vo"
        ),
        "sixteen": known(
            (cell, dc.replace(cell, sensing="tof"))
            for cell in plain
            if cell.sensing == "tof16"
        ),
        **{
            key: known(
                (cell, dc.replace(cell, variant=""))
                for cell in cells
                if cell.variant == key
            )
            for key in VARIANTS
        },
    }


def read_first_runs(folder: Path, plan: Plan[Cell]) -> dict[Cell, Samples]:
    """Reads what the figures need of one run of each cell without a variant.

    Takes the first trial there is; leaves out cells without any.

    Raises:
        UserError: The samples of a finished run are missing or broken.
    """
    samples = {}
    for run in plan.list_runs():
        wanted = run.trial is not None and not run.cell.variant
        if not wanted or run.cell in samples:
            continue
        where = get_run_folder(folder, run)
        if (where / "row.parquet").exists():
            try:
                samples[run.cell] = _read_run(where)
            except UserError as error:
                raise UserError(
                    f"{error}; remove {where} to have the run repeated"
                ) from None
    return {cell: samples[cell] for cell in plan.cells if cell in samples}


def _read_run(where):
    """Returns the samples of a run with what the figures need."""
    samples = read_samples(where, _KINDS)
    for name in _PLAIN:
        require(
            name in samples.column,
            f"{where / 'samples.parquet'}: it has no column `{name}`",
        )
    return samples


def find_latencies(
    samples: dict[Cell, Samples],
) -> dict[str, dict[str, float]]:
    """Returns the parts of the worst latency, s, by sensing."""
    latencies: dict[str, dict[str, float]] = {}
    for cell, run in samples.items():
        audit = run.metadata.get("audit") or {}
        if "latency_s" in audit:
            latencies.setdefault(cell.sensing, audit["latency_s"])
    return latencies


def make_latency_table(
    latencies: dict[str, dict[str, float]],
) -> list[tuple[str, dict[str, str]]]:
    """Returns rows (part, text by sensing), in ms, the sum last."""
    parts = list(dict.fromkeys(p for of in latencies.values() for p in of))
    rows = [
        (
            part,
            {
                sensing: f"{1000 * of[part]:.0f}" if part in of else _NONE
                for sensing, of in latencies.items()
            },
        )
        for part in parts
    ]
    if rows:
        sums = {
            s: f"{1000 * sum(of.values()):.0f}" for s, of in latencies.items()
        }
        rows.append(("sum", sums))
    return rows


def write_campaign_report(
    folder: Path,
    *,
    plan: Plan[Cell],
    rows: list[dict],
    parameters: list[tuple[str, dict[str, str]]],
    command: str,
    failures: dict[str, str] | None = None,
) -> Path:
    """Writes report.html, and the figures as SVG and PNG, each file whole.

    Args:
        folder: The campaign's.
        plan: The campaign's.
        rows: What `make_results` returned.
        parameters: Rows of the table of parameters: name, and value by
            sensing.
        command: What makes the campaign again.
        failures: Reason by the label of the run that failed.

    Returns:
        The report's path.

    Raises:
        UserError: The folder cannot be written.
    """
    results = Results(rows)
    samples = read_first_runs(folder, plan)
    drawn = campaign_figures.list_figures(results, samples)
    pictures, contents = {}, {}
    for name, (make, description, arguments) in drawn.items():
        figure = make(*arguments)
        svg = figures.to_svg(figure)
        # The layout is done by now; it is a third of the work.
        figure.set_layout_engine("none")
        png = figures.to_png(figure)
        pictures[name] = Picture(
            wide=figures.encode_svg(svg),
            narrow=figures.to_data_uri(make(*arguments, narrow=True)),
            description=description,
        )
        contents[f"{name}.svg"] = svg.encode()
        contents[f"{name}.png"] = png
    page = make_campaign_report(
        plan=plan,
        results=results,
        pictures=pictures,
        parameters=parameters,
        latencies=find_latencies(samples),
        command=command,
        failures=failures or {},
    )
    # Nothing is written before everything is made.
    where = Path(folder) / "figures"
    where.mkdir(exist_ok=True)
    for name, content in contents.items():
        write_atomically(
            where / name, lambda p, content=content: p.write_bytes(content)
        )
    path = Path(folder) / "report.html"
    write_atomically(path, lambda p: p.write_text(page, "utf-8"))
    return path


def make_campaign_report(
    *,
    plan: Plan[Cell],
    results: Results,
    pictures: dict,
    parameters: list[tuple[str, dict[str, str]]],
    latencies: dict[str, dict[str, float]],
    command: str,
    failures: dict[str, str],
) -> str:
    """Returns the report as one HTML document.

    Args:
        plan: See `write_campaign_report`.
        results: Of the campaign.
        pictures: By the name that `list_figures` gives them.
        parameters: See `write_campaign_report`.
        latencies: From `find_latencies`.
        command: See `write_campaign_report`.
        failures: See `write_campaign_report`.
    """
    found = check_claims(results)
    plain = [cell for cell in results.cells if not cell.variant]
    sensings = list(dict.fromkeys(cell.sensing for cell in plain))
    return render_page(
        "campaign.html.jinja",
        room=__package__,
        trials=len(results.trials),
        runs=results.count_runs(),
        verdict=make_verdict(results, found, failures),
        claims=[make_claim_row(claim) for claim in found],
        pictures=pictures,
        **_make_tables(results, plain),
        latencies=make_latency_table(latencies),
        sensings=[(s, SENSINGS[s].name) for s in sensings],
        parameters=parameters,
        variants=list(VARIANTS.values()),
        varied=describe_variants(results),
        people=_make_people(plan),
        alone=_describe_alone(results),
        span=SPAN,
        versions=plan.versions,
        command=command,
        seed=plan.seed,
        failures=failures,
    )


def _make_tables(results, plain):
    """Returns the tables of the report by the template's names."""
    radar_metrics = [
        column
        for _, curves in RADARS
        for metric, _ in curves
        for column in add_count(BY_NAME[metric])
    ]
    # A law that does not monitor the person's speed must not rely on it.
    monitored = [cell for cell in plain if cell.configuration == "vo"]
    shortfall = AUDIT_METRICS[0].name
    compared = [BY_NAME[name] for name in COMPARED]
    return {
        "tables": {
            name: make_cell_table(results, plain, metrics)
            for name, metrics in METRICS.items()
        },
        "radar_table": make_cell_table(results, plain, radar_metrics),
        "audit": make_cell_table(results, plain, AUDIT_METRICS),
        "monitored": make_cell_table(results, monitored, MONITORED_METRICS),
        "has_audit": any(
            results.estimate(cell, shortfall).count for cell in plain
        ),
        "differences": {
            name: make_difference_table(results, rows, compared)
            for name, rows in list_pairs(results).items()
            if rows
        },
    }


def describe_variants(results: Results) -> str:
    """Returns which variants were run, and which others there are."""
    cells = results.cells
    run = [k for k in VARIANTS if any(c.variant == k for c in cells)]
    plain = [cell for cell in cells if not cell.variant]
    rest = [k for k in VARIANTS if k not in run]
    possible = [
        k
        for k in rest
        if any(VARIANTS[k].covers(c.sensing, c.configuration) for c in plain)
    ]
    impossible = [k for k in rest if k not in possible]
    return join(
        f"Run: {_name_variants(run)}." if run else "No variant was run.",
        f"Not run: {_name_variants(possible)}. The option --variant all adds "
        "them to this campaign."
        if possible
        else "",
        f"Without a cell in this campaign: {_name_variants(impossible)}."
        if impossible
        else "",
    )


def _name_variants(keys):
    return ", ".join(f"{key} ({VARIANTS[key].label})" for key in keys)


def _describe_alone(results):
    """Returns how long the run without a person took; empty: no such run."""
    if results.alone is None:
        return ""
    time = results.alone["task_time_s"]
    if math.isfinite(time):
        return f"Without a person the task takes {time:.1f} s."
    return (
        "Without a person the task is not finished in the "
        f"{results.alone['simulated_s']:.1f} s that were simulated."
    )


def _make_people(plan):
    """Rows of the table of trials."""
    motions = list(plan.motions)
    return [
        {
            "number": trial.number,
            "seed": trial.seed,
            "who": (
                motions[(trial.number - 1) % len(motions)]
                if motions
                else f"{trial.stature:.2f} m tall, {trial.speed:.2f} m/s"
            ),
            "start": f"{100 * trial.start:.0f} %",
            "direction": "reverse" if trial.reverse else "forward",
            "shift": f"{trial.centre[0]:+.2f}, {trial.centre[1]:+.2f}".replace(
                "-", "\u2212"
            ),
            "size": f"{trial.half_length:.2f} \u00d7 {trial.half_width:.2f}",
        }
        for trial in plan.trials
    ]
