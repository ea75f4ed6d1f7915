from pathlib import Path
import tempfile
import unittest

from bvh_writer import NAMINGS, PERIOD, SPEED, write_bvh
import numpy as np
from pydrake.common.yaml import yaml_load_typed

from tofssm_drake.errors import UserError
import tofssm_drake.people.bvh as mut
from tofssm_drake.people.figure_eight import FigureEight, FigureEightPath
from tofssm_drake.people.motion import capsule_ends
from tofssm_drake.people.skeleton import (
    FOOT_RADIUS,
    JOINT_INDEX,
    LANDMARK_INDEX,
    LANDMARKS,
)
from tofssm_drake.people.walk import calc_slip

_DT = 0.008


def _get(motion, name):
    return motion.joints[:, JOINT_INDEX[name]]


def _calc_heading(motion, row):
    left = (_get(motion, "left_hip") - _get(motion, "right_hip"))[row]
    return np.degrees(np.arctan2(-left[0], left[1]))


def _calc_slides(motion, slowest):
    """How far each foot slides while it is down, m."""
    slides = []
    for side in ("left", "right"):
        slip = calc_slip(motion.joints[:, : len(LANDMARKS)], side, motion.dt)
        down = np.flatnonzero(np.linalg.norm(slip, axis=-1) < slowest)
        for rows in np.split(down, np.flatnonzero(np.diff(down) > 1) + 1):
            if len(rows) * motion.dt > 0.2:
                way = np.cumsum(slip[rows], axis=0) * motion.dt
                slides.append(np.ptp(way, axis=0).max())
    return slides


class BvhMotionTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.path = write_bvh(Path(cls.folder.name) / "walk.bvh")
        cls.turned = write_bvh(
            Path(cls.folder.name) / "turned.bvh",
            heading_deg=140.0,
            up="z",
            naming="anatomy",
            metres_per_unit=0.0254,
        )

    def _make(self, dt=_DT, **kwargs):
        kwargs.setdefault("filename", self.path)
        return mut.make_bvh_motion(mut.BvhRecording(**kwargs), dt)

    def test_in_place(self):
        for filename in (self.path, self.turned):
            dut = self._make(
                filename=filename,
                placement="in_place",
                position=[0.4, -0.3],
                heading_deg=30.0,
            )
            self.assertFalse(dut.loops)
            self.assertAlmostEqual(dut.duration, 4.0, delta=_DT)
            pelvis = _get(dut, "pelvis")
            np.testing.assert_allclose(
                pelvis[:, :2], [[0.4, -0.3]] * len(pelvis), atol=1e-9
            )
            self.assertAlmostEqual(_calc_heading(dut, 0), 30.0, delta=8.0)
            self.assertGreater(np.ptp(pelvis[:, 2]), 0.02)

    def test_own_path(self):
        for filename in (self.path, self.turned):
            dut = self._make(
                filename=filename,
                placement="own_path",
                position=[1.0, 2.0],
                heading_deg=-90.0,
            )
            pelvis = _get(dut, "pelvis")
            np.testing.assert_allclose(pelvis[0, :2], [1.0, 2.0], atol=1e-9)
            way = pelvis[-1] - pelvis[0]
            self.assertAlmostEqual(np.hypot(*way[:2]), 4 * SPEED, delta=0.02)
            heading = np.degrees(np.arctan2(way[1], way[0]))
            self.assertAlmostEqual(heading, -90.0, delta=8.0)
            np.testing.assert_array_equal(
                capsule_ends(dut, 4.0), capsule_ends(dut, 60.0)
            )

    def test_loops_are_smooth(self):
        for placement in ("in_place", "own_path"):
            dut = self._make(placement=placement, loop=True)
            self.assertTrue(dut.loops)
            joints = dut.joints
            step = joints - np.roll(joints, 1, axis=0)
            speed = np.linalg.norm(step, axis=-1) / _DT
            recorded = round(4.0 / _DT)
            self.assertLess(
                speed[[0, *range(recorded, len(joints))]].max(),
                1.2 * speed[1:recorded].max(),
            )
            pelvis = speed[:, JOINT_INDEX["pelvis"]]
            self.assertLess(pelvis.max(), 1.8)
            # Neither a jump in velocity where it joins.
            change = np.linalg.norm(step - np.roll(step, 1, axis=0), axis=-1)
            within = change[2:recorded].max()
            self.assertLess(change.max(), 2 * within + 0.3 * _DT)
            for side in ("left", "right"):
                for name in ("toe", "heel"):
                    lowest = _get(dut, f"{side}_{name}")[:, 2].min()
                    self.assertGreater(lowest, FOOT_RADIUS * dut.stature - 1e-6)
                thigh = np.linalg.norm(
                    _get(dut, f"{side}_hip") - _get(dut, f"{side}_knee"),
                    axis=-1,
                )
                self.assertLess(np.ptp(thigh), 1e-3)

    def test_figure_eight(self):
        for filename in (self.path, self.turned):
            dut = self._make(filename=filename)
            self.assertTrue(dut.loops)
            path = FigureEightPath(config=FigureEight())
            laps = dut.duration * SPEED / path.length
            self.assertAlmostEqual(laps, round(laps), delta=0.03)
            rows = len(dut.joints)
            s = round(laps) * path.length * np.arange(rows) / rows
            away = _get(dut, "pelvis")[:, :2] - path.calc_position(s)
            self.assertLess(np.linalg.norm(away, axis=-1).max(), 0.06)
            # The steps are the recording's.
            knee = _get(dut, "left_knee")[:, 2]
            spectrum = np.abs(np.fft.rfft(knee - knee.mean()))
            frequency = np.argmax(spectrum) / dut.duration
            self.assertAlmostEqual(frequency * PERIOD, 1.0, delta=0.06)

    def test_feet_do_not_skate(self):
        dut = self._make()
        slides = _calc_slides(dut, 0.3 * SPEED)
        self.assertGreater(len(slides), 8)
        self.assertLess(max(slides), 0.03)
        for side in ("left", "right"):
            for name in ("toe", "heel"):
                lowest = _get(dut, f"{side}_{name}")[:, 2].min()
                sole = FOOT_RADIUS * dut.stature
                self.assertGreater(lowest, sole - 1e-6)
                self.assertLess(lowest, sole + 0.02)

    def test_bones_keep_their_lengths(self):
        for placement in mut.PLACEMENTS:
            dut = self._make(placement=placement)
            for side in ("left", "right"):
                for a, b in (
                    ("hip", "knee"),
                    ("knee", "ankle"),
                    ("ankle", "toe"),
                    ("ankle", "heel"),
                    ("shoulder", "elbow"),
                    ("elbow", "wrist"),
                ):
                    length = np.linalg.norm(
                        _get(dut, f"{side}_{a}") - _get(dut, f"{side}_{b}"),
                        axis=-1,
                    )
                    self.assertLess(np.ptp(length), 1e-3, (placement, side, a))

    def test_speed_can_be_given(self):
        own = self._make()
        slow = self._make(speed=0.6)
        self.assertAlmostEqual(
            slow.duration / own.duration, SPEED / 0.6, delta=0.05
        )

    def test_dt(self):
        """The same motion on any tick."""
        coarse, fine = (
            self._make(placement="own_path"),
            self._make(dt=0.002, placement="own_path"),
        )
        for t in (0.0, 1.0, 3.3):
            np.testing.assert_allclose(
                capsule_ends(coarse, t), capsule_ends(fine, t), atol=5e-3
            )

    def test_gait(self):
        performance = mut.make_performance(mut.read_bvh(self.path), _DT)
        dut = mut.find_gait(performance, _DT)
        self.assertAlmostEqual(dut.period, PERIOD, delta=0.02)
        self.assertAlmostEqual(dut.stride / dut.period, SPEED, delta=0.02)
        # It repeats itself: its seam is no wider than any step.
        step = np.linalg.norm(
            dut.landmarks - np.roll(dut.landmarks, 1, axis=0), axis=-1
        )
        knees = [LANDMARK_INDEX[f"{s}_knee"] for s in ("left", "right")]
        others = [i for i in range(len(LANDMARKS)) if i not in knees]
        self.assertLess(
            step[0, others].max(), 1.2 * step[1:, others].max() + 1e-3
        )

    def test_on_the_spot(self):
        """A treadmill's recording walks the figure of eight, too."""
        path = write_bvh(
            Path(self.folder.name) / "spot.bvh", root_position=False
        )
        dut = self._make(filename=path)
        travel = np.diff(_get(dut, "pelvis")[:, :2], axis=0)
        speed = np.linalg.norm(travel, axis=-1) / _DT
        self.assertTrue(0.6 < np.median(speed) < 1.5)

    def test_nobody_walks(self):
        path = write_bvh(Path(self.folder.name) / "still.bvh", duration=0.5)
        with self.assertRaisesRegex(UserError, r"still\.bvh:2: nobody walks"):
            self._make(filename=path)
        dut = self._make(filename=path, placement="in_place", loop=True)
        self.assertGreater(dut.duration, 0.5)
        path = write_bvh(Path(self.folder.name) / "one.bvh", duration=0.0)
        with self.assertRaisesRegex(UserError, "nobody walks"):
            self._make(filename=path)
        for loop in (True, False):
            dut = self._make(filename=path, placement="own_path", loop=loop)
            self.assertEqual(len(dut.joints), 1)

    def test_all_dialects_walk_alike(self):
        plain = self._make(placement="own_path")
        for naming in NAMINGS:
            path = write_bvh(
                Path(self.folder.name) / "dialect.bvh",
                naming=naming,
                duration=1.2,
                metres_per_unit=0.01,
            )
            dut = self._make(filename=path, placement="own_path")
            np.testing.assert_allclose(
                capsule_ends(dut, 1.0),
                capsule_ends(plain, 1.0),
                atol=0.01,
            )

    def test_yaml(self):
        config = yaml_load_typed(
            schema=mut.BvhRecording,
            data="""
                filename: walk.bvh
                placement: own_path
                position: [0, 1]
                speed: 1.1
                end_time: null
                figure_eight: {half_length: 2}
            """,
            defaults=mut.BvhRecording(),
        )
        self.assertEqual(config.speed, 1.1)
        self.assertIsNone(config.end_time)
        self.assertEqual(config.figure_eight.half_length, 2)

    def test_check(self):
        mut.BvhRecording(filename="a.bvh").check("human")
        mut.BvhRecording(filename="a.bvh", units="0.056").check("human")
        for name, value in (
            ("filename", ""),
            ("units", "parsec"),
            ("units", "-1"),
            ("up", "w"),
            ("placement", "moon"),
            ("position", [1.0]),
            ("position", [1.0, np.nan]),
            ("position", [1e120, 0.0]),
            ("position", [0.0, -100.1]),
            ("heading_deg", 1e300),
            ("heading_deg", np.inf),
            ("start_time", -1.0),
            ("end_time", 0.0),
            ("speed", 9.0),
        ):
            with self.subTest(name=name, value=value):
                config = mut.BvhRecording(
                    **({"filename": "a.bvh"} | {name: value})
                )
                with self.assertRaisesRegex(UserError, rf"^human\.{name}: "):
                    config.check("human")

    def test_file_errors_come_through(self):
        with self.assertRaisesRegex(UserError, "no such file"):
            self._make(filename="/nowhere/walk.bvh")


if __name__ == "__main__":
    unittest.main()
