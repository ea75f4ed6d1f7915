"""The fault table: what goes wrong, and how soon it must stop the robot.

A `Row` is a fault, and a `Moment` says who is there when it begins.
`measure_row` lets it happen in a copy of the process, so that each begins
with the robot at full speed at the same place of its path, in lock-step.
"""

from collections.abc import Callable
import dataclasses as dc
import enum
import math
import multiprocessing
import re

from dh_arms import UR5E, calc_dh_pose
from lockstep import CYCLE, Cell, Times, Visitor
import numpy as np
from paper_cell import RINGS
from pydrake.math import RigidTransform, RotationMatrix

from tofssm_drake.ringlink.ring_fault_injection import FAULTS
from tofssm_drake.ringlink.ring_frame import (
    FLAG_RESTARTED,
    SEQUENCE_BITS,
    TIME_BITS,
)
from tofssm_drake.robots.robot_modes import SafetyMode
from tofssm_drake.sensors import ring_mount
from tofssm_drake.sensors.range_status import STATUS_VALID

# Who sees the person: a sensor that sees nothing of robot and cell meanwhile.
RING, SENSOR = "tool", 0
OTHER = 5
# In each ring, the sensor whose beam hits the robot's own arm nearly all the
# time.
SEES_ROBOT = 2
# Where somebody is if a fault begins during a stop, m from the sensor, and how
# long after a fault somebody comes in sight, s.
NEAR = 0.6
DELAY = 0.1
# A robot that has stood still for this long, s, is assumed to stay there;
# beside a person it is watched for longer, s.
LINGER = 0.1
WATCHED = 1.0
# The arm stands still by then, ms after the fault, if the fault alone does
# not stop it: somebody has come within d_C, and the law's ramp is over.
HELD_LIMIT = 120.0
COMES_LIMIT = 750.0
# A fault that alone stops the robot later than this, ms, leaves it to the law.
SLOW = 2000.0


class Moment(enum.Enum):
    """Who is there when a fault begins."""

    ALONE = "nobody is there"
    HELD = "somebody at 0.6 m, whom one sensor sees, holds the robot"
    COMES = "somebody comes in sight of that sensor 0.1 s later"


@dc.dataclass(frozen=True, kw_only=True)
class Row:
    """One fault."""

    name: str
    act: Callable[[Cell], None]
    """Injects it."""
    says: str = ""
    """What the runner reports while nobody is there; a pattern."""
    zero: float = math.inf
    """With nobody there, the slider must be at 0 by then, ms after the fault;
    inf: it need not."""
    still: float = math.inf
    """The arm must stand still by then, ms; inf: it may go on while nobody is
    there. With a person it may be as late, if that is later than HELD_LIMIT
    or COMES_LIMIT."""
    why: str = ""
    """Why, with nobody there, it may go on or takes that long."""
    duration: float = 0.5
    """With nobody there, an arm that may go on is watched for this long, s."""
    person: float = 0.0
    """With a person the arm must stand still by then, ms after the fault, if
    that is later than the other limits."""
    rise: float = 0.0
    """By how much the slider may rise while somebody holds the robot."""
    open: tuple[Moment, ...] = ()
    """Moments at which it does not stop the robot although it should: `finder`
    is to do that. Once it is found, remove it and give the limits."""
    finder: str = ""


# What a row injects.


def _inject(kind: str, ring: str, *sensors: int) -> Callable[[Cell], None]:
    return lambda cell: cell.inject(kind, ring, *sensors)


def _set(**values) -> Callable[[Cell], None]:
    """Sets attributes of the simulated robot."""
    return lambda cell: vars(cell.robot).update(values)


def _offset_joint(joint: int, angle: float) -> Callable[[Cell], None]:
    return lambda cell: cell.robot.joint_offset.__setitem__(joint - 1, angle)


def _report(**values) -> Callable[[Cell], None]:
    """Lets the robot report something else."""

    def act(cell):
        cell.change_outputs = lambda outputs: outputs | values

    return act


def _report_joint(joint: int, **values: float) -> Callable[[Cell], None]:
    """Lets it report something else for one joint."""

    def act(cell):
        def change(outputs):
            changed = {n: list(outputs[n]) for n in values}
            for name, value in values.items():
                changed[name][joint - 1] = value
            return outputs | changed

        cell.change_outputs = change

    return act


def _report_other_arm(cell: Cell) -> None:
    """Reports the tool's pose of a UR5e with the same joints and tool."""

    def change(outputs):
        q, p_FT = outputs["actual_q"], outputs["tcp_offset"][:3]
        pose = tuple(calc_dh_pose(q, UR5E, p_FT).tolist())
        return outputs | {"actual_TCP_pose": pose}

    cell.change_outputs = change


def _with_ring(act: Callable[[Cell], None]) -> Callable[[Cell], None]:
    """Injects a fault that shows only when the robot is to stop."""

    def both(cell):
        act(cell)
        cell.inject("bus", RING)

    return both


def _swap(one: str, other: str) -> Callable[[Cell], None]:
    """Each of two rings sends what the other one sees."""
    numbers = {
        RINGS.index(one): RINGS.index(other),
        RINGS.index(other): RINGS.index(one),
    }

    def change(frame):
        return dc.replace(frame, ring=numbers.get(frame.ring, frame.ring))

    return lambda cell: setattr(cell, "change", change)


def _spoil_near(status: int, mm: int) -> Callable[[Cell], None]:
    """Everything nearer than a limit gets another status."""

    def change(frame):
        is_near = (frame.status == STATUS_VALID) & (frame.mm < mm)
        return dc.replace(
            frame,
            status=np.where(is_near, status, frame.status).astype(np.uint8),
        )

    return lambda cell: setattr(cell, "change", change)


def _brown_out(ring: str, silence: float) -> Callable[[Cell], None]:
    """A device goes down and restarts, with clock and sequence at 0."""

    def act(cell):
        end, first = cell.time + silence, []

        def change(frame):
            if frame.ring != RINGS.index(ring):
                return frame
            if cell.time < end:
                return None
            first.append(frame)
            since = first[0]
            return dc.replace(
                frame,
                flags=FLAG_RESTARTED if len(first) == 1 else 0,
                sequence=(frame.sequence - since.sequence) % 2**SEQUENCE_BITS,
                time_us=(frame.time_us - since.time_us) % 2**TIME_BITS,
            )

        cell.change = change

    return act


def _mount(ring: str, X_LL: RigidTransform) -> Callable[[Cell], None]:
    """A ring is elsewhere on its link than in the model.

    Args:
        ring: Its name.
        X_LL: Where it is, in the frame in which it should be.
    """

    def mount_ring(plant, inspector, name):
        mount = ring_mount.find_ring_mount(plant, inspector, name)
        if name != ring:
            return mount
        X_FL = mount.X_FS[0] @ mount.X_LS[0].inverse()
        X_LS = [X_LL @ X for X in mount.X_LS]
        return dc.replace(mount, X_LS=X_LS, X_FS=[X_FL @ X for X in X_LS])

    return lambda cell: cell.mount(mount_ring)


def _turn(ring: str, degrees: float) -> Callable[[Cell], None]:
    R = RotationMatrix.MakeZRotation(math.radians(degrees))
    return _mount(ring, RigidTransform(R, [0.0, 0.0, 0.0]))


# The self-hit watch: 8 looks of 72 ms, then the law's ramp.
_SELF_HIT = 1150
_FOUND = "unseen self-hit|misplaced|do not fit"
_EACH = tuple(Moment)
# 0.4 s are the law's ramp from full speed; then there is a frame to wait for
# and the robot's cycle.
_RAMP = 450
# One sensor may be faulted for 0.3 s.
_FAULT_TIME = 745
_EMPTY = {
    "says": _FOUND,
    "still": _SELF_HIT,
    "why": "looks like an empty room; found because it does not see the robot",
}
# What it sees of the robot may stop it earlier.
_MISPLACED = {
    "says": f"{_FOUND}|tool at",
    "still": _SELF_HIT,
    "why": "found by what it sees of the robot",
}
# A sensor that sees nothing of the robot proves nothing by its silence.
_UNPROVEN = {
    "finder": "this sensor never sees the robot in the default task: only a "
    "check motion could show it something",
}
_EMPTY_ONE = _UNPROVEN | {"open": _EACH, "why": "looks like an empty room"}
_WRONG_ONE = _UNPROVEN | {
    "open": (Moment.ALONE,),
    "why": "a person counts, but as farther away",
}
_BLIND_TO_THE_ROBOT = {
    "says": _FOUND,
    "still": _SELF_HIT,
    "why": "found because it does not see the robot",
}
_NOTHING_THERE = "a sensor that repeats that nothing is there proves nothing"
_GLITCH = {
    "why": "each glitch stops the robot for a moment, and is over",
    "duration": 1.5,
}


def _ring(kind, says="", still=math.inf, *, ring=RING, **more) -> Row:
    """Returns a fault of a whole ring."""
    return Row(
        name=f"ring `{kind}`"
        + (f" of {ring}" if ring != RING else "")
        + f": {FAULTS[kind]}",
        act=_inject(kind, ring),
        says=says,
        zero=still,
        still=still,
        **more,
    )


def _sensor(
    kind, says="", still=math.inf, *, ring=RING, sensors=(SENSOR,), **more
) -> Row:
    """Returns a fault of one sensor, or of two."""
    who = "sensor" if len(sensors) == 1 else "two sensors"
    where = f" of {ring}, number {sensors[0]}"
    is_usual = ring == RING and sensors[0] == SENSOR
    return Row(
        name=f"{who} `{kind}`{'' if is_usual else where}: {FAULTS[kind]}",
        act=_inject(kind, ring, *sensors),
        says=says,
        zero=still,
        still=still,
        **more,
    )


def _all_rings(kind, says="", still=math.inf, **more) -> Row:
    """Returns a fault of all rings at once."""

    def act(cell):
        for ring in RINGS:
            cell.inject(kind, ring)

    return Row(
        name=f"all rings `{kind}`: {FAULTS[kind]}",
        act=act,
        says=says,
        zero=still,
        still=still,
        **more,
    )


_OLD = "tool sample is .* s old, deadline 0.100 s"
_ALL = "tool is faulted, all sensors: "
_PERIOD = "tool is faulted, .*period .* ms, configured 24 ms"

RING_ROWS: tuple[Row, ...] = (
    _ring("silent", _OLD, 520),
    _ring("silent", "base sample is .* s old", 520, ring="base"),
    _ring("corrupt", _OLD, 520),
    _ring("duplicate", _OLD, 540),
    _ring(
        "frozen",
        f"{_ALL}frozen",
        1100,
        why="25 repeated distances of all sensors together: the fewer see "
        "something, the longer it takes",
    ),
    _ring("late", "tool", 520),
    _ring("implausible", _ALL, _RAMP),
    _ring("bus", f"{_ALL}bus", _RAMP),
    _ring("bus", "elbow is faulted, all sensors: bus", _RAMP, ring="elbow"),
    _ring("restart", _OLD, 520),
    _ring("status1", f"{_ALL}sigma", _RAMP),
    _ring("status2", **_EMPTY),
    _ring("status3", "tool at 0.0", _RAMP),
    _ring("status4", **_EMPTY),
    _ring("status5", f"{_ALL}hardware", _RAMP),
    _ring("status6", f"{_ALL}sigma", _RAMP),
    _ring("status7", **_EMPTY),
    _ring("status8", f"{_ALL}hardware", _RAMP),
    _ring("status9", f"{_ALL}sigma", _RAMP),
    _ring("status12", f"{_ALL}sigma", _RAMP),
    _ring("status13", "tool at 0.0", _RAMP),
    _ring("status14", f"{_ALL}hardware", _RAMP),
    _ring("status240", f"{_ALL}hardware", _RAMP),
    _ring("status253", f"{_ALL}bus", _RAMP),
    _ring("status254", "tool is faulted", 520),
    _ring("status255", f"{_ALL}hardware", _RAMP),
    _ring("stuck0", "tool", _RAMP),
    _ring("stuck27", "tool", _RAMP),
    _ring("stuck100", "tool", _RAMP),
    _ring("stuck300", "tool", _RAMP),
    _ring("stuck500", "tool", _RAMP),
    _ring("far", _ALL, _RAMP),
    _ring("old", f"{_ALL}late", _RAMP),
    _ring("glitch", **_GLITCH),
    _ring("blind", **_EMPTY),
    _ring("latency30", "tool is faulted, samples 46 ms old", 680),
    _ring("latency45", "tool is faulted, samples 61 ms old", 700),
    _ring("latency1000", _OLD, 520),
    _ring(
        "loss10",
        "tool is faulted, 11 % of frames lost",
        7500,
        why="up to a tenth is tolerated: the reaction is a period longer",
    ),
    _ring(
        "clockfast",
        "tool is faulted, clock .* % fast",
        2600,
        why="within the first second its samples look no older than they are",
    ),
    _ring(
        "clockslow",
        "tool is faulted, samples .* old|tool is faulted, clock .* slow",
        2700,
        why="samples look older than they are: the law stops sooner",
    ),
    _ring("period37", _PERIOD, 960),
    _ring("slow48", _PERIOD, 650),
    _ring("slow72", _PERIOD, 560),
    _ring("slow100", _PERIOD, 510),
    _ring("reversed", **_MISPLACED),
    _ring("shifted", **_MISPLACED),
    _ring("gain", **_MISPLACED),
    _ring("offset", **_MISPLACED),
    _all_rings("silent", "base sample is .* s old", 520),
    _all_rings("bus", "base is faulted, all sensors: bus", _RAMP),
    _all_rings("frozen", "is faulted, all sensors: frozen", 1100),
    _all_rings("blind", **_EMPTY),
    Row(
        name="brown-out: a ring is silent for 0.3 s, then restarts",
        act=_brown_out(RING, 0.3),
        says=_OLD,
        zero=520,
        still=520,
    ),
    Row(
        name="range status 1 for all that is nearer than 0.5 m",
        act=_spoil_near(1, 500),
        why="nobody is near: nothing is wrong yet",
    ),
    Row(
        name="rings tool and elbow swapped",
        act=_swap("tool", "elbow"),
        **_MISPLACED,
    ),
    Row(
        name="rings base and elbow swapped",
        act=_swap("base", "elbow"),
        **_MISPLACED,
    ),
    *(
        Row(
            name=f"ring tool turned by {angle} degrees",
            act=_turn("tool", angle),
            **_MISPLACED,
        )
        for angle in (5, 20, 45)
    ),
)
"""Faults of rings and of their links."""

_ONE = "tool is faulted, sensor 0: "
_TWO = (SENSOR, OTHER)

SENSOR_ROWS: tuple[Row, ...] = (
    _sensor(
        "frozen",
        open=(Moment.ALONE, Moment.COMES),
        why=_NOTHING_THERE,
        **_UNPROVEN,
    ),
    _sensor("implausible", _ONE, _FAULT_TIME),
    _sensor("bus", f"{_ONE}bus", _FAULT_TIME),
    _sensor(
        "bus",
        "base is faulted, sensor 4: bus",
        _FAULT_TIME,
        ring="base",
        sensors=(4,),
    ),
    _sensor("status1", f"{_ONE}sigma", 475),
    _sensor("status2", **_EMPTY_ONE),
    _sensor("status3", "tool at 0.0", _RAMP),
    _sensor("status4", **_EMPTY_ONE),
    _sensor("status5", f"{_ONE}hardware", _FAULT_TIME),
    _sensor("status6", f"{_ONE}sigma", 475),
    _sensor("status7", **_EMPTY_ONE),
    _sensor("status8", f"{_ONE}hardware", _FAULT_TIME),
    _sensor("status9", f"{_ONE}sigma", 475),
    _sensor("status12", f"{_ONE}sigma", 475),
    _sensor("status13", "tool at 0.0", _RAMP),
    _sensor("status14", f"{_ONE}hardware", _FAULT_TIME),
    _sensor("status240", f"{_ONE}hardware", _FAULT_TIME),
    _sensor("status253", f"{_ONE}bus", _FAULT_TIME),
    _sensor("status254", "tool is faulted, sensor 0", _FAULT_TIME),
    _sensor("status255", f"{_ONE}hardware", _FAULT_TIME),
    _sensor("stuck0", "tool at 0.0", _RAMP),
    _sensor("stuck27", "tool at 0.0", _RAMP),
    _sensor("stuck100", "tool at 0.1", _RAMP),
    _sensor("stuck300", "tool at 0.3", _RAMP),
    _sensor("stuck500", "tool at 0.5", _RAMP),
    _sensor("stuck0", "tool at 0.0", _RAMP, sensors=_TWO),
    _sensor("stuck27", "tool at 0.0", _RAMP, sensors=_TWO),
    _sensor("stuck100", "tool at 0.1", _RAMP, sensors=_TWO),
    _sensor("stuck300", "tool at 0.3", _RAMP, sensors=_TWO),
    _sensor("stuck500", "tool at 0.5", _RAMP, sensors=_TWO),
    _sensor("far", _ONE, _FAULT_TIME),
    _sensor("old", f"{_ONE}late", _FAULT_TIME),
    _sensor("glitch", **_GLITCH),
    _sensor("blind", **_EMPTY_ONE),
    *(
        _sensor(
            "blind", ring=ring, sensors=(SEES_ROBOT,), **_BLIND_TO_THE_ROBOT
        )
        for ring in RINGS
    ),
    _sensor("slow48", _PERIOD, 650),
    _sensor("slow72", _PERIOD, 560),
    _sensor("slow100", _PERIOD, 510),
    _sensor("gain", **_WRONG_ONE),
    _sensor("offset", **_WRONG_ONE),
)
"""Faults of single sensors: of the one that sees the person."""

_POSE = "robot: reported tool is .* mm and .* deg from where the modelled"
_ENDS = {"zero": 300, "still": 500}
# The watchdog's 0.2 s and the pause's.
_WATCHDOG = 440
_FOLLOWS_LAW = "nothing is wrong while nobody is there to stop for"

ROBOT_ROWS: tuple[Row, ...] = (
    Row(
        name="robot's reports 0.15 s late",
        act=lambda cell: setattr(cell, "delay", 0.15),
        says="sample is .* s old",
        zero=660,
        still=660,
    ),
    Row(
        name="robot's reports 0.3 s late",
        act=lambda cell: setattr(cell, "delay", 0.3),
        says="robot: reports come [23].. ms late",
        zero=340,
        still=_WATCHDOG,
    ),
    Row(
        name="robot silent",
        act=lambda cell: setattr(cell, "is_silent", True),
        still=_WATCHDOG,
        why="its own watchdog stops it",
    ),
    *(
        Row(
            name=f"robot's clock jumps by {seconds:+g} s",
            act=lambda cell, s=seconds: cell.robot.shift_clock(s),
            why="a new session: the slider is at 0 for 0.2 s, then rises to "
            "the law's fraction",
            # The law's own ramp is not over yet.
            rise=0.03,
        )
        for seconds in (5.0, -5.0)
    ),
    *(
        Row(
            name=f"robot's clock {what}",
            act=_set(clock_rate=rate),
            says=f"robot: its clock runs {rate:.3f} times as fast",
            zero=4200,
            still=4400,
            why="three steps of a second are needed to know a rate",
        )
        for what, rate in (("twice as fast", 2.0), ("3 % fast", 1.03))
    ),
    *(
        Row(
            name=f"program {what}",
            act=act,
            says=f"program: {what}",
            zero=32,
            still=220,
        )
        for what, act in (
            ("paused", lambda cell: cell.robot.pause()),
            ("stopped", lambda cell: cell.robot.stop()),
        )
    ),
    *(
        Row(
            name=mode.name.lower().replace("_", " "),
            act=lambda cell, mode=mode: cell.robot.set_safety_mode(mode),
            says="safety mode: .* stop",
            zero=32,
            still=120,
        )
        for mode in (
            SafetyMode.PROTECTIVE_STOP,
            SafetyMode.SAFEGUARD_STOP,
            SafetyMode.ROBOT_EMERGENCY_STOP,
        )
    ),
    Row(
        name="a ring, and the slider does not obey",
        act=_with_ring(_set(slider_frozen=True)),
        says="slider does not obey: at 1.00, not",
        still=550,
    ),
    Row(
        name="slider does not obey",
        act=_set(slider_frozen=True),
        why=_FOLLOWS_LAW,
        person=900,
    ),
    Row(
        name="a ring, and the arm ignores its slider",
        act=_with_ring(_set(ignores_slider=True)),
        says="arm does not slow: joint . at .* rad/s, the slider",
        zero=_RAMP,
        still=1300,
    ),
    Row(
        name="arm ignores its slider",
        act=_set(ignores_slider=True),
        why=_FOLLOWS_LAW,
        person=1300,
    ),
    *(
        Row(
            name=f"a ring, and the arm gets no slower than {fraction}",
            act=_with_ring(_set(slowest_fraction=fraction)),
            says="arm does not slow: joint . at .* rad/s, the slider",
            zero=_RAMP,
            still=1300,
        )
        for fraction in (0.6, 0.1)
    ),
    *(
        Row(
            name=f"joint {joint} is reported {angle} rad off",
            act=_offset_joint(joint, angle),
            says=_POSE,
            **_ENDS,
        )
        for joint, angle in ((1, 0.1), (1, 0.4), (6, 0.35))
    ),
    *(
        Row(
            name=f"joints are reported {ms} ms late",
            act=_set(joints_late=1e-3 * ms),
            says=_POSE,
            **_ENDS,
        )
        for ms in (50, 100)
    ),
    Row(
        name="joints and tool's pose are reported as 0",
        act=_report(actual_q=(0.0,) * 6, actual_TCP_pose=(0.0,) * 6),
        says="robot: joint 1 went from",
        zero=32,
        still=230,
    ),
    *(
        Row(
            name=f"a joint's {what} is reported as NaN",
            act=_report_joint(3, **{name: math.nan}),
            still=_WATCHDOG,
            why="such a report is rejected; its own watchdog stops the robot",
        )
        for what, name in (("angle", "actual_q"), ("speed", "actual_qd"))
    ),
    Row(
        name="tool's pose is reported as 0",
        act=_report(actual_TCP_pose=(0.0,) * 6),
        says=_POSE,
        **_ENDS,
    ),
    Row(
        name="tool's pose is that of a UR5e",
        act=_report_other_arm,
        says=_POSE,
        **_ENDS,
    ),
    Row(
        name="tool's pose is reported as NaN",
        act=_report(actual_TCP_pose=(math.nan,) * 6),
        still=_WATCHDOG,
        why="such a report is rejected; its own watchdog stops the robot",
    ),
    Row(
        name="tool is set up 100 mm longer than modelled",
        act=lambda cell: cell.robot.tcp_offset.__setitem__(2, 0.1),
        why="a setting of the robot, which moves no ring; reported at the "
        "start",
    ),
)
"""Faults of the robot and of its link."""

ROWS = (*RING_ROWS, *SENSOR_ROWS, *ROBOT_ROWS)


def make_cell(moment: Moment) -> Cell:
    """Returns a cell just before a fault.

    Args:
        moment: Who is there.
    """
    cell = Cell()
    cell.wait_for_full_speed()
    if moment == Moment.HELD:
        cell.visitor = Visitor(ring=RING, sensor=SENSOR, start=cell.time)
        while cell.visitor.calc_distance(cell.time) > NEAR:
            cell.step()
    return cell


def measure_row(cell: Cell, row: Row, moment: Moment, shift: int = 0) -> Times:
    """Injects a fault and returns its effect; the cell itself is unchanged.

    Args:
        cell: From `make_cell`.
        row: The fault.
        moment: Of the cell.
        shift: Cycles to wait before it: the moment between two samples matters.
    """

    def measure():
        for _ in range(shift):
            cell.step()
        row.act(cell)
        duration, linger = 1e-3 * row.still + LINGER, LINGER
        if moment == Moment.HELD:
            duration, linger = WATCHED, math.inf
        elif moment == Moment.COMES:
            cell.visitor = Visitor(
                ring=RING, sensor=SENSOR, start=cell.time + DELAY
            )
            duration = 1e-3 * calc_person_limit(row, moment) + LINGER
        elif math.isinf(row.still):
            duration = row.duration
        return cell.measure(duration + CYCLE / 2, linger=linger, may_end=True)

    return call_in_copy(measure)


def call_in_copy(function: Callable):
    """Returns what a function returns in a copy of this process.

    Its side effects stay there.

    Raises:
        RuntimeError: It raised, or the copy died.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(function, sender))
    process.start()
    sender.close()
    try:
        is_well, result = receiver.recv()
    except EOFError:
        is_well, result = False, "the copy died"
    process.join()
    if not is_well:
        raise RuntimeError(result)
    return result


def _answer(function, sender):
    try:
        sender.send((True, function()))
    except Exception as error:
        sender.send((False, repr(error)))


def calc_person_limit(row: Row, moment: Moment) -> float:
    """Returns by when the arm must stand still if somebody is there, ms."""
    limit = HELD_LIMIT if moment == Moment.HELD else COMES_LIMIT
    # A fault that takes longer than a person to come must not be waited for.
    still = row.still if row.still < SLOW else 0.0
    return max(limit, still, row.person)


def find_failure(row: Row, moment: Moment, times: Times) -> str:
    """Returns what violates a row's limits, in one line; "": nothing.

    Args:
        row: The fault.
        moment: Who was there.
        times: Its effect.
    """
    if moment == Moment.ALONE:
        if not re.search(row.says, times.health):
            return f"it says {times.health!r}"
        if math.isinf(row.still) and row.why and not row.open:
            return ""
        limit = row.still
        if times.zero > 1e-3 * row.zero:
            return f"slider at 0 after {times.zero} s"
    else:
        limit = calc_person_limit(row, moment)
        if moment == Moment.HELD and times.rise > row.rise:
            return f"slider rose by {times.rise:.2f} while somebody was there"
    # inf: it never does.
    if math.isinf(times.still) or times.still > 1e-3 * limit:
        return f"standstill after {times.still} s"
    return ""
