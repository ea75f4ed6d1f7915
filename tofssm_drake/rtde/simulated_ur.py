"""A simulated robot with program, slider, modes and registers; no sockets.

It stands in for a robot and its controller. `step` is one control cycle:
received inputs are applied, the program advances at the speed that the slider
allows, and `outputs` is what the controller would report in that cycle. The
server around it is `rtde_server.py`.
"""

import collections
import dataclasses as dc
import math

import numpy as np
from pydrake.math import RotationMatrix

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.errors import require
from tofssm_drake.messages import RTDE_JOINTS
from tofssm_drake.robots.robot_modes import (
    RobotMode,
    RobotStatusBit,
    RuntimeState,
    SafetyMode,
    SafetyStatusBit,
)
from tofssm_drake.rtde.model_match import compose, make_pose
from tofssm_drake.rtde.rtde_fields import (
    ECHOED_TYPES,
    INPUT_TYPES,
    OUTPUT_TYPES,
)
from tofssm_drake.rtde.rtde_protocol import Value
from tofssm_drake.tasks.path import ProgramPath

_SERIES = {
    "cb3": (125, (3, 15, 8, 106)),
    "e": (500, (5, 12, 4, 1101)),
}
# Fields that neither of the simulated software versions has.
_TOO_NEW = {"actual_current_as_torque"}
_E_SERIES_ONLY = {"ft_raw_wrench"}

_SAFETY_BITS: dict[int, SafetyStatusBit] = {
    SafetyMode.NORMAL: SafetyStatusBit.NORMAL,
    SafetyMode.REDUCED: SafetyStatusBit.REDUCED,
    SafetyMode.PROTECTIVE_STOP: SafetyStatusBit.PROTECTIVE_STOPPED,
    SafetyMode.RECOVERY: SafetyStatusBit.RECOVERY,
    SafetyMode.SAFEGUARD_STOP: SafetyStatusBit.SAFEGUARD_STOPPED,
    SafetyMode.SYSTEM_EMERGENCY_STOP: SafetyStatusBit.SYSTEM_EMERGENCY_STOPPED
    | SafetyStatusBit.EMERGENCY_STOPPED,
    SafetyMode.ROBOT_EMERGENCY_STOP: SafetyStatusBit.ROBOT_EMERGENCY_STOPPED
    | SafetyStatusBit.EMERGENCY_STOPPED,
    SafetyMode.VIOLATION: SafetyStatusBit.VIOLATION,
    SafetyMode.FAULT: SafetyStatusBit.FAULT,
}
_MAY_MOVE = (SafetyMode.NORMAL, SafetyMode.REDUCED)
# Largest delay of the reported joints, s.
_MOST_LATE = 1.0


@dc.dataclass(kw_only=True)
class SimulatedUrConfig:
    """What kind of robot is simulated and how it behaves."""

    # "cb3": 125 Hz, software 3.15; "e": e-Series, 500 Hz, software 5.12.
    series: str = "cb3"

    # Restart the program when it is done.
    loop: bool = False

    # When the program starts: "now", with the first "heartbeat" (change of
    # the heartbeat register), or by the dashboard's "play".
    start: str = "now"

    # Time in which the speed along the path follows the slider over its full
    # range, s; 0: at once (assumed: there is no public figure).
    ramp: float = 0.2

    # Time from full speed to standstill when the program pauses or stops, s
    # (assumed), and in a protective stop, s (the safety system's limit for
    # stops is 0.5 s).
    pause_time: float = 0.2
    protective_stop_time: float = 0.1

    # The robot program's watchdog: it acts if the heartbeat register does not
    # change for this long while the program plays, s; 0: not loaded. The
    # action is "pause" or "stop".
    watchdog_timeout: float = 0.0
    watchdog_action: str = "stop"

    # input_int_register of the heartbeat, output_int_register in which the
    # program counts products, digital output of the gripper.
    heartbeat_register: int = 24
    products_register: int = 24
    gripper_output: int = 0

    # Reported of some robots: the slider jumps to 100 % when the program
    # pauses; a protective stop when the slider leaves 0 while the program
    # plays.
    slider_resets_on_pause: bool = False
    protective_stop_after_zero: bool = False

    # The controller's clock at the start, s.
    initial_timestamp: float = 100.0

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        for name, known in (
            ("series", tuple(_SERIES)),
            ("start", ("now", "heartbeat", "dashboard")),
            ("watchdog_action", ("pause", "stop")),
        ):
            require(
                getattr(self, name) in known,
                f"{where}.{name}: {getattr(self, name)!r} is unknown, use "
                f"one of {', '.join(known)}",
            )
        for name, largest in (
            ("ramp", 10.0),
            ("pause_time", 10.0),
            ("protective_stop_time", 10.0),
            ("watchdog_timeout", 60.0),
            ("initial_timestamp", 1e9),
        ):
            require(
                0 <= getattr(self, name) <= largest,
                f"{where}.{name}: must be from 0 to {largest:g} s, "
                f"got {getattr(self, name):g}",
            )
        for name, largest in (
            ("heartbeat_register", 47),
            ("products_register", 47),
            ("gripper_output", 17),
        ):
            require(
                0 <= getattr(self, name) <= largest,
                f"{where}.{name}: must be from 0 to {largest}, "
                f"got {getattr(self, name)}",
            )


class SimulatedUr:
    """The robot: its control cycles, and what people do to it.

    Args:
        config: Settings; checked.
        path: The motion of its program.
        kinematics: Of the robot, for the pose of its tool.
    """

    def __init__(
        self,
        *,
        config: SimulatedUrConfig,
        path: ProgramPath,
        kinematics: ArmKinematics,
    ):
        config.check("robot")
        self._config = config
        self._path = path
        self._kinematics = kinematics
        self.rate, self.version = _SERIES[config.series]
        """Control cycles per second; major, minor, bugfix, build."""
        self.output_types = _list_output_types(config.series)
        self.input_types = dict(INPUT_TYPES)
        self.inputs = {
            name: (0.0,) * 6 if kind == "VECTOR6D" else 0
            for name, kind in INPUT_TYPES.items()
        }
        self.outputs = _make_outputs(self.output_types)
        self.cycle = 0
        """Number of control cycles; not the controller's clock."""
        self.timestamp = config.initial_timestamp
        self.slider = 1.0
        self.slider_frozen = False
        """A fault to inject: inputs do not move the slider."""
        self.ignores_slider = False
        """A fault to inject: the slider moves, but the arm ignores it."""
        self.slowest_fraction = 0.0
        """A fault to inject: the arm follows the slider only down to this."""
        self.joint_offset = np.zeros(RTDE_JOINTS)
        """A fault to inject: error of the reported joints, rad, (6,); the
        tool's pose is right."""
        self.joints_late = 0.0
        """A fault to inject: delay of the reported joints and their speeds, s,
        at most 1; the tool's pose is current."""
        self.clock_rate = 1.0
        """A fault to inject: seconds of the controller's clock per second."""
        self.tcp_offset = calc_tcp_offset(kinematics)
        """Tool in the flange as the robot is set up: x, y, z, rotation
        vector, m, rad, (6,); initially the modelled tool's."""
        self.position = np.zeros(RTDE_JOINTS)
        """True joint angles, rad, (6,), whatever is reported."""
        self.velocity = np.zeros(RTDE_JOINTS)
        """True joint speeds, rad/s, (6,)."""
        self._joints: collections.deque[tuple] = collections.deque(
            maxlen=round(_MOST_LATE * self.rate) + 1
        )
        self.safety_mode = int(SafetyMode.NORMAL)
        self.runtime_state = RuntimeState.STOPPED
        self.path_time = 0.0
        self.speed_fraction = 0.0
        """Speed along the path, of nominal: follows slider and pauses."""
        self._beat: Value | None = None
        self._beat_cycle = 0
        if config.start == "now":
            self.play()
        self._write_outputs(np.zeros(RTDE_JOINTS))

    def receive(self, values: dict) -> None:
        """Takes inputs written by a client, for the next cycle."""
        if values.get("speed_slider_mask", 0) & 1 and not self.slider_frozen:
            fraction = values.get("speed_slider_fraction", math.nan)
            if math.isfinite(fraction):
                self.move_slider(fraction)
        for kind, first in (
            ("standard", 0),
            ("configurable", 8),
            ("tool", 16),
        ):
            name = f"{kind}_digital_output"
            mask = values.get(f"{name}_mask", 0)
            for bit in range(8):
                if mask >> bit & 1:
                    self._set_output(first + bit, values[name] >> bit & 1)
        for i in (0, 1):
            if values.get("standard_analog_output_mask", 0) >> i & 1:
                self.outputs[f"standard_analog_output{i}"] = values[
                    f"standard_analog_output_{i}"
                ]
        self.inputs.update(values)
        self.outputs |= {n: values[n] for n in ECHOED_TYPES.keys() & values}

    def move_slider(self, fraction: float) -> None:
        """Moves the speed slider, as a client or a person does."""
        fraction = min(max(fraction, 0.0), 1.0)
        if (
            self._config.protective_stop_after_zero
            and self.slider == 0.0 < fraction
            and self.runtime_state == RuntimeState.PLAYING
        ):
            self.set_safety_mode(SafetyMode.PROTECTIVE_STOP)
        self.slider = fraction

    def play(self) -> bool:
        """Starts or resumes the program; returns whether it may.

        A stopped program continues where it was, since its products are where
        it left them. A finished one restarts.
        """
        if self.safety_mode not in _MAY_MOVE:
            return False
        if self.runtime_state == RuntimeState.PAUSED:
            self.runtime_state = RuntimeState.RESUMING
        elif self.runtime_state in (
            RuntimeState.STOPPED,
            RuntimeState.STOPPING,
            RuntimeState.PAUSING,
        ):
            if self.path_time >= self._path.duration:
                self.path_time = 0.0
            self.runtime_state = RuntimeState.PLAYING
        self._beat_cycle = self.cycle
        return True

    def pause(self) -> None:
        """Pauses the program, if it runs."""
        if self.is_program_running():
            self.runtime_state = RuntimeState.PAUSING
            if self._config.slider_resets_on_pause:
                self.slider = 1.0

    def stop(self) -> None:
        """Ends the program."""
        if self.runtime_state != RuntimeState.STOPPED:
            self.runtime_state = RuntimeState.STOPPING

    def set_safety_mode(self, mode: int) -> None:
        """Sets the safety mode; all but normal and reduced stop the robot."""
        self.safety_mode = int(mode)
        if mode not in _MAY_MOVE:
            self.pause()

    def restart_clock(self) -> None:
        """Sets the controller's clock to 0, as a restart does."""
        self.shift_clock(-self.timestamp)

    def shift_clock(self, seconds: float) -> None:
        """Lets the controller's clock jump."""
        self.timestamp += seconds

    def is_program_running(self) -> bool:
        """Returns whether the program plays or is about to."""
        return self.runtime_state in (
            RuntimeState.PLAYING,
            RuntimeState.RESUMING,
        )

    def step(self) -> None:
        """Advances by one control cycle."""
        period = 1.0 / self.rate
        self.cycle += 1
        self.timestamp += period * self.clock_rate
        self._watch_heartbeat()
        rate, path = self.speed_fraction, self._path
        next_rate = self._calc_next_rate(period)
        self.path_time += period * (rate + next_rate) / 2
        if self.path_time >= path.duration:
            if self._config.loop:
                self.path_time = 0.0
            else:
                self.path_time = path.duration
                next_rate = 0.0
                self.runtime_state = RuntimeState.STOPPED
        self.speed_fraction = next_rate
        if next_rate == 0.0:
            self.runtime_state = {
                RuntimeState.PAUSING: RuntimeState.PAUSED,
                RuntimeState.STOPPING: RuntimeState.STOPPED,
            }.get(self.runtime_state, self.runtime_state)
        if self.runtime_state == RuntimeState.RESUMING:
            self.runtime_state = RuntimeState.PLAYING
        self._set_output(
            self._config.gripper_output,
            path.calc_gripper_closed(self.path_time),
        )
        self._write_outputs((next_rate - rate) / period)

    def _watch_heartbeat(self):
        """Acts as the watchdog of the robot's program."""
        beat = self.inputs[
            f"input_int_register_{self._config.heartbeat_register}"
        ]
        if self._beat is None:
            self._beat = beat
        if beat != self._beat:
            self._beat = beat
            self._beat_cycle = self.cycle
            if (
                self._config.start == "heartbeat"
                and self.path_time == 0.0
                and self.runtime_state == RuntimeState.STOPPED
            ):
                self.play()
        timeout = self._config.watchdog_timeout
        if (
            timeout
            and self.is_program_running()
            and (self.cycle - self._beat_cycle) / self.rate > timeout
        ):
            if self._config.watchdog_action == "pause":
                self.pause()
            else:
                self.stop()

    def _calc_next_rate(self, period):
        """Returns the speed fraction after a cycle."""
        if self.is_program_running():
            wanted = max(self.slider, self.slowest_fraction)
            if self.ignores_slider:
                wanted = 1.0
            time = self._config.ramp
        elif self.safety_mode in _MAY_MOVE:
            wanted, time = 0.0, self._config.pause_time
        else:
            wanted, time = 0.0, self._config.protective_stop_time
        change = wanted - self.speed_fraction
        if time > 0.0:
            change = min(max(change, -period / time), period / time)
        rate = self.speed_fraction + change
        # A rounding error must not keep the robot moving.
        return 0.0 if rate < 1e-9 else rate

    def _set_output(self, bit, value):
        bits = self.outputs["actual_digital_output_bits"] & ~(1 << bit)
        self.outputs["actual_digital_output_bits"] = bits | int(value) << bit

    def _write_outputs(self, rate_change):
        q, dq, ddq = self._path.calc_motion(self.path_time)
        rate = self.speed_fraction
        qd = dq * rate
        qdd = ddq * rate * rate + dq * rate_change
        self.position, self.velocity = q, qd
        pose, velocity, elbow, elbow_velocity = calc_tool_motion(
            self._kinematics, q, qd, make_pose(self.tcp_offset)
        )
        q, qd = self._calc_reported_joints()
        running = self.is_program_running()
        for name, value in (
            ("q", q),
            ("qd", qd),
            ("TCP_pose", pose),
            ("TCP_speed", velocity),
        ):
            value = tuple(value.tolist())
            self.outputs[f"actual_{name}"] = value
            self.outputs[f"target_{name}"] = value
        self.outputs |= {
            "timestamp": self.timestamp,
            "tcp_offset": tuple(float(x) for x in self.tcp_offset),
            "target_qdd": tuple(qdd.tolist()),
            "elbow_position": tuple(elbow.tolist()),
            "elbow_velocity": tuple(elbow_velocity.tolist()),
            "target_speed_fraction": self.slider,
            "runtime_state": int(self.runtime_state),
            "safety_mode": self.safety_mode,
            "safety_status": self.safety_mode,
            "safety_status_bits": self._calc_safety_bits(),
            "robot_status_bits": int(
                RobotStatusBit.POWER_ON
                | (RobotStatusBit.PROGRAM_RUNNING if running else 0)
            ),
            f"output_int_register_{self._config.products_register}": (
                self._path.calc_products_placed(self.path_time)
            ),
        }

    def _calc_reported_joints(self):
        """Returns the joints' angles and speeds as reported."""
        self._joints.append((self.position, self.velocity))
        late = min(round(self.joints_late * self.rate), len(self._joints) - 1)
        q, qd = self._joints[-1 - late]
        return q + self.joint_offset, qd

    def _calc_safety_bits(self):
        bits = _SAFETY_BITS.get(self.safety_mode, SafetyStatusBit(0))
        if self.safety_mode not in _MAY_MOVE:
            bits |= SafetyStatusBit.STOPPED_DUE_TO_SAFETY
        return int(bits)


def calc_tool_motion(
    kinematics: ArmKinematics, q: np.ndarray, qd: np.ndarray, X_FT: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns what a UR controller reports of tool and elbow.

    Args:
        kinematics: Of the robot.
        q: Joint angles, rad, (6,).
        qd: Joint speeds, rad/s, (6,).
        X_FT: Pose of the tool in the flange, (3, 4).

    Returns:
        Tool's pose in the base: x, y, z, rotation vector, m, rad, (6,).
        Tool's velocity in the base: translational, rotational, m/s, rad/s,
        (6,).
        Elbow's position and velocity in the base, m, m/s, (3,) each.
    """
    X_BA = kinematics.calc_link_poses_in_base(q)
    axes = X_BA[1:, :, 2]
    X_BT = compose(X_BA[-1], X_FT)
    pose = _calc_pose_vector(X_BT[:, :3], X_BT[:, 3])
    v_BT = qd @ np.cross(axes, X_BT[:, 3] - X_BA[1:, :, 3])
    # The elbow joint's origin moves with the upper arm.
    p_BE = X_BA[3, :, 3]
    v_BE = qd[:2] @ np.cross(axes[:2], p_BE - X_BA[1:3, :, 3])
    return pose, np.concatenate([v_BT, qd @ axes]), p_BE, v_BE


def calc_tcp_offset(kinematics: ArmKinematics) -> np.ndarray:
    """Returns the tool's pose in the flange, as a UR controller reports it.

    Args:
        kinematics: Of the robot; its tool sits on the flange.

    Returns:
        x, y, z, rotation vector, m, rad, (6,).

    Raises:
        UserError: The tool sits elsewhere.
    """
    require(
        kinematics.site_link[-1] == kinematics.num_joints,
        "robot model: the tool must sit on the flange",
    )
    X_FT = kinematics.X_AS[-1]
    return _calc_pose_vector(X_FT[:, :3], X_FT[:, 3])


def _calc_pose_vector(R, p):
    """Returns a pose as UR writes it: x, y, z, rotation vector, (6,)."""
    angle_axis = RotationMatrix(R).ToAngleAxis()
    return np.concatenate([p, angle_axis.angle() * angle_axis.axis()])


def _list_output_types(series):
    """Returns the types of the outputs of a controller, by name."""
    return {
        name: kind
        for name, kind in (OUTPUT_TYPES | ECHOED_TYPES).items()
        if name not in _TOO_NEW
        and (series == "e" or name not in _E_SERIES_ONLY)
    }


def _make_outputs(types):
    """Returns outputs of these types, before the first control cycle."""
    return {name: _make_zero(kind) for name, kind in types.items()} | {
        "joint_temperatures": (30.0,) * RTDE_JOINTS,
        "joint_mode": (253,) * RTDE_JOINTS,
        "actual_main_voltage": 48.0,
        "actual_robot_voltage": 48.0,
        "actual_joint_voltage": (48.0,) * RTDE_JOINTS,
        "robot_mode": int(RobotMode.RUNNING),
        "speed_scaling": 1.0,
    }


def _make_zero(kind):
    if kind == "BOOL":
        return False
    if kind.startswith("VECTOR"):
        return (0,) * (3 if kind.startswith("VECTOR3") else 6)
    return 0
