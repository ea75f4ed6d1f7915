"""Frozen values that travel on the abstract ports.

A message never changes: its arrays are read-only and a copy of it is the
message itself, so that Drake's caches, logs and cloned Contexts cost nothing
and cannot disagree. Another process gets an equal one, also read-only.

`n` is the number of sensors of a ring, `m` the number of watched links.
"""

from collections.abc import Mapping
import dataclasses as dc
import enum
import functools
import types

import numpy as np


class RobotState(enum.IntEnum):
    """How fast the robot may be: the paper's TriSSM state psi (II-A).

    Of a law without such states it is what its target speed fraction amounts
    to, see `classify_target`.
    """

    STOP = 0
    REDUCED = 1
    NORMAL = 2


def classify_target(target: float) -> RobotState:
    """Returns what a target speed fraction amounts to.

    Args:
        target: 0 is stop, 1 normal, anything between reduced; whatever is not
            a number from 0 to 1 is stop.
    """
    if not 0.0 < target <= 1.0:
        return RobotState.STOP
    return RobotState.NORMAL if target == 1.0 else RobotState.REDUCED


class Reading(enum.IntEnum):
    """What one sensor's sample means to the monitor; never a number alone."""

    CLEAR = 0
    """No return: nothing is within range."""
    VALID = 1
    """A distance to something that is not the robot or its cell."""
    MASKED = 2
    """The robot or its restricted workspace is seen: ignored."""
    FAULTED = 3
    """Broken, stale or implausible: not clear."""
    HELD = 4
    """No distance now: the last one still counts, and shrinks."""


class SensorFault(enum.IntEnum):
    """Why a sensor's sample cannot be used."""

    NONE = 0
    BUS = 1
    """The sensor does not answer on its bus."""
    NO_DATA = 2
    """No new measurement for too long."""
    LATE = 3
    """Its sample is too old."""
    IMPLAUSIBLE = 4
    """A valid distance that its mode cannot measure."""
    SIGMA = 5
    """Something is there, but its distance cannot be measured."""
    HARDWARE = 6
    """It reports a failure or an unknown status."""
    FROZEN = 7
    """It repeats one distance bit for bit."""
    SELF_TEST = 8
    """The device sends made-up numbers."""
    CONTESTED = 9
    """Two devices send frames of this ring."""
    LINK = 10
    """The ring's link exceeds its limits, see `RingScan.problem`."""
    UNSEEN_SELF_HIT = 11
    """It does not see the robot where it must."""
    DEAD = 12
    """Declared dead in the scenario: ignored, the robot is slow."""
    RIDING_HIT = 13
    """Something that is not the robot moves with it: tape, a cable, a hand."""
    UNRELIABLE = 14
    """Its sample is good, but too many lately were not."""


FAULT_NAMES = {
    SensorFault.NONE: "",
    SensorFault.BUS: "bus",
    SensorFault.NO_DATA: "no new data",
    SensorFault.LATE: "late",
    SensorFault.IMPLAUSIBLE: "implausible",
    SensorFault.SIGMA: "sigma",
    SensorFault.HARDWARE: "hardware",
    SensorFault.FROZEN: "frozen",
    SensorFault.SELF_TEST: "self-test",
    SensorFault.CONTESTED: "contested",
    SensorFault.LINK: "link",
    SensorFault.UNSEEN_SELF_HIT: "unseen self-hit",
    SensorFault.DEAD: "declared dead",
    SensorFault.RIDING_HIT: "riding hit",
    SensorFault.UNRELIABLE: "fails too often",
}
"""Names of the faults in messages and reports."""


class RingHealth(enum.IntEnum):
    """Whether a ring's distance can be trusted."""

    HEALTHY = 0
    BLIND = 1
    """Every working sensor is masked, so nothing is known: reduce."""
    FAULTED = 2
    """A sensor faulted for too long, many at once, or no scan yet: stop."""
    DEGRADED = 3
    """A sensor is declared dead: reduce."""


class _Frozen:
    """Makes array fields read-only and a copy the message itself."""

    def __post_init__(self):
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def __deepcopy__(self, memo):
        return self

    def __reduce__(self):
        # Pickle restores arrays that can be written, and no mapping proxies.
        fields = {
            name: dict(value) if isinstance(value, Mapping) else value
            for name, value in vars(self).items()
        }
        return functools.partial(type(self), **fields), ()

    @classmethod
    def of_read_only(cls, **fields):
        """Makes a message from all its fields, whose arrays are read-only.

        Like the constructor, but without looking at each of them; for
        views of an array that was made read-only.
        """
        message = object.__new__(cls)
        vars(message).update(fields)
        return message


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingScan(_Frozen):
    """What a ring of sensors delivers, simulated or real."""

    sequence: int = -1
    """Counts scans from 0; -1: none yet."""
    time: float = -np.inf
    """When the scan was delivered, s."""
    sensor_time: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Centre of each sensor's integration, s, shape (n,)."""
    distance: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Measured distance, m, shape (n,); arbitrary unless status is 0 or 3."""
    status: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.uint8)
    )
    """Range status (ST API numbers; 253 bus failure, 254 no new data; the
    host's own 240 frozen, 241 self-test, 242 contested)."""
    problem: str = ""
    """Why none of this ring's samples may be used, with figures, e.g.
    "period 37 ms, configured 24 ms"; empty: nothing is wrong."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class LidarScan(_Frozen):
    """What a planar lidar of n rays delivers, simulated or real."""

    sequence: int = -1
    """Counts scans from 0; -1: none yet."""
    time: float = -np.inf
    """When the rays were measured (middle of the turn), s."""
    angles: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Directions about the scanner's z axis from its x axis, rad, (n,)."""
    ranges: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Measured distances, m, (n,); inf: nothing within range."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class MaskedScan(_Frozen):
    """A scan with the meaning of each reading and the robot's motion then."""

    scan: RingScan = dc.field(default_factory=RingScan)
    """As the monitor uses it."""
    raw: RingScan = dc.field(default_factory=RingScan)
    """Each sensor's last sample as it came, with its own time."""
    reading: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.uint8)
    )
    """`Reading` of each sensor, shape (n,)."""
    fault: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.uint8)
    )
    """`SensorFault` of each sensor, shape (n,)."""
    healthy_time: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Until when each sensor counts as having worked, s, (n,): the time of its
    last good sample less its lag (`sensing.memory`); -inf: none yet."""
    no_returns: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.int64)
    )
    """Number of samples in a row without a return, (n,)."""
    unmeasured: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.int64)
    )
    """Number of samples in a row with a target but no distance, (n,)."""
    others: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.int64)
    )
    """Number of samples in a row too far for the obstacle before, (n,)."""
    self_nearest: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Nearest hit of each sensor's rays on the twin, m, (n,); inf: none, or
    not computed, since the sample has no distance."""
    self_farthest: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Farthest such hit, m, (n,); -inf where the nearest is inf."""
    previous_distance: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0)
    )
    """The same sensor's previous sample, m, (n,); NaN: not VALID."""
    previous_time: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """When that was, s, (n,)."""
    position: np.ndarray = dc.field(default_factory=lambda: np.empty((0, 0)))
    """Measured joints at each sensor's time, rad or m, (n, j)."""
    velocity: np.ndarray = dc.field(default_factory=lambda: np.empty((0, 0)))
    """Their speeds at each sensor's time, rad/s or m/s, (n, j)."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Separation(_Frozen):
    """Distance of the person from each watched link, and how fast it shrinks.

    The same message for every sensing (rings, ideal, lidar), so that the safety
    law need not know which one is used.
    """

    name: tuple[str, ...]
    """The m watched links."""
    sequence: np.ndarray
    """Number of each link's sample, (m,); changes with each new sample."""
    time: np.ndarray
    """When the deciding sensor measured, s, (m,); -inf: never."""
    distance: np.ndarray
    """||D|| from the link's centre, m, (m,); inf: clear."""
    sensor: np.ndarray
    """Index of the deciding sensor, (m,); -1: none."""
    direction: np.ndarray
    """Unit vector from link centre to obstacle in world, (m, 3); NaN: clear."""
    link_speed: np.ndarray
    """||V_l|| of the link's centre, m/s, (m,)."""
    k_l: np.ndarray
    """Directed speed of the link, m/s, (m,); positive is closing."""
    k_o: np.ndarray
    """Directed relative speed, m/s, (m,); positive is closing."""
    health: np.ndarray
    """`RingHealth` of each link's sensing, (m,)."""
    count: np.ndarray
    """Numbers of clear, valid (or held), masked and faulted sensors, (m, 4)."""
    problem: tuple[str, ...] = ()
    """What is wrong with each link's sensing, e.g. "sensor 3: bus", (m,);
    empty: nothing, or unknown."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SafetyIndex(_Frozen):
    """Distance Safety Index of each link with its thresholds (Algorithm 1)."""

    name: tuple[str, ...]
    sequence: np.ndarray
    time: np.ndarray
    """When the deciding sensor measured, s, (m,); -inf: never."""
    d_C: np.ndarray
    """Critical distance, m, (m,)."""
    d_R: np.ndarray
    """Reduced distance, m, (m,)."""
    dsi_raw: np.ndarray
    """(C_dC / ||D||)^2 before the filter, (m,)."""
    dsi: np.ndarray
    """The same after the filter, (m,)."""
    dsi_C: np.ndarray
    """Threshold of the critical distance, (m,)."""
    dsi_R: np.ndarray
    """Threshold of the reduced distance, (m,)."""
    health: np.ndarray
    """`RingHealth`, (m,)."""
    problem: tuple[str, ...] = ()
    """As in `Separation`."""


@dc.dataclass(frozen=True, kw_only=True)
class LinkSignal:
    """What one of a law's signals is; there is a value for each link."""

    unit: str = ""
    """Of the values; empty: a plain number."""
    meaning: str = ""
    """In a few words, for whoever reads the record."""
    bound: str = ""
    """"stop" or "slow": a measured distance, m, at which the law stops or
    slows the robot. Metrics and figures compare distances with it."""
    is_drawn: bool = True
    """Whether the report draws it over time, if it is not a bound."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SpeedDecision(_Frozen):
    """What a safety law decided, and why; the same message for every law."""

    name: tuple[str, ...]
    """The m watched links."""
    target: float = 0.0
    """Speed fraction to go to, 0 to 1; anything else stops the robot."""
    link: str = ""
    """The link that decided; empty: none did."""
    reason: str = ""
    """Why the target is what it is, in one line."""
    state: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0, dtype=np.int8)
    )
    """State of each link, (m,); (0,) if the law has no such states. The names
    of the states are the law's."""
    signal: Mapping[str, np.ndarray] = dc.field(default_factory=dict)
    """Further values of each link by name, (m,); the law says what they are,
    see `LinkSignal`."""

    def __post_init__(self):
        super().__post_init__()
        signal = types.MappingProxyType(dict(self.signal))
        for values in signal.values():
            values.setflags(write=False)
        object.__setattr__(self, "signal", signal)

    @property
    def safe_target(self) -> float:
        """`target`, but 0 if that is not a number from 0 to 1."""
        return self.target if 0.0 < self.target <= 1.0 else 0.0

    @property
    def robot_state(self) -> RobotState:
        """What the target amounts to."""
        return classify_target(self.target)


RTDE_JOINTS = 6
"""Joints of every robot that RTDE is spoken with."""


def _make_unknown():
    """Returns six numbers that a robot did not send."""
    return np.full(RTDE_JOINTS, np.nan)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RobotReport(_Frozen):
    """What a real robot reports about itself in one package.

    All values belong to one control cycle. A number that the robot does not
    send is NaN, or -1 for an integer. Its driver makes it (`robots.Driver`);
    modes and states are numbered as in `robots.robot_modes`, whatever the
    brand. Of these `robot_mode`, `safety_mode` and `runtime_state` are needed:
    a robot that does not report them is held.
    """

    sequence: int = -1
    """Counts packages from 0 over all connections; -1: none yet."""
    session: int = -1
    """Counts connections from 0, and restarts of the robot's clock; within
    one of them `timestamp` only grows."""
    missed: int = 0
    """Number of packages missed so far, by the robot's clock."""
    time: float = -np.inf
    """When the package arrived, s on the host's monotonic clock."""
    timestamp: float = -np.inf
    """When it was made, s on the robot's own clock."""
    position: np.ndarray = dc.field(default_factory=_make_unknown)
    """Measured joints q, rad or m, (n,)."""
    velocity: np.ndarray = dc.field(default_factory=_make_unknown)
    """Measured joint speeds, rad/s or m/s, (n,)."""
    acceleration_commanded: np.ndarray = dc.field(default_factory=_make_unknown)
    """Target joint accelerations, rad/s^2 or m/s^2, (n,)."""
    tcp_pose: np.ndarray = dc.field(default_factory=_make_unknown)
    """Tool in the robot's base: x, y, z in m, rotation vector in rad, (6,)."""
    tcp_velocity: np.ndarray = dc.field(default_factory=_make_unknown)
    """Of the tool in the base: m/s, then rad/s, (6,)."""
    tcp_offset: np.ndarray = dc.field(default_factory=_make_unknown)
    """Tool in the flange, which is the frame of the modelled arm's last joint:
    x, y, z in m, rotation vector in rad, (6,)."""
    digital_inputs: int = -1
    """Bits 0-7 standard, 8-15 configurable, 16-17 tool."""
    digital_outputs: int = -1
    """The same for outputs."""
    robot_mode: int = -1
    """7 is running; in no other mode can it move."""
    safety_mode: int = -1
    """1 normal, 2 reduced; anything else is a stop or a fault."""
    safety_status: int = -1
    """The same on newer software, -1 on older."""
    robot_status_bits: int = -1
    """0 power on, 1 program running, 2 teach button, 3 power button."""
    safety_status_bits: int = -1
    """Bits from 0: normal, reduced, protective stopped, recovery, ..."""
    runtime_state: int = -1
    """Of the robot's program: 2 playing, 4 paused, 1 stopped, ..."""
    speed_scaling: float = np.nan
    """Factor of the robot's own trajectory limiter."""
    target_speed_fraction: float = np.nan
    """Where the speed slider is, the echo of the commanded fraction, 0 to 1."""
    products_placed: int = -1
    """How often the gripper has let go, as the robot's program counts."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SliderCommand(_Frozen):
    """What to tell the robot: its speed slider and a sign of life."""

    sequence: int = -1
    """Of the report that it answers; -1: there was none, nothing to send."""
    mask: int = 0
    """1 sets the slider, 0 leaves it alone."""
    speed_fraction: float = 0.0
    """Where to set the slider, 0 to 1; used only with mask 1."""
    heartbeat: int = 0
    """Changes with each package unless there is a fault."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SelfHitHealth(_Frozen):
    """Whether the rings see the robot where the twin says they must."""

    name: tuple[str, ...]
    """The m rings."""
    fault: np.ndarray
    """`SensorFault` of each sensor, (m, n): NONE, UNSEEN_SELF_HIT or
    RIDING_HIT."""
    problem: tuple[str, ...]
    """What is wrong with each ring, in one line; empty: nothing."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Frame(_Frozen):
    """All that a viewer needs in order to draw one instant of a run."""

    time: float = 0.0
    """Diagram's time, s."""
    position_measured: np.ndarray = dc.field(
        default_factory=lambda: np.empty(0)
    )
    """The robot's joints, rad or m, (j,)."""
    carried_objects: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Where the p objects are, see `CarriableObjects`, (p,)."""
    decision: SpeedDecision = dc.field(
        default_factory=lambda: SpeedDecision(name=())
    )
    """The law's."""
    masked_scan: Mapping[str, MaskedScan] = dc.field(default_factory=dict)
    """Newest scan of each ring, by name."""
    health: Mapping[str, str] = dc.field(default_factory=dict)
    """Words of `HealthBoard` by name; empty: there is no board."""

    def __post_init__(self):
        super().__post_init__()
        for name in ("masked_scan", "health"):
            values = types.MappingProxyType(dict(getattr(self, name)))
            object.__setattr__(self, name, values)


def make_empty_separation(name: tuple[str, ...]) -> Separation:
    """Returns the separation before any sample: nothing is known."""
    m = len(name)
    return Separation(
        name=name,
        sequence=np.full(m, -1),
        time=np.full(m, -np.inf),
        distance=np.full(m, np.inf),
        sensor=np.full(m, -1),
        direction=np.full((m, 3), np.nan),
        link_speed=np.zeros(m),
        k_l=np.zeros(m),
        k_o=np.zeros(m),
        health=np.full(m, RingHealth.FAULTED),
        count=np.zeros((m, 4), dtype=int),
    )


def make_empty_safety_index(name: tuple[str, ...]) -> SafetyIndex:
    """Returns the index before any sample: nothing is known."""
    m = len(name)
    return SafetyIndex(
        name=name,
        sequence=np.full(m, -1),
        time=np.full(m, -np.inf),
        d_C=np.full(m, np.inf),
        d_R=np.full(m, np.inf),
        dsi_raw=np.full(m, np.inf),
        dsi=np.full(m, np.inf),
        dsi_C=np.zeros(m),
        dsi_R=np.zeros(m),
        health=np.full(m, RingHealth.FAULTED),
    )


def make_empty_decision(
    name: tuple[str, ...], signals: tuple[str, ...] = ()
) -> SpeedDecision:
    """Returns the decision before anything is known: stop.

    Args:
        name: The m watched links.
        signals: Names of the law's signals; their values are NaN.
    """
    return SpeedDecision(
        name=tuple(name),
        reason="stop: nothing is known yet",
        signal={s: np.full(len(name), np.nan) for s in signals},
    )


def make_empty_self_hit_health(
    name: tuple[str, ...], sensors: int = 0
) -> SelfHitHealth:
    """Returns the health of rings with no known problem."""
    return SelfHitHealth(
        name=name,
        fault=np.full((len(name), sensors), SensorFault.NONE, dtype=np.uint8),
        problem=("",) * len(name),
    )
