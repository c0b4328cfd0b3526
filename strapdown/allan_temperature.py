"""A sensor's bias over temperature, from a record at rest whose temperature was recorded: polynomial with intervals, and what is left.

``x = c_0 + c_1 (T − T_0) + c_2 (T − T_0)² + … + noise``. The noise is anything but white (a bias that wanders looks like one that follows
the temperature), so plain least squares would be far too sure. The cosine transform of the record has independent coefficients, whose
variances the noise's terms give (:mod:`strapdown.allan`): the regression is weighted by these, generalised least squares, and repeated
with the noise of what is left until it stands still. A rate ramp is not fitted beside it, for a sensor that warms up has one.

``c_0``, the bias at ``T_0``, is the mean that is left; a wandering bias gives it no interval. Gaps must not be in the record.

Source: IEEE Std 952-1997, 12.11 (temperature sensitivity); the weights: as in :mod:`strapdown.allan`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import allan, checks
from strapdown.checks import Array, InputError

__all__ = [
    "TemperatureFit",
    "fit_temperature",
]

MOST_PASSES = 50
"""Most regressions, each with the noise of what the one before left."""
SETTLED = 1e-3
"""Largest change of a coefficient, in σ, and relative change of the noise's spectrum, that end them."""
SMALLEST_SPAN = 0.5
"""Range of temperature, K, below which no regression is made."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TemperatureFit:
    """A sensor's bias over temperature."""

    reference: float
    """T_0, °C: the mean temperature of the record."""
    span: tuple[float, float]
    """Lowest and highest temperature, °C: outside the polynomial says nothing."""
    coefficients: Array
    """(axes, order + 1), SI per K to the power."""
    sigma: Array
    """Standard deviations (axes, order + 1); NaN of c_0."""
    lower: Array
    """Ends of the intervals, of the same shape."""
    upper: Array
    level: float
    left: Array
    """The record (n, axes) without its dependence on temperature, the mean kept."""

    def bias(self, temperature: ArrayLike) -> Array:
        """Return the bias (..., axes) at temperatures, °C, SI."""
        T = checks.array("temperature", temperature, (...,)) - self.reference
        powers = T[..., None] ** np.arange(self.coefficients.shape[1])
        return np.asarray(powers @ self.coefficients.T)


def fit_temperature(
    values: ArrayLike, temperature: ArrayLike, sample_interval: float, *, order: int = 1, level: float = 0.95
) -> TemperatureFit:
    """Return the dependence of a sensor's bias on temperature.

    Parameters
    ----------
    values : (n,) or (n, axes)
        Averaged samples at rest, SI.
    temperature : (n,)
        °C.
    sample_interval : float
        s.
    order : int
        Highest power of the temperature.
    level : float
        Confidence of the intervals.

    Raises
    ------
    InputError
        If the temperature spans too little, or samples are missing.
    """
    x = checks.array("values", values, ("n",) if np.ndim(values) == 1 else ("n", "axes"))
    x = x[:, None] if x.ndim == 1 else x
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    T = checks.array("temperature", temperature, (len(x),))
    checks.count("order", order)
    if not 0.5 < level < 1.0:
        raise InputError(f"level is {level:g}; a confidence lies between 0.5 and 1, for example 0.95")
    span = (float(T.min()), float(T.max()))
    if span[1] - span[0] < SMALLEST_SPAN:
        raise InputError(
            f"temperature spans {span[1] - span[0]:.2g} K, less than {SMALLEST_SPAN} K; warm the sensor up while it records"
        )
    reference = float(T.mean())
    powers = (T[:, None] - reference) ** np.arange(1, order + 1)
    from scipy.stats import norm

    coefficients, sigma = np.full((x.shape[1], order + 1), np.nan), np.full((x.shape[1], order + 1), np.nan)
    left = np.empty_like(x)
    for axis in range(x.shape[1]):
        found, errors = _regression(x[:, axis], powers, dt)
        coefficients[axis, 1:], sigma[axis, 1:] = found, errors
        left[:, axis] = x[:, axis] - (powers - powers.mean(axis=0)) @ found
        coefficients[axis, 0] = float(np.mean(x[:, axis] - powers @ found))
    reach = float(norm.ppf(0.5 + 0.5 * level)) * sigma
    return TemperatureFit(
        reference=reference,
        span=span,
        coefficients=coefficients,
        sigma=sigma,
        lower=coefficients - reach,
        upper=coefficients + reach,
        level=level,
        left=left,
    )


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
    starts = allan._bin_starts(samples - 1)
    basis = np.stack([allan._basis(term, samples, dt, starts, samples - 1) for term in allan.TERMS[:4]])
    number = np.diff(np.append(starts, samples)).astype(np.float64)

    def binned(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts - 1))

    found = np.linalg.lstsq(A, y, rcond=None)[0]
    variance = np.maximum(binned((y - A @ found) ** 2) / number, 1e-300)
    errors = np.full(len(found), np.inf)
    for _ in range(MOST_PASSES):
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
