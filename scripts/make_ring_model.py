"""Writes models/rings/rings_N.dmd.yaml: the frames of the ToF rings.

Usage: python -m tofssm_drake.scripts.make_ring_model [FOLDER]
"""

import dataclasses as dc
import pathlib
import sys

import numpy as np

import tofssm_drake.models as models


@dc.dataclass(frozen=True, kw_only=True)
class RingPlace:
    """Where a ring is mounted."""

    name: str
    link: str
    """Frame that carries the ring."""
    p_AL: tuple[float, float, float]
    """Ring's centre in that frame, m."""
    rpy_AL: tuple[float, float, float]
    """Orientation of the ring's frame in it, deg."""
    radius: float
    """From the ring's axis to the sensors, m (assumed)."""
    text: str


# The z axis of a ring is its axis, outwards along the arm; x is the beam of
# sensor 0. On the two arms x is the joint axis, hence the direction of the
# sweep: sensors 0 and n/2 look where the arm goes. At the tool x is the tool's
# x axis, which the default program also keeps along the sweep.
RINGS = (
    RingPlace(
        name="base",
        link="ur10::upper_arm_link",
        p_AL=(-0.306, 0.0, 0.1759),
        rpy_AL=(0.0, -90.0, 0.0),
        radius=0.075,
        text="mid upper arm, on the axis of its tube",
    ),
    RingPlace(
        name="elbow",
        link="ur10::forearm_link",
        p_AL=(-0.286, 0.0, 0.0482),
        rpy_AL=(0.0, -90.0, 0.0),
        radius=0.065,
        text="mid forearm, on the axis of its tube",
    ),
    RingPlace(
        name="tool",
        link="ur10::tool0",
        p_AL=(0.0, 0.0, 0.035),
        rpy_AL=(0.0, 0.0, 0.0),
        radius=0.070,
        text="between flange and gripper, on the tool axis",
    ),
)


def _format(value: float) -> str:
    return f"{round(value, 9) + 0.0:.9g}"


def make_ring_directives(sensors_per_ring: int) -> str:
    """Returns the text of rings_N.dmd.yaml.

    Frame `<ring>_ring` is the ring's frame L: origin at the link's centre,
    z along the link. Frame `<ring>_ring_<j>` is sensor frame S_j: turned by
    360 j / n deg about L's z axis (right-handed), x is the beam, the origin
    lies on the ring's circle.

    Args:
        sensors_per_ring: Number n of sensors, evenly spaced.
    """
    lines = [
        "# Written by scripts/make_ring_model.py: do not edit.",
        "# <ring>_ring: centre of the ring, z along the link, x is the beam of",
        "# sensor 0. <ring>_ring_<j>: sensor j, at j * "
        f"{_format(360 / sensors_per_ring)} deg about that z; x is",
        "# its beam, the origin lies on the ring's circle.",
        "directives:",
    ]
    for ring in RINGS:
        frame = f"{ring.name}_ring"
        p = ", ".join(_format(value) for value in ring.p_AL)
        rpy = ", ".join(_format(value) for value in ring.rpy_AL)
        lines += [
            f"# {ring.text}",
            "- add_frame:",
            f"    name: {frame}",
            "    X_PF:",
            f"      base_frame: {ring.link}",
            f"      translation: [{p}]",
            f"      rotation: !Rpy {{deg: [{rpy}]}}",
        ]
        for j in range(sensors_per_ring):
            angle = 2 * np.pi * j / sensors_per_ring
            x = _format(ring.radius * np.cos(angle))
            y = _format(ring.radius * np.sin(angle))
            lines += [
                "- add_frame:",
                f"    name: {frame}_{j}",
                "    X_PF:",
                f"      base_frame: {frame}",
                f"      translation: [{x}, {y}, 0]",
                "      rotation: !Rpy {deg: [0, 0, "
                f"{_format(np.rad2deg(angle))}]}}",
            ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Writes the shipped files."""
    folder = models.find_package_xml().parent / "rings"
    if len(sys.argv) > 1:
        folder = pathlib.Path(sys.argv[1])
    for sensors_per_ring in (8, 16):
        path = folder / f"rings_{sensors_per_ring}.dmd.yaml"
        path.write_text(make_ring_directives(sensors_per_ring))
        print(path)


if __name__ == "__main__":
    main()
