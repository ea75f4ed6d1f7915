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


def explain_times(results: Results, cells: list[Cell]) -> str:
    """Tells for how long the robot was stopped and slowed."""
    return join(
        _tell_means(
            results, "Time stopped per run (s)", "stopped_s", cells, digits=1
        ),
        _tell_means(results, "At half speed (s)", "reduced_s", cells, digits=1),
    )


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


def explain_slowing(results: Results) -> str:
    """Tells the times to slow down themselves, not only their differences."""
    return _tell_means(
        results, "Mean time to reduce (s)", "time_to_reduce_s", make_cells()
    )


def explain_speeds(results: Results) -> str:
    """Tells how fast the tool was at a stop, and how often it was slowed."""
    cells = make_cells()
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
    return _tell(
        f"Of {count} cells with something changed, these differ with 95 % "
        "confidence",
        ", ".join(changed) or "none",
    )
