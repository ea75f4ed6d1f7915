"""A motion-capture recording as the person's motion.

From a BVH file to a table of landmarks in metres, z up, on the floor: the
joints' roles are found by name, the vertical by posture, the unit by stature.
Then one of three placements.
"""

import dataclasses as dc
import math
import re

import numpy as np

from tofssm_drake.errors import UserError, require
from tofssm_drake.human.bvh_file import BvhFile, read_bvh
from tofssm_drake.human.figure_eight import FigureEight, FigureEightPath
from tofssm_drake.human.motion import HumanMotion, make_motion
from tofssm_drake.human.skeleton import (
    ANKLE_HEIGHT,
    FOOT_RADIUS,
    HEEL_LENGTH,
    KNUCKLE_LENGTH,
    LANDMARK_INDEX,
    LANDMARKS,
    SHOULDER_HEIGHT,
)
from tofssm_drake.human.walk import (
    DOWN,
    Gait,
    calc_cycle_slip,
    calc_slip,
    carry_gait,
    ease,
    find_longest_run,
    smooth,
    solve_knee,
)

PLACEMENTS = ("in_place", "own_path", "figure_eight")

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

_UPS = ("x", "y", "z", "-x", "-y", "-z")

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

_PARENTS = {
    "waist": "pelvis",
    "neck": "waist",
    "head": "neck",
    "head_top": "head",
    **{
        f"{side}_{child}": parent.replace("*", side)
        for side in ("left", "right")
        for child, parent in (
            ("shoulder", "neck"),
            ("elbow", "*_shoulder"),
            ("wrist", "*_elbow"),
            ("hand", "*_wrist"),
            ("hip", "pelvis"),
            ("knee", "*_hip"),
            ("ankle", "*_knee"),
            ("toe", "*_ankle"),
            ("heel", "*_toe"),
        )
    },
}
"""Chains of landmarks, from the pelvis outwards."""


@dc.dataclass(kw_only=True)
class BvhRecording:
    """A person who moves as one did in a recording."""

    # The BVH file.
    filename: str = ""

    # Unit of length in the file: "m", "ft", "inch", "cm", "mm", "cgspeed"
    # (inch / 0.45, as in the usual conversions of the CMU database), a number
    # of metres per unit, or "auto": whichever makes an adult.
    units: str = "auto"

    # The file's vertical axis: "y", "z", "x", one of these with a minus, or
    # "auto": from feet to head.
    up: str = "auto"

    # "in_place": without the way covered; "own_path": along the recorded
    # way; "figure_eight": the recorded stride, carried along the figure.
    placement: str = "figure_eight"

    # Where the person starts (in_place: stays), [x, y] in world, m, for
    # in_place and own_path. *Assumed.*
    position: list[float] = dc.field(default_factory=lambda: [1.15, 1.5])

    # Where the person faces at the start, degrees from world x, for in_place
    # and own_path. *Assumed.*
    heading_deg: float = -90.0

    # For in_place and own_path: True goes back to the start in a smooth
    # transition and begins anew; False holds the last posture.
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
            self.units == "auto" or _read_units(self.units) is not None,
            f"{where}.units: '{self.units}' should be auto, "
            f"{', '.join(UNITS)} or metres per unit",
        )
        require(
            self.up in ("auto", *_UPS),
            f"{where}.up: '{self.up}' should be auto, {', '.join(_UPS)}",
        )
        require(
            self.placement in PLACEMENTS,
            f"{where}.placement: '{self.placement}' should be "
            f"{', '.join(PLACEMENTS)}",
        )
        require(
            np.shape(self.position) == (2,)
            and bool(np.isfinite(np.asarray(self.position, float)).all()),
            f"{where}.position: {self.position} should be two numbers "
            "[x, y], m",
        )
        require(
            math.isfinite(self.heading_deg),
            f"{where}.heading_deg: {self.heading_deg} should be finite",
        )
        require(
            0.0 <= self.start_time < math.inf,
            f"{where}.start_time: {self.start_time} should be 0 s or more",
        )
        require(
            self.end_time is None or self.end_time > self.start_time,
            f"{where}.end_time: {self.end_time} should be after start_time "
            f"{self.start_time}",
        )
        require(
            self.speed is None or 0.2 <= self.speed <= 2.2,
            f"{where}.speed: {self.speed} should be from 0.2 to 2.2 m/s",
        )
        self.figure_eight.check(f"{where}.figure_eight")


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


def _read_units(units):
    if units in UNITS:
        return UNITS[units]
    try:
        value = float(units)
    except ValueError:
        return None
    return value if 0.0 < value < math.inf else None


# Names.


def _split_words(name):
    """LeftUpLeg, mixamorig:LeftUpLeg, l_upleg, Bip01 L UpLeg: into words."""
    name = name.rsplit(":", 1)[-1].rsplit("|", 1)[-1]
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return [word.lower() for word in words]


_NOISE = ("joint", "jnt", "jt", "bone")


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
        for side, mark in (("left", "left|l"), ("right", "right|r")):
            match = re.fullmatch(f"(?:{mark})(.+)|(.+?)(?:{mark})", text)
            if match:
                yield side, match.group(1) or match.group(2)


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


# Forward kinematics.


def _multiply(q, p):
    """Quaternion products, shape (..., 4), w first."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    a, b, c, d = np.moveaxis(p, -1, 0)
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )


def _interpolate_rotation(q, low, weight):
    """Spherical interpolation between rows low and low + 1."""
    high = np.minimum(low + 1, len(q) - 1)
    a, b = q[low], q[high]
    cosine = np.sum(a * b, axis=-1)
    b = np.where(cosine[:, None] < 0.0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-9
    safe = np.where(near, 1.0, sine)
    u = np.where(near, 1 - weight, np.sin((1 - weight) * angle) / safe)
    v = np.where(near, weight, np.sin(weight * angle) / safe)
    result = u[:, None] * a + v[:, None] * b
    return result / np.linalg.norm(result, axis=-1, keepdims=True)


def _to_matrix(q):
    w, x, y, z = q.T
    return np.stack(
        [
            np.stack(
                [
                    1 - 2 * (y * y + z * z),
                    2 * (x * y - w * z),
                    2 * (x * z + w * y),
                ],
                axis=-1,
            ),
            np.stack(
                [
                    2 * (x * y + w * z),
                    1 - 2 * (x * x + z * z),
                    2 * (y * z - w * x),
                ],
                axis=-1,
            ),
            np.stack(
                [
                    2 * (x * z - w * y),
                    2 * (y * z + w * x),
                    1 - 2 * (x * x + y * y),
                ],
                axis=-1,
            ),
        ],
        axis=-2,
    )


def calc_positions(
    file: BvhFile, times: np.ndarray, rotations_of: tuple[int, ...] = ()
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Poses the hierarchy at any times between the first and last frame.

    Each joint's rotation is interpolated on the sphere, so that bones keep
    their lengths; positions are interpolated linearly.

    A joint's position channels replace its offset where their values are
    about the offset, and add to it otherwise; files of both kinds exist.

    Args:
        file: The file.
        times: From the first frame, s, shape (T,).
        rotations_of: Joints whose rotations are wanted as well.

    Returns:
        Positions of all joints, End Sites included, in the file's axes and
        units, shape (T, J, 3), and rotation matrices (T, 3, 3) by joint.
    """
    index = np.clip(
        np.asarray(times, float) / file.frame_time, 0, len(file.frames) - 1
    )
    low = np.floor(index + 1e-9).astype(int)
    weight = np.clip(index - low, 0.0, 1.0)
    high = np.minimum(low + 1, len(file.frames) - 1)
    count = len(low)
    positions = np.empty((count, len(file.joints), 3))
    rotations = {}
    for j, joint in enumerate(file.joints):
        columns = file.frames[
            :, joint.first_channel : joint.first_channel + len(joint.channels)
        ]
        local = np.tile(joint.offset, (count, 1))
        moved = [
            (axis, k)
            for k, (kind, axis) in enumerate(joint.channels)
            if kind == "position"
        ]
        if moved:
            axes, k = (list(part) for part in zip(*moved, strict=True))
            values = columns[:, k]
            typical = np.median(values, axis=0)
            offset = joint.offset[axes]
            adds = np.linalg.norm(typical - offset) > np.linalg.norm(typical)
            values = (1 - weight)[:, None] * values[low] + weight[
                :, None
            ] * values[high]
            local[:, axes] = values + (offset if adds else 0.0)
        turned = None
        for k, (kind, axis) in enumerate(joint.channels):
            if kind == "rotation":
                half = np.radians(columns[:, k]) / 2
                q = np.zeros((len(half), 4))
                q[:, 0] = np.cos(half)
                q[:, 1 + axis] = np.sin(half)
                turned = q if turned is None else _multiply(turned, q)
        R = None
        if turned is not None:
            R = _to_matrix(_interpolate_rotation(turned, low, weight))
        if joint.parent < 0:
            positions[:, j] = local
        else:
            R_parent = rotations[joint.parent]
            positions[:, j] = positions[:, joint.parent] + np.einsum(
                "tij,tj->ti", R_parent, local
            )
            R = R_parent if R is None else R_parent @ R
        if not joint.is_end:
            rotations[j] = np.tile(np.eye(3), (count, 1, 1)) if R is None else R
    return positions, {j: rotations[j] for j in rotations_of}


# From joints to landmarks.


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


def _normalize(vector):
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.maximum(norm, 1e-12)


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
        beyond.append(j)
        if "thumb" in joint.name.lower():
            continue
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
    up = _normalize(R_flat[:, 2, :].mean(axis=0))
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
    ahead = _normalize(ahead)
    down = (FOOT_RADIUS * stature - height) * up
    p["heel"] = p_ankle + R_foot @ (down - HEEL_LENGTH * stature * ahead)
    p["toe"] = p_ankle + R_foot @ (down + length * ahead)


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

    last = file.duration if end_time is None else end_time
    if start_time > file.duration or last > file.duration + 1e-6:
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
    rows = int(math.floor((last - start_time) / dt + 1e-6)) + 1
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
        scale = _read_units(units)
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
    trunk_up = _normalize(shoulders - p["pelvis"])
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
    axis = _normalize(p["head"] - p["neck"])
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
            axis = _normalize(crown - p["head"])
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
        ] + KNUCKLE_LENGTH * stature * _normalize(along)
    facing = _calc_facing(p)
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
        kind == "position" for kind, _ in file.joints[0].channels
    )
    sole = FOOT_RADIUS * stature
    if has_position:
        landmarks[:, :, 2] += sole - _find_floor(landmarks, dt)
        _lift_feet(landmarks, sole)
    else:
        landmarks[:, :, 2] += sole - _calc_lowest(landmarks)[:, None]
        _plant_feet(landmarks, dt)
    return Performance(
        landmarks=landmarks, stature=float(stature), units=scale, up=up
    )


_FEET = [
    LANDMARK_INDEX[f"{side}_{name}"]
    for side in ("left", "right")
    for name in ("heel", "toe")
]


def _calc_lowest(landmarks):
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


def _calc_facing(p):
    """Horizontal unit vectors: where hips and shoulders face, (T, 3)."""
    left = _normalize(p["left_hip"] - p["right_hip"]) + _normalize(
        p["left_shoulder"] - p["right_shoulder"]
    )
    ahead = np.stack([left[:, 1], -left[:, 0], 0 * left[:, 0]], axis=-1)
    return _normalize(ahead)


def _get_facing(landmarks):
    return _calc_facing(
        {name: landmarks[:, i] for name, i in LANDMARK_INDEX.items()}
    )


def _plant_feet(landmarks, dt):
    """Moves a person who has no travel so that the lowest foot stands."""
    feet = landmarks[:, _FEET]
    lowest = np.argmin(feet[:-1, :, 2], axis=1)
    step = np.diff(feet[:, :, :2], axis=0)
    back = step[np.arange(len(step)), lowest]
    back = smooth(back, round(0.1 / dt)) if len(back) else back
    travel = np.concatenate([np.zeros((1, 2)), -np.cumsum(back, axis=0)])
    landmarks[:, :, :2] += travel[:, None, :]


# Placements.


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
        for child, parent in _PARENTS.items()
    }


def _restore_lengths(landmarks, lengths):
    """Gives blended postures the bones' lengths again, pelvis outwards."""
    result = landmarks.copy()
    for child, parent in _PARENTS.items():
        i, j = LANDMARK_INDEX[child], LANDMARK_INDEX[parent]
        axis = _normalize(landmarks[:, i] - landmarks[:, j])
        result[:, i] = result[:, j] + lengths[child] * axis
    return result


def _wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _calc_heading(landmarks):
    facing = _get_facing(landmarks)
    return np.unwrap(np.arctan2(facing[:, 1], facing[:, 0]))


def _close_loop(landmarks, dt, stature):
    """Appends a way back from the last posture to the first.

    Place, heading and posture each follow a cubic that leaves and arrives
    with the recording's own velocities; slow enough for a walk.
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
    u = np.arange(1, rows) / rows

    def blend(first, second, v_first, v_second):
        w = u.reshape(-1, *[1] * np.ndim(first))
        span = rows
        return (
            (1 + 2 * w) * (1 - w) ** 2 * first
            + w * (1 - w) ** 2 * span * v_first
            + w**2 * (3 - 2 * w) * second
            + w**2 * (w - 1) * span * v_second
        )

    # Velocities fade within a quarter of a second, as a person's would.
    fade = min(1.0, 0.25 / (rows * dt) * 3.0)

    def rate(values, a, b):
        return fade * (values[a] - values[b])

    place = blend(
        pelvis[-1], pelvis[0], rate(pelvis, -1, -2), rate(pelvis, 1, 0)
    )
    angle = blend(
        heading[-1],
        heading[-1] + turn,
        rate(heading, -1, -2),
        rate(heading, 1, 0),
    )
    posture = blend(local[-1], local[0], rate(local, -1, -2), rate(local, 1, 0))
    back = _turn(posture, angle) + place[:, None]
    back = _restore_lengths(back, _calc_lengths(landmarks))
    sunk = np.maximum(FOOT_RADIUS * stature - _calc_lowest(back), 0.0)
    back[:, :, 2] += sunk[:, None]
    return np.concatenate([landmarks, back])


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
    window = round(0.4 / dt)
    travelled = float(_norm(pelvis - pelvis[0]).max())
    if travelled < 0.5 * stature:
        # On the spot, as on a treadmill: let the feet tell the way.
        landmarks = landmarks.copy()
        _plant_feet(landmarks, dt)
        pelvis = landmarks[:, 0, :2]
    velocity = smooth(np.gradient(pelvis, dt, axis=0), window)
    speed = _norm(velocity)
    walking = speed > max(0.3, 0.6 * np.quantile(speed, 0.9))
    direction = _normalize(velocity)
    span = (
        landmarks[:, LANDMARK_INDEX["left_ankle"], :2]
        - landmarks[:, LANDMARK_INDEX["right_ankle"], :2]
    )
    lead = np.sum(span * direction, axis=-1)
    passing = [
        k
        for k in range(1, len(lead))
        if lead[k - 1] < 0.0 <= lead[k] and walking[k]
    ]
    best, best_cost = None, math.inf
    for i, j in zip(passing[:-1], passing[1:], strict=True):
        if not (0.5 <= (j - i) * dt <= 2.5 and walking[i:j].all()):
            continue
        steps = lead[i:j]
        if min(steps.max(), -steps.min()) < 0.06 * stature:
            continue
        way = pelvis[j] - pelvis[i]
        angle = math.atan2(way[1], way[0])
        ends = landmarks[[i, j]].copy()
        ends[:, :, :2] -= pelvis[[i, j]][:, None]
        ends = _turn(ends, -angle)
        mismatch = float(_norm(ends[1] - ends[0]).max())
        bend = _wrap(
            math.atan2(*direction[j][::-1]) - math.atan2(*direction[i][::-1])
        )
        hurry = abs(math.log(speed[j] / speed[i]))
        cost = mismatch + 0.3 * abs(bend) + 0.3 * hurry
        if cost < best_cost:
            best, best_cost = (i, j, angle), cost
    if best is None:
        return None
    i, j, angle = best
    stride = float(_norm(pelvis[j] - pelvis[i]))
    # Fade from what follows the stride to the stride itself, so that its end
    # runs into its beginning.
    fade = min((j - i) // 3, len(landmarks) - j)
    rows = landmarks[i : j + fade].copy()
    rows[:, :, :2] -= pelvis[i]
    rows = _turn(rows, -angle)
    phase = np.arange(len(rows)) / (j - i)
    rows[:, :, 0] -= stride * phase[:, None]
    cycle = rows[: j - i]
    weight = ease(1.0 - np.arange(fade) / fade)[:, None, None]
    cycle[:fade] += weight * (rows[j - i :] - cycle[:fade])
    cycle[:, :, :2] -= cycle[:, :1, :2].mean(axis=0)
    cycle = _restore_lengths(cycle, _calc_lengths(landmarks))
    for side in ("left", "right"):
        slip = calc_slip(landmarks, side, dt)[i:j]
        down = _norm(slip) < DOWN * stride / ((j - i) * dt)
        _settle_foot(cycle, side, down, stride, FOOT_RADIUS * stature, dt)
    return Gait(
        landmarks=cycle,
        stride=stride,
        period=(j - i) * dt,
        stature=stature,
    )


def _smooth_periodic(values, width):
    half = max(1, min(width, len(values) // 4)) // 2
    return np.mean(
        [np.roll(values, k, axis=0) for k in range(-half, half + 1)], axis=0
    )


def _settle_foot(cycle, side, down, stride, sole, dt):
    """Makes a foot of a stride stand on the floor, and stand still.

    While it is down, the point that touches the floor (heel, toe or both) is
    kept where it is; in the air the foot goes over to the next such place.
    The knee is left to be solved.

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
        The motion. It loops on the figure of eight and where asked to.

    Raises:
        UserError: A setting is out of range, or the file is of no use; the
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
    stature = performance.stature
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
    landmarks = performance.landmarks
    beginning = landmarks[: max(1, round(0.25 / dt))]
    facing = _get_facing(beginning).mean(axis=0)
    turn = math.radians(config.heading_deg) - math.atan2(facing[1], facing[0])
    origin = landmarks[:1, :1] * [1.0, 1.0, 0.0]
    if config.placement == "in_place":
        origin = landmarks[:, :1] * [1.0, 1.0, 0.0]
    landmarks = _turn(landmarks - origin, turn)
    landmarks[:, :, :2] += config.position
    if config.loop:
        landmarks = _close_loop(landmarks, dt, stature)
    return make_motion(
        landmarks=landmarks, dt=dt, loops=config.loop, stature=stature
    )
