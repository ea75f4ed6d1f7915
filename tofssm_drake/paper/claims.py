"""The claims of the paper, compared with a campaign's results.

Each claim is a function from results to a verdict with the numbers behind
it. The rules are the same for all and were fixed before any run:

- A claim that one cell exceeds others is *reproduced* if the paired
  difference to each of them is above 0 with 95 % confidence; *not
  reproduced* if the difference to any of them is below 0 with 95 %
  confidence; *undecided* otherwise.
- A claim that a value is about x is *reproduced* if the 95 % confidence
  interval of the mean lies within x +- 20 %; *not reproduced* if it lies
  outside; *undecided* otherwise.
- A claim of several parts is not reproduced if one of them is not, and
  reproduced if all of them are.
- *Not run*: the campaign lacks a cell of the claim.
- *No value*: all of them were run, but in one the event that the claim is
  about never happened, and no other part decides against the claim.
"""

from collections.abc import Callable
import dataclasses as dc

from tofssm_drake.paper import explanations
from tofssm_drake.paper.explanations import (
    CONFIGURATIONS,
    SENSINGS,
    make_cell,
    make_cells,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.studies.statistics import Estimate

REPRODUCED = "reproduced"
NOT_REPRODUCED = "not reproduced"
UNDECIDED = "undecided"
NOT_RUN = "not run"
NO_VALUE = "no value"

TOLERANCE = 0.2
"""What "about" means, as a fraction."""

SAFETY = {
    "safety_mean_m2_per_mps": "mean",
    "safety_ratio_of_means_m2_per_mps": "ratio of means",
    "safety_median_m2_per_mps": "median",
}
"""The three averages of the safety metric; the first one decides."""


@dc.dataclass(frozen=True, kw_only=True)
class Evidence:
    """One number behind a verdict."""

    what: str
    """What it is, e.g. `Real Vr - Real Vo`."""
    estimate: Estimate
    verdict: str
    """Of this number alone."""


@dc.dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim of the paper with the result of this campaign."""

    key: str
    """Short name."""
    text: str
    """What the paper says, in our words."""
    verdict: str
    """REPRODUCED, NOT_REPRODUCED, UNDECIDED, NO_VALUE or NOT_RUN."""
    unit: str
    """Of the evidence."""
    evidence: tuple[Evidence, ...] = ()
    digits: int = 3
    """Of the evidence, after the decimal point."""
    note: str = ""
    """What else the reader should know."""
    why: str = ""
    """Why it is not reproduced or undecided, as far as the results show; empty
    if it is reproduced, or with too few trials to say anything."""


def judge_positive(difference: Estimate) -> str:
    """Judges the claim that a difference is above 0."""
    if not difference.count:
        return NOT_RUN
    if difference.low > 0.0:
        return REPRODUCED
    if difference.high < 0.0:
        return NOT_REPRODUCED
    return UNDECIDED


def judge_about(value: Estimate, target: float) -> str:
    """Judges the claim that a mean is about a positive target."""
    if not value.count:
        return NOT_RUN
    low, high = (1.0 - TOLERANCE) * target, (1.0 + TOLERANCE) * target
    if low <= value.low and value.high <= high:
        return REPRODUCED
    if value.high < low or value.low > high:
        return NOT_REPRODUCED
    return UNDECIDED


def combine(verdicts: list[str]) -> str:
    """Returns the verdict of a claim of several parts."""
    for verdict in (NOT_RUN, NOT_REPRODUCED, NO_VALUE, UNDECIDED):
        if verdict in verdicts:
            return verdict
    return REPRODUCED if verdicts else NOT_RUN


def _check_run(results, cells, verdict):
    """Returns the verdict; "no value" if "not run" but all cells were run."""
    is_run = all(cell in results.cells for cell in cells)
    return NO_VALUE if verdict == NOT_RUN and is_run else verdict


def _orient(pairs, least):
    """Returns the pairs so that the first one is claimed to have more."""
    return [(b, a) for a, b in pairs] if least else list(pairs)


def _compare(results, metric, pairs, *, least=False, scale=1.0):
    """Returns evidence that the first of each pair has more of the metric.

    Args:
        results: Of the campaign.
        metric: Column.
        pairs: (first, second) cells.
        least: Claims that the first has less instead.
        scale: From the column's unit to the claim's.
    """
    evidence = []
    for first, second in _orient(pairs, least):
        difference = results.difference(first, second, metric).scale(scale)
        evidence.append(
            Evidence(
                what=f"{first.label} \u2212 {second.label}",
                estimate=difference,
                verdict=_check_run(
                    results, (first, second), judge_positive(difference)
                ),
            )
        )
    return evidence


def _claim(key, text, unit, evidence, note="", why="", digits=3):
    verdict = combine([e.verdict for e in evidence])
    is_open = verdict in (NOT_REPRODUCED, UNDECIDED)
    is_known = any(e.estimate.count > 1 for e in evidence)
    return Claim(
        key=key,
        text=text,
        verdict=verdict,
        unit=unit,
        evidence=tuple(evidence),
        digits=digits,
        note=note,
        why=why if is_open and is_known else "",
    )


def _find_cells(pairs):
    """Returns the cells of pairs in the order of the tables."""
    return [c for c in make_cells() if any(c in pair for pair in pairs)]


def _claim_safety(results, key, text, pairs, *, least=False, why=""):
    """Returns a claim on the safety metric, by all three averages."""
    metrics = list(SAFETY)
    evidence = _compare(results, metrics[0], pairs, least=least)
    others = []
    for metric in metrics[1:]:
        verdict = combine(
            [e.verdict for e in _compare(results, metric, pairs, least=least)]
        )
        others.append(f"by the {SAFETY[metric]}: {verdict}")
    cells = _find_cells(pairs)
    note = explanations.join(
        f"By the mean over the samples. {'; '.join(others).capitalize()}.",
        explanations.count_contacts(results, cells),
    )
    verdict = combine([e.verdict for e in evidence])
    oriented = _orient(pairs, least)
    deciding = [
        pair
        for pair, e in zip(oriented, evidence, strict=True)
        if e.verdict == verdict
    ]
    why = explanations.join(
        explanations.explain_standing(results, cells, metrics[0], deciding),
        why,
        explanations.explain_studies(results, metrics[0], cells, oriented),
    )
    return _claim(key, text, "m\u00b2/(m/s)", evidence, note, why)


def _claim_productivity(results, key, text, pairs, *, by="sensing"):
    """Returns a claim on productivity, with the time that is lost.

    Args:
        results: Of the campaign.
        key: Of the claim.
        text: Of the claim.
        pairs: (first, second) cells; the first is claimed to have more.
        by: What the cells of a pair have in common.
    """
    cells = _find_cells(pairs)
    return _claim(
        key,
        text,
        "percentage points",
        _compare(results, "productivity", pairs, scale=100.0),
        why=explanations.join(
            explanations.explain_studies(
                results, "productivity", cells, pairs, digits=1, scale=100.0
            ),
            explanations.explain_times(results, cells, by=by),
        ),
        digits=1,
    )


def _claim_separation(
    results, key, text, metric, target, asked: tuple[str, str]
):
    """Returns a claim on the separation of Real and Ideal at events.

    Args:
        results: Of the campaign.
        key: Of the claim.
        text: Of the claim.
        metric: Column of the separation.
        target: What the paper reports, m.
        asked: Name and column of the distance that the law asks for.
    """
    cells = make_cells(("tof", "ideal"))
    return _claim(
        key,
        text,
        "m",
        _about(results, metric, [(cell, target) for cell in cells]),
        why=explanations.join(
            explanations.explain_studies(results, metric, cells),
            explanations.explain_law_distances(results, *asked, cells),
            explanations.conclude_separation(
                results, metric, asked[1], cells, target, TOLERANCE
            ),
        ),
    )


def _about(results, metric, targets, *, scale=1.0):
    """Returns evidence that cells have about the value of the paper.

    Args:
        results: Of the campaign.
        metric: Column.
        targets: (cell, value in the claim's unit) pairs.
        scale: From the column's unit to the claim's.
    """
    evidence = []
    for cell, target in targets:
        value = results.estimate(cell, metric).scale(scale)
        evidence.append(
            Evidence(
                what=f"{cell.label} (paper: {target:g})",
                estimate=value,
                verdict=_check_run(
                    results, (cell,), judge_about(value, target)
                ),
            )
        )
    return evidence


_AT_STOP = ("d_C at the stops", "d_C_at_stop_m")
_AT_REDUCE = ("d_R at these changes", "d_R_at_reduce_m")


def claim_rmse(results: Results) -> Claim:
    """Fig. 9: errors of the distances."""
    targets = {"ideal": 9.0, "tof": 63.0, "lidar": 128.0}
    return _claim(
        "rmse",
        "The minimum distance errs by 9 mm (Ideal), 63 mm (ToF rings) and "
        "128 mm (Lidar) RMSE against the ground truth.",
        "mm",
        _about(
            results,
            "distance_rmse_surface_m",
            [(make_cell(s, "vo"), target) for s, target in targets.items()],
            scale=1000.0,
        ),
        "Distances minus the radius of the body that is measured from, in "
        "configuration Vo. The distance from a link's centre to a surface "
        "cannot be within 9 mm of that between two surfaces.",
        why=explanations.explain_errors(results),
        digits=0,
    )


def claim_rmse_order(results: Results) -> Claim:
    """Fig. 9: order of the errors."""
    return _claim(
        "rmse order",
        "Ideal errs least and the Lidar most.",
        "mm",
        _compare(
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
        why=explanations.explain_errors(results),
        digits=0,
    )


def claim_productivity_over_lidar(results: Results) -> Claim:
    """Fig. 10: on-robot sensing costs less time."""
    return _claim_productivity(
        results,
        "productivity: sensing",
        "Real and Ideal are more productive than the Lidar.",
        [
            (make_cell(s, c), make_cell("lidar", c))
            for s in ("tof", "ideal")
            for c in CONFIGURATIONS
        ],
        by="configuration",
    )


def claim_vr_most_productive(results: Results) -> Claim:
    """Fig. 10: the most productive configuration."""
    return _claim_productivity(
        results,
        "productivity: Vr",
        "Vr is the most productive configuration of Real and of Ideal.",
        [
            (make_cell(s, "vr"), make_cell(s, c))
            for s in ("tof", "ideal")
            for c in ("vo", "sm")
        ],
    )


def claim_vr_less_safe(results: Results) -> Claim:
    """Fig. 10: what the productivity of Vr costs."""
    return _claim_safety(
        results,
        "safety: Vr",
        "Vr is the least safe configuration of Real and of Ideal.",
        [
            (make_cell(s, "vr"), make_cell(s, c))
            for s in ("tof", "ideal")
            for c in ("vo", "sm")
        ],
        least=True,
    )


def claim_vo_ideal_safest(results: Results) -> Claim:
    """Fig. 10: the safest of the nine cells."""
    return _claim_safety(
        results,
        "safety: Ideal Vo",
        "Vo with the Ideal distance is the safest of the nine.",
        [
            (make_cell("ideal", "vo"), make_cell(s, c))
            for s in SENSINGS
            for c in CONFIGURATIONS
            if (s, c) != ("ideal", "vo")
        ],
    )


def claim_vo_safer_than_vr(results: Results) -> Claim:
    """Fig. 10: Vo against Vr."""
    return _claim_safety(
        results,
        "safety: Vo over Vr",
        "With each sensing Vo is safer than Vr.",
        [(make_cell(s, "vo"), make_cell(s, "vr")) for s in SENSINGS],
    )


def claim_vo_safer_than_sm(results: Results) -> Claim:
    """Section IV: what directed speeds add to safety."""
    return _claim_safety(
        results,
        "safety: Vo over SM",
        "Directed speeds add to safety: with each sensing Vo is safer than "
        "SM, which has fixed distances.",
        [(make_cell(s, "vo"), make_cell(s, "sm")) for s in SENSINGS],
    )


def claim_vo_more_productive_than_sm(results: Results) -> Claim:
    """Section IV: what directed speeds add to productivity."""
    return _claim_productivity(
        results,
        "productivity: Vo over SM",
        "Directed speeds add to productivity: with each sensing Vo is more "
        "productive than SM, which has fixed distances.",
        [(make_cell(s, "vo"), make_cell(s, "sm")) for s in SENSINGS],
    )


def claim_lidar_less_safe(results: Results) -> Claim:
    """Fig. 10: the Lidar's safety."""
    return _claim_safety(
        results,
        "safety: Lidar",
        "The Lidar is less safe than Real and Ideal.",
        [
            (make_cell("lidar", c), make_cell(s, c))
            for s in ("tof", "ideal")
            for c in CONFIGURATIONS
        ],
        least=True,
    )


def claim_real_less_safe_than_ideal(results: Results) -> Claim:
    """Section IV: what the error of the rings costs."""
    return _claim_safety(
        results,
        "safety: Real",
        "Real is less safe than Ideal, because its distances err more.",
        [(make_cell("tof", c), make_cell("ideal", c)) for c in CONFIGURATIONS],
        least=True,
        why=explanations.explain_seeing(results, make_cells(("tof", "ideal"))),
    )


def claim_fastest_reaction(results: Results) -> Claim:
    """Fig. 12 (a): the fastest reaction of the nine."""
    pairs = [
        (make_cell("tof", "vo"), make_cell(s, c))
        for s in SENSINGS
        for c in CONFIGURATIONS
        if (s, c) != ("tof", "vo")
    ]
    return _claim(
        "reaction: Real Vo",
        "Vo with Real reacts fastest of the nine.",
        "s",
        _compare(
            results,
            "reaction_time_s",
            pairs,
            least=True,
        ),
        "From the true distance's fall to 0.5 m to the stop; an approach "
        "without a stop has no reaction time and counts as missed.",
        why=explanations.join(
            explanations.explain_earliest(results, make_cells()),
            explanations.explain_studies(
                results,
                "reaction_time_s",
                make_cells(),
                _orient(pairs, least=True),
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
                verdict=_check_run(
                    results,
                    (cell,),
                    judge_positive(dc.replace(value, mean=-value.mean)),
                ),
            )
        )
    return _claim(
        "reaction: sign",
        "Reaction times are negative: the stop comes before the person is at "
        "the critical distance.",
        "s",
        evidence,
        why=explanations.join(
            explanations.explain_late(results, make_cells()),
            explanations.explain_studies(
                results, "reaction_time_s", make_cells()
            ),
        ),
    )


def claim_real_reacts_before_ideal(results: Results) -> Claim:
    """Section IV: the rings are faster than the mesh distance."""
    return _claim(
        "reaction: Real over Ideal",
        "Real reacts faster than Ideal, because the mesh distance takes "
        "longer to compute.",
        "s",
        _compare(
            results,
            "reaction_time_s",
            [
                (make_cell("tof", c), make_cell("ideal", c))
                for c in CONFIGURATIONS
            ],
            least=True,
        ),
        why=explanations.explain_real_against_ideal(results),
    )


def claim_time_to_stop(results: Results) -> Claim:
    """Fig. 12 (b): stopping takes longest with SM."""
    return _claim(
        "time to stop",
        "With each sensing SM takes longest to stop.",
        "s",
        _compare(
            results,
            "time_to_stop_s",
            [
                (make_cell(s, "sm"), make_cell(s, c))
                for s in SENSINGS
                for c in ("vo", "vr")
            ],
        ),
        explanations.count_timed(results, "stop"),
        why=explanations.explain_ramps(results, "stop"),
    )


def claim_time_to_reduce(results: Results) -> Claim:
    """Fig. 12 (b): slowing takes longer with Vr and SM."""
    return _claim(
        "time to reduce",
        "With each sensing Vr and SM take longer to slow down than Vo.",
        "s",
        _compare(
            results,
            "time_to_reduce_s",
            [
                (make_cell(s, c), make_cell(s, "vo"))
                for s in SENSINGS
                for c in ("vr", "sm")
            ],
        ),
        explanations.count_timed(results, "reduce"),
        why=explanations.explain_ramps(results, "reduce"),
    )


def claim_vo_best_times(results: Results) -> Claim:
    """Fig. 12 (b): Vo gives the best results."""
    pairs = [
        (make_cell(s, "vo"), make_cell(s, c))
        for s in SENSINGS
        for c in ("vr", "sm")
    ]
    evidence = [
        dc.replace(e, what=f"{name}: {e.what}")
        for name, metric in (
            ("to stop", "time_to_stop_s"),
            ("to reduce", "time_to_reduce_s"),
        )
        for e in _compare(results, metric, pairs, least=True)
    ]
    return _claim(
        "times: Vo best",
        "Vo gives the best results: with each sensing it takes the least "
        "time to stop and to slow down.",
        "s",
        evidence,
        explanations.join(
            explanations.count_timed(results, "stop"),
            explanations.count_timed(results, "reduce"),
        ),
        why=explanations.join(
            explanations.explain_ramps(results, "stop"),
            explanations.explain_ramps(results, "reduce"),
        ),
    )


def claim_velocity_change(results: Results) -> Claim:
    """Fig. 12 (c): stops from the highest speed."""
    return _claim(
        "velocity change",
        "With each sensing Vr has the largest velocity change at a stop.",
        "m/s",
        _compare(
            results,
            "velocity_change_at_stop_mps",
            [
                (make_cell(s, "vr"), make_cell(s, c))
                for s in SENSINGS
                for c in ("vo", "sm")
            ],
        ),
        why=explanations.explain_speeds(results),
    )


def claim_separation_at_stop(results: Results) -> Claim:
    """Fig. 12 (d): where Real and Ideal stop."""
    return _claim_separation(
        results,
        "separation at stop",
        "Real and Ideal stop at about 0.5 m on average.",
        "separation_at_stop_m",
        0.5,
        _AT_STOP,
    )


def claim_separation_at_reduce(results: Results) -> Claim:
    """Fig. 12 (d): where Real and Ideal slow down."""
    return _claim_separation(
        results,
        "separation at reduce",
        "Real and Ideal slow down at about 0.75 m on average.",
        "separation_at_reduce_m",
        0.75,
        _AT_REDUCE,
    )


def claim_lidar_conservative(results: Results) -> Claim:
    """Fig. 12 (d): the Lidar stops farther away."""
    return _claim(
        "separation: Lidar",
        "The Lidar is more conservative: it stops at larger separations than "
        "Real and Ideal.",
        "m",
        _compare(
            results,
            "separation_at_stop_m",
            [
                (make_cell("lidar", c), make_cell(s, c))
                for s in ("tof", "ideal")
                for c in CONFIGURATIONS
            ],
        ),
        why=explanations.join(
            explanations.explain_law_distances(
                results, *_AT_STOP, make_cells()
            ),
            explanations.conclude_lidar(results),
        ),
    )


def claim_vo_smoother(results: Results) -> Claim:
    """Section V: relative speeds make the movement smoother."""
    return _claim(
        "smoothness: Vo",
        "Relative speeds give more consistent and smoother movement: with "
        "each sensing Vo changes its state less often than Vr and SM.",
        "changes per episode",
        _compare(
            results,
            "state_changes_per_episode",
            [
                (make_cell(s, "vo"), make_cell(s, c))
                for s in SENSINGS
                for c in ("vr", "sm")
            ],
            least=True,
        ),
        explanations.join(
            "An episode lasts from leaving the normal state until the robot "
            "is back in it for half a second.",
            explanations.list_long_episodes(results),
        ),
        why=explanations.explain_chatter(results),
        digits=2,
    )


def claim_sixteen(results: Results) -> Claim:
    """Section V: more sensors see more."""
    return _claim(
        "sixteen sensors",
        "Rings of 16 sensors have smaller blind spots (announced, without "
        "figures).",
        "percentage points",
        _compare(
            results,
            "detection_share",
            [
                (make_cell("tof16", c), make_cell("tof", c))
                for c in CONFIGURATIONS
            ],
            scale=100.0,
        ),
        "Share of the time with the person within 1.31 m in which any ring "
        "reports a distance.",
        why=explanations.explain_seeing(results, make_cells(("tof", "tof16"))),
        digits=1,
    )


CLAIMS: tuple[Callable[[Results], Claim], ...] = (
    claim_rmse,
    claim_rmse_order,
    claim_productivity_over_lidar,
    claim_vr_most_productive,
    claim_vr_less_safe,
    claim_vo_ideal_safest,
    claim_vo_safer_than_vr,
    claim_vo_safer_than_sm,
    claim_vo_more_productive_than_sm,
    claim_lidar_less_safe,
    claim_real_less_safe_than_ideal,
    claim_fastest_reaction,
    claim_reaction_anticipates,
    claim_real_reacts_before_ideal,
    claim_time_to_stop,
    claim_time_to_reduce,
    claim_vo_best_times,
    claim_velocity_change,
    claim_separation_at_stop,
    claim_separation_at_reduce,
    claim_lidar_conservative,
    claim_vo_smoother,
    claim_sixteen,
)
"""All claims in the order in which the paper makes them."""


def check_claims(results: Results) -> list[Claim]:
    """Holds all claims against results."""
    return [claim(results) for claim in CLAIMS]
