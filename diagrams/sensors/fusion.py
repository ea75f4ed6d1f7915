"""One separation of all links, from those of several sensors."""

from collections.abc import Sequence

from pydrake.systems.framework import OutputPort

from tofssm_drake.diagrams.sensors.parts import Monitor, Sensing
from tofssm_drake.perception.fusion import SeparationFusion


def fuse(monitor: Monitor, sensing: Sequence[Sensing]) -> OutputPort:
    """Adds the fusion of separations, if there are several.

    Args:
        monitor: With all watched links.
        sensing: At least one.

    Returns:
        The separation of all links, in the order of the monitor's kinematics.
    """
    if len(sensing) == 1:
        return sensing[0].separation
    builder = monitor.builder
    fusion = builder.AddNamedSystem(
        "fusion",
        SeparationFusion(
            [part.links for part in sensing], name=monitor.kinematics.name
        ),
    )
    for i, part in enumerate(sensing):
        builder.Connect(part.separation, fusion.get_input_port(i))
    return fusion.get_output_port()
