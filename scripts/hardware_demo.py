"""`tofssm hardware-demo`: robot, rings and monitor, a process each."""

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

from tofssm_drake.errors import UserError, require

_HOST = "127.0.0.1"


def hardware_demo(
    products: Annotated[
        int, typer.Option(help="How many the robot picks and places.")
    ] = 10,
    ssm: Annotated[
        str, typer.Option(help="Safety law: vo, vr or sm.", metavar="vo|vr|sm")
    ] = "vo",
    duration: Annotated[
        float,
        typer.Option(help="For how long, s; 0: until all is placed."),
    ] = 0.0,
    out: Annotated[
        Path, typer.Option(help="Folder for the results.", metavar="DIR")
    ] = Path("out/hardware"),
) -> int:
    """Run the hardware's program on a simulated robot and simulated rings.

    Three processes on this machine, which know of each other only what goes
    over sockets: the robot's controller, the rings around a person who walks,
    and the monitor. Takes as long as the robot does.
    """
    require(
        1 <= products <= 10,
        f"--products: must be from 1 to 10, got {products}",
    )
    scenario = f"{{program: {{products: {products}}}}}"
    robot_port, ring_port = _find_port(socket.SOCK_STREAM), _find_port()
    with (
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
        record = Path(folder) / "run.mcap"
        monitor = _spawn(
            *("hardware", "--robot-host", _HOST, "--robot-port", robot_port),
            *("--rings", f"udp://{_HOST}:{ring_port}"),
            *("--scenario-text", scenario, "--ssm", ssm),
            *("--duration", duration, "--record", record, "--out", out),
        )
        code = _wait(monitor)
        if record.is_file() and out.is_dir():
            shutil.move(record, out / "run.mcap")
            print(f"record: {out / 'run.mcap'}")
    return code


def _find_port(kind=socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((_HOST, 0))
        return probe.getsockname()[1]


def _spawn(*arguments, **options):
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "tofssm_drake.scripts.main"),
            *map(str, arguments),
        ],
        **options,
    )


@contextlib.contextmanager
def _start(*arguments) -> Iterator[None]:
    """Starts a process, waits until it is ready, ends it afterwards."""
    process = _spawn(*arguments, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        if not line:
            raise UserError(f"{arguments[0]} did not start")
        print(line, end="", flush=True)
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate()


def _wait(process) -> int:
    """Waits for the end; Ctrl-C reaches the process by itself."""
    while True:
        try:
            return process.wait()
        except KeyboardInterrupt:
            continue
