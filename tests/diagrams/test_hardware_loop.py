"""The monitor on a robot and on rings that are handed their data by a test."""

import unittest

import numpy as np

from tofssm_drake.diagrams.hardware_loop import HardwareLoop, TickInput
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulated_rings import (
    SimulatedRings,
    iterate_wake_times,
)
from tofssm_drake.hardware.ring_fault_injection import parse_ring_fault
from tofssm_drake.hardware.ring_frame import encode_frame
from tofssm_drake.hardware.ring_link import LoopbackRingLink
from tofssm_drake.hardware.ring_receiver import RingDecoder, RingLinkConfig
from tofssm_drake.hardware.rtde_fields import (
    RobotMode,
    RuntimeState,
    SafetyMode,
)
from tofssm_drake.hardware.slider import SliderPhase
from tofssm_drake.messages import RobotReport, RobotState
from tofssm_drake.robot.kinematics import RingKinematics
from tofssm_drake.robot.program import make_program_path

_HOST = 900.0
"""Host's time when the Diagram's is 0, s."""
_TICK = 0.008


class Bench:
    """A robot that stands, follows its slider at once, and has three rings."""

    def __init__(self, loop, scenario, faults=()):
        self.sent = []
        self.loop = loop
        loop_path = make_program_path(
            scenario.program,
            RingKinematics.from_plant(loop.workcell.station.plant),
        )
        self.position = loop_path.calc_motion(0.0)[0]
        self.echo = 1.0
        self.changes = {}
        self.link = LoopbackRingLink(
            decoder=RingDecoder(
                config=RingLinkConfig(),
                num_sensors=scenario.sensors_per_ring,
                timing_budget=scenario.rings.sensor.timing_budget,
            )
        )
        self.rings = SimulatedRings(
            scenario=scenario,
            faults=[parse_ring_fault(text) for text in faults],
            send=self.receive,
        )
        self.wake_times = iterate_wake_times(scenario)
        self.wake_time = next(self.wake_times)
        self.count = 0

    def receive(self, frame, is_damaged):
        data = bytearray(encode_frame(frame))
        data[14] ^= is_damaged
        self.link.put_datagram(bytes(data), _HOST + self.wake_time)
        return True

    def report(self):
        return RobotReport(
            **{
                "sequence": self.count,
                "session": 0,
                "time": _HOST + self.count * _TICK,
                "timestamp": self.count * _TICK,
                "position": self.position,
                "velocity": np.zeros(6),
                "digital_outputs": 0,
                "robot_mode": RobotMode.RUNNING,
                "safety_mode": SafetyMode.NORMAL,
                "runtime_state": RuntimeState.PLAYING,
                "speed_scaling": 1.0,
                "target_speed_fraction": self.echo,
                "products_placed": 0,
                **self.changes,
            }
        )

    def tick(self):
        time = self.count * _TICK
        report = self.report()
        while self.wake_time <= time:
            self.rings.advance(self.wake_time, report, _HOST + self.wake_time)
            self.wake_time = next(self.wake_times)
        result = self.loop.tick(
            TickInput(
                time=time,
                report=report,
                scans=self.link.get_scans(),
                clock_offset=-_HOST,
            )
        )
        self.count += 1
        command = result.slider.command
        if command.mask:
            self.echo = command.speed_fraction
        return result

    def run_until(self, end):
        return [self.tick() for _ in range(self.count, round(end / _TICK))]


class TestRealRings(unittest.TestCase):
    """Whatever goes wrong with a ring: the slider goes to 0, and says why."""

    # kind, ring, length of the fault, longest time to 0 (s) and the reason.
    # 0.4 s of the time is the law's ramp from full speed, 0.1 s its deadline
    # for a sample; a frozen sensor takes 25 repetitions of 0.024 s.
    FAULTS = (
        ("silent", "elbow", 0.8, 0.55, "elbow sample is .* s old"),
        ("corrupt", "base", 0.8, 0.55, "base sample is .* s old"),
        ("late", "tool", 0.8, 0.55, "tool"),
        ("duplicate", "elbow", 0.8, 0.55, "elbow sample is .* s old"),
        ("frozen", "base", 1.4, 1.2, "base is faulted"),
        ("implausible", "tool", 0.8, 0.45, "tool is faulted"),
        ("bus", "elbow", 0.8, 0.45, "elbow is faulted"),
        ("restart", "base", 0.8, 0.55, "base sample is .* s old"),
    )
    RECOVERY = 1.6

    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario(text="{human: !NoHuman {}}")
        cls.loop = HardwareLoop(scenario=cls.scenario, virtual_rings=False)

    def test_ring_faults(self):
        start, faults = 1.0, []
        for kind, ring, length, _, _ in self.FAULTS:
            end = round(start + length, 3)
            faults.append(f"{kind}:{ring}@{start}-{end}")
            start = round(end + self.RECOVERY, 3)
        bench = Bench(self.loop, self.scenario, faults)

        # Without a scan of each ring it does not move.
        for result in bench.run_until(0.3):
            self.assertEqual(result.robot_state, RobotState.STOP)
            self.assertEqual(result.slider.command.speed_fraction, 0.0)
        self.assertIn("no sample yet", result.reason)

        for fault, (_, _, length, limit, why) in zip(
            faults, self.FAULTS, strict=True
        ):
            with self.subTest(fault=fault):
                start = float(fault.partition("@")[2].partition("-")[0])
                result = bench.run_until(start)[-1]
                self.assertEqual(result.slider.command.speed_fraction, 1.0)
                during = bench.run_until(start + length)
                zero = [
                    r for r in during if r.slider.command.speed_fraction == 0.0
                ]
                self.assertTrue(zero, "it never stops")
                self.assertLessEqual(zero[0].time - start, limit)
                self.assertRegex(zero[0].reason, why)
                # Once stopped, it stays so as long as the fault lasts.
                self.assertEqual(
                    len(zero),
                    during[-1] is zero[-1]
                    and (round((during[-1].time - zero[0].time) / _TICK) + 1),
                )
        result = bench.run_until(start + length + self.RECOVERY)[-1]
        self.assertEqual(result.slider.command.speed_fraction, 1.0)


class TestRobot(unittest.TestCase):
    """Whatever the robot does: nothing but 0 is sent until it is fine."""

    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario(text="{human: !NoHuman {}}")

    def make_bench(self):
        self.sent = []
        return Bench(
            HardwareLoop(
                scenario=self.scenario,
                virtual_rings=True,
                send=lambda command: self.sent.append(command) or True,
            ),
            self.scenario,
        )

    def test_command_answers_the_report_it_was_computed_of(self):
        bench = self.make_bench()
        results = bench.run_until(1.0)
        self.assertEqual(
            [c.sequence for c in self.sent], list(range(len(results)))
        )
        self.assertEqual(results[-1].slider.phase, SliderPhase.FOLLOWING)
        for result, command in zip(results, self.sent, strict=True):
            self.assertIs(result.slider.command, command)
            # Never faster than the law says in the same tick.
            self.assertLessEqual(command.speed_fraction, result.speed_fraction)
        self.assertEqual(self.sent[-1].speed_fraction, 1.0)

    def test_modes_hold_the_slider_down(self):
        bench = self.make_bench()
        bench.run_until(1.0)
        for name, value in (
            ("safety_mode", SafetyMode.PROTECTIVE_STOP),
            ("robot_mode", RobotMode.IDLE),
            ("runtime_state", RuntimeState.PAUSED),
        ):
            with self.subTest(mode=name):
                self.assertEqual(self.sent[-1].speed_fraction, 1.0)
                bench.changes = {name: value}
                result = bench.tick()
                self.assertEqual(result.slider.phase, SliderPhase.HOLDING)
                self.assertEqual(self.sent[-1].speed_fraction, 0.0)
                bench.run_until(bench.count * _TICK + 0.2)
                bench.changes = {}
                # Back, but slowly: at most 2 per second.
                first = bench.run_until(bench.count * _TICK + 0.1)[-1]
                self.assertLessEqual(first.slider.command.speed_fraction, 0.25)
                bench.run_until(bench.count * _TICK + 1.0)

    def test_echo_that_does_not_follow(self):
        bench = self.make_bench()
        bench.run_until(1.0)
        bench.changes = {"target_speed_fraction": 0.3}
        bench.tick()
        bench.changes = {"target_speed_fraction": 0.7}
        results = bench.run_until(bench.count * _TICK + 0.2)
        self.assertEqual(results[-1].slider.phase, SliderPhase.FAULT)
        self.assertEqual(self.sent[-1].speed_fraction, 0.0)
        # The heartbeat stands still, so that the robot's watchdog bites.
        self.assertEqual(self.sent[-1].heartbeat, self.sent[-2].heartbeat)
