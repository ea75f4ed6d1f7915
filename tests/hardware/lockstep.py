"""Robot, rings and monitor in one thread, cycle by cycle, without a clock.

Everything is as on hardware, with the bytes of the robot's packages and of the
rings' frames, except for sockets and time: a cycle of the robot lasts exactly
as long as configured. So measurements here are the same on every computer.
"""

import collections
import dataclasses as dc
import math
from unittest import mock

import numpy as np
from paper_cell import RINGS
from robot_room import make_kinematics, make_robot

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.diagrams.hardware_loop import HardwareLoop
from tofssm_drake.diagrams.hardware_run import HardwareRun, JointLimits
from tofssm_drake.diagrams.ring_decoder import make_ring_decoder
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.sensors import rings
from tofssm_drake.diagrams.simulated_rings import (
    SimulatedRings,
    iterate_wake_times,
)
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotReport, RobotState, SliderCommand
from tofssm_drake.ringlink.ring_fault_injection import (
    FaultInjector,
    RingFault,
    damage,
)
from tofssm_drake.ringlink.ring_frame import encode_frame
from tofssm_drake.ringlink.ring_link import LoopbackRingLink
from tofssm_drake.robots.robot_connection import RobotStatus
from tofssm_drake.rtde.rtde_protocol import Recipe, RtdeError
from tofssm_drake.rtde.rtde_report import ReportMaker, list_outputs
from tofssm_drake.rtde.simulated_ur import SimulatedUr
from tofssm_drake.rtde.slider import SliderPhase
from tofssm_drake.sensors.range_status import STATUS_VALID

CYCLE = 0.008
# Host's time at the beginning, s.
_HOST = 900.0
# A client reconnects after this silence, s.
_STREAM_TIMEOUT = 0.1
# What a sensor can see of a person.
_FARTHEST_MM = 1300.0


@dc.dataclass(frozen=True, kw_only=True)
class Visitor:
    """Somebody who comes straight up to one sensor, and stays there.

    No other sensor sees them: this one decides.
    """

    ring: str
    """Name of the sensor's ring."""
    sensor: int
    """Its index."""
    start: float
    """When they come in sight, s on the cell's clock."""
    first: float = 1.2
    """How far from the sensor they come in sight, m."""
    last: float = 0.3
    """Where they stay, m from the sensor."""
    speed: float = 1.6
    """How fast they come, m/s."""
    noise: float = 0.003
    """Standard deviation of the sensor's distances, m."""

    def calc_distance(self, time: float) -> float:
        """Returns how far away they are, m; inf: not in sight yet."""
        if time < self.start:
            return math.inf
        return max(self.first - self.speed * (time - self.start), self.last)


@dc.dataclass
class Times:
    """Effect of a fault, s after it began; inf: never."""

    zero: float = math.inf
    """The slider was at 0 in the robot, and stayed there."""
    still: float = math.inf
    """The robot stood still, and stayed so."""
    health: str = ""
    """What the runner reported when the robot stood still, or at the end."""
    lowest: float = 1.0
    """The slider's lowest position."""
    rise: float = 0.0
    """By how much it rose again from there."""
    last: float = 1.0
    """The arm's speed at the end, of full speed."""

    def see(self, elapsed: float, robot: SimulatedUr, health: str) -> None:
        """Takes the robot's present state."""
        if robot.slider != 0.0:
            self.zero = math.inf
        elif self.zero == math.inf:
            self.zero = elapsed
        if robot.speed_fraction != 0.0:
            self.still = math.inf
        elif self.still == math.inf:
            self.still = elapsed
            self.health = health
        self.lowest = min(self.lowest, robot.slider)
        self.rise = max(self.rise, robot.slider - self.lowest)
        self.last = robot.speed_fraction


class _Loop(HardwareLoop):
    """Without a warm-up, which only affects speed."""

    def rehearse(self):
        """Does nothing."""


class Cell:
    """A robot at work between three rings, and the monitor.

    It is the runner's `RobotConnection`: waiting for a report lets a cycle
    pass.

    Args:
        checks_model: Whether the run ends if the robot is not the modelled
            one.

    Attributes:
        time: s since the beginning.
        robot: A `SimulatedUr` with its watchdog at 0.2 s.
        is_silent: The robot's packages no longer come.
        delay: By how much they come late, s.
        visitor: The person seen by one sensor; None: nobody is there.
        change: Turns a ring's frame into what its wire carries, before faults
            are injected; None: it does not come.
        change_outputs: Turns the robot's outputs into what it reports.
    """

    def __init__(self, *, checks_model: bool = True):
        self.scenario = load_scenario(text="{people: {visitor: null}}")
        self.robot = make_robot(
            program=self.scenario.task,
            start="heartbeat",
            watchdog_timeout=0.2,
            loop=True,
        )
        self.time = 0.0
        self.is_silent = False
        self.delay = 0.0
        self.visitor: Visitor | None = None
        self.change = lambda frame: frame
        self.change_outputs = lambda outputs: outputs
        self._random = np.random.default_rng(0)
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
            loop=_Loop(
                scenario=self.scenario, virtual_rings=False, send=self.send
            ),
            robot=self,
            rings=self._link,
            period=self.scenario.control_period,
            kinematics=make_kinematics() if checks_model else None,
            limits=JointLimits.from_plant(make_cell_plant()),
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
        return RobotStatus(connected=not self.is_silent, problem="")

    def close(self):
        """Writes 0, as a client does, and stops the heartbeat."""
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

    def mount(self, mount_ring):
        """Moves the rings from now on.

        Args:
            mount_ring: Replaces `find_ring_mount` in the rings' world;
                unknown to the monitor.
        """
        heard = []

        def send(frame, is_damaged):
            return not heard or self._receive_frame(frame, is_damaged)

        with mock.patch.object(rings, "find_ring_mount", mount_ring):
            self._rings = SimulatedRings(scenario=self.scenario, send=send)
        # Until now nothing depends on it.
        now = self._wake_time - CYCLE
        self._rings.advance(now, self._newest, _HOST + now)
        heard.append(True)

    def inject(self, kind, ring, *sensors):
        """Begins a fault of a ring, or of some of its sensors."""
        self._injectors[RINGS.index(ring)] = FaultInjector(
            RingFault(kind=kind, ring=ring, start=0.0, sensor=sensor)
            for sensor in sensors or (None,)
        )

    def heal(self):
        """Ends all faults of the rings: their devices restart."""
        self._injectors = [
            FaultInjector(
                [
                    # One frame that reports it.
                    RingFault(
                        kind="restart",
                        ring=ring,
                        start=0.0,
                        end=self.time + 0.024,
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
            assert self.time < end, f"gave up waiting: {self.result.health}"
        return self.result

    def wait_for_full_speed(self):
        """Runs until the robot is at full speed without any problem."""
        self.wait_until(
            lambda r: (
                r.robot_state == RobotState.NORMAL
                and r.slider.phase == SliderPhase.FOLLOWING
                and self.robot.slider == 1.0
                and self.robot.speed_fraction == 1.0
                and abs(self._report.velocity[0]) > 1.5
            )
        )

    def measure(self, duration, *, linger=math.inf, may_end=False):
        """Runs for some time and returns `Times` from now on.

        Args:
            duration: s.
            linger: Ends earlier if the robot has stood still for this long, s.
            may_end: Go on with the robot alone when the run ends.
        """
        start, times = self.time, Times()
        end = ""
        while self.time < start + duration:
            if end:
                self._advance()
            else:
                try:
                    self.step()
                except UserError as error:
                    if not may_end:
                        raise
                    end = str(error)
                    self.close()
            elapsed = round(self.time - start, 6)
            times.see(elapsed, self.robot, end or self.result.health)
            if elapsed >= times.still + linger:
                break
        times.health = times.health or end or self.result.health
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
        self._newest = self._decode(
            self._encode(self.robot.outputs), self._newest
        )
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
        package = self._encode(self.change_outputs(self.robot.outputs))
        self._queue.append((self.time + self.delay, package))
        while self._queue and self._queue[0][0] <= self.time:
            _, package = self._queue.popleft()
            self._take(package)

    def _encode(self, outputs):
        values = [outputs[name] for name in self._recipe.names]
        return self._recipe.encode(values)[3:]

    def _take(self, package):
        try:
            self._report = self._decode(package, self._report)
        except RtdeError:
            # A client hangs up, and reconnects.
            self._begin_session()
            return
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
        frame = self.change(self._show_visitor(frame))
        if frame is not None:
            self._injectors[frame.ring].put(frame, self._wake_time)
        return True

    def _show_visitor(self, frame):
        """Puts the visitor's distance into the frame of their ring."""
        visitor = self.visitor
        if visitor is None or RINGS[frame.ring] != visitor.ring:
            return frame
        noise = visitor.noise * self._random.standard_normal()
        mm = 1e3 * (visitor.calc_distance(self._wake_time) + noise)
        i = visitor.sensor
        is_hidden = frame.status[i] == STATUS_VALID and frame.mm[i] < mm
        if is_hidden or not mm < _FARTHEST_MM:
            return frame
        values = frame.mm.copy(), frame.status.copy()
        values[0][i], values[1][i] = round(mm), STATUS_VALID
        return dc.replace(frame, mm=values[0], status=values[1])

    def _deliver_frames(self):
        """Hands over the arrived frames, each with its own time."""
        for injector in self._injectors:
            for delivery in injector.take(self.time):
                data = encode_frame(delivery.frame)
                self._link.put_datagram(
                    damage(data) if delivery.is_damaged else data,
                    _HOST + delivery.time,
                )
