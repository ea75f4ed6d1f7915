import unittest

from fake_meshcat import FakeMeshcat
import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value

from tofssm_drake.messages import RobotState, SpeedDecision
import tofssm_drake.visualization.state_light as mut


class TestMeshes(unittest.TestCase):
    def test_annulus(self):
        vertices, faces = mut.make_annulus_mesh(1.0, 1.5)
        area = 0.0
        for i, j, k in faces.T:
            a, b, c = vertices[:, i], vertices[:, j], vertices[:, k]
            area += np.cross(b - a, c - a)[2] / 2
        self.assertAlmostEqual(area, np.pi * 1.25, delta=0.01)


class TestStateLight(unittest.TestCase):
    def setUp(self):
        self.meshcat = FakeMeshcat()
        self.dut = mut.StateLight(meshcat=self.meshcat, links=RINGS)
        self.context = self.dut.CreateDefaultContext()

    def test_ports(self):
        self.assertEqual(self.dut.num_input_ports(), 1)
        self.assertEqual(self.dut.get_input_port(0).get_name(), "decision")

    def test_one_state_is_shown(self):
        for tick, (state, target) in enumerate(
            [(0, 0.0), (1, 0.5), (1, 0.01), (2, 1.0), (0, np.nan)]
        ):
            self.context.SetTime(tick)
            self.dut.GetInputPort("decision").FixValue(
                self.context, Value(SpeedDecision(name=RINGS, target=target))
            )
            self.dut.ForcedPublish(self.context)
            shown = [
                s
                for s in RobotState
                if self.meshcat.find_last(f"state/{s.name}", "visible")
            ]
            self.assertEqual(shown, [state])

    def test_told_without_colour(self):
        """Lamps differ in height, words in letters, rings in width."""
        X = {path: X for path, X, _ in self.meshcat.transforms}
        heights = [
            X[f"state/{s.name}/lamp"].translation()[2] for s in RobotState
        ]
        self.assertEqual(sorted(heights, reverse=True), heights)
        widths = []
        for s in RobotState:
            (vertices, _), _ = self.meshcat.objects[f"state/{s.name}/floor"]
            radius = np.linalg.norm(vertices, axis=0)
            widths.append(radius.max() - radius.min())
        self.assertGreater(widths[0], widths[1])
        self.assertGreater(widths[1], widths[2])
