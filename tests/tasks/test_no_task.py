import unittest

import numpy as np

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.errors import UserError
import tofssm_drake.tasks.no_task as mut

_POSITION = [0.1, -1.4, 1.3, -1.5, -1.5, 0.2]


class TestRestingPath(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        arm = UrArm(model="ur5e")
        cls.kinematics = ArmKinematics.from_plant(
            make_cell_plant(arm=arm, workcell="")
        )
        cls.limits = arm.read_limits()

    def make(self, position):
        return mut.make_resting_path(
            mut.NoTask(position=position), self.kinematics, self.limits
        )

    def test_nothing_moves(self):
        path = self.make(_POSITION)
        for s in (0.0, 1.0, 86400.0):
            motion = path.calc_motion(s)
            np.testing.assert_array_equal(motion[0], _POSITION)
            np.testing.assert_array_equal(motion[1:], 0.0)
        self.assertGreater(path.duration, 86400.0)
        self.assertEqual(len(path.objects), 0)
        self.assertEqual(path.calc_carried_objects(5.0).shape, (0,))

    def test_default_is_all_joints_at_zero(self):
        np.testing.assert_array_equal(self.make([]).calc_motion(0.0), 0.0)

    def test_mistakes(self):
        for position, says in (
            ([0.0], r"^task\.position: has 1 values, but the arm 6 joints$"),
            ([9.0] * 6, r"^task\.position: shoulder_pan_joint must be from"),
            ([float("nan")] * 6, r"^task\.position: shoulder_pan_joint must"),
        ):
            with self.subTest(says), self.assertRaisesRegex(UserError, says):
                self.make(position)


class TestRun(unittest.TestCase):
    def test_arm_stays_and_watches(self):
        scenario = load_scenario(
            text=f"{{task: !NoTask {{position: {_POSITION}}}, "
            "simulation_duration: 0.4}"
        )
        run = Run(workcell=make_workcell(scenario), scenario=scenario)
        while not run.advance().finished:
            pass
        samples = run.make_samples()
        for j, q in enumerate(_POSITION):
            np.testing.assert_allclose(samples[f"q_{j}"], q, atol=1e-6)
        self.assertEqual(samples["products_placed"].max(), 0)
