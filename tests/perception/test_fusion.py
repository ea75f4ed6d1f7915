"""Separations of several sensors in one message."""

import numpy as np
from pydrake.common.value import Value
import pytest

from tofssm_drake.messages import Separation, make_empty_separation
import tofssm_drake.perception.fusion as mut


def make_separation(name, distance, problem=()):
    empty = make_empty_separation(name)
    return Separation(
        **vars(empty)
        | {
            "distance": np.array(distance),
            "problem": problem,
            "direction": np.arange(3.0 * len(name)).reshape(-1, 3),
        }
    )


def test_links_keep_what_is_theirs():
    one = make_separation(("a", "b"), [1.0, 2.0], ("", "sensor 3: bus"))
    other = make_separation(("c",), [3.0])
    joined = mut.join_separations([one, other], ("b", "c", "a"))
    assert joined.name == ("b", "c", "a")
    assert joined.problem == ("sensor 3: bus", "", "")
    np.testing.assert_array_equal(joined.distance, [2.0, 3.0, 1.0])
    np.testing.assert_array_equal(
        joined.direction, [[3.0, 4.0, 5.0], [0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]
    )
    assert joined.count.shape == (3, 4)


def test_system():
    dut = mut.SeparationFusion([("a",), ("b",)], name=("b", "a"))
    assert not dut.CreateDefaultContext().num_total_states()
    context = dut.CreateDefaultContext()
    for i, (name, distance) in enumerate((("a", 1.0), ("b", 2.0))):
        dut.GetInputPort(f"separation_{i}").FixValue(
            context, Value(make_separation((name,), [distance]))
        )
    output = dut.GetOutputPort("separation").Eval(context)
    np.testing.assert_array_equal(output.distance, [2.0, 1.0])


def test_names_must_be_those_of_the_inputs():
    for name in (("a",), ("a", "b", "c"), ("a", "a")):
        with pytest.raises(ValueError, match="links"):
            mut.SeparationFusion([("a",), ("b",)], name=name)
