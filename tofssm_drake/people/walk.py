"""Walking: a stride, generated or recorded, carried along a path."""

import dataclasses as dc
import math

import numpy as np
from scipy.interpolate import PchipInterpolator

from tofssm_drake.errors import require
from tofssm_drake.people.figure_eight import FigureEight, FigureEightPath
from tofssm_drake.people.motion import HumanMotion, make_motion
from tofssm_drake.people.skeleton import (
    ANKLE_HEIGHT,
    FOOT_LENGTH,
    FOOT_RADIUS,
    FOREARM_LENGTH,
    HALF_HIP_JOINT_BREADTH,
    HALF_SHOULDER_BREADTH,
    HEAD_JOINT_HEIGHT,
    HEEL_LENGTH,
    HIP_HEIGHT,
    KNUCKLE_LENGTH,
    LANDMARK_INDEX,
    LANDMARKS,
    NECK_HEIGHT,
    SHANK_LENGTH,
    SHOULDER_HEIGHT,
    THIGH_LENGTH,
    UPPER_ARM_LENGTH,
    WAIST_HEIGHT,
)

_PHASES = 240
"""Samples of a generated stride."""

_WALK_RATIO = 0.0065
"""Step length over cadence, m min at 1.75 m stature: nearly constant over
the speeds at which adults like to walk (Sekiya and Nagasaki, 1998)."""

_STANCE = 0.61
"""Fraction of the stride in which a foot is on the floor."""

_LONGEST_REACH = 0.998
"""Fraction of the leg's length: no knee is ever locked."""

DOWN = 0.35
"""A foot is down while its lowest part is slower than this, as a fraction of
the walking speed."""

_MOST_LAPS = 5

_LEG_NAMES = ("knee", "ankle", "heel", "toe")
_FOOT_NAMES = ("ankle", "heel", "toe")
_SIGN = {"left": 1, "right": -1}
"""Of y in G, by side."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Gait:
    """One stride of level walking straight ahead, ready to be repeated.

    Frame G moves along the floor at the stride's mean speed: x forward, y
    left, z up from the floor.
    """

    landmarks: np.ndarray
    """Positions in G in the order of LANDMARKS, m, shape (N, l, 3); row k is
    at phase k / N, and row 0 follows row N - 1."""
    stride: float
    """Distance covered by one stride (two steps), m."""
    period: float
    """Duration of one stride, s."""
    stature: float
    """Standing height, m."""


@dc.dataclass(kw_only=True)
class GeneratedWalk:
    """A person who walks round the figure of eight for ever."""

    # Walking speed along the path, m/s. *Assumed*: an adult in no hurry.
    speed: float = 1.2

    # Standing height, m. *Assumed*: between the adult means.
    stature: float = 1.75

    # The path.
    figure_eight: FigureEight = dc.field(default_factory=FigureEight)

    def check(self, where: str):
        """Raises UserError where a value is out of range.

        Args:
            where: What the user calls this, for the message.
        """
        require(
            0.2 <= self.speed <= 2.2,
            f"{where}.speed: {self.speed} should be from 0.2 to 2.2 m/s",
        )
        require(
            1.0 <= self.stature <= 2.3,
            f"{where}.stature: {self.stature} should be from 1.0 to 2.3 m",
        )
        self.figure_eight.check(f"{where}.figure_eight")

    def make_motion(self, period: float, where: str = "people") -> HumanMotion:
        """Returns the motion; period: control tick, s; where: see `check`."""
        return make_walk(self, period)


def _interpolate_cycle(phase, knots, values):
    """Interpolates a periodic curve with phase in [0, 1), without overshoot."""
    knots = np.asarray(knots, float)
    curve = PchipInterpolator(
        np.concatenate([knots - 1.0, knots, knots + 1.0]), np.tile(values, 3)
    )
    return curve(phase)


def solve_knee(
    p_hip: np.ndarray,
    p_ankle: np.ndarray,
    thigh: float,
    shank: float,
    forward: np.ndarray,
) -> np.ndarray:
    """Places the knee of a leg with fixed bones.

    Args:
        p_hip: Hips, m, shape (n, 3).
        p_ankle: Ankles, m, shape (n, 3).
        thigh: Hip to knee, m.
        shank: Knee to ankle, m.
        forward: Where the knee points, any length, shape (n, 3).

    Returns:
        Knees, m, shape (n, 3). Where a leg is too short for its ankle, the
        knee lies on the straight line.
    """
    span = p_ankle - p_hip
    distance = np.linalg.norm(span, axis=-1, keepdims=True)
    axis = span / distance
    reach = np.clip(distance, abs(thigh - shank) + 1e-6, thigh + shank)
    along = (thigh**2 - shank**2 + reach**2) / (2 * reach)
    height = np.sqrt(np.maximum(thigh**2 - along**2, 0.0))
    bend = forward - np.sum(forward * axis, -1, keepdims=True) * axis
    bend /= np.maximum(np.linalg.norm(bend, axis=-1, keepdims=True), 1e-9)
    return p_hip + along * axis + height * bend


def _rotate(x, z, pitch):
    """Rotates (forward, up) by a pitch, nose down positive."""
    c, s = np.cos(pitch), np.sin(pitch)
    return c * x + s * z, -s * x + c * z


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Style:
    """What all parts of a generated body move by."""

    phase: np.ndarray
    """Of the stride, shape (N,)."""
    stride: float
    """Length of two steps, m."""
    stature: float
    """Standing height, m."""
    vigour: float
    """Amplitude of the motion; 1 at 1.2 m/s for an adult of 1.75 m."""

    @property
    def wave(self) -> np.ndarray:
        """Phase as an angle, rad, shape (N,)."""
        return 2 * np.pi * self.phase


def make_gait(*, speed: float, stride: float, stature: float) -> Gait:
    """Generates a stride of ordinary level walking.

    The feet are placed first: each lands on its heel, stands, and rolls over
    its toe without slipping. Pelvis and trunk follow; the knees are solved
    from hip and ankle. Angles and timing are rounded textbook values (Perry,
    "Gait Analysis"; Winter).

    Args:
        speed: Mean forward speed, m/s.
        stride: Length of two steps, m.
        stature: Standing height, m.

    Returns:
        The stride; at phase 0 the left heel lands, at 0.5 the right one.
    """
    style = _Style(
        phase=np.arange(_PHASES) / _PHASES,
        stride=stride,
        stature=stature,
        vigour=min(stride / (1.37 * stature / 1.75), 1.3),
    )
    point = _place_foot(style, "left") | _place_foot(style, "right")
    point |= _place_pelvis(style, point)
    for side in _SIGN:
        point[f"{side}_knee"] = _place_knee(style, point, side)
    point |= _place_trunk(style, point["pelvis"])
    for side in _SIGN:
        point |= _place_arm(style, point[f"{side}_shoulder"], side)
    return Gait(
        landmarks=np.stack([point[name] for name in LANDMARKS], axis=1),
        stride=stride,
        period=stride / speed,
        stature=stature,
    )


def _stack(x, y, z):
    """Returns points (N, 3) of coordinates that are numbers or (N,)."""
    rows = np.zeros(_PHASES)
    return np.stack(np.broadcast_arrays(x, y, z, rows)[:3], axis=-1)


def _place_foot(style, side):
    """Returns toe, heel and ankle of one foot by name."""
    H, stride, sign = style.stature, style.stride, _SIGN[side]
    radius = FOOT_RADIUS * H
    foot = FOOT_LENGTH * H - 2 * radius
    back = HEEL_LENGTH * H
    u = style.phase if side == "left" else (style.phase + 0.5) % 1.0
    pitch = _calc_foot_pitch(u, style.vigour)
    # The heel lies still from landing until the foot is flat, the toe from
    # then until it leaves the floor.
    heel_landing = 0.235 * stride - back
    toe_stance = heel_landing + foot
    toe_landing = heel_landing + foot * np.cos(pitch[np.argmin(u)])
    swing = np.clip((u - _STANCE) / (1 - _STANCE), 0.0, 1.0)
    toe_x = np.where(
        u <= _STANCE,
        heel_landing + foot * np.where(u < 0.09, np.cos(pitch), 1.0),
        toe_stance + ease(swing) * (stride + toe_landing - toe_stance),
    )
    clearance = H * _interpolate_cycle(
        u,
        [0.0, _STANCE, 0.69, 0.80, 0.94],
        [0.0, 0.0, 0.030, 0.016, 0.010],
    )
    toe_z = radius + clearance + foot * np.maximum(np.sin(-pitch), 0.0)
    toe_x = toe_x - stride * u
    y = sign * 0.048 * H
    turned_out = math.radians(sign * 6.0)
    toe_y = y + foot * math.sin(turned_out) / 2
    point = {f"{side}_toe": _stack(toe_x, toe_y, toe_z)}
    heel = _rotate(-foot, 0.0, pitch)
    ankle = _rotate(back - foot, ANKLE_HEIGHT * H - radius, pitch)
    for name, (x, z) in (("heel", heel), ("ankle", ankle)):
        point[f"{side}_{name}"] = _stack(
            toe_x + x * math.cos(turned_out),
            y + (foot / 2 + x) * math.sin(turned_out),
            toe_z + z,
        )
    return point


def _calc_foot_pitch(u, vigour):
    """Returns the pitch of a foot, toe down positive, rad, (N,)."""
    degrees = np.array([-20, 0, 0, 24, 64, 56, 4, -19]) * min(vigour, 1.15)
    knots = [0.0, 0.09, 0.30, 0.50, _STANCE, 0.69, 0.85, 0.96]
    return np.radians(_interpolate_cycle(u, knots, degrees))


def _place_pelvis(style, feet):
    """Returns pelvis and hips by name, as high as the legs reach.

    The pelvis is lowest when both feet are down, and moves towards the
    standing foot.
    """
    H, vigour, wave = style.stature, style.vigour, style.wave
    bob = -0.011 * H * vigour * np.cos(2 * wave - 0.55)
    sway = 0.012 * H * np.sin(wave - 0.25)
    yaw = np.radians(5.0) * vigour * np.cos(wave)
    roll = np.radians(3.0) * vigour * np.sin(wave - 0.1)
    half_hips = HALF_HIP_JOINT_BREADTH * H
    hips = {
        # A left hip that is ahead turns the pelvis to the right.
        side: _stack(
            sign * half_hips * np.sin(yaw),
            sway + sign * half_hips * np.cos(yaw),
            bob + sign * half_hips * np.sin(roll),
        )
        for side, sign in _SIGN.items()
    }
    reach = _LONGEST_REACH * (THIGH_LENGTH * H + SHANK_LENGTH * H)
    height = HIP_HEIGHT * H
    for side, hip in hips.items():
        room = _calc_highest_hip(hip, feet[f"{side}_ankle"], reach) - hip[:, 2]
        height = min(height, np.min(room))
    point = {"pelvis": _stack(0.0, sway, height + bob)}
    for side, hip in hips.items():
        point[f"{side}_hip"] = hip + np.array([0.0, 0.0, height])
    return point


def _calc_highest_hip(p_hip, p_ankle, reach):
    """Returns the greatest height at which a leg reaches its ankle, m, (n,).

    The hip keeps its place over the floor.
    """
    flat = np.linalg.norm((p_ankle - p_hip)[:, :2], axis=-1)
    return p_ankle[:, 2] + np.sqrt(np.maximum(reach**2 - flat**2, 0.0))


def _place_knee(style, point, side):
    toe, heel = point[f"{side}_toe"], point[f"{side}_heel"]
    return solve_knee(
        point[f"{side}_hip"],
        point[f"{side}_ankle"],
        THIGH_LENGTH * style.stature,
        SHANK_LENGTH * style.stature,
        (toe - heel) * [1.0, 1.0, 0.0] + [0.2, 0.0, 0.0],
    )


def _place_trunk(style, pelvis):
    """Returns waist to head and shoulders by name.

    The trunk leans a little and turns against the pelvis.
    """
    H, vigour = style.stature, style.vigour
    _, sway, base_z = pelvis.T
    lean = math.radians(2.0 + 2.0 * vigour)

    def go_up(height, sway_share):
        rise = (height - HIP_HEIGHT) * H
        return (
            rise * math.sin(lean),
            sway * sway_share,
            base_z + rise * math.cos(lean),
        )

    point = {
        "waist": _stack(*go_up(WAIST_HEIGHT, 0.9)),
        "neck": _stack(*go_up(NECK_HEIGHT, 0.7)),
    }
    neck_x = go_up(NECK_HEIGHT, 0.7)[0]
    for name, height, ahead in (
        ("head", HEAD_JOINT_HEIGHT, 0.012 * H),
        ("head_top", 1.0, 0.016 * H),
    ):
        _, y, z = go_up(height, 0.7)
        point[name] = _stack(neck_x + ahead, y, z)
    twist = -np.radians(6.0) * vigour * np.cos(style.wave)
    half_shoulders = HALF_SHOULDER_BREADTH * H * 0.9
    x, y, z = go_up(SHOULDER_HEIGHT, 0.7)
    for side, sign in _SIGN.items():
        point[f"{side}_shoulder"] = _stack(
            x + sign * half_shoulders * np.sin(twist),
            y + sign * half_shoulders * np.cos(twist),
            z,
        )
    return point


def _place_arm(style, p_shoulder, side):
    """Returns elbow, wrist and hand by name; they swing against the leg."""
    sign, vigour = _SIGN[side], style.vigour
    forward = -sign * np.cos(style.wave)
    swing = math.radians(20.0) * vigour * forward + math.radians(-3.0)
    bend = math.radians(14.0) + math.radians(9.0) * vigour * (1.0 + forward)
    spread = math.radians(9.0)
    x, y, z = p_shoulder.T
    point = {}
    for name, length, angle, aside in (
        ("elbow", UPPER_ARM_LENGTH, swing, spread),
        ("wrist", FOREARM_LENGTH, swing + bend, 0.2 * spread),
        ("hand", KNUCKLE_LENGTH, swing + 1.1 * bend, -0.3 * spread),
    ):
        length = length * style.stature
        x = x + length * np.sin(angle) * math.cos(aside)
        y = y + sign * length * math.sin(aside)
        z = z - length * np.cos(angle) * math.cos(aside)
        point[f"{side}_{name}"] = _stack(x, y, z)
    return point


def smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Returns the moving average over about `width` rows, (T, ...)."""
    half = min(width // 2, len(values) - 1)
    if half < 1:
        return np.array(values, dtype=float)
    total = np.cumsum(
        np.concatenate([np.zeros((1, *values.shape[1:])), values]), axis=0
    )
    rows = np.arange(len(values))
    low = np.maximum(rows - half, 0)
    high = np.minimum(rows + half + 1, len(values))
    count = (high - low).reshape(-1, *[1] * (values.ndim - 1))
    return (total[high] - total[low]) / count


def calc_slip(landmarks: np.ndarray, side: str, dt: float) -> np.ndarray:
    """Returns how fast the lowest part of a foot moves over the floor.

    Args:
        landmarks: Positions in the order of LANDMARKS, m, shape (T, l, 3).
        side: "left" or "right".
        dt: Time from row to row, s.

    Returns:
        Horizontal velocity of heel, toe, or their middle where the foot is
        flat, m/s, shape (T, 2).
    """
    points = landmarks[
        :, [LANDMARK_INDEX[f"{side}_{name}"] for name in ("heel", "toe")]
    ]
    velocity = np.gradient(points[:, :, :2], dt, axis=0)
    height = points[:, :, 2]
    share = np.exp(-(height - height.min(axis=1, keepdims=True)) / 0.01)
    share /= share.sum(axis=1, keepdims=True)
    slip = np.sum(share[..., None] * velocity, axis=1)
    return smooth(slip, round(0.05 / dt))


def calc_cycle_slip(
    cycle: np.ndarray, side: str, stride: float, dt: float
) -> np.ndarray:
    """Returns calc_slip of an endlessly repeated stride, (N, 2)."""
    count = len(cycle)
    # Three strides in a row, so that the middle one has no ends.
    thrice = np.tile(cycle, (3, 1, 1))
    ahead = np.arange(3 * count) / count - 1.0
    thrice[:, :, 0] += stride * ahead[:, None]
    return calc_slip(thrice, side, dt)[count : 2 * count]


def find_longest_run(flags: np.ndarray) -> tuple[int, int]:
    """Finds the longest run of True in a cycle.

    Args:
        flags: Of a cycle, shape (N,).

    Returns:
        First row and length of the run; (0, 0) if all flags are the same.
    """
    count = len(flags)
    if flags.all() or not flags.any():
        return 0, 0
    first = np.flatnonzero(flags & ~np.roll(flags, 1))
    stop = np.flatnonzero(~flags & np.roll(flags, 1))
    lengths = [int(np.min((stop - k) % count)) for k in first]
    longest = int(np.argmax(lengths))
    return int(first[longest]), lengths[longest]


def ease(u: np.ndarray) -> np.ndarray:
    """Returns the smooth step from 0 at u = 0 to 1 at u = 1."""
    return u**2 * (3.0 - 2.0 * u)


def _calc_anchor(gait, side):
    """Returns the point of a straight path that a foot goes with, x in G, (N,).

    It lies still on the floor, amid the foot, while the foot does.
    """
    count = len(gait.landmarks)
    dt = gait.period / count
    middle = 0.5 * (
        gait.landmarks[:, LANDMARK_INDEX[f"{side}_heel"], 0]
        + gait.landmarks[:, LANDMARK_INDEX[f"{side}_toe"], 0]
    )
    slip = calc_cycle_slip(gait.landmarks, side, gait.stride, dt)
    down = np.linalg.norm(slip, axis=-1) < DOWN * gait.stride / gait.period
    start, length = find_longest_run(down)
    if length == 0:
        return middle
    k = np.arange(count)
    x = np.roll(middle, -start) + gait.stride * k / count
    place = np.median(x[:length])
    rest = ease(np.clip((k - length + 1) / (count - length + 1), 0.0, 1.0))
    end = x[0] + gait.stride
    x = np.where(
        k < length,
        place,
        x
        + (1 - rest) * (place - x[length - 1])
        + rest * (place + gait.stride - end),
    )
    return np.roll(x - gait.stride * k / count, start)


def _calc_smooth_drop(need, window):
    """Returns a periodic curve nowhere below `need` and without corners."""
    window = max(1, min(window, len(need) // 4))
    offsets = range(-window, window + 1)
    highest = np.max([np.roll(need, k) for k in offsets], axis=0)
    return np.mean([np.roll(highest, k) for k in offsets], axis=0)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Route:
    """Where on a path a walker is, row by row."""

    path: FigureEightPath
    s: np.ndarray
    """Arc length, m, shape (T,)."""
    phase: np.ndarray
    """Strides made so far, shape (T,)."""
    stretch: float
    """Stride on the path over the gait's own."""
    half_step: float
    """m. Shoulders face along a chord of about one step: they do not follow
    every bend at once."""

    @staticmethod
    def make(gait, path, speed, dt, any_stride) -> "_Route":
        """Lays whole strides on whole laps; arguments as for `carry_gait`."""
        laps, strides = _choose_laps(gait, path, any_stride)
        total = laps * path.length
        stretch = total / (strides * gait.stride)
        rows = max(2, round(total / (speed * dt)))
        return _Route(
            path=path,
            s=total * np.arange(rows) / rows,
            phase=strides * np.arange(rows) / rows,
            stretch=stretch,
            half_step=0.25 * stretch * gait.stride,
        )


def _choose_laps(gait, path, any_stride):
    """Returns the numbers of laps and of strides in them."""
    if any_stride:
        return 1, max(1, round(path.length / gait.stride))

    def calc_cost(candidate):
        laps, strides = candidate
        stretch = laps * path.length / (strides * gait.stride)
        return abs(stretch - 1.0) + 0.004 * laps

    candidates = [
        (k, max(1, round(k * path.length / gait.stride)))
        for k in range(1, _MOST_LAPS + 1)
    ]
    return min(candidates, key=calc_cost)


def _sample_cycle(values, phase):
    """Interpolates a cycle of N rows linearly at phases (T,)."""
    count = len(values)
    index = (phase % 1.0) * count
    low = np.floor(index).astype(int) % count
    shape = (-1, *[1] * (values.ndim - 1))
    weight = (index - np.floor(index)).reshape(shape)
    return (1 - weight) * values[low] + weight * values[(low + 1) % count]


def _lay(origin, direction, p_G):
    """Puts points (T, 3) of G where the path is and heads, (T, 3)."""
    x, y, z = p_G.T
    left = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    floor = origin + x[:, None] * direction + y[:, None] * left
    return np.concatenate([floor, z[:, None]], axis=-1)


def _get_indices(side, *names):
    return [LANDMARK_INDEX[f"{side}_{name}"] for name in names]


def carry_gait(
    *,
    gait: Gait,
    path: FigureEightPath,
    speed: float,
    dt: float,
    any_stride: bool,
) -> HumanMotion:
    """Carries a stride along a closed path, round and round.

    The trunk rides along the path as a rigid whole. Each foot goes with a
    point of the path that lies still while the foot is down, so that a foot
    that stands still in straight walking also does on a curve. Then the knees
    are solved, keeping the lengths of the bones.

    Args:
        gait: The stride.
        path: Where to walk.
        speed: Along the path, m/s. It is changed by less than one tick in a
            lap, so that the motion closes on a tick.
        dt: Time from row to row, s.
        any_stride: True: the stride is stretched as needed to close in one
            lap. False: as many laps are taken (up to 5) as leave the stride
            nearly as it was.

    Returns:
        The motion, which loops.
    """
    route = _Route.make(gait, path, speed, dt, any_stride)
    p_G = _sample_cycle(gait.landmarks, route.phase)
    origin = path.calc_position(route.s)
    direction = path.calc_direction(route.s, route.half_step)
    p_W = np.empty_like(p_G)
    for i in range(len(LANDMARKS)):
        p_W[:, i] = _lay(origin, direction, p_G[:, i])
    bones = {}
    for side in _SIGN:
        _carry_foot(p_W, p_G, gait, route, side)
        bones[side] = _calc_leg_lengths(gait.landmarks, side)
    _lower_body(p_W, bones, round(0.08 / dt))
    for side in _SIGN:
        _carry_knee(p_W, p_G, bones[side], route, side)
    return make_motion(landmarks=p_W, dt=dt, loops=True, stature=gait.stature)


def _carry_foot(p_W, p_G, gait, route, side):
    """Lays a foot where its own point of the path is; changes p_W."""
    anchor = _sample_cycle(_calc_anchor(gait, side), route.phase)
    abreast = route.s + route.stretch * anchor
    direction = route.path.calc_direction(abreast, 0.02)
    origin = route.path.calc_position(abreast)
    for i in _get_indices(side, *_FOOT_NAMES):
        x, y, z = p_G[:, i].T
        p_foot = np.stack([x - anchor, y, z], axis=-1)
        p_W[:, i] = _lay(origin, direction, p_foot)


def _calc_leg_lengths(landmarks, side):
    """Returns the lengths of thigh and shank, m."""
    hip, knee, ankle = _get_indices(side, "hip", "knee", "ankle")
    return tuple(
        np.median(np.linalg.norm(landmarks[:, b] - landmarks[:, a], axis=-1))
        for a, b in ((hip, knee), (knee, ankle))
    )


def _lower_body(p_W, bones, window):
    """Lowers all but the legs where a leg is too short; changes p_W.

    On a curve the outer foot reaches farther.
    """
    need = np.zeros(len(p_W))
    for side, (thigh, shank) in bones.items():
        hip, ankle = _get_indices(side, "hip", "ankle")
        reach = _LONGEST_REACH * (thigh + shank)
        highest = _calc_highest_hip(p_W[:, hip], p_W[:, ankle], reach)
        need = np.maximum(need, p_W[:, hip, 2] - highest)
    legs = {i for side in bones for i in _get_indices(side, *_LEG_NAMES)}
    body = [i for i in range(len(LANDMARKS)) if i not in legs]
    p_W[:, body, 2] -= _calc_smooth_drop(need, window)[:, None]


def _carry_knee(p_W, p_G, bones, route, side):
    """Solves a knee so that it bends as in the gait; changes p_W."""
    hip, knee, ankle, toe, heel = _get_indices(
        side, "hip", "knee", "ankle", "toe", "heel"
    )
    thigh, shank = bones
    bend_G = p_G[:, knee] - 0.5 * (p_G[:, hip] + p_G[:, ankle])
    # A nearly straight knee has no clear direction: lend it the foot's.
    lent = (p_G[:, toe] - p_G[:, heel]) * [1.0, 1.0, 0.0]
    bend_G = bend_G + 0.1 * lent
    middle = route.path.calc_direction(
        route.s + 0.5 * route.stretch * p_G[:, ankle, 0], route.half_step
    )
    bend_W = _lay(np.zeros((len(p_W), 2)), middle, bend_G)
    p_W[:, knee] = solve_knee(p_W[:, hip], p_W[:, ankle], thigh, shank, bend_W)


def make_walk(config: GeneratedWalk, dt: float) -> HumanMotion:
    """Makes the motion of a person walking round the figure of eight.

    Args:
        config: Speed, stature, path.
        dt: Time from row to row, s.

    Returns:
        The motion, which loops.

    Raises:
        UserError: A setting is out of range.
    """
    config.check("generated_walk")
    path = FigureEightPath(config=config.figure_eight)
    tallness = config.stature / 1.75
    step = math.sqrt(60.0 * config.speed * _WALK_RATIO * tallness)
    wanted = 2.0 * min(step, 0.47 * config.stature)
    stride = path.length / max(1, round(path.length / wanted))
    gait = make_gait(speed=config.speed, stride=stride, stature=config.stature)
    return carry_gait(
        gait=gait, path=path, speed=config.speed, dt=dt, any_stride=True
    )
