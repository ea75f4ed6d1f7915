"""What a safety law is to the rest of the cell."""

from collections.abc import Mapping
import dataclasses as dc
from typing import Protocol

import numpy as np
from pydrake.systems.framework import System

from tofssm_drake.errors import check_range
from tofssm_drake.laws.speed_fraction import SpeedRamp
from tofssm_drake.messages import LinkSignal


@dc.dataclass(frozen=True, kw_only=True)
class LawTraits:
    """What others must know of a law: numbers they rely on, words to show."""

    title: str = ""
    """A short name, e.g. for the head of a report."""
    about: str = ""
    """What the law goes by, as a phrase."""
    guide: tuple[tuple[str, str], ...] = ()
    """How to read its results: pairs of a term and sentences about it."""
    limits: str = ""
    """What it is known to fall short of, in sentences."""
    states: tuple[str, ...] = ()
    """Names of its states of a link, by number; empty: it has none."""
    signals: Mapping[str, LinkSignal] = dc.field(default_factory=dict)
    """What the signals in its decision are, by name."""
    deadline: float = 0.1
    """Age of a sample, s, above which its link counts as unwatched."""
    T_R: float = 0.1
    """Reaction time of sensing and robot that it assumes, s."""
    T_stop: float = 0.4
    """Time to a standstill that it assumes, s."""
    C: float = 0.3
    """Margin that it adds for intrusion and uncertainty, m."""
    k_max: float = 3.3
    """Greatest speed at which robot and person close in, m/s: what the sensing
    assumes where it has measured none."""
    monitors_person: bool = False
    """Whether it goes by the speed of the person."""
    reduced_fraction: float = 0.5
    """The speed fraction when it is slow, or a typical one, in (0, 1)."""
    ramp: SpeedRamp = dc.field(default_factory=SpeedRamp)
    """How fast the speed fraction may follow its target."""

    def check(self, where: str) -> None:
        """Raises UserError unless every number is possible.

        Args:
            where: What the user calls these traits.
        """
        for name, low, high in (
            ("deadline", 0.001, 10.0),
            ("T_R", 0.0, 10.0),
            ("T_stop", 0.0, 60.0),
            ("C", 0.0, 100.0),
            ("k_max", 0.01, 100.0),
            ("reduced_fraction", 0.001, 0.999),
        ):
            check_range(where, name, getattr(self, name), low, high)
        self.ramp.check(f"{where}.ramp")


class Law(Protocol):
    """A safety law: from the separation of the links to a speed decision.

    `make` returns a System, a LeafSystem or a Diagram, with one input port and
    one output port, both abstract:

    - `separation`, a `Separation` of the links;
    - `decision`, a `SpeedDecision` of the same links, whose signals are those
      of `traits.signals`.

    The law must not ask for full speed while a link has no sample or an old
    one, is not healthy, or has a distance that is not a number: it is slow or
    stops, and its reason says why. It uses neither clock nor random numbers;
    time is the Context's.

    Attributes:
        traits: What others must know of it.
    """

    @property
    def traits(self) -> LawTraits:
        """What others must know of the law."""

    def make(
        self, *, links: tuple[str, ...], offset: np.ndarray, period: float
    ) -> System:
        """Makes the law for a cell.

        Args:
            links: Names of the m watched links.
            offset: How much farther from the robot's surface than an ordinary
                link's centre each link is measured from, m, (m,); distances to
                keep are greater by that.
            period: Control tick, s.
        """
        ...


def describe_law(law: Law) -> dict:
    """Returns what a record tells of its law, as plain values (JSON).

    Args:
        law: The law as it was run.
    """
    traits = law.traits
    return {
        "kind": type(law).__name__,
        "title": traits.title,
        "about": traits.about,
        "guide": [list(pair) for pair in traits.guide],
        "limits": traits.limits,
        "states": list(traits.states),
        "signals": {
            name: dc.asdict(signal) for name, signal in traits.signals.items()
        },
    }
