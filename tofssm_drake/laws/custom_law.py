"""A law of one's own as a choice of a scenario."""

import dataclasses as dc

import numpy as np
from pydrake.systems.framework import PortDataType, System

from tofssm_drake.errors import UserError, require
from tofssm_drake.factory import call_factory, tell
from tofssm_drake.laws.law import LawTraits
from tofssm_drake.messages import (
    RingHealth,
    Separation,
    SpeedDecision,
    make_empty_separation,
)

_TRIAL = ("first", "second")
_TICK = 0.008


@dc.dataclass(kw_only=True)
class Custom:
    """A law that someone else's code makes, see `Law`."""

    # The function that returns the law, "package.module:function". Python
    # looks for the module where it looks for all, and in the current folder.
    factory: str = ""

    # Its keyword arguments.
    parameters: dict[str, bool | int | float | str] = dc.field(
        default_factory=dict
    )

    def check(self, where: str) -> None:
        """Raises UserError unless the factory makes a `Law`.

        The law is made once for two links and asked what it decides when
        nothing is known: it must not be full speed.

        Args:
            where: Name of these settings in the user's input.
        """
        law = call_factory(self.factory, self.parameters, where=where)
        where = f"{where}.factory: {self.factory}"
        require(
            isinstance(getattr(law, "traits", None), LawTraits),
            f"{where}: what it returns has no `traits` of type LawTraits",
        )
        require(
            callable(getattr(law, "make", None)),
            f"{where}: what it returns has no method `make(links, offset, "
            "period)`",
        )
        law.traits.check(f"{where}: traits")
        try:
            system = law.make(
                links=_TRIAL, offset=np.zeros(len(_TRIAL)), period=_TICK
            )
        except Exception as error:
            raise UserError(f"{where}: make: {tell(error)}") from error
        check_law_system(system, law.traits, _TRIAL, where=f"{where}: make")

    @property
    def traits(self) -> LawTraits:
        """See `Law`."""
        return self._load().traits

    def make(
        self, *, links: tuple[str, ...], offset: np.ndarray, period: float
    ) -> System:
        """Makes the law, see `Law`."""
        law = self._load()
        system = law.make(links=links, offset=offset, period=period)
        check_law_system(system, law.traits, links, where=self.factory)
        return system

    def _load(self):
        return call_factory(self.factory, self.parameters, where="law")


def check_law_system(
    system: System, traits: LawTraits, links: tuple[str, ...], *, where: str
) -> None:
    """Raises UserError unless a System has the ports of a law, see `Law`.

    Args:
        system: What a law's `make` returned.
        traits: The law's.
        links: What it was made for.
        where: Whose it is, for the message.
    """
    require(
        isinstance(system, System),
        f"{where}: must return a Drake System, not {type(system).__name__}",
    )
    _require_ports(system, where)
    for case, separation in make_unknown_separations(links):
        try:
            context = system.CreateDefaultContext()
            port = system.GetInputPort("separation")
            port.FixValue(context, separation)
            decision = system.GetOutputPort("decision").Eval(context)
        except Exception as error:
            raise UserError(f"{where}: {case}: {tell(error)}") from error
        _require_decision(decision, traits, links, where)
        require(
            decision.safe_target < 1.0 and bool(decision.reason),
            f"{where}: {case} it asks for full speed, or gives no reason; it "
            "must be slow or stop, and say why",
        )


def make_unknown_separations(
    links: tuple[str, ...],
) -> list[tuple[str, Separation]]:
    """Returns separations at time 0 at which no law may be at full speed.

    Args:
        links: Names of the m links.

    Returns:
        Pairs of a description and the separation.
    """
    m = len(links)
    empty = make_empty_separation(links)
    good = dc.replace(
        empty,
        sequence=np.zeros(m, dtype=int),
        time=np.zeros(m),
        health=np.full(m, int(RingHealth.HEALTHY)),
    )

    def spoil(field, value):
        values = getattr(good, field).copy()
        values[-1] = value
        return dc.replace(good, **{field: values})

    return [
        ("without any sample", empty),
        ("with a link without a sample", spoil("sequence", -1)),
        ("with an old sample", spoil("time", -10.0)),
        ("with a distance that is not a number", spoil("distance", np.nan)),
        *(
            (f"with a {health.name.lower()} link", spoil("health", health))
            for health in RingHealth
            if health != RingHealth.HEALTHY
        ),
    ]


def _require_ports(system, where):
    """Raises UserError unless the ports are named and typed like a law's."""
    inputs = [system.get_input_port(i) for i in range(system.num_input_ports())]
    outputs = [
        system.get_output_port(i) for i in range(system.num_output_ports())
    ]
    for ports, name, way in (
        (inputs, "separation", "input"),
        (outputs, "decision", "output"),
    ):
        require(
            [port.get_name() for port in ports] == [name]
            and ports[0].get_data_type() == PortDataType.kAbstractValued,
            f"{where}: must have one {way} port, {name!r}, abstract; it has "
            f"{', '.join(port.get_name() for port in ports) or 'none'}",
        )


def _require_decision(decision, traits, links, where):
    """Raises UserError unless a decision is one of this law's."""
    require(
        isinstance(decision, SpeedDecision),
        f"{where}: decision: must be a SpeedDecision, not "
        f"{type(decision).__name__}",
    )
    m = len(links)
    require(
        decision.name == links,
        f"{where}: decision: is of the links {decision.name}, must be of "
        f"{links}",
    )
    require(
        set(decision.signal) == set(traits.signals)
        and all(np.shape(v) == (m,) for v in decision.signal.values()),
        f"{where}: decision: signals {sorted(decision.signal)} must be those "
        f"of the traits, {sorted(traits.signals)}, one value per link",
    )
    require(
        len(decision.state) == (m if traits.states else 0),
        f"{where}: decision: {len(decision.state)} states for {m} links and "
        f"{len(traits.states)} names of states",
    )
