import unittest

import numpy as np
from synthetic_run import PERIOD, RINGS, make_run, make_steps

from tofssm_drake.messages import RobotState
import tofssm_drake.metrics.approach as mut
from tofssm_drake.metrics.metrics import calc_summary, find_contacts
from tofssm_drake.reports.report import describe_contact

_CONTACT = 4.0


def _make_run(*, stop, elbow_due=None, azimuth=0.0, elevation=0.0):
    """A contact at 4 s, the robot stopped from `stop` s on (None: never).

    The person comes to the elbow ring at `elbow_due`, in the direction given
    (rad), and walks 1.5 m/s. All d_C are 0.6 m.
    """
    run = make_run(8.0)
    t = run["t"]
    for ring in RINGS:
        run[f"{ring}_true_distance"][:] = 1.0
        run[f"{ring}_true_azimuth"][:] = azimuth
        run[f"{ring}_true_elevation"][:] = elevation
    if elbow_due is not None:
        run["elbow_true_distance"][t >= elbow_due - 1e-9] = 0.5
    if stop is not None:
        states = make_steps(t, (0, 0), (0.04, 2), (stop, 0), (6.0, 2))
        run["robot_state"][:] = states
        run["elbow_state"][:] = states
    run["person_x"][:] = 1.5 * t
    run["person_y"][:] = 0.0
    run["true_distance"][:] = 0.3
    during = (t >= _CONTACT - 1e-9) & (t < 4.2 - 1e-9)
    run["true_distance"][during] = -0.01
    run["contact_speed"][during] = 0.13
    run["tcp_speed"][t < 4.2 - 1e-9] = 0.5
    run["robot_body"][:] = 1
    run["person_part"][:] = 1
    return run


def _see(run, start, distance=0.52):
    run["elbow_measured_distance"][run["t"] >= start - 1e-9] = distance


class TestApproach(unittest.TestCase):
    def _analyse(self, run):
        (contact,) = find_contacts(run)
        self.text = " ".join(describe_contact(contact))
        (self.summary,) = calc_summary(run)["contacts"]
        return contact.approach

    def test_gap_between_sensors(self):
        """Due at 3.6 s; stop, from wherever it came, at 3.8 s."""
        run = _make_run(stop=3.8, elbow_due=3.6, azimuth=np.deg2rad(22.5))
        run["elbow_state"][:] = RobotState.NORMAL
        run["tool_state"][:] = run["robot_state"]
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "gap")
        self.assertEqual(approach.ring, "elbow")
        self.assertEqual(approach.sensors, (0, 1))
        self.assertAlmostEqual(approach.late, 0.2)
        elbow, tool = approach.rings[1:]
        self.assertAlmostEqual(elbow.due, 3.6)
        self.assertEqual(elbow.d_C, 0.6)
        self.assertEqual(elbow.late, np.inf)
        self.assertEqual(elbow.nearest_reading, np.inf)
        self.assertFalse(elbow.seen)
        self.assertTrue(np.isnan(tool.late))
        self.assertAlmostEqual(tool.reacted, 3.8)
        self.assertIn(
            "late by 0.20 s, because of the gap between sensors 0 and 1 of "
            "the elbow ring",
            self.text,
        )
        self.assertIn("Until then it read clear", self.text)
        expected = {
            "time_s": _CONTACT,
            "speed_mps": 0.13,
            "robot_body": "forearm_link",
            "person": None,
            "person_part": "left_forearm",
            "cause": "gap",
            "ring": "elbow",
            "sensors": [0, 1],
        }
        self.assertAlmostEqual(self.summary.pop("late_s"), 0.2)
        self.assertAlmostEqual(self.summary.pop("time_s"), 4.0)
        del expected["time_s"]
        self.assertEqual(self.summary, expected)

    def test_gap_along_the_link(self):
        run = _make_run(stop=3.8, elbow_due=3.6, elevation=np.deg2rad(60))
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "gap")
        self.assertIn("above and below the plane of the elbow ring", self.text)
        self.assertIn("said stop 0.20 s later", self.text)

    def test_behind_the_sensors(self):
        """The ring's radius is 0.075 m: no angle to a beam means anything."""
        run = _make_run(stop=3.8, elbow_due=3.6)
        run["elbow_true_distance"][run["t"] >= 3.6 - 1e-9] = 0.05
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "gap")
        self.assertTrue(np.isnan(approach.rings[1].off_around))
        words = "nearer to the link than the sensors"
        # The cause, the approach and the view at the contact.
        self.assertEqual(self.text.count(words), 3)
        self.assertNotIn("nan", self.text)

    def test_seen_in_time(self):
        """Robot rests 0.2 s after the contact: 1.5 m/s ask 0.3 m more."""
        run = _make_run(stop=3.64, elbow_due=3.6)
        _see(run, 3.62)
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "short")
        self.assertAlmostEqual(approach.late, 0.04)
        self.assertIsNone(approach.sensors)
        self.assertAlmostEqual(approach.person_speed, 1.5)
        self.assertAlmostEqual(approach.needed, 0.6 + 1.5 * 0.2)
        self.assertTrue(approach.rings[1].seen)
        self.assertIn("for a person at 1.50\u00a0m/s", self.text)
        self.assertIn("(it needs at least 0.900 m here)", self.text)

    def test_stop_before_it_was_due(self):
        run = _make_run(stop=3.4, elbow_due=3.6)
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "short")
        self.assertEqual(approach.late, 0.0)
        self.assertAlmostEqual(approach.rings[1].reacted, 3.4)
        self.assertIn("said stop by then", self.text)

    def test_never_seen(self):
        run = _make_run(stop=None, elbow_due=3.6, azimuth=np.deg2rad(67.5))
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "unseen")
        self.assertEqual(approach.late, np.inf)
        self.assertEqual(approach.sensors, (1, 2))
        self.assertIsNone(self.summary["late_s"])
        self.assertIn("never seen by any ring", self.text)

    def test_slow_although_inside_a_beam(self):
        run = _make_run(stop=3.9, elbow_due=3.6)
        _see(run, 3.7, 0.7)
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "late")
        self.assertEqual(approach.rings[1].nearest_reading, 0.7)
        self.assertIn("inside a beam of the elbow ring", self.text)

    def test_beyond_every_ring(self):
        approach = self._analyse(_make_run(stop=None))
        self.assertEqual(approach.cause, "beyond")
        self.assertIsNone(self.summary["ring"])
        self.assertIn("no ring was due", self.text)

    def test_earlier_stop_is_left_out(self):
        """The person was near before, the robot stopped and went on."""
        run = _make_run(stop=3.8, elbow_due=3.704)
        t = run["t"]
        before = (t >= 2.5 - 1e-9) & (t < 3.0 - 1e-9)
        run["elbow_true_distance"][before] = 0.4
        run["robot_state"][before] = 0
        run["elbow_state"][before] = 0
        approach = self._analyse(run)
        self.assertAlmostEqual(approach.rings[1].due, 3.704)
        self.assertAlmostEqual(approach.late, 0.096)

    def test_long_stop_is_followed_to_its_beginning(self):
        run = _make_run(stop=1.5, elbow_due=1.46)
        approach = self._analyse(run)
        self.assertAlmostEqual(approach.stop, 1.504)
        self.assertAlmostEqual(approach.late, 0.04, delta=PERIOD)

    def test_without_geometry(self):
        run = _make_run(stop=3.8, elbow_due=3.6)
        del run.metadata["ring_geometry"]
        approach = self._analyse(run)
        self.assertEqual(approach.cause, "late")
        self.assertIsNone(approach.rings[1].sensors)


class TestLateStops(unittest.TestCase):
    def test_counts_long_ones_while_running(self):
        run = make_run(8.0)
        t = run["t"]
        for start, stop in ((1.0, 1.4), (2.0, 2.056), (3.0, 3.4), (5.0, 5.4)):
            during = (t >= start - 1e-9) & (t < stop - 1e-9)
            run["tool_true_distance"][during] = 0.5
        run["speed_fraction"][(t > 2.9) & (t < 3.5)] = 0.0
        run["robot_state"][(t > 5.04) & (t < 5.5)] = 0
        self.assertEqual(mut.count_late_stops(run, 5), 1)
        self.assertEqual(calc_summary(run)["late_stops"], 1)
        self.assertEqual(mut.count_late_stops(run, len(t)), 0)

    def test_no_threshold_yet(self):
        run = make_run(1.0)
        run["tool_true_distance"][:] = 0.5
        run["tool_d_C"][:] = np.inf
        self.assertEqual(mut.count_late_stops(run, 5), 0)
        self.assertEqual(calc_summary(make_run(0.0))["late_stops"], 0)


class TestSplitOffset(unittest.TestCase):
    def test_from_the_sensor(self):
        """Sensor 0.1 m from the centre; sides by hand."""
        beams = np.deg2rad(np.arange(0, 360, 45))
        point = np.array([0.5, -0.2, 0.3])
        around, along = mut.split_offset(
            azimuth=np.arctan2(point[1], point[0]) + np.pi / 2,
            elevation=np.arcsin(point[2] / np.linalg.norm(point)),
            distance=np.linalg.norm(point),
            beam_azimuth=beams,
            fov=np.deg2rad(25),
            radius=0.1,
        )
        self.assertAlmostEqual(around, np.arctan2(0.2, 0.4) - np.deg2rad(12.5))
        self.assertAlmostEqual(
            along,
            np.arctan2(0.3, np.hypot(0.4, 0.2)) - np.deg2rad(12.5),
        )
