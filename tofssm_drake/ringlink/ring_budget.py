"""Whether a ring's link keeps within the time that the safety law assumes.

The law assumes a reaction time T_R from what a sensor sees to the start of
braking. The link's share of it is measured here from the frames of the last
seconds, and reported in one line with figures if it is too large.

Figures are differences of running totals, the newest minus those of one window
ago: a frame costs the same however long the window is.

A delay that is present from a device's first frame cannot be seen: it looks
like an offset of its clock (see ring_clock.py).
"""

from collections.abc import Sequence
import dataclasses as dc
import itertools
import statistics

import numpy as np

from tofssm_drake.errors import check_range
from tofssm_drake.sensors.range_status import (
    STATUS_BUS_FAILURE,
    STATUS_NO_NEW_DATA,
)

# Least time to measure, s: in less, a single late frame would weigh too much.
# A device's scans count only after 0.5 s.
_LEAST_SPAN = 0.4
# The clock's error is the median of this many slopes, of one block each. One
# of them may be a delay that came or went.
_SLOPES = 3


@dc.dataclass(frozen=True, kw_only=True)
class RingBudget:
    """Limits of a ring's link; `make_ring_budget` fits them to a scenario."""

    # Period of each sensor that the law assumes, s.
    period: float = 0.024

    # Greatest age of a sample at its frame's arrival, from the middle of its
    # integration, s; see `calc_max_age`. The default is that of the default
    # scenario.
    max_age: float = 0.034

    # Time over which everything is measured, s (*assumed*). If 1 % of the
    # frames are lost independently, three rings of 24 ms exceed `max_lost`
    # once in 21 minutes over one second, once in 5 days over two.
    window: float = 2.0

    # Greatest part of a window's frames that may be lost, and that may be
    # older than `max_age` (*assumed*). While a frame is missing the reaction
    # takes a period longer, 6 ms beyond T_R; that is tolerated for a tenth of
    # the time, beyond which it is not an accident any more.
    max_lost: float = 0.1

    # By what part a measured period may be longer (*assumed*: the device's
    # own jitter is 1 %; a sensor that skips samples doubles it).
    period_tolerance: float = 0.1

    # Greatest rate error of the device's clock against the host's, s/s
    # (*assumed*: crystals differ by 200e-6, and a millisecond of jitter looks
    # like 1000e-6). Beyond it is not a crystal, or a delay that grows.
    max_clock_error: float = 2e-3

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        for name, low, high in (
            ("period", 0.001, 10.0),
            ("max_age", 0.0, 10.0),
            ("window", 1.0, 60.0),
            ("max_lost", 0.0, 1.0),
            ("period_tolerance", 0.0, 1.0),
            ("max_clock_error", 1e-4, 0.1),
        ):
            check_range(where, name, getattr(self, name), low, high)


def calc_max_age(
    *,
    T_R: float,
    period: float,
    monitor_time: float,
    control_period: float,
    rtde_period: float,
    brake_start: float,
) -> float:
    """Returns how old a sample may be on arrival, s; 0: never in time.

    An event right after a sample is seen by the next one, a period later. That
    sample arrives, is masked, waits for the control tick and for the robot's
    cycle, and then the robot begins to brake:

        period + age + monitor_time + control_period + rtde_period
            + brake_start <= T_R

    Args:
        T_R: Reaction time of the law, s.
        period: Of a sensor, s.
        monitor_time: Computing time of mask and distances, s.
        control_period: Of the monitor, s.
        rtde_period: The robot's cycle, s.
        brake_start: From the command to the beginning of braking, s.
    """
    rest = monitor_time + control_period + rtde_period + brake_start
    return max(T_R - period - rest, 0.0)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class FrameTiming:
    """What one frame says about its link; n sensors."""

    arrival: float
    """Host's time, s."""
    device: float
    """Device's time in the frame, s, unwrapped."""
    sequence: int
    """Unwrapped."""
    age: float
    """Age of the oldest new sample on arrival, s; 0: none is new."""
    status: np.ndarray
    """Range status of each sensor, (n,)."""
    period_ms: np.ndarray
    """Reported period of each sensor, ms, (n,); 0: not known."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class _Totals:
    """Sums over all frames so far."""

    arrival: float
    device: float
    sequence: int
    received: int = 0
    late: int = 0
    """Frames older than the limit."""
    late_age: float = 0.0
    """Sum of their ages, s."""
    aged: int = 0
    """Frames with a new sample."""
    age: float = 0.0
    """Sum of their ages, s."""
    samples: np.ndarray | float = 0.0
    """Of each sensor, (4, n): number of frames with a new sample, number
    without, number with a known period, and the sum of these periods in ms."""


_NOTHING = _Totals(arrival=-np.inf, device=-np.inf, sequence=-1)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class LinkFigures:
    """What was measured over a window; NaN: not known yet."""

    span: float = 0.0
    """Time that was measured, s."""
    period: float = np.nan
    """Of the frames, s by the device's clock."""
    lost: float = np.nan
    """Part of the window's frames that never came."""
    age: float = np.nan
    """Mean age of the samples at arrival, s, of the oldest in each frame."""
    late: float = 0.0
    """Part of the window's frames with samples that were too old."""
    late_age: float = np.nan
    """Mean age of those, s."""
    sensor_period: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    """Of each sensor, s, (n,): the longer of the counted and the reported one;
    0: not known."""
    clock_error: float = 0.0
    """How much slower the device's clock is, s/s; 0: not known yet."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class LinkWatch:
    """What is known of a link; immutable."""

    totals: tuple[_Totals, ...] = ()
    """After each frame of the last window."""
    blocks: tuple[tuple[float, float], ...] = ()
    """Device's time at the start of each block of half a window, and the
    least host minus device time in it, s."""
    figures: LinkFigures = dc.field(default_factory=LinkFigures)
    """Newest."""
    last_problem: str = ""
    """What was wrong last."""
    problem_time: float = -np.inf
    """When that was, s."""
    problem: str = ""
    """What is, or within the last window was, wrong; empty: nothing."""


def restart_watch(watch: LinkWatch) -> LinkWatch:
    """Returns the watch after a restart of the device: keeps what was wrong."""
    return LinkWatch(
        last_problem=watch.last_problem,
        problem_time=watch.problem_time,
        problem=watch.problem,
    )


def update_watch(
    watch: LinkWatch, timing: FrameTiming, budget: RingBudget
) -> LinkWatch:
    """Returns what is known after one more frame.

    A problem lasts until the link has been within its limits for a whole
    window.

    Args:
        watch: What was known before.
        timing: Of a frame newer than all before.
        budget: Limits of the link.
    """
    before = watch.totals[-1] if watch.totals else _NOTHING
    totals = (*watch.totals, _add(before, timing, budget))
    first = next(
        i
        for i, old in enumerate(totals)
        if timing.arrival - old.arrival <= budget.window
    )
    totals = totals[first:]
    blocks = _add_to_blocks(watch.blocks, timing, 0.5 * budget.window)
    figures = _measure(totals, calc_clock_error(blocks), budget)
    found = "; ".join(find_problems(figures, budget))
    last_problem = found or watch.last_problem
    problem_time = timing.arrival if found else watch.problem_time
    is_over = timing.arrival - problem_time >= budget.window
    return LinkWatch(
        totals=totals,
        blocks=blocks,
        figures=figures,
        last_problem=last_problem,
        problem_time=problem_time,
        problem="" if is_over else last_problem,
    )


def find_problems(figures: LinkFigures, budget: RingBudget) -> list[str]:
    """Returns the figures beyond the budget, a text for each.

    Args:
        figures: As measured.
        budget: Limits of the link.
    """
    problems = []
    limit = (1.0 + budget.period_tolerance) * budget.period
    configured = f"configured {1e3 * budget.period:g} ms"
    if abs(figures.clock_error) > budget.max_clock_error:
        way = "slow" if figures.clock_error > 0.0 else "fast"
        problems.append(f"clock {100 * abs(figures.clock_error):.2f} % {way}")
    if figures.period > limit:
        problems.append(f"period {1e3 * figures.period:.1f} ms, {configured}")
    elif (figures.sensor_period > limit).any():
        i = int(figures.sensor_period.argmax())
        period = 1e3 * figures.sensor_period[i]
        problems.append(f"sensor {i}: period {period:.1f} ms, {configured}")
    if figures.lost > budget.max_lost:
        problems.append(
            f"{100 * figures.lost:.0f} % of frames lost in the last "
            f"{budget.window:g} s"
        )
    if figures.late > budget.max_lost:
        problems.append(
            f"samples {1e3 * figures.late_age:.0f} ms old on arrival, "
            f"{1e3 * budget.max_age:.0f} ms allowed"
        )
    return problems


def calc_clock_error(blocks: Sequence[tuple[float, float]]) -> float:
    """Returns how much slower a device's clock is, s/s; 0: not known yet.

    The fastest frames show the clock, the others their delays. A delay that
    comes or goes changes one slope of three, not the median.

    Args:
        blocks: Device's time and least host minus device time, s. The last
            one may still be growing and does not count.
    """
    whole = blocks[-2 - _SLOPES : -1]
    if len(whole) <= _SLOPES:
        return 0.0
    return statistics.median(
        (after[1] - before[1]) / (after[0] - before[0])
        for before, after in itertools.pairwise(whole)
    )


def _add_to_blocks(blocks, timing, length):
    """Returns the newest blocks, with one more frame."""
    offset = timing.arrival - timing.device
    if not blocks or timing.device - blocks[-1][0] >= length:
        return (*blocks[-1 - _SLOPES :], (timing.device, offset))
    begin, least = blocks[-1]
    return (*blocks[:-1], (begin, min(least, offset)))


def _add(before, timing, budget):
    """Returns the totals with one more frame."""
    is_idle = timing.status == STATUS_NO_NEW_DATA
    is_fresh = ~is_idle & (timing.status != STATUS_BUS_FAILURE)
    is_late = timing.age > budget.max_age
    return _Totals(
        arrival=timing.arrival,
        device=timing.device,
        sequence=timing.sequence,
        received=before.received + 1,
        late=before.late + is_late,
        late_age=before.late_age + timing.age * is_late,
        aged=before.aged + (timing.age > 0.0),
        age=before.age + timing.age,
        samples=before.samples
        + np.array([is_fresh, is_idle, timing.period_ms > 0, timing.period_ms]),
    )


def _measure(totals, clock_error, budget):
    """Returns the figures between the first and the last totals."""
    old, new = totals[0], totals[-1]
    span = new.arrival - old.arrival
    received = new.received - old.received
    if received == 0:
        return LinkFigures(clock_error=clock_error)
    frames = new.sequence - old.sequence
    # While the window fills, parts are of the frames of a whole window.
    all_frames = max(frames, budget.window / budget.period)
    period = (new.device - old.device) / frames
    late = new.late - old.late
    aged = new.aged - old.aged
    is_known = span >= _LEAST_SPAN
    return LinkFigures(
        span=span,
        period=period if is_known else np.nan,
        lost=(frames - received) / all_frames,
        age=(new.age - old.age) / aged if aged else np.nan,
        late=late / all_frames,
        late_age=(new.late_age - old.late_age) / late if late else np.nan,
        sensor_period=_measure_sensors(old, new, period, budget.window)
        if is_known
        else np.empty(0),
        clock_error=clock_error,
    )


def _measure_sensors(old, new, period, window):
    """Returns each sensor's period, s, (n,): counted or reported; 0: unknown.

    The counted period is that of the frames times their number over that of
    new samples; lost frames do not count. A sensor that was just started takes
    time to its first sample, and is counted only after half a window.
    """
    fresh, idle, known, known_ms = new.samples - old.samples
    answered = period * (fresh + idle)
    counted = answered / np.maximum(fresh, 1)
    counted[(fresh == 0) | (answered < 0.5 * window)] = 0.0
    return np.maximum(counted, 1e-3 * known_ms / np.maximum(known, 1))
