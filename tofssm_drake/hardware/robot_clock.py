"""From a robot's clock to the Diagram's."""

import math

from tofssm_drake.hardware.ring_clock import (
    ClockMap,
    start_clock_map,
    update_clock_map,
)
from tofssm_drake.messages import RobotReport

# Two crystals of 100 ppm (*assumed*).
_MAX_DRIFT = 200e-6
# The robot's clock counts its cycles; this much is rounding, s.
_ROUNDING = 1e-5


class RobotClock:
    """Makes the Diagram's time of the robot's reports.

    It is 0 at the first report and grows as the robot's clock does. Between
    two sessions, when the robot's clock tells nothing, it grows as the host's
    does. A time next to a control tick is put onto it, so that the tick's
    events are not missed by a rounding error.

    Attributes:
        time: Diagram's time of the newest report, s.
        lateness: By how much that report came later than the fastest ones of
            its session, s.
        offset: What the Diagram's clock shows more than the host's, s.

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

    def update(self, report: RobotReport) -> float:
        """Takes the next report and returns the Diagram's time of it, s."""
        if report.session != self._session:
            begin = 0.0
            if self._session >= 0:
                gap = max(report.time - self._arrival, 0.0)
                begin = self._snap(self.time + max(gap, self._period))
            self._session = report.session
            self._origin = begin - report.timestamp
            self._map = start_clock_map(device=begin, host=report.time)
        # Never back: the Simulator can not follow.
        time = max(self._snap(self._origin + report.timestamp), self.time)
        if time > self._map.device:
            self._map = update_clock_map(
                self._map,
                device=time,
                host=report.time,
                max_drift=_MAX_DRIFT,
            )
        self.time = time
        self.lateness = self._map.lateness
        self.offset = -self._map.offset
        self._arrival = report.time
        return time

    def _snap(self, time):
        tick = round(time / self._period) * self._period
        return tick if abs(time - tick) < _ROUNDING else time
