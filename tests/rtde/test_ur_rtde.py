"""The simulated controller, checked with a widely used library."""

import json
from pathlib import Path
import subprocess
import sys
import unittest

import numpy as np
import pytest
from robot_process import find_free_host, start_robot
from robot_room import make_kinematics

from tofssm_drake.robots.robot_modes import RuntimeState
from tofssm_drake.rtde.model_match import make_pose
from tofssm_drake.rtde.simulated_ur import (
    calc_tcp_offset,
    calc_tool_motion,
)

_PEER = Path(__file__).parent / "ur_rtde_peer.py"


class TestUrRtde(unittest.TestCase):
    def check(self, host):
        peer = subprocess.run(
            [sys.executable, _PEER, host],
            capture_output=True,
            text=True,
            timeout=60,
        )
        self.assertEqual(peer.returncode, 0, peer.stderr)
        seen = json.loads(peer.stdout)
        self.assertEqual(
            [name for name, value in seen.items() if value is False], []
        )
        self.assertEqual(seen["robot_mode"], 7)
        self.assertEqual(seen["safety_mode"], 1)
        self.assertEqual(seen["safety_bits"], 1)
        self.assertEqual(seen["robot_status"], 1)
        self.assertEqual(seen["voltage"], 48.0)
        # The program waits for its heartbeat: the robot stands.
        self.assertEqual(seen["runtime_state"], RuntimeState.STOPPED)
        pose, *_ = calc_tool_motion(
            make_kinematics(),
            np.array(seen["q"]),
            np.zeros(6),
            make_pose(calc_tcp_offset(make_kinematics())),
        )
        np.testing.assert_allclose(seen["tcp_pose"], pose, atol=1e-9)

    def test_cb3_series(self):
        self.check_robots(("--series", "cb3"))

    @pytest.mark.long
    def test_e_series(self):
        self.check_robots(
            ("--series", "e"),
            ("--series", "e", "--text-messages", "--fragment", 100),
        )

    def check_robots(self, *cases):
        for options in cases:
            host = find_free_host()
            with (
                self.subTest(options=options),
                start_robot(
                    *("--host", host, "--dashboard-port", -1),
                    *("--start", "heartbeat"),
                    *options,
                ) as process,
            ):
                self.assertIn(f"{host}:30004", process.stdout.readline())
                self.check(host)
                if options == ("--series", "cb3"):
                    # The first one's inputs are free again.
                    self.check(host)
