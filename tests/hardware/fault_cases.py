"""The rows of the fault table as cases of a test."""

from collections.abc import Sequence

from fault_rows import Moment, Row, find_failure, measure_row
from lockstep import Cell
import pytest


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
            marks=[pytest.mark.xfail(reason=row.finder)]
            if moment in row.open
            else [],
        )
        for row in rows
        for moment in Moment
    ]


def check_row(cell: Cell, row: Row, moment: Moment) -> None:
    """Fails with one line unless the robot does what the row demands."""
    failure = find_failure(row, moment, measure_row(cell, row, moment))
    assert not failure, failure
