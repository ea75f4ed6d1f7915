"""A box that moves along waypoints, such as a cart."""

import dataclasses as dc

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    MakePhongIllustrationProperties,
    PerceptionProperties,
    Rgba,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem

from tofssm_drake.errors import require

_COLOUR = np.array([0.45, 0.45, 0.5, 1.0])


@dc.dataclass(kw_only=True)
class MovingBox:
    """A box on the floor that is driven along waypoints, there and back."""

    # Length (in the direction of motion), width and height, m.
    size: list[float] = dc.field(default_factory=lambda: [0.8, 0.5, 1.0])

    # Places of its centre on the floor, m: [[x, y], ...]; one stands still.
    waypoints: list[list[float]] = dc.field(default_factory=list)

    # Along the way, m/s.
    speed: float = 0.5

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            len(self.size) == 3 and all(0.0 < s <= 10.0 for s in self.size),
            f"{where}.size: {self.size} must be three lengths up to 10 m",
        )
        require(
            bool(self.waypoints)
            and all(
                len(p) == 2 and all(abs(x) <= 100.0 for x in p)
                for p in self.waypoints
            ),
            f"{where}.waypoints: {self.waypoints} must be one or more places "
            "[x, y] within 100 m",
        )
        require(
            0.0 < self.speed <= 10.0,
            f"{where}.speed: {self.speed} must be above 0 and at most 10 m/s",
        )


def calc_box_place(config: MovingBox, time: float) -> tuple[np.ndarray, float]:
    """Returns where a box is and which way it faces.

    Args:
        config: Checked settings.
        time: s.

    Returns:
        Its centre on the floor, m, (2,), and the angle of its length about
        the world's z axis, rad.
    """
    points = np.array(config.waypoints, dtype=float)
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    keep = lengths > 0.0
    points = points[np.concatenate([[True], keep])]
    steps, lengths = steps[keep], lengths[keep]
    if not len(steps):
        return points[0], 0.0
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    # There and back: the angle stays, the box reverses.
    s = config.speed * time % (2.0 * way[-1])
    s = min(s, 2.0 * way[-1] - s)
    i = min(int(np.searchsorted(way, s, side="right")) - 1, len(steps) - 1)
    place = points[i] + (s - way[i]) / lengths[i] * steps[i]
    return place, float(np.arctan2(steps[i, 1], steps[i, 0]))


class MovingBoxSystem(LeafSystem):
    """Moves a box through the scene.

    .. pydrake_system::

        name: MovingBoxSystem
        output_ports:
        - geometry_pose

    Sensors see it; it is no person, so the truth of distances leaves it out.

    Attributes:
        source_id: Of the geometry on the SceneGraph.
    """

    def __init__(
        self, *, scene_graph: SceneGraph, config: MovingBox, name: str
    ):
        """Registers the box.

        Args:
            scene_graph: Where to register; the caller connects the port.
            config: Checked settings.
            name: Of the source and of the box.
        """
        super().__init__()
        self.set_name(name)
        self._config = config
        self.source_id = scene_graph.RegisterSource(name)
        self._frame_id = scene_graph.RegisterFrame(
            self.source_id, GeometryFrame(name)
        )
        box = GeometryInstance(
            RigidTransform([0.0, 0.0, 0.5 * config.size[2]]),
            Box(*config.size),
            name,
        )
        box.set_illustration_properties(
            MakePhongIllustrationProperties(_COLOUR)
        )
        perception = PerceptionProperties()
        perception.AddProperty("phong", "diffuse", Rgba(*_COLOUR))
        box.set_perception_properties(perception)
        scene_graph.RegisterGeometry(self.source_id, self._frame_id, box)
        self.DeclareAbstractOutputPort(
            "geometry_pose",
            alloc=lambda: Value(FramePoseVector()),
            calc=self._calc_geometry_pose,
            prerequisites_of_calc={self.time_ticket()},
        )

    def _calc_geometry_pose(self, context, output):
        (x, y), angle = calc_box_place(self._config, context.get_time())
        output.get_mutable_value().set_value(
            self._frame_id,
            RigidTransform(RotationMatrix.MakeZRotation(angle), [x, y, 0.0]),
        )
