"""Process noise of a filter matched to a gyro: its angle and rate random walk, and its flicker.

A filter with a random-walk bias does not model flicker. :func:`matched_process_noise` gives the white and random-walk noise with which its
attitude variance is the actual one; :func:`process_noise` a bound, a spectrum that is nowhere below that of the gyro: ``σ_v'² = σ_v² +
B²/(2ω*)`` and ``σ_u'² = σ_u² + ω* B²/2``; by the inequality of the means ``B²/(2ω*) + ω* B²/(2ω²) ≥ B²/ω`` for every ω, with equality at
ω*. The exact model adds the sixteen states of :class:`strapdown.gyro.flicker.Shaping` to the filter, driven by one white noise per axis.

``sims/flicker_in_filter.py`` compares them on the presets: mean NEES per degree of freedom of the attitude 1.00 to 1.05 matched, 1.00 to
1.61 if flicker is ignored; the RMS error is within 1.2 % of that of the augmented filter. For the bias this does not hold: a random-walk
bias tracks the low-frequency part of the flicker, and its covariance does not include the high-frequency part, which the simulated bias
contains. Judge such a filter by its attitude.
"""

from __future__ import annotations

import numpy as np

from strapdown.checks import InputError, positive
from strapdown.gyro.model import GyroSpec


def process_noise(spec: GyroSpec, *, bandwidth: float | None = None) -> dict[str, float]:
    """Return the process noise of a filter with a random-walk bias: ``ProcessNoise(**process_noise(spec))``.

    Parameters
    ----------
    spec : GyroSpec
        Specification of the gyro.
    bandwidth : float, optional
        ω*, rad/s, at which the spectral bound equals the flicker, required if the gyro has flicker: the natural frequency of the filter.

    Returns
    -------
    dict
        ``angle_random_walk``, rad/√s, and ``rate_random_walk``, rad/s/√s, the maximum over the axes.

    Notes
    -----
    Without flicker these are the coefficients of the gyro; a Gauss–Markov bias is represented by its driving noise, which is valid for
    times much shorter than τ.

    Examples
    --------
    >>> process_noise(GyroSpec(angle_random_walk=1e-5, rate_random_walk=1e-8))
    {'angle_random_walk': 1e-05, 'rate_random_walk': 1e-08}
    """
    white, walk, instability = _filter_terms(spec)
    if instability > 0.0:
        if bandwidth is None:
            raise InputError(
                "the specification has flicker (bias_instability); pass the bandwidth of its spectral bound, in rad/s"
            )
        corner = positive("bandwidth", bandwidth, unit="rad/s")
        white += instability**2 / (2.0 * corner)
        walk += 0.5 * corner * instability**2
    return {"angle_random_walk": float(np.sqrt(white)), "rate_random_walk": float(np.sqrt(walk))}


def matched_process_noise(spec: GyroSpec, measurement_density: float) -> dict[str, float]:
    """Return the process noise for which the filter's steady-state attitude variance is correct in the presence of flicker.

    Parameters
    ----------
    spec : GyroSpec
        Specification of the gyro.
    measurement_density : float
        r, rad² s: variance of a measurement about an axis times the interval between measurements.

    Returns
    -------
    dict
        ``angle_random_walk``, rad/√s, and ``rate_random_walk``, rad/s/√s.

    Notes
    -----
    The transfer function from rate to attitude error is ``s/(s² + 2ζω s + ω²)``, so flicker gives the attitude variance
    ``B²/(2πω²) arccos ζ/(ζ √(1 − ζ²))``, and the bound at ω* = ω gives ``B²/(4ζω²)``. Their ratio is ``κ(ζ) = (2/π) arccos ζ/√(1 −
    ζ²)`` (arcosh and ζ² − 1 above ζ = 1): 1, 0.71 and 0.64 at ζ = 0, 0.71 and 1. The bound with κ B² in place of B² is solved for the ω and
    ζ of the resulting filter.
    """
    white, walk, instability = _filter_terms(spec)
    density = positive("measurement_density", measurement_density, unit="rad² s")
    if instability == 0.0:
        return process_noise(spec)
    share = 1.0
    for _ in range(200):
        power = share * instability**2
        natural = _natural_frequency(walk, power, density)
        matched_white, matched_walk = white + power / (2.0 * natural), walk + 0.5 * natural * power
        damping = 0.5 * float(np.sqrt((matched_white + 2.0 * np.sqrt(matched_walk * density)) / density)) / natural
        before, share = share, flicker_share(damping)
        if abs(share - before) <= 1e-14 * share:
            break
    return {"angle_random_walk": float(np.sqrt(matched_white)), "rate_random_walk": float(np.sqrt(matched_walk))}


def flicker_share(damping: float) -> float:
    """Return κ(ζ) of :func:`matched_process_noise`: the ratio of the attitude variance due to flicker to that of its spectral bound."""
    away = 1.0 - damping**2
    if abs(away) < 1e-6:
        return float(2.0 / np.pi * (1.0 + (1.0 - damping) / 3.0))
    angle = np.arccos(damping) if away > 0.0 else np.arccosh(damping)
    return float(2.0 / np.pi * angle / np.sqrt(abs(away)))


def _natural_frequency(walk: float, power: float, density: float) -> float:
    """Return the root ω of r ω⁴ = σ_u² + ω B²/2."""
    from scipy.optimize import brentq

    # In units of the larger of the two limits ω⁴ = σ_u²/r and ω³ = B²/(2r), the root lies in [1, 2).
    scale = max((walk / density) ** 0.25, (power / (2.0 * density)) ** (1.0 / 3.0))
    a, b = walk / (density * scale**4), power / (2.0 * density * scale**3)
    return float(scale * brentq(lambda x: x**4 - b * x - a, 0.5, 2.0, xtol=1e-14))


def _filter_terms(spec: GyroSpec) -> tuple[float, float, float]:
    """Return σ_v², the PSD of all random walks, and B, each the maximum over the axes."""
    white = float(np.max(spec.angle_random_walk)) ** 2
    walk = float(np.max(np.square(spec.rate_random_walk) + np.square(spec.markov_noise)))
    return white, walk, float(np.max(spec.bias_instability))
