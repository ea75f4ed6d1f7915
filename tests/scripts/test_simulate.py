"""The command line: what it writes, and how it fails."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import attacks
from bvh_writer import write_bvh
import numpy as np
from paper_cell import RINGS, change_rings
import psutil
import pytest

import tofssm_drake.diagrams.simulation as simulation
from tofssm_drake.recording.samples import read_samples
import tofssm_drake.scripts.main as mut
import tofssm_drake.scripts.simulate as simulate

FILES = {"summary.json", "samples.parquet", "scans.parquet", "report.html"}

SHORT = ("--duration", "0.4", "--no-recording")

SUMMARY_KEYS = {
    "products_placed",
    "task_time_s",
    "stop_events",
    "reduce_events",
    "stopped_s",
    "reduced_s",
    "min_true_distance_m",
    "contact_while_moving_events",
    "max_tcp_speed_mps",
    "distance_rmse_m",
    "real_time_factor",
    "seed",
    "scenario",
    "versions",
}

COLUMNS = {
    "t",
    *(f"q_{i}" for i in range(6)),
    *(f"qd_{i}" for i in range(6)),
    "tcp_speed",
    "speed_fraction",
    "robot_state",
    "products_placed",
    "true_distance",
}

RING_COLUMNS = (
    "state",
    "measured_distance",
    "true_distance",
    "closing_speed",
    "d_C",
    "d_R",
    "dsi_raw",
    "dsi",
    "dsi_C",
    "dsi_R",
    "valid",
    "masked",
    "faulted",
)


def run(*arguments):
    return mut.run(["simulate", *map(str, arguments)])


def read_summary(out):
    return json.loads((out / "summary.json").read_text())


def check_readable(out, *, files=FILES):
    """Reads everything in a folder; returns summary and samples."""
    assert {path.name for path in out.iterdir()} == files
    summary = read_summary(out)
    samples = read_samples(out)
    assert set(samples.scan) == set(RINGS)
    report = (out / "report.html").read_text("utf-8")
    assert report.rstrip().endswith("</html>")
    return summary, samples


@pytest.fixture(scope="module")
def short_run(tmp_path_factory):
    """A short run of the default scenario, into a folder yet to be made."""
    out = tmp_path_factory.mktemp("run") / "a" / "b"
    assert run(*SHORT, "--seed", 5, "--ssm", "VR", "--out", out) == 0
    return out


class TestResults:
    def test_all_files_are_written_and_readable(self, short_run):
        summary, samples = check_readable(short_run)
        assert summary["interrupted"] is False
        assert summary["simulated_s"] == pytest.approx(0.4, abs=0.0081)
        # One row per tick, the first one at 0 and the last one at the end.
        np.testing.assert_allclose(
            samples["t"], 0.008 * np.arange(51), atol=1e-9
        )

    def test_summary_holds_every_key(self, short_run):
        summary = read_summary(short_run)
        assert SUMMARY_KEYS <= set(summary)
        assert summary["seed"] == 5
        assert summary["scenario"]["law"]["configuration"] == "vr"
        assert summary["scenario"]["simulation_duration"] == 0.4
        assert (
            summary["scenario"]["people"]["visitor"]["kind"] == "GeneratedWalk"
        )
        assert summary["real_time_factor"] > 0.0
        for package in ("tofssm-drake", "drake", "numpy", "python"):
            assert summary["versions"][package][0].isdigit()

    def test_samples_hold_every_column(self, short_run):
        _, samples = check_readable(short_run)
        assert set(samples.column) >= COLUMNS | {
            f"{ring}_{name}" for ring in RINGS for name in RING_COLUMNS
        }
        assert {len(values) for values in samples.column.values()} == {51}

    def test_report_tells_what_was_run(self, short_run):
        report = (short_run / "report.html").read_text("utf-8")
        for word in ("Default", "vr", "products", "speed"):
            assert word in report

    def test_the_installed_command_gives_the_same(self, short_run, tmp_path):
        out = tmp_path / "out"
        done = subprocess.run(
            [
                Path(sys.executable).with_name("tofssm"),
                "simulate",
                *SHORT,
                *("--seed", "5", "--ssm", "vr", "--out", "out"),
            ],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
        assert str(out / "report.html") in done.stdout.splitlines()
        summary, samples = check_readable(out)
        _, expected = check_readable(short_run)
        assert set(samples.column) == set(expected.column)
        for name, values in expected.column.items():
            np.testing.assert_array_equal(samples[name], values, name)
        metadata = dict(samples.metadata)
        command = metadata.pop("command")
        assert command.endswith("simulate " + " ".join(done.args[2:]))
        assert metadata == {
            key: value
            for key, value in expected.metadata.items()
            if key != "command"
        }
        assert summary["seed"] == 5


@pytest.fixture(scope="module")
def full_run(tmp_path_factory):
    """A run with every option that adds something to what is written."""
    folder = tmp_path_factory.mktemp("full")
    bvh = write_bvh(folder / "walk.bvh")
    (folder / "out").mkdir()
    code = run(
        *("--duration", 0.4),
        *("--human-motion", bvh, "--scenario-name", "IdealSensors"),
        "--scenario-text",
        "{people: {visitor: {speed: 1.1}}, random_seed: 2, "
        + change_rings("{count: 16}")
        + "}",
        *("--graphviz", folder / "cell.dot", "--out", folder / "out"),
    )
    assert code == 0
    return folder


class TestOptions:
    def test_recording_contains_the_run(self, full_run):
        check_readable(full_run / "out", files=FILES | {"recording.html"})
        page = (full_run / "out" / "recording.html").read_text("utf-8")
        assert page.rstrip().endswith("</html>")
        # What was changed is told, too.
        assert "<title>tofssm_drake: IdealSensors, " in page
        assert "human-motion walk.bvh" in page
        data = page.partition("const run = ")[2].partition(";\n")[0]
        data = json.loads(data)
        assert data["end"] == pytest.approx(0.4)
        assert data["spans"][0][0] == 0.0
        assert data["spans"][0][2] == 0
        assert data["spans"][-1][1] == pytest.approx(0.4)
        assert min(data["distance"]) > 0.1
        # Meshcat's own part: a scene with robot, person and beams.
        assert len(page) > 1_000_000

    def test_report_leads_into_the_recording(self, full_run, short_run):
        for folder, expected in ((full_run / "out", True), (short_run, False)):
            report = (folder / "report.html").read_text("utf-8")
            assert ('href="recording.html' in report) is expected

    def test_diagram_is_drawn(self, full_run):
        dot = (full_run / "cell.dot").read_text()
        assert dot.startswith("digraph")
        for name in ("station", "monitor", "recorder"):
            assert name in dot

    def test_sixteen_sensors(self, full_run):
        _, samples = check_readable(
            full_run / "out", files=FILES | {"recording.html"}
        )
        for ring in RINGS:
            assert samples.scan[ring]["distance"].shape[1] == 16
            counts = [
                samples[f"{ring}_{name}"]
                for name in ("clear", "valid", "masked", "faulted")
            ]
            assert set(np.sum(counts, axis=0)[-10:]) == {16}

    @pytest.mark.parametrize(
        ("name", "links"),
        [("MotionCapture", RINGS), ("PlanarLidar", ("lidar",))],
    )
    def test_other_sensors(self, tmp_path, name, links, monkeypatch):
        # Their reports are looked at in test_sensings.py.
        monkeypatch.setattr(simulate, "write_report", lambda *_, **__: None)
        assert run("--scenario-name", name, *SHORT, "--out", tmp_path) == 0
        summary = read_summary(tmp_path)
        (sensor,) = summary["scenario"]["sensors"].values()
        assert sensor["kind"] == name
        samples = read_samples(tmp_path)
        assert samples.rings == links
        for link in links:
            assert np.isfinite(samples[f"{link}_measured_distance"][-1])
            assert link not in samples.scan

    def test_human_motion(self, full_run):
        summary = read_summary(full_run / "out")
        human = summary["scenario"]["people"]["visitor"]
        assert human["kind"] == "BvhRecording"
        assert Path(human["filename"]).name == "walk.bvh"
        assert human["placement"] == "figure_eight"
        assert 0.1 < summary["min_true_distance_m"] < 4.0

    def test_options_win_over_text_and_file(self, full_run):
        scenario = read_summary(full_run / "out")["scenario"]
        # Text over file, option over both, the rest of the file kept.
        assert scenario["random_seed"] == 2
        assert scenario["sensors"]["tool"]["sensor"]["ideal"] is True

    def test_an_old_recording_is_not_taken_for_this_runs(
        self, tmp_path, capsys
    ):
        (tmp_path / "recording.html").write_text("of another run")
        assert run(*SHORT, "--out", tmp_path) == 0
        check_readable(tmp_path)
        assert "recording.html" not in capsys.readouterr().out

    def test_help_lists_the_options(self, capsys):
        assert run("--help") == 0
        text = capsys.readouterr().out
        for option in (
            "--scenario-file",
            "--scenario-name",
            "--scenario-text",
            "--ssm",
            "--human-motion",
            "--seed",
            "--duration",
            "--meshcat",
            "--graphviz",
            "--out",
        ):
            assert option in text


def _text(text):
    return ("--scenario-text", text)


def _file(text, name="Cell"):
    return ("--scenario-file", ("cell.yaml", text), "--scenario-name", name)


_NOT_BVH = ("walk.bvh", "HIERARCHY\nROOT Hips\n{\n")

# What a user wrote, and what the line on stderr must tell.
BAD_INPUT = {
    "unknown_key": (_text("{weather: 1}"), "--scenario-text:1: weather:"),
    "misspelt_key": (
        _text("{law: {configuratoin: vr}}"),
        "law.configuratoin: unknown key; did you mean 'configuration'?",
    ),
    "former_key": (
        _text("{ssm: {configuration: vr}}"),
        "--scenario-text:1: ssm: is now law",
    ),
    "law_without_factory": (
        _text("{law: !Custom {}}"),
        "law.factory: '' must be",
    ),
    "law_from_nowhere": (
        _text("{law: !Custom {factory: 'no_such.module:make'}}"),
        "law.factory: there is no module 'no_such.module', neither installed",
    ),
    "law_without_such_a_function": (
        _text("{law: !Custom {factory: 'json:make_law'}}"),
        "law.factory: module 'json' has no function 'make_law'",
    ),
    "law_that_is_none": (
        _text("{law: !Custom {factory: 'builtins:dict'}}"),
        "law.factory: builtins:dict: what it returns has no `traits`",
    ),
    "law_with_a_list": (
        _text("{law: !Custom {factory: 'a:b', parameters: {x: [1]}}}"),
        "law.parameters.x: must be one of: true or false, a whole number",
    ),
    "misspelt_key_in_a_file": (
        _file("Cell:\n  people:\n    a:\n      sped: 1.0\n"),
        "cell.yaml:4: Cell.people.a.sped: unknown key; did you mean 'speed'?",
    ),
    "unknown_kind": (_text("{people: {visitor: !Robot {}}}"), "!GeneratedWalk"),
    "wrong_type": (
        _text("{sensors: {tool: {count: eight}}}"),
        "sensors.tool.count: must be a whole number, not 'eight'",
    ),
    "wrong_type_in_a_file": (
        _file("Cell:\n  mask: 3\n"),
        "cell.yaml:2: Cell.mask: must be a mapping",
    ),
    "number_for_a_list": (
        _text("{people: {visitor: {figure_eight: {centre: 1}}}}"),
        "must be a list",
    ),
    "out_of_range": (
        _text("{people: {visitor: {speed: 9}}}"),
        "people.visitor.speed: 9",
    ),
    "out_of_range_deep": (
        _text("{sensors: {tool: {sensor: {usable_range: 0.01}}}}"),
        "sensors.tool.sensor.usable_range: 0.01 is out of range; use 0.05 to 4",
    ),
    "out_of_reach": (
        _text("{task: {pick_center: [0.0, -3.0, 0.7]}}"),
        "task.pick_center: point [-0.2, -3.05, 0.8251]: out of the robot's "
        "reach",
    ),
    "real_robot": (
        _text("{driver: !Rtde {}}"),
        "driver: !Rtde is a real robot: run it with tofssm hardware",
    ),
    "time_step_does_not_fit": (
        _text("{driver: {time_step: 0.003}}"),
        "driver.time_step: control_period (0.008) must be a multiple",
    ),
    "nan": (
        _text("{task: {pick_center: [.nan, 0.0, 0.7]}}"),
        "task.pick_center[0]: must be a finite number, not '.nan'",
    ),
    "inf": (_text("{task: {base_jerk: .inf}}"), "base_jerk: must be a fin"),
    "nan_duration": (("--duration", "nan"), "--duration: nan"),
    "duration_0": (("--duration", "0"), "--duration: 0"),
    "negative_seed": (("--seed", "-1"), "--seed: -1"),
    "huge_seed": (("--seed", "1" + 30 * "0"), "--seed: 1000"),
    "seed_is_no_number": (("--seed", "x"), "--seed"),
    "yaml_syntax": (_text("{law: ["), "--scenario-text:1: not YAML"),
    "yaml_syntax_in_a_file": (
        _file("Cell:\n  law: {\n"),
        "cell.yaml:2: not YAML",
    ),
    "yaml_is_a_list": (_text("[1, 2]"), "must be a mapping"),
    "file_is_not_text": (
        ("--scenario-file", ("cell.yaml", b"\xff\xfe\x00")),
        "cell.yaml: is not text",
    ),
    "missing_scenario_file": (
        ("--scenario-file", "nowhere.yaml"),
        "nowhere.yaml: cannot read the scenarios: No such file",
    ),
    "scenario_file_is_a_folder": (("--scenario-file", "."), "directory"),
    "unknown_scenario": (
        ("--scenario-name", "Defalt"),
        "no scenario 'Defalt'; did you mean 'Default'?",
    ),
    "unknown_scenario_in_a_file": (
        _file("Cell: {}\n", name="Zoo"),
        "cell.yaml: no scenario 'Zoo'; there are Cell",
    ),
    "missing_bvh": (("--human-motion", "gone.bvh"), "gone.bvh: no such file"),
    "malformed_bvh": (("--human-motion", _NOT_BVH), "walk.bvh:"),
    "empty_bvh": (("--human-motion", ("walk.bvh", "")), "walk.bvh"),
    "bvh_is_a_folder": (("--human-motion", "."), "."),
    "missing_bvh_in_a_file": (
        _file(
            "Cell:\n  people: {visitor: !BvhRecording {filename: gone.bvh}}\n"
        ),
        "gone.bvh",
    ),
    "unknown_ssm": (("--ssm", "vx"), "--ssm: 'vx' is unknown"),
    "unknown_ssm_in_text": (
        _text("{law: {configuration: vx}}"),
        "law.configuration: 'vx' is unknown",
    ),
    "key_of_before": (
        _text("{sensing: lidar}"),
        "sensing: is now sensors, as in the scenarios MotionCapture, Planar",
    ),
    "too_many_sensors": (
        _text("{sensors: {tool: {count: 65}}}"),
        "sensors.tool.count: 65 is out of range; use 1 to 64",
    ),
    "no_sensors_in_a_file": (
        _file("Cell:\n  sensors: {}\n"),
        "sensors: there is none; without a sensor the robot cannot see",
    ),
    "sensor_on_nothing": (
        _text("{sensors: {tool: {parent: hand}}}"),
        "sensors.tool.parent: the robot has no frame 'hand'",
    ),
    "arm_too_slow": (
        _text("{task: {arm_speed: 0.5}}"),
        "task.approach_speed: 0.8 m/s over a slot needs 1.275 rad/s",
    ),
    "too_much_jerk": (
        _text("{task: {base_jerk: 1e300}}"),
        "task.base_jerk: must be from 0.001",
    ),
    "person_far_away": (
        _text(
            "{people: {visitor: "
            "!GeneratedWalk {figure_eight: {centre: [1e200, 0]}}}}"
        ),
        "visitor.figure_eight.centre: [1e+200, 0.0] should be two numbers",
    ),
    "recording_far_away": (
        _text(
            "{people: {visitor: "
            "!BvhRecording {placement: in_place, filename: a.bvh, "
            "position: [1e120, 0]}}}"
        ),
        "people.visitor.position: [1e+120, 0.0] should be two numbers",
    ),
    "key_twice": (
        _text("{law: {C_dC: 0.4},\n law: {C_dC: 0.9}}"),
        "--scenario-text:2: law: appears twice, first in line 1",
    ),
    "name_twice_in_a_file": (
        _file("Cell: {}\nOther: {}\nCell: {random_seed: 3}\n"),
        "cell.yaml:3: Cell: appears twice, first in line 1",
    ),
    "octal": (_text("{random_seed: 010}"), "which YAML reads as 8"),
    "list_as_a_key": (_text("{? [1,2] : 3}"), "a key must be a word"),
    "number_for_text": (
        _text("{sensors: {tool: {parent: 3}}}"),
        "--scenario-text:1: sensors.tool.parent: must be text, not '3'; write",
    ),
    "number_for_units": (
        _text("{people: {visitor: !BvhRecording {filename: a.bvh, units: 0}}}"),
        "people.visitor.units: must be text, not '0'; write it in quotes",
    ),
    "empty_out": (("--out", ""), "'--out': must not be empty"),
    "empty_bvh_name": (
        ("--human-motion", ""),
        "'--human-motion': must not be empty",
    ),
    "empty_scenario_file": (("--scenario-file", ""), "must not be empty"),
    "empty_graphviz": (("--graphviz", ""), "must not be empty"),
    "graphviz_can_not_be_written": (
        ("--graphviz", "/proc/x.dot"),
        "--graphviz: cannot write /proc/x.dot: No such file",
    ),
    "graphviz_is_a_folder": (
        ("--graphviz", ("x.dot/", None)),
        "--graphviz: x.dot is a folder",
    ),
    "unknown_option": (("--sede", "3"), "No such option: --sede"),
    "no_value": (("--seed",), "--seed"),
    "stray_argument": (("Default",), "Default"),
    "graphviz_name": (("--graphviz", "cell.jpg"), "--graphviz: cell.jpg"),
    "graphviz_folder": (
        ("--graphviz", "nowhere/cell.dot"),
        "--graphviz: there is no folder nowhere",
    ),
}


def list_tree(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def check_mistake(code, captured, message):
    assert code == 2
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("tofssm: ")
    assert message in line
    assert "Traceback" not in line


class TestBadInput:
    @pytest.mark.parametrize("name", BAD_INPUT)
    def test_one_line_and_nothing_written(
        self, name, tmp_path, monkeypatch, capfd
    ):
        arguments, message = BAD_INPUT[name]
        monkeypatch.chdir(tmp_path)
        command = []
        for argument in arguments:
            if isinstance(argument, tuple):
                argument, content = argument
                if content is None:
                    Path(argument).mkdir()
                    command.append(argument)
                    continue
                if isinstance(content, str):
                    content = content.encode()
                Path(argument).write_bytes(content)
            command.append(argument)
        before = list_tree(tmp_path)
        # The last one counts: a name of the test's own wins.
        code = run("--out", "made/anew", *command)
        check_mistake(code, capfd.readouterr(), message)
        assert list_tree(tmp_path) == before

    def test_graphviz_is_not_installed(self, tmp_path, monkeypatch, capfd):
        monkeypatch.setenv("PATH", str(tmp_path))
        picture = tmp_path / "cell.svg"
        code = run("--graphviz", picture, "--out", tmp_path / "out")
        check_mistake(code, capfd.readouterr(), "apt-get install graphviz")
        assert list_tree(tmp_path) == []

    @pytest.mark.parametrize("out", ["file", "file/below", "/proc/self/fd"])
    def test_unwritable_folder(self, out, tmp_path, capfd):
        # No test by permissions: root may write everywhere.
        (tmp_path / "file").write_text("in the way")
        code = run(*SHORT, "--out", tmp_path / out)
        check_mistake(code, capfd.readouterr(), "--out: cannot write into")
        assert list_tree(tmp_path) == ["file"]
        assert (tmp_path / "file").read_text() == "in the way"

    def test_from_outside(self, tmp_path):
        done = subprocess.run(
            [
                *(sys.executable, "-m", "tofssm_drake.scripts.main"),
                *("simulate", "--scenario-text", "{random_seed: -9}"),
            ],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 2
        assert done.stdout == ""
        assert len(done.stderr.splitlines()) == 1
        assert list_tree(tmp_path) == []


def attack_once(monkeypatch, attack):
    """Attacks the viewer of the next run after a while."""
    advance, done = simulation.Run.advance, []

    def advance_and_attack(self):
        progress = advance(self)
        if progress.time > 0.3 and not done:
            done.append(attack(attacks.find_viewer()))
        return progress

    monkeypatch.setattr(simulation.Run, "advance", advance_and_attack)
    return done


class TestViewer:
    """A dead viewer never ends a run."""

    @pytest.mark.parametrize("attack", [attacks.kill, attacks.send_garbage])
    @pytest.mark.parametrize("options", [(), ("--meshcat",)])
    def test_run_goes_on_without_it(
        self, attack, options, short_run, tmp_path, monkeypatch, capfd
    ):
        (tmp_path / "recording.html").write_text("of another run")
        done = attack_once(monkeypatch, attack)
        seeds = ("--seed", 5, "--ssm", "vr")
        arguments = ("--duration", 1.0, *seeds, *options, "--out", tmp_path)
        assert run(*arguments) == 0
        assert len(done) == 1
        _, samples = check_readable(tmp_path)
        assert samples["t"][-1] == pytest.approx(1.0)
        # It changes nothing.
        expected = read_samples(short_run)
        for name, values in expected.column.items():
            np.testing.assert_array_equal(
                samples[name][: len(expected)], values, name
            )
        captured = capfd.readouterr()
        (line,) = [
            line
            for line in captured.err.splitlines()
            if line.startswith("the viewer ended: ")
        ]
        assert line.endswith("; the run goes on, there is no recording")
        assert "Traceback" not in captured.err
        assert "recording.html" not in captured.out
        report = (tmp_path / "report.html").read_text("utf-8")
        assert 'href="recording.html' not in report

    def test_the_run_itself_opens_no_port(self, tmp_path, monkeypatch):
        def list_ports():
            return {
                c.laddr
                for c in psutil.Process().net_connections()
                if c.status == psutil.CONN_LISTEN
            }

        before = list_ports()

        def compare(viewer):
            assert attacks.wait_for_port(viewer)
            return list_ports() - before

        done = attack_once(monkeypatch, compare)
        assert run("--duration", 0.6, "--out", tmp_path) == 0
        assert done == [set()]
        check_readable(tmp_path, files=FILES | {"recording.html"})

    def test_a_recording_that_cannot_be_written(
        self, tmp_path, monkeypatch, capfd
    ):
        """The samples that it needs are gone."""
        monkeypatch.setattr(simulate, "write_samples", lambda *_: None)
        assert run("--duration", 0.4, "--out", tmp_path) == 0
        error = capfd.readouterr().err
        assert "there is no recording" in error
        assert {p.name for p in tmp_path.iterdir()} == {
            "summary.json",
            "report.html",
        }

    def test_ctrl_c_is_for_the_run(self, tmp_path, monkeypatch, capfd):
        """A terminal sends it to the viewer's group as well, if it is in it."""

        def interrupt(viewer):
            assert os.getpgid(viewer.pid) != os.getpgid(0)
            os.kill(os.getpid(), signal.SIGINT)
            return viewer

        done = attack_once(monkeypatch, interrupt)
        assert run("--out", tmp_path) == 130
        check_readable(tmp_path, files=FILES | {"recording.html"})
        assert "the viewer ended" not in capfd.readouterr().err
        assert not done[0].is_running()


class TestInterruption:
    def test_no_signal_changes_how_it_ended(self, monkeypatch):
        """One that comes while the interpreter closes."""
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        handlers = [signal.getsignal(number) for number in numbers]
        monkeypatch.setattr(mut, "make_app", lambda: None)
        monkeypatch.setattr(mut, "run", lambda: 7)
        try:
            with pytest.raises(SystemExit) as caught:
                mut.main()
            for number in numbers:
                os.kill(os.getpid(), number)
        finally:
            for number, handler in zip(numbers, handlers, strict=True):
                signal.signal(number, handler)
        assert caught.value.code == 7

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_while_kernels_are_compiled(
        self, number, tmp_path, monkeypatch, capfd
    ):
        """It is told at once that the run ends, and after what."""
        advance = simulation.Run.advance
        told = []

        def interrupt(self):
            os.kill(os.getpid(), number)
            told.append(capfd.readouterr().err)
            return advance(self)

        monkeypatch.setattr(simulation.Run, "advance", interrupt)
        assert run("--no-recording", "--out", tmp_path) == 130
        (text,) = told
        assert "the run ends when its kernels are loaded" in text

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_from_inside(self, number, tmp_path, monkeypatch, capfd):
        advance = simulation.Run.advance

        def interrupt(self):
            progress = advance(self)
            if progress.time > 0.5:
                os.kill(os.getpid(), number)
            return progress

        monkeypatch.setattr(simulation.Run, "advance", interrupt)
        handler = signal.getsignal(number)
        assert run("--no-recording", "--out", tmp_path) == 130
        assert signal.getsignal(number) is handler
        captured = capfd.readouterr()
        assert "until interrupted" in captured.out
        assert "Traceback" not in captured.err
        summary, samples = check_readable(tmp_path)
        assert summary["interrupted"] is True
        assert summary["task_time_s"] is None
        assert samples["t"][-1] == pytest.approx(0.6)
        report = (tmp_path / "report.html").read_text("utf-8")
        assert "interrupted" in report.lower()

    def test_while_results_are_written(self, tmp_path, monkeypatch, capfd):
        for name in (*FILES, "recording.html"):
            (tmp_path / name).write_text("of another run")
        (tmp_path / "notes.txt").write_text("not of a run")

        def interrupt(*args, **kwargs):
            os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(simulate, "write_report", interrupt)
        assert run(*SHORT, "--out", tmp_path) == 130
        captured = capfd.readouterr()
        assert captured.out == ""
        last = captured.err.splitlines()[-1]
        left = ["samples.parquet", "scans.parquet", "summary.json"]
        assert last.startswith("tofssm: interrupted while the results were")
        assert last.endswith(
            f"{tmp_path}: summary.json, samples.parquet, scans.parquet"
        )
        assert list_tree(tmp_path) == ["notes.txt", *left]
        for name in left:
            assert (tmp_path / name).read_bytes() != b"of another run"

    def test_a_second_ctrl_c_while_simulating(
        self, tmp_path, monkeypatch, capfd
    ):
        (tmp_path / "report.html").write_text("of another run")

        def interrupt(self):
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(simulation.Run, "advance", interrupt)
        assert run(*SHORT, "--out", tmp_path) == 130
        captured = capfd.readouterr()
        assert captured.out == ""
        last = captured.err.splitlines()[-1]
        assert last == "tofssm: interrupted; nothing of this run was written"
        assert list_tree(tmp_path) == ["report.html"]
        assert (tmp_path / "report.html").read_text() == "of another run"

    @pytest.mark.parametrize("delay", [0.1, 0.3])
    def test_ctrl_c_while_starting(self, delay, tmp_path):
        process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                "import tofssm_drake.scripts.main as main\n"
                "print('ready', flush=True)\n"
                "main.main()\n",
                *("simulate", "--duration", "80000", "--out", "out"),
            ],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout.readline() == "ready\n"
            time.sleep(delay)
            process.send_signal(signal.SIGINT)
            _, error = process.communicate(timeout=60)
        finally:
            process.kill()
            process.wait()
        assert process.returncode == 130
        assert error.splitlines()[-1].startswith("tofssm: interrupted")
        assert "Traceback" not in error

    def test_ctrl_c_and_kill_from_outside(self, tmp_path):
        # A robot that waits for its rings for ever is never done.
        command = [
            *(sys.executable, "-m", "tofssm_drake.scripts.main", "simulate"),
            *(
                "--scenario-text",
                "{" + change_rings("{sensor: {readout_time: 1.0}}") + "}",
            ),
            *("--duration", "80000", "--no-recording", "--out"),
        ]
        runs = {}
        for number in (signal.SIGINT, signal.SIGTERM):
            out = tmp_path / number.name
            runs[number] = (
                out,
                subprocess.Popen(
                    [*command, out], stderr=subprocess.PIPE, text=True
                ),
            )
        try:
            for number, (out, process) in runs.items():
                while not out.exists():
                    assert process.poll() is None, process.stderr.read()
                    time.sleep(0.05)
                time.sleep(0.5)
                process.send_signal(number)
            for out, process in runs.values():
                _, error = process.communicate(timeout=120)
                assert process.returncode == 130
                assert "Traceback" not in error
                summary, samples = check_readable(out)
                assert summary["interrupted"] is True
                assert len(samples) > 1
        finally:
            for _, process in runs.values():
                if process.poll() is None:
                    process.kill()
                    process.wait()
