"""Why reactions, stops and slowing are not as claimed.

See `claims.py` for what an explanation is.
"""

from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.explain_distances import explain_seeing
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import (
    CONFIGURATIONS,
    PAPER_SENSINGS,
    format_number,
    get_means,
    join,
    make_cell,
    make_cells,
    name_cells,
    write_list,
    write_means,
)
from tofssm_drake.studies.statistics import format_estimate


def explain_earliest(results: Results, cells: list[Cell]) -> str:
    """Says whether the cell that reacts first also stops farthest away."""
    times = get_means(results, "reaction_time_s", cells)
    separations = get_means(results, "separation_at_stop_m", cells)
    both = [cell for cell in times if cell in separations]
    if len(both) < 2:
        return ""
    earliest = min(both, key=times.__getitem__)
    farthest = max(both, key=separations.__getitem__)
    if separations[earliest] >= separations[farthest]:
        verdict = f"{earliest.label} reacts first, and none stops farther away."
    else:
        verdict = (
            f"{earliest.label} reacts first, {farthest.label} stops farthest "
            "away."
        )
    return join(
        write_means(results, "Mean reaction time (s)", "reaction_time_s", both),
        write_means(
            results,
            "Mean separation at a stop (m)",
            "separation_at_stop_m",
            both,
        ),
        verdict,
    )


def explain_late(results: Results, cells: list[Cell]) -> str:
    """Lists the cells that react late, and their distances at a stop."""
    times = get_means(results, "reaction_time_s", cells)
    late = [cell for cell, time in times.items() if time >= 0.0]
    return join(
        write_means(
            results,
            "A stop is early where the law asks for more than 0.5 m between "
            "the surfaces. Its d_C at the stops, from the point that is "
            "measured from (a link's centre, with the Lidar the base's axis; "
            "m)",
            "d_C_at_stop_m",
            cells,
        ),
        write_list("Late on average", name_cells(late)),
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
        write_list("On average earlier than Ideal", ", ".join(earlier)),
        write_list("Later", ", ".join(later)),
        explain_seeing(results, make_cells(("tof",))),
        write_list(
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
    counted = get_means(results, f"time_to_{kind}_events", make_cells())
    every = get_means(results, f"{kind}_events", list(counted))
    listed = ", ".join(
        f"{cell.label} {format_number(counted[cell], 0)} of "
        f"{format_number(every[cell], 0)}"
        for cell in every
    )
    return write_list(f"{_TIMED[kind][0]}; per run", listed)


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
    for s in PAPER_SENSINGS:
        cells = make_cells((s,))
        like = get_means(results, alike, cells)
        mean = get_means(results, metric, list(like))
        if len(like) < 2 or len(mean) < len(like):
            continue
        spread, left = (
            max(of.values()) - min(of.values()) for of in (mean, like)
        )
        name = next(iter(like)).label.split()[0]
        spreads.append(
            f"{name} {format_number(spread, 3)} and {format_number(left, 3)}"
        )
        side = less if left < 0.5 * spread else stays
        side.append(name)
    return join(
        write_means(results, _TIMED[kind][1], alike, make_cells(), digits=3),
        write_list(
            "The largest mean of the configurations minus the smallest, over "
            "all timed events and over these only (s)",
            ", ".join(spreads),
        ),
        write_list(
            "So most of the difference comes from which events are timed, and "
            "from which speed",
            ", ".join(less),
        ),
        write_list("Half of it or more does not", ", ".join(stays)),
    )


def _calc_normal_stretch(results, event, cells):
    """Returns the time in the normal state per event, s, by cell, and words."""
    normal = get_means(results, "normal_s", cells)
    count = get_means(results, event, cells)
    stretch = {c: normal[c] / count[c] for c in normal if count.get(c)}
    listed = ", ".join(
        f"{c.label} {format_number(s, 1)}" for c, s in stretch.items()
    )
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
    for s in PAPER_SENSINGS:
        cells = [c for c in make_cells((s,)) if c in effect and c in cause]
        if len(cells) < 2:
            continue
        top = max(cells, key=effect.__getitem__)
        side = yes if cause[top] >= max(cause[c] for c in cells) else no
        side.append(top.label)
    return join(
        write_list(
            f"So the configuration that {what} with its sensing {agrees}",
            ", ".join(yes),
        ),
        write_list(
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
        write_means(
            results,
            "Tool speed at a stop (m/s)",
            "velocity_change_at_stop_mps",
            cells,
        ),
        write_means(
            results,
            "Changes from normal to reduced, per run",
            "reduce_events",
            cells,
            digits=1,
        ),
        write_means(results, "Changes to stop", "stop_events", cells, digits=1),
        write_list("Time in the normal state per stop (s)", listed),
        _conclude_greatest(
            get_means(results, "velocity_change_at_stop_mps", cells),
            stretch,
            "has the largest velocity change",
            "is also in the normal state for longest per stop",
            "it is not in the normal state for longest per stop",
        ),
    )
