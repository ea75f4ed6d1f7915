import dataclasses as dc
import unittest

import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from tofssm_drake.messages import (
    MaskedScan,
    Reading,
    RingScan,
    Separation,
    SpeedDecision,
    make_empty_decision,
    make_empty_separation,
)
from tofssm_drake.metrics.truth import TruthLayout
from tofssm_drake.people.motion import capsule_ends
from tofssm_drake.people.walk import GeneratedWalk, make_walk
import tofssm_drake.recording.recorder as mut
from tofssm_drake.recording.samples import get_link_columns

_PORTS = [
    "position",
    "velocity",
    "speed_fraction",
    "products_placed",
    "decision",
    "separation",
    "masked_scan_base",
    "masked_scan_elbow",
    "masked_scan_tool",
]


def _make_separation(sequence=(4, 5, -1)):
    return Separation(
        name=RINGS,
        sequence=np.array(sequence),
        time=np.array([0.1, 0.2, -np.inf]),
        distance=np.array([0.7, np.inf, np.inf]),
        sensor=np.array([3, -1, -1]),
        direction=np.zeros((3, 3)),
        link_speed=np.array([0.1, 0.2, 0.3]),
        k_l=np.array([1.0, 2.0, 3.0]),
        k_o=np.array([1.5, 2.5, 3.5]),
        health=np.array([0, 1, 2]),
        count=np.arange(12).reshape(3, 4),
    )


_SIGNAL = {
    "d_C": [0.5, 0.6, 0.7],
    "d_R": [1.1, 1.2, 1.3],
    "dsi_raw": [0.11, 0.12, 0.13],
    "dsi": [0.21, 0.22, 0.23],
    "dsi_C": [0.31, 0.32, 0.33],
    "dsi_R": [0.41, 0.42, 0.43],
}


def _make_decision(states=(2, 1, 0), reason="base: near", **signal):
    signal = _SIGNAL | signal
    return SpeedDecision(
        name=RINGS,
        target=(0.0, 0.5, 1.0)[min(states)],
        link=RINGS[int(np.argmin(states))],
        reason=reason,
        state=np.array(states),
        signal={name: np.array(values) for name, values in signal.items()},
    )


def _make_scan(sequence):
    return MaskedScan(
        scan=RingScan(
            sequence=sequence,
            time=0.0,
            distance=np.array([0.4, 0.5, 1.2, 9.0]) + 0.01 * sequence,
        ),
        reading=np.array(
            [Reading.VALID, Reading.MASKED, Reading.CLEAR, Reading.FAULTED],
            dtype=np.uint8,
        ),
    )


class _CountingTruth:
    """Stands for a TruthModel: each quantity is its place in the vector."""

    num_positions = 6
    skeleton_size = 0

    def __init__(self, num_rings=3):
        self.layout = TruthLayout(num_rings)

    def calc(self, *, q, qd, skeleton):
        truth = np.tile(np.arange(float(self.layout.size)), (len(q), 1))
        # What it was asked for.
        truth[:, self.layout.contact_speed] = q[:, 1] + qd[:, 1]
        return truth


class TestSampleRecorder(unittest.TestCase):
    def setUp(self):
        self.dut = mut.SampleRecorder(
            truth=_CountingTruth(),
            rings=RINGS,
            signals=tuple(_SIGNAL),
            num_sensors=dict.fromkeys(RINGS, 4),
            metadata={"seed": 3, "products": 10},
        )
        self.simulator = Simulator(self.dut)
        self.context = self.simulator.get_mutable_context()
        for name, value in {
            "position": np.arange(6.0),
            "velocity": np.arange(6.0) / 10,
            "speed_fraction": [0.5],
            "products_placed": [7],
            "decision": Value(_make_decision()),
            "separation": Value(_make_separation()),
            **{
                f"masked_scan_{ring}": Value(MaskedScan())
                for ring in ("base", "elbow", "tool")
            },
        }.items():
            self._fix(name, value)

    def _fix(self, name, value):
        self.dut.GetInputPort(name).FixValue(self.context, value)

    def _advance(self, ticks):
        """Runs to just before tick number `ticks`."""
        self.simulator.AdvanceTo(0.008 * ticks - 0.004)

    def _make_samples(self):
        return self.dut.make_samples(self.context)

    def test_ports(self):
        self.assertEqual(
            [
                self.dut.get_input_port(i).get_name()
                for i in range(self.dut.num_input_ports())
            ],
            _PORTS,
        )
        self.assertEqual(self.dut.num_output_ports(), 0)

    def test_row(self):
        self._advance(2)
        samples = self._make_samples()
        self.assertEqual(len(samples), 2)
        layout = TruthLayout(3)
        row = {name: values[1] for name, values in samples.column.items()}
        self.assertEqual(row["t"], 0.008)
        self.assertEqual([row[f"q_{i}"] for i in range(6)], [0, 1, 2, 3, 4, 5])
        self.assertEqual(row["qd_3"], 0.3)
        self.assertEqual(row["speed_fraction"], 0.5)
        self.assertEqual(row["robot_state"], 0)
        self.assertEqual(row["products_placed"], 7)
        self.assertEqual(row["reason"], "base: near")
        self.assertEqual(row["tcp_speed"], layout.tcp_speed)
        self.assertEqual(row["true_distance"], layout.distance)
        self.assertEqual(row["contact_speed"], 1.1)
        self.assertEqual(row["person_point_y"], layout.p_WH.start + 1)
        self.assertEqual(row["tcp_z"], layout.p_WT.start + 2)
        self.assertEqual(row["person_y"], layout.person.start + 1)
        self.assertEqual(
            row["tool_true_distance"], layout.ring_distance.start + 2
        )
        self.assertEqual(
            row["elbow_true_azimuth"], layout.ring_azimuth.start + 1
        )
        self.assertEqual(row["base_measured_distance"], 0.7)
        self.assertEqual(row["elbow_measured_distance"], np.inf)
        self.assertTrue(np.isnan(row["tool_measured_distance"]))
        self.assertEqual(row["base_closing_speed"], 1.5)
        self.assertEqual(
            [row[f"{r}_state"] for r in ("base", "elbow", "tool")], [2, 1, 0]
        )
        for i, ring in enumerate(("base", "elbow", "tool")):
            for j, name in enumerate(("clear", "valid", "masked", "faulted")):
                self.assertEqual(row[f"{ring}_{name}"], 4 * i + j)
            for name in ("d_C", "d_R", "dsi_raw", "dsi", "dsi_C", "dsi_R"):
                self.assertEqual(row[f"{ring}_{name}"], _SIGNAL[name][i])
        self.assertEqual(row["target_fraction"], 0.0)
        self.assertEqual(row["deciding_link"], 2)
        self.assertEqual(row["base_sensor"], 3)
        self.assertEqual(row["tool_health"], 2)
        self.assertEqual(row["elbow_sequence"], 5)

    def test_columns_in_order(self):
        self._advance(1)
        names = list(self.dut.make_samples(self.context).column)
        expected = [
            "t",
            *(f"q_{i}" for i in range(6)),
            *(f"qd_{i}" for i in range(6)),
            "tcp_speed",
            "speed_fraction",
            "robot_state",
            "products_placed",
            "true_distance",
            *(
                f"{ring}_{name}"
                for ring in ("base", "elbow", "tool")
                for name in get_link_columns(tuple(_SIGNAL))
            ),
        ]
        self.assertEqual(names[: len(expected)], expected)
        self.assertEqual(len(set(names)), len(names))

    def test_scans(self):
        """A scan is recorded once, when it is new; none before the first."""
        self._fix("separation", Value(make_empty_separation(RINGS)))
        self._advance(1)
        for tick, sequence in enumerate([0, 0, 1]):
            self._fix("masked_scan_elbow", Value(_make_scan(sequence)))
            self._fix("separation", Value(_make_separation([-1, sequence, -1])))
            self._advance(tick + 2)
        scan = self.dut.make_samples(self.context).scan
        self.assertEqual(list(scan), ["base", "elbow", "tool"])
        self.assertEqual(scan["base"]["reading"].shape, (0, 4))
        np.testing.assert_array_equal(scan["elbow"]["time"], [0.008, 0.024])
        np.testing.assert_allclose(
            scan["elbow"]["distance"],
            [[0.4, 0.5, np.inf, np.nan], [0.41, 0.51, np.inf, np.nan]],
            rtol=1e-6,
        )
        np.testing.assert_array_equal(
            scan["elbow"]["reading"], [[1, 2, 0, 3]] * 2
        )

    def test_row_is_before_the_update(self):
        """A message of a tick is in force in the next row, not in its own."""
        self._advance(2)
        decision = _make_decision([2, 2, 1], "tool: far", d_C=[9.0, 9.1, 9.2])
        self._fix("decision", Value(decision))
        self._fix("separation", Value(_make_separation()))
        self._fix("speed_fraction", [0.75])
        self._advance(4)
        samples = self._make_samples()
        np.testing.assert_array_equal(
            samples["elbow_d_C"], [0.6, 0.6, 0.6, 9.1]
        )
        np.testing.assert_array_equal(samples["robot_state"], [0, 0, 0, 1])
        np.testing.assert_array_equal(samples["elbow_state"], [1, 1, 1, 2])
        self.assertEqual(
            list(samples["reason"]), ["base: near"] * 3 + ["tool: far"]
        )
        # A vector is what its port says when the tick begins.
        np.testing.assert_array_equal(
            samples["speed_fraction"], [0.5, 0.5, 0.75, 0.75]
        )

    def test_reason_belongs_to_the_target(self):
        """It is kept when the target changes, not a link's state."""
        self._advance(1)
        self._fix("decision", Value(_make_decision([1, 1, 0], "tool: nearer")))
        self._advance(3)
        samples = self._make_samples()
        self.assertEqual(samples["base_state"][-1], 1)
        self.assertEqual(samples["reason"][-1], "base: near")

    def test_law_without_states(self):
        """The link that decides has the robot's state, others have none."""
        self._fix(
            "decision",
            Value(
                dc.replace(
                    _make_decision(),
                    target=0.3,
                    link="elbow",
                    state=np.empty(0),
                )
            ),
        )
        self._advance(1)
        free = dc.replace(
            _make_decision(), target=1.0, link="", state=np.empty(0)
        )
        self._fix("decision", Value(free))
        self._advance(3)
        samples = self._make_samples()
        np.testing.assert_array_equal(
            samples.ring("state"), [[-1, 1, -1], [-1, 1, -1], [2, 2, 2]]
        )
        np.testing.assert_array_equal(samples["robot_state"], [1, 1, 2])
        np.testing.assert_array_equal(samples["deciding_link"], [1, 1, -1])
        np.testing.assert_array_equal(
            samples["target_fraction"], [0.3, 0.3, 1.0]
        )

    def test_signals_change_without_a_new_separation(self):
        """As of a law with a memory of its own."""
        for tick in range(4):
            decision = _make_decision(d_C=[tick, 0.0, 0.0])
            self._fix("decision", Value(decision))
            self._advance(tick + 1)
        np.testing.assert_array_equal(
            self._make_samples()["base_d_C"], [0, 0, 1, 2]
        )

    def test_signals_of_any_name(self):
        self.dut = mut.SampleRecorder(
            truth=_CountingTruth(),
            rings=RINGS,
            num_sensors={},
            signals=("margin",),
        )
        empty = make_empty_decision(RINGS, ("margin",))
        self.assertEqual(list(empty.signal), ["margin"])
        samples = self.dut.make_samples(self.dut.CreateDefaultContext())
        for ring in RINGS:
            self.assertIn(f"{ring}_margin", samples)
            self.assertNotIn(f"{ring}_dsi", samples)

    def test_period(self):
        self.simulator.AdvanceTo(0.08)
        t = self._make_samples()["t"]
        np.testing.assert_allclose(t, 0.008 * np.arange(11), atol=1e-12)

    def test_contexts_do_not_share(self):
        self._advance(1)
        other = Simulator(self.dut, self.context.Clone())
        other.AdvanceTo(0.02)
        self.assertEqual(len(self._make_samples()), 1)
        samples = self.dut.make_samples(other.get_context())
        self.assertEqual(len(samples), 3)
        self.assertEqual(samples["base_d_C"][-1], 0.5)

    def test_before_anything_came(self):
        """Without a start nothing is in force: stopped, distance unknown."""
        self.dut.ForcedPublish(self.context)
        samples = self._make_samples()
        self.assertEqual(samples["robot_state"], [0])
        self.assertEqual(samples["reason"], [""])
        self.assertTrue(np.isnan(samples["base_measured_distance"][0]))

    def test_many_messages(self):
        """Packing on the way loses and changes nothing."""
        ticks = 1100
        for i in range(ticks):
            self._fix("separation", Value(_make_separation([i, i, i])))
            self._fix("masked_scan_tool", Value(_make_scan(i)))
            self._advance(i + 1)
        samples = self._make_samples()
        # Row 0 is the start, which saw the first message as well.
        expected = np.append(0, np.arange(ticks - 1))
        np.testing.assert_array_equal(samples["tool_sequence"], expected)
        scan = samples.scan["tool"]
        np.testing.assert_allclose(
            scan["distance"][:, 0], 0.4 + 0.01 * np.arange(ticks), rtol=1e-6
        )
        # Asking does not end the recording.
        self._advance(ticks + 3)
        self.assertEqual(len(self._make_samples()), ticks + 3)

    def test_metadata(self):
        samples = self.dut.make_samples(self.context)
        self.assertEqual(samples.metadata["seed"], 3)
        self.assertEqual(samples.metadata["rings"], ["base", "elbow", "tool"])
        self.assertEqual(len(samples), 0)

    def test_one_link_without_rings(self):
        """The lidar has one watched link and no ring scans."""
        dut = mut.SampleRecorder(
            truth=_CountingTruth(1),
            rings=("lidar",),
            signals=("d_C",),
            num_sensors={},
        )
        self.assertEqual(dut.num_input_ports(), 6)
        simulator = Simulator(dut)
        context = simulator.get_mutable_context()
        for port, size in (
            ("position", 6),
            ("velocity", 6),
            ("speed_fraction", 1),
            ("products_placed", 1),
        ):
            dut.GetInputPort(port).FixValue(context, np.zeros(size))
        for port, value in (
            ("separation", make_empty_separation(("lidar",))),
            (
                "decision",
                SpeedDecision(name=("lidar",), signal={"d_C": np.array([9.0])}),
            ),
        ):
            dut.GetInputPort(port).FixValue(context, Value(value))
        simulator.Initialize()
        samples = dut.make_samples(context)
        self.assertTrue(np.isnan(samples["lidar_measured_distance"][0]))
        self.assertEqual(samples["lidar_d_C"][0], 9.0)
        self.assertEqual(samples.scan, {})

    def test_person_follows_from_time(self):
        """The truth is asked with the skeleton of each row's time."""
        asked = []

        class Truth(_CountingTruth):
            def calc(self, *, q, qd, skeleton):
                asked.append(skeleton)
                return super().calc(q=q, qd=qd, skeleton=skeleton)

        motion = make_walk(GeneratedWalk(), 0.008)
        self.dut = mut.SampleRecorder(
            truth=Truth(),
            rings=RINGS,
            motions=[motion],
            num_sensors=dict.fromkeys(RINGS, 4),
        )
        context = self.dut.CreateDefaultContext()
        context.SetTime(1.5)
        for name, size in (
            ("position", 6),
            ("velocity", 6),
            ("speed_fraction", 1),
            ("products_placed", 1),
        ):
            self.dut.GetInputPort(name).FixValue(context, np.zeros(size))
        self.dut.GetSubsystemByName("vector_log").ForcedPublish(
            self.dut.GetSubsystemContext(
                self.dut.GetSubsystemByName("vector_log"), context
            )
        )
        self.dut.make_samples(context)
        np.testing.assert_array_equal(
            asked[0], [capsule_ends(motion, 1.5).ravel()]
        )


class TestNoState(unittest.TestCase):
    def test_no_state(self):
        dut = mut.SampleRecorder(
            truth=_CountingTruth(), rings=RINGS, num_sensors={}
        )
        self.assertTrue(dut.CreateDefaultContext().is_stateless())
