"""Links that different sensors watch, in one message."""

from collections.abc import Sequence
import dataclasses as dc
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from tofssm_drake.messages import Separation, make_empty_separation


def join_separations(
    parts: Sequence[Separation], name: tuple[str, ...]
) -> Separation:
    """Returns the separation of all links of several ones.

    A law takes the worst of all links, so links need not be merged: one that
    two sensors watch is there twice, under two names.

    Args:
        parts: Of different links.
        name: The links in the order of the result.
    """
    joined: dict[str, Any] = {}
    names = [link for part in parts for link in part.name]
    rows = [names.index(link) for link in name]
    for field in dc.fields(Separation):
        values = [getattr(part, field.name) for part in parts]
        if field.name == "problem":
            # Empty means that nothing is known of a part.
            values = [part.problem or ("",) * len(part.name) for part in parts]
        joined[field.name] = (
            tuple(sum(values, ())[row] for row in rows)
            if isinstance(values[0], tuple)
            else np.concatenate(values)[rows]
        )
    return Separation(**joined)


class SeparationFusion(LeafSystem):
    """Joins the separations of several sensors.

    .. pydrake_system::

        name: SeparationFusion
        input_ports:
        - separation_0
        - separation_1
        output_ports:
        - separation

    There are as many inputs as sensors (two in this picture).
    """

    def __init__(
        self, links: Sequence[tuple[str, ...]], *, name: tuple[str, ...]
    ):
        """Constructs the system.

        Args:
            links: Names of the links of each input.
            name: All of them in the order of the result.

        Raises:
            ValueError: The names are not the same, or one occurs twice.
        """
        super().__init__()
        if sorted(sum(links, ())) != sorted(set(name)):
            raise ValueError(f"links {links} are not {name}")
        self._name = tuple(name)
        self._inputs = [
            self.DeclareAbstractInputPort(
                f"separation_{i}", Value(make_empty_separation(part))
            )
            for i, part in enumerate(links)
        ]
        self.DeclareAbstractOutputPort(
            "separation",
            lambda: Value(make_empty_separation(self._name)),
            self._calc_separation,
            {port.ticket() for port in self._inputs},
        )

    def _calc_separation(self, context, output):
        output.set_value(
            join_separations(
                [port.Eval(context) for port in self._inputs], self._name
            )
        )
