"""Claims on reactions, stops and what is seen: Fig. 12 and the text."""

import dataclasses as dc

from tofssm_drake.paper import (
    explain_distances,
    explain_stops,
    explain_variants,
    explain_work,
    sentences,
)
from tofssm_drake.paper.claim_parts import (
    AT_REDUCE,
    AT_STOP,
    make_claim,
    make_separation_claim,
)
from tofssm_drake.paper.claim_rules import (
    Claim,
    Evidence,
    check_run,
    compare,
    judge_positive,
    orient,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import (
    CONFIGURATIONS,
    PAPER_SENSINGS,
    make_cell,
    make_cells,
)


def claim_fastest_reaction(results: Results) -> Claim:
    """Fig. 12 (a): the fastest reaction of the nine."""
    pairs = [
        (make_cell("tof", "vo"), make_cell(s, c))
        for s in PAPER_SENSINGS
        for c in CONFIGURATIONS
        if (s, c) != ("tof", "vo")
    ]
    return make_claim(
        "reaction: Real Vo",
        compare(
            results,
            "reaction_time_s",
            pairs,
            least=True,
        ),
        why=sentences.join(
            explain_stops.explain_earliest(results, make_cells()),
            explain_variants.explain_variants(
                results,
                "reaction_time_s",
                make_cells(),
                orient(pairs, least=True),
            ),
        ),
    )


def claim_reaction_anticipates(results: Results) -> Claim:
    """Fig. 12 (a): reactions come before the threshold."""
    evidence = []
    for cell in make_cells():
        value = results.estimate(cell, "reaction_time_s")
        evidence.append(
            Evidence(
                what=cell.label,
                estimate=value,
                verdict=check_run(
                    results,
                    (cell,),
                    judge_positive(dc.replace(value, mean=-value.mean)),
                ),
            )
        )
    return make_claim(
        "reaction: sign",
        evidence,
        why=sentences.join(
            explain_stops.explain_late(results, make_cells()),
            explain_variants.explain_variants(
                results, "reaction_time_s", make_cells()
            ),
        ),
    )


def claim_real_reacts_before_ideal(results: Results) -> Claim:
    """Section IV: the rings are faster than the mesh distance."""
    return make_claim(
        "reaction: Real over Ideal",
        compare(
            results,
            "reaction_time_s",
            [
                (make_cell("tof", c), make_cell("ideal", c))
                for c in CONFIGURATIONS
            ],
            least=True,
        ),
        why=explain_stops.explain_real_against_ideal(results),
    )


def claim_time_to_stop(results: Results) -> Claim:
    """Fig. 12 (b): stopping takes longest with SM."""
    return make_claim(
        "time to stop",
        compare(
            results,
            "time_to_stop_s",
            [
                (make_cell(s, "sm"), make_cell(s, c))
                for s in PAPER_SENSINGS
                for c in ("vo", "vr")
            ],
        ),
        explain_stops.count_timed(results, "stop"),
        why=explain_stops.explain_ramps(results, "stop"),
    )


def claim_time_to_reduce(results: Results) -> Claim:
    """Fig. 12 (b): slowing takes longer with Vr and SM."""
    return make_claim(
        "time to reduce",
        compare(
            results,
            "time_to_reduce_s",
            [
                (make_cell(s, c), make_cell(s, "vo"))
                for s in PAPER_SENSINGS
                for c in ("vr", "sm")
            ],
        ),
        explain_stops.count_timed(results, "reduce"),
        why=explain_stops.explain_ramps(results, "reduce"),
    )


def claim_vo_best_times(results: Results) -> Claim:
    """Fig. 12 (b): Vo gives the best results."""
    pairs = [
        (make_cell(s, "vo"), make_cell(s, c))
        for s in PAPER_SENSINGS
        for c in ("vr", "sm")
    ]
    evidence = [
        dc.replace(e, what=f"{name}: {e.what}")
        for name, metric in (
            ("to stop", "time_to_stop_s"),
            ("to reduce", "time_to_reduce_s"),
        )
        for e in compare(results, metric, pairs, least=True)
    ]
    return make_claim(
        "times: Vo best",
        evidence,
        sentences.join(
            explain_stops.count_timed(results, "stop"),
            explain_stops.count_timed(results, "reduce"),
        ),
        why=sentences.join(
            explain_stops.explain_ramps(results, "stop"),
            explain_stops.explain_ramps(results, "reduce"),
        ),
    )


def claim_velocity_change(results: Results) -> Claim:
    """Fig. 12 (c): stops from the highest speed."""
    return make_claim(
        "velocity change",
        compare(
            results,
            "velocity_change_at_stop_mps",
            [
                (make_cell(s, "vr"), make_cell(s, c))
                for s in PAPER_SENSINGS
                for c in ("vo", "sm")
            ],
        ),
        why=explain_stops.explain_speeds(results),
    )


def claim_separation_at_stop(results: Results) -> Claim:
    """Fig. 12 (d): where Real and Ideal stop."""
    return make_separation_claim(
        results,
        "separation at stop",
        "separation_at_stop_m",
        0.5,
        AT_STOP,
    )


def claim_separation_at_reduce(results: Results) -> Claim:
    """Fig. 12 (d): where Real and Ideal slow down."""
    return make_separation_claim(
        results,
        "separation at reduce",
        "separation_at_reduce_m",
        0.75,
        AT_REDUCE,
    )


def claim_lidar_conservative(results: Results) -> Claim:
    """Fig. 12 (d): the Lidar stops farther away."""
    return make_claim(
        "separation: Lidar",
        compare(
            results,
            "separation_at_stop_m",
            [
                (make_cell("lidar", c), make_cell(s, c))
                for s in ("tof", "ideal")
                for c in CONFIGURATIONS
            ],
        ),
        why=sentences.join(
            explain_distances.explain_law_distances(
                results, *AT_STOP, make_cells()
            ),
            explain_distances.conclude_lidar(results),
        ),
    )


def claim_vo_smoother(results: Results) -> Claim:
    """Section V: relative speeds make the movement smoother."""
    return make_claim(
        "smoothness: Vo",
        compare(
            results,
            "state_changes_per_episode",
            [
                (make_cell(s, "vo"), make_cell(s, c))
                for s in PAPER_SENSINGS
                for c in ("vr", "sm")
            ],
            least=True,
        ),
        sentences.join(
            "An episode lasts from leaving the normal state until the robot "
            "is back in it for half a second.",
            explain_work.list_long_episodes(results),
        ),
        why=explain_work.explain_chatter(results),
    )


def claim_sixteen(results: Results) -> Claim:
    """Section V: more sensors see more."""
    return make_claim(
        "sixteen sensors",
        compare(
            results,
            "detection_share",
            [
                (make_cell("tof16", c), make_cell("tof", c))
                for c in CONFIGURATIONS
            ],
            scale=100.0,
        ),
        why=explain_distances.explain_seeing(
            results, make_cells(("tof", "tof16"))
        ),
    )
