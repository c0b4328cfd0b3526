"""Bias of a sensor over temperature, from a record at rest with its temperature: a polynomial with intervals, and the residuals.

``x = c_0 + c_1 (T − T_0) + c_2 (T − T_0)² + … + noise``. The noise is far from white (a drifting bias resembles one that depends on the
temperature), so the intervals of ordinary least squares would be too small. The coefficients of the cosine transform of the record are
independent, and their variances follow from the noise terms (:mod:`strapdown.allan`). The regression is therefore by generalised least
squares with these weights, iterated with the noise of the residuals until it converges. No rate ramp is fitted, because the bias of a
sensor that warms up resembles one.

``c_0``, the bias at ``T_0``, is the mean of the residuals; it has no interval, since the bias drifts. The record must have no gaps.

Source: IEEE Std 952-1997, 12.11 (temperature sensitivity); the weights: as in :mod:`strapdown.allan`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks
from strapdown.allan.deviation import TERMS
from strapdown.allan.spectrum import bin_starts, mean_power
from strapdown.checks import Array, InputError
from strapdown.gyro.temperature import BiasOverTemperature

__all__ = [
    "TemperatureFit",
    "fit_temperature",
]

MAX_PASSES = 50
"""Maximum number of iterations of the regression, each with the noise of the last residuals."""
SETTLED = 1e-3
"""Tolerance of convergence: change of a coefficient, in σ, and relative change of the noise spectrum."""
LEVEL = 0.95
"""Confidence of the intervals."""
SMALLEST_SPAN = 0.5
"""Minimum temperature range of a regression, K."""


class TemperatureFit(NamedTuple):
    """Bias of a sensor over temperature.

    Parameters
    ----------
    polynomial : BiasOverTemperature
        ``bias = Σ c_k (T − T_0)^k`` of each axis with its σ; T_0 is the mean temperature of the record.
    reach : ndarray (order + 1, axes)
        Half-width of the 95 % intervals of the coefficients; 0 for c_0, which has none.
    left : ndarray (n, axes)
        The record less its dependence on temperature, with its mean.
    """

    polynomial: BiasOverTemperature
    reach: Array
    left: Array


def fit_temperature(
    values: ArrayLike, temperature: ArrayLike, sample_interval: float, *, order: int = 1
) -> TemperatureFit:
    """Return the dependence of the bias of a sensor on temperature.

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

    Returns
    -------
    TemperatureFit
        Coefficients with intervals, and the record less the dependence.

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
    span = (float(T.min()), float(T.max()))
    if span[1] - span[0] < SMALLEST_SPAN:
        raise InputError(
            f"temperature spans {span[1] - span[0]:.2g} K, less than {SMALLEST_SPAN} K; record while the sensor warms up"
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
    return TemperatureFit(polynomial, float(norm.ppf(0.5 + 0.5 * LEVEL)) * sigma, left)


def _regression(x: Array, powers: Array, dt: float) -> tuple[Array, Array]:
    """Return the coefficients of the powers and their σ, weighted by the noise, whose terms maximise the restricted likelihood.

    Fisher scoring as in :func:`strapdown.allan.fit_noise`: the noise terms are fitted to the squared residuals, each with the expected
    reduction by the regression added back.
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
