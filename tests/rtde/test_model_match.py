"""Is it the modelled robot?"""

import dataclasses as dc
import math
import unittest

from dh_arms import UR5E, UR10, calc_dh_pose
import numpy as np
from robot_room import make_kinematics, make_robot
from scipy.spatial.transform import Rotation

from tofssm_drake.arms.arm import make_arm_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotReport
import tofssm_drake.rtde.model_match as mut

_NAN = np.full(6, np.nan)


def make_report(q, pose, offset=_NAN, **fields):
    return RobotReport(
        **{
            "session": 0,
            "timestamp": 100.0,
            "position": np.asarray(q, dtype=float),
            "tcp_pose": np.asarray(pose, dtype=float),
            "tcp_offset": np.asarray(offset, dtype=float),
        }
        | fields
    )


def start(report, **settings):
    return mut.start_model_match(
        mut.ModelConfig(**settings), make_kinematics(), report
    )


def list_joints(count=20):
    """Returns arbitrary joints, and those of the program's beginning."""
    path = make_robot()._path
    return [
        *np.random.default_rng(3).uniform(-3, 3, (count, 6)),
        *(path.calc_motion(t)[0] for t in (0.0, 2.0, 4.0)),
    ]


class TestStart(unittest.TestCase):
    def test_modelled_robot(self):
        """Against the published table, with and without a reported offset."""
        for q in list_joints():
            for p_FT in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.2), (0.1, -0.05, 0.3)):
                pose = calc_dh_pose(q, UR10, p_FT)
                for offset in (_NAN, (*p_FT, 0, 0, 0)):
                    start(make_report(q, pose, offset))

    def test_tool_that_is_turned(self):
        q = list_joints()[0]
        flange = mut.make_pose(calc_dh_pose(q, UR10))
        offset = np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.5])
        tool = mut.compose(flange, mut.make_pose(offset))
        rotation = Rotation.from_matrix(tool[:, :3]).as_rotvec()
        pose = np.concatenate([tool[:, 3], rotation])
        start(make_report(q, pose, offset))
        start(make_report(q, pose))
        offset = np.add(offset, [0, 0, 0, 0.05, 0, 0])
        with self.assertRaisesRegex(UserError, "0 mm and 2.7 deg from where"):
            start(make_report(q, pose, offset))

    def test_calibration_of_a_real_arm_is_put_up_with(self):
        """Lengths that differ by millimetres, as those of the old manual."""
        robot = (
            (0, -0.6127, -0.5716, 0, 0, 0),
            (0.1280, 0, 0, 0.1639, 0.1157, 0.0922),
        )
        for q in list_joints():
            start(make_report(q, calc_dh_pose(q, robot), np.zeros(6)))

    def test_zeros_of_a_robot_that_does_not_know(self):
        for offset in (_NAN, np.zeros(6)):
            with self.subTest(offset=offset):
                with self.assertRaisesRegex(UserError, "^robot: reported tool"):
                    start(make_report(np.zeros(6), np.zeros(6), offset))
        # sqrt((0.612 + 0.5723)^2 + (0.163941 + 0.0922)^2
        # + (0.1273 - 0.1157)^2) = 1.212 m.
        with self.assertRaisesRegex(UserError, "is 1212 mm and 90.0 deg from"):
            start(make_report(np.zeros(6), np.zeros(6), np.zeros(6)))

    def test_ur5e(self):
        for q in list_joints():
            pose = calc_dh_pose(q, UR5E, (0, 0, 0.2))
            with self.assertRaisesRegex(UserError, "mm and 0.0 deg from"):
                start(make_report(q, pose, (0, 0, 0.2, 0, 0, 0)))

    def test_ur5e_that_is_modelled(self):
        """Against the published table: a UR5e's reports fit a UR5e's model."""
        kinematics = ArmKinematics.from_plant(
            make_arm_plant(UrArm(model="ur5e"))
        )
        for q in list_joints():
            pose = calc_dh_pose(q, UR5E, (0, 0, 0.2))
            report = make_report(q, pose, (0, 0, 0.2, 0, 0, 0))
            mut.start_model_match(mut.ModelConfig(), kinematics, report)

    def test_no_pose(self):
        report = make_report(np.zeros(6), _NAN)
        with self.assertRaisesRegex(UserError, "--allow-no-pose"):
            start(report)
        match = start(report, allow_no_pose=True)
        config = mut.ModelConfig(allow_no_pose=True)
        kinematics = make_kinematics()
        match = mut.step_model_match(config, kinematics, match, report)
        self.assertEqual(match.problem, "")
        self.assertIn(
            "reports no pose", mut.describe_tool(config, kinematics, report)
        )

    def test_tool_that_is_not_the_modelled_one(self):
        kinematics, config = make_kinematics(), mut.ModelConfig()
        q = list_joints()[0]
        modelled = kinematics.X_AS[-1][:, 3]
        for more, says in ((0.0, ""), (0.25, "is set 250 mm from")):
            p_FT = np.add(modelled, [0, 0, more])
            report = make_report(q, calc_dh_pose(q, UR10, p_FT))
            line = mut.describe_tool(config, kinematics, report)
            self.assertEqual(bool(line), bool(says))
            self.assertIn(says, line)

    def test_settings(self):
        for name, value in (
            ("position_tolerance", 0.0),
            ("position_tolerance", math.nan),
            ("angle_tolerance", 1.0),
            ("longest_tcp_offset", -1.0),
            ("check_period", 2.0),
            ("confirm_time", 0.0),
        ):
            with self.subTest(name=name, value=value):
                config = dc.replace(mut.ModelConfig(), **{name: value})
                with self.assertRaisesRegex(UserError, rf"^model\.{name}: "):
                    config.check("model")


class TestStep(unittest.TestCase):
    def run_robot(self, robot, *, seconds, has_offset=True):
        """Returns when something was wrong, s from now, and what."""
        config, match = mut.ModelConfig(), mut.ModelMatch()
        act, begin = robot.timestamp, math.nan
        for _ in range(round(seconds * robot.rate)):
            if robot.timestamp - act > 0.5 and math.isnan(begin):
                begin = robot.timestamp
                self.act()
            robot.step()
            out = robot.outputs
            match = mut.step_model_match(
                config,
                make_kinematics(),
                match,
                make_report(
                    out["actual_q"],
                    out["actual_TCP_pose"],
                    out["tcp_offset"] if has_offset else _NAN,
                    timestamp=robot.timestamp,
                ),
            )
            if match.problem:
                return robot.timestamp - begin, match.problem
        return math.inf, ""

    def test_all_is_well_over_the_program(self):
        self.act = lambda: None
        for has_offset in (True, False):
            elapsed, _ = self.run_robot(
                make_robot(), seconds=13.0, has_offset=has_offset
            )
            self.assertEqual(elapsed, math.inf)

    def test_faults(self):
        """It must last for 0.2 s, and is checked every 0.04 s."""
        for series in ("cb3", "e"):
            for has_offset in (True, False):
                robot = make_robot(series=series)
                self.act = lambda r=robot: r.joint_offset.__setitem__(0, 0.1)
                elapsed, problem = self.run_robot(
                    robot, seconds=3.0, has_offset=has_offset
                )
                self.assertLessEqual(elapsed, 0.27)
                # 0.1 rad are 5.7 deg.
                self.assertRegex(problem, "is [0-9]+ mm and 5.7 deg from where")

    def test_joints_that_are_late(self):
        """Found as soon as the arm is fast for long enough."""
        robot = make_robot()
        self.act = lambda: setattr(robot, "joints_late", 0.05)
        elapsed, _ = self.run_robot(robot, seconds=13.0)
        self.assertLess(elapsed, 2.0)

    def test_tool_that_changes(self):
        """Fine if the offset is reported; otherwise it is another robot."""
        for has_offset in (True, False):
            robot = make_robot()
            self.act = lambda r=robot: r.tcp_offset.__setitem__(2, 0.3)
            elapsed, problem = self.run_robot(
                robot, seconds=2.0, has_offset=has_offset
            )
            self.assertEqual(elapsed < 0.27, not has_offset)
            if not has_offset:
                self.assertIn("is 100 mm and 0.0 deg from", problem)

    def test_ur5e_whose_offset_is_not_known(self):
        """A wrong arm's apparent tool does not stay the same."""
        path = make_robot()._path
        config, match = mut.ModelConfig(longest_tcp_offset=2), mut.ModelMatch()
        for i in range(500):
            q = path.calc_motion(0.008 * i)[0]
            report = make_report(
                q, calc_dh_pose(q, UR5E), timestamp=100 + 0.008 * i
            )
            match = mut.step_model_match(
                config, make_kinematics(), match, report
            )
            if match.problem:
                break
        self.assertIn("from where the modelled arm has it", match.problem)

    def test_pose_that_vanishes(self):
        config, match = mut.ModelConfig(), mut.ModelMatch()
        q = list_joints()[0]
        for t in np.arange(100.0, 100.5, 0.008):
            pose = calc_dh_pose(q, UR10) if t < 100.2 else _NAN
            match = mut.step_model_match(
                config,
                make_kinematics(),
                match,
                make_report(q, pose, timestamp=t),
            )
        self.assertIn("reports no pose", match.problem)


if __name__ == "__main__":
    unittest.main()
