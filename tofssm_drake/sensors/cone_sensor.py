"""A range sensor with a single cone, described by a few numbers.

The defaults are those of a small lidar, Benewake's TFmini-S: 0.1 to 12 m on a
target that reflects 90 % (7 m on 10 %), +-6 cm up to 6 m and +-1 % beyond,
steps of 1 cm, 100 Hz, a field of view of 2 deg. Sources: Benewake, datasheet
SJ-GU-TFmini-S-01 A00, table 1
(https://github.com/parallaxinc/BlocklyProp/files/4104382/TFmini-S-01.A00.Datasheet.pdf);
for the dark target that of the TFmini-i, which is based on it, BP-DS-16 A02.
What is not in there is marked *assumed*.
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.errors import check_range, require
from tofssm_drake.sensors.range_sensor import FARTHEST, SensorTraits
from tofssm_drake.sensors.range_status import (
    STATUS_MIN_RANGE_FAIL,
    STATUS_SIGNAL_FAIL,
    STATUS_VALID,
)

_NOISE_DRAWS = 2


@dc.dataclass(kw_only=True)
class ConeSensor:
    """Reports the nearest hit in its cone, with normal noise."""

    # Nothing is seen beyond this distance, m. 12 on white, 7 on dark things.
    max_range: float = 12.0

    # Below this distance a target is detected but not measured, m (*assumed*:
    # the datasheet says nothing of a target in the blind zone).
    min_range: float = 0.1

    # Full opening angle of the cone, deg.
    fov_deg: float = 2.0

    # Rays that represent the cone; 9 are 1 + 8, the ring on the cone's edge.
    rays_per_sensor: int = 9

    # Standard deviation of a distance d, m: sigma + sigma_per_metre d. The
    # datasheet's accuracies are taken as 3 sigma; this line has them at 0 and
    # 12 m, and more in between.
    sigma: float = 0.020
    sigma_per_metre: float = 0.00167

    # Step of the reported distance, m; 0: none.
    resolution: float = 0.01

    # Samples per second, Hz.
    rate: float = 100.0

    # How long a sample takes, s (*assumed*: the whole period).
    integration_time: float = 0.010

    # From the middle of a sample to the delivered scan, s (*assumed*: the rest
    # of the integration, and as much to read out and send).
    latency: float = 0.010

    # Probability that a sample is lost and looks like one without a target
    # (*assumed*).
    dropout: float = 0.002

    @property
    def traits(self) -> SensorTraits:
        """See `RangeSensor`."""
        error = 3.0 * self._calc_sigma(self.max_range) + 0.5 * self.resolution
        return SensorTraits(
            period=1.0 / self.rate,
            latency=self.latency,
            integration_time=self.integration_time,
            fov_deg=self.fov_deg,
            rays_per_sensor=self.rays_per_sensor,
            cast_range=self.max_range,
            min_range=self.min_range,
            # Twice the tolerance: at the end of the range noise is no fault.
            max_range=min(self.max_range + 2.0 * error, FARTHEST),
            sure_range=self.max_range,
            tolerance=error,
            resolution=self.resolution,
            least_noise=self._calc_sigma(0.0),
            noise_draws=_NOISE_DRAWS,
        )

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        for name, low, high in (
            ("max_range", 0.05, 50.0),
            ("min_range", 0.0, 5.0),
            ("fov_deg", 0.1, 90.0),
            ("rays_per_sensor", 1, 10000),
            ("sigma", 0.0, 1.0),
            ("sigma_per_metre", 0.0, 0.1),
            ("resolution", 0.0, 1.0),
            ("rate", 0.1, 1000.0),
            ("integration_time", 0.0, 1.0),
            ("latency", 0.0, 1.0),
            ("dropout", 0.0, 1.0),
        ):
            check_range(where, name, getattr(self, name), low, high)
        require(
            self.min_range < self.max_range,
            f"{where}.min_range: {self.min_range} must be below max_range, "
            f"{self.max_range}",
        )
        self.traits.check(where)

    def measure(
        self,
        ray_distance: np.ndarray,
        noise: np.ndarray,
        constants: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `RangeSensor`: what is nearest in the cone, or no return."""
        # Only for this sensor: SciPy takes long to import.
        from scipy.special import ndtri

        nearest = ray_distance.min(axis=1)
        is_lost = noise[:, 1] < ndtri(self.dropout)
        is_seen = (nearest <= self.max_range) & ~is_lost
        true = np.where(is_seen, nearest, 0.0)
        distance = true + self._calc_sigma(true) * noise[:, 0]
        if self.resolution > 0.0:
            distance = self.resolution * np.round(distance / self.resolution)
        status = np.select(
            [~is_seen, nearest < self.min_range],
            [STATUS_SIGNAL_FAIL, STATUS_MIN_RANGE_FAIL],
            STATUS_VALID,
        )
        is_measured = status == STATUS_VALID
        return np.where(is_measured, np.maximum(distance, 0.0), 0.0), status

    def _calc_sigma(self, distance):
        return self.sigma + self.sigma_per_metre * distance
