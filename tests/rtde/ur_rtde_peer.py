"""Queries a controller through ur_rtde and prints the answers as JSON.

It is a separate program, as ur_rtde holds the interpreter's lock while it
connects, and aborts the process if the controller goes away.
"""

import json
import sys
import time

from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface


def wait_until(condition, timeout=120.0):
    """Waits until a condition holds; returns whether it does."""
    deadline = time.monotonic() + timeout
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.002)
    return bool(condition())


def main():
    """Prints what ur_rtde says of the controller at the given address."""
    host = sys.argv[1]
    receive = RTDEReceiveInterface(host)
    io = RTDEIOInterface(host)
    seen = {
        "connected": receive.isConnected(),
        "robot_mode": receive.getRobotMode(),
        "safety_mode": receive.getSafetyMode(),
        "runtime_state": receive.getRuntimeState(),
        "robot_status": receive.getRobotStatus(),
        "safety_bits": receive.getSafetyStatusBits(),
        "q": receive.getActualQ(),
        "tcp_pose": receive.getActualTCPPose(),
        "voltage": receive.getActualMainVoltage(),
    }
    start = receive.getTimestamp()
    seen["runs"] = wait_until(lambda: receive.getTimestamp() > start + 0.1)
    for fraction in (0.25, 0.0, 1.0):
        accepted = io.setSpeedSlider(fraction)
        seen[f"slider {fraction}"] = accepted and wait_until(
            lambda f=fraction: receive.getTargetSpeedFraction() == f
        )
    bits = receive.getActualDigitalOutputBits
    for name, bit, put in (
        ("standard", 5, lambda on: io.setStandardDigitalOut(5, on)),
        ("configurable", 10, lambda on: io.setConfigurableDigitalOut(2, on)),
        ("tool", 17, lambda on: io.setToolDigitalOut(1, on)),
    ):
        for on in (True, False):
            put(on)
            seen[f"{name} {on}"] = wait_until(
                lambda bit=bit, on=on: bits() >> bit & 1 == on
            )
    io.setAnalogOutputVoltage(1, 0.5)
    seen["analog"] = wait_until(
        lambda: receive.getStandardAnalogOutput1() == 0.5
    )
    seen["registers"] = io.setInputIntRegister(
        20, -7
    ) and io.setInputDoubleRegister(20, 2.5)
    receive.disconnect()
    # Disconnecting sends PAUSE and waits for its answer.
    io.disconnect()
    print(json.dumps(seen))


if __name__ == "__main__":
    main()
