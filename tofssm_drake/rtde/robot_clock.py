"""From a robot's clock to the Diagram's."""

import dataclasses as dc
import math
import statistics

from tofssm_drake.device_clock import (
    ClockMap,
    start_clock_map,
    update_clock_map,
)
from tofssm_drake.messages import RobotReport

# Two crystals of 100 ppm (*assumed*).
_MAX_DRIFT = 200e-6
# The robot's clock counts its cycles; this much is rounding, s.
_ROUNDING = 1e-5
# The rate is the median of this many steps of this many seconds.
_RATE_STEPS = 5
_RATE_STEP = 1.0


@dc.dataclass(frozen=True, kw_only=True)
class ClockRate:
    """How fast a robot's clock runs beside the host's.

    The fastest report of each second counts, and the median of the last five
    steps from one second to the next. So neither late reports nor a jump in
    lateness pass for a rate; a wrong rate is known after three steps, 3 to 4 s.
    """

    began: float = math.nan
    """Host's time at which the current second began, s; NaN: none yet."""
    least: float = math.inf
    """Least host minus robot time in it, s."""
    before: tuple[float, float] = (math.nan, math.nan)
    """Robot's time at the end of the second before, and its `least`, s."""
    drifts: tuple[float, ...] = (0.0,) * _RATE_STEPS
    """Gain of the host's clock in each step, s per robot's s."""

    @property
    def rate(self) -> float:
        """Robot's seconds per host's second; 1 until more is known."""
        return _calc_rate(statistics.median(self.drifts))

    @property
    def newest(self) -> float:
        """The same for the last step alone; a late report may distort it."""
        return _calc_rate(self.drifts[-1])


def _calc_rate(drift):
    return 1.0 / max(1.0 + drift, 1e-9)


def update_clock_rate(
    state: ClockRate, *, device: float, host: float
) -> ClockRate:
    """Returns what is known of the rate after one more report.

    Args:
        state: After the report before, of the same session.
        device: Robot's time in the report, s.
        host: Host's time of its arrival, s.
    """
    if math.isnan(state.began):
        return dc.replace(state, began=host, least=host - device)
    least = min(state.least, host - device)
    if host - state.began < _RATE_STEP:
        return dc.replace(state, least=least)
    then, least_then = state.before
    drifts = state.drifts
    if device > then:
        drifts = (*drifts[1:], (least - least_then) / (device - then))
    return ClockRate(
        began=host, least=math.inf, before=(device, least), drifts=drifts
    )


class RobotClock:
    """Makes the Diagram's time from the robot's reports.

    It is 0 at the first report and advances with the robot's clock, or with the
    host's between two sessions, when the robot's is unknown. A time close to a
    control tick is moved onto it, so that the tick's events are not missed by a
    rounding error.

    Attributes:
        time: Diagram's time of the newest report, s.
        lateness: By how much that report came later than the fastest ones of
            its session, s.
        offset: Diagram's minus host's clock, s.
        rate: What is known of the rates of both clocks.

    Args:
        period: Control tick, s.
    """

    def __init__(self, *, period: float):
        self._period = period
        self._session = -1
        self._origin = 0.0
        self._arrival = -math.inf
        self._map: ClockMap | None = None
        self.time = 0.0
        self.lateness = 0.0
        self.offset = 0.0
        self.rate = ClockRate()

    def update(self, report: RobotReport) -> float:
        """Takes the next report and returns its Diagram time, s."""
        clock_map = self._map
        if clock_map is None or report.session != self._session:
            begin = 0.0
            if self._session >= 0:
                gap = max(report.time - self._arrival, 0.0)
                begin = self._snap(self.time + max(gap, self._period))
            self._session = report.session
            self._origin = begin - report.timestamp
            clock_map = start_clock_map(device=begin, host=report.time)
            self.rate = ClockRate()
        # Never backwards: the Simulator cannot follow.
        time = max(self._snap(self._origin + report.timestamp), self.time)
        if time > clock_map.device:
            clock_map = update_clock_map(
                clock_map,
                device=time,
                host=report.time,
                max_drift=_MAX_DRIFT,
            )
        self.rate = update_clock_rate(
            self.rate, device=report.timestamp, host=report.time
        )
        self.time = time
        self._map = clock_map
        self.lateness = clock_map.lateness
        self.offset = -clock_map.offset
        self._arrival = report.time
        return time

    def _snap(self, time):
        tick = round(time / self._period) * self._period
        return tick if abs(time - tick) < _ROUNDING else time
