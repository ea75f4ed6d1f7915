import unittest
import xml.etree.ElementTree as ElementTree

import numpy as np
from synthetic_run import PERIOD, RINGS, make_rich_run, make_run, make_steps

from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.metrics import find_contacts, find_state_events
import tofssm_drake.reports.figures as mut


class TestDecidingRing(unittest.TestCase):
    def _find(self, state, measured, critical):
        run = make_run(PERIOD)
        for i, ring in enumerate(RINGS):
            run[f"{ring}_state"][:] = state[i]
            run[f"{ring}_measured_distance"][:] = measured[i]
            run[f"{ring}_d_C"][:] = critical[i]
        return RINGS[mut.find_deciding_ring(run)[0]]

    def test_lowest_state_first(self):
        self.assertEqual(
            self._find([2, 1, 2], [0.1, 1.2, 0.1], [0.5, 0.5, 0.5]), "elbow"
        )

    def test_then_the_nearest_to_its_threshold(self):
        self.assertEqual(
            self._find([1, 1, 1], [0.6, 0.7, np.inf], [0.5, 0.65, 0.9]),
            "elbow",
        )

    def test_then_the_longest_threshold(self):
        self.assertEqual(
            self._find([2, 2, 2], [np.inf] * 3, [0.5, 0.6, 0.9]), "tool"
        )

    def test_unknown_is_not_near(self):
        self.assertEqual(
            self._find([0, 0, 0], [np.nan, 0.9, np.nan], [np.inf, 0.5, np.inf]),
            "elbow",
        )

    def test_pick(self):
        run = make_run(2 * PERIOD)
        run["tool_d_C"][:] = [0.7, 0.8]
        np.testing.assert_array_equal(
            mut.pick(run, "d_C", np.array([2, 0])), [0.7, 0.6]
        )


class TestThin(unittest.TestCase):
    def test_short_signal_is_kept(self):
        t = np.arange(5.0)
        self.assertIs(mut.thin(t, t, 5)[1], t)

    def test_range(self):
        """No extreme is lost, and a gap stays a gap."""
        t = np.arange(1000.0)
        y = np.sin(t)
        y[40] = 7.0
        y[500:600] = np.nan
        time, least, median, greatest = mut.thin(t, y, 50)
        self.assertEqual(len(time), 50)
        self.assertEqual(np.nanmax(greatest), 7.0)
        self.assertEqual(greatest[2], 7.0)
        self.assertEqual(np.nanmin(least), np.nanmin(y))
        np.testing.assert_array_equal(
            np.flatnonzero(np.isnan(median)), np.arange(25, 30)
        )
        self.assertAlmostEqual(time[0], 9.5)
        known = ~np.isnan(median)
        self.assertTrue(np.all(least[known] <= median[known]))
        self.assertTrue(np.all(median[known] <= greatest[known]))


class TestPlaceStates(unittest.TestCase):
    def test_most_frequent(self):
        """Twice stopped and once normal in one square is stopped."""
        run = make_run(4 * PERIOD)
        run["person_x"][:] = [0.011, 0.013, 0.012, 0.511]
        run["person_y"][:] = 0.02
        run.column["robot_state"] = np.array([0, 2, 0, 1], dtype=np.int8)
        places = mut.find_place_states(run)
        x, y = places[RobotState.STOP]
        np.testing.assert_allclose(x, [0.012])
        np.testing.assert_allclose(y, [0.02])
        np.testing.assert_allclose(places[RobotState.REDUCED][0], [0.511])
        self.assertEqual(len(places[RobotState.NORMAL][0]), 0)

    def test_nobody(self):
        places = mut.find_place_states(make_run(1.0))
        self.assertEqual([len(x) for x, _ in places.values()], [0, 0, 0])


class TestReadingImage(unittest.TestCase):
    def test_image(self):
        time = np.array([0.5, 0.6, 2.5])
        distance = np.array(
            [[0.9, np.inf], [0.4, 0.2], [0.7, np.nan]], dtype=np.float32
        )
        reading = np.array([[1, 0], [1, 2], [0, 3]])
        edges = np.arange(5.0)
        image, kind = mut.make_reading_image(time, distance, reading, edges)
        # Nothing before the first scan would be -1; here it is in time.
        np.testing.assert_array_equal(kind, [[1, 1, 0, 0], [2, 2, 3, 3]])
        self.assertAlmostEqual(image[0, 0], 0.4, places=6)
        self.assertTrue(np.isnan(image[1]).all())

    def test_before_the_first_scan(self):
        _, kind = mut.make_reading_image(
            np.array([1.5]),
            np.array([[0.5]]),
            np.array([[1]]),
            np.array([0.0, 1.0, 2.0]),
        )
        np.testing.assert_array_equal(kind, [[-1, 1]])


class TestFigures(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.run_ = make_rich_run(8.0)

    def _get_texts(self, figure):
        svg = mut.to_svg(figure)
        root = ElementTree.fromstring(svg)
        self.assertLess(len(svg), 600_000)
        return ["".join(e.itertext()) for e in root.iter() if "text" in e.tag]

    def test_axes_are_labelled_with_units(self):
        for make, labels in (
            (mut.make_timeline, ["time (s)", "tool (m/s)", "distance (m)"]),
            (mut.make_plan, ["x (m)", "y (m)"]),
            (
                mut.make_rings,
                ["time (s)", "distance read by a sensor (m)", "sensor"],
            ),
        ):
            for narrow in (False, True):
                texts = self._get_texts(make(self.run_, narrow=narrow))
                for label in labels:
                    self.assertIn(label, texts)

    def test_closeup_shows_the_speed_fraction(self):
        texts = self._get_texts(mut.make_closeup(self.run_, 4.0))
        self.assertIn("speed fraction (%)", texts)

    def test_same_run_same_bytes(self):
        self.assertEqual(
            mut.to_svg(mut.make_plan(self.run_)),
            mut.to_svg(mut.make_plan(self.run_)),
        )

    def test_nobody_and_nothing_measured(self):
        run = make_run(2.0)
        for ring in RINGS:
            run[f"{ring}_d_R"][:] = np.inf
            run[f"{ring}_measured_distance"][:] = np.nan
        for make in (mut.make_timeline, mut.make_plan, mut.make_rings):
            figure = make(run)
            self.assertIn("<svg", mut.to_svg(figure))
            # What is not known is not in the legend either.
            self.assertFalse(
                [t for t in self._get_texts(figure) if t.startswith("true")]
            )

    def test_no_scans(self):
        run = make_run(2.0)
        run.scan = {}
        self.assertIn("no scans recorded", self._get_texts(mut.make_rings(run)))

    def test_contacts_are_marked(self):
        run = make_rich_run(3.0)
        run["true_distance"][200:220] = -0.01
        run["contact_speed"][:] = 0.0
        run["contact_speed"][200:220] = 0.5
        for make in (mut.make_timeline, mut.make_plan):
            self.assertIn("contact while moving", self._get_texts(make(run)))

    def test_people_and_obstacles_have_names(self):
        run = make_rich_run(3.0)
        run.metadata |= {
            "people": ["anna", "ben"],
            "plan": {
                "obstacles": [
                    {
                        "label": "cart",
                        "outline": [[1, 1], [2, 1], [2, 2], [1, 2]],
                        "way": [[1.5, 1.5], [1.5, -1.5]],
                    },
                    {
                        "label": "shelf",
                        "outline": [[3, 3], [4, 3], [4, 4], [3, 4]],
                        "way": [[3.5, 3.5]],
                    },
                ]
            },
        }
        for i, name in enumerate(("anna", "ben")):
            run.column[f"place_of_{name}_x"] = run["t"] + i
            run.column[f"place_of_{name}_y"] = 0.5 * run["t"]
        for narrow in (False, True):
            figure = mut.make_plan(run, narrow=narrow)
            texts = self._get_texts(figure)
            for text in (
                *("anna", "ben", "anna starts", "ben starts"),
                "cart, at first, dotted: its way",
                "shelf, stands still",
                "nearest person, robot stopped",
            ):
                self.assertIn(text, texts)
            # Also without colours.
            looks = {
                (handle.get_color(), handle.get_marker())
                for handle in figure.axes[0].get_legend().legend_handles
                if getattr(handle, "get_label", str)() in ("anna", "ben")
            }
            self.assertEqual(len({marker for _, marker in looks}), 2)

    def test_one_person_is_the_person(self):
        texts = self._get_texts(mut.make_plan(self.run_))
        self.assertIn("person starts", texts)
        self.assertIn("person, robot stopped", texts)

    def test_ring_diagram(self):
        figure = mut.make_ring_diagram(
            beam_azimuth=np.arange(8) * np.pi / 4,
            fov=np.deg2rad(25),
            radius=0.075,
            azimuth=0.4,
            distance=0.2,
            label="tool ring",
        )
        texts = self._get_texts(figure)
        self.assertEqual(sorted(texts[:8]), [str(j) for j in range(8)])


class TestCloseup(unittest.TestCase):
    def test_what_is_worth_looking_at(self):
        run = make_run(6.0)
        self.assertIsNone(mut.find_closeup([], []))
        run.column["robot_state"] = make_steps(
            run["t"], (0, 0), (0.04, 2), (1, 1), (2, 0), (3, 2), (4, 0)
        ).astype(np.int8)
        run["tcp_speed"][run["t"] >= 3.9] = 1.0
        events = find_state_events(run)
        self.assertEqual(
            mut.find_closeup(events[:1], [])[1], "the reduction at 1.00 s"
        )
        time, what = mut.find_closeup(events, [])
        self.assertAlmostEqual(time, 4.0)
        self.assertEqual(what, "the stop at 4.00 s")
        run["contact_speed"][run["t"] >= 5.0] = 0.3
        time, what = mut.find_closeup(events, find_contacts(run))
        self.assertAlmostEqual(time, 5.0)
        self.assertEqual(what, "the contact at 5.00 s")


def test_links_of_a_mixed_cell_are_told_by_kind():
    run = make_run(1.0)
    first, *others = run.rings
    run.metadata["sensing"] = "mixed"
    run.metadata["link_kinds"] = {first: "rings"} | dict.fromkeys(
        others, "planar lidar"
    )
    run.scan = {first: run.scan[first]}
    figure = mut.make_rings(run)
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert [title for title in titles if title] == [
        f"{first} ring",
        *(f"{link} (planar lidar)" for link in others),
    ]
    # A strip of readings below the ring only, and the colour bar.
    assert len(figure.axes) == len(run.rings) + 2
