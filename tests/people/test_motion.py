import unittest

import numpy as np

import tofssm_drake.people.motion as mut
from tofssm_drake.people.skeleton import CAPSULES, LANDMARKS
from tofssm_drake.people.walk import make_gait


def _make_landmarks(rows, *, seed=0):
    """A real posture, carried about by a wandering origin."""
    gait = make_gait(speed=1.2, stride=1.4, stature=1.75)
    rng = np.random.default_rng(seed)
    origin = np.cumsum(0.01 * rng.standard_normal((rows, 1, 3)), axis=0)
    return gait.landmarks[np.arange(rows) % len(gait.landmarks)] + origin


def _make(rows, loops):
    return mut.make_motion(
        landmarks=_make_landmarks(rows), dt=0.008, loops=loops, stature=1.75
    )


class MotionTest(unittest.TestCase):
    def test_rows_are_met_on_the_tick(self):
        motion = _make(40, loops=False)
        for row in (0, 1, 17, 39):
            ends = mut.capsule_ends(motion, row * 0.008)
            centre = ends.mean(axis=1)
            expected = 0.5 * (
                motion.joints[row, mut.CAPSULE_FIRST]
                + motion.joints[row, mut.CAPSULE_SECOND]
            )
            np.testing.assert_allclose(centre, expected, atol=1e-12)

    def test_between_rows(self):
        motion = _make(40, loops=False)
        middle = mut.capsule_ends(motion, 10.25 * 0.008).mean(axis=1)
        a = mut.capsule_ends(motion, 10 * 0.008).mean(axis=1)
        b = mut.capsule_ends(motion, 11 * 0.008).mean(axis=1)
        np.testing.assert_allclose(middle, 0.75 * a + 0.25 * b, atol=1e-12)

    def test_lengths_are_constant(self):
        motion = _make(40, loops=True)
        for t in np.linspace(-1.0, 2.0, 77):
            ends = mut.capsule_ends(motion, t)
            length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
            np.testing.assert_allclose(length, motion.lengths, atol=1e-12)

    def test_over_time_is_the_same(self):
        motion = _make(40, loops=True)
        t = np.linspace(-1.0, 2.0, 77)
        np.testing.assert_array_equal(
            mut.capsule_ends_over_time(motion, t),
            [mut.capsule_ends(motion, x) for x in t],
        )

    def test_holds(self):
        motion = _make(40, loops=False)
        self.assertAlmostEqual(motion.duration, 39 * 0.008)
        last = mut.capsule_ends(motion, motion.duration)
        for t in (motion.duration + 1e-3, 1e3):
            np.testing.assert_array_equal(mut.capsule_ends(motion, t), last)
        np.testing.assert_array_equal(
            mut.capsule_ends(motion, -5.0), mut.capsule_ends(motion, 0.0)
        )

    def test_loops(self):
        motion = _make(40, loops=True)
        self.assertAlmostEqual(motion.duration, 40 * 0.008)
        for t in (0.0, 0.1, 39.5 * 0.008):
            for laps in (-2, 1, 3):
                np.testing.assert_allclose(
                    mut.capsule_ends(motion, t + laps * motion.duration),
                    mut.capsule_ends(motion, t),
                    atol=1e-9,
                )

    def test_one_row(self):
        for loops in (False, True):
            motion = _make(1, loops=loops)
            np.testing.assert_array_equal(
                mut.capsule_ends(motion, 0.0), mut.capsule_ends(motion, 3.21)
            )

    def test_read_only(self):
        motion = _make(3, loops=False)
        for array in (motion.joints, motion.radii, motion.lengths):
            with self.assertRaises(ValueError):
                array[0] = 1.0
        self.assertEqual(motion.radii.shape, (len(CAPSULES),))

    def test_rejects_what_is_no_motion(self):
        landmarks = _make_landmarks(3)
        landmarks[1, 2, 0] = np.nan
        with self.assertRaisesRegex(ValueError, "finite"):
            mut.make_motion(
                landmarks=landmarks, dt=0.008, loops=False, stature=1.75
            )
        with self.assertRaisesRegex(ValueError, "finite"):
            mut.make_motion(
                landmarks=np.empty((0, len(LANDMARKS), 3)),
                dt=0.008,
                loops=False,
                stature=1.75,
            )


if __name__ == "__main__":
    unittest.main()
