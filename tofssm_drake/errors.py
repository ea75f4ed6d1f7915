"""Errors of the user, reported in one line."""

from collections.abc import Iterator
import contextlib
import math


class UserError(ValueError):
    """A mistake in the user's input: a setting, a file, a name.

    The message is one line: what is wrong, where, and what would be right.
    The command line prints it without a traceback and exits with code 2.
    """


def require(condition: bool, message: str) -> None:
    """Raises UserError(message) unless the condition holds."""
    if not condition:
        raise UserError(message)


@contextlib.contextmanager
def prefix_errors(where: str) -> Iterator[None]:
    """Begins the message of a UserError with the setting that has led to it.

    Args:
        where: What the user calls it, e.g. its path of keys.
    """
    try:
        yield
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def check_range(
    where: str, name: str, value: float, low: float, high: float
) -> None:
    """Raises UserError unless low <= value <= high (NaN is outside)."""
    require(
        isinstance(value, (int, float)) and low <= value <= high,
        f"{where}.{name}: {value} is out of range; use {low:g} to {high:g}",
    )


def require_period(period: float) -> None:
    """Raises UserError unless a control tick is longer than 0 s.

    Drake itself accepts any number as the period of an event.
    """
    require(
        math.isfinite(period) and period > 0.0,
        f"period: {period!r} must be a number of seconds greater than 0",
    )
