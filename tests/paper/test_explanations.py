import unittest

from synthetic_campaign import make_rows, make_small_plan

from tofssm_drake.paper import (
    explain_distances,
    explain_stops,
    explain_variants,
    explain_work,
    sentences,
)
from tofssm_drake.paper.cells import Cell
from tofssm_drake.paper.results import Results
from tofssm_drake.studies.results import make_results


def make_results_of(values, *, variants=()):
    """Results whose metrics are told by (sensing, configuration).

    Args:
        values: By metric: by cell (sensing, configuration), or one of all.
        variants: Variants that are run as well.
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


REAL, IDEAL, LIDAR = (
    sentences.make_cell(s, "vo") for s in sentences.PAPER_SENSINGS
)


class TestEveryExplanation(unittest.TestCase):
    """What they conclude turns over with the numbers."""

    def test_errors_of_geometry_or_of_the_sensing(self):
        surface = dict.fromkeys(
            [(s, "vo") for s in sentences.PAPER_SENSINGS], 0.2
        )
        link = {("tof", "vo"): 0.05, ("ideal", "vo"): 0.0, ("lidar", "vo"): 0.3}
        results = make_results_of(
            {"distance_rmse_surface_m": surface, "distance_rmse_link_m": link}
        )
        text = explain_distances.explain_errors(results)
        self.assertIn("Real Vo 50, Ideal Vo 0, Lidar Vo 300", text)
        self.assertIn("whole surface: Real Vo, Ideal Vo.", text)
        self.assertIn("how exactly: Lidar Vo.", text)
        self.assertNotIn("Without noise", text)

    def test_errors_with_the_study(self):
        results = make_results_of(
            {"distance_rmse_surface_m": 0.2, "distance_rmse_link_m": 0.2},
            variants=["exact"],
        )
        text = explain_distances.explain_errors(results)
        self.assertNotIn("whole surface", text)
        self.assertIn("Without noise", text)

    def test_times(self):
        results = make_results_of({"stopped_s": 12.34, "reduced_s": 5.0})
        self.assertEqual(
            explain_work.explain_times(results, [REAL]),
            "Time stopped per run (s): Real Vo 12.3. "
            "At half speed (s): Real Vo 5.0.",
        )

    def test_standing(self):
        """Of the pair that decides, not of who scores highest of all."""
        share = {("tof", "vo"): 0.2, ("ideal", "vo"): 0.3, ("lidar", "vo"): 0.9}
        top = {("lidar", "vo"): 9.0}
        for safety, expected, unexpected in (
            (
                {("tof", "vo"): 3.0, ("ideal", "vo"): 4.0} | top,
                "also stopped for a larger share of its time: Ideal Vo over "
                "Real Vo (30.0 against 20.0).",
                "in none",
            ),
            (
                {("tof", "vo"): 5.0, ("ideal", "vo"): 4.0} | top,
                "in none is the one with the higher mean stopped for a larger "
                "share of its time, so standing does not explain it: Real Vo "
                "over Ideal Vo (20.0 against 30.0).",
                "also stopped",
            ),
        ):
            results = make_results_of({"s": safety, "stopped_share": share})
            text = explain_work.explain_standing(
                results, [REAL, IDEAL, LIDAR], "s", [(REAL, IDEAL)]
            )
            self.assertIn(expected, text)
            self.assertNotIn(unexpected, text)
            self.assertIn("Real Vo 20.0, Ideal Vo 30.0, Lidar Vo 90.0", text)
        both = explain_work.explain_standing(
            results, [REAL, IDEAL, LIDAR], "s", [(REAL, IDEAL), (IDEAL, LIDAR)]
        )
        self.assertIn(
            "also stopped for a larger share of its time: Lidar", both
        )
        self.assertIn("which contradicts that: Real Vo over Ideal", both)
        self.assertEqual(
            explain_work.explain_standing(
                results, [LIDAR], "s", [(REAL, IDEAL)]
            ),
            "",
        )

    def test_contacts_are_counted(self):
        results = make_results_of(
            {
                "contacts_while_moving": {
                    ("tof", "vo"): 2.0,
                    ("ideal", "vo"): 0.0,
                }
            }
        )
        self.assertEqual(
            explain_work.count_contacts(results, [REAL, IDEAL, LIDAR]),
            "Contacts while moving: Real Vo 6 in 3 of 3 runs. "
            "Without one: Ideal Vo.",
        )
        self.assertEqual(
            explain_work.count_contacts(results, [IDEAL]),
            "Without a contact while moving: Ideal Vo.",
        )

    def test_seeing(self):
        results = make_results_of(
            {
                "detection_share": 0.5,
                "missed_events": {("tof", "vo"): 0.4},
                "false_events": 2.0,
            }
        )
        text = explain_distances.explain_seeing(results, [REAL, IDEAL])
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
            text = explain_stops.explain_earliest(results, [REAL, LIDAR])
            self.assertIn("Lidar Vo reacts first", text)
            self.assertIn(expected, text)

    def test_late(self):
        results = make_results_of(
            {
                "reaction_time_s": {("tof", "vo"): 0.1, ("ideal", "vo"): -0.1},
                "d_C_at_stop_m": 0.5,
            }
        )
        text = explain_stops.explain_late(results, sentences.make_cells())
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
        text = explain_stops.explain_real_against_ideal(results)
        self.assertIn("earlier than Ideal: Real Vo by 0.20 s.", text)
        self.assertIn("Later: Real SM by 0.20 s.", text)
        self.assertIn("Real is: Vo +0.20 s, SM", text)

    def test_ramps(self):
        """A difference that events that begin alike do not have."""
        times = {("tof", "vo"): 0.14, ("tof", "vr"): 0.20}
        for alike, expected, unexpected in (
            (
                {("tof", "vo"): 0.219, ("tof", "vr"): 0.223},
                "Real 0.060 and 0.004. So most of the difference comes from "
                "which events are timed, and from which speed: Real.",
                "Half of it",
            ),
            (
                {("tof", "vo"): 0.14, ("tof", "vr"): 0.19},
                "Real 0.060 and 0.050. Half of it or more does not: Real.",
                "So most",
            ),
        ):
            for kind in ("stop", "reduce"):
                results = make_results_of(
                    {
                        f"time_to_{kind}_s": times,
                        f"time_to_{kind}_alike_s": alike,
                    }
                )
                text = explain_stops.explain_ramps(results, kind)
                self.assertIn(f"Real Vo {alike['tof', 'vo']:.3f}", text)
                self.assertIn(expected, text)
                self.assertNotIn(unexpected, text)

    def test_how_many_are_timed(self):
        results = make_results_of(
            {
                "time_to_stop_events": {("tof", "vo"): 55.0},
                "stop_events": 291.0,
            }
        )
        text = explain_stops.count_timed(results, "stop")
        self.assertTrue(text.endswith("per run: Real Vo 55 of 291."), text)
        self.assertEqual(explain_stops.count_timed(results, "reduce"), "")

    def make_varied(self, change, trials=3, variants=("literal", "late")):
        plan = make_small_plan(trials, variants=list(variants))
        rows = make_rows(
            plan,
            {"task_time_s": 80.0},
            lambda cell, trial: {
                "productivity": 0.1 * trial + change(cell, trial)
            },
        )
        return Results(make_results(plan, rows))

    def test_variants_of_a_number(self):
        """Only of the claim's cells; what is not decided is not absent."""

        def change(cell, trial):
            if cell.variant != "literal":
                return 0.0
            sure = cell.configuration == "vo"
            return 0.5 + 0.0005 * (trial % 2) if sure else 0.1 * (trial - 2)

        results = self.make_varied(change)
        cells = sentences.make_cells(("tof",))
        text = explain_variants.explain_variants(
            results, "productivity", cells, digits=1, scale=100
        )
        self.assertIn("3 comparisons, without correction", text)
        self.assertIn("Decided: Real Vo (literal law) +50.0 \u00b1 0.1.", text)
        self.assertIn("Otherwise no change is decided by these trials", text)
        self.assertIn("Real Vr (literal law) +0.0 \u00b1 24.8", text)
        for unexpected in ("late", "the cause", "matters"):
            self.assertNotIn(unexpected, text)
        text = explain_variants.explain_variants(
            results, "productivity", cells[1:2]
        )
        self.assertIn("One comparison).", text)
        self.assertIn("No change is decided by these trials", text)
        self.assertEqual(
            explain_variants.explain_variants(results, "productivity", [LIDAR]),
            "",
        )
        self.assertEqual(
            explain_variants.explain_variants(
                make_results_of({"productivity": 0.5}), "productivity", cells
            ),
            "",
        )

    def test_variants_of_a_difference(self):
        """What changes both cells alike does not change their difference."""
        vr = sentences.make_cell("tof", "vr")

        def change(cell, trial):
            return 0.5 + 0.001 * trial if cell.variant == "literal" else 0.0

        results = self.make_varied(change)
        text = explain_variants.explain_variants(
            results, "productivity", [REAL, vr], [(REAL, vr)]
        )
        self.assertIn("Real Vo \u2212 Real Vr (literal law) +0.00", text)
        self.assertNotIn("Decided", text)
        # Where one of them is studied its own change is told, and once.
        text = explain_variants.explain_variants(
            results,
            "productivity",
            [REAL, IDEAL, LIDAR],
            [(REAL, LIDAR), (REAL, sentences.make_cell("lidar", "vr"))],
        )
        self.assertIn("One comparison).", text)
        self.assertIn("Decided: Real Vo (literal law) +0.50", text)

    def test_only_some_of_many_are_told(self):
        results = self.make_varied(lambda cell, trial: 0.0)
        text = explain_variants.explain_variants(
            results, "productivity", sentences.make_cells()
        )
        self.assertIn("The 4 largest:", text)
        self.assertEqual(text.count("+0.00"), 4)

    def test_what_costs_productivity(self):
        vr = sentences.make_cell("tof", "vr")
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
            (
                slow,
                slow,
                "it loses no less time: these times do not explain it.",
            ),
        ):
            results = make_results_of(
                {
                    "productivity": share,
                    "stopped_s": stopped,
                    "reduced_s": reduced,
                }
            )
            text = explain_work.explain_times(results, [REAL, vr])
            self.assertTrue(text.endswith(expected), text)
            # Cells that are not compared with each other are not concluded on.
            text = explain_work.explain_times(
                results, [REAL, vr], by="configuration"
            )
            self.assertNotIn("So ", text)

    def test_what_makes_the_velocity_change_large(self):
        speeds = {("tof", "vo"): 0.5, ("tof", "vr"): 0.9}
        for normal, expected in (
            (
                {("tof", "vo"): 2.0, ("tof", "vr"): 8.0},
                "So the configuration that has the largest velocity change "
                "with its sensing is also in the normal state for longest per "
                "stop: Real Vr.",
            ),
            (
                {("tof", "vo"): 8.0, ("tof", "vr"): 2.0},
                "So there is one that has the largest velocity change though "
                "it is not in the normal state for longest per stop: Real Vr.",
            ),
        ):
            results = make_results_of(
                {
                    "velocity_change_at_stop_mps": speeds,
                    "normal_s": normal,
                    "stop_events": 4.0,
                }
            )
            text = explain_stops.explain_speeds(results)
            self.assertTrue(text.endswith(expected), text)

    def test_chatter_per_minute(self):
        episode = {("tof", "vo"): 2.0, ("tof", "vr"): 3.0}
        for minute, expected in (
            ({("tof", "vo"): 40.0, ("tof", "vr"): 50.0}, "in the same order"),
            ({("tof", "vo"): 50.0, ("tof", "vr"): 40.0}, "in another order"),
        ):
            results = make_results_of(
                {
                    "state_changes_per_episode": episode,
                    "state_changes_per_min": minute,
                    "false_events": episode,
                }
            )
            text = explain_work.explain_chatter(results)
            first, second = sorted(minute, key=minute.get, reverse=True)
            order = " > ".join(
                sentences.make_cell(*k).label for k in (first, second)
            )
            self.assertIn(f"{expected}: {order}.", text)
            self.assertNotIn("no approach", text)

    def test_an_episode_as_long_as_the_run(self):
        results = make_results_of(
            {"slow_episodes": {("tof", "vo"): 20.0, ("lidar", "vo"): 1.0}}
        )
        text = explain_work.list_long_episodes(results)
        self.assertTrue(text.endswith("how long the run was: Lidar Vo."), text)

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
            text = explain_distances.conclude_separation(
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
            self.assertIn(expected, explain_distances.conclude_lidar(results))

    def test_lists(self):
        results = make_results_of(
            {
                "velocity_change_at_stop_mps": 0.5,
                "reduce_events": 3.0,
                "stop_events": 2.0,
                "d_C_at_stop_m": 0.98,
            }
        )
        text = explain_stops.explain_speeds(results)
        for part in ("Real Vo 0.50", "Real Vo 3.0", "Real Vo 2.0"):
            self.assertIn(part, text)
        text = explain_distances.explain_law_distances(
            results, "d_C at the stops", "d_C_at_stop_m", [REAL]
        )
        self.assertIn("d_C at the stops", text)
        self.assertTrue(text.endswith("(m): Real Vo 0.98."))

    def test_nothing_is_said_of_what_was_not_run(self):
        nothing = Results([])
        cells = sentences.make_cells()
        for text in (
            explain_distances.explain_errors(nothing),
            explain_work.explain_times(nothing, cells),
            explain_work.explain_standing(nothing, cells, "s", [(REAL, IDEAL)]),
            explain_distances.explain_seeing(nothing, cells),
            explain_stops.explain_earliest(nothing, cells),
            explain_stops.explain_late(nothing, cells),
            explain_stops.explain_ramps(nothing, "stop"),
            explain_stops.count_timed(nothing, "reduce"),
            explain_work.count_contacts(nothing, cells),
            explain_work.list_long_episodes(nothing),
            explain_variants.explain_variants(nothing, "s", cells),
            explain_variants.explain_variants(
                nothing, "s", cells, [(REAL, IDEAL)]
            ),
            explain_stops.explain_speeds(nothing),
            explain_distances.explain_law_distances(nothing, "d", "d", cells),
            explain_work.explain_chatter(nothing),
            explain_distances.conclude_separation(
                nothing, "d", "d", cells, 0.5, 0.2
            ),
            explain_distances.conclude_lidar(nothing),
        ):
            self.assertEqual(text, "")
        self.assertNotIn(":", explain_stops.explain_real_against_ideal(nothing))
        self.assertEqual(REAL, Cell(sensing="tof", configuration="vo"))


if __name__ == "__main__":
    unittest.main()
