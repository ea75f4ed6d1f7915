"""The closed path through the robot's workspace: a figure of eight."""

import dataclasses as dc
import math

import numpy as np

from tofssm_drake.errors import require

_SAMPLES = 4096
_SMALLEST_RADIUS = 0.25
"""m; a person cannot follow a tighter curve at a walk."""

FARTHEST = 100.0
"""m from world's origin along x and y; no cell is larger."""


@dc.dataclass(kw_only=True)
class FigureEight:
    """Where the figure of eight lies on the floor.

    The defaults lead the person across the robot's sweep and back, between
    the pick table, the place table and the far side of the workspace.
    """

    # Where the two lobes cross, [x, y] in world, m. *Assumed.*
    centre: list[float] = dc.field(default_factory=lambda: [1.15, 0.0])

    # From the crossing to the far end of a lobe, m. *Assumed.*
    half_length: float = 1.5

    # Half the width of a lobe, across the long axis, m. *Assumed.*
    half_width: float = 0.45

    # Direction of the long axis, degrees from world x. *Assumed.*
    orientation_deg: float = 90.0

    # Where the person is at t = 0, as a fraction of the way round: 0 at the
    # crossing, 0.25 at the far end of the first lobe. *Assumed.*
    start: float = 0.25

    # True walks the figure the other way round.
    reverse: bool = False

    def check(self, where: str):
        """Raises UserError where a value makes no path for a person.

        Args:
            where: What the user calls this, for the message.
        """
        require(
            is_position(self.centre),
            f"{where}.centre: {self.centre} should be two numbers [x, y] from "
            f"{-FARTHEST:g} to {FARTHEST:g} m",
        )
        for name in ("half_length", "half_width"):
            value = getattr(self, name)
            require(
                0.2 <= value <= 20.0,
                f"{where}.{name}: {value} should be from 0.2 to 20 m",
            )
        require(
            -360.0 <= self.orientation_deg <= 360.0,
            f"{where}.orientation_deg: {self.orientation_deg} should be from "
            "-360 to 360 deg",
        )
        require(
            0.0 <= self.start <= 1.0,
            f"{where}.start: {self.start} should be from 0 to 1",
        )
        radius = calc_smallest_radius(self)
        require(
            radius >= _SMALLEST_RADIUS,
            f"{where}.half_width: {self.half_width} with half_length "
            f"{self.half_length} bends too tightly to walk (radius "
            f"{radius:.2f} m, should be {_SMALLEST_RADIUS} m or more); a "
            "larger figure, about 0.3 times as wide as long, would be right",
        )


def is_position(xy: list[float]) -> bool:
    """Whether this is a place on the floor for a person, [x, y] in W, m."""
    return np.shape(xy) == (2,) and bool(
        np.all(np.abs(np.asarray(xy, float)) <= FARTHEST)
    )


def calc_smallest_radius(config: FigureEight) -> float:
    """Returns the smallest radius of curvature, m."""
    tau = np.linspace(0.0, np.pi, _SAMPLES)
    a, b = config.half_length, config.half_width
    dx, dy = a * np.cos(tau), 2 * b * np.cos(2 * tau)
    ddx, ddy = -a * np.sin(tau), -4 * b * np.sin(2 * tau)
    curvature = np.abs(dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5
    return float(1.0 / np.max(curvature))


class FigureEightPath:
    """The lemniscate of Gerono by arc length.

    Along the long axis half_length sin(tau), across it half_width sin(2 tau).

    Attributes:
        length: Once round, m.
    """

    def __init__(self, *, config: FigureEight):
        """Measures the path.

        Args:
            config: Where it lies.
        """
        config.check("figure_eight")
        self._config = config
        tau = np.linspace(0.0, 2 * np.pi, _SAMPLES + 1)
        if config.reverse:
            tau = -tau
        points = self._calc_points(tau)
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        self._tau = tau
        self._arc = np.concatenate([[0.0], np.cumsum(step)])
        self.length = float(self._arc[-1])

    def _calc_points(self, tau):
        config = self._config
        angle = math.radians(config.orientation_deg)
        along = np.array([math.cos(angle), math.sin(angle)])
        across = np.array([-along[1], along[0]])
        return (
            np.asarray(config.centre, float)
            + config.half_length * np.sin(tau)[..., None] * along
            + config.half_width * np.sin(2 * tau)[..., None] * across
        )

    def calc_position(self, s: np.ndarray) -> np.ndarray:
        """Returns points on the path.

        Args:
            s: Arc length from the start, any sign, m, shape (n,).

        Returns:
            [x, y] in W, m, shape (n, 2).
        """
        arc = (
            np.asarray(s, float) + self._config.start * self.length
        ) % self.length
        return self._calc_points(np.interp(arc, self._arc, self._tau))

    def calc_direction(self, s: np.ndarray, half_span: float) -> np.ndarray:
        """Returns where a person who walks there faces.

        Args:
            s: Arc length from the start, m, shape (n,).
            half_span: The direction is that of the chord from s - half_span
                to s + half_span, m, > 0.

        Returns:
            Unit vectors [x, y] in W, shape (n, 2).
        """
        chord = self.calc_position(s + half_span) - self.calc_position(
            s - half_span
        )
        return chord / np.linalg.norm(chord, axis=-1, keepdims=True)
