import numpy as np
import pytest

import tofssm_drake.arms.stop_time as mut


def test_stated_points_are_on_the_line():
    np.testing.assert_allclose(
        mut.calc_stated_stop_time(mut.STATED_SPEED), mut.STATED_TIME
    )
    assert mut.calc_stated_stop_time(1.7) == pytest.approx(0.520)
