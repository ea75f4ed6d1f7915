"""Why a person was touched: when each ring should have stopped the robot."""

import dataclasses as dc

import numpy as np

from tofssm_drake.messages import RobotState
from tofssm_drake.recording.samples import Samples

LOOK_BACK = 2.0
"""How far before the stop (or the contact, if none) the cause is sought, s."""
USUAL_DELAY = 0.08
"""A stop within this time is in time, s: sampling at 42 Hz, the sensors'
timing budget, and one or two samples for the filter."""
SEEN_TOLERANCE = 0.25
"""A reading farther than this behind the person is not of the person, m."""
STANDING = 0.01
"""A speed fraction below this is a standstill."""
_RESTING_SPEED = 0.01

CAUSES = {
    "gap": "the stop was late: the person was in a gap between sensors",
    "late": "the stop was late, though the person was inside a beam",
    "unseen": "no ring ever saw the person near enough to stop the robot",
    "short": "seen in time, but the distance the law keeps is too short",
    "beyond": "touched farther from every ring than its critical distance",
    "unjudged": "the law has no distance at which it stops the robot",
}


@dc.dataclass(frozen=True, kw_only=True)
class RingApproach:
    """How one ring followed the person's approach."""

    ring: str
    due: float
    """When the true distance from the link's centre first was at or under
    the critical distance of that moment, s; inf: it never was."""
    d_C: float
    """That critical distance, m; NaN: never due."""
    reacted: float
    """When the ring first was in state stop, s; inf: not before the
    contact. Earlier than `due` is possible."""
    nearest_reading: float
    """Least distance it read from `due` until it reacted, m; inf: clear."""
    sensors: tuple[int, int] | None
    """Sensors between which the person was most of that time."""
    off_around: float
    """How far outside the nearest beam the person was around the link, rad,
    in the middle of that time; negative: inside; NaN: geometry unknown, or
    nearer to the link's axis than the sensors sit, which look outwards."""
    off_along: float
    """The same along the link."""
    seen: bool
    """Whether it measured the person at any time since it was due."""

    @property
    def late(self) -> float:
        """Time from due to reaction, s; 0: in time; inf: none; NaN: not due."""
        if np.isinf(self.due):
            return np.nan
        return max(self.reacted - self.due, 0.0)


@dc.dataclass(frozen=True, kw_only=True)
class Approach:
    """What led to a contact."""

    cause: str
    """A key of `CAUSES`."""
    ring: str
    """The ring that was due first; empty: none was."""
    sensors: tuple[int, int] | None
    """Where the gap is; None: no gap, or geometry unknown."""
    late: float
    """From that ring's due time to the robot's stop, s; inf: no stop."""
    stop: float
    """When the robot was told to stop, s; inf: not before the contact."""
    person_speed: float
    """Mean speed of the person over the ground since then, m/s; NaN:
    unknown."""
    needed: float
    """Distance at which the robot would have had to be told to stop, so that
    it rests before this person arrives, m; NaN: unknown."""
    rings: tuple[RingApproach, ...]
    """None if the approach cannot be judged."""


def find_neighbours(
    *,
    azimuth: float,
    elevation: float,
    distance: float,
    beam_azimuth: np.ndarray,
    fov: float,
    radius: float,
) -> tuple[tuple[int, int], float]:
    """Finds between which two beams of a ring a point lies.

    Args:
        azimuth: Direction of the point about the ring's axis, rad.
        elevation: Direction above the ring's plane, rad.
        distance: Of the point from the ring's centre, m.
        beam_azimuth: Directions of the beams, rad, (n,), n > 0.
        fov: Full cone angle of a beam, rad.
        radius: Radius of the ring on which the sensors sit, m.

    Returns:
        ((j, k), off_beam): the neighbouring sensors, j before k in the sense
        of growing azimuth, and the angle by which the point is outside the
        nearest beam's cone, seen from that sensor, rad; negative inside; NaN
        for a point nearer to the link's axis than the sensors sit: it is
        behind all of them.
    """
    turn = 2 * np.pi
    after = np.mod(beam_azimuth - azimuth, turn)
    before = np.mod(azimuth - beam_azimuth, turn)
    sensors = int(np.argmin(before)), int(np.argmin(after))
    if distance * np.cos(elevation) < radius:
        return sensors, np.nan
    point = distance * np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    axis = np.stack(
        [
            np.cos(beam_azimuth),
            np.sin(beam_azimuth),
            np.zeros(len(beam_azimuth)),
        ],
        axis=1,
    )
    ray = point - radius * axis
    along = np.einsum("ij,ij->i", ray, axis)
    across = np.linalg.norm(ray - along[:, None] * axis, axis=1)
    angle = np.arctan2(across, along)
    return sensors, float(angle.min() - fov / 2)


def split_offset(
    *,
    azimuth: float,
    elevation: float,
    distance: float,
    beam_azimuth: np.ndarray,
    fov: float,
    radius: float,
) -> tuple[float, float]:
    """How far outside the nearest beam a point is, in its two directions.

    Args:
        azimuth: As `find_neighbours` has it, like the rest.
        elevation: As above.
        distance: As above.
        beam_azimuth: As above.
        fov: As above.
        radius: As above.

    Returns:
        (around, along): angles at the sensor whose beam points nearest in
        azimuth, around the link and along it, less half the cone, rad;
        negative: inside in that direction; NaN as for `find_neighbours`.
    """
    turn = np.mod(azimuth - beam_azimuth + np.pi, 2 * np.pi) - np.pi
    turn = turn[np.argmin(np.abs(turn))]
    level = distance * np.cos(elevation)
    if level < radius:
        return np.nan, np.nan
    out = level * np.cos(turn) - radius
    side = level * np.sin(turn)
    up = distance * np.sin(elevation)
    around = np.arctan2(abs(side), out) - fov / 2
    along = np.arctan2(abs(up), np.hypot(out, side)) - fov / 2
    return float(around), float(along)


def is_seen(samples: Samples, ring: str) -> np.ndarray:
    """Returns at which ticks a ring's reading is of the person."""
    measured = samples[f"{ring}_measured_distance"]
    true = samples[f"{ring}_true_distance"]
    return np.isfinite(measured) & (measured < true + SEEN_TOLERANCE)


def get_stop_distance(samples: Samples, ring: str) -> np.ndarray:
    """Returns the distance at which the law stops the robot, m, (k,).

    It is the signal whose bound is "stop"; NaN if the law has none.
    """
    name = samples.find_bound("stop")
    if not name:
        return np.full(len(samples), np.nan)
    return samples[f"{ring}_{name}"]


def find_due(samples: Samples, ring: str) -> np.ndarray:
    """Returns at which ticks a ring should stop the robot, by the truth.

    None if the law has no distance at which it stops.
    """
    d_C = get_stop_distance(samples, ring)
    return np.isfinite(d_C) & (samples[f"{ring}_true_distance"] <= d_C)


def find_any_due(samples: Samples) -> np.ndarray:
    """Returns at which ticks any ring should stop the robot, by the truth."""
    return np.any([find_due(samples, ring) for ring in samples.rings], axis=0)


def _find_window(samples, first):
    """Returns (tick, stop): where the approach begins, and the stop in it."""
    t = samples["t"]
    stopped = samples["robot_state"] == RobotState.STOP
    stop = None
    before = first
    if stopped[first]:
        running = np.flatnonzero(~stopped[:first])
        stop = int(running[-1]) + 1 if len(running) else 0
        before = stop
    start = int(np.searchsorted(t, t[before] - LOOK_BACK - 1e-9))
    # An earlier stop, from which the robot recovered, is another story.
    earlier = np.flatnonzero(stopped[:before])
    if len(earlier):
        start = max(start, int(earlier[-1]) + 1)
    return start, stop


def _follow_ring(samples, ring, start, first):
    t = samples["t"]
    window = slice(start, first + 1)
    is_due = np.flatnonzero(find_due(samples, ring)[window])
    has_reacted = np.flatnonzero(
        samples[f"{ring}_state"][window] == RobotState.STOP
    )
    reacted = start + int(has_reacted[0]) if len(has_reacted) else None
    due = start + int(is_due[0]) if len(is_due) else None
    sensors, around, along = None, np.nan, np.nan
    nearest, seen = np.inf, False
    if due is not None:
        end = first if reacted is None else max(reacted - 1, due)
        span = slice(due, end + 1)
        reading = samples[f"{ring}_measured_distance"][span]
        nearest = float(np.where(np.isnan(reading), np.inf, reading).min())
        seen = bool(is_seen(samples, ring)[due : first + 1].any())
        sensors, around, along = _place(samples, ring, (due + end) // 2)
    return RingApproach(
        ring=ring,
        due=np.inf if due is None else float(t[due]),
        d_C=(
            np.nan
            if due is None
            else float(get_stop_distance(samples, ring)[due])
        ),
        reacted=np.inf if reacted is None else float(t[reacted]),
        nearest_reading=nearest,
        sensors=sensors,
        off_around=around,
        off_along=along,
        seen=seen,
    )


def _place(samples, ring, tick):
    geometry = samples.metadata.get("ring_geometry", {}).get(ring)
    azimuth = float(samples[f"{ring}_true_azimuth"][tick])
    if geometry is None or not np.isfinite(azimuth):
        return None, np.nan, np.nan
    where = {
        "azimuth": azimuth,
        "elevation": float(samples[f"{ring}_true_elevation"][tick]),
        "distance": float(samples[f"{ring}_true_distance"][tick]),
        "beam_azimuth": np.array(geometry["azimuth"]),
        "fov": geometry["fov"],
        "radius": geometry["radius"],
    }
    sensors, _ = find_neighbours(**where)
    return sensors, *split_offset(**where)


def find_approach(samples: Samples, first: int) -> Approach:
    """Finds out why the robot was still moving at a contact.

    It looks back 2 s from the stop, but not past an earlier stop from which
    the robot has recovered.

    Args:
        samples: The run.
        first: First tick of the contact while moving.
    """
    t = samples["t"]
    start, stop_tick = _find_window(samples, first)
    stop = np.inf if stop_tick is None else float(t[stop_tick])
    if not samples.find_bound("stop"):
        return _make_unjudged_approach(stop)
    rings = tuple(
        _follow_ring(samples, ring, start, first) for ring in samples.rings
    )
    culprit = min(rings, key=lambda r: r.due)
    speed = needed = np.nan
    sensors = None
    if np.isinf(culprit.due):
        cause, ring, late = "beyond", "", np.nan
    else:
        ring = culprit.ring
        late = max(stop - culprit.due, 0.0)
        is_outside = (
            culprit.off_around > 0
            or culprit.off_along > 0
            # Behind the sensors.
            or (culprit.sensors is not None and np.isnan(culprit.off_around))
        )
        if late <= USUAL_DELAY:
            cause = "short"
        elif np.isinf(stop) and not any(r.seen for r in rings):
            cause = "unseen"
        else:
            cause = "gap" if is_outside else "late"
        if is_outside and cause != "short":
            sensors = culprit.sensors
        due = int(np.searchsorted(t, culprit.due - 1e-9))
        speed, needed = _calc_needed(samples, culprit, due, first)
    return Approach(
        cause=cause,
        ring=ring,
        sensors=sensors,
        late=late,
        stop=stop,
        person_speed=speed,
        needed=needed,
        rings=rings,
    )


def _make_unjudged_approach(stop):
    """Returns what is known if the law has no distance at which it stops."""
    return Approach(
        cause="unjudged",
        ring="",
        sensors=None,
        late=np.nan,
        stop=stop,
        person_speed=np.nan,
        needed=np.nan,
        rings=(),
    )


def _calc_needed(samples, culprit, due, first):
    t = samples["t"]
    if due == first:
        return np.nan, np.nan
    step = [
        samples[f"person_{axis}"][first] - samples[f"person_{axis}"][due]
        for axis in "xy"
    ]
    speed = float(np.hypot(*step) / (t[first] - t[due]))
    resting = np.flatnonzero(samples["tcp_speed"][first:] < _RESTING_SPEED)
    if not len(resting):
        return speed, np.nan
    # Until the robot is at rest the person comes that much nearer.
    missing = speed * float(t[first + resting[0]] - t[first])
    return speed, culprit.d_C + missing


def count_late_stops(samples: Samples, start: int) -> int:
    """Counts how often the robot ran on though it should have been stopped.

    That is by the truth: some ring's true distance was at or under its
    critical distance for more than `USUAL_DELAY`, and the robot was neither at
    a standstill nor told to stop.

    Args:
        samples: The run.
        start: First tick that counts (`find_start`).
    """
    t = samples["t"]
    running_on = (
        find_any_due(samples)
        & (samples["robot_state"] != RobotState.STOP)
        & (samples["speed_fraction"] >= STANDING)
    )
    running_on[:start] = False
    edge = np.diff(np.concatenate(([0], running_on.astype(int), [0])))
    begin, end = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) - 1
    return int(np.sum(t[end] - t[begin] > USUAL_DELAY)) if len(begin) else 0
