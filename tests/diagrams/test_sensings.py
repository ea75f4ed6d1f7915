"""Ideal sensing and lidar in place of the rings."""

import functools
import json

import numpy as np
from paper_cell import RINGS
import pytest
from test_connections import (
    find_connections,
    find_reached,
    get_inputs,
    get_outputs,
)

from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.scenario import (
    Scenario,
    change_scenario,
    dump_scenario,
    find_threshold_offsets,
    load_scenario,
)
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.audit import calc_audit
from tofssm_drake.metrics.metrics import calc_summary
from tofssm_drake.metrics.run_metrics import calc_run_metrics
from tofssm_drake.reports.report import make_report

JOINTS = {"position_measured", "velocity_measured"}
SEEN = {"MotionCapture": "skeleton", "PlanarLidar": "scan_lidar"}
OTHERS = tuple(SEEN)


@functools.cache
def make(sensing, human=True):
    text = f"simulation_duration: {2.4 if human else 0.6}\n"
    if not human:
        text += "people: {visitor: null}\n"
    scenario = load_scenario(name=sensing, text=text)
    return scenario, make_workcell(scenario)


@functools.cache
def run(sensing, human=True):
    scenario, workcell = make(sensing, human)
    run = Run(workcell=workcell, scenario=scenario)
    while not run.advance().finished:
        pass
    return run.make_samples()


class TestPorts:
    @pytest.mark.parametrize("sensing", OTHERS)
    def test_only_what_the_sensing_needs(self, sensing):
        _, workcell = make(sensing)
        monitor = workcell.diagram.GetSubsystemByName("monitor")
        assert set(get_inputs(monitor)) == {*JOINTS, SEEN[sensing]}
        assert set(get_outputs(monitor)) == {
            *("speed_fraction", "decision", "separation"),
        }
        scans = {
            name
            for name in get_outputs(workcell.station.diagram)
            if name.startswith("scan")
        }
        assert scans == ({"scan_lidar"} if sensing == "PlanarLidar" else set())

    @pytest.mark.parametrize("sensing", OTHERS)
    def test_no_feedthrough(self, sensing):
        _, workcell = make(sensing)
        for name in ("station", "monitor"):
            system = workcell.diagram.GetSubsystemByName(name)
            assert not system.HasAnyDirectFeedthrough()

    @pytest.mark.parametrize("sensing", OTHERS)
    def test_observers_feed_nothing_back(self, sensing):
        connections = find_connections(make(sensing)[1].diagram)
        reached = find_reached(connections, "recorder")
        assert not reached & {"station", "monitor"}
        assert {
            (source, port)
            for source, port, sink, _ in connections
            if sink == "monitor"
        } == {("station", name) for name in {*JOINTS, SEEN[sensing]}}

    def test_the_person_is_seen_by_the_lidar_alone(self):
        station = make("PlanarLidar")[1].station.diagram
        reached = find_reached(find_connections(station), "visitor")
        assert reached == {"scene_graph", "lidar"}

    def test_ideal_sensing_has_to_know_the_person(self):
        with pytest.raises(ValueError, match="person_radii"):
            make_monitor(load_scenario(name="MotionCapture"))

    def test_lidar_inside_of_the_robot(self):
        scenario = load_scenario(
            name="PlanarLidar",
            text="{sensors: {lidar: {X_PS: {translation: [0, 0, 0.9]}}}}",
        )
        with pytest.raises(UserError, match=r"sensors.lidar.X_PS: .* inside"):
            make_monitor(scenario)


class TestLaw:
    def test_lidar_s_distances_grow_by_the_workspace(self):
        scenario = load_scenario(name="PlanarLidar")
        (offset,) = find_threshold_offsets(scenario)
        law = scenario.law.grow(offset)
        assert (law.C_dC, law.d_C_sm, law.d_R_sm) == (1.12, 1.32, 1.92)

    def test_unless_its_rule_takes_it_off(self):
        for rule in ("subtracted", "literal"):
            scenario = load_scenario(
                name="PlanarLidar",
                text="{sensors: {lidar: {separation: "
                f"{{distance_rule: {rule}}}}}}}}}",
            )
            (offset,) = find_threshold_offsets(scenario)
            law = scenario.law.grow(offset)
            assert (law.C_dC, law.d_C_sm, law.d_R_sm) == (0.3, 0.5, 1.1)

    def test_the_others_have_the_law_as_it_is(self):
        for name in ("Default", "MotionCapture"):
            scenario = load_scenario(name=name)
            offsets = find_threshold_offsets(scenario)
            np.testing.assert_array_equal(offsets, np.zeros(len(RINGS)))
            assert scenario.law.grow(offsets[0]) is scenario.law


class TestScenario:
    @pytest.mark.parametrize("sensing", ["Default", *OTHERS])
    def test_dump_and_load(self, sensing):
        scenario = load_scenario(name=sensing)
        values = dump_scenario(scenario)
        text = json.dumps(values)
        assert change_scenario(Scenario(), text, source="x") == scenario

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (
                "sensors: {m: !MotionCapture {latency: -1}}",
                "sensors.m.latency: -1.0 is out of range",
            ),
            (
                "sensors: {m: !PlanarLidar {hosing: [a]}}",
                "sensors.m.hosing: unknown key; .*'housing'",
            ),
            (
                "sensors: {m: !PlanarLidar {separation: "
                "{distance_rule: subtract}}}",
                "sensors.m.separation.distance_rule: 'subtract' is unknown",
            ),
            ("audit: {V_h: -1}", "audit.V_h: -1.0 is out of range"),
        ],
    )
    def test_mistakes(self, text, message):
        with pytest.raises(UserError, match=message):
            load_scenario(text=text)


class TestRuns:
    @pytest.mark.parametrize(
        ("sensing", "links", "words"),
        [
            ("MotionCapture", RINGS, "motion capture"),
            ("PlanarLidar", ("lidar",), "planar lidar"),
        ],
    )
    def test_record(self, sensing, links, words):
        samples = run(sensing)
        assert samples.rings == links
        assert samples.scan == {}
        assert samples.metadata["sensing"] == words
        # It moves, and it sees the person and reacts.
        assert samples["speed_fraction"].max() > 0.4
        assert (samples["robot_state"][100:] != RobotState.NORMAL).any()
        row = calc_run_metrics(samples)
        assert row["detection_share"] > 0.9
        assert row["contacts_while_moving"] == 0
        assert calc_audit(samples) is not None

    def test_ideal_is_the_truth_of_the_tick_before(self):
        samples = run("MotionCapture")
        measured = samples.ring("measured_distance")
        true = samples.ring("true_distance")
        assert np.isnan(measured[0]).all()
        np.testing.assert_allclose(
            measured[1:], np.maximum(true[:-1], 0.0), atol=1e-9
        )
        # Hence the closing speed predicts the next tick.
        closing = samples.ring("closing_speed")
        fell = -np.diff(true, axis=0)[1:] / 0.008
        error = np.abs(np.clip(fell, -3.3, 3.3) - closing[2:])
        assert np.median(error) < 0.05

    def test_lidar_sees_a_leg_and_no_more(self):
        """Not nearer than the nearest point of the person, except for noise."""
        samples = run("PlanarLidar")
        measured = samples["lidar_measured_distance"]
        true = samples["lidar_true_distance"]
        seen = np.isfinite(measured)
        assert seen.mean() > 0.9
        error = measured[seen][10:] - true[seen][10:]
        # A scan is up to 0.06 s old, and the person walks at 1.2 m/s.
        assert error.min() > -0.2
        assert 0.0 < np.median(error) < 0.3
        # More rays than fit into eight bits.
        counts = sum(
            samples[f"lidar_{name}"].astype(int)
            for name in ("clear", "valid", "masked", "faulted")
        )
        assert set(counts[seen]) == {720}
        assert samples["lidar_sensor"].max() > 127

    def test_offsets_of_the_links(self):
        offsets = run("MotionCapture").metadata["link_offset_m"]
        assert offsets == pytest.approx(
            {"base": 0.075, "elbow": 0.065, "tool": 0.070}
        )
        assert run("PlanarLidar").metadata["link_offset_m"] == {"lidar": 0.82}

    @pytest.mark.parametrize("sensing", OTHERS)
    def test_report(self, sensing):
        samples = run(sensing)
        page = make_report(samples, calc_summary(samples))
        assert "Three rings" not in page
        assert "Audit against the standard" in page
        assert {
            "MotionCapture": "tool link",
            "PlanarLidar": "A lidar, which sees the person",
        }[sensing] in page

    @pytest.mark.parametrize("sensing", OTHERS)
    def test_nobody(self, sensing):
        """The robot does not take itself or its cell for a person."""
        samples = run(sensing, human=False)
        started = samples["t"] > 0.2
        assert (samples["robot_state"][started] == RobotState.NORMAL).all()
        for link in samples.rings:
            measured = samples[f"{link}_measured_distance"][started]
            assert np.isinf(measured).all()

    def test_same_scenario_same_samples(self):
        scenario, workcell = make("PlanarLidar")
        again = Run(workcell=workcell, scenario=scenario)
        for _ in range(5):
            again.advance()
        part = again.make_samples()
        whole = run("PlanarLidar")
        for name, values in part.column.items():
            if values.dtype != object:
                np.testing.assert_array_equal(
                    values, whole[name][: len(part)], name
                )
