"""`tofssm hardware` as a user meets it: robot, rings, runner, a process each.

Whatever happens, the robot comes to rest. How fast is written by `make
fault-table` and held in lock-step by test_hardware_faults: here a machine may
be as slow as it likes.
"""

import math
from pathlib import Path
import signal
import tempfile
import time
import unittest

from cell_process import CellProcess

from tofssm_drake.hardware.rtde_fields import RuntimeState
from tofssm_drake.hardware.run_record import RunReader
from tofssm_drake.messages import RobotState


class TestRings(unittest.TestCase):
    def check_record(self, path, why):
        """From the stop on speed comes back through one half."""
        ticks = list(RunReader(path).read_ticks())
        stops = [
            i
            for i, tick in enumerate(ticks)
            if why in tick.state["reason"]
            and tick.state["robot_state"] == RobotState.STOP
            and tick.command.speed_fraction == 0.0
        ]
        self.assertTrue(stops, f"never {why}")
        after = ticks[stops[-1] :]
        at_half = [
            tick.report.timestamp
            for tick in after
            if tick.command.speed_fraction == 0.5
        ]
        above = [t for t in after if t.command.speed_fraction > 0.5]
        if above:
            self.assertGreaterEqual(len(at_half), 10)
            self.assertLess(at_half[0], above[0].report.timestamp)

    def test_udp(self):
        with (
            tempfile.TemporaryDirectory() as folder,
            CellProcess("udp") as cell,
        ):
            path = Path(folder) / "run.mcap"
            runner = cell.start_runner("--record", path)
            cell.wait_for_full_speed()
            # Rings that hang, and go on.
            start = time.monotonic()
            cell.rings.process.send_signal(signal.SIGSTOP)
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 0.0)
            runner.wait_for(r"stop, slider \w+: stop: .* sample is")
            cell.rings.process.send_signal(signal.SIGCONT)
            cell.wait_for_full_speed()
            # The runner is told to stop.
            start = time.monotonic()
            runner.process.send_signal(signal.SIGTERM)
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 0.0)
            self.assertEqual(runner.process.wait(30.0), 130)
            self.assertIn("interrupted; slider set to 0", runner.out)
            self.check_record(path, "sample is")
            # Another one is killed: the robot's watchdog does the rest.
            runner = cell.start_runner()
            cell.wait_for_full_speed()
            start = time.monotonic()
            runner.process.kill()
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 1.0)
            self.assertEqual(
                seen.reports[-1].runtime_state, RuntimeState.STOPPED
            )

    def test_serial(self):
        with CellProcess("pty") as cell:
            self.assertRegex(cell.address, "serial:///dev/")
            runner = cell.start_runner()
            cell.wait_for_full_speed()
            # The device is unplugged.
            start = time.monotonic()
            cell.rings.process.send_signal(signal.SIGKILL)
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 0.0)
            runner.wait_for(r"stop, slider \w+: stop: .* sample is")
            runner.wait_for(r"rings: serial:///dev/\S+ is gone")
            # It does not wait for it in motion, but it waits.
            self.assertIsNone(runner.process.poll())


if __name__ == "__main__":
    unittest.main()
