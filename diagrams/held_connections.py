"""Connections that show one report and its scans until they get the next.

Systems that use these see the same data in all steps of a tick, whatever
arrives in the meantime. So a tick follows from what was handed in, live and
in a replay.
"""

from collections.abc import Callable, Sequence

from tofssm_drake.messages import RingScan, RobotReport, SliderCommand
from tofssm_drake.ringlink.ring_link import (
    RingLinkStatus,
    calc_measured_time,
)
from tofssm_drake.ringlink.ring_systems import shift_scan
from tofssm_drake.robots.robot_connection import RobotStatus


class HeldRobot:
    """A `RobotConnection` that shows the report it was given.

    Args:
        send: Takes commands and returns whether they were handed over; None
            drops them.
    """

    def __init__(self, send: Callable[[SliderCommand], bool] | None = None):
        self._send = send
        self.report = RobotReport()
        """The report shown."""

    def get_report(self) -> RobotReport:
        """Returns the report that it was given."""
        return self.report

    def wait_for_report(self, *, after: int, timeout: float) -> RobotReport:
        """Returns at once what `get_report` returns."""
        return self.report

    def send(self, command: SliderCommand) -> bool:
        """Hands a command on; returns whether it was handed over."""
        return self._send is not None and self._send(command)

    def get_status(self) -> RobotStatus:
        """Returns that it is connected once it has a report."""
        return RobotStatus(connected=self.report.sequence >= 0, problem="")

    def close(self) -> None:
        """Does nothing."""


class HeldRings:
    """A `RingConnection` that shows the scans it was given.

    Args:
        name: The rings, in the order of the scans.
    """

    def __init__(self, name: Sequence[str]):
        self.name = tuple(name)
        """The rings."""
        self.scans: tuple[RingScan, ...] = tuple(RingScan() for _ in name)
        """The scans shown, on the Diagram's clock."""

    def take(self, scans: tuple[RingScan, ...], *, clock_offset: float) -> None:
        """Takes those scans that are new.

        Args:
            scans: Newest of each ring, on the host's clock; empty: none.
            clock_offset: Diagram's minus host's clock, s; applies to the scans
                taken now.
        """
        self.scans = tuple(
            shift_scan(scan, clock_offset)
            if scan.sequence != held.sequence
            else held
            for scan, held in zip(scans or self.scans, self.scans, strict=True)
        )

    def get_scans(self) -> tuple[RingScan, ...]:
        """Returns the scans that it was given."""
        return self.scans

    def get_status(self) -> RingLinkStatus:
        """Returns when the scans' samples were measured."""
        return RingLinkStatus(
            source="held",
            counts={},
            measured={
                ring: calc_measured_time(scan)
                for ring, scan in zip(self.name, self.scans, strict=True)
            },
        )

    def wait_for_scans(self, timeout: float) -> bool:
        """Returns at once whether there is a scan of each ring."""
        return all(scan.sequence >= 0 for scan in self.scans)

    def close(self) -> None:
        """Does nothing."""
