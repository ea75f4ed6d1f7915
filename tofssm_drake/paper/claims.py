"""The claims of the paper, compared with a campaign's results.

Each claim is a function from results to a verdict with the numbers behind it
(`claim_rules.py`), and with an explanation, where it does not hold: another
function, from results to sentences. What an explanation says about this
campaign comes from the campaign's numbers: other numbers give other sentences,
and cells that were not run are not mentioned. The words of the claims are in
`claims.yaml`.
"""

from collections.abc import Callable

from tofssm_drake.paper.claim_rules import Claim
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.stop_claims import (
    claim_fastest_reaction,
    claim_lidar_conservative,
    claim_reaction_anticipates,
    claim_real_reacts_before_ideal,
    claim_separation_at_reduce,
    claim_separation_at_stop,
    claim_sixteen,
    claim_time_to_reduce,
    claim_time_to_stop,
    claim_velocity_change,
    claim_vo_best_times,
    claim_vo_smoother,
)
from tofssm_drake.paper.work_claims import (
    claim_lidar_less_safe,
    claim_productivity_over_lidar,
    claim_real_less_safe_than_ideal,
    claim_rmse,
    claim_rmse_order,
    claim_vo_ideal_safest,
    claim_vo_more_productive_than_sm,
    claim_vo_safer_than_sm,
    claim_vo_safer_than_vr,
    claim_vr_less_safe,
    claim_vr_most_productive,
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
