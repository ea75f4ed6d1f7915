"""What came out of a campaign, in plain words."""

import collections

from tofssm_drake.paper.cells import CONFIGURATION_LABEL
from tofssm_drake.paper.claim_rules import (
    NO_VALUE,
    NOT_REPRODUCED,
    NOT_RUN,
    REPRODUCED,
    UNDECIDED,
    Claim,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.reports.report import count_of
from tofssm_drake.reports.tables import count
from tofssm_drake.studies.statistics import calc_rate_bound, format_estimate

_NONE = "\u2013"
_MARK = {
    REPRODUCED: "\u2713",
    NOT_REPRODUCED: "\u2717",
    UNDECIDED: "?",
    NO_VALUE: _NONE,
    NOT_RUN: _NONE,
}


def make_claim_row(claim: Claim) -> dict:
    """Returns what the report shows of a claim."""
    return {
        "text": claim.text,
        "verdict": claim.verdict,
        "is_run": claim.verdict != NOT_RUN,
        "kind": {
            REPRODUCED: "good",
            NOT_REPRODUCED: "bad",
            UNDECIDED: "open",
            NO_VALUE: "none",
            NOT_RUN: "none",
        }[claim.verdict],
        "unit": claim.unit,
        "note": claim.note,
        "why": claim.why,
        "evidence": [
            {
                "what": e.what,
                "value": format_estimate(
                    e.estimate, digits=claim.digits, sign="\u2212" in e.what
                ),
                "verdict": e.verdict,
                "mark": _MARK[e.verdict],
            }
            for e in claim.evidence
        ],
    }


def make_verdict(
    results: Results, found: list[Claim], failures: dict[str, str]
) -> list[tuple[str, str]]:
    """Returns the results in plain words.

    Args:
        results: Of the campaign.
        found: The claims.
        failures: Reason by the label of the run that failed.

    Returns:
        (grade, sentence) pairs; grade is `good`, `bad` or `note`.
    """
    runs = results.count_runs()
    verdict = [
        _judge_claims(results, found),
        *_judge_contacts(results),
        *_judge_unfinished(results),
    ]
    if failures:
        verdict.append(
            (
                "bad",
                f"{len(failures)} of {count(runs + len(failures), 'run')} "
                "failed and left nothing in what follows.",
            )
        )
    return verdict


def _judge_claims(results, found):
    if len(results.trials) == 1:
        return (
            "note",
            "One trial has no confidence interval: no claim of the paper "
            "can be decided, whatever the numbers look like. The option "
            "--trials 5 adds trials to this campaign.",
        )
    verdicts = collections.Counter(claim.verdict for claim in found)
    judged = len(found) - verdicts[NOT_RUN] - verdicts[NO_VALUE]
    return (
        "note",
        f"Of {count(judged, 'claim')} of the paper that this campaign can "
        f"judge, {_be(verdicts[REPRODUCED])} reproduced, "
        f"{_be(verdicts[NOT_REPRODUCED])} not, and {_be(verdicts[UNDECIDED])} "
        "undecided.",
    )


def _judge_contacts(results):
    plain = [cell for cell in results.cells if not cell.variant]
    runs = sum(len(results.values(cell, "finished")) for cell in plain)
    contacts = results.total("contacts_while_moving", plain)
    if contacts:
        with_contact = sum(
            value > 0
            for cell in plain
            for value in results.values(cell, "contacts_while_moving").values()
        )
        return [
            (
                "bad",
                f"In {with_contact} of {count(runs, 'run')} the moving robot "
                f"touched the person ({count_of(round(contacts), 'contact')}). "
                "Runs with a contact: "
                f"{_count_by_configuration(results, plain)}.",
            )
        ]
    if not runs:
        return []
    bound = 100 * calc_rate_bound(runs)
    return [
        (
            "good",
            f"The moving robot touched nobody in {count(runs, 'run')}. That "
            f"only bounds the rate of contacts below {bound:.1f} % per run, "
            "with 95 % confidence.",
        )
    ]


def _judge_unfinished(results):
    runs = results.count_runs()
    unfinished = runs - results.total("finished")
    if not unfinished:
        return []
    return [
        (
            "note",
            f"In {unfinished:.0f} of {count(runs, 'run')} the task was not "
            "finished when the time was up: "
            f"{_describe_unfinished(results)}. In brackets, for how much of "
            "the time the person was truly within the distance at which the "
            "law stops the robot. Their productivity is that of the part "
            "that was done.",
        )
    ]


def _be(number):
    return f"{number} {'is' if number == 1 else 'are'}"


def _describe_unfinished(results):
    """Lists by cell what was not finished, and how long a stop was due."""
    parts = []
    for cell in results.cells:
        finished = results.values(cell, "finished")
        undone = sum(value == 0.0 for value in finished.values())
        if not undone:
            continue
        text = f"{cell.label} {undone} of {len(finished)}"
        due = results.estimate(cell, "stop_due_share")
        if due.count:
            text += f" ({100 * due.mean:.0f} %)"
        parts.append(text)
    return ", ".join(parts)


def _count_by_configuration(results, cells):
    """Returns how many runs had a contact, by configuration."""
    parts = []
    for c, name in CONFIGURATION_LABEL.items():
        values = [
            value
            for cell in cells
            if cell.configuration == c
            for value in results.values(cell, "contacts_while_moving").values()
        ]
        if values:
            touched = sum(value > 0 for value in values)
            parts.append(f"{name} {touched} of {len(values)}")
    return ", ".join(parts)
