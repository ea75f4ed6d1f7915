"""A motion-capture recording as the person's motion.

`read_bvh` reads the file, `make_performance` finds the person in it, and
`make_bvh_motion` places that person in one of three ways.
"""

import dataclasses as dc
import itertools
import math
from typing import ClassVar

import numpy as np

from tofssm_drake.errors import UserError, prefix_errors, require
from tofssm_drake.people.bvh_file import read_bvh
from tofssm_drake.people.figure_eight import (
    FARTHEST,
    FigureEight,
    FigureEightPath,
    is_position,
)
from tofssm_drake.people.motion import HumanMotion, make_motion
from tofssm_drake.people.performance import (
    UNITS,
    UPS,
    Performance,
    calc_facing,
    calc_lowest,
    make_performance,
    plant_feet,
    read_units,
)
from tofssm_drake.people.skeleton import (
    FOOT_RADIUS,
    LANDMARK_INDEX,
    PARENTS,
    normalize,
)
from tofssm_drake.people.walk import (
    DOWN,
    Gait,
    calc_cycle_slip,
    calc_slip,
    carry_gait,
    ease,
    find_longest_run,
    smooth,
)

_STOPPING_TIME = 0.08
"""s; how fast limbs come to rest where a recording ends."""

# No recording is longer than a day, s.
_LONGEST = 86400.0

PLACEMENTS = ("in_place", "own_path", "figure_eight")


@dc.dataclass(kw_only=True)
class BvhRecording:
    """A person who moves as in a recording."""

    # The BVH file.
    filename: str = ""

    PATHS: ClassVar[tuple[str, ...]] = ("filename",)

    # Unit of length in the file: "m", "ft", "inch", "cm", "mm", "cgspeed"
    # (inch / 0.45, as in the usual conversions of the CMU database), a number
    # of metres per unit, or "auto": the one that makes an adult.
    units: str = "auto"

    # The file's vertical axis: "y", "z", "x", one of these with a minus, or
    # "auto": from feet to head.
    up: str = "auto"

    # "in_place": on the spot; "own_path": along the recorded path;
    # "figure_eight": the recorded stride, carried along the figure.
    placement: str = "figure_eight"

    # Where the person starts (in_place: stays), [x, y] in world, m, for
    # in_place and own_path. *Assumed.*
    position: list[float] = dc.field(default_factory=lambda: [1.15, 1.5])

    # Where the person faces at the start, degrees from world x, for in_place
    # and own_path. *Assumed.*
    heading_deg: float = -90.0

    # For in_place and own_path: True goes back to the start in a smooth
    # transition and begins again; False holds the last posture.
    loop: bool = False

    # The part of the recording to use, s; end_time null: up to its end.
    start_time: float = 0.0
    end_time: float | None = None

    # Walking speed along the figure of eight, m/s; null: the recording's own.
    speed: float | None = None

    # The path, for figure_eight.
    figure_eight: FigureEight = dc.field(default_factory=FigureEight)

    def check(self, where: str):
        """Raises UserError where a value is out of range.

        Args:
            where: What the user calls this, for the message.
        """
        require(
            bool(self.filename),
            f"{where}.filename: is empty, should name a BVH file",
        )
        require(
            self.units == "auto" or read_units(self.units) is not None,
            f"{where}.units: '{self.units}' should be auto, "
            f"{', '.join(UNITS)} or metres per unit",
        )
        require(
            self.up in ("auto", *UPS),
            f"{where}.up: '{self.up}' should be auto, {', '.join(UPS)}",
        )
        require(
            self.placement in PLACEMENTS,
            f"{where}.placement: '{self.placement}' should be "
            f"{', '.join(PLACEMENTS)}",
        )
        require(
            is_position(self.position),
            f"{where}.position: {self.position} should be two numbers [x, y] "
            f"from {-FARTHEST:g} to {FARTHEST:g} m",
        )
        require(
            -360.0 <= self.heading_deg <= 360.0,
            f"{where}.heading_deg: {self.heading_deg} should be from -360 to "
            "360 deg",
        )
        require(
            0.0 <= self.start_time <= _LONGEST,
            f"{where}.start_time: {self.start_time} should be from 0 to "
            f"{_LONGEST:g} s",
        )
        require(
            self.end_time is None
            or self.start_time < self.end_time <= _LONGEST,
            f"{where}.end_time: {self.end_time} should be after start_time "
            f"{self.start_time} and at most {_LONGEST:g} s",
        )
        require(
            self.speed is None or 0.2 <= self.speed <= 2.2,
            f"{where}.speed: {self.speed} should be from 0.2 to 2.2 m/s",
        )
        self.figure_eight.check(f"{where}.figure_eight")

    def make_motion(self, period: float, where: str = "people") -> HumanMotion:
        """Returns the motion; period: control tick, s; where: see `check`."""
        self.check(where)
        with prefix_errors(f"{where}.filename"):
            return make_bvh_motion(self, period)


def _norm(vector):
    return np.linalg.norm(vector, axis=-1)


def _turn(points, angle):
    """Rotates about z by angles; points (T, l, 3), angle scalar or (T,)."""
    c = np.cos(angle)
    s = np.sin(angle)
    if np.ndim(angle):
        c, s = c[:, None], s[:, None]
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def _calc_lengths(landmarks):
    return {
        child: float(
            np.median(
                _norm(
                    landmarks[:, LANDMARK_INDEX[child]]
                    - landmarks[:, LANDMARK_INDEX[parent]]
                )
            )
        )
        for child, parent in PARENTS.items()
    }


def _restore_lengths(landmarks, lengths):
    """Restores the bones' lengths in blended postures, pelvis outwards."""
    result = landmarks.copy()
    for child, parent in PARENTS.items():
        i, j = LANDMARK_INDEX[child], LANDMARK_INDEX[parent]
        axis = normalize(landmarks[:, i] - landmarks[:, j])
        result[:, i] = result[:, j] + lengths[child] * axis
    return result


def _wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _calc_heading(landmarks):
    facing = calc_facing(landmarks)
    return np.unwrap(np.arctan2(facing[:, 1], facing[:, 0]))


def _close_loop(landmarks, dt, stature):
    """Appends a way back from the last posture to the first.

    Place, heading and posture leave and arrive with the recording's own
    velocities, no faster than a walk.
    """
    if len(landmarks) < 2:
        return landmarks
    pelvis = landmarks[:, 0] * [1.0, 1.0, 0.0]
    heading = _calc_heading(landmarks)
    local = _turn(landmarks - pelvis[:, None], -heading)
    distance = float(_norm(pelvis[-1] - pelvis[0]))
    turn = _wrap(heading[0] - heading[-1])
    duration = max(1.0, 1.5 * distance / 1.2, abs(turn) / 2.0)
    rows = max(2, round(duration / dt))
    k = np.arange(1, rows)

    def blend(values, first, second):
        # Either end runs out with its own velocity, as a person stops; in
        # between, one fades into the other.
        shape = (-1, *[1] * np.ndim(first))
        stop = _STOPPING_TIME / dt
        after = stop * (1.0 - np.exp(-k / stop)).reshape(shape)
        before = stop * (1.0 - np.exp(-(rows - k) / stop)).reshape(shape)
        weight = ease(k / rows).reshape(shape)
        return (1 - weight) * (
            first + after * (values[-1] - values[-2])
        ) + weight * (second - before * (values[1] - values[0]))

    place = blend(pelvis, pelvis[-1], pelvis[0])
    angle = blend(heading, heading[-1], heading[-1] + turn)
    posture = blend(local, local[-1], local[0])
    back = _turn(posture, angle) + place[:, None]
    back = _restore_lengths(back, _calc_lengths(landmarks))
    sunk = np.maximum(FOOT_RADIUS * stature - calc_lowest(back), 0.0)
    back[:, :, 2] += sunk[:, None]
    return np.concatenate([landmarks, back])


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Travel:
    """How the person of a recording moves over the floor, row by row."""

    pelvis: np.ndarray
    """Position on the floor, m, shape (T, 2)."""
    speed: np.ndarray
    """Smoothed, m/s, shape (T,)."""
    direction: np.ndarray
    """Unit vectors, shape (T, 2)."""
    walking: np.ndarray
    """Whether the person walks, shape (T,)."""


def find_gait(performance: Performance, dt: float) -> Gait | None:
    """Finds the stride in a recording that best repeats itself.

    A stride goes from one moment at which the left ankle passes the right
    one to the next such moment.

    Args:
        performance: The recording.
        dt: Time from row to row, s.

    Returns:
        The stride; None where nobody walks.
    """
    landmarks = performance.landmarks
    stature = performance.stature
    if len(landmarks) < 3:
        return None
    pelvis = landmarks[:, 0, :2]
    if _norm(pelvis - pelvis[0]).max() < 0.5 * stature:
        # On the spot, as on a treadmill: the feet show the way covered.
        landmarks = landmarks.copy()
        plant_feet(landmarks, dt)
    travel = _calc_travel(landmarks, dt)
    strides = _list_strides(landmarks, travel, stature, dt)
    if not strides:
        return None
    i, j = min(strides, key=lambda ij: _calc_mismatch(landmarks, travel, *ij))
    way = travel.pelvis[j] - travel.pelvis[i]
    length = float(_norm(way))
    cycle = _cut_cycle(landmarks, i, j, way)
    for side in ("left", "right"):
        slip = _norm(calc_slip(landmarks, side, dt)[i:j])
        # Feet that skate still move more slowly the longer they are down.
        pace = length / ((j - i) * dt)
        down = slip < max(DOWN * pace, np.quantile(slip, 0.45))
        _settle_foot(cycle, side, down, length, FOOT_RADIUS * stature, dt)
    return Gait(
        landmarks=cycle,
        stride=length,
        period=(j - i) * dt,
        stature=stature,
    )


def _calc_travel(landmarks, dt):
    pelvis = landmarks[:, 0, :2]
    velocity = smooth(np.gradient(pelvis, dt, axis=0), round(0.4 / dt))
    speed = _norm(velocity)
    return _Travel(
        pelvis=pelvis,
        speed=speed,
        direction=normalize(velocity),
        walking=speed > max(0.3, 0.6 * np.quantile(speed, 0.9)),
    )


def _list_strides(landmarks, travel, stature, dt):
    """Returns first and last row of every complete stride of walking."""
    span = (
        landmarks[:, LANDMARK_INDEX["left_ankle"], :2]
        - landmarks[:, LANDMARK_INDEX["right_ankle"], :2]
    )
    lead = np.sum(span * travel.direction, axis=-1)
    walking = travel.walking
    passing = [
        k
        for k in range(1, len(lead))
        if lead[k - 1] < 0.0 <= lead[k] and walking[k]
    ]
    return [
        (i, j)
        for i, j in itertools.pairwise(passing)
        if 0.5 <= (j - i) * dt <= 2.5
        and walking[i:j].all()
        and min(lead[i:j].max(), -lead[i:j].min()) >= 0.06 * stature
    ]


def _calc_mismatch(landmarks, travel, i, j):
    """Returns how badly a stride from row i to row j repeats itself."""
    way = travel.pelvis[j] - travel.pelvis[i]
    ends = landmarks[[i, j]].copy()
    ends[:, :, :2] -= travel.pelvis[[i, j]][:, None]
    ends = _turn(ends, -math.atan2(way[1], way[0]))
    gap = float(_norm(ends[1] - ends[0]).max())
    bend = _wrap(
        math.atan2(*travel.direction[j][::-1])
        - math.atan2(*travel.direction[i][::-1])
    )
    hurry = abs(math.log(travel.speed[j] / travel.speed[i]))
    return gap + 0.3 * abs(bend) + 0.3 * hurry


def _cut_cycle(landmarks, i, j, way):
    """Returns rows i to j in G so that the end runs into the beginning.

    What follows the stride fades into its beginning.
    """
    fade = min((j - i) // 3, len(landmarks) - j)
    rows = landmarks[i : j + fade].copy()
    rows[:, :, :2] -= landmarks[i, 0, :2]
    rows = _turn(rows, -math.atan2(way[1], way[0]))
    phase = np.arange(len(rows)) / (j - i)
    rows[:, :, 0] -= float(_norm(way)) * phase[:, None]
    cycle = rows[: j - i]
    weight = ease(1.0 - np.arange(fade) / fade)[:, None, None]
    cycle[:fade] += weight * (rows[j - i :] - cycle[:fade])
    cycle[:, :, :2] -= cycle[:, :1, :2].mean(axis=0)
    return _restore_lengths(cycle, _calc_lengths(landmarks))


def _smooth_periodic(values, width):
    half = max(1, min(width, len(values) // 4)) // 2
    return np.mean(
        [np.roll(values, k, axis=0) for k in range(-half, half + 1)], axis=0
    )


def _settle_foot(cycle, side, down, stride, sole, dt):
    """Makes a foot of a stride stand on the floor, and stand still.

    While it is down, the point that touches the floor (heel, toe or both) is
    kept where it is; in the air the foot moves on to the next such place. The
    knee is solved later.

    Args:
        cycle: Landmarks of a stride in G, changed in place, (N, l, 3).
        side: "left" or "right".
        down: Whether the foot is on the floor, shape (N,).
        stride: Length of the stride, m.
        sole: Height of heel and toe of a foot that stands, m.
        dt: Time from row to row, s.
    """
    start, length = find_longest_run(down)
    if length == 0:
        return
    count = len(cycle)
    foot = [LANDMARK_INDEX[f"{side}_{n}"] for n in ("heel", "toe", "ankle")]
    k = np.arange(count)
    slip = np.roll(calc_cycle_slip(cycle, side, stride, dt), -start, axis=0)
    sunk = np.roll(cycle[:, foot[:2], 2].min(axis=1) - sole, -start)
    ramp = max(2, round(0.04 / dt))
    hold = ease(np.clip(np.minimum(k + 1, length - k) / ramp, 0.0, 1.0))
    shift = -np.cumsum(hold[:, None] * slip * dt, axis=0)
    rest = np.clip((k - length + 1) / (count - length + 1), 0.0, 1.0)
    shift = shift * (1.0 - ease(rest))[:, None]
    shift -= shift[:length].mean(axis=0)
    drop = np.where(
        k < length,
        -sunk,
        -sunk[length - 1] + ease(rest) * (sunk[length - 1] - sunk[0]),
    )
    drop = np.maximum(_smooth_periodic(drop, round(0.05 / dt)), -sunk)
    move = np.roll(np.column_stack([shift, drop]), start, axis=0)
    cycle[:, foot] += move[:, None]


def make_bvh_motion(config: BvhRecording, dt: float) -> HumanMotion:
    """Makes the motion of a recorded person.

    Args:
        config: Which recording, and how to place it.
        dt: Time from row to row, s.

    Returns:
        The motion. It loops on the figure of eight and with `loop`.

    Raises:
        UserError: A setting is out of range, or the file cannot be used; the
            message names the setting, or the file and its line.
    """
    config.check("bvh_recording")
    file = read_bvh(config.filename)
    performance = make_performance(
        file,
        dt,
        units=config.units,
        up=config.up,
        start_time=config.start_time,
        end_time=config.end_time,
    )
    if config.placement == "figure_eight":
        gait = find_gait(performance, dt)
        if gait is None:
            raise UserError(
                f"{file.path}:{file.joints[0].line}: nobody walks in this "
                "recording; placement figure_eight needs two steps in a row, "
                "in_place or own_path would be right"
            )
        return carry_gait(
            gait=gait,
            path=FigureEightPath(config=config.figure_eight),
            speed=config.speed or gait.stride / gait.period,
            dt=dt,
            any_stride=False,
        )
    landmarks = _place(performance.landmarks, config, dt)
    if config.loop:
        landmarks = _close_loop(landmarks, dt, performance.stature)
    return make_motion(
        landmarks=landmarks,
        dt=dt,
        loops=config.loop,
        stature=performance.stature,
    )


def _place(landmarks, config, dt):
    """Moves a recording to its position and heading in the cell."""
    beginning = landmarks[: max(1, round(0.25 / dt))]
    facing = calc_facing(beginning).mean(axis=0)
    turn = math.radians(config.heading_deg) - math.atan2(facing[1], facing[0])
    origin = landmarks[:1, :1] * [1.0, 1.0, 0.0]
    if config.placement == "in_place":
        origin = landmarks[:, :1] * [1.0, 1.0, 0.0]
    landmarks = _turn(landmarks - origin, turn)
    landmarks[:, :, :2] += config.position
    return landmarks
