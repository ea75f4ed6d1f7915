"""`tofssm simulated-ur` in a process of its own."""

import contextlib
import io
from pathlib import Path
import re
import signal
import socket
import time
import unittest

import pytest
from robot_process import find_free_host, start, start_robot

from tofssm_drake.robots.robot_modes import RuntimeState
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig
from tofssm_drake.scripts.main import run

# Of a connection; a busy computer must not matter, s.
_PATIENT = {
    "connect_timeout": 60.0,
    "reply_timeout": 60.0,
    "stream_timeout": 60.0,
}
_HERE = Path(__file__).parent


def wait_for(client, condition, timeout=120.0):
    """Returns the first report for which the condition holds."""
    deadline = time.monotonic() + timeout
    report = client.get_report()
    while time.monotonic() < deadline:
        report = client.wait_for_report(after=report.sequence, timeout=0.5)
        if condition(report):
            return report
    raise AssertionError(f"gave up waiting: {client.get_status()}")


class TestProcess(unittest.TestCase):
    def test_heartbeat_and_end(self):
        self.check_series("e")

    @pytest.mark.long
    def test_heartbeat_and_end_of_the_cb3_series(self):
        self.check_series("cb3")

    def check_series(self, series):
        host = find_free_host()
        with start_robot(
            *("--host", host, "--dashboard-port", 0),
            *("--series", series, "--start", "heartbeat"),
            *("--watchdog", 0.2, "--ramp", 0.05),
        ) as process:
            line = process.stdout.readline()
            self.assertRegex(
                line,
                rf"simulated UR10, \d+ Hz, RTDE at {host}:30004, "
                rf"dashboard at {host}:\d+",
            )
            self.check_watchdog(host)
            self.check_dashboard(host, int(re.search(r":(\d+)$", line)[1]))
            process.send_signal(signal.SIGTERM)
            self.assertEqual(process.wait(120), 0)
            self.assertEqual(process.stdout.read(), "")

    def check_watchdog(self, host):
        """If the monitor is killed, the robot's program stops on its own."""
        config = RtdeConfig(**_PATIENT, host=host, write=False)
        with RtdeClient(config) as watcher:
            report = wait_for(watcher, lambda r: r.sequence >= 0)
            self.assertEqual(report.runtime_state, RuntimeState.STOPPED)
            with start([_HERE / "heart.py"], host, 30004) as heart:
                self.assertEqual(heart.stdout.readline(), "beating\n")
                wait_for(
                    watcher,
                    lambda r: (
                        r.runtime_state == RuntimeState.PLAYING
                        and r.velocity.any()
                    ),
                )
                heart.kill()
                stopped = wait_for(
                    watcher,
                    lambda r: (
                        r.runtime_state == RuntimeState.STOPPED
                        and not r.velocity.any()
                    ),
                )
            # The slider is still where the killed one left it.
            self.assertEqual(stopped.target_speed_fraction, 1.0)

    def check_dashboard(self, host, port):
        with socket.create_connection((host, port), 5.0) as console:
            lines = console.makefile("rw", newline="\n")
            self.assertIn("Dashboard Server", lines.readline())
            lines.write("programState\n")
            lines.flush()
            self.assertEqual(lines.readline(), "STOPPED pick_and_place.urp\n")


class TestMistakes(unittest.TestCase):
    def test_one_line_and_code_2(self):
        for options, message in (
            (("--series", "cb2"), "--series: 'cb2' is unknown"),
            (("--port", "70000"), "--port: must be a TCP port"),
            (("--dashboard-port", "-2"), "--dashboard-port: must be"),
            (("--products", "0"), "--products: "),
            (("--ramp", "-1"), "--ramp: must be from 0 to 10 s"),
            (("--ramp", "nan"), "--ramp: must be from 0 to 10 s"),
            (("--start", "later"), "--start: 'later' is unknown"),
            (("--watchdog", "-1"), "--watchdog: must be from 0 to 60 s"),
            (("--watchdog-action", "shout"), "--watchdog-action: 'shout'"),
            (("--skip-every", "1"), "--skip-every: must be 0 or at least 2"),
            (("--fragment", "-1"), "--fragment: must be 0 or more"),
            (("--host", "192.0.2.1"), "cannot listen at 192.0.2.1:30004"),
        ):
            with self.subTest(options=options):
                errors = io.StringIO()
                with contextlib.redirect_stderr(errors):
                    self.assertEqual(run(["simulated-ur", *options]), 2)
                (line,) = errors.getvalue().splitlines()
                self.assertTrue(line.startswith(f"tofssm: {message}"), line)
