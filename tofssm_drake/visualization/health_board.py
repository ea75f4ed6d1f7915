"""Health of rings and robot in Meshcat, in words."""

import numpy as np
from pydrake.geometry import Box, Meshcat, Rgba
from pydrake.math import RigidTransform

from tofssm_drake.messages import RobotState
from tofssm_drake.visualization import palette
from tofssm_drake.visualization.state_light import make_word_mesh

OK, HELD, BLIND, FAULT = "OK", "HELD", "BLIND", "FAULT"

_COLOR = {
    OK: palette.STATE[RobotState.NORMAL],
    HELD: palette.STATE[RobotState.REDUCED],
    BLIND: palette.STATE[RobotState.REDUCED],
    FAULT: palette.STATE[RobotState.STOP],
}
_HEIGHT, _STROKE, _ROW = 0.09, 0.016, 0.15
_WIDTH = 0.98


class HealthBoard:
    """A board beside the state's, one row for each ring and the robot.

    Each row is a name and one of OK, HELD, BLIND and FAULT. It is drawn when
    something changes and not by the Diagram: the slider's state is known to
    who runs the loop only.

    Args:
        meshcat: Where to draw.
        names: Of the rows, from the top; of the letters in `state_light`.
        p_WB: Centre of the board in world, m; it faces +x.
        path: Where in Meshcat's tree.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
        names: tuple[str, ...] = ("base", "elbow", "tool", "robot"),
        p_WB=(-0.75, 1.32, 2.05),
        path: str = "health",
    ):
        self._meshcat = meshcat
        self._path = path
        self._shown: dict[str, str] = {}
        size = len(names) * _ROW + 0.06
        meshcat.SetObject(
            f"{path}/board",
            Box(0.04, _WIDTH, size),
            Rgba(0.20, 0.21, 0.23, 1.0),
        )
        meshcat.SetTransform(f"{path}/board", RigidTransform(p_WB))
        for i, name in enumerate(names):
            up = (len(names) / 2 - i - 0.5) * _ROW
            p = np.add(p_WB, [0.022, 0, up])
            self._draw(name, name, p, -0.44, Rgba(0.85, 0.86, 0.88, 1.0))
            for status, color in _COLOR.items():
                at = f"{name}/{status}"
                self._draw(at, status, p, 0.07, color)
                meshcat.SetProperty(f"{path}/{at}", "visible", False)

    def _draw(self, name, word, p, left, color):
        vertices, faces = make_word_mesh(
            word.upper(), height=_HEIGHT, stroke=_STROKE
        )
        path = f"{self._path}/{name}/word"
        self._meshcat.SetTriangleMesh(path, vertices, faces, color)
        shift = [0, left - vertices[1].min(), 0]
        self._meshcat.SetTransform(path, RigidTransform(p + shift))

    def show(self, status: dict[str, str]) -> None:
        """Shows what is new.

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
