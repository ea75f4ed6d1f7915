"""`tofssm simulated-rings`: simulated rings around a robot, for tests."""

import contextlib
import copy
import dataclasses as dc
import time
from typing import Annotated

from rich.console import Console
import typer

from tofssm_drake.diagrams.drivers import find_real_cell
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.diagrams.simulated_rings import (
    SimulatedRings,
    iterate_wake_times,
)
from tofssm_drake.errors import UserError, require
from tofssm_drake.ringlink.ring_address import UdpAddress, parse_ring_address
from tofssm_drake.ringlink.ring_device import (
    DeviceClock,
    PtySender,
    UdpSender,
)
from tofssm_drake.ringlink.ring_fault_injection import parse_ring_fault
from tofssm_drake.robots.robot_connection import RobotConnection
import tofssm_drake.scripts.options as options
from tofssm_drake.scripts.simulate import (
    catch_stop,
    interrupt_on_stop,
    override,
)

# Each message is one line, however long, and printed unchanged.
_console = Console(
    stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False
)


def simulated_rings(
    robot_host: Annotated[
        str | None,
        typer.Option(
            help="Address of the robot, real or simulated; default: the "
            "scenario's."
        ),
    ] = None,
    robot_port: options.RobotPort = None,
    robot_text: options.RobotText = "",
    to: Annotated[
        str | None,
        typer.Option(
            help="Where to send the frames.", metavar="udp://127.0.0.1:PORT"
        ),
    ] = None,
    pty: Annotated[
        bool,
        typer.Option(
            "--pty", help="Make a virtual serial line and send there."
        ),
    ] = False,
    scenario_file: options.ScenarioFile = None,
    scenario_name: options.ScenarioName = "Default",
    scenario_text: options.ScenarioText = "",
    human_motion: options.HumanMotion = None,
    seed: options.Seed = None,
    drift: Annotated[
        float,
        typer.Option(help="How much too fast the devices' clocks run, ppm."),
    ] = 0.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="Fault to inject, times in s after the start; can be "
            "repeated. KIND is silent, bus, status254, latency30, ...: "
            "docs/ring_link.md lists them all.",
            metavar="KIND:RING[.SENSOR]@START[-END]",
        ),
    ] = None,
    duration: Annotated[
        float, typer.Option(help="Longest run, s; 0: until Ctrl-C.")
    ] = 0.0,
) -> int:
    """Simulate the rings around a running robot, and send their frames.

    The rings see the cell, the products, a walking person, and the arm where
    the robot reports it to be. It prints a line that says where the frames go;
    they start once the robot has reported.
    """
    require(
        (to is None) == pty,
        "give either --to udp://ADDRESS:PORT or --pty",
    )
    require(
        -10_000.0 <= drift <= 10_000.0,
        f"--drift: must be from -10000 to 10000 ppm, got {drift:g}",
    )
    require(duration >= 0.0, f"--duration: must be 0 or more, got {duration:g}")
    address = None if to is None else _parse_udp_address(to)
    scenario = load_scenario(
        filename=scenario_file, name=scenario_name, text=scenario_text
    )
    override(scenario, human_motion=human_motion, seed=seed)
    counts = {
        name: ring.num_sensors
        for name, ring in find_rings(scenario.sensors).items()
    }
    require(bool(counts), "sensors: there is no ring to simulate")
    faults = [parse_ring_fault(text, counts) for text in fault or []]
    driver = copy.copy(find_real_cell(scenario.driver))
    options.change_robot(
        driver, host=robot_host, port=robot_port, text=robot_text
    )
    sender = PtySender() if address is None else UdpSender(address)
    try:
        with catch_stop() as stopped:
            with interrupt_on_stop(stopped, "interrupted before the start"):
                rings = SimulatedRings(
                    scenario=scenario,
                    clocks=[
                        DeviceClock(start=100.0 * i, drift=1e-6 * drift)
                        for i in range(len(counts))
                    ],
                    faults=faults,
                    send=sender.send,
                )
            with contextlib.closing(driver.open(write=False)) as robot:
                print(
                    "simulated rings, "
                    + ", ".join(
                        f"{k} of {n} sensors" for k, n in counts.items()
                    )
                    + f", frames to {sender.target}",
                    flush=True,
                )
                _Run(rings, robot, stopped, duration).run(
                    iterate_wake_times(scenario)
                )
        print(
            "sent "
            + ", ".join(f"{ring} {n}" for ring, n in rings.sent.items())
            + " frames"
        )
    finally:
        sender.close()
    return 0


def _parse_udp_address(text: str) -> UdpAddress:
    address = parse_ring_address(text, where="--to")
    if not isinstance(address, UdpAddress):
        raise UserError(
            f"--to: {text!r} is not a UDP address; for a serial line use --pty"
        )
    return address


@dc.dataclass
class _Run:
    """The loop, until it is stopped or the time has passed."""

    rings: SimulatedRings
    robot: RobotConnection
    stopped: list
    duration: float
    problem: str = ""

    def run(self, wake_times) -> None:
        while self.robot.get_report().sequence < 0:
            if self.stopped:
                return
            self._tell()
            self.robot.wait_for_report(after=-1, timeout=0.2)
        start = time.monotonic()
        for wake_time in wake_times:
            if self.duration and wake_time > self.duration:
                return
            # No longer than a period, so signals need not interrupt it.
            time.sleep(max(start + wake_time - time.monotonic(), 0.0))
            if self.stopped:
                return
            self._tell()
            self.rings.advance(
                wake_time, self.robot.get_report(), start + wake_time
            )

    def _tell(self):
        """Prints once what is wrong with the robot, and its recovery."""
        problem = self.robot.get_status().problem
        if problem not in (self.problem, "connecting"):
            _console.print(f"robot: {problem or 'reports'}")
            self.problem = problem
