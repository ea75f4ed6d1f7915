"""What a user writes against the public rooms is checked by its types."""

import textwrap

from check_types import check_types

_RIGHT = """
    from typing import assert_type

    import numpy as np

    from tofssm_drake.laws import Law, TriSsm
    from tofssm_drake.raycast import make_lidar_fan
    from tofssm_drake.rtde import RtdeClient, RtdeConfig

    law: Law = TriSsm(deadline=0.1)
    assert_type(law.traits.deadline, float)
    directions = make_lidar_fan(np.zeros(4), np.zeros(1))
    with RtdeClient(RtdeConfig(host="127.0.0.1")) as robot:
        assert_type(robot.get_report().position, np.ndarray)
"""

_WRONG = """
    import numpy as np

    from tofssm_drake.laws import TriSsm
    from tofssm_drake.raycast import make_lidar_fan
    from tofssm_drake.rtde import RtdeConfig

    TriSsm(deadline="soon")
    TriSsm().traits.dead_line
    make_lidar_fan("left", np.zeros(1))
    RtdeConfig(hots="127.0.0.1")
"""


def check(tmp_path, text):
    """Returns what mypy says of a user's file, by line."""
    file = tmp_path / "mine.py"
    file.write_text(textwrap.dedent(text).lstrip(), "utf-8")
    # With the settings of `make test`, or mypy would check all of it again.
    said, _ = check_types(str(file))
    errors = [line for line in said.splitlines() if ": error: " in line]
    # Those of the package are reported by check_types.py.
    return [line for line in errors if file.name in line], said


def test_right_use_is_accepted(tmp_path):
    errors, said = check(tmp_path, _RIGHT)
    assert errors == [], said


def test_mistakes_are_found(tmp_path):
    errors, said = check(tmp_path, _WRONG)
    codes = [error.rpartition("[")[2].rstrip("]") for error in errors]
    assert codes == ["arg-type", "attr-defined", "arg-type", "call-arg"], said
