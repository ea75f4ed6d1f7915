import functools
import unittest

import numpy as np
from paper_cell import find_kinematics, make_plant
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

import tofssm_drake.tasks.products as mut
from tofssm_drake.tasks.program import (
    PickAndPlace,
    calc_pick_slots,
    calc_place_slots,
    list_places,
    make_program_path,
)


@functools.cache
def make_kinematics():
    return find_kinematics(make_plant())


@functools.cache
def make_path():
    return make_program_path(PickAndPlace(), make_kinematics())


def calc(s, carried=None):
    path = make_path()
    return mut.calc_object_positions(
        objects=path.objects,
        kinematics=make_kinematics(),
        q=path.calc_motion(s)[0],
        carried=path.calc_carried_objects(s) if carried is None else carried,
    )


class TestProductPositions(unittest.TestCase):
    def setUp(self):
        self.pick_slots = calc_pick_slots(PickAndPlace())
        self.place_slots = calc_place_slots(PickAndPlace())

    def test_before_and_after(self):
        np.testing.assert_allclose(
            calc(0.0)[:, 4:], self.pick_slots, atol=1e-12
        )
        np.testing.assert_allclose(
            calc(make_path().duration)[:, 4:],
            self.place_slots,
            atol=1e-12,
        )

    def test_carried(self):
        """Checks that the product in the gripper is at the tool, upright
        while the tool points down, and that the others stay."""
        path = make_path()
        s = (path.close_time[4] + path.open_time[4]) / 2
        positions = calc(s)
        X_WT = make_kinematics().calc_tcp_pose(path.calc_motion(s)[0])
        np.testing.assert_allclose(positions[4, 4:], X_WT[:, 3], atol=1e-12)
        R_WP = RotationMatrix(Quaternion(positions[4, :4])).matrix()
        np.testing.assert_allclose(R_WP[:, 0], X_WT[:, 0], atol=1e-12)
        np.testing.assert_allclose(R_WP[:, 2], [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(
            positions[:4, 4:], self.place_slots[:4], atol=1e-12
        )
        np.testing.assert_allclose(
            positions[5:, 4:], self.pick_slots[5:], atol=1e-12
        )

    def test_no_jump(self):
        """Checks that a product neither jumps nor turns when the gripper
        takes it and when it lets go."""
        path = make_path()
        for s in (*path.close_time, *path.open_time):
            before, after = calc(s - 1e-9), calc(s)
            np.testing.assert_allclose(before[:, 4:], after[:, 4:], atol=1e-8)
            # A quaternion and its negative are the same orientation.
            same = np.abs(np.sum(before[:, :4] * after[:, :4], axis=1))
            np.testing.assert_allclose(same, 1, atol=1e-9)

    def test_beyond_the_last(self):
        carried = make_path().find_carried_objects(
            products_placed=10, gripper_closed=True
        )
        positions = calc(0.0, carried)
        np.testing.assert_allclose(
            positions[:, 4:], self.place_slots, atol=1e-12
        )

    def test_quaternions(self):
        """Checks the conversion against Drake at random orientations and at
        half turns, where a careless formula divides by zero."""
        generator = np.random.default_rng(0)
        rotations = [
            RotationMatrix(Quaternion(q / np.linalg.norm(q)))
            for q in generator.normal(size=(200, 4))
        ]
        rotations += [
            RotationMatrix(np.diag(d).astype(float))
            for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])
        ]
        X = np.zeros((len(rotations), 3, 4))
        for i, rotation in enumerate(rotations):
            X[i, :, :3] = rotation.matrix()
            X[i, :, 3] = generator.normal(size=3)
        positions = np.empty((len(rotations), 7))
        mut.write_free_body_positions(X, positions)
        for i, rotation in enumerate(rotations):
            np.testing.assert_allclose(
                RotationMatrix(Quaternion(positions[i, :4])).matrix(),
                rotation.matrix(),
                atol=1e-12,
            )
        np.testing.assert_array_equal(positions[:, 4:], X[:, :, 3])


class TestObjectCarrier(unittest.TestCase):
    def test_ports_and_value(self):
        dut = mut.ObjectCarrier(
            objects=make_path().objects, kinematics=make_kinematics()
        )
        self.assertEqual(
            [dut.get_input_port(i).get_name() for i in range(2)],
            ["position_measured", "carried_objects"],
        )
        context = dut.CreateDefaultContext()
        path = make_path()
        s = path.close_time[2] + 0.9
        dut.GetInputPort("position_measured").FixValue(
            context, path.calc_motion(s)[0]
        )
        dut.GetInputPort("carried_objects").FixValue(
            context, list_places(10)[5]
        )
        actual = dut.GetOutputPort("object_positions").Eval(context)
        np.testing.assert_array_equal(actual.reshape(-1, 7), calc(s))
