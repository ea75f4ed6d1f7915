"""What docs/arms.md shows, runs and gives what the page says."""

from pathlib import Path
import re
import unittest

import numpy as np
import yaml

from tofssm_drake.arms.arm import Arm
from tofssm_drake.arms.ur_data import list_ur_models, read_ur_data

PAGE = Path(__file__).parents[2] / "docs" / "arms.md"


class TestPage(unittest.TestCase):
    def test_example(self):
        (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
        space = {}
        exec(example, space)
        X_WT = space["kinematics"].calc_tcp_pose(space["q"])
        np.testing.assert_allclose(X_WT[:, 3], [0.4, 0.2, 0.8], atol=1e-9)

    def test_table(self):
        rows = re.findall(
            r"`(ur\w+)`(?: \(CB3\))? \| ([0-9.]+) \| ([0-9.]+)",
            PAGE.read_text(),
        )
        self.assertEqual(sorted(row[0] for row in rows), list_ur_models())
        for model, payload, reach in rows:
            data = read_ur_data(model)
            self.assertEqual(float(payload), data.payload)
            self.assertEqual(float(reach), data.reach)

    def test_settings(self):
        _, text = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.S)
        settings = yaml.safe_load(text.replace("!Arm", ""))["robot"]
        Arm(**settings).check("robot")
