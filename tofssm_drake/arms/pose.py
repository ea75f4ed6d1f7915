"""A pose as a setting."""

import dataclasses as dc

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from tofssm_drake.errors import require


@dc.dataclass(kw_only=True)
class Pose:
    """Where a frame is in another one."""

    # Its origin, m, (3,).
    translation: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])

    # Roll, pitch and yaw, deg, (3,): turned about fixed x, then y, then z.
    rpy: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])

    def check(self, where: str) -> None:
        """Raises UserError with one line if there are not three numbers."""
        for name in ("translation", "rpy"):
            value = getattr(self, name)
            require(
                len(value) == 3 and bool(np.isfinite(value).all()),
                f"{where}.{name}: must be three numbers, got {value}",
            )

    def make(self) -> RigidTransform:
        """Returns it as Drake has it."""
        if not any(self.rpy):
            return RigidTransform(self.translation)
        return RigidTransform(
            RollPitchYaw(np.deg2rad(self.rpy)), self.translation
        )
