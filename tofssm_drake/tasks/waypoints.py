"""A task of waypoints, for any arm."""

import dataclasses as dc
from typing import ClassVar

import numpy as np

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.limits import ArmLimits
from tofssm_drake.arms.tool_down import calc_tool_down_joints
from tofssm_drake.carried_objects import ON_TOOL, CarriableObjects
from tofssm_drake.errors import UserError, check_range, require
from tofssm_drake.tasks.path import PathBuilder, ProgramPath
from tofssm_drake.tasks.products import X_TO, make_upright_pose

_GRIPS = ("keep", "close", "open")
# The gripper takes what is this close to the tool centre point, m: half of a
# product's width.
_REACH = 0.0275

# No cell is larger, m; no joint turns that far, rad.
_MOST = 100.0


@dc.dataclass(kw_only=True)
class Waypoint:
    """A place of the arm, by its joints or by its tool."""

    # Positions of the joints, rad or m, base to tool.
    joints: list[float] = dc.field(default_factory=list)

    # Or the tool centre point in the world, m, with the tool pointing down.
    point: list[float] = dc.field(default_factory=list)

    # Direction of the tool's x axis then, deg about the world's z.
    yaw_deg: float = 0.0

    # Part of the joints' greatest speeds on the way there.
    speed: float = 0.5

    # Rest there, s.
    dwell: float = 0.2

    # What the gripper does in the middle of the rest: "keep", "close", "open".
    gripper: str = "keep"

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            bool(self.joints) != bool(self.point),
            f"{where}: give either joints or point",
        )
        require(
            len(self.point) in (0, 3)
            and all(abs(x) <= _MOST for x in self.point),
            f"{where}.point: {self.point} must be three numbers within "
            f"{_MOST:g} m",
        )
        require(
            all(abs(q) <= _MOST for q in self.joints),
            f"{where}.joints: {self.joints} must be within {_MOST:g} rad or m",
        )
        check_range(where, "yaw_deg", self.yaw_deg, -360.0, 360.0)
        require(
            0.0 < self.speed <= 1.0,
            f"{where}.speed: {self.speed} must be above 0 and at most 1",
        )
        require(
            0.0 <= self.dwell <= 3600.0,
            f"{where}.dwell: {self.dwell} must be from 0 to 3600 s",
        )
        require(
            self.gripper in _GRIPS,
            f"{where}.gripper: {self.gripper!r} is unknown, use one of "
            f"{', '.join(_GRIPS)}",
        )


@dc.dataclass(kw_only=True)
class CarriedProduct:
    """A product (models/workcell/product.urdf) that the gripper may take.

    It is taken if its middle is at the tool centre point when the gripper
    closes, and stays where the gripper opens.
    """

    # Its middle at first, in the world, m.
    point: list[float] = dc.field(default_factory=list)

    # Its orientation then, deg about the world's z.
    yaw_deg: float = 0.0

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            len(self.point) == 3 and all(abs(x) <= _MOST for x in self.point),
            f"{where}.point: {self.point} must be three numbers within "
            f"{_MOST:g} m",
        )
        check_range(where, "yaw_deg", self.yaw_deg, -360.0, 360.0)


@dc.dataclass(kw_only=True)
class Waypoints:
    """Goes from waypoint to waypoint and back to the first, again and again."""

    PATHS: ClassVar[tuple[str, ...]] = ("file",)
    """Settings that are paths of files."""

    # YAML file that has `waypoints` and `objects`, in place of these here.
    file: str = ""

    waypoints: list[Waypoint] = dc.field(default_factory=list)

    # How many times.
    rounds: int = 1

    # Part of the joints' greatest accelerations.
    acceleration: float = 0.5

    # From rest to that acceleration, s.
    jerk_time: float = 0.1

    # What the gripper takes and lets go of.
    objects: list[CarriedProduct] = dc.field(default_factory=list)

    # Its motion does not count products.
    products: ClassVar[int] = 0

    step: ClassVar[str] = "waypoint reached"
    """What the task counts, in words."""

    @property
    def num_objects(self) -> int:
        """How many products the cell has."""
        return len(self.objects)

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            len(self.waypoints) >= 2,
            f"{where}.waypoints: must be two or more",
        )
        for i, waypoint in enumerate(self.waypoints):
            waypoint.check(f"{where}.waypoints[{i}]")
        for i, product in enumerate(self.objects):
            product.check(f"{where}.objects[{i}]")
        require(
            1 <= self.rounds <= 10_000,
            f"{where}.rounds: {self.rounds} must be from 1 to 10000",
        )
        require(
            0.0 < self.acceleration <= 1.0,
            f"{where}.acceleration: {self.acceleration} must be above 0 and "
            "at most 1",
        )
        require(
            0.001 <= self.jerk_time <= 10.0,
            f"{where}.jerk_time: {self.jerk_time} must be from 0.001 to 10 s",
        )


def make_waypoint_path(
    config: Waypoints,
    kinematics: ArmKinematics,
    limits: ArmLimits,
    where: str = "task",
) -> ProgramPath:
    """Plans the motion: time-optimal between rests, under the arm's limits.

    Args:
        config: Checked settings.
        kinematics: Of the arm in its cell.
        limits: Of its joints.
        where: Path of keys, for the message.

    Raises:
        UserError: A waypoint is out of reach, or the gripper closes where no
            object is.
    """
    targets = _find_targets(config, kinematics, limits, where)
    acceleration = config.acceleration * limits.acceleration
    path = PathBuilder(
        targets[0],
        limits.speed,
        acceleration,
        acceleration / config.jerk_time,
    )
    close_time, open_time, step_time = [], [], []
    handling = _Handling(config.objects)
    is_closed = False
    for i in range(config.rounds * len(targets)):
        j = i % len(targets)
        waypoint = config.waypoints[j]
        if i:
            path.limits = (waypoint.speed * limits.speed, *path.limits[1:])
            path.move(targets[j])
            step_time.append(path.time)
        now = path.time + 0.5 * waypoint.dwell
        X_WT = kinematics.calc_tcp_pose(targets[j])
        if waypoint.gripper == "close" and not is_closed:
            close_time.append(now)
            handling.close(X_WT, f"{where}.waypoints[{j}].gripper")
            is_closed = True
        elif waypoint.gripper == "open" and is_closed:
            open_time.append(now)
            handling.open(X_WT, f"waypoints[{j}]")
            is_closed = False
        if waypoint.dwell > 0.0:
            path.rest(waypoint.dwell)
    path.move(targets[0])
    return path.finish(
        close_time,
        open_time,
        handling.make_objects(),
        handling.carried,
        step_time=[*step_time, path.time],
    )


class _Handling:
    """Where the gripper leaves the objects, action by action.

    Args:
        products: Those of the task.
    """

    def __init__(self, products):
        self.carried = [np.zeros(len(products))]
        """See `ProgramPath.carried`."""
        self._places = [
            [
                (
                    make_upright_pose(
                        product.point, np.deg2rad(product.yaw_deg)
                    ),
                    f"objects[{i}].point",
                )
            ]
            for i, product in enumerate(products)
        ]

    def close(self, X_WT, where):
        """Closes the gripper on the object at the tool."""
        now = self.carried[-1].copy()
        self.carried.append(now)
        if not self._places:
            return
        distance = [
            float(np.linalg.norm(places[int(k)][0][:, 3] - X_WT[:, 3]))
            for places, k in zip(self._places, now, strict=True)
        ]
        i = int(np.argmin(distance))
        require(
            distance[i] <= _REACH,
            f"{where}: closes {distance[i]:.3f} m from object {i}, the "
            f"nearest; must be within {_REACH:g} m of one",
        )
        now[i] = ON_TOOL

    def open(self, X_WT, setting):
        """Leaves what hangs on the tool where it is."""
        now = self.carried[-1].copy()
        self.carried.append(now)
        for i in np.flatnonzero(now == ON_TOOL):
            X_WO = X_WT[:, :3] @ X_TO
            X_WO[:, 3] += X_WT[:, 3]
            places = self._places[i]
            known = [k for k, (X, _) in enumerate(places) if (X == X_WO).all()]
            if not known:
                places.append((X_WO, setting))
            now[i] = known[0] if known else len(places) - 1

    def make_objects(self):
        """Returns the objects with all their places."""
        if not self._places:
            return CarriableObjects.make_empty()
        k = max(map(len, self._places))
        # An object with fewer places than others has its last one again.
        rows = [p + [p[-1]] * (k - len(p)) for p in self._places]
        return CarriableObjects(
            X_TO=np.tile(X_TO, (len(rows), 1, 1)),
            X_WO=np.array([[X for X, _ in row] for row in rows]),
            setting=tuple(tuple(name for _, name in row) for row in rows),
        )


def _find_targets(config, kinematics, limits, where):
    """Returns the joints at each waypoint."""
    n = kinematics.num_joints
    targets: list[np.ndarray] = []
    for i, waypoint in enumerate(config.waypoints):
        at = f"{where}.waypoints[{i}]"
        if waypoint.point:
            try:
                q = calc_tool_down_joints(
                    kinematics,
                    np.array(waypoint.point),
                    np.deg2rad(waypoint.yaw_deg),
                    guess=targets[-1] if targets else None,
                )
            except UserError as error:
                raise UserError(f"{at}.point: {error}") from None
        else:
            q = np.array(waypoint.joints, dtype=float)
        require(
            len(q) == n, f"{at}.joints: has {len(q)} values, but the arm {n}"
        )
        low, high = limits.lower, limits.upper
        bad = np.flatnonzero((q < low) | (q > high) | ~np.isfinite(q))
        require(
            len(bad) == 0,
            f"{at}: joint {bad[0] if len(bad) else 0} would be at "
            f"{q[bad[0]] if len(bad) else 0:.4g}, beyond its limits",
        )
        targets.append(q)
    return targets
