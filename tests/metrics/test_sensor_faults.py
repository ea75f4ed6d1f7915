import unittest

import numpy as np

import tofssm_drake.metrics.sensor_faults as mut
from tofssm_drake.recording.samples import Samples


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


class TestFindFaultedLinks(unittest.TestCase):
    def test_causes_that_differ_in_numbers_are_one(self):
        samples = make_samples([[0, 0]])
        samples.column["reason"] = np.array(
            [
                "",
                "stop: tool is faulted, samples 46 ms old, 34 ms allowed",
                "stop: tool is faulted, samples 61 ms old, 34 ms allowed",
                "stop: base at 0.500 m <= d_C 0.665 m",
                "reduced: tool is degraded, sensor 3: declared dead",
                "stop: base is faulted, unseen self-hit: base sensor 2",
            ],
            dtype=object,
        )
        found = mut.find_faulted_links(samples)
        self.assertEqual(
            [(f.link, f.cause) for f in found],
            [
                ("tool", "samples 46 ms old, 34 ms allowed"),
                ("tool", "sensor 3: declared dead"),
                ("base", "unseen self-hit: base sensor 2"),
            ],
        )
        np.testing.assert_allclose(
            [f.first for f in found], [0.008, 0.032, 0.04]
        )
        np.testing.assert_allclose(
            [f.duration for f in found], [0.016, 0.008, 0.0], atol=1e-12
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
