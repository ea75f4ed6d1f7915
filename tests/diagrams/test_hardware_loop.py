"""The monitor on a robot that is handed its data by a test."""

import dataclasses as dc
import itertools
import types
import unittest
from unittest import mock

import numpy as np

from tofssm_drake.diagrams.hardware_loop import (
    HardwareLoop,
    TickInput,
    describe_links,
)
from tofssm_drake.diagrams.hardware_run import HardwareRun, describe_state
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.hardware.rtde_fields import (
    RobotMode,
    RuntimeState,
    SafetyMode,
)
from tofssm_drake.hardware.slider import SliderPhase
from tofssm_drake.messages import (
    RINGS,
    RingHealth,
    RingScan,
    RobotReport,
    make_empty_separation,
)
from tofssm_drake.robot.kinematics import RingKinematics
from tofssm_drake.robot.program import make_program_path
from tofssm_drake.sensing import separation
from tofssm_drake.ssm import dsi_filter

_HOST = 900.0
"""Host's time when the Diagram's is 0, s."""
_TICK = 0.008


class Bench:
    """A robot that stands and follows its slider at once."""

    def __init__(self, loop, scenario):
        self.loop = loop
        loop_path = make_program_path(
            scenario.program,
            RingKinematics.from_plant(loop.workcell.station.plant),
        )
        self.position = loop_path.calc_motion(0.0)[0]
        self.echo = 1.0
        self.changes = {}
        self.count = 0
        self.pause = 0.0
        self.scans = self.early_scans = ()

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
        time = self.count * _TICK + self.pause
        report = self.report()
        result = self.loop.tick(
            TickInput(
                time=time,
                report=report,
                scans=self.scans,
                early_scans=self.early_scans,
                clock_offset=-_HOST,
            )
        )
        self.early_scans = ()
        self.count += 1
        command = result.slider.command
        if command.mask:
            self.echo = command.speed_fraction
        return result

    def run_until(self, end):
        return [self.tick() for _ in range(self.count, round(end / _TICK))]


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
        results = bench.run_until(1.5)
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
                # Back, but slowly: at most 2 per second.
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
        # The heartbeat stands still, so that the robot's watchdog bites.
        self.assertEqual(self.sent[-1].heartbeat, self.sent[-2].heartbeat)


class TestRehearsal(unittest.TestCase):
    """Rings that are not virtual; scans come now and then."""

    def run_bench(self, *, rehearse):
        self.sent = []
        scenario = load_scenario(text="{human: !NoHuman {}}")
        loop = HardwareLoop(
            scenario=scenario,
            virtual_rings=False,
            send=lambda command: self.sent.append(command) or True,
        )
        bench = Bench(loop, scenario)
        said = []
        for i in range(120):
            if i < 80 and i % 3 == 0:
                bench.scans = (self.make_scan(i),) * len(RINGS)
            # A pause, after which the rehearsals have to catch up.
            bench.pause = 0.5 if i >= 60 else 0.0
            said.append(describe_state(bench.tick()))
            # Not before each tick: a report may come early.
            if rehearse and i % 10:
                loop.rehearse()
                loop.rehearse()
        return said, [(c.mask, c.speed_fraction) for c in self.sent]

    def make_scan(self, i):
        time = _HOST + i * _TICK - 0.01
        return RingScan(
            sequence=i,
            time=time,
            sensor_time=np.full(8, time),
            distance=np.full(8, 1.0 + 0.01 * i),
            status=np.full(8, 0 if i < 40 else 4, dtype=np.uint8),
        )

    def test_nothing_follows_from_it(self):
        said, sent = self.run_bench(rehearse=True)
        self.assertEqual(len(sent), 120)
        self.assertEqual((said, sent), self.run_bench(rehearse=False))
        self.assertGreater(len({s["robot_state"] for s in said}), 1)

    def test_comes_before_the_next_report_if_there_is_time(self):
        for cycle, early, rehearsals in (
            # Nothing is known before the third.
            (0.008, 0.0, 8),
            # Each second one comes early, and is answered at once.
            (0.008, 0.003, 4),
            (0.002, 0.0, 0),
        ):
            with self.subTest(cycle=cycle, early=early):
                robot = Clockwork(cycle, early)
                loop = mock.Mock()
                run = HardwareRun(
                    loop=loop,
                    robot=robot,
                    rings=None,
                    period=cycle,
                    clock=lambda r=robot: r.now,
                )
                for _ in range(10):
                    self.assertIsNotNone(run.step())
                    # The tick itself takes its time, too.
                    robot.now += 0.0005
                self.assertEqual(loop.tick.call_count, 10)
                self.assertEqual(loop.rehearse.call_count, rehearsals)


class TestEarlyScans(unittest.TestCase):
    """Scans that are taken before their tick."""

    def run_bench(self, how):
        """Returns what was said; a scan comes before each third tick.

        It is taken `live`, as on a robot; in the next tick as in a `replay`;
        or `late`, not before the tick. Each one tells something else.
        """
        scenario = load_scenario(text="{human: !NoHuman {}}")
        loop = HardwareLoop(scenario=scenario, virtual_rings=False)
        bench = Bench(loop, scenario)
        bench.scans = (RingScan(),) * len(RINGS)
        said, taken = [], []
        for i in range(40):
            if i % 3 == 1:
                bench.scans = (self.make_scan(i),) * len(RINGS)
                if how != "late":
                    bench.early_scans = bench.scans
                if how == "live":
                    taken.append(loop.take_scans(bench.scans))
            said.append(describe_state(bench.tick()))
        return said, taken

    def make_scan(self, i):
        # What is ahead of the last tick has to wait for the next.
        age = 0.004 if i > 20 else 0.02
        time = _HOST + i * _TICK - age
        return RingScan(
            sequence=i,
            time=time,
            sensor_time=np.full(8, time),
            distance=np.full(8, 1.0 + 0.01 * i),
            status=np.zeros(8, dtype=np.uint8),
        )

    def test_replay_says_the_same(self):
        said, taken = self.run_bench("live")
        self.assertEqual(taken, [True] * 13)
        self.assertEqual(said, self.run_bench("replay")[0])
        # Here nothing moves: it does not matter when they were taken.
        self.assertEqual(said, self.run_bench("late")[0])
        self.assertGreater(len({str(s["distance"]) for s in said}), 10)

    def test_computed_before_their_tick(self):
        scenario = load_scenario(text="{human: !NoHuman {}}")
        loop = HardwareLoop(scenario=scenario, virtual_rings=False)
        bench = Bench(loop, scenario)
        bench.scans = (RingScan(),) * len(RINGS)
        bench.tick()
        bench.scans = bench.early_scans = (self.make_scan(1),) * len(RINGS)
        with (
            mock.patch.object(
                separation, "calc_link_row", wraps=separation.calc_link_row
            ) as rows,
            mock.patch.object(
                dsi_filter,
                "calc_safety_index",
                wraps=dsi_filter.calc_safety_index,
            ) as index,
        ):
            loop.take_scans(bench.scans)
            self.assertEqual((rows.call_count, index.call_count), (3, 1))
            result = bench.tick()
            self.assertEqual((rows.call_count, index.call_count), (3, 1))
        self.assertEqual(set(result.separation.sequence), {1})

    def test_nothing_new(self):
        scenario = load_scenario(text="{human: !NoHuman {}}")
        loop = HardwareLoop(scenario=scenario, virtual_rings=False)
        bench = Bench(loop, scenario)
        bench.scans = (RingScan(),) * len(RINGS)
        scans = (self.make_scan(1),) * len(RINGS)
        # Nothing is known of the robot yet.
        self.assertFalse(loop.take_scans(scans))
        bench.tick()
        self.assertFalse(loop.take_scans(()))
        self.assertTrue(loop.take_scans(scans))
        self.assertFalse(loop.take_scans(scans))

    def test_between_two_reports(self):
        """Taken once, and handed to the tick that follows."""
        for cycle in (0.008, 0.002):
            with self.subTest(cycle=cycle):
                robot = Clockwork(cycle, 0.0)
                loop = mock.Mock()
                rings = mock.Mock()
                rings.get_scans.side_effect = itertools.count()
                run = HardwareRun(
                    loop=loop,
                    robot=robot,
                    rings=rings,
                    period=cycle,
                    clock=lambda r=robot: r.now,
                )
                for _ in range(5):
                    run.step()
                    robot.now += 0.0005
                given = [c.args[0] for c in loop.tick.call_args_list]
                taken = [c.args[0] for c in loop.take_scans.call_args_list]
                self.assertEqual(taken, [t.early_scans for t in given[2:]])
                self.assertEqual([t.scans - 1 for t in given[2:]], taken)
                self.assertEqual([t.early_scans for t in given[:2]], [()] * 2)


class Clockwork:
    """A robot whose reports come on time, or a little early.

    Args:
        cycle: Between two reports, s.
        early: By how much each second one comes too early, s.
    """

    def __init__(self, cycle, early):
        self.now = 100.0
        self._cycle = cycle
        self._early = early
        self._count = 0

    def wait_for_report(self, *, after, timeout):
        due = 100.0 + (self._count + 1) * self._cycle
        due -= self._early * (self._count % 2)
        if self.now + timeout >= due:
            self.now = max(self.now, due)
            self._count += 1
        else:
            self.now += max(timeout, 0.0)
        return RobotReport(
            sequence=self._count - 1,
            session=0,
            time=self.now,
            timestamp=self._count * self._cycle,
        )


class TestLinks(unittest.TestCase):
    def describe(self, phase=SliderPhase.FOLLOWING, now=1.05, **changes):
        separation = dc.replace(
            make_empty_separation(),
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
