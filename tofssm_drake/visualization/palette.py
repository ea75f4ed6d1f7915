"""Colours of the 3-D views, by Okabe and Ito, for all eyes."""

from pydrake.geometry import Rgba

from tofssm_drake.messages import Reading, RobotState

BEAM = {
    Reading.CLEAR: Rgba(0.20, 0.60, 0.86, 0.6),
    Reading.VALID: Rgba(0.0, 0.45, 0.70, 0.6),
    Reading.MASKED: Rgba(0.45, 0.47, 0.50, 0.40),
    Reading.FAULTED: Rgba(0.0, 0.0, 0.0, 1.0),
    Reading.HELD: Rgba(0.80, 0.47, 0.65, 0.6),
}
"""Beam by what its reading means."""

STATE = {
    RobotState.STOP: Rgba(0.80, 0.22, 0.02, 1.0),
    RobotState.REDUCED: Rgba(0.94, 0.72, 0.10, 1.0),
    RobotState.NORMAL: Rgba(0.0, 0.62, 0.45, 1.0),
}
"""Robot state; stop is redder than vermillion, for Meshcat's bright lights."""

STATE_WORD = {
    RobotState.STOP: "STOP",
    RobotState.REDUCED: "REDUCED",
    RobotState.NORMAL: "NORMAL",
}


def to_hex(rgba: Rgba) -> str:
    """Returns the colour as `#rrggbb`, without its opacity."""
    return "#" + "".join(
        f"{round(255 * c):02x}" for c in (rgba.r(), rgba.g(), rgba.b())
    )
