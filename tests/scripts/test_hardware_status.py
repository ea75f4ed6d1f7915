import dataclasses as dc
import io
import os
import threading
import types
import unittest
from unittest import mock

import numpy as np
from paper_cell import RINGS

from tofssm_drake.messages import RobotReport, RobotState
from tofssm_drake.ringlink.ring_budget import LinkFigures
from tofssm_drake.ringlink.ring_link import RingLinkStatus
from tofssm_drake.ringlink.ring_receiver import RingCounts
from tofssm_drake.robots.robot_connection import LoopbackConnection
from tofssm_drake.rtde.slider import SliderPhase, SliderState
import tofssm_drake.scripts.hardware_status as mut


def make_result(
    time,
    state,
    *,
    distance=(np.inf, np.inf, np.inf),
    sensors=("", "", ""),
    **changes,
):
    """Returns a tick's result, as far as it is printed."""
    slider = SliderState(phase=SliderPhase.FOLLOWING, reason="")
    return types.SimpleNamespace(
        **{
            "time": time,
            "robot_state": int(state),
            "reason": f"{state.name.lower()}: tool at {time:.3f} m",
            "problem": "",
            "health": state.name.lower(),
            "slider": slider,
            "speed_fraction": 0.25,
            "separation": types.SimpleNamespace(
                name=RINGS,
                distance=np.array(distance),
                problem=sensors,
            ),
            "products_placed": 3,
        }
        | changes
    )


def make_report():
    return RobotReport(time=100.0, missed=7, target_speed_fraction=0.5)


def make_rings(**counts):
    return RingLinkStatus(
        source="udp",
        counts={"base": RingCounts(**counts), "tool": RingCounts()},
        measured={"base": 99.990, "tool": 99.979},
    )


class TestStatus(unittest.TestCase):
    def describe(self, width=1000, rings=None, **options):
        return mut.describe_status(
            make_result(5.0, RobotState.REDUCED, distance=(np.inf, 0.7, 0.5)),
            make_report(),
            rings,
            now=100.003,
            width=width,
            **options,
        )

    def test_all_of_it(self):
        self.assertEqual(
            self.describe(rings=make_rings(lost=2), missed_before=5),
            "reduced  tool 0.50 m  rho 0.25, echo 0.50  "
            "age robot 3, rings 24 ms  gaps 2, 2  3 placed  "
            "base 13 ms, tool 24 ms; 2 lost",
        )
        self.assertNotIn("placed", self.describe(placed=""))
        line = self.describe(dry_run=True)
        self.assertTrue(line.startswith("reduced  dry run  tool"))

    def test_a_late_link_is_seen(self):
        """From when its samples were measured, not from when they came."""
        rings = dc.replace(
            make_rings(),
            measured={"base": 99.990, "tool": 95.5},
            problem={"base": "", "tool": "samples 4480 ms old on arrival"},
            figures={
                "base": LinkFigures(),
                "tool": LinkFigures(period=0.024, lost=0.02, age=4.48),
            },
        )
        line = self.describe(rings=rings)
        self.assertIn("age robot 3, rings 4503 ms", line)
        self.assertIn(
            "base 13 ms, tool 4503 ms; tool: samples 4480 ms old on arrival "
            "(period 24.0 ms, 2 % lost, 4480 ms old on arrival)",
            line,
        )

    def test_sensors_with_a_problem_are_reported(self):
        line = mut.describe_status(
            make_result(
                1.0,
                RobotState.REDUCED,
                sensors=("", "", "sensor 3: declared dead"),
            ),
            RobotReport(),
            None,
            now=1.0,
        )
        self.assertIn("tool sensor 3: declared dead", line)

    def test_what_matters_fits_into_80_columns(self):
        line = self.describe(width=79, rings=make_rings())
        for part in ("reduced", "tool", "rho", "echo", "robot 3", "gaps 7, 0"):
            self.assertIn(part, line)

    def test_never_wider_than_there_is_room_for(self):
        for width in range(1, 200):
            line = self.describe(width=width, rings=make_rings(lost=3))
            self.assertLessEqual(len(line), width)
            self.assertTrue("reduced".startswith(line[:7]))


class TestChanges(unittest.TestCase):
    def find(self, states, **options):
        """Returns the times of ticks 8 ms apart that are reported."""
        changes = mut.Changes(**{"dry_run": False} | options)
        return [
            round(0.008 * k, 3)
            for k, state in enumerate(states)
            if changes.find(make_result(0.008 * k, state))
        ]

    def test_a_stop_is_reported_at_once_and_its_end_when_it_lasts(self):
        states = [RobotState.NORMAL] * 200 + [RobotState.STOP] * 100
        states += [RobotState.REDUCED] * 200
        # 0.008 * 299 is the last tick of the stop.
        self.assertEqual(self.find(states), [0.0, 1.6, 3.392])

    def test_a_state_that_flickers_is_one_stop(self):
        states = [RobotState.NORMAL] * 200
        states += [RobotState.STOP, RobotState.REDUCED] * 500
        self.assertEqual(self.find(states), [0.0, 1.6])

    def test_problems_and_phases_are_reported_at_once(self):
        changes = mut.Changes(dry_run=False)
        fault = SliderState(phase=SliderPhase.FAULT, reason="at 0.5, not 0.1")
        later = SliderState(phase=SliderPhase.FAULT, reason="at 0.4, not 0.0")
        results = [
            make_result(0.0, RobotState.NORMAL),
            make_result(0.1, RobotState.NORMAL, slider=fault),
            make_result(0.2, RobotState.NORMAL, slider=later),
            make_result(0.3, RobotState.NORMAL, problem="base is faulted"),
        ]
        found = [bool(changes.find(r)) for r in results]
        self.assertEqual(found, [True, True, False, True])
        # In a dry run nobody expects the slider to obey.
        changes = mut.Changes(dry_run=True)
        found = [bool(changes.find(r)) for r in results]
        self.assertEqual(found, [True, False, False, True])


class TestThread(unittest.TestCase):
    def make(self, stream):
        return mut.HardwareStatus(
            robot=LoopbackConnection(), link=None, dry_run=False, stream=stream
        )

    def test_a_file_gets_lines_only(self):
        stream = io.StringIO()
        with self.make(stream) as status:
            for k in range(1000):
                status.show(make_result(0.008 * k, RobotState.NORMAL))
        self.assertEqual(
            stream.getvalue(), "    0.00 s  normal, slider following: normal\n"
        )

    def test_what_is_ignored_is_told_once_a_minute(self):
        stream = io.StringIO()
        status = self.make(stream)
        told = []
        with mock.patch.object(mut.time, "monotonic") as clock:
            for now, unknown in ((1, 0), (2, 3), (3, 99), (61, 990), (63, 991)):
                clock.return_value = now
                rings = dc.replace(make_rings(), unknown=unknown, foreign=2)
                status._find_strangers(rings)
                told.append(len(status._lines))
        self.assertEqual(told, [1, 1, 1, 1, 2])
        self.assertEqual(
            status._lines[-1],
            "rings: ignored so far: 991 frames of unknown rings, 2 datagrams "
            "of other senders",
        )

    def test_a_terminal_that_is_held_holds_nobody(self):
        release = threading.Event()

        class Held(io.StringIO):
            def write(self, text):
                release.wait()
                return super().write(text)

        stream = Held()
        self.addCleanup(release.set)
        with self.make(stream) as status:
            for k in range(10_000):
                state = RobotState(2 * (k // 200 % 2))
                status.show(make_result(0.008 * k, state))
        self.assertEqual(stream.getvalue(), "")

    def test_a_terminal_gets_a_line_that_stays(self):
        master, slave = os.openpty()
        self.addCleanup(os.close, master)
        with open(slave, "w") as terminal:
            with self.make(terminal) as status:
                status.show(make_result(1.0, RobotState.STOP))
            text = os.read(master, 1 << 16).decode()
        first, last = text.split("\n", 1)
        self.assertIn("1.00 s  stop, slider following", first)
        self.assertTrue(last.startswith("stop  clear  rho 0.25"), last)
        # Nothing of it is left at the end.
        self.assertTrue(last.endswith("\r\x1b[K"))

    def test_a_terminal_that_is_gone_is_no_error(self):
        stream = io.StringIO()
        stream.close()
        with self.make(stream) as status:
            status.show(make_result(1.0, RobotState.STOP))
