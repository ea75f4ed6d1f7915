"""The rows of the fault table as cases of a test.

`make test` injects every third fault, at one moment each; `make test-long`
does the rest.
"""

from collections.abc import Sequence

from fault_rows import Moment, Row, find_failure, measure_row
from lockstep import Cell
import pytest

_MOMENTS = tuple(Moment)
# Of these rows `make test` does one.
_EACH = 3


def list_cases(rows: Sequence[Row]) -> list:
    """Returns each row at each moment, for `pytest.mark.parametrize`.

    Faults that nothing finds yet are expected to fail: the case reports when
    one is found.
    """
    return [
        pytest.param(
            row,
            moment,
            id=f"{row.name.replace('`', '')}-{moment.name}",
            marks=_list_marks(row, moment, number),
        )
        for number, row in enumerate(rows)
        for moment in Moment
    ]


def _list_marks(row, moment, number):
    marks = []
    if moment in row.open:
        marks.append(pytest.mark.xfail(reason=row.finder))
    turn, rest = divmod(number, _EACH)
    if rest or moment != _MOMENTS[turn % len(_MOMENTS)]:
        marks.append(pytest.mark.long)
    return marks


def check_row(cell: Cell, row: Row, moment: Moment) -> None:
    """Fails with one line unless the robot does what the row demands."""
    failure = find_failure(row, moment, measure_row(cell, row, moment))
    assert not failure, failure
