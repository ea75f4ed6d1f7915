"""Why distances and separations are not as claimed.

See `claims.py` for what an explanation is.
"""

from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import (
    CONFIGURATIONS,
    get_means,
    join,
    make_cell,
    make_cells,
    name_cells,
    write_list,
    write_means,
)
from tofssm_drake.studies.statistics import format_estimate


def explain_errors(results: Results) -> str:
    """Divides the error of the distances into geometry and sensing."""
    cells = make_cells(configurations=("vo",))
    surface = get_means(results, "distance_rmse_surface_m", cells)
    link = get_means(results, "distance_rmse_link_m", cells)
    both = [cell for cell in surface if cell in link]
    geometry = [cell for cell in both if link[cell] < 0.5 * surface[cell]]
    own = [cell for cell in both if cell not in geometry]
    exact = Cell(sensing="tof", configuration="vo", variant="exact")
    change = results.difference(
        exact, make_cell("tof", "vo"), "distance_rmse_surface_m"
    )
    return join(
        write_means(
            results,
            "Against the true distance from the point that is measured from (a "
            "link's centre, the base) the errors are, in mm",
            "distance_rmse_link_m",
            both,
            digits=0,
            scale=1000,
        ),
        write_list(
            "Less than half of the error is left, so most of it is that these "
            "points do not represent the robot's whole surface",
            name_cells(geometry),
        ),
        write_list(
            "Half of it or more is left, which comes from what is seen of the "
            "person (gaps between beams, the height of a plane), when, and "
            "how exactly",
            name_cells(own),
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


def explain_seeing(results: Results, cells: list[Cell]) -> str:
    """Lists how often people are seen, missed and falsely detected."""
    return join(
        write_means(
            results,
            "Person seen while in range (%)",
            "detection_share",
            cells,
            digits=1,
            scale=100,
        ),
        write_means(
            results,
            "Approaches without a stop, per run",
            "missed_events",
            cells,
            digits=1,
        ),
        write_means(
            results,
            "Stops without an approach, per run",
            "false_events",
            cells,
            digits=1,
        ),
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
    return write_means(
        results,
        f"The law's own {name}, from the point that is measured from (m)",
        metric,
        cells,
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
    kept = get_means(results, metric, cells)
    wanted = get_means(results, asked, cells)

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
        f"{target:g} m with {name_cells(law)}."
        if law
        else "",
        f"The law does not ask for that with {name_cells(rest)}: there it "
        "comes from where the distance is measured and how late."
        if rest
        else "",
    )


def conclude_lidar(results: Results) -> str:
    """Says whether the law asks for more distance with the Lidar."""
    wanted = get_means(results, "d_C_at_stop_m", make_cells())
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
        write_list("It asks for no more with", ", ".join(rest)) if more else "",
    )
