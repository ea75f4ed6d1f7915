"""Why a claim of the paper does not hold, as far as the results tell.

Each explanation is a function from results to sentences. What it states of
this campaign it takes from the campaign's numbers: other numbers give other
sentences, and cells that were not run are not spoken of.
"""

import dataclasses as dc

from tofssm_drake.evaluation.campaign import Cell
from tofssm_drake.evaluation.results import Results
from tofssm_drake.evaluation.statistics import format_estimate

SENSINGS = ("tof", "ideal", "lidar")
"""What the paper compares."""
CONFIGURATIONS = ("vo", "vr", "sm")


def make_cell(sensing: str, configuration: str) -> Cell:
    """Returns a cell without a variant."""
    return Cell(sensing=sensing, configuration=configuration)


def make_cells(sensings=SENSINGS, configurations=CONFIGURATIONS) -> list[Cell]:
    """Returns the cells of some sensings with some configurations."""
    return [make_cell(s, c) for s in sensings for c in configurations]


def _get_means(results, metric, cells):
    """Returns the means of the cells for which there is one."""
    estimates = {cell: results.estimate(cell, metric) for cell in cells}
    return {cell: e.mean for cell, e in estimates.items() if e.count}


def list_means(
    results: Results,
    metric: str,
    cells: list[Cell],
    *,
    digits: int = 2,
    scale: float = 1.0,
) -> str:
    """Returns `Real Vo 0.53, ...` of the cells that have the metric."""
    means = _get_means(results, metric, cells)
    return ", ".join(
        f"{cell.label} {_format(scale * mean, digits)}"
        for cell, mean in means.items()
    )


def _format(value, digits):
    return f"{value:.{digits}f}".replace("-", "\u2212")


def _tell(head, listed):
    """Returns a sentence; empty if there is nothing to list."""
    return f"{head}: {listed}." if listed else ""


def _tell_means(results, head, metric, cells, **options):
    """Returns a sentence that lists a metric's means by cell."""
    return _tell(head, list_means(results, metric, cells, **options))


def join(*sentences: str) -> str:
    """Returns the sentences that there are as one text."""
    return " ".join(sentence for sentence in sentences if sentence)


def _name(cells):
    return ", ".join(cell.label for cell in cells)


def explain_errors(results: Results) -> str:
    """Parts the error of the distances into geometry and sensing."""
    cells = make_cells(configurations=("vo",))
    surface = _get_means(results, "distance_rmse_surface_m", cells)
    link = _get_means(results, "distance_rmse_link_m", cells)
    both = [cell for cell in surface if cell in link]
    geometry = [cell for cell in both if link[cell] < 0.5 * surface[cell]]
    own = [cell for cell in both if cell not in geometry]
    exact = Cell(sensing="tof", configuration="vo", variant="exact")
    change = results.difference(
        exact, make_cell("tof", "vo"), "distance_rmse_surface_m"
    )
    return join(
        _tell_means(
            results,
            "Against the true distance from the same place that is measured "
            "from (a link's centre, the base) the errors are, in mm",
            "distance_rmse_link_m",
            both,
            digits=0,
            scale=1000,
        ),
        _tell(
            "Less than half of the error is left, so most of it is that these "
            "places do not stand for the robot's whole surface",
            _name(geometry),
        ),
        _tell("Half of it or more is the sensing's own", _name(own)),
        (
            "Without any sensor error the rings' error changes by "
            f"{format_estimate(change.scale(1000.0), digits=0, sign=True)} mm."
            if change.count
            else ""
        ),
    )


def explain_times(
    results: Results, cells: list[Cell], *, by: str = "sensing"
) -> str:
    """Tells for how long the robot was stopped and slowed, and which cost it.

    At half speed half of the time is lost.

    Args:
        results: Of the campaign.
        cells: Those that are compared.
        by: What those have in common that are compared with each other:
            sensing or configuration.
    """
    groups = {}
    for cell in cells:
        groups.setdefault(getattr(cell, by), []).append(cell)
    return join(
        _tell_means(
            results, "Time stopped per run (s)", "stopped_s", cells, digits=1
        ),
        _tell_means(results, "At half speed (s)", "reduced_s", cells, digits=1),
        *(_conclude_times(results, group) for group in groups.values()),
    )


def _conclude_times(results, cells):
    """Tells what sets the most productive of some cells apart."""
    productivity = _get_means(results, "productivity", cells)
    stopped = _get_means(results, "stopped_s", cells)
    reduced = _get_means(results, "reduced_s", cells)
    known = [c for c in productivity if c in stopped and c in reduced]
    if len(known) < 2:
        return ""
    best = max(known, key=productivity.get)
    worst = min(known, key=productivity.get)
    by_stops = stopped[worst] - stopped[best]
    by_slowness = 0.5 * (reduced[worst] - reduced[best])
    head = f"So {best.label} is more productive than {worst.label} "
    if by_stops + by_slowness <= 0.0:
        return head + "though it loses no less time: not for these times."
    cause = "stops" if by_stops >= by_slowness else "slow movement"
    return head + (
        f"mostly by its {cause}: it loses {_compare(by_stops)} to stops and "
        f"{_compare(by_slowness)} to slow movement."
    )


def _compare(saved):
    return f"{abs(saved):.1f} s {'more' if saved < 0.0 else 'less'}"


def explain_standing(results: Results, cells: list[Cell], metric: str) -> str:
    """Tells whether the safety metric follows how long the robot stands.

    Args:
        results: Of the campaign.
        cells: Those that are compared.
        metric: The safety metric's average.
    """
    safety = _get_means(results, metric, cells)
    share = _get_means(results, "stopped_share", cells)
    both = [cell for cell in safety if cell in share]
    if len(both) < 2:
        return ""
    safest = max(both, key=safety.get)
    longest = max(both, key=share.get)
    if share[safest] >= share[longest]:
        verdict = (
            f"{safest.label} scores highest, and none is stopped for a larger "
            "share of its time."
        )
    else:
        verdict = (
            f"{safest.label} scores highest, though {longest.label} is "
            "stopped for a larger share of its time: that alone does not "
            "explain the order."
        )
    return join(
        "The metric divides by the tool speed, so a slow robot scores high.",
        _tell_means(
            results,
            "Stopped (% of the time)",
            "stopped_share",
            both,
            digits=1,
            scale=100,
        ),
        verdict,
    )


def explain_seeing(results: Results, cells: list[Cell]) -> str:
    """Tells what is seen, missed and taken for a person."""
    return join(
        _tell_means(
            results,
            "Person seen while in range (%)",
            "detection_share",
            cells,
            digits=1,
            scale=100,
        ),
        _tell_means(
            results,
            "Approaches without a stop, per run",
            "missed_events",
            cells,
            digits=1,
        ),
        _tell_means(
            results,
            "Stops without an approach, per run",
            "false_events",
            cells,
            digits=1,
        ),
    )


def explain_earliest(results: Results, cells: list[Cell]) -> str:
    """Tells whether who reacts first is who stops farthest away."""
    times = _get_means(results, "reaction_time_s", cells)
    separations = _get_means(results, "separation_at_stop_m", cells)
    both = [cell for cell in times if cell in separations]
    if len(both) < 2:
        return ""
    earliest = min(both, key=times.get)
    farthest = max(both, key=separations.get)
    if separations[earliest] >= separations[farthest]:
        verdict = f"{earliest.label} reacts first, and none stops farther away."
    else:
        verdict = (
            f"{earliest.label} reacts first, {farthest.label} stops farthest "
            "away."
        )
    return join(
        _tell_means(results, "Mean reaction time (s)", "reaction_time_s", both),
        _tell_means(
            results,
            "Mean separation at a stop (m)",
            "separation_at_stop_m",
            both,
        ),
        verdict,
    )


def explain_late(results: Results, cells: list[Cell]) -> str:
    """Tells who does not anticipate, and at which distance it stops."""
    times = _get_means(results, "reaction_time_s", cells)
    late = [cell for cell, time in times.items() if time >= 0.0]
    return join(
        _tell_means(
            results,
            "A stop is early where the law asks for more than 0.5 m between "
            "the surfaces. Its d_C at the stops, from the link's centre (m)",
            "d_C_at_stop_m",
            cells,
        ),
        _tell("Late on average", _name(late)),
    )


def explain_real_against_ideal(results: Results) -> str:
    """Tells with which law the rings come earlier than the true distance."""
    earlier, later, studied = [], [], []
    for c in CONFIGURATIONS:
        real, ideal = make_cell("tof", c), make_cell("ideal", c)
        value = results.difference(real, ideal, "reaction_time_s")
        if value.count:
            side = earlier if value.mean < 0.0 else later
            side.append(f"{real.label} by {abs(value.mean):.2f} s")
        late = Cell(sensing="ideal", configuration=c, variant="late")
        value = results.difference(late, real, "reaction_time_s")
        if value.count:
            name = real.label.removeprefix("Real ")
            difference = format_estimate(value, digits=2, sign=True)
            studied.append(f"{name} {difference} s")
    return join(
        "Ideal comes without delay here, the rings sample and filter.",
        _tell("On average earlier than Ideal", ", ".join(earlier)),
        _tell("Later", ", ".join(later)),
        explain_seeing(results, make_cells(("tof",))),
        _tell(
            "With an Ideal distance that comes 0.1 s late, Ideal \u2212 Real "
            "is",
            ", ".join(studied),
        ),
    )


def explain_ramps(results: Results) -> str:
    """Tells whether who takes longest to stop was the fastest before."""
    same = total = 0
    for s in SENSINGS:
        cells = make_cells((s,))
        times = _get_means(results, "time_to_stop_s", cells)
        speeds = _get_means(results, "velocity_change_at_stop_mps", cells)
        if len(times) > 1 and set(times) == set(speeds):
            total += 1
            same += max(times, key=times.get) == max(speeds, key=speeds.get)
    return join(
        "A stop lasts as long as the speed fraction has to fall.",
        _tell_means(
            results,
            "Tool speed at a stop (m/s)",
            "velocity_change_at_stop_mps",
            make_cells(),
        ),
        (
            f"With {same} of {total} sensings, the configuration that takes "
            "longest is the one with the fastest tool."
            if total
            else ""
        ),
    )


def _calc_normal_stretch(results, event, cells):
    """Returns the time in the normal state per event, s, by cell, and words."""
    normal = _get_means(results, "normal_s", cells)
    count = _get_means(results, event, cells)
    stretch = {c: normal[c] / count[c] for c in normal if count.get(c)}
    listed = ", ".join(f"{c.label} {_format(s, 1)}" for c, s in stretch.items())
    return stretch, listed


def explain_slowing(results: Results) -> str:
    """Tells whether who takes longest to slow down had run the longest."""
    cells = make_cells()
    stretch, listed = _calc_normal_stretch(results, "reduce_events", cells)
    return join(
        _tell_means(
            results, "Mean time to reduce (s)", "time_to_reduce_s", cells
        ),
        _tell("Time in the normal state per change to reduced (s)", listed),
        _conclude_greatest(
            _get_means(results, "time_to_reduce_s", cells),
            stretch,
            "takes longest to slow down",
            "is in the normal state for longest between, so it is more often "
            "back at full speed when it has to slow down",
            "it is not in the normal state for longest between, so something "
            "else makes it take longest",
        ),
    )


def _conclude_greatest(effect, cause, what, agrees, differs):
    """Tells with which sensings the greatest effect goes with a cause.

    Args:
        effect: Mean by cell.
        cause: Likewise, greater where more of the effect is expected.
        what: What the cell with the greatest effect does.
        agrees: What is so of that cell if it has the greatest cause.
        differs: Sentence for the others.
    """
    yes, no = [], []
    for s in SENSINGS:
        cells = [c for c in make_cells((s,)) if c in effect and c in cause]
        if len(cells) < 2:
            continue
        top = max(cells, key=effect.get)
        side = yes if cause[top] >= max(cause[c] for c in cells) else no
        side.append(top.label)
    return join(
        _tell(
            f"So the configuration that {what} with its sensing {agrees}",
            ", ".join(yes),
        ),
        _tell(
            f"{'But there' if yes else 'So there'} is one that {what} though "
            f"{differs}",
            ", ".join(no),
        ),
    )


def explain_speeds(results: Results) -> str:
    """Tells whether who stops from the highest speed had run the longest."""
    cells = make_cells()
    stretch, listed = _calc_normal_stretch(results, "stop_events", cells)
    return join(
        _tell_means(
            results,
            "Tool speed at a stop (m/s)",
            "velocity_change_at_stop_mps",
            cells,
        ),
        _tell_means(
            results,
            "Changes from normal to reduced, per run",
            "reduce_events",
            cells,
            digits=1,
        ),
        _tell_means(results, "Changes to stop", "stop_events", cells, digits=1),
        _tell("Time in the normal state per stop (s)", listed),
        _conclude_greatest(
            _get_means(results, "velocity_change_at_stop_mps", cells),
            stretch,
            "has the largest velocity change",
            "is in the normal state for longest per stop, so it is more often "
            "at full speed when it has to stop",
            "it is not in the normal state for longest per stop, so something "
            "else makes the change largest",
        ),
    )


def explain_chatter(results: Results) -> str:
    """Tells whether many changes go with many or with long episodes."""
    cells = make_cells()
    return join(
        _tell_means(
            results,
            "Changes of state per episode",
            "state_changes_per_episode",
            cells,
        ),
        _tell_means(
            results, "Episodes per run", "slow_episodes", cells, digits=1
        ),
        _conclude_greatest(
            _get_means(results, "state_changes_per_episode", cells),
            _get_means(results, "false_events", cells),
            "changes its state most often per episode",
            "has the most stops without an approach, so it reacts to what is "
            "no approach",
            "it has not the most stops without an approach, so its changes "
            "come from the law's distances while the person is near",
        ),
    )


def conclude_separation(
    results: Results,
    metric: str,
    asked: str,
    cells: list[Cell],
    target: float,
    tolerance: float,
) -> str:
    """Tells whether the law itself asks for another separation.

    Args:
        results: Of the campaign.
        metric: Column of the separation.
        asked: Column of the distance that the law asks for at that time.
        cells: Those that are compared.
        target: What the paper reports, m.
        tolerance: What "about" means, as a fraction.
    """
    kept = _get_means(results, metric, cells)
    wanted = _get_means(results, asked, cells)

    def find_side(value):
        """-1, 0, 1: less, about the target, more."""
        off = value - target
        return 0 if abs(off) <= tolerance * target else 1 if off > 0 else -1

    known = [cell for cell in kept if cell in wanted]
    off = [cell for cell in known if find_side(kept[cell])]
    if not known:
        return ""
    if not off:
        return (
            f"So the means are about {target:g} m, and only their intervals "
            "are too wide to be sure."
        )
    law = [c for c in off if find_side(wanted[c]) == find_side(kept[c])]
    rest = [cell for cell in off if cell not in law]
    return join(
        f"So it is the law itself that asks for another distance than "
        f"{target:g} m with {_name(law)}."
        if law
        else "",
        f"The law does not ask for that with {_name(rest)}: there it comes "
        "from where the distance is measured and how late."
        if rest
        else "",
    )


def conclude_lidar(results: Results) -> str:
    """Tells whether the law asks for more distance with the Lidar."""
    wanted = _get_means(results, "d_C_at_stop_m", make_cells())
    pairs = [
        (make_cell("lidar", c), make_cell(s, c))
        for s in ("tof", "ideal")
        for c in CONFIGURATIONS
    ]
    known = [pair for pair in pairs if set(pair) <= set(wanted)]
    more = [pair for pair in known if wanted[pair[0]] > wanted[pair[1]]]
    if not known:
        return ""
    rest = [f"{a.label} than {b.label}" for a, b in known if (a, b) not in more]
    return join(
        f"So the law asks for more with the Lidar in {len(more)} of "
        f"{len(known)} comparisons, as the workspace's radius is in it: what "
        "is left of that between the surfaces depends on how far the arm "
        "reaches out."
        if more
        else "So the law does not ask for more with the Lidar.",
        _tell("It asks for no more with", ", ".join(rest)) if more else "",
    )


def explain_law_distances(
    results: Results, name: str, metric: str, cells: list[Cell]
) -> str:
    """Tells which distance the law itself asked for.

    Args:
        results: Of the campaign.
        name: Of that distance, with when.
        metric: Its column.
        cells: Those that are compared.
    """
    return _tell_means(
        results,
        f"The law's own {name}, from the place that is measured from (m)",
        metric,
        cells,
    )


def explain_studies(
    results: Results, metric: str, *, digits: int = 2, scale: float = 1.0
) -> str:
    """Tells which of the studies that were run change a metric for sure.

    Args:
        results: Of the campaign.
        metric: Column.
        digits: Of the changes.
        scale: From the column's unit to that of the text.
    """
    changed = []
    count = 0
    for cell in results.cells:
        if not cell.variant:
            continue
        plain = dc.replace(cell, variant="")
        value = results.difference(cell, plain, metric).scale(scale)
        if value.count < 2:
            continue
        count += 1
        if value.low > 0.0 or value.high < 0.0:
            change = format_estimate(value, digits=digits, sign=True)
            changed.append(f"{cell.label} {change}")
    if not count:
        return ""
    return join(
        _tell(
            f"Of {count} cells with something changed, these differ with 95 % "
            "confidence",
            ", ".join(changed) or "none",
        ),
        "So what was changed there matters to this number."
        if changed
        else "So nothing that was changed there is the cause.",
    )
