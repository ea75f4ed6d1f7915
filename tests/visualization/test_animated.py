import unittest

from fake_meshcat import FakeMeshcat

import tofssm_drake.visualization.animated as mut


class TestAnimatedProperty(unittest.TestCase):
    def setUp(self):
        self.meshcat = FakeMeshcat()

    def _make(self, **options):
        return mut.AnimatedProperty(
            meshcat=self.meshcat, path="a", name="scale", **options
        )

    def _get_keys(self):
        return [(t, v) for _, _, v, t in self.meshcat.properties]

    def test_only_changes_are_written(self):
        dut = self._make()
        for i, value in enumerate([True, True, False, False, True]):
            dut.set(value, i * 0.25, 0.25)
        self.assertEqual(
            self._get_keys(), [(0.0, True), (0.5, False), (1.0, True)]
        )

    def test_hold_before_a_jump(self):
        """The old value is repeated one frame before, so nothing drifts."""
        dut = self._make(hold=True)
        for i, value in enumerate([1.0, 1.0, 1.0, 2.0, 3.0]):
            dut.set(value, i * 0.25, 0.25)
        self.assertEqual(
            self._get_keys(), [(0.0, 1.0), (0.5, 1.0), (0.75, 2.0), (1.0, 3.0)]
        )

    def test_new_run_draws_again(self):
        dut = self._make(hold=True)
        dut.set(1.0, 5.0, 0.25)
        dut.set(1.0, 0.0, 0.25)
        self.assertEqual(self._get_keys(), [(5.0, 1.0), (0.0, 1.0)])
