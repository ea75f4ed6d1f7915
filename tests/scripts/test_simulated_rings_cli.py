"""The process, with a simulated robot in another process."""

import contextlib
import re
import select
import signal
import socket
import subprocess
import sys
import time
import unittest

from paper_cell import RINGS, make_rings
import pytest

from tofssm_drake.ringlink.ring_address import parse_ring_address
from tofssm_drake.ringlink.ring_link import RingLink, explain_silence
from tofssm_drake.ringlink.ring_receiver import RingDecoder, RingLinkConfig
from tofssm_drake.scripts.main import run


@contextlib.contextmanager
def start(*arguments):
    """Starts tofssm; yields the process and its first line; ends it."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tofssm_drake.scripts.main", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        readable, _, _ = select.select([process.stdout], [], [], 60.0)
        assert readable, "it says nothing"
        line = process.stdout.readline()
        assert line, process.stderr.read()
        yield process, line
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=120.0)


def open_link(address):
    return RingLink(
        addresses=[parse_ring_address(address)],
        decoder=RingDecoder(config=RingLinkConfig(), rings=make_rings()),
    )


class TestSimulatedRings(unittest.TestCase):
    def test_waits_for_the_robot_then_sends_until_it_is_told_to_stop(self):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = str(probe.getsockname()[1])
        with start(
            *("simulated-rings", "--robot-port", port, "--pty"),
            *("--fault", "corrupt:tool@0.1", "--drift", "40"),
        ) as (rings, line):
            self.assertIn("simulated rings, base of 8 sensors, ", line)
            (address,) = re.findall(r"serial:///dev/\S+", line)
            self.assertIn("refused", rings.stderr.readline())
            with (
                open_link(address) as link,
                start(
                    *("simulated-ur", "--port", port),
                    *("--dashboard-port", "-1"),
                ),
            ):
                end = time.monotonic() + 60.0
                while link.get_scans()[1].sequence < 5:
                    self.assertLess(
                        time.monotonic(),
                        end,
                        explain_silence(link.get_status()),
                    )
                    time.sleep(0.01)
                status = link.get_status()
            self.assertGreater(status.corrupt, 10)
            self.assertEqual(status.counts["tool"].delivered, 0)
            for ring in ("base", "elbow"):
                self.assertEqual(status.counts[ring].lost, 0)
            rings.send_signal(signal.SIGTERM)
            out, _ = rings.communicate(timeout=120.0)
            self.assertEqual(rings.returncode, 0)
            for ring in RINGS:
                (count,) = re.findall(rf"{ring} (\d+)", out)
                self.assertGreater(int(count), 20)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either --to"),
        (["--pty", "--to", "udp://127.0.0.1:5005"], "give either --to"),
        (
            ["--to", "127.0.0.1:5005"],
            "--to: '127.0.0.1:5005' is not an address",
        ),
        (["--to", "udp://0.0.0.0:5005"], "every interface"),
        (["--to", "serial:///dev/ttyS0"], "use --pty"),
        (["--pty", "--fault", "silent:wrist@1"], "no ring 'wrist'"),
        (["--pty", "--drift", "nan"], "--drift"),
        (["--pty", "--duration", "-1"], "--duration"),
        (["--pty", "--robot-port", "0"], "tofssm: --robot-port: must be"),
        (["--pty", "--robot-host", ""], "tofssm: --robot-host: must not be"),
        (
            ["--pty", "--robot-text", "{retry: 1}"],
            "--robot-text:1: robot.retry",
        ),
        (["--pty", "--human-motion", "none.bvh"], "none.bvh"),
    ],
)
def test_mistakes_are_told_in_one_line(arguments, message, capfd):
    assert run(["simulated-rings", *arguments]) == 2
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err


if __name__ == "__main__":
    unittest.main()
