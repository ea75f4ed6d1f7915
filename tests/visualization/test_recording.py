import functools
import json
import math
from pathlib import Path
import re
import tempfile
import types
import unittest

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams, Rgba, Sphere

from tofssm_drake.errors import UserError
from tofssm_drake.recording.samples import Samples
import tofssm_drake.visualization.recording as mut

PAGE = """<html><head><title>Drake MeshCat</title></head>
<body><script>var viewer = 1;</script></body>
</html>"""


@functools.cache
def get_meshcat():
    """One per process: each one opens a port of its own."""
    return Meshcat(MeshcatParams(host="localhost"))


def _make_samples():
    n = 1001
    return Samples(
        column={
            "t": np.arange(n) * 0.008,
            "robot_state": np.repeat([0, 2, 1], [101, 400, 500]),
            "tcp_speed": np.linspace(0, 1, n),
            "true_distance": np.where(np.arange(n) < 500, np.inf, -0.1),
        }
    )


class TestRunData(unittest.TestCase):
    def test_data(self):
        data = mut.make_run_data(_make_samples())
        self.assertAlmostEqual(data["end"], 8.0)
        self.assertEqual(
            data["spans"],
            [[0.0, 0.808, 0], [0.808, 4.008, 2], [4.008, 8.0, 1]],
        )
        self.assertAlmostEqual(data["step"], 0.04)
        self.assertEqual(len(data["speed"]), 201)
        self.assertIsNone(data["distance"][0])
        self.assertEqual(data["distance"][-1], 0.0)
        # Strict JSON, which has no infinity.
        json.dumps(data, allow_nan=False)

    def test_nothing(self):
        self.assertIsNone(mut.make_run_data(None))
        self.assertIsNone(
            mut.make_run_data(
                Samples(column={"t": np.zeros(1), "robot_state": np.zeros(1)})
            )
        )


class TestOverlay(unittest.TestCase):
    def test_inserted_before_the_end(self):
        page = mut.add_overlay(PAGE, samples=_make_samples(), title="A < B")
        self.assertIn("<title>A &lt; B</title>", page)
        self.assertNotIn("A < B", page)
        self.assertTrue(page.endswith("</body>\n</html>"))
        self.assertLess(page.index("var viewer"), page.index('id="tofssm"'))
        for word in ("clear", "hit", "masked", "fault", "STOP", "NORMAL"):
            self.assertIn(word, page)

    def test_several_people_are_in_the_legend(self):
        samples = _make_samples()
        samples.metadata |= {
            "people": ["anna", "ben"],
            "person_parts": ["anna's head", "ben's head"],
            "shirts": {"anna": "#ff0000", "ben": "#0000ff"},
        }
        samples.column["person_part"] = np.ones(len(samples), dtype=int)
        page = mut.add_overlay(PAGE, samples=samples)
        for text in ("anna", "ben", "#ff0000", "#0000ff"):
            self.assertIn(text, page)
        self.assertEqual(set(mut.make_run_data(samples)["who"]), {"ben"})
        samples.metadata["people"] = ["anna"]
        self.assertNotIn("#ff0000", mut.add_overlay(PAGE, samples=samples))

    def test_a_link_opens_at_the_frame_that_shows_its_event(self):
        """Runs the page's own arithmetic of frames."""
        page = mut.add_overlay(PAGE, samples=_make_samples(), fps=16.0)
        lines = [
            line.strip()
            for line in page.splitlines()
            if line.strip().startswith(("const fps", "const frame"))
        ]
        found = dict(re.findall(r"const (\w+) = (.*);", "\n".join(lines)))
        self.assertEqual(float(found["fps"]), 16.0)
        python = {
            name: re.sub(r"^\(t\) => ", "", code).replace("Math", "math")
            for name, code in found.items()
            if name.startswith("frame")
        }
        scope = {"math": math, "fps": 16.0}
        scope["run"] = types.SimpleNamespace(tick=0.008)
        for name, code in python.items():
            scope[name] = eval(f"lambda t: {code}", scope)
        for t, at, row, following in (
            (31.752, 31.75, 31.752, 31.8125),
            (31.75, 31.75, 31.752, 31.75),
            # Recorded at 1.32: the state since the tick at 1.312.
            (1.32, 1.3125, 1.32, 1.375),
            (0.0, 0.0, 0.0, 0.0),
            # A tick and a frame at once.
            (4.008, 4.0, 4.0, 4.0625),
        ):
            with self.subTest(t=t):
                self.assertEqual(scope["frameAt"](t), at)
                self.assertAlmostEqual(scope["frameRow"](t), row)
                start = scope["frameFrom"](t)
                self.assertAlmostEqual(start, following, delta=0.002)
                self.assertEqual(scope["frameAt"](start), following)
        self.assertIn("seek(frameFrom(parseFloat(match[1])))", page)
        self.assertIn("const row = frameRow(t) + run.tick / 4;", page)
        self.assertIn("find((s) => row < s[1])", page)

    def test_meshcats_controls_are_not_over_the_title_on_a_phone(self):
        page = mut.add_overlay(PAGE, title="x")
        narrow = page.partition("@media (max-width: 640px)")[2]
        self.assertIn(
            ".dg.main { display: none !important; }", narrow.splitlines()[0]
        )

    def test_without_samples(self):
        page = mut.add_overlay(PAGE, title="x")
        self.assertIn("tofssm-legend", page)
        self.assertNotIn('tofssm-strip"', page)
        self.assertIn("const run = null;", page)


class TestRecording(unittest.TestCase):
    def test_write(self):
        meshcat = get_meshcat()
        mut.set_scene(meshcat)
        meshcat.SetObject("ball", Sphere(0.1), Rgba(1, 0, 0, 1))
        mut.start_recording(meshcat)
        meshcat.SetProperty("ball", "visible", True, 0.0)
        meshcat.SetProperty("ball", "visible", False, 1.0)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "recording.html"
            mut.write_recording(
                meshcat, path, samples=_make_samples(), title="Test"
            )
            page = path.read_text("utf-8")
            self.assertEqual(
                [p.name for p in path.parent.iterdir()], [path.name]
            )
        # The page needs Meshcat's viewer under this name, and no network.
        self.assertIn("var viewer = new MeshCat.Viewer", page)
        self.assertIn('id="tofssm-strip"', page)
        self.assertIsNone(
            re.search(r"<(?:script|link|img)[^>]*(?:src|href)=.https?:", page)
        )

    def test_unwritable(self):
        meshcat = get_meshcat()
        mut.start_recording(meshcat)
        with self.assertRaisesRegex(UserError, "cannot be written"):
            mut.write_recording(meshcat, Path("/nonexistent/recording.html"))
