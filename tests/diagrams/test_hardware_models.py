"""The hardware runner in front of each UR that is modelled."""

import contextlib
import functools
from importlib import resources
import io
import json

import numpy as np
import pytest
from robot_room import serve

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.ur_arm import get_ur_lengths
from tofssm_drake.arms.ur_data import read_ur_data
from tofssm_drake.diagrams.hardware_loop import HardwareLoop, TickInput
from tofssm_drake.diagrams.hardware_run import (
    require_ready,
    set_control_period,
    wait_for_robot,
)
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotReport
from tofssm_drake.rtde.model_match import (
    ModelConfig,
    make_pose,
    start_model_match,
)
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.rtde.simulated_ur import (
    SimulatedUrConfig,
    calc_tcp_offset,
    calc_tool_motion,
)
from tofssm_drake.rtde.slider import SliderPhase
from tofssm_drake.scripts.main import run
from tofssm_drake.scripts.simulated_ur import find_series, make_robot

MODELS = sorted(
    path.name.removesuffix(".yaml")
    for path in (resources.files("tofssm_drake.models") / "ur").iterdir()
    if path.name.endswith(".yaml")
)
TICKS = 12
# A busy computer must not matter, s.
_PATIENCE = 600.0
# The longest that a connection may be given, s.
_LONGEST = 60.0
_TIMEOUTS = {
    "connect_timeout": _LONGEST,
    "reply_timeout": _LONGEST,
    "stream_timeout": _LONGEST,
}
_START = [0.3, -1.4, 1.2, -1.3, -1.5, 0.2]
_END = [0.9, -1.2, 1.0, -1.2, -1.4, 0.4]


def make_text(model):
    """Returns a cell with one ring around an arm that moves to and fro."""
    return f"""
robot: !UrArm {{model: {model}}}
people: {{visitor: null}}
sensors:
  base: null
  elbow: null
  tool: null
  fore: !Ring {{parent: "{model}::forearm_link", radius: 0.1, count: 8}}
task: !Waypoints
  waypoints: [{{joints: {_START}}}, {{joints: {_END}}}]
"""


def make_simulated(model):
    scenario = load_scenario(text=make_text(model))
    config = SimulatedUrConfig(
        series=find_series(scenario.robot), start="heartbeat"
    )
    return scenario, make_robot(config, scenario)


@functools.cache
def make_kinematics(model):
    scenario = load_scenario(text=make_text(model))
    return ArmKinematics.from_plant(make_cell_plant(arm=scenario.robot))


def make_report(model, q):
    """Returns what a robot of a model reports with these joints."""
    kinematics = make_kinematics(model)
    offset = calc_tcp_offset(kinematics)
    pose, *_ = calc_tool_motion(kinematics, q, np.zeros(6), make_pose(offset))
    return RobotReport(
        session=0,
        timestamp=100.0,
        position=q,
        velocity=np.zeros(6),
        tcp_pose=pose,
        tcp_offset=offset,
    )


def test_models():
    assert len(MODELS) == 9


@pytest.mark.parametrize("model", MODELS)
def test_monitor_runs_in_front_of_it(model):
    """Connects, checks, and answers some reports of the robot."""
    scenario, robot = make_simulated(model)
    with (
        serve(robot) as server,
        RtdeClient(RtdeConfig(port=server.address[1], **_TIMEOUTS)) as client,
    ):
        assert wait_for_robot(
            client, timeout=_PATIENCE, tell=print, is_stopped=lambda: False
        )
        set_control_period(
            scenario,
            frequency=client.get_status().frequency,
            control_period=None,
        )
        assert scenario.control_period == 1.0 / robot.rate
        loop = HardwareLoop(
            scenario=scenario, virtual_rings=True, send=client.send
        )
        report = client.get_report()
        require_ready(
            report, scenario, loop.workcell.station.plant, max_deviation=0.1
        )
        for i in range(TICKS):
            report = client.wait_for_report(
                after=report.sequence, timeout=_PATIENCE
            )
            result = loop.tick(
                TickInput(time=i * scenario.control_period, report=report)
            )
    np.testing.assert_allclose(report.position, _START, atol=1e-9)
    assert result.slider.phase != SliderPhase.FAULT
    assert result.slider.command.sequence == report.sequence
    assert np.isfinite(result.sent)


@pytest.mark.parametrize("model", MODELS)
def test_every_other_arm_is_refused(model):
    """As far as its lengths differ; a UR7e has those of a UR5e."""
    accepted = set()
    for other in MODELS:
        for q in (_START, _END):
            report = make_report(other, np.array(q))
            try:
                start_model_match(ModelConfig(), make_kinematics(model), report)
            except UserError as error:
                assert "mm and" in str(error)
            else:
                accepted.add(other)
    lengths = get_ur_lengths(read_ur_data(model))
    assert accepted == {
        other
        for other in MODELS
        if get_ur_lengths(read_ur_data(other)) == lengths
    }


def run_hardware(*options):
    """Returns exit code and the lines of stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(["hardware", *options])
    return code, err.getvalue().splitlines()


@pytest.mark.parametrize("is_in_scenario", [False, True])
def test_another_arm_ends_the_command_with_one_line(is_in_scenario):
    """Whether options or the scenario say where robot and rings are."""
    _, robot = make_simulated("ur10")
    text = make_text("ur5e")
    with serve(robot) as server:
        port = server.address[1]
        if is_in_scenario:
            options = ()
            robot_text = json.dumps(
                _TIMEOUTS | {"host": "127.0.0.1", "port": port}
            )
            text += f"driver: !Rtde {{rings: [virtual], robot: {robot_text}}}"
        else:
            options = (
                *("--robot-host", "127.0.0.1", "--robot-port", str(port)),
                *("--robot-text", json.dumps(_TIMEOUTS), "--rings", "virtual"),
            )
        code, lines = run_hardware(
            *options,
            *("--duration", "1", "--wait", "60", "--scenario-text", text),
        )
    assert code == 2
    (line,) = lines
    assert "it is not the scenario's ur5e" in line
    assert robot.path_time == 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "--rings: nothing says where the rings' frames come from"),
        (("--rings", "virtual", "--rings", "udp://127.0.0.1:5"), "--rings: "),
        (
            ("--scenario-text", "driver: !Rtde {rings: [virtual, virtual]}"),
            "driver.rings: virtual stands alone",
        ),
        (
            ("--scenario-text", "driver: !Rtde {gripper_output: 18}"),
            "driver.gripper_output: must be from 0 to 17, got 18",
        ),
        (
            ("--scenario-text", "driver: !Rtde {robot: {hos: a}}"),
            "did you mean 'host'",
        ),
    ],
)
def test_what_the_user_gets_wrong(options, message):
    code, lines = run_hardware(*options)
    assert code == 2
    (line,) = lines
    assert message in line
