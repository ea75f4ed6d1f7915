"""What the joints of an arm can do."""

import dataclasses as dc

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.chain import find_chain
from tofssm_drake.errors import require


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ArmLimits:
    """Limits of an arm's n joints, base to tool; rad or m, and Nm or N."""

    joint_name: tuple[str, ...]
    """Names of the joints."""
    lower: np.ndarray
    """Least positions; -inf: none, (n,)."""
    upper: np.ndarray
    """Greatest positions; inf: none, (n,)."""
    speed: np.ndarray
    """Greatest speeds, (n,)."""
    acceleration: np.ndarray
    """Greatest accelerations, (n,)."""
    effort: np.ndarray
    """Greatest torques or forces; inf: none is known, (n,)."""

    @staticmethod
    def from_plant(
        plant: MultibodyPlant, *, tcp: str = "tcp", where: str = "robot"
    ) -> "ArmLimits":
        """Reads the limits of the arm in a plant.

        Limits of speed and acceleration are symmetric: the smaller of both
        directions counts.

        Args:
            plant: Finalized.
            tcp: Name of the tool's frame.
            where: The arm in the user's settings, for the message.

        Raises:
            UserError: A joint has no limit of speed or acceleration. Then
                nothing could be planned for it.
        """
        joints = find_chain(plant, tcp).joints
        speed, acceleration = (
            np.array(
                [
                    min(
                        -getattr(joint, f"{kind}_lower_limit")(),
                        getattr(joint, f"{kind}_upper_limit")(),
                    )
                    for joint in joints
                ]
            )
            for kind in ("velocity", "acceleration")
        )
        for kind, values in (("speed", speed), ("acceleration", acceleration)):
            missing = [
                joint.name()
                for joint, value in zip(joints, values, strict=True)
                if not np.isfinite(value)
            ]
            require(
                not missing,
                f"{where}.joint_{kind}: the model has no limit for "
                f"{', '.join(missing)}; give one for each of its "
                f"{len(joints)} joints",
            )
        effort_of = {
            actuator.joint().name(): actuator.effort_limit()
            for actuator in map(
                plant.get_joint_actuator, plant.GetJointActuatorIndices()
            )
        }
        return ArmLimits(
            joint_name=tuple(joint.name() for joint in joints),
            lower=np.array([joint.position_lower_limit() for joint in joints]),
            upper=np.array([joint.position_upper_limit() for joint in joints]),
            speed=speed,
            acceleration=acceleration,
            effort=np.array(
                [effort_of.get(joint.name(), np.inf) for joint in joints]
            ),
        )
