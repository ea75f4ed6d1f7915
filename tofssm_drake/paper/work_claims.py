"""Claims on distances, productivity and safety: Figs. 9 and 10."""

from tofssm_drake.paper import (
    explain_distances,
)
from tofssm_drake.paper.claim_parts import (
    make_claim,
    make_productivity_claim,
    make_safety_claim,
)
from tofssm_drake.paper.claim_rules import (
    Claim,
    compare,
    list_about,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import (
    CONFIGURATIONS,
    PAPER_SENSINGS,
    make_cell,
    make_cells,
)


def claim_rmse(results: Results) -> Claim:
    """Fig. 9: errors of the distances."""
    targets = {"ideal": 9.0, "tof": 63.0, "lidar": 128.0}
    return make_claim(
        "rmse",
        list_about(
            results,
            "distance_rmse_surface_m",
            [(make_cell(s, "vo"), target) for s, target in targets.items()],
            scale=1000.0,
        ),
        why=explain_distances.explain_errors(results),
    )


def claim_rmse_order(results: Results) -> Claim:
    """Fig. 9: order of the errors."""
    return make_claim(
        "rmse order",
        compare(
            results,
            "distance_rmse_surface_m",
            [
                pair
                for c in CONFIGURATIONS
                for pair in (
                    (make_cell("lidar", c), make_cell("tof", c)),
                    (make_cell("tof", c), make_cell("ideal", c)),
                )
            ],
            scale=1000.0,
        ),
        why=explain_distances.explain_errors(results),
    )


def claim_productivity_over_lidar(results: Results) -> Claim:
    """Fig. 10: on-robot sensing costs less time."""
    return make_productivity_claim(
        results,
        "productivity: sensing",
        [
            (make_cell(s, c), make_cell("lidar", c))
            for s in ("tof", "ideal")
            for c in CONFIGURATIONS
        ],
        by="configuration",
    )


def claim_vr_most_productive(results: Results) -> Claim:
    """Fig. 10: the most productive configuration."""
    return make_productivity_claim(
        results,
        "productivity: Vr",
        [
            (make_cell(s, "vr"), make_cell(s, c))
            for s in ("tof", "ideal")
            for c in ("vo", "sm")
        ],
    )


def claim_vr_less_safe(results: Results) -> Claim:
    """Fig. 10: what the productivity of Vr costs."""
    return make_safety_claim(
        results,
        "safety: Vr",
        [
            (make_cell(s, "vr"), make_cell(s, c))
            for s in ("tof", "ideal")
            for c in ("vo", "sm")
        ],
        least=True,
    )


def claim_vo_ideal_safest(results: Results) -> Claim:
    """Fig. 10: the safest of the nine cells."""
    return make_safety_claim(
        results,
        "safety: Ideal Vo",
        [
            (make_cell("ideal", "vo"), make_cell(s, c))
            for s in PAPER_SENSINGS
            for c in CONFIGURATIONS
            if (s, c) != ("ideal", "vo")
        ],
    )


def claim_vo_safer_than_vr(results: Results) -> Claim:
    """Fig. 10: Vo against Vr."""
    return make_safety_claim(
        results,
        "safety: Vo over Vr",
        [(make_cell(s, "vo"), make_cell(s, "vr")) for s in PAPER_SENSINGS],
    )


def claim_vo_safer_than_sm(results: Results) -> Claim:
    """Section IV: what directed speeds add to safety."""
    return make_safety_claim(
        results,
        "safety: Vo over SM",
        [(make_cell(s, "vo"), make_cell(s, "sm")) for s in PAPER_SENSINGS],
    )


def claim_vo_more_productive_than_sm(results: Results) -> Claim:
    """Section IV: what directed speeds add to productivity."""
    return make_productivity_claim(
        results,
        "productivity: Vo over SM",
        [(make_cell(s, "vo"), make_cell(s, "sm")) for s in PAPER_SENSINGS],
    )


def claim_lidar_less_safe(results: Results) -> Claim:
    """Fig. 10: the Lidar's safety."""
    return make_safety_claim(
        results,
        "safety: Lidar",
        [
            (make_cell("lidar", c), make_cell(s, c))
            for s in ("tof", "ideal")
            for c in CONFIGURATIONS
        ],
        least=True,
    )


def claim_real_less_safe_than_ideal(results: Results) -> Claim:
    """Section IV: what the error of the rings costs."""
    return make_safety_claim(
        results,
        "safety: Real",
        [(make_cell("tof", c), make_cell("ideal", c)) for c in CONFIGURATIONS],
        least=True,
        why=explain_distances.explain_seeing(
            results, make_cells(("tof", "ideal"))
        ),
    )
