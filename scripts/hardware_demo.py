"""`tofssm hardware-demo`: robot, rings and monitor, each in a process."""

from collections.abc import Iterator
import contextlib
from pathlib import Path
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from typing import Annotated

import typer

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.errors import UserError, require
from tofssm_drake.laws.config import CONFIGURATIONS
import tofssm_drake.scripts.options as options
from tofssm_drake.scripts.simulate import (
    catch_stop,
    make_folder,
    override,
)

_HOST = "127.0.0.1"
# One wait for the monitor, s; then signals are checked.
_WAIT = 0.1
# A process that does not end within this time, s, is killed.
_FAREWELL = 20.0


def hardware_demo(
    products: Annotated[
        int, typer.Option(help="How many products are picked and placed.")
    ] = 10,
    ssm: Annotated[
        str,
        typer.Option(
            help=f"Safety law: {options.SAFETY_LAWS}.",
            metavar="|".join(CONFIGURATIONS),
        ),
    ] = CONFIGURATIONS[0],
    duration: Annotated[
        float,
        typer.Option(help="Longest run, s; 0: until all products are placed."),
    ] = 0.0,
    out: Annotated[
        Path,
        typer.Option(
            parser=options.parse_path,
            help="Folder for the results.",
            metavar="DIR",
        ),
    ] = Path("out/hardware"),
) -> int:
    """Run the monitor on a simulated robot and simulated rings.

    Three processes on this machine, which communicate only over sockets: the
    robot's controller, the rings around a walking person, and the monitor. The
    demo runs in real time. Ctrl-C stops the robot, then all of them.
    """
    require(
        1 <= products <= 10,
        f"--products: must be from 1 to 10, got {products}",
    )
    require(duration >= 0.0, f"--duration: must be 0 or more, got {duration:g}")
    scenario = f"{{task: {{products: {products}}}}}"
    override(load_scenario(text=scenario), ssm=ssm)
    make_folder(out)
    kept = out / "run.mcap"
    require(not kept.is_dir(), f"--out: {kept} is a folder")
    robot_port, ring_port = _find_port(socket.SOCK_STREAM), _find_port()
    with (
        catch_stop(until_end=True) as stopped,
        tempfile.TemporaryDirectory() as folder,
        _start(
            *("simulated-ur", "--host", _HOST, "--port", robot_port),
            *("--dashboard-port", -1, "--products", products),
            *("--start", "heartbeat", "--watchdog", 0.2),
        ),
        _start(
            *("simulated-rings", "--robot-host", _HOST),
            *("--robot-port", robot_port),
            *("--to", f"udp://{_HOST}:{ring_port}"),
            *("--scenario-text", scenario),
        ),
    ):
        if stopped:
            print("interrupted before the start")
            return 130
        record = Path(folder) / "run.mcap"
        with _spawn(
            *("hardware", "--robot-host", _HOST, "--robot-port", robot_port),
            *("--rings", f"udp://{_HOST}:{ring_port}"),
            *("--scenario-text", scenario, "--ssm", ssm),
            *("--duration", duration, "--record", record, "--out", out),
        ) as monitor:
            code = _wait(monitor, stopped)
        if record.is_file() and out.is_dir():
            shutil.move(record, kept)
            print(f"record: {kept}")
    return code


def _find_port(kind=socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((_HOST, 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def _spawn(*arguments, **options) -> Iterator[subprocess.Popen]:
    """Starts one of our processes and ends it afterwards.

    It gets its own session: otherwise Ctrl-C would end robot and rings before
    the monitor has stopped the robot.
    """
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "tofssm_drake.scripts.main"),
            *map(str, arguments),
        ],
        start_new_session=True,
        **options,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            process.communicate(timeout=_FAREWELL)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


@contextlib.contextmanager
def _start(*arguments) -> Iterator[None]:
    """Starts a process, waits until it is ready, ends it afterwards."""
    with _spawn(*arguments, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None  # It is a pipe.
        line = process.stdout.readline()
        if not line:
            raise UserError(f"{arguments[0]} did not start")
        print(line, end="", flush=True)
        yield


def _wait(process, stopped) -> int:
    """Waits for the end; passes on the first signal."""
    is_passed_on = False
    while True:
        try:
            return process.wait(_WAIT)
        except subprocess.TimeoutExpired:
            if stopped and not is_passed_on:
                is_passed_on = True
                process.send_signal(stopped[0])
