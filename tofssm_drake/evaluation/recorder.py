"""Recorder of one row per control tick."""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem, ValueProducer

from tofssm_drake.evaluation.samples import RING_COLUMNS, Samples, narrow_type
from tofssm_drake.evaluation.truth import TruthLayout
from tofssm_drake.messages import (
    RINGS,
    MaskedScan,
    Reading,
    SafetyIndex,
    Separation,
    make_empty_safety_index,
    make_empty_separation,
)

_ROWS_PER_BLOCK = 4096


class _Table:
    """Rows of numbers in blocks, so that appending never copies old rows."""

    def __init__(self, width):
        self._width = width
        self._blocks = []
        self._used = _ROWS_PER_BLOCK

    def __len__(self):
        return (len(self._blocks) - 1) * _ROWS_PER_BLOCK + self._used

    def append(self):
        """Returns a new row to be filled in."""
        if self._used == _ROWS_PER_BLOCK:
            self._blocks.append(np.empty((_ROWS_PER_BLOCK, self._width)))
            self._used = 0
        row = self._blocks[-1][self._used]
        self._used += 1
        return row

    def to_array(self):
        if not self._blocks:
            return np.empty((0, self._width))
        return np.concatenate(
            [*self._blocks[:-1], self._blocks[-1][: self._used]]
        )


class _Log:
    """Everything one Context recorded."""

    def __init__(self, width, num_rings, num_sensors):
        self.table = _Table(width)
        self.reason = []
        # (time, MaskedScan) per ring; taken apart when the run is over.
        self.scans = [[] for _ in range(num_rings)]
        self.sequence = [-1] * num_rings
        self.last_ring_states = None
        self.last_separation = None
        self.last_dsi = None
        self.held = None


_HELD = (
    "measured_distance",
    "closing_speed",
    "sensor",
    "health",
    "sequence",
    "sample_time",
    "clear",
    "valid",
    "masked",
    "faulted",
    "d_C",
    "d_R",
    "dsi_raw",
    "dsi",
    "dsi_C",
    "dsi_R",
)


def pack_safety(separation: Separation, dsi: SafetyIndex) -> np.ndarray:
    """Lays the two messages out as one row, ring by ring within each column.

    Args:
        separation: Separation of m links.
        dsi: Their safety index.

    Returns:
        (16 m,) values in the order of the recorder's columns. The distance
        of a link without any sample is NaN, because nothing is known.
    """
    return np.concatenate(
        (
            np.where(separation.sequence < 0, np.nan, separation.distance),
            separation.k_o,
            separation.sensor,
            separation.health,
            separation.sequence,
            separation.time,
            separation.count.T.ravel(),
            dsi.d_C,
            dsi.d_R,
            dsi.dsi_raw,
            dsi.dsi,
            dsi.dsi_C,
            dsi.dsi_R,
        )
    )


def _unpack_scans(scans, num_sensors):
    """Returns the table of one ring's scans, as `Samples.scan` has it."""
    shape = (len(scans), num_sensors)
    distance = np.empty(shape, dtype=np.float32)
    reading = np.empty(shape, dtype=np.int8)
    for i, (_, scan) in enumerate(scans):
        distance[i] = scan.scan.distance
        reading[i] = scan.reading
    distance[reading == Reading.CLEAR] = np.inf
    distance[reading == Reading.FAULTED] = np.nan
    return {
        "time": np.array([time for time, _ in scans]),
        "distance": distance,
        "reading": reading,
    }


def _repeat_reasons(reasons, rows):
    """Returns a column from (number of rows so far, reason) pairs."""
    column = np.empty(rows, dtype=object)
    for start, reason in reasons:
        column[start - 1 :] = reason
    return column


class SampleRecorder(LeafSystem):
    """Records the run, one row per control tick and one per ring scan.

    .. pydrake_system::

        name: SampleRecorder
        input_ports:
        - position
        - velocity
        - speed_fraction
        - robot_state
        - ring_states
        - products_placed
        - reason
        - separation
        - dsi
        - truth
        - masked_scan_base
        - masked_scan_elbow
        - masked_scan_tool

    A log has no dynamics and affects no output, so it is not State: it lives
    in the Context like that of Drake's VectorLogSink. Rows are written by a
    periodic publish, hence before the updates of the same tick: a row at t
    holds what was in force when the tick began.

    Args:
        period: Control tick, s.
        rings: Names of the m watched links, as in the messages.
        num_positions: Number of robot joints.
        num_sensors: Sensors per ring. 0 declares no `masked_scan` ports and
            records no scans (sensing without rings).
        metadata: Plain values (JSON) to store with the samples, such as the
            scenario, the seed and what `Samples` names.
    """

    def __init__(
        self,
        *,
        period: float = 0.008,
        rings: tuple[str, ...] = RINGS,
        num_positions: int = 6,
        num_sensors: int = 8,
        metadata: dict | None = None,
    ):
        super().__init__()
        m = len(rings)
        self._rings = tuple(rings)
        self._num_sensors = num_sensors
        self._metadata = {"rings": list(rings), "period": period}
        self._metadata.update(metadata or {})
        self._layout = TruthLayout(m)
        self._names = (
            "t",
            *(f"q_{i}" for i in range(num_positions)),
            *(f"qd_{i}" for i in range(num_positions)),
            "speed_fraction",
            "robot_state",
            "products_placed",
        )
        self._order = (
            *self._names[: 1 + 2 * num_positions],
            "tcp_speed",
            *self._names[1 + 2 * num_positions :],
            "true_distance",
            *(f"{ring}_{name}" for ring in rings for name in RING_COLUMNS),
        )
        # Start of each part of a row.
        self._q = 1
        self._v = 1 + num_positions
        self._plain = 1 + 2 * num_positions
        self._state = len(self._names)
        self._truth = self._state + m
        self._held = self._truth + self._layout.size
        width = self._held + len(_HELD) * m

        self._position_port = self.DeclareVectorInputPort(
            "position", num_positions
        )
        self._velocity_port = self.DeclareVectorInputPort(
            "velocity", num_positions
        )
        self._speed_fraction_port = self.DeclareVectorInputPort(
            "speed_fraction", 1
        )
        self._robot_state_port = self.DeclareVectorInputPort("robot_state", 1)
        self._ring_states_port = self.DeclareVectorInputPort("ring_states", m)
        self._products_port = self.DeclareVectorInputPort("products_placed", 1)
        self._reason_port = self.DeclareAbstractInputPort("reason", Value(""))
        self._separation_port = self.DeclareAbstractInputPort(
            "separation", Value(make_empty_separation(self._rings))
        )
        self._dsi_port = self.DeclareAbstractInputPort(
            "dsi", Value(make_empty_safety_index(self._rings))
        )
        self._truth_port = self.DeclareVectorInputPort(
            "truth", self._layout.size
        )
        self._scan_ports = [
            self.DeclareAbstractInputPort(
                f"masked_scan_{name}", Value(MaskedScan())
            )
            for name in (self._rings if num_sensors else ())
        ]
        self._log = self.DeclareCacheEntry(
            description="log",
            value_producer=ValueProducer(
                allocate=lambda: Value(_Log(width, m, num_sensors)),
                calc=ValueProducer.NoopCalc,
            ),
            prerequisites_of_calc={self.nothing_ticket()},
        )
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _find_log(self, context) -> _Log:
        entry = self._log.get_mutable_cache_entry_value(context)
        return entry.GetMutableValueOrThrow()

    def _publish(self, context):
        log = self._find_log(context)
        separation = self._separation_port.Eval(context)
        dsi = self._dsi_port.Eval(context)
        if separation is not log.last_separation or dsi is not log.last_dsi:
            log.held = pack_safety(separation, dsi)
            if separation is not log.last_separation:
                self._record_scans(context, log, separation.sequence.tolist())
            log.last_separation = separation
            log.last_dsi = dsi
        row = log.table.append()
        plain = self._plain
        row[0] = context.get_time()
        row[self._q : self._v] = self._position_port.Eval(context)
        row[self._v : plain] = self._velocity_port.Eval(context)
        row[plain] = self._speed_fraction_port.Eval(context)[0]
        row[plain + 1] = self._robot_state_port.Eval(context)[0]
        row[plain + 2] = self._products_port.Eval(context)[0]
        ring_states = self._ring_states_port.Eval(context)
        row[self._state : self._truth] = ring_states
        row[self._truth : self._held] = self._truth_port.Eval(context)
        row[self._held :] = log.held
        # Words cost more than numbers: one reason per change of state.
        ring_states = ring_states.tolist()
        if ring_states != log.last_ring_states:
            log.last_ring_states = ring_states
            log.reason.append((len(log.table), self._reason_port.Eval(context)))

    def _record_scans(self, context, log, sequence):
        """Keeps the scans that the new separation was made from."""
        for i, port in enumerate(self._scan_ports):
            if sequence[i] != log.sequence[i]:
                log.sequence[i] = sequence[i]
                scan = port.Eval(context)
                if scan.scan.sequence >= 0:
                    log.scans[i].append((context.get_time(), scan))

    def make_samples(self, root_context) -> Samples:
        """Returns what was recorded so far.

        Args:
            root_context: Context of the Diagram, or of this system.

        Returns:
            New arrays; the recording may go on.
        """
        log = self._find_log(self.GetMyContextFromRoot(root_context))
        table = log.table.to_array()
        m = len(self._rings)
        truth = table[:, self._truth : self._held]
        layout = self._layout
        column = {
            name: narrow_type(name, table[:, i])
            for i, name in enumerate(self._names)
        }

        def insert(name, values):
            column[name] = narrow_type(name, values)

        insert("tcp_speed", truth[:, layout.tcp_speed])
        insert("true_distance", truth[:, layout.distance])
        per_ring = {
            name: table[:, self._held + j * m : self._held + (j + 1) * m]
            for j, name in enumerate(_HELD)
        }
        per_ring["state"] = table[:, self._state : self._truth]
        per_ring["true_distance"] = truth[:, layout.ring_distance]
        per_ring["true_azimuth"] = truth[:, layout.ring_azimuth]
        per_ring["true_elevation"] = truth[:, layout.ring_elevation]
        for i, ring in enumerate(self._rings):
            for name, values in per_ring.items():
                column[f"{ring}_{name}"] = narrow_type(name, values[:, i])
        insert("contact_speed", truth[:, layout.contact_speed])
        insert("robot_body", truth[:, layout.robot_body])
        insert("person_part", truth[:, layout.person_part])
        for part, where in (
            ("robot_point", layout.p_WR),
            ("person_point", layout.p_WH),
            ("tcp", layout.p_WT),
        ):
            for axis, values in zip("xyz", truth[:, where].T, strict=True):
                insert(f"{part}_{axis}", values)
        insert("person_x", truth[:, layout.person.start])
        insert("person_y", truth[:, layout.person.start + 1])
        column["reason"] = _repeat_reasons(log.reason, len(log.table))
        scan = {}
        if self._num_sensors:
            scan = {
                ring: _unpack_scans(scans, self._num_sensors)
                for ring, scans in zip(self._rings, log.scans, strict=True)
            }
        ordered = {name: column.pop(name) for name in self._order}
        return Samples(
            column=ordered | column, scan=scan, metadata=dict(self._metadata)
        )
