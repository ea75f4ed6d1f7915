"""Recorder of one row per control tick."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    ValueProducer,
)
from pydrake.systems.primitives import Multiplexer, VectorLogSink

from tofssm_drake.messages import (
    MaskedScan,
    Reading,
    RobotState,
    Separation,
    SpeedDecision,
    classify_target,
    make_empty_decision,
    make_empty_separation,
)
from tofssm_drake.people.motion import HumanMotion, capsule_ends_over_time
from tofssm_drake.people.skeleton import PELVIS
from tofssm_drake.recording.samples import (
    Samples,
    get_link_columns,
    narrow_type,
)

# Messages are packed when there are that many.
_PACK_AT = 512
# Rows of truth per call, so that few skeletons exist at a time.
_TRUTH_ROWS = 1024

_COUNTS = ("clear", "valid", "masked", "faulted")
# Column by field of the message.
_OF_SEPARATION = {
    "measured_distance": "distance",
    "closing_speed": "k_o",
    "link_closing_speed": "k_l",
    "sensor": "sensor",
    "health": "health",
    "sequence": "sequence",
    "sample_time": "time",
}


def pack_separations(separations: list[Separation]) -> dict[str, np.ndarray]:
    """Lays messages out as columns.

    Args:
        separations: k separations of the same m links, k > 0.

    Returns:
        Arrays (k, m) by name of the recorder's column. The distance of a
        link without any sample is NaN, because nothing is known.
    """
    k = len(separations)

    def stack(messages, field):
        # Much faster than np.stack, and this runs during the simulation.
        flat = np.concatenate([getattr(m, field) for m in messages])
        return flat.reshape(k, -1, *flat.shape[1:])

    packed = {
        name: stack(separations, field)
        for name, field in _OF_SEPARATION.items()
    }
    packed["measured_distance"] = np.where(
        packed["sequence"] < 0, np.nan, packed["measured_distance"]
    )
    count = stack(separations, "count")
    return packed | {name: count[..., i] for i, name in enumerate(_COUNTS)}


def pack_signals(
    signals: list[tuple[np.ndarray, ...]], names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Lays a law's signals out as columns.

    Args:
        signals: k times the value of each signal, (m,) each, k > 0.
        names: The signals' names, in the same order.

    Returns:
        Arrays (k, m) by name.
    """
    return {
        name: np.concatenate([values[i] for values in signals]).reshape(
            len(signals), -1
        )
        for i, name in enumerate(names)
    }


def find_link_states(decision: SpeedDecision) -> list[int]:
    """Returns the state of each link that a decision amounts to, (m,).

    Without states of its law's own, the link that decides has the robot's
    state, and all have if that is normal; the others' is not known: -1.
    """
    if len(decision.state):
        return decision.state.tolist()
    state = int(decision.robot_state)
    if state == RobotState.NORMAL:
        return [state] * len(decision.name)
    return [state if name == decision.link else -1 for name in decision.name]


class Truth(Protocol):
    """What computes the truth, see `metrics.ground_truth.TruthModel`."""

    num_positions: int
    layout: Any
    """Where each quantity is in a row, see `metrics.truth.TruthLayout`."""

    def calc(
        self, *, q: np.ndarray, qd: np.ndarray, skeleton: np.ndarray
    ) -> np.ndarray:
        """Returns one row for each row of the arguments."""


class _Scan(NamedTuple):
    time: float
    distance: np.ndarray
    reading: np.ndarray
    fault: np.ndarray


def _pack_scans(scans):
    """Returns k > 0 scans of one ring as `Samples.scan` has them."""
    shape = (len(scans), -1)
    reading = np.concatenate([scan.reading for scan in scans])
    reading = reading.astype(np.int8).reshape(shape)
    fault = np.concatenate([scan.fault for scan in scans])
    fault = fault.astype(np.int8).reshape(shape)
    distance = np.concatenate([scan.distance for scan in scans])
    distance = distance.astype(np.float32).reshape(shape)
    distance[reading == Reading.CLEAR] = np.inf
    distance[reading == Reading.FAULTED] = np.nan
    return {
        "time": np.array([scan.time for scan in scans]),
        "distance": distance,
        "reading": reading,
        "fault": fault,
    }


def _join(parts):
    """Joins dictionaries of arrays, of which there is at least one."""
    return {
        name: np.concatenate([part[name] for part in parts])
        for name in parts[0]
    }


class _Log:
    """The messages that one Context recorded, with the time of each."""

    def __init__(self, scanned, signal_names):
        self.signal_names = signal_names
        self.times = []
        self.separations = []
        self.packed = []
        self.signal_times = []
        self.signals = []
        self.packed_signals = []
        self.scans: dict[str, list] = {ring: [] for ring in scanned}
        self.packed_scans: dict[str, list] = {ring: [] for ring in scanned}
        self.sequence = dict.fromkeys(scanned, -1)
        self.decision_times = []
        self.link_states = []
        self.targets = []
        self.deciding = []
        self.reasons = []
        # The last of each.
        self.separation = None
        self.some_missing = True
        self.decision = None
        self.signal = ()
        self.decided = None
        self.why = None

    def pack(self):
        """Turns the messages into columns, a tenth of their size."""
        if self.separations:
            self.packed.append(pack_separations(self.separations))
            self.separations = []
        if self.signals:
            self.packed_signals.append(
                pack_signals(self.signals, self.signal_names)
            )
            self.signals = []
        for ring, scans in self.scans.items():
            if scans:
                self.packed_scans[ring].append(_pack_scans(scans))
                scans.clear()


def _find_in_force(times, t):
    """Returns the index of the entry in force just before each t.

    Args:
        times: When each entry came, s, in order; the first is -inf.
        t: Times, s, (k,).
    """
    return np.searchsorted(times, t, side="left") - 1


class MessageLog(LeafSystem):
    """Keeps the messages of a run, each one once.

    .. pydrake_system::

        name: MessageLog
        input_ports:
        - decision
        - separation
        - masked_scan_<ring>

    A part of `SampleRecorder`. As in `VectorLogSink` the log lives in the
    Context, but not in its State.

    The messages are read in the discrete update of each tick, where the
    safety law itself evaluates them. A publish would come after the law's
    state has changed, so that Drake would compute them again, which costs as
    much as the law. A message read at a tick is in force from then on. It is
    kept when it is new; of `decision` its signals and the rest on their own.

    Args:
        period: Control tick, s.
        rings: Names of the m watched links, as in the messages.
        signals: Names of the law's signals.
        scanned: Names of those that have a `masked_scan` port.
    """

    def __init__(
        self,
        *,
        period: float,
        rings: tuple[str, ...],
        signals: tuple[str, ...],
        scanned: tuple[str, ...],
    ):
        super().__init__()
        self._rings = tuple(rings)
        self._signals = tuple(signals)
        self._decision_port = self.DeclareAbstractInputPort(
            "decision", Value(make_empty_decision(self._rings, self._signals))
        )
        self._separation_port = self.DeclareAbstractInputPort(
            "separation", Value(make_empty_separation(self._rings))
        )
        self._scan_ports = {
            name: (
                self._rings.index(name),
                self.DeclareAbstractInputPort(
                    f"masked_scan_{name}", Value(MaskedScan())
                ),
            )
            for name in scanned
        }
        self._log = self.DeclareCacheEntry(
            description="log",
            value_producer=ValueProducer(
                allocate=lambda: Value(_Log(scanned, self._signals)),
                calc=ValueProducer.NoopCalc,
            ),
            prerequisites_of_calc={self.nothing_ticket()},
        )
        self.DeclareInitializationPublishEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def find_log(self, context) -> _Log:
        """Returns the log of one of this system's Contexts."""
        return self._log.Eval(context)

    def _start(self, context):
        self._record(context, -np.inf)

    def _update(self, context, discrete_state):
        self._record(context, context.get_time())
        return EventStatus.DidNothing()

    def _record(self, context, time):
        log = self.find_log(context)
        separation = self._separation_port.Eval(context)
        decision = self._decision_port.Eval(context)
        if separation is log.separation and decision is log.decision:
            return
        if separation is not log.separation:
            log.separation = separation
            log.times.append(time)
            log.separations.append(separation)
            sequence = separation.sequence.tolist()
            log.some_missing = min(sequence) < 0
            self._record_scans(context, log, sequence)
        if decision is not log.decision:
            log.decision = decision
            self._record_signals(log, decision, time)
        self._record_decision(log, decision, time)
        if max(len(log.separations), len(log.signals)) >= _PACK_AT:
            log.pack()

    def _record_signals(self, log, decision, time):
        """Keeps the signals if any of them is another array."""
        signal = tuple(decision.signal[name] for name in self._signals)
        if not log.signal_times or any(
            a is not b for a, b in zip(signal, log.signal, strict=True)
        ):
            log.signal = signal
            log.signal_times.append(time)
            log.signals.append(signal)

    def _record_decision(self, log, decision, time):
        """Keeps what was decided, if that is new."""
        states = find_link_states(decision)
        decided = (states, decision.target, decision.link)
        # Near a threshold the reason has other figures at every tick: one per
        # target, and another one when the last link has its first sample.
        why = (decision.target, log.some_missing)
        if decided == log.decided and why == log.why:
            return
        if why != log.why:
            log.reasons.append(decision.reason)
        else:
            log.reasons.append(log.reasons[-1])
        log.decided, log.why = decided, why
        log.decision_times.append(time)
        log.link_states.append(states)
        log.targets.append(decision.target)
        log.deciding.append(
            self._rings.index(decision.link) if decision.link else -1
        )

    def _record_scans(self, context, log, sequence):
        """Keeps the scans that the new separation was made from."""
        for ring, (i, port) in self._scan_ports.items():
            if sequence[i] != log.sequence[ring]:
                log.sequence[ring] = sequence[i]
                masked = port.Eval(context)
                if masked.scan.sequence >= 0:
                    log.scans[ring].append(
                        _Scan(
                            time=context.get_time(),
                            distance=masked.scan.distance,
                            reading=masked.reading,
                            fault=masked.fault,
                        )
                    )


def _lay_out_truth(truth, layout):
    """Yields name and values of the columns of contacts and places."""
    yield "contact_speed", truth[:, layout.contact_speed]
    yield "robot_body", truth[:, layout.robot_body]
    yield "person_part", truth[:, layout.person_part]
    for part, where in (
        ("robot_point", layout.p_WR),
        ("person_point", layout.p_WH),
        ("tcp", layout.p_WT),
        ("person", layout.person),
    ):
        # The person's place has x and y only.
        for axis, values in zip("xyz", truth[:, where].T, strict=False):
            yield f"{part}_{axis}", values


class SampleRecorder(Diagram):
    """Records the run, one row per control tick and one per ring scan.

    .. pydrake_system::

        name: SampleRecorder
        input_ports:
        - position
        - velocity
        - speed_fraction
        - products_placed
        - decision
        - separation
        - masked_scan_<ring>

    `position` (rad), `velocity` (rad/s) and `products_placed` are the world's;
    the rest is the monitor's. The person needs no port: its place follows
    from its motion and the time.

    A log has no dynamics and affects no output, so it is not State: it lives
    in the Context like that of Drake's VectorLogSink. A row at t holds what
    was in force when the tick began, before its updates. Vectors are written
    by a periodic publish, hence one row each; of the monitor's messages only
    new ones are kept, see `MessageLog`. What follows from both, above all the
    truth, is computed when the samples are requested.

    Args:
        truth: Computes the truth; its links are those of `rings`.
        motions: How each person moves, in the truth's order.
        period: Control tick, s.
        rings: Names of the m watched links, as in the messages.
        signals: Names of the law's signals.
        num_sensors: Number of sensors of each ring; its scans are recorded.
            Other links have none.
        metadata: Plain values (JSON) to store with the samples, such as the
            scenario, the seed and what `Samples` names.
    """

    def __init__(
        self,
        *,
        truth: Truth,
        rings: tuple[str, ...],
        signals: tuple[str, ...] = (),
        motions: Sequence[HumanMotion] = (),
        period: float = 0.008,
        num_sensors: Mapping[str, int],
        metadata: dict | None = None,
    ):
        super().__init__()
        self._truth = truth
        self._motions = tuple(motions)
        self._rings = tuple(rings)
        self._signals = tuple(signals)
        self._num_sensors = dict(num_sensors)
        self._metadata: dict[str, Any] = {
            "rings": list(rings),
            "period": period,
        }
        self._metadata.update(metadata or {})

        sizes = {
            "position": truth.num_positions,
            "velocity": truth.num_positions,
            "speed_fraction": 1,
            "products_placed": 1,
        }
        ends = np.cumsum(list(sizes.values()))
        self._part = {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        builder = DiagramBuilder()
        vectors = builder.AddNamedSystem(
            "vectors", Multiplexer(list(sizes.values()))
        )
        self._vectors = builder.AddNamedSystem(
            "vector_log", VectorLogSink(int(ends[-1]), period)
        )
        builder.Connect(
            vectors.get_output_port(), self._vectors.get_input_port()
        )
        self._messages = builder.AddNamedSystem(
            "message_log",
            MessageLog(
                period=period,
                rings=self._rings,
                signals=self._signals,
                scanned=tuple(self._num_sensors),
            ),
        )
        for i, name in enumerate(sizes):
            builder.ExportInput(vectors.get_input_port(i), name)
        for i in range(self._messages.num_input_ports()):
            port = self._messages.get_input_port(i)
            builder.ExportInput(port, port.get_name())
        builder.BuildInto(self)

    def make_samples(self, root_context) -> Samples:
        """Returns what was recorded so far.

        Args:
            root_context: Context of the outermost Diagram, which may be this
                system itself.

        Returns:
            New arrays; the recording may go on.
        """
        vector_log = self._vectors.FindLog(root_context)
        log = self._messages.find_log(
            self._messages.GetMyContextFromRoot(root_context)
        )
        log.pack()
        data = vector_log.data().T
        plain = {name: data[:, where] for name, where in self._part.items()}
        t = vector_log.sample_times()
        truth = self._calc_truth(plain, t)
        layout = self._truth.layout
        column = {}

        def insert(name, values, kind=None):
            column[name] = narrow_type(kind or name, values)

        decided = self._lay_out_decisions(log, t)
        insert("t", t)
        for prefix, name in (("q", "position"), ("qd", "velocity")):
            for i, values in enumerate(plain[name].T):
                insert(f"{prefix}_{i}", values)
        insert("tcp_speed", truth[:, layout.tcp_speed])
        insert("speed_fraction", plain["speed_fraction"][:, 0])
        insert("robot_state", decided["robot_state"])
        insert("products_placed", plain["products_placed"][:, 0])
        insert("true_distance", truth[:, layout.distance])
        per_ring = self._lay_out_messages(log, t) | {
            "state": decided["state"],
            "true_distance": truth[:, layout.ring_distance],
            "true_azimuth": truth[:, layout.ring_azimuth],
            "true_elevation": truth[:, layout.ring_elevation],
        }
        for i, ring in enumerate(self._rings):
            for name in get_link_columns(self._signals):
                insert(f"{ring}_{name}", per_ring[name][:, i], name)
        for name, values in _lay_out_truth(truth, layout):
            insert(name, values)
        for name, values in self._lay_out_places(t):
            insert(name, values)
        insert("target_fraction", decided["target"])
        insert("deciding_link", decided["deciding"])
        column["reason"] = decided["reason"]
        scan = {
            ring: self._join_scans(parts, self._num_sensors[ring])
            for ring, parts in log.packed_scans.items()
        }
        return Samples(column=column, scan=scan, metadata=dict(self._metadata))

    def _lay_out_places(self, t):
        """Yields name and values of the columns of each person's place.

        One person's place is in the columns of the truth.
        """
        names: Sequence[str] = self._metadata.get("people", ())
        if len(self._motions) < 2 or len(names) != len(self._motions):
            return
        for name, motion in zip(names, self._motions, strict=True):
            pelvis = capsule_ends_over_time(motion, t)[:, PELVIS]
            place = pelvis.mean(axis=1)
            for axis, values in zip("xy", place.T, strict=False):
                yield f"place_of_{name}_{axis}", values

    def _calc_truth(self, plain, t):
        truth = np.empty((len(t), self._truth.layout.size))
        for start in range(0, len(t), _TRUTH_ROWS):
            part = slice(start, start + _TRUTH_ROWS)
            truth[part] = self._truth.calc(
                q=plain["position"][part],
                qd=plain["velocity"][part],
                skeleton=self._calc_skeletons(t[part]),
            )
        return truth

    def _calc_skeletons(self, t):
        return np.hstack(
            [
                np.empty((len(t), 0)),
                *(
                    capsule_ends_over_time(motion, t).reshape(len(t), -1)
                    for motion in self._motions
                ),
            ]
        )

    def _lay_out_messages(self, log, t):
        # Nothing is known before the first, as at a start in mid-air.
        unknown = np.full(len(self._rings), np.nan)
        columns: dict[str, np.ndarray] = {}
        for times, first, packed in (
            (
                log.times,
                pack_separations([make_empty_separation(self._rings)]),
                log.packed,
            ),
            (
                log.signal_times,
                pack_signals([(unknown,) * len(self._signals)], self._signals),
                log.packed_signals,
            ),
        ):
            which = _find_in_force([-np.inf, *times], t)
            joined = _join([first, *packed])
            columns |= {name: values[which] for name, values in joined.items()}
        return columns

    def _lay_out_decisions(self, log, t):
        empty = make_empty_decision(self._rings)
        which = _find_in_force([-np.inf, *log.decision_times], t)
        targets = [empty.target, *log.targets]
        columns = {
            "state": [
                [int(empty.robot_state)] * len(self._rings),
                *log.link_states,
            ],
            "robot_state": [float(classify_target(x)) for x in targets],
            "target": targets,
            "deciding": [-1, *log.deciding],
            "reason": np.array(["", *log.reasons], dtype=object),
        }
        return {name: np.array(v)[which] for name, v in columns.items()}

    def _join_scans(self, parts, n):
        if parts:
            return _join(parts)
        return {
            "time": np.empty(0),
            "distance": np.empty((0, n), dtype=np.float32),
            "reading": np.empty((0, n), dtype=np.int8),
            "fault": np.empty((0, n), dtype=np.int8),
        }
