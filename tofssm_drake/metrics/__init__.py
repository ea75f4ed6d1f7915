"""Ground truth, metrics, audit."""

from tofssm_drake.metrics.approach import find_approach
from tofssm_drake.metrics.audit import calc_audit
from tofssm_drake.metrics.ground_truth import GroundTruth, TruthModel
from tofssm_drake.metrics.metrics import (
    calc_summary,
    find_contacts,
    find_episodes,
)
from tofssm_drake.metrics.run_metrics import calc_run_metrics
from tofssm_drake.metrics.standards import AuditConfig, calc_protective_distance

__all__ = [
    "AuditConfig",
    "GroundTruth",
    "TruthModel",
    "calc_audit",
    "calc_protective_distance",
    "calc_run_metrics",
    "calc_summary",
    "find_approach",
    "find_contacts",
    "find_episodes",
]
