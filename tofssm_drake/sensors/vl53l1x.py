"""Measurement model of a VL53L1X: from ray distances to its reports.

The figures are those of ST's datasheet and user manual UM2356 where they
give any, and engineering assumptions (marked *assumed*) where they do not.
Pure functions only: the random draws are an argument.
"""

import dataclasses as dc
import math

import numpy as np

from tofssm_drake.errors import check_range, require
from tofssm_drake.kernels import njit
from tofssm_drake.sensors.range_sensor import SensorTraits
from tofssm_drake.sensors.range_status import (
    SATURATED,
    STATUS_MIN_RANGE_CLIPPED,
    STATUS_OUT_OF_BOUNDS,
    STATUS_SIGMA_FAIL,
    STATUS_SIGNAL_FAIL,
    STATUS_VALID,
    STATUS_WRAP_AROUND,
)

NOISE_DRAWS = 4
"""Standard normal draws per sensor and sample: range error, validity, kind of
failure, arbitrary millimetres. All but the first are turned into uniform
numbers by the normal distribution function."""

CONSTANT_DRAWS = 2
"""Standard normal draws per sensor: offset, scale factor."""

# A valid distance may exceed the mode's range by offset, scale and noise at
# that distance, m.
_EXCESS = 0.09

# A target is seen with a probability of 0.998 where the argument of the
# logistic function is this.
_SURE = -6.2

# One standard deviation at a timing budget of 33 ms (54 % grey, dark), read
# off figure 6 of the datasheet.
_SIGMA_DISTANCE = np.array(
    [0.09, 0.14, 0.19, 0.24, 0.4, 1.0, 1.2, 1.4, 1.6, 1.8, 2.8, 3.0, 3.1]
)
_SIGMA_33MS = 1e-3 * np.array(
    [3.7, 2.9, 2.7, 2.0, 1.8, 1.8, 2.1, 2.1, 2.5, 2.8, 2.8, 3.4, 5.0]
)


@dc.dataclass(kw_only=True)
class Vl53l1x:
    """How a VL53L1X measures; every effect can be switched off."""

    # Report the exact nearest distance up to `usable_range`, nothing else:
    # no noise, no bias, no failures, no millimetres.
    ideal: bool = False

    # How the hits within the cone are combined: "nearest" reports the nearest
    # one, "mean" their mean weighted by 1/d^2, as the photons are.
    return_model: str = "nearest"

    # Distance at which a target is seen with probability 1/2, m. 1.31 is the
    # paper's best range; short mode reaches 1.30 (typical), at most 1.5 here.
    usable_range: float = 1.31

    # Width of the logistic fall of that probability, as a part of
    # `usable_range` (*assumed*). 0: seen up to `usable_range`, never beyond.
    range_falloff: float = 0.05

    # No valid reading beyond this distance or `usable_range`, whichever is
    # larger, m (short mode).
    mode_range: float = 1.36

    # Integration time of a measurement, s; 0.020 is the full driver's shortest,
    # in short mode only.
    timing_budget: float = 0.020

    # Factor on the datasheet's standard deviation; 0: no noise.
    noise_gain: float = 1.0

    # Least standard deviation as a part of the distance; ambient light raises
    # it to 0.01.
    noise_floor: float = 0.0015

    # Part of the hits' spread that adds to the standard deviation with the
    # return model "mean" (*assumed*).
    spread_gain: float = 0.05

    # A standard deviation above this fails with status 1, m; 0: never.
    sigma_limit: float = 0.015

    # Constant offset of each sensor: standard deviation and bound, m; 0: none
    # (*assumed* after the datasheet's +-20 mm accuracy).
    bias_sigma: float = 0.007
    bias_limit: float = 0.015

    # Standard deviation of each sensor's scale factor; 0: none (*assumed*).
    gain_sigma: float = 0.002

    # Below this distance the target is detected but the value is wrong, m.
    min_range: float = 0.040

    # Largest error then, m, and how often status 3 reports it (*assumed*).
    # 0 m: as good as elsewhere, always valid.
    min_range_error: float = 0.030
    min_range_clipped: float = 0.5

    # Probability that a sample fails for no reason in the scene (*assumed*;
    # 0.002 to 0.01 is plausible). 0: never.
    dropout: float = 0.005

    # Probability that a target beyond the range is reported as valid with
    # `wrap_range` taken off (*assumed*; the device has its own check, status
    # 7, and 0.001 is a pessimistic guess of what slips through). 0: never.
    wrap_probability: float = 0.0
    wrap_range: float = 1.36

    # Step of the reported distance, m; 0: none.
    resolution: float = 0.001

    # Greatest error of a valid distance, m: 3 standard deviations of 10 mm,
    # which covers the datasheet's +-25 mm, plus 5 mm for a sensor whose
    # constant error is at its bound.
    tolerance: float = 0.030

    # Full opening angle of the cone, deg (paper).
    fov_deg: float = 25.0

    # Rays that represent the cone; 25 are 1 + 8 + 16, the last ring on the
    # cone's edge.
    rays_per_sensor: int = 25

    # Time between two integrations, s; the period is the timing budget plus
    # this.
    period_overhead: float = 0.004

    # From the end of the integration to the delivered scan, s (*assumed*):
    # reading out 8 sensors over a 400 kHz bus takes 0.8 ms each, of which a
    # sample waits half on average, and the frame takes about 1 ms more.
    readout_time: float = 0.005

    @property
    def period(self) -> float:
        """From one sample to the next, s."""
        return self.timing_budget + self.period_overhead

    @property
    def latency(self) -> float:
        """From the centre of the integration to the delivered scan, s."""
        return 0.5 * self.timing_budget + self.readout_time

    @property
    def traits(self) -> SensorTraits:
        """See `RangeSensor`."""
        farthest = max(self.usable_range, self.mode_range)
        return SensorTraits(
            period=self.period,
            latency=self.latency,
            integration_time=self.timing_budget,
            fov_deg=self.fov_deg,
            rays_per_sensor=self.rays_per_sensor,
            cast_range=self._calc_cast_range(),
            min_range=self.min_range,
            max_range=farthest + _EXCESS,
            sure_range=self._calc_sure_range(),
            tolerance=self.tolerance,
            resolution=self.resolution,
            least_noise=0.0 if self.ideal else self._calc_least_noise(),
            noise_draws=0 if self.ideal else NOISE_DRAWS,
            constant_draws=CONSTANT_DRAWS,
        )

    def measure(
        self,
        ray_distance: np.ndarray,
        noise: np.ndarray,
        constants: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `RangeSensor` and, for the physics, the function `measure`."""
        return measure(
            self,
            ray_distance=ray_distance,
            noise=noise,
            errors=make_sensor_errors(self, constants),
        )

    def _calc_least_noise(self) -> float:
        # Nearer than half a metre the datasheet's own noise is more.
        return self.noise_gain * self.noise_floor * 0.5

    def _calc_cast_range(self) -> float:
        if self.ideal:
            return self.usable_range
        if self.wrap_probability > 0.0:
            # The device itself sees no farther, in any mode.
            return 4.0
        return max(self.usable_range, self.mode_range)

    def _calc_sure_range(self) -> float:
        if self.ideal:
            return self.usable_range
        return self.usable_range * max(0.0, 1.0 + _SURE * self.range_falloff)

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(
            self.return_model in ("nearest", "mean"),
            f"{where}.return_model: {self.return_model!r} is not known; "
            "use 'nearest' or 'mean'",
        )
        for name, low, high in (
            ("usable_range", 0.05, 4.0),
            ("range_falloff", 0.0, 1.0),
            ("mode_range", 0.05, 4.0),
            ("timing_budget", 0.015, 1.0),
            ("noise_gain", 0.0, 100.0),
            ("noise_floor", 0.0, 0.1),
            ("spread_gain", 0.0, 1.0),
            ("sigma_limit", 0.0, 1.0),
            ("bias_sigma", 0.0, 0.1),
            ("bias_limit", 0.0, 0.1),
            ("gain_sigma", 0.0, 0.1),
            ("min_range", 0.0, 0.2),
            ("min_range_error", 0.0, 0.2),
            ("min_range_clipped", 0.0, 1.0),
            ("dropout", 0.0, 1.0),
            ("wrap_probability", 0.0, 1.0),
            ("wrap_range", 0.1, 10.0),
            ("resolution", 0.0, 0.1),
            ("tolerance", 0.0, 0.3),
            ("fov_deg", 1.0, 90.0),
            ("rays_per_sensor", 1, 10000),
            ("period_overhead", 0.0, 10.0),
            ("readout_time", 0.0, 1.0),
        ):
            check_range(where, name, getattr(self, name), low, high)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class SensorErrors:
    """The constant errors of n sensors of a ring."""

    bias: np.ndarray
    """Offset, m, (n,)."""
    gain: np.ndarray
    """Scale factor, (n,)."""


def make_sensor_errors(config: Vl53l1x, constants: np.ndarray) -> SensorErrors:
    """Returns the constant errors of n sensors.

    Args:
        config: how large they are.
        constants: standard normal draws, (n, CONSTANT_DRAWS).
    """
    limit = config.bias_limit
    return SensorErrors(
        bias=np.clip(config.bias_sigma * constants[:, 0], -limit, limit),
        gain=1.0 + config.gain_sigma * constants[:, 1],
    )


# Settings in the order of the vector, and their indices in it.
_PACKED = (
    "ideal",
    "usable_range",
    "range_falloff",
    "mode_range",
    "timing_budget",
    "noise_gain",
    "noise_floor",
    "spread_gain",
    "sigma_limit",
    "min_range",
    "min_range_error",
    "min_range_clipped",
    "dropout",
    "wrap_probability",
    "wrap_range",
    "resolution",
)
_IDEAL, _USABLE_RANGE, _RANGE_FALLOFF, _MODE_RANGE, _TIMING_BUDGET = range(5)
_NOISE_GAIN, _NOISE_FLOOR, _SPREAD_GAIN, _SIGMA_LIMIT = range(5, 9)
_MIN_RANGE, _MIN_RANGE_ERROR, _MIN_RANGE_CLIPPED, _DROPOUT = range(9, 13)
_WRAP_PROBABILITY, _WRAP_RANGE, _RESOLUTION, _IS_MEAN = range(13, 17)


def pack_config(config: Vl53l1x) -> np.ndarray:
    """Returns the settings as the vector that `measure_packed` takes."""
    values = [float(getattr(config, name)) for name in _PACKED]
    return np.array([*values, float(config.return_model == "mean")])


def measure(
    config: Vl53l1x,
    *,
    ray_distance: np.ndarray,
    noise: np.ndarray,
    errors: SensorErrors,
) -> tuple[np.ndarray, np.ndarray]:
    """Measures once with each of n sensors.

    A target at distance d is seen with probability
    1 / (1 + exp((d - usable_range) / (range_falloff usable_range))), and
    never beyond the mode's range. A target that is not seen gives status 2, 4
    or 7 with arbitrary millimetres. A dropout is independent of the target and
    can also be a status 1. The standard deviation is the datasheet's at 33 ms
    times sqrt(33 ms / timing budget).

    Args:
        config: how well the sensors measure.
        ray_distance: (n, k) distance along each ray of each sensor's cone,
            m; inf where it hits nothing.
        noise: (n, NOISE_DRAWS) standard normal draws; not read when ideal.
        errors: the sensors' constant errors; not read when ideal.

    Returns:
        Distance, m, (n,), and range status (ST API numbers), uint8, (n,).
        The distance is arbitrary unless the status is 0 or 3.
    """
    distance = np.empty(len(ray_distance))
    status = np.empty(len(ray_distance), dtype=np.uint8)
    measure_packed(
        pack_config(config),
        np.ascontiguousarray(ray_distance, dtype=float),
        np.ascontiguousarray(noise, dtype=float),
        errors.bias,
        errors.gain,
        distance,
        status,
    )
    return distance, status


@njit(cache=True)
def _calc_uniform(z):
    """Turns a standard normal draw into a uniform one in [0, 1]."""
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


@njit(cache=True)
def _interpolate_sigma(d):
    """Returns the standard deviation at a timing budget of 33 ms, m."""
    last = len(_SIGMA_DISTANCE) - 1
    if d <= _SIGMA_DISTANCE[0]:
        return _SIGMA_33MS[0]
    if d >= _SIGMA_DISTANCE[last]:
        return _SIGMA_33MS[last]
    i = 0
    while d > _SIGMA_DISTANCE[i + 1]:
        i += 1
    s = (d - _SIGMA_DISTANCE[i]) / (_SIGMA_DISTANCE[i + 1] - _SIGMA_DISTANCE[i])
    return (1.0 - s) * _SIGMA_33MS[i] + s * _SIGMA_33MS[i + 1]


@njit(cache=True)
def _calc_target(rays, is_mean):
    """Returns the distance seen by the cone and the spread of its hits, m."""
    nearest = np.inf
    for d in rays:
        nearest = min(nearest, d)
    if not is_mean or nearest == np.inf or nearest <= 0.0:
        return nearest, 0.0
    sum_w = 0.0
    sum_wd = 0.0
    for d in rays:
        if d < np.inf:
            w = (nearest / d) ** 2
            sum_w += w
            sum_wd += w * d
    mean = sum_wd / sum_w
    sum_wdd = 0.0
    for d in rays:
        if d < np.inf:
            sum_wdd += (nearest / d) ** 2 * (d - mean) ** 2
    return mean, math.sqrt(sum_wdd / sum_w)


@njit(cache=True)
def _pick_no_return(u):
    """Returns a status of a target that is too weak or too far to be seen."""
    if u < 0.70:
        return STATUS_SIGNAL_FAIL
    if u < 0.80:
        return STATUS_OUT_OF_BOUNDS
    return STATUS_WRAP_AROUND


@njit(cache=True)
def _pick_dropout(u):
    """Returns a status of a sample that failed for no reason in the scene."""
    if u < 0.70:
        return STATUS_SIGNAL_FAIL
    if u < 0.85:
        return STATUS_SIGMA_FAIL
    if u < 0.95:
        return STATUS_OUT_OF_BOUNDS
    return STATUS_WRAP_AROUND


@njit(cache=True)
def _calc_detection_probability(p, d):
    if d > max(p[_USABLE_RANGE], p[_MODE_RANGE]):
        return 0.0
    if p[_RANGE_FALLOFF] == 0.0:
        return 1.0 if d <= p[_USABLE_RANGE] else 0.0
    x = (d - p[_USABLE_RANGE]) / (p[_RANGE_FALLOFF] * p[_USABLE_RANGE])
    return 1.0 / (1.0 + math.exp(x))


@njit(cache=True)
def _calc_sigma(p, d, spread):
    """Returns the standard deviation of a distance, m."""
    if not d < np.inf:
        return 0.0
    sigma = math.sqrt(0.033 / p[_TIMING_BUDGET]) * _interpolate_sigma(d)
    sigma = math.hypot(
        max(sigma, p[_NOISE_FLOOR] * d), p[_SPREAD_GAIN] * spread
    )
    return sigma * p[_NOISE_GAIN]


@njit(cache=True)
def _measure_ideally(p, rays):
    """Returns the nearest distance within range, m, and the status."""
    d, _ = _calc_target(rays, False)
    if d <= p[_USABLE_RANGE]:
        return d, STATUS_VALID
    return 0.0, STATUS_SIGNAL_FAIL


@njit(cache=True)
def _measure_target(p, d, sigma, draws, bias, gain):
    """Returns the distance measured with one sensor, m, and the status.

    The distance means nothing unless the status is 0 or 3. `draws` are
    NOISE_DRAWS numbers, all but the first uniform.
    """
    z, u_validity, u_kind, u_arbitrary = draws
    # One uniform number decides: first on a dropout, then on detection.
    missed = 1.0 - _calc_detection_probability(p, d)
    if u_validity < p[_DROPOUT]:
        return 0.0, _pick_dropout(u_kind)
    if u_validity < p[_DROPOUT] + (1.0 - p[_DROPOUT]) * missed:
        wraps = u_kind < p[_WRAP_PROBABILITY]
        limit = max(p[_USABLE_RANGE], p[_MODE_RANGE])
        if wraps and d < np.inf and d > limit:
            return d % p[_WRAP_RANGE], STATUS_VALID
        return 0.0, _pick_no_return(u_kind)
    if d < p[_MIN_RANGE] and p[_MIN_RANGE_ERROR] > 0.0:
        error = p[_MIN_RANGE_ERROR] * (2.0 * u_arbitrary - 1.0)
        if u_kind < p[_MIN_RANGE_CLIPPED]:
            return d + error, STATUS_MIN_RANGE_CLIPPED
        return d + error, STATUS_VALID
    if p[_SIGMA_LIMIT] > 0.0 and sigma > p[_SIGMA_LIMIT]:
        return 0.0, STATUS_SIGMA_FAIL
    return gain * d + bias + sigma * z, STATUS_VALID


@njit(cache=True)
def measure_packed(p, ray_distance, noise, bias, gain, distance, status):
    """Does what `measure` does, with settings `p` from `pack_config`.

    It writes `distance` and `status`; returning them would cost more.
    """
    for i in range(ray_distance.shape[0]):
        if p[_IDEAL] != 0.0:
            distance[i], status[i] = _measure_ideally(p, ray_distance[i])
            continue
        d, spread = _calc_target(ray_distance[i], p[_IS_MEAN] != 0.0)
        u_arbitrary = _calc_uniform(noise[i, 3])
        draws = (
            noise[i, 0],
            _calc_uniform(noise[i, 1]),
            _calc_uniform(noise[i, 2]),
            u_arbitrary,
        )
        measured, status[i] = _measure_target(
            p, d, _calc_sigma(p, d, spread), draws, bias[i], gain[i]
        )
        if status[i] not in (STATUS_VALID, STATUS_MIN_RANGE_CLIPPED):
            # As on the device: an arbitrary number.
            measured = 4.0 * u_arbitrary
        if p[_RESOLUTION] > 0.0:
            measured = p[_RESOLUTION] * np.round(measured / p[_RESOLUTION])
        distance[i] = min(max(measured, 0.0), SATURATED)
