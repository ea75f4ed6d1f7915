"""A viewer that works, and viewers that do not."""

from pathlib import Path
import pickle
import signal
import subprocess
import sys
import threading
import time

from attacks import DEADLINE, find_viewer, send_garbage, wait_for
import psutil
import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import make_simulator
import tofssm_drake.diagrams.viewer as mut
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.messages import Frame

_ORDER = mut.RecordingOrder(
    folder=Path("/nonexistent"), name="recording.html", title=""
)


@pytest.fixture(scope="module")
def scenario():
    return load_scenario()


def start(scenario, program=None, **settings):
    """Starts a viewer; `program` takes the place of its process."""
    patience = settings.pop("patience", DEADLINE)
    viewer = mut.Viewer(
        mut.ViewerSettings(scenario=scenario, **settings),
        patience=patience,
        command=program and (sys.executable, "-c", program),
    )
    viewer.start()
    return viewer


_SILENT = "import time; time.sleep(100000)"
_DEAF = "import sys; sys.stdin.buffer.read()"
_GONE = "import sys; sys.exit(3)"
_ANSWER = "import json; print(json.dumps({}), flush=True);"
_BROKEN = "print('this is no answer', flush=True);" + _ANSWER.format(
    {"error": "no\nroom"}
)


class TestTrouble:
    @pytest.mark.parametrize(
        ("program", "why"),
        [
            (_GONE, "exit code 3"),
            (_BROKEN, "no room"),
            (f"{_BROKEN}\n{_SILENT}", "no room"),
            ("import os; os.abort()", "signal SIGABRT"),
        ],
    )
    def test_it_ends(self, scenario, program, why, capfd):
        with start(scenario, program, is_recorded=True) as viewer:
            # More than fit into its queue and the pipe.
            for _ in range(3000):
                viewer.send(Frame())
            assert not viewer.record(_ORDER)
            assert not viewer.record(_ORDER)
        assert capfd.readouterr().err == (
            f"the viewer ended: {why}; the run goes on, there is no recording\n"
        )

    @pytest.mark.parametrize("program", [_SILENT, _DEAF])
    def test_it_never_answers(self, scenario, program, capfd):
        with start(scenario, program, is_recorded=True, patience=0.5) as viewer:
            for _ in range(3000):
                viewer.send(Frame())
            assert not viewer.record(_ORDER)
        assert capfd.readouterr().err == (
            "the viewer ended: it did nothing for 0.5 s; the run goes on, "
            "there is no recording\n"
        )

    def test_it_cannot_be_started(self, scenario, capfd):
        settings = mut.ViewerSettings(scenario=scenario, is_recorded=True)
        with mut.Viewer(settings, command=("/nonexistent/viewer",)) as viewer:
            viewer.start()
            viewer.wait_until_ready()
            for _ in range(3000):
                viewer.send(Frame())
            assert not viewer.record(_ORDER)
        error = capfd.readouterr().err
        assert error.startswith("the viewer ended: cannot be started: No such")
        assert len(error.splitlines()) == 1

    def test_a_frame_that_cannot_be_pickled(self, scenario, capfd):
        with start(scenario, _DEAF, is_watched=True) as viewer:
            viewer.send(Frame(health={"ring": lambda: "OK"}))
            viewer.wait_until_ready()
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith("the viewer ended: a frame cannot be sent: ")
        assert line.endswith("; the run goes on")

    def test_a_live_view_loses_frames_and_is_not_waited_for(
        self, scenario, capfd
    ):
        with start(scenario, _SILENT, is_watched=True) as viewer:
            for _ in range(20_000):
                viewer.send(Frame())
        # It was ended on purpose.
        assert capfd.readouterr().err == ""

    def test_a_live_view_that_hangs_is_given_up(self, scenario, capfd):
        with start(scenario, _SILENT, is_watched=True, patience=0.5) as viewer:
            told = ""

            def is_told():
                nonlocal told
                viewer.send(Frame())
                told += capfd.readouterr().err
                return told

            wait_for(is_told)
        assert told == (
            "the viewer ended: it did nothing for 0.5 s; the run goes on\n"
        )

    def test_an_idle_run_is_not_the_viewers_fault(self, scenario, capfd):
        """E.g. while kernels are compiled, or a robot is waited for."""
        program = (
            _ANSWER.format({"url": "http://localhost"}) + "import pickle, sys\n"
            "for _ in range(2): pickle.load(sys.stdin.buffer)\n"
            + _ANSWER.format({"recorded": "yes"})
            + "sys.stdin.buffer.read()"
        )
        with start(scenario, program, is_recorded=True, patience=2.0) as viewer:
            viewer.wait_until_ready()
            time.sleep(3.0)
            assert viewer.record(_ORDER)
        assert capfd.readouterr().err == ""

    def test_nothing_is_left_of_it(self, scenario):
        for program in (_SILENT, _DEAF):
            viewer = start(scenario, program, is_recorded=True)
            (child,) = psutil.Process().children()
            before = threading.active_count()
            viewer.close()
            wait_for(lambda child=child: not child.is_running())
            wait_for(lambda n=before: threading.active_count() < n)


@pytest.mark.parametrize(
    "name", ["Default", "MotionCapture", "PlanarLidar", "SixteenSensors"]
)
def test_it_shows_every_kind_of_cell(name, capfd):
    scenario = load_scenario(name=name)
    with mut.Viewer(
        mut.ViewerSettings(scenario=scenario, is_watched=True, with_health=True)
    ) as viewer:
        workcell = make_workcell(scenario, prebuild=viewer.connect)
        viewer.start()
        viewer.wait_until_ready()
        simulator = make_simulator(
            workcell.diagram, workcell.make_context(scenario.random_seed)
        )
        simulator.AdvanceTo(0.25)
        (child,) = psutil.Process().children()
        # Only it listens, and only to this machine.
        (port,) = [
            c.laddr for c in child.net_connections() if c.status == "LISTEN"
        ]
        assert port.ip in ("127.0.0.1", "::1")
    output = capfd.readouterr()
    assert output.err == ""
    assert output.out == f"watch at http://localhost:{port.port}\n"


def test_its_answers_are_not_mixed_with_what_others_print(
    tmp_path, monkeypatch, capfd
):
    """A motion of a user's own, from the current folder, which prints."""
    (tmp_path / "my_motion.py").write_text(
        "from tofssm_drake.people.walk import GeneratedWalk\n"
        "def make(*, period, **_):\n"
        "    print('hello')\n"
        "    return GeneratedWalk().make_motion(period, 'people.visitor')\n"
    )
    monkeypatch.chdir(tmp_path)
    scenario = load_scenario(
        text="{people: {visitor: !CustomMotion {factory: 'my_motion:make'}}}"
    )
    assert "hello" in capfd.readouterr().out
    with start(scenario, is_watched=True) as viewer:
        viewer.wait_until_ready()
    output = capfd.readouterr()
    assert output.err == ""
    assert output.out.startswith("watch at http://localhost:")


def test_ends_with_its_input_whatever_meshcat_got(scenario):
    """Nobody is left to end it if the run itself was killed."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tofssm_drake.diagrams.viewer_process"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    settings = mut.ViewerSettings(scenario=scenario, is_recorded=True)
    process.stdin.write(pickle.dumps(settings))
    process.stdin.flush()
    assert b"url" in process.stdout.readline()
    send_garbage(psutil.Process(process.pid))
    process.stdin.close()
    # By itself, or by what the message did to it.
    assert process.wait(DEADLINE) in (0, -signal.SIGABRT)
    process.stdout.close()


def test_its_memory_is_bounded(scenario):
    """It draws what a scenario names, whatever that is."""
    with start(scenario, is_watched=True) as viewer:
        viewer.wait_until_ready()
        bound, _ = find_viewer().rlimit(psutil.RLIMIT_DATA)
    assert bound == 4 * 1024**3
