"""Figures and report of a made-up campaign."""

import dataclasses as dc
from html.parser import HTMLParser
import math
from pathlib import Path
import re
import tempfile
import unittest
import warnings

from matplotlib.colors import to_rgb
import numpy as np
from synthetic_campaign import make_rows, make_small_plan, make_values
from synthetic_run import make_rich_run

from tofssm_drake.paper import (
    audit_figure,
    campaign_figures,
    cell_style,
    distance_figure,
    productivity_figure,
    radar_figure,
    response_figures,
    verdict,
)
import tofssm_drake.paper.campaign_report as mut
from tofssm_drake.paper.cells import (
    CONFIGURATION_LABEL,
    VARIANTS,
    Cell,
    make_plan,
)
from tofssm_drake.paper.claim_rules import (
    NO_VALUE,
    NOT_REPRODUCED,
    NOT_RUN,
    REPRODUCED,
    UNDECIDED,
    Claim,
)
from tofssm_drake.paper.claims import check_claims
from tofssm_drake.paper.columns import (
    AUDIT_METRICS,
    METRICS,
    MONITORED_METRICS,
)
from tofssm_drake.paper.results import Results
from tofssm_drake.recording.samples import write_samples
from tofssm_drake.reports import figures
from tofssm_drake.reports.page import Picture, write_symbols
from tofssm_drake.reports.tables import make_cell_table
from tofssm_drake.studies.campaign import PlannedRun
from tofssm_drake.studies.campaign_folder import get_run_folder
from tofssm_drake.studies.results import make_results

_VOID = ("meta", "img", "source", "br")


class _Checker(HTMLParser):
    """Collects what a page refers to, and checks that tags are closed."""

    def __init__(self):
        super().__init__()
        self.stack, self.links, self.ids, self.alt = [], [], [], []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.links += [
            attrs[name] for name in ("src", "href", "srcset") if name in attrs
        ]
        self.ids += [attrs["id"]] if "id" in attrs else []
        if tag == "img":
            self.alt.append(attrs.get("alt"))
        if tag not in _VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag, tag


def _read(page):
    text = re.sub(r"<style>.*?</style>", " ", page, flags=re.S)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))


class _Campaign:
    """Two trials of every cell, one run like the other but for numbers."""

    def __init__(self, **options):
        self.run = make_rich_run(12.0)
        self.plan = make_small_plan(2, **options)
        metrics = make_values(self.run)

        def change(cell, trial):
            i = self.plan.cells.index(cell)
            return {
                "productivity": 0.3
                + (0.05 + 0.0001 * trial) * i
                + 0.01 * trial,
                "safety_mean_m2_per_mps": 5.0 - 0.2 * i,
                "task_time_s": 100.0 + trial,
                "shortfall_walking_in_p05_m": 0.1,
                "shortfall_walking_in_p50_m": 0.2,
                "shortfall_walking_in_p95_m": 0.4,
                "shortfall_walking_in_max_m": 0.5 + 0.01 * i,
            }

        self.rows = make_rows(self.plan, metrics, change)

    @property
    def results(self):
        return Results(make_results(self.plan, self.rows))


class TestFigures(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.campaign = _Campaign()
        cls.samples = {
            cell: cls.campaign.run
            for cell in cls.campaign.plan.cells
            if cell.sensing != "tof16"
        }

    def texts(self, figure):
        return re.sub(r"<[^>]+>", " ", figures.to_svg(figure))

    def test_distance(self):
        cells = [c for c in self.samples if c.configuration == "vo"]
        for narrow in (False, True):
            figure = distance_figure.make_distance_figure(
                self.campaign.results,
                {cell: self.samples[cell] for cell in cells},
                narrow=narrow,
            )
            self.assertEqual(len(figure.axes), 4)
            text = self.texts(figure)
            for word in ("Real Vo", "RMSE (m)", "time (s)", "paper"):
                self.assertIn(word, text)

    def test_bars_are_the_means(self):
        results = self.campaign.results
        figure = distance_figure.make_distance_figure(results, {})
        heights = sorted(p.get_height() for p in figure.axes[-1].patches)
        expected = sorted(
            results.estimate(cell, metric).mean
            for cell in results.cells
            for metric in (
                "distance_rmse_centre_m",
                "distance_rmse_surface_m",
            )
        )
        for height, mean in zip(heights, expected, strict=True):
            self.assertAlmostEqual(height, mean)

    def test_productivity(self):
        figure = productivity_figure.make_productivity_figure(
            self.campaign.results
        )
        (ax,) = figure.axes
        marks = [
            line.get_xydata()[0].tolist()
            for line in ax.get_lines()
            if line.get_markersize() == 9
        ]
        self.assertEqual(len(marks), 12)
        self.assertAlmostEqual(marks[0][0], 5.0)
        self.assertAlmostEqual(marks[0][1], 100 * (0.3 + 0.015))
        self.assertIn("%", ax.get_ylabel())
        self.assertIn("m²/(m/s)", ax.get_xlabel())

    def test_legend_has_a_row_for_sensings_and_one_for_configurations(self):
        for narrow in (False, True):
            figure = productivity_figure.make_productivity_figure(
                self.campaign.results, narrow=narrow
            )
            figure.draw_without_rendering()
            at = {}
            for text in figure.axes[0].get_legend().get_texts():
                box = text.get_window_extent()
                if text.get_text().strip():
                    place = box.x0 if narrow else box.y0
                    at[text.get_text()] = round(place)
            names = list(CONFIGURATION_LABEL.values())
            one = {at.pop(name) for name in names}
            self.assertEqual(len(at), 4)
            if narrow:
                self.assertEqual(len(one), 1)
                self.assertEqual(len(set(at.values())), 1)
            else:
                # Letters differ a little in height.
                lowest = min(one)
                self.assertTrue(all(y < lowest - 5 for y in at.values()))

    def test_letters_are_dark_enough(self):
        """Contrast of at least 4.5 on white (WCAG 2.1, AA)."""
        for colour in cell_style.SENSING_TEXT.values():
            c = np.array(to_rgb(colour))
            linear = np.where(
                c <= 0.03928, c / 12.92, ((c + 0.055) / 1.055) ** 2.4
            )
            luminance = linear @ [0.2126, 0.7152, 0.0722]
            self.assertGreater(1.05 / (luminance + 0.05), 4.5)

    def test_a_run_of_one_tick(self):
        """Draws without a complaint."""
        run = make_rich_run(12.0)
        one = dc.replace(
            run, column={k: v[:1] for k, v in run.column.items()}, scan={}
        )
        samples = {Cell(sensing="tof", configuration="vo"): one}
        results = self.campaign.results
        for make, _, arguments in campaign_figures.list_figures(
            results, samples
        ).values():
            for narrow in (False, True):
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    figures.to_svg(make(*arguments, narrow=narrow))

    def test_response(self):
        wide = response_figures.make_response_figure(self.samples)
        # Two axes a panel: speed and distance.
        self.assertEqual(len(wide.axes), 18)
        narrow = response_figures.make_response_figure(
            self.samples, narrow=True
        )
        self.assertEqual(len(narrow.axes), 18)
        self.assertEqual(narrow.axes[8].get_title(loc="left"), "Lidar SM")

    def test_phase(self):
        some = dict(list(self.samples.items())[:2])
        for narrow in (False, True):
            figure = response_figures.make_phase_figure(some, narrow=narrow)
            text = self.texts(figure)
            self.assertIn("measured distance (m)", text)
            self.assertIn("share of the run", text)

    def test_radars(self):
        figure = radar_figure.make_radar_figure(self.campaign.results)
        self.assertEqual(len(figure.axes), 4)
        text = self.texts(figure)
        for title, _ in radar_figure.RADARS:
            self.assertIn(title, text)

    def test_audit(self):
        figure = audit_figure.make_audit_figure(self.campaign.results)
        (ax,) = figure.axes
        worst = [
            float(line.get_xdata()[0])
            for line in ax.get_lines()
            if line.get_marker() == ">"
        ]
        self.assertAlmostEqual(max(worst), 0.61)

    def test_a_campaign_without_results(self):
        """Everything failed: there is still something to draw."""
        results = Results([])
        for make, _, arguments in campaign_figures.list_figures(
            results, {}
        ).values():
            self.assertTrue(make(*arguments).axes)

    def test_window(self):
        run = self.campaign.run
        rows = cell_style.find_window(run, 4.0)
        t = run["t"][rows]
        self.assertAlmostEqual(t[-1] - t[0], 4.0, delta=0.02)
        mean = run["true_distance"][rows].mean()
        for start in range(0, 900, 50):
            other = run["true_distance"][start : start + len(t)].mean()
            self.assertLessEqual(mean, other + 0.02)
        whole = cell_style.find_window(run, 100.0)
        self.assertEqual(len(run["t"][whole]), len(run))


class TestReport(unittest.TestCase):
    def setUp(self):
        self.campaign = _Campaign(variants=["literal"])

    def make(self, **changes):
        results = changes.pop("results", self.campaign.results)
        names = campaign_figures.list_figures(results, {})
        options = {
            "plan": self.campaign.plan,
            "results": results,
            "pictures": {
                name: Picture(
                    wide="data:image/svg+xml;base64,AA",
                    narrow="data:image/svg+xml;base64,AA",
                    description=description,
                )
                for name, (_, description, _) in names.items()
            },
            "parameters": [("C_dC", dict.fromkeys(campaign_sensings(), "0.3"))],
            "latencies": {"tof": {"mask": 0.002, "control_tick": 0.008}},
            "command": "tofssm experiments --out <here>",
            "failures": {},
        }
        page = mut.make_campaign_report(**(options | changes))
        checker = _Checker()
        checker.feed(page)
        self.assertEqual(checker.stack, [])
        return page, checker, _read(page)

    def test_self_contained(self):
        page, checker, _ = self.make()
        for link in checker.links:
            self.assertRegex(link, r"^(data:image/svg\+xml;base64,|#\w+$)")
            if link.startswith("#"):
                self.assertIn(link[1:], checker.ids)
        self.assertTrue(all(checker.alt))
        self.assertNotIn("<script", page)

    def test_tells_everything(self):
        _, _, text = self.make()
        for claim in check_claims(self.campaign.results):
            self.assertIn(claim.text, text)
        for cell in self.campaign.plan.cells:
            if not cell.variant:
                self.assertIn(cell.label, text)
        for trial in self.campaign.plan.trials:
            self.assertIn(str(trial.seed), text)
        for group in METRICS.values():
            for metric in group:
                self.assertIn(metric.label, text)
        self.assertIn("tofssm experiments --out &lt;here&gt;", text)
        self.assertIn("control tick", text)
        self.assertIn("drake 1.51.1", text)
        self.assertIn("What do the corrections of the printed law", text)

    def test_only_vo_stands_under_the_monitored_speed(self):
        for row in self.campaign.rows.values():
            row["shortfall_as_reckoned_p50_m"] = 0.1
        _, _, text = self.make(results=self.campaign.results)
        _, _, after = text.partition("speed as it was monitored")
        table, _, _ = after.partition("Only Vo monitors")
        self.assertIn("Real Vo 0.10", table)
        self.assertNotIn("Real Vr", table)
        self.assertNotIn("speed that Vo measured", text)

    def test_failures_are_told(self):
        label = PlannedRun(
            cell=self.campaign.plan.cells[0],
            trial=self.campaign.plan.trials[0],
        ).label
        _, _, text = self.make(failures={label: "out of <memory>"})
        self.assertIn("1 of 31 runs failed", text)
        self.assertIn(f"{label}: out of &lt;memory&gt;", text)

    def test_contacts_are_told(self):
        for row in self.campaign.rows.values():
            row["contacts_while_moving"] = 0.0
        _, _, text = self.make()
        self.assertNotIn("in 1 runs", text)
        # Variants are no part of it: 12 cells, 2 trials.
        self.assertIn("touched nobody in 24 runs", text)
        self.assertIn("below 11.7 % per run", text)
        self.campaign.rows["tof-vo-2"]["contacts_while_moving"] = 3.0
        _, _, text = self.make(results=self.campaign.results)
        self.assertIn("In 1 of 24 runs the moving robot touched", text)

    def test_one_of_a_thing_is_in_the_singular(self):
        claims = [
            Claim(key="a", text="a", verdict=verdict, unit="s")
            for verdict in (
                REPRODUCED,
                UNDECIDED,
                NOT_REPRODUCED,
                NOT_REPRODUCED,
            )
        ]
        sentences = verdict.make_verdict(self.campaign.results, claims, {})
        self.assertIn(
            "Of 4 claims of the paper that this campaign can judge, 1 is "
            "reproduced, 2 are not, and 1 is undecided.",
            sentences[0][1],
        )
        row = self.campaign.rows["tof-vo-1"] | {"contacts_while_moving": 0.0}
        sentences = verdict.make_verdict(Results([row]), claims, {})
        self.assertIn("touched nobody in 1 run. That", sentences[1][1])

    def test_one_contact_is_no_contacts(self):
        for row in self.campaign.rows.values():
            row["contacts_while_moving"] = 0.0
        self.campaign.rows["tof-vo-2"]["contacts_while_moving"] = 1.0
        _, _, text = self.make(results=self.campaign.results)
        self.assertIn("touched the person (1 contact).", text)

    def test_what_was_not_finished_is_told_by_cell(self):
        for row in self.campaign.rows.values():
            row |= {"finished": 1.0, "stop_due_share": 0.25}
        self.assertNotIn("not finished when", self.make()[2])
        for trial in (1, 2):
            self.campaign.rows[f"lidar-vo-{trial}"] |= {
                "finished": 0.0,
                "stop_due_share": 0.7 + 0.06 * trial,
            }
        _, _, text = self.make(results=self.campaign.results)
        self.assertIn("In 2 of 30 runs the task was not finished", text)
        self.assertIn("was up: Lidar Vo 2 of 2 (79 %). In brackets", text)
        self.assertNotIn("Ideal Vo 0 of", text)

    def test_without_a_person(self):
        self.campaign.rows["alone"]["task_time_s"] = 63.72
        text = self.make(results=self.campaign.results)[2]
        self.assertIn("Without a person the task takes 63.7 s.", text)
        self.campaign.rows["alone"] |= {
            "task_time_s": math.nan,
            "simulated_s": 12.0,
        }
        text = self.make(results=self.campaign.results)[2]
        self.assertIn("the task is not finished in the 12.0 s", text)
        self.assertNotIn("takes \u2013", text)

    def test_one_trial_decides_nothing(self):
        plan = make_small_plan(1)
        rows = make_rows(plan, make_values(self.campaign.run))
        text = self.make(plan=plan, results=Results(make_results(plan, rows)))[
            2
        ]
        self.assertIn("no claim of the paper can be decided", text)
        self.assertNotIn("are reproduced", text)
        self.assertNotIn("Why:", text)
        self.assertIn("(none with one trial)", text)
        self.assertNotIn("can be decided", self.make()[2])

    def test_nothing_came_out(self):
        _, _, text = self.make(results=Results([]), failures={"all": "broken"})
        self.assertIn("Of 0 claims", text)

    def test_written_whole(self):
        plan = make_plan(
            seed=0,
            trials=1,
            sensings=["tof"],
            configurations=["vo"],
            variants=[],
            scenario={},
        )
        run = make_rich_run(3.0)
        rows = make_rows(plan, make_values(run))
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for planned in plan.list_runs()[1:]:
                where = get_run_folder(folder, planned)
                where.mkdir(parents=True)
                write_samples(run, where)
                (where / "row.parquet").touch()
            path = mut.write_campaign_report(
                folder,
                plan=plan,
                rows=make_results(plan, rows),
                parameters=[("C_dC", {"tof": "0.3 m"})],
                command="tofssm experiments",
            )
            names = sorted(p.name for p in (folder / "figures").iterdir())
            self.assertEqual(len(names), 2 * 6)
            for file in (folder / "figures").iterdir():
                start = file.read_bytes()[:4]
                self.assertIn(start, (b"<?xm", b"\x89PNG"))
            page = path.read_text("utf-8")
            self.assertTrue(page.rstrip().endswith("</html>"))
            self.assertLess(len(page), 3_000_000)


class TestTables(unittest.TestCase):
    def test_latency(self):
        rows = mut.make_latency_table(
            {"tof": {"wait": 0.024, "tick": 0.008}, "ideal": {"tick": 0.008}}
        )
        self.assertEqual(
            rows,
            [
                ("wait", {"tof": "24", "ideal": "\u2013"}),
                ("tick", {"tof": "8", "ideal": "8"}),
                ("sum", {"tof": "32", "ideal": "8"}),
            ],
        )

    def test_differences(self):
        campaign = _Campaign()
        pairs = mut.list_pairs(campaign.results)
        self.assertEqual(len(pairs["sensing"]), 6)
        self.assertEqual(len(pairs["configuration"]), 8)
        self.assertEqual(len(pairs["sixteen"]), 3)
        self.assertEqual(pairs["literal"], [])
        vo = Cell(sensing="tof", configuration="vo")
        vr = Cell(sensing="tof", configuration="vr")
        table = mut.make_difference_table(
            campaign.results,
            [(vr, vo)],
            [
                m
                for m in METRICS["Productivity"]
                if m.name in ("productivity", "task_time_s")
            ],
        )
        (row,) = table["rows"]
        self.assertEqual(row[0], "Real Vr \u2212 Real Vo")
        self.assertEqual(row[1][0], ("+5.0 \u00b1 0.1", True))
        # Equal in both trials: nothing to be sure of.
        self.assertEqual(row[1][1], ("+0.0", False))
        # A difference of shares is in points.
        units = [unit for _, unit in table["head"]]
        self.assertEqual(units, ["points", "s"])

    def test_only_vo_monitors_the_person(self):
        campaign = _Campaign()
        for row in campaign.rows.values():
            row["shortfall_as_reckoned_p50_m"] = 0.1
            row["shortfall_as_reckoned_clear_share"] = 0.84
        cell = Cell(sensing="tof", configuration="vo")
        table = make_cell_table(campaign.results, [cell], MONITORED_METRICS)
        labels = [label for label, _ in table["head"]]
        for label, expected in (
            ("as monitored: median", "0.10"),
            ("of that with nothing measured", "84"),
        ):
            column = labels.index(label)
            texts = [texts[column] for _, texts in table["rows"]]
            self.assertEqual(texts, [expected])
        labels = {metric.label for metric in AUDIT_METRICS}
        self.assertNotIn("as monitored: median", labels)

    def test_counts_have_no_interval_below_zero(self):
        campaign = _Campaign()
        cell = Cell(sensing="tof", configuration="vr")
        for trial, contacts in ((1, 5.0), (2, 0.0)):
            campaign.rows[f"tof-vr-{trial}"]["contacts_while_moving"] = contacts
            campaign.rows[f"tof-vo-{trial}"]["contacts_while_moving"] = 0.0
        metrics = [
            m for m in METRICS["Safety"] if m.name.startswith("contacts")
        ]
        table = make_cell_table(
            campaign.results,
            [cell, Cell(sensing="tof", configuration="vo")],
            metrics,
        )
        texts = [text for _, (text,) in table["rows"]]
        self.assertEqual(texts, ["5 in 1 of 2 runs", "0 in 2 runs"])
        self.assertEqual(table["head"][0][1], "in all runs")
        pair = [(cell, Cell(sensing="tof", configuration="vo"))]
        table = mut.make_difference_table(campaign.results, pair, metrics)
        self.assertEqual(table["head"][0][1], "per run")

    def test_how_many_stops_are_timed(self):
        campaign = _Campaign()
        cell = Cell(sensing="tof", configuration="vo")
        for trial, timed in ((1, 50.0), (2, 60.0)):
            campaign.rows[f"tof-vo-{trial}"] |= {
                "time_to_stop_events": timed,
                "stop_events": 291.0,
                "state_changes_per_min": 454.0,
            }
        table = make_cell_table(
            campaign.results,
            [cell],
            [m for group in METRICS.values() for m in group],
        )
        ((_, texts),) = table["rows"]
        texts = dict(zip(table["head"], texts, strict=True))
        self.assertEqual(texts["stops timed", "of all, per run"], "55 of 291")
        self.assertEqual(texts["state changes", "per minute"], "454")

    def test_no_value_is_not_called_not_run(self):
        claims = [
            Claim(key="a", text="a", verdict=verdict, unit="s")
            for verdict in (NO_VALUE, NOT_RUN, REPRODUCED)
        ]
        rows = [verdict.make_claim_row(claim) for claim in claims]
        self.assertEqual([r["is_run"] for r in rows], [True, False, True])
        self.assertEqual(rows[0]["verdict"], "no value")
        sentences = verdict.make_verdict(_Campaign().results, claims, {})
        self.assertIn("Of 1 claim of", sentences[0][1])

    def test_the_worst_of_all_runs(self):
        """Not the mean of the runs' worst, which is a column of its own."""
        campaign = _Campaign()
        cell = Cell(sensing="tof", configuration="vr")
        for trial, shortfall, late in ((1, 0.3, 0.01), (2, 0.9, -0.02)):
            campaign.rows[f"tof-vr-{trial}"] |= {
                "shortfall_walking_in_max_m": shortfall,
                "latency_over_T_R_s": late,
                "stated_stop_over_T_stop_s": math.nan,
            }
        table = make_cell_table(campaign.results, [cell], AUDIT_METRICS)
        ((_, texts),) = table["rows"]
        by_label = {}
        for (label, _), text in zip(table["head"], texts, strict=True):
            by_label.setdefault(label, text)
        self.assertEqual(by_label["worst of all runs"], "0.90")
        mean = by_label["mean of the runs\u2019 worst"]
        self.assertTrue(mean.startswith("0.60 \u00b1 "), mean)
        self.assertEqual(by_label["worst latency over T_R"], "10")
        self.assertEqual(by_label["UR10\u2019s stop over T_stop"], "\u2013")

    def test_measured_productivity_is_shown(self):
        campaign = _Campaign()
        for row in campaign.rows.values():
            row["task_time_s"] = 100.0
        campaign.rows["alone"]["task_time_s"] = 60.0
        cell = Cell(sensing="tof", configuration="vo")
        table = make_cell_table(
            campaign.results, [cell], METRICS["Productivity"]
        )
        labels = [label for label, _ in table["head"]]
        ((_, texts),) = table["rows"]
        self.assertEqual(texts[labels.index("productivity, measured")], "60.0")

    def test_which_variants_were_run(self):
        text = mut.describe_variants(_Campaign(variants=["literal"]).results)
        self.assertTrue(text.startswith("Run: literal (literal law). Not run"))
        for key in ("kmax", "exact", "late", "subtracted", "piecewise"):
            self.assertIn(f"{key} (", text.partition("Not run: ")[2])
        self.assertIn("--variant all adds them", text)
        self.assertNotIn("Without a cell", text)
        text = mut.describe_variants(_Campaign(sensings=["lidar"]).results)
        self.assertTrue(text.startswith("No variant was run. Not run: subtr"))
        self.assertIn(
            "Without a cell in this campaign: literal (literal law), kmax",
            text,
        )
        everything = list(VARIANTS)
        text = mut.describe_variants(_Campaign(variants=everything).results)
        self.assertNotIn("Not run", text)
        self.assertNotIn("--variant", text)

    def test_symbols(self):
        self.assertEqual(
            write_symbols("inside S_p < T_stop, alpha_I of k_max"),
            "inside S<sub>p</sub> &lt; T<sub>stop</sub>, "
            "\u03b1<sub>I</sub> of k<sub>max</sub>",
        )
        for text in ("state_changes", "shortfall", "t"):
            self.assertEqual(write_symbols(text), text)

    def test_a_variant_is_told_by_its_cells(self):
        campaign = _Campaign(variants=["late"])
        pairs = mut.list_pairs(campaign.results)["late"]
        table = mut.make_difference_table(campaign.results, pairs, [])
        labels = [label for label, _ in table["rows"]]
        self.assertEqual(labels, ["Ideal Vo", "Ideal Vr", "Ideal SM"])

    def test_unknown_numbers_are_dashes(self):
        campaign = _Campaign()
        for row in campaign.rows.values():
            row["task_time_s"] = math.nan
        table = make_cell_table(
            campaign.results,
            campaign.plan.cells[:1],
            [m for m in METRICS["Productivity"] if m.name == "task_time_s"],
        )
        self.assertEqual(table["rows"][0][1], ["\u2013"])


def campaign_sensings():
    return ("tof", "ideal", "lidar", "tof16")


if __name__ == "__main__":
    unittest.main()
