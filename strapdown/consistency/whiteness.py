"""Tests of the innovations of a consistent filter: white, normal, of mean zero, independent of those of other sensors.

All take whitened innovations (m, dof), :attr:`strapdown.records.Innovations.whitened`. All are invariant to a common factor on the
innovations, which the NIS shows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, array, numbers
from strapdown.consistency.bounds import tail

MAX_LAGS = 20


def usual_lags(samples: int) -> int:
    """Return the number of lags of a whiteness test: a fiftieth of the samples, from 1 to 20."""
    return max(1, min(MAX_LAGS, samples // 50))


class Autocorrelation(NamedTuple):
    """Autocorrelation of each component of a series."""

    lags: Array
    """Lags (L,), from 1."""
    values: Array
    """Autocorrelation at each lag (L, dof)."""
    bounds: Array
    """Half-width of the bounds that hold for all values jointly (L,) (Bonferroni)."""


def autocorrelation(whitened: ArrayLike, confidence_level: float = 0.99) -> Autocorrelation:
    """Return the autocorrelation of whitened innovations (n,) or (n, m) at the :func:`usual_lags`, of each component.

    The mean is known to be zero and is not subtracted. For white noise the value at lag l is approximately normal with variance
    (N − l)/(N(N + 2)) (Ljung & Box 1978, Biometrika 65).
    """
    from scipy.special import ndtri

    z = _series(whitened)
    n, lags = len(z), np.arange(1, usual_lags(len(z)) + 1)
    values = np.array([np.sum(z[lag:] * z[:-lag], axis=0) for lag in lags]) / np.sum(z * z, axis=0)
    sigma = np.sqrt((n - lags) / (n * (n + 2.0)))
    return Autocorrelation(lags.astype(np.float64), values, -ndtri(tail(confidence_level) / values.size) * sigma)


def ljung_box(whitened: ArrayLike) -> tuple[float, int, float]:
    """Return the multivariate Ljung–Box statistic of whitened innovations (n,) or (n, m), its degrees of freedom and its p-value.

    ``Q = N(N + 2/m) Σ_l tr(C_lᵀ C_0⁻¹ C_l C_0⁻¹)/(N − l)`` is χ² with m² L degrees of freedom if the innovations are white. The test is
    one-sided: large values reject. No parameters are fitted, so no degrees of freedom are subtracted; the factor N(N + 2/m), instead
    of N², gives the right mean in small samples where the mean is known (Hosking 1980, J. American Statistical Association 75).
    """
    from scipy.special import chdtrc

    z = _series(whitened)
    n, m = z.shape
    number = usual_lags(n)
    if number >= n or n <= m:
        raise InputError(f"{n} samples are too few for {number} lags of {m} components")
    # With components of unit covariance the traces are sums of squares.
    u = _decorrelated(z)
    total = 0.0
    for lag in range(1, number + 1):
        C = u[lag:].T @ u[:-lag] / n
        total += float(np.sum(C * C)) / (n - lag)
    statistic = n * (n + 2.0 / m) * total
    degrees = m * m * number
    return statistic, degrees, float(chdtrc(degrees, statistic))


def _decorrelated(z: Array) -> Array:
    factor = np.linalg.cholesky(z.T @ z / len(z))
    return np.asarray(np.linalg.solve(factor, z.T).T)


def anderson_darling(whitened: ArrayLike) -> tuple[float, float]:
    """Return the Anderson–Darling statistic A²* of normality, with mean and variance unknown, and its p-value.

    The components are standardised separately and pooled. p-values after D'Agostino & Stephens (1986), table 4.9: 0.752 is 5 %, 1.035 is
    1 %.
    """
    from scipy.special import log_ndtr

    z = _series(whitened)
    if len(z) < 8:
        raise InputError(f"{len(z)} samples are too few to judge normality; at least 8 are needed")
    spread = z.std(axis=0, ddof=1)
    if np.any(spread == 0.0):
        raise InputError("the innovations do not vary; check that they are from measurements")
    x = np.sort(((z - z.mean(axis=0)) / spread).ravel())
    n = len(x)
    weight = 2.0 * np.arange(1, n + 1) - 1.0
    square = -n - float(np.sum(weight * (log_ndtr(x) + log_ndtr(-x[::-1])))) / n
    a = square * (1.0 + 0.75 / n + 2.25 / n**2)
    if a >= 0.6:
        p = math.exp(1.2937 - 5.709 * min(a, 13.0) + 0.0186 * min(a, 13.0) ** 2)
    elif a > 0.34:
        p = math.exp(0.9177 - 4.279 * a - 1.38 * a * a)
    elif a > 0.2:
        p = 1.0 - math.exp(-8.318 + 42.796 * a - 59.938 * a * a)
    else:
        p = 1.0 - math.exp(-13.436 + 101.14 * a - 223.73 * a * a)
    return a, p


def mean_innovation_p_value(whitened: ArrayLike) -> tuple[Array, float]:
    """Return the mean of the whitened innovations (dof,) and the p-value that it is zero: Hotelling's T², exact for normal innovations."""
    from scipy.special import fdtrc

    z = _series(whitened)
    n, m = z.shape
    if n <= m + 1:
        raise InputError(f"{n} samples are too few to judge a mean of {m} components")
    mean = z.mean(axis=0)
    covariance = (z - mean).T @ (z - mean) / (n - 1.0)
    square = n * float(mean @ np.linalg.solve(covariance, mean))
    return mean, float(fdtrc(m, n - m, square * (n - m) / (m * (n - 1.0))))


def cross_correlation_p_value(
    time: ArrayLike, whitened: ArrayLike, other_time: ArrayLike, other: ArrayLike
) -> tuple[Array, int, float]:
    """Return the correlation of two sensors' whitened innovations (dof, dof), the number of pairs, and the p-value that it is zero.

    Each innovation of the other is paired with the last of the first sensor at or before it, and each is used once at most. For a
    consistent filter they are independent whatever their times. Bartlett's test of canonical correlations,
    −(N − (p + q + 1)/2) Σ ln(1 − ρ²), is χ² with p q degrees of freedom; if there are too few pairs, it is NaN.
    """
    from scipy.special import chdtrc

    a, b = _series(whitened), _series(other)
    ta, tb = array("time", time, (len(a),)), array("other_time", other_time, (len(b),))
    before = (
        np.searchsorted(ta, tb, side="right") - 1
    )  # index of the last of the first sensor at or before each of the other
    first = np.ones(len(tb), bool)
    first[1:] = before[1:] != before[:-1]
    used = first & (before >= 0)
    x, y = a[before[used]], b[used]
    n, p, q = len(x), a.shape[1], b.shape[1]
    if n < 10 * (p + q):
        return np.full((p, q), np.nan), n, math.nan
    correlation = x.T @ y / np.sqrt(np.outer(np.sum(x * x, axis=0), np.sum(y * y, axis=0)))
    canonical = np.linalg.svd(_decorrelated(x).T @ _decorrelated(y) / n, compute_uv=False)
    statistic = -(n - 0.5 * (p + q + 1.0)) * float(np.sum(np.log1p(-np.minimum(canonical**2, 1.0 - 1e-15))))
    return correlation, n, float(chdtrc(p * q, statistic))


def _series(whitened: ArrayLike) -> Array:
    values = numbers("whitened", whitened)
    return array("whitened", values[:, None] if values.ndim == 1 else values, ("m", "dof"))
