"""What surrounds the loop on a real robot."""

import os
import threading
import unittest
from unittest import mock

import numpy as np

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.diagrams import hardware_run as mut
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RobotReport
from tofssm_drake.robots.robot_connection import LoopbackConnection


class Scheduler:
    """Stands in for the system's scheduling functions.

    Args:
        refuses: Whether nothing is permitted.
        ended: Whether the first thread to be changed has ended.
        policy: Of all threads, initially.
    """

    def __init__(self, *, refuses=False, ended=False, policy=os.SCHED_OTHER):
        self.refuses = refuses
        # Those of other tests may still come and go.
        self.threads = threading.enumerate()
        self.policies = {t.native_id: policy for t in self.threads}
        self.policies[0] = policy
        # Not the main thread, which is the first.
        self.threads.reverse()
        self.ended = self.threads[0].native_id if ended else None

    def get(self, number):
        if number == self.ended:
            raise ProcessLookupError(3, "no such process")
        return self.policies[number]

    def set(self, number, policy, parameters):
        # As for a user with a line in limits.conf, who may not clear the flag.
        flag = os.SCHED_RESET_ON_FORK
        if self.refuses or self.policies[number] & ~policy & flag:
            raise PermissionError(1, "not permitted")
        self.policies[number] = policy
        if number == threading.get_native_id():
            self.policies[0] = policy

    def run(self):
        """Returns what is yielded, and the policies within."""
        with (
            mock.patch.object(
                threading, "enumerate", return_value=self.threads
            ),
            mock.patch.object(os, "sched_getscheduler", self.get),
            mock.patch.object(os, "sched_setscheduler", self.set),
            mut.run_in_real_time() as granted,
        ):
            return granted, {self.policies[t.native_id] for t in self.threads}

    def get_end(self):
        """Returns the policies after it, without the flag."""
        return {p & ~os.SCHED_RESET_ON_FORK for p in self.policies.values()}


class TestRealTime(unittest.TestCase):
    def setUp(self):
        done = threading.Event()
        thread = threading.Thread(target=done.wait)
        thread.start()
        self.addCleanup(thread.join)
        self.addCleanup(done.set)

    def test_all_threads_and_back(self):
        scheduler = Scheduler()
        # Threads started within have no such priority.
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        self.assertEqual(scheduler.run(), (True, {policy}))
        self.assertEqual(scheduler.get_end(), {os.SCHED_OTHER})

    def test_refused(self):
        scheduler = Scheduler(refuses=True)
        self.assertEqual(scheduler.run(), (False, {os.SCHED_OTHER}))

    def test_a_thread_that_has_ended_does_not_matter(self):
        scheduler = Scheduler(ended=True)
        granted, policies = scheduler.run()
        flag = os.SCHED_RESET_ON_FORK
        self.assertTrue(granted)
        self.assertEqual(policies, {os.SCHED_OTHER, os.SCHED_FIFO | flag})

    def test_idle_is_not_a_priority(self):
        scheduler = Scheduler(policy=os.SCHED_IDLE)
        self.assertEqual(scheduler.run(), (False, {os.SCHED_IDLE}))

    def test_what_it_was_started_with_stays(self):
        scheduler = Scheduler(policy=os.SCHED_RR)
        self.assertEqual(scheduler.run(), (True, {os.SCHED_RR}))
        self.assertEqual(scheduler.get_end(), {os.SCHED_RR})


def make_report(**changes):
    fields = {
        "sequence": 1,
        "session": 0,
        "timestamp": 100.0,
        "position": np.zeros(6),
        "velocity": np.zeros(6),
    }
    return RobotReport(**(fields | changes))


class TestPlausible(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.limits = mut.JointLimits.from_plant(make_cell_plant())

    def check(self, message, before=None, **changes):
        before = make_report() if before is None else before
        report = make_report(timestamp=100.008, **changes)
        if not message:
            mut.require_plausible(report, before, self.limits)
            return
        with self.assertRaisesRegex(UserError, message):
            mut.require_plausible(report, before, self.limits)

    def test_positions(self):
        for q, message in (
            (50.0, "joint 3 is at 50.000 rad, the model's limits are -6.28"),
            (-1e300, "joint 3 is at -1"),
            (0.6, "joint 3 went from 0.000 to 0.600 rad in 0.008 s"),
            (-0.6, "joint 3 went from 0.000 to -0.600"),
            (0.4, ""),
        ):
            with self.subTest(q=q):
                self.check(message, position=np.array([0, 0, q, 0, 0, 0]))

    def test_speeds(self):
        for v, message in (
            (1e6, r"joint 2 turns at 1e\+06 rad/s, the model's limit is 2.09"),
            (-7.0, "joint 2 turns at -7 rad/s"),
            (6.0, ""),
        ):
            with self.subTest(v=v):
                self.check(message, velocity=np.array([0, v, 0, 0, 0, 0]))

    def test_what_was_before(self):
        q = np.full(6, 3.0)
        self.check("joint 1 went", position=q)
        # Its last position is unknown.
        self.check("", position=q, before=RobotReport())
        self.check("", position=q, before=make_report(session=1))
        # There was time enough.
        self.check("", position=q, before=make_report(timestamp=98.0))


class TestHoldRobot(unittest.TestCase):
    def test_only_what_is_too_high(self):
        for echo, lowest, sent in (
            (1.0, 0.0, [(1, 0.0)]),
            (0.0, 0.0, []),
            (np.nan, 0.0, [(1, 0.0)]),
            (0.5, 0.01, [(1, 0.01)]),
            (0.01, 0.01, []),
        ):
            with self.subTest(echo=echo, lowest=lowest):
                robot = LoopbackConnection()
                robot.put(make_report(target_speed_fraction=echo))
                mut.hold_robot(robot, lowest)
                self.assertEqual(
                    [(c.mask, c.speed_fraction) for c in robot.sent], sent
                )
                # It must not pass for a monitor.
                self.assertEqual({c.heartbeat for c in robot.sent} - {0}, set())
