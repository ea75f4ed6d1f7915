import dataclasses as dc
import sys
import types
import unittest

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from tofssm_drake.errors import UserError
import tofssm_drake.laws.custom_law as mut
from tofssm_drake.laws.law import LawTraits
from tofssm_drake.messages import (
    LinkSignal,
    RingHealth,
    SpeedDecision,
    make_empty_decision,
    make_empty_separation,
)

MODULE = "law_of_a_test"
LINKS = ("base", "tool")


class _System(LeafSystem):
    """Full speed unless something is nearer than a metre, or not known."""

    def __init__(self, links, decide):
        super().__init__()
        self._decide = decide
        self._separation = self.DeclareAbstractInputPort(
            "separation", Value(make_empty_separation(links))
        )
        self.DeclareAbstractOutputPort(
            "decision",
            Value(make_empty_decision(links)).Clone,
            self._calc,
            {self._separation.ticket(), self.time_ticket()},
        )

    def _calc(self, context, output):
        separation = self._separation.Eval(context)
        output.set_value(self._decide(separation, context.get_time()))


def decide(separation, time):
    is_known = (
        (separation.sequence >= 0)
        & (separation.health == RingHealth.HEALTHY)
        & (time - separation.time <= 0.1)
    )
    is_clear = is_known & (separation.distance > 1.0)
    return SpeedDecision(
        name=separation.name,
        target=float(is_clear.all()),
        reason="far" if is_clear.all() else "near or unknown",
    )


class _Law:
    traits = LawTraits(title="A metre")

    def __init__(self, make=None):
        if make is not None:
            self.make = make

    def make(self, *, links, offset, period):
        return _System(links, decide)


def make_careless(blind_to):
    """Returns a law that takes one thing for good."""

    def careless(separation, time):
        return decide(blind_to(separation), time)

    return lambda **cell: _System(cell["links"], careless)


class TestCustom(unittest.TestCase):
    def setUp(self):
        self.module = types.ModuleType(MODULE)
        sys.modules[MODULE] = self.module
        self.addCleanup(sys.modules.pop, MODULE)
        self.module.make = lambda: _Law()

    def make_dut(self, **parameters):
        return mut.Custom(factory=f"{MODULE}:make", parameters=parameters)

    def assert_wrong(self, law, expected):
        self.module.make = lambda: law
        with self.assertRaisesRegex(UserError, expected) as caught:
            self.make_dut().check("law")
        self.assertNotIn("\n", str(caught.exception))

    def test_good_law(self):
        dut = self.make_dut()
        dut.check("law")
        self.assertEqual(dut.traits.title, "A metre")
        system = dut.make(links=LINKS, offset=np.zeros(2), period=0.008)
        self.assertIsInstance(system, _System)

    def test_parameters_are_the_factory_s(self):
        self.module.make = lambda *, gain, name="x": _Law()
        self.make_dut(gain=1.5, name="y").check("law")
        for parameters in ({}, {"gain": 1.0, "speed": 2}):
            with self.assertRaisesRegex(
                UserError, rf"^law\.parameters: {MODULE}:make does not take"
            ):
                self.make_dut(**parameters).check("law")

    def test_a_factory_s_own_complaint(self):
        def make():
            raise ValueError("gain must be\nabove 0")

        self.module.make = make
        with self.assertRaisesRegex(
            UserError, f"^law: {MODULE}:make: ValueError: gain must be above 0$"
        ):
            self.make_dut().check("law")

    def test_a_factory_that_ends_the_program(self):
        def make():
            sys.exit(3)

        self.module.make = make
        with self.assertRaisesRegex(
            UserError, f"^law: {MODULE}:make: SystemExit: 3$"
        ):
            self.make_dut().check("law")

    def test_factory_that_is_not_there(self):
        for factory, expected in (
            ("", r"law\.factory: '' must be \"package.module:function\""),
            ("my_law", r"'my_law' must be"),
            ("my_law:", r"'my_law:' must be"),
            (":make", r"':make' must be"),
            ("no_such.law:make", r"there is no module 'no_such\.law'"),
            ("tofssm_drake.no:make", r"there is no module 'tofssm_drake\.no'"),
            (f"{MODULE}:other", rf"module '{MODULE}' has no function 'other'"),
        ):
            with self.assertRaisesRegex(UserError, expected):
                mut.Custom(factory=factory).check("law")

    def test_what_is_no_law(self):
        class WithoutMake:
            traits = LawTraits()

        self.assert_wrong(object(), "has no `traits`")
        self.assert_wrong(WithoutMake(), "has no method `make")

    def test_wrong_systems(self):
        def rename(**cell):
            system = LeafSystem()
            system.DeclareVectorInputPort("distance", 1)
            return system

        def make_vector(**cell):
            system = LeafSystem()
            system.DeclareVectorInputPort("separation", 1)
            return system

        for make, expected in (
            (lambda: None, "make: TypeError: "),
            (lambda **cell: 3, "make: must return a Drake System, not int"),
            (rename, "one input port, 'separation', abstract; it has distance"),
            (make_vector, "one input port, 'separation', abstract"),
        ):
            self.assert_wrong(_Law(make), expected)

    def test_wrong_decisions(self):
        def make_deciding(**changes):
            def wrong(separation, time):
                return SpeedDecision(
                    **{"name": separation.name, "reason": "x"} | changes
                )

            return lambda **cell: _System(cell["links"], wrong)

        for changes, expected in (
            ({"name": ("a", "b")}, "decision: is of the links"),
            ({"signal": {"x": np.zeros(2)}}, r"signals \['x'\] must be"),
            ({"state": np.zeros(2)}, "2 states for 2 links and 0 names"),
            ({"reason": ""}, "gives no reason"),
        ):
            self.assert_wrong(_Law(make_deciding(**changes)), expected)

        def no_decision(separation, time):
            return 0.5

        self.assert_wrong(
            _Law(lambda **cell: _System(cell["links"], no_decision)),
            "must be a SpeedDecision, not float",
        )

    def test_signals_need_a_value_per_link(self):
        class Law(_Law):
            traits = LawTraits(signals={"x": LinkSignal()})

        def wrong(separation, time):
            return SpeedDecision(
                name=separation.name, reason="x", signal={"x": np.zeros(3)}
            )

        self.assert_wrong(
            Law(lambda **cell: _System(cell["links"], wrong)),
            "one value per link",
        )

    def test_full_speed_on_what_is_not_known(self):
        """Each way of not knowing is tried."""
        good = np.zeros(2)
        for field, value, case in (
            ("sequence", good, "without any sample"),
            ("time", good, "with an old sample"),
            ("distance", good + 9.0, "with a distance that is not a number"),
            ("health", good, "with a blind link"),
        ):

            def blind_to(separation, field=field, value=value):
                changes = {field: value}
                if field == "sequence":
                    changes |= {"health": good, "time": good}
                return dc.replace(separation, **changes)

            self.assert_wrong(
                _Law(make_careless(blind_to)),
                f"{case} it asks for full speed",
            )
