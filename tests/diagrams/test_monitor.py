"""The monitor alone, in front of rings that a test plays."""

from monitor_rig import HARDWARE_FAIL, LATENCY, SIGNAL_FAIL, TICK, VALID, Rig
from paper_cell import RINGS
import pytest

from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.messages import RobotState


@pytest.fixture(scope="module")
def monitor():
    # These rings see nothing, not even the robot.
    return make_monitor(load_scenario(text="{self_hits: {enabled: false}}"))


@pytest.fixture(scope="module")
def start_position():
    """The pose in which the program starts."""
    station = make_station(load_scenario()).diagram
    context = station.CreateDefaultContext()
    return station.GetOutputPort("position_measured").Eval(context).copy()


@pytest.fixture
def rig(monitor, start_position):
    return Rig(monitor, start_position)


def test_stopped_until_every_ring_has_delivered(rig):
    rig.silent = {"tool"}
    rows = rig.run(0.5)
    assert set(rows[:, 1]) == {RobotState.STOP}
    assert set(rows[:, 2]) == {0.0}
    assert rig.decision.reason == "stop: tool has no sample yet"
    rig.silent = set()
    rows = rig.run(0.6)
    assert rows[-1, 1] == RobotState.NORMAL
    assert rows[-1, 2] == 1.0


@pytest.mark.parametrize("ring", RINGS)
def test_a_ring_that_falls_silent_stops_the_robot(rig, ring):
    assert rig.run(0.8)[-1, 2] == 1.0
    rig.silent = {ring}
    start = rig.tick * TICK
    rows = rig.run(0.6)
    stopped = rows[rows[:, 1] == RobotState.STOP, 0]
    assert stopped[0] - start <= 0.1 + TICK
    assert (rows[rows[:, 0] >= stopped[0], 1] == RobotState.STOP).all()
    assert rig.rho == 0.0
    assert rig.decision.reason.startswith(f"stop: {ring} sample is")
    assert rig.decision.state.tolist() == [
        RobotState.STOP if name == ring else RobotState.NORMAL for name in RINGS
    ]
    # It comes back as soon as the ring does.
    rig.silent = set()
    assert rig.run(0.6)[-1, 2] == 1.0


@pytest.mark.parametrize("ring", RINGS)
def test_a_broken_ring_stops_the_robot(rig, ring):
    rig.run(0.8)
    rig.readings[ring] = (HARDWARE_FAIL, 0.0)
    rig.run(0.6)
    assert rig.rho == 0.0
    assert rig.decision.reason.startswith(f"stop: {ring} ")


def test_rings_that_see_nothing_at_all_stop_the_robot(start_position):
    rig = Rig(make_monitor(load_scenario()), start_position)
    rows = rig.run(3.0)
    # The robot stands still here, so it is looked at a fifth as often.
    assert rows[-1, 1] == RobotState.STOP
    assert rig.rho == 0.0
    assert rig.decision.reason.startswith("stop: ")
    for ring, line in zip(
        RINGS, rig.eval("self_hit_health").problem, strict=True
    ):
        assert line.startswith(f"unseen self-hit: {ring} sensor ")


def test_a_frozen_ring_stops_the_robot(rig):
    """Old samples under new numbers, as from a driver that hangs."""
    rig.run(0.8)
    rig.silent = set(RINGS)
    for i in range(100):
        for ring in RINGS:
            rig.deliver(ring, age=LATENCY + i * TICK if ring == "tool" else 0)
        rig.run(TICK)
    assert rig.rho == 0.0
    assert rig.decision.reason.startswith("stop: tool ")


def test_scans_that_come_too_late_stop_the_robot(rig):
    rig.silent = set(RINGS)
    for _ in range(100):
        for ring in RINGS:
            rig.deliver(ring, age=0.2)
        rig.run(TICK)
        assert rig.state == RobotState.STOP
        assert rig.rho == 0.0
    assert rig.decision.reason.startswith("stop: base")


def test_something_near_stops_and_its_leaving_releases(rig):
    # Up to a tick in which the rings deliver.
    rig.run(0.816)
    rig.readings["elbow"] = ([VALID] + 7 * [SIGNAL_FAIL], 0.25)
    start = rig.tick * TICK
    rows = rig.run(0.6)
    # In the tick in which the scan came.
    assert rows[0, 1] == RobotState.STOP
    assert rows[0, 0] == pytest.approx(start + TICK)
    assert rig.rho == 0.0
    assert rig.decision.reason.startswith("stop: elbow at 0.3")
    rig.readings["elbow"] = (SIGNAL_FAIL, 0.0)
    assert rig.run(0.8)[-1, 2] == 1.0


def test_something_nearer_than_can_be_measured_stops(rig):
    rig.run(0.8)
    rig.readings["base"] = ([VALID] + 7 * [SIGNAL_FAIL], 0.01)
    rig.run(0.6)
    assert rig.rho == 0.0
