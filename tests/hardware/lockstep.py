"""Robot, rings and monitor in one thread, cycle by cycle, without a clock.

All is as on hardware, with the bytes of the robot's packages and of the
rings' frames, but for sockets and time: a cycle of the robot lasts as long as
the numbers say. So what is measured here is the same on every computer.
"""

import collections
import dataclasses as dc
import math

from robot_room import make_kinematics, make_robot

from tofssm_drake.diagrams.hardware_loop import HardwareLoop
from tofssm_drake.diagrams.hardware_run import HardwareRun
from tofssm_drake.diagrams.ring_decoder import make_ring_decoder
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulated_rings import (
    SimulatedRings,
    iterate_wake_times,
)
from tofssm_drake.hardware.ring_fault_injection import (
    FaultInjector,
    RingFault,
    damage,
)
from tofssm_drake.hardware.ring_frame import encode_frame
from tofssm_drake.hardware.ring_link import LoopbackRingLink
from tofssm_drake.hardware.robot_connection import RtdeStatus
from tofssm_drake.hardware.rtde_protocol import Recipe
from tofssm_drake.hardware.rtde_report import ReportMaker, list_outputs
from tofssm_drake.hardware.slider import SliderPhase
from tofssm_drake.messages import (
    RINGS,
    RobotReport,
    RobotState,
    SliderCommand,
)

CYCLE = 0.008
# Host's time at the begin, s.
_HOST = 900.0
# A client connects anew after that silence, s.
_STREAM_TIMEOUT = 0.1


@dc.dataclass
class Times:
    """What came of a fault, s after it began; inf: never."""

    zero: float = math.inf
    """The slider was at 0 in the robot, and stayed there."""
    still: float = math.inf
    """The robot stood still, and stayed so."""
    health: str = ""
    """What the runner said when the robot stood still, or at last."""


class Cell:
    """A robot at work between three rings, and the monitor.

    It is the runner's `RobotConnection`: to wait for a report lets a cycle
    pass.

    Args:
        checks_model: Whether the run ends if the robot is not the modelled
            one.

    Attributes:
        time: s since the begin.
        robot: A `SimulatedUr` with its watchdog at 0.2 s.
        is_silent: The robot's packages do not come any more.
        delay: By how much they come late, s.
    """

    def __init__(self, *, checks_model: bool = True):
        self.scenario = load_scenario(text="{human: !NoHuman {}}")
        self.robot = make_robot(
            program=self.scenario.program,
            start="heartbeat",
            watchdog_timeout=0.2,
            loop=True,
        )
        self.time = 0.0
        self.is_silent = False
        self.delay = 0.0
        self._commands = []
        self._queue = collections.deque()
        self._report = self._newest = RobotReport()
        self._session = 0
        self._last = math.nan
        self._begin_session()
        self._link = LoopbackRingLink(decoder=make_ring_decoder(self.scenario))
        self._injectors = [FaultInjector() for _ in RINGS]
        self._rings = SimulatedRings(
            scenario=self.scenario, send=self._receive_frame
        )
        self._wake_times = iterate_wake_times(self.scenario)
        self._wake_time = next(self._wake_times)
        self.run = HardwareRun(
            loop=HardwareLoop(
                scenario=self.scenario, virtual_rings=False, send=self.send
            ),
            robot=self,
            rings=self._link,
            period=self.scenario.control_period,
            kinematics=make_kinematics() if checks_model else None,
            clock=lambda: _HOST + self.time,
        )
        self.result = None

    # What a RobotConnection does.

    def get_report(self):
        return self._report

    def wait_for_report(self, *, after, timeout):
        self._advance()
        return self._report

    def send(self, command):
        self._commands.append(command)
        return True

    def get_status(self):
        return RtdeStatus(connected=not self.is_silent, problem="")

    def close(self):
        """Writes 0, as a client does, and lets the heartbeat stand."""
        self._commands = [
            SliderCommand(
                mask=1, heartbeat=self.robot.inputs["input_int_register_24"]
            )
        ]

    # What a test does.

    def step(self):
        """Lets a cycle pass; returns the newest result."""
        self.result = self.run.step() or self.result
        return self.result

    def inject(self, kind, ring, sensor=None):
        """Begins a fault of a ring, or of one of its sensors alone."""
        self._injectors[RINGS.index(ring)] = FaultInjector(
            [RingFault(kind=kind, ring=ring, start=0.0, sensor=sensor)]
        )

    def heal(self):
        """Ends all faults of the rings: their devices begin anew."""
        self._injectors = [
            FaultInjector(
                [
                    # One frame that says so.
                    RingFault(
                        kind="restart",
                        ring=ring,
                        start=0.0,
                        end=self.time + self.scenario.rings.period,
                    )
                ]
            )
            if injector.faults
            else injector
            for ring, injector in zip(RINGS, self._injectors, strict=True)
        ]

    def wait_until(self, condition, timeout=10.0):
        """Runs until a condition of the newest result holds."""
        end = self.time + timeout
        while not (self.step() and condition(self.result)):
            assert self.time < end, f"waited in vain: {self.result.health}"
        return self.result

    def wait_for_full_speed(self):
        """Runs until the robot is at full speed and everything is well."""
        self.wait_until(
            lambda r: (
                r.robot_state == RobotState.NORMAL
                and r.slider.phase == SliderPhase.FOLLOWING
                and self.robot.slider == 1.0
                and self.robot.speed_fraction == 1.0
                and abs(self._report.velocity[0]) > 1.5
            )
        )

    def measure(self, duration):
        """Runs for so long and returns `Times` from now on."""
        start, times = self.time, Times()
        while self.time < start + duration:
            self.step()
            elapsed = round(self.time - start, 6)
            if self.robot.slider != 0.0:
                times.zero = math.inf
            elif times.zero == math.inf:
                times.zero = elapsed
            if self.robot.speed_fraction != 0.0:
                times.still = math.inf
            elif times.still == math.inf:
                times.still = elapsed
                times.health = self.result.health
        times.health = times.health or self.result.health
        return times

    # How a cycle passes.

    def _advance(self):
        for command in self._commands:
            self.robot.receive(
                {
                    "speed_slider_mask": command.mask,
                    "speed_slider_fraction": command.speed_fraction,
                    "input_int_register_24": command.heartbeat,
                }
            )
        self._commands.clear()
        self.robot.step()
        self.time += CYCLE
        values = [self.robot.outputs[name] for name in self._recipe.names]
        package = self._recipe.encode(values)[3:]
        self._newest = self._decode(package, self._newest)
        while self._wake_time <= self.time:
            self._rings.advance(
                self._wake_time, self._newest, _HOST + self._wake_time
            )
            self._wake_time = next(self._wake_times)
        self._deliver_frames()
        if self.is_silent:
            if self.time - (self._report.time - _HOST) > _STREAM_TIMEOUT:
                self._begin_session()
            return
        self._queue.append((self.time + self.delay, package))
        while self._queue and self._queue[0][0] <= self.time:
            _, package = self._queue.popleft()
            self._report = self._decode(package, self._report)
            self._session = self._report.session
            self._last = self._report.timestamp

    def _begin_session(self):
        names = list_outputs(24)
        self._recipe = Recipe(
            names, [self.robot.output_types[name] for name in names], 1
        )
        self._make_report = ReportMaker(
            self._recipe,
            frequency=1.0 / CYCLE,
            products_register=24,
            clock_jump=1.0,
        )
        self._session = self._report.session + 1
        self._last = math.nan
        self._queue.clear()

    def _decode(self, package, before):
        return self._make_report(
            self._recipe.decode_flat(package),
            before=before,
            time=_HOST + self.time,
            last=self._last,
            session=self._session,
        )

    def _receive_frame(self, frame, is_damaged):
        self._injectors[frame.ring].put(frame, self._wake_time)
        return True

    def _deliver_frames(self):
        """Hands over the frames that have come, each with its own arrival."""
        for injector in self._injectors:
            for delivery in injector.take(self.time):
                data = encode_frame(delivery.frame)
                self._link.put_datagram(
                    damage(data) if delivery.is_damaged else data,
                    _HOST + delivery.time,
                )
