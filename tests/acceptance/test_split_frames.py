"""Rings as the shipped firmware sends them: half of the sensors per frame.

It sends a frame each 12 ms, in which the sensors of the other half have no new
data. The self-hit watch must not look at the same half for ever.
"""

import dataclasses as dc

from lockstep import Cell
import numpy as np
from paper_cell import RINGS
import pytest

from tofssm_drake.ringlink.ring_frame import SEQUENCE_BITS, TIME_BITS
from tofssm_drake.sensors.range_status import STATUS_NO_NEW_DATA

_NO_AGE = 255
_STEP_MS = 12


class SplitCell(Cell):
    """A cell whose rings send some sensors in one frame, the rest in the next.

    Args:
        first: The sensors of the first frame.
    """

    def __init__(self, first):
        super().__init__()
        self._is_first = np.isin(np.arange(8), first)

    def _receive_frame(self, frame, is_damaged):
        frame = self.change(self._show_visitor(frame))
        for k, missing in enumerate((~self._is_first, self._is_first)):
            status, age = frame.status.copy(), frame.age_ms.copy()
            age[~missing] += k * _STEP_MS
            status[missing], age[missing] = STATUS_NO_NEW_DATA, _NO_AGE
            half = dc.replace(
                frame,
                status=status,
                age_ms=age,
                sequence=(2 * frame.sequence + k) % 2**SEQUENCE_BITS,
                time_us=(frame.time_us + 1000 * k * _STEP_MS) % 2**TIME_BITS,
            )
            self._injectors[frame.ring].put(
                half, self._wake_time + 1e-3 * k * _STEP_MS
            )
        return True


def blind(*rings):
    """Returns a change of frames: these rings see nothing."""

    def change(frame):
        if RINGS[frame.ring] not in rings:
            return frame
        return dc.replace(frame, status=np.full(8, 2, dtype=np.uint8))

    return change


@pytest.mark.parametrize(
    "first",
    [
        (1, 3, 5, 7),
        pytest.param((0,), marks=pytest.mark.long),
        pytest.param((2,), marks=pytest.mark.long),
    ],
)
def test_blind_rings_are_found(first):
    cell = SplitCell(first)
    cell.wait_for_full_speed()
    end = cell.time + 2.0
    while cell.time < end:
        cell.step()
    assert cell.robot.slider == 1.0, cell.result.health
    cell.change = blind("tool")
    # A robot that dwells at its pick is looked at a fifth as often.
    end = cell.time + 4.0
    while cell.robot.speed_fraction > 0.0 and cell.time < end:
        cell.step()
    assert cell.robot.speed_fraction == 0.0
    assert "unseen self-hit: tool sensor 2" in cell.result.health
