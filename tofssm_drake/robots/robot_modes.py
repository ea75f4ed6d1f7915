"""The numbers of modes and states in a `RobotReport`, for every brand.

They are Universal Robots' ("Real-Time Data Exchange (RTDE) Guide"; the later
safety modes from their client library). Another brand's driver translates its
own modes into these; -1, which is not reported, holds the robot.
"""

import enum


class RobotMode(enum.IntEnum):
    """`robot_mode`: how far the arm is switched on; it moves if RUNNING."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(enum.IntEnum):
    """`safety_mode` and `safety_status`."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9
    VALIDATE_JOINT_ID = 10
    UNDEFINED = 11
    AUTOMATIC_MODE_SAFEGUARD_STOP = 12
    SYSTEM_THREE_POSITION_ENABLING_STOP = 13
    TP_THREE_POSITION_ENABLING_STOP = 14
    IMMI_EMERGENCY_STOP = 15
    IMMI_SAFEGUARD_STOP = 16
    PROFISAFE_WAITING = 17
    PROFISAFE_AUTOMATIC_MODE_SAFEGUARD_STOP = 18
    PROFISAFE_SAFEGUARD_STOP = 19
    PROFISAFE_EMERGENCY_STOP = 20
    SAFETY_API_SAFEGUARD_STOP = 22


class RuntimeState(enum.IntEnum):
    """`runtime_state`: what the robot's program does."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class RobotStatusBit(enum.IntFlag):
    """`robot_status_bits`."""

    POWER_ON = 1
    PROGRAM_RUNNING = 2
    TEACH_BUTTON = 4
    POWER_BUTTON = 8


class SafetyStatusBit(enum.IntFlag):
    """`safety_status_bits`."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOPPED = 4
    RECOVERY = 8
    SAFEGUARD_STOPPED = 16
    SYSTEM_EMERGENCY_STOPPED = 32
    ROBOT_EMERGENCY_STOPPED = 64
    EMERGENCY_STOPPED = 128
    VIOLATION = 256
    FAULT = 512
    STOPPED_DUE_TO_SAFETY = 1024


def name_of(kind: type[enum.IntEnum], number: int) -> str:
    """Returns a mode in words; also an unknown one."""
    try:
        return kind(number).name.lower().replace("_", " ")
    except ValueError:
        return f"unknown ({number})"
