import html
from html.parser import HTMLParser
from pathlib import Path
import re
import tempfile
import unittest
from unittest import mock

import numpy as np
from synthetic_run import RINGS, make_rich_run, make_run, make_steps

from tofssm_drake.errors import UserError
from tofssm_drake.metrics.metrics import calc_summary, find_contacts
import tofssm_drake.reports.figures as figures
import tofssm_drake.reports.report as mut


class _Checker(HTMLParser):
    """Collects what a page refers to, and checks that tags are closed."""

    VOID = ("meta", "img", "source", "br", "link", "input")

    def __init__(self):
        super().__init__()
        self.stack = []
        self.links = []
        self.ids = []
        self.alt = []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        for name in ("src", "href", "srcset"):
            if name in attrs:
                self.links.append(attrs[name])
        if "id" in attrs:
            self.ids.append(attrs["id"])
        if tag == "img":
            self.alt.append(attrs.get("alt"))
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack and self.stack[-1] == tag, (tag, self.stack)
        self.stack.pop()


def _strip(page):
    text = re.sub(r"<style>.*?</style>", " ", page, flags=re.S)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", text)))


def _make_contact_run():
    run = make_run(6.0)
    run["true_distance"][:] = 0.5
    during = (run["t"] >= 2.0 - 1e-9) & (run["t"] < 2.4)
    run["true_distance"][during] = -0.01
    run["contact_speed"][during] = 0.62
    run["robot_body"][:] = 2
    run["person_part"][:] = 1
    for ring in RINGS:
        run[f"{ring}_true_distance"][:] = 0.3
        run[f"{ring}_true_azimuth"][:] = np.deg2rad(22.5)
        run[f"{ring}_true_elevation"][:] = 0.0
    return run


def _draw_nothing():
    """Drawing takes seconds and is tested elsewhere; once is enough here."""
    return mock.patch.object(
        mut.figures,
        "to_data_uri",
        return_value="data:image/svg+xml;base64,AAAA",
    )


class TestReport(unittest.TestCase):
    def setUp(self):
        _draw_nothing().start()
        self.addCleanup(mock.patch.stopall)

    def _make(self, run, **options):
        page = mut.make_report(run, calc_summary(run), **options)
        checker = _Checker()
        checker.feed(page)
        self.assertEqual(checker.stack, [])
        return page, checker, _strip(page)

    def test_self_contained(self):
        """Nothing is loaded from elsewhere; inner links lead somewhere."""
        mock.patch.stopall()
        run = make_rich_run(6.0)
        page, checker, _ = self._make(run)
        for link in checker.links:
            self.assertRegex(link, r"^(data:image/svg\+xml;base64,|#\w+$)")
            if link.startswith("#"):
                self.assertIn(link[1:], checker.ids)
        self.assertTrue(all(checker.alt))
        self.assertNotIn("<script", page)
        self.assertLess(len(page), 4_000_000)

    def test_a_page_of_an_hour_can_be_opened(self):
        """The robot's state changes five times a second all the time."""
        mock.patch.stopall()
        run = make_run(3600.0)
        tick = np.arange(len(run["t"]))
        run.column["robot_state"] = (tick // 25 % 3).astype(np.int8)
        run["tcp_speed"][:] = 0.5 + 0.4 * np.sin(0.01 * tick)
        page, _, text = self._make(run)
        self.assertLess(len(page), 5_000_000)
        self.assertTrue("Every change of state (17998), with" in text)
        self.assertTrue("16998 later ones are left out here" in text)

    def test_the_fastest_contacts_are_told(self):
        contacts = [
            mock.Mock(time=float(i), max_speed=0.1 * (i % 7))
            for i in range(100)
        ]
        told = mut._pick_worst(contacts)
        self.assertEqual(len(told), 20)
        self.assertEqual(told, sorted(told, key=lambda c: c.time))
        self.assertGreaterEqual(min(c.max_speed for c in told), 0.5)

    def test_what_was_run(self):
        run = make_rich_run(3.0)
        run.metadata["scenario"] = "human: <b>nobody</b>\n"
        run.metadata["command"] = "tofssm simulate --ssm vo"
        page, _, text = self._make(run)
        self.assertIn("human: <b>nobody</b>", text)
        self.assertNotIn("<b>nobody", page)
        self.assertIn("tofssm simulate --ssm vo", text)
        self.assertIn("drake 1.51.1", text)
        self.assertIn("Configuration Vo", text)
        self.assertIn("not a certified safety function", text)
        self.assertIn("0.12 to 0.22 m shorter", text)

    def test_what_was_not_verified(self):
        run = make_run(3.0)
        run.metadata |= {
            "dead_sensors": {"tool": [3]},
            "self_hit_coverage": ["base ring cannot be verified by self-hits"],
        }
        page = _strip(mut.make_report(run, calc_summary(run)))
        self.assertIn("Sensors declared dead: tool 3.", page)
        self.assertIn("base ring cannot be verified by self-hits.", page)

    def test_bare_run(self):
        """Without any metadata, person or event there is still a report."""
        run = make_run(2.0, geometry=False)
        run.metadata = {}
        _, _, text = self._make(run)
        self.assertIn("Nobody was in the cell.", text)
        self.assertIn("Nothing stopped or slowed the robot.", text)
        self.assertIn("0 of 10 products were placed", text)

    def test_a_robot_that_never_started(self):
        summary = calc_summary(make_run(2.0, geometry=False))
        summary["startup_s"] = summary["simulated_s"]
        verdict = dict(mut.make_verdict(summary))
        self.assertIn("never started: it was told to stop", verdict["bad"])

    def test_a_robot_that_never_started_says_why(self):
        run = make_run(2.0, geometry=False)
        run["robot_state"][:] = 0
        run["reason"][:] = "stop: tool at 0.30 m <= d_C 0.60 m"
        _, _, text = self._make(run)
        self.assertIn("At the end it was told: stop: tool at 0.30 m", text)
        self.assertNotIn("Nothing did, after the start", text)
        self.assertNotIn("until the law first lets it go", text)

    def test_nobody_is_not_a_person(self):
        _, _, text = self._make(make_run(2.0, geometry=False))
        self.assertIn("A robot arm works alone.", text)

    def test_real_sensors_tell_nothing_of_contacts(self):
        run = make_run(2.0, geometry=False)
        summary = calc_summary(run) | {"person_is_known": False}
        self.assertIsNone(summary["min_true_distance_m"])
        text = str(mut.make_verdict(summary))
        self.assertNotIn("Nobody", text)
        self.assertIn("is not known", text)

    def test_nobody_is_claimed_to_be_absent_from_real_sensors(self):
        run = make_run(2.0, geometry=False)
        run["robot_state"][50:] = 0
        run.metadata["human"] = "not known: real rings"
        summary = calc_summary(run) | {"person_is_known": False}
        page = mut.make_report(run, summary)
        for word in ("nobody<", "Nobody", "simulated world", "walking person"):
            self.assertNotIn(word, page)
        self.assertIn('<td class="n">not known</td>', page)
        self.assertIn("not known: real rings", page)
        self.assertNotIn("true distance with", page)
        self.assertNotIn("measured and true", page)
        # In a simulation it is known.
        page = mut.make_report(run, calc_summary(run))
        self.assertIn("nobody<", page)

    def test_no_rows(self):
        """Interrupted before the first tick."""
        run = make_run(0.0)
        run.metadata["interrupted"] = True
        _, _, text = self._make(run)
        self.assertIn("The run was interrupted", text)
        self.assertIn("Nothing was recorded", text)

    def test_contact(self):
        _, checker, text = self._make(_make_contact_run())
        self.assertIn(
            "The moving robot touched the person: 1 contact, at up to "
            "0.620 m/s.",
            text,
        )
        self.assertIn(
            "At 2.00 s the robot's wrist 3 touched the person's left forearm "
            "while moving at 0.620 m/s",
            text,
        )
        self.assertIn("never seen by any ring", text)
        self.assertIn("gap between sensors 0 and 1 of the base ring", text)
        self.assertIn("between sensors 0 and 1", text)
        # Four figures in two widths less one alternative each, three rings.
        self.assertEqual(len(checker.alt), 4 + 3)

    def test_episodes_and_replay(self):
        run = make_run(6.0)
        run.column["robot_state"] = make_steps(
            run["t"], (0, 0), (0.04, 2), (1, 1), (2.504, 0), (3, 2)
        ).astype(np.int8)
        run["reason"][313] = "tool at 0.40 m"
        page, _, text = self._make(run, recording="recording.html")
        self.assertIn('href="recording.html#t=1.000"', page)
        # A tick of 8 ms: two decimals would open before the event.
        self.assertIn('href="recording.html#t=2.504"', page)
        self.assertIn("tool at 0.40 m", text)
        self.assertIn("slowed the robot in 1 episode ", text)

    def test_write(self):
        run = make_run(1.0)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "report.html"
            mut.write_report(run, calc_summary(run), path)
            self.assertEqual(list(path.parent.iterdir()), [path])
            self.assertTrue(
                path.read_text("utf-8").startswith("<!DOCTYPE html>")
            )
        with self.assertRaisesRegex(UserError, "cannot be written"):
            mut.write_report(run, calc_summary(run), path)


class TestWords(unittest.TestCase):
    def test_format_number(self):
        self.assertEqual(mut.format_number(1.234), "1.23")
        self.assertEqual(mut.format_number(1.26, 1, "s"), "1.3\u00a0s")
        self.assertEqual(mut.format_number(None), "\u2013")
        self.assertEqual(mut.format_number(np.nan), "\u2013")
        self.assertEqual(mut.format_number(np.inf), "clear")

    def test_a_minus_is_no_hyphen(self):
        self.assertEqual(mut.format_number(-0.333, 2, "m"), "\u22120.33\u00a0m")

    def test_why_a_task_was_not_finished(self):
        run = make_run(10.0)
        run["true_distance"][:] = 0.5
        for share, told in ((0.7, True), (0.3, False)):
            for ring in RINGS:
                run[f"{ring}_true_distance"][:] = np.where(
                    run["t"] < 10.0 * share, 0.5, 1.0
                )
            summary = calc_summary(run)
            verdict = mut.make_verdict(summary)
            text = " ".join(sentence for _, sentence in verdict)
            self.assertIn("0 of 10 products were placed in the 10.0 s", text)
            self.assertEqual("For 70 % of that time" in text, told)
            self.assertEqual("at which this law stops" in text, told)

    def test_several_people_are_told_apart(self):
        run = make_run(4.0)
        run.metadata |= {
            "people": ["anna", "ben"],
            "person_parts": ["anna's head", "ben's left_hand"],
        }
        run["true_distance"][:] = 0.4
        run["person_part"][:] = 1
        self.assertIn(
            "never touched anna or ben. The nearest was ben, at 0.40 m",
            str(mut.make_verdict(calc_summary(run))),
        )
        run["contact_speed"][100] = 0.5
        summary = calc_summary(run)
        self.assertIn(
            "The moving robot touched ben once: 1 contact",
            str(mut.make_verdict(summary)),
        )
        page = mut.make_report(run, summary)
        for text in (
            "beside 2 people",
            "anna 0, ben 1",
            "touched ben&#39;s left hand while",
        ):
            self.assertIn(text, page)

    def test_tasks_that_place_no_products(self):
        run = make_run(2.0)
        run.metadata["task"] = {"step": "", "steps": 0}
        page = mut.make_report(run, calc_summary(run))
        self.assertIn("2.0 s without a task that counts", page)
        self.assertNotIn("products placed", page)
        run.metadata["task"] = {
            "step": "waypoint reached",
            "steps": 3,
            "step_time": [0.5, 1.0],
        }
        page = mut.make_report(run, calc_summary(run))
        self.assertIn("2 of 3 waypoints were reached", page)
        self.assertNotIn("products", mut.make_verdict(calc_summary(run))[1][1])

    def test_count_of(self):
        self.assertEqual(mut.count_of(0, "contact"), "no contacts")
        self.assertEqual(mut.count_of(1, "contact"), "1 contact")
        self.assertEqual(mut.count_of(3, "contact"), "3 contacts")

    def test_verdict_grades(self):
        run = make_run(2.0)
        run["true_distance"][:] = 0.4
        run["products_placed"][-1] = 10
        grades = dict(
            (sentence, grade)
            for grade, sentence in mut.make_verdict(calc_summary(run))
        )
        self.assertEqual(
            grades[
                "The robot never touched the person. The nearest they came "
                "was 0.40 m."
            ],
            "good",
        )
        self.assertEqual(
            grades["All 10 products were placed in 2.0 s."], "good"
        )
        for products, placed, sentence in (
            (1, 1, "The product was placed in 2.0 s."),
            (1, 0, "0 of 1 product was placed in the 2.0 s"),
        ):
            run["products_placed"][-1] = placed
            run.metadata["products"] = products
            verdict = mut.make_verdict(calc_summary(run))
            self.assertIn(sentence, str(verdict))
        run["true_distance"][50] = -0.01
        verdict = mut.make_verdict(calc_summary(run))
        self.assertIn("while it stood still", verdict[0][1])
        summary = calc_summary(_make_contact_run())
        self.assertEqual(mut.make_verdict(summary)[0][0], "bad")

    def test_seen_contact(self):
        run = _make_contact_run()
        run["base_measured_distance"][:] = 0.35
        (contact,) = find_contacts(run)
        text = " ".join(mut.describe_contact(contact))
        self.assertIn("the person was seen (by base)", text)
        self.assertNotIn("never seen", text)
        self.assertIn("base ring read 0.35 m", text)
        self.assertIn("tool ring read clear", text)


class TestLawOfOnesOwn(unittest.TestCase):
    """No states, no distance at which it stops, one signal."""

    def make_run(self):
        run = _make_contact_run()
        for ring in run.rings:
            for name in ("d_C", "d_R", "dsi_raw", "dsi", "dsi_C", "dsi_R"):
                del run.column[f"{ring}_{name}"]
            run.column[f"{ring}_margin"] = (
                run[f"{ring}_measured_distance"] - 0.6
            )
            run.column[f"{ring}_state"] = np.full(len(run), -1, dtype=np.int8)
        run.metadata["law"] = {
            "kind": "Custom",
            "title": "Nearer is slower",
            "about": "goes by the distance",
            "guide": [["Margin.", "The room to spare."]],
            "limits": "It knows no speeds.",
            "states": [],
            "signals": {"margin": {"unit": "m", "meaning": "room to spare"}},
        }
        return run

    def test_its_words_and_its_signal_are_shown(self):
        run = self.make_run()
        page = mut.make_report(run, calc_summary(run))
        for text in (
            "Nearer is slower: goes by the distance.",
            "<strong>Margin.</strong> The room to spare.",
            "It knows no speeds.",
            "What the law made of it",
        ):
            self.assertIn(text, page)
        self.assertNotIn("lower threshold", page)
        self.assertNotIn("critical distance", page)
        self.assertEqual(figures.find_drawn_signals(run), ["margin"])
        figure = figures.make_signals(run)
        (ax,) = figure.axes
        self.assertEqual(ax.get_title("left"), "margin: room to spare")

    def test_a_contact_is_not_judged(self):
        run = self.make_run()
        summary = calc_summary(run)
        self.assertEqual(summary["late_stops"], 0)
        self.assertEqual(summary["stop_due_s"], 0.0)
        for contact in summary["contacts"]:
            self.assertEqual(contact["cause"], "unjudged")
        self.assertTrue(summary["contacts"])
        with _draw_nothing():
            page = mut.make_report(run, summary)
        self.assertIn("not judged, because this law has no distance", page)
