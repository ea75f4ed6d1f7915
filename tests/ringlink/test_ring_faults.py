import unittest

import numpy as np

import tofssm_drake.ringlink.ring_faults as mut
from tofssm_drake.sensors.cone_sensor import ConeSensor
from tofssm_drake.sensors.vl53l1x import Vl53l1x


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


class TestCalcFrozenSamples(unittest.TestCase):
    def calc(self, noise, resolution=0.0):
        sensor = ConeSensor(
            sigma=noise, sigma_per_metre=0.0, resolution=resolution
        )
        return mut.calc_frozen_samples(sensor.traits)

    def test_of_the_sensors_that_ship(self):
        self.assertEqual(mut.calc_frozen_samples(Vl53l1x().traits), 25)
        self.assertEqual(mut.calc_frozen_samples(Vl53l1x(ideal=True).traits), 0)
        self.assertEqual(
            mut.calc_frozen_samples(Vl53l1x(noise_gain=0.0).traits), 0
        )
        self.assertEqual(mut.calc_frozen_samples(ConeSensor().traits), 25)

    def test_a_coarse_step_may_repeat(self):
        self.assertEqual(self.calc(0.00075), 25)
        self.assertEqual(self.calc(0.01, 0.001), 25)
        self.assertGreater(self.calc(0.005, 0.010), 40)
        self.assertEqual(self.calc(0.005, 0.050), 0)
        self.assertEqual(self.calc(0.0, 0.001), 0)

    def test_probability(self):
        """Against equal neighbours of a still target, mid of a step."""
        generator = np.random.default_rng(0)
        for noise in (0.3, 0.5, 0.75, 2.0):
            steps = np.rint(noise * generator.standard_normal(200_000))
            self.assertAlmostEqual(
                mut.calc_repeat_probability(noise),
                float((steps[1:] == steps[:-1]).mean()),
                delta=0.01,
            )
        self.assertEqual(mut.calc_repeat_probability(0.0), 1.0)

    def test_a_still_target_is_never_frozen(self):
        """A coarse sensor before a wall, 24 of them for 20 min at 42 Hz."""
        noise, step = 0.005, 0.010
        needed = self.calc(noise, step)
        generator = np.random.default_rng(1)
        sigma = noise / step
        steps = np.rint(sigma * generator.standard_normal((50_000, 24)))
        count = np.zeros(24, dtype=int)
        most, usual = 0, 0
        for now, before in zip(steps[1:], steps[:-1], strict=True):
            is_same = now == before
            count = np.where(is_same, count + 1, np.maximum(count - 2, 0))
            most = max(most, int(count.max()))
            usual += int((count >= mut.FROZEN_SAMPLES).any())
        self.assertLess(most, needed)
        # The limit of a finer sensor would have accused some of these.
        self.assertGreater(usual, 0)


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
