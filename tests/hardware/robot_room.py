"""A simulated robot in a thread of the test, and free ports for it."""

import contextlib
import functools
import threading

from paper_cell import find_kinematics, make_plant

from tofssm_drake.rtde.rtde_server import Faults, RtdeServer
from tofssm_drake.rtde.simulated_ur import SimulatedUr, SimulatedUrConfig
from tofssm_drake.tasks.program import PickAndPlace, make_program_path


@functools.cache
def make_kinematics():
    return find_kinematics(make_plant())


@functools.cache
def make_path(products=2):
    return make_program_path(PickAndPlace(products=products), make_kinematics())


def make_robot(**settings):
    """Makes a robot whose program has two products, or another one."""
    program = settings.pop("program", PickAndPlace(products=2))
    return SimulatedUr(
        config=SimulatedUrConfig(**settings),
        path=make_path(program.products),
        kinematics=make_kinematics(),
    )


@contextlib.contextmanager
def serve(robot=None, *, host="127.0.0.1", port=0, faults=None):
    """Serves a robot in a thread; yields its RtdeServer."""
    server = RtdeServer(
        robot=make_robot() if robot is None else robot,
        host=host,
        port=port,
        dashboard_port=0,
        faults=Faults() if faults is None else faults,
    )
    stopped = threading.Event()
    thread = threading.Thread(target=server.run, args=(stopped.is_set,))
    thread.start()
    try:
        yield server
    finally:
        stopped.set()
        thread.join()
