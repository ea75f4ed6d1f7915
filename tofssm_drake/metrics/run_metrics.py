"""The paper's metrics of one run, from its samples only.

`calc_run_metrics` returns one flat row of numbers: a campaign has one per
run, and a recording of real hardware gives the same columns. Definitions, in
addition to those of `tofssm_drake.metrics.metrics`:

- *Productivity* is t_NoHRI / t_HRI (paper, Eq. 10a). t_NoHRI is the path time
  of the program at the end of t_HRI, i.e. the integral of the speed fraction:
  what the same motion takes at full speed. t_HRI ends when the last product
  is placed. If it never is, t_HRI ends with the record, productivity is that
  of the part done, and `finished` is 0.
- *Safety metric* is ||D_gt||^2 / ||V_tool|| (Eq. 10b): the mean and the
  median over the samples in which the tool moves faster than 0.01 m/s, and
  the ratio of the means of numerator and denominator over all samples.
- The *true distance* ||D_gt|| is between the surfaces of robot and person; an
  overlap counts as 0.
- An *approach* begins when ||D_gt|| falls to the nominal critical distance
  (0.5 m) and ends when it has been above it for 0.5 s. A *stop* begins with
  a stop event and ends when the robot has not been in state stop for 0.5 s.
  Both belong together if they overlap or are less than 0.5 s apart.
- The *reaction time* is the time from the beginning of an approach to that
  of the first stop that belongs to it; negative: the stop came first. A stop
  counts once, for the first approach it belongs to. An approach without any
  stop is *missed*, a stop without any approach is *false*. An approach that
  began before the end of start-up has no reaction time.
- The *time to stop* is the time from a stop event until the speed fraction is
  below 0.01; the *time to reduce* that from a reduce event until it is at
  most 0.5. It does not exist where the speed fraction was that low already,
  or where the state rises again first; such events are counted but do not
  enter the mean. A configuration that chatters has many of them, and its
  remaining events begin at other speeds than elsewhere. So the means are also
  given over events that begin alike: stops from the reduced speed fraction
  (0.5 +- 0.05) and reductions from full speed (at least 0.95).
- The *distance error* is that of the nearest distance over the links, as it
  stood at that tick, against ||D_gt||, while ||D_gt|| is within the sensors'
  best range (1.31 m) and any link reports a distance. `centre` takes the
  distance as measured (from the link's centre, or the base's axis),
  `surface` subtracts the radius of the body it was measured from. `link`
  compares with the nearest of the links' own true distances: the quantity
  that was measured.
- *Chatter* is the number of changes of state, per minute after start-up and
  per episode.

Rows are a control tick apart: all these times have that resolution.
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.approach import (
    STANDING,
    count_late_stops,
    find_any_due,
)
from tofssm_drake.metrics.audit import calc_audit
from tofssm_drake.metrics.metrics import (
    MOVING_SPEED,
    calc_distance_rmse,
    calc_periods,
    find_contacts,
    find_episodes,
    find_start,
    find_state_events,
)
from tofssm_drake.metrics.task_progress import count_steps, read_task_steps
from tofssm_drake.recording.samples import Samples

NOMINAL_CRITICAL_DISTANCE = 0.5
"""Reaction times count from it, m (paper: about 0.5 m at a stop)."""
BEST_RANGE = 1.31
"""Distance up to which distance errors are compared, m (paper)."""
_SETTLE_TIME = 0.5
_REDUCED = 0.5
# The speed fraction already falls in the tick of the event.
_ALIKE = 0.05
# A profile that ends at the reduced speed fraction gets there up to rounding.
_ROUNDING = 1e-6


@dc.dataclass(frozen=True, kw_only=True)
class Reactions:
    """How the stops fit the approaches of the person."""

    times: tuple[float, ...]
    """Reaction times, s, in order; negative: anticipated."""
    approaches: int
    """Approaches after start-up."""
    missed: int
    """Those of them without a stop."""
    false: int
    """Stops without an approach."""


def calc_productivity(t_no_hri: float, t_hri: float) -> float:
    """Returns t_NoHRI / t_HRI (paper, Eq. 10a); NaN if t_HRI is 0."""
    return t_no_hri / t_hri if t_hri > 0.0 else np.nan


def calc_safety_metric(
    true_distance: np.ndarray, tcp_speed: np.ndarray
) -> tuple[float, float, float]:
    """Averages ||D_gt||^2 / ||V_tool|| (paper, Eq. 10b).

    Args:
        true_distance: ||D_gt||, m, (k,); negative counts as 0.
        tcp_speed: ||V_tool||, m/s, (k,).

    Returns:
        (mean, ratio of means, median), m^2/(m/s). Mean and median are over
        the samples with a tool speed above 0.01 m/s. All are NaN without a
        person (a distance of inf), or if the tool never moves.
    """
    square = np.maximum(true_distance, 0.0) ** 2
    moving = tcp_speed > MOVING_SPEED
    if not (moving.any() and np.isfinite(square).all()):
        return np.nan, np.nan, np.nan
    ratio = square[moving] / tcp_speed[moving]
    return (
        float(ratio.mean()),
        float(square.mean() / tcp_speed.mean()),
        float(np.median(ratio)),
    )


def find_reactions(
    *,
    t: np.ndarray,
    robot_state: np.ndarray,
    true_distance: np.ndarray,
    threshold: float = NOMINAL_CRITICAL_DISTANCE,
) -> Reactions:
    """Matches stops with approaches; see the top of this module.

    Args:
        t: Times, s, (k,).
        robot_state: `RobotState`, (k,).
        true_distance: ||D_gt||, m, (k,).
        threshold: Nominal critical distance, m.
    """
    start = find_start(robot_state)
    is_stop = np.array(robot_state) == RobotState.STOP
    is_stop[:start] = False
    stops = _find_merged_spans(t, is_stop)
    approaches = _find_merged_spans(t, np.asarray(true_distance) <= threshold)
    matches = [
        [
            i
            for i, (begin, end) in enumerate(stops)
            if begin - last < _SETTLE_TIME and first - end < _SETTLE_TIME
        ]
        for first, last in approaches
    ]
    # An approach in the first row began at an unknown time before it.
    began = t[start] if start < len(t) else np.inf
    times, used = [], set()
    counted = missed = 0
    for (first, _), match in zip(approaches, matches, strict=True):
        if first <= max(began, t[0]):
            used.update(match)
            continue
        counted += 1
        if not match:
            missed += 1
        elif match[0] not in used:
            times.append(float(stops[match[0]][0] - first))
        used.update(match)
    return Reactions(
        times=tuple(times),
        approaches=counted,
        missed=missed,
        false=len(stops) - len(used),
    )


def _find_merged_spans(t, flags):
    """Returns (first, last) time of each stretch; short gaps are bridged."""
    rows = np.flatnonzero(flags)
    if not len(rows):
        return []
    breaks = np.flatnonzero(
        (np.diff(rows) > 1) & (np.diff(t[rows]) >= _SETTLE_TIME)
    )
    first = rows[np.concatenate(([0], breaks + 1))]
    last = rows[np.append(breaks, len(rows) - 1)]
    return list(zip(t[first].tolist(), t[last].tolist(), strict=True))


def _find_times_until(t, state, rho, rows, limit):
    """Returns how long rho takes from each row to the limit; NaN: never.

    Args:
        t: Times, s, (k,).
        state: `RobotState`, (k,).
        rho: Speed fraction, (k,).
        rows: Rows of the events.
        limit: rho has to fall below it.

    Returns:
        Times, s, (n,).
    """
    times = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        if rho[row] < limit:
            continue
        there = np.flatnonzero(rho[row:] < limit)
        risen = np.flatnonzero(state[row:] > state[row])
        if len(there) and not (len(risen) and risen[0] < there[0]):
            times[i] = t[row + there[0]] - t[row]
    return times


def _calc_times(name, times, rho, limit, is_alike):
    """Returns the metrics of times to stop or to reduce.

    Args:
        name: Of the columns, `stop` or `reduce`.
        times: From `_find_times_until`, s, (n,).
        rho: Speed fraction at each event, (n,).
        limit: Of the speed fraction.
        is_alike: Which events begin alike, (n,).
    """
    counts = np.isfinite(times)
    return {
        f"time_to_{name}_s": _mean(times[counts]),
        f"time_to_{name}_events": float(counts.sum()),
        f"{name}_there_already_events": float((rho < limit).sum()),
        f"time_to_{name}_alike_s": _mean(times[counts & is_alike]),
        f"time_to_{name}_alike_events": float((counts & is_alike).sum()),
    }


def calc_run_metrics(samples: Samples) -> dict[str, float]:
    """Returns the paper's metrics of a run, one flat row of numbers.

    Args:
        samples: The run. Of `metadata` it reads what the task counts and
            `link_offset_m`, by link the distance from the point that is
            measured from to the surface it stands for (default: 0).

    Returns:
        Numbers by name with unit; NaN where one does not exist:

        - `simulated_s`, `products_placed`, `finished` (1 or 0),
          `task_time_s`, `nominal_time_s` (t_NoHRI), `productivity`;
        - `safety_mean_m2_per_mps`, `safety_ratio_of_means_m2_per_mps`,
          `safety_median_m2_per_mps`;
        - `stop_events`, `reduce_events`, `velocity_change_at_stop_mps`,
          `separation_at_stop_m`, `separation_at_reduce_m`, `d_C_at_stop_m`,
          `d_R_at_reduce_m` (of the link that decides), `time_to_stop_s`,
          `time_to_reduce_s`: means over the events. Of the latter two also
          `_events`, how many count, `_alike_s` and `_alike_events` over those
          that begin alike, and `stop_there_already_events`,
          `reduce_there_already_events`, how many were as slow already;
        - `approaches`, `reaction_events`, `reaction_time_s` (mean),
          `missed_events`, `false_events`;
        - `distance_rmse_centre_m`, `distance_rmse_surface_m`,
          `distance_rmse_link_m`; `detection_share`, share of the time with
          ||D_gt|| within the best range in which any link reports a distance;
        - `stopped_s`, `reduced_s`, `normal_s`, `stopped_share` of the three
          together; `stop_due_share`, share of the same time in which a link's
          true distance is at or under its critical distance;
        - `slow_episodes`,
          `state_changes`, `state_changes_per_min`,
          `state_changes_per_episode`;
        - `contacts_while_moving`, `contact_speed_max_mps`,
          `min_true_distance_m`, `mean_true_distance_m`, `late_stops`,
          `tcp_speed_max_mps`;
        - those of `Audit.make_row`, if the run can be audited.
    """
    audit = calc_audit(samples)
    return (
        _calc_productivity(samples)
        | _calc_safety(samples)
        | _calc_events(samples)
        | _calc_reactions(samples)
        | _calc_distance_errors(samples)
        | ({} if audit is None else audit.make_row())
    )


def _mean(values):
    return float(np.mean(values)) if len(values) else np.nan


def _calc_productivity(samples):
    t, periods = samples["t"], calc_periods(samples["t"])
    placed = samples["products_placed"]
    steps = read_task_steps(samples.metadata).steps
    last = np.flatnonzero(count_steps(samples) >= steps)
    finished = len(last) > 0 and steps > 0
    end = int(last[0]) if finished else len(t)
    t_no_hri = float((samples["speed_fraction"] * periods)[:end].sum())
    t_hri = float(periods[:end].sum())
    return {
        "simulated_s": float(periods.sum()),
        "products_placed": float(placed.max(initial=0)),
        "finished": float(finished),
        "task_time_s": t_hri if finished else np.nan,
        "nominal_time_s": t_no_hri,
        "productivity": calc_productivity(t_no_hri, t_hri),
    }


def _calc_safety(samples):
    true = np.maximum(samples["true_distance"], 0.0)
    speed = samples["tcp_speed"]
    mean, ratio, median = calc_safety_metric(true, speed)
    contacts = find_contacts(samples)
    someone = len(true) > 0 and bool(np.isfinite(true).all())
    return {
        "safety_mean_m2_per_mps": mean,
        "safety_ratio_of_means_m2_per_mps": ratio,
        "safety_median_m2_per_mps": median,
        "contacts_while_moving": float(len(contacts)),
        "contact_speed_max_mps": max(
            (contact.max_speed for contact in contacts), default=0.0
        ),
        "min_true_distance_m": float(true.min()) if someone else np.nan,
        "mean_true_distance_m": float(true.mean()) if someone else np.nan,
        "late_stops": float(
            count_late_stops(samples, find_start(samples["robot_state"]))
        ),
        "tcp_speed_max_mps": float(speed.max(initial=0.0)),
    }


def _calc_events(samples):
    events = find_state_events(samples)
    stops = [e for e in events if e.kind == "stop"]
    reductions = [e for e in events if e.kind == "reduce"]
    return (
        _calc_event_times(samples, stops, reductions)
        | {
            "stop_events": float(len(stops)),
            "reduce_events": float(len(reductions)),
            "velocity_change_at_stop_mps": _mean([e.tcp_speed for e in stops]),
            "separation_at_stop_m": _calc_separation(stops),
            "separation_at_reduce_m": _calc_separation(reductions),
            "d_C_at_stop_m": _calc_threshold(samples, stops, "stop"),
            "d_R_at_reduce_m": _calc_threshold(samples, reductions, "slow"),
        }
        | _calc_states(samples, events)
    )


def _find_rows(samples, events):
    return np.searchsorted(samples["t"], [event.time for event in events])


def _calc_separation(events):
    """Returns the mean true distance at events, m."""
    distance = [max(event.true_distance, 0.0) for event in events]
    return _mean([d for d in distance if np.isfinite(d)])


def _calc_threshold(samples, events, bound):
    """Returns the mean bound at events, of the links that decide, m."""
    name = samples.find_bound(bound)
    if not name:
        return np.nan
    distance = [
        float(samples[f"{event.ring}_{name}"][row])
        for event, row in zip(events, _find_rows(samples, events), strict=True)
        if event.ring
    ]
    return _mean([d for d in distance if np.isfinite(d)])


def _calc_event_times(samples, stops, reductions):
    """Returns how long stops and reductions take."""
    t, state = samples["t"], samples["robot_state"]
    rho = samples["speed_fraction"]
    stop_rows = _find_rows(samples, stops)
    reduce_rows = _find_rows(samples, reductions)
    slow = _REDUCED + _ROUNDING
    return _calc_times(
        "stop",
        _find_times_until(t, state, rho, stop_rows, STANDING),
        rho[stop_rows],
        STANDING,
        np.abs(rho[stop_rows] - _REDUCED) <= _ALIKE,
    ) | _calc_times(
        "reduce",
        _find_times_until(t, state, rho, reduce_rows, slow),
        rho[reduce_rows],
        slow,
        rho[reduce_rows] >= 1.0 - _ALIKE,
    )


def _calc_states(samples, events):
    """Returns the time in each state and how often it changes."""
    state = samples["robot_state"]
    start = find_start(state)
    periods = calc_periods(samples["t"])[start:]
    running = float(periods.sum())

    def duration(is_in):
        return float(periods[is_in[start:]].sum())

    def over_time(value):
        return value / running if running else np.nan

    stopped = duration(state == RobotState.STOP)
    episodes = find_episodes(samples, events)
    changes = sum(episode.changes for episode in episodes)
    return {
        "stopped_s": stopped,
        "reduced_s": duration(state == RobotState.REDUCED),
        "normal_s": duration(state == RobotState.NORMAL),
        "stopped_share": over_time(stopped),
        "stop_due_share": over_time(duration(find_any_due(samples))),
        "slow_episodes": float(len(episodes)),
        "state_changes": float(len(events)),
        "state_changes_per_min": over_time(60.0 * len(events)),
        "state_changes_per_episode": (
            changes / len(episodes) if episodes else np.nan
        ),
    }


def _calc_reactions(samples):
    reactions = find_reactions(
        t=samples["t"],
        robot_state=samples["robot_state"],
        true_distance=samples["true_distance"],
    )
    return {
        "approaches": float(reactions.approaches),
        "reaction_events": float(len(reactions.times)),
        "reaction_time_s": _mean(reactions.times),
        "missed_events": float(reactions.missed),
        "false_events": float(reactions.false),
    }


def _calc_distance_errors(samples):
    periods = calc_periods(samples["t"])
    true = np.maximum(samples["true_distance"], 0.0)
    in_range = true <= BEST_RANGE
    true = np.where(in_range, true, np.inf)
    centre, surface = calc_nearest_distances(samples)
    near = periods[in_range].sum()
    seen = periods[in_range & np.isfinite(centre)].sum()
    of_link = samples.ring("true_distance").min(axis=1)
    of_link = np.where(in_range, of_link, np.inf)

    def error(measured, truth):
        rmse = calc_distance_rmse(measured, truth)
        return np.nan if rmse is None else rmse

    return {
        "distance_rmse_centre_m": error(centre, true),
        "distance_rmse_surface_m": error(surface, true),
        "distance_rmse_link_m": error(centre, of_link),
        "detection_share": float(seen / near) if near else np.nan,
    }


def calc_nearest_distances(samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Returns the nearest measured distance over the links, m, (k,) each.

    Args:
        samples: The run; see `calc_run_metrics`.

    Returns:
        (centre, surface): as measured, and with `link_offset_m` subtracted
        (not below 0). inf: all links are clear, or know nothing.
    """
    measured = samples.ring("measured_distance")
    measured = np.where(np.isnan(measured), np.inf, measured)
    offsets = samples.metadata.get("link_offset_m", {})
    offset = np.array([offsets.get(link, 0.0) for link in samples.rings])
    surface = np.maximum(measured - offset, 0.0)
    return measured.min(axis=1), surface.min(axis=1)
