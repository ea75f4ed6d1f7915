from pathlib import Path
import tempfile
import unittest

from bvh_writer import write_bvh
import numpy as np

from tofssm_drake.errors import UserError
import tofssm_drake.people.bvh_file as mut


class BvhFileTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.good = Path(cls.folder.name) / "walk.bvh"
        write_bvh(cls.good, duration=0.1)
        cls.text = cls.good.read_text()
        cls.lines = cls.text.splitlines()

    def _write(self, text):
        path = Path(self.folder.name) / "bad.bvh"
        if isinstance(text, bytes):
            path.write_bytes(text)
        else:
            path.write_text(text)
        return path

    def _line_of(self, beginning):
        return next(
            i
            for i, line in enumerate(self.lines)
            if line.strip().startswith(beginning)
        )

    def _replace_line(self, index, new):
        lines = list(self.lines)
        lines[index] = new
        return "\n".join(lines)

    def _check(self, text, line, message):
        path = self._write(text)
        with self.assertRaises(UserError) as context:
            mut.read_bvh(path)
        what = str(context.exception)
        self.assertNotIn("\n", what)
        self.assertRegex(what, rf"bad\.bvh:{line}: .*{message}")

    def test_reads(self):
        dut = mut.read_bvh(self.good)
        self.assertEqual(dut.frames.shape, (13, 6 + 20 * 3))
        self.assertAlmostEqual(dut.frame_time, 1 / 120, delta=1e-8)
        self.assertAlmostEqual(dut.duration, 0.1, delta=1e-6)
        self.assertEqual(dut.joints[0].name, "Hips")
        self.assertEqual(dut.joints[0].parent, -1)
        self.assertEqual(
            dut.joints[0].channels,
            (
                ("position", 0),
                ("position", 1),
                ("position", 2),
                ("rotation", 2),
                ("rotation", 1),
                ("rotation", 0),
            ),
        )
        ends = [joint for joint in dut.joints if joint.is_end]
        self.assertEqual(len(ends), 5)
        knee = next(j for j in dut.joints if j.name == "LeftLeg")
        np.testing.assert_allclose(knee.offset, [0, -0.42, 0])
        self.assertEqual(dut.joints[knee.parent].name, "LeftUpLeg")
        for index, joint in enumerate(dut.joints):
            self.assertLess(joint.parent, index)
            self.assertIn(
                "End" if joint.is_end else joint.name,
                self.lines[joint.line - 1],
            )

    def test_spelling_does_not_matter(self):
        expected = mut.read_bvh(self.good).frames
        for text in (
            self.text.replace("\n", "\r\n"),
            "\ufeff" + self.text,
            self.text.replace("\n", " \n").replace("Frames: ", "FRAMES:\t"),
            self.text.replace("Frame Time: ", "Frame Time:"),
            self.text.replace("CHANNELS", "Channels").replace("rot", "Rot"),
            self.text.replace("\n{", " {"),
            self.text + "\n\n",
            self.text.replace("End Site", "End site"),
        ):
            np.testing.assert_array_equal(
                mut.read_bvh(self._write(text)).frames, expected
            )

    def test_names_in_any_encoding(self):
        data = self.text.replace("Hips", "H\u00fcfte").encode("latin-1")
        self.assertEqual(len(mut.read_bvh(self._write(data)).joints), 26)

    def test_no_such_file(self):
        with self.assertRaisesRegex(UserError, r"none\.bvh: no such file"):
            mut.read_bvh(Path(self.folder.name) / "none.bvh")
        with self.assertRaisesRegex(UserError, "is a folder"):
            mut.read_bvh(self.folder.name)

    def test_no_bvh_file(self):
        self._check("", 1, "empty")
        self._check(" \n\n", 1, "empty")
        self._check(bytes(range(256)), 1, "not text")
        self._check("a,b\n1,2\n", 1, "HIERARCHY")
        self._check("HIERARCHY\n", 2, "ends where ROOT")

    def test_cut_short(self):
        motion = self._line_of("MOTION")
        self._check("\n".join(self.lines[:20]), 20, "ends where")
        self._check("\n".join(self.lines[:motion]), motion, "MOTION")
        self._check("\n".join(self.lines[: motion + 2]), motion + 2, "Time")
        end = motion + 3
        self._check("\n".join(self.lines[:end]), end, "0 of 13 frames")
        self._check("\n".join(self.lines[: end + 5]), end + 5, "5 of 13 frames")
        half = "\n".join(self.lines[: end + 5])[:-100]
        self._check(half, end + 5, "frame 5 has .* should have 66")

    def test_every_cut_is_told(self):
        """Wherever the file is cut, the user gets one clear line."""
        rng = np.random.default_rng(0)
        for cut in rng.integers(1, len(self.text) - 10, 200):
            with self.assertRaisesRegex(UserError, r"bad\.bvh:\d+: "):
                mut.read_bvh(self._write(self.text[:cut]))

    def test_wrong_numbers(self):
        frames = self._line_of("Frames")
        first = frames + 2
        for new, line, message in (
            ("Frames: 12", 14, "more lines of values than the 12 frames"),
            ("Frames: 14", 14, "13 of 14 frames"),
            ("Frames: 0", 0, "should be 1 or more"),
            ("Frames: many", 0, "should be 1 or more"),
            ("Frames 13", 0, "should be 'Frames:'"),
        ):
            self._check(
                self._replace_line(frames, new), frames + 1 + line, message
            )
        for new in ("0", "-0.01", "nan", "inf", "fast", "8.333"):
            self._check(
                self._replace_line(frames + 1, f"Frame Time: {new}"),
                frames + 2,
                "second",
            )
        values = self.lines[first + 2].split()
        for bad in ("abc", "nan", "1e999", "1,5"):
            self._check(
                self._replace_line(
                    first + 2, " ".join([*values[:10], bad, *values[11:]])
                ),
                first + 3,
                f"frame 3: '{bad}' should be a number",
            )
        for row, count in ((values[:-1], 65), ([*values, "0"], 67)):
            self._check(
                self._replace_line(first + 2, " ".join(row)),
                first + 3,
                f"frame 3 has {count} values, should have 66",
            )

    def test_wrong_hierarchy(self):
        offset = self._line_of("OFFSET")
        channels = self._line_of("CHANNELS")
        for index, new, message in (
            (1, "JOINT Hips", "should be ROOT"),
            (offset, "OFFSET 0 0", "three numbers"),
            (offset, "OFFSET 0 0 zero", "three numbers"),
            (offset, "OFFSET 0 0 nan", "three numbers"),
            (channels, "CHANNELS 6 Xposition", "followed by 1 names"),
            (channels, "CHANNELS 1 Wrotation", "Wrotation' should be"),
            (channels, "CHANNELS 2 Xrotation Xrotation", "twice"),
            (channels, "CHANNELS", "should be CHANNELS"),
            (channels, "", "should be CHANNELS"),
            (channels + 1, "BONE LeftUpLeg", "should be JOINT"),
            (self._line_of("MOTION"), "ROOT Other", "second ROOT"),
            (self._line_of("MOTION"), "}", "should be MOTION"),
        ):
            with self.subTest(new=new):
                line = index + 1 + (new == "")
                self._check(self._replace_line(index, new), line, message)


if __name__ == "__main__":
    unittest.main()
