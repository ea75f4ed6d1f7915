"""Writes small BVH recordings of a walking person, in many dialects."""

import numpy as np

# (key, parent, offset in metres: x left, y up, z forward)
_TREE = (
    ("hips", None, (0, 0, 0)),
    ("left_hip", "hips", (0.09, -0.05, 0)),
    ("left_knee", "left_hip", (0, -0.42, 0)),
    ("left_ankle", "left_knee", (0, -0.42, 0)),
    ("left_toe", "left_ankle", (0, -0.05, 0.13)),
    ("right_hip", "hips", (-0.09, -0.05, 0)),
    ("right_knee", "right_hip", (0, -0.42, 0)),
    ("right_ankle", "right_knee", (0, -0.42, 0)),
    ("right_toe", "right_ankle", (0, -0.05, 0.13)),
    ("spine", "hips", (0, 0.12, 0)),
    ("chest", "spine", (0, 0.15, 0)),
    ("neck", "chest", (0, 0.23, 0)),
    ("head", "neck", (0, 0.1, 0.01)),
    ("left_collar", "chest", (0.03, 0.18, 0)),
    ("left_shoulder", "left_collar", (0.14, 0.02, 0)),
    ("left_elbow", "left_shoulder", (0.3, 0, 0)),
    ("left_wrist", "left_elbow", (0.25, 0, 0)),
    ("right_collar", "chest", (-0.03, 0.18, 0)),
    ("right_shoulder", "right_collar", (-0.14, 0.02, 0)),
    ("right_elbow", "right_shoulder", (-0.3, 0, 0)),
    ("right_wrist", "right_elbow", (-0.25, 0, 0)),
)
_ENDS = {
    "left_toe": (0, 0, 0.06),
    "right_toe": (0, 0, 0.06),
    "head": (0, 0.18, 0),
    "left_wrist": (0.15, 0, 0),
    "right_wrist": (-0.15, 0, 0),
}

SPEED = 1.2
"""m/s."""
PERIOD = 1.1
"""Of a stride, s."""

_LIMBS = ("hip", "knee", "ankle", "toe", "collar", "shoulder", "elbow", "wrist")
_CENTRE = ("hips", "spine", "chest", "neck", "head")


def _name(pattern, centre, limbs, left="Left", right="Right"):
    names = dict(zip(_CENTRE, centre.split(), strict=True))
    for key, mark in (("left", left), ("right", right)):
        for role, word in zip(_LIMBS, limbs.split(), strict=True):
            names[f"{key}_{role}"] = pattern.format(side=mark, name=word)
    return names


NAMINGS = {
    "cgspeed": _name(
        "{side}{name}",
        "Hips LowerBack Spine1 Neck1 Head",
        "UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand",
    ),
    "anatomy": _name(
        "{side}{name}",
        "Hips Chest Chest2 Neck Head",
        "Hip Knee Ankle Toe Collar Shoulder Elbow Wrist",
    ),
    "mixamo": {
        key: f"mixamorig:{name}"
        for key, name in _name(
            "{side}{name}",
            "Hips Spine Spine2 Neck Head",
            "UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand",
        ).items()
    },
    "xsens": _name(
        "{side}{name}",
        "Pelvis L5 T8 Neck Head",
        "UpperLeg LowerLeg Foot Toe Shoulder UpperArm ForeArm Hand",
    ),
    "rokoko": _name(
        "{side}{name}",
        "Hips Spine1 Spine4 Neck Head",
        "Thigh Shin Foot Toe Shoulder Arm ForeArm Hand",
    ),
    "acclaim": _name(
        "{side}{name}",
        "root lowerback thorax upperneck head",
        "femur tibia foot toes clavicle humerus radius wrist",
        left="l",
        right="r",
    ),
    "engine": _name(
        "{name}_{side}",
        "pelvis spine_01 spine_03 neck_01 head",
        "thigh calf foot ball clavicle upperarm lowerarm hand",
        left="l",
        right="r",
    ),
    "biped": _name(
        "Bip01 {side} {name}",
        "Bip01 Bip01_Spine Bip01_Spine1 Bip01_Neck Bip01_Head",
        "Thigh Calf Foot Toe0 Clavicle UpperArm Forearm Hand",
        left="L",
        right="R",
    ),
    "suffixed": _name(
        "{name}.{side}_01",
        "Root_01 Spine_01 Chest_01 Neck_01 Head_01",
        "UpperLeg LowerLeg Foot Toes Collar UpperArm LowerArm Hand",
        left="Left",
        right="Right",
    ),
}


def _turn(axis, degrees):
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R


def _calc_euler(R, order):
    """Angles a, b, c, degrees, with R = R_i(a) R_j(b) R_k(c)."""
    i, j, k = order
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    b = np.arcsin(np.clip(sign * R[i, k], -1.0, 1.0))
    a = np.arctan2(-sign * R[j, k], R[k, k])
    c = np.arctan2(-sign * R[i, j], R[i, i])
    return np.degrees([a, b, c])


def calc_posture(t):
    """Root position and the joints' local rotations, walking along z."""
    wave = 2 * np.pi * t / PERIOD
    root = np.array(
        [
            0.01 * np.sin(wave),
            0.95 + 0.02 * np.cos(2 * wave),
            SPEED * t,
        ]
    )
    R = {key: np.eye(3) for key, _, _ in _TREE}
    R["hips"] = _turn(1, 4 * np.sin(wave))
    R["chest"] = _turn(1, -6 * np.sin(wave)) @ _turn(0, 3.0)
    R["head"] = _turn(0, 5.0)
    for side, sign in (("left", 1), ("right", -1)):
        swing = sign * np.sin(wave)
        bend = 6 + 50 * max(0.0, sign * np.cos(wave)) ** 2
        R[f"{side}_hip"] = _turn(0, -17 * swing - 5)
        R[f"{side}_knee"] = _turn(0, bend)
        R[f"{side}_ankle"] = _turn(0, 17 * swing + 5 - bend)
        # From the T-pose down to the side, then to and fro.
        R[f"{side}_shoulder"] = _turn(0, 20 * swing) @ _turn(2, -sign * 80)
        R[f"{side}_elbow"] = _turn(1, -sign * 25)
    return root, R


def calc_joints(t):
    """Positions of the joints by key, x left, y up, z forward, m."""
    root, R_local = calc_posture(t)
    p, R = {}, {}
    for key, parent, offset in _TREE:
        if parent is None:
            p[key], R[key] = root, R_local[key]
        else:
            p[key] = p[parent] + R[parent] @ np.array(offset)
            R[key] = R[parent] @ R_local[key]
    return p


def write_bvh(
    path,
    *,
    naming="cgspeed",
    metres_per_unit=1.0,
    up="y",
    order=(2, 1, 0),
    root_position=True,
    joint_positions=None,
    fps=120.0,
    duration=4.0,
    calibration=False,
    heading_deg=0.0,
    newline="\n",
):
    """Writes a walk; `joint_positions` is None, "replace" or "add"."""
    names = NAMINGS[naming]
    C = {
        "y": np.eye(3),
        "z": np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        "-y": np.diag([1, -1, -1]),
    }[up] @ _turn(1, heading_deg)
    axes = "XYZ"
    rotations = " ".join(f"{axes[i]}rotation" for i in order)
    positions = "Xposition Yposition Zposition"
    children = {key: [] for key, _, _ in _TREE}
    for key, parent, _ in _TREE:
        if parent:
            children[parent].append(key)
    offsets = {key: np.array(offset) for key, _, offset in _TREE}
    lines = ["HIERARCHY"]
    sequence = []

    def write_offset(offset, pad):
        values = C @ np.asarray(offset) / metres_per_unit
        lines.append(f"{pad}OFFSET " + " ".join(f"{v:.9f}" for v in values))

    def write_joint(key, depth):
        pad = "\t" * depth
        sequence.append(key)
        lines.append(f"{pad}{'JOINT' if depth else 'ROOT'} {names[key]}")
        lines.append(pad + "{")
        write_offset(offsets[key], pad + "\t")
        moved = joint_positions if depth else root_position
        lines.append(
            f"{pad}\tCHANNELS 6 {positions} {rotations}"
            if moved
            else f"{pad}\tCHANNELS 3 {rotations}"
        )
        for child in children[key]:
            write_joint(child, depth + 1)
        if key in _ENDS:
            lines.append(f"{pad}\tEnd Site")
            lines.append(pad + "\t{")
            write_offset(_ENDS[key], pad + "\t\t")
            lines.append(pad + "\t}")
        lines.append(pad + "}")

    write_joint("hips", 0)
    frames = []
    for k in range(round(duration * fps) + 1):
        root, R = calc_posture(k / fps)
        row = []
        for key in sequence:
            if key == "hips":
                if root_position:
                    row.extend(C @ root / metres_per_unit)
            elif joint_positions:
                here = offsets[key] if joint_positions == "replace" else 0.0
                row.extend(C @ (here + np.zeros(3)) / metres_per_unit)
            row.extend(_calc_euler(C @ R[key] @ C.T, order))
        frames.append(row)
    if calibration:
        still = np.array(frames[0])
        still[3:] = 0.0
        frames.insert(0, still)
    lines += ["MOTION", f"Frames: {len(frames)}", f"Frame Time: {1 / fps:.9f}"]
    lines += [" ".join(f"{v:.8f}" for v in row) for row in frames]
    with open(path, "w", newline=newline) as file:
        file.write("\n".join(lines) + "\n")
    return str(path)
