"""No number of a scenario may be absurd: every one has two bounds."""

import copy
import dataclasses as dc
import typing

import pytest

from tofssm_drake.arms.arm import Arm
from tofssm_drake.arms.sim_arm import Simulated
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.diagrams.drivers.rtde import Rtde
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.sensors.motion_capture import Link, MotionCapture
from tofssm_drake.diagrams.sensors.planar_lidar import PlanarLidar
from tofssm_drake.errors import UserError
from tofssm_drake.laws.law import LawTraits
from tofssm_drake.laws.speed_fraction import SpeedRamp
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.metrics.standards import AuditConfig
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.moving_box import MovingBox
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.perception.occlusion_mask import OcclusionMaskConfig
from tofssm_drake.perception.self_hits import SelfHitConfig
from tofssm_drake.perception.separation import SeparationConfig
from tofssm_drake.sensors.cone_sensor import ConeSensor
from tofssm_drake.sensors.ring import Ring
from tofssm_drake.sensors.vl53l1x import Vl53l1x
from tofssm_drake.tasks.program import PickAndPlace
from tofssm_drake.tasks.waypoints import CarriedProduct, Waypoint, Waypoints

FILE = "package://tofssm_drake_models/gripper/gripper.urdf"

KINDS = (
    Scenario(sensors={"tool": Ring(parent="tool0")}),
    Arm(file=FILE, joint_speed=[1.0], fixed_joints={"finger": 0.0}),
    UrArm(),
    Simulated(),
    Rtde(rings=["udp://127.0.0.1:5005?from=127.0.0.2"]),
    MotionCapture(links={"tool": Link(parent="tool0")}),
    PlanarLidar(),
    LawTraits(),
    SpeedRamp(),
    TriSsm(),
    AuditConfig(),
    BvhRecording(filename="walk.bvh", end_time=2.0, speed=1.0),
    GeneratedWalk(),
    MovingBox(waypoints=[[0.0, 0.0], [1.0, 0.0]]),
    OcclusionMaskConfig(max_age=0.1),
    SelfHitConfig(),
    SeparationConfig(max_gap=0.1),
    ConeSensor(),
    Ring(parent="tool0", sensor=Vl53l1x()),
    PickAndPlace(),
    Waypoints(
        waypoints=[
            Waypoint(joints=[0.0] * 6),
            Waypoint(point=[0.5, 0.0, 0.5]),
        ],
        objects=[CarriedProduct(point=[0.0, 0.0, 0.0])],
    ),
)


def list_numbers(settings, path=()):
    """Yields the path of each number within settings."""
    if dc.is_dataclass(settings):
        for field in dc.fields(settings):
            yield from list_numbers(
                getattr(settings, field.name), (*path, field.name)
            )
    elif isinstance(settings, dict):
        for key, value in settings.items():
            yield from list_numbers(value, (*path, key))
    elif isinstance(settings, (list, tuple)):
        for i, value in enumerate(settings):
            yield from list_numbers(value, (*path, i))
    elif isinstance(settings, (int, float)) and not isinstance(settings, bool):
        yield path


def set_number(settings, path, value) -> typing.Any:
    """Returns settings with one number replaced."""
    settings = copy.deepcopy(settings)
    *way, last = path
    owner = settings
    for key in way:
        owner = (
            getattr(owner, key)
            if isinstance(key, str) and dc.is_dataclass(owner)
            else owner[key]
        )
    if dc.is_dataclass(owner):
        object.__setattr__(owner, last, value)
    else:
        owner[last] = value
    return settings


CASES = [
    (kind, path, value)
    for kind in KINDS
    for path in list_numbers(kind)
    # The parts of a scenario are kinds of their own.
    if not isinstance(kind, Scenario) or len(path) == 1
    for value in (1e300, -1e300)
]


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    CASES,
    ids=[
        f"{type(kind).__name__}.{'.'.join(map(str, path))}={value:g}"
        for kind, path, value in CASES
    ],
)
def test_absurd_numbers_are_refused(kind, path, value):
    with pytest.raises(UserError) as caught:
        set_number(kind, path, value).check("here")
    text = str(caught.value)
    assert "\n" not in text
    names = [key for key in path if isinstance(key, str)]
    assert names[-1] in text or names[0] in text, text
