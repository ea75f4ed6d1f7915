"""Health of rings and robot in Meshcat, in words."""

import numpy as np
from pydrake.geometry import Box, Meshcat, Rgba
from pydrake.math import RigidTransform

from tofssm_drake.messages import RobotState
import tofssm_drake.visualization.palette as palette
from tofssm_drake.visualization.sign import BOARD, make_sign

OK, HELD, BLIND, FAULT = "OK", "HELD", "BLIND", "FAULT"

_COLOR = {
    OK: palette.STATE[RobotState.NORMAL],
    HELD: palette.STATE[RobotState.REDUCED],
    BLIND: palette.STATE[RobotState.REDUCED],
    FAULT: palette.STATE[RobotState.STOP],
}
_ROW, _COLUMN = 0.15, 0.46
"""Height of a row and width of each of its two columns, m."""


class HealthBoard:
    """A board beside the state's, one row for each ring and the robot.

    Each row is a name and one of OK, HELD, BLIND and FAULT. The loop that
    runs the Diagram draws it when something changes, because the Diagram does
    not know the slider's state.

    Args:
        meshcat: Where to draw.
        names: Of the rows, from the top.
        p_WB: Centre of the board in world, m; it faces +x.
        path: Where in Meshcat's tree.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
        names: tuple[str, ...],
        p_WB=(-0.75, 1.32, 2.05),
        path: str = "health",
    ):
        self._meshcat = meshcat
        self._path = path
        self._shown: dict[str, str] = {}
        height = len(names) * _ROW + 0.06
        board = Box(0.04, 2 * _COLUMN + 0.06, height)
        meshcat.SetObject(f"{path}/board", board, BOARD)
        meshcat.SetTransform(f"{path}/board", RigidTransform(p_WB))
        for i, name in enumerate(names):
            up = (len(names) / 2 - i - 0.5) * _ROW
            left, right = (
                np.add(p_WB, [0.022, side * _COLUMN / 2, up])
                for side in (-1, 1)
            )
            white = Rgba(0.85, 0.86, 0.88, 1.0)
            self._draw(f"{name}/word", name.upper(), left, white)
            for status, color in _COLOR.items():
                self._draw(f"{name}/{status}", status, right, color)
                meshcat.SetProperty(f"{path}/{name}/{status}", "visible", False)

    def _draw(self, name, word, p, color):
        sign = make_sign(
            word, width=_COLUMN, height=_ROW, rgba=color, align="left"
        )
        path = f"{self._path}/{name}"
        self._meshcat.SetObject(path, sign, color)
        self._meshcat.SetTransform(path, RigidTransform(p))

    def show(self, status: dict[str, str]) -> None:
        """Shows what has changed.

        Args:
            status: OK, HELD, BLIND or FAULT by name.
        """
        for name, word in status.items():
            before = self._shown.get(name)
            if word == before:
                continue
            self._shown[name] = word
            for look, visible in ((before, False), (word, True)):
                if look is not None:
                    self._meshcat.SetProperty(
                        f"{self._path}/{name}/{look}", "visible", visible
                    )
