"""What the paper says came out, held against a campaign's results.

Each claim is a function from results to a verdict with the numbers behind
it. The rules are the same for all and were fixed before any run:

- A claim that one cell exceeds others is *reproduced* if the paired
  difference to each of them is above 0 with 95 % confidence; *not
  reproduced* if the difference to any of them is below 0 with 95 %
  confidence; *undecided* else.
- A claim that a value is about x is *reproduced* if the 95 % confidence
  interval of the mean lies within x +- 20 %; *not reproduced* if it lies
  outside of it; *undecided* else.
- A claim of several parts is not reproduced if one of them is not, and
  reproduced if all of them are.
- *Not run*: the campaign lacks a cell that the claim speaks of.
"""

from collections.abc import Callable
import dataclasses as dc
import math

from tofssm_drake.evaluation.campaign import Cell
from tofssm_drake.evaluation.results import Results
from tofssm_drake.evaluation.statistics import Estimate

REPRODUCED = "reproduced"
NOT_REPRODUCED = "not reproduced"
UNDECIDED = "undecided"
NOT_RUN = "not run"

TOLERANCE = 0.2
"""What "about" means, as a fraction."""

SAFETY = {
    "safety_mean_m2_per_mps": "mean",
    "safety_ratio_of_means_m2_per_mps": "ratio of means",
    "safety_median_m2_per_mps": "median",
}
"""The three averages of the safety metric; the first one decides."""

_SENSINGS = ("tof", "ideal", "lidar")
_CONFIGURATIONS = ("vo", "vr", "sm")


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
    """A claim of the paper with what came out here."""

    key: str
    """Short name."""
    text: str
    """What the paper says, in our words."""
    verdict: str
    """REPRODUCED, NOT_REPRODUCED, UNDECIDED or NOT_RUN."""
    unit: str
    """Of the evidence; empty: a ratio."""
    evidence: tuple[Evidence, ...] = ()
    note: str = ""
    """What else one has to know."""
    why: str = ""
    """Why it is not reproduced, as far as the results tell; empty unless so."""


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
    for verdict in (NOT_RUN, NOT_REPRODUCED, UNDECIDED):
        if verdict in verdicts:
            return verdict
    return REPRODUCED if verdicts else NOT_RUN


def _cell(sensing, configuration):
    return Cell(sensing=sensing, configuration=configuration)


def _compare(results, metric, pairs, *, least=False):
    """Evidence that the first of each pair has more of the metric.

    Args:
        results: Of the campaign.
        metric: Column.
        pairs: (first, second) cells.
        least: Claims that the first has less instead.
    """
    evidence = []
    for first, second in pairs:
        if least:
            first, second = second, first
        difference = results.difference(first, second, metric)
        evidence.append(
            Evidence(
                what=f"{first.label} \u2212 {second.label}",
                estimate=difference,
                verdict=judge_positive(difference),
            )
        )
    return evidence


def _claim(key, text, unit, evidence, note="", why=""):
    verdict = combine([e.verdict for e in evidence])
    return Claim(
        key=key,
        text=text,
        verdict=verdict,
        unit=unit,
        evidence=tuple(evidence),
        note=note,
        why=why if verdict in (NOT_REPRODUCED, UNDECIDED) else "",
    )


def _list_means(results, metric, cells, *, digits=2, scale=1.0):
    """Returns `Real Vo 0.53, ...` of the cells that were run."""
    parts = []
    for cell in cells:
        value = results.estimate(cell, metric)
        if value.count:
            mean = f"{scale * value.mean:.{digits}f}".replace("-", "\u2212")
            parts.append(f"{cell.label} {mean}")
    return ", ".join(parts)


def _claim_safety(results, key, text, pairs, *, least=False, why=""):
    """A claim on the safety metric, with what the other averages say."""
    metrics = list(SAFETY)
    evidence = _compare(results, metrics[0], pairs, least=least)
    others = []
    for metric in metrics[1:]:
        verdict = combine(
            [e.verdict for e in _compare(results, metric, pairs, least=least)]
        )
        others.append(f"by the {SAFETY[metric]}: {verdict}")
    note = f"By the mean over the samples. {'; '.join(others).capitalize()}."
    return _claim(key, text, "m\u00b2/(m/s)", evidence, note, why)


def _explain_slow_lidar(results):
    """Tells what a robot that mostly stands does to the safety metric."""
    stopped = _list_means(
        results,
        "stopped_s",
        [_cell(s, "vo") for s in _SENSINGS],
        digits=0,
    )
    return (
        "The metric divides by the tool speed: who keeps the robot slow or "
        f"standing scores high. Time stopped per run (s): {stopped}."
    )


def _about(results, metric, targets):
    evidence = []
    for cell, target in targets:
        value = results.estimate(cell, metric)
        evidence.append(
            Evidence(
                what=f"{cell.label} (paper: {target:g})",
                estimate=value,
                verdict=judge_about(value, target),
            )
        )
    return evidence


def _explain_errors(results):
    """Tells where the errors come from, with the study if any."""
    text = (
        "Three link centres can not stand for the robot's whole surface: the "
        "Ideal distance, which has no sensor error, errs by as much as the "
        "nearest part is away from a link's centre (hand, gripper, forearm's "
        "ends). The lidar's distance is that from the base, right only while "
        "the arm points at the person."
    )
    exact = Cell(sensing="tof", configuration="vo", variant="exact")
    value = results.difference(
        exact, _cell("tof", "vo"), "distance_rmse_surface_m"
    )
    if value.count:
        change = format_estimate(value, sign=True)
        text += f" Without any sensor error the rings' changes by {change} m."
    return text


def claim_rmse(results: Results) -> Claim:
    """Fig. 9: errors of the distances."""
    targets = {"ideal": 0.009, "tof": 0.063, "lidar": 0.128}
    return _claim(
        "rmse",
        "The minimum distance errs by 9 mm (Ideal), 63 mm (ToF rings) and "
        "128 mm (Lidar) RMSE against the ground truth.",
        "m",
        _about(
            results,
            "distance_rmse_surface_m",
            [(_cell(s, "vo"), target) for s, target in targets.items()],
        ),
        "Distances with the radius of what they are measured from taken off, "
        "in configuration Vo. The distance from a link's centre to a surface "
        "can not be 9 mm from that between two surfaces.",
        why=_explain_errors(results),
    )


def claim_rmse_order(results: Results) -> Claim:
    """Fig. 9: order of the errors."""
    return _claim(
        "rmse order",
        "Ideal errs least and the Lidar most.",
        "m",
        _compare(
            results,
            "distance_rmse_surface_m",
            [
                pair
                for c in _CONFIGURATIONS
                for pair in (
                    (_cell("lidar", c), _cell("tof", c)),
                    (_cell("tof", c), _cell("ideal", c)),
                )
            ],
        ),
    )


def claim_productivity_over_lidar(results: Results) -> Claim:
    """Fig. 10: on-robot sensing costs less time."""
    return _claim(
        "productivity: sensing",
        "Real and Ideal are more productive than the Lidar.",
        "",
        _compare(
            results,
            "productivity",
            [
                (_cell(s, c), _cell("lidar", c))
                for s in ("tof", "ideal")
                for c in _CONFIGURATIONS
            ],
        ),
    )


def claim_vr_most_productive(results: Results) -> Claim:
    """Fig. 10: the most productive configuration."""
    return _claim(
        "productivity: Vr",
        "Vr is the most productive configuration of Real and of Ideal.",
        "",
        _compare(
            results,
            "productivity",
            [
                (_cell(s, "vr"), _cell(s, c))
                for s in ("tof", "ideal")
                for c in ("vo", "sm")
            ],
        ),
    )


def claim_vr_less_safe(results: Results) -> Claim:
    """Fig. 10: what the productivity of Vr costs."""
    return _claim_safety(
        results,
        "safety: Vr",
        "Vr is the least safe configuration of Real and of Ideal.",
        [
            (_cell(s, "vr"), _cell(s, c))
            for s in ("tof", "ideal")
            for c in ("vo", "sm")
        ],
        least=True,
        why=(
            "Vr and SM differ by less than the trials do. Time stopped per "
            "run (s): "
            + _list_means(
                results,
                "stopped_s",
                [_cell(s, c) for s in ("tof", "ideal") for c in ("vr", "sm")],
                digits=0,
            )
            + "."
        ),
    )


def claim_vo_ideal_safest(results: Results) -> Claim:
    """Fig. 10: the safest of the nine cells."""
    return _claim_safety(
        results,
        "safety: Ideal Vo",
        "Vo with the Ideal distance is the safest of the nine.",
        [
            (_cell("ideal", "vo"), _cell(s, c))
            for s in _SENSINGS
            for c in _CONFIGURATIONS
            if (s, c) != ("ideal", "vo")
        ],
        why=_explain_slow_lidar(results),
    )


def claim_vo_safer_than_vr(results: Results) -> Claim:
    """Fig. 10: Vo against Vr."""
    return _claim_safety(
        results,
        "safety: Vo over Vr",
        "With each sensing Vo is safer than Vr.",
        [(_cell(s, "vo"), _cell(s, "vr")) for s in _SENSINGS],
    )


def claim_lidar_less_safe(results: Results) -> Claim:
    """Fig. 10: the Lidar's safety."""
    return _claim_safety(
        results,
        "safety: Lidar",
        "The Lidar is less safe than Real and Ideal.",
        [
            (_cell("lidar", c), _cell(s, c))
            for s in ("tof", "ideal")
            for c in _CONFIGURATIONS
        ],
        least=True,
        why=_explain_slow_lidar(results),
    )


def claim_real_less_safe_than_ideal(results: Results) -> Claim:
    """Section IV: what the error of the rings costs."""
    return _claim_safety(
        results,
        "safety: Real",
        "Real is less safe than Ideal, because its distances err more.",
        [(_cell("tof", c), _cell("ideal", c)) for c in _CONFIGURATIONS],
        least=True,
        why=(
            "Errors of the rings go both ways: they see the person too late, "
            "or stop where Ideal would not. Time stopped per run (s): "
            + _list_means(
                results,
                "stopped_s",
                [
                    _cell(s, c)
                    for s in ("tof", "ideal")
                    for c in _CONFIGURATIONS
                ],
                digits=0,
            )
            + "."
        ),
    )


def claim_fastest_reaction(results: Results) -> Claim:
    """Fig. 12 (a): the fastest reaction of the nine."""
    return _claim(
        "reaction: Real Vo",
        "Vo with Real reacts fastest of the nine.",
        "s",
        _compare(
            results,
            "reaction_time_s",
            [
                (_cell("tof", "vo"), _cell(s, c))
                for s in _SENSINGS
                for c in _CONFIGURATIONS
                if (s, c) != ("tof", "vo")
            ],
            least=True,
        ),
        "From the true distance's fall to 0.5 m to the stop; an approach "
        "without a stop has no reaction time and counts as missed.",
        why=(
            "The lidar sees the person all the way and its distances are the "
            "largest, so that it stops as early."
        ),
    )


def claim_reaction_anticipates(results: Results) -> Claim:
    """Fig. 12 (a): reactions come before the threshold."""
    evidence = []
    for s in _SENSINGS:
        for c in _CONFIGURATIONS:
            cell = _cell(s, c)
            value = results.estimate(cell, "reaction_time_s")
            evidence.append(
                Evidence(
                    what=cell.label,
                    estimate=value,
                    verdict=judge_positive(dc.replace(value, mean=-value.mean)),
                )
            )
    return _claim(
        "reaction: sign",
        "Reaction times are negative: the stop comes before the person is at "
        "the critical distance.",
        "s",
        evidence,
        why=(
            "SM stops at 0.5 m from a link's centre, which is less than 0.5 m "
            "between the surfaces: it can not come before. At rest Vr stops "
            "at 0.585 m from the centre, hardly more."
        ),
    )


def _explain_reaction(results):
    """Tells what makes rings earlier or later, with the study if any."""
    text = (
        "Ideal comes without delay here. The rings are later by their "
        "sampling and filter, and by what they do not see; with Vo they are "
        "earlier, because a person seen for the first time counts as walking "
        "in at 1.6 m/s."
    )
    studied = []
    for c in _CONFIGURATIONS:
        late = Cell(sensing="ideal", configuration=c, variant="late")
        value = results.difference(late, _cell("tof", c), "reaction_time_s")
        if value.count:
            difference = format_estimate(value, digits=2, sign=True)
            studied.append(
                f"{_cell('tof', c).label.removeprefix('Real ')} {difference} s"
            )
    if studied:
        text += (
            " With an Ideal distance that comes 0.1 s late, Ideal \u2212 Real "
            f"is: {', '.join(studied)}."
        )
    return text


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
            [(_cell("tof", c), _cell("ideal", c)) for c in _CONFIGURATIONS],
            least=True,
        ),
        why=_explain_reaction(results),
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
                (_cell(s, "sm"), _cell(s, c))
                for s in _SENSINGS
                for c in ("vo", "vr")
            ],
        ),
        why=(
            "A stop takes as long as the speed fraction has to fall: what "
            "counts is how fast the robot was. Tool speed at a stop (m/s): "
            + _list_means(
                results,
                "velocity_change_at_stop_mps",
                [_cell(s, c) for s in _SENSINGS for c in _CONFIGURATIONS],
            )
            + "."
        ),
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
                (_cell(s, c), _cell(s, "vo"))
                for s in _SENSINGS
                for c in ("vr", "sm")
            ],
        ),
        "From full speed the ramp takes 0.25 s; it is shorter where the robot "
        "had not yet reached full speed again.",
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
                (_cell(s, "vr"), _cell(s, c))
                for s in _SENSINGS
                for c in ("vo", "sm")
            ],
        ),
    )


def claim_separation_at_stop(results: Results) -> Claim:
    """Fig. 12 (d): where Real and Ideal stop."""
    return _claim(
        "separation at stop",
        "Real and Ideal stop at about 0.5 m on average.",
        "m",
        _about(
            results,
            "separation_at_stop_m",
            [
                (_cell(s, c), 0.5)
                for s in ("tof", "ideal")
                for c in _CONFIGURATIONS
            ],
        ),
        why=(
            "The distance at a stop follows the law's own: SM stops at 0.5 m "
            "from the link's centre, Vo the earlier the faster the person "
            "comes."
        ),
    )


def claim_separation_at_reduce(results: Results) -> Claim:
    """Fig. 12 (d): where Real and Ideal slow down."""
    return _claim(
        "separation at reduce",
        "Real and Ideal slow down at about 0.75 m on average.",
        "m",
        _about(
            results,
            "separation_at_reduce_m",
            [
                (_cell(s, c), 0.75)
                for s in ("tof", "ideal")
                for c in _CONFIGURATIONS
            ],
        ),
        why=(
            "As at a stop: with Vo the distance grows with the closing speed, "
            "and a person who is seen for the first time counts as walking in."
        ),
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
                (_cell("lidar", c), _cell(s, c))
                for s in ("tof", "ideal")
                for c in _CONFIGURATIONS
            ],
        ),
    )


def claim_sixteen(results: Results) -> Claim:
    """Section V: more sensors see more."""
    return _claim(
        "sixteen sensors",
        "Rings of 16 sensors have smaller blind spots (announced, without "
        "figures).",
        "",
        _compare(
            results,
            "detection_share",
            [(_cell("tof16", c), _cell("tof", c)) for c in _CONFIGURATIONS],
        ),
        "Share of the time with the person within 1.31 m in which any ring "
        "reports a distance.",
    )


CLAIMS: tuple[Callable[[Results], Claim], ...] = (
    claim_rmse,
    claim_rmse_order,
    claim_productivity_over_lidar,
    claim_vr_most_productive,
    claim_vr_less_safe,
    claim_vo_ideal_safest,
    claim_vo_safer_than_vr,
    claim_lidar_less_safe,
    claim_real_less_safe_than_ideal,
    claim_fastest_reaction,
    claim_reaction_anticipates,
    claim_real_reacts_before_ideal,
    claim_time_to_stop,
    claim_time_to_reduce,
    claim_velocity_change,
    claim_separation_at_stop,
    claim_separation_at_reduce,
    claim_lidar_conservative,
    claim_sixteen,
)
"""All claims in the order in which the paper makes them."""


def check_claims(results: Results) -> list[Claim]:
    """Holds all claims against results."""
    return [claim(results) for claim in CLAIMS]


def format_estimate(value: Estimate, *, digits: int = 3, sign=False) -> str:
    """Returns `mean +- half width`; an en dash where there is none."""
    if not value.count:
        return "\u2013"
    text = f"{value.mean:{'+' if sign else ''}.{digits}f}"
    text = text.replace("-", "\u2212")
    if math.isfinite(value.half_width):
        text += f" \u00b1 {value.half_width:.{digits}f}"
    return text
