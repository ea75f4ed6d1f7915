"""Every shipped scenario runs, and does what its comment says."""

import numpy as np
from paper_cell import RINGS
import pytest

from tofssm_drake.diagrams.scenario import list_scenarios


@pytest.mark.parametrize("name", list_scenarios())
def test_scenario_runs(run, name):
    samples, summary = run(name, "{simulation_duration: 10.0}")
    assert summary["simulated_s"] == pytest.approx(10.0, abs=0.02)
    assert np.isfinite(samples["tcp_speed"]).all()
    assert summary["max_tcp_speed_mps"] < 1.75


@pytest.mark.parametrize("ssm", ["vo", "vr", "sm"])
class TestThePapersCell:
    def text(self, ssm):
        return f"{{law: {{configuration: {ssm}}}}}"

    def test_ten_products_are_placed(self, run, ssm):
        _, summary = run(text=self.text(ssm))
        assert summary["products_placed"] == 10
        assert summary["task_time_s"] is not None

    def test_it_stops_and_recovers(self, run, ssm):
        samples, summary = run(text=self.text(ssm))
        assert summary["stop_events"] >= 3
        assert summary["reduce_events"] >= 3
        rho = samples["speed_fraction"]
        # Times at rest that are followed by a stretch at full speed.
        rest = np.flatnonzero(np.diff((rho < 0.01).astype(int)) == -1)
        full = [
            rho[start:end].max() == 1.0
            for start, end in zip(rest, [*rest[1:], len(rho)], strict=True)
        ]
        assert sum(full) >= 5

    def test_nothing_that_moves_touches_the_person(self, run, ssm):
        _, summary = run(text=self.text(ssm))
        if ssm == "sm":
            # Fixed distances are too short for a person who walks in (see
            # docs/safety_law.md): not hidden, but reported with the cause.
            assert summary["contact_while_moving_max_mps"] < 0.4
            for contact in summary["contacts"]:
                assert contact["cause"] in ("short", "gap", "late")
        else:
            assert summary["contact_while_moving_events"] == 0

    def test_the_person_is_really_in_the_way(self, run, ssm):
        _, summary = run(text=self.text(ssm))
        assert summary["min_true_distance_m"] < 0.3

    def test_the_rings_measure_the_person(self, run, ssm):
        _, summary = run(text=self.text(ssm))
        assert 0.01 < summary["distance_rmse_m"] < 0.2
        for ring in RINGS:
            assert summary["detection_share_by_ring"][ring] > 0.1
            assert summary["ghost_s_by_ring"][ring] < 1.0

    def test_speed_reaches_the_papers(self, run, ssm):
        _, summary = run(text=self.text(ssm))
        assert summary["max_tcp_speed_mps"] == pytest.approx(1.7, abs=0.01)


def test_without_a_person_nothing_stops_the_robot(run):
    samples, alone = run("NoHuman")
    assert alone["stop_events"] == 0
    assert alone["reduce_events"] == 0
    assert alone["products_placed"] == 10
    assert alone["contact_while_moving_events"] == 0
    assert alone["min_true_distance_m"] is None
    # The rings do see robot and cell all the time.
    assert all((samples[f"{ring}_masked"] > 0).any() for ring in RINGS)
    for ssm in ("vo", "vr", "sm"):
        _, summary = run(text=f"{{law: {{configuration: {ssm}}}}}")
        assert alone["task_time_s"] < summary["task_time_s"]


@pytest.mark.parametrize("ssm", ["vo", "vr", "sm"])
def test_without_the_mask_the_robot_stops_at_itself(run, ssm):
    _, summary = run("NoMask", f"{{law: {{configuration: {ssm}}}}}")
    assert summary["stop_events"] > 0
    assert summary["stopped_s"] > 1.0


def test_sixteen_sensors_see_more(run):
    _, eight = run()
    _, sixteen = run("SixteenSensors")
    assert sixteen["products_placed"] == 10
    assert sixteen["contact_while_moving_events"] == 0
    # The two robots do not move alike, so a single ring may see 1 % less.
    for ring in RINGS:
        assert (
            sixteen["detection_share_by_ring"][ring]
            > eight["detection_share_by_ring"][ring] - 0.01
        )
    assert sum(sixteen["detection_share_by_ring"].values()) > sum(
        eight["detection_share_by_ring"].values()
    )
