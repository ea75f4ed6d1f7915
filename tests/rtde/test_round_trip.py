"""Client and simulated robot over a real socket."""

import unittest

from robot_room import make_robot, serve

from tofssm_drake.messages import SliderCommand
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig


class TestRoundTrip(unittest.TestCase):
    def test_slider_comes_back_within_two_cycles(self):
        for series, rate in (("cb3", 125), ("e", 500)):
            with (
                self.subTest(series=series),
                serve(make_robot(series=series)) as server,
                RtdeClient(RtdeConfig(port=server.address[1])) as dut,
            ):
                report = dut.wait_for_report(after=-1, timeout=120)
                self.assertEqual(report.target_speed_fraction, 1.0)
                self.assertEqual(dut.get_status().frequency, rate)
                command = SliderCommand(
                    sequence=report.sequence, mask=1, speed_fraction=0.25
                )
                self.assertTrue(dut.send(command))
                written = report.timestamp
                while report.target_speed_fraction != 0.25:
                    report = dut.wait_for_report(
                        after=report.sequence, timeout=5
                    )
                self.assertLess(report.timestamp - written, 0.5)
