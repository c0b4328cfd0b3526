"""A sensor's bias over temperature, from a record at rest with its temperature: a polynomial with intervals, and the remainder.

``x = c_0 + c_1 (T − T_0) + c_2 (T − T_0)² + … + noise``. The noise is far from white (a wandering bias looks like one that follows
the temperature), so plain least squares would be overconfident. The cosine transform of the record has independent coefficients,
whose variances the noise terms give (:mod:`strapdown.allan`): the regression is weighted by these, generalised least squares, and
iterated with the noise of the remainder until it converges. A rate ramp is not fitted beside it, for a sensor that warms up has
one.

``c_0``, the bias at ``T_0``, is the mean of the remainder; a wandering bias gives it no interval. The record must have no gaps.

Source: IEEE Std 952-1997, 12.11 (temperature sensitivity); the weights: as in :mod:`strapdown.allan`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks
from strapdown.allan.deviation import TERMS, confidence
from strapdown.allan.spectrum import bin_starts, mean_power
from strapdown.checks import Array, InputError
from strapdown.gyro.temperature import BiasOverTemperature

__all__ = [
    "TemperatureFit",
    "fit_temperature",
]

MAX_PASSES = 50
"""Most iterations of the regression, each with the noise of the last residuals."""
SETTLED = 1e-3
"""Convergence: largest change of a coefficient, in σ, and relative change of the noise's spectrum."""
SMALLEST_SPAN = 0.5
"""Range of temperature, K, below which no regression is made."""


class TemperatureFit(NamedTuple):
    """A sensor's bias over temperature.

    Parameters
    ----------
    polynomial : BiasOverTemperature
        ``bias = Σ c_k (T − T_0)^k`` of each axis with its σ; T_0 is the mean temperature of the record.
    reach : ndarray (order + 1, axes)
        Half-width of the intervals of the coefficients; 0 of c_0, which has none.
    left : ndarray (n, axes)
        The record without its dependence on temperature, the mean kept.
    """

    polynomial: BiasOverTemperature
    reach: Array
    left: Array


def fit_temperature(
    values: ArrayLike, temperature: ArrayLike, sample_interval: float, *, order: int = 1, level: float = 0.95
) -> TemperatureFit:
    """Return the dependence of a sensor's bias on temperature.

    Parameters
    ----------
    values : array_like (n,) or (n, axes)
        Averaged samples at rest, SI.
    temperature : array_like (n,)
        Temperature of the sensor, °C.
    sample_interval : float
        Sample interval, s.
    order : int, default 1
        Highest power of the temperature.
    level : float, default 0.95
        Confidence of the intervals, 0.5 to 1.

    Returns
    -------
    TemperatureFit
        Coefficients with intervals, and the record without the dependence.

    Raises
    ------
    InputError
        If the temperature spans less than 0.5 K, or samples are missing.
    """
    x = checks.array("values", values, ("n",) if np.ndim(values) == 1 else ("n", "axes"))
    x = x[:, None] if x.ndim == 1 else x
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    T = checks.array("temperature", temperature, (len(x),))
    checks.count("order", order)
    level = confidence(level)
    span = (float(T.min()), float(T.max()))
    if span[1] - span[0] < SMALLEST_SPAN:
        raise InputError(
            f"temperature spans {span[1] - span[0]:.2g} K, less than {SMALLEST_SPAN} K; warm the sensor up while it records"
        )
    reference = float(T.mean())
    powers = (T[:, None] - reference) ** np.arange(1, order + 1)
    from scipy.stats import norm

    coefficients, sigma = np.zeros((2, order + 1, x.shape[1]))
    left = np.empty_like(x)
    for axis in range(x.shape[1]):
        found, sigma[1:, axis] = _regression(x[:, axis], powers, dt)
        left[:, axis] = x[:, axis] - (powers - powers.mean(axis=0)) @ found
        coefficients[:, axis] = float(np.mean(x[:, axis] - powers @ found)), *found
    polynomial = BiasOverTemperature(reference=reference, span=span, coefficients=coefficients, sigma=sigma)
    return TemperatureFit(polynomial, float(norm.ppf(0.5 + 0.5 * level)) * sigma, left)


def _regression(x: Array, powers: Array, dt: float) -> tuple[Array, Array]:
    """Return the coefficients of the powers and their σ, weighted by the noise, whose terms are those of greatest restricted likelihood.

    Fisher scoring as in :func:`strapdown.allan.fit_noise`: the noise's terms are fitted to the squares of what is left, each with the part
    put back that the regression took from it.
    """
    from scipy.fft import dct
    from scipy.optimize import nnls

    samples = len(x)
    scale = np.linalg.norm(powers - powers.mean(axis=0), axis=0)
    A = dct((powers - powers.mean(axis=0)) / scale, type=2, norm="ortho", axis=0)[1:]
    y = dct(x - x.mean(), type=2, norm="ortho")[1:]
    starts = bin_starts(samples - 1)
    basis = np.stack([mean_power(term, samples, dt, starts, samples - 1) for term in TERMS[:4]])
    number = np.diff(np.append(starts, samples)).astype(np.float64)

    def binned(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts - 1))

    found = np.linalg.lstsq(A, y, rcond=None)[0]
    variance = np.maximum(binned((y - A @ found) ** 2) / number, 1e-300)
    errors = np.full(len(found), np.inf)
    for _ in range(MAX_PASSES):
        weight = np.repeat(1.0 / np.sqrt(variance), number.astype(np.int64))
        Q, R = np.linalg.qr(A * weight[:, None])
        before, found = found, np.linalg.solve(R, Q.T @ (y * weight))
        errors = np.sqrt(np.sum(np.linalg.inv(R) ** 2, axis=1))
        taken = np.sum(Q**2, axis=1) / weight**2
        power = binned((y - A @ found) ** 2 + taken) / number
        design = (basis * np.sqrt(number) / variance).T
        norm = np.linalg.norm(design, axis=0)
        theta = nnls(design / norm, power * np.sqrt(number) / variance)[0] / norm
        after = theta @ basis
        if np.all(np.abs(found - before) < SETTLED * errors) and np.all(np.abs(after - variance) < SETTLED * variance):
            break
        variance = after
    return found / scale, errors / scale
