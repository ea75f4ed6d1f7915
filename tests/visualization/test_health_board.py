import unittest

from fake_meshcat import FakeMeshcat

import tofssm_drake.visualization.health_board as mut

_WORDS = (mut.OK, mut.HELD, mut.BLIND, mut.FAULT)


class TestHealthBoard(unittest.TestCase):
    def setUp(self):
        self.meshcat = FakeMeshcat()
        self.dut = mut.HealthBoard(
            meshcat=self.meshcat, names=("base", "elbow", "tool", "robot")
        )

    def find_shown(self, name):
        return [
            word
            for word in _WORDS
            if self.meshcat.find_last(f"health/{name}/{word}", "visible")
        ]

    def test_one_word_for_each(self):
        names = ("base", "elbow", "tool", "robot")
        for name in names:
            self.assertEqual(self.find_shown(name), [])
        for k in range(len(_WORDS)):
            status = {n: _WORDS[(i + k) % 4] for i, n in enumerate(names)}
            self.dut.show(status)
            for name in names:
                self.assertEqual(self.find_shown(name), [status[name]])

    def test_rows_are_below_each_other_and_on_the_board(self):
        X = {path: X.translation() for path, X, _ in self.meshcat.transforms}
        heights = [
            X[f"health/{name}/word"][2]
            for name in ("base", "elbow", "tool", "robot")
        ]
        self.assertEqual(heights, sorted(heights, reverse=True))
        for p in X.values():
            self.assertLess(abs(p - X["health/board"])[1], 0.5)
            self.assertLess(abs(p - X["health/board"])[2], 0.33)
