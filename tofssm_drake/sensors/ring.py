"""A ring of ranging sensors: what a scenario says of it, and its frames."""

import dataclasses as dc
import math

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    FrameIndex,
    ModelInstanceIndex,
)

from tofssm_drake.errors import UserError, check_range, require
from tofssm_drake.poses import Pose
from tofssm_drake.sensors.cone_sensor import ConeSensor
from tofssm_drake.sensors.custom_sensor import CustomSensor
from tofssm_drake.sensors.vl53l1x import Vl53l1x

MOST_SENSORS = 64
"""A ring's link has room for that many."""


@dc.dataclass(kw_only=True)
class Ring:
    """Sensors around a link of the robot.

    The ring's frame L has its origin at the link's centre, from which
    distances count; z is the ring's axis. Sensor j of n is turned about it by
    360 j / n deg from L's x axis, the axis of its beam.
    """

    # Frame of the robot's model that carries the ring, `frame` or
    # `model::frame`.
    parent: str = ""

    # The ring's frame L in it.
    X_PL: Pose = dc.field(default_factory=Pose)

    # From the axis to the sensors, m.
    radius: float = 0.07

    # Number n of sensors, evenly spaced.
    count: int = 8

    # By how much the beams point out of the ring's plane, deg; positive is
    # towards its axis z.
    tilt_deg: float = 0.0

    # Poses of the sensors in L, in place of the circle; x is the beam's axis.
    poses: list[Pose] = dc.field(default_factory=list)

    # The sensor model: how well it measures, and how often. Each is a
    # `RangeSensor`; without a tag it is the first.
    sensor: Vl53l1x | ConeSensor | CustomSensor = dc.field(
        default_factory=Vl53l1x
    )

    # First sample, s; 0 is after one period. *Assumed*: all rings are
    # triggered together; alike rings of equal phase are one system and cost
    # one cast. Different values stagger them.
    phase: float = 0.0

    # Sensors known to be dead. They are ignored, and the robot is never faster
    # than reduced. A failed sensor that is not listed stops the robot.
    dead_sensors: list[int] = dc.field(default_factory=list)

    @property
    def num_sensors(self) -> int:
        """Number of sensors."""
        return len(self.poses) or self.count

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            bool(self.parent),
            f"{where}.parent: name the frame that carries the ring",
        )
        self.X_PL.check(f"{where}.X_PL")
        check_range(where, "radius", self.radius, 0.005, 1.0)
        check_range(where, "tilt_deg", self.tilt_deg, -80.0, 80.0)
        check_range(where, "count", self.num_sensors, 1, MOST_SENSORS)
        for i, pose in enumerate(self.poses):
            pose.check(f"{where}.poses[{i}]")
        self.sensor.check(f"{where}.sensor")
        check_range(where, "phase", self.phase, 0.0, 10.0)
        n = self.num_sensors
        dead = self.dead_sensors
        require(
            all(isinstance(i, int) and 0 <= i < n for i in dead)
            and len(set(dead)) == len(dead) < n,
            f"{where}.dead_sensors: {dead} must be different numbers from 0 to "
            f"{n - 1}, and not all of them",
        )

    def calc_sensor_poses(self) -> list[RigidTransform]:
        """Returns X_LS of each sensor."""
        if self.poses:
            return [pose.to_transform() for pose in self.poses]
        tilt = RotationMatrix.MakeYRotation(-math.radians(self.tilt_deg))
        turns = [
            RotationMatrix.MakeZRotation(2.0 * math.pi * j / self.count)
            for j in range(self.count)
        ]
        return [
            RigidTransform(turn @ tilt, turn @ np.array([self.radius, 0, 0]))
            for turn in turns
        ]

    def add_frames(self, plant: MultibodyPlant, name: str) -> None:
        """Adds the ring's frames to a plant that is not yet finalized.

        `<name>_ring` is the ring's frame L, `<name>_ring_<j>` that of sensor
        j.

        Args:
            plant: With the robot.
            name: Of the ring.

        Raises:
            UserError: If the robot has no frame `parent`.
        """
        parent = find_frame(plant, self.parent, f"sensors.{name}.parent")
        frame_L = plant.AddFrame(
            FixedOffsetFrame(f"{name}_ring", parent, self.X_PL.to_transform())
        )
        for j, X_LS in enumerate(self.calc_sensor_poses()):
            plant.AddFrame(FixedOffsetFrame(f"{name}_ring_{j}", frame_L, X_LS))

    def find_link_frames(self, name: str) -> dict[str, str]:
        """Returns the frame of the watched link's centre, by link."""
        return {name: f"{name}_ring"}


def find_frame(plant: MultibodyPlant, name: str, where: str):
    """Returns a plant's frame by its name, `frame` or `model::frame`.

    Raises:
        UserError: If there is none of this name, or several.
    """
    model, _, frame = name.rpartition("::")
    found = [
        candidate
        for i in range(plant.num_frames())
        if (candidate := plant.get_frame(FrameIndex(i))).name() == frame
        and model
        in ("", plant.GetModelInstanceName(candidate.model_instance()))
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise UserError(f"{where}: several frames are called {name!r}")
    require(
        not model or plant.HasModelInstanceNamed(model),
        f"{where}: there is no model {model!r}, only "
        f"{', '.join(_list_models(plant))}; sensors that a scenario does not "
        "give are those of the shipped cell",
    )
    raise UserError(f"{where}: the robot has no frame {name!r}")


def _list_models(plant):
    """Returns the names of the models that have bodies, without the world."""
    return [
        plant.GetModelInstanceName(model)
        for i in range(2, plant.num_model_instances())
        if plant.GetBodyIndices(model := ModelInstanceIndex(i))
    ]
