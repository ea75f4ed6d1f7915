"""Real rings in a Diagram: the owner of the link and the source of scans."""

from collections.abc import Sequence
import dataclasses as dc

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from tofssm_drake.errors import UserError, require
from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_link import RingConnection, explain_silence


def shift_scan(scan: RingScan, offset: float) -> RingScan:
    """Returns a scan on a clock that is ahead by an offset, s."""
    if offset == 0.0 or scan.sequence < 0:
        return scan
    return dc.replace(
        scan, time=scan.time + offset, sensor_time=scan.sensor_time + offset
    )


def is_ahead(scan: RingScan, now: float) -> bool:
    """Returns whether a scan has samples from after a time, s.

    Args:
        scan: The scan.
        now: Time on the clock of the scan.
    """
    return scan.sequence >= 0 and bool((scan.sensor_time > now).any())


class RingInterfaceSystem(LeafSystem):
    """Owns the link to the rings.

    .. pydrake_system::

        name: RingInterfaceSystem

    It has neither ports nor state nor events: the link receives in a thread
    of its own. Put it into the Diagram, so that the link lives as long as the
    Diagram, and give `connection` to the subscriber.

    Args:
        connection: A `RingLink`, or one without rings.
    """

    def __init__(self, *, connection: RingConnection):
        super().__init__()
        self._connection = connection

    @property
    def connection(self) -> RingConnection:
        """The owned link."""
        return self._connection

    def DoGetGraphvizFragment(self, params):
        """Adds the source of the frames to the system's drawing."""
        source = self._connection.get_status().source
        params.header_lines += [f"ring_url={source}"]
        return super().DoGetGraphvizFragment(params)


class RingSubscriberSystem(LeafSystem):
    """Provides the scans of real rings on the same ports as TofRings.

    .. pydrake_system::

        name: RingSubscriberSystem
        input_ports:
        - clock_offset
        output_ports:
        - scan_<ring>

    At each step the newest scan of each ring moves from the link into the
    state, and nothing else reads the link: the outputs follow from the
    Context. Initialization waits until every ring has delivered.

    `clock_offset` (vector, 1) is the Diagram's minus the host's monotonic
    clock, s; 0 if unconnected. The scans' times are on the Diagram's clock as
    it was known when they were taken.

    If it is connected, a scan waits in the link while the Diagram's time, which
    is that of the robot's newest report, is before its samples: the monitor
    does not know yet where the robot was then, and would take it for a person.
    That happens when the loop is late.

    A port holds an empty scan (sequence -1) before the first one.
    """

    def __init__(
        self,
        *,
        connection: RingConnection,
        wait_timeout: float = 10.0,
        max_ahead: float = 0.004,
        name: Sequence[str],
    ):
        """Constructs the system.

        Args:
            connection: Where scans come from.
            wait_timeout: Longest wait for the first scans at initialization,
                s; 0 does not wait.
            max_ahead: How far a sample may be ahead of the Diagram's time, s;
                the occlusion mask looks as far to both sides.
            name: The rings, in the order of the link's scans.

        Raises:
            UserError: The time is out of range.
            ValueError: The link has a different number of rings.
        """
        super().__init__()
        require(
            0.0 <= wait_timeout <= 3600.0,
            f"wait_timeout: must be from 0 to 3600 s, got {wait_timeout!r}",
        )
        require(
            0.0 <= max_ahead <= 1.0,
            f"max_ahead: must be from 0 to 1 s, got {max_ahead!r}",
        )
        self._connection = connection
        self._wait_timeout = wait_timeout
        self._max_ahead = max_ahead
        num_rings = len(self._connection.get_scans())
        if num_rings != len(name):
            raise ValueError(f"link of {num_rings} rings, not of {len(name)}")
        self._clock_offset = self.DeclareVectorInputPort("clock_offset", 1)
        self._scans = [
            self.DeclareAbstractState(Value(RingScan())) for _ in name
        ]
        for ring, index in zip(name, self._scans, strict=True):
            self.DeclareStateOutputPort(f"scan_{ring}", index)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclarePerStepUnrestrictedUpdateEvent(self._take_scans)

    def _initialize(self, context: Context, state: State):
        """Waits until every ring has delivered.

        Raises:
            UserError: Some of them did not deliver.
        """
        if self._wait_timeout > 0.0:
            if not self._connection.wait_for_scans(self._wait_timeout):
                raise UserError(explain_silence(self._connection.get_status()))
        return self._take_scans(context, state)

    def _take_scans(self, context: Context, state: State):
        offset, now = 0.0, np.inf
        if self._clock_offset.HasValue(context):
            offset = self._clock_offset.Eval(context)[0]
            now = context.get_time() - offset + self._max_ahead
        status = EventStatus.DidNothing()
        for index, scan in zip(
            self._scans, self._connection.get_scans(), strict=True
        ):
            held = context.get_abstract_state(index).get_value()
            if scan.sequence != held.sequence and not is_ahead(scan, now):
                state.get_mutable_abstract_state(index).set_value(
                    shift_scan(scan, offset)
                )
                status = EventStatus.Succeeded()
        return status
