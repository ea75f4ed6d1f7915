"""Why a claim of the paper does not hold, as far as the results show.

Each explanation is a function from results to sentences. What it says about
this campaign comes from the campaign's numbers: other numbers give other
sentences, and cells that were not run are not mentioned.
"""

import dataclasses as dc
import math

from tofssm_drake.paper.campaign import VARIANTS, Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.studies.statistics import (
    calc_paired_difference,
    format_estimate,
)

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
    """Returns the means of the cells that have one."""
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


def _write(head, listed):
    """Returns a sentence; empty if there is nothing to list."""
    return f"{head}: {listed}." if listed else ""


def _write_means(results, head, metric, cells, **options):
    """Returns a sentence that lists a metric's means by cell."""
    return _write(head, list_means(results, metric, cells, **options))


def join(*sentences: str) -> str:
    """Returns the non-empty sentences as one text."""
    return " ".join(sentence for sentence in sentences if sentence)


def _name(cells):
    return ", ".join(cell.label for cell in cells)


def explain_errors(results: Results) -> str:
    """Divides the error of the distances into geometry and sensing."""
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
        _write_means(
            results,
            "Against the true distance from the point that is measured from (a "
            "link's centre, the base) the errors are, in mm",
            "distance_rmse_link_m",
            both,
            digits=0,
            scale=1000,
        ),
        _write(
            "Less than half of the error is left, so most of it is that these "
            "points do not represent the robot's whole surface",
            _name(geometry),
        ),
        _write(
            "Half of it or more is left, which comes from what is seen of the "
            "person (gaps between beams, the height of a plane), when, and "
            "how exactly",
            _name(own),
        ),
        (
            "Without noise and the other errors of a sensor the rings' error "
            "changes by "
            f"{format_estimate(change.scale(1000.0), digits=0, sign=True)} mm; "
            "gaps between beams and the age of what is seen remain."
            if change.count
            else ""
        ),
    )


def explain_times(
    results: Results, cells: list[Cell], *, by: str = "sensing"
) -> str:
    """Explains which of stops and slow movement cost the robot time.

    At half speed half of the time is lost.

    Args:
        results: Of the campaign.
        cells: The cells that are compared.
        by: What cells have in common that are compared with each other:
            sensing or configuration.
    """
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(getattr(cell, by), []).append(cell)
    return join(
        _write_means(
            results, "Time stopped per run (s)", "stopped_s", cells, digits=1
        ),
        _write_means(
            results, "At half speed (s)", "reduced_s", cells, digits=1
        ),
        *(_conclude_times(results, group) for group in groups.values()),
    )


def _conclude_times(results, cells):
    """Explains what sets the most productive of some cells apart."""
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
        return (
            head
            + "though it loses no less time: these times do not explain it."
        )
    cause = "stops" if by_stops >= by_slowness else "slow movement"
    return head + (
        f"mostly by its {cause}: it loses {_compare(by_stops)} to stops and "
        f"{_compare(by_slowness)} to slow movement."
    )


def _compare(saved):
    return f"{abs(saved):.1f} s {'more' if saved < 0.0 else 'less'}"


def count_contacts(results: Results, cells: list[Cell]) -> str:
    """Lists the contacts while moving, which the safety metric ignores."""
    touched, untouched = [], []
    for cell in cells:
        values = results.values(cell, "contacts_while_moving").values()
        known = [value for value in values if math.isfinite(value)]
        if sum(known):
            runs = sum(value > 0.0 for value in known)
            touched.append(
                f"{cell.label} {sum(known):.0f} in {runs} of {len(known)} runs"
            )
        elif known:
            untouched.append(cell)
    return join(
        _write("Contacts while moving", ", ".join(touched)),
        _write(
            "Without one" if touched else "Without a contact while moving",
            _name(untouched),
        ),
    )


def explain_standing(
    results: Results,
    cells: list[Cell],
    metric: str,
    pairs: list[tuple[Cell, Cell]],
) -> str:
    """Explains whether the safety metric follows how long the robot stands.

    Args:
        results: Of the campaign.
        cells: The cells that are compared.
        metric: The safety metric's average.
        pairs: The pairs that decide the claim.
    """
    safety = _get_means(results, metric, cells)
    share = _get_means(results, "stopped_share", cells)
    both = [cell for cell in safety if cell in share]
    if len(both) < 2:
        return ""
    fits: list[str] = []
    against: list[str] = []
    for pair in pairs:
        if not set(pair) <= set(both):
            continue
        high, low = sorted(pair, key=safety.get, reverse=True)
        side = fits if share[high] > share[low] else against
        side.append(
            f"{high.label} over {low.label} ({_format(100 * share[high], 1)} "
            f"against {_format(100 * share[low], 1)})"
        )
    return join(
        "The metric divides by the tool speed, so a slow robot scores high.",
        _write_means(
            results,
            "Stopped (% of the time)",
            "stopped_share",
            both,
            digits=1,
            scale=100,
        ),
        _write(
            "Of the pairs on which the verdict rests, in these the one with "
            "the higher mean is also stopped for a larger share of its time",
            ", ".join(fits),
        ),
        _write(
            "In these it is not stopped for a larger share, which contradicts "
            "that"
            if fits
            else "Of the pairs on which the verdict rests, in none is the one "
            "with the higher mean stopped for a larger share of its time, so "
            "standing does not explain it",
            ", ".join(against),
        ),
    )


def explain_seeing(results: Results, cells: list[Cell]) -> str:
    """Lists how often people are seen, missed and falsely detected."""
    return join(
        _write_means(
            results,
            "Person seen while in range (%)",
            "detection_share",
            cells,
            digits=1,
            scale=100,
        ),
        _write_means(
            results,
            "Approaches without a stop, per run",
            "missed_events",
            cells,
            digits=1,
        ),
        _write_means(
            results,
            "Stops without an approach, per run",
            "false_events",
            cells,
            digits=1,
        ),
    )


def explain_earliest(results: Results, cells: list[Cell]) -> str:
    """Says whether the cell that reacts first also stops farthest away."""
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
        _write_means(
            results, "Mean reaction time (s)", "reaction_time_s", both
        ),
        _write_means(
            results,
            "Mean separation at a stop (m)",
            "separation_at_stop_m",
            both,
        ),
        verdict,
    )


def explain_late(results: Results, cells: list[Cell]) -> str:
    """Lists the cells that react late, and their distances at a stop."""
    times = _get_means(results, "reaction_time_s", cells)
    late = [cell for cell, time in times.items() if time >= 0.0]
    return join(
        _write_means(
            results,
            "A stop is early where the law asks for more than 0.5 m between "
            "the surfaces. Its d_C at the stops, from the point that is "
            "measured from (a link's centre, with the Lidar the base's axis; "
            "m)",
            "d_C_at_stop_m",
            cells,
        ),
        _write("Late on average", _name(late)),
    )


def explain_real_against_ideal(results: Results) -> str:
    """Lists the laws with which the rings react before the true distance."""
    earlier: list[str] = []
    later: list[str] = []
    studied = []
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
        "Ideal has no delay here; the rings sample and filter.",
        _write("On average earlier than Ideal", ", ".join(earlier)),
        _write("Later", ", ".join(later)),
        explain_seeing(results, make_cells(("tof",))),
        _write(
            "With an Ideal distance that is 0.1 s late, Ideal \u2212 Real is",
            ", ".join(studied),
        ),
    )


_TIMED = {
    "stop": (
        "Stops are timed if the robot comes to a standstill; the others find "
        "it at a standstill or end before",
        "Over stops from about half speed only (s)",
    ),
    "reduce": (
        "Changes are timed if the robot slows to half speed; the others find "
        "it that slow or end before",
        "Over changes from full speed only (s)",
    ),
}
"""How to say which events are timed, and which of them begin alike."""


def count_timed(results: Results, kind: str) -> str:
    """Lists how many of the events have a time to stop, or to reduce.

    Args:
        results: Of the campaign.
        kind: `stop` or `reduce`.
    """
    counted = _get_means(results, f"time_to_{kind}_events", make_cells())
    every = _get_means(results, f"{kind}_events", list(counted))
    listed = ", ".join(
        f"{cell.label} {_format(counted[cell], 0)} of {_format(every[cell], 0)}"
        for cell in every
    )
    return _write(f"{_TIMED[kind][0]}; per run", listed)


def explain_ramps(results: Results, kind: str) -> str:
    """Explains whether times differ, or only which events are timed.

    Args:
        results: Of the campaign.
        kind: `stop` or `reduce`.
    """
    metric, alike = f"time_to_{kind}_s", f"time_to_{kind}_alike_s"
    less: list[str] = []
    stays: list[str] = []
    spreads = []
    for s in SENSINGS:
        cells = make_cells((s,))
        like = _get_means(results, alike, cells)
        mean = _get_means(results, metric, list(like))
        if len(like) < 2 or len(mean) < len(like):
            continue
        spread, left = (
            max(of.values()) - min(of.values()) for of in (mean, like)
        )
        name = next(iter(like)).label.split()[0]
        spreads.append(f"{name} {_format(spread, 3)} and {_format(left, 3)}")
        side = less if left < 0.5 * spread else stays
        side.append(name)
    return join(
        _write_means(results, _TIMED[kind][1], alike, make_cells(), digits=3),
        _write(
            "The largest mean of the configurations minus the smallest, over "
            "all timed events and over these only (s)",
            ", ".join(spreads),
        ),
        _write(
            "So most of the difference comes from which events are timed, and "
            "from which speed",
            ", ".join(less),
        ),
        _write("Half of it or more does not", ", ".join(stays)),
    )


def _calc_normal_stretch(results, event, cells):
    """Returns the time in the normal state per event, s, by cell, and words."""
    normal = _get_means(results, "normal_s", cells)
    count = _get_means(results, event, cells)
    stretch = {c: normal[c] / count[c] for c in normal if count.get(c)}
    listed = ", ".join(f"{c.label} {_format(s, 1)}" for c, s in stretch.items())
    return stretch, listed


def _conclude_greatest(effect, cause, what, agrees, differs):
    """Says with which sensings the greatest effect goes with a cause.

    Args:
        effect: Mean by cell.
        cause: Likewise, greater where more of the effect is expected.
        what: What the cell with the greatest effect does.
        agrees: What is also true of it if it has the greatest cause.
        differs: What is true of it otherwise.
    """
    yes: list[str] = []
    no: list[str] = []
    for s in SENSINGS:
        cells = [c for c in make_cells((s,)) if c in effect and c in cause]
        if len(cells) < 2:
            continue
        top = max(cells, key=effect.get)
        side = yes if cause[top] >= max(cause[c] for c in cells) else no
        side.append(top.label)
    return join(
        _write(
            f"So the configuration that {what} with its sensing {agrees}",
            ", ".join(yes),
        ),
        _write(
            f"{'But there' if yes else 'So there'} is one that {what} though "
            f"{differs}",
            ", ".join(no),
        ),
    )


def explain_speeds(results: Results) -> str:
    """Says whether the cell that stops from the highest speed ran longest."""
    cells = make_cells()
    stretch, listed = _calc_normal_stretch(results, "stop_events", cells)
    return join(
        _write_means(
            results,
            "Tool speed at a stop (m/s)",
            "velocity_change_at_stop_mps",
            cells,
        ),
        _write_means(
            results,
            "Changes from normal to reduced, per run",
            "reduce_events",
            cells,
            digits=1,
        ),
        _write_means(
            results, "Changes to stop", "stop_events", cells, digits=1
        ),
        _write("Time in the normal state per stop (s)", listed),
        _conclude_greatest(
            _get_means(results, "velocity_change_at_stop_mps", cells),
            stretch,
            "has the largest velocity change",
            "is also in the normal state for longest per stop",
            "it is not in the normal state for longest per stop",
        ),
    )


def list_long_episodes(results: Results) -> str:
    """Lists the cells whose changes per episode say nothing."""
    episodes = _get_means(results, "slow_episodes", make_cells())
    return _write(
        "About one episode lasts the whole run, so that changes per episode "
        "only show how long the run was",
        _name([cell for cell, count in episodes.items() if 0 < count <= 1.5]),
    )


def explain_chatter(results: Results) -> str:
    """Says whether the order per minute is that per episode."""
    cells = make_cells()
    per_episode = _get_means(results, "state_changes_per_episode", cells)
    per_minute = _get_means(results, "state_changes_per_min", cells)
    same: list[str] = []
    other: list[str] = []
    for s in SENSINGS:
        known = [
            cell
            for cell in make_cells((s,))
            if cell in per_episode and cell in per_minute
        ]
        if len(known) < 2:
            continue
        order = sorted(known, key=per_minute.get, reverse=True)
        side = (
            same
            if order == sorted(known, key=per_episode.get, reverse=True)
            else other
        )
        side.append(" > ".join(cell.label for cell in order))
    return join(
        _write_means(
            results,
            "Changes of state per episode",
            "state_changes_per_episode",
            cells,
            digits=1,
        ),
        _write_means(
            results, "Episodes per run", "slow_episodes", cells, digits=1
        ),
        _write_means(
            results,
            "Changes of state per minute",
            "state_changes_per_min",
            cells,
            digits=0,
        ),
        _write("Per minute the means are in the same order", "; ".join(same)),
        _write("Per minute they are in another order", "; ".join(other)),
    )


def conclude_separation(
    results: Results,
    metric: str,
    asked: str,
    cells: list[Cell],
    target: float,
    tolerance: float,
) -> str:
    """Says whether the law itself asks for another separation.

    Args:
        results: Of the campaign.
        metric: Column of the separation.
        asked: Column of the distance that the law asks for at that time.
        cells: The cells that are compared.
        target: What the paper reports, m.
        tolerance: What "about" means, as a fraction.
    """
    kept = _get_means(results, metric, cells)
    wanted = _get_means(results, asked, cells)

    def find_side(value):
        """Returns -1, 0, 1: less, about the target, more."""
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
    """Says whether the law asks for more distance with the Lidar."""
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
        f"{len(known)} comparisons, as it includes the workspace's radius: "
        "how much of that is left between the surfaces depends on how far the "
        "arm reaches out."
        if more
        else "So the law does not ask for more with the Lidar.",
        _write("It asks for no more with", ", ".join(rest)) if more else "",
    )


def explain_law_distances(
    results: Results, name: str, metric: str, cells: list[Cell]
) -> str:
    """Lists the distance that the law itself asked for.

    Args:
        results: Of the campaign.
        name: Of that distance, with when.
        metric: Its column.
        cells: The cells that are compared.
    """
    return _write_means(
        results,
        f"The law's own {name}, from the point that is measured from (m)",
        metric,
        cells,
    )


def explain_studies(
    results: Results,
    metric: str,
    cells: list[Cell],
    pairs: list[tuple[Cell, Cell]] | None = None,
    *,
    digits: int = 2,
    scale: float = 1.0,
) -> str:
    """Lists by how much the studies that were run change what is claimed.

    A change whose interval contains 0 is not decided, which does not mean
    that there is no change.

    Args:
        results: Of the campaign.
        metric: Column.
        cells: The cells of the claim.
        pairs: (first, second) if the claim is about the difference first -
            second: then the change of that difference counts, not what
            changes both alike.
        digits: Of the changes.
        scale: From the column's unit to that of the text.
    """
    changes = (
        _list_changes(results, metric, cells)
        if pairs is None
        else _list_difference_changes(results, metric, pairs)
    )
    changes = [(n, v.scale(scale)) for n, v in changes if v.count > 1]
    decided = [c for c in changes if c[1].low > 0.0 or c[1].high < 0.0]
    rest = [change for change in changes if change not in decided]
    rest.sort(key=lambda change: -abs(change[1].mean))
    if not changes:
        return ""

    def write(listed):
        return "; ".join(
            f"{name} {format_estimate(value, digits=digits, sign=True)}"
            for name, value in listed
        )

    what = (
        "the number"
        if pairs is None
        else "the claimed difference, or of a cell where only that one of the "
        "two was studied"
    )
    count = (
        "One comparison"
        if len(changes) == 1
        else f"{len(changes)} comparisons, without correction for their number"
    )
    shown = f" The {_SHOWN} largest" if len(rest) > _SHOWN else ""
    return join(
        f"What the studies change of {what} (95 % confidence; {count}).",
        _write("Decided", write(decided)),
        f"{'Otherwise no' if decided else 'No'} change is decided by these "
        "trials, which does not mean that there is none."
        f"{shown or ' They are'}: "
        f"{write(rest[:_SHOWN])}."
        if rest
        else "",
    )


_SHOWN = 4
"""Number of undecided changes that are shown."""


def _list_changes(results, metric, cells):
    """Returns (name, change) of each cell with a study."""
    return [
        (cell.label, results.difference(cell, plain, metric))
        for cell in results.cells
        if cell.variant and (plain := dc.replace(cell, variant="")) in cells
    ]


def _list_difference_changes(results, metric, pairs):
    """Returns (name, change) of each pair and study, each change once.

    Where only one cell of a pair was studied, its own change counts.
    """
    studied = [cell.variant for cell in results.cells if cell.variant]
    changes = {}
    for pair in pairs:
        for key in dict.fromkeys(studied):
            changed = [dc.replace(cell, variant=key) for cell in pair]
            known = [cell for cell in changed if cell in results.cells]
            if len(known) == 1:
                plain = dc.replace(known[0], variant="")
                changes[known[0].label] = results.difference(
                    known[0], plain, metric
                )
            elif known:
                name = " \u2212 ".join(cell.label for cell in pair)
                changes[f"{name} ({VARIANTS[key].label})"] = (
                    calc_paired_difference(
                        _get_difference(results, metric, *changed),
                        _get_difference(results, metric, *pair),
                    )
                )
    return list(changes.items())


def _get_difference(results, metric, first, second):
    """Returns first - second by trial."""
    one, other = results.values(first, metric), results.values(second, metric)
    return {trial: one[trial] - other[trial] for trial in one if trial in other}
