"""Figures of Universal Robots' arms, one file each in models/ur/.

The files say where each number is from, and which are assumed.
"""

import dataclasses as dc
import functools
import pathlib

from pydrake.common.yaml import yaml_load_typed

from tofssm_drake.errors import require
import tofssm_drake.models as models


@dc.dataclass(kw_only=True)
class UrRadii:
    """Radii of the capsules along an arm's links, m."""

    # Of the base, and of the housings of shoulder, elbow and wrists.
    base: float = 0.0
    shoulder: float = 0.0
    elbow: float = 0.0
    wrist: float = 0.0

    # Of the tubes.
    upper_arm: float = 0.0
    forearm: float = 0.0


@dc.dataclass(kw_only=True)
class UrData:
    """Figures of one kind of arm."""

    # What UR calls it.
    name: str = ""

    # Greatest payload, kg, and reach, m.
    payload: float = 0.0
    reach: float = 0.0

    # A robot description of the arm; empty: it is built from these figures.
    file: str = ""

    # Denavit-Hartenberg lengths, m, with UR's signs.
    d1: float = 0.0
    a2: float = 0.0
    a3: float = 0.0
    d4: float = 0.0
    d5: float = 0.0
    d6: float = 0.0

    # Of each link: mass, kg, (6,); centre of mass in its Denavit-Hartenberg
    # frame, m, (6, 3); xx, yy, zz, xy, xz, yz of its inertia about that, along
    # the frame's axes, kg m^2, (6, 6). And the base's mass, kg.
    mass: list[float] = dc.field(default_factory=list)
    center_of_mass: list[list[float]] = dc.field(default_factory=list)
    inertia: list[list[float]] = dc.field(default_factory=list)
    base_mass: float = 0.0

    # Greatest joint speeds, deg/s, torques, Nm, accelerations, deg/s^2, (6,),
    # and how far the joints turn either way, deg.
    max_speed: list[float] = dc.field(default_factory=list)
    max_torque: list[float] = dc.field(default_factory=list)
    max_acceleration: list[float] = dc.field(default_factory=list)
    position_limit: float = 0.0

    # How far the tubes of upper arm and forearm lie beside the plane of the
    # shoulder, along its axis, m.
    shoulder_offset: float = 0.0
    elbow_offset: float = 0.0

    # Of the capsules.
    radius: UrRadii = dc.field(default_factory=UrRadii)


def list_ur_models() -> list[str]:
    """Returns the names of the arms that have figures, in order."""
    return sorted(path.stem for path in _find_folder().glob("*.yaml"))


@functools.cache
def read_ur_data(model: str, where: str = "robot.model") -> UrData:
    """Returns the figures of an arm.

    Args:
        model: E.g. "ur5e".
        where: What the user calls this, for the message.

    Raises:
        UserError: There is no such arm.
    """
    known = list_ur_models()
    require(
        model in known,
        f"{where}: {model!r} is unknown, use one of {', '.join(known)}",
    )
    return yaml_load_typed(
        schema=UrData, filename=str(_find_folder() / f"{model}.yaml")
    )


def _find_folder() -> pathlib.Path:
    return models.find_package_xml().parent / "ur"
