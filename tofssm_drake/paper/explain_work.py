"""Why productivity, safety and smoothness are not as claimed.

See `claims.py` for what an explanation is.
"""

import math

from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import (
    PAPER_SENSINGS,
    format_number,
    get_means,
    join,
    make_cells,
    name_cells,
    write_list,
    write_means,
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
        write_means(
            results, "Time stopped per run (s)", "stopped_s", cells, digits=1
        ),
        write_means(results, "At half speed (s)", "reduced_s", cells, digits=1),
        *(_conclude_times(results, group) for group in groups.values()),
    )


def _conclude_times(results, cells):
    """Explains what sets the most productive of some cells apart."""
    productivity = get_means(results, "productivity", cells)
    stopped = get_means(results, "stopped_s", cells)
    reduced = get_means(results, "reduced_s", cells)
    known = [c for c in productivity if c in stopped and c in reduced]
    if len(known) < 2:
        return ""
    best = max(known, key=productivity.__getitem__)
    worst = min(known, key=productivity.__getitem__)
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
        write_list("Contacts while moving", ", ".join(touched)),
        write_list(
            "Without one" if touched else "Without a contact while moving",
            name_cells(untouched),
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
    safety = get_means(results, metric, cells)
    share = get_means(results, "stopped_share", cells)
    both = [cell for cell in safety if cell in share]
    if len(both) < 2:
        return ""
    fits: list[str] = []
    against: list[str] = []
    for pair in pairs:
        if not set(pair) <= set(both):
            continue
        high, low = sorted(pair, key=safety.__getitem__, reverse=True)
        side = fits if share[high] > share[low] else against
        side.append(
            f"{high.label} over {low.label} "
            f"({format_number(100 * share[high], 1)} against "
            f"{format_number(100 * share[low], 1)})"
        )
    return join(
        "The metric divides by the tool speed, so a slow robot scores high.",
        write_means(
            results,
            "Stopped (% of the time)",
            "stopped_share",
            both,
            digits=1,
            scale=100,
        ),
        write_list(
            "Of the pairs on which the verdict rests, in these the one with "
            "the higher mean is also stopped for a larger share of its time",
            ", ".join(fits),
        ),
        write_list(
            "In these it is not stopped for a larger share, which contradicts "
            "that"
            if fits
            else "Of the pairs on which the verdict rests, in none is the one "
            "with the higher mean stopped for a larger share of its time, so "
            "standing does not explain it",
            ", ".join(against),
        ),
    )


def list_long_episodes(results: Results) -> str:
    """Lists the cells whose changes per episode say nothing."""
    episodes = get_means(results, "slow_episodes", make_cells())
    return write_list(
        "About one episode lasts the whole run, so that changes per episode "
        "only show how long the run was",
        name_cells(
            [cell for cell, count in episodes.items() if 0 < count <= 1.5]
        ),
    )


def explain_chatter(results: Results) -> str:
    """Says whether the order per minute is that per episode."""
    cells = make_cells()
    per_episode = get_means(results, "state_changes_per_episode", cells)
    per_minute = get_means(results, "state_changes_per_min", cells)
    same: list[str] = []
    other: list[str] = []
    for s in PAPER_SENSINGS:
        known = [
            cell
            for cell in make_cells((s,))
            if cell in per_episode and cell in per_minute
        ]
        if len(known) < 2:
            continue
        order = sorted(known, key=per_minute.__getitem__, reverse=True)
        side = (
            same
            if order == sorted(known, key=per_episode.__getitem__, reverse=True)
            else other
        )
        side.append(" > ".join(cell.label for cell in order))
    return join(
        write_means(
            results,
            "Changes of state per episode",
            "state_changes_per_episode",
            cells,
            digits=1,
        ),
        write_means(
            results, "Episodes per run", "slow_episodes", cells, digits=1
        ),
        write_means(
            results,
            "Changes of state per minute",
            "state_changes_per_min",
            cells,
            digits=0,
        ),
        write_list(
            "Per minute the means are in the same order", "; ".join(same)
        ),
        write_list("Per minute they are in another order", "; ".join(other)),
    )
