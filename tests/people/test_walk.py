import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.common.yaml import yaml_load_typed

from tofssm_drake.errors import UserError
from tofssm_drake.people.figure_eight import FigureEightPath
from tofssm_drake.people.motion import capsule_ends
from tofssm_drake.people.skeleton import (
    FOOT_RADIUS,
    JOINT_INDEX,
    LANDMARK_INDEX,
)
import tofssm_drake.people.walk as mut

_DT = 0.008
_SIDES = ("left", "right")


def _calc_knee_flexion(points, index, side):
    hip, knee, ankle = (
        points[:, index[f"{side}_{name}"]] for name in ("hip", "knee", "ankle")
    )
    a, b = knee - hip, ankle - knee
    cosine = np.sum(a * b, -1) / (
        np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    )
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _calc_box_gap(ends, radii, low, high):
    """Smallest gap between capsules and a box, by sampling the axes."""
    u = np.linspace(0, 1, 21)[:, None, None]
    points = (1 - u) * ends[None, :, 0] + u * ends[None, :, 1]
    outside = np.maximum(np.maximum(low - points, points - high), 0.0)
    return np.min(np.linalg.norm(outside, axis=-1) - radii)


class GaitTest(unittest.TestCase):
    def setUp(self):
        self.dut = mut.make_gait(speed=1.2, stride=1.4, stature=1.75)

    def _get(self, name):
        return self.dut.landmarks[:, LANDMARK_INDEX[name]]

    def test_knees_bend(self):
        for side in _SIDES:
            flexion = _calc_knee_flexion(
                self.dut.landmarks, LANDMARK_INDEX, side
            )
            self.assertTrue(3 < flexion.min() < 25)
            self.assertTrue(45 < flexion.max() < 75)
            # Forwards, as knees do.
            middle = 0.5 * (
                self._get(f"{side}_hip") + self._get(f"{side}_ankle")
            )
            self.assertTrue((self._get(f"{side}_knee") > middle)[:, 0].all())

    def test_arms_swing_against_legs(self):
        for side in _SIDES:
            arm = self._get(f"{side}_wrist") - self._get(f"{side}_shoulder")
            leg = self._get(f"{side}_ankle") - self._get(f"{side}_hip")
            self.assertLess(np.corrcoef(arm[:, 0], leg[:, 0])[0, 1], -0.8)
            self.assertGreater(np.ptp(arm[:, 0]), 0.25)

    def test_sides_mirror_each_other(self):
        half = len(self.dut.landmarks) // 2
        for name in ("hip", "knee", "ankle", "toe", "elbow", "hand"):
            right = np.roll(self._get(f"right_{name}"), half, axis=0)
            np.testing.assert_allclose(
                self._get(f"left_{name}"), right * [1, -1, 1], atol=1e-9
            )

    def test_feet_stand_still_on_the_floor(self):
        phase = np.arange(len(self.dut.landmarks)) / len(self.dut.landmarks)
        sole = FOOT_RADIUS * 1.75
        for side, first in (("left", 0.0), ("right", 0.5)):
            u = (phase - first) % 1.0
            for name, start, stop in (("heel", 0, 0.29), ("toe", 0.1, 0.6)):
                stance = (u > start + 1e-9) & (u < stop)
                p = self._get(f"{side}_{name}")[stance]
                x = p[:, 0] + self.dut.stride * u[stance]
                self.assertLess(np.ptp(x), 0.002)
                self.assertLess(np.ptp(p[:, 1]), 0.002)
                np.testing.assert_allclose(p[:, 2], sole, atol=1e-3)

    @settings(max_examples=25, deadline=None)
    @given(st.floats(0.3, 2.0), st.floats(1.1, 2.2))
    def test_any_walker(self, speed, stature):
        stride = 2 * np.sqrt(60 * speed * 0.0065 * stature / 1.75)
        stride = min(stride, 0.94 * stature)
        dut = mut.make_gait(speed=speed, stride=stride, stature=stature)
        p = dut.landmarks
        self.assertTrue(np.isfinite(p).all())
        self.assertAlmostEqual(dut.period, stride / speed)
        for side in _SIDES:
            for name in ("heel", "toe"):
                z = p[:, LANDMARK_INDEX[f"{side}_{name}"], 2]
                self.assertGreater(z.min(), FOOT_RADIUS * stature - 1e-6)
                self.assertLess(z.min(), FOOT_RADIUS * stature + 1e-3)
            hip, knee, ankle = (
                p[:, LANDMARK_INDEX[f"{side}_{name}"]]
                for name in ("hip", "knee", "ankle")
            )
            thigh = np.linalg.norm(knee - hip, axis=-1)
            shank = np.linalg.norm(ankle - knee, axis=-1)
            np.testing.assert_allclose(thigh, 0.245 * stature, atol=1e-9)
            np.testing.assert_allclose(shank, 0.246 * stature, atol=1e-9)
        top = p[:, LANDMARK_INDEX["head_top"], 2]
        self.assertTrue(0.85 * stature < top.min())
        self.assertTrue(top.max() <= stature)


class WalkTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.config = mut.GeneratedWalk()
        cls.dut = mut.make_walk(cls.config, _DT)

    def _get(self, name):
        return self.dut.joints[:, JOINT_INDEX[name]]

    def test_speed_and_path(self):
        path = FigureEightPath(config=self.config.figure_eight)
        self.assertTrue(self.dut.loops)
        self.assertAlmostEqual(
            self.dut.duration, path.length / self.config.speed, delta=_DT
        )
        s = path.length * np.arange(len(self.dut.joints))
        on_path = path.calc_position(s / len(self.dut.joints))
        away = np.linalg.norm(self._get("pelvis")[:, :2] - on_path, axis=-1)
        self.assertLess(away.max(), 0.04)

    def test_starts_at_the_far_end(self):
        np.testing.assert_allclose(
            self._get("pelvis")[0, :2], [1.15, 1.5], atol=0.05
        )

    def test_closes_smoothly(self):
        """No seam: the step from last to first row is like all others."""
        joints = self.dut.joints
        step = np.linalg.norm(joints - np.roll(joints, 1, axis=0), axis=-1)
        self.assertTrue((step[0] <= step[1:].max(axis=0) + 1e-4).all())
        self.assertLess(step.max(), 6.5 * _DT)
        second = np.roll(joints, 1, 0) + np.roll(joints, -1, 0) - 2 * joints
        jolt = np.linalg.norm(second, axis=-1)
        self.assertLess(jolt[[0, -1]].max(), jolt[1:-1].max() + 1e-6)

    def test_feet_do_not_skate(self):
        """On curves as on the straight each toe rests half of the time."""
        for side in _SIDES:
            toe = self._get(f"{side}_toe")
            speed = np.linalg.norm(np.diff(toe, axis=0), axis=-1) / _DT
            self.assertGreater(np.mean(speed < 0.02), 0.48)
            self.assertGreater(
                toe[:, 2].min(), FOOT_RADIUS * self.dut.stature - 1e-6
            )

    def test_bones_keep_their_lengths(self):
        for side in _SIDES:
            for a, b in (
                ("hip", "knee"),
                ("knee", "ankle"),
                ("ankle", "toe"),
                ("shoulder", "elbow"),
                ("elbow", "wrist"),
            ):
                length = np.linalg.norm(
                    self._get(f"{side}_{a}") - self._get(f"{side}_{b}"),
                    axis=-1,
                )
                self.assertLess(np.ptp(length), 1e-3, (side, a))

    def test_knees_bend_forwards(self):
        heading = np.roll(self._get("pelvis"), -20, 0) - self._get("pelvis")
        for side in _SIDES:
            flexion = _calc_knee_flexion(self.dut.joints, JOINT_INDEX, side)
            self.assertTrue(45 < flexion.max() < 80)
            middle = 0.5 * (
                self._get(f"{side}_hip") + self._get(f"{side}_ankle")
            )
            ahead = np.sum((self._get(f"{side}_knee") - middle) * heading, -1)
            self.assertGreater(ahead.min(), 0.0)

    def test_stays_out_of_the_cell(self):
        """Not through the tables, nor through the robot's pedestal."""
        for t in np.arange(0.0, self.dut.duration, 0.04):
            ends = capsule_ends(self.dut, t)
            for centre, half in (
                ([0, 0.82], 0.25),
                ([0, -0.82], 0.25),
                ([0, 0], 0.2),
            ):
                gap = _calc_box_gap(
                    ends,
                    self.dut.radii,
                    np.array([centre[0] - half, centre[1] - half, 0.0]),
                    np.array([centre[0] + half, centre[1] + half, 2.0]),
                )
                self.assertGreater(gap, 0.05)

    def test_enters_the_workspace(self):
        nearest = np.linalg.norm(self.dut.joints[:, :, :2], axis=-1).min()
        self.assertLess(nearest, 0.82)

    def test_any_setting(self):
        for speed, stature in ((0.3, 1.5), (2.0, 1.95)):
            dut = mut.make_walk(
                mut.GeneratedWalk(speed=speed, stature=stature), 0.002
            )
            pelvis = dut.joints[:, JOINT_INDEX["pelvis"]]
            travel = np.linalg.norm(
                np.diff(pelvis[:, :2], axis=0), axis=-1
            ).sum()
            self.assertAlmostEqual(
                travel / dut.duration / speed, 1.0, delta=0.05
            )

    def test_yaml(self):
        config = yaml_load_typed(
            schema=mut.GeneratedWalk,
            data="{speed: 0.9, figure_eight: {centre: [1, 2]}}",
            defaults=mut.GeneratedWalk(),
        )
        self.assertEqual(config.speed, 0.9)
        self.assertEqual(config.figure_eight.centre, [1, 2])
        self.assertEqual(config.figure_eight.half_length, 1.5)

    def test_check(self):
        for name, value in (
            ("speed", 0.0),
            ("speed", float("nan")),
            ("stature", 3.0),
        ):
            config = mut.GeneratedWalk(**{name: value})
            with self.assertRaisesRegex(UserError, rf"^human\.{name}: "):
                config.check("human")
            with self.assertRaises(UserError):
                mut.make_walk(config, _DT)
        config = mut.GeneratedWalk()
        config.figure_eight.start = -1
        with self.assertRaisesRegex(UserError, r"^human\.figure_eight\.start"):
            config.check("human")


if __name__ == "__main__":
    unittest.main()
