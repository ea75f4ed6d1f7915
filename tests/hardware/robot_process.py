"""A simulated robot in a process of its own, at a free address."""

import contextlib
import os
import socket
import subprocess
import sys


def find_free_host(port=30004):
    """Returns a loopback address at which nobody listens on that port."""
    number = os.getpid()
    for i in range(2, 250):
        host = f"127.{1 + number // 250 % 250}.{1 + number % 250}.{i}"
        with contextlib.suppress(OSError), socket.create_server((host, port)):
            return host
    raise AssertionError("no free address")


@contextlib.contextmanager
def start(program, *arguments):
    """Starts a program of this folder or a module; ends it by its id."""
    process = subprocess.Popen(
        [sys.executable, *program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def start_robot(*options):
    return start(["-m", "tofssm_drake.scripts.main", "simulated-ur"], *options)
