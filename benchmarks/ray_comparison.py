"""Times ray casters against each other, one state after the other.

Time is the processor time of the only thread, so that other processes on the
machine do not count. All casters take turns, a few states at a time.
"""

import dataclasses as dc
import importlib.util
import time

import numpy as np
from ray_peers import (
    MujocoMultiRay,
    MujocoRangefinders,
    NumpyCaster,
    PybulletCaster,
)
from ray_scene import NUM_STATES, Scene

_BLOCK = 16


class FastPath:
    """This project's caster with poses as the monitor's twin has them."""

    name = "RayCaster, known poses"

    def __init__(self, scene: Scene):
        self._scene = scene

    def prepare(self, i: int):
        """Does nothing: no state depends on the previous one."""

    def update(self, i: int):
        """Poses the frames in state i."""
        self._X_WF = self._scene.calc_poses(i)

    def cast(self, i: int):
        """Casts the rays."""
        scene = self._scene
        return scene.caster.cast_bundles(scene.bundles, self._X_WF)

    def get_distances(self, result) -> np.ndarray:
        """Returns the distances, (m, k)."""
        return result[0]


class QueryObjectPath(FastPath):
    """The same with the poses from a Context by way of a QueryObject."""

    name = "RayCaster, QueryObject"

    def update(self, i: int):
        """Sets Drake's Context to state i and gathers the poses."""
        self._X_WF = self._scene.query_poses(i)


PEERS = (
    ("mujoco", MujocoRangefinders),
    ("mujoco", MujocoMultiRay),
    ("pybullet", PybulletCaster),
)


# How many times faster than which library, at least.
HOLD = {
    False: {
        FastPath.name: {"PyBullet": 30.0, "MuJoCo": 10.0},
        QueryObjectPath.name: {"PyBullet": 4.0, "MuJoCo": 1.3},
    },
    True: {FastPath.name: {"PyBullet": 4.0, "MuJoCo": 4.0}},
}


@dc.dataclass(frozen=True, kw_only=True)
class Row:
    """What one caster takes, us, and how often it differs."""

    name: str
    update: float
    """Median of the state's update."""
    median: float
    """Update and cast."""
    p99: float
    differing: float
    """Share of the rays whose distance is off by more than 5 mm."""


def find_missing_peers() -> list[str]:
    """Returns the packages that are not installed."""
    return sorted(
        {name for name, _ in PEERS if not importlib.util.find_spec(name)}
    )


def compare(scene: Scene, *, meshes: bool, rounds: int = 4) -> list[Row]:
    """Returns a row for each caster that can be had, ours first.

    Args:
        scene: The scene.
        meshes: Whether it has meshes, which the NumPy one cannot cast.
        rounds: How often all states are gone through.
    """
    missing = find_missing_peers()
    casters = [FastPath(scene), QueryObjectPath(scene)]
    if not meshes:
        casters.append(NumpyCaster(scene))
    casters += [make(scene) for name, make in PEERS if name not in missing]
    differing = [_compare_distances(scene, caster) for caster in casters]
    took = np.empty((len(casters), 2, rounds, NUM_STATES))
    clock = time.thread_time
    for r in range(rounds):
        for start in range(0, NUM_STATES, _BLOCK):
            for c, caster in enumerate(casters):
                caster.prepare(start)
                for i in range(start, start + _BLOCK):
                    begin = clock()
                    caster.update(i)
                    middle = clock()
                    caster.cast(i)
                    took[c, :, r, i] = middle - begin, clock() - begin
    took *= 1e6
    return [
        Row(
            name=caster.name,
            update=float(np.median(took[c, 0])),
            median=float(np.median(took[c, 1])),
            p99=float(np.quantile(took[c, 1], 0.99)),
            differing=differing[c],
        )
        for c, caster in enumerate(casters)
    ]


def _compare_distances(scene, caster) -> float:
    """Returns how many of the rays differ from our caster's."""
    caster.prepare(0)
    count = 0
    for i, X_WF in enumerate(scene.X_WF):
        expected, _ = scene.caster.cast_bundles(scene.bundles, X_WF)
        caster.update(i)
        found = caster.get_distances(caster.cast(i))
        with np.errstate(invalid="ignore"):
            same = (found == expected) | (np.abs(found - expected) < 5e-3)
        count += np.count_nonzero(~same)
    return count / (len(scene.X_WF) * expected.size)


def find_ratios(rows: list[Row], caster: str) -> dict[str, float]:
    """Returns how many times faster one caster is than each library.

    Of a library that is used in more than one way the fastest counts.
    """
    ours = next(row.median for row in rows if row.name == caster)
    ratios = {}
    for row in rows:
        library = row.name.split(",")[0]
        if library != "RayCaster":
            ratio = row.median / ours
            ratios[library] = min(ratio, ratios.get(library, np.inf))
    return ratios


def format_table(rows: list[Row]) -> str:
    """Returns a Markdown table."""
    fast, query = rows[0].median, rows[1].median
    lines = [
        "| caster | update | median | p99 | to known poses | to QueryObject"
        " | differ by > 5 mm |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.name} | {row.update:.0f} us | {row.median:.0f} us |"
        f" {row.p99:.0f} us | {row.median / fast:.1f} x |"
        f" {row.median / query:.1f} x |"
        f" {100 * row.differing:.2f} % |"
        for row in rows
    ]
    return "\n".join(lines)
