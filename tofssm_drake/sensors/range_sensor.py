"""What everyone else knows of the sensors of a ring: the sensor model.

A model is one file of this room: a dataclass of settings that is a
`RangeSensor`. See docs/own_sensor.md.
"""

import dataclasses as dc
from typing import Protocol

import numpy as np

from tofssm_drake.errors import check_range, require
from tofssm_drake.sensors.range_status import convert_status

FARTHEST = 65.0
"""No sensor may see farther, m: a device's frame has 16 bits of millimetres."""


@dc.dataclass(frozen=True, kw_only=True)
class SensorTraits:
    """What a sensor model says of itself.

    The simulated rings take from it how to cast and when to sample; the monitor
    takes what a reading may mean. Both get it from the same model.
    """

    period: float
    """From one sample to the next, s."""

    latency: float
    """From the middle of a sample's integration to the delivered scan, s."""

    integration_time: float = 0.0
    """How long a sample takes, s."""

    fov_deg: float
    """Full opening angle of the cone, deg."""

    rays_per_sensor: int
    """Rays that represent the cone. With fewer than 2 a ring cannot be verified
    by what it sees of the robot."""

    cast_range: float
    """How far the rays have to be cast, m: nothing is seen beyond."""

    min_range: float = 0.0
    """A valid distance below this only says that something is there, m; it
    counts as 0 m."""

    max_range: float
    """A valid distance above this is implausible, a fault, m."""

    sure_range: float
    """Up to here the sensor sees whatever fills its cone, but for lost samples,
    m. Where it must see the robot up to here and does not, it is faulted."""

    tolerance: float
    """Greatest error of a valid distance, m: readings this near to the expected
    ones are the robot's own."""

    resolution: float = 0.0
    """Step of the reported distance, m; 0: none."""

    least_noise: float = 0.00075
    """Standard deviation of a valid distance at the least, m; 0: none. How
    often a sensor may repeat a distance follows from it and the resolution; the
    default is that of a VL53L1X, 0.15 % of half a metre."""

    noise_draws: int = 0
    """Standard normal numbers that a sensor takes for each sample."""

    constant_draws: int = 0
    """Standard normal numbers that tell a sensor from the others of its kind,
    drawn once."""

    def check(self, where: str) -> None:
        """Raises UserError unless all of it is possible."""
        for name, low, high in (
            ("period", 0.001, 10.0),
            ("latency", 0.0, 10.0),
            ("integration_time", 0.0, 10.0),
            ("fov_deg", 0.1, 180.0),
            ("rays_per_sensor", 1, 10000),
            ("cast_range", 0.01, FARTHEST),
            ("min_range", 0.0, FARTHEST),
            ("max_range", 0.01, FARTHEST),
            ("sure_range", 0.0, FARTHEST),
            ("tolerance", 0.0, FARTHEST),
            ("resolution", 0.0, FARTHEST),
            ("least_noise", 0.0, FARTHEST),
            ("noise_draws", 0, 1000),
            ("constant_draws", 0, 1000),
        ):
            check_range(where, name, getattr(self, name), low, high)
        for name in ("rays_per_sensor", "noise_draws", "constant_draws"):
            value = getattr(self, name)
            require(
                isinstance(value, int),
                f"{where}.{name}: {value} must be a whole number",
            )
        # Up to rounding.
        require(
            self.latency >= 0.5 * self.integration_time - 1e-9,
            f"{where}.latency: {self.latency} must be at least half of "
            f"integration_time, {self.integration_time}",
        )
        require(
            self.tolerance >= 0.5 * self.resolution,
            f"{where}.tolerance: {self.tolerance} must be at least half of "
            f"resolution, {self.resolution}",
        )

    @property
    def delivery_time(self) -> float:
        """From the end of a sample's integration to the delivered scan, s."""
        return round(self.latency - 0.5 * self.integration_time, 12)


class RangeSensor(Protocol):
    """A model of the sensors of a ring."""

    @property
    def traits(self) -> SensorTraits:
        """The numbers that others need."""

    def measure(
        self,
        ray_distance: np.ndarray,
        noise: np.ndarray,
        constants: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Measures once with each of n sensors: a pure function.

        Args:
            ray_distance: Along each ray of each sensor's cone, m, (n, k); inf
                where it hits nothing within `cast_range`.
            noise: New standard normal numbers, (n, noise_draws).
            constants: Those of each sensor, always the same,
                (n, constant_draws); 0 is a sensor like the book's.

        Returns:
            Distance, m, (n,), and range status, (n,), see `range_status`.
        """


def measure_checked(
    sensor: RangeSensor,
    ray_distance: np.ndarray,
    noise: np.ndarray,
    constants: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Measures, and returns arrays of their own, float and uint8, (n,).

    Raises:
        ValueError: The model does not return two such arrays.
    """
    distance, status = sensor.measure(ray_distance, noise, constants)
    distance = np.array(distance, dtype=float)
    status = convert_status(status)
    n = len(ray_distance)
    if not distance.shape == status.shape == (n,):
        raise ValueError(
            f"measure: must return distance and status of {n} sensors, not "
            f"arrays of shape {distance.shape} and {status.shape}"
        )
    return distance, status


def draw_constants(
    traits: SensorTraits, *, sensors: int, seed: int, ring: int = 0
) -> np.ndarray:
    """Draws what tells the sensors of one ring apart, (n, constant_draws).

    Args:
        traits: Of their model.
        sensors: n.
        seed: The same seed gives the same sensors.
        ring: Distinguishes the rings of one seed.
    """
    generator = np.random.default_rng([seed, ring])
    return generator.standard_normal((traits.constant_draws, sensors)).T
