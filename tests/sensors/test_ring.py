"""A ring of a scenario, and its frames in a plant."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
import pytest

from tofssm_drake.errors import UserError
from tofssm_drake.poses import Pose
import tofssm_drake.sensors.ring as mut


def make_plant(*models):
    plant = MultibodyPlant(0.0)
    for model in models or ("arm",):
        instance = plant.AddModelInstance(model)
        plant.AddRigidBody(
            "link", instance, SpatialInertia.SolidSphereWithMass(1.0, 0.1)
        )
    return plant


def test_the_paper_s_circle():
    """As its directives were: sensor j at 360 j / n deg about z."""
    ring = mut.Ring(parent="link", radius=0.065, count=16)
    poses = ring.calc_sensor_poses()
    assert len(poses) == ring.num_sensors == 16
    for j, X_LS in enumerate(poses):
        angle = 2 * np.pi * j / 16
        expected = RigidTransform(
            RollPitchYaw(0.0, 0.0, angle),
            [0.065 * np.cos(angle), 0.065 * np.sin(angle), 0.0],
        )
        assert X_LS.IsNearlyEqualTo(expected, 1e-12)


def test_a_tilted_ring_looks_out_of_its_plane():
    ring = mut.Ring(parent="link", radius=0.1, count=4, tilt_deg=30.0)
    for X_LS in ring.calc_sensor_poses():
        beam = X_LS.rotation().matrix()[:, 0]
        assert beam[2] == pytest.approx(0.5)
        # Still straight away from the axis.
        outwards = X_LS.translation()[:2] / 0.1
        np.testing.assert_allclose(beam[:2], np.cos(np.pi / 6) * outwards)


def test_listed_poses_take_the_place_of_the_circle():
    poses = [Pose(translation=[0.0, 0.0, 0.1 * i]) for i in range(3)]
    ring = mut.Ring(parent="link", poses=poses, count=8)
    ring.check("here")
    assert ring.num_sensors == 3
    assert [X.translation()[2] for X in ring.calc_sensor_poses()] == [
        0.0,
        0.1,
        0.2,
    ]


def test_frames():
    plant = make_plant()
    ring = mut.Ring(
        parent="arm::link",
        X_PL=Pose(translation=[1.0, 2.0, 3.0], rpy_deg=[0.0, 90.0, 0.0]),
        count=3,
    )
    ring.add_frames(plant, "fore")
    plant.Finalize()
    X_BL = plant.GetFrameByName("fore_ring").GetFixedPoseInBodyFrame()
    assert X_BL.IsNearlyEqualTo(ring.X_PL.to_transform(), 1e-12)
    for j, X_LS in enumerate(ring.calc_sensor_poses()):
        X_BS = plant.GetFrameByName(f"fore_ring_{j}").GetFixedPoseInBodyFrame()
        assert X_BS.IsNearlyEqualTo(X_BL @ X_LS, 1e-12)
    assert not plant.HasFrameNamed("fore_ring_3")
    assert ring.find_link_frames("fore") == {"fore": "fore_ring"}


def test_frames_are_found_by_name_or_by_model_and_name():
    plant = make_plant("one", "two")
    for name in ("one::link", "two::link"):
        frame = mut.find_frame(plant, name, "here")
        model = plant.GetModelInstanceName(frame.model_instance())
        assert f"{model}::{frame.name()}" == name
    with pytest.raises(UserError, match="here: several frames are called 'li"):
        mut.find_frame(plant, "link", "here")
    with pytest.raises(UserError, match="here: the robot has no frame 'hand'"):
        mut.find_frame(plant, "hand", "here")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"parent": ""}, "here.parent: name the frame"),
        ({"radius": 0.0}, "here.radius: 0.0 is out of range"),
        ({"count": 0}, "here.count: 0 is out of range; use 1 to 64"),
        ({"count": 65}, "here.count: 65 is out of range"),
        ({"tilt_deg": 90.0}, "here.tilt_deg: 90.0 is out of range"),
        ({"phase": -1.0}, "here.phase: -1.0 is out of range"),
        ({"dead_sensors": [8]}, "here.dead_sensors: .8. must be different"),
        ({"dead_sensors": list(range(8))}, "and not all of them"),
        ({"poses": [Pose(rpy_deg=[1.0])]}, "here.poses.0..rpy_deg: .1.0. must"),
        ({"X_PL": Pose(translation=[np.nan] * 3)}, "here.X_PL.translation"),
    ],
)
def test_mistakes(settings, message):
    ring = mut.Ring(**({"parent": "link"} | settings))
    with pytest.raises(UserError, match=message):
        ring.check("here")
