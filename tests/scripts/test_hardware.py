"""`tofssm hardware` on a simulated robot, over real sockets."""

import contextlib
import dataclasses as dc
import io
import itertools
import json
import os
from pathlib import Path
import re
import resource
import signal
import tempfile
import threading
import time
import unittest
from unittest import mock

from mcap.reader import make_reader
import numpy as np
from robot_room import make_robot, serve

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams import hardware_run
from tofssm_drake.diagrams.hardware_loop import HardwareLoop
from tofssm_drake.diagrams.hardware_replay import replay_record
from tofssm_drake.diagrams.hardware_run import require_ready
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.errors import UserError
from tofssm_drake.laws import sensing_problem, tri_ssm
from tofssm_drake.messages import RobotReport
from tofssm_drake.recording.run_record import RunReader
from tofssm_drake.ringlink.ring_link import RingLink
from tofssm_drake.robots.robot_modes import SafetyMode
from tofssm_drake.rtde import rtde_systems
from tofssm_drake.rtde.model_match import make_pose
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_protocol import PackageType
from tofssm_drake.rtde.simulated_ur import (
    calc_tcp_offset,
    calc_tool_motion,
)
import tofssm_drake.scripts.hardware_status as hardware_status
from tofssm_drake.scripts.main import run
from tofssm_drake.tasks.program import make_program_path

_NOBODY = "{task: {products: 2}, people: {visitor: null}}"


def run_hardware(server, *options, text=_NOBODY, rings="virtual", err=None):
    """Returns exit code, stdout and stderr."""
    out, err = io.StringIO(), err or io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(
            [
                *("hardware", "--robot-host", "127.0.0.1"),
                *("--robot-port", str(server.address[1])),
                *("--rings", rings, "--scenario-text", text),
                *map(str, options),
            ]
        )
    return code, out.getvalue(), err.getvalue()


@contextlib.contextmanager
def at_ticks(actions):
    """Calls functions before certain ticks of the next loop."""
    tick, count = HardwareLoop.tick, 0

    def act(loop, given):
        nonlocal count
        # The loop counts its warm-up ticks as well.
        count += 1
        if count in actions:
            actions[count]()
        return tick(loop, given)

    with mock.patch.object(HardwareLoop, "tick", act):
        yield


@contextlib.contextmanager
def when(condition, action):
    """Calls a function once, before the first tick at which a condition holds.

    Also yields a list that is empty before it was done.
    """
    tick, done = HardwareLoop.tick, []

    def act(loop, given):
        if not done and condition():
            done.append(True)
            action()
        return tick(loop, given)

    with mock.patch.object(HardwareLoop, "tick", act):
        yield done


def interrupt():
    signal.raise_signal(signal.SIGINT)


def run_replay(path):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = run(["replay", str(path)])
    return code, out.getvalue()


def _leave_out(state, gone):
    """Returns a tick's results without one of them, or without any."""
    if gone == "everything":
        return {}
    return {name: value for name, value in state.items() if name != gone}


class TestHardware(unittest.TestCase):
    def setUp(self):
        # On a busy computer reports come late; see test_hardware_faults.
        latest = mock.patch.object(hardware_run, "_LATEST", 10.0)
        latest.start()
        self.addCleanup(latest.stop)
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def test_runs_then_leaves_the_slider_at_zero(self):
        path = self.folder / "run.mcap"
        robot = make_robot(start="heartbeat")
        with (
            serve(robot) as server,
            when(
                lambda: robot.path_time > 0.0 and robot.slider > 0.5, interrupt
            ),
        ):
            code, out, err = run_hardware(
                server,
                *("--record", path, "--out", self.folder / "out"),
                text="{task: {products: 2}}",
            )
            self.assertEqual(code, 130, err)
            self.assertIn("interrupted; slider set to 0", out)
            self.assertEqual(robot.slider, 0.0)
            self.assertGreater(robot.path_time, 0.1)
        self.assertTrue((self.folder / "out" / "report.html").is_file())
        summary = json.loads((self.folder / "out" / "summary.json").read_text())
        self.assertTrue(summary["interrupted"])

        ticks = list(RunReader(path).read_ticks())
        fractions = [t.command.speed_fraction for t in ticks]
        self.assertEqual(fractions[0], 0.0)
        self.assertGreater(max(fractions), 0.5)
        code, out = run_replay(path)
        self.assertEqual(
            (code, out.split(", ")[-1]), (0, "all states as recorded\n")
        )

    def test_real_time_only_if_asked_for(self):
        """A refused priority is reported, and the run goes on."""
        with mock.patch.object(
            os, "sched_setscheduler", side_effect=PermissionError
        ) as ask:
            for options, asked in (((), False), (("--real-time",), True)):
                with (
                    self.subTest(options=options),
                    serve(make_robot(start="heartbeat")) as server,
                ):
                    ask.reset_mock()
                    code, out, err = run_hardware(
                        server, "--duration", 0.5, "--dry-run", *options
                    )
                    self.assertEqual(code, 0, err)
                    self.assertIn("ran for 0.5 s", out)
                    self.assertEqual(ask.called, asked)
                    self.assertEqual(
                        "the system does not grant a real-time" in err, asked
                    )

    def test_the_tick_is_the_robots(self):
        """An e-Series needs no setting; an unsuitable one is refused."""
        path = self.folder / "run.mcap"
        with serve(make_robot(series="e", start="heartbeat")) as server:
            for options, period in (
                ((), 0.002),
                (("--control-period", 0.008), 0.008),
            ):
                with self.subTest(options=options):
                    code, _, err = run_hardware(
                        server,
                        *("--duration", 2, "--record", path, *options),
                    )
                    self.assertEqual(code, 0, err)
                    self.assertIn(
                        f"software 5.12.4, 500 Hz; control tick "
                        f"{1e3 * period:g} ms\n",
                        err,
                    )
                    reader = RunReader(path)
                    scenario = reader.run["scenario"]
                    self.assertEqual(scenario["control_period"], period)
                    self.assertEqual(scenario["audit"]["rtde_period"], 0.002)
                    # Reports come on the robot's clock; a busy computer may
                    # miss some.
                    times = np.array([t.time for t in reader.read_ticks()])
                    steps = np.diff(times) / 0.002
                    np.testing.assert_allclose(
                        steps, np.maximum(np.round(steps), 1), atol=0.005
                    )
                    self.assertEqual(run_replay(path)[0], 0)
            code, _, err = run_hardware(server, "--control-period", 0.003)
            self.assertEqual(code, 2)
            self.assertIn("must be a multiple of 0.002 s", err)

    def test_record_of_before_a_law_was_a_choice(self):
        """Version 4: the scenario has `ssm`."""
        path = self.folder / "run.mcap"
        with (
            serve(make_robot(start="heartbeat")) as server,
            at_ticks({80: interrupt}),
        ):
            run_hardware(server, "--record", path)
        data = path.read_bytes()
        for now, then in (
            (b'"version":5', b'"version":4'),
            # Of the same length.
            (b'"law":{"kind":"TriSsm",', b'"ssm":{' + 16 * b" "),
        ):
            self.assertIn(now, data)
            data = data.replace(now, then)
        path.write_bytes(data)
        _, out = run_replay(path)
        self.assertIn("all states as recorded", out)

    def test_replay_shows_a_difference(self):
        path = self.folder / "run.mcap"
        with (
            serve(make_robot(start="heartbeat")) as server,
            at_ticks({80: interrupt}),
        ):
            run_hardware(server, "--record", path)
        data = path.read_bytes()
        self.assertIn(b'"robot_state":2', data)
        path.write_bytes(data.replace(b'"robot_state":2', b'"robot_state":1'))
        code, out = run_replay(path)
        self.assertEqual(code, 1)
        self.assertIn("robot_state 2, was 1", out)
        self.assertRegex(out, "the record is damaged: the checksum of its")
        # Cut off, as by a process that was killed.
        path.write_bytes(data[: len(data) * 2 // 3])
        code, out = run_replay(path)
        self.assertEqual(code, 0)
        self.assertIn("all states as recorded", out)
        self.assertIn("the record is incomplete: it ends within a record", out)
        path.write_bytes(
            re.sub(rb'"heartbeat":([1-9])', rb'"heartbeaT":\1', data)
        )
        self.assertEqual(run_replay(path)[0], 1)
        path.write_bytes(data)
        self.check_missing_results(RunReader(path))
        self.check_missing_settings(RunReader(path))
        self.check_other_robots(RunReader(path))

    def check_missing_results(self, reader):
        """A result that is not there is a difference, of any version."""
        ticks = list(reader.read_ticks())[:4]
        for is_new, gone in itertools.product(
            (True, False), ("robot_state", "speed_fraction", "everything")
        ):
            cut = [
                dc.replace(t, state=_leave_out(t.state, gone)) for t in ticks
            ]
            with (
                self.subTest(is_new=is_new, gone=gone),
                mock.patch.object(reader, "read_ticks", lambda cut=cut: cut),
                mock.patch.object(RunReader, "is_of_this_version", is_new),
            ):
                result = replay_record(reader)
                self.assertEqual(result.differences, len(cut))
                self.assertIn("was missing", result.first)

    def check_missing_settings(self, reader):
        for name in ("virtual_rings", "minimum_fraction", "arm", "scenario"):
            with self.subTest(name=name):
                value = reader.run.pop(name)
                with self.assertRaisesRegex(UserError, f"record: .*{name}"):
                    replay_record(reader)
                reader.run[name] = value

    def check_other_robots(self, reader):
        """A tick that is not of the scenario's robot and rings is refused."""
        tick = next(reader.read_ticks())
        seven = dc.replace(tick.report, position=np.zeros(7))
        none = dc.replace(tick.report, velocity=np.zeros(0))
        place = dc.replace(tick.report, tcp_pose=np.zeros(3))
        word = dc.replace(tick.report, target_speed_fraction="much")
        for report, message in (
            (seven, "position has 7 numbers, of the scenario's robot 6"),
            (none, "velocity has 0 numbers, of the scenario's robot 6"),
            (place, "tcp_pose has 3 numbers, of the scenario's robot 6"),
            (word, "it does not fit the scenario"),
        ):
            cut = [dc.replace(tick, report=report)]
            with (
                self.subTest(message=message),
                mock.patch.object(reader, "read_ticks", lambda cut=cut: cut),
                self.assertRaisesRegex(UserError, f"tick at 0.*: {message}"),
            ):
                replay_record(reader)

    def test_dry_run_writes_nothing(self):
        path = self.folder / "run.mcap"
        robot = make_robot(start="heartbeat")
        with serve(robot) as server:
            before = dict(robot.inputs)
            code, out, err = run_hardware(
                server, "--dry-run", "--duration", 0.5, "--record", path
            )
            self.assertEqual((code, robot.slider), (0, 1.0), err)
            self.assertEqual(robot.inputs, before)
        self.assertIn("nothing was written (dry run)", out)
        with path.open("rb") as stream:
            kinds = {
                message.data[2]
                for _, channel, message in make_reader(stream).iter_messages()
                if channel.topic == "/robot/sent"
            }
        self.assertIn(PackageType.SETUP_OUTPUTS, kinds)
        self.assertNotIn(PackageType.SETUP_INPUTS, kinds)
        self.assertNotIn(PackageType.DATA_PACKAGE, kinds)

    def test_another_robot_does_not_start(self):
        robot = make_robot(start="heartbeat")
        robot.joint_offset[1] = 0.1
        with serve(robot) as server:
            code, _, err = run_hardware(server)
        self.assertEqual(code, 2)
        self.assertRegex(
            err,
            "robot: reported tool is [0-9]+ mm and 5.7 deg from where the "
            "modelled arm has it with these joints; 20 mm and 2.0 deg are "
            "allowed; it is not the scenario's ur10, or is set up wrongly; "
            "slider set to 0",
        )
        self.assertEqual(robot.path_time, 0.0)

    def test_a_robot_that_reports_no_pose(self):
        for options, starts in (((), False), (("--allow-no-pose",), True)):
            robot = make_robot(start="heartbeat")
            del robot.output_types["actual_TCP_pose"]
            with serve(robot) as server:
                code, _, err = run_hardware(server, *options, "--duration", 0.2)
            self.assertEqual(code, 0 if starts else 2, err)
            self.assertIn("robot: reports no pose of its tool", err)

    def test_settings_of_the_checks(self):
        """And a record has them: otherwise a replay would find a difference."""
        with (
            tempfile.TemporaryDirectory() as folder,
            serve(make_robot(start="heartbeat")) as server,
        ):
            path = Path(folder) / "run.mcap"
            code, _, err = run_hardware(
                server,
                *("--duration", 1.0, "--record", path),
                *("--checks-text", "{arm: {ramp_time: 0.21}}"),
            )
            self.assertEqual(code, 0, err)
            self.assertEqual(RunReader(path).run["arm"]["ramp_time"], 0.21)
            code, out = run_replay(path)
            self.assertEqual(code, 0)
            self.assertIn("all states as recorded", out)
            for text, message in (
                ("{arm: {ramp_time: 0}}", "checks.arm.ramp_time: must be more"),
                ("{model: {allow_no_pose: true}}", "use --allow-no-pose"),
                ("{clock_tolerance: 1}", "checks.clock_tolerance: must be"),
                ("{arms: {}}", "arms"),
            ):
                code, _, err = run_hardware(server, "--checks-text", text)
                self.assertEqual(code, 2)
                self.assertIn(message, err)

    def test_any_exception_leaves_the_slider_at_zero(self):
        """In a system, in the law, in the loop: each is one line."""
        for module, name in (
            (rtde_systems, "step_slider"),
            (tri_ssm, "calc_ring_states"),
            (sensing_problem, "find_sensing_problem"),
        ):
            with self.subTest(name=name):
                function, armed = getattr(module, name), []

                def fail(*args, function=function, armed=armed, **kwargs):
                    if armed:
                        raise RuntimeError("something\nis broken")
                    return function(*args, **kwargs)

                robot = make_robot(start="heartbeat")
                with (
                    serve(robot) as server,
                    mock.patch.object(module, name, fail),
                    at_ticks({100: lambda armed=armed: armed.append(True)}),
                ):
                    code, out, err = run_hardware(server)
                    self.assertEqual((code, robot.slider), (1, 0.0), err)
                self.assertIn(
                    "stopped: RuntimeError: something is broken; "
                    "slider set to 0",
                    out,
                )
                self.assertNotIn("Traceback", out + err)

    def test_a_terminal_that_is_held_does_not_keep_the_robot_moving(self):
        robot = make_robot(start="heartbeat")
        waited = []

        class Terminal(io.StringIO):
            """Blocks from some time on, until the robot's slider is at 0."""

            is_held = False

            def isatty(self):
                return True

            def write(self, text):
                if self.is_held and not waited:
                    waited.append(True)
                    deadline = time.monotonic() + 5.0
                    while robot.slider > 0.0 and time.monotonic() < deadline:
                        time.sleep(0.01)
                    waited.append(robot.slider)
                return super().write(text)

        terminal = Terminal()

        def hold():
            terminal.is_held = True
            while not waited:
                time.sleep(0.01)
            self.assertGreater(robot.slider, 0.0)
            raise RuntimeError("broken")

        with (
            serve(robot) as server,
            mock.patch.object(hardware_status, "_FAREWELL", 10.0),
            at_ticks({300: hold}),
        ):
            code, out, _ = run_hardware(server, err=terminal)
        self.assertEqual((code, waited), (1, [True, 0.0]), out)

    def test_a_stream_that_stalls_starts_again_from_zero(self):
        path = self.folder / "run.mcap"
        robot = make_robot(start="heartbeat")
        with (
            serve(robot) as server,
            at_ticks({60: lambda: server.do("simulate stall 0.5")}),
        ):
            code, _, err = run_hardware(
                server, "--duration", 3, "--record", path
            )
            self.assertEqual((code, robot.slider), (0, 0.0), err)
        self.assertIn("robot: 127.0.0.1:", err)
        self.assertIn("no package for 0.1 s", err)
        self.assertIn("robot: all is well again", err)
        ticks = list(RunReader(path).read_ticks())
        restarts = [
            (a, b)
            for a, b in itertools.pairwise(ticks)
            if b.report.session != a.report.session
        ]
        # A busy computer may cause more of them.
        stalls = [a for a, b in restarts if b.report.time - a.report.time > 0.4]
        self.assertGreaterEqual(len(stalls), 1)
        for _, first in restarts:
            self.assertEqual(first.command.speed_fraction, 0.0)
            self.assertEqual(first.command.mask, 1)

    def test_a_robot_that_is_gone_for_good_ends_the_run(self):
        robot = make_robot(start="heartbeat")
        with (
            serve(robot) as server,
            mock.patch.object(hardware_run, "_LONGEST_SILENCE", 0.5),
            when(
                lambda: robot.path_time > 0.0 and robot.slider > 0.3,
                lambda: server.do("simulate stall 60"),
            ),
        ):
            code, out, err = run_hardware(server)
        self.assertEqual(code, 1, err)
        self.assertIn("slider not seen at 0: its own watchdog", out)
        self.assertRegex(out, r"stopped: robot: no report for \d+ s: ")
        self.assertEqual(len(out.splitlines()), 1, out)

    def test_a_disk_that_is_full_ends_the_run(self):
        path = self.folder / "run.mcap"
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        self.addCleanup(resource.setrlimit, resource.RLIMIT_FSIZE, limits)
        robot = make_robot(start="heartbeat")
        with (
            serve(robot) as server,
            at_ticks(
                {
                    60: lambda: resource.setrlimit(
                        resource.RLIMIT_FSIZE,
                        (path.stat().st_size + 10_000, limits[1]),
                    )
                }
            ),
        ):
            code, out, err = run_hardware(server, "--record", path)
            self.assertEqual((code, robot.slider), (1, 0.0), err)
        self.assertIn("cannot write it: File too large; slider set to 0", out)
        self.assertNotIn("Traceback", out + err)
        self.assertGreater(len(list(RunReader(path).read_ticks())), 20)

    def test_products_of_a_run_before_are_not_the_end(self):
        robot = make_robot(start="dashboard")
        robot.path_time = 1e3
        with serve(robot) as server:
            code, out, err = run_hardware(server, "--duration", 1)
            self.assertEqual(robot.outputs["output_int_register_24"], 2)
        self.assertEqual(code, 0, err)
        self.assertIn("ran for 1 s", out)

    def test_says_why_the_robot_is_slow(self):
        """Whatever a person, the robot or a fieldbus does: one line each."""
        robot = make_robot(start="heartbeat")

        def claim():
            server.claim(["speed_slider_mask", "speed_slider_fraction"])
            server.drop_clients()
            threading.Timer(2.0, server.release).start()

        with (
            serve(robot) as server,
            at_ticks(
                {
                    210: lambda: server.do("simulate slider 0.3"),
                    250: lambda: server.do("simulate slider 1"),
                    300: lambda: server.do("pause"),
                    330: lambda: server.do("play"),
                    350: lambda: server.do("simulate safety 3"),
                    370: lambda: server.do("unlock protective stop"),
                    371: lambda: server.do("play"),
                    390: claim,
                    500: lambda: server.do("simulate slider-frozen on"),
                    501: lambda: server.do("pause"),
                    600: lambda: signal.raise_signal(signal.SIGINT),
                }
            ),
        ):
            code, _, err = run_hardware(server)
            self.assertEqual(code, 130, err)
        lines = err.splitlines()
        for why in (
            r"slider yielding: someone has set the slider to 0\.30",
            r"slider holding: program: paus",
            r"slider holding: safety mode: protective stop",
            r"robot: speed_slider_mask, speed_slider_fraction in use: a field",
            r"slider recovering: slider at most 0\.50 for now, after: new ",
            r"slider fault: slider does not obey: at ",
        ):
            with self.subTest(why=why):
                self.assertTrue(any(re.search(why, t) for t in lines), err)
        # Not one for each of the 600 ticks.
        self.assertLess(len(lines), 150, err)

    def test_a_robot_that_takes_offence_at_zero(self):
        robot = make_robot(start="heartbeat", protective_stop_after_zero=True)
        with serve(robot) as server:
            code, _, err = run_hardware(server, "--duration", 1)
        self.assertEqual(code, 0, err)
        self.assertIn(
            "protective stop, right after the slider left 0: see "
            "minimum_fraction",
            err,
        )

    def test_refuses_what_is_not_fit(self):
        robot = make_robot(start="heartbeat")
        robot.set_safety_mode(SafetyMode.PROTECTIVE_STOP)
        with serve(robot) as server:
            for options, rings, message in (
                ((), "virtual", "safety mode is protective stop"),
                (("--wait", 0.3), "udp://127.0.0.1:0", "names no port"),
                (("--wait", 0), "virtual", "--wait"),
                (("--duration", -1), "virtual", "--duration"),
                *(
                    ((f"--{name}", value), "virtual", f"tofssm: --{name}: must")
                    for name, value in (
                        ("minimum-fraction", 0.5),
                        ("slider-limit", 0),
                        ("robot-port", 70000),
                        ("robot-host", ""),
                    )
                ),
                (
                    (
                        *("--scenario-text", "{law: {rho_reduced: 0.05}}"),
                        *("--minimum-fraction", 0.1),
                    ),
                    "virtual",
                    "--minimum-fraction: must be below the law's reduced "
                    "speed fraction, 0.05",
                ),
                ((), "udp://0.0.0.0:5005", "--allow-remote"),
                *(
                    (option, rings, f"{option[0]}: is only for --rings virtual")
                    for option in (("--seed", 0), ("--human-motion", "a.bvh"))
                    for rings in ("udp://127.0.0.1:5005", "serial:///dev/null")
                ),
                *(
                    (("--robot-text", text), "virtual", message)
                    for text, message in (
                        ("{lenien: true}", "did you mean 'lenient'?"),
                        ("{host: there}", "robot.host: use --robot-host"),
                        ("{write: false}", "robot.write: use --dry-run"),
                        (
                            "{products_register: 48}",
                            "robot.products_register: must be from 0 to 47",
                        ),
                    )
                ),
            ):
                # A run that is not refused ends all the same.
                options = ("--wait", 0.3, *options)
                with self.subTest(message=message, rings=rings):
                    code, out, err = run_hardware(server, *options, rings=rings)
                    self.assertEqual((code, out), (2, ""))
                    self.assertIn(message, err)
                    self.assertEqual(err.count("\n"), 1)
            self.assertEqual(robot.path_time, 0.0)

    def test_an_error_while_it_is_reported_to_stop(self):
        def fail():
            os.kill(os.getpid(), signal.SIGTERM)
            raise RuntimeError("just then")

        robot = make_robot(start="heartbeat")
        with serve(robot) as server, at_ticks({60: fail}):
            code, out, err = run_hardware(server)
        self.assertEqual((code, robot.slider), (130, 0.0), err)
        self.assertEqual(out, "interrupted; slider set to 0\n")

    def test_settings_of_the_connection(self):
        path = self.folder / "run.mcap"
        with serve(make_robot(start="heartbeat")) as server:
            code, _, err = run_hardware(
                server,
                *("--robot-text", "{heartbeat_register: 31}"),
                *("--duration", 0.2, "--record", path),
            )
        self.assertEqual(code, 0, err)
        record = path.read_bytes()
        self.assertIn(b"speed_slider_fraction,input_int_register_31", record)
        self.assertNotIn(b"input_int_register_24", record)

    def test_no_signal_ends_it_before_zero_was_sent(self):
        """One is enough, of any kind; another one comes too late."""
        for numbers in (
            (signal.SIGHUP,),
            (signal.SIGTERM, signal.SIGTERM),
            (signal.SIGINT, signal.SIGHUP, signal.SIGINT),
        ):

            def send(numbers=numbers):
                for number in numbers:
                    os.kill(os.getpid(), number)

            robot = make_robot(start="heartbeat")
            leave = RtdeClient._leave_stopped

            def leave_late(client, send=send, leave=leave):
                send()
                leave(client)

            with (
                self.subTest(numbers=numbers),
                serve(robot) as server,
                at_ticks({100: send}),
                mock.patch.object(RtdeClient, "_leave_stopped", leave_late),
            ):
                before = [signal.getsignal(number) for number in numbers]
                code, out, err = run_hardware(server)
                self.assertEqual(code, 130, err)
                self.assertEqual(out, "interrupted; slider set to 0\n")
                self.assertEqual(robot.slider, 0.0)
                after = [signal.getsignal(number) for number in numbers]
                self.assertEqual(after, before)

    def test_interrupted_while_kernels_are_compiled(self):
        robot = make_robot(start="heartbeat")
        for is_wrapped in (False, True):
            with self.subTest(is_wrapped=is_wrapped), serve(robot) as server:

                def compile_long(*args, is_wrapped=is_wrapped, **kwargs):
                    try:
                        os.kill(os.getpid(), signal.SIGINT)
                        time.sleep(30.0)
                    except KeyboardInterrupt:
                        if is_wrapped:
                            raise RuntimeError("from a library") from None
                        raise

                with mock.patch.object(HardwareLoop, "_warm_up", compile_long):
                    code, out, err = run_hardware(server)
                self.assertEqual((code, out), (130, ""))
                self.assertEqual(err, "tofssm: interrupted before the start\n")
                self.assertEqual(robot.slider, 1.0)

    def test_what_needs_no_robot_is_refused_before_it_is_touched(self):
        robot = make_robot(start="heartbeat")
        with serve(robot) as server:
            for options, message in (
                (("--human-motion", "/nope.bvh"), "/nope.bvh"),
                (("--control-period", "nan"), "--control-period"),
                (("--control-period", "inf"), "--control-period"),
                (("--slider-limit", "nan"), "--slider-limit"),
            ):
                with self.subTest(options=options):
                    path = self.folder / "run.mcap"
                    code, out, err = run_hardware(
                        server, *options, "--record", path, text="{}"
                    )
                    self.assertEqual((code, out), (2, ""))
                    self.assertIn(message, err)
                    self.assertEqual(err.count("\n"), 1, err)
                    self.assertFalse(path.exists())
                    self.assertEqual(robot.slider, 1.0)

    def test_a_run_that_never_begins_spares_the_record_before(self):
        robot = make_robot(start="heartbeat")
        robot.set_safety_mode(SafetyMode.PROTECTIVE_STOP)
        path, out = self.folder / "run.mcap", self.folder / "out"
        path.write_bytes(b"of an earlier run")
        with serve(robot) as server:
            code, _, err = run_hardware(
                server, "--record", path, "--out", out, text=_NOBODY
            )
        self.assertEqual(code, 2, err)
        self.assertEqual(path.read_bytes(), b"of an earlier run")
        self.assertFalse(out.exists())

    def test_a_refusal_says_where_it_leaves_the_slider(self):
        for options, message in (
            ((), "must be normal or reduced; slider set to 0\n"),
            (("--dry-run",), "reduced; nothing was written (dry run)\n"),
        ):
            robot = make_robot(start="heartbeat")
            robot.set_safety_mode(SafetyMode.PROTECTIVE_STOP)
            with self.subTest(options=options), serve(robot) as server:
                code, out, err = run_hardware(server, *options)
                self.assertEqual((code, out), (2, ""))
                self.assertIn(message, err)
                self.assertEqual(err.count("\n"), 1, err)

    def test_a_slider_that_stands_low_stays_low(self):
        for options, highest in (((), 0.1), (("--slider-limit", 0.4), 0.4)):
            path = self.folder / "run.mcap"
            robot = make_robot(start="heartbeat")
            robot.move_slider(0.1)
            with self.subTest(options=options), serve(robot) as server:
                code, _, err = run_hardware(
                    server, "--duration", 1.5, "--record", path, *options
                )
                self.assertEqual(code, 0, err)
                self.assertIn(f"someone has set the slider to {highest}", err)
            fractions = [
                t.command.speed_fraction for t in RunReader(path).read_ticks()
            ]
            self.assertEqual(max(fractions), highest)
            self.assertEqual(run_replay(path)[0], 0)

    def test_robot_is_held_while_rings_are_waited_for(self):
        robot = make_robot(start="heartbeat")
        seen = []

        def wait(link, timeout):
            time.sleep(timeout)
            seen.append(robot.slider)
            if len(seen) == 3:
                # Somebody raises it again.
                robot.slider = 0.8
            return False

        with (
            serve(robot) as server,
            mock.patch.object(RingLink, "wait_for_scans", wait),
        ):
            code, _, err = run_hardware(
                server, "--wait", 1.5, rings="udp://127.0.0.1:47812"
            )
        self.assertEqual(code, 2, err)
        # Before it, the twin was made.
        self.assertEqual({seen[0], seen[-1]}, {0.0}, seen)

    def test_says_what_it_waits_for(self):
        with serve() as server:
            code, _, err = run_hardware(
                server, "--wait", 1.5, rings="udp://127.0.0.1:47811"
            )
            self.assertEqual(code, 2)
            self.assertIn("no scan of base, elbow, tool", err)
            self.assertIn("(waited 1.5 s)", err)
        code, _, err = run_hardware(server, "--wait", 0.3)
        self.assertEqual(code, 2)
        self.assertIn("no report from the robot", err)
        self.assertIn("refused", err)

    def test_a_message_is_a_line(self):
        """Whatever the width of a terminal, as stderr is not one."""
        columns = mock.patch.dict(os.environ, COLUMNS="80")
        quiet = mock.patch.object(hardware_run, "_QUIET", 0.0)
        with serve() as server, columns, quiet:
            _, _, err = run_hardware(
                server, "--wait", 0.3, rings="udp://127.0.0.1:47811"
            )
        # The robot may be waited for as well.
        *_, waiting, refused = err.splitlines()
        self.assertGreater(len(waiting), 80)
        problem = waiting.removeprefix("waiting: ")
        self.assertTrue(refused.startswith(f"tofssm: {problem} (waited"), err)


class TestReady(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario()
        cls.plant = make_cell_plant()
        path = make_program_path(
            cls.scenario.task, ArmKinematics.from_plant(cls.plant)
        )
        cls.q = path.calc_motion(0.5 * path.duration)[0]
        cls.kinematics = ArmKinematics.from_plant(cls.plant)

    def require(self, *, max_deviation=0.5, **fields):
        q = fields.get("position", self.q)
        tool = calc_tcp_offset(self.kinematics)
        pose, *_ = calc_tool_motion(
            self.kinematics, np.array(q), np.zeros(6), make_pose(tool)
        )
        require_ready(
            RobotReport(
                **{
                    "tcp_pose": pose,
                    "tcp_offset": tool,
                    "position": self.q,
                    "velocity": np.zeros(6),
                    "safety_mode": 1,
                    "safety_status": 1,
                }
                | fields
            ),
            self.scenario,
            self.plant,
            max_deviation=max_deviation,
        )

    def test_fit(self):
        self.require()
        self.require(safety_mode=2, safety_status=-1)

    def test_another_robot(self):
        with self.assertRaisesRegex(UserError, "robot: reported tool is"):
            self.require(tcp_pose=np.zeros(6))
        with self.assertRaisesRegex(UserError, "reports no pose of its tool"):
            self.require(tcp_pose=np.full(6, np.nan))

    def test_safety_modes(self):
        for fields in (
            {"safety_mode": 3},
            {"safety_mode": -1, "safety_status": -1},
            {"safety_mode": 99},
            {"safety_status": 5},
        ):
            with self.subTest(**fields):
                with self.assertRaisesRegex(UserError, "safety mode is"):
                    self.require(**fields)

    def test_joints(self):
        far = self.q + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.5])
        with self.assertRaisesRegex(UserError, "from the path of the scenario"):
            self.require(position=far)
        self.require(position=far, max_deviation=np.inf)
        outside = self.q.copy()
        outside[2] = 7.0
        for q in (outside, np.full(6, np.nan)):
            with self.assertRaisesRegex(UserError, "the model's limits"):
                self.require(position=q, max_deviation=np.inf)


if __name__ == "__main__":
    unittest.main()
