"""Summary numbers of a run, from its samples only.

Definitions:

- *Start-up* lasts until the robot state first leaves stop. The monitor
  starts stopped, because it has seen nothing yet; that is not a stop event.
- A *stop event* is a change of the robot state to stop after start-up, a
  *reduce event* one from normal to reduced. Recovering (stop to reduced,
  reduced to normal) is neither.
- An *episode* is the time from leaving normal (the first one: from slowing
  down at all) until normal lasts for 0.5 s.
  Close to a threshold the state changes every few samples: an episode is
  what a bystander would call slowing down once.
- A *standstill* begins when the speed fraction falls below 0.01 after
  start-up.
- A *contact while moving* is a stretch of ticks in which the robot touches
  the person with a point that moves faster than 0.01 m/s. Stretches less
  than 0.25 s apart are one event, because a swinging limb may leave and
  return within the same collision.
- A tick counts for the time until the next one.
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.messages import RobotState
from tofssm_drake.metrics.approach import (
    SEEN_TOLERANCE,
    Approach,
    count_late_stops,
    find_any_due,
    find_approach,
    find_neighbours,
    is_seen,
)
from tofssm_drake.metrics.task_progress import count_steps, read_task_steps
from tofssm_drake.recording.samples import Samples

MOVING_SPEED = 0.01
"""Slower than this counts as standing, m/s."""
_MERGE_TIME = 0.25
_SETTLE_TIME = 0.5
_STANDSTILL = 0.01


@dc.dataclass(frozen=True, kw_only=True)
class StateEvent:
    """One change of the robot state after start-up."""

    time: float
    """When, s."""
    before: RobotState
    after: RobotState
    duration: float
    """How long the new state lasted, s."""
    ring: str
    """The ring that decides: of those with the new robot state, the one with
    the least measured distance; empty where none is known to have it."""
    measured_distance: float
    """What that ring measured, m; inf: clear."""
    true_distance: float
    """True distance between robot and person, m."""
    tcp_speed: float
    """Speed of the tool centre point, m/s."""
    reason: str
    """The law's reason."""

    @property
    def kind(self) -> str:
        """`stop`, `reduce`, `recover`."""
        if self.after == RobotState.STOP:
            return "stop"
        if self.after < self.before:
            return "reduce"
        return "recover"


@dc.dataclass(frozen=True, kw_only=True)
class Episode:
    """One slowing down, from normal to normal again."""

    time: float
    """When it began, s."""
    duration: float
    """Until normal lasted, or until the run ended, s."""
    lowest: RobotState
    """The slowest state in it."""
    stopped: float
    """Time in state stop, s."""
    rest: bool
    """Whether the robot came to a standstill."""
    changes: int
    """Changes of state in it, including the first."""
    first: StateEvent
    """The change that began it."""
    least_true_distance: float
    """Between robot and person, m; 0: they touched; inf: nobody there."""


@dc.dataclass(frozen=True, kw_only=True)
class RingView:
    """How one ring saw the person at one instant."""

    ring: str
    measured_distance: float
    """||D|| as measured, m; inf: clear, NaN: nothing known."""
    true_distance: float
    """From the link's centre to the person's surface, m."""
    azimuth: float
    """Direction of the person's nearest point about the ring's axis, rad."""
    elevation: float
    """The same above the ring's plane, rad."""
    sensors: tuple[int, int] | None
    """The two sensors between whose beam axes that direction lies."""
    off_beam: float
    """Angle from that point to the edge of the nearest beam, as seen from
    the sensor, rad; negative inside the beam; NaN: geometry unknown."""
    seen: bool
    """Whether the ring measured the person: a valid reading no farther than
    0.25 m behind the person's true distance."""


@dc.dataclass(frozen=True, kw_only=True)
class Contact:
    """One contact of the moving robot with the person."""

    time: float
    """First tick of contact while moving, s."""
    duration: float
    """From the first to the last such tick, s."""
    max_speed: float
    """Highest speed of a touching robot point, m/s."""
    first_speed: float
    """That speed at the first tick, m/s."""
    robot_body: str
    """The robot's touching body at the first tick."""
    person: str
    """Who was touched at the first tick; empty: nobody has a name."""
    person_part: str
    """That person's touching part."""
    robot_state: RobotState
    """Robot state at the first tick."""
    views: tuple[RingView, ...]
    """What each ring made of the person at the first tick."""
    last_seen: float
    """How long before the contact a ring last saw the person, s; 0: at the
    contact; inf: never."""
    approach: Approach
    """What led to it."""

    @property
    def blind(self) -> bool:
        """Whether no ring saw the person when it was touched."""
        return not any(view.seen for view in self.views)


def calc_periods(t: np.ndarray) -> np.ndarray:
    """Returns the time that each tick counts for, s, shape of t.

    The last one counts for as long as the one before it.
    """
    if len(t) < 2:
        return np.zeros(len(t))
    return np.append(np.diff(t), t[-1] - t[-2])


def find_start(robot_state: np.ndarray) -> int:
    """Returns the first tick after start-up.

    Args:
        robot_state: (k,) states.

    Returns:
        Index of the first tick that is not stopped; k if there is none.
    """
    running = np.flatnonzero(np.asarray(robot_state) != RobotState.STOP)
    return int(running[0]) if len(running) else len(robot_state)


def find_state_events(samples: Samples) -> list[StateEvent]:
    """Returns every change of the robot state after start-up, in order."""
    state = samples["robot_state"]
    if not len(state):
        return []
    t = samples["t"]
    start = find_start(state)
    change = np.flatnonzero(np.diff(state)) + 1
    change = change[change > start]
    last = t[-1] + calc_periods(t)[-1]
    ends = np.append(t[change[1:]], last)
    ring_state = samples.ring("state")
    measured = samples.ring("measured_distance")
    events = []
    for i, end in zip(change, ends, strict=False):
        ring = -1
        deciding = np.flatnonzero(ring_state[i] == state[i])
        if len(deciding):
            distance = np.nan_to_num(measured[i, deciding], nan=np.inf)
            ring = deciding[np.argmin(distance)]
        events.append(
            StateEvent(
                time=float(t[i]),
                before=RobotState(state[i - 1]),
                after=RobotState(state[i]),
                duration=float(end - t[i]),
                ring=samples.rings[ring] if ring >= 0 else "",
                measured_distance=(
                    float(measured[i, ring]) if ring >= 0 else np.nan
                ),
                true_distance=float(samples["true_distance"][i]),
                tcp_speed=float(samples["tcp_speed"][i]),
                reason=str(samples["reason"][i]),
            )
        )
    return events


def find_episodes(
    samples: Samples, events: list[StateEvent] | None = None
) -> list[Episode]:
    """Returns the episodes of slowing down after start-up, in order.

    Args:
        samples: The run.
        events: Its `find_state_events`, if at hand.
    """
    if events is None:
        events = find_state_events(samples)
    return [_make_episode(samples, group) for group in _group_events(events)]


def _group_events(events):
    """Returns the events of each episode."""
    groups: list[list[StateEvent]] = []
    back = -np.inf
    for event in events:
        # Before the first episode normal may never have lasted.
        if event.after < event.before and (
            not groups
            or (
                event.before == RobotState.NORMAL
                and event.time - back >= _SETTLE_TIME
            )
        ):
            groups.append([])
        if groups:
            groups[-1].append(event)
        if event.after == RobotState.NORMAL:
            back = event.time
    return groups


def _make_episode(samples, group):
    t = samples["t"]
    end = group[-1].time
    if group[-1].after != RobotState.NORMAL:
        end += group[-1].duration
    rows = slice(*np.searchsorted(t, [group[0].time, end - 1e-9]))
    is_stopped = samples["robot_state"][rows] == RobotState.STOP
    distance = np.maximum(samples["true_distance"][rows], 0.0)
    return Episode(
        time=group[0].time,
        duration=end - group[0].time,
        lowest=min(event.after for event in group),
        stopped=float(calc_periods(t)[rows][is_stopped].sum()),
        rest=bool((samples["speed_fraction"][rows] < _STANDSTILL).any()),
        changes=len(group),
        first=group[0],
        least_true_distance=float(distance.min(initial=np.inf)),
    )


def count_standstills(samples: Samples) -> int:
    """Returns how often the speed fraction fell to 0 after start-up."""
    rest = samples["speed_fraction"] < _STANDSTILL
    moved = np.flatnonzero(~rest)
    if not len(moved):
        return 0
    return int(np.sum(np.diff(rest[moved[0] :].astype(int)) == 1))


def find_contacts(samples: Samples) -> list[Contact]:
    """Returns the contacts while moving, in order."""
    t = samples["t"]
    speed = samples["contact_speed"]
    ticks = np.flatnonzero(speed > MOVING_SPEED)
    if not len(ticks):
        return []
    periods = calc_periods(t)
    breaks = np.flatnonzero(
        t[ticks[1:]] - (t[ticks[:-1]] + periods[ticks[:-1]]) > _MERGE_TIME
    )
    contacts = []
    seen = np.any([is_seen(samples, ring) for ring in samples.rings], axis=0)
    for group in np.split(ticks, breaks + 1):
        first, last = int(group[0]), int(group[-1])
        before = np.flatnonzero(seen[: first + 1])
        contacts.append(
            Contact(
                time=float(t[first]),
                duration=float(t[last] + periods[last] - t[first]),
                max_speed=float(speed[first : last + 1].max()),
                first_speed=float(speed[first]),
                robot_body=_name(samples, "robot_bodies", "robot_body", first),
                person=samples.find_nearest_person(first),
                person_part=_name(
                    samples, "person_parts", "person_part", first
                ).rpartition("'s ")[2],
                robot_state=RobotState(samples["robot_state"][first]),
                views=tuple(
                    make_ring_view(samples, ring, first)
                    for ring in samples.rings
                ),
                last_seen=(
                    float(t[first] - t[before[-1]]) if len(before) else np.inf
                ),
                approach=find_approach(samples, first),
            )
        )
    return contacts


def _name(samples, table, column, tick):
    index = int(samples[column][tick])
    names = samples.metadata.get(table, [])
    if 0 <= index < len(names):
        return names[index]
    return f"{column} {index}" if index >= 0 else "unknown"


def make_ring_view(samples: Samples, ring: str, tick: int) -> RingView:
    """Returns how a ring saw the person at one tick.

    Args:
        samples: The run. `metadata["ring_geometry"][ring]` (see
            `make_ring_metadata`) says where the beams are; without it the
            view does not name sensors.
        ring: Name of the ring.
        tick: Row.
    """
    azimuth = float(samples[f"{ring}_true_azimuth"][tick])
    elevation = float(samples[f"{ring}_true_elevation"][tick])
    true = float(samples[f"{ring}_true_distance"][tick])
    sensors, off_beam = None, np.nan
    geometry = samples.metadata.get("ring_geometry", {}).get(ring)
    if geometry is not None and np.isfinite(azimuth):
        sensors, off_beam = find_neighbours(
            azimuth=azimuth,
            elevation=elevation,
            distance=true,
            beam_azimuth=np.array(geometry["azimuth"]),
            fov=geometry["fov"],
            radius=geometry["radius"],
        )
    return RingView(
        ring=ring,
        measured_distance=float(samples[f"{ring}_measured_distance"][tick]),
        true_distance=true,
        azimuth=azimuth,
        elevation=elevation,
        sensors=sensors,
        off_beam=off_beam,
        seen=bool(is_seen(samples, ring)[tick]),
    )


def calc_distance_rmse(measured: np.ndarray, true: np.ndarray) -> float | None:
    """Returns the root mean square error of distances, while in range.

    Args:
        measured: Measured distances, m; inf (clear) and NaN are left out.
        true: True distances, m, same shape; inf (nobody there, or out of
            range) is left out.

    Returns:
        The error, m; None if nothing was in range.
    """
    both = np.isfinite(measured) & np.isfinite(true)
    if not both.any():
        return None
    return float(np.sqrt(np.mean((measured[both] - true[both]) ** 2)))


def calc_detection(
    measured: np.ndarray, in_range: np.ndarray, periods: np.ndarray
) -> tuple[float | None, float]:
    """Returns how long a ring reported the person, and how long ghosts.

    Args:
        measured: Measured distances, m, (k,); inf: clear, NaN: not known.
        in_range: Whether the person was in the sensors' range, (k,).
        periods: Time that each tick counts for, s, (k,).

    Returns:
        (share, ghost_s): of the time with the person in range, the share in
        which the ring reported any distance (None: never in range); the time
        in which it reported one with nobody in range, s.
    """
    reported = np.isfinite(measured)
    near = periods[in_range].sum()
    share = periods[in_range & reported].sum() / near if near else None
    ghost = periods[~in_range & reported].sum()
    return (None if share is None else float(share)), float(ghost)


def never_started(summary: dict) -> bool:
    """Returns whether the robot was told to stop all the time.

    Args:
        summary: What `calc_summary` returned.
    """
    return summary.get("startup_s", 0.0) >= summary["simulated_s"] > 0.0


def calc_summary(samples: Samples) -> dict:
    """Returns the numbers of a run.

    Args:
        samples: The run.

    Returns:
        Plain values (JSON; None where a number does not exist):

        - `step`, what the task counts, e.g. "product placed" (empty: it
          counts nothing), `steps`, how many there are, and `steps_done`;
          `products_placed`, if these are the steps; `task_time_s`, when the
          last step was done (None: not finished); `simulated_s`, length of
          the run.
        - `stop_events`, `reduce_events`; `stopped_s`, `reduced_s`,
          `normal_s`, time in each state after start-up; `startup_s` before.
        - `slow_episodes`, `standstills`: see the top of this module.
        - `min_true_distance_m` between the surfaces of robot and person
          (0: they touched; None: nobody there).
        - `contact_while_moving_events`, `contact_while_moving_max_mps`.
        - `people`, their names; `nearest_person`, who was at that distance
          (None: nobody); `contacts_by_person`, by name.
        - `contacts`, one entry each: `time_s`, `speed_mps`, `robot_body`,
          `person`, `person_part`; `cause` (see `approach.CAUSES`), `ring`
          that should have stopped the robot first, `sensors` beside the gap,
          `late_s` (None: it never stopped).
        - `late_stops`: see `approach.count_late_stops`; `stop_due_s`, time
          after start-up in which a link's true distance is at or under its
          critical distance.
        - `max_tcp_speed_mps`.
        - `distance_rmse_m`, measured against true distance from the link
          centres, all rings pooled; `distance_rmse_by_ring_m`, each ring's;
          `distance_rmse_nearest_m`, that of the least over the rings. All
          over the ticks in which the person is in the sensors' range and the
          ring reports a distance, as it stood at that tick: the sensors'
          latency is part of the error.
        - `detection_share_by_ring`, `ghost_s_by_ring`: see `calc_detection`.
          The range is that of the sensors from the link centre, with a
          margin of 0.25 m before a reading counts as a ghost.
    """
    events = find_state_events(samples)
    return (
        _summarize_task(samples)
        | _summarize_states(samples, events)
        | _summarize_safety(samples)
        | _summarize_sensing(samples)
    )


def _summarize_task(samples):
    task, done = read_task_steps(samples.metadata), count_steps(samples)
    finished = np.flatnonzero((done >= task.steps) & bool(task.steps))
    most = int(done.max(initial=0))
    return {
        "step": task.step,
        "steps": task.steps,
        "steps_done": most,
        **({"products_placed": most} if task.step == "product placed" else {}),
        "task_time_s": (
            float(samples["t"][finished[0]]) if len(finished) else None
        ),
        "simulated_s": float(calc_periods(samples["t"]).sum()),
    }


def _summarize_states(samples, events):
    periods = calc_periods(samples["t"])
    state = samples["robot_state"]
    start = find_start(state)

    def duration(value):
        return float(periods[start:][state[start:] == value].sum())

    return {
        "startup_s": float(periods[:start].sum()),
        "stop_events": sum(e.kind == "stop" for e in events),
        "reduce_events": sum(e.kind == "reduce" for e in events),
        "stopped_s": duration(RobotState.STOP),
        "reduced_s": duration(RobotState.REDUCED),
        "normal_s": duration(RobotState.NORMAL),
        "slow_episodes": len(find_episodes(samples, events)),
        "standstills": count_standstills(samples),
    }


def _summarize_safety(samples):
    contacts = find_contacts(samples)
    distance = samples["true_distance"]
    has_person = np.isfinite(distance).any()
    start = find_start(samples["robot_state"])
    due = find_any_due(samples)[start:]
    people = samples.metadata.get("people", ())
    return {
        "min_true_distance_m": (
            max(float(distance.min()), 0.0) if has_person else None
        ),
        "contact_while_moving_events": len(contacts),
        "contact_while_moving_max_mps": max(
            (c.max_speed for c in contacts), default=0.0
        ),
        "people": list(people),
        "nearest_person": (
            samples.find_nearest_person(int(distance.argmin())) or None
            if has_person
            else None
        ),
        "contacts_by_person": {
            name: sum(c.person == name for c in contacts) for name in people
        },
        "contacts": [_summarize_contact(c) for c in contacts],
        "late_stops": count_late_stops(samples, start),
        "stop_due_s": float(calc_periods(samples["t"])[start:][due].sum()),
        "max_tcp_speed_mps": float(samples["tcp_speed"].max(initial=0.0)),
    }


def _summarize_sensing(samples):
    rings = samples.rings
    measured = samples.ring("measured_distance")
    true = samples.ring("true_distance")
    reach = np.array([_reach(samples, ring) for ring in rings])
    near = np.where(true <= reach, true, np.inf)
    nearest = np.where(np.isnan(measured), np.inf, measured).min(axis=1)
    periods = calc_periods(samples["t"])
    detection = [
        calc_detection(
            measured[:, i], true[:, i] <= reach[i] + SEEN_TOLERANCE, periods
        )
        for i in range(len(rings))
    ]
    return {
        "distance_rmse_m": calc_distance_rmse(measured, near),
        "distance_rmse_by_ring_m": {
            ring: calc_distance_rmse(measured[:, i], near[:, i])
            for i, ring in enumerate(rings)
        },
        "distance_rmse_nearest_m": calc_distance_rmse(
            nearest, near.min(axis=1, initial=np.inf)
        ),
        "detection_share_by_ring": {
            ring: share
            for ring, (share, _) in zip(rings, detection, strict=True)
        },
        "ghost_s_by_ring": {
            ring: ghost
            for ring, (_, ghost) in zip(rings, detection, strict=True)
        },
    }


def _summarize_contact(contact):
    approach = contact.approach
    return {
        "time_s": contact.time,
        "speed_mps": contact.max_speed,
        "robot_body": contact.robot_body,
        "person": contact.person or None,
        "person_part": contact.person_part,
        "cause": approach.cause,
        "ring": approach.ring or None,
        "sensors": approach.sensors and list(approach.sensors),
        "late_s": approach.late if np.isfinite(approach.late) else None,
    }


def _reach(samples, ring):
    """Farthest a ring can measure from the link's centre, m; else inf."""
    geometry = samples.metadata.get("ring_geometry", {}).get(ring)
    return geometry["max_range"] + geometry["radius"] if geometry else np.inf
