"""What a few paired trials allow to say: intervals, differences, ellipses."""

import dataclasses as dc
import functools
import math

import numpy as np

CONFIDENCE = 0.95
# Values that are no farther apart are equal but for rounding.
_ROUNDING = 1e-9


@dc.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A mean with its confidence interval, mean +- half_width."""

    mean: float
    """NaN: there was no value."""
    half_width: float
    """Of the 95 % confidence interval; NaN: there is none, because there are
    fewer than two values or all are equal. A few equal values, as counts often
    are, do not make a mean certain."""
    count: int
    """Values it is made from."""

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.mean - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.mean + self.half_width

    def scale(self, factor: float) -> "Estimate":
        """Returns the same in another unit; factor: above 0."""
        return dc.replace(
            self, mean=self.mean * factor, half_width=self.half_width * factor
        )


def format_estimate(value: Estimate, *, digits: int = 3, sign=False) -> str:
    """Returns `mean +- half width`; an en dash where there is none."""
    if not value.count:
        return "\u2013"
    # z: what rounds to nothing has no sign of its own.
    text = f"{value.mean:{'+' if sign else ''}z.{digits}f}"
    text = text.replace("-", "\u2212")
    if math.isfinite(value.half_width):
        text += f" \u00b1 {value.half_width:.{digits}f}"
    return text


@functools.cache
def calc_t_quantile(
    degrees_of_freedom: int, confidence: float = CONFIDENCE
) -> float:
    """Returns t with P(|T| < t) = confidence for Student's T.

    Args:
        degrees_of_freedom: nu, at least 1.
        confidence: Of the two-sided interval, in (0, 1).
    """
    nu = degrees_of_freedom
    # With t = sqrt(nu) tan(a), P(|T| < t) is the integral of cos^(nu - 1)
    # over (-a, a), normalised: smooth and on a finite interval for every nu.
    angle = np.linspace(0.0, math.pi / 2, 20001)
    weight = np.cos(angle) ** (nu - 1)
    step = angle[1]
    area = np.concatenate(
        [[0.0], np.cumsum(0.5 * step * (weight[1:] + weight[:-1]))]
    )
    found = np.interp(confidence * area[-1], area, angle)
    return math.sqrt(nu) * math.tan(found)


def calc_estimate(values) -> Estimate:
    """Estimates a mean from independent values; NaN are left out.

    Args:
        values: (n,) numbers.

    Returns:
        The mean with Student's 95 % confidence interval, if there is one.
    """
    values = np.asarray(list(values), dtype=float)
    values = values[np.isfinite(values)]
    n = len(values)
    if not n:
        return Estimate(mean=math.nan, half_width=math.nan, count=0)
    half_width = math.nan
    if n > 1 and np.ptp(values) > _ROUNDING * max(1.0, np.abs(values).max()):
        error = float(values.std(ddof=1)) / math.sqrt(n)
        half_width = calc_t_quantile(n - 1) * error
    return Estimate(mean=float(values.mean()), half_width=half_width, count=n)


def calc_paired_difference(
    first: dict[int, float], second: dict[int, float]
) -> Estimate:
    """Estimates the mean of first - second over the trials of both.

    Args:
        first: Value by trial; trials that only one has are left out.
        second: Likewise.
    """
    both = [trial for trial in first if trial in second]
    return calc_estimate(first[trial] - second[trial] for trial in both)


@dc.dataclass(frozen=True, kw_only=True)
class Ellipse:
    """Where the mean of pairs (x, y) lies with 95 % confidence."""

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    """The longer one first."""
    angle: float
    """Of the longer one, from x towards y, rad."""


def calc_confidence_ellipse(x, y) -> Ellipse | None:
    """Returns Hotelling's confidence region of the mean of pairs.

    Args:
        x: (n,) numbers.
        y: (n,) numbers.

    Returns:
        The ellipse; None with fewer than three pairs, for which there is
        none.
    """
    points = np.stack([np.asarray(x, float), np.asarray(y, float)], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    n = len(points)
    if n < 3:
        return None
    # The quantile of F with 2 and m degrees of freedom in closed form.
    m = n - 2
    f = 0.5 * m * ((1.0 - CONFIDENCE) ** (-2.0 / m) - 1.0)
    scale = 2.0 * (n - 1) / (n * m) * f
    values, vectors = np.linalg.eigh(np.cov(points.T))
    half_axes = np.sqrt(scale * np.maximum(values, 0.0))
    longest = vectors[:, 1]
    centre = points.mean(axis=0)
    return Ellipse(
        centre=(float(centre[0]), float(centre[1])),
        half_axes=(float(half_axes[1]), float(half_axes[0])),
        angle=float(np.arctan2(longest[1], longest[0])),
    )


def calc_rate_bound(runs: int, confidence: float = CONFIDENCE) -> float:
    """Returns the rate per run that no event in so many runs still allows.

    Args:
        runs: How many, at least 1.
        confidence: One-sided.
    """
    return 1.0 - (1.0 - confidence) ** (1.0 / runs)
