"""The task: ten products picked from a table and put into a box.

The paper's robot program (section III): ten products, the base joint turns
180 degrees between pick and place, the tool peaks at 1.7 m/s at a radius of
0.82 m. A program is a nominal motion q(s) over path time s. A speed fraction
rho in [0, 1] scales the rate of s and nothing else, as a robot's speed slider
does: the path itself cannot change.
"""

import dataclasses as dc
import functools
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
)

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.tool_down import calc_tool_down_joints
from tofssm_drake.carried_objects import ON_TOOL, CarriableObjects
from tofssm_drake.errors import UserError, require, require_period
from tofssm_drake.kernels import njit
from tofssm_drake.tasks.path import (
    PathBuilder,
    ProgramPath,
    evaluate_pieces,
)
from tofssm_drake.tasks.products import X_TO, make_upright_pose


@dc.dataclass(kw_only=True)
class PickAndPlace:
    """Where the products lie and how fast the robot works."""

    # Number of products; each has its own slot on the pick table and in the
    # box.
    products: int = 10

    # Azimuth of the hover point over the pick table, deg about the base's z.
    pick_azimuth: float = -90.0

    # The base joint turns by this much from pick to place, deg.
    sweep: float = 180.0

    # Distance of both hover points from the base's axis, m (the paper's r_o).
    hover_radius: float = 0.82

    # Height of the tool at both hover points above the floor, m (assumed).
    hover_height: float = 0.95

    # Peak speed of the tool while sweeping, m/s (the paper's V_lmax). At
    # hover_radius it must keep the base joint below its 120 deg/s.
    sweep_speed: float = 1.7

    # Acceleration limit of the base joint, rad/s^2 (assumed).
    base_acceleration: float = 6.0

    # Jerk limit of the base joint, rad/s^3 (assumed).
    base_jerk: float = 80.0

    # Speed, acceleration and jerk limit of the other joints, rad/s, rad/s^2,
    # rad/s^3 (assumed).
    arm_speed: float = 2.0
    arm_acceleration: float = 15.0
    arm_jerk: float = 300.0

    # Vertical speed of the tool where it enters the last, straight part of
    # its way down to a slot, m/s (assumed), and the length of that part, m.
    # The product in the gripper clears the box's wall above it.
    approach_speed: float = 0.8
    approach_height: float = 0.125

    # How long the robot rests while the gripper closes or opens, s (assumed);
    # the gripper's signal changes in the middle of it.
    gripper_dwell: float = 0.2

    # Slots on the pick table: middle of the grid in world, m, (3,); the slots
    # are filled in rows along x.
    pick_center: list[float] = dc.field(
        default_factory=lambda: [0.0, -0.82, 0.7275]
    )
    # Distance between slots along x and y, m, (2,).
    pick_pitch: list[float] = dc.field(default_factory=lambda: [0.10, 0.10])
    # Slots per row.
    pick_columns: int = 5

    # The same for the slots in the box.
    place_center: list[float] = dc.field(
        default_factory=lambda: [0.0, 0.82, 0.7335]
    )
    place_pitch: list[float] = dc.field(default_factory=lambda: [0.08, 0.10])
    place_columns: int = 5

    # Direction of the tool's x axis (along which the fingers close) over the
    # pick table, deg about the world's z.
    pick_yaw: float = 180.0

    step: ClassVar[str] = "product placed"
    """What the task counts, in words."""

    @property
    def num_objects(self) -> int:
        """How many products the cell has."""
        return self.products

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        require(
            1 <= self.products <= 100,
            f"{where}.products: must be from 1 to 100, got {self.products}",
        )
        for name, (unit, low, high) in _RANGES.items():
            value = getattr(self, name)
            require(
                low <= value <= high,
                f"{where}.{name}: must be from {low:g} to {high:g} {unit}, "
                f"got {value:g}",
            )
        require(
            0 < abs(self.sweep) <= 270,
            f"{where}.sweep: must be within 270 deg and not 0, "
            f"got {self.sweep:g}",
        )
        self._check_joint_speeds(where)
        for name, size in _SIZES.items():
            values = getattr(self, name)
            require(
                len(values) == size and all(abs(x) <= 100.0 for x in values),
                f"{where}.{name}: must have {size} numbers within 100 m",
            )
        for name in ("pick_columns", "place_columns"):
            require(
                1 <= getattr(self, name) <= 100,
                f"{where}.{name}: must be from 1 to 100, "
                f"got {getattr(self, name)}",
            )

    def _check_joint_speeds(self, where):
        limit = np.deg2rad(120.0)
        require(
            self.sweep_speed / self.hover_radius <= limit,
            f"{where}.sweep_speed: {self.sweep_speed:g} m/s at "
            f"{self.hover_radius:g} m needs more than the base joint's "
            f"120 deg/s; at most {limit * self.hover_radius:.3f}",
        )
        require(
            self.arm_speed <= limit,
            f"{where}.arm_speed: at most {limit:.4f} rad/s (120 deg/s), "
            f"got {self.arm_speed:g}",
        )


_RANGES = {
    "pick_azimuth": ("deg", -360.0, 360.0),
    "pick_yaw": ("deg", -360.0, 360.0),
    "hover_radius": ("m", 0.01, 10.0),
    "hover_height": ("m", 0.01, 10.0),
    "sweep_speed": ("m/s", 0.001, 100.0),
    "base_acceleration": ("rad/s^2", 0.001, 1e4),
    "base_jerk": ("rad/s^3", 0.001, 1e6),
    "arm_speed": ("rad/s", 0.001, 100.0),
    "arm_acceleration": ("rad/s^2", 0.001, 1e4),
    "arm_jerk": ("rad/s^3", 0.001, 1e6),
    "approach_speed": ("m/s", 0.001, 100.0),
    "approach_height": ("m", 0.001, 10.0),
    "gripper_dwell": ("s", 0.0, 60.0),
}
"""Unit and range by setting, far wider than any robot's: planning works within
them."""
_SIZES = {
    "pick_center": 3,
    "pick_pitch": 2,
    "place_center": 3,
    "place_pitch": 2,
}
"""Numbers of each list."""


def calc_slots(
    *, center: list[float], pitch: list[float], columns: int, count: int
) -> np.ndarray:
    """Returns the middle of each slot of a grid, m, (count, 3).

    Rows run along x, `columns` slots each, and follow one another along y.
    """
    index = np.arange(count)
    rows = -(-count // columns)
    slots = np.tile(np.asarray(center, dtype=float), (count, 1))
    slots[:, 0] += (index % columns - (columns - 1) / 2) * pitch[0]
    slots[:, 1] += (index // columns - (rows - 1) / 2) * pitch[1]
    return slots


def calc_pick_slots(config: PickAndPlace) -> np.ndarray:
    """Returns where the products lie at first, m in world, (n, 3)."""
    return calc_slots(
        center=config.pick_center,
        pitch=config.pick_pitch,
        columns=config.pick_columns,
        count=config.products,
    )


def calc_place_slots(config: PickAndPlace) -> np.ndarray:
    """Returns where the products lie afterwards, m in world, (n, 3)."""
    return calc_slots(
        center=config.place_center,
        pitch=config.place_pitch,
        columns=config.place_columns,
        count=config.products,
    )


def find_products(config: PickAndPlace) -> CarriableObjects:
    """Returns the products: each has a place on the table and one in the box.

    Args:
        config: Checked settings.
    """
    pick_yaw = float(np.deg2rad(config.pick_yaw))
    place_yaw = float(np.deg2rad(config.pick_yaw + config.sweep))
    slots = zip(calc_pick_slots(config), calc_place_slots(config), strict=True)
    return CarriableObjects(
        X_TO=np.tile(X_TO, (config.products, 1, 1)),
        X_WO=np.array(
            [
                [
                    make_upright_pose(pick, pick_yaw),
                    make_upright_pose(place, place_yaw),
                ]
                for pick, place in slots
            ]
        ),
        setting=(("pick_center", "place_center"),) * config.products,
    )


def list_places(products: int) -> np.ndarray:
    """Returns the products' places after each action of the gripper.

    Product i is in its place 0 until the gripper closes for the (i + 1)-th
    time, then on the tool, and from its opening on in place 1.

    Args:
        products: Their number, p.

    Returns:
        See `ProgramPath.carried`, (2 p + 1, p).
    """
    carried = np.zeros((2 * products + 1, products))
    for i in range(products):
        carried[2 * i + 1, i] = ON_TOOL
        carried[2 * i + 2 :, i] = 1
    return carried


@njit(cache=True)
def advance_path_time(state, time, period):
    """Returns path time and its first two derivatives within a tick.

    Args:
        state: [path time, rate, change of the rate, time] at the tick,
            s, 1, 1/s, s.
        time: Now, s; at most one period after the tick.
        period: Of the tick, s.
    """
    elapsed = min(max(time - state[3], 0.0), period)
    rate = state[1] + elapsed * state[2]
    s = state[0] + elapsed * (state[1] + rate) / 2
    return s, rate, state[2]


@njit(cache=True)
def begin_tick(state, time, period, duration, speed_fraction):
    """Moves the state on to a tick and sets the rate of path time from there.

    Args:
        state: As in `advance_path_time`, of the tick before; overwritten.
        time: Of the tick, s.
        period: Of the tick, s.
        duration: Path time at the end, s, which it does not pass.
        speed_fraction: Where the rate goes within the period, clipped to
            [0, 1]; NaN counts as 0.

    Returns:
        Path time at the tick, s.
    """
    s, rate, _ = advance_path_time(state, time, period)
    # NaN fails both comparisons and stops the robot.
    wanted = min(speed_fraction, 1.0) if speed_fraction > 0.0 else 0.0
    state[0] = min(s, duration)
    state[1] = rate
    state[2] = (wanted - rate) / period
    state[3] = time
    return state[0]


@njit(cache=True)
def calc_motion_commanded(start, coefficients, state, time, period, motion):
    """Calculates q, qd, qdd of the motion at speed fraction ds/dt.

    q = q(s), qd = q' ds/dt, qdd = q'' (ds/dt)^2 + q' d2s/dt2.

    Args:
        start: As in `evaluate_pieces`, like the next.
        coefficients: Of the path.
        state: As in `advance_path_time`, like the next two.
        time: Now, s.
        period: Of the tick, s.
        motion: Written: q, qd, qdd, (3 n,).
    """
    n = coefficients.shape[2]
    s, rate, change = advance_path_time(state, time, period)
    path = np.empty((3, n))
    evaluate_pieces(start, coefficients, s, path)
    for j in range(n):
        motion[j] = path[0, j]
        motion[n + j] = path[1, j] * rate
        motion[2 * n + j] = path[2, j] * rate * rate + path[1, j] * change


def _require_approachable(config, rate, limit):
    """Raises UserError unless every joint is fast enough at a slot.

    Args:
        config: Of the program.
        rate: Of the joints per height of the tool, rad/m, (n,).
        limit: Speed limits of the joints, rad/s, (n,).
    """
    needed = np.abs(rate) * config.approach_speed
    worst = int(np.argmax(needed / limit))
    if needed[worst] > limit[worst]:
        name = "sweep_speed" if worst == 0 else "arm_speed"
        most = limit[worst] / abs(rate[worst])
        raise UserError(
            f"task.approach_speed: {config.approach_speed:g} m/s over a "
            f"slot needs {needed[worst]:.3f} rad/s of joint q_{worst}, "
            f"more than the {limit[worst]:.3f} rad/s of task.{name}; at "
            f"most {np.floor(most * 1000) / 1000:g}"
        )


def make_program_path(
    config: PickAndPlace, kinematics: ArmKinematics
) -> ProgramPath:
    """Plans the whole task: each product from its slot into its slot.

    Per product: from the hover point over the pick table to a point over the
    product, straight down, grasp, up and back to the hover point, a turn of
    the base joint alone, the same over the box, and back. Every part is a
    time-optimal motion under limits of speed, acceleration and jerk
    (Ruckig), so that q(s), q'(s), q''(s) are continuous.

    Args:
        config: Settings; checked.
        kinematics: Of the robot in its cell.

    Raises:
        UserError: If a setting is out of range or a point out of reach.
    """
    config.check("task")
    pick, place = _find_stations(config, kinematics)
    n = kinematics.num_joints
    speed = np.full(n, config.arm_speed)
    acceleration = np.full(n, config.arm_acceleration)
    jerk = np.full(n, config.arm_jerk)
    speed[0] = config.sweep_speed / config.hover_radius
    acceleration[0] = config.base_acceleration
    jerk[0] = config.base_jerk
    path = PathBuilder(pick.hover, speed, acceleration, jerk)
    close_time: list[float] = []
    open_time: list[float] = []
    for i in range(config.products):
        close_time.append(_serve(path, config, kinematics, pick, i))
        path.move(place.hover, joints=[0])
        open_time.append(_serve(path, config, kinematics, place, i))
        path.move(pick.hover, joints=[0])
    return path.finish(
        close_time,
        open_time,
        find_products(config),
        list_places(config.products),
        step_time=open_time,
    )


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Station:
    """Pick table or box, as the robot works on it."""

    slots: np.ndarray
    """Middle of each product, m in world, (n, 3)."""
    yaw: float
    """Direction of the tool's x axis, rad."""
    hover: np.ndarray
    """Joints at the hover point, rad, (n,)."""
    setting: str
    """Which setting places it, for messages."""


def _solve(kinematics, p_WT, yaw, setting):
    """Returns joints, rad, (n,); an error names the setting."""
    try:
        return calc_tool_down_joints(kinematics, p_WT, yaw)
    except UserError as error:
        raise UserError(f"task.{setting}: {error}") from None


def _find_stations(config, kinematics):
    """Returns pick table and box."""
    sweep = np.deg2rad(config.sweep)
    azimuth = np.deg2rad(config.pick_azimuth)
    pick_yaw = np.deg2rad(config.pick_yaw)
    base = kinematics.X_WB[:, 3]
    radial = kinematics.X_WB[:, :3] @ [np.cos(azimuth), np.sin(azimuth), 0]
    p_WHover = base + config.hover_radius * radial
    p_WHover[2] = config.hover_height
    hover_pick = _solve(kinematics, p_WHover, pick_yaw, "hover_radius")
    hover_place = hover_pick.copy()
    hover_place[0] += sweep
    return (
        _Station(
            slots=calc_pick_slots(config),
            yaw=pick_yaw,
            hover=hover_pick,
            setting="pick_center",
        ),
        _Station(
            slots=calc_place_slots(config),
            yaw=pick_yaw + sweep,
            hover=hover_place,
            setting="place_center",
        ),
    )


def _serve(path, config, kinematics, station, i):
    """Appends the way from hover point to slot i and back.

    Returns:
        When the gripper closes or opens, s.
    """

    def solve(p_WT):
        q = _solve(kinematics, p_WT, station.yaw, station.setting)
        for k in (0, len(q) - 1):
            turns = (station.hover[k] - q[k]) / (2 * np.pi)
            q[k] += 2 * np.pi * np.round(turns)
        return q

    slot = station.slots[i]
    up = np.array([0.0, 0.0, 1.0])
    p_above = slot + config.approach_height * up
    step = 1e-4 * up
    rate = (solve(p_above + step) - solve(p_above - step)) / (2 * 1e-4)
    _require_approachable(config, rate, path.limits[0])
    above, rise = solve(p_above), rate * config.approach_speed
    path.move(above, -rise)
    path.move(solve(slot))
    event = path.time + config.gripper_dwell / 2
    path.rest(config.gripper_dwell)
    path.move(above, rise)
    path.move(station.hover)
    return event


class TaskProgram(LeafSystem):
    """Runs the nominal motion at the commanded speed fraction.

    .. pydrake_system::

        name: TaskProgram
        input_ports:
        - speed_fraction
        output_ports:
        - motion_commanded
        - position_commanded
        - velocity_commanded
        - acceleration_commanded
        - gripper_closed
        - carried_objects
        - products_placed
        - task_done

    At each tick it reads the speed fraction (clipped to [0, 1]; NaN counts as
    0). The rate of path time goes there linearly within one period, so that
    the commanded velocity is continuous. Path time never goes back and stays
    at the end. Between ticks the motion goes on: the outputs of motion depend
    on time, so a controller may run faster than the tick.

    `position_commanded`, `velocity_commanded`, `acceleration_commanded` (n,
    rad, rad/s, rad/s^2) are parts of `motion_commanded` (3 n), which costs one
    evaluation instead of three. `gripper_closed` is 0 or 1, `carried_objects`
    says where the task's objects are (`CarriableObjects`), `products_placed`
    counts those let go of, `task_done` is 1 once the motion has ended; these
    four change at ticks only, as a robot's digital output and registers do.

    Args:
        path: The nominal motion of n joints.
        period: Control tick, s.
    """

    def __init__(
        self,
        *,
        path: ProgramPath,
        period: float = 0.008,
    ):
        super().__init__()
        require_period(period)
        self._path = path
        self._num_joints = path.coefficients.shape[2]
        self._period = period
        self._speed_fraction = self.DeclareVectorInputPort("speed_fraction", 1)
        # Path time, its rate, the rate's change, time of the tick.
        self._progress = self.DeclareDiscreteState(4)
        motion = {
            self.discrete_state_ticket(self._progress),
            self.time_ticket(),
        }
        self._motion = self.DeclareVectorOutputPort(
            "motion_commanded", 3 * self._num_joints, self._calc_motion, motion
        )
        for i, name in enumerate(("position", "velocity", "acceleration")):
            self.DeclareVectorOutputPort(
                f"{name}_commanded",
                self._num_joints,
                functools.partial(self._calc_part, part=i),
                motion,
            )
        self._gripper_closed = self.DeclareDiscreteState(1)
        self._carried = self.DeclareDiscreteState(path.carried[0])
        self._products_placed = self.DeclareDiscreteState(1)
        self._task_done = self.DeclareDiscreteState(1)
        for name, index in (
            ("gripper_closed", self._gripper_closed),
            ("carried_objects", self._carried),
            ("products_placed", self._products_placed),
            ("task_done", self._task_done),
        ):
            self.DeclareStateOutputPort(name, index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    @property
    def path(self) -> ProgramPath:
        """The nominal motion."""
        return self._path

    def count_steps(self, context: Context) -> int:
        """Returns how many steps of the task are done.

        Args:
            context: This system's.
        """
        s = context.get_discrete_state(self._progress).value()[0]
        return self._path.calc_steps_done(s)

    def _calc_motion(self, context: Context, output: BasicVector) -> None:
        calc_motion_commanded(
            self._path.start,
            self._path.coefficients,
            context.get_discrete_state(self._progress).value(),
            context.get_time(),
            self._period,
            output.get_mutable_value(),
        )

    def _calc_part(
        self, context: Context, output: BasicVector, part: int
    ) -> None:
        motion = self._motion.Eval(context)
        n = self._num_joints
        output.SetFromVector(motion[n * part : n * part + n])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        s = begin_tick(
            discrete_state.get_mutable_value(self._progress),
            context.get_time(),
            self._period,
            self._path.duration,
            self._speed_fraction.Eval(context)[0],
        )
        # Compared with the present values: the last tick of a stop has moved
        # the robot, too, and path time may have been set from outside.
        path = self._path
        has_changed = False
        for index, value in (
            (self._gripper_closed, path.calc_gripper_closed(s)),
            (self._products_placed, path.calc_products_placed(s)),
            (self._task_done, s >= path.duration),
        ):
            if value != discrete_state.get_value(index)[0]:
                discrete_state.get_mutable_value(index)[0] = value
                has_changed = True
        if has_changed:
            discrete_state.set_value(
                self._carried, path.calc_carried_objects(s)
            )
