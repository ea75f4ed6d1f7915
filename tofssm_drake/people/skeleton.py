"""The person's body: joints, capsules, proportions.

Proportions are fractions of stature after Drillis and Contini, "Body Segment
Parameters" (1966), as reprinted in Winter, "Biomechanics and Motor Control of
Human Movement", Fig. 4.1. Radii of the capsules are *assumed*: round figures
that give a clothed adult's breadths.

A source of motion (a generated walk, a recording) delivers the LANDMARKS;
`complete_joints` adds the points that carry the trunk's capsules, so that all
sources have the same body.
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.kernels import njit

_SIDES = ("left", "right")

LANDMARKS = (
    "pelvis",
    "waist",
    "neck",
    "head",
    "head_top",
    *(
        f"{side}_{name}"
        for side in _SIDES
        for name in (
            "shoulder",
            "elbow",
            "wrist",
            "hand",
            "hip",
            "knee",
            "ankle",
            "heel",
            "toe",
        )
    ),
)
"""Points that a source of motion delivers.

`pelvis` is the middle between the hips, `neck` its base between the
shoulders, `head` the joint at the skull's base, `hand` the knuckles. `heel`
and `toe` are the ends of the foot's capsule: one foot radius above the floor
when the foot stands flat.
"""

PARENTS = {
    "waist": "pelvis",
    "neck": "waist",
    "head": "neck",
    "head_top": "head",
    **{
        f"{side}_{child}": parent.replace("*", side)
        for side in _SIDES
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

JOINTS = (
    *LANDMARKS,
    *(
        f"{side}_{name}"
        for side in _SIDES
        for name in ("pelvis", "belly", "lower_rib", "upper_rib")
    ),
    "head_low",
    "head_high",
)
"""All points of a motion table, in order."""

LANDMARK_INDEX = {name: i for i, name in enumerate(LANDMARKS)}
JOINT_INDEX = {name: i for i, name in enumerate(JOINTS)}

HIP_HEIGHT = 0.530
ANKLE_HEIGHT = 0.039
SHOULDER_HEIGHT = 0.818
HALF_SHOULDER_BREADTH = 0.129
HIP_BREADTH = 0.191
UPPER_ARM_LENGTH = 0.186
FOREARM_LENGTH = 0.146
THIGH_LENGTH = 0.245
SHANK_LENGTH = 0.246
FOOT_LENGTH = 0.152
HEAD_HEIGHT = 0.130
"""Chin to crown; all as fractions of stature."""

# Assumed: not in the tables.
HALF_HIP_JOINT_BREADTH = 0.050
WAIST_HEIGHT = 0.630
NECK_HEIGHT = 0.835
HEAD_JOINT_HEIGHT = 0.885
KNUCKLE_LENGTH = 0.058
HEEL_LENGTH = 0.036
"""From the ankle back to the end of the heel, along the sole."""

TRUNK_RADIUS = 0.056
FOOT_RADIUS = 0.022
HEAD_RADIUS = 0.048


@dc.dataclass(frozen=True, kw_only=True)
class Capsule:
    """One rigid piece of the body: a capsule between two joints."""

    name: str
    first: str
    """Joint at end A."""
    second: str
    """Joint at end B."""
    radius: float
    """As a fraction of stature."""
    colour: str
    """Key of COLOURS."""


COLOURS = {
    "skin": (0.87, 0.68, 0.56, 1.0),
    "shirt": (0.95, 0.48, 0.10, 1.0),
    "trousers": (0.18, 0.23, 0.34, 1.0),
    "shoe": (0.12, 0.12, 0.13, 1.0),
}
"""RGBA; the shirt is of the colour of high-visibility working clothes."""


def _make_capsules() -> tuple[Capsule, ...]:
    def capsule(name, first, second, radius, colour):
        return Capsule(
            name=name, first=first, second=second, radius=radius, colour=colour
        )

    def both_sides(name, first, second, radius, colour):
        return [
            capsule(
                f"{side}_{name}",
                first.replace("*", side),
                second.replace("*", side),
                radius,
                colour,
            )
            for side in _SIDES
        ]

    return (
        capsule("head", "head_low", "head_high", HEAD_RADIUS, "skin"),
        capsule("neck", "neck", "head", 0.033, "skin"),
        *both_sides("collar", "neck", "*_shoulder", 0.033, "shirt"),
        *both_sides("chest", "*_lower_rib", "*_upper_rib", 0.062, "shirt"),
        capsule("abdomen", "left_belly", "right_belly", 0.056, "shirt"),
        capsule("pelvis", "left_pelvis", "right_pelvis", 0.056, "trousers"),
        *both_sides("upper_arm", "*_shoulder", "*_elbow", 0.028, "shirt"),
        *both_sides("forearm", "*_elbow", "*_wrist", 0.023, "skin"),
        *both_sides("hand", "*_wrist", "*_hand", 0.024, "skin"),
        *both_sides("thigh", "*_hip", "*_knee", 0.044, "trousers"),
        *both_sides("shank", "*_knee", "*_ankle", 0.031, "trousers"),
        *both_sides("foot", "*_heel", "*_toe", FOOT_RADIUS, "shoe"),
    )


CAPSULES = _make_capsules()
"""The body's pieces; every capsule-wise array has their order."""

PELVIS = [capsule.name for capsule in CAPSULES].index("pelvis")
"""Index of the capsule whose centre is a person's place."""

CAPSULE_FIRST = np.array([JOINT_INDEX[c.first] for c in CAPSULES])
CAPSULE_SECOND = np.array([JOINT_INDEX[c.second] for c in CAPSULES])
CAPSULE_FIRST.flags.writeable = False
CAPSULE_SECOND.flags.writeable = False


def calc_radii(stature: float) -> np.ndarray:
    """Returns the capsules' radii of a person.

    Args:
        stature: Standing height, m.

    Returns:
        Radii in the order of CAPSULES, m, shape (c,).
    """
    return stature * np.array([capsule.radius for capsule in CAPSULES])


def normalize(vector: np.ndarray) -> np.ndarray:
    """Returns vectors of length 1 (or 0), shape (..., 3)."""
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.maximum(norm, 1e-12)


def calc_frames(up: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Returns right-handed frames with z along `up` and y about `left`.

    Args:
        up: Any length, shape (T, 3).
        left: Any length, not parallel to `up`, shape (T, 3).

    Returns:
        Rotation matrices, columns forward, left, up, shape (T, 3, 3).
    """
    z = normalize(up)
    x = normalize(np.cross(left, z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def complete_joints(landmarks: np.ndarray, stature: float) -> np.ndarray:
    """Adds the points that carry the trunk's and the head's capsules.

    They keep constant distances from each other within pelvis, chest and
    head, however the source's spine bends.

    Args:
        landmarks: Points in the order of LANDMARKS, m, in W, shape (T, l, 3).
        stature: Standing height, m.

    Returns:
        Points in the order of JOINTS, m, in W, shape (T, J, 3).
    """
    landmarks = np.asarray(landmarks, dtype=float)
    joints = np.empty((len(landmarks), len(JOINTS), 3))
    joints[:, : len(LANDMARKS)] = landmarks
    point = {
        name: landmarks[:, index] for name, index in LANDMARK_INDEX.items()
    }

    def place(name, origin, frame, offset):
        joints[:, JOINT_INDEX[name]] = origin + frame @ (
            stature * np.asarray(offset)
        )

    R_pelvis = calc_frames(
        point["waist"] - point["pelvis"],
        point["left_hip"] - point["right_hip"],
    )
    R_chest = calc_frames(
        point["neck"] - point["waist"],
        point["left_shoulder"] - point["right_shoulder"],
    )
    pelvis_offset = HIP_BREADTH / 2 - TRUNK_RADIUS
    for side, sign in zip(_SIDES, (1, -1), strict=True):
        place(
            f"{side}_pelvis",
            point["pelvis"],
            R_pelvis,
            [0, sign * pelvis_offset, 0.025],
        )
        place(
            f"{side}_belly",
            point["waist"],
            R_pelvis,
            [0.002, sign * 0.034, -0.012],
        )
        # Downwards from the neck, so that the shoulders' line stays right in
        # bodies whose waist is low.
        for name, offset in (("upper_rib", -0.068), ("lower_rib", -0.160)):
            place(
                f"{side}_{name}",
                point["neck"],
                R_chest,
                [0.002, sign * 0.030, offset],
            )
    axis = normalize(point["head_top"] - point["head"])
    for name, depth in (
        ("head_high", HEAD_RADIUS),
        ("head_low", HEAD_HEIGHT - HEAD_RADIUS),
    ):
        joints[:, JOINT_INDEX[name]] = (
            point["head_top"] - stature * depth * axis
        )
    return joints


@njit(cache=True)
def calc_capsule_poses(ends, poses):
    """Poses frames F at the capsules' centres, z from end A to end B.

    The rotation about z is the one of least turn from W's z axis: a capsule
    looks the same from all sides.

    Args:
        ends: Capsule ends A, B in W, m, shape (c, 2, 3).
        poses: Filled with X_WF = [R_WF p_WF], shape (c, 3, 4).
    """
    for i in range(ends.shape[0]):
        x = ends[i, 1, 0] - ends[i, 0, 0]
        y = ends[i, 1, 1] - ends[i, 0, 1]
        z = ends[i, 1, 2] - ends[i, 0, 2]
        norm = np.sqrt(x * x + y * y + z * z)
        if norm > 0.0:
            x /= norm
            y /= norm
            z /= norm
        else:
            x, y, z = 0.0, 0.0, 1.0
        # Duff et al., "Building an Orthonormal Basis, Revisited" (2017).
        sign = 1.0 if z >= 0.0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        poses[i, 0, 0] = 1.0 + sign * x * x * a
        poses[i, 1, 0] = sign * b
        poses[i, 2, 0] = -sign * x
        poses[i, 0, 1] = b
        poses[i, 1, 1] = sign + y * y * a
        poses[i, 2, 1] = -y
        poses[i, 0, 2] = x
        poses[i, 1, 2] = y
        poses[i, 2, 2] = z
        for k in range(3):
            poses[i, k, 3] = 0.5 * (ends[i, 0, k] + ends[i, 1, k])
