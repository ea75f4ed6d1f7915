"""The robot state in Meshcat, at a glance."""

import itertools

import numpy as np
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import LeafSystem

from tofssm_drake.messages import RobotState
from tofssm_drake.visualization import palette
from tofssm_drake.visualization.animated import AnimatedProperty

# Strokes on a grid of 4 by 6, as they would be written by hand.
_LETTERS = {
    "A": ["00 26 40", "12 32"],
    "B": ["00 06 36 45 44 33 03", "33 42 41 30 00"],
    "C": ["45 36 16 05 01 10 30 41"],
    "D": ["00 06 26 44 42 20 00"],
    "E": ["46 06 00 40", "03 33"],
    "F": ["06 00", "46 06", "03 33"],
    "H": ["06 00", "46 40", "03 43"],
    "I": ["20 26"],
    "K": ["06 00", "46 03 40"],
    "L": ["06 00 40"],
    "M": ["00 06 23 46 40"],
    "N": ["00 06 40 46"],
    "O": ["10 01 05 16 36 45 41 30 10"],
    "P": ["00 06 36 45 44 33 03"],
    "R": ["00 06 36 45 44 33 03", "23 40"],
    "S": ["45 36 16 05 04 13 33 42 41 30 10 01"],
    "T": ["06 46", "26 20"],
    "U": ["06 01 10 30 41 46"],
    "W": ["06 10 24 30 46"],
}


def make_word_mesh(
    word: str, *, height: float, stroke: float
) -> tuple[np.ndarray, np.ndarray]:
    """Makes flat letters as triangles.

    Args:
        word: Of the letters of what is shown: the states, the rings' names,
            their health.
        height: Of a letter, m.
        stroke: Width of its strokes, m.

    Returns:
        (vertices (3, v), faces (3, f)), as Meshcat wants them. The word lies
        in the y-z plane, is read along +y with z up, as seen from +x, and is
        centred on the origin.
    """
    unit = height / 6
    vertices, faces = [], []
    for k, letter in enumerate(word):
        for strokes in _LETTERS[letter]:
            points = np.array(
                [[float(c[0]) + 5.6 * k, float(c[1])] for c in strokes.split()]
            )
            points *= unit
            for a, b in itertools.pairwise(points):
                along = (b - a) / np.linalg.norm(b - a) * stroke / 2
                across = np.array([-along[1], along[0]])
                first = len(vertices)
                vertices += [
                    a - along - across,
                    b + along - across,
                    b + along + across,
                    a - along + across,
                ]
                faces += [
                    [first, first + 1, first + 2],
                    [first, first + 2, first + 3],
                ]
    flat = np.array(vertices)
    width = (5.6 * (len(word) - 1) + 4) * unit
    flat -= [width / 2, height / 2]
    return np.vstack([np.zeros(len(flat)), flat.T]), np.array(faces).T


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
    """Shows the robot state as stack light, word and ring on the floor.

    .. pydrake_system::

        name: StateLight
        input_ports:
        - robot_state

    No part of it relies on colour alone: the stack light has stop on top and
    normal at the bottom, the sign spells the state, and the ring on the
    floor is the broader the slower the robot.

    Args:
        meshcat: Where to draw.
        p_WF: Foot of the stack light in world, m.
        p_WR: Centre of the ring on the floor, m.
        height: Of the stack light, m.
        radius: Outer radius of the ring on the floor, m.
        yaw: Direction into which the sign faces, rad; 0 is +x.
        period: Between frames, s.
        path: Where in Meshcat's tree.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
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
        self._robot_state_port = self.DeclareVectorInputPort("robot_state", 1)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _draw_stack(self, meshcat, p_WF, height, yaw, path):
        dark = Rgba(0.20, 0.21, 0.23, 1.0)
        unlit = Rgba(0.36, 0.37, 0.39, 1.0)
        R = RollPitchYaw(0, 0, yaw)

        def draw(name, shape, rgba, p):
            meshcat.SetObject(f"{path}/{name}", shape, rgba)
            meshcat.SetTransform(
                f"{path}/{name}", RigidTransform(R, p_WF + np.asarray(p))
            )

        lamp = 0.15
        pole = height - 3 * lamp
        draw("pole", Cylinder(0.025, pole), dark, [0, 0, pole / 2])
        facing = RigidTransform(R, p_WF).rotation()
        for i, state in enumerate((2, 1, 0)):
            state = RobotState(state)
            z = pole + (i + 0.5) * lamp
            draw(
                f"unlit_{state.name}",
                Cylinder(0.055, lamp - 0.015),
                unlit,
                [0, 0, z],
            )
            name = f"{state.name}/lamp"
            draw(
                name,
                Cylinder(0.085, lamp - 0.01),
                palette.STATE[state],
                [0, 0, z],
            )
            word = f"{path}/{state.name}/word"
            meshcat.SetTriangleMesh(
                word,
                *make_word_mesh(
                    palette.STATE_WORD[state], height=0.2, stroke=0.035
                ),
                palette.STATE[state],
            )
            p = p_WF + facing @ [0.022, 0, height + 0.28]
            meshcat.SetTransform(word, RigidTransform(R, p))
        draw("board", Box(0.04, 1.42, 0.36), dark, [0, 0, height + 0.28])

    def _publish(self, context):
        state = int(self._robot_state_port.Eval(context)[0])
        for look, shown in self._shown.items():
            shown.set(look == state, context.get_time(), self._period)
