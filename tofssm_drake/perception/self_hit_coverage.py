"""Which sensors can be verified during a task by seeing the robot."""

from typing import Protocol

import numpy as np

from tofssm_drake.path_times import list_times
from tofssm_drake.perception.self_hit_watch import Look, SelfHitModel, expect
from tofssm_drake.perception.self_hits import make_no_expectation, must_see

# 200 s step by step; longer tasks are looked at here and there.
_MOST_LOOKS = 2000


class Motion(Protocol):
    """What is known of a task: where the robot is when, and what it carries."""

    @property
    def duration(self) -> float:
        """Path time at the end, s."""

    def calc_motion(self, s: float) -> np.ndarray:
        """Returns joints, their speeds and accelerations, (3, j)."""

    def calc_carried_objects(self, s: float) -> np.ndarray:
        """Returns the place of each object, or ON_TOOL, (p,)."""


def calc_verifiable_share(
    model: SelfHitModel, path: Motion, *, step: float = 0.1
) -> np.ndarray:
    """Returns the part of a task in which each sensor must see the robot.

    Args:
        model: of the rings on the twin.
        path: the task's.
        step: between looks, s of path time.

    Returns:
        0 to 1, ring by ring, (m, n); 0 for sensors that are declared dead.
    """
    m, n = len(model.name), model.num_sensors
    times = list_times(path.duration, step=step, most=_MOST_LOOKS)
    count = np.zeros((m, n))
    for time in times:
        q, qd, _ = path.calc_motion(time)
        look = Look(
            rings=tuple(range(m)),
            which=np.ones(m * n, dtype=bool),
            sampled=np.ones(m * n, dtype=bool),
            time=np.zeros(m * n),
            distance=np.zeros(m * n),
            status=np.zeros(m * n, dtype=np.uint8),
            q=q,
            qd=qd,
            spread=0.0,
            carried=path.calc_carried_objects(time),
        )
        expectation = make_no_expectation(m * n)
        expect(model, look, model.believed, expectation)
        count += must_see(expectation, *model.limits[1:]).reshape(m, n)
    count[model.is_dead.reshape(m, n)] = 0.0
    return count / len(times)


def tell_coverage(model: SelfHitModel, share: np.ndarray) -> list[str]:
    """Returns lines that say what self-hits cannot verify of the rings.

    Args:
        model: has the least share that counts.
        share: from `calc_verifiable_share`, (m, n).

    Returns:
        One line for each ring that cannot be verified at all, and one for each
        other ring with unverifiable sensors; empty if all can be verified.
    """
    lines = []
    for name, part in zip(model.name, share, strict=True):
        seen = part >= model.config.min_share
        if not seen.any():
            lines.append(f"{name} ring cannot be verified by self-hits")
        elif not seen.all():
            sensors = ", ".join(map(str, np.flatnonzero(~seen)))
            lines.append(
                f"{name} ring: self-hits verify {seen.sum()} of {len(seen)} "
                f"sensors, not {sensors}"
            )
    return lines
