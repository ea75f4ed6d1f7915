"""A box that is driven along waypoints."""

import numpy as np
from pydrake.geometry import SceneGraph
import pytest

from tofssm_drake.errors import UserError
import tofssm_drake.people.moving_box as mut


def test_there_and_back():
    config = mut.MovingBox(
        waypoints=[[0, 0], [2, 0], [2, 0], [2, 1]], speed=0.5
    )
    config.check("here")
    for time, place, angle in (
        (0.0, [0.0, 0.0], 0.0),
        (2.0, [1.0, 0.0], 0.0),
        (5.0, [2.0, 0.5], np.pi / 2),
        (6.0, [2.0, 1.0], np.pi / 2),
        (8.0, [2.0, 0.0], np.pi / 2),
        (10.0, [1.0, 0.0], 0.0),
        (12.0, [0.0, 0.0], 0.0),
        (14.0, [1.0, 0.0], 0.0),
    ):
        found, facing = mut.calc_box_place(config, time)
        np.testing.assert_allclose(found, place, atol=1e-12)
        assert facing == pytest.approx(angle)


def test_one_place_stands_still():
    config = mut.MovingBox(waypoints=[[1.0, 2.0]])
    found, facing = mut.calc_box_place(config, 100.0)
    assert (found.tolist(), facing) == ([1.0, 2.0], 0.0)


def test_it_stands_on_the_floor_of_the_scene():
    scene_graph = SceneGraph()
    config = mut.MovingBox(size=[0.8, 0.5, 1.0], waypoints=[[0, 0], [0, 4]])
    dut = mut.MovingBoxSystem(
        scene_graph=scene_graph, config=config, name="cart"
    )
    context = dut.CreateDefaultContext()
    context.SetTime(2.0)
    poses = dut.GetOutputPort("geometry_pose").Eval(context)
    (frame_id,) = poses.ids()
    X_WF = poses.value(frame_id)
    np.testing.assert_allclose(X_WF.translation(), [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        X_WF.rotation().matrix()[:, 0], [0.0, 1.0, 0.0], atol=1e-12
    )
    inspector = scene_graph.model_inspector()
    (geometry_id,) = inspector.GetAllGeometryIds()
    X_FG = inspector.GetPoseInFrame(geometry_id)
    np.testing.assert_allclose(X_FG.translation(), [0.0, 0.0, 0.5])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"waypoints": []}, "here.waypoints: .. must be one or more places"),
        ({"waypoints": [[1.0]]}, "here.waypoints"),
        ({"size": [1.0, 1.0]}, "here.size: .1.0, 1.0. must be three"),
        ({"speed": 0.0}, "here.speed: 0.0 must be above 0"),
    ],
)
def test_mistakes(settings, message):
    with pytest.raises(UserError, match=message):
        mut.MovingBox(**({"waypoints": [[0, 0]]} | settings)).check("here")
