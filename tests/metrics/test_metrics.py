import itertools
import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from synthetic_run import PERIOD, RINGS, make_run, make_steps

from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.approach import find_neighbours
import tofssm_drake.metrics.metrics as mut


def _set_state(run, *pairs, ring="tool"):
    state = make_steps(run["t"], *pairs).astype(np.int8)
    run.column["robot_state"] = state
    run.column[f"{ring}_state"] = state.copy()


class TestSummary(unittest.TestCase):
    def test_uneventful_run(self):
        """Starting stopped is no event; nobody there is no distance."""
        run = make_run(10.0)
        summary = mut.calc_summary(run)
        self.assertEqual(summary["stop_events"], 0)
        self.assertEqual(summary["reduce_events"], 0)
        self.assertAlmostEqual(summary["startup_s"], 0.04)
        self.assertAlmostEqual(summary["simulated_s"], 10.0)
        self.assertAlmostEqual(summary["normal_s"], 9.96)
        self.assertEqual(summary["stopped_s"], 0.0)
        self.assertIsNone(summary["min_true_distance_m"])
        self.assertIsNone(summary["distance_rmse_m"])
        self.assertIsNone(summary["task_time_s"])
        self.assertEqual(summary["contact_while_moving_events"], 0)
        self.assertEqual(
            summary["detection_share_by_ring"], dict.fromkeys(RINGS)
        )

    def test_state_events(self):
        """Two stops, one of them through reduced; recovering is neither."""
        run = make_run(10.0)
        _set_state(
            run,
            (0, 0),
            (0.04, 2),
            (2.0, 1),
            (2.4, 0),
            (3.4, 1),
            (3.8, 2),
            (6.0, 0),
            (7.0, 1),
            (7.2, 2),
        )
        summary = mut.calc_summary(run)
        self.assertEqual(summary["stop_events"], 2)
        self.assertEqual(summary["reduce_events"], 1)
        self.assertAlmostEqual(summary["stopped_s"], 2.0)
        self.assertAlmostEqual(summary["reduced_s"], 1.0)
        self.assertAlmostEqual(summary["normal_s"], 6.96)

    def test_event_details(self):
        run = make_run(5.0)
        _set_state(run, (0, 0), (0.04, 2), (2.0, 0), (3.0, 1), ring="elbow")
        run["tcp_speed"][:] = 1.25
        run["elbow_measured_distance"][run["t"] >= 2.0] = 0.45
        run["tool_measured_distance"][:] = 0.2
        run["true_distance"][:] = 0.4
        run["reason"][250] = "elbow: 0.45 m"
        stop, recover = mut.find_state_events(run)
        self.assertEqual((stop.kind, recover.kind), ("stop", "recover"))
        self.assertAlmostEqual(stop.time, 2.0)
        self.assertAlmostEqual(stop.duration, 1.0)
        self.assertAlmostEqual(recover.duration, 2.0)
        self.assertEqual(stop.before, RobotState.NORMAL)
        self.assertEqual(stop.after, RobotState.STOP)
        self.assertEqual(stop.ring, "elbow")
        self.assertEqual(stop.measured_distance, 0.45)
        self.assertEqual(stop.true_distance, 0.4)
        self.assertEqual(stop.tcp_speed, 1.25)
        self.assertEqual(stop.reason, "elbow: 0.45 m")

    def test_never_started(self):
        run = make_run(1.0)
        _set_state(run, (0, 0))
        summary = mut.calc_summary(run)
        self.assertEqual(summary["stop_events"], 0)
        self.assertAlmostEqual(summary["startup_s"], 1.0)
        self.assertEqual(summary["stopped_s"], 0.0)

    def test_task_time(self):
        run = make_run(10.0)
        run.column["products_placed"] = make_steps(
            run["t"], (0, 0), (4.0, 2), (8.0, 3)
        ).astype(np.int16)
        run.metadata["products"] = 3
        summary = mut.calc_summary(run)
        self.assertEqual(summary["products_placed"], 3)
        self.assertAlmostEqual(summary["task_time_s"], 8.0)
        run.metadata["products"] = 10
        self.assertIsNone(mut.calc_summary(run)["task_time_s"])

    def test_waypoints_are_counted_by_path_time(self):
        run = make_run(10.0)
        run.metadata["task"] = {
            "step": "waypoint reached",
            "steps": 4,
            "step_time": [1.0, 3.0, 5.0, 7.0],
        }
        run.column["speed_fraction"] = make_steps(
            run["t"], (0, 1.0), (4.0, 0.5)
        )
        summary = mut.calc_summary(run)
        # 4 s at full speed, 6 s at half speed: 7 s of path time, but for the
        # first tick, in which the rate rises from 0.
        self.assertEqual(summary["steps_done"], 3)
        self.assertNotIn("products_placed", summary)
        run.column["speed_fraction"][-100:] = 1.0
        summary = mut.calc_summary(run)
        self.assertEqual((summary["steps_done"], summary["steps"]), (4, 4))
        self.assertGreater(summary["task_time_s"], 9.0)

    def test_who_was_touched(self):
        run = make_run(4.0)
        run.metadata |= {
            "people": ["anna", "ben"],
            "person_parts": [
                f"{name}'s {part}"
                for name in ("anna", "ben")
                for part in ("head", "hand")
            ],
        }
        run["true_distance"][:] = 0.4
        for row, part in ((100, 3), (200, 0), (300, 3)):
            run["contact_speed"][row] = 0.5
            run["true_distance"][row] = -0.01
            run["person_part"][row] = part
        run["true_distance"][300] = -0.02
        summary = mut.calc_summary(run)
        self.assertEqual(summary["contacts_by_person"], {"anna": 1, "ben": 2})
        self.assertEqual(summary["nearest_person"], "ben")
        self.assertEqual(
            [(c.person, c.person_part) for c in mut.find_contacts(run)],
            [("ben", "hand"), ("anna", "head"), ("ben", "hand")],
        )

    def test_no_task_counts_nothing(self):
        run = make_run(1.0)
        run.metadata["task"] = {"step": "", "steps": 0}
        summary = mut.calc_summary(run)
        self.assertEqual((summary["step"], summary["steps_done"]), ("", 0))
        self.assertIsNone(summary["task_time_s"])

    def test_distances(self):
        """Only in range counts; errors 0.1 and 0.3 pooled."""
        run = make_run(4.0)
        t = run["t"]
        run["true_distance"][:] = 0.7
        run["true_distance"][100] = -0.02
        run["base_true_distance"][:] = make_steps(t, (0, 1.0), (2.0, 5.0))
        run["base_measured_distance"][:] = make_steps(
            t, (0, 1.1), (1.0, np.inf), (3.0, 0.5)
        )
        run["tool_true_distance"][:] = 0.9
        run["tool_measured_distance"][t < 1.0] = 1.2
        summary = mut.calc_summary(run)
        self.assertEqual(summary["min_true_distance_m"], 0.0)
        by_ring = summary["distance_rmse_by_ring_m"]
        self.assertAlmostEqual(by_ring["base"], 0.1)
        self.assertIsNone(by_ring["elbow"])
        self.assertAlmostEqual(by_ring["tool"], 0.3)
        self.assertAlmostEqual(summary["distance_rmse_m"], np.sqrt(0.05))
        # Nearest: 1.1 measured, 0.9 true; then 0.5 of a ghost at 0.9.
        self.assertAlmostEqual(
            summary["distance_rmse_nearest_m"], np.sqrt(0.04 / 2 + 0.16 / 2)
        )
        self.assertAlmostEqual(summary["detection_share_by_ring"]["base"], 0.5)
        self.assertAlmostEqual(summary["detection_share_by_ring"]["tool"], 0.25)
        self.assertAlmostEqual(summary["ghost_s_by_ring"]["base"], 1.0)
        self.assertEqual(summary["ghost_s_by_ring"]["tool"], 0.0)

    def test_no_rows(self):
        run = make_run(0.0)
        summary = mut.calc_summary(run)
        self.assertEqual(summary["products_placed"], 0)
        self.assertEqual(summary["simulated_s"], 0.0)
        self.assertIsNone(summary["min_true_distance_m"])

    @given(st.lists(st.integers(0, 2), min_size=1, max_size=60))
    def test_times_add_up(self, states):
        """Every tick is start-up or in exactly one state."""
        run = make_run(len(states) * PERIOD)
        run.column["robot_state"] = np.array(states, dtype=np.int8)
        summary = mut.calc_summary(run)
        total = sum(
            summary[name]
            for name in ("startup_s", "stopped_s", "reduced_s", "normal_s")
        )
        self.assertAlmostEqual(total, summary["simulated_s"])
        running = states[mut.find_start(states) :]
        stops = sum(b == 0 and a != 0 for a, b in itertools.pairwise(running))
        self.assertEqual(summary["stop_events"], stops)


class TestEpisodes(unittest.TestCase):
    def test_chatter_is_one_episode(self):
        run = make_run(10.0)
        _set_state(
            run,
            (0, 0),
            (0.04, 1),  # Recovering from start-up slows nobody.
            (0.2, 2),
            (2.0, 1),
            (2.08, 2),
            (2.4, 0),
            (2.8, 1),
            (3.2, 2),
            (5.0, 1),
            (5.4, 2),
            (9.6, 0),
        )
        run["true_distance"][:] = 0.9
        run["true_distance"][310] = -0.02
        run["speed_fraction"][(run["t"] > 2.6) & (run["t"] < 2.9)] = 0.0
        first, second, third = mut.find_episodes(run)
        self.assertAlmostEqual(first.time, 2.0)
        self.assertAlmostEqual(first.duration, 1.2)
        self.assertEqual(first.lowest, RobotState.STOP)
        self.assertAlmostEqual(first.stopped, 0.4)
        self.assertEqual(first.changes, 5)
        self.assertTrue(first.rest)
        self.assertEqual(first.least_true_distance, 0.0)
        self.assertEqual(first.first.after, RobotState.REDUCED)
        self.assertAlmostEqual(second.time, 5.0)
        self.assertEqual(second.lowest, RobotState.REDUCED)
        self.assertEqual(second.stopped, 0.0)
        self.assertFalse(second.rest)
        self.assertEqual(second.least_true_distance, 0.9)
        # Until the end of the run.
        self.assertAlmostEqual(third.duration, 0.4)
        self.assertAlmostEqual(third.stopped, 0.4)
        summary = mut.calc_summary(run)
        self.assertEqual(summary["slow_episodes"], 3)
        self.assertEqual(summary["standstills"], 1)

    def test_standing_at_the_start_is_no_standstill(self):
        run = make_run(2.0)
        run["speed_fraction"][run["t"] < 0.5] = 0.0
        self.assertEqual(mut.count_standstills(run), 0)
        run["speed_fraction"][:] = 0.0
        self.assertEqual(mut.count_standstills(run), 0)


class TestContacts(unittest.TestCase):
    def _make(self, *spans):
        run = make_run(10.0)
        run["true_distance"][:] = 0.5
        run["robot_body"][:] = 1
        run["person_part"][:] = 1
        for ring in RINGS:
            run[f"{ring}_true_distance"][:] = 0.3
            run[f"{ring}_true_azimuth"][:] = np.deg2rad(22.5)
            run[f"{ring}_true_elevation"][:] = 0.0
        for start, stop, speed in spans:
            during = (run["t"] >= start - 1e-9) & (run["t"] < stop - 1e-9)
            run["true_distance"][during] = -0.01
            run["contact_speed"][during] = speed
        return run

    def test_events(self):
        """Resting contact is none; short interruptions do not split one."""
        run = self._make(
            (2.0, 2.4, 0.5),
            (2.48, 2.56, 0.8),
            (4.0, 5.0, 0.009),
            (6.0, 6.08, 0.02),
        )
        contacts = mut.find_contacts(run)
        self.assertEqual(len(contacts), 2)
        first, second = contacts
        self.assertAlmostEqual(first.time, 2.0)
        self.assertAlmostEqual(first.duration, 0.56)
        self.assertEqual(first.first_speed, 0.5)
        self.assertEqual(first.max_speed, 0.8)
        self.assertEqual(first.robot_body, "forearm_link")
        self.assertEqual(first.person_part, "left_forearm")
        self.assertEqual(first.robot_state, RobotState.NORMAL)
        self.assertAlmostEqual(second.time, 6.0)
        summary = mut.calc_summary(run)
        self.assertEqual(summary["contact_while_moving_events"], 2)
        self.assertEqual(summary["contact_while_moving_max_mps"], 0.8)

    def test_blind_gap(self):
        """Halfway between the beams of sensors 0 and 1 nobody is seen."""
        run = self._make((2.0, 2.4, 0.5))
        run["tool_measured_distance"][run["t"] < 1.6 - 1e-9] = 0.4
        (contact,) = mut.find_contacts(run)
        self.assertTrue(contact.blind)
        self.assertAlmostEqual(contact.last_seen, 0.4 + PERIOD)
        view = contact.views[2]
        self.assertEqual(view.ring, "tool")
        self.assertEqual(view.sensors, (0, 1))
        self.assertEqual(view.measured_distance, np.inf)
        self.assertFalse(view.seen)
        # Sensor on the ring at 0.075 m, point at 0.3 m and 22.5 degrees.
        angle = np.arctan2(
            0.3 * np.sin(np.deg2rad(22.5)),
            0.3 * np.cos(np.deg2rad(22.5)) - 0.075,
        )
        self.assertAlmostEqual(view.off_beam, angle - np.deg2rad(12.5))

    def test_seen_contact(self):
        run = self._make((2.0, 2.4, 0.5))
        run["base_measured_distance"][:] = 0.35
        (contact,) = mut.find_contacts(run)
        self.assertFalse(contact.blind)
        self.assertEqual(contact.last_seen, 0.0)
        self.assertEqual([v.seen for v in contact.views], [True, False, False])

    def test_far_reading_is_not_seeing(self):
        """Another part of the person, far behind, does not count."""
        run = self._make((2.0, 2.4, 0.5))
        run["base_measured_distance"][:] = 0.9
        (contact,) = mut.find_contacts(run)
        self.assertTrue(contact.blind)
        self.assertEqual(contact.last_seen, np.inf)

    def test_unknown_geometry(self):
        run = self._make((2.0, 2.4, 0.5))
        del run.metadata["ring_geometry"]
        (contact,) = mut.find_contacts(run)
        self.assertIsNone(contact.views[0].sensors)
        self.assertTrue(np.isnan(contact.views[0].off_beam))


class TestNeighbours(unittest.TestCase):
    AXES = np.arange(8) * np.pi / 4

    def _find(self, degrees, elevation=0.0, distance=0.5):
        return find_neighbours(
            azimuth=np.deg2rad(degrees),
            elevation=np.deg2rad(elevation),
            distance=distance,
            beam_azimuth=self.AXES,
            fov=np.deg2rad(25),
            radius=0.075,
        )

    def test_pairs(self):
        self.assertEqual(self._find(50)[0], (1, 2))
        self.assertEqual(self._find(-10)[0], (7, 0))
        self.assertEqual(self._find(350)[0], (7, 0))

    def test_on_axis(self):
        _, off_beam = self._find(90)
        self.assertAlmostEqual(off_beam, -np.deg2rad(12.5))

    def test_above(self):
        """Straight above a beam the elevation alone leaves the cone."""
        _, off_beam = self._find(90, elevation=40, distance=10)
        self.assertAlmostEqual(off_beam, np.deg2rad(27.5), delta=0.01)

    def test_behind_the_sensors(self):
        """Nearer to the axis than they sit there is no angle to a beam."""
        for distance, elevation in ((0.05, 0), (0.09, 40), (0.3, 80)):
            _, off_beam = self._find(90, elevation, distance)
            self.assertTrue(np.isnan(off_beam))
        _, off_beam = self._find(90, distance=0.076)
        self.assertAlmostEqual(off_beam, -np.deg2rad(12.5))

    @given(st.floats(-360, 360))
    def test_gap_of_eight(self, degrees):
        """Far out, gaps are 20 degrees wide: never more than 10 off."""
        _, off_beam = self._find(degrees, distance=1e6)
        self.assertLessEqual(off_beam, np.deg2rad(10) + 1e-6)
        self.assertGreaterEqual(off_beam, -np.deg2rad(12.5) - 1e-6)
