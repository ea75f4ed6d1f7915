"""Where the joints of a BVH file are, at any time."""

import numpy as np

from tofssm_drake.human.bvh_file import BvhFile


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
