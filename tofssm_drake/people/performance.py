"""From the joints of a recording to a person.

Roles are found by name, the vertical by posture, the unit by stature, the
floor by where feet come to rest.
"""

import dataclasses as dc
import itertools
import math
import re

import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.people.bvh_file import BvhFile
from tofssm_drake.people.bvh_kinematics import calc_positions
from tofssm_drake.people.skeleton import (
    ANKLE_HEIGHT,
    FOOT_RADIUS,
    HEEL_LENGTH,
    KNUCKLE_LENGTH,
    LANDMARK_INDEX,
    LANDMARKS,
    SHOULDER_HEIGHT,
    normalize,
)
from tofssm_drake.people.walk import smooth, solve_knee

UNITS = {
    "m": 1.0,
    "ft": 0.3048,
    "cgspeed": 0.0254 / 0.45,
    "inch": 0.0254,
    "cm": 0.01,
    "mm": 0.001,
}
"""Metres per unit. `cgspeed` is the scale of B. Hahn's conversions of the CMU
database: inches divided by 0.45."""

_TYPICAL_STATURE = 1.7
_STATURE_RANGE = (1.0, 2.4)

UPS = ("x", "y", "z", "-x", "-y", "-z")
"""The vertical axes that a file may have."""

_LIMB_ROLES = {
    "hip": (
        "upleg",
        "upperleg",
        "legupper",
        "thigh",
        "femur",
        "hip",
        "hipjoint",
    ),
    "knee": (
        "lowleg",
        "lowerleg",
        "leglower",
        "shin",
        "calf",
        "tibia",
        "knee",
        "leg",
    ),
    "ankle": ("ankle", "foot"),
    "toe": ("toebase", "toe", "toes", "ball", "foottoe", "forefoot"),
    "shoulder": (
        "uparm",
        "upperarm",
        "armupper",
        "humerus",
        "shldr",
        "arm",
        "shoulder",
    ),
    "elbow": (
        "forearm",
        "lowarm",
        "lowerarm",
        "armlower",
        "radius",
        "elbow",
    ),
    "wrist": ("wrist", "hand"),
}
"""Names of the joint at the near end of each bone. The first one that the
file has counts, so that LeftShoulder is the collar where there is a LeftArm."""

_REQUIRED = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")

_SAID_AS = {
    "hip": "UpLeg, Thigh or Hip",
    "knee": "Leg, Shin or Knee",
    "ankle": "Foot or Ankle",
    "shoulder": "Arm, UpperArm or Shoulder",
    "elbow": "ForeArm, LowerArm or Elbow",
    "wrist": "Hand or Wrist",
}


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Performance:
    """A recording as a person: metres, z up, soles on the floor z = 0.

    Place on the floor and heading are still the recording's own.
    """

    landmarks: np.ndarray
    """Positions in the order of LANDMARKS, m, shape (T, l, 3)."""
    stature: float
    """Estimated standing height, m."""
    units: float
    """Metres per unit of the file."""
    up: str
    """The file's vertical axis."""


def read_units(units: str) -> float | None:
    """Returns metres per unit; None if `units` is neither name nor number."""
    if units in UNITS:
        return UNITS[units]
    try:
        value = float(units)
    except ValueError:
        return None
    return value if 0.0 < value < math.inf else None


def _split_words(name):
    """Splits e.g. mixamorig:LeftUpLeg, l_upleg, Bip01 L UpLeg into words."""
    name = name.rsplit(":", 1)[-1].rsplit("|", 1)[-1]
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return [word.lower() for word in words]


_NOISE = ("joint", "jnt", "jt", "bone", "bend")


def _trim(words):
    """Drops numbers and the like at the end."""
    words = list(words)
    while len(words) > 1 and (words[-1].isdecimal() or words[-1] in _NOISE):
        words.pop()
    return words


def _list_readings(words):
    """Yields every possible reading of the words as (side, rest)."""
    for start in range(len(words)):
        text = "".join(words[start:])
        for side, marks in (("left", ("left", "l")), ("right", ("right", "r"))):
            for mark in marks:
                if text.startswith(mark):
                    yield side, text[len(mark) :]
                if text.endswith(mark):
                    yield side, text[: -len(mark)]


def find_roles(names: list[str]) -> dict[str, int]:
    """Finds which joint belongs to which limb, by the usual names.

    Args:
        names: Names of the joints, parents first.

    Returns:
        Joint index by role, e.g. left_knee; only those found.
    """
    words = [_split_words(name) for name in names]
    found: dict[tuple[str, str], int] = {}
    # Plain names first: LHipJoint is not the hip where there is a LeftHip.
    for some_words in (words, [_trim(w) for w in words]):
        for index, reading in enumerate(some_words):
            for side_and_rest in _list_readings(reading):
                found.setdefault(side_and_rest, index)
    roles = {}
    for side in ("left", "right"):
        for role, aliases in _LIMB_ROLES.items():
            for alias in aliases:
                if (side, alias) in found:
                    roles[f"{side}_{role}"] = found[side, alias]
                    break
        # In skeletons with both ankle and foot, the foot is at the toes.
        if (
            f"{side}_toe" not in roles
            and (side, "ankle") in found
            and (side, "foot") in found
        ):
            roles[f"{side}_toe"] = found[side, "foot"]
    for index, some_words in enumerate(words):
        if _trim(some_words)[-1:] in (["head"], ["skull"]):
            roles.setdefault("head", index)
    return roles


def _list_ancestors(file, index):
    """Returns indices from the joint itself up to the root."""
    chain = []
    while index >= 0:
        chain.append(index)
        index = file.joints[index].parent
    return chain


def _get_up_matrix(up):
    """Returns the rotation of the file's axes that makes `up` z."""
    cyclic = {"z": (0, 1, 2), "x": (1, 2, 0), "y": (2, 0, 1)}[up[-1]]
    R = np.eye(3)[list(cyclic)]
    if up.startswith("-"):
        R = np.diag([1.0, -1.0, -1.0]) @ R
    return R


def _find_up(span, fail):
    """Returns the axis that points from the feet to the head."""
    typical = np.median(span, axis=0)
    axis = int(np.argmax(np.abs(typical)))
    if abs(typical[axis]) < 0.8 * np.linalg.norm(typical):
        fail(
            "it is not clear which axis is up (the person hardly stands); "
            "give it as up: y or up: z"
        )
    return ("-" if typical[axis] < 0 else "") + "xyz"[axis]


def _find_units(stature, fail):
    """Returns the unit in which the stature is that of an adult."""
    name = min(
        UNITS,
        key=lambda n: abs(math.log(stature * UNITS[n] / _TYPICAL_STATURE)),
    )
    if not _is_stature(stature * UNITS[name]):
        fail(
            f"a stature of {stature:.3g} is that of an adult in no usual "
            "unit; give units as metres per unit"
        )
    return UNITS[name]


def _is_stature(stature):
    return _STATURE_RANGE[0] <= stature <= _STATURE_RANGE[1]


def _norm(vector):
    return np.linalg.norm(vector, axis=-1)


def _find_hand(file, positions, wrist, smallest):
    """Returns a joint beyond the wrist, which gives the hand's direction."""
    beyond = [wrist]
    best = None
    for j in range(wrist + 1, len(file.joints)):
        joint = file.joints[j]
        if joint.parent not in beyond:
            continue
        if "thumb" in joint.name.lower():
            continue
        beyond.append(j)
        reach = np.median(_norm(positions[:, j] - positions[:, wrist]))
        if best is None and reach > smallest:
            best = j
    return best


def _drop_calibration(file):
    """Leaves out a first frame that is a calibration posture.

    Many conversions put a T-pose before the recording. It shows as a jump from
    the first frame to the second, far larger than any that follows.
    """
    count = min(len(file.frames), 12)
    if count < 4:
        return file
    positions, _ = calc_positions(file, file.frame_time * np.arange(count))
    size = np.ptp(positions[0], axis=0).max()
    local = positions - positions[:, :1]
    step = _norm(np.diff(local, axis=0)).max(axis=1)
    if step[0] < 0.1 * size or step[0] < 5.0 * step[1:].max():
        return file
    return dc.replace(file, frames=file.frames[1:])


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Recording:
    """Joints of a person in metres, z up, with their roles."""

    file: BvhFile
    roles: dict[str, int]
    """Joint index by role."""
    positions: np.ndarray
    """Of all joints, shape (T, J, 3)."""
    rotations: dict[int, np.ndarray]
    """Of the ankles, shape (T, 3, 3) each, by joint index."""
    stature: float
    """Standing height, m."""
    units: float
    """Metres per unit of the file."""
    up: str
    """The file's vertical axis."""

    def get(self, role):
        """Returns where the joint of a role is, (T, 3)."""
        return self.positions[:, self.roles[role]]

    def middle(self, role):
        """Returns the middle between left and right, (T, 3)."""
        return 0.5 * (self.get(f"left_{role}") + self.get(f"right_{role}"))


def _make_fail(file):
    def fail(message):
        raise UserError(f"{file.path}:{file.joints[0].line}: {message}")

    return fail


def make_performance(
    file: BvhFile,
    dt: float,
    *,
    units: str = "auto",
    up: str = "auto",
    start_time: float = 0.0,
    end_time: float | None = None,
) -> Performance:
    """Turns a file into a person: roles, vertical, unit, floor, feet.

    Args:
        file: The file.
        dt: Time from row to row, s.
        units: As in BvhRecording.
        up: As in BvhRecording.
        start_time: First moment to use, s.
        end_time: Last moment to use, s; None: the end.

    Returns:
        The person at every dt.

    Raises:
        UserError: Joints are missing, or the vertical or the unit cannot be
            determined; the message names the file and the line of its root.
    """
    file = _drop_calibration(file)
    times = _list_times(file, dt, start_time, end_time)
    recording = _normalize_recording(
        _pose_recording(file, times), units=units, up=up
    )
    point = _place_trunk(recording)
    for side in ("left", "right"):
        point |= _place_limbs(recording, side)
    facing = normalize(
        np.cross(point["left_hip"] - point["right_hip"], [0.0, 0.0, 1.0])
    )
    for side in ("left", "right"):
        point |= _place_foot(recording, side, facing)
    landmarks = np.stack([point[name] for name in LANDMARKS], axis=1)
    _stand_on_floor(landmarks, recording, dt)
    return Performance(
        landmarks=landmarks,
        stature=float(recording.stature),
        units=recording.units,
        up=recording.up,
    )


def _list_times(file, dt, start_time, end_time):
    """Returns the times of the rows, s, (T,)."""
    last = file.duration if end_time is None else end_time
    if start_time > file.duration or last > file.duration + 1e-3:
        _make_fail(file)(
            f"the recording lasts {file.duration:.3f} s; start_time and "
            "end_time should lie within"
        )
    # Frame times are rounded in the file.
    rows = math.floor((last - start_time) / dt + 1e-3) + 1
    return start_time + dt * np.arange(rows)


def _pose_recording(file, times):
    """Returns the recording in the file's own unit and axes.

    `stature` is estimated, in that unit, from parts that keep their lengths
    in any posture.
    """
    fail = _make_fail(file)
    roles = find_roles(
        ["" if joint.is_end else joint.name for joint in file.joints]
    )
    for side, role in itertools.product(("left", "right"), _REQUIRED):
        if f"{side}_{role}" not in roles:
            fail(
                f"no {side} {role} among the joints; one should be named "
                f"like {_SAID_AS[role]} with {side.capitalize()} or "
                f"{side[0].upper()}"
            )
    ankles = tuple(roles[f"{side}_ankle"] for side in ("left", "right"))
    positions, rotations = calc_positions(file, times, ankles)
    recording = _Recording(
        file=file,
        roles=roles,
        positions=positions,
        rotations=rotations,
        stature=math.nan,
        units=1.0,
        up="z",
    )
    get, middle = recording.get, recording.middle
    legs = [
        np.median(_norm(get(f"{s}_{a}") - get(f"{s}_{b}")))
        for s in ("left", "right")
        for a, b in (("hip", "knee"), ("knee", "ankle"))
    ]
    if min(legs) <= 0.0:
        fail("a thigh or shank has no length")
    trunk = np.quantile(_norm(middle("shoulder") - middle("hip")), 0.9)
    stature = (0.5 * sum(legs) + trunk) / (SHOULDER_HEIGHT - ANKLE_HEIGHT)
    return dc.replace(recording, stature=stature)


def _normalize_recording(recording, *, units, up):
    """Returns the recording in metres with z up."""
    fail = _make_fail(recording.file)
    stature = recording.stature
    if units == "auto":
        scale = _find_units(stature, fail)
    else:
        scale = read_units(units)
        if not _is_stature(stature * scale):
            fail(
                f"units {units} make a person of {stature * scale:.3g} m; "
                "units: auto would be right"
            )
    if up == "auto":
        span = recording.middle("shoulder") - recording.middle("ankle")
        up = _find_up(span, fail)
    R_up = _get_up_matrix(up)
    return dc.replace(
        recording,
        positions=scale * recording.positions @ R_up.T,
        rotations={j: R_up @ R for j, R in recording.rotations.items()},
        stature=stature * scale,
        units=scale,
        up=up,
    )


def _place_trunk(recording):
    """Returns pelvis, waist, neck, head and its top by name.

    A joint of the spine that is near a landmark serves as it, because it
    bends where the person does; else the landmark is on a straight line.
    """
    stature = recording.stature
    _require_width(recording, "hip", 0.02)
    _require_width(recording, "shoulder", 0.05)
    pelvis, shoulders = recording.middle("hip"), recording.middle("shoulder")
    trunk_up = normalize(shoulders - pelvis)
    base = shoulders + 0.017 * stature * trunk_up
    head = recording.roles.get("head")
    if head is not None:
        spine = _list_ancestors(recording.file, head)[1:]
    else:
        collar = recording.file.joints[recording.roles["left_shoulder"]].parent
        spine = _list_ancestors(recording.file, collar)
    neck = _find_near(recording, spine, base, 0.04)
    wanted = pelvis + 0.34 * (neck - pelvis)
    point = {
        "pelvis": pelvis,
        "waist": _find_near(recording, spine, wanted, 0.06),
        "neck": neck,
    }
    if head is not None:
        p_head = recording.positions[:, head]
    else:
        p_head = base + 0.05 * stature * trunk_up
    axis = normalize(p_head - neck)
    if np.median(_norm(p_head - neck)) < 0.01 * stature:
        axis = trunk_up
        p_head = neck + 0.05 * stature * axis
    crown = None if head is None else _find_crown(recording, head, p_head)
    if crown is not None:
        axis = normalize(crown - p_head)
    point["head"] = p_head
    point["head_top"] = p_head + 0.115 * stature * axis
    return point


def _require_width(recording, role, least):
    """Fails if left and right are nearer than a fraction of the stature."""
    span = recording.get(f"left_{role}") - recording.get(f"right_{role}")
    if np.median(_norm(span)) < least * recording.stature:
        _make_fail(recording.file)(f"left and right {role} are in one place")


def _find_near(recording, joints, wanted, farthest):
    """Returns the joint nearest to a landmark, or the landmark itself, (T, 3).

    The latter if no joint is within a fraction of the stature.
    """
    away = [
        np.median(_norm(recording.positions[:, j] - wanted)) for j in joints
    ]
    if away and min(away) < farthest * recording.stature:
        return recording.positions[:, joints[int(np.argmin(away))]]
    return wanted


def _find_crown(recording, head, p_head):
    """Returns the highest joint beyond the head, (T, 3), if there is any."""
    file, positions = recording.file, recording.positions
    beyond = [
        j
        for j in range(len(file.joints))
        if head in _list_ancestors(file, j)[1:]
    ]
    rise = [np.median(positions[:, j, 2] - p_head[:, 2]) for j in beyond]
    if not beyond or max(rise) <= 0.03 * recording.stature:
        return None
    return positions[:, beyond[int(np.argmax(rise))]]


def _place_limbs(recording, side):
    """Returns the joints of one arm and one leg and the knuckles by name."""
    point = {
        f"{side}_{role}": recording.get(f"{side}_{role}") for role in _REQUIRED
    }
    p_wrist = point[f"{side}_wrist"]
    tip = _find_hand(
        recording.file,
        recording.positions,
        recording.roles[f"{side}_wrist"],
        0.012 * recording.stature,
    )
    if tip is None:
        along = p_wrist - point[f"{side}_elbow"]
    else:
        along = recording.positions[:, tip] - p_wrist
    length = KNUCKLE_LENGTH * recording.stature
    point[f"{side}_hand"] = p_wrist + length * normalize(along)
    return point


def _place_foot(recording, side, facing):
    """Returns heel and toe of one foot by name; both are rigid with it."""
    stature = recording.stature
    p_ankle = recording.get(f"{side}_ankle")
    p_toe = None
    if f"{side}_toe" in recording.roles:
        p_toe = recording.get(f"{side}_toe")
        if np.median(_norm(p_toe - p_ankle)) < 0.02 * stature:
            p_toe = None
    R_foot = recording.rotations[recording.roles[f"{side}_ankle"]]
    flat = _find_flat(p_ankle, p_toe)
    R_flat = R_foot[flat]
    up = normalize(R_flat[:, 2, :].mean(axis=0))
    if p_toe is not None:
        span = p_toe[flat] - p_ankle[flat]
    else:
        span = 0.09 * stature * facing[flat]
    ahead = np.einsum("tji,tj->ti", R_flat, span).mean(axis=0)
    height = max(
        ANKLE_HEIGHT * stature,
        -float(up @ ahead) + 0.6 * FOOT_RADIUS * stature,
    )
    ahead = ahead - (up @ ahead) * up
    length = float(np.clip(_norm(ahead), 0.072 * stature, 0.12 * stature))
    ahead = normalize(ahead)
    down = (FOOT_RADIUS * stature - height) * up
    return {
        f"{side}_heel": p_ankle
        + R_foot @ (down - HEEL_LENGTH * stature * ahead),
        f"{side}_toe": p_ankle + R_foot @ (down + length * ahead),
    }


def _find_flat(p_ankle, p_toe):
    """Returns rows in which ankle and toe are lowest: the sole is level."""
    low = p_ankle[:, 2]
    flat = np.flatnonzero(low <= np.quantile(low, 0.25))
    if p_toe is not None:
        toe_low = p_toe[flat, 2]
        flat = flat[toe_low <= np.quantile(toe_low, 0.5)]
    return flat


def _stand_on_floor(landmarks, recording, dt):
    """Puts the soles on z = 0; changes landmarks."""
    has_position = any(
        kind == "position"
        for j in _list_ancestors(recording.file, recording.roles["left_hip"])
        for kind, _ in recording.file.joints[j].channels
    )
    sole = FOOT_RADIUS * recording.stature
    if has_position:
        landmarks[:, :, 2] += sole - _find_floor(landmarks, dt)
        _lift_feet(landmarks, sole)
    else:
        landmarks[:, :, 2] += sole - calc_lowest(landmarks)[:, None]
        plant_feet(landmarks, dt)


_FEET = [
    LANDMARK_INDEX[f"{side}_{name}"]
    for side in ("left", "right")
    for name in ("heel", "toe")
]


def calc_lowest(landmarks: np.ndarray) -> np.ndarray:
    """Returns the height of the lowest heel or toe, m, shape (T,)."""
    return landmarks[:, _FEET, 2].min(axis=1)


def _find_floor(landmarks, dt):
    """Returns the height at which the lowest foot usually comes to rest.

    Not the lowest height of all: recorded toes go through the floor when
    someone kneels, and a marker may jump.
    """
    feet = landmarks[:, _FEET]
    lowest = np.argmin(feet[:, :, 2], axis=1)
    rows = np.arange(len(feet))
    height = feet[rows, lowest, 2]
    if len(feet) < 2:
        return height[0]
    speed = _norm(np.gradient(feet[:, :, :2], dt, axis=0))[rows, lowest]
    return np.median(height[speed <= np.quantile(speed, 0.5)])


def _lift_feet(landmarks, sole):
    """Lifts feet that are below the floor up to it; the knees bend."""
    for side in ("left", "right"):
        hip, knee, ankle, heel, toe = (
            LANDMARK_INDEX[f"{side}_{name}"]
            for name in ("hip", "knee", "ankle", "heel", "toe")
        )
        lift = sole - landmarks[:, (heel, toe), 2].min(axis=1)
        low = np.flatnonzero(lift > 0.0)
        if not len(low):
            continue
        p = landmarks[low]
        thigh = float(np.median(_norm(p[:, knee] - p[:, hip])))
        shank = float(np.median(_norm(p[:, ankle] - p[:, knee])))
        bend = p[:, knee] - 0.5 * (p[:, hip] + p[:, ankle])
        # A straight leg does not show which way its knee bends.
        bend = bend + 0.05 * (p[:, toe] - p[:, heel])
        p[:, (ankle, heel, toe), 2] += lift[low, None]
        p[:, knee] = solve_knee(p[:, hip], p[:, ankle], thigh, shank, bend)
        landmarks[low] = p


def calc_facing(landmarks: np.ndarray) -> np.ndarray:
    """Returns the direction that hips and shoulders face.

    Args:
        landmarks: Positions in the order of LANDMARKS, m, shape (T, l, 3).

    Returns:
        Horizontal unit vectors, shape (T, 3).
    """
    hips, shoulders = (
        normalize(
            landmarks[:, LANDMARK_INDEX[f"left_{name}"]]
            - landmarks[:, LANDMARK_INDEX[f"right_{name}"]]
        )
        for name in ("hip", "shoulder")
    )
    left = hips + shoulders
    ahead = np.stack([left[:, 1], -left[:, 0], 0 * left[:, 0]], axis=-1)
    return normalize(ahead)


def plant_feet(landmarks: np.ndarray, dt: float) -> None:
    """Moves a person recorded on the spot so that the lowest foot stands.

    Args:
        landmarks: Positions in the order of LANDMARKS, m, changed in place,
            shape (T, l, 3).
        dt: Time from row to row, s.
    """
    feet = landmarks[:, _FEET]
    lowest = np.argmin(feet[:-1, :, 2], axis=1)
    step = np.diff(feet[:, :, :2], axis=0)
    back = step[np.arange(len(step)), lowest]
    back = smooth(back, round(0.1 / dt)) if len(back) else back
    travel = np.concatenate([np.zeros((1, 2)), -np.cumsum(back, axis=0)])
    landmarks[:, :, :2] += travel[:, None, :]
