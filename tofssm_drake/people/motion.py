"""How the person moves: a table of joint positions over time."""

import dataclasses as dc

import numpy as np

from tofssm_drake.kernels import njit
from tofssm_drake.people.skeleton import (
    CAPSULE_FIRST,
    CAPSULE_SECOND,
    CAPSULES,
    calc_radii,
    complete_joints,
)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class HumanMotion:
    """Joint positions in W at a fixed step, computed before the run.

    Made by `make_motion`; its arrays are read-only.
    """

    joints: np.ndarray
    """Positions in the order of JOINTS, m, in W, shape (T, J, 3)."""
    dt: float
    """Time from row to row, s; row 0 is at t = 0."""
    loops: bool
    """True: row 0 follows the last row. False: the last row is held."""
    stature: float
    """Standing height, m."""
    radii: np.ndarray
    """Radii of the capsules, m, shape (c,)."""
    lengths: np.ndarray
    """Lengths of the capsules between their ends' centres, m, shape (c,).

    Bodies are rigid: each capsule keeps this length at all times.
    """

    @property
    def duration(self) -> float:
        """Seconds until the motion starts again or is held."""
        rows = len(self.joints)
        return self.dt * (rows if self.loops else rows - 1)


def make_motion(
    *, landmarks: np.ndarray, dt: float, loops: bool, stature: float
) -> HumanMotion:
    """Makes a motion from what a source of motion delivers.

    Args:
        landmarks: Positions in the order of skeleton.LANDMARKS, m, in W,
            shape (T, l, 3).
        dt: Time from row to row, s.
        loops: Whether row 0 follows the last row.
        stature: Standing height, m.

    Returns:
        The motion with all joints, capsule radii and lengths.
    """
    joints = complete_joints(landmarks, stature)
    if not (len(joints) > 0 and np.isfinite(joints).all() and dt > 0):
        raise ValueError("a motion needs finite rows and dt > 0")
    span = joints[:, CAPSULE_SECOND] - joints[:, CAPSULE_FIRST]
    lengths = np.median(np.linalg.norm(span, axis=-1), axis=0)
    radii = calc_radii(stature)
    for array in (joints, radii, lengths):
        array.flags.writeable = False
    return HumanMotion(
        joints=joints,
        dt=float(dt),
        loops=bool(loops),
        stature=float(stature),
        radii=radii,
        lengths=lengths,
    )


@njit(cache=True)
def _calc_capsule_ends(
    joints, first, second, lengths, dt, loops, t, ends
):  # pragma: no cover
    rows = joints.shape[0]
    index = t / dt
    # A tick that meets a row gets that row, unharmed by the division.
    nearest = np.floor(index + 0.5)
    if abs(index - nearest) < 1e-6:
        index = nearest
    if loops:
        index -= rows * np.floor(index / rows)
    else:
        index = min(max(index, 0.0), float(rows - 1))
    row = int(np.floor(index))
    weight = index - row
    row = row % rows
    next_row = row + 1
    if next_row == rows:
        next_row = 0 if loops else row
    for i in range(first.size):
        square = 0.0
        for k in range(3):
            a = joints[row, first[i], k]
            b = joints[row, second[i], k]
            if weight > 0.0:
                a += weight * (joints[next_row, first[i], k] - a)
                b += weight * (joints[next_row, second[i], k] - b)
            ends[i, 0, k] = a
            ends[i, 1, k] = b
            square += (b - a) ** 2
        # Between two rows, and where a recorded shoulder or spine gives way,
        # the distance differs a little from the rigid piece's length.
        if square > 0.0:
            half = 0.5 * lengths[i] / np.sqrt(square)
            for k in range(3):
                centre = 0.5 * (ends[i, 0, k] + ends[i, 1, k])
                reach = half * (ends[i, 1, k] - ends[i, 0, k])
                ends[i, 0, k] = centre - reach
                ends[i, 1, k] = centre + reach


@njit(cache=True)
def _calc_capsule_ends_rows(
    joints, first, second, lengths, dt, loops, t, ends
):  # pragma: no cover
    for i in range(t.size):
        _calc_capsule_ends(
            joints, first, second, lengths, dt, loops, t[i], ends[i]
        )


def capsule_ends(motion: HumanMotion, t: float) -> np.ndarray:
    """Returns where the capsules are at one time.

    Positions are interpolated linearly between rows; lengths stay those of
    the motion.

    Args:
        motion: The motion.
        t: Time, s; before 0 the first row holds (or the loop goes on).

    Returns:
        Ends A and B in W in the order of CAPSULES, m, shape (c, 2, 3).
    """
    ends = np.empty((len(CAPSULES), 2, 3))
    _calc_capsule_ends(*_list_settings(motion), t, ends)
    return ends


def capsule_ends_over_time(motion: HumanMotion, t: np.ndarray) -> np.ndarray:
    """Returns where the capsules are at many times.

    Args:
        motion: The motion.
        t: Times, s, shape (k,).

    Returns:
        As `capsule_ends`, at each time, shape (k, c, 2, 3).
    """
    ends = np.empty((len(t), len(CAPSULES), 2, 3))
    _calc_capsule_ends_rows(
        *_list_settings(motion), np.array(t, dtype=float), ends
    )
    return ends


def _list_settings(motion):
    """Returns what the kernels take of a motion, in their order."""
    return (
        motion.joints,
        CAPSULE_FIRST,
        CAPSULE_SECOND,
        motion.lengths,
        motion.dt,
        motion.loops,
    )
