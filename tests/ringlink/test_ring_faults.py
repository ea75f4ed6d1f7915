import unittest

import numpy as np

import tofssm_drake.ringlink.ring_faults as mut


def count(samples):
    """Counts after frames of (mm, status) lists."""
    repeats = np.zeros(len(samples[0][0]), dtype=int)
    before = tuple(np.array(values) for values in samples[0])
    for sample in samples[1:]:
        now = tuple(np.array(values) for values in sample)
        repeats = mut.count_repeats(repeats, before=before, now=now, most=50)
        fresh = now[1] != 254
        before = tuple(
            np.where(fresh, new, old)
            for new, old in zip(now, before, strict=True)
        )
    return repeats


def find(repeats, status, frozen_samples=3):
    return mut.find_frozen_sensors(
        np.array(repeats),
        status=np.array(status),
        frozen_samples=frozen_samples,
    ).tolist()


class TestCountRepeats(unittest.TestCase):
    def test_counts_what_is_equal_to_the_last_bit(self):
        frames = [
            ([500, 700, 0], [0, 0, 2]),
            ([500, 701, 0], [0, 0, 2]),
            ([500, 701, 0], [0, 0, 4]),
            ([500, 700, 0], [0, 0, 4]),
        ]
        self.assertEqual(count(frames).tolist(), [3, 0, 1])

    def test_no_new_data_neither_counts_nor_ends_a_row(self):
        frames = [
            ([500, 500], [0, 0]),
            ([0, 0], [254, 254]),
            ([500, 501], [0, 0]),
            ([0, 0], [254, 254]),
            ([500, 501], [0, 0]),
        ]
        self.assertEqual(count(frames).tolist(), [2, 1])

    def test_a_changed_distance_takes_two_back(self):
        frames = [([mm], [0]) for mm in (5, 5, 5, 5, 6, 6, 7, 8, 8)]
        counts = [count(frames[: i + 1])[0] for i in range(len(frames))]
        self.assertEqual(counts, [0, 1, 2, 3, 1, 2, 0, 0, 1])

    def test_each_sample_sent_four_times_is_found(self):
        frames = [([mm // 4], [0]) for mm in range(110)]
        self.assertTrue(find(count(frames), [0], frozen_samples=25)[0])

    def test_no_count_is_higher_than_the_most(self):
        frames = [([5], [0])] * 70 + [([6 + i], [0]) for i in range(13)]
        self.assertEqual(count(frames).tolist(), [24])


class TestFindFrozenSensors(unittest.TestCase):
    def test_a_repeated_distance_is_frozen(self):
        self.assertEqual(
            find([2, 3, 4, 0], [0, 0, 0, 0]), [False, True, True, False]
        )

    def test_no_return_alone_proves_nothing(self):
        self.assertEqual(find([9, 9, 0], [2, 4, 0]), [False, False, False])
        self.assertEqual(find([9, 9, 9], [2, 4, 7]), [False, False, False])

    def test_a_device_that_repeats_itself_takes_the_clear_ones_along(self):
        self.assertEqual(find([5, 9, 9], [0, 2, 2]), [True, True, True])
        # One sensor changes, so the device is alive.
        self.assertEqual(find([5, 9, 0], [0, 2, 2]), [True, False, False])

    def test_a_whole_ring_that_repeats_itself_is_found_sooner(self):
        eight = [0] * 8
        self.assertEqual(find([3] * 8, eight, 25), [False] * 8)
        self.assertEqual(find([4] * 8, eight, 25), [True] * 8)
        # Three of them have a distance: 9 frames.
        three = [0, 0, 0, 2, 2, 4, 7, 2]
        self.assertEqual(find([8] * 8, three, 25), [False] * 8)
        self.assertEqual(find([9] * 8, three, 25), [True] * 8)
        # If one changes, in whatever way, the device is alive.
        self.assertEqual(find([9] * 7 + [0], eight, 25), [False] * 8)

    def test_can_be_switched_off(self):
        self.assertEqual(find([9, 9], [0, 0], frozen_samples=0), [False] * 2)

    def test_little_noise_is_not_taken_for_frozen(self):
        """20000 scans of 24 sensors with three quarters of a millimetre."""
        generator = np.random.default_rng(0)
        mm = np.rint(500 + 0.75 * generator.standard_normal((20_000, 24)))
        same = mm[1:] == mm[:-1]
        self.assertAlmostEqual(same.mean(), 0.35, delta=0.01)
        # The longest run of equal neighbours.
        longest, row = 0, np.zeros(24, dtype=int)
        for i in range(len(same)):
            row = (row + 1) * same[i]
            longest = max(longest, row.max())
        self.assertLess(longest, mut.FROZEN_SAMPLES - 5)
        # Nor is a whole ring, of which few sensors see something.
        for sensors in (2, 3, 8):
            longest = row = 0
            for i in range(len(same)):
                row = (row + 1) * bool(same[i, :sensors].all())
                longest = max(longest, row)
            self.assertLess(longest * sensors, mut.FROZEN_SAMPLES - 4)


if __name__ == "__main__":
    unittest.main()
