"""The people of a cell, and other things that move in it.

To add a kind of person, write its file in `tofssm_drake/people`, a dataclass
with `check` and `make_motion`, and name it in `Person`.
"""

from collections.abc import Mapping, Sequence
import dataclasses as dc

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource, Multiplexer

from tofssm_drake.errors import require
from tofssm_drake.people.avatar import SHIRTS, HumanAvatar
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.custom_motion import CustomMotion
from tofssm_drake.people.figure_eight import FigureEightPath
from tofssm_drake.people.motion import HumanMotion
from tofssm_drake.people.moving_box import MovingBox, MovingBoxSystem
from tofssm_drake.people.walk import GeneratedWalk

Person = GeneratedWalk | BvhRecording | CustomMotion


# People nearer to each other at the start are at the same place, m.
_SAME_PLACE = 1e-3


def require_apart(people: Mapping[str, Person], where: str) -> None:
    """Raises UserError unless all people start at different places.

    Args:
        people: By name; checked.
        where: Path of keys, for the message.
    """
    starts: dict[str, np.ndarray] = {}
    for name, person in people.items():
        start = _find_start(person)
        if start is None:
            continue
        for other, place in starts.items():
            require(
                float(np.linalg.norm(start - place)) > _SAME_PLACE,
                f"{where}.{name}: starts where {where}.{other} does, at "
                f"[{place[0]:.2f}, {place[1]:.2f}]; give one of them another "
                "start, e.g. figure_eight: {start: 0.75}",
            )
        starts[name] = start


def _find_start(person):
    """Returns where a person starts, m, (2,); None: only the motion says."""
    if isinstance(person, CustomMotion):
        return None
    if isinstance(person, BvhRecording) and person.placement != "figure_eight":
        return np.array(person.position)
    path = FigureEightPath(config=person.figure_eight)
    return path.calc_position(np.zeros(1))[0]


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class People:
    """The people in a world."""

    avatars: Mapping[str, HumanAvatar]
    """By name; empty: nobody is there."""
    skeleton: OutputPort
    """Where all of them are, one after the other."""
    obstacles: Mapping[str, MovingBox] = dc.field(default_factory=dict)
    """What else moves, by name."""

    @property
    def radii(self) -> np.ndarray:
        """Radii of the capsules in `skeleton`, m, (c,)."""
        return np.concatenate(
            [np.empty(0), *(a.radii for a in self.avatars.values())]
        )

    @property
    def motions(self) -> list[HumanMotion]:
        """How each of them moves."""
        return [avatar.motion for avatar in self.avatars.values()]


def add_people(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    people: Mapping[str, Person],
    obstacles: Mapping[str, MovingBox],
    period: float,
) -> People:
    """Adds the people, and what else moves, to a world.

    Args:
        builder: Of the Diagram.
        scene_graph: Which will show them.
        people: By name.
        obstacles: By name.
        period: Control tick, s.
    """
    avatars = {}
    for i, (name, person) in enumerate(people.items()):
        avatar = builder.AddNamedSystem(
            name,
            HumanAvatar(
                scene_graph=scene_graph,
                motion=person.make_motion(period, f"people.{name}"),
                name=name,
                shirt=SHIRTS[i % len(SHIRTS)],
            ),
        )
        builder.Connect(
            avatar.GetOutputPort("geometry_pose"),
            scene_graph.get_source_pose_port(avatar.source_id),
        )
        avatars[name] = avatar
    for name, box in obstacles.items():
        system = builder.AddNamedSystem(
            name,
            MovingBoxSystem(scene_graph=scene_graph, config=box, name=name),
        )
        builder.Connect(
            system.get_output_port(),
            scene_graph.get_source_pose_port(system.source_id),
        )
    ports = [avatar.GetOutputPort("skeleton") for avatar in avatars.values()]
    return People(
        avatars=avatars,
        skeleton=_join(builder, ports),
        obstacles=dict(obstacles),
    )


def _join(builder, ports: Sequence[OutputPort]) -> OutputPort:
    """Returns a port with all skeletons."""
    if not ports:
        nobody = builder.AddNamedSystem("nobody", ConstantVectorSource([]))
        return nobody.get_output_port()
    if len(ports) == 1:
        return ports[0]
    people = builder.AddNamedSystem(
        "people", Multiplexer([port.size() for port in ports])
    )
    for i, port in enumerate(ports):
        builder.Connect(port, people.get_input_port(i))
    return people.get_output_port()
