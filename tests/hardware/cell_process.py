"""Robot, rings and runner as processes, and a client that watches the robot."""

import contextlib
import dataclasses as dc
import math
import os
from pathlib import Path
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

from robot_process import find_free_host

from tofssm_drake.messages import RobotReport
from tofssm_drake.robots.robot_modes import RuntimeState
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig

NOBODY = "{people: {visitor: null}}"
_MAIN = ("-m", "tofssm_drake.scripts.main")
# Starts a runner that tolerates a busy computer.
PATIENT = (Path(__file__).parent / "patient_runner.py",)
# Longest time for a process to start, s.
_PATIENCE = 600.0
# Longer than that of a runner.
_ROBOT_PRIORITY = 20
# A robot that does not rest within this time never does, s.
_REST = 15.0


@dc.dataclass
class Seen:
    """What a robot did after something happened, s; inf: never."""

    zero: float
    """Its slider was at 0, and stayed there."""
    still: float
    """It stood still, and stayed so."""
    slider: float
    """Where its slider was at the end."""
    reports: list[RobotReport]
    """What it reported from then on."""


class Watcher:
    """Another client of a robot, which keeps all that it reports."""

    def __init__(self, host: str):
        self._client = RtdeClient(RtdeConfig(host=host, write=False))
        self._reports: list[RobotReport] = []
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()

    def _watch(self):
        sequence = -1
        while not self._closed.is_set():
            report = self._client.wait_for_report(after=sequence, timeout=0.1)
            if report.sequence > sequence:
                sequence = report.sequence
                self._reports.append(report)

    @property
    def report(self) -> RobotReport:
        """The newest."""
        return self._client.get_report()

    def wait_for(self, condition, timeout=_PATIENCE):
        """Returns the first report from now on for which a condition holds."""
        deadline = time.monotonic() + timeout
        report = self.report
        while not (report.sequence >= 0 and condition(report)):
            assert time.monotonic() < deadline, f"gave up waiting: {report}"
            report = self._client.wait_for_report(
                after=report.sequence, timeout=0.5
            )
        return report

    def see(self, start: float, *, settled: float = 0.5) -> Seen:
        """Waits until the robot rests, and returns what it did.

        Args:
            start: Host's time of what happened, s.
            settled: For how long it must rest, s.
        """
        deadline = time.monotonic() + _REST
        while True:
            is_late = time.monotonic() > deadline
            reports = [r for r in list(self._reports) if r.time >= start]
            end = _find_rest(reports, settled)
            if end or is_late:
                break
            time.sleep(0.01)
        assert reports, "the robot does not report"
        reports = reports[: end or None]
        return Seen(
            zero=_find_last(reports, start, lambda r: r.target_speed_fraction),
            still=_find_last(reports, start, lambda r: r.velocity.any()),
            slider=reports[-1].target_speed_fraction,
            reports=reports,
        )

    def close(self):
        """Ends the connection."""
        self._closed.set()
        self._thread.join()
        self._client.close()


def _find_rest(reports, settled):
    """Returns the number of reports until the robot rested; 0: never."""
    rest = math.inf
    for i, report in enumerate(reports):
        rest = math.inf if report.velocity.any() else min(rest, report.time)
        if report.time - rest >= settled:
            return i + 1
    return 0


def _find_last(reports, start, is_up):
    """Returns from when on something stayed down, s after the start."""
    last = -1
    for i, report in enumerate(reports):
        if is_up(report):
            last = i
    if last + 1 >= len(reports):
        return math.inf
    return reports[last + 1].time - start


class Program:
    """A process whose output goes to files, so that it never blocks."""

    def __init__(self, *arguments, main=_MAIN, limit_file_size=0):
        self._folder = tempfile.TemporaryDirectory()
        self._out = Path(self._folder.name) / "out"
        self._err = Path(self._folder.name) / "err"
        command = [sys.executable, *main, *map(str, arguments)]
        if limit_file_size:
            # In blocks of 1 kB, which is how bash counts.
            command = [
                *("bash", "-c", f'ulimit -f {limit_file_size}; exec "$@"'),
                *("bash", *command),
            ]
        with self._out.open("w") as out, self._err.open("w") as err:
            self.process = subprocess.Popen(command, stdout=out, stderr=err)

    @property
    def out(self) -> str:
        """What it printed so far."""
        return self._out.read_text()

    @property
    def err(self) -> str:
        """What it printed on stderr so far."""
        return self._err.read_text()

    def wait_for(self, pattern: str, timeout=_PATIENCE) -> re.Match:
        """Waits until it has printed something on stdout or stderr."""
        deadline = time.monotonic() + timeout
        while not (match := re.search(pattern, self.out + self.err)):
            assert self.process.poll() is None, self.out + self.err
            assert time.monotonic() < deadline, (
                f"no {pattern!r} in: {self.out}{self.err}"
            )
            time.sleep(0.02)
        return match

    def end(self) -> None:
        """Ends it by its id, if it has not ended."""
        if self.process.poll() is None:
            # A stopped process could not end.
            self.process.send_signal(signal.SIGCONT)
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(120.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._folder.cleanup()


class CellProcess:
    """A simulated robot at work, rings around it, and runners.

    Args:
        rings: How simulated rings send: "udp" or "pty"; None: there are none.
    """

    def __init__(self, rings: str | None = None):
        self._stack = contextlib.ExitStack()
        self.host = find_free_host()
        self.robot = self._start(
            *("simulated-ur", "--host", self.host, "--dashboard-port", 0),
            *("--start", "heartbeat", "--watchdog", 0.2, "--loop"),
        )
        # A real controller is a separate computer: nothing may delay it.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(
                self.robot.process.pid,
                os.SCHED_FIFO,
                os.sched_param(_ROBOT_PRIORITY),
            )
        self.rings = None
        self.address = "virtual"
        if rings is not None:
            self.rings = self.start_rings(rings)
            self.address = self.rings.wait_for(r"(udp|serial)://\S+")[0]
        match = self.robot.wait_for(r"dashboard at ([0-9.]+):(\d+)")
        self._dashboard = match[1], int(match[2])
        self.watcher = Watcher(self.host)
        self._stack.callback(self.watcher.close)

    def __enter__(self) -> "CellProcess":
        return self

    def __exit__(self, *_) -> None:
        self._stack.close()

    def _start(self, *arguments, **options):
        program = Program(*arguments, **options)
        self._stack.callback(program.end)
        return program

    def start_rings(self, kind: str) -> Program:
        """Starts simulated rings."""
        to = ("--pty",)
        if kind == "udp":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((self.host, 0))
                port = probe.getsockname()[1]
            to = ("--to", f"udp://{self.host}:{port}")
        return self._start(
            *("simulated-rings", "--robot-host", self.host, *to),
            *("--scenario-text", NOBODY),
        )

    def start_runner(self, *options, **settings) -> Program:
        """Starts `tofssm hardware`."""
        return self._start(
            *("hardware", "--robot-host", self.host),
            *("--rings", self.address, "--scenario-text", NOBODY),
            *("--any-pose", "--wait", _PATIENCE, "--slider-limit", 1),
            "--real-time",
            *options,
            **settings,
        )

    def do(self, line: str) -> None:
        """Sends a command to the robot's dashboard."""
        with socket.create_connection(self._dashboard, 10.0) as console:
            lines = console.makefile("rw", newline="\n")
            lines.readline()
            lines.write(line + "\n")
            lines.flush()
            answer = lines.readline()
            assert "could not" not in answer, answer

    def wait_for_full_speed(self, runner: Program) -> None:
        """Waits until the program runs fast; restarts it whenever it stops.

        A machine that is too busy for 0.2 s trips the watchdog.

        Args:
            runner: Must be monitoring the robot first.
        """
        runner.wait_for("normal, slider")
        played = -math.inf

        def is_fast(report):
            nonlocal played
            assert runner.process.poll() is None, runner.err + runner.out
            if (
                report.runtime_state
                in (RuntimeState.STOPPED, RuntimeState.PAUSED)
                and report.time - played > 0.5
            ):
                played = report.time
                self.do("play")
            return (
                report.runtime_state == RuntimeState.PLAYING
                and report.target_speed_fraction == 1.0
                and abs(report.velocity[0]) > 1.5
            )

        self.watcher.wait_for(is_fast)
