import unittest

import numpy as np

from tofssm_drake.evaluation.samples import Samples
import tofssm_drake.evaluation.sensor_faults as mut


def make_samples(fault):
    fault = np.array(fault, dtype=np.int8)
    t = 0.008 * np.arange(6)
    return Samples(
        column={
            "t": t,
            "tool_sample_time": np.array([-np.inf, -np.inf, 0, 0, 0.02, 0.02]),
        },
        scan={
            "tool": {
                "time": 0.1 + 0.024 * np.arange(len(fault)),
                "fault": fault,
            }
        },
        metadata={"rings": ["tool"]},
    )


class TestFindFaultedSensors(unittest.TestCase):
    def test_none(self):
        self.assertEqual(
            mut.find_faulted_sensors(make_samples([[0, 0]] * 3)), []
        )

    def test_counts_and_times(self):
        samples = make_samples(
            [[0, 1], [5, 1], [0, 0], [1, 1], [0, 1], [0, 1], [0, 0]]
        )
        found = mut.find_faulted_sensors(samples)
        self.assertEqual(
            [(f.sensor, f.cause, f.scans) for f in found],
            [(0, "bus", 1), (0, "sigma", 1), (1, "bus", 5)],
        )
        self.assertEqual([f.longest for f in found[:2]], [0.0, 0.0])
        self.assertAlmostEqual(found[2].longest, 0.048)
        self.assertAlmostEqual(found[2].first, 0.1)

    def test_files_without_faults(self):
        samples = make_samples([[0]])
        del samples.scan["tool"]["fault"]
        self.assertEqual(mut.find_faulted_sensors(samples), [])


class TestCalcAges(unittest.TestCase):
    def test_of_what_was_measured(self):
        median, most = mut.calc_ages(make_samples([[0]]), "tool")
        self.assertAlmostEqual(median, 0.018)
        self.assertAlmostEqual(most, 0.024)

    def test_never(self):
        samples = make_samples([[0]])
        samples.column["tool_sample_time"][:] = -np.inf
        self.assertTrue(np.isnan(mut.calc_ages(samples, "tool")).all())


if __name__ == "__main__":
    unittest.main()
