"""The robot's side of the watchdog agrees with ours and with itself."""

import importlib.resources
from pathlib import Path
import re
import unittest

from tofssm_drake.rtde.rtde_config import RtdeConfig

_FILE = importlib.resources.files("tofssm_drake.rtde") / (
    "tofssm_watchdog.script"
)
_DOC = Path(__file__).parents[2] / "docs" / "robot_link.md"


class TestWatchdogScript(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.lines = [
            line.split("#")[0].rstrip()
            for line in _FILE.read_text("ascii").splitlines()
        ]
        cls.code = "\n".join(cls.lines)

    def test_every_block_ends(self):
        depth = 0
        for line in self.lines:
            word = line.strip().partition(" ")[0]
            if word.startswith("else"):
                self.assertEqual(line.index("else") // 2, depth - 1)
                continue
            if word == "end":
                depth -= 1
            if line:
                self.assertEqual(len(line) - len(line.lstrip()), 2 * depth)
            if word in ("def", "thread", "if", "while"):
                self.assertTrue(line.endswith(":"), line)
                depth += 1
        self.assertEqual(depth, 0)

    def test_register_is_the_one_we_write(self):
        register = str(RtdeConfig().heartbeat_register)
        found = re.findall(r"register(?:_|\()(\d+)", self.code)
        self.assertEqual(set(found), {register})
        self.assertGreaterEqual(len(found), 5)

    def test_waits_before_it_watches(self):
        order = [
            self.code.index(text)
            for text in (
                "\ntofssm_wait_for_monitor()",
                "\nrtde_set_watchdog(",
                "run tofssm_watchdog()",
            )
        ]
        self.assertEqual(order, sorted(order))

    def test_document_shows_the_same_times(self):
        frames = int(re.search(r"tofssm_frames = (\d+)", self.code)[1])
        frequency = int(re.search(r'_24", (\d+), "stop"', self.code)[1])
        text = _DOC.read_text("utf-8")
        self.assertIn(f"{frames * 0.008:g} s", text)
        self.assertIn(f"{1 / frequency:g} s", text)
        self.assertIn(_FILE.name, text)
