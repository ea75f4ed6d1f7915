"""No task: the arm rests, or does what only its controller knows."""

import dataclasses as dc
from typing import ClassVar

import numpy as np

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.limits import ArmLimits
from tofssm_drake.carried_objects import CarriableObjects
from tofssm_drake.errors import require
from tofssm_drake.tasks.path import PathBuilder, ProgramPath

# Longer than any run, s.
_LONG = 1e6


@dc.dataclass(kw_only=True)
class NoTask:
    """The arm carries nothing that the monitor would have to know.

    A real robot runs a program of its own; a simulated one stays where it is.
    """

    # Where a simulated arm stays, rad or m, (n,); empty: all joints at 0.
    position: list[float] = dc.field(default_factory=list)

    products: ClassVar[int] = 0
    num_objects: ClassVar[int] = 0
    step: ClassVar[str] = ""
    """It counts nothing."""

    def check(self, where: str) -> None:
        """Does nothing: `make_resting_path` knows the arm's joints."""


def make_resting_path(
    config: NoTask,
    kinematics: ArmKinematics,
    limits: ArmLimits,
    where: str = "task",
) -> ProgramPath:
    """Returns a path on which nothing moves, longer than any run.

    Args:
        config: Settings.
        kinematics: Of the arm in its cell.
        limits: Of its joints.
        where: Path of keys, for the message.

    Raises:
        UserError: The arm cannot be there.
    """
    n = kinematics.num_joints
    position = config.position or [0.0] * n
    require(
        len(position) == n,
        f"{where}.position: has {len(position)} values, but the arm {n} joints",
    )
    for name, value, low, high in zip(
        limits.joint_name, position, limits.lower, limits.upper, strict=True
    ):
        require(
            bool(low <= value <= high),
            f"{where}.position: {name} must be from {low:g} to {high:g}, got "
            f"{value:g}",
        )
    path = PathBuilder(
        np.array(position), limits.speed, limits.acceleration, limits.speed
    )
    path.rest(_LONG)
    return path.finish([], [], CarriableObjects.make_empty(), [[]])
