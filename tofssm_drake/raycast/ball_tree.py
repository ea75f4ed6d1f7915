"""Bounding balls of shapes and, where a frame has many, of groups of them."""

import numpy as np

import tofssm_drake.raycast.ray_kernels as ray_kernels

# Testing this many balls is faster than testing a ball around them first.
_GROUP_SIZE = 8


def make_ball_tree(
    frames: np.ndarray, centres: np.ndarray, radii: np.ndarray
) -> np.ndarray:
    """Makes the table `balls` of the ray kernels.

    Shapes of one frame do not move relative to each other, so their tree is
    built once. Everything fixed in the world is one frame, however large.

    Args:
        frames: Row of each shape's frame in X_WF, shape (n,).
        centres: Centres of the shapes' balls in these frames, shape (n, 3), m.
        radii: Radii, inf for a shape without bounds, shape (n,), m.
    """
    table = [np.zeros(ray_kernels.BALL_COLUMNS)]
    top = []
    for frame in np.unique(frames):
        shapes = np.flatnonzero((frames == frame) & np.isfinite(radii))
        if len(shapes) > _GROUP_SIZE:
            top.append(shapes)
        else:
            top += [shapes[i : i + 1] for i in range(len(shapes))]
    top += [np.array([i]) for i in np.flatnonzero(~np.isfinite(radii))]
    pending = [(0, top)]
    while pending:
        row, groups = pending.pop()
        table[row][ray_kernels.BALL_FIRST] = len(table)
        table[row][ray_kernels.BALL_COUNT] = len(groups)
        for group in groups:
            ball = np.zeros(ray_kernels.BALL_COLUMNS)
            ball[ray_kernels.BALL_FRAME] = frames[group[0]]
            if len(group) == 1:
                ball[ray_kernels.BALL_FIRST] = group[0]
                ball[:3] = centres[group[0]]
                ball[ray_kernels.BALL_RADIUS] = radii[group[0]]
            else:
                pending.append((len(table), _split(group, centres)))
                ball[:4] = _enclose(centres[group], radii[group])
            table.append(ball)
    return np.array(table)


def _split(group, centres):
    """Returns the halves of a large group, the members of a small one."""
    if len(group) <= _GROUP_SIZE:
        return [group[i : i + 1] for i in range(len(group))]
    axis = np.argmax(np.ptp(centres[group], axis=0))
    group = group[np.argsort(centres[group, axis], kind="stable")]
    return [group[: len(group) // 2], group[len(group) // 2 :]]


def _enclose(centres, radii):
    """Returns x, y, z and radius of a ball around balls."""
    low = (centres - radii[:, None]).min(axis=0)
    high = (centres + radii[:, None]).max(axis=0)
    centre = 0.5 * (low + high)
    radius = (np.linalg.norm(centres - centre, axis=1) + radii).max()
    # Rounding must not take a point out of its ball.
    return [*centre, radius * (1.0 + 1e-12)]
