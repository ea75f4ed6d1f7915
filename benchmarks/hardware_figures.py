"""What a run on hardware took, from its record and the robot's log."""

import dataclasses as dc
from pathlib import Path

from mcap.reader import make_reader
import numpy as np
import yaml

from tofssm_drake.diagrams.ring_decoder import make_ring_decoder
from tofssm_drake.diagrams.scenario import Scenario, change_scenario
from tofssm_drake.recording.run_record import RecordedTick, RunReader
from tofssm_drake.ringlink.ring_systems import is_ahead

# The first ticks, while everything is still starting up, s.
_START = 1.0
# As RingSubscriberSystem has it, s.
_MAX_AHEAD = 0.004


@dc.dataclass(frozen=True, kw_only=True)
class Figures:
    """What was measured; times in s."""

    period: float
    """Of the robot's reports."""
    answer: np.ndarray
    """From the arrival of a package to the write of its answer."""
    round_trip: np.ndarray
    """From the robot's cycle to the answer's arrival at the robot."""
    to_host: np.ndarray
    """The part of it before the arrival of the package."""
    to_robot: np.ndarray
    """The part of it after the write."""
    frame: np.ndarray
    """From a frame's arrival to the first command computed from it."""
    change: np.ndarray
    """The same where the command began to fall in that tick."""
    missed: int
    """Packages that never arrived, by the robot's clock."""
    left_out: int
    """Those of them that the robot did not send because it was late itself."""
    unanswered: int
    """Packages that were not answered because a newer one had arrived."""
    ticks: int
    busy: float
    """Fraction of one core's time that the whole program took."""


def read_figures(path: Path, notes: dict | None = None) -> Figures:
    """Returns the figures of a record.

    Args:
        path: Of the record.
        notes: What `clocked_robot.py` wrote; None: nothing of the robot's side
            is known.
    """
    reader = RunReader(path)
    ticks = [t for t in reader.read_ticks() if t.time > _START]
    period = reader.run["scenario"]["audit"]["rtde_period"]
    trips = _find_trips(ticks, notes)
    frame, change = _find_frames(path, reader.run, ticks)
    sequence = np.array([t.report.sequence for t in ticks])
    elapsed = ticks[-1].sent - ticks[0].sent
    return Figures(
        period=period,
        answer=np.array([t.sent - t.report.time for t in ticks]),
        round_trip=trips.sum(axis=1),
        to_host=trips[:, 0],
        to_robot=trips[:, 2],
        frame=frame,
        change=change,
        missed=ticks[-1].report.missed - ticks[0].report.missed,
        left_out=_count_left_out(ticks, notes, period),
        unanswered=int((np.diff(sequence) - 1).sum()),
        ticks=len(ticks),
        busy=(ticks[-1].busy - ticks[0].busy) / elapsed,
    )


def _find_trips(ticks: list[RecordedTick], notes):
    """Returns the parts of each round trip, s, (k, 3)."""
    if notes is None:
        return np.empty((0, 3))
    stepped, received = dict(notes["stepped"]), dict(notes["received"])
    return np.array(
        [
            (
                t.report.time - stepped[t.report.timestamp],
                t.sent - t.report.time,
                received[t.command.heartbeat] - t.sent,
            )
            for t in ticks
            if t.command.heartbeat in received
        ]
    ).reshape(-1, 3)


def _count_left_out(ticks, notes, period):
    """Returns how many cycles ended together with the next one.

    That is how a late robot catches up; it sends only the last one.
    """
    if notes is None:
        return 0
    first, last = ticks[0].report.timestamp, ticks[-1].report.timestamp
    times = [t for stamp, t in notes["stepped"] if first <= stamp <= last]
    return int((np.diff(times) < 0.2 * period).sum())


def _find_frames(path, run, ticks):
    """Returns how long frames took to reach a command, and to change one.

    The frames are decoded again, which reproduces the scans.
    """
    arrivals = _decode_frames(path, run)
    frame, change = [], []
    taken = set()
    newest, fractions = -np.inf, (0.0, 0.0)
    for tick in ticks:
        now = tick.time - tick.clock_offset + _MAX_AHEAD
        for ring, scan in enumerate(tick.scans):
            key = ring, scan.sequence
            if key in taken or key not in arrivals or is_ahead(scan, now):
                continue
            taken.add(key)
            newest = max(newest, arrivals[key])
            # The first tick did not see earlier ones at once.
            if arrivals[key] > ticks[0].sent:
                frame.append(tick.sent - arrivals[key])
        fraction = tick.state["speed_fraction"]
        if fractions[0] <= fractions[1] > fraction:
            change.append(tick.sent - newest)
        fractions = fractions[1], fraction
    return np.array(frame), np.array(change)


def _decode_frames(path, run):
    """Returns when each frame came, s, by ring and sequence of its scan."""
    decoder = make_ring_decoder(
        change_scenario(
            Scenario(), yaml.safe_dump(run["scenario"]), source="the record"
        )
    )
    arrivals = {}
    with path.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(
            topics=["/rings/received"]
        ):
            arrival = message.publish_time * 1e-9 - run["epoch"]
            if decoder.receive_datagram(message.data, arrival):
                for ring, scan in enumerate(decoder.scans):
                    arrivals.setdefault((ring, scan.sequence), arrival)
    return arrivals
