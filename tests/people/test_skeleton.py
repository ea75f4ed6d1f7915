import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

import tofssm_drake.people.skeleton as mut


def _make_standing(stature):
    """A person standing upright at the origin, facing +x."""
    points = {
        "pelvis": [0, 0, 0.53],
        "waist": [0, 0, 0.63],
        "neck": [0, 0, 0.835],
        "head": [0, 0, 0.885],
        "head_top": [0, 0, 1.0],
    }
    for side, sign in (("left", 1), ("right", -1)):
        points |= {
            f"{side}_shoulder": [0, sign * 0.12, 0.818],
            f"{side}_elbow": [0, sign * 0.13, 0.63],
            f"{side}_wrist": [0, sign * 0.13, 0.485],
            f"{side}_hand": [0, sign * 0.13, 0.43],
            f"{side}_hip": [0, sign * 0.05, 0.53],
            f"{side}_knee": [0, sign * 0.05, 0.285],
            f"{side}_ankle": [0, sign * 0.05, 0.039],
            f"{side}_heel": [-0.036, sign * 0.05, 0.022],
            f"{side}_toe": [0.07, sign * 0.05, 0.022],
        }
    return stature * np.array([[points[name] for name in mut.LANDMARKS]])


class SkeletonTest(unittest.TestCase):
    def test_names(self):
        self.assertGreaterEqual(len(mut.CAPSULES), 16)
        for names in (
            [c.name for c in mut.CAPSULES],
            mut.JOINTS,
            mut.LANDMARKS,
        ):
            self.assertEqual(len(set(names)), len(names))
        self.assertEqual(mut.JOINTS[: len(mut.LANDMARKS)], mut.LANDMARKS)
        for capsule in mut.CAPSULES:
            self.assertIn(capsule.colour, mut.COLOURS)

    def test_extent_is_a_persons(self):
        """Stands on the floor, as tall and as broad as the tables say."""
        stature = 1.8
        joints = mut.complete_joints(_make_standing(stature), stature)[0]
        ends = np.stack(
            [joints[mut.CAPSULE_FIRST], joints[mut.CAPSULE_SECOND]], axis=1
        )
        radii = mut.calc_radii(stature)[:, None, None]
        low = np.min(ends - radii, axis=(0, 1))
        high = np.max(ends + radii, axis=(0, 1))
        self.assertAlmostEqual(low[2], 0.0, delta=1e-9)
        self.assertAlmostEqual(high[2], stature, delta=1e-9)
        self.assertTrue(0.22 < (high - low)[1] / stature < 0.36)
        names = [c.name for c in mut.CAPSULES]
        pelvis = names.index("pelvis")
        breadth = np.ptp(ends[pelvis, :, 1]) + 2 * radii[pelvis, 0, 0]
        self.assertAlmostEqual(breadth, mut.HIP_BREADTH * stature, delta=1e-9)

    def test_added_points_are_rigid(self):
        """However the spine bends, pelvis, chest and head keep their shape."""
        standing = _make_standing(1.75)
        rng = np.random.default_rng(0)
        bent = standing + 0.05 * rng.standard_normal((50, *standing.shape[1:]))
        joints = mut.complete_joints(bent, 1.75)
        for names in (
            ("left_pelvis", "right_pelvis"),
            ("left_belly", "right_belly"),
            ("left_upper_rib", "right_lower_rib"),
            ("head_low", "head_high"),
        ):
            a, b = (mut.JOINT_INDEX[name] for name in names)
            length = np.linalg.norm(joints[:, a] - joints[:, b], axis=-1)
            np.testing.assert_allclose(length, length[0], atol=1e-12)

    def test_left_is_left(self):
        joints = mut.complete_joints(_make_standing(1.75), 1.75)[0]
        for name in ("pelvis", "belly", "lower_rib", "upper_rib"):
            self.assertGreater(joints[mut.JOINT_INDEX[f"left_{name}"], 1], 0.01)
            self.assertLess(joints[mut.JOINT_INDEX[f"right_{name}"], 1], -0.01)

    @settings(max_examples=100, deadline=None)
    @given(
        # Whole picometres: between 1e-160 m and nothing the direction of a
        # length is a matter of rounding.
        st.lists(
            st.floats(-2, 2).map(lambda value: round(value, 12)),
            min_size=6,
            max_size=6,
        )
    )
    def test_capsule_poses(self, numbers):
        ends = np.reshape(np.array(numbers), (1, 2, 3))
        poses = np.full((1, 3, 4), np.nan)
        mut.calc_capsule_poses(ends, poses)
        R, p = poses[0, :, :3], poses[0, :, 3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        self.assertAlmostEqual(np.linalg.det(R), 1.0, delta=1e-12)
        np.testing.assert_allclose(p, ends[0].mean(axis=0), atol=1e-12)
        span = ends[0, 1] - ends[0, 0]
        length = np.linalg.norm(span)
        np.testing.assert_allclose(length * R[:, 2], span, atol=1e-11) if (
            length > 0.0
        ) else np.testing.assert_array_equal(R[:, 2], [0, 0, 1])


if __name__ == "__main__":
    unittest.main()
