"""The report of a campaign: a single file that any browser opens, offline."""

import collections
import dataclasses as dc
import math
from pathlib import Path

from tofssm_drake.errors import UserError
from tofssm_drake.paper import campaign_figures
from tofssm_drake.paper.campaign import (
    VARIANTS,
    Cell,
    Plan,
    get_run_folder,
)
from tofssm_drake.paper.campaign_figures import CONFIGURATION_NAME
from tofssm_drake.paper.claims import (
    NO_VALUE,
    NOT_REPRODUCED,
    NOT_RUN,
    REPRODUCED,
    UNDECIDED,
    Claim,
    check_claims,
)
from tofssm_drake.paper.explanations import join
from tofssm_drake.paper.results import Results
from tofssm_drake.recording.samples import (
    Samples,
    read_samples,
    write_atomically,
)
from tofssm_drake.reports import figures
from tofssm_drake.reports.page import Picture, render_page
from tofssm_drake.reports.report import count_of
from tofssm_drake.studies.statistics import (
    Estimate,
    calc_rate_bound,
    format_estimate,
)

_NONE = "\u2013"
_MARK = {
    REPRODUCED: "\u2713",
    NOT_REPRODUCED: "\u2717",
    UNDECIDED: "?",
    NO_VALUE: _NONE,
    NOT_RUN: _NONE,
}
_KINDS = ("tcp_speed", "true_distance", "measured_distance")


@dc.dataclass(frozen=True, kw_only=True)
class Metric:
    """A column of the tables."""

    name: str
    """Of the results' column."""
    label: str
    unit: str
    digits: int = 2
    scale: float = 1.0
    is_worst: bool = False
    """Whether to show the greatest value of all runs, not the mean."""
    is_count: bool = False
    """Whether to show the sum and the runs with any, not the mean."""
    whole: str = ""
    """Column of which this one counts a part; shown as `part of whole`."""


def _make_time_metrics(kind, counted, alike):
    """Columns of the time to stop, or to reduce."""
    name = f"time_to_{kind}"
    return (
        Metric(name=f"{name}_s", label=f"time to {kind}", unit="s", digits=3),
        Metric(
            name=f"{name}_events",
            label=counted,
            unit="of all, per run",
            whole=f"{kind}_events",
        ),
        Metric(name=f"{name}_alike_s", label=alike, unit="s", digits=3),
    )


_TIMES = {
    "stop": _make_time_metrics(
        "stop", "stops timed", "to stop, from half speed"
    ),
    "reduce": _make_time_metrics(
        "reduce", "reductions timed", "to reduce, from full speed"
    ),
}
METRICS = {
    "Safety": (
        Metric(
            name="velocity_change_at_stop_mps",
            label="velocity change at stop",
            unit="m/s",
        ),
        Metric(
            name="separation_at_stop_m", label="separation at stop", unit="m"
        ),
        Metric(
            name="separation_at_reduce_m",
            label="separation at reduce",
            unit="m",
        ),
        Metric(name="mean_true_distance_m", label="mean separation", unit="m"),
        Metric(
            name="safety_mean_m2_per_mps",
            label="safety metric, mean",
            unit="m\u00b2/(m/s)",
        ),
        Metric(
            name="safety_ratio_of_means_m2_per_mps",
            label="ratio of means",
            unit="m\u00b2/(m/s)",
        ),
        Metric(
            name="safety_median_m2_per_mps",
            label="median",
            unit="m\u00b2/(m/s)",
        ),
        Metric(
            name="contacts_while_moving",
            label="contacts while moving",
            unit="in all runs",
            is_count=True,
        ),
    ),
    "Performance": (
        *_TIMES["stop"],
        *_TIMES["reduce"],
        Metric(name="reaction_time_s", label="reaction time", unit="s"),
        Metric(
            name="missed_events",
            label="missed",
            unit="per run",
            digits=1,
        ),
        Metric(
            name="false_events", label="false stops", unit="per run", digits=1
        ),
    ),
    "Performance: changes of state, and what is measured": (
        Metric(
            name="state_changes_per_episode",
            label="state changes",
            unit="per episode",
            digits=1,
        ),
        Metric(
            name="slow_episodes", label="episodes", unit="per run", digits=1
        ),
        Metric(
            name="state_changes_per_min",
            label="state changes",
            unit="per minute",
            digits=0,
        ),
        Metric(
            name="distance_rmse_centre_m",
            label="RMSE, from centre",
            unit="mm",
            digits=0,
            scale=1000.0,
        ),
        Metric(
            name="distance_rmse_surface_m",
            label="RMSE, from surface",
            unit="mm",
            digits=0,
            scale=1000.0,
        ),
        Metric(
            name="detection_share",
            label="seen while in range",
            unit="%",
            digits=0,
            scale=100.0,
        ),
    ),
    "Productivity": (
        Metric(
            name="productivity",
            label="productivity",
            unit="%",
            digits=1,
            scale=100.0,
        ),
        Metric(
            name="productivity_measured",
            label="productivity, measured",
            unit="%",
            digits=1,
            scale=100.0,
        ),
        Metric(name="task_time_s", label="task time", unit="s", digits=1),
        Metric(name="stopped_s", label="stopped", unit="s", digits=1),
        Metric(name="reduced_s", label="reduced", unit="s", digits=1),
        Metric(
            name="products_placed",
            label="products placed",
            unit="",
            digits=1,
        ),
    ),
}
"""The paper's evaluation metric (its first table): criteria and columns."""


def _make_shortfall_metrics(name, label, **options):
    """Returns columns of a shortfall: its name, label of its median."""
    columns = (
        ("p50_m", label, {"unit": "m"}),
        ("max_m", "mean of the runs\u2019 worst", {"unit": "m"}),
        ("max_m", "worst of all runs", {"unit": "m", "is_worst": True}),
        (
            "share",
            "time too short",
            {"unit": "%", "digits": 0, "scale": 100.0},
        ),
    )
    return tuple(
        Metric(
            name=f"shortfall_{name}_{suffix}", label=text, **about, **options
        )
        for suffix, text, about in columns
    )


AUDIT_METRICS = (
    *_make_shortfall_metrics("walking_in", "shortfall, walking in: median"),
    Metric(
        name="inside_protective_s",
        label="not told to stop inside S_p",
        unit="s per run",
        digits=1,
    ),
    Metric(
        name="latency_over_T_R_s",
        label="worst latency over T_R",
        unit="ms",
        digits=0,
        scale=1000.0,
        is_worst=True,
    ),
    Metric(
        name="stated_stop_over_T_stop_s",
        label="UR10\u2019s stop over T_stop",
        unit="ms",
        digits=0,
        scale=1000.0,
        is_worst=True,
    ),
)
"""Columns of the audit's table."""
MONITORED_METRICS = (
    *_make_shortfall_metrics("as_reckoned", "as monitored: median"),
    Metric(
        name="shortfall_as_reckoned_clear_share",
        label="of that with nothing measured",
        unit="%",
        digits=0,
        scale=100.0,
    ),
    *_make_shortfall_metrics(
        "measuring", "as measured, links that measure: median"
    ),
)
"""Columns of the table of laws that monitor the person's speed."""

_COMPARED = (
    "productivity",
    "safety_mean_m2_per_mps",
    "velocity_change_at_stop_mps",
    "separation_at_stop_m",
    "reaction_time_s",
    "contacts_while_moving",
    "state_changes_per_episode",
    "distance_rmse_surface_m",
    "detection_share",
)
_BY_NAME = {m.name: m for group in METRICS.values() for m in group}


def _add_count(metric):
    """Returns a column and, if there is one, the column of its events."""
    count = _BY_NAME.get(metric.name.removesuffix("_s") + "_events")
    return (metric, count) if count else (metric,)


def make_cell_table(results: Results, cells, metrics) -> dict:
    """Returns a table with a row per cell: mean with interval.

    Args:
        results: Of the campaign.
        cells: Rows.
        metrics: Columns.

    Returns:
        `head`, pairs (label, unit), and `rows`, pairs (cell, texts).
    """

    def write(cell, metric):
        value = results.estimate(cell, metric.name)
        if metric.is_count and value.count:
            return _count_in_runs(results, cell, metric)
        if metric.whole and value.count:
            whole = results.estimate(cell, metric.whole)
            return f"{value.mean:.0f} of {whole.mean:.0f}"
        if metric.is_worst and value.count:
            known = results.values(cell, metric.name).values()
            worst = max(v for v in known if math.isfinite(v))
            value = Estimate(mean=worst, half_width=math.nan, count=1)
        return _format(value, metric)

    return {
        "head": [(m.label, m.unit) for m in metrics],
        "rows": [(cell, [write(cell, m) for m in metrics]) for cell in cells],
    }


def _count_in_runs(results, cell, metric):
    """Returns `6 in 2 of 5 runs`: counts have no symmetric interval."""
    known = results.values(cell, metric.name).values()
    known = [value for value in known if math.isfinite(value)]
    if not sum(known):
        return f"0 in {_count(len(known), 'run')}"
    some = sum(value > 0.0 for value in known)
    return f"{sum(known):.0f} in {some} of {_count(len(known), 'run')}"


def make_difference_table(results: Results, pairs, metrics) -> dict:
    """Returns a table of paired differences.

    Args:
        results: Of the campaign.
        pairs: (first, second) cells; a row is first - second.
        metrics: Columns.

    Returns:
        `head` as in `make_cell_table`, and `rows`, pairs (label, entries).
        An entry is (text, whether 0 is outside the interval).
    """
    rows = []
    for first, second in pairs:
        entries = []
        for m in metrics:
            value = results.difference(first, second, m.name)
            clear = value.low > 0.0 or value.high < 0.0
            entries.append((_format(value, m, sign=True), clear))
        label = f"{first.label} \u2212 {second.label}"
        if first == dc.replace(second, variant=first.variant):
            # The table is about the variant.
            label = second.label
        rows.append((label, entries))
    # A difference of shares in % is not a share of anything.
    units = {"%": "points", "in all runs": "per run"}
    head = [(m.label, units.get(m.unit, m.unit)) for m in metrics]
    return {"head": head, "rows": rows}


def _format(value, metric, *, sign=False):
    return format_estimate(
        value.scale(metric.scale), digits=metric.digits, sign=sign
    )


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


def make_claim_row(claim: Claim) -> dict:
    """Returns what the report shows of a claim."""
    return {
        "text": claim.text,
        "verdict": claim.verdict,
        "is_run": claim.verdict != NOT_RUN,
        "kind": {
            REPRODUCED: "good",
            NOT_REPRODUCED: "bad",
            UNDECIDED: "open",
            NO_VALUE: "none",
            NOT_RUN: "none",
        }[claim.verdict],
        "unit": claim.unit,
        "note": claim.note,
        "why": claim.why,
        "evidence": [
            {
                "what": e.what,
                "value": format_estimate(
                    e.estimate, digits=claim.digits, sign="\u2212" in e.what
                ),
                "verdict": e.verdict,
                "mark": _MARK[e.verdict],
            }
            for e in claim.evidence
        ],
    }


def make_verdict(
    results: Results, found: list[Claim], failures: dict[str, str]
) -> list[tuple[str, str]]:
    """Returns the results in plain words.

    Args:
        results: Of the campaign.
        found: The claims.
        failures: Reason by the label of the run that failed.

    Returns:
        (grade, sentence) pairs; grade is `good`, `bad` or `note`.
    """
    runs = results.count_runs()
    verdict = [
        _judge_claims(results, found),
        *_judge_contacts(results),
        *_judge_unfinished(results),
    ]
    if failures:
        verdict.append(
            (
                "bad",
                f"{len(failures)} of {_count(runs + len(failures), 'run')} "
                "failed and left nothing in what follows.",
            )
        )
    return verdict


def _judge_claims(results, found):
    if len(results.trials) == 1:
        return (
            "note",
            "One trial has no confidence interval: no claim of the paper "
            "can be decided, whatever the numbers look like. The option "
            "--trials 5 adds trials to this campaign.",
        )
    count = collections.Counter(claim.verdict for claim in found)
    judged = len(found) - count[NOT_RUN] - count[NO_VALUE]
    return (
        "note",
        f"Of {_count(judged, 'claim')} of the paper that this campaign can "
        f"judge, {_be(count[REPRODUCED])} reproduced, "
        f"{_be(count[NOT_REPRODUCED])} not, and {_be(count[UNDECIDED])} "
        "undecided.",
    )


def _judge_contacts(results):
    plain = [cell for cell in results.cells if not cell.variant]
    runs = sum(len(results.values(cell, "finished")) for cell in plain)
    contacts = results.total("contacts_while_moving", plain)
    if contacts:
        with_contact = sum(
            value > 0
            for cell in plain
            for value in results.values(cell, "contacts_while_moving").values()
        )
        return [
            (
                "bad",
                f"In {with_contact} of {_count(runs, 'run')} the moving robot "
                f"touched the person ({count_of(round(contacts), 'contact')}). "
                "Runs with a contact: "
                f"{_count_by_configuration(results, plain)}.",
            )
        ]
    if not runs:
        return []
    bound = 100 * calc_rate_bound(runs)
    return [
        (
            "good",
            f"The moving robot touched nobody in {_count(runs, 'run')}. That "
            f"only bounds the rate of contacts below {bound:.1f} % per run, "
            "with 95 % confidence.",
        )
    ]


def _judge_unfinished(results):
    runs = results.count_runs()
    unfinished = runs - results.total("finished")
    if not unfinished:
        return []
    return [
        (
            "note",
            f"In {unfinished:.0f} of {_count(runs, 'run')} the task was not "
            "finished when the time was up: "
            f"{_describe_unfinished(results)}. In brackets, for how much of "
            "the time the person was truly within the distance at which the "
            "law stops the robot. Their productivity is that of the part "
            "that was done.",
        )
    ]


def _count(count, noun):
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _be(count):
    return f"{count} {'is' if count == 1 else 'are'}"


def _describe_unfinished(results):
    """Lists by cell what was not finished, and how long a stop was due."""
    parts = []
    for cell in results.cells:
        finished = results.values(cell, "finished")
        undone = sum(value == 0.0 for value in finished.values())
        if not undone:
            continue
        text = f"{cell.label} {undone} of {len(finished)}"
        due = results.estimate(cell, "stop_due_share")
        if due.count:
            text += f" ({100 * due.mean:.0f} %)"
        parts.append(text)
    return ", ".join(parts)


def _count_by_configuration(results, cells):
    """Returns how many runs had a contact, by configuration."""
    parts = []
    for c, name in CONFIGURATION_NAME.items():
        values = [
            value
            for cell in cells
            if cell.configuration == c
            for value in results.values(cell, "contacts_while_moving").values()
        ]
        if values:
            touched = sum(value > 0 for value in values)
            parts.append(f"{name} {touched} of {len(values)}")
    return ", ".join(parts)


def list_figures(
    results: Results, samples: dict[Cell, Samples]
) -> dict[str, tuple]:
    """Returns how to draw each figure: (function, description, arguments).

    Args:
        results: Of the campaign.
        samples: One run of each cell without a variant.
    """
    nine = {
        cell: run for cell, run in samples.items() if cell.sensing != "tof16"
    }
    over_time = {
        cell: run for cell, run in nine.items() if cell.configuration == "vo"
    }
    return {
        "fig09_distance": (
            campaign_figures.make_distance_figure,
            "Measured against true distance over time for each sensing, and "
            "bars of their errors.",
            (results, over_time or nine),
        ),
        "fig10_productivity_safety": (
            campaign_figures.make_productivity_figure,
            "Productivity against safety metric: mean and confidence ellipse "
            "of each cell, and every run as a faint point.",
            (results,),
        ),
        "fig11_response": (
            campaign_figures.make_response_figure,
            "Tool speed and measured distance over time, a panel per cell.",
            (nine,),
        ),
        "fig11_phase": (
            campaign_figures.make_phase_figure,
            "How often which tool speed at which measured distance, a panel "
            "per cell.",
            (nine,),
        ),
        "audit_shortfall": (
            campaign_figures.make_audit_figure,
            "For each cell by how much its critical distance is shorter than "
            "the protective separation distance of ISO/TS 15066.",
            (results,),
        ),
        "fig12_radars": (
            campaign_figures.make_radar_figure,
            "Four radars: reaction time, times to stop and to reduce, tool "
            "speed at a stop, separation at events. The numbers are in the "
            "table beside it.",
            (results,),
        ),
    }


def read_first_runs(folder: Path, plan: Plan) -> dict[Cell, Samples]:
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
                samples[run.cell] = read_samples(where, _KINDS)
            except UserError as error:
                raise UserError(
                    f"{error}; remove {where} to have the run repeated"
                ) from None
    return {cell: samples[cell] for cell in plan.cells if cell in samples}


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
    plan: Plan,
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
    drawn = list_figures(results, samples)
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
    plan: Plan,
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
        sensings=[(s, campaign_figures.SENSING_NAME[s]) for s in sensings],
        parameters=parameters,
        studies=list(VARIANTS.values()),
        studied=describe_studies(results),
        people=_make_people(plan),
        alone=_describe_alone(results),
        span=campaign_figures.SPAN,
        versions=plan.versions,
        command=command,
        seed=plan.seed,
        failures=failures,
    )


def _make_tables(results, plain):
    """Returns the tables of the report by the template's names."""
    radar_metrics = [
        column
        for _, curves in campaign_figures.RADARS
        for metric, _ in curves
        for column in _add_count(_BY_NAME[metric])
    ]
    # A law that does not monitor the person's speed must not rely on it.
    monitored = [cell for cell in plain if cell.configuration == "vo"]
    shortfall = AUDIT_METRICS[0].name
    compared = [_BY_NAME[name] for name in _COMPARED]
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


def describe_studies(results: Results) -> str:
    """Returns which studies were run, and which others there are."""
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
        f"Run: {_name_studies(run)}." if run else "No study was run.",
        f"Not run: {_name_studies(possible)}. The option --study all adds "
        "them to this campaign."
        if possible
        else "",
        f"Without a cell in this campaign: {_name_studies(impossible)}."
        if impossible
        else "",
    )


def _name_studies(keys):
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
