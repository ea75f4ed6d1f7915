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


def make_link_samples(*, tool, base, deciding, state, reason):
    """Makes a run of six ticks with the codes of two links."""
    return Samples(
        column={
            "t": 0.008 * np.arange(6),
            "robot_state": np.array(state, dtype=np.int8),
            "deciding_link": np.array(deciding, dtype=np.int8),
            "reason": np.array(reason, dtype=object),
            "tool_health": np.array(tool, dtype=np.int8),
            "base_health": np.array(base, dtype=np.int8),
            "tool_sequence": np.arange(6),
            "base_sequence": np.arange(6),
        },
        metadata={"rings": ["tool", "base"]},
    )


class TestFindFaultedLinks(unittest.TestCase):
    def test_causes_that_differ_in_numbers_are_one(self):
        samples = make_link_samples(
            tool=[0, 2, 0, 2, 0, 0],
            base=[0, 0, 0, 0, 0, 0],
            deciding=[-1, 0, 1, 0, 1, 1],
            state=[2, 0, 0, 0, 0, 0],
            reason=[
                "",
                "no words in common: 46 ms",
                "somebody is near",
                "no words in common: 61 ms",
                *["somebody is near"] * 2,
            ],
        )
        (found,) = mut.find_faulted_links(samples)
        self.assertEqual(found.link, "tool")
        self.assertEqual(found.cause, "no words in common: 46 ms")
        self.assertAlmostEqual(found.first, 0.008)
        self.assertAlmostEqual(found.duration, 0.016)

    def test_a_faulted_link_counts_whoever_decides(self):
        samples = make_link_samples(
            tool=[0, 0, 2, 2, 2, 0],
            base=[0, 0, 0, 0, 0, 0],
            deciding=[-1, 1, 1, 1, 1, 1],
            state=[2, 0, 0, 0, 0, 0],
            reason=["", *["somebody is near"] * 5],
        )
        (found,) = mut.find_faulted_links(samples)
        self.assertEqual((found.link, found.cause), ("tool", "faulted"))
        self.assertAlmostEqual(found.duration, 0.024)

    def test_a_degraded_link_counts_while_it_decides(self):
        samples = make_link_samples(
            tool=[3, 3, 3, 3, 3, 3],
            base=[0, 0, 0, 0, 0, 0],
            deciding=[0, 0, 1, 1, -1, -1],
            state=[1, 1, 0, 0, 2, 2],
            reason=["dead", "dead", "near", "near", "", ""],
        )
        (found,) = mut.find_faulted_links(samples)
        self.assertEqual((found.link, found.cause), ("tool", "dead"))
        self.assertAlmostEqual(found.duration, 0.016)

    def test_before_the_first_sample_there_is_no_fault(self):
        samples = make_link_samples(
            tool=[2] * 6,
            base=[2] * 6,
            deciding=[0] * 6,
            state=[0] * 6,
            reason=["no sample yet"] * 6,
        )
        for link in ("tool", "base"):
            samples.column[f"{link}_sequence"][:] = -1
        self.assertEqual(mut.find_faulted_links(samples), [])


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
