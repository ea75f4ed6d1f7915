"""What the columns of a run's metrics are, see docs/metrics.md."""

from tofssm_drake.metrics.audit import QUANTILES
from tofssm_drake.recording.columns import Column


def _count(meaning):
    return Column(meaning=f"number of {meaning}")


_TASK = {
    "simulated_s": Column(unit="s", meaning="length of the record"),
    "products_placed": _count("products placed"),
    "finished": Column(meaning="1: the task was finished, 0: not"),
    "task_time_s": Column(
        unit="s", meaning="time until the task was finished (t_HRI)"
    ),
    "nominal_time_s": Column(
        unit="s", meaning="what the same motion takes at full speed (t_NoHRI)"
    ),
    "productivity": Column(meaning="t_NoHRI / t_HRI, of the part done"),
}

_SAFETY = {
    "safety_mean_m2_per_mps": Column(
        unit="m s",
        meaning="mean of true distance squared over tool speed, tool moving",
    ),
    "safety_ratio_of_means_m2_per_mps": Column(
        unit="m s",
        meaning="mean of true distance squared over mean of tool speed",
    ),
    "safety_median_m2_per_mps": Column(
        unit="m s",
        meaning="median of true distance squared over tool speed, tool moving",
    ),
    "contacts_while_moving": _count("contacts while the robot moved"),
    "contact_speed_max_mps": Column(
        unit="m/s", meaning="greatest speed of a touching robot point"
    ),
    "min_true_distance_m": Column(
        unit="m", meaning="least true distance between the surfaces"
    ),
    "mean_true_distance_m": Column(
        unit="m", meaning="mean true distance between the surfaces"
    ),
    "late_stops": _count("stops that came late"),
    "tcp_speed_max_mps": Column(unit="m/s", meaning="highest tool speed"),
}

_EVENTS = {
    "stop_events": _count("changes to stop"),
    "reduce_events": _count("changes from normal to reduced"),
    "velocity_change_at_stop_mps": Column(
        unit="m/s", meaning="mean tool speed when told to stop"
    ),
    "separation_at_stop_m": Column(
        unit="m", meaning="mean true distance when told to stop"
    ),
    "separation_at_reduce_m": Column(
        unit="m", meaning="mean true distance when told to slow down"
    ),
    "d_C_at_stop_m": Column(
        unit="m",
        meaning="mean distance at which the law stops, when told to stop, of "
        "the link that decides",
    ),
    "d_R_at_reduce_m": Column(
        unit="m",
        meaning="mean distance at which the law slows, when told to slow "
        "down, of the link that decides",
    ),
    "stopped_s": Column(unit="s", meaning="time in stop after the start"),
    "reduced_s": Column(unit="s", meaning="time in reduced after the start"),
    "normal_s": Column(unit="s", meaning="time in normal after the start"),
    "stopped_share": Column(meaning="share of these times that is stop"),
    "stop_due_share": Column(
        meaning="share of the time after the start in which, by the true "
        "distances, a stop was due"
    ),
    "slow_episodes": _count("episodes of slowing down"),
    "state_changes": _count("changes of state"),
    "state_changes_per_min": Column(
        unit="1/min", meaning="changes of state per minute after the start"
    ),
    "state_changes_per_episode": Column(meaning="changes of state per episode"),
}

_REACTIONS = {
    "approaches": _count("approaches of the person"),
    "reaction_events": _count("approaches with a reaction time"),
    "reaction_time_s": Column(
        unit="s",
        meaning="mean time from an approach to its stop; negative: the stop "
        "came first",
    ),
    "missed_events": _count("approaches without a stop"),
    "false_events": _count("stops without an approach"),
}

_DISTANCES = {
    "distance_rmse_centre_m": Column(
        unit="m",
        meaning="RMS error of the nearest distance as measured, against the "
        "true one",
    ),
    "distance_rmse_surface_m": Column(
        unit="m",
        meaning="RMS error of the nearest distance from the links' surface, "
        "against the true one",
    ),
    "distance_rmse_link_m": Column(
        unit="m",
        meaning="RMS error of the nearest distance as measured, against the "
        "true one from the links' centres",
    ),
    "detection_share": Column(
        meaning="share of the time with the person in range in which any "
        "link reports a distance"
    ),
}


def _describe_times(name, event):
    """Returns the columns of the times that a kind of event takes."""
    return {
        f"time_to_{name}_s": Column(
            unit="s", meaning=f"mean time from {event} until it is reached"
        ),
        f"time_to_{name}_events": _count(f"{event} that count for this mean"),
        f"{name}_there_already_events": _count(
            f"{event} at which the robot was as slow already"
        ),
        f"time_to_{name}_alike_s": Column(
            unit="s",
            meaning=f"mean time from {event} that begin at like speeds",
        ),
        f"time_to_{name}_alike_events": _count(
            f"{event} that count for that mean"
        ),
    }


_READINGS = {
    "walking_in": "person who walks in",
    "as_reckoned": "person as the monitor has it",
    "measuring": "person as measured, links that measure only",
}


def _describe_shortfall(name, person):
    """Returns the columns of one reading of the shortfall."""
    what = f"shortfall against ISO/TS 15066, {person}"
    start = f"shortfall_{name}"
    return {
        **{
            f"{start}_p{round(100 * q):02d}_m": Column(
                unit="m", meaning=f"{what}: {round(100 * q)} % quantile"
            )
            for q in QUANTILES
        },
        f"{start}_max_m": Column(unit="m", meaning=f"{what}: the greatest"),
        f"{start}_share": Column(
            meaning=f"share of the time with a {what}",
        ),
    }


_AUDIT = {
    "shortfall_as_reckoned_clear_share": Column(
        meaning="share of the time with a shortfall, person as the monitor "
        "has it, in which the link that decides measured nothing"
    ),
    "inside_protective_s": Column(
        unit="s",
        meaning="time in which a person who walks in was nearer than the "
        "protective distance and the robot was not told to stop",
    ),
    "latency_s": Column(unit="s", meaning="worst latency of the sensing"),
    "latency_over_T_R_s": Column(
        unit="s", meaning="the same less what the law assumes"
    ),
    "stated_stop_time_s": Column(
        unit="s",
        meaning="longest stopping time that the robot's maker states for the "
        "highest speed",
    ),
    "stated_stop_over_T_stop_s": Column(
        unit="s", meaning="the same less what the law assumes"
    ),
}

METRIC_COLUMNS = {
    **_TASK,
    **_SAFETY,
    **_EVENTS,
    **_describe_times("stop", "changes to stop"),
    **_describe_times("reduce", "changes to reduced"),
    **_REACTIONS,
    **_DISTANCES,
    **{
        name: column
        for key, person in _READINGS.items()
        for name, column in _describe_shortfall(key, person).items()
    },
    **_AUDIT,
}
"""What `calc_run_metrics` returns, by name."""
