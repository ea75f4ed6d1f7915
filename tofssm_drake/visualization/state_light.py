"""The robot state in Meshcat, at a glance."""

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import LeafSystem

from tofssm_drake.messages import RobotState, make_empty_decision
from tofssm_drake.visualization.animated import AnimatedProperty
import tofssm_drake.visualization.palette as palette
from tofssm_drake.visualization.sign import BOARD, make_sign


def make_annulus_mesh(
    inner: float, outer: float, *, sides: int = 72
) -> tuple[np.ndarray, np.ndarray]:
    """Makes a flat ring in the x-y plane.

    Args:
        inner: Inner radius, m.
        outer: Outer radius, m.
        sides: Corners of its circles.

    Returns:
        (vertices (3, v), faces (3, f)).
    """
    phi = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.vstack([np.cos(phi), np.sin(phi), np.zeros(sides)])
    i = np.arange(sides)
    j = (i + 1) % sides
    faces = np.hstack([[i, sides + i, sides + j], [i, sides + j, j]])
    return np.hstack([inner * circle, outer * circle]), faces


class StateLight(LeafSystem):
    """Shows a law's decision as stack light, word and ring on the floor.

    .. pydrake_system::

        name: StateLight
        input_ports:
        - decision

    `decision` is a `SpeedDecision`; what its target amounts to is shown: stop,
    reduced or normal (`RobotState`).

    No part of it relies on colour alone: the stack light has stop on top and
    normal at the bottom, the sign spells the state, and the slower the
    robot, the broader the ring on the floor.

    Args:
        meshcat: Where to draw.
        links: Names of the m watched links.
        p_WF: Foot of the stack light in world, m.
        p_WR: Centre of the ring on the floor, m.
        height: Of the stack light, m.
        radius: Outer radius of the ring on the floor, m.
        yaw: Direction that the sign faces, rad; 0 is +x.
        period: Between frames, s.
        path: Where in Meshcat's tree.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
        links: tuple[str, ...],
        p_WF=(-0.75, 0.0, 0.0),
        p_WR=(0.0, 0.0, 0.004),
        height: float = 1.9,
        radius: float = 1.35,
        yaw: float = 0.0,
        period: float = 1 / 16,
        path: str = "state",
    ):
        super().__init__()
        self._period = period
        self._draw_stack(meshcat, np.asarray(p_WF), height, yaw, path)
        width = {
            RobotState.STOP: 0.20,
            RobotState.REDUCED: 0.10,
            RobotState.NORMAL: 0.04,
        }
        for state in RobotState:
            ring = f"{path}/{state.name}/floor"
            meshcat.SetTriangleMesh(
                ring,
                *make_annulus_mesh(radius - width[state], radius),
                palette.STATE[state],
            )
            meshcat.SetTransform(ring, RigidTransform(p_WR))
        self._shown = {
            state: AnimatedProperty(
                meshcat=meshcat, path=f"{path}/{state.name}", name="visible"
            )
            for state in RobotState
        }
        self._decision = self.DeclareAbstractInputPort(
            "decision", Value(make_empty_decision(links))
        )
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _draw_stack(self, meshcat, p_WF, height, yaw, path):
        unlit = Rgba(0.36, 0.37, 0.39, 1.0)
        X_WF = RigidTransform(RollPitchYaw(0, 0, yaw), p_WF)

        def draw(name, shape, rgba, p_F):
            meshcat.SetObject(f"{path}/{name}", shape, rgba)
            meshcat.SetTransform(f"{path}/{name}", X_WF @ RigidTransform(p_F))

        lamp = 0.15
        pole = height - 3 * lamp
        board = height + 0.28
        draw("pole", Cylinder(0.025, pole), BOARD, [0, 0, pole / 2])
        draw("board", Box(0.04, 1.42, 0.36), BOARD, [0, 0, board])
        for i, state in enumerate(sorted(RobotState, reverse=True)):
            p_F = [0, 0, pole + (i + 0.5) * lamp]
            rgba = palette.STATE[state]
            off = Cylinder(0.055, lamp - 0.015)
            draw(f"unlit_{state.name}", off, unlit, p_F)
            on = Cylinder(0.085, lamp - 0.01)
            draw(f"{state.name}/lamp", on, rgba, p_F)
            word = make_sign(
                palette.STATE_WORD[state], width=1.42, height=0.36, rgba=rgba
            )
            draw(f"{state.name}/word", word, rgba, [0.022, 0, board])

    def _publish(self, context):
        state = self._decision.Eval(context).robot_state
        for look, shown in self._shown.items():
            shown.set(look == state, context.get_time(), self._period)
