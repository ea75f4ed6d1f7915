"""Motion capture: the true person, as in the paper's *Ideal* sensing."""

import dataclasses as dc

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame

from tofssm_drake.diagrams.sensors.parts import Monitor, Sensing
from tofssm_drake.errors import check_range, require
from tofssm_drake.perception.ideal_separation import (
    IdealSeparation,
    IdealSeparationConfig,
)
from tofssm_drake.poses import Pose
from tofssm_drake.sensors.ring import find_frame


@dc.dataclass(kw_only=True)
class Link:
    """A link that motion capture watches."""

    # Frame of the robot's model, `frame` or `model::frame`.
    parent: str = ""

    # The frame of the link's centre, from which distances count, in it.
    X_PL: Pose = dc.field(default_factory=Pose)

    # From the centre to the link's surface, m; only the report uses it.
    radius: float = 0.0

    def check(self, where: str) -> None:
        """Raises UserError unless the link is complete."""
        require(bool(self.parent), f"{where}.parent: name a frame of the robot")
        self.X_PL.check(f"{where}.X_PL")
        check_range(where, "radius", self.radius, 0.0, 10.0)


@dc.dataclass(kw_only=True)
class MotionCapture(IdealSeparationConfig):
    """Knows the person's true surface; only in simulation."""

    # What it watches, by name.
    links: dict[str, Link] = dc.field(default_factory=dict)

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        super().check(where)
        require(bool(self.links), f"{where}.links: name what it watches")
        for name, link in self.links.items():
            link.check(f"{where}.links.{name}")

    def add_frames(self, plant: MultibodyPlant, name: str) -> None:
        """Adds the links' frames to a plant not yet finalized."""
        for link_name, link in self.links.items():
            where = f"sensors.{name}.links.{link_name}.parent"
            plant.AddFrame(
                FixedOffsetFrame(
                    f"{name}_{link_name}",
                    find_frame(plant, link.parent, where),
                    link.X_PL.to_transform(),
                )
            )

    def find_link_frames(self, name: str) -> dict[str, str]:
        """Returns the frame of each watched link."""
        return {link: f"{name}_{link}" for link in self.links}


def add_motion_capture_to_monitor(
    monitor: Monitor, name: str, capture: MotionCapture
) -> Sensing:
    """Adds the separation of motion capture; it has no side in the world."""
    if monitor.person_radii is None:
        raise ValueError("person_radii: motion capture needs the person's")
    links = tuple(capture.links)
    system = monitor.builder.AddNamedSystem(
        f"separation_{name}",
        IdealSeparation(
            config=capture,
            k_max=monitor.settings.k_max,
            kinematics=monitor.select_links(links),
            radii=monitor.person_radii,
            name=links,
        ),
    )
    for port in ("position_measured", "velocity_measured", "skeleton"):
        monitor.connect_input(port, system.GetInputPort(port))
    return Sensing(links=links, separation=system.GetOutputPort("separation"))
