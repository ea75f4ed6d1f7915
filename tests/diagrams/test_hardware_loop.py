"""The monitor on a robot played by a test."""

import dataclasses as dc
import itertools
import sys
import types
import unittest
from unittest import mock

import numpy as np
from paper_cell import RINGS

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.hardware_loop import (
    HardwareLoop,
    TickInput,
    describe_links,
)
from tofssm_drake.diagrams.hardware_run import HardwareRun
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.viewer import Viewer, ViewerSettings
from tofssm_drake.messages import (
    RingHealth,
    RingScan,
    RobotReport,
    make_empty_separation,
)
from tofssm_drake.robots.robot_modes import (
    RobotMode,
    RuntimeState,
    SafetyMode,
)
from tofssm_drake.rtde.slider import SliderPhase
from tofssm_drake.tasks.program import make_program_path

_HOST = 900.0
"""Host's time when the Diagram's is 0, s."""
_TICK = 0.008


class Bench:
    """A robot at rest whose slider follows at once."""

    def __init__(self, loop, scenario):
        self.loop = loop
        loop_path = make_program_path(
            scenario.task,
            ArmKinematics.from_plant(loop.workcell.station.plant),
        )
        self.position = loop_path.calc_motion(0.0)[0]
        self.echo = 1.0
        self.changes = {}
        self.count = 0
        self.scans = ()

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
        result = self.loop.tick(
            TickInput(
                time=time,
                report=report,
                scans=self.scans,
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


class TestRobot(unittest.TestCase):
    """Whatever the robot does, only 0 is sent until it is ready."""

    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario(text="{people: {visitor: null}}")

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
        results = bench.run_until(1.5)
        self.assertEqual(
            [c.sequence for c in self.sent], list(range(len(results)))
        )
        self.assertEqual(results[-1].slider.phase, SliderPhase.FOLLOWING)
        for result, command in zip(results, self.sent, strict=True):
            self.assertIs(result.slider.command, command)
            # Never faster than the law allows in the same tick.
            self.assertLessEqual(command.speed_fraction, result.speed_fraction)
        self.assertEqual(self.sent[-1].speed_fraction, 1.0)

    def test_modes_hold_the_slider_down(self):
        bench = self.make_bench()
        bench.run_until(1.5)
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
                # It recovers slowly: at most 2 per second.
                first = bench.run_until(bench.count * _TICK + 0.1)[-1]
                self.assertLessEqual(first.slider.command.speed_fraction, 0.25)
                bench.run_until(bench.count * _TICK + 1.4)

    def test_echo_that_does_not_follow(self):
        bench = self.make_bench()
        bench.run_until(1.5)
        bench.changes = {"target_speed_fraction": 0.3}
        bench.tick()
        bench.changes = {"target_speed_fraction": 0.7}
        results = bench.run_until(bench.count * _TICK + 0.2)
        self.assertEqual(results[-1].slider.phase, SliderPhase.FAULT)
        self.assertEqual(self.sent[-1].speed_fraction, 0.0)
        # The heartbeat stops, so that the robot's watchdog acts.
        self.assertEqual(self.sent[-1].heartbeat, self.sent[-2].heartbeat)


class TestViewer(unittest.TestCase):
    """What is shown of the robot, and that the loop does not wait for it."""

    @classmethod
    def setUpClass(cls):
        cls.scenario = load_scenario(text="{people: {visitor: null}}")

    def make_bench(self, show, sent):
        loop = HardwareLoop(
            scenario=self.scenario,
            virtual_rings=True,
            send=lambda command: sent.append(command) or True,
            show=show,
        )
        return Bench(loop, self.scenario)

    def test_frames_tell_pose_and_health(self):
        frames = []
        bench = self.make_bench(frames.append, [])
        bench.run_until(1.5)
        # None of the loop's warm-up; the first is before any result.
        self.assertEqual(
            [frame.time for frame in frames],
            [i / 16 for i in range(len(frames))],
        )
        self.assertGreater(len(frames), 20)
        self.assertEqual(dict(frames[0].health), {})
        for frame in frames[1:]:
            np.testing.assert_array_equal(
                frame.position_measured, bench.position
            )
            self.assertEqual(list(frame.health), [*RINGS, "robot"])
            self.assertEqual(set(frame.masked_scan), set(RINGS))
        self.assertEqual(set(frames[-1].health.values()), {"OK"})
        bench.changes = {"safety_mode": SafetyMode.PROTECTIVE_STOP}
        bench.run_until(2.0)
        self.assertEqual(frames[-1].health["robot"], "HELD")

    def test_goes_on_with_a_viewer_that_takes_nothing(self):
        without, with_viewer = [], []
        self.make_bench(None, without).run_until(4.0)
        settings = ViewerSettings(scenario=self.scenario, is_watched=True)
        deaf = (sys.executable, "-c", "import time; time.sleep(100000)")
        with Viewer(settings, command=deaf) as viewer:
            viewer.start()
            bench = self.make_bench(viewer.send, with_viewer)
            # More frames than its queue and the pipe hold.
            bench.run_until(4.0)
        self.assertEqual(len(with_viewer), len(without))
        for a, b in zip(with_viewer, without, strict=True):
            self.assertEqual(a.speed_fraction, b.speed_fraction)


class TestScans(unittest.TestCase):
    """Rings that are not virtual; scans come now and then."""

    def make_bench(self):
        scenario = load_scenario(text="{people: {visitor: null}}")
        loop = HardwareLoop(scenario=scenario, virtual_rings=False)
        bench = Bench(loop, scenario)
        bench.scans = (RingScan(),) * len(RINGS)
        return bench

    def make_scan(self, i, age=0.01):
        time = _HOST + i * _TICK - age
        return RingScan(
            sequence=i,
            time=time,
            sensor_time=np.full(8, time),
            distance=np.full(8, 1.0 + 0.01 * i),
            status=np.zeros(8, dtype=np.uint8),
        )

    def test_counts_in_its_own_tick(self):
        bench = self.make_bench()
        for i in range(1, 40):
            if i % 3 == 1:
                bench.scans = (self.make_scan(bench.count),) * len(RINGS)
            result = bench.tick()
            self.assertEqual(
                set(result.separation.sequence), {bench.scans[0].sequence}
            )
        self.assertLess(result.separation.distance.max(), np.inf)

    def test_samples_from_later_wait(self):
        """The monitor does not know yet where the robot was then."""
        bench = self.make_bench()
        bench.tick()
        bench.scans = (self.make_scan(1, age=-_TICK),) * len(RINGS)
        seen = [bench.tick().separation for _ in range(4)]
        sequences = [set(s.sequence) for s in seen]
        self.assertEqual(sequences, [{-1}, {-1}, {1}, {1}])

    def test_run_hands_the_newest_to_each_tick(self):
        robot = Clockwork(_TICK)
        loop = mock.Mock()
        rings = mock.Mock()
        rings.get_scans.side_effect = itertools.count()
        run = HardwareRun(
            loop=loop,
            robot=robot,
            rings=rings,
            period=_TICK,
            clock=lambda: robot.now,
        )
        for _ in range(5):
            self.assertIsNotNone(run.step())
        given = [c.args[0].scans for c in loop.tick.call_args_list]
        self.assertEqual(given, [0, 1, 2, 3, 4])


class Clockwork:
    """A robot whose reports come on time.

    Args:
        cycle: Between two reports, s.
    """

    def __init__(self, cycle):
        self.now = 100.0
        self._cycle = cycle
        self._count = 0

    def wait_for_report(self, *, after, timeout):
        self._count += 1
        self.now += self._cycle
        return RobotReport(
            sequence=self._count - 1,
            session=0,
            time=self.now,
            timestamp=self._count * self._cycle,
        )


class TestLinks(unittest.TestCase):
    def describe(self, phase=SliderPhase.FOLLOWING, now=1.05, **changes):
        separation = dc.replace(
            make_empty_separation(RINGS),
            **{
                "sequence": np.array([3, 3, 3]),
                "time": np.array([1.0, 1.0, 1.0]),
                "health": np.array([RingHealth.HEALTHY] * 3),
            }
            | changes,
        )
        result = types.SimpleNamespace(
            time=now,
            separation=separation,
            slider=types.SimpleNamespace(phase=phase),
        )
        return list(describe_links(result, deadline=0.1).values())

    def test_words(self):
        self.assertEqual(self.describe(), ["OK"] * 4)
        self.assertEqual(
            self.describe(
                health=np.array(
                    [RingHealth.BLIND, RingHealth.FAULTED, RingHealth.HEALTHY]
                )
            ),
            ["BLIND", "FAULT", "OK", "OK"],
        )
        self.assertEqual(self.describe(now=1.2), ["FAULT"] * 3 + ["OK"])
        self.assertEqual(
            self.describe(sequence=np.array([3, -1, 3])),
            ["OK", "FAULT", "OK", "OK"],
        )
        for phase, word in (
            (SliderPhase.RISING, "OK"),
            (SliderPhase.HOLDING, "HELD"),
            (SliderPhase.WAITING, "HELD"),
            (SliderPhase.FAULT, "FAULT"),
        ):
            self.assertEqual(self.describe(phase)[3], word)
