"""Where the joints of a BVH file are, at any time."""

import dataclasses as dc

import numpy as np

from tofssm_drake.people.bvh_file import BvhFile


def calc_positions(
    file: BvhFile, times: np.ndarray, rotations_of: tuple[int, ...] = ()
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Poses the hierarchy at any times between the first and last frame.

    Rotations are interpolated on the sphere, so that bones keep their
    lengths; positions are interpolated linearly.

    A joint's position channels replace its offset where their values are
    close to the offset, and add to it otherwise; both kinds of files exist.

    Args:
        file: The file.
        times: From the first frame, s, shape (T,).
        rotations_of: Joints whose rotations are also returned.

    Returns:
        Positions of all joints, End Sites included, in the file's axes and
        units, shape (T, J, 3), and rotation matrices (T, 3, 3) by joint.
    """
    index = np.clip(
        np.asarray(times, float) / file.frame_time, 0, len(file.frames) - 1
    )
    low = np.floor(index + 1e-9).astype(int)
    at = _Interpolation(
        low=low,
        high=np.minimum(low + 1, len(file.frames) - 1),
        weight=np.clip(index - low, 0.0, 1.0)[:, None],
    )
    count = len(low)
    positions = np.empty((count, len(file.joints), 3))
    rotations: dict[int, np.ndarray] = {}
    for j, joint in enumerate(file.joints):
        first = joint.first_channel
        channels = file.frames[:, first : first + len(joint.channels)]
        local = _calc_translation(joint, channels, at)
        R = _calc_rotation(joint, channels, at)
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


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Interpolation:
    """Which frames to interpolate between, and how far."""

    low: np.ndarray
    """Frame before, (T,)."""
    high: np.ndarray
    """Frame after, (T,)."""
    weight: np.ndarray
    """Of the frame after, (T, 1)."""


def _calc_translation(joint, channels, at):
    """Returns positions in the parent's axes, (T, 3)."""
    local = np.tile(joint.offset, (len(at.low), 1))
    moved = [
        (axis, k)
        for k, (kind, axis) in enumerate(joint.channels)
        if kind == "position"
    ]
    if moved:
        axes, k = (list(part) for part in zip(*moved, strict=True))
        values = channels[:, k]
        typical = np.median(values, axis=0)
        offset = joint.offset[axes]
        adds = np.linalg.norm(typical - offset) > np.linalg.norm(typical)
        values = (1 - at.weight) * values[at.low] + at.weight * values[at.high]
        local[:, axes] = values + (offset if adds else 0.0)
    return local


def _calc_rotation(joint, channels, at):
    """Returns rotation matrices in the parent, (T, 3, 3); None: no channel."""
    turned = [
        ("XYZ"[axis], k)
        for k, (kind, axis) in enumerate(joint.channels)
        if kind == "rotation"
    ]
    if not turned:
        return None
    # Only for recordings: SciPy takes long to import.
    from scipy.spatial.transform import Rotation

    axes, k = (list(part) for part in zip(*turned, strict=True))
    R = Rotation.from_euler("".join(axes), channels[:, k], degrees=True)
    step = (R[at.low].inv() * R[at.high]).as_rotvec()
    return (R[at.low] * Rotation.from_rotvec(at.weight * step)).as_matrix()
