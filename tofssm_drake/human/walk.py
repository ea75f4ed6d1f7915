"""Walking: a stride, generated or recorded, carried along a path."""

import dataclasses as dc
import math

import numpy as np

from tofssm_drake.errors import require
from tofssm_drake.human.figure_eight import FigureEight, FigureEightPath
from tofssm_drake.human.motion import HumanMotion, make_motion
from tofssm_drake.human.skeleton import (
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
"""Of the leg's length: no knee is ever locked."""

DOWN = 0.35
"""A foot is down while its lowest part is slower than this, as a fraction of
the walking speed."""

_MOST_LAPS = 5

_LEG_NAMES = ("knee", "ankle", "heel", "toe")
_FOOT_NAMES = ("ankle", "heel", "toe")


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
    """A person walking round the figure of eight without end."""

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


def _interpolate_cycle(phase, knots, values):
    """Periodic interpolation without overshoot, smooth at the knots.

    Cubic Hermite pieces with the slopes of Fritsch and Carlson (1980).
    """
    knots = np.asarray(knots, float)
    values = np.asarray(values, float)
    x = np.concatenate([knots, [knots[0] + 1.0]])
    y = np.concatenate([values, [values[0]]])
    h = np.diff(x)
    secant = np.diff(y) / h
    before = np.roll(secant, 1)
    h_before = np.roll(h, 1)
    w1 = 2 * h + h_before
    w2 = h + 2 * h_before
    same = before * secant > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        harmonic = (w1 + w2) / (w1 / before + w2 / secant)
    slope = np.where(same, harmonic, 0.0)
    slope = np.concatenate([slope, slope[:1]])
    phase = (np.asarray(phase, float) - knots[0]) % 1.0 + knots[0]
    i = np.clip(np.searchsorted(x, phase, side="right") - 1, 0, len(h) - 1)
    u = (phase - x[i]) / h[i]
    return (
        (1 + 2 * u) * (1 - u) ** 2 * y[i]
        + u * (1 - u) ** 2 * h[i] * slope[i]
        + u**2 * (3 - 2 * u) * y[i + 1]
        + u**2 * (u - 1) * h[i] * slope[i + 1]
    )


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
        Knees, m, shape (n, 3). A leg that is too short for its ankle gets
        its knee on the straight line.
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
    """Turns (forward, up) by a pitch, nose down positive."""
    c, s = np.cos(pitch), np.sin(pitch)
    return c * x + s * z, -s * x + c * z


def make_gait(*, speed: float, stride: float, stature: float) -> Gait:
    """Generates a stride of ordinary level walking.

    The feet are placed first: each lands on its heel, stands, and rolls over
    its toe without slipping. Pelvis and trunk follow; the knees are solved
    from hip and ankle. Angles and timing are those of the textbooks (Perry,
    "Gait Analysis"; Winter), rounded.

    Args:
        speed: Mean forward speed, m/s.
        stride: Length of two steps, m.
        stature: Standing height, m.

    Returns:
        The stride; at phase 0 the left heel lands, at 0.5 the right one.
    """
    phase = np.arange(_PHASES) / _PHASES
    H = stature
    # Vigour: 1 at 1.2 m/s for an adult of 1.75 m.
    vigour = min(stride / (1.37 * H / 1.75), 1.3)
    landmarks = np.zeros((_PHASES, len(LANDMARKS), 3))

    def put(name, x, y, z):
        landmarks[:, LANDMARK_INDEX[name]] = np.stack(
            np.broadcast_arrays(x, y, z, phase)[:3], axis=-1
        )

    # Feet.
    radius = FOOT_RADIUS * H
    foot = FOOT_LENGTH * H - 2 * radius
    back = HEEL_LENGTH * H
    ankle_rise = ANKLE_HEIGHT * H - radius
    leg_phases = {"left": phase, "right": (phase + 0.5) % 1.0}
    for side, sign in (("left", 1), ("right", -1)):
        u = leg_phases[side]
        pitch = np.radians(
            _interpolate_cycle(
                u,
                [0.0, 0.09, 0.30, 0.50, _STANCE, 0.69, 0.85, 0.96],
                np.array([-20, 0, 0, 24, 64, 56, 4, -19]) * min(vigour, 1.15),
            )
        )
        # The heel lies still from landing until the foot is flat, the toe
        # from then until it leaves the floor.
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
        heel = _rotate(-foot, 0.0, pitch)
        ankle = _rotate(back - foot, ankle_rise, pitch)
        put(f"{side}_toe", toe_x, y + foot * math.sin(turned_out) / 2, toe_z)
        for name, (x, z) in (("heel", heel), ("ankle", ankle)):
            put(
                f"{side}_{name}",
                toe_x + x * math.cos(turned_out),
                y + (foot / 2 + x) * math.sin(turned_out),
                toe_z + z,
            )

    # Pelvis: lowest when both feet are down, towards the standing foot.
    wave = 2 * np.pi * phase
    bob = -0.011 * H * vigour * np.cos(2 * wave - 0.55)
    sway = 0.012 * H * np.sin(wave - 0.25)
    yaw = np.radians(5.0) * vigour * np.cos(wave)
    roll = np.radians(3.0) * vigour * np.sin(wave - 0.1)
    half_hips = HALF_HIP_JOINT_BREADTH * H
    thigh, shank = THIGH_LENGTH * H, SHANK_LENGTH * H
    hips = {}
    for side, sign in (("left", 1), ("right", -1)):
        # A left hip that is ahead turns the pelvis to the right.
        hips[side] = np.stack(
            [
                sign * half_hips * np.sin(yaw),
                sway + sign * half_hips * np.cos(yaw),
                bob + sign * half_hips * np.sin(roll),
            ],
            axis=-1,
        )
    reach = _LONGEST_REACH * (thigh + shank)
    pelvis_z = HIP_HEIGHT * H
    for side in ("left", "right"):
        ankle = landmarks[:, LANDMARK_INDEX[f"{side}_ankle"]]
        flat = np.linalg.norm((ankle - hips[side])[:, :2], axis=-1)
        highest = ankle[:, 2] + np.sqrt(np.maximum(reach**2 - flat**2, 0.0))
        pelvis_z = min(pelvis_z, np.min(highest - hips[side][:, 2]))
    put("pelvis", 0.0, sway, pelvis_z + bob)
    for side in ("left", "right"):
        p_hip = hips[side] + [0.0, 0.0, pelvis_z]
        landmarks[:, LANDMARK_INDEX[f"{side}_hip"]] = p_hip
        toe = landmarks[:, LANDMARK_INDEX[f"{side}_toe"]]
        p_heel = landmarks[:, LANDMARK_INDEX[f"{side}_heel"]]
        ahead = (toe - p_heel) * [1.0, 1.0, 0.0] + [0.2, 0.0, 0.0]
        landmarks[:, LANDMARK_INDEX[f"{side}_knee"]] = solve_knee(
            p_hip,
            landmarks[:, LANDMARK_INDEX[f"{side}_ankle"]],
            thigh,
            shank,
            ahead,
        )

    # Trunk: leans a little, turns against the pelvis.
    lean = math.radians(2.0 + 2.0 * vigour)
    base_z = pelvis_z + bob

    def up_trunk(height, sway_share):
        rise = (height - HIP_HEIGHT) * H
        return (
            rise * math.sin(lean),
            sway * sway_share,
            base_z + rise * math.cos(lean),
        )

    put("waist", *up_trunk(WAIST_HEIGHT, 0.9))
    put("neck", *up_trunk(NECK_HEIGHT, 0.7))
    neck_x, _, _ = up_trunk(NECK_HEIGHT, 0.7)
    for name, height in (("head", HEAD_JOINT_HEIGHT), ("head_top", 1.0)):
        _, y, z = up_trunk(height, 0.7)
        ahead = 0.012 * H if name == "head" else 0.016 * H
        put(name, neck_x + ahead, y, z)

    twist = -np.radians(6.0) * vigour * np.cos(wave)
    half_shoulders = HALF_SHOULDER_BREADTH * H * 0.9
    shoulder_x, shoulder_y, shoulder_z = up_trunk(SHOULDER_HEIGHT, 0.7)
    for side, sign in (("left", 1), ("right", -1)):
        forward = -sign * np.cos(wave)  # Against the leg of its side.
        swing = math.radians(20.0) * vigour * forward + math.radians(-3.0)
        bend = math.radians(14.0) + math.radians(9.0) * vigour * (1.0 + forward)
        p = [
            shoulder_x + sign * half_shoulders * np.sin(twist),
            shoulder_y + sign * half_shoulders * np.cos(twist),
            shoulder_z + np.zeros(_PHASES),
        ]
        put(f"{side}_shoulder", *p)
        spread = math.radians(9.0)
        for name, length, angle, aside in (
            ("elbow", UPPER_ARM_LENGTH, swing, spread),
            ("wrist", FOREARM_LENGTH, swing + bend, 0.2 * spread),
            ("hand", KNUCKLE_LENGTH, swing + 1.1 * bend, -0.3 * spread),
        ):
            p = [
                p[0] + length * H * np.sin(angle) * math.cos(aside),
                p[1] + sign * length * H * math.sin(aside),
                p[2] - length * H * np.cos(angle) * math.cos(aside),
            ]
            put(f"{side}_{name}", *p)
    return Gait(
        landmarks=landmarks,
        stride=stride,
        period=stride / speed,
        stature=stature,
    )


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
    """Returns calc_slip of a stride that goes on for ever, (N, 2)."""
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
    """Which point of a straight path a foot belongs to, x in G, (N,).

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
    """A periodic curve that is nowhere below `need` and has no corners."""
    window = max(1, min(window, len(need) // 4))
    offsets = range(-window, window + 1)
    highest = np.max([np.roll(need, k) for k in offsets], axis=0)
    return np.mean([np.roll(highest, k) for k in offsets], axis=0)


def carry_gait(
    *,
    gait: Gait,
    path: FigureEightPath,
    speed: float,
    dt: float,
    any_stride: bool,
) -> HumanMotion:
    """Carries a stride along a closed path, round and round.

    The trunk rides along the path as a rigid whole. Each foot belongs to a
    point of the path that lies still while the foot is down: what lies still
    in straight walking so lies still on the curve. Then the knees are
    solved, with the bones' own lengths.

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
    laps, strides = 1, max(1, round(path.length / gait.stride))
    if not any_stride:
        candidates = [
            (k, max(1, round(k * path.length / gait.stride)))
            for k in range(1, _MOST_LAPS + 1)
        ]
        laps, strides = min(
            candidates,
            key=lambda c: (
                abs(c[0] * path.length / (c[1] * gait.stride) - 1.0)
                + 0.004 * c[0]
            ),
        )
    total = laps * path.length
    stretch = total / (strides * gait.stride)
    rows = max(2, round(total / (speed * dt)))
    s = total * np.arange(rows) / rows
    phase = strides * np.arange(rows) / rows
    cycle = len(gait.landmarks)
    index = (phase % 1.0) * cycle
    low = np.floor(index).astype(int) % cycle
    weight = (index - np.floor(index))[:, None, None]
    p_G = (1 - weight) * gait.landmarks[low] + weight * gait.landmarks[
        (low + 1) % cycle
    ]

    def lay(origin, direction, x, y, z):
        left = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
        floor = origin + x[:, None] * direction + y[:, None] * left
        return np.concatenate([floor, z[:, None]], axis=-1)

    # A chord of about one step: shoulders do not follow every bend at once.
    half_step = 0.25 * stretch * gait.stride
    origin = path.calc_position(s)
    direction = path.calc_direction(s, half_step)
    p_W = np.empty_like(p_G)
    for i in range(len(LANDMARKS)):
        p_W[:, i] = lay(origin, direction, *p_G[:, i].T)
    for side in ("left", "right"):
        cycle_anchor = _calc_anchor(gait, side)
        anchor = (1 - weight[:, 0, 0]) * cycle_anchor[low] + weight[
            :, 0, 0
        ] * cycle_anchor[(low + 1) % cycle]
        abreast = s + stretch * anchor
        foot_direction = path.calc_direction(abreast, 0.02)
        foot_origin = path.calc_position(abreast)
        for name in _FOOT_NAMES:
            i = LANDMARK_INDEX[f"{side}_{name}"]
            x, y, z = p_G[:, i].T
            p_W[:, i] = lay(foot_origin, foot_direction, x - anchor, y, z)

    # On a curve the outer foot reaches farther: go down where a leg is short.
    bones = {}
    need = np.zeros(rows)
    for side in ("left", "right"):
        hip, knee, ankle = (
            LANDMARK_INDEX[f"{side}_{name}"]
            for name in ("hip", "knee", "ankle")
        )
        thigh, shank = (
            np.median(
                np.linalg.norm(
                    gait.landmarks[:, b] - gait.landmarks[:, a], axis=-1
                )
            )
            for a, b in ((hip, knee), (knee, ankle))
        )
        bones[side] = thigh, shank
        flat = np.linalg.norm((p_W[:, ankle] - p_W[:, hip])[:, :2], axis=-1)
        reach = _LONGEST_REACH * (thigh + shank)
        highest = p_W[:, ankle, 2] + np.sqrt(
            np.maximum(reach**2 - flat**2, 0.0)
        )
        need = np.maximum(need, p_W[:, hip, 2] - highest)
    drop = _calc_smooth_drop(need, round(0.08 / dt))
    legs = {
        LANDMARK_INDEX[f"{side}_{name}"]
        for side in ("left", "right")
        for name in _LEG_NAMES
    }
    body = [i for i in range(len(LANDMARKS)) if i not in legs]
    p_W[:, body, 2] -= drop[:, None]
    for side in ("left", "right"):
        hip, knee, ankle, toe, heel = (
            LANDMARK_INDEX[f"{side}_{name}"]
            for name in ("hip", "knee", "ankle", "toe", "heel")
        )
        bend_G = p_G[:, knee] - 0.5 * (p_G[:, hip] + p_G[:, ankle])
        # Nearly straight knees say little: lend them the foot's direction.
        lent = (p_G[:, toe] - p_G[:, heel]) * [1.0, 1.0, 0.0]
        bend_G = bend_G + 0.1 * lent
        middle = path.calc_direction(
            s + 0.5 * stretch * p_G[:, ankle, 0], half_step
        )
        bend_W = lay(np.zeros((rows, 2)), middle, *bend_G.T)
        p_W[:, knee] = solve_knee(
            p_W[:, hip], p_W[:, ankle], *bones[side], bend_W
        )
    return make_motion(landmarks=p_W, dt=dt, loops=True, stature=gait.stature)


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
