"""`tofssm hardware` on the shipped toy controller, with its own driver."""

import contextlib
import importlib
import io
from pathlib import Path
import signal
import threading

import pytest

from tofssm_drake.diagrams import hardware_run
from tofssm_drake.diagrams.hardware_loop import HardwareLoop
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.recording.run_record import RunReader
from tofssm_drake.scripts.main import run

ROOT = Path(__file__).parents[2]
FILE = ROOT / "examples" / "my_driver.yaml"


@pytest.fixture
def my_driver(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(ROOT)
    module = importlib.import_module("examples.my_driver")
    # On a busy computer everything comes late.
    monkeypatch.setattr(module, "SILENCE", 10.0)
    monkeypatch.setattr(hardware_run, "_LATEST", 10.0)
    return module


@contextlib.contextmanager
def serve(controller):
    """Runs a controller in a thread; yields its port."""
    stopped = threading.Event()
    thread = threading.Thread(target=controller.run, args=[stopped.is_set])
    thread.start()
    try:
        yield controller.server.getsockname()[1]
    finally:
        stopped.set()
        thread.join()
        controller.server.close()


def run_command(*options, port, text=""):
    """Returns exit code, stdout and stderr of a command on the toy."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(
            [
                *map(str, options),
                *("--scenario-file", str(FILE), "--scenario-name", "Panda"),
                "--scenario-text",
                text or f"{{driver: {{parameters: {{port: {port}}}}}}}",
            ]
        )
    return code, out.getvalue(), err.getvalue()


def make_controller(my_driver):
    return my_driver.ToyController(load_scenario(filename=FILE, name="Panda"))


def interrupt_when(monkeypatch, condition):
    """Presses Ctrl-C at the first tick at which a condition holds."""
    tick, done = HardwareLoop.tick, []

    def act(loop, given):
        result = tick(loop, given)
        if not done and condition(result):
            done.append(True)
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(HardwareLoop, "tick", act)


def test_slows_down_for_a_person_and_ends_at_zero(
    my_driver, monkeypatch, tmp_path
):
    controller = make_controller(my_driver)
    commanded = controller.commanded

    def has_slowed(_):
        up = [f > 0.5 for f in commanded]
        return (
            True in up[1:]
            and controller.path_time > 0.1
            and commanded[-1] < 0.3
        )

    interrupt_when(monkeypatch, has_slowed)
    path = tmp_path / "run.mcap"
    with serve(controller) as port:
        code, out, err = run_command(
            *("hardware", "--wait", 300, "--duration", 300, "--record", path),
            port=port,
        )
    assert code == 130, out + err
    assert "interrupted; slider set to 0" in out
    assert commanded[-1] == 0.0
    ticks = list(RunReader(path).read_ticks())
    assert len(ticks[0].report.position) == 7
    assert {tick.state["robot_state"] for tick in ticks} > {2}
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert run(["replay", str(path)]) == 0
    assert "all states as recorded" in said.getvalue()


def test_another_robot_is_refused_before_the_rings_are_waited_for(my_driver):
    controller = make_controller(my_driver)
    step = controller.step

    def step_wrong():
        said = step()
        said["tool"][0] += 0.1
        return said

    controller.step = step_wrong
    with serve(controller) as port:
        code, _, err = run_command(
            *("hardware", "--rings", "udp://127.0.0.1:5999"), port=port
        )
    assert code == 2
    assert "reported tool is 100 mm and 0.0 deg from where" in err
    assert "slider set to 0" in err
    assert controller.commanded[-1] == 0.0


@pytest.mark.parametrize(
    ("options", "text", "message"),
    [
        (
            ("--robot-host", "a"),
            "",
            "--robot-host: is not for the driver !CustomDriver; use --scen",
        ),
        (("--robot-port", 1), "", "--robot-port: is not for the driver"),
        (("--robot-text", "{}"), "", "--robot-text: is not for the driver"),
        (
            (),
            "{driver: {factory: examples.my_driver:make_vector, "
            "parameters: null}}",
            "driver.parameters",
        ),
        (
            (),
            "{driver: {factory: examples.my_driver:None_such}}",
            "driver.factory: module 'examples.my_driver' has no function",
        ),
        (
            (),
            "{driver: {parameters: {prot: 1}}}",
            "driver.parameters: examples.my_driver:Toy does not take these",
        ),
        (
            (),
            "{driver: !CustomDriver {factory: 'builtins:dict'}}",
            "what it returns has no `traits` of type DriverTraits",
        ),
        ((), "{driver: !Rtde {rings: [virtual]}}", "RTDE is for arms of 6"),
    ],
)
def test_mistakes_cost_one_line(my_driver, options, text, message):
    code, _, err = run_command("hardware", *options, port=1, text=text)
    assert code == 2
    (line,) = err.strip().splitlines()
    assert message in line
