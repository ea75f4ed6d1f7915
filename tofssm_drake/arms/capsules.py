"""Capsules around a triangle mesh, and how well they fit it.

`capsule_fit` finds them.

Distances between capsules are closed-form, so an arm's true distance to a
person is measured from capsules. The surface's triangles are shared out, and
each is wholly inside its capsule, which is convex: their union covers all.
"""

import dataclasses as dc

import numpy as np


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class FittedCapsule:
    """A capsule; a ball if both ends are one."""

    p: np.ndarray
    """First end of its axis, m, (3,)."""
    q: np.ndarray
    """Second end of its axis, m, (3,)."""
    radius: float
    """m."""

    @property
    def volume(self) -> float:
        """m^3."""
        length = float(np.linalg.norm(self.q - self.p))
        return np.pi * self.radius**2 * (length + 4 / 3 * self.radius)

    def calc_distance(self, points: np.ndarray) -> np.ndarray:
        """Returns how far points (k, 3) are outside, m, (k,); < 0: inside."""
        axis = self.q - self.p
        length2 = float(axis @ axis)
        along = np.zeros(len(points))
        if length2 > 0.0:
            along = np.clip((points - self.p) @ axis / length2, 0.0, 1.0)
        nearest = self.p + along[:, None] * axis
        return np.linalg.norm(points - nearest, axis=1) - self.radius


@dc.dataclass(frozen=True, kw_only=True)
class Coverage:
    """How well capsules cover a link's mesh."""

    share_inside: float
    """Share of the mesh's vertices in a capsule, [0, 1]."""
    farthest_outside: float
    """How far the farthest vertex is outside of all, m; 0: none is."""
    farthest_excess: float
    """How far the capsules stand out of the mesh at most, m."""
