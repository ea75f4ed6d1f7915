"""Runs a workcell from the start to the end of its task."""

import dataclasses as dc
import time

from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Context, Diagram

from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.workcell import Workcell
from tofssm_drake.recording.samples import Samples

_TICKS_PER_STEP = 25

# Longer than the time between events, s.
_LONG = 10.0


@dc.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a run has come."""

    time: float
    """Simulated time, s."""
    steps_done: int
    """Of the task: products placed, waypoints reached."""
    wall_time: float
    """Wall time since the start, s."""
    real_time_factor: float
    """Simulated over wall time since the end of the first step, in which
    kernels are loaded, or in the first run compiled."""
    finished: bool
    """The task is done, or the time is up."""


class Run:
    """One run of a workcell, advanced in steps.

    Args:
        workcell: The workcell.
        scenario: Its scenario: seed and longest duration.
        real_time_rate: 1 runs no faster than real time, for watching; 0 runs
            as fast as possible.
    """

    def __init__(
        self,
        *,
        workcell: Workcell,
        scenario: Scenario,
        real_time_rate: float = 0.0,
    ):
        self._workcell = workcell
        self._duration = scenario.simulation_duration
        self._step = _TICKS_PER_STEP * scenario.control_period
        self._simulator = make_simulator(
            workcell.diagram, workcell.make_context(scenario.random_seed)
        )
        self._simulator.set_target_realtime_rate(real_time_rate)
        self._simulator.Initialize()
        self._context = self._simulator.get_context()
        station = workcell.station.diagram
        self._station_context = station.GetMyContextFromRoot(self._context)
        self._task_done = station.GetOutputPort("task_done")
        self._program = workcell.station.program
        self._steps = 0
        self._wall_time = 0.0
        self._first = 0.0, 0.0

    @property
    def context(self) -> Context:
        """The workcell's Context at the time reached."""
        return self._context

    def advance(self) -> Progress:
        """Advances 25 control ticks, or to the end; returns the progress."""
        start = time.perf_counter()
        self._steps += 1
        # From the count, not a sum, so that rounding errors do not add up.
        end = min(self._steps * self._step, self._duration)
        self._simulator.AdvanceTo(end)
        self._wall_time += time.perf_counter() - start
        if self._steps == 1:
            self._first = end, self._wall_time
        start_time, start_wall_time = (
            (0.0, 0.0) if self._steps == 1 else self._first
        )
        factor = (end - start_time) / (self._wall_time - start_wall_time)
        done = self._task_done.Eval(self._station_context)[0] > 0.5
        return Progress(
            time=end,
            steps_done=self._count_steps(),
            wall_time=self._wall_time,
            real_time_factor=factor,
            finished=bool(done or end >= self._duration),
        )

    def _count_steps(self):
        if self._program is None:
            return 0
        return self._program.count_steps(
            self._program.GetMyContextFromRoot(self._context)
        )

    def make_samples(self) -> Samples:
        """Returns what has been recorded so far."""
        recorder = self._workcell.recorder
        if recorder is None:
            raise ValueError("the workcell was made without samples")
        return recorder.make_samples(self._context)


def make_simulator(diagram: Diagram, context: Context) -> Simulator:
    """Makes the Simulator of a Diagram without continuous state."""
    simulator = Simulator(diagram, context)
    # There is nothing to integrate: the cheapest integrator, with a step longer
    # than any event interval.
    ResetIntegratorFromFlags(simulator, "explicit_euler", _LONG)
    return simulator
