from pathlib import Path
import tempfile
import unittest

from bvh_writer import NAMINGS, calc_joints, write_bvh
import numpy as np
from pydrake.math import RotationMatrix

from tofssm_drake.people.bvh_file import read_bvh
import tofssm_drake.people.bvh_kinematics as mut


class BvhKinematicsTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)

    def _read(self, **kwargs):
        path = Path(self.folder.name) / "walk.bvh"
        return read_bvh(write_bvh(path, duration=0.3, **kwargs))

    def test_positions_in_any_channel_order(self):
        """Against the writer's own kinematics, frame by frame."""
        for order in (
            (0, 1, 2),
            (0, 2, 1),
            (1, 0, 2),
            (1, 2, 0),
            (2, 0, 1),
            (2, 1, 0),
        ):
            for joint_positions in (None, "replace", "add"):
                file = self._read(order=order, joint_positions=joint_positions)
                times = file.frame_time * np.arange(len(file.frames))
                positions, _ = mut.calc_positions(file, times)
                names = [joint.name for joint in file.joints]
                for k in (0, 7, 36):
                    expected = calc_joints(k / 120)
                    for key, name in NAMINGS["cgspeed"].items():
                        np.testing.assert_allclose(
                            positions[k, names.index(name)],
                            expected[key],
                            atol=1e-6,
                        )

    def test_bones_keep_their_lengths_between_frames(self):
        file = self._read(fps=10.0)
        times = np.linspace(0, file.duration, 97)
        positions, _ = mut.calc_positions(file, times)
        for j, joint in enumerate(file.joints[1:], start=1):
            length = np.linalg.norm(
                positions[:, j] - positions[:, joint.parent], axis=-1
            )
            np.testing.assert_allclose(
                length, np.linalg.norm(joint.offset), atol=1e-9
            )

    def test_rotation_between_frames(self):
        """The shortest way from frame to frame, at an even pace."""
        file = self._read(fps=10.0)
        names = [joint.name for joint in file.joints]
        hip, knee = names.index("LeftUpLeg"), names.index("LeftLeg")
        times = file.frame_time * np.array([1, 1.25, 2])
        _, R = mut.calc_positions(file, times, (hip, knee))
        a, b, c = R[hip].transpose(0, 2, 1) @ R[knee]
        whole = RotationMatrix(a.T @ c).ToAngleAxis()
        part = RotationMatrix(a.T @ b).ToAngleAxis()
        self.assertGreater(whole.angle(), 0.1)
        self.assertAlmostEqual(part.angle(), whole.angle() / 4, delta=1e-6)
        np.testing.assert_allclose(part.axis(), whole.axis(), atol=1e-6)

    def test_through_180_degrees(self):
        """Angles that jump from 180 to -180 are no turn."""
        path = Path(self.folder.name) / "spin.bvh"
        path.write_text(
            "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Zrotation\n"
            "End Site\n{\nOFFSET 1 0 0\n}\n}\nMOTION\nFrames: 2\n"
            "Frame Time: 0.1\n175\n-175\n"
        )
        file = read_bvh(path)
        positions, _ = mut.calc_positions(file, np.array([0.0, 0.05, 0.1]))
        np.testing.assert_allclose(positions[1, 1], [-1, 0, 0], atol=1e-9)

    def test_holds_at_the_ends(self):
        file = self._read()
        positions, _ = mut.calc_positions(
            file, np.array([-1.0, 0.0, file.duration, 9.0])
        )
        np.testing.assert_array_equal(positions[0], positions[1])
        np.testing.assert_array_equal(positions[2], positions[3])


if __name__ == "__main__":
    unittest.main()
