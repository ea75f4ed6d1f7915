"""What several claims have in common: their words and explanations."""

from collections.abc import Sequence
import importlib.resources

import yaml

from tofssm_drake.paper import (
    explain_distances,
    explain_variants,
    explain_work,
    sentences,
)
from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.claim_rules import (
    NOT_REPRODUCED,
    TOLERANCE,
    UNDECIDED,
    Claim,
    Evidence,
    combine,
    compare,
    list_about,
    orient,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import (
    make_cells,
)

Pairs = Sequence[tuple[Cell, Cell]]

SAFETY = {
    "safety_mean_m2_per_mps": "mean",
    "safety_ratio_of_means_m2_per_mps": "ratio of means",
    "safety_median_m2_per_mps": "median",
}
"""The three averages of the safety metric; the first one decides."""


_WORDS = yaml.safe_load(
    importlib.resources.files(__package__)
    .joinpath("claims.yaml")
    .read_text(encoding="utf-8")
)
"""What the report says of a claim, by its key."""


def make_claim(
    key: str, evidence: Sequence[Evidence], note: str = "", why: str = ""
) -> Claim:
    """Returns a claim with its words; an explanation only where it is due."""
    words = _WORDS[key]
    verdict = combine([e.verdict for e in evidence])
    is_open = verdict in (NOT_REPRODUCED, UNDECIDED)
    is_known = any(e.estimate.count > 1 for e in evidence)
    return Claim(
        key=key,
        text=words["text"],
        verdict=verdict,
        unit=words["unit"],
        evidence=tuple(evidence),
        digits=words.get("digits", 3),
        note=sentences.join(words.get("note", ""), note),
        why=why if is_open and is_known else "",
    )


def _find_cells(pairs):
    """Returns the cells of pairs in the order of the tables."""
    return [c for c in make_cells() if any(c in pair for pair in pairs)]


def make_safety_claim(
    results: Results,
    key: str,
    pairs: Pairs,
    *,
    least: bool = False,
    why: str = "",
) -> Claim:
    """Returns a claim on the safety metric, by all three averages."""
    metrics = list(SAFETY)
    evidence = compare(results, metrics[0], pairs, least=least)
    others = []
    for metric in metrics[1:]:
        verdict = combine(
            [e.verdict for e in compare(results, metric, pairs, least=least)]
        )
        others.append(f"by the {SAFETY[metric]}: {verdict}")
    cells = _find_cells(pairs)
    note = sentences.join(
        f"By the mean over the samples. {'; '.join(others).capitalize()}.",
        explain_work.count_contacts(results, cells),
    )
    verdict = combine([e.verdict for e in evidence])
    oriented = orient(pairs, least)
    deciding = [
        pair
        for pair, e in zip(oriented, evidence, strict=True)
        if e.verdict == verdict
    ]
    why = sentences.join(
        explain_work.explain_standing(results, cells, metrics[0], deciding),
        why,
        explain_variants.explain_variants(results, metrics[0], cells, oriented),
    )
    return make_claim(key, evidence, note, why)


def make_productivity_claim(
    results: Results, key: str, pairs: Pairs, *, by: str = "sensing"
) -> Claim:
    """Returns a claim on productivity, with the time that is lost.

    Args:
        results: Of the campaign.
        key: Of the claim.
        pairs: (first, second) cells; the first is claimed to have more.
        by: What the cells of a pair have in common.
    """
    cells = _find_cells(pairs)
    return make_claim(
        key,
        compare(results, "productivity", pairs, scale=100.0),
        why=sentences.join(
            explain_variants.explain_variants(
                results, "productivity", cells, pairs, digits=1, scale=100.0
            ),
            explain_work.explain_times(results, cells, by=by),
        ),
    )


def make_separation_claim(
    results: Results,
    key: str,
    metric: str,
    target: float,
    asked: tuple[str, str],
) -> Claim:
    """Returns a claim on the separation of Real and Ideal at events.

    Args:
        results: Of the campaign.
        key: Of the claim.
        metric: Column of the separation.
        target: What the paper reports, m.
        asked: Name and column of the distance that the law asks for.
    """
    cells = make_cells(("tof", "ideal"))
    return make_claim(
        key,
        list_about(results, metric, [(cell, target) for cell in cells]),
        why=sentences.join(
            explain_variants.explain_variants(results, metric, cells),
            explain_distances.explain_law_distances(results, *asked, cells),
            explain_distances.conclude_separation(
                results, metric, asked[1], cells, target, TOLERANCE
            ),
        ),
    )


AT_STOP = ("d_C at the stops", "d_C_at_stop_m")
AT_REDUCE = ("d_R at these changes", "d_R_at_reduce_m")
