"""What a task of waypoints carries."""

import functools

import numpy as np
import pytest

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.carried_objects import ON_TOOL
from tofssm_drake.errors import UserError
import tofssm_drake.tasks.waypoints as mut

HERE, THERE, AWAY = [0.1, -0.6, 0.73], [-0.1, -0.6, 0.73], [0.4, -0.5, 0.73]


@functools.cache
def make_kinematics():
    return ArmKinematics.from_plant(make_cell_plant())


def make_path(points, objects, rounds=1):
    """Returns the path of (point, gripper) with objects at points."""
    config = mut.Waypoints(
        waypoints=[mut.Waypoint(point=p, gripper=g) for p, g in points],
        objects=[mut.CarriedProduct(point=p) for p in objects],
        rounds=rounds,
    )
    config.check("task")
    arm = UrArm()
    return mut.make_waypoint_path(config, make_kinematics(), arm.read_limits())


def test_an_object_is_left_where_the_gripper_opens():
    path = make_path([(HERE, "close"), (THERE, "open")], [AWAY, HERE])
    np.testing.assert_array_equal(path.carried, [[0, 0], [0, ON_TOOL], [0, 1]])
    assert path.objects.setting[1] == ("objects[1].point", "waypoints[1]")
    np.testing.assert_allclose(
        path.objects.X_WO[1, :, :, 3], [HERE, THERE], atol=1e-9
    )
    # It stands upright again.
    np.testing.assert_allclose(
        path.objects.X_WO[1, 1, :, 2], [0, 0, 1], atol=1e-9
    )
    # The other one has one place only.
    np.testing.assert_array_equal(*path.objects.X_WO[0])


def test_it_is_where_the_path_time_says():
    path = make_path([(HERE, "close"), (THERE, "open")], [HERE])
    for s, place in (
        (0.0, 0),
        (path.close_time[0], ON_TOOL),
        (path.open_time[0] - 1e-6, ON_TOOL),
        (path.open_time[0], 1),
        (path.duration, 1),
    ):
        assert path.calc_carried_objects(s) == [place]


def test_to_and_fro_needs_no_new_places():
    path = make_path(
        [
            (HERE, "close"),
            (THERE, "open"),
            (THERE, "close"),
            (HERE, "open"),
        ],
        [HERE],
        rounds=2,
    )
    # Its first place is not exactly where the arm puts it back.
    assert path.objects.X_WO.shape[1] <= 4
    places = path.carried[:, 0]
    np.testing.assert_array_equal(places[1::2], ON_TOOL)
    np.testing.assert_array_equal(places[2:5], places[6:])


def test_nothing_is_carried_without_objects():
    path = make_path([(HERE, "close"), (THERE, "open")], [])
    assert path.carried.shape == (3, 0)
    assert len(path.objects) == 0


def test_gripper_that_closes_on_nothing():
    with pytest.raises(
        UserError,
        match=r"^task\.waypoints\[1\]\.gripper: closes 0\.200 m from object 0",
    ):
        make_path([(HERE, "keep"), (THERE, "close")], [HERE])
    with pytest.raises(UserError, match=r"^task.objects\[0\].point: "):
        make_path([(HERE, "keep"), (THERE, "keep")], [[1.0, 2.0]])


def test_places_from_what_a_robot_reports():
    path = make_path([(HERE, "close"), (THERE, "open")], [HERE])
    for placed, closed, place in (
        (0, False, 0),
        (0, True, ON_TOOL),
        (1, False, 1),
        # More than there are.
        (7, True, 1),
    ):
        carried = path.find_carried_objects(
            products_placed=placed, gripper_closed=closed
        )
        assert carried == [place]
