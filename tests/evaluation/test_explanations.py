import unittest

from synthetic_campaign import make_rows, make_small_plan

from tofssm_drake.evaluation.campaign import Cell, make_results
import tofssm_drake.evaluation.explanations as mut
from tofssm_drake.evaluation.results import Results


def make_results_of(values, *, variants=()):
    """Results whose metrics are told by (sensing, configuration).

    Args:
        values: By metric: by cell (sensing, configuration), or one of all.
        variants: Studies that are run as well.
    """
    plan = make_small_plan(3, variants=variants)

    def change(cell, trial):
        key = (cell.sensing, cell.configuration)
        return {
            name: of.get(key, float("nan")) if isinstance(of, dict) else of
            for name, of in values.items()
        }

    rows = make_rows(plan, {"task_time_s": 80.0}, change)
    return Results(make_results(plan, rows))


REAL, IDEAL, LIDAR = (mut.make_cell(s, "vo") for s in mut.SENSINGS)


class TestEveryExplanation(unittest.TestCase):
    """What they conclude turns over with the numbers."""

    def test_errors_of_geometry_or_of_the_sensing(self):
        surface = dict.fromkeys([(s, "vo") for s in mut.SENSINGS], 0.2)
        link = {("tof", "vo"): 0.05, ("ideal", "vo"): 0.0, ("lidar", "vo"): 0.3}
        results = make_results_of(
            {"distance_rmse_surface_m": surface, "distance_rmse_link_m": link}
        )
        text = mut.explain_errors(results)
        self.assertIn("Real Vo 50, Ideal Vo 0, Lidar Vo 300", text)
        self.assertIn("whole surface: Real Vo, Ideal Vo.", text)
        self.assertIn("the sensing's own: Lidar Vo.", text)
        self.assertNotIn("Without any sensor error", text)

    def test_errors_with_the_study(self):
        results = make_results_of(
            {"distance_rmse_surface_m": 0.2, "distance_rmse_link_m": 0.2},
            variants=["exact"],
        )
        text = mut.explain_errors(results)
        self.assertNotIn("whole surface", text)
        self.assertIn("Without any sensor error", text)

    def test_times(self):
        results = make_results_of({"stopped_s": 12.34, "reduced_s": 5.0})
        self.assertEqual(
            mut.explain_times(results, [REAL]),
            "Time stopped per run (s): Real Vo 12.3. "
            "At half speed (s): Real Vo 5.0.",
        )

    def test_standing(self):
        share = {("tof", "vo"): 0.2, ("ideal", "vo"): 0.3}
        for safety, expected in (
            (
                {("tof", "vo"): 3.0, ("ideal", "vo"): 4.0},
                "Vo scores highest, and none",
            ),
            ({("tof", "vo"): 5.0, ("ideal", "vo"): 4.0}, "though Ideal Vo is"),
        ):
            results = make_results_of({"s": safety, "stopped_share": share})
            text = mut.explain_standing(results, [REAL, IDEAL], "s")
            self.assertIn(expected, text)
            self.assertIn("Real Vo 20.0, Ideal Vo 30.0", text)
        self.assertEqual(mut.explain_standing(results, [LIDAR], "s"), "")

    def test_seeing(self):
        results = make_results_of(
            {
                "detection_share": 0.5,
                "missed_events": {("tof", "vo"): 0.4},
                "false_events": 2.0,
            }
        )
        text = mut.explain_seeing(results, [REAL, IDEAL])
        self.assertIn("(%): Real Vo 50.0, Ideal Vo 50.0.", text)
        self.assertIn("without a stop, per run: Real Vo 0.4.", text)
        self.assertIn("Real Vo 2.0, Ideal Vo 2.0.", text)

    def test_earliest(self):
        times = {("tof", "vo"): -0.2, ("lidar", "vo"): -0.9}
        for separation, expected in (
            ({("tof", "vo"): 0.6, ("lidar", "vo"): 1.2}, "and none stops far"),
            ({("tof", "vo"): 1.6, ("lidar", "vo"): 1.2}, "Real Vo stops far"),
        ):
            results = make_results_of(
                {"reaction_time_s": times, "separation_at_stop_m": separation}
            )
            text = mut.explain_earliest(results, [REAL, LIDAR])
            self.assertIn("Lidar Vo reacts first", text)
            self.assertIn(expected, text)

    def test_late(self):
        results = make_results_of(
            {
                "reaction_time_s": {("tof", "vo"): 0.1, ("ideal", "vo"): -0.1},
                "d_C_at_stop_m": 0.5,
            }
        )
        text = mut.explain_late(results, mut.make_cells())
        self.assertIn("Late on average: Real Vo.", text)
        self.assertIn("Real Vo 0.50", text)

    def test_real_against_ideal(self):
        results = make_results_of(
            {
                "reaction_time_s": {
                    **{("tof", "vo"): -0.3, ("ideal", "vo"): -0.1},
                    **{("tof", "sm"): 0.3, ("ideal", "sm"): 0.1},
                }
            },
            variants=["late"],
        )
        text = mut.explain_real_against_ideal(results)
        self.assertIn("earlier than Ideal: Real Vo by 0.20 s.", text)
        self.assertIn("Later: Real SM by 0.20 s.", text)
        self.assertIn("Real is: Vo +0.20 s, SM", text)

    def test_ramps(self):
        def by_configuration(*values):
            return {
                (s, c): value
                for s in mut.SENSINGS
                for c, value in zip(mut.CONFIGURATIONS, values, strict=True)
            }

        times = by_configuration(0.2, 0.4, 0.3)
        for speeds, count in (((0.1, 0.9, 0.5), 3), ((0.9, 0.1, 0.5), 0)):
            results = make_results_of(
                {
                    "time_to_stop_s": times,
                    "velocity_change_at_stop_mps": by_configuration(*speeds),
                }
            )
            text = mut.explain_ramps(results)
            self.assertIn(f"With {count} of 3 sensings", text)

    def test_studies(self):
        plan = make_small_plan(3, variants=["kmax", "late"])
        for shift, expected in (
            (0.5, "Real Vr (k_max 3.3 m/s) +50.0 \u00b1 0.1"),
            (0.5, "So what was changed there matters to this number."),
            (0.0, "confidence: none. So nothing that was changed there is"),
        ):

            def change(cell, trial, shift=shift):
                own = shift + 0.0005 * (trial % 2) * (shift > 0.0)
                moved = own if cell.variant == "kmax" else 0.0
                return {"productivity": 0.1 * trial + moved}

            rows = make_rows(plan, {"task_time_s": 80.0}, change)
            text = mut.explain_studies(
                Results(make_results(plan, rows)),
                "productivity",
                digits=1,
                scale=100,
            )
            self.assertIn("Of 5 cells with something changed", text)
            self.assertIn(expected, text)
            self.assertNotIn("late", text)
        results = make_results_of({"productivity": 0.5})
        self.assertEqual(mut.explain_studies(results, "productivity"), "")

    def test_what_costs_productivity(self):
        vr = mut.make_cell("tof", "vr")
        share = {("tof", "vo"): 0.5, ("tof", "vr"): 0.7}
        stops = {("tof", "vo"): 20.0, ("tof", "vr"): 5.0}
        slow = {("tof", "vo"): 20.0, ("tof", "vr"): 30.0}
        for stopped, reduced, expected in (
            (
                stops,
                slow,
                "So Real Vr is more productive than Real Vo mostly by its "
                "stops: it loses 15.0 s less to stops and 5.0 s more to slow "
                "movement.",
            ),
            (
                {("tof", "vo"): 5.0, ("tof", "vr"): 6.0},
                {("tof", "vo"): 30.0, ("tof", "vr"): 20.0},
                "mostly by its slow movement: it loses 1.0 s more to stops "
                "and 5.0 s less to slow movement.",
            ),
            (slow, slow, "it loses no less time: not for these times."),
        ):
            results = make_results_of(
                {
                    "productivity": share,
                    "stopped_s": stopped,
                    "reduced_s": reduced,
                }
            )
            text = mut.explain_times(results, [REAL, vr])
            self.assertTrue(text.endswith(expected), text)
            # Cells that are not compared with each other are not concluded on.
            text = mut.explain_times(results, [REAL, vr], by="configuration")
            self.assertNotIn("So ", text)

    def test_what_makes_slowing_long(self):
        times = {("tof", "vo"): 0.2, ("tof", "vr"): 0.3}
        for normal, expected in (
            (
                {("tof", "vo"): 20.0, ("tof", "vr"): 40.0},
                "So the configuration that takes longest to slow down with "
                "its sensing is in the normal state for longest between",
            ),
            (
                {("tof", "vo"): 40.0, ("tof", "vr"): 20.0},
                "So there is one that takes longest to slow down though",
            ),
        ):
            results = make_results_of(
                {
                    "time_to_reduce_s": times,
                    "normal_s": normal,
                    "reduce_events": 4.0,
                }
            )
            text = mut.explain_slowing(results)
            self.assertIn("Real Vo " + f"{normal['tof', 'vo'] / 4:.1f}", text)
            self.assertIn(expected, text)
            self.assertTrue(text.endswith(": Real Vr."), text)

    def test_what_makes_the_velocity_change_large(self):
        speeds = {("tof", "vo"): 0.5, ("tof", "vr"): 0.9}
        for normal, expected in (
            (
                {("tof", "vo"): 2.0, ("tof", "vr"): 8.0},
                "So the configuration that has the largest velocity change "
                "with its sensing is in the normal state for longest per stop, "
                "so it is more often at full speed when it has to stop: "
                "Real Vr.",
            ),
            (
                {("tof", "vo"): 8.0, ("tof", "vr"): 2.0},
                "So there is one that has the largest velocity change though "
                "it is not in the normal state for longest per stop, so "
                "something else makes the change largest: Real Vr.",
            ),
        ):
            results = make_results_of(
                {
                    "velocity_change_at_stop_mps": speeds,
                    "normal_s": normal,
                    "stop_events": 4.0,
                }
            )
            text = mut.explain_speeds(results)
            self.assertTrue(text.endswith(expected), text)

    def test_what_makes_chatter(self):
        changes = {("tof", "vo"): 2.0, ("tof", "vr"): 3.0}
        for false, expected in (
            ({("tof", "vo"): 0.0, ("tof", "vr"): 5.0}, "reacts to what is no"),
            ({("tof", "vo"): 5.0, ("tof", "vr"): 0.0}, "come from the law's"),
        ):
            results = make_results_of(
                {"state_changes_per_episode": changes, "false_events": false}
            )
            self.assertIn(expected, mut.explain_chatter(results))

    def test_who_asks_for_another_separation(self):
        cells = [REAL, IDEAL]
        kept = {("tof", "vo"): 0.8, ("ideal", "vo"): 0.8}
        for separation, asked, expected, unexpected in (
            (
                kept,
                {("tof", "vo"): 0.9, ("ideal", "vo"): 0.5},
                "than 0.5 m with Real Vo. The law does not ask for that with "
                "Ideal Vo",
                "intervals",
            ),
            (kept, 0.9, "than 0.5 m with Real Vo, Ideal Vo.", "does not"),
            (kept, 0.2, "does not ask for that with Real Vo, Ideal", "itself"),
            (0.52, 0.9, "only their intervals", "itself"),
        ):
            results = make_results_of({"kept": separation, "asked": asked})
            text = mut.conclude_separation(
                results, "kept", "asked", cells, 0.5, 0.2
            )
            self.assertIn(expected, text)
            self.assertNotIn(unexpected, text)

    def test_what_the_lidar_asks_for(self):
        for lidar, expected in (
            (1.5, "asks for more with the Lidar in 2 of 2 comparisons"),
            (0.6, "1 of 2 comparisons"),
            (0.6, "It asks for no more with: Lidar Vo than Real Vo."),
            (0.3, "does not ask for more with the Lidar."),
        ):
            asked = {
                **{("tof", "vo"): 0.9, ("ideal", "vo"): 0.5},
                ("lidar", "vo"): lidar,
            }
            results = make_results_of({"d_C_at_stop_m": asked})
            self.assertIn(expected, mut.conclude_lidar(results))

    def test_lists(self):
        results = make_results_of(
            {
                "time_to_reduce_s": -0.25,
                "velocity_change_at_stop_mps": 0.5,
                "reduce_events": 3.0,
                "stop_events": 2.0,
                "d_C_at_stop_m": 0.98,
            }
        )
        self.assertIn("Real Vo \u22120.25", mut.explain_slowing(results))
        text = mut.explain_speeds(results)
        for part in ("Real Vo 0.50", "Real Vo 3.0", "Real Vo 2.0"):
            self.assertIn(part, text)
        text = mut.explain_law_distances(
            results, "d_C at the stops", "d_C_at_stop_m", [REAL]
        )
        self.assertIn("d_C at the stops", text)
        self.assertTrue(text.endswith("(m): Real Vo 0.98."))

    def test_nothing_is_said_of_what_was_not_run(self):
        nothing = Results([])
        cells = mut.make_cells()
        for text in (
            mut.explain_errors(nothing),
            mut.explain_times(nothing, cells),
            mut.explain_standing(nothing, cells, "s"),
            mut.explain_seeing(nothing, cells),
            mut.explain_earliest(nothing, cells),
            mut.explain_late(nothing, cells),
            mut.explain_slowing(nothing),
            mut.explain_speeds(nothing),
            mut.explain_law_distances(nothing, "d", "d", cells),
            mut.explain_chatter(nothing),
            mut.conclude_separation(nothing, "d", "d", cells, 0.5, 0.2),
            mut.conclude_lidar(nothing),
        ):
            self.assertEqual(text, "")
        self.assertNotIn(":", mut.explain_ramps(nothing))
        self.assertNotIn(":", mut.explain_real_against_ideal(nothing))
        self.assertEqual(REAL, Cell(sensing="tof", configuration="vo"))


if __name__ == "__main__":
    unittest.main()
