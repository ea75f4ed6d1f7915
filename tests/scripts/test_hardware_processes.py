"""`tofssm hardware` as a user runs it: robot, rings, runner as processes.

Whatever happens, the robot comes to rest. How fast is measured by `make
fault-table` and checked in lock-step by test_hardware_faults: here the machine
may be slow.
"""

import json
import math
from pathlib import Path
import signal
import tempfile
import time
import unittest

from cell_process import PATIENT, CellProcess, Program
from mcap.reader import make_reader
import numpy as np
import pytest
from ring_flood import flood

from tofssm_drake.messages import RingScan, RobotState
from tofssm_drake.recording.run_record import RunReader
from tofssm_drake.ringlink.ring_address import parse_ring_address
from tofssm_drake.ringlink.ring_device import make_frame
from tofssm_drake.ringlink.ring_frame import encode_frame, peek_ring
from tofssm_drake.robots.robot_modes import RuntimeState
from tofssm_drake.rtde.rtde_fields import (
    ECHOED_TYPES,
    OUTPUT_TYPES,
)
from tofssm_drake.rtde.rtde_protocol import PackageType, Recipe
from tofssm_drake.rtde.rtde_report import list_outputs


@pytest.mark.long
class TestRings(unittest.TestCase):
    def check_record(self, path, why):
        """After the stop, speed recovers through one half."""
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
            runner = cell.start_runner("--record", path, main=PATIENT)
            cell.wait_for_full_speed(runner)
            # Rings that hang, and go on.
            start = time.monotonic()
            cell.rings.process.send_signal(signal.SIGSTOP)
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 0.0)
            runner.wait_for(r"stop, slider \w+: stop: .* sample is")
            cell.rings.process.send_signal(signal.SIGCONT)
            cell.wait_for_full_speed(runner)
            # The runner is stopped.
            start = time.monotonic()
            runner.process.send_signal(signal.SIGTERM)
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 0.0)
            self.assertEqual(
                runner.process.wait(120.0), 130, runner.err + runner.out
            )
            self.assertIn("interrupted; slider set to 0", runner.out)
            self.check_record(path, "sample is")
            # Another one is killed: the robot's watchdog stops the robot.
            runner = cell.start_runner(main=PATIENT)
            cell.wait_for_full_speed(runner)
            start = time.monotonic()
            runner.process.kill()
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 1.0)
            self.assertEqual(
                seen.reports[-1].runtime_state, RuntimeState.STOPPED
            )

    def test_flood(self):
        """Valid frames of a ring that the scenario does not know."""
        scan = RingScan(
            sequence=0,
            time=0.0,
            sensor_time=np.zeros(8),
            distance=np.ones(8),
            status=np.zeros(8, np.uint8),
        )
        frame = encode_frame(make_frame(scan, ring=99, timing_budget=0.0))
        with (
            tempfile.TemporaryDirectory() as folder,
            CellProcess("udp") as cell,
        ):
            path = Path(folder) / "run.mcap"
            runner = cell.start_runner("--record", path, main=PATIENT)
            cell.wait_for_full_speed(runner)
            address = parse_ring_address(cell.address)
            with flood(address, frame):
                runner.wait_for(r"ignored so far: \d+ frames of unknown rings")
                start = time.monotonic()
                cell.watcher.wait_for(lambda r: r.time > start + 2.0)
                cell.wait_for_full_speed(runner)
            runner.process.send_signal(signal.SIGTERM)
            self.assertEqual(runner.process.wait(120.0), 130, runner.err)
            with path.open("rb") as file:
                messages = make_reader(file).iter_messages("/rings/received")
                rings = {peek_ring(message.data) for _, _, message in messages}
            self.assertEqual(rings, {0, 1, 2})

    def test_serial(self):
        with CellProcess("pty") as cell:
            self.assertRegex(cell.address, "serial:///dev/")
            runner = cell.start_runner(main=PATIENT)
            cell.wait_for_full_speed(runner)
            # The device is unplugged.
            start = time.monotonic()
            cell.rings.process.send_signal(signal.SIGKILL)
            seen = cell.watcher.see(start)
            self.assertLess(seen.still, math.inf)
            self.assertEqual(seen.slider, 0.0)
            runner.wait_for(r"stop, slider \w+: stop: .* sample is")
            runner.wait_for(r"rings: serial:///dev/\S+ is gone")
            # It waits for it, but not in motion.
            self.assertIsNone(runner.process.poll())


class TestDemo(unittest.TestCase):
    def test_interrupted_it_leaves_files_and_no_process(self):
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "out"
            demo = Program(
                *("hardware-demo", "--products", 2, "--out", out),
            )
            self.addCleanup(demo.end)
            demo.wait_for(r"slider (recovering|rising)")
            children = find_children(demo.process.pid)
            self.assertEqual(len(children), 3)
            demo.process.send_signal(signal.SIGINT)
            self.assertEqual(demo.process.wait(120.0), 130)
            self.assertIn("interrupted; slider set to 0", demo.out)
            self.assertNotIn("Traceback", demo.out + demo.err)
            for child in children:
                self.assertFalse(Path(f"/proc/{child}").exists())
            summary = json.loads((out / "summary.json").read_text())
            self.assertTrue(summary["interrupted"])
            self.assertTrue((out / "report.html").is_file())
            path = out / "run.mcap"
            ticks = list(RunReader(path).read_ticks())
            self.assertGreater(len(ticks), 5)
            # The last command to the robot, and its echo.
            sent, echo = read_last_slider(path)
            self.assertEqual((sent, echo), (0.0, 0.0))


def find_children(pid):
    """Returns the ids of a process's children."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(child) for child in text.split()]


def read_last_slider(path):
    """Returns what was last written to the slider, and the robot's echo."""
    with path.open("rb") as stream:
        messages = [
            (channel.topic, message.data)
            for _, channel, message in make_reader(stream).iter_messages()
            if channel.topic.startswith("/robot/")
            and message.data[2] == PackageType.DATA_PACKAGE
        ]
    inputs = Recipe(("m", "f", "h"), ("UINT32", "DOUBLE", "INT32"), 1)
    (mask, sent, _) = inputs.decode(
        [data for topic, data in messages if topic == "/robot/sent"][-1][3:]
    )
    assert mask == 1
    names = list_outputs(24)
    known = OUTPUT_TYPES | ECHOED_TYPES
    outputs = Recipe(names, [known[name] for name in names], 1)
    values = outputs.decode(
        [data for topic, data in messages if topic == "/robot/received"][-1][3:]
    )
    return sent, values[names.index("target_speed_fraction")]


if __name__ == "__main__":
    unittest.main()
