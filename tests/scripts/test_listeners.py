"""Where each command listens while it runs: as SECURITY.md lists, no more."""

import ipaddress
import re
import socket
import time

from cell_process import CellProcess, Program
import psutil
import pytest

_PERSONLESS = "{task: {products: 1}, people: {visitor: null}}"
_SHORT = ("--duration", 0.4, "--scenario-text", _PERSONLESS)
# The first ports of which Meshcat takes a free one.
_MESHCAT = range(7000, 7100)


def find_listeners(process):
    """Returns where a process and its children can be reached.

    Returns:
        Protocol, address and port of each open door.
    """
    found = set()
    try:
        for one in (process, *process.children(recursive=True)):
            for connection in one.net_connections(kind="inet"):
                is_tcp = connection.type == socket.SOCK_STREAM
                is_open = not connection.raddr and (
                    not is_tcp or connection.status == psutil.CONN_LISTEN
                )
                if is_open and connection.laddr:
                    kind = "tcp" if is_tcp else "udp"
                    found.add((kind, *connection.laddr))
    except psutil.NoSuchProcess:
        # It has just ended.
        pass
    return found


def watch(program, until=lambda: False):
    """Returns where a program could be reached until it ended."""
    process, found = psutil.Process(program.process.pid), set()
    deadline = time.monotonic() + 600.0
    while program.process.poll() is None and not until():
        assert time.monotonic() < deadline, program.out + program.err
        found |= find_listeners(process)
        time.sleep(0.02)
    return found


def run(*arguments):
    """Runs a command; returns where it could be reached."""
    program = Program(*arguments)
    try:
        found = watch(program)
        assert program.process.returncode == 0, program.err
    finally:
        program.end()
    return found


def require_loopback(found):
    for _, address, _ in found:
        assert ipaddress.ip_address(address).is_loopback, found


@pytest.mark.long
def test_simulate(tmp_path):
    found = run("simulate", *_SHORT, "--out", tmp_path / "a", "--no-recording")
    assert found == set()
    assert run("describe", tmp_path / "a") == set()
    found = run("simulate", *_SHORT, "--out", tmp_path / "b")
    require_loopback(found)
    assert {kind for kind, _, _ in found} <= {"tcp"}
    assert all(port in _MESHCAT for _, _, port in found), found
    assert len(found) <= 1


@pytest.mark.long
def test_experiments(tmp_path):
    found = run(
        *("experiments", "--sensing", "ideal", "--ssm", "vo"),
        *("--trials", 1, "--workers", 2, "--duration", 0.4),
        *("--scenario-text", "{task: {products: 1}}"),
        *("--out", tmp_path / "out"),
    )
    assert found
    require_loopback(found)
    assert {kind for kind, _, _ in found} == {"tcp"}


@pytest.mark.long
def test_robot_rings_and_hardware(tmp_path):
    record = tmp_path / "run.mcap"
    with CellProcess("udp") as cell:
        runner = cell.start_runner("--dry-run", "--record", record)
        ring_port = int(cell.address.rpartition(":")[2])

        def is_running():
            # Whatever it says of the robot: a busy computer may be late.
            return re.search(r"\d s  (stop|reduced|normal)", runner.err)

        assert watch(runner, is_running) == {("udp", cell.host, ring_port)}
        assert find_listeners(psutil.Process(runner.process.pid)) == {
            ("udp", cell.host, ring_port)
        }
        robot = find_listeners(psutil.Process(cell.robot.process.pid))
        rings = find_listeners(psutil.Process(cell.rings.process.pid))
        dashboard = int(cell.robot.wait_for(r"dashboard at [\d.]+:(\d+)")[1])
    assert robot == {
        ("tcp", cell.host, 30004),
        ("tcp", cell.host, dashboard),
    }
    # From where they send; nothing that comes there is read.
    ((kind, address, _),) = rings
    assert (kind, address) == ("udp", cell.host)
    assert run("replay", record) == set()


@pytest.mark.long
def test_hardware_demo(tmp_path):
    found = run(
        *("hardware-demo", "--products", 1, "--duration", 5),
        *("--out", tmp_path / "out"),
    )
    require_loopback(found)
    assert {kind for kind, _, _ in found} == {"tcp", "udp"}
    # The robot's, the rings', and from where they send.
    assert len(found) == 3
