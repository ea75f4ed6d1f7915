"""What a safety engineer would ask before standing next to the robot.

What holds in whole runs is in test_whole_runs.py.
"""

from bvh_writer import write_bvh
import numpy as np
from paper_cell import RINGS, change_rings
import pytest

from tofssm_drake.messages import RingHealth, RobotState


@pytest.fixture(scope="module")
def standing(run, tmp_path_factory):
    """Runs with a person who stands still at a place."""
    recording = write_bvh(tmp_path_factory.mktemp("bvh") / "walk.bvh")

    def run_with(position, duration):
        return run(
            text=f"""
simulation_duration: {duration}
people:
  visitor: !BvhRecording
    filename: {recording}
    placement: in_place
    position: {list(position)}
    heading_deg: 180.0
    end_time: 0.2
"""
        )

    return run_with


class TestPersonWhoStays:
    def test_in_front_of_the_arm_keeps_it_stopped(self, standing):
        samples, summary = standing((0.55, -0.5), 6.0)
        assert summary["min_true_distance_m"] < 0.5
        assert (samples["robot_state"] == RobotState.STOP).all()
        assert (samples["speed_fraction"] == 0.0).all()
        assert samples["tcp_speed"].max() < 1e-6
        assert summary["products_placed"] == 0

    def test_in_the_way_of_the_sweep_is_never_reached(self, standing):
        samples, summary = standing((0.85, 0.0), 8.0)
        assert summary["contact_while_moving_events"] == 0
        assert summary["min_true_distance_m"] > 0.2
        assert summary["products_placed"] == 0
        assert samples["q_0"].max() < np.deg2rad(-20.0)


class TestBrokenSensing:
    @pytest.mark.parametrize("ring", RINGS)
    def test_a_ring_that_never_delivers(self, run, looks, ring):
        text = (
            f"{{simulation_duration: 1.0, sensors: {{{ring}: {{phase: 9.9}}}}}}"
        )
        samples, summary = run("NoHuman", text)
        assert (samples["robot_state"] == RobotState.STOP).all()
        assert (samples["speed_fraction"] == 0.0).all()
        assert (samples[f"{ring}_sequence"] == -1).all()
        others = [name for name in RINGS if name != ring]
        for other in others:
            assert samples[f"{other}_state"][-1] == RobotState.NORMAL
        last = looks("NoHuman", text)[-1]
        assert last.reason == f"stop: {ring} has no sample yet"
        assert summary["products_placed"] == 0

    def test_samples_that_come_too_late(self, run):
        samples, _ = run(
            "NoHuman",
            "{simulation_duration: 1.5, "
            + change_rings("{sensor: {readout_time: 0.3}}")
            + "}",
        )
        assert (samples[f"{RINGS[0]}_sequence"] >= 0).any()
        assert (samples["robot_state"] == RobotState.STOP).all()
        assert (samples["speed_fraction"] == 0.0).all()
        assert samples["reason"][-1].startswith("stop: base ")

    def test_another_way_to_be_blind_is_no_licence(self, run):
        """Sensors that lose every second sample never free the robot more
        than good ones do, and most of the time they stop it."""
        text = (
            "{simulation_duration: 6.0, "
            + change_rings("{sensor: {dropout: 0.5}}")
            + "}"
        )
        samples, _ = run("NoHuman", text)
        faulted = samples.ring("health") == RingHealth.FAULTED
        assert faulted.any()
        assert (samples["robot_state"][faulted.any(axis=1)] == 0).all()
