import pathlib

import numpy as np
import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.errors import UserError
from tofssm_drake.people.motion import make_motion
from tofssm_drake.people.skeleton import JOINTS, LANDMARKS
from tofssm_drake.people.walk import GeneratedWalk, make_walk

FACTORY = f"{__name__}:read_positions"


def read_positions(*, period, file, loops):
    """Returns a motion from a table with a row of landmarks per tick."""
    table = np.loadtxt(file, delimiter=",", ndmin=2)
    landmarks = table.reshape(len(table), len(LANDMARKS), 3)
    return make_motion(
        landmarks=landmarks, dt=period, loops=loops, stature=1.75
    )


def load(parameters):
    text = (
        "{people: {visitor: null, guest: !CustomMotion "
        f"{{factory: '{FACTORY}', parameters: {parameters}}}}}}}"
    )
    return load_scenario(text=text).people["guest"]


def test_parameters_may_be_words_and_truth_values(tmp_path, monkeypatch):
    """A recording of one's own format is named by a parameter."""
    monkeypatch.syspath_prepend(pathlib.Path(__file__).parent)
    walk = make_walk(GeneratedWalk(), 0.008).joints[:5]
    landmarks = walk[:, [JOINTS.index(name) for name in LANDMARKS]]
    path = tmp_path / "positions.csv"
    np.savetxt(path, landmarks.reshape(5, -1), delimiter=",")
    dut = load(f"{{file: {path}, loops: false}}")
    motion = dut.make_motion(0.008)
    assert motion.loops is False
    np.testing.assert_allclose(motion.joints, walk, atol=1e-9)
    with pytest.raises(UserError, match=r"people.guest: .*no_such\.csv"):
        load("{file: no_such.csv, loops: true}")
