import dataclasses as dc
import itertools
import unittest

from synthetic_campaign import make_means, make_rows, make_small_plan

from tofssm_drake.paper import claim_rules
import tofssm_drake.paper.claims as mut
from tofssm_drake.paper.results import Results
from tofssm_drake.paper.sentences import make_cell
from tofssm_drake.studies.results import make_results
from tofssm_drake.studies.statistics import Estimate, format_estimate

_SENSINGS = ("tof", "ideal", "lidar")
_CONFIGURATIONS = ("vo", "vr", "sm")
_NINE = list(itertools.product(_SENSINGS, _CONFIGURATIONS))


def make_results_of(metric, means, *, trials=4, sensings=None):
    """Results with these means of a metric, or of several."""
    plan = make_small_plan(trials, sensings=sensings)
    metrics = [metric] if isinstance(metric, str) else metric
    changes = [make_means(means, name) for name in metrics]

    def change(cell, trial):
        return {k: v for one in changes for k, v in one(cell, trial).items()}

    plain = {"task_time_s": 80.0, **dict.fromkeys(metrics, 0.0)}
    rows = make_rows(plan, plain, change)
    return Results(make_results(plan, rows))


def by_sensing(tof, ideal, lidar):
    values = {"tof": tof, "ideal": ideal, "lidar": lidar}
    return {(s, c): values[s] for s, c in _NINE}


def by_configuration(vo, vr, sm):
    values = {"vo": vo, "vr": vr, "sm": sm}
    return {(s, c): values[c] for s, c in _NINE}


def one_out(sensing, configuration, value, others):
    means = dict.fromkeys(_NINE, others)
    means[sensing, configuration] = value
    return means


SAFETY = "safety_mean_m2_per_mps"

# Claim, its metric, means that bear it out, means that contradict it.
CASES = [
    (
        mut.claim_rmse,
        "distance_rmse_surface_m",
        None,
        by_sensing(0.3, 0.3, 0.3),
    ),
    (
        mut.claim_rmse_order,
        "distance_rmse_surface_m",
        by_sensing(0.2, 0.1, 0.4),
        by_sensing(0.2, 0.3, 0.4),
    ),
    (
        mut.claim_productivity_over_lidar,
        "productivity",
        by_sensing(0.6, 0.5, 0.2),
        by_sensing(0.6, 0.1, 0.2),
    ),
    (
        mut.claim_vr_most_productive,
        "productivity",
        by_configuration(0.4, 0.6, 0.5),
        by_configuration(0.4, 0.6, 0.7),
    ),
    (
        mut.claim_vr_less_safe,
        SAFETY,
        by_configuration(5.0, 4.0, 4.5),
        by_configuration(5.0, 4.0, 3.5),
    ),
    (
        mut.claim_vo_ideal_safest,
        SAFETY,
        one_out("ideal", "vo", 6.0, 5.0),
        one_out("lidar", "sm", 6.0, 5.0),
    ),
    (
        mut.claim_vo_safer_than_vr,
        SAFETY,
        by_configuration(5.0, 4.0, 9.0),
        by_configuration(4.0, 5.0, 1.0),
    ),
    (
        mut.claim_vo_safer_than_sm,
        SAFETY,
        by_configuration(5.0, 9.0, 4.0),
        by_configuration(4.0, 1.0, 5.0),
    ),
    (
        mut.claim_vo_more_productive_than_sm,
        "productivity",
        by_configuration(0.5, 0.9, 0.4),
        by_configuration(0.4, 0.1, 0.5),
    ),
    (
        mut.claim_lidar_less_safe,
        SAFETY,
        by_sensing(5.0, 5.0, 3.0),
        by_sensing(5.0, 2.0, 3.0),
    ),
    (
        mut.claim_real_less_safe_than_ideal,
        SAFETY,
        by_sensing(4.0, 5.0, 0.0),
        by_sensing(5.0, 4.0, 0.0),
    ),
    (
        mut.claim_fastest_reaction,
        "reaction_time_s",
        one_out("tof", "vo", -0.5, 0.1),
        one_out("lidar", "vo", -0.5, 0.1),
    ),
    (
        mut.claim_reaction_anticipates,
        "reaction_time_s",
        by_sensing(-0.3, -0.2, -0.5),
        by_configuration(-0.3, -0.2, 0.5),
    ),
    (
        mut.claim_real_reacts_before_ideal,
        "reaction_time_s",
        by_sensing(-0.3, -0.1, 0.0),
        by_sensing(-0.1, -0.3, 0.0),
    ),
    (
        mut.claim_time_to_stop,
        "time_to_stop_s",
        by_configuration(0.1, 0.2, 0.3),
        by_configuration(0.1, 0.4, 0.3),
    ),
    (
        mut.claim_time_to_reduce,
        "time_to_reduce_s",
        by_configuration(0.1, 0.2, 0.3),
        by_configuration(0.2, 0.3, 0.1),
    ),
    (
        mut.claim_vo_best_times,
        ("time_to_stop_s", "time_to_reduce_s"),
        by_configuration(0.1, 0.2, 0.3),
        by_configuration(0.2, 0.1, 0.3),
    ),
    (
        mut.claim_vo_smoother,
        "state_changes_per_episode",
        by_configuration(2.0, 2.5, 3.0),
        by_configuration(2.0, 1.5, 3.0),
    ),
    (
        mut.claim_velocity_change,
        "velocity_change_at_stop_mps",
        by_configuration(0.5, 0.9, 0.6),
        by_configuration(0.5, 0.9, 1.1),
    ),
    (
        mut.claim_separation_at_stop,
        "separation_at_stop_m",
        by_sensing(0.5, 0.52, 3.0),
        by_sensing(0.5, 0.8, 0.5),
    ),
    (
        mut.claim_separation_at_reduce,
        "separation_at_reduce_m",
        by_sensing(0.75, 0.7, 3.0),
        by_sensing(0.75, 1.1, 0.75),
    ),
    (
        mut.claim_lidar_conservative,
        "separation_at_stop_m",
        by_sensing(0.5, 0.5, 0.9),
        by_sensing(0.5, 0.9, 0.6),
    ),
    (
        mut.claim_sixteen,
        "detection_share",
        {("tof16", c): 0.9 for c in _CONFIGURATIONS},
        {("tof", c): 0.9 for c in _CONFIGURATIONS},
    ),
]


class TestRules(unittest.TestCase):
    def test_positive(self):
        for mean, half, count, expected in (
            (0.3, 0.2, 5, claim_rules.REPRODUCED),
            (-0.3, 0.2, 5, claim_rules.NOT_REPRODUCED),
            (0.1, 0.2, 5, claim_rules.UNDECIDED),
            (-0.1, 0.2, 5, claim_rules.UNDECIDED),
            (0.3, float("nan"), 1, claim_rules.UNDECIDED),
            (float("nan"), float("nan"), 0, claim_rules.NOT_RUN),
        ):
            value = Estimate(mean=mean, half_width=half, count=count)
            self.assertEqual(claim_rules.judge_positive(value), expected)

    def test_about(self):
        for mean, half, expected in (
            (0.5, 0.05, claim_rules.REPRODUCED),
            (0.59, 0.005, claim_rules.REPRODUCED),
            (0.59, 0.05, claim_rules.UNDECIDED),
            (0.7, 0.05, claim_rules.NOT_REPRODUCED),
            (0.3, 0.05, claim_rules.NOT_REPRODUCED),
            (0.5, 0.4, claim_rules.UNDECIDED),
        ):
            value = Estimate(mean=mean, half_width=half, count=5)
            self.assertEqual(
                claim_rules.judge_about(value, 0.5), expected, mean
            )

    def test_parts(self):
        yes, no, open_, missing = (
            claim_rules.REPRODUCED,
            claim_rules.NOT_REPRODUCED,
            claim_rules.UNDECIDED,
            claim_rules.NOT_RUN,
        )
        self.assertEqual(claim_rules.combine([yes, yes]), yes)
        self.assertEqual(claim_rules.combine([yes, open_]), open_)
        self.assertEqual(claim_rules.combine([open_, no, yes]), no)
        self.assertEqual(claim_rules.combine([no, missing]), missing)
        self.assertEqual(
            claim_rules.combine([yes, claim_rules.NO_VALUE]),
            claim_rules.NO_VALUE,
        )
        self.assertEqual(claim_rules.combine([no, claim_rules.NO_VALUE]), no)
        self.assertEqual(claim_rules.combine([]), missing)

    def test_format(self):
        value = Estimate(mean=-0.1234, half_width=0.05, count=3)
        self.assertEqual(
            format_estimate(value, digits=2), "\u22120.12 \u00b1 0.05"
        )
        value = dc.replace(value, mean=0.5, half_width=float("nan"))
        self.assertEqual(format_estimate(value, sign=True), "+0.500")
        self.assertEqual(format_estimate(dc.replace(value, count=0)), "\u2013")


class TestClaims(unittest.TestCase):
    def test_every_claim_has_a_case(self):
        self.assertEqual({case[0] for case in CASES}, set(mut.CLAIMS))

    def test_borne_out(self):
        for claim, metric, means, _ in CASES:
            if means is None:
                continue
            with self.subTest(claim.__name__):
                found = claim(make_results_of(metric, means))
                self.assertEqual(found.verdict, claim_rules.REPRODUCED)
                for evidence in found.evidence:
                    self.assertEqual(evidence.verdict, claim_rules.REPRODUCED)

    def test_contradicted(self):
        for claim, metric, _, means in CASES:
            with self.subTest(claim.__name__):
                found = claim(make_results_of(metric, means))
                self.assertEqual(found.verdict, claim_rules.NOT_REPRODUCED)

    def test_too_little_to_decide(self):
        """One trial has no interval; equal cells do not differ."""
        for claim, metric, means, _ in CASES[1:]:
            with self.subTest(claim.__name__):
                found = claim(make_results_of(metric, means, trials=1))
                self.assertEqual(found.verdict, claim_rules.UNDECIDED)

    def test_cells_are_missing(self):
        for claim, metric, _, means in CASES:
            with self.subTest(claim.__name__):
                found = claim(
                    make_results_of(metric, means, sensings=["lidar"])
                )
                self.assertEqual(found.verdict, claim_rules.NOT_RUN)

    def test_rmse_takes_the_papers_figures(self):
        means = {("ideal", "vo"): 0.009, ("tof", "vo"): 0.063}
        results = make_results_of("distance_rmse_surface_m", means)
        found = mut.claim_rmse(results)
        self.assertEqual(
            [e.what for e in found.evidence],
            [
                "Ideal Vo (paper: 9)",
                "Real Vo (paper: 63)",
                "Lidar Vo (paper: 128)",
            ],
        )
        self.assertEqual(found.unit, "mm")
        self.assertAlmostEqual(found.evidence[1].estimate.mean, 63, delta=15)

    def test_shares_are_told_in_percent(self):
        results = make_results_of("productivity", by_sensing(0.6, 0.5, 0.2))
        found = mut.claim_productivity_over_lidar(results)
        self.assertEqual(found.unit, "percentage points")
        self.assertAlmostEqual(found.evidence[0].estimate.mean, 40, delta=0.5)
        means = {("tof16", c): 0.9 for c in ("vo", "vr", "sm")}
        found = mut.claim_sixteen(make_results_of("detection_share", means))
        self.assertEqual(found.unit, "percentage points")
        self.assertAlmostEqual(found.evidence[0].estimate.mean, 90, delta=0.5)

    def test_both_times_decide_who_is_best(self):
        def verdict(stop, reduce):
            plan = make_small_plan(4)
            changes = [
                make_means(by_configuration(*means), metric)
                for metric, means in (
                    ("time_to_stop_s", stop),
                    ("time_to_reduce_s", reduce),
                )
            ]
            rows = make_rows(
                plan,
                {"task_time_s": 80.0},
                lambda c, t: changes[0](c, t) | changes[1](c, t),
            )
            found = mut.claim_vo_best_times(Results(make_results(plan, rows)))
            self.assertEqual(len(found.evidence), 12)
            self.assertTrue(found.evidence[0].what.startswith("to stop: "))
            return found.verdict

        best, worst = (0.1, 0.2, 0.3), (0.3, 0.2, 0.1)
        self.assertEqual(verdict(best, best), claim_rules.REPRODUCED)
        self.assertEqual(verdict(best, worst), claim_rules.NOT_REPRODUCED)
        self.assertEqual(verdict(worst, best), claim_rules.NOT_REPRODUCED)

    def test_equal_values_decide_nothing(self):
        """Counts are often equal in a few trials; that is no certainty."""
        plan = make_small_plan(4)
        rows = make_rows(
            plan,
            {"task_time_s": 80.0},
            lambda cell, trial: {
                "state_changes_per_episode": 2.0 + (cell.configuration != "vo")
            },
        )
        found = mut.claim_vo_smoother(Results(make_results(plan, rows)))
        self.assertEqual(found.evidence[0].estimate.mean, 1.0)
        self.assertEqual(found.verdict, claim_rules.UNDECIDED)

    def test_why(self):
        """Told where a claim does not hold, with the studies that were run."""
        plan = make_small_plan(3, variants=["exact", "late"])
        change = make_means(by_sensing(0.3, 0.3, 0.3), "reaction_time_s")
        for studied in (False, True):
            rows = make_rows(
                plan,
                {"task_time_s": 80.0, "distance_rmse_surface_m": 0.3},
                change,
            )
            if not studied:
                for run in plan.list_runs():
                    if run.cell.variant:
                        del rows[run.key]
            results = Results(make_results(plan, rows))
            why = mut.claim_rmse(results).why
            self.assertEqual("changes by +0 mm;" in why, studied)
            why = mut.claim_real_reacts_before_ideal(results).why
            self.assertEqual("that is 0.1 s late" in why, studied)
        results = make_results_of("productivity", by_sensing(0.6, 0.5, 0.2))
        self.assertEqual(mut.claim_productivity_over_lidar(results).why, "")

    def test_one_trial_explains_nothing(self):
        for claim, metric, _, means in CASES:
            with self.subTest(claim.__name__):
                results = make_results_of(metric, means, trials=1)
                self.assertEqual(claim(results).why, "")

    def test_all_averages_of_the_safety_metric_are_told(self):
        results = make_results_of(SAFETY, by_configuration(5.0, 4.0, 9.0))
        note = mut.claim_vo_safer_than_vr(results).note
        self.assertIn("ratio of means: no value", note)
        self.assertIn("median: no value", note)

    def test_contacts_stand_beside_safety(self):
        """Also where the claim is reproduced, and of its cells only."""
        results = make_results_of(
            [SAFETY, "contacts_while_moving"], by_configuration(5.0, 4.0, 9.0)
        )
        found = mut.claim_vo_safer_than_vr(results)
        self.assertEqual(found.verdict, claim_rules.REPRODUCED)
        self.assertIn("Contacts while moving: Real Vo", found.note)
        self.assertNotIn("SM", found.note)

    def test_what_was_run_has_no_value(self):
        """An event that never happened is no run that is missing."""
        results = make_results_of(
            "time_to_stop_s", by_configuration(0.1, 0.2, 0.3)
        )
        for row in results._rows[make_cell("ideal", "sm")].values():
            row["time_to_stop_s"] = float("nan")
        found = mut.claim_time_to_stop(results)
        self.assertEqual(found.verdict, claim_rules.NO_VALUE)
        self.assertEqual(
            [e.verdict for e in found.evidence].count(claim_rules.NO_VALUE), 2
        )
        found = mut.claim_vo_best_times(results)
        self.assertIn(
            claim_rules.NO_VALUE,
            [e.verdict for e in found.evidence if "to stop" in e.what],
        )
        found = mut.claim_reaction_anticipates(results)
        self.assertEqual(found.verdict, claim_rules.NO_VALUE)
        found = mut.claim_rmse(results)
        self.assertEqual(found.verdict, claim_rules.NO_VALUE)

    def test_safety_looks_at_the_pair_that_decides(self):
        """Vr over SM is against the claim; Vo stands longest of all."""
        results = make_results_of(
            [SAFETY, "stopped_share"], by_configuration(5.0, 4.0, 3.5)
        )
        why = mut.claim_vr_less_safe(results).why
        self.assertIn("Real Vr over Real SM", why)
        self.assertNotIn("Real Vo over", why)

    def test_keys_are_unique(self):
        found = mut.check_claims(make_results_of(SAFETY, {}))
        self.assertEqual(len({c.key for c in found}), len(mut.CLAIMS))


if __name__ == "__main__":
    unittest.main()
