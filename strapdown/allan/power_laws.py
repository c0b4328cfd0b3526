"""Power laws of gyro noise: the law of a series of averages, and the degrees of freedom of an Allan variance under it.

Sources: Greenhall & Riley, "Uncertainty of stability variances based on finite differences", PTTI 2003; Riley & Greenhall, "Power law noise
identification using the lag 1 autocorrelation", EFTF 2004; NIST SP 1065 (Riley 2008).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from strapdown import checks
from strapdown.allan.spectrum import inner
from strapdown.checks import Array, InputError

NOISE_TYPES = {
    2: "quantization",
    1: "flicker angle",
    0: "angle random walk",
    -1: "bias instability",
    -2: "rate random walk",
}
"""Name of each power law; the key is the exponent of f in the PSD of the rate."""

ESTIMATORS = {
    "overlapping": "overlapping Allan deviation, OADEV",
    "robust": "Allan deviation by the median of second differences",
    "modified": "modified Allan deviation, MDEV: of the angle averaged over τ; separates quantisation from flicker of the angle",
    "hadamard": "overlapping Hadamard deviation, HDEV: from third differences of the angle, which are insensitive to a rate ramp",
}
"""Estimators of :func:`allan_deviation`."""

_FEWEST_BLOCKS = 30  # with fewer the lag-1 autocorrelation is too uncertain (SP 1065, §5.5.6)

MANY_BLOCKS = 128
"""Number of averages from which the scatter of their power law is well below one half."""


def power_law(means: Array, otherwise: int) -> int:
    """Return the power law of averages (n,), NaN for missing ones, by their lag-1 autocorrelation (Riley & Greenhall 2004).

    A series with correlation r at lag 1 has fractional-difference parameter δ = r/(1 + r); it is differenced while δ ≥ ¼. The exponent of
    gyro noise decreases with τ. With few averages, whose estimate is uncertain, the result is therefore at most ``otherwise``, the exponent
    at the previous τ.
    """
    count = int(np.isfinite(means).sum())
    if count < _FEWEST_BLOCKS:
        return otherwise
    for differenced in range(3):
        centred = means - np.nanmean(means)
        there = np.isfinite(centred)
        centred[~there] = 0.0
        power = inner(centred, centred)
        pairs = int((there[1:] & there[:-1]).sum())
        if power <= 0.0 or pairs == 0:
            return -2
        correlation = inner(centred[1:], centred[:-1]) / power * ((int(there.sum()) - 1) / pairs)
        delta = correlation / (1.0 + correlation) if correlation > -1.0 else -math.inf
        if delta < 0.25 or differenced == 2:
            alpha = int(np.clip(np.round(-2.0 * (max(delta, -2.0) + differenced)), -2, 2))
            return alpha if count >= MANY_BLOCKS else min(alpha, otherwise)
        means = np.diff(means)
    return otherwise


def differences_of(estimator: str) -> int:
    """Return the order of the differences that an estimator squares: of the angle, or for the modified Allan deviation of its sum."""
    return 3 if estimator in ("modified", "hadamard") else 2


def equivalent_degrees_of_freedom(alpha: int, samples: int, m: int, estimator: str = "overlapping") -> float:
    """Return the equivalent degrees of freedom of the variance at m samples, from ``samples`` samples of the rate.

    ``2 E²/Var`` of the mean of squared differences, by summing their squared autocorrelation (Greenhall & Riley 2003). The phase of white,
    flicker and random-walk noise in continuous time has the generalised covariances −|t|, t² ln|t| and |t|³, used without further
    approximation; quantisation is white phase. The covariances of the summed phase, whose third differences the modified Allan deviation
    squares, are their second integrals.
    """
    if alpha not in NOISE_TYPES:
        raise InputError(f"alpha is {alpha!r}; it must be one of {', '.join(map(str, NOISE_TYPES))}")
    checks.one_of("estimator", estimator, ESTIMATORS)
    checks.count("samples", samples, minimum=2)
    order = differences_of(estimator)
    if not 1 <= m <= samples // order:
        raise InputError(f"m is {m!r}; with {samples} samples it must be between 1 and {samples // order}")
    summed = estimator == "modified"
    count = samples + 1 + summed - order * m
    if alpha == 2 and not summed:  # overlaps of the differences by lags of 0, m, 2m, …
        weights = [math.comb(2 * order, order + j) for j in range(order + 1)]
        overlaps = sum((1 + (j > 0)) * w**2 * max(count - j * m, 0) for j, w in enumerate(weights))
        return float((weights[0] * count) ** 2 / overlaps)
    # Midpoint rule with cells of one lag near the peaks at 0, m, 2m, … (narrow for flicker phase) and larger ones elsewhere.
    end = min(count, 6 * m)
    if m <= 1000:
        edges = np.arange(end + 1)
    else:
        fine = [np.arange(centre - 1000, centre + 1001) for centre in range(0, (order + 1) * m, m)]
        edges = np.unique(np.concatenate([*fine, np.arange(0, end, m // 500), [0, end]]))
        edges = edges[(edges >= 0) & (edges <= end)]
    width = np.diff(edges)
    lag = edges[:-1] + 0.5 * (width - 1)
    covariance = _summed_phase_covariance if summed else _phase_covariance
    correlation = _difference_covariance(covariance, alpha, lag, m, order)
    correlation /= _difference_covariance(covariance, alpha, np.zeros(1), m, order)
    both_sides = np.where(edges[:-1] == 0, 1.0, 2.0) * width
    return float(max(1.0, count / float(np.sum(both_sides * correlation**2 * (1.0 - lag / count)))))


def _difference_covariance(
    covariance: Callable[[int, Array, int], Array], alpha: int, lag: Array, m: int, order: int
) -> Array:
    """Return the autocovariance, up to a factor, of differences of the given order over m samples, from a generalised covariance."""
    total = np.zeros_like(lag)
    for j in range(-order, order + 1):
        total += (-1) ** j * math.comb(2 * order, order + j) * covariance(alpha, lag + j * m, m)
    return total


def _phase_covariance(alpha: int, k: Array, m: int) -> Array:
    """Return the generalised covariance of the phase at lags of k samples, in units of m samples, up to a factor."""
    t = np.abs(k) / m
    if alpha == 0:
        return np.asarray(-t)
    if alpha == -1:
        return np.asarray(t * t * _logarithm(t))
    if alpha == -2:
        return np.asarray(t**3)

    # Flicker of the phase needs a band limit for a finite variance: Greenhall's second difference over one sample interval.
    def smooth(j: Array) -> Array:
        return np.asarray(j * j * _logarithm(np.abs(j)))

    near = np.minimum(np.abs(k), 1000)
    difference = 2.0 * smooth(near) - smooth(near - 1) - smooth(near + 1)
    return np.asarray(np.where(np.abs(k) <= 1000, difference, -2.0 * np.log(np.maximum(np.abs(k), 1)) - 3.0))


def _summed_phase_covariance(alpha: int, k: Array, m: int) -> Array:
    """Return the same for the running sum of the phase: minus its second difference over one sample is the covariance of the phase.

    This is exact except for flicker of the rate, where the difference approximates the derivative.
    """
    t, step = np.abs(k) / m, 1.0 / m
    if alpha == 2:
        return np.asarray(-t)
    if alpha == 1:
        return np.asarray(t * t * _logarithm(t))
    if alpha == 0:
        return np.asarray(t**3 - step**2 * t)
    if alpha == -1:
        return np.asarray(-(t**4) * _logarithm(t))
    return np.asarray(-(t**5) + step**2 * t**3 * 5.0 / 3.0 - step**4 * t * 2.0 / 3.0)


def _logarithm(t: Array) -> Array:
    """Return ln t, and 0 at t = 0, where it is multiplied by a power of t."""
    return np.asarray(np.log(np.where(t > 0.0, t, 1.0)))
