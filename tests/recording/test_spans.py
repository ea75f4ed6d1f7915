import unittest

import numpy as np

import tofssm_drake.recording.spans as mut


class TestSpans(unittest.TestCase):
    def test_spans(self):
        t = np.array([0.0, 1, 2, 3, 4])
        self.assertEqual(
            mut.find_spans(t, np.array([0, 0, 2, 2, 1])),
            [(0.0, 2.0, 0), (2.0, 4.0, 2), (4.0, 4.0, 1)],
        )
        self.assertEqual(mut.find_spans(t[:0], t[:0]), [])
