"""Statistics of a few paired trials: intervals, differences, ellipses."""

import dataclasses as dc
import math

import numpy as np
from scipy.special import fdtri, stdtrit

CONFIDENCE = 0.95
# Values no farther apart than this are equal up to rounding.
_ROUNDING = 1e-9


@dc.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A mean with its confidence interval, mean +- half_width."""

    mean: float
    """NaN: no value."""
    half_width: float
    """Of the 95 % confidence interval; NaN: no interval, because there are
    fewer than two values or all are equal. A few equal values, as counts often
    are, do not make a mean certain."""
    count: int
    """Number of values."""

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.mean - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.mean + self.half_width

    def scale(self, factor: float) -> "Estimate":
        """Returns the estimate in another unit; factor: above 0."""
        return dc.replace(
            self, mean=self.mean * factor, half_width=self.half_width * factor
        )


def format_estimate(value: Estimate, *, digits: int = 3, sign=False) -> str:
    """Returns `mean +- half width`; an en dash without any value."""
    if not value.count:
        return "\u2013"
    # z: no sign on a value that rounds to zero.
    text = f"{value.mean:{'+' if sign else ''}z.{digits}f}"
    text = text.replace("-", "\u2212")
    if math.isfinite(value.half_width):
        text += f" \u00b1 {value.half_width:.{digits}f}"
    return text


def calc_estimate(values) -> Estimate:
    """Estimates a mean from independent values, leaving out NaN.

    Args:
        values: (n,) numbers.

    Returns:
        The mean with Student's 95 % confidence interval, if it has one.
    """
    values = np.asarray(list(values), dtype=float)
    values = values[np.isfinite(values)]
    n = len(values)
    if not n:
        return Estimate(mean=math.nan, half_width=math.nan, count=0)
    half_width = math.nan
    if n > 1 and np.ptp(values) > _ROUNDING * max(1.0, np.abs(values).max()):
        # scipy.stats would say it more plainly and takes a second to import.
        quantile = float(stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE))
        half_width = quantile * float(values.std(ddof=1)) / math.sqrt(n)
    return Estimate(mean=float(values.mean()), half_width=half_width, count=n)


def calc_paired_difference(
    first: dict[int, float], second: dict[int, float]
) -> Estimate:
    """Estimates the mean of first - second over the trials they share.

    Args:
        first: Value by trial; a trial missing from either is left out.
        second: Likewise.
    """
    both = [trial for trial in first if trial in second]
    return calc_estimate(first[trial] - second[trial] for trial in both)


@dc.dataclass(frozen=True, kw_only=True)
class Ellipse:
    """Where the mean of pairs (x, y) lies with 95 % confidence."""

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    """Longer one first."""
    angle: float
    """Of the longer half axis, from x towards y, rad."""


def calc_confidence_ellipse(x, y) -> Ellipse | None:
    """Returns Hotelling's confidence region of the mean of pairs.

    Args:
        x: (n,) numbers.
        y: (n,) numbers.

    Returns:
        The ellipse; None with fewer than three pairs.
    """
    points = np.stack([np.asarray(x, float), np.asarray(y, float)], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    n = len(points)
    if n < 3:
        return None
    quantile = fdtri(2, n - 2, CONFIDENCE)
    scale = 2.0 * (n - 1) / (n * (n - 2)) * quantile
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
    """Returns the highest rate per run consistent with no event in any run.

    The exact (Clopper-Pearson) upper bound, one-sided.

    Args:
        runs: Number of runs, at least 1.
        confidence: One-sided.
    """
    return 1.0 - (1.0 - confidence) ** (1.0 / runs)
