"""No failure of a sensor releases the stop that this sensor holds."""

from hypothesis import given, settings
from hypothesis import strategies as st
from monitor_rig import PERIOD, SIGNAL_FAIL, TICK, VALID, Rig
import numpy as np
from paper_cell import RINGS
import pytest

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.messages import Reading, RobotState
from tofssm_drake.tasks.program import make_program_path

# The rings of these tests do not see the robot where they must.
NO_WATCH = "self_hits: {enabled: false}"
NO_RETURN = (2, 4, 7)
MEASURED = (0, 3, 13)
# Those of ST's manuals, this project's own, and one that means nothing.
KNOWN = (*range(15), 99, 240, 241, 242, 253, 254, 255)
STOP, REDUCED, NORMAL = RobotState


@pytest.fixture(scope="module")
def position():
    """Where no sensor of a ring sees the robot or its cell."""
    scenario = load_scenario()
    station = make_station(scenario)
    path = make_program_path(
        scenario.task, ArmKinematics.from_plant(station.plant)
    )
    return path.calc_motion(0.0)[0]


@pytest.fixture(
    scope="module",
    params=[
        "vo",
        pytest.param("vr", marks=pytest.mark.long),
        pytest.param("sm", marks=pytest.mark.long),
    ],
)
def monitor(request):
    return make_monitor(
        load_scenario(
            text=f"{{law: {{configuration: {request.param}}}, {NO_WATCH}}}"
        )
    )


class Watch(Rig):
    """One sensor decides, all others see nothing."""

    def __init__(self, monitor, position, ring="tool", sensor=0):
        super().__init__(monitor, position)
        self.ring, self.sensor = ring, sensor

    def tell(self, status, distance, age=0.015):
        """Sets what the sensor delivers from now on."""
        every = np.full(8, SIGNAL_FAIL), np.full(8, 4.0), np.full(8, 0.015)
        for values, value in zip(every, (status, distance, age), strict=True):
            values[self.sensor] = value
        self.readings[self.ring] = every[:2]
        self.ages[self.ring] = every[2]

    def stop(self, distance=0.4):
        """Lets somebody come near until the robot is to stop."""
        for d in np.arange(1.3, distance, -0.03):
            self.tell(VALID, d)
            self.run(PERIOD)
        self.tell(VALID, distance)
        self.run(0.5)
        masked = self.eval(f"masked_scan_{self.ring}")
        assert masked.reading[self.sensor] == Reading.VALID
        assert self.state == STOP
        assert self.rho == 0.0

    def run_scan(self):
        """Delivers one scan; returns the highest state until the next."""
        return self.run(PERIOD)[:, 1].max()


@pytest.fixture(scope="module")
def moments(monitor, position):
    """Returns a watch, a moment of it in motion, and one at a stop."""
    watch = Watch(monitor, position)
    watch.run(1.0)
    assert watch.state == NORMAL
    in_motion = watch.save()
    watch.stop()
    return watch, in_motion, watch.save()


@pytest.fixture
def moving(moments):
    """A watch of a robot that has seen nothing for a second."""
    watch, in_motion, _ = moments
    watch.restore(in_motion)
    return watch


@pytest.fixture
def stopped(moments):
    """A watch of a robot that its sensor has just stopped."""
    watch, _, at_stop = moments
    watch.restore(at_stop)
    return watch


failed_statuses = st.integers(0, 255).filter(
    lambda s: s not in (*NO_RETURN, *MEASURED)
)
any_distance = st.floats(0.0, 65.535)
failures = st.one_of(
    # Any status without a valid range, with any number.
    st.tuples(failed_statuses, any_distance, st.just(0.015)),
    # A distance that its mode cannot measure, or NaN.
    st.tuples(
        st.just(0),
        st.one_of(st.floats(1.46, 65.535), st.just(np.nan)),
        st.just(0.015),
    ),
    # Old data again and again, or of unknown age.
    st.tuples(
        st.integers(0, 255),
        any_distance,
        st.one_of(st.floats(0.08, 100.0), st.just(np.inf), st.just(np.nan)),
    ),
    # One lost sample, which looks like nothing there.
    st.tuples(st.sampled_from(NO_RETURN), any_distance, st.just(0.015)),
)


@settings(deadline=None, max_examples=25)
@given(
    samples=st.lists(failures, min_size=1, max_size=30),
    repeats=st.integers(1, 25),
)
def test_no_failure_releases_a_stop(moments, samples, repeats):
    watch, _, at_stop = moments
    watch.restore(at_stop)
    confirmed = 0
    for sample in samples:
        is_no_return = sample[0] in NO_RETURN and sample[2] < 0.072
        watch.tell(*sample)
        for _ in range(1 if is_no_return else repeats):
            confirmed = confirmed + 1 if is_no_return else 0
            if confirmed >= 2:
                # That is a measurement: nobody is there now.
                break
            assert watch.run_scan() == STOP, sample


@pytest.mark.parametrize(
    "status",
    [
        pytest.param(s, marks=() if s in KNOWN else pytest.mark.long)
        for s in range(256)
    ],
)
def test_each_status_for_two_seconds(stopped, status):
    stopped.tell(status, 0.4 if status in MEASURED else 1.2)
    states = [stopped.run_scan() for _ in range(round(2.0 / PERIOD))]
    if status in NO_RETURN:
        # Two in a row, and what the filter forgets.
        assert states[0] == STOP
        assert states[-1] == NORMAL
    else:
        assert set(states) == {STOP}, stopped.decision.reason


def test_a_hang_is_reported(stopped):
    stopped.tell(254, 0.4)
    stopped.run(0.25)
    assert "tool at" in stopped.decision.reason
    stopped.run(0.2)
    assert stopped.decision.reason == "stop: tool is faulted, sensor 0: late"


@pytest.mark.parametrize(
    ("status", "distance", "cause"),
    [
        (253, 0.4, "bus"),
        (240, 0.4, "frozen"),
        (241, 0.4, "self-test"),
        (242, 0.4, "contested"),
        (1, 0.4, "sigma"),
        (5, 0.4, "hardware"),
        (0, 4.0, "implausible"),
    ],
)
def test_a_sensor_that_saw_nothing_stops_the_robot_after_0_3_s(
    moving, status, distance, cause
):
    moving.tell(status, distance)
    rows = moving.run(0.5)
    stopped = np.flatnonzero(rows[:, 1] == STOP)
    elapsed = (stopped[0] + 1) * TICK
    # A target that cannot be measured counts from its second sample on.
    assert elapsed <= (2 * PERIOD if cause == "sigma" else 0.3 + PERIOD)
    assert (rows[stopped[0] :, 1] == STOP).all()
    assert moving.decision.reason == f"stop: tool is faulted, sensor 0: {cause}"


def test_one_lost_sample_now_and_then_is_tolerated(moving):
    for status in (253, 1, 5, 254, 255):
        for _ in range(5):
            moving.tell(status, 0.2)
            assert moving.run_scan() == NORMAL
            moving.tell(SIGNAL_FAIL, 4.0)
            for _ in range(4):
                assert moving.run_scan() == NORMAL


def test_half_of_a_ring_at_once(moving):
    status = np.full(8, SIGNAL_FAIL)
    status[:5] = 253
    moving.readings["base"] = status, np.full(8, 0.4)
    assert moving.run(PERIOD)[-1, 1] == STOP
    assert (
        moving.decision.reason
        == "stop: base is faulted, sensors 0, 1, 2, 3, 4: bus"
    )


def test_a_sensor_declared_dead_slows_the_robot(position):
    monitor = make_monitor(
        load_scenario(
            text=f"{{sensors: {{tool: {{dead_sensors: [0]}}}}, {NO_WATCH}}}"
        )
    )
    watch = Watch(monitor, position)
    watch.tell(253, 0.2)
    rows = watch.run(2.0)
    assert rows[-1, 1] == REDUCED
    assert rows[-1, 2] == 0.5
    assert (
        watch.decision.reason
        == "reduced: tool is degraded, sensor 0: declared dead"
    )
    # Its neighbour still stops the robot.
    watch.sensor = 1
    watch.tell(VALID, 0.3)
    assert watch.run(PERIOD)[-1, 1] == STOP


def test_without_a_failure_the_robot_starts_again(stopped):
    stopped.tell(SIGNAL_FAIL, 4.0)
    assert stopped.run_scan() == STOP
    stopped.run(1.0)
    assert stopped.state == NORMAL
    assert set(RINGS) == set(stopped.sequence)


SIGMA, LOST, IMPLAUSIBLE = (1, 0.2), (255, 0.2), (0, 4.0)
NOTHING = (2, 4.0)


@pytest.mark.parametrize(
    "pattern",
    [
        [SIGMA, NOTHING],
        [SIGMA, NOTHING, NOTHING],
        [(9, 0.2), NOTHING, (12, 0.2), NOTHING],
        [IMPLAUSIBLE, NOTHING, NOTHING],
        [LOST, NOTHING, NOTHING],
        [NOTHING, LOST],
        # A sensor that fails must not be believed with a far value either.
        [LOST, (0, 1.40), (0, 1.41)],
        [(0, 1.40), LOST],
        [(0, 1.40), *[(253, 0.2)] * 200],
    ],
)
def test_failures_mixed_with_good_samples_release_nothing(stopped, pattern):
    for i in range(round(3.0 / PERIOD)):
        stopped.tell(*pattern[i % len(pattern)])
        assert stopped.run_scan() == STOP, (i, stopped.decision.reason)


@pytest.mark.parametrize(
    "pattern",
    [
        [SIGMA, NOTHING],
        [LOST, NOTHING],
        [NOTHING, *[LOST] * 11],
        [NOTHING, NOTHING, *[(253, 0.2)] * 11],
        [SIGMA, NOTHING, NOTHING],
    ],
)
def test_a_sensor_that_fails_again_and_again_stops_the_robot(moving, pattern):
    states = []
    for i in range(round(3.0 / PERIOD)):
        moving.tell(*pattern[i % len(pattern)])
        states.append(moving.run_scan())
    late = states[round(1.5 / PERIOD) :]
    assert set(late) == {STOP}, moving.decision.reason
    assert "sensor 0: " in moving.decision.reason


@pytest.mark.parametrize("later", [0, 2, 5])
def test_a_frozen_value_releases_nothing(moving, later):
    """It repeats before anyone knows; the speed must not be forgotten."""
    distance = 1.3
    while moving.state != STOP:
        distance -= 0.03
        moving.tell(VALID, distance)
        moving.run(PERIOD)
    for _ in range(later):
        distance -= 0.03
        moving.tell(VALID, distance)
        moving.run(PERIOD)
    for _ in range(25):
        assert moving.run_scan() == STOP, moving.decision.reason
    moving.tell(240, distance)
    for _ in range(50):
        assert moving.run_scan() == STOP


def test_a_value_stuck_far_away_releases_nothing(stopped):
    stopped.tell(VALID, 1.3)
    for _ in range(25):
        assert stopped.run_scan() == STOP
    stopped.tell(240, 1.3)
    for _ in range(50):
        assert stopped.run_scan() == STOP
