"""A driver of one's own, and a toy controller to try it on.

The controller sends a line of JSON a hundred times a second and takes lines
with a speed fraction. Start it, then the monitor, in two terminals:

python examples/my_driver.py
tofssm hardware --scenario-file examples/my_driver.yaml --scenario-name Panda
"""

import contextlib
import json
from pathlib import Path
import socket
import threading
import time

import numpy as np
from pydrake.math import RotationMatrix

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.robots import (
    DriverTraits,
    LinkClient,
    RobotMode,
    RobotReport,
    RuntimeState,
    SafetyMode,
    read_carried_objects,
)

RATE = 100.0
PROGRAM = {"runs": RuntimeState.PLAYING, "ended": RuntimeState.STOPPED}
SILENCE = 0.1  # A robot without a report for so long is lost, s.


class Toy:
    """What the scenario's factory returns, see `Driver`."""

    traits = DriverTraits(name="the toy controller")

    def __init__(self, host="127.0.0.1", port=5600):
        self.address = (host, port)

    def open(self, *, write=True, tap=None):
        """Connects, again and again; closing sets the fraction to 0."""
        where = "{}:{}".format(*self.address)
        return LinkClient(
            lambda: ToyLink(self.address), where=where, write=write
        )

    def find_carried_objects(self, report, path):
        """Returns where the objects are; this robot has no gripper."""
        return read_carried_objects(report, path)


class ToyLink:
    """One connection, see `RobotLink`."""

    frequency = RATE

    def __init__(self, address):
        self._socket = socket.create_connection(address, timeout=2.0)
        self._socket.settimeout(SILENCE)
        self._lines = self._socket.makefile("rb")

    def read(self):
        """Returns the next report: translates the brand's words."""
        line = self._lines.readline()
        if not line:
            raise OSError("the controller hung up")
        said = json.loads(line)
        return RobotReport(
            timestamp=said["time"],
            position=np.array(said["q"]),
            velocity=np.array(said["qd"]),
            tcp_pose=np.array(said["tool"]),
            tcp_offset=np.array(said["tool_in_flange"]),
            target_speed_fraction=said["fraction"],
            # This robot has neither modes nor a safety system.
            robot_mode=RobotMode.RUNNING,
            safety_mode=SafetyMode.NORMAL,
            runtime_state=PROGRAM[said["program"]],
        )

    def write(self, command):
        """Sends a sign of life, and the fraction if it is to be set."""
        said = {"heartbeat": command.heartbeat}
        if command.mask:
            said["fraction"] = command.speed_fraction
        self._socket.sendall(json.dumps(said).encode() + b"\n")

    def close(self):
        """Ends the connection."""
        self._lines.close()
        self._socket.close()


class ToyController:
    """Runs the scenario's task at its speed fraction; one client at a time."""

    def __init__(self, scenario, port=0):
        arm = scenario.robot
        self.kinematics = ArmKinematics.from_plant(make_cell_plant(arm=arm))
        self.path = make_task_path(scenario.task, self.kinematics, arm)
        self.path_time = self.speed = 0.0
        self.time = time.monotonic()
        self.commanded = [1.0]  # All fractions so far.
        self.server = socket.create_server(("127.0.0.1", port))
        self.server.settimeout(0.2)

    def run(self, is_stopped=lambda: False):
        """Serves until it is to stop."""
        while not is_stopped():
            try:
                client, _ = self.server.accept()
            except TimeoutError:
                continue
            threading.Thread(target=self._listen, args=[client.dup()]).start()
            with client, contextlib.suppress(OSError):  # Until it has gone.
                while not is_stopped():
                    client.sendall(json.dumps(self.step()).encode() + b"\n")
                    time.sleep(1.0 / RATE)

    def _listen(self, client):
        with client, contextlib.suppress(OSError):
            for line in client.makefile("rb"):
                if "fraction" in (said := json.loads(line)):
                    self.commanded.append(said["fraction"])

    def step(self):
        """Advances to the present and returns what to say."""
        before, self.time = self.time, time.monotonic()
        elapsed = min(self.time - before, 5.0 / RATE)
        change = self.commanded[-1] - self.speed
        self.speed += np.clip(change, -5.0 * elapsed, 5.0 * elapsed)
        self.path_time += self.speed * elapsed
        done = self.path_time >= self.path.duration
        q, qd, _ = self.path.calc_motion(self.path_time)
        X_AT, X_BA = np.eye(4), np.eye(4)
        X_AT[:3] = self.kinematics.X_AS[-1]
        X_BA[:3] = self.kinematics.calc_link_poses_in_base(q)[-1]
        return {
            "time": self.time,
            "q": q.tolist(),
            "qd": (self.speed * qd).tolist(),
            "tool": make_vector(X_BA @ X_AT),
            "tool_in_flange": make_vector(X_AT),
            "fraction": self.commanded[-1],
            "program": "ended" if done else "runs",
        }


def make_vector(X):
    """Returns a pose (4, 4) as position and rotation vector."""
    turn = RotationMatrix(X[:3, :3]).ToAngleAxis()
    return [*X[:3, 3], *(turn.angle() * turn.axis())]


if __name__ == "__main__":
    file = Path(__file__).with_name("my_driver.yaml")
    ToyController(load_scenario(filename=file, name="Panda"), port=5600).run()
