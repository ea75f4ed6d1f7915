"""The fault table: faults of single sensors.

The rows are in tests/hardware/fault_rows.py.
"""

import re

from fault_cases import check_row, list_cases
from fault_rows import NEAR, RING, SENSOR, SENSOR_ROWS, Moment
import pytest


@pytest.mark.parametrize(("row", "moment"), list_cases(SENSOR_ROWS))
def test_fault(fault_cells, row, moment):
    check_row(fault_cells[moment], row, moment)


def test_who_holds_the_robot_is_inside_of_d_C(fault_cells):
    cell = fault_cells[Moment.HELD]
    reason = re.fullmatch(
        r"stop: (\w+) at (\d\.\d+) m <= d_C (\d\.\d+) m", cell.result.reason
    )
    assert reason[1] == RING
    assert float(reason[2]) == pytest.approx(NEAR, abs=0.12)
    separation = cell.result.separation
    assert separation.sensor[separation.name.index(RING)] == SENSOR
    # It was at full speed when they came, and is not at rest yet.
    assert 0.0 < cell.robot.speed_fraction < 0.2
