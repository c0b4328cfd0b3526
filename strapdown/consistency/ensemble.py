"""All that independent errors at one epoch say of the covariance they came with."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, count
from strapdown.consistency.bounds import (
    Coverage,
    coverage,
    log_mean_bounds,
    log_mean_p_value,
    mean_bounds,
    mean_p_value,
    tail,
)
from strapdown.consistency.manifold import whitened

DECIBEL = 10.0 / math.log(10.0)
"""Of a natural logarithm of a power."""


@dataclass(frozen=True, kw_only=True)
class Credibility:
    """Statistics of independent errors against their covariances."""

    runs: int
    degrees: int
    anees: float
    """Mean NEES per degree of freedom: 1 for a consistent filter."""
    log_nees: float
    """Mean of ln NEES: ψ(n/2) + ln 2 for a consistent filter."""
    non_credibility: float
    """Li & Zhao's index, dB: mean of ``10 |lg(ε/ε*)|``, ε the NEES with the filter's covariance, ε* with the actual mean square error; 0 is
    perfect, and the sampling of the latter keeps a consistent filter a little above it."""
    inclination: float
    """Mean of ``10 lg(ε/ε*)``, dB: above zero the filter is optimistic (too sure), below pessimistic."""
    coverage: Coverage
    """Of the whitened errors, all components."""
    probability: float

    @property
    def anees_bounds(self) -> tuple[float, float]:
        """Two-sided bounds of :attr:`anees`."""
        return mean_bounds(self.degrees, self.runs, self.probability)

    @property
    def log_nees_bounds(self) -> tuple[float, float]:
        """Two-sided bounds of :attr:`log_nees`."""
        return log_mean_bounds(self.degrees, self.runs, self.probability)

    @property
    def non_credibility_bound(self) -> float:
        """Upper bound of :attr:`non_credibility`, by simulation of right filters."""
        indices = null_indices(self.degrees, self.runs)[0]
        return float(np.quantile(indices, self.probability))

    @property
    def inclination_bounds(self) -> tuple[float, float]:
        """Two-sided bounds of :attr:`inclination`, by simulation of right filters."""
        outside = tail(self.probability)
        low, high = np.quantile(null_indices(self.degrees, self.runs)[1], [outside, 1.0 - outside])
        return float(low), float(high)

    @property
    def p_values(self) -> dict[str, float]:
        """Two-sided p-values of ANEES and log-NEES, whose distributions are exact."""
        return {
            "anees": mean_p_value(self.anees, self.degrees, self.runs),
            "log_nees": log_mean_p_value(self.log_nees, self.degrees, self.runs),
        }

    @property
    def leaning(self) -> str:
        """Whether it is "optimistic" or "pessimistic", or "credible": the inclination lies inside its bounds."""
        low, high = self.inclination_bounds
        return "pessimistic" if self.inclination < low else "optimistic" if self.inclination > high else "credible"


def credibility(error: ArrayLike, covariance: ArrayLike, probability: float = 0.99) -> Credibility:
    """Return the credibility statistics of independent errors at one epoch.

    Parameters
    ----------
    error : array_like (runs, n)
        At least n + 1 runs, so that the mean square error has an inverse.
    covariance : array_like (runs, n, n)
        The filter's covariance in each run.
    probability : float, default 0.99
        Of the bounds.

    Returns
    -------
    Credibility
        ANEES, log-NEES, non-credibility index, inclination and coverage, with their bounds.

    Raises
    ------
    InputError
        If the shapes do not agree, or a covariance is not positive definite.

    References
    ----------
    X. R. Li, Z. Zhao, Measuring estimator's credibility: noncredibility index, Fusion 2006.
    """
    tail(probability)
    white = whitened(error, covariance)
    if white.ndim != 2:
        raise InputError(f"error has shape {white.shape}, wanted (runs, n): one error a run, all at one epoch")
    runs, n = white.shape
    count("the number of runs", runs, least=n + 1)
    squares = np.sum(white * white, axis=1)
    index, inclination = credibility_indices(white)
    return Credibility(
        runs=runs,
        degrees=n,
        anees=float(squares.mean() / n),
        log_nees=float(np.log(squares).mean()),
        non_credibility=float(index),
        inclination=float(inclination),
        coverage=coverage(white.ravel(), 1.0, probability),
        probability=probability,
    )


def credibility_indices(white: Array) -> tuple[Array, Array]:
    """Return non-credibility index and inclination (...,), dB, of whitened errors (..., runs, n).

    Whitening every run by its own covariance first makes them those of a filter whose covariance is the same in all runs; where it is, they
    are exactly Li & Zhao's, which no change of coordinates alters.
    """
    actual = np.swapaxes(white, -1, -2) @ white / white.shape[-2]
    own = np.sum(white * white, axis=-1)
    other = np.sum(white * np.swapaxes(np.linalg.solve(actual, np.swapaxes(white, -1, -2)), -1, -2), axis=-1)
    ratio = DECIBEL * np.log(own / other)
    return np.asarray(np.abs(ratio).mean(axis=-1)), np.asarray(ratio.mean(axis=-1))


NULL_DRAWS = 20_000
"""Simulated consistent filters that the bounds of the indices are quantiles of; a 1 % tail is then known to a tenth of itself."""


@functools.lru_cache(maxsize=16)
def null_indices(degrees: int, runs: int) -> tuple[Array, Array]:
    """Return both indices of simulated right filters (draws,) each, from a fixed seed; they depend on nothing else."""
    random = np.random.default_rng([degrees, runs])
    most = max(1, 2_000_000 // (runs * degrees))
    parts = []
    left = NULL_DRAWS
    while left:
        now = min(left, most)
        parts.append(credibility_indices(random.standard_normal((now, runs, degrees))))
        left -= now
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
