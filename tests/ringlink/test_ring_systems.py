import dataclasses as dc
import unittest

import numpy as np
from paper_cell import RINGS, make_rings
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from tofssm_drake.diagrams.monitor import make_monitor
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.errors import UserError
from tofssm_drake.messages import RingScan, RobotState
from tofssm_drake.ringlink.ring_device import make_frame
from tofssm_drake.ringlink.ring_frame import encode_frame
from tofssm_drake.ringlink.ring_link import LoopbackRingLink, NullRingLink
from tofssm_drake.ringlink.ring_receiver import RingDecoder, RingLinkConfig
import tofssm_drake.ringlink.ring_systems as mut

_BUDGET = 0.020
_HOST = 70_000.0
"""Host's time when the Diagram's is 0, s."""

# Start and end of a ring's fault, s. The first affected frame comes up to 24 ms
# later.
_FAULT, _END = 0.5, 1.0


class _Relay:
    """A link that passes everything to another one."""

    link = None

    def get_scans(self):
        if self.link is None:
            return (RingScan(),) * 3
        return self.link.get_scans()

    def get_status(self):
        return self.link.get_status()


def make_decoder(**changes):
    config = RingLinkConfig(settle_time=0.0, min_delay=0.0)
    return RingDecoder(
        config=dc.replace(config, **changes),
        rings=make_rings(),
    )


def make_frame_at(ring, sequence, time, distance=None, status=2):
    """A frame whose scan ends at a time of the Diagram's clock."""
    if distance is None:
        generator = np.random.default_rng([ring, sequence])
        distance = 1.0 + 0.01 * generator.standard_normal(8)
    scan = RingScan(
        sequence=sequence,
        time=time,
        sensor_time=np.full(8, time - 0.010),
        distance=distance,
        status=np.full(8, status, dtype=np.uint8),
    )
    return make_frame(scan, ring=ring, timing_budget=_BUDGET)


def put(link, ring, sequence, time, **options):
    frame = make_frame_at(ring, sequence, time, **options)
    return link.put_datagram(encode_frame(frame), _HOST + time)


def make_cell(link, *, clock_offset=None, wait_timeout=0.0):
    builder = DiagramBuilder()
    interface = builder.AddNamedSystem(
        "interface", mut.RingInterfaceSystem(connection=link)
    )
    subscriber = builder.AddNamedSystem(
        "rings",
        mut.RingSubscriberSystem(
            name=RINGS,
            connection=interface.connection,
            wait_timeout=wait_timeout,
        ),
    )
    for ring in RINGS:
        port = f"scan_{ring}"
        builder.ExportOutput(subscriber.GetOutputPort(port), port)
    if clock_offset is not None:
        source = builder.AddSystem(ConstantVectorSource([clock_offset]))
        builder.Connect(
            source.get_output_port(), subscriber.GetInputPort("clock_offset")
        )
    return builder.Build()


def get_scans(diagram, context):
    return [diagram.GetOutputPort(f"scan_{r}").Eval(context) for r in RINGS]


class TestRingSubscriberSystem(unittest.TestCase):
    def test_data_enters_at_steps_only(self):
        link = LoopbackRingLink(decoder=make_decoder())
        diagram = make_cell(link)
        simulator = Simulator(diagram)
        context = simulator.get_context()
        simulator.Initialize()
        self.assertEqual(
            [s.sequence for s in get_scans(diagram, context)], [-1] * 3
        )
        put(link, 1, 5, 0.1)
        self.assertEqual(
            [s.sequence for s in get_scans(diagram, context)], [-1] * 3
        )
        simulator.AdvanceTo(0.008)
        scans = get_scans(diagram, context)
        self.assertEqual([s.sequence for s in scans], [-1, 0, -1])
        self.assertIs(scans[1], link.get_scans()[1])
        # A copy of the Context keeps what it had.
        copy = context.Clone()
        put(link, 1, 6, 0.124)
        put(link, 1, 7, 0.148)
        simulator.AdvanceTo(0.016)
        self.assertEqual(get_scans(diagram, copy)[1].sequence, 0)
        self.assertEqual(get_scans(diagram, context)[1].sequence, 2)

    def test_pending_events_take_what_came(self):
        """A scan that arrives before a tick counts in that tick."""
        link = LoopbackRingLink(decoder=make_decoder())
        diagram = make_cell(link)
        simulator = Simulator(diagram)
        simulator.Initialize()
        put(link, 0, 0, 0.008)
        simulator.AdvanceTo(0.008)
        self.assertEqual(
            get_scans(diagram, simulator.get_context())[0].sequence, 0
        )
        put(link, 0, 1, 0.032)
        simulator.AdvancePendingEvents()
        self.assertEqual(
            get_scans(diagram, simulator.get_context())[0].sequence, 1
        )

    def test_times_are_the_diagrams(self):
        link = LoopbackRingLink(decoder=make_decoder())
        for ring in range(3):
            put(link, ring, 0, 1.5)
        for clock_offset, expected in ((None, _HOST + 1.5), (-_HOST, 1.5)):
            diagram = make_cell(link, clock_offset=clock_offset)
            simulator = Simulator(diagram)
            simulator.get_mutable_context().SetTime(1.5)
            simulator.Initialize()
            for ring, scan in enumerate(
                get_scans(diagram, simulator.get_context())
            ):
                self.assertAlmostEqual(scan.time, expected, places=6)
                np.testing.assert_allclose(
                    scan.sensor_time, expected - 0.010, rtol=0, atol=1e-6
                )
                raw = link.get_scans()[ring]
                np.testing.assert_array_equal(scan.distance, raw.distance)
                np.testing.assert_array_equal(scan.status, raw.status)
                self.assertFalse(scan.sensor_time.flags.writeable)

    def test_a_scan_from_after_the_diagrams_time_waits(self):
        """It is not known yet where the robot was at the samples' time."""
        link = LoopbackRingLink(decoder=make_decoder())
        diagram = make_cell(link, clock_offset=-_HOST)
        simulator = Simulator(diagram)
        context = simulator.get_context()
        simulator.Initialize()
        # Samples of 0.014 s; the scan is there before the Diagram is at 0 s.
        put(link, 0, 0, 0.024)
        for tick, sequence in ((0.008, -1), (0.016, 0)):
            simulator.AdvanceTo(tick)
            simulator.AdvancePendingEvents()
            self.assertEqual(get_scans(diagram, context)[0].sequence, sequence)

    def test_ahead(self):
        scan = RingScan(sequence=0, sensor_time=np.array([1.0, 2.0, -np.inf]))
        self.assertTrue(mut.is_ahead(scan, 1.9))
        self.assertFalse(mut.is_ahead(scan, 2.0))
        self.assertFalse(mut.is_ahead(RingScan(), 0.0))

    def test_waits_for_every_ring(self):
        link = LoopbackRingLink(decoder=make_decoder())
        put(link, 0, 0, 0.0)
        simulator = Simulator(make_cell(link, wait_timeout=0.01))
        with self.assertRaisesRegex(
            UserError, "no scan of elbow, tool from loopback"
        ):
            simulator.Initialize()
        put(link, 1, 0, 0.0)
        put(link, 2, 0, 0.0)
        simulator.Initialize()

    def test_no_rings_no_scans(self):
        diagram = make_cell(NullRingLink(decoder=make_decoder()))
        simulator = Simulator(diagram)
        simulator.AdvanceTo(0.1)
        self.assertEqual(
            [s.sequence for s in get_scans(diagram, simulator.get_context())],
            [-1] * 3,
        )

    def test_rejects_another_number_of_rings(self):
        link = NullRingLink(decoder=make_decoder())
        with self.assertRaisesRegex(ValueError, "3 rings, not of 2"):
            mut.RingSubscriberSystem(connection=link, name=("a", "b"))
        with self.assertRaisesRegex(UserError, "wait_timeout"):
            mut.RingSubscriberSystem(
                name=RINGS, connection=link, wait_timeout=-1.0
            )
        with self.assertRaisesRegex(UserError, "max_ahead"):
            mut.RingSubscriberSystem(
                name=RINGS, connection=link, max_ahead=-1.0
            )

    def test_diagram_shows_the_source(self):
        diagram = make_cell(NullRingLink(decoder=make_decoder()))
        self.assertIn("ring_url=null", diagram.GetGraphvizString())


class TestMonitorBehindTheLink(unittest.TestCase):
    """Each fault of a ring stops the robot, and fresh data release it."""

    @classmethod
    def setUpClass(cls):
        scenario = load_scenario()
        cls.period = scenario.control_period
        # One Diagram for all tests: what it is connected to changes.
        cls.link = _Relay()
        builder = DiagramBuilder()
        cls.monitor = builder.AddSystem(make_monitor(scenario))
        builder.AddSystem(mut.RingInterfaceSystem(connection=cls.link))
        rings = builder.AddSystem(
            mut.RingSubscriberSystem(
                name=RINGS, connection=cls.link, wait_timeout=0.0
            )
        )
        offset = builder.AddSystem(ConstantVectorSource([-_HOST]))
        builder.Connect(
            offset.get_output_port(), rings.GetInputPort("clock_offset")
        )
        for name, value in (
            ("position_measured", [0.0, -1.6, 1.0, -1.0, -1.57, 0.0]),
            ("velocity_measured", np.zeros(6)),
            ("carried_objects", np.zeros(10)),
        ):
            source = builder.AddSystem(ConstantVectorSource(value))
            builder.Connect(
                source.get_output_port(), cls.monitor.GetInputPort(name)
            )
        for ring in RINGS:
            builder.Connect(
                rings.GetOutputPort(f"scan_{ring}"),
                cls.monitor.GetInputPort(f"scan_{ring}"),
            )
        cls.diagram = builder.Build()

    def run_monitor(self, make_datagrams, *, seconds, **changes):
        """Runs the monitor on datagrams made tick by tick.

        Args:
            make_datagrams: Takes ring, sequence and time of the scan's end;
                returns the datagrams that arrive then.
            seconds: Duration.
            changes: Of the link's settings.

        Returns:
            Time, robot state and reason at each tick.
        """
        link = LoopbackRingLink(decoder=make_decoder(**changes))
        self.link.link = link
        simulator = Simulator(self.diagram)
        simulator.Initialize()
        context = self.monitor.GetMyContextFromRoot(simulator.get_context())
        trace = []
        for k in range(1, round(seconds / self.period)):
            time = k * self.period
            if k % 3 == 0:
                for ring in range(3):
                    for data in make_datagrams(ring, k // 3, time - 0.001):
                        link.put_datagram(data, _HOST + time - 0.001)
            simulator.AdvanceTo(time)
            simulator.AdvancePendingEvents()
            decision = self.monitor.GetOutputPort("decision").Eval(context)
            trace.append((time, decision.robot_state, decision.reason))
        return trace

    def check_fault(self, fault, *, within, reason, **changes):
        """Injects a fault into the elbow's frames from 0.5 s to 1 s.

        Before it and some time after it, in an empty room, the state is normal.
        """

        def make_datagrams(ring, sequence, time):
            frame = make_frame_at(ring, sequence, time)
            if ring == 1 and _FAULT <= time < _END:
                return fault(frame)
            return [encode_frame(frame)]

        trace = self.run_monitor(make_datagrams, seconds=6.0, **changes)
        stopped = None
        for time, state, text in trace:
            # A link must be within its limits again for a whole window.
            if 0.3 < time < _FAULT or time > 5.5:
                self.assertEqual(state, RobotState.NORMAL, f"{time}: {text}")
            elif _FAULT <= time < _END:
                if stopped is None and state == RobotState.STOP:
                    stopped = time
                if stopped is not None:
                    self.assertEqual(state, RobotState.STOP, f"{time}: {text}")
                    self.assertIn(reason, text)
        self.assertIsNotNone(stopped)
        self.assertLess(stopped - _FAULT, within + 1e-6)

    def test_silent(self):
        self.check_fault(
            lambda frame: [], within=0.12, reason="elbow sample is"
        )

    def test_corrupt(self):
        def damage(frame):
            data = bytearray(encode_frame(frame))
            data[20] ^= 4
            return [bytes(data)]

        self.check_fault(damage, within=0.12, reason="elbow sample is")

    def test_duplicated(self):
        first = []

        def repeat(frame):
            first.append(encode_frame(frame))
            return [first[0]]

        self.check_fault(repeat, within=0.125, reason="elbow sample is")

    def test_frozen_payload(self):
        """The device goes on counting, but its samples are frozen."""
        first = []

        def freeze(frame):
            first.append(frame)
            status = np.array([0, 2, 2, 2, 2, 2, 2, 2], dtype=np.uint8)
            frame = dc.replace(frame, mm=first[0].mm, status=status)
            return [encode_frame(frame)]

        self.check_fault(
            freeze, within=0.35, reason="elbow is faulted", frozen_samples=12
        )

    def test_restarting_all_the_time(self):
        self.check_fault(
            lambda frame: [encode_frame(dc.replace(frame, flags=1))],
            within=0.12,
            reason="elbow sample is",
            settle_time=0.1,
        )

    def test_old_samples(self):
        """The device runs, but its sensors give nothing new."""

        def age(frame):
            return [encode_frame(dc.replace(frame, age_ms=np.full(8, 255)))]

        self.check_fault(age, within=0.032, reason="elbow is faulted")

    def test_bus_failure(self):
        def fail(frame):
            return [encode_frame(dc.replace(frame, status=np.full(8, 253)))]

        self.check_fault(fail, within=0.032, reason="elbow is faulted")

    def test_implausible_distance(self):
        def lie(frame):
            return [
                encode_frame(
                    dc.replace(
                        frame, mm=np.full(8, 65535), status=np.zeros(8, int)
                    )
                )
            ]

        self.check_fault(lie, within=0.032, reason="elbow is faulted")

    def test_self_test_numbers(self):
        self.check_fault(
            lambda frame: [encode_frame(dc.replace(frame, flags=0x80))],
            within=0.032,
            reason="elbow is faulted",
        )

    def test_another_ring_size(self):
        def double(frame):
            return [
                encode_frame(
                    dc.replace(
                        frame,
                        mm=np.tile(frame.mm, 2),
                        status=np.tile(frame.status, 2),
                        age_ms=np.tile(frame.age_ms, 2),
                        period_ms=np.tile(frame.period_ms, 2),
                    )
                )
            ]

        self.check_fault(double, within=0.12, reason="elbow sample is")


if __name__ == "__main__":
    unittest.main()
