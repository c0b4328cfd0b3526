"""Flicker noise (bias instability) as the output of a shaping filter, for simulation and as states of a filter.

The samples have the two-sided PSD ``1/(2π f)``, f in cycles per sample, from far below 1/T up to the Nyquist frequency. The best rational
approximation of 1/√s on [s_min, 4], ``s = 4 sin²(π f)``, is Zolotarev's, known in closed form; a fixed factor of three poles and zeros
converts 1/√s = 1/(2 sin π f) to 1/(2π f). Each factor of a rational function of s is a squared modulus, so the spectrum has a shaping
filter with real poles, which in partial fractions is sixteen first-order states driven by *one* white noise:

    x_i ← p_i x_i + w,    y = Σ g_i x_i

With sixteen states the error of the spectrum is within 1 % over eight decades. The stationary covariance of the states is known in closed
form, so the noise is stationary from its first sample. The same states can augment a filter: see :class:`Shaping`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array, count

STATES = 16
"""Number of states of the shaping filter."""

MARGIN = 8
"""The spectrum is correct down to the frequency 1/(MARGIN · samples); below it is flat."""

_ZEROS = (-0.92451637, -0.62241797, -0.17473594)
_POLES = (-0.92314517, -0.60000265, -0.10898167)
"""Least-squares fit of ``|Π(1 − ζ/z)/Π(1 − p/z)|²`` to sin(πf)/(πf), up to a factor, on 0 < f < ½; maximum error 0.22 %, by a test."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shaping:
    """Shaping filter of flicker with B = 1: ``x ← p x + w``, ``y = g · x``, with w one standard normal per sample."""

    decrements: Array
    """1 − p of each state (n,), which keeps the digits that p loses by rounding; the time constants are sample interval / decrement."""
    gains: Array
    """g (n,)."""

    @property
    def poles(self) -> Array:
        """The poles p (n,)."""
        return np.asarray(1.0 - self.decrements)

    @property
    def covariance(self) -> Array:
        """Stationary covariance of the states (n, n): 1/(1 − p_i p_j)."""
        e = self.decrements
        return np.asarray(1.0 / (e[:, None] + e - e[:, None] * e))

    @property
    def variance(self) -> float:
        """Stationary variance of y."""
        return float(self.gains @ self.covariance @ self.gains)

    def start(self, normals: Array) -> Array:
        """Return stationary states (..., n) from standard normals (..., n)."""
        scale = np.sqrt(np.diag(self.covariance))
        correlation = self.covariance / np.outer(scale, scale)
        return np.asarray(scale * (normals @ np.linalg.cholesky(correlation).T))

    def spectrum(self, frequency: Array) -> Array:
        """Return the two-sided PSD of y at frequencies in cycles per sample."""
        turn = -2.0 * np.pi * np.asarray(frequency)[..., None]
        # 1 − p e^{jθ} = (1 − e^{jθ}) + (1 − p) e^{jθ}, without cancellation at low frequency.
        back = np.exp(1j * turn)
        away = 2.0 * np.sin(0.5 * turn) ** 2 - 1j * np.sin(turn)
        return np.asarray(np.abs(np.sum(self.gains / (away + self.decrements * back), axis=-1)) ** 2)


@functools.lru_cache(maxsize=64)
def shaping(samples: int) -> Shaping:
    """Return the shaping filter for records of the given number of samples.

    The poles and zeros of Zolotarev's function are ``−c_l``, ``c_l = 4 κ² tn²(l K'/(2n); k')`` for odd and even l, κ² = s_min/4
    (Petrushev & Popov 1987, section 4.3).
    """
    from scipy.special import ellipkm1

    lowest = 1.0 / (MARGIN * max(count("samples", samples), 16))
    complement = np.sin(np.pi * lowest) ** 2  # κ² = s_min/4
    orders = STATES - len(_POLES)
    quarter = float(ellipkm1(complement))
    argument = np.arange(1, 2 * orders) * quarter / (2 * orders)
    # tn at a parameter 1 − κ² so near 1 by its expansion (Abramowitz & Stegun 16.15), used below half the quarter period;
    # above it tn(K − u) = 1/(κ tn u).
    near = np.minimum(argument, quarter - argument)
    tangent = np.sinh(near) * _correction(near, complement)
    squared = np.where(argument <= 0.5 * quarter, complement * tangent**2, 1.0 / tangent**2)
    decrements = _decrement(4.0 * squared)
    poles = np.concatenate([decrements[0::2], 1.0 - np.array(_POLES)])
    zeros = np.concatenate([decrements[1::2], 1.0 - np.array(_ZEROS)])
    # Partial fractions from differences of the decrements, accurate for poles close to 1.
    p = 1.0 - poles
    above = np.prod((zeros[None, :] - poles[:, None]) / p[:, None], axis=1)
    apart = poles[None, :] - poles[:, None] + np.diag(p)
    gains = above / np.prod(apart / p[:, None], axis=1)
    unit = Shaping(decrements=poles, gains=gains)
    frequency = np.geomspace(lowest, 0.5, 4000)
    ratio = unit.spectrum(frequency) * 2.0 * np.pi * frequency
    return Shaping(decrements=poles, gains=gains / (ratio.max() * ratio.min()) ** 0.25)


def _correction(u: Array, complement: float) -> Array:
    """Return tn(u)/sinh(u) at the parameter 1 − ``complement``, to first order in it."""
    part = 0.25 * complement * (np.sinh(u) * np.cosh(u) - u)
    sine = 1.0 + part / (np.sinh(u) * np.cosh(u))
    cosine = 1.0 - part * np.tanh(u)
    return np.asarray(sine / cosine)


def _decrement(c: Array) -> Array:
    """Return 1 − p of the root p < 1 of p + 1/p = 2 + c: |1 − p e^{jθ}|² ∝ s + c."""
    return np.asarray(0.5 * (np.sqrt(c * c + 4.0 * c) - c))
