"""The paper's cell from the first tick to the tenth product.

`make test` looks at the beginning of one run, `make test-long` at whole ones.
"""

import itertools

import numpy as np
from paper_cell import RINGS
import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.messages import RingHealth, RobotState

TICK = 0.008

CONFIGURATIONS = ("vo", "vr", "sm")


def make_text(configuration, end=300.0):
    return (
        f"{{simulation_duration: {end}, "
        f"law: {{configuration: {configuration}}}}}"
    )


def calc_time_in(is_in):
    """Returns for how long a condition has held at each row, s.

    A row's speed fraction is the answer to the state of the same row: both are
    from the tick before.
    """
    held = np.zeros(len(is_in))
    for i in range(1, len(is_in)):
        held[i] = held[i - 1] + TICK if is_in[i] else 0.0
    return held


def calc_deviation(q, s, q_nominal, s_nominal, *, window=12):
    """Largest joint distance to a path given as points, row by row, rad.

    Args:
        q: (n, 6) measured joints.
        s: (n,) path time at which they should have been reached, s.
        q_nominal: (k, 6) points of the path, joined by straight lines.
        s_nominal: (k,) path times of these points, s.
        window: number of pieces to each side in which to look for the nearest.
    """
    middle = np.searchsorted(s_nominal, s)
    nearest = np.full(len(q), np.inf)
    for offset in range(-window, window):
        i = np.clip(middle + offset, 0, len(q_nominal) - 2)
        a, b = q_nominal[i], q_nominal[i + 1]
        ab = b - a
        length = np.maximum((ab**2).sum(axis=1), 1e-18)
        part = np.clip(((q - a) * ab).sum(axis=1) / length, 0.0, 1.0)
        away = np.abs(q - a - part[:, None] * ab).max(axis=1)
        nearest = np.minimum(nearest, away)
    return nearest


def get_joints(samples):
    return np.stack([samples[f"q_{i}"] for i in range(6)], axis=1)


def get_joint_speeds(samples):
    return np.stack([samples[f"qd_{i}"] for i in range(6)], axis=1)


@pytest.fixture(
    params=[
        pytest.param((name, end), id=f"{name}-{what}", marks=marks)
        for end, what, names, marks in (
            (24.0, "beginning", CONFIGURATIONS[:1], ()),
            (300.0, "whole", CONFIGURATIONS, pytest.mark.long),
        )
        for name in names
    ]
)
def case(request):
    """Configuration of the law, and when the run ends at the latest, s."""
    return request.param


@pytest.fixture
def samples(run, case):
    """Of the default scenario."""
    name, end = case
    return run(text=make_text(name, end))[0]


class TestSafety:
    def test_nothing_moves_before_every_ring_has_measured(self, samples):
        waits = (samples.ring("sequence") < 0).any(axis=1)
        assert waits[0]
        assert not waits[-1]
        assert (samples["robot_state"][waits] == RobotState.STOP).all()
        assert (samples["speed_fraction"][waits] == 0.0).all()
        assert np.abs(get_joint_speeds(samples)[waits]).max() < 1e-6
        # Measured distances are then unknown, rather than clear.
        for ring in RINGS:
            unknown = np.isnan(samples[f"{ring}_measured_distance"])
            np.testing.assert_array_equal(
                unknown, samples[f"{ring}_sequence"] < 0
            )

    def test_speed_obeys_the_state(self, samples):
        rho = samples["speed_fraction"]
        psi = samples["robot_state"]
        assert rho.min() == 0.0
        assert rho.max() == 1.0
        stopped = calc_time_in(psi == RobotState.STOP)
        slow = calc_time_in(psi <= RobotState.REDUCED)
        assert (stopped >= 0.45).any()
        assert (slow >= 0.3).any()
        assert (rho[stopped >= 0.45] == 0.0).all()
        assert (rho[slow >= 0.3] <= 0.5 + 1e-9).all()

    def test_it_never_speeds_up_while_it_should_slow_down(self, samples):
        rho = samples["speed_fraction"]
        psi = samples["robot_state"][1:]
        rise = np.diff(rho)
        assert rise[psi == RobotState.STOP].max() <= 1e-9
        fast = (psi == RobotState.REDUCED) & (rho[:-1] >= 0.5)
        assert rise[fast].max() <= 1e-9

    def test_the_arm_stands_when_the_speed_fraction_is_0(self, samples):
        standing = calc_time_in(samples["speed_fraction"] == 0.0)
        speed = samples["tcp_speed"][standing >= 0.2]
        assert len(speed) > 100
        assert speed.max() < 0.01
        joint_speed = get_joint_speeds(samples)[standing >= 0.2]
        assert np.abs(joint_speed).max() < 0.01

    def test_braking_takes_no_longer_than_the_law_assumes(self, samples):
        """T_stop is 0.4 s; the command takes two ticks."""
        psi = samples["robot_state"]
        starts = np.flatnonzero((psi[:-1] != 0) & (psi[1:] == 0)) + 1
        speed = samples["tcp_speed"]
        checked = 0
        for start in starts:
            end = start + round(0.416 / TICK)
            if end < len(psi) and (psi[start:end] == 0).all():
                assert speed[end] < 0.02 + 0.03 * speed[start]
                way = speed[start:end].sum() * TICK
                # T_stop / 2 at the speed then; it may speed up on its path.
                assert way < 1.7 * 0.2 + 0.03
                checked += 1
        assert checked >= 3

    def test_critical_index_stops_in_the_same_row(self, samples):
        critical_rows = 0
        for ring in RINGS:
            critical = (
                (samples[f"{ring}_sequence"] >= 0)
                & (samples[f"{ring}_health"] == RingHealth.HEALTHY)
                & (samples[f"{ring}_dsi_raw"] >= samples[f"{ring}_dsi_C"])
            )
            critical_rows += critical.sum()
            assert (samples[f"{ring}_state"][critical] == 0).all()
            assert (samples["robot_state"][critical] == 0).all()
        assert critical_rows > 100

    def test_measured_inside_the_critical_distance_stops(self, samples):
        """The same in metres."""
        for ring in RINGS:
            inside = (
                samples[f"{ring}_measured_distance"]
                < samples[f"{ring}_d_C"] - 1e-9
            ) & (samples[f"{ring}_sequence"] >= 0)
            assert (samples["robot_state"][inside] == 0).all()

    def test_the_lowest_ring_decides(self, samples):
        np.testing.assert_array_equal(
            samples["robot_state"], samples.ring("state").min(axis=1)
        )

    def test_a_ring_that_is_not_healthy_is_never_normal(self, samples):
        health = samples.ring("health")
        state = samples.ring("state")
        assert (state[health == RingHealth.BLIND] <= 1).all()
        assert (state[health == RingHealth.FAULTED] == 0).all()

    def test_thresholds_are_safe(self, samples):
        for ring in RINGS:
            measured = samples[f"{ring}_sequence"] >= 0
            d_C = samples[f"{ring}_d_C"][measured]
            d_R = samples[f"{ring}_d_R"][measured]
            assert (d_C >= 0.3 - 1e-9).all()
            assert (d_R >= d_C - 1e-9).all()

    def test_samples_are_fresh(self, samples):
        """No row relies on a sample older than the law's reaction time."""
        for ring in RINGS:
            measured = samples[f"{ring}_sequence"] >= 0
            age = (samples["t"] - samples[f"{ring}_sample_time"])[measured]
            assert age.min() > 0.0
            assert age.max() <= 0.1

    def test_every_stop_has_a_reason_that_names_a_ring(self, samples):
        reason = samples["reason"]
        for state, word in ((0, "stop"), (1, "reduced"), (2, "normal")):
            words = set(reason[samples["robot_state"] == state])
            assert words
            for text in words:
                assert text.startswith(word)
                assert state == 2 or any(ring in text for ring in RINGS)

    def test_limits_of_the_joints(self, samples):
        """Datasheet: 120 deg/s for base and shoulder, 180 deg/s others."""
        speed = np.abs(get_joint_speeds(samples)).max(axis=0)
        limit = np.deg2rad([120, 120, 180, 180, 180, 180])
        assert (speed <= 1.01 * limit).all()
        assert (np.abs(get_joints(samples)) <= 2 * np.pi).all()

    def test_path_is_that_without_a_person(self, run, case, samples):
        nominal, _ = run("NoHuman", f"{{simulation_duration: {case[1]}}}")

        def calc_path_time(of):
            return np.cumsum(of["speed_fraction"]) * TICK

        deviation = calc_deviation(
            get_joints(samples),
            calc_path_time(samples),
            get_joints(nominal),
            calc_path_time(nominal),
        )
        # It did stand and slow down on the way.
        rho = samples["speed_fraction"].mean()
        assert nominal["speed_fraction"].mean() > 1.1 * rho
        assert deviation.max() < 0.003
        # The measure detects points off the path.
        off = get_joints(samples) + np.array([0, 0.02, 0, 0, 0, 0])
        assert (
            calc_deviation(
                off,
                calc_path_time(samples),
                get_joints(nominal),
                calc_path_time(nominal),
            ).max()
            > 0.01
        )


@pytest.mark.long
class TestProducts:
    def test_they_move_with_the_tool(self, looks):
        seen = looks("NoHuman")
        carried = {}
        for look in seen:
            for i, X_WP in enumerate(look.X_WP):
                if i in look.carried:
                    X_GP = look.X_WG.inverse() @ X_WP
                    carried.setdefault(i, []).append((X_GP, X_WP))
        assert sorted(carried) == list(range(10))
        for poses in carried.values():
            first, _ = poses[0]
            assert len(poses) >= 5
            for X_GP, _ in poses:
                assert X_GP.IsNearlyEqualTo(first, 1e-9)
            p = np.array([X_WP.translation() for _, X_WP in poses])
            assert np.ptp(p[:, 1]) > 1.0
        # All are in the gripper in the same way.
        first = carried[0][0][0]
        for poses in carried.values():
            assert poses[0][0].IsNearlyEqualTo(first, 1e-9)

    def test_the_others_rest(self, looks):
        seen = looks("NoHuman")
        for before, after in itertools.pairwise(seen):
            for i, (X, Y) in enumerate(
                zip(before.X_WP, after.X_WP, strict=True)
            ):
                if i < before.placed or i > after.placed:
                    assert X.IsExactlyEqualTo(Y)

    def test_nothing_jumps_when_the_gripper_closes_or_opens(self, looks):
        seen = looks("NoHuman")
        p = np.array([[X.translation() for X in look.X_WP] for look in seen])
        # 0.2 s at 1.7 m/s, and the tool's path up and down.
        assert np.linalg.norm(np.diff(p, axis=0), axis=2).max() < 0.4

    def test_ten_lie_in_the_box_at_the_end(self, run, looks):
        samples, _ = run("NoHuman")
        last = looks("NoHuman")[-1]
        assert last.placed == 10
        assert samples["products_placed"][-1] == 10
        assert not last.carried
        (box,) = (
            part["outline"]
            for part in samples.metadata["plan"]["outlines"]
            if part["label"] == "box"
        )
        low, high = np.min(box, axis=0), np.max(box, axis=0)
        p = np.array([X.translation() for X in last.X_WP])
        assert (p[:, :2] > low).all()
        assert (p[:, :2] < high).all()
        # Each has its own place.
        gap = np.linalg.norm(p[:, None] - p[None], axis=2)
        assert gap[~np.eye(10, dtype=bool)].min() > 0.05
        # None was there at the beginning.
        p = np.array([X.translation() for X in looks("NoHuman")[0].X_WP])
        assert (p[:, 1] < low[1]).all()

    @pytest.mark.parametrize("ssm", CONFIGURATIONS)
    def test_they_are_counted_one_by_one(self, run, ssm):
        samples, _ = run(text=make_text(ssm))
        steps = np.diff(samples["products_placed"])
        assert set(steps) == {0, 1}
        assert steps.sum() == 10


@pytest.mark.long
@pytest.mark.parametrize("ssm", CONFIGURATIONS)
class TestThePapersCell:
    def test_ten_products_are_placed(self, run, ssm):
        _, summary = run(text=make_text(ssm))
        assert summary["products_placed"] == 10
        assert summary["task_time_s"] is not None

    def test_it_stops_and_recovers(self, run, ssm):
        samples, summary = run(text=make_text(ssm))
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
        _, summary = run(text=make_text(ssm))
        if ssm == "sm":
            # Fixed distances are too short for a person who walks in (see
            # docs/safety_law.md): not hidden, but reported with the cause.
            assert summary["contact_while_moving_max_mps"] < 0.4
            for contact in summary["contacts"]:
                assert contact["cause"] in ("short", "gap", "late")
        else:
            assert summary["contact_while_moving_events"] == 0

    def test_the_person_is_really_in_the_way(self, run, ssm):
        _, summary = run(text=make_text(ssm))
        assert summary["min_true_distance_m"] < 0.3

    def test_the_rings_measure_the_person(self, run, ssm):
        _, summary = run(text=make_text(ssm))
        assert 0.01 < summary["distance_rmse_m"] < 0.2
        for ring in RINGS:
            assert summary["detection_share_by_ring"][ring] > 0.1
            assert summary["ghost_s_by_ring"][ring] < 1.0

    def test_speed_reaches_the_papers(self, run, ssm):
        _, summary = run(text=make_text(ssm))
        assert summary["max_tcp_speed_mps"] == pytest.approx(1.7, abs=0.01)


@pytest.mark.long
def test_without_a_person_nothing_stops_the_robot(run):
    samples, alone = run("NoHuman")
    assert alone["stop_events"] == 0
    assert alone["reduce_events"] == 0
    assert alone["products_placed"] == 10
    assert alone["contact_while_moving_events"] == 0
    assert alone["min_true_distance_m"] is None
    # The rings do see robot and cell all the time.
    assert all((samples[f"{ring}_masked"] > 0).any() for ring in RINGS)
    for ssm in CONFIGURATIONS:
        _, summary = run(text=make_text(ssm))
        assert alone["task_time_s"] < summary["task_time_s"]


@pytest.mark.long
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


def test_the_same_law_in_every_run():
    """The runs above differ only in the configuration."""
    for name in CONFIGURATIONS:
        scenario = load_scenario(text=f"{{law: {{configuration: {name}}}}}")
        scenario.law.configuration = "vo"
        assert scenario == load_scenario()
