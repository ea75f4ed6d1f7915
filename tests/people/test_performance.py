from pathlib import Path
import tempfile
import unittest

from bvh_writer import NAMINGS, calc_joints, write_bvh
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.people.bvh_file import read_bvh
import tofssm_drake.people.performance as mut
from tofssm_drake.people.skeleton import (
    FOOT_RADIUS,
    LANDMARK_INDEX,
    LANDMARKS,
)

_DT = 0.008


class PerformanceTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.path = Path(cls.folder.name) / "walk.bvh"
        cls.plain = cls._make(cls)

    def _make(self, config=None, **kwargs):
        kwargs.setdefault("duration", 1.3)
        file = read_bvh(write_bvh(self.path, **kwargs))
        return mut.make_performance(file, _DT, **(config or {}))

    def _get(self, name):
        return self.plain.landmarks[:, LANDMARK_INDEX[name]]

    def _check_same(self, dut, atol=2e-5):
        self.assertAlmostEqual(dut.stature, self.plain.stature, delta=atol)
        np.testing.assert_allclose(
            dut.landmarks, self.plain.landmarks, atol=atol
        )

    def test_is_the_person_recorded(self):
        """Metres, z up, x forward: where the writer put the joints."""
        times = _DT * np.arange(len(self.plain.landmarks))
        expected = [calc_joints(t) for t in times[::15]]
        lift = None
        for name in LANDMARKS:
            key = name
            if key not in expected[0]:
                continue
            if key.endswith(("toe", "knee", "ankle")):
                continue  # The feet are put on the floor.
            p = np.array([q[key] for q in expected])[:, [2, 0, 1]]
            difference = self._get(name)[::15] - p
            if lift is None:
                lift = difference[0]
                np.testing.assert_allclose(lift[:2], 0.0, atol=1e-3)
            np.testing.assert_allclose(difference - lift, 0.0, atol=2e-3)

    def test_stature(self):
        # Head joint at 1.42 m over soles about 0.08 m below the ankles.
        self.assertTrue(1.6 < self.plain.stature < 1.85)
        top = self._get("head_top")[:, 2]
        self.assertLess(abs(top.max() / self.plain.stature - 1), 0.06)

    def test_feet_are_on_the_floor(self):
        sole = FOOT_RADIUS * self.plain.stature
        lowest = mut.calc_lowest(self.plain.landmarks)
        self.assertGreaterEqual(lowest.min(), sole - 1e-9)
        self.assertLess(np.median(lowest), sole + 0.02)
        for side in ("left", "right"):
            for pair in (
                ("hip", "knee"),
                ("knee", "ankle"),
                ("ankle", "heel"),
                ("ankle", "toe"),
                ("shoulder", "elbow"),
                ("elbow", "wrist"),
                ("wrist", "hand"),
            ):
                a, b = (self._get(f"{side}_{name}") for name in pair)
                length = np.linalg.norm(a - b, axis=-1)
                self.assertLess(np.ptp(length), 1e-3, pair)
            heel, toe = self._get(f"{side}_heel"), self._get(f"{side}_toe")
            self.assertTrue((toe - heel)[:, 0].mean() > 0.1)

    def test_facing(self):
        facing = mut.calc_facing(self.plain.landmarks)
        self.assertTrue((facing[:, 0] > 0.95).all())

    def test_any_naming(self):
        for naming in NAMINGS:
            with self.subTest(naming=naming):
                self._check_same(self._make(naming=naming))

    def test_any_unit(self):
        for name, scale in mut.UNITS.items():
            with self.subTest(name=name):
                dut = self._make(metres_per_unit=scale)
                self.assertEqual(dut.units, scale)
                self._check_same(dut)
        dut = self._make({"units": "0.11"}, metres_per_unit=0.11)
        self._check_same(dut)
        self._check_same(self._make({"units": "cm"}, metres_per_unit=0.01))

    def test_any_vertical(self):
        for up in ("y", "z"):
            for given in ("auto", up):
                dut = self._make({"up": given}, up=up)
                self.assertEqual(dut.up, up)
                self._check_same(dut)
        dut = self._make(up="-y")
        self.assertEqual(dut.up, "-y")
        np.testing.assert_allclose(
            dut.landmarks[..., 2], self.plain.landmarks[..., 2], atol=1e-5
        )
        facing = mut.calc_facing(dut.landmarks)
        travel = dut.landmarks[-1, 0] - dut.landmarks[0, 0]
        self.assertGreater(facing[0] @ travel, 1.5)

    def test_any_channels(self):
        self._check_same(self._make(order=(0, 1, 2)))
        self._check_same(self._make(joint_positions="replace"))
        self._check_same(self._make(joint_positions="add"))
        self._check_same(self._make(newline="\r\n"))

    def test_calibration_frame_is_left_out(self):
        self._check_same(self._make(calibration=True))

    def test_other_frame_rates(self):
        for fps, atol in ((30.0, 0.02), (250.0, 2e-3)):
            dut = self._make(fps=fps)
            rows = min(len(dut.landmarks), len(self.plain.landmarks))
            np.testing.assert_allclose(
                dut.landmarks[:rows], self.plain.landmarks[:rows], atol=atol
            )

    def test_root_without_position(self):
        """Then the standing foot tells the way; it does not slip."""
        dut = self._make(root_position=False)
        travel = dut.landmarks[-1, 0] - dut.landmarks[0, 0]
        expected = self.plain.landmarks[-1, 0] - self.plain.landmarks[0, 0]
        self.assertAlmostEqual(travel[0], expected[0], delta=0.9)
        self.assertGreater(travel[0], 1.0)
        np.testing.assert_allclose(
            mut.calc_lowest(dut.landmarks),
            FOOT_RADIUS * dut.stature,
            atol=1e-9,
        )

    def test_part_of_a_recording(self):
        dut = self._make({"start_time": 0.4, "end_time": 1.2})
        self.assertEqual(len(dut.landmarks), 101)
        for config in ({"start_time": 3.0}, {"end_time": 1.4}):
            with self.assertRaisesRegex(UserError, "lasts 1.3"):
                self._make(config)

    def test_one_frame(self):
        dut = self._make(duration=0.0)
        self.assertEqual(len(dut.landmarks), 1)
        self.assertTrue(np.isfinite(dut.landmarks).all())

    def test_missing_joints(self):
        write_bvh(self.path, duration=0.1)
        text = self.path.read_text()
        for name, message in (
            ("LeftLeg", "no left knee .*Leg, Shin or Knee with Left or L"),
            ("RightForeArm", "no right elbow"),
            ("LeftUpLeg", "no left hip"),
        ):
            self.path.write_text(text.replace(f"{name}\n", "Tail\n"))
            with self.assertRaisesRegex(UserError, rf"walk\.bvh:2: {message}"):
                mut.make_performance(read_bvh(self.path), _DT)

    def test_head_and_toes_are_not_needed(self):
        write_bvh(self.path, duration=1.3)
        text = self.path.read_text()
        for name in ("Head", "LeftToeBase", "RightToeBase"):
            text = text.replace(f"{name}\n", "Thing\n")
        self.path.write_text(text)
        dut = mut.make_performance(read_bvh(self.path), _DT)
        away = np.linalg.norm(dut.landmarks - self.plain.landmarks, axis=-1)
        self.assertLess(away.max(), 0.1)

    def test_no_vertical(self):
        """A person who lies down does not tell what is up."""
        write_bvh(self.path, duration=0.1)
        lines = self.path.read_text().splitlines()
        for k in range(len(lines) - 13, len(lines)):
            row = lines[k].split()
            row[3:6] = ["0", "0", "45"]
            lines[k] = " ".join(row)
        self.path.write_text("\n".join(lines))
        file = read_bvh(self.path)
        with self.assertRaisesRegex(UserError, r"walk\.bvh:2: .*up: y"):
            mut.make_performance(file, _DT)
        mut.make_performance(file, _DT, up="y")

    def test_no_unit(self):
        write_bvh(self.path, duration=0.1, metres_per_unit=30.0)
        with self.assertRaisesRegex(UserError, "give units"):
            mut.make_performance(read_bvh(self.path), _DT)
        write_bvh(self.path, duration=0.1)
        with self.assertRaisesRegex(UserError, "units cm make a person"):
            mut.make_performance(read_bvh(self.path), _DT, units="cm")

    def test_roles(self):
        roles = mut.find_roles(
            ["Hips", "LHipJoint", "LeftHip", "LeftKnee", "Leg_R", "LFingers"]
        )
        self.assertEqual(
            roles, {"left_hip": 2, "left_knee": 3, "right_knee": 4}
        )
        roles = mut.find_roles(
            ["L_Hip", "L_Ankle", "L_Foot", "LeftShoulder", "LeftArm", "Head"]
        )
        self.assertEqual(
            roles,
            {
                "left_hip": 0,
                "left_ankle": 1,
                "left_toe": 2,
                "left_shoulder": 4,
                "head": 5,
            },
        )


if __name__ == "__main__":
    unittest.main()
