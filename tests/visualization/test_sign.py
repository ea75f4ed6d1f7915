import io
import unittest

from matplotlib.image import imread
import numpy as np

from tofssm_drake.visualization import palette
import tofssm_drake.visualization.sign as mut


def _read(sign, name):
    files = sign.source().in_memory().supporting_files
    return files[name].contents()


class TestSign(unittest.TestCase):
    def setUp(self):
        self.rgba = next(iter(palette.STATE.values()))

    def make_picture(self, text, width=1.4, **options):
        sign = mut.make_sign(
            text, width=width, height=0.36, rgba=self.rgba, **options
        )
        return imread(io.BytesIO(_read(sign, "sign.png")))[:, :, :3]

    def find_ink(self, picture):
        board = np.array([mut.BOARD.r(), mut.BOARD.g(), mut.BOARD.b()])
        return np.abs(picture - board).max(axis=2) > 0.1

    def test_words_fit(self):
        """Every word of the boards is whole: nothing at the panel's edges."""
        for word in palette.STATE_WORD.values():
            ink = self.find_ink(self.make_picture(word))
            self.assertTrue(ink.any())
            for edge in (ink[0], ink[-1], ink[:, 0], ink[:, -1]):
                self.assertFalse(edge.any())

    def test_colour_and_place(self):
        ink = self.find_ink(self.make_picture("STOP"))
        columns = np.flatnonzero(ink.any(axis=0))
        middle = 0.5 * (columns[0] + columns[-1])
        self.assertAlmostEqual(middle / ink.shape[1], 0.5, delta=0.02)
        rows = np.flatnonzero(ink.any(axis=1))
        self.assertAlmostEqual(rows.mean() / ink.shape[0], 0.5, delta=0.05)
        left = self.find_ink(self.make_picture("OK", align="left"))
        self.assertLess(
            np.flatnonzero(left.any(axis=0))[-1], 0.5 * len(left[0])
        )
        picture = self.make_picture("STOP")
        wanted = [self.rgba.r(), self.rgba.g(), self.rgba.b()]
        nearest = np.abs(picture - wanted).max(axis=2).min()
        self.assertLess(nearest, 0.01)

    def test_size(self):
        sign = mut.make_sign("OK", width=1.4, height=0.36, rgba=self.rgba)
        text = sign.source().in_memory().mesh_file.contents().decode()
        corners = np.array(
            [
                [float(x) for x in line.split()[1:]]
                for line in text.splitlines()
                if line.startswith("v ")
            ]
        )
        np.testing.assert_allclose(np.ptp(corners, axis=0), [0, 1.4, 0.36])
