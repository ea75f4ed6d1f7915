"""A person's motion from an array, e.g. of one's own motion capture.

Used by examples/my_person.yaml: `!CustomMotion` names this function.
"""

import numpy as np

from tofssm_drake.people.motion import HumanMotion, make_motion
from tofssm_drake.people.skeleton import JOINTS, LANDMARKS
from tofssm_drake.people.walk import GeneratedWalk, make_walk


def sway(*, period: float, distance: float, swing: float) -> HumanMotion:
    """Returns a person who stands before the robot and sways to and fro.

    Args:
        period: Control tick, s; other rows between ticks are interpolated.
        distance: From the robot's base, m.
        swing: To either side, m.
    """
    # Positions over time of the landmarks, (T, l, 3), m: here one posture of
    # the shipped walk, moved sideways. Put your own array here.
    walk = make_walk(GeneratedWalk(), period)
    posture = walk.joints[0, [JOINTS.index(name) for name in LANDMARKS]]
    posture[:, :2] += [distance, 0.0] - posture[:, :2].mean(axis=0)
    time = np.arange(0.0, 4.0, period)
    landmarks = np.repeat(posture[None], len(time), axis=0)
    landmarks[:, :, 1] += swing * np.sin(2 * np.pi * time / 4.0)[:, None]
    return make_motion(
        landmarks=landmarks, dt=period, loops=True, stature=walk.stature
    )
