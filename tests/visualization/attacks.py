"""What a viewer must survive, or at least the run that it shows."""

import base64
import os
import socket
import time

import psutil

DEADLINE = 300.0
"""No attack waits longer, s."""


def find_viewer() -> psutil.Process:
    """Returns the viewer of this process."""
    (viewer,) = (
        child
        for child in psutil.Process().children()
        if "tofssm_drake.diagrams.viewer_process" in child.cmdline()
    )
    return viewer


def kill(viewer: psutil.Process) -> None:
    """Kills it, as a system without memory does."""
    viewer.kill()
    viewer.wait(DEADLINE)


def send_garbage(viewer: psutil.Process) -> None:
    """Sends five bytes that are no message, as any program here may."""
    port = wait_for_port(viewer)
    with socket.create_connection(("localhost", port), DEADLINE) as browser:
        key = base64.b64encode(os.urandom(16)).decode()
        browser.sendall(
            f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\n"
            "Upgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
            "".encode()
        )
        assert b" 101 " in browser.recv(4096)
        # A final binary frame of five bytes, masked with 0.
        browser.sendall(bytes([0x82, 0x85, 0, 0, 0, 0]) + 5 * b"\xc1")
        # What listens dies of it; the rest, when it draws the next frame.
        wait_for(lambda: not list_ports(viewer))


def list_ports(viewer: psutil.Process) -> list[int]:
    """Returns the ports on which it listens; those of a dead one are none."""
    try:
        return [
            connection.laddr.port
            for connection in viewer.net_connections()
            if connection.status == psutil.CONN_LISTEN
        ]
    except psutil.Error:
        return []


def wait_for_port(viewer: psutil.Process) -> int:
    """Returns the port on which it listens, when it does."""
    wait_for(lambda: list_ports(viewer))
    return list_ports(viewer)[0]


def wait_for(condition) -> None:
    """Waits until something is so."""
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.02)
