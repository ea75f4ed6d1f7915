"""Fixed poses as a user writes them."""

import dataclasses as dc
import math

from pydrake.math import RigidTransform, RollPitchYaw

from tofssm_drake.errors import require

_MOST = 1000.0
"""Of each number, m or deg."""


@dc.dataclass(kw_only=True)
class Pose:
    """Pose of a frame in another one."""

    # Origin, m.
    translation: list[float] = dc.field(default_factory=lambda: [0.0] * 3)

    # Roll, pitch and yaw, deg: turn about x, then y, then z of the other
    # frame.
    rpy_deg: list[float] = dc.field(default_factory=lambda: [0.0] * 3)

    def check(self, where: str) -> None:
        """Raises UserError unless both are three numbers of a sane size."""
        for name in ("translation", "rpy_deg"):
            values = getattr(self, name)
            require(
                len(values) == 3 and all(abs(x) <= _MOST for x in values),
                f"{where}.{name}: {values} must be three finite numbers, from "
                f"{-_MOST:g} to {_MOST:g}",
            )

    def to_transform(self) -> RigidTransform:
        """Returns the pose as Drake has it."""
        return RigidTransform(
            RollPitchYaw([math.radians(angle) for angle in self.rpy_deg]),
            self.translation,
        )
