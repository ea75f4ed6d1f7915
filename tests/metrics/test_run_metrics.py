import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from synthetic_run import PERIOD, RINGS, make_rich_run, make_run, make_steps

import tofssm_drake.metrics.run_metrics as mut


def set_state(run, *pairs):
    state = make_steps(run["t"], *pairs).astype(np.int8)
    run.column["robot_state"] = state
    for ring in RINGS:
        run.column[f"{ring}_state"] = state.copy()


class TestWorkedNumbers:
    def test_safety_metric(self):
        mean, ratio, median = mut.calc_safety_metric(
            np.array([1.0, 0.8, 0.6, 0.5, 0.5]),
            np.array([1.7, 1.7, 0.85, 0.2, 0.0]),
        )
        assert mean == pytest.approx(0.659559, abs=5e-7)
        assert ratio == pytest.approx(0.561798, abs=5e-7)
        assert median == pytest.approx(0.505882, abs=5e-7)

    def test_productivity(self):
        assert mut.calc_productivity(60.0, 78.5) == pytest.approx(
            0.764331, abs=5e-7
        )
        assert math.isnan(mut.calc_productivity(0.0, 0.0))

    def test_no_safety_metric_without_person_or_motion(self):
        for distance, speed in ((np.inf, 1.0), (0.5, 0.0)):
            assert np.isnan(
                mut.calc_safety_metric(np.full(3, distance), np.full(3, speed))
            ).all()

    def test_touching_counts_as_no_distance(self):
        metric = mut.calc_safety_metric(
            np.array([-0.1, 1.0]), np.array([1.0, 1.0])
        )
        assert metric == (0.5, 0.5, 0.5)


class TestProductivity:
    def test_of_a_finished_run(self):
        """Half speed for 2 s of 8 s: 7 s of path time."""
        run = make_run(10.0)
        run.metadata["products"] = 3
        run.column["speed_fraction"] = make_steps(
            run["t"], (0, 1.0), (3.0, 0.5), (5.0, 1.0)
        )
        run.column["products_placed"] = make_steps(
            run["t"], (0, 0), (8.0, 3)
        ).astype(np.int16)
        row = mut.calc_run_metrics(run)
        assert row["finished"] == 1.0
        assert row["task_time_s"] == pytest.approx(8.0)
        assert row["nominal_time_s"] == pytest.approx(7.0)
        assert row["productivity"] == pytest.approx(7.0 / 8.0)

    def test_of_a_run_that_did_not_finish(self):
        run = make_run(10.0)
        run.column["speed_fraction"][run["t"] >= 5.0 - 1e-9] = 0.0
        row = mut.calc_run_metrics(run)
        assert row["finished"] == 0.0
        assert math.isnan(row["task_time_s"])
        assert row["productivity"] == pytest.approx(0.5)


class TestLawDistances:
    """What the law itself asked for, from hand-made columns."""

    def test_stop_due_and_asked(self):
        run = make_run(10.0)
        t = run["t"]
        run["robot_state"][:] = make_steps(
            t, (0, 0), (0.04, 2), (2.0, 1), (3.0, 0), (5.0, 2)
        )
        run["base_state"][:] = run["robot_state"]
        run["base_d_R"][:] = 0.9
        run["base_d_C"][:] = np.where(t < 4.0, 0.6, 0.7)
        run["base_true_distance"][:] = np.where(t < 7.5 - 1e-9, 0.7, 0.5)
        row = mut.calc_run_metrics(run)
        assert row["d_C_at_stop_m"] == pytest.approx(0.6)
        assert row["d_R_at_reduce_m"] == pytest.approx(0.9)
        running = 10.0 - 0.04
        assert row["stopped_share"] == pytest.approx(2.0 / running, abs=1e-3)
        # Due is what is at or under d_C: from 4 s on.
        assert row["stop_due_share"] == pytest.approx(6.0 / running, abs=2e-3)


class TestReactions:
    """Hand-made logs whose events are known."""

    def find(self, distance, state, duration=20.0):
        t = np.arange(round(duration / PERIOD)) * PERIOD
        return mut.find_reactions(
            t=t,
            robot_state=make_steps(t, *state),
            true_distance=make_steps(t, *distance),
        )

    def test_late(self):
        dut = self.find(
            [(0, 2.0), (4.0, 0.5), (6.0, 2.0)],
            [(0, 0), (0.04, 2), (4.2, 0), (7.0, 2)],
        )
        assert dut.times == pytest.approx((0.2,), abs=1e-9)
        assert (dut.approaches, dut.missed, dut.false) == (1, 0, 0)

    def test_early(self):
        dut = self.find(
            [(0, 2.0), (4.0, 0.4), (6.0, 2.0)],
            [(0, 0), (0.04, 2), (3.0, 1), (3.2, 0), (7.0, 2)],
        )
        assert dut.times == pytest.approx((-0.8,), abs=1e-9)
        assert (dut.approaches, dut.missed, dut.false) == (1, 0, 0)

    def test_missed(self):
        dut = self.find(
            [(0, 2.0), (4.0, 0.4), (6.0, 2.0)],
            [(0, 0), (0.04, 2), (4.0, 1), (5.0, 2)],
        )
        assert dut.times == ()
        assert (dut.approaches, dut.missed, dut.false) == (1, 1, 0)

    def test_false(self):
        dut = self.find([(0, 0.51)], [(0, 0), (0.04, 2), (4.0, 0), (5.0, 2)])
        assert dut.times == ()
        assert (dut.approaches, dut.missed, dut.false) == (0, 0, 1)

    def test_one_of_each(self):
        dut = self.find(
            [
                *((0, 2.0), (2.0, 0.5), (4.0, 2.0)),  # late by 0.1
                *((6.0, 0.3), (8.0, 2.0)),  # anticipated by 0.4
                *((10.0, 0.3), (12.0, 2.0)),  # missed
            ],
            [
                *((0, 0), (0.04, 2), (2.1, 0), (4.0, 2)),
                *((5.6, 0), (8.0, 1), (8.2, 2)),
                *((14.0, 0), (15.0, 2)),  # false
            ],
        )
        assert dut.times == pytest.approx((0.1, -0.4), abs=0.009)
        assert (dut.approaches, dut.missed, dut.false) == (3, 1, 1)

    def test_chatter_is_one_stop_and_one_approach(self):
        dut = self.find(
            [(0, 2.0), (4.0, 0.5), (4.1, 0.52), (4.5, 0.4), (6.0, 2.0)],
            [(0, 0), (0.04, 2), (3.9, 0), (4.0, 1), (4.3, 0), (6.0, 2)],
        )
        assert dut.times == pytest.approx((-0.1,), abs=0.009)
        assert (dut.approaches, dut.missed, dut.false) == (1, 0, 0)

    def test_a_stop_that_lasts_over_two_approaches_counts_once(self):
        dut = self.find(
            [(0, 2.0), (4.0, 0.5), (5.0, 1.0), (6.0, 0.4), (7.0, 2.0)],
            [(0, 0), (0.04, 2), (4.1, 0), (8.0, 2)],
        )
        assert dut.times == pytest.approx((0.1,), abs=0.009)
        assert (dut.approaches, dut.missed, dut.false) == (2, 0, 0)

    def test_a_stop_shortly_after_a_brush_belongs_to_it(self):
        dut = self.find(
            [(0, 2.0), (4.0, 0.45), (4.1, 2.0)],
            [(0, 0), (0.04, 2), (4.3, 0), (5.0, 2)],
        )
        assert dut.times == pytest.approx((0.3,), abs=0.009)
        assert (dut.approaches, dut.missed, dut.false) == (1, 0, 0)

    def test_what_was_there_at_the_start_has_no_reaction(self):
        for state in (
            [(0, 0), (1.0, 2), (3.0, 0), (4.0, 2)],
            [(0, 2), (0.2, 0), (4.0, 2)],
        ):
            dut = self.find([(0, 0.4), (3.5, 2.0)], state)
            assert dut.times == ()
            assert (dut.approaches, dut.missed, dut.false) == (0, 0, 0)

    def test_never_started(self):
        dut = self.find([(0, 2.0), (4.0, 0.4)], [(0, 0)])
        assert (dut.times, dut.missed, dut.false) == ((), 0, 0)

    @given(
        st.lists(st.integers(0, 2), min_size=1, max_size=40),
        st.lists(st.floats(0.0, 1.0), min_size=40, max_size=40),
    )
    def test_everything_is_counted_once(self, states, distances):
        k = len(states)
        dut = mut.find_reactions(
            t=0.4 * np.arange(k),
            robot_state=np.array(states),
            true_distance=np.array(distances[:k]),
        )
        assert len(dut.times) + dut.missed <= dut.approaches
        assert dut.false >= 0


class TestEvents:
    def make(self):
        run = make_run(10.0)
        set_state(
            run,
            *((0, 0), (0.04, 2)),
            *((2.0, 1), (3.0, 0), (5.0, 2)),
            *((7.0, 0), (7.1, 2)),  # too short to come to rest
        )
        t = run["t"]
        run.column["speed_fraction"] = np.interp(
            t,
            [0, 2.0, 2.24, 3.0, 3.2, 5.0, 5.4, 7.0, 7.104, 7.2],
            [1, 1, 0.5, 0.5, 0.0, 0.0, 1.0, 1.0, 0.7, 1.0],
        )
        run.column["tcp_speed"] = 1.5 * run["speed_fraction"]
        run.column["true_distance"] = make_steps(
            t, (0, 3.0), (2.0, 0.8), (3.0, 0.5), (5.0, 3.0), (7.0, 0.7)
        )
        return run

    def test_means(self):
        row = mut.calc_run_metrics(self.make())
        assert row["stop_events"] == 2
        assert row["reduce_events"] == 1
        assert row["velocity_change_at_stop_mps"] == pytest.approx(
            (0.75 + 1.5) / 2
        )
        assert row["separation_at_stop_m"] == pytest.approx((0.5 + 0.7) / 2)
        assert row["separation_at_reduce_m"] == pytest.approx(0.8)
        # 0.5 to 0 in 0.2 s: below 0.01 after 0.196 s, at the tick of 0.2 s.
        assert row["time_to_stop_s"] == pytest.approx(0.2)
        assert row["time_to_reduce_s"] == pytest.approx(0.24)
        # The second stop ends before the robot stands.
        assert row["time_to_stop_events"] == 1
        assert row["stop_there_already_events"] == 0
        assert row["time_to_reduce_events"] == 1
        assert row["state_changes"] == 5
        assert row["state_changes_per_min"] == pytest.approx(5 / 9.96 * 60)
        assert row["slow_episodes"] == 2
        assert row["state_changes_per_episode"] == 2.5
        assert row["stopped_s"] == pytest.approx(2.1, abs=0.009)

    def test_what_stands_already_has_no_time_to_stop(self):
        run = self.make()
        run["speed_fraction"][:] = 0.005
        row = mut.calc_run_metrics(run)
        assert math.isnan(row["time_to_stop_s"])
        assert math.isnan(row["time_to_reduce_s"])
        assert row["time_to_stop_events"] == 0
        assert row["stop_there_already_events"] == 2
        assert row["reduce_there_already_events"] == 1

    def test_stops_that_begin_alike(self):
        """A stop from full speed counts, but not among those from half."""
        run = self.make()
        t = run["t"]
        run.column["speed_fraction"] = np.interp(
            t,
            [0, 2.0, 2.24, 3.0, 3.2, 5.0, 5.4, 7.0, 7.08, 7.2],
            [1, 1, 0.5, 0.5, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0],
        )
        row = mut.calc_run_metrics(run)
        assert row["time_to_stop_events"] == 2
        assert row["time_to_stop_s"] == pytest.approx(0.14)
        assert row["time_to_stop_alike_events"] == 1
        assert row["time_to_stop_alike_s"] == pytest.approx(0.2)
        assert row["time_to_reduce_alike_events"] == 1
        assert row["time_to_reduce_alike_s"] == pytest.approx(0.24)

    def test_no_events(self):
        row = mut.calc_run_metrics(make_run(5.0))
        assert row["stop_events"] == 0
        for name in (
            *("velocity_change_at_stop_mps", "separation_at_stop_m"),
            *("time_to_stop_s", "reaction_time_s", "min_true_distance_m"),
            *("distance_rmse_centre_m", "safety_mean_m2_per_mps"),
        ):
            assert math.isnan(row[name]), name


class TestDistanceErrors:
    def test_centre_and_surface(self):
        """The nearest link counts; beyond 1.31 m nothing does."""
        run = make_run(4.0)
        run.metadata["link_offset_m"] = {"base": 0.08, "tool": 0.05}
        run.column["true_distance"] = make_steps(
            run["t"], (0, 0.6), (1.0, 0.9), (2.0, 1.2), (3.0, 1.4)
        )
        run.column["base_measured_distance"] = make_steps(
            run["t"], (0, 0.68), (1.0, np.inf), (3.0, 0.2)
        )
        run.column["tool_measured_distance"] = make_steps(
            run["t"], (0, np.nan), (1.0, 0.8), (2.0, np.inf)
        )
        run["base_true_distance"][:] = 0.66
        row = mut.calc_run_metrics(run)
        assert row["distance_rmse_link_m"] == pytest.approx(
            math.sqrt((0.02**2 + 0.14**2) / 2)
        )
        assert row["distance_rmse_centre_m"] == pytest.approx(
            math.sqrt((0.08**2 + 0.1**2) / 2)
        )
        assert row["distance_rmse_surface_m"] == pytest.approx(
            math.sqrt((0.0**2 + 0.15**2) / 2)
        )
        assert row["detection_share"] == pytest.approx(2 / 3)


class TestRow:
    def test_is_flat_and_the_same_for_all_runs(self):
        rows = [
            mut.calc_run_metrics(run)
            for run in (make_run(0.0), make_run(2.0), make_rich_run(10.0))
        ]
        for row in rows:
            assert list(row) == list(rows[0])
            assert all(type(value) is float for value in row.values())
        assert rows[2]["contacts_while_moving"] >= 0
