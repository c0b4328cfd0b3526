"""Exact two-sided bounds and p-values of averages over independent samples, and the verdict over several epochs."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, count

COVERED = (0.6826894921370859, 0.9544997361036416, 0.9973002039367398)
"""Fraction of a consistent filter's errors inside 1, 2, 3 σ."""


def tail(confidence_level: float) -> float:
    """Return the probability beyond each of two-sided bounds that hold with ``confidence_level``."""
    if not 0.0 < confidence_level < 1.0:
        raise InputError(f"confidence_level is {confidence_level}; it must lie between 0 and 1")
    return 0.5 * (1.0 - confidence_level)


def two_sided(lower: float, upper: float) -> float:
    """Return the two-sided p-value of a value with probabilities ``lower`` at or below and ``upper`` at or above it."""
    return float(min(1.0, 2.0 * min(lower, upper)))


def mean_bounds(
    degrees: int, samples: float, confidence_level: float = 0.99, *, certainty: float = math.inf
) -> tuple[float, float]:
    """Return two-sided bounds of the mean of independent χ² values, per degree of freedom.

    ``samples · degrees · mean`` is χ² with ``samples · degrees`` degrees of freedom; the expected mean is 1. If the number of samples is
    itself estimated, the normal score of that χ² is distributed as Student's t.

    Parameters
    ----------
    degrees : int
        Degrees of freedom of one value.
    samples : float
        Number of independent values; an effective number need not be an integer.
    confidence_level : float, default 0.99
        Probability that the mean lies between the bounds.
    certainty : float, default inf
        Degrees of freedom of the estimate of ``samples``; infinite if they are counted.

    Returns
    -------
    low, high : float
        Bounds of the mean, with half of the remaining probability beyond each.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.2.

    Examples
    --------
    >>> from strapdown import consistency
    >>> [round(x, 2) for x in consistency.mean_bounds(3, 50, 0.95)]  # 50 runs, 3 states
    [0.79, 1.24]
    """
    from scipy.special import ndtr, stdtrit
    from scipy.stats import chi2

    outside = tail(confidence_level)
    if math.isfinite(certainty):
        outside = float(ndtr(stdtrit(certainty, outside)))
    total = _total(degrees, samples)
    return float(chi2.ppf(outside, total) / total), float(chi2.isf(outside, total) / total)


def mean_p_value(mean: float, degrees: int, samples: float, *, certainty: float = math.inf) -> float:
    """Return the two-sided p-value of a mean of independent χ² values per degree of freedom (see :func:`mean_bounds`)."""
    from scipy.special import chdtr, chdtrc, ndtri, stdtr

    total = _total(degrees, samples)
    if not np.isfinite(mean):
        return 0.0
    tails = np.array([chdtr(total, total * mean), chdtrc(total, total * mean)])
    if math.isfinite(certainty):
        tails = stdtr(certainty, ndtri(tails))
    return two_sided(float(tails[0]), float(tails[1]))


def _total(degrees: int, samples: float) -> float:
    count("degrees", degrees)
    if not np.isfinite(samples) or samples < 1.0:
        raise InputError(f"samples is {samples!r}; it must be 1 or more")
    return float(samples) * degrees


def log_moments(degrees: int) -> tuple[float, float]:
    """Return mean and variance of ln χ²: ψ(n/2) + ln 2 and ψ′(n/2), n = ``degrees``."""
    from scipy.special import digamma, polygamma

    half = 0.5 * count("degrees", degrees)
    return float(digamma(half) + math.log(2.0)), float(polygamma(1, half))


@functools.lru_cache(maxsize=64)
def _log_mean_characteristic(degrees: int, samples: int) -> tuple[Array, np.ndarray]:
    """Return abscissae and the characteristic function of the standardised mean of ``samples`` values of ln χ²."""
    from scipy.special import loggamma

    mean, variance = log_moments(degrees)
    spread = math.sqrt(variance / samples)
    # |φ| falls as exp(−t²/2) for many samples and as exp(−0.7 t) for one: negligible at t = 60. The step in t aliases tails beyond 60 σ.
    t = (np.arange(1200) + 0.5) * 0.05
    u = t / (spread * samples)
    half = 0.5 * degrees
    exponent = samples * (loggamma(half + 1j * u) - loggamma(half) + 1j * u * (math.log(2.0) - mean))
    return np.asarray(t), np.asarray(np.exp(exponent))


def log_mean_distribution(value: float, degrees: int, samples: int) -> float:
    """Return the probability that the mean of ``samples`` independent values of ln χ² lies at or below ``value``.

    ``E exp(i u ln χ²) = 2^{iu} Γ(n/2 + iu)/Γ(n/2)``, inverted after Gil-Pelaez (1951) by the midpoint rule; accurate to 1e-12.
    """
    mean, variance = log_moments(degrees)
    z = (value - mean) / math.sqrt(variance / samples)
    t, phi = _log_mean_characteristic(degrees, count("samples", samples))
    if abs(z) > 30.0:
        return 0.0 if z < 0.0 else 1.0
    return float(np.clip(0.5 - 0.05 / math.pi * np.sum(np.imag(np.exp(-1j * t * z) * phi) / t), 0.0, 1.0))


def log_mean_bounds(degrees: int, samples: int, confidence_level: float = 0.99) -> tuple[float, float]:
    """Return exact two-sided bounds of the mean of ``samples`` independent values of ln χ² with ``degrees`` degrees of freedom."""
    from scipy.optimize import brentq

    outside = tail(confidence_level)
    mean, variance = log_moments(degrees)
    reach = 25.0 * math.sqrt(variance / count("samples", samples))
    low, high = (
        brentq(lambda x, p=p: log_mean_distribution(x, degrees, samples) - p, mean - reach, mean + reach, xtol=1e-12)
        for p in (outside, 1.0 - outside)
    )
    return float(low), float(high)


def log_mean_p_value(mean: float, degrees: int, samples: int) -> float:
    """Return the two-sided p-value of a mean of independent values of ln χ²."""
    if not np.isfinite(mean):
        return 0.0
    below = log_mean_distribution(mean, degrees, samples)
    return two_sided(below, 1.0 - below)


def coverage_p_values(inside: ArrayLike, samples: int) -> Array:
    """Return two-sided binomial p-values of the fractions (..., 3) of ``samples`` independent errors inside 1, 2 and 3 σ."""
    from scipy.stats import binom

    number = np.round(np.asarray(inside) * samples)
    lower, upper = binom.cdf(number, samples, COVERED), binom.sf(number - 1.0, samples, COVERED)
    return np.asarray(np.minimum(1.0, 2.0 * np.minimum(lower, upper)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """Mean over independent runs of a χ² statistic per degree of freedom at several epochs, with its two-sided bounds."""

    mean: Array
    """Mean over the runs at each epoch, per degree of freedom (epochs,); 1 for a consistent filter."""
    degrees: int
    runs: int
    confidence_level: float
    """Probability that the mean at one epoch lies inside the bounds for a consistent filter."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Two-sided bounds of the mean at one epoch."""
        return mean_bounds(self.degrees, self.runs, self.confidence_level)

    @property
    def simultaneous_bounds(self) -> tuple[float, float]:
        """Two-sided bounds for the means at all epochs together, with at least ``confidence_level`` (Bonferroni).

        Errors at different epochs of one run are correlated, bias errors most of all, so the number of epochs outside :attr:`bounds` is
        not binomial. The Bonferroni bounds hold under any dependence.
        """
        return mean_bounds(self.degrees, self.runs, 1.0 - (1.0 - self.confidence_level) / len(self.mean))

    @property
    def outside(self) -> int:
        """Number of epochs outside the simultaneous bounds."""
        low, high = self.simultaneous_bounds
        return int(np.sum(~((self.mean >= low) & (self.mean <= high))))  # NaN is outside

    @property
    def consistent(self) -> bool:
        """Whether every epoch lies inside the simultaneous bounds."""
        return self.outside == 0

    @property
    def p_value(self) -> float:
        """Two-sided p-value of the worst epoch, times the number of epochs (Bonferroni)."""
        worst = min(mean_p_value(float(mean), self.degrees, self.runs) for mean in self.mean)
        return min(1.0, worst * len(self.mean))
