"""From the joints of a recording to a person.

Roles are found by name, the vertical by posture, the unit by stature, the
floor by where feet come to rest.
"""

import dataclasses as dc
import math
import re

import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.human.bvh_file import BvhFile
from tofssm_drake.human.bvh_kinematics import calc_positions
from tofssm_drake.human.skeleton import (
    ANKLE_HEIGHT,
    FOOT_RADIUS,
    HEEL_LENGTH,
    KNUCKLE_LENGTH,
    LANDMARK_INDEX,
    LANDMARKS,
    SHOULDER_HEIGHT,
    normalize,
)
from tofssm_drake.human.walk import smooth, solve_knee

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
"""What the joint at the near end of each bone is called; the first that the
file has is taken, so that LeftShoulder is the collar where there is a
LeftArm."""

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

    Where on the floor, and facing where, is still the recording's own.
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
    """LeftUpLeg, mixamorig:LeftUpLeg, l_upleg, Bip01 L UpLeg: into words."""
    name = name.rsplit(":", 1)[-1].rsplit("|", 1)[-1]
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return [word.lower() for word in words]


_NOISE = ("joint", "jnt", "jt", "bone", "bend")


def _trim(words):
    """Without numbers and the like at the end."""
    words = list(words)
    while len(words) > 1 and (words[-1].isdecimal() or words[-1] in _NOISE):
        words.pop()
    return words


def _list_readings(words):
    """Joins the words to (side, rest) in every way that may be meant."""
    for start in range(len(words)):
        text = "".join(words[start:])
        for side, marks in (("left", ("left", "l")), ("right", ("right", "r"))):
            for mark in marks:
                if text.startswith(mark):
                    yield side, text[len(mark) :]
                if text.endswith(mark):
                    yield side, text[: -len(mark)]


def find_roles(names: list[str]) -> dict[str, int]:
    """Finds which joint is which limb's, by the usual names.

    Args:
        names: Of the joints, parents first.

    Returns:
        Joint index by role, e.g. left_knee; only those found.
    """
    words = [_split_words(name) for name in names]
    found = {}
    # Plain names first: LHipJoint is no LeftHip where there is one.
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
        # Some skeletons have ankle and foot: that foot is at the toes.
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
    """Indices from the joint itself up to the root."""
    chain = []
    while index >= 0:
        chain.append(index)
        index = file.joints[index].parent
    return chain


def _get_up_matrix(up):
    """Rotates the file's axes so that `up` becomes z."""
    cyclic = {"z": (0, 1, 2), "x": (1, 2, 0), "y": (2, 0, 1)}[up[-1]]
    R = np.eye(3)[list(cyclic)]
    if up.startswith("-"):
        R = np.diag([1.0, -1.0, -1.0]) @ R
    return R


def _find_up(span, fail):
    """The axis that points from the feet to the head."""
    typical = np.median(span, axis=0)
    axis = int(np.argmax(np.abs(typical)))
    if abs(typical[axis]) < 0.8 * np.linalg.norm(typical):
        fail(
            "it is not clear which axis is up (the person hardly stands); "
            "give it as up: y or up: z"
        )
    return ("-" if typical[axis] < 0 else "") + "xyz"[axis]


def _find_units(stature, fail):
    """The unit that makes an adult of the stature in file units."""
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
    """A joint beyond the wrist, by which the hand's direction is known."""
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


def _place_feet(p, p_ankle, R_foot, p_toe, facing, stature):
    """Fits sole, heel and toe to one foot; all rigid with it.

    The sole is what is level when ankle and toe are lowest.
    """
    low = p_ankle[:, 2]
    flat = np.flatnonzero(low <= np.quantile(low, 0.25))
    if p_toe is not None:
        toe_low = p_toe[flat, 2]
        flat = flat[toe_low <= np.quantile(toe_low, 0.5)]
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
    p["heel"] = p_ankle + R_foot @ (down - HEEL_LENGTH * stature * ahead)
    p["toe"] = p_ankle + R_foot @ (down + length * ahead)


def _drop_calibration(file):
    """Leaves out a first frame that is a posture of calibration.

    Many conversions put a T-pose before the recording: a jump from the first
    frame to the second that is nowhere near what follows.
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
        UserError: Joints are missing, or the vertical or the unit can not be
            told; the message names the file and the line of its root.
    """

    def fail(message):
        raise UserError(f"{file.path}:{file.joints[0].line}: {message}")

    file = _drop_calibration(file)
    last = file.duration if end_time is None else end_time
    if start_time > file.duration or last > file.duration + 1e-3:
        fail(
            f"the recording lasts {file.duration:.3f} s; start_time and "
            "end_time should lie within"
        )
    roles = find_roles(
        ["" if joint.is_end else joint.name for joint in file.joints]
    )
    for side in ("left", "right"):
        for role in _REQUIRED:
            if f"{side}_{role}" not in roles:
                fail(
                    f"no {side} {role} among the joints; one should be named "
                    f"like {_SAID_AS[role]} with {side.capitalize()} or "
                    f"{side[0].upper()}"
                )
    # Frame times are rounded in the file.
    rows = math.floor((last - start_time) / dt + 1e-3) + 1
    times = start_time + dt * np.arange(rows)
    ankles = tuple(roles[f"{side}_ankle"] for side in ("left", "right"))
    positions, rotations = calc_positions(file, times, ankles)

    def get(role):
        return positions[:, roles[role]]

    def middle(role):
        return 0.5 * (get(f"left_{role}") + get(f"right_{role}"))

    # Stature, from parts that keep their lengths in any posture.
    legs = [
        np.median(_norm(get(f"{s}_{a}") - get(f"{s}_{b}")))
        for s in ("left", "right")
        for a, b in (("hip", "knee"), ("knee", "ankle"))
    ]
    if min(legs) <= 0.0:
        fail("a thigh or shank has no length")
    trunk = np.quantile(_norm(middle("shoulder") - middle("hip")), 0.9)
    stature = (0.5 * sum(legs) + trunk) / (SHOULDER_HEIGHT - ANKLE_HEIGHT)
    if units == "auto":
        scale = _find_units(stature, fail)
    else:
        scale = read_units(units)
        if not _is_stature(stature * scale):
            fail(
                f"units {units} make a person of {stature * scale:.3g} m; "
                "units: auto would be right"
            )
    stature *= scale
    if up == "auto":
        up = _find_up(middle("shoulder") - middle("ankle"), fail)
    R_up = _get_up_matrix(up)
    positions = scale * positions @ R_up.T
    rotations = {j: R_up @ R for j, R in rotations.items()}

    # Trunk: whichever joints of the chain lie where neck and waist are.
    p = {"pelvis": middle("hip")}
    shoulders = middle("shoulder")
    if np.median(_norm(get("left_hip") - get("right_hip"))) < 0.02 * stature:
        fail("left and right hip are in one place")
    if (
        np.median(_norm(get("left_shoulder") - get("right_shoulder")))
        < 0.05 * stature
    ):
        fail("left and right shoulder are in one place")
    trunk_up = normalize(shoulders - p["pelvis"])
    base = shoulders + 0.017 * stature * trunk_up
    head = roles.get("head")
    if head is not None:
        chain = _list_ancestors(file, head)
        p["head"] = positions[:, head]
    else:
        chain = _list_ancestors(
            file, file.joints[roles["left_shoulder"]].parent
        )
        p["head"] = base + 0.05 * stature * trunk_up
    # A joint that is anywhere near serves, as it bends where the person does.
    candidates = chain[1:] if head is not None else chain
    away = [np.median(_norm(positions[:, j] - base)) for j in candidates]
    p["neck"] = base
    if away and min(away) < 0.04 * stature:
        p["neck"] = positions[:, candidates[int(np.argmin(away))]]
    wanted = p["pelvis"] + 0.34 * (p["neck"] - p["pelvis"])
    away = [np.median(_norm(positions[:, j] - wanted)) for j in candidates]
    p["waist"] = wanted
    if away and min(away) < 0.06 * stature:
        p["waist"] = positions[:, candidates[int(np.argmin(away))]]
    axis = normalize(p["head"] - p["neck"])
    if np.median(_norm(p["head"] - p["neck"])) < 0.01 * stature:
        axis = trunk_up
        p["head"] = p["neck"] + 0.05 * stature * axis
    if head is not None:
        ends = [
            j
            for j, joint in enumerate(file.joints)
            if head in _list_ancestors(file, j)[1:]
        ]
        reach = [np.median(positions[:, j, 2] - p["head"][:, 2]) for j in ends]
        if ends and max(reach) > 0.03 * stature:
            crown = positions[:, ends[int(np.argmax(reach))]]
            axis = normalize(crown - p["head"])
    p["head_top"] = p["head"] + 0.115 * stature * axis

    # Limbs.
    for side in ("left", "right"):
        for role in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
            p[f"{side}_{role}"] = get(f"{side}_{role}")
        wrist = roles[f"{side}_wrist"]
        tip = _find_hand(file, positions, wrist, 0.012 * stature)
        if tip is None:
            along = p[f"{side}_wrist"] - p[f"{side}_elbow"]
        else:
            along = positions[:, tip] - positions[:, wrist]
        p[f"{side}_hand"] = p[
            f"{side}_wrist"
        ] + KNUCKLE_LENGTH * stature * normalize(along)
    left = p["left_hip"] - p["right_hip"]
    facing = normalize(np.cross(left, [0.0, 0.0, 1.0]))
    for side in ("left", "right"):
        ankle = roles[f"{side}_ankle"]
        p_toe = None
        if f"{side}_toe" in roles:
            p_toe = get(f"{side}_toe")
            if np.median(_norm(p_toe - get(f"{side}_ankle"))) < (
                0.02 * stature
            ):
                p_toe = None
        foot = {}
        _place_feet(
            foot,
            positions[:, ankle],
            rotations[ankle],
            p_toe,
            facing,
            stature,
        )
        p |= {f"{side}_{name}": value for name, value in foot.items()}
    landmarks = np.stack([p[name] for name in LANDMARKS], axis=1)
    has_position = any(
        kind == "position"
        for j in _list_ancestors(file, roles["left_hip"])
        for kind, _ in file.joints[j].channels
    )
    sole = FOOT_RADIUS * stature
    if has_position:
        landmarks[:, :, 2] += sole - _find_floor(landmarks, dt)
        _lift_feet(landmarks, sole)
    else:
        landmarks[:, :, 2] += sole - calc_lowest(landmarks)[:, None]
        plant_feet(landmarks, dt)
    return Performance(
        landmarks=landmarks, stature=float(stature), units=scale, up=up
    )


_FEET = [
    LANDMARK_INDEX[f"{side}_{name}"]
    for side in ("left", "right")
    for name in ("heel", "toe")
]


def calc_lowest(landmarks: np.ndarray) -> np.ndarray:
    """Returns the height of the lowest heel or toe, m, shape (T,)."""
    return landmarks[:, _FEET, 2].min(axis=1)


def _find_floor(landmarks, dt):
    """Height at which the lowest foot usually comes to rest.

    Not the lowest height ever: toes are recorded as going through the floor
    when someone kneels, and a marker may jump.
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
    """Takes feet that are below the floor up to it; the knees give way."""
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
        # A straight leg says little about where its knee would go.
        bend = bend + 0.05 * (p[:, toe] - p[:, heel])
        p[:, (ankle, heel, toe), 2] += lift[low, None]
        p[:, knee] = solve_knee(p[:, hip], p[:, ankle], thigh, shank, bend)
        landmarks[low] = p


def calc_facing(landmarks: np.ndarray) -> np.ndarray:
    """Returns where hips and shoulders face.

    Args:
        landmarks: Positions in the order of LANDMARKS, m, shape (T, l, 3).

    Returns:
        Horizontal unit vectors, shape (T, 3).
    """
    left = sum(
        normalize(
            landmarks[:, LANDMARK_INDEX[f"left_{name}"]]
            - landmarks[:, LANDMARK_INDEX[f"right_{name}"]]
        )
        for name in ("hip", "shoulder")
    )
    ahead = np.stack([left[:, 1], -left[:, 0], 0 * left[:, 0]], axis=-1)
    return normalize(ahead)


def plant_feet(landmarks: np.ndarray, dt: float) -> None:
    """Moves a person who has no travel so that the lowest foot stands.

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
