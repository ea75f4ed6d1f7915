"""A person who moves as a user's own function says."""

import dataclasses as dc

from tofssm_drake.errors import require
from tofssm_drake.factory import call_factory
from tofssm_drake.people.motion import HumanMotion


@dc.dataclass(kw_only=True)
class CustomMotion:
    """A motion that a function makes, e.g. from an array of positions.

    The function is called with `period` (control tick, s) and the parameters,
    and returns a `HumanMotion`; `make_motion` makes one of landmarks.
    """

    # The function, "package.module:function".
    factory: str = ""

    # Its further arguments, by name: numbers, words, true or false. A file's
    # name is one relative to the current folder.
    parameters: dict[str, bool | int | float | str] = dc.field(
        default_factory=dict
    )

    def check(self, where: str) -> None:
        """Raises UserError unless the function makes a motion."""
        require(
            bool(self.factory),
            f'{where}.factory: must be "package.module:function"',
        )
        load_motion(self, 0.008, where=where)

    def make_motion(self, period: float, where: str = "people") -> HumanMotion:
        """Returns the motion; period: control tick, s; where: see `check`."""
        return load_motion(self, period, where=where)


def load_motion(
    custom: CustomMotion, period: float, *, where: str = "people"
) -> HumanMotion:
    """Returns the motion that the function makes.

    Args:
        custom: Names the function.
        period: Control tick, s.
        where: Path of keys, for the message.

    Raises:
        UserError: There is no such function, or it makes no motion.
    """
    motion = call_factory(
        custom.factory, custom.parameters, where=where, period=period
    )
    require(
        isinstance(motion, HumanMotion),
        f"{where}: {custom.factory} must return a HumanMotion, not "
        f"{type(motion).__name__}",
    )
    return motion
