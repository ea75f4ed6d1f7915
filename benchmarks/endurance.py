"""Watches memory, threads and open files of long runs.

`make endurance` runs the monitor beside a simulated robot and simulated rings
for an hour, in real time, and simulates an hour. Each process is looked at
every half minute. Prints what each used in the second quarter of its run and
in the last, when all that is loaded late is loaded.
"""

import argparse
import contextlib
import dataclasses as dc
from pathlib import Path
import socket
import statistics
import subprocess
import sys
import tempfile
import time

import psutil

_HOST = "127.0.0.1"
_INTERVAL = 30.0
_TASK = (
    "{task: !Waypoints {rounds: 1000, waypoints: ["
    "{joints: [-1.5, -1.6, 1.6, -1.6, -1.57, 0.0], speed: 0.6}, "
    "{joints: [0.3, -1.3, 1.3, -1.6, -1.57, 0.0], speed: 0.6}]}}"
)


@dc.dataclass(frozen=True, kw_only=True)
class Use:
    """What a process uses at one time."""

    memory: float
    """Resident, MB."""
    threads: int
    files: int
    """Open files and sockets."""


def look_at(process: psutil.Process) -> Use:
    """Returns what a process uses now."""
    with process.oneshot():
        return Use(
            memory=process.memory_info().rss / 1e6,
            threads=process.num_threads(),
            files=process.num_fds(),
        )


def describe(name: str, uses: list[Use]) -> str:
    """Returns one line: the second quarter of a run against its last."""
    n = len(uses) // 4
    early, late = uses[n : 2 * n], uses[-n:]
    parts = []
    for field in dc.fields(Use):
        before, after = (
            statistics.median(getattr(use, field.name) for use in part)
            for part in (early, late)
        )
        parts.append(f"{field.name} {before:.4g} -> {after:.4g}")
    return f"{name}: {', '.join(parts)} ({len(uses)} looks)"


@contextlib.contextmanager
def start(*arguments):
    """Runs a command of the project until the block is left."""
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "tofssm_drake.scripts.main"),
            *map(str, arguments),
        ],
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


def watch(processes: dict[str, subprocess.Popen], duration: float) -> None:
    """Looks at processes until the last of them ends, and prints.

    Args:
        processes: By name; the run is that of the last.
        duration: Expected, s; four looks at least.
    """
    *_, main = processes.values()
    uses: dict[str, list[Use]] = {name: [] for name in processes}
    interval = min(_INTERVAL, duration / 20.0)
    said = None
    while said is None:
        for name, process in processes.items():
            with contextlib.suppress(psutil.Error):
                uses[name].append(look_at(psutil.Process(process.pid)))
        with contextlib.suppress(subprocess.TimeoutExpired):
            said, _ = main.communicate(timeout=interval)
    print(*said.decode().splitlines()[-3:], sep="\n")
    for name, seen in uses.items():
        print(describe(name, seen), flush=True)


def run_hardware(duration: float, folder: Path) -> None:
    """Runs robot, rings and monitor over sockets, with a record."""
    robot, rings = find_port(socket.SOCK_STREAM), find_port(socket.SOCK_DGRAM)
    task = ("--scenario-text", _TASK)
    to_robot = ("--robot-host", _HOST, "--robot-port", robot)
    with (
        start(
            *("simulated-ur", "--host", _HOST, "--port", robot, *task),
            *("--dashboard-port", -1, "--start", "heartbeat"),
        ) as ur,
        start(
            *("simulated-rings", *to_robot, *task),
            *("--to", f"udp://{_HOST}:{rings}"),
        ) as devices,
    ):
        assert ur.stdout is not None
        ur.stdout.readline()
        with start(
            *("hardware", *to_robot, *task, "--any-pose"),
            *("--rings", f"udp://{_HOST}:{rings}"),
            *("--duration", duration, "--record", folder / "run.mcap"),
        ) as monitor:
            watch(
                {
                    "simulated-ur": ur,
                    "simulated-rings": devices,
                    "hardware": monitor,
                },
                duration,
            )
    size = (folder / "run.mcap").stat().st_size
    print(f"hardware: ended with {monitor.returncode}, {size / 1e6:.1f} MB")


def run_simulation(duration: float, folder: Path) -> None:
    """Simulates; its samples grow with the run, as they are its result."""
    began = time.monotonic()
    with start(
        *("simulate", "--no-recording", "--scenario-text", _TASK),
        *("--duration", duration, "--out", folder / "simulated"),
    ) as simulation:
        # On a slow machine it takes half as long as what it simulates.
        watch({"simulate": simulation}, duration / 4.0)
    size = (folder / "simulated" / "samples.parquet").stat().st_size
    print(
        f"simulate: ended with {simulation.returncode} after "
        f"{time.monotonic() - began:.0f} s, samples of {size / 1e6:.1f} MB"
    )


def find_port(kind: socket.SocketKind) -> int:
    """Returns a free port."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((_HOST, 0))
        return probe.getsockname()[1]


def main() -> None:
    """Runs both, or one of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--only", choices=("hardware", "simulation"))
    options = parser.parse_args()
    duration = 3600.0 * options.hours
    with tempfile.TemporaryDirectory() as folder:
        if options.only != "simulation":
            run_hardware(duration, Path(folder))
        if options.only != "hardware":
            run_simulation(duration, Path(folder))


if __name__ == "__main__":
    main()
