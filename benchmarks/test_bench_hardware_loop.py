"""The whole chain over real sockets: robot, rings and `tofssm hardware`.

Three processes on this machine, three rings, 600 rays of the mask. Robot and
rings, which are computers of their own in truth, leave the last processor to
the monitor, if there is another one. The times are those of the record; the
robot notes when it is answered, too, which is everything that a robot would
see.

BENCH_SECONDS is how long each run takes, 60 s if it is not set.
"""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys

from hardware_figures import read_figures
import numpy as np
import pytest

_SECONDS = float(os.environ.get("BENCH_SECONDS", 60))
_TOFSSM = (sys.executable, "-m", "tofssm_drake.scripts.main")
_ROBOT = os.path.join(os.path.dirname(__file__), "clocked_robot.py")


@contextlib.contextmanager
def start(*command):
    """Starts a process and yields the first line that it prints."""
    usual = os.sched_getaffinity(0)
    # What is started within keeps to them.
    os.sched_setaffinity(0, usual - {max(usual)} or usual)
    try:
        process = subprocess.Popen(
            [str(part) for part in command], stdout=subprocess.PIPE, text=True
        )
    finally:
        os.sched_setaffinity(0, usual)
    try:
        yield process.stdout.readline()
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30.0)


def run_hardware(series, folder, seconds=_SECONDS, options=()):
    """Runs the three processes and returns the figures."""
    record, notes = folder / "run.mcap", folder / "robot.json"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        frames = f"udp://127.0.0.1:{probe.getsockname()[1]}"
    with start(sys.executable, _ROBOT, series, notes) as port:
        robot = ("--robot-host", "127.0.0.1", "--robot-port", port.strip())
        with start(*_TOFSSM, "simulated-rings", *robot, "--to", frames):
            subprocess.run(
                [
                    *(*_TOFSSM, "hardware", *robot, "--rings", frames),
                    *("--record", str(record), "--any-pose", "--real-time"),
                    *("--duration", str(seconds), *options),
                ],
                check=True,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
    return read_figures(record, json.loads(notes.read_text()))


def list_figures(figures):
    """Yields names and values of what is reported."""
    for name, times in (
        ("answer", figures.answer),
        ("round trip", figures.round_trip),
        ("frame to command", figures.frame),
        ("frame to fall of the command", figures.change),
    ):
        for part, value in (
            ("median", np.median(times)),
            ("p99", np.quantile(times, 0.99)),
        ):
            yield f"{name}, {part}, ms", 1e3 * value
            yield f"{name}, {part}, cycles", value / figures.period
    yield "packages", figures.ticks
    yield "packages missed", figures.missed
    yield "of them not sent by the robot", figures.left_out
    yield "packages not answered", figures.unanswered
    yield "CPU of one core, %", 100.0 * figures.busy


@pytest.mark.parametrize("series", ["cb3", "e"])
def test_hardware_loop(benchmark, tmp_path, series):
    """125 Hz and 500 Hz."""
    runs = []
    benchmark.pedantic(
        lambda: runs.append(run_hardware(series, tmp_path)),
        rounds=1,
        iterations=1,
    )
    (figures,) = runs
    assert figures.ticks > 10
    assert len(figures.frame) > 10
    benchmark.extra_info.update(list_figures(figures))
