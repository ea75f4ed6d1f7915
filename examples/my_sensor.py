"""A sensor model of one's own: an ultrasonic ranger in a ring.

tofssm simulate --scenario-file examples/my_sensor.yaml --out out/my_sensor
"""

import numpy as np

from tofssm_drake.sensors.range_sensor import SensorTraits
import tofssm_drake.sensors.range_status as status

RESOLUTION = 0.005


class Ultrasonic:
    """What the scenario's factory returns, see `RangeSensor`."""

    def __init__(self, reach=2.0, noise=0.003):
        self.noise = noise
        # What others must know: when it samples, and what a reading may mean.
        self.traits = SensorTraits(
            period=0.030,
            latency=0.015,  # From the ping to the delivered scan.
            fov_deg=30.0,
            rays_per_sensor=25,
            cast_range=reach,
            min_range=0.05,
            max_range=1.1 * reach,
            sure_range=0.7 * reach,  # A flat thing that fills the cone.
            tolerance=0.04,  # 1 % of 2 m, 3 times the noise, half a step.
            resolution=RESOLUTION,
            least_noise=noise,
            noise_draws=1,
            constant_draws=1,
        )

    def measure(self, ray_distance, noise, constants):
        """Returns distance, m, and status: this function is the model."""
        nearest = ray_distance.min(axis=1)  # inf where nothing is hit.
        is_seen = np.isfinite(nearest)
        # Each sensor believes in another speed of sound, by 0.3 %.
        scale = 1.0 + 0.003 * np.clip(constants[:, 0], -3.0, 3.0)
        distance = np.zeros(len(nearest))
        distance[is_seen] = (scale * nearest)[is_seen]
        distance += self.noise * noise[:, 0]
        distance = RESOLUTION * np.round(np.maximum(distance, 0.0) / RESOLUTION)
        return distance, np.where(
            is_seen, status.STATUS_VALID, status.STATUS_SIGNAL_FAIL
        )
