"""Power laws of gyro noise: the law of a series of averages, and the degrees of freedom of an Allan variance under it.

Sources: Greenhall & Riley, "Uncertainty of stability variances based on finite differences", PTTI 2003; Riley & Greenhall, "Power law noise
identification using the lag 1 autocorrelation", EFTF 2004; NIST SP 1065 (Riley 2008).
"""

from __future__ import annotations

import math

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


def equivalent_degrees_of_freedom(alpha: int, samples: int, m: int) -> float:
    """Return the equivalent degrees of freedom of the variance at m samples, from ``samples`` samples of the rate.

    ``2 E²/Var`` of the mean of squared second differences, by summing their squared autocorrelation (Greenhall & Riley 2003). The phase of
    white, flicker and random-walk noise in continuous time has the generalised covariances −|t|, t² ln|t| and |t|³, used without further
    approximation; quantisation is white phase.
    """
    if alpha not in NOISE_TYPES:
        raise InputError(f"alpha is {alpha!r}; it must be one of {', '.join(map(str, NOISE_TYPES))}")
    checks.count("samples", samples, minimum=2)
    if not 1 <= m <= samples // 2:
        raise InputError(f"m is {m!r}; with {samples} samples it must be between 1 and {samples // 2}")
    count = samples + 1 - 2 * m
    if alpha == 2:  # overlaps of the differences by lags of 0, m and 2m
        overlaps = 36 * count + 32 * max(count - m, 0) + 2 * max(count - 2 * m, 0)
        return float((6 * count) ** 2 / overlaps)
    # Midpoint rule with cells of one lag near the peaks at 0, m, 2m, … (narrow for flicker phase) and larger ones elsewhere.
    end = min(count, 6 * m)
    if m <= 1000:
        edges = np.arange(end + 1)
    else:
        fine = [np.arange(centre - 1000, centre + 1001) for centre in range(0, 3 * m, m)]
        edges = np.unique(np.concatenate([*fine, np.arange(0, end, m // 500), [0, end]]))
        edges = edges[(edges >= 0) & (edges <= end)]
    width = np.diff(edges)
    lag = edges[:-1] + 0.5 * (width - 1)
    correlation = _difference_covariance(alpha, lag, m) / _difference_covariance(alpha, np.zeros(1), m)
    both_sides = np.where(edges[:-1] == 0, 1.0, 2.0) * width
    return float(max(1.0, count / float(np.sum(both_sides * correlation**2 * (1.0 - lag / count)))))


def _difference_covariance(alpha: int, lag: Array, m: int) -> Array:
    """Return the autocovariance, up to a factor, of second differences of the phase over m samples."""
    weights = zip(range(-2, 3), (1.0, -4.0, 6.0, -4.0, 1.0), strict=True)
    return np.asarray(sum(weight * _phase_covariance(alpha, lag + j * m, m) for j, weight in weights))


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


def _logarithm(t: Array) -> Array:
    """Return ln t, and 0 at t = 0, where it is multiplied by a power of t."""
    return np.asarray(np.log(np.where(t > 0.0, t, 1.0)))
