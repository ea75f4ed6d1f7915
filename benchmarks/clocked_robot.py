"""A simulated robot controller that logs when it steps and is answered.

Run as a program: it prints its port, serves until it is told to stop, and
then writes its log as JSON to the given file.
"""

import argparse
import contextlib
import json
import os
from pathlib import Path
import time

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.rtde.rtde_server import RtdeServer
from tofssm_drake.rtde.simulated_ur import SimulatedUr, SimulatedUrConfig
from tofssm_drake.scripts.simulate import catch_stop
from tofssm_drake.tasks.program import PickAndPlace, make_program_path

HEARTBEAT = "input_int_register_24"
# A real controller is a computer of its own: nothing here may delay it.
_PRIORITY = 20


class ClockedUr(SimulatedUr):
    """Logs the monotonic clock at the end of each cycle, when its package
    is sent, and when each heartbeat arrives."""

    def __init__(self, **options):
        self.stepped = {}
        self.received = {}
        super().__init__(**options)

    def step(self):
        super().step()
        self.stepped[self.timestamp] = time.monotonic()

    def receive(self, values):
        if HEARTBEAT in values:
            self.received[values[HEARTBEAT]] = time.monotonic()
        super().receive(values)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("series")
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    config = SimulatedUrConfig(
        series=arguments.series, start="heartbeat", loop=True
    )
    kinematics = ArmKinematics.from_plant(make_cell_plant())
    robot = ClockedUr(
        config=config,
        path=make_program_path(PickAndPlace(), kinematics),
        kinematics=kinematics,
    )
    robot.step()
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    with catch_stop() as stopped:
        server = RtdeServer(robot=robot, port=0)
        print(server.address[1], flush=True)
        server.run(lambda: bool(stopped))
    noted = {
        "stepped": list(robot.stepped.items()),
        "received": list(robot.received.items()),
    }
    arguments.out.write_text(json.dumps(noted))


if __name__ == "__main__":
    main()
