"""The fault table: faults of the robot and of its link.

The rows are in tests/hardware/fault_rows.py.
"""

from fault_cases import check_row, list_cases
from fault_rows import ROBOT_ROWS
import pytest


@pytest.mark.parametrize(("row", "moment"), list_cases(ROBOT_ROWS))
def test_fault(fault_cells, row, moment):
    check_row(fault_cells[moment], row, moment)
