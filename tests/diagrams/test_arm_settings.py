"""The arm as a member of a scenario: YAML in and out."""

import dataclasses as dc
import unittest

from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from tofssm_drake.arms.arm import Arm
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.diagrams.yaml_check import check_yaml, parse_yaml
from tofssm_drake.errors import UserError

UR5E = """
robot: !UrArm
  model: ur5e
  X_WB: {translation: [0.0, 0.0, 0.72], rpy_deg: [0, 0, 90]}
"""

PANDA = """
robot: !Arm
  file: package://example-robot-data/robots/panda_description/urdf/panda.urdf
  flange_frame: panda_hand_tcp
  tool: ""
  fixed_joints: {panda_finger_joint1: 0.02, panda_finger_joint2: 0.02}
  # Franka's data sheet; the description has none.
  joint_acceleration: [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]
  sensed: capsules
"""


@dc.dataclass(kw_only=True)
class Settings:
    robot: UrArm | Arm = dc.field(default_factory=UrArm)


def load(text):
    check_yaml(parse_yaml(text, "test"), Settings, "test")
    settings = yaml_load_typed(schema=Settings, data=text, defaults=Settings())
    settings.robot.check("robot")
    return settings


class TestArmSettings(unittest.TestCase):
    def test_round_trip(self):
        for text, kind, joints in ((UR5E, UrArm, 6), (PANDA, Arm, 7)):
            settings = load(text)
            self.assertIsInstance(settings.robot, kind)
            limits = settings.robot.read_limits()
            self.assertEqual(len(limits.joint_name), joints)
            again = yaml_dump_typed(settings, schema=Settings)
            self.assertEqual(load(again), settings)

    def test_default_is_the_ur10(self):
        self.assertEqual(load("{}").robot.model, "ur10")

    def test_mistakes(self):
        with self.assertRaisesRegex(UserError, "modl"):
            load("robot: !UrArm {modl: ur5e}")
        with self.assertRaisesRegex(UserError, r"robot\.model: 'ur5'"):
            load("robot: !UrArm {model: ur5}")
