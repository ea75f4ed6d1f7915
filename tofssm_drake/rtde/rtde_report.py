"""From a controller's outputs to a `RobotReport`."""

import math

import numpy as np

from tofssm_drake.messages import RTDE_JOINTS, RobotReport
import tofssm_drake.rtde.rtde_protocol as rtde
from tofssm_drake.rtde.rtde_protocol import RtdeError

# Numbers of a vector: one for each joint, or position and rotation of the tool.
_SIX = RTDE_JOINTS
# Vectors first, so that one array holds all of them.
_VECTORS = {
    "position": "actual_q",
    "velocity": "actual_qd",
    "acceleration_commanded": "target_qdd",
    "tcp_pose": "actual_TCP_pose",
    "tcp_velocity": "actual_TCP_speed",
    "tcp_offset": "tcp_offset",
}
_SCALARS = {
    "timestamp": "timestamp",
    "digital_inputs": "actual_digital_input_bits",
    "digital_outputs": "actual_digital_output_bits",
    "robot_mode": "robot_mode",
    "safety_mode": "safety_mode",
    "safety_status": "safety_status",
    "robot_status_bits": "robot_status_bits",
    "safety_status_bits": "safety_status_bits",
    "runtime_state": "runtime_state",
    "speed_scaling": "speed_scaling",
    "target_speed_fraction": "target_speed_fraction",
}
# How much the robot's clock may gain on the host's from one package to the
# next, s: as late as a package may be.
_LEAP = 0.25
REQUIRED = {
    "timestamp",
    "actual_q",
    "actual_qd",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "target_speed_fraction",
}
"""Outputs that monitoring needs."""
REQUIRED_LENIENT = {"timestamp", "actual_q", "actual_qd"}
"""Outputs that even a lenient client needs."""


def list_outputs(products_register: int) -> list[str]:
    """Returns the names to ask for; `ReportMaker` relies on their order.

    Args:
        products_register: output_int_register of the products.
    """
    return [
        *_VECTORS.values(),
        *_SCALARS.values(),
        f"output_int_register_{products_register}",
    ]


class ReportMaker:
    """Makes reports from data packages of one recipe.

    Args:
        recipe: Of the outputs; its first fields are vectors of six.
        frequency: Packages per second, to count the missing ones.
        products_register: Number of the register of products.
        clock_jump: Largest step of the robot's clock, s.
    """

    def __init__(
        self,
        recipe: rtde.Recipe,
        *,
        frequency: float,
        products_register: int,
        clock_jump: float,
    ):
        self._period = 1.0 / frequency
        self._clock_jump = clock_jump
        names = list(recipe.names)
        self._vectors = [n for n in _VECTORS if _VECTORS[n] in names]
        self._absent = {
            name: value
            for name, value in vars(RobotReport()).items()
            if name in _VECTORS and name not in self._vectors
        }
        fields = {
            wire: name
            for name, wire in (
                *_SCALARS.items(),
                ("products_placed", f"output_int_register_{products_register}"),
            )
        }
        self._scalars = [fields[n] for n in names[len(self._vectors) :]]
        for name, value in vars(RobotReport()).items():
            if name in fields.values() and name not in self._scalars:
                self._absent[name] = value

    def __call__(
        self,
        flat: tuple,
        *,
        before: RobotReport,
        time: float,
        last: float,
        session: int,
    ) -> RobotReport:
        """Returns the report of a package.

        Args:
            flat: All numbers of the package.
            before: The previous report.
            time: When it arrived, s.
            last: The previous timestamp in this session, s; NaN: none.
            session: Number of the session.

        Raises:
            RtdeError: A number is not finite.
        """
        count = _SIX * len(self._vectors)
        vectors = np.array(flat[:count]).reshape(-1, _SIX)
        vectors.setflags(write=False)
        values = dict(zip(self._scalars, flat[count:], strict=True))
        timestamp = values["timestamp"]
        # A sum is finite only if all its numbers are.
        if not math.isfinite(sum(flat[:count]) + timestamp):
            raise RtdeError("data package: not a number")
        missed = before.missed
        step = timestamp - last
        # All false for the first package: its step is NaN.
        if step < 0 or step > self._clock_jump:
            session += 1
        elif step > 0:
            missed += max(round(step / self._period) - 1, 0)
            if step - (time - before.time) > _LEAP:
                session += 1
        return RobotReport.of_read_only(
            sequence=before.sequence + 1,
            session=session,
            missed=missed,
            time=time,
            **dict(zip(self._vectors, vectors, strict=True)),
            **values,
            **self._absent,
        )
