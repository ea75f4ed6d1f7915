"""Nominal motions of an arm over path time, and how they are put together.

A speed fraction rho in [0, 1] scales the rate of path time and nothing else,
as a robot's speed slider does: the path itself cannot change.
"""

import bisect
import dataclasses as dc

import numpy as np
import ruckig

from tofssm_drake.carried_objects import CarriableObjects
from tofssm_drake.errors import UserError
from tofssm_drake.kernels import njit


@njit(cache=True)
def evaluate_pieces(start, coefficients, s, motion):
    """Evaluates a piecewise cubic joint motion.

    Args:
        start: Path time at which each piece starts, s, ascending, (p,).
        coefficients: q, q', q'', q''' at each start, (p, 4, n).
        s: Path time, s; held at zero before the first piece. The last piece
            is at rest.
        motion: Written: q, q', q'' at s, (3, n).
    """
    low = 0
    high = start.shape[0]
    while high - low > 1:
        middle = (low + high) // 2
        if start[middle] <= s:
            low = middle
        else:
            high = middle
    u = max(s - start[low], 0.0)
    for j in range(motion.shape[1]):
        p = coefficients[low, 0, j]
        v = coefficients[low, 1, j]
        a = coefficients[low, 2, j]
        jerk = coefficients[low, 3, j]
        motion[0, j] = p + u * (v + u * (a / 2 + u * jerk / 6))
        motion[1, j] = v + u * (a + u * jerk / 2)
        motion[2, j] = a + u * jerk


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ProgramPath:
    """A nominal motion over path time, with what the gripper does.

    Made by a task. Path time is the time it takes at speed
    fraction 1. The gripper closes first, then opens and closes in turn.
    """

    start: np.ndarray
    """Path time at which each cubic piece starts, s, (p,)."""
    coefficients: np.ndarray
    """q, q', q'', q''' at each start, (p, 4, n)."""
    duration: float
    """Path time at the end, s."""
    close_time: tuple[float, ...]
    """When the gripper closes on each product, s."""
    open_time: tuple[float, ...]
    """When it lets go of it, s."""
    objects: CarriableObjects
    """What the task carries."""
    carried: np.ndarray
    """Place of each object, or ON_TOOL, at first and after each of the e times
    at which the gripper closes or opens, (e + 1, p)."""
    step_time: tuple[float, ...] = ()
    """When each step of the task is done, s, ascending: a product placed, a
    waypoint reached."""

    def calc_motion(self, s: float) -> np.ndarray:
        """Returns q, q', q'' at path time s, (3, n); q' = dq/ds."""
        motion = np.empty((3, self.coefficients.shape[2]))
        evaluate_pieces(self.start, self.coefficients, s, motion)
        return motion

    def calc_products_placed(self, s: float) -> int:
        """Returns how many products were let go of up to path time s."""
        return bisect.bisect_right(self.open_time, s)

    def calc_steps_done(self, s: float) -> int:
        """Returns how many steps are done up to path time s."""
        return bisect.bisect_right(self.step_time, s)

    def calc_gripper_closed(self, s: float) -> bool:
        """Returns whether the gripper is closed at path time s."""
        closed = bisect.bisect_right(self.close_time, s)
        return closed > self.calc_products_placed(s)

    def calc_carried_objects(self, s: float) -> np.ndarray:
        """Returns each object's place, or ON_TOOL, at path time s, (p,)."""
        return self.find_carried_objects(
            products_placed=self.calc_products_placed(s),
            gripper_closed=self.calc_gripper_closed(s),
        )

    def find_carried_objects(
        self, *, products_placed: int, gripper_closed: bool
    ) -> np.ndarray:
        """Returns each object's place, or ON_TOOL, from what a robot reports.

        Args:
            products_placed: How often its gripper has let go.
            gripper_closed: Whether it is closed now.

        Returns:
            Shape (p,), read-only.
        """
        actions = 2 * products_placed + bool(gripper_closed)
        return self.carried[min(actions, len(self.carried) - 1)]


class PathBuilder:
    """Strings jerk-limited motions together; its state is the end so far."""

    def __init__(self, q, speed, acceleration, jerk):
        """Starts at rest.

        Args:
            q: First position, rad or m, (n,).
            speed: Limits of the joints, (n,).
            acceleration: Likewise.
            jerk: Likewise.
        """
        self.limits = (speed, acceleration, jerk)
        self.q = np.array(q, dtype=float)
        self.qd = np.zeros(len(q))
        self.time = 0.0
        self.start = []
        self.coefficients = []

    def move(self, q, qd=None, joints=None):
        """Appends the fastest motion to q with end speed qd.

        Joints that do not move are left out, so that they stay exactly still.
        """
        n = len(self.q)
        joints = list(range(n)) if joints is None else joints
        qd = np.zeros(n) if qd is None else qd
        given = ruckig.InputParameter(len(joints))
        given.current_position = self.q[joints].tolist()
        given.current_velocity = self.qd[joints].tolist()
        given.target_position = q[joints].tolist()
        given.target_velocity = qd[joints].tolist()
        given.max_velocity = self.limits[0][joints].tolist()
        given.max_acceleration = self.limits[1][joints].tolist()
        given.max_jerk = self.limits[2][joints].tolist()
        trajectory = ruckig.Trajectory(len(joints))
        try:
            result = ruckig.Ruckig(len(joints)).calculate(given, trajectory)
        except (ruckig.RuckigError, ValueError):
            # ValueError: ruckig has no name for some of its own results.
            result = None
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            raise UserError(
                "task: no motion within these limits of speed, "
                "acceleration and jerk; those by default have one"
            )
        # Every time at which a joint's jerk changes starts a new piece.
        times = [0.0]
        for profile in trajectory.profiles[0]:
            brake = sum(profile.brake.t[:2]) if profile.brake else 0.0
            times.extend(brake + np.cumsum(profile.t))
        knots = np.unique(np.clip(times, 0.0, trajectory.duration))
        knots = knots[np.diff(knots, append=np.inf) > 1e-9]
        ends = np.append(knots[1:], trajectory.duration)
        for begin, end in zip(knots, ends, strict=True):
            if end - begin <= 1e-9:
                continue
            at_begin = trajectory.at_time(begin)
            # Acceleration is continuous and linear in the piece.
            at_end = trajectory.at_time(end)
            piece = np.zeros((4, n))
            piece[0] = self.q
            piece[:3, joints] = at_begin
            piece[3, joints] = (np.array(at_end[2]) - np.array(at_begin[2])) / (
                end - begin
            )
            self.start.append(self.time + begin)
            self.coefficients.append(piece)
        self.time += trajectory.duration
        self.q = np.array(q, dtype=float)
        self.qd = np.array(qd, dtype=float)

    def rest(self, duration):
        """Appends a rest at the end so far."""
        piece = np.zeros((4, len(self.q)))
        piece[0] = self.q
        self.start.append(self.time)
        self.coefficients.append(piece)
        self.time += duration

    def finish(
        self, close_time, open_time, objects, carried, step_time=()
    ) -> ProgramPath:
        """Returns the path, at rest after its end.

        Args:
            close_time: When the gripper closes, s.
            open_time: When it opens again, s.
            objects: What the task carries.
            carried: See `ProgramPath`.
            step_time: See `ProgramPath`.
        """
        duration = self.time
        self.rest(np.inf)
        carried = np.array(carried, dtype=float)
        carried.setflags(write=False)
        return ProgramPath(
            start=np.array(self.start),
            coefficients=np.array(self.coefficients),
            duration=duration,
            close_time=tuple(close_time),
            open_time=tuple(open_time),
            objects=objects,
            carried=carried,
            step_time=tuple(step_time),
        )
