"""The columns of the tables: the paper's evaluation metric, and the audit."""

from tofssm_drake.reports.tables import Metric


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
        name="ur10_stop_over_T_stop_s",
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

COMPARED = (
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
"""Columns of the tables of differences."""
BY_NAME = {m.name: m for group in METRICS.values() for m in group}


def add_count(metric: Metric) -> tuple[Metric, ...]:
    """Returns a column and, if there is one, the column of its events."""
    count = BY_NAME.get(metric.name.removesuffix("_s") + "_events")
    return (metric, count) if count else (metric,)
