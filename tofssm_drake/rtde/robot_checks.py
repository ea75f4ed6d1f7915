"""What a robot is checked for during a run."""

import dataclasses as dc

from tofssm_drake.errors import require
from tofssm_drake.rtde.arm_obedience import ArmConfig
from tofssm_drake.rtde.model_match import ModelConfig


@dc.dataclass(kw_only=True)
class RobotChecks:
    """Settings of `--checks-text`."""

    # Does the arm follow its slider?
    arm: ArmConfig = dc.field(default_factory=ArmConfig)

    # Is it the robot that is modelled?
    model: ModelConfig = dc.field(default_factory=ModelConfig)

    # By what part the robot's clock may be faster or slower than this
    # computer's (assumed: two crystals differ by a hundredth of that; a
    # computer that is busy for seconds seems to be off by less).
    clock_tolerance: float = 0.02

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        self.arm.check(f"{where}.arm")
        self.model.check(f"{where}.model")
        require(
            0 < self.clock_tolerance <= 0.2,
            f"{where}.clock_tolerance: must be more than 0 and at most 0.2, "
            f"got {self.clock_tolerance:g}",
        )
