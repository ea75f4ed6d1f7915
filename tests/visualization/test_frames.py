"""Frames on their way from a run to what draws it."""

import copy
import pickle
import unittest

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantValueSource,
    ConstantVectorSource,
)

from tofssm_drake.messages import (
    Frame,
    MaskedScan,
    Reading,
    RingScan,
    SpeedDecision,
)
import tofssm_drake.visualization.frames as mut

_RINGS = ("first", "second")


def make_frame(time=0.5):
    scan = RingScan(
        sequence=7,
        time=0.25,
        sensor_time=np.full(2, 0.2),
        distance=np.array([1.0, np.nan]),
        status=np.array([0, 255], dtype=np.uint8),
    )
    reading = np.array([Reading.VALID, Reading.CLEAR], dtype=np.uint8)
    return Frame(
        time=time,
        position_measured=np.array([0.1, -0.2, 0.3]),
        carried_objects=np.array([0.0, -1.0]),
        decision=SpeedDecision(
            name=_RINGS,
            target=0.5,
            link="first",
            reason="reduced: somebody is near",
            state=np.array([1, 2], dtype=np.int8),
            signal={"dsi": np.array([1.5, np.inf])},
        ),
        masked_scan={
            "first": MaskedScan(scan=scan, reading=reading),
            "second": MaskedScan(),
        },
        health={"first": "OK", "robot": "HELD"},
    )


def list_values(value, path=""):
    """Yields (path, value) of all that is in a message."""
    if hasattr(value, "items"):
        for name, child in value.items():
            yield from list_values(child, f"{path}.{name}")
    elif hasattr(value, "__dataclass_fields__"):
        yield from list_values(vars(value), f"{path}:{type(value).__name__}")
    else:
        yield path, value


class TestFrame(unittest.TestCase):
    def check_equal(self, one, other):
        values = list(list_values(one))
        self.assertGreater(len(values), 30)
        for (path, a), (its_path, b) in zip(
            values, list_values(other), strict=True
        ):
            self.assertEqual(path, its_path)
            self.assertIs(type(a), type(b), path)
            np.testing.assert_array_equal(a, b, path)
            if isinstance(a, np.ndarray):
                self.assertEqual(a.dtype, b.dtype, path)
                self.assertFalse(b.flags.writeable, path)

    def test_pickle_changes_nothing(self):
        frame = make_frame()
        again = pickle.loads(pickle.dumps(frame))
        self.assertIsNot(again, frame)
        self.check_equal(frame, again)
        with self.assertRaises(TypeError):
            again.health["robot"] = "OK"
        with self.assertRaises(TypeError):
            again.decision.signal["dsi"] = 0

    def test_copy_is_the_frame(self):
        frame = make_frame()
        self.assertIs(copy.deepcopy(frame), frame)


class TestSystems(unittest.TestCase):
    def make_sender(self, frame, send):
        """Returns a Diagram that sends the frame again and again."""
        builder = DiagramBuilder()
        sender = builder.AddSystem(
            mut.FrameSender(
                send=send, num_joints=3, num_objects=2, rings=_RINGS
            )
        )
        for name in ("position_measured", "carried_objects"):
            source = builder.AddSystem(
                ConstantVectorSource(getattr(frame, name))
            )
            builder.Connect(source.get_output_port(), sender.GetInputPort(name))
        abstract = {"decision": frame.decision} | {
            f"masked_scan_{ring}": scan
            for ring, scan in frame.masked_scan.items()
        }
        for name, message in abstract.items():
            source = builder.AddSystem(ConstantValueSource(Value(message)))
            builder.Connect(source.get_output_port(), sender.GetInputPort(name))
        return builder.Build()

    def test_sends_what_is_on_its_ports_at_its_rate(self):
        expected, frames = make_frame(), []
        simulator = Simulator(self.make_sender(expected, frames.append))
        simulator.AdvanceTo(0.25)
        self.assertEqual(
            [frame.time for frame in frames], [i / 16 for i in range(5)]
        )
        for frame in frames:
            np.testing.assert_array_equal(
                frame.position_measured, expected.position_measured
            )
            np.testing.assert_array_equal(
                frame.carried_objects, expected.carried_objects
            )
            self.assertIs(frame.decision, expected.decision)
            self.assertEqual(
                dict(frame.masked_scan), dict(expected.masked_scan)
            )
            self.assertEqual(dict(frame.health), {})

    def test_reader_takes_the_newest_frame_apart(self):
        dut = mut.FrameReader(num_joints=3, num_objects=2, rings=_RINGS)
        context = dut.CreateDefaultContext()
        for frame in (make_frame(), make_frame(time=0.75)):
            dut.get_input_port().FixValue(context, frame)
            for name in ("position_measured", "carried_objects"):
                np.testing.assert_array_equal(
                    dut.GetOutputPort(name).Eval(context),
                    getattr(frame, name),
                )
            self.assertIs(
                dut.GetOutputPort("decision").Eval(context), frame.decision
            )
            for ring in _RINGS:
                self.assertIs(
                    dut.GetOutputPort(f"masked_scan_{ring}").Eval(context),
                    frame.masked_scan[ring],
                )
