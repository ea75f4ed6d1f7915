"""Arms by the DH tables that Universal Robots publishes."""

import numpy as np
from scipy.spatial.transform import Rotation

# theta, a, d, alpha as published by Universal Robots, m.
UR10 = (
    (0, -0.612, -0.5723, 0, 0, 0),
    (0.1273, 0, 0, 0.163941, 0.1157, 0.0922),
)
UR5E = (
    (0, -0.425, -0.3922, 0, 0, 0),
    (0.1625, 0, 0, 0.1333, 0.0997, 0.0996),
)


def calc_dh_pose(q, robot, p_FT=(0.0, 0.0, 0.0)):
    """Returns a tool's pose as UR writes it, by a DH table, (6,)."""
    X = np.eye(4)
    alphas = (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0)
    for theta, a, d, alpha in zip(q, *robot, alphas, strict=True):
        c, s, ca, sa = (
            *(f(theta) for f in (np.cos, np.sin)),
            *(f(alpha) for f in (np.cos, np.sin)),
        )
        X = X @ [
            [c, -s * ca, s * sa, a * c],
            [s, c * ca, -c * sa, a * s],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    rotation = Rotation.from_matrix(X[:3, :3]).as_rotvec()
    return np.concatenate([X[:3, 3] + X[:3, :3] @ p_FT, rotation])
