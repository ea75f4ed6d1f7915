import copy
import unittest

import numpy as np
from paper_cell import RINGS

import tofssm_drake.messages as mut


class TestMessages(unittest.TestCase):
    def test_copy_is_the_message_itself(self):
        dut = mut.RingScan(distance=np.ones(8))
        self.assertIs(copy.deepcopy(dut), dut)

    def test_arrays_are_read_only(self):
        dut = mut.RingScan(distance=np.ones(8))
        with self.assertRaises(ValueError):
            dut.distance[0] = 0.0

    def test_of_read_only_makes_the_same(self):
        distance = np.ones(8)
        plain = mut.RingScan(distance=distance)
        dut = mut.RingScan.of_read_only(**vars(plain))
        self.assertEqual(vars(dut), vars(plain))
        self.assertIs(dut.distance, distance)
        self.assertIs(copy.deepcopy(dut), dut)
        with self.assertRaises(AttributeError):
            dut.sequence = 3

    def test_nothing_is_trusted_before_the_first_sample(self):
        separation = mut.make_empty_separation(RINGS)
        self.assertTrue((separation.health == mut.RingHealth.FAULTED).all())
        index = mut.make_empty_safety_index(RINGS)
        self.assertTrue((index.health == mut.RingHealth.FAULTED).all())
        self.assertTrue((index.dsi >= index.dsi_C).all())
