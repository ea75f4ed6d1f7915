"""Sends far more datagrams than rings do."""

from collections.abc import Iterator
import contextlib
import subprocess
import sys

from tofssm_drake.ringlink.ring_address import UdpAddress

# 10,000 a second.
_SENDER = """
import socket, sys, time
data, address = bytes.fromhex(sys.argv[1]), (sys.argv[2], int(sys.argv[3]))
start, sent = time.monotonic(), 0
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
    sender.bind((sys.argv[2], 0))
    while True:
        while sent < 10_000 * (time.monotonic() - start):
            sender.sendto(data, address)
            sent += 1
        time.sleep(0.001)
"""


@contextlib.contextmanager
def flood(address: UdpAddress, data: bytes) -> Iterator[None]:
    """Sends a datagram from a link's own address, again and again."""
    where = (address.host, str(address.port))
    sender = subprocess.Popen(
        [sys.executable, "-c", _SENDER, data.hex(), *where]
    )
    try:
        yield
    finally:
        sender.kill()
        sender.wait()
