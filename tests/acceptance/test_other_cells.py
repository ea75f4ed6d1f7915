"""Cells that are not the paper's: other sensors, people, things that move."""

import functools

import numpy as np
import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.metrics import calc_summary
from tofssm_drake.reports.report import make_report

# A fourth ring of six tilted sensors, a lidar and motion capture besides.
MIXTURE = """
sensors:
  wrist: !Ring
    parent: ur10::wrist_1_link
    radius: 0.08
    count: 6
    tilt_deg: 20.0
  low: !PlanarLidar
    housing: [pedestal]
    separation: {distance_rule: subtracted}
  mocap: !MotionCapture
    links: {hand: {parent: "ur10::tool0"}}
"""
PEOPLE = """
people:
  visitor: !GeneratedWalk {figure_eight: {start: 0.0}}
  worker: !GeneratedWalk {figure_eight: {start: 0.5, centre: [-1.3, 0.3]}}
"""

# Until the robot has begun to move, s.
SHORT = 0.4


@functools.cache
def run(text, duration=4.0):
    scenario = load_scenario(text=f"simulation_duration: {duration}\n{text}")
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    while not run.advance().finished:
        pass
    return run.make_samples()


def test_sensors_of_all_kinds_at_once():
    samples = run(MIXTURE)
    assert samples.rings == ("base", "elbow", "tool", "wrist", "low", "hand")
    assert {n: s["distance"].shape[1] for n, s in samples.scan.items()} == {
        "base": 8,
        "elbow": 8,
        "tool": 8,
        "wrist": 6,
    }
    # The law takes the worst of all links.
    np.testing.assert_array_equal(
        samples["robot_state"], samples.ring("state").min(axis=1)
    )
    true = samples["hand_true_distance"]
    measured = samples["hand_measured_distance"]
    np.testing.assert_allclose(measured[5:], true[4:-1], atol=1e-9)
    page = make_report(samples, calc_summary(samples))
    assert "Sensors of several kinds" in page


def test_a_fourth_ring_changes_nothing_for_the_others():
    """Alike sensors with noise of their own streams see the same cell."""
    plain = run("random_seed: 0", SHORT)
    more = run(
        "sensors: {wrist: !Ring {parent: ur10::wrist_1_link, radius: 0.08, "
        "count: 6}}",
        SHORT,
    )
    # Nothing moves before the first samples, so the distances agree.
    first = plain["t"] < 0.1
    for ring in ("base", "elbow", "tool"):
        np.testing.assert_allclose(
            more[f"{ring}_true_distance"][first],
            plain[f"{ring}_true_distance"][first],
            atol=1e-6,
        )


def test_the_nearest_of_two_people_counts():
    both = run(PEOPLE, SHORT)
    alone = [
        run(f"people: {{{name}: {person}, {other}: null}}", SHORT)
        for name, person, other in (
            (
                "visitor",
                "!GeneratedWalk {figure_eight: {start: 0.0}}",
                "nobody",
            ),
            (
                "worker",
                "!GeneratedWalk {figure_eight: {start: 0.5, "
                "centre: [-1.3, 0.3]}}",
                "visitor",
            ),
        )
    ]
    # As long as the robot stands, only the people move.
    n = 10
    np.testing.assert_allclose(
        both["true_distance"][:n],
        np.minimum(*(samples["true_distance"][:n] for samples in alone)),
        atol=1e-9,
    )
    nearest = np.argmin([samples["true_distance"][:n] for samples in alone], 0)
    for i in range(n):
        for axis in ("person_x", "person_y"):
            assert both[axis][i] == pytest.approx(
                alone[nearest[i]][axis][i], abs=1e-9
            )
    parts = both.metadata["person_parts"]
    assert parts[0].startswith("visitor's")
    assert parts[-1].startswith("worker's")


def test_a_cart_in_the_way_stops_the_robot_and_is_no_person():
    text = "people: {visitor: null}\n"
    free = run(text)
    blocked = run(
        text + "obstacles: {cart: {waypoints: [[0.8, 0.0]], size: "
        "[0.4, 0.4, 1.4]}}"
    )
    assert free["robot_state"][-1] == RobotState.NORMAL
    assert blocked["robot_state"][-1] == RobotState.STOP
    assert np.isinf(blocked["true_distance"]).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "task: {pick_center: [0.0, -0.82, 0.78]}",
            r"task.pick_center: product \d would float 0.05. m above",
        ),
        (
            "task: {place_center: [0.0, 0.82, 0.72]}",
            r"task.place_center: product \d would reach 0.01. m into",
        ),
        (
            "sensors: {a: !Ring {parent: knee}}",
            "sensors.a.parent: the robot has no frame 'knee'",
        ),
        (
            "sensors: {a: !PlanarLidar {parent: 'ur10::tool0'}}",
            "sensors.a.parent: 'ur10::tool0' moves; the lidar must stand",
        ),
        (
            "sensors: {a: !PlanarLidar {X_PS: {rpy_deg: [10.0, 0.0, 0.0]}}}",
            "sensors.a.X_PS: the scanner's plane must be level",
        ),
    ],
)
def test_what_does_not_fit_the_cell(text, message):
    with pytest.raises(UserError, match=message):
        make_workcell(load_scenario(text=text))


@pytest.mark.parametrize("parent", ["world", "pedestal"])
def test_a_ring_may_stand_in_the_cell(parent):
    """On a frame with a shape and on one without."""
    samples = run(
        f"sensors: {{post: !Ring {{parent: {parent}, "
        "X_PL: {translation: [0.9, 0.0, 1.0]}}}",
        duration=1.0,
    )
    assert np.isfinite(samples["post_true_distance"]).all()
    assert (samples["post_valid"] > 0).any()
