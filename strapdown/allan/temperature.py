"""Bias of a sensor over temperature, from a record at rest with its temperature: a polynomial with intervals, and the residuals.

``x = c_0 + c_1 (T − T_0) + c_2 (T − T_0)² + … + noise``. The noise is far from white (a drifting bias resembles one that depends on the
temperature), so the intervals of ordinary least squares would be too small. The coefficients of the cosine transform of the record are
independent, and their variances follow from the noise terms (:mod:`strapdown.allan`). The regression is therefore by generalised least
squares with these weights. A weak rate random walk is hardly seen in the record, and yet limits the coefficients: they are averaged over
all walks that the record allows, weighted by the restricted likelihood of the noise terms, and the intervals are those of the mixture. If
the bias only flickers, the intervals are about twice as large as with the noise known, because a walk cannot be excluded. No rate ramp is
fitted, because the bias of a sensor that warms up resembles one.

``c_0``, the bias at ``T_0``, is the mean of the residuals; it has no interval, since the bias drifts. The record must have no gaps.

Sources: IEEE Std 952-1997, 12.11 (temperature sensitivity); Harville, "Maximum likelihood approaches to variance component estimation",
J. Am. Stat. Assoc. 72, 1977; Berger, de Oliveira & Sansó, "Objective Bayesian analysis of spatially correlated data", ibid. 96, 2001.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks
from strapdown.allan.deviation import TERMS
from strapdown.allan.noise_fit import SHORTEST
from strapdown.allan.spectrum import bin_starts, mean_power, scored
from strapdown.checks import Array, Hint, InputError
from strapdown.gyro.temperature import BiasOverTemperature, to_table
from strapdown.results import Table

__all__ = ["TemperatureFit", "fit_temperature"]

FLICKER, WALK = TERMS.index("bias_instability"), TERMS.index("rate_random_walk")
SUPPORT = 4.8
"""Log-likelihood ratio that supports flicker: probability 1e-3 without it, as in :mod:`strapdown.allan.noise_fit`."""
COARSE, FINE = 25, 40
"""Number of values of the rate random walk: for the limits of what is possible, and between these."""
UNLIKELY = 12.0
"""Decrease of the log-likelihood from its maximum beyond which a rate random walk is not considered."""
LEVEL = 0.95
"""Confidence of the intervals."""
SMALLEST_SPAN = 0.5
"""Minimum temperature range of a regression, K."""


UNITS = {"gyro": ("rad/s", "rad_per_s"), "accelerometer": ("m/s²", "m_per_s2"), "magnetometer": ("T", "t")}
"""Unit of the samples of each sensor, in messages and in keys."""


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

    def listing(self, unit: str) -> Table:
        """Return the coefficients with their intervals as a table, given the unit of the samples."""
        rows = []
        for (k, axis), value in np.ndenumerate(self.polynomial.coefficients):
            ends = (value - self.reach[k, axis], value + self.reach[k, axis]) if k else ("", "")
            rows.append(("xyz"[axis], k, f"{unit}/K{k if k > 1 else ''}" if k else unit, value, *ends))
        title = f"Bias over temperature, T − {self.polynomial.reference:.3f} °C"
        return Table(title, ("axis", "power", "unit", "estimate", "from", "to"), rows, left=3)


def fit_temperature(
    values: ArrayLike, temperature: ArrayLike, sample_interval: float, *, order: int = 1
) -> TemperatureFit:
    """Return the dependence of the bias of a sensor on temperature.

    Parameters
    ----------
    values : array_like (n,) or (n, axes)
        Averaged samples at rest, SI, at least 64 without gaps.
    temperature : array_like (n,)
        Temperature of the sensor, °C, which changes by 0.5 K or more.
    sample_interval : float
        Sample interval, s.
    order : int, default 1
        Highest power of the temperature.

    Returns
    -------
    TemperatureFit
        Coefficients with intervals, and the record less the dependence.
    """
    x = checks.array("values", values, ("n",) if np.ndim(values) == 1 else ("n", "axes"))
    x = x[:, None] if x.ndim == 1 else x
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    if len(x) < SHORTEST:
        raise InputError(f"values has {len(x)} samples; at least {SHORTEST} are needed to separate the noise terms")
    T = checks.array("temperature", temperature, (len(x),))
    checks.count("order", order)
    span = (float(T.min()), float(T.max()))
    if span[1] - span[0] < SMALLEST_SPAN:
        raise InputError(
            f"temperature spans {span[1] - span[0]:.2g} K, less than {SMALLEST_SPAN} K; record while the sensor warms up"
        )
    reference = float(T.mean())
    powers = (T[:, None] - reference) ** np.arange(1, order + 1)
    coefficients, sigma, reach = np.zeros((3, order + 1, x.shape[1]))
    left = np.empty_like(x)
    for axis in range(x.shape[1]):
        if np.ptp(x[:, axis]) <= 1e-13 * np.abs(x[:, axis]).max():
            raise InputError(f"values, axis {axis}, has no noise (it is constant); pass a recorded sensor")
        slopes, sigma[1:, axis], reach[1:, axis] = _regression(x[:, axis], powers, dt)
        left[:, axis] = x[:, axis] - np.sum((powers - powers.mean(axis=0)) * slopes, axis=1)
        coefficients[:, axis] = float(np.mean(x[:, axis]) - powers.mean(axis=0) @ slopes), *slopes
    polynomial = BiasOverTemperature(reference=reference, span=span, coefficients=coefficients, sigma=sigma)
    return TemperatureFit(polynomial, reach, left)


def regressed(source: Any, sensor: str, order: int) -> tuple[Array, Table, str]:
    """Return recorded samples (:class:`strapdown.recordings.GyroSamples`) less their bias over temperature, its table and its TOML."""
    import tomli_w

    if source.temperature is None:
        raise InputError(f"no temperature is recorded; leave {Hint('temperature')} out")
    if np.isnan(source.values).any():
        raise InputError(
            "there are gaps, which a regression on temperature does not support; cut the recording between them"
        )
    scale = source.sample_interval if source.kind == "increments" else 1.0
    fit = fit_temperature(source.values / scale, source.temperature, source.sample_interval, order=order)
    unit, stem = UNITS[sensor]
    title = "Bias over temperature by `strapdown allan`, a polynomial in T - reference."
    toml = tomli_w.dumps({sensor: {"temperature": to_table(fit.polynomial, stem)}})
    return fit.left * scale, fit.listing(unit), f"# {title}\n\n{toml}"


class _Bins(NamedTuple):
    """Sums over each bin of cosine coefficients: of the residuals y of a first fit and the regressors A, and the expected noise."""

    number: Array
    square: Array
    """Σ y² (b,)."""
    product: Array
    """Σ y A (b, p)."""
    gram: Array
    """Σ A Aᵀ (b, p, p)."""
    basis: Array
    """Expected square of a coefficient for unit noise of each term (terms, b)."""


class _Fit(NamedTuple):
    """Coefficients (p,) and their covariance (p, p) for given noise, whose restricted log-likelihood is −``loss``."""

    loss: float
    theta: Array
    variance: Array
    coefficients: Array
    covariance: Array


def _regression(x: Array, powers: Array, dt: float) -> tuple[Array, Array, Array]:
    """Return the coefficients of the powers, their σ and the half-widths of their intervals.

    A mixture over the rate random walk K: for each K the other noise terms maximise the restricted likelihood, and this likelihood times
    Jeffreys' prior of K² is the weight of the coefficients that follow by generalised least squares.
    """
    bins, first, scale = _binned(x, powers, dt)
    fits, weights = _over_walk(bins)
    each = np.array([fit.coefficients for fit in fits])
    variances = np.array([fit.covariance.diagonal() for fit in fits])
    mean = weights @ each
    sigma = np.sqrt(weights @ (variances + (each - mean) ** 2))
    reach = np.array([_half_width(weights, *axis) for axis in zip((each - mean).T, np.sqrt(variances).T, strict=True)])
    return (first + mean) / scale, sigma / scale, reach / scale


def _binned(x: Array, powers: Array, dt: float) -> tuple[_Bins, Array, Array]:
    """Return the bins, the coefficients of a first fit, which is subtracted so that no digits cancel, and the scale of both."""
    from scipy.fft import dct

    samples = len(x)
    centred = powers - powers.mean(axis=0)
    scale = np.sqrt(np.sum(centred**2, axis=0))
    A = dct(centred / scale, type=2, norm="ortho", axis=0)[1:]
    y = dct(x - x.mean(), type=2, norm="ortho")[1:]
    starts = bin_starts(samples - 1)
    basis = np.stack([mean_power(term, samples, dt, starts, samples - 1) for term in TERMS[:4]])

    def sums(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts - 1, axis=0))

    gram = sums(A[:, :, None] * A[:, None, :])
    first = np.linalg.solve(gram.sum(axis=0), sums(A * y[:, None]).sum(axis=0))
    rest = y - np.sum(A * first, axis=1)
    number = np.diff(np.append(starts, samples)).astype(np.float64)
    return _Bins(number, sums(rest**2), sums(A * rest[:, None]), gram, basis), first, scale


def _fitted(bins: _Bins, theta: Array) -> _Fit:
    """Return the generalised least squares fit for noise coefficients squared (terms,)."""
    variance = theta @ bins.basis
    if not np.all(variance > 0.0):
        nothing = np.zeros_like(bins.product[0])
        return _Fit(np.inf, theta, variance, nothing, np.outer(nothing, nothing))
    information = np.sum(bins.gram / variance[:, None, None], axis=0)
    covariance = np.linalg.inv(information)
    right = np.sum(bins.product / variance[:, None], axis=0)
    coefficients = covariance @ right
    loss = 0.5 * float(np.sum(bins.number * np.log(variance) + bins.square / variance) - right @ coefficients)
    return _Fit(loss + 0.5 * float(np.linalg.slogdet(information)[1]), theta, variance, coefficients, covariance)


def _maximised(bins: _Bins, start: Array, free: NDArray[np.bool_]) -> _Fit:
    """Return the fit at the maximum of the restricted likelihood over the free noise terms.

    The noise terms are fitted to the squared residuals, each with the expected reduction by the regression added back.
    """

    def power(fit: _Fit) -> Array:
        c, C = fit.coefficients, fit.covariance
        return np.asarray(bins.square - 2.0 * bins.product @ c + np.einsum("bij,ij->b", bins.gram, np.outer(c, c) + C))

    at = lambda theta: _fitted(bins, theta)  # noqa: E731
    return scored(bins, at, power, start, free)


def _over_walk(bins: _Bins) -> tuple[list[_Fit], Array]:
    """Return fits over the rate random walk K, without flicker and with it, and their weights.

    From a walk without effect to the largest that is possible. The weight is the restricted likelihood, maximised over the other noise,
    times Jeffreys' prior of θ = K², the root of its information; with flicker, divided by the likelihood ratio that supports a term.
    """
    every = np.ones(len(bins.basis), bool)
    best = _maximised(bins, np.asarray(bins.square.sum() / (bins.basis @ bins.number) / len(bins.basis)), every)

    def held(size: float, flicker: bool) -> _Fit:
        start, free = best.theta.copy(), every.copy()
        start[WALK], free[WALK], free[FLICKER] = size, False, flicker
        start[FLICKER] *= flicker
        return _maximised(bins, start, free)

    def information(fit: _Fit) -> float:
        return float(np.sum(0.5 * bins.number * (bins.basis[WALK] / fit.variance) ** 2))

    negligible = 1e-3 / np.sqrt(information(held(0.0, False)))
    grid = np.geomspace(negligible, 1e3 * max(1e3 * negligible, best.theta[WALK]), COARSE)
    near = np.flatnonzero([held(size, True).loss < best.loss + UNLIKELY for size in grid])
    grid = np.geomspace(grid[max(near[0] - 1, 0)], grid[min(near[-1] + 1, COARSE - 1)], FINE)
    fits = [held(size, flicker) for flicker in (False, True) for size in grid]
    cost = np.repeat([0.0, SUPPORT], FINE) + [fit.loss - best.loss for fit in fits]
    # dθ = θ d ln θ.
    density = np.tile(grid, 2) * np.sqrt([information(fit) for fit in fits]) * np.exp(cost.min() - cost)
    return fits, density / density.sum()


def _half_width(weights: Array, centre: Array, sigma: Array) -> float:
    """Return r with probability LEVEL of ±r in a mixture of normal distributions."""
    from scipy.optimize import brentq
    from scipy.special import ndtr

    def outside(r: float) -> float:
        return float(weights @ (ndtr((-r - centre) / sigma) + ndtr((centre - r) / sigma))) - (1.0 - LEVEL)

    return float(brentq(outside, 0.0, float(np.max(np.abs(centre) + 10.0 * sigma)), xtol=1e-9 * float(sigma.max())))
