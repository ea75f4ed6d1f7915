"""Which sensors and links failed in a run, why, and for how long."""

import dataclasses as dc
import re

import numpy as np

from tofssm_drake.messages import (
    FAULT_NAMES,
    RingHealth,
    RobotState,
    SensorFault,
)
from tofssm_drake.recording.samples import Samples


@dc.dataclass(frozen=True, kw_only=True)
class FaultedSensor:
    """Faults of one sensor with one cause."""

    ring: str
    sensor: int
    cause: str
    """In the words of `FAULT_NAMES`."""
    scans: int
    """In how many scans."""
    longest: float
    """Longest time from first to last of consecutive ones, s."""
    first: float
    """When it was first reported, s."""


def find_faulted_sensors(samples: Samples) -> list[FaultedSensor]:
    """Returns what went wrong with each sensor, ring by ring.

    A single lost sample counts too: its longest time is 0 s.
    """
    found = []
    for ring, scan in samples.scan.items():
        fault = scan.get("fault")
        if fault is None:
            continue
        for sensor, cause in zip(*_find_pairs(fault), strict=True):
            is_faulted = fault[:, sensor] == cause
            starts, ends = _find_stretches(is_faulted)
            time = scan["time"]
            found.append(
                FaultedSensor(
                    ring=ring,
                    sensor=int(sensor),
                    cause=FAULT_NAMES[SensorFault(cause)],
                    scans=int(is_faulted.sum()),
                    longest=float((time[ends] - time[starts]).max()),
                    first=float(time[starts[0]]),
                )
            )
    return found


@dc.dataclass(frozen=True, kw_only=True)
class FaultedLink:
    """What stopped or slowed the robot because a link could not be trusted."""

    link: str
    cause: str
    """The law's reason as first recorded, or the name of the link's health."""
    duration: float
    """For how long it decided in all, s."""
    first: float
    """When it was first reported, s."""


def find_faulted_links(samples: Samples) -> list[FaultedLink]:
    """Returns for what faults of links the robot stopped or was slow.

    A faulted link stops the robot, whoever else does; a degraded one counts
    while it decides. Faults of the ring's link (loss, age, clock), of the
    self-hit watch and of sensors alike. Reasons that differ in numbers only are
    one.
    """
    t = samples["t"]
    if not len(t):
        return []
    tick = np.diff(t, append=t[-1])
    found: dict[tuple[str, str], FaultedLink] = {}
    for i, link in enumerate(samples.rings):
        starts, ends = _find_stretches(_is_at_fault(samples, i))
        for start, end in zip(starts, ends, strict=True):
            cause = _tell_cause(samples, i, start)
            key = link, re.sub(r"\d+(\.\d+)?", "", cause)
            before = found.get(key)
            found[key] = FaultedLink(
                link=link,
                cause=before.cause if before else cause,
                duration=float(tick[start : end + 1].sum())
                + (before.duration if before else 0.0),
                first=before.first if before else float(t[start]),
            )
    return sorted(found.values(), key=lambda fault: fault.first)


def _is_at_fault(samples, i):
    """Returns whether a link's health stopped or slowed the robot, (k,).

    Without its first sample a link is faulted, too; that is no fault yet.
    """
    link = samples.rings[i]
    health = samples[f"{link}_health"]
    state = samples["robot_state"]
    is_faulted = (health == RingHealth.FAULTED) & (state == RobotState.STOP)
    is_degraded = (health == RingHealth.DEGRADED) & (state < RobotState.NORMAL)
    decides = _find_deciding(samples) == i
    return (is_faulted | (is_degraded & decides)) & (
        samples[f"{link}_sequence"] >= 0
    )


def _find_deciding(samples):
    """Returns the index of the link that decides, -1: none, (k,)."""
    if "deciding_link" in samples:
        return samples["deciding_link"]
    # Of an earlier version.
    return np.full(len(samples), -1)


def _tell_cause(samples, i, row):
    """Returns why a link is at fault, in the law's words if it decides."""
    if _find_deciding(samples)[row] == i and samples["reason"][row]:
        return str(samples["reason"][row])
    health = samples[f"{samples.rings[i]}_health"][row]
    return RingHealth(int(health)).name.lower()


def _find_pairs(fault):
    """Returns sensors and causes that occur, (k,) each, in order."""
    pairs = [
        (sensor, cause)
        for sensor in range(fault.shape[1])
        for cause in np.unique(fault[:, sensor])
        if cause != SensorFault.NONE
    ]
    return tuple(zip(*pairs, strict=True)) or ((), ())


def _find_stretches(flags):
    """Returns the first and last index of each stretch of true ones."""
    edges = np.diff(np.concatenate([[0], flags.astype(int), [0]]))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1


def calc_ages(samples: Samples, ring: str) -> tuple[float, float]:
    """Returns how old a ring's measurement was, median and greatest, s.

    The age at each tick of the sample that the law worked on; NaN if there
    was none.
    """
    age = samples["t"] - samples[f"{ring}_sample_time"]
    age = age[np.isfinite(age)]
    if not len(age):
        return np.nan, np.nan
    return float(np.median(age)), float(age.max())
