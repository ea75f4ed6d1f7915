"""What docs/ray_caster.md shows, runs and gives what the page says."""

from pathlib import Path
import re
import unittest

import numpy as np

PAGE = Path(__file__).parents[2] / "docs" / "ray_caster.md"


class TestPage(unittest.TestCase):
    def test_examples(self):
        blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
        self.assertEqual(len(blocks), 4)
        example, sensors, system, known_poses = blocks
        lines = [line for line in example.splitlines() if line]
        code = [x for x in lines if not x.startswith(("import ", "from "))]
        self.assertEqual(len(code), 10)
        space = {}
        exec(example, space)
        np.testing.assert_allclose(space["distance"], [1.5])
        np.testing.assert_array_equal(space["index"], [0])
        caster = space["caster"]
        self.assertEqual(
            caster.get_geometry_ids(space["index"]).tolist(),
            caster.geometry_ids,
        )
        exec(sensors, space)
        self.assertEqual(space["distances"].shape, (2, 25))
        self.assertEqual(space["normals"].shape, (2, 25, 3))
        seen = np.isfinite(space["distances"])
        self.assertGreater(seen[0].sum(), 1)
        self.assertFalse(seen[1].any())
        self.assertAlmostEqual(space["distances"][0, 0], 1.5)
        np.testing.assert_allclose(
            space["normals"][0][seen[0]],
            np.tile([-1.0, 0, 0], (seen[0].sum(), 1)),
            atol=1e-15,
        )
        apart = dict(space)
        exec(system, apart)
        self.assertEqual(apart["ranges"].shape, (3, 181))
        self.assertAlmostEqual(apart["ranges"][1, 90], 1.5)
        self.assertAlmostEqual(apart["scan_time"][0], 0.2)
        found = space["distances"]
        exec(known_poses, space)
        self.assertIsNot(space["distances"], found)
        np.testing.assert_allclose(space["distances"], found, atol=1e-12)


if __name__ == "__main__":
    unittest.main()
