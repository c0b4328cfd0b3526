"""Integration of increments or rates to rotation vectors or attitude, by any algorithm of the catalogue."""

from __future__ import annotations

import functools
import math
import time
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks, quaternion
from strapdown.checks import Array, InputError
from strapdown.coning import coefficients as exact
from strapdown.coning.algorithms import Algorithm, named, pair_tables
from strapdown.kernels import integration_polynomial as kernels
from strapdown.kernels import integration_uneven
from strapdown.kernels.integration import (
    WORK,
    accumulate_quaternions,
    accumulate_vectors,
    compressed_vectors,
    pair_vectors,
)
from strapdown.kernels.machine import compiled

IDENTITY = (1.0, 0.0, 0.0, 0.0)
_VECTOR_SOLVERS = ("compressed", "pairs")

EVEN = 1e-3
"""Maximum relative deviation of an interval from the mean of its window for which the intervals are treated as equal: the rounding of
stamps in microseconds at 1 kHz."""
GAP = 4.0
"""Maximum ratio of an interval to its neighbour, or of the neighbour to it, across which a rate polynomial is fitted."""
LOPSIDED = 4
"""Maximum difference between the numbers of increments on the two sides of an interval in the fit of its polynomial, uneven intervals."""


def integrate(
    increments: ArrayLike,
    algorithm: str | Algorithm = "one-sample",
    initial_attitude: ArrayLike = IDENTITY,
    *,
    edges: ArrayLike | None = None,
) -> Array:
    """Return the attitude at the step edges from gyro increments.

    Parameters
    ----------
    increments : array_like (n, 3)
        Integrals of the body rate over each sample interval, rad; the last n mod N increments are not used.
    algorithm : str or Algorithm, default "one-sample"
        Name in :data:`ALGORITHMS`, or an algorithm.
    initial_attitude : array_like (4,), default identity
        Unit quaternion q_fb at the first edge.
    edges : array_like (n + 1,), optional
        Times of the edges of the sample intervals, s, as in :func:`rotation_vectors`. Default: equal intervals.

    Returns
    -------
    ndarray (n // N + 1, 4)
        Unit quaternions q_fb, starting with the initial attitude.
    """
    table = named(algorithm)
    initial = checks.unit_quaternions("initial_attitude", initial_attitude)
    if initial.shape != (4,):
        raise InputError(f"initial_attitude has shape {initial.shape}, wanted (4,); pass one quaternion")
    late = table.window == 1 and _is_plain(increments)
    samples = np.asarray(increments) if late else _increments(increments)
    attitude = np.empty((len(samples) // table.samples + 1, 4))
    work = np.empty(WORK)
    uneven, corrected = _uneven(samples, edges, table)
    if table.solver in _VECTOR_SOLVERS:
        vectors = _vectors(samples, table)
        if len(uneven):
            vectors[uneven] = quaternion.log(corrected)
        compiled(accumulate_vectors)(vectors.reshape(-1), initial, work, attitude.reshape(-1))
    else:
        steps = _steps(samples, table)
        if len(uneven):
            steps[uneven] = corrected
        compiled(accumulate_quaternions)(steps.reshape(-1), initial, work, attitude.reshape(-1))
    if not math.isfinite(attitude[-1, 0]):
        # A value that is not finite makes all later attitudes NaN, so plain arrays need not be searched before.
        _increments(increments)
        raise InputError("increments holds a rotation vector of more than 1e150 rad; check its unit")
    return attitude


def increments_from_rates(rates: ArrayLike, sample_interval: float, points: int = 2) -> Array:
    """Return rotation increments from rate samples at the edges of the intervals.

    Parameters
    ----------
    rates : array_like (n + 1, 3)
        Rates, rad/s.
    sample_interval : float
        Interval between samples, s.
    points : int, default 2
        Even number of nearest samples whose interpolating polynomial is integrated; 2 is the trapezoidal rule, which drifts under coning
        as much as no correction does. Use 8 for the algorithms of the catalogue.

    Returns
    -------
    ndarray (n, 3)
        Increments, rad. For an oscillation they are too small by a relative error of order λ^points. Near the ends one-sided samples are
        used.

    Examples
    --------
    >>> increments_from_rates([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0]], 0.5).tolist()
    [[0.0, 0.0, 1.0]]
    """
    samples = checks.array("rates", rates, ("n", 3))
    interval = checks.positive("sample_interval", sample_interval, unit="s")
    checks.count("points", points, minimum=2)
    if points % 2:
        raise InputError(
            f"points is {points}; it must be even, with the same number of samples before and after an interval"
        )
    if len(samples) < 2:
        raise InputError(f"rates has {len(samples)} samples; at least 2 are needed, one at each edge of an interval")
    n = len(samples) - 1
    points = min(points, len(samples) - len(samples) % 2)
    middle = points // 2 - 1
    increments = np.zeros((n, 3))
    for j, weight in enumerate(_quadrature(points, middle)):
        increments[middle : n - middle] += weight * samples[j : j + n - 2 * middle]
    for i in range(middle):
        increments[i] = np.asarray(_quadrature(points, i)) @ samples[:points]
        increments[n - 1 - i] = np.asarray(_quadrature(points, points - 2 - i)) @ samples[n + 1 - points :]
    return np.asarray(increments * interval)


def rotation_vectors(
    increments: ArrayLike, algorithm: str | Algorithm = "one-sample", *, edges: ArrayLike | None = None
) -> Array:
    """Return the body rotation vector of each step from gyro increments.

    Parameters
    ----------
    increments : array_like (n, 3)
        Integrals of the body rate over each sample interval, rad; the last n mod N increments are not used.
    algorithm : str or Algorithm, default "one-sample"
        Name in :data:`ALGORITHMS`, or an algorithm.
    edges : array_like (n + 1,), optional
        Times of the edges of the sample intervals, s. Omit them if the resolution of the stamps is coarser than the sampling jitter
        (milliseconds at 300 Hz). Default: equal intervals.

    Returns
    -------
    ndarray (n // N, 3)
        Rotation vectors, rad. For solvers that use quaternions it is the logarithm of the step, of length at most π.

    Notes
    -----
    The coefficients of every algorithm are for equal intervals. If the intervals in the window of a step are unequal according to
    ``edges``, the polynomial solver computes that step: the quaternion equation for the rate polynomial through the increments over
    intervals of any length. For an interval that is a gap relative to its neighbours, the rate is assumed constant.
    """
    table = named(algorithm)
    samples = _increments(increments)
    uneven, corrected = _uneven(samples, edges, table)
    if table.solver in _VECTOR_SOLVERS:
        vectors = _vectors(samples, table)
        vectors = vectors.copy() if vectors is samples else vectors
    else:
        vectors = quaternion.log(_steps(samples, table))
    if len(uneven):
        vectors[uneven] = quaternion.log(corrected)
    return vectors


def time_per_sample(algorithm: str | Algorithm, samples: int = 20_160) -> float:
    """Return the minimum time per sample of :func:`integrate` on this machine, s, without compilation."""
    table = named(algorithm)
    checks.count("samples", samples, minimum=table.window)
    increments = 1e-3 * np.random.default_rng(0).standard_normal((samples, 3))
    best = math.inf
    for _ in range(6):
        start = time.perf_counter()
        integrate(increments, table)
        best = min(best, time.perf_counter() - start)
    return best / samples


def _is_plain(increments: ArrayLike) -> bool:
    """Return whether kernels can use the array of increments without conversion; its values are not checked."""
    if not isinstance(increments, np.ndarray) or increments.dtype != np.float64:
        return False
    return increments.ndim == 2 and increments.shape[1] == 3 and increments.flags.c_contiguous


def _increments(increments: ArrayLike) -> Array:
    return np.ascontiguousarray(checks.array("increments", increments, ("n", 3)))


def _vectors(increments: Array, table: Algorithm) -> Array:
    if table.window == 1:
        return increments
    vectors = np.empty((len(increments) // table.samples, 3))
    if table.solver == "compressed":
        # The first steps use later increments instead of previous ones; for a record too short for that, a smaller p is used.
        previous = min(table.previous, max(0, len(increments) - table.samples) // 2)
        coefficients = _compressed_array(table, previous)
        compiled(compressed_vectors)(increments.reshape(-1), coefficients, table.samples, vectors.reshape(-1))
    else:
        short = len(increments) < table.window
        tables = pair_tables(table.samples, len(increments), {}) if short else table.pair_arrays
        previous = len(increments) if short else table.previous
        compiled(pair_vectors)(increments, table.samples, previous, tables, vectors)
    return vectors


def _steps(increments: Array, table: Algorithm) -> Array:
    steps = np.empty((len(increments) // table.samples, 4))
    if table.solver == "polynomial":
        # A record shorter than the window is fitted by one polynomial of lower degree, without the correction.
        window = min(table.window, len(increments))
        correction = table.correction_array if window == table.window else np.zeros((1, 1))
        previous = table.previous if window == table.window else len(increments)
        fits = _fits(window)
        compiled(kernels.polynomial_steps)(increments, table.samples, previous, fits, correction, *_work(window), steps)
        return steps
    compiled(kernels.magnus_steps)(increments, exact.floats(exact.magnus_moments(table.samples)), steps)
    return steps


def _uneven(increments: Array, edges: ArrayLike | None, table: Algorithm) -> tuple[NDArray[np.intp], Array]:
    """Return the steps with unequal intervals in their window, and their rotations as quaternions."""
    none = np.empty(0, np.intp), np.empty((0, 4))
    if edges is None:
        return none
    stamps = np.ascontiguousarray(checks.increasing("edges", edges, minimum=2))
    if len(stamps) != len(increments) + 1:
        raise InputError(
            f"edges holds {len(stamps)} times and increments {len(increments)} rows; give the {len(increments) + 1} edges of the intervals"
        )
    window = min(table.window, len(increments))
    lengths = np.diff(stamps)
    if window == 1 or lengths.max() - lengths.min() <= EVEN * lengths.min():
        return none
    previous = table.previous if window == table.window else len(increments)
    begin = np.arange(len(increments) // table.samples) * table.samples
    start = np.clip(begin - previous, 0, len(increments) - window)
    mean = (stamps[start + window] - stamps[start]) / window
    apart = np.zeros(len(start))
    for j in range(window):
        apart = np.maximum(apart, np.abs(lengths[start + j] - mean))
    uneven = np.flatnonzero(apart > EVEN * mean)
    if len(uneven) == 0:
        return none
    steps = np.empty((len(uneven), 4))
    limits = table.samples, previous, window, GAP, LOPSIDED
    nodes = np.empty((integration_uneven.ROWS, window + 1))
    compiled(integration_uneven.uneven_steps)(increments, stamps, uneven, *limits, nodes, *_work(window), steps)
    return uneven, steps


def _work(window: int) -> tuple[Array, Array]:
    """Return the work space of the polynomial solver: the rate polynomial, and the power series of the quaternion."""
    return np.empty((4, window)), np.empty((kernels.TERMS_PER_SAMPLE * window + kernels.EXTRA_TERMS, 4))


def _compressed_array(table: Algorithm, previous: int) -> Array:
    if previous == table.previous:
        return table.coefficient_array
    return np.array([float(k) for k in exact.compressed_coefficients(table.samples, previous)])


@functools.cache
def _fits(window: int) -> Array:
    """Return (interval, increment, power): coefficients of the rate polynomial per increment, in time from the middle of the interval."""
    tables = [exact.rates_about(window, Fraction(2 * i + 1, 2)) for i in range(window)]
    return np.array([exact.floats(table) for table in tables]).reshape(window, window, window)


@functools.cache
def _quadrature(points: int, interval: int) -> tuple[float, ...]:
    return tuple(float(w) for w in exact.rate_weights(points, interval))
