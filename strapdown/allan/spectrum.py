"""Spectrum of a record by the cosine transform: exact variances of its coefficients under each noise, in bins of 5 %."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from strapdown.checks import Array, positive

BIN_GROWTH = 1.05

LARGEST_EXACT = 1 << 16


def last_coefficient(samples: int, dt: float, highest_frequency: float | None) -> int:
    """Return the index of the last DCT coefficient below a frequency, Hz; None: of the last one."""
    if highest_frequency is None:
        return samples - 1
    return min(samples - 1, int(2.0 * samples * dt * positive("highest_frequency", highest_frequency, unit="Hz")))


def bin_starts(last: int) -> NDArray[np.int64]:
    """Return the first index of each bin of DCT coefficients 1 … last; each bin spans 5 % or one coefficient."""
    starts = [1]
    while (following := max(starts[-1] + 1, math.ceil(starts[-1] * BIN_GROWTH))) <= last:
        starts.append(following)
    return np.array(starts, dtype=np.int64)


def bin_slices(starts: NDArray[np.int64], last: int) -> list[slice]:
    """Return the coefficients of each bin."""
    return [slice(int(a), int(b)) for a, b in zip(starts, [*starts[1:], last + 1], strict=True)]


def mean_power(term: str, samples: int, dt: float, starts: NDArray[np.int64], last: int) -> Array:
    """Return the mean over each bin of the expected squared DCT-II coefficient for a unit coefficient of ``term``."""
    return np.array(
        [
            float(np.mean(expected_power(term, samples, dt, np.arange(s.start, s.stop))))
            for s in bin_slices(starts, last)
        ]
    )


def expected_power(term: str, samples: int, dt: float, j: NDArray[np.int64]) -> Array:
    """Return the expected square of the orthonormal DCT-II coefficients j of averaged-rate samples, unit coefficient of ``term``.

    With θ = πj/n, the spectrum of white rate noise is constant. The difference of averaged random-walk samples has covariance dt (2/3, 1/6
    at lag 1), which the sine transform diagonalises as the cosine transform does that of the samples. The covariance of differenced
    quantisation noise is the same Laplacian with two different corner entries.
    """
    theta = np.pi * j / samples
    laplacian = 4.0 * np.sin(0.5 * theta) ** 2
    if term == "angle_random_walk":
        return np.full(j.shape, 1.0 / dt)
    if term == "rate_random_walk":
        return np.asarray(dt * (2.0 / 3.0 + np.cos(theta) / 3.0) / laplacian)
    if term == "quantization":
        return np.asarray((laplacian + 4.0 / samples * np.cos(0.5 * theta) ** 2) / dt**2)
    spectrum = samples / (np.pi * j)  # B²/(2π f dt) at f dt = j/2n
    ratio = flicker_leakage(min(samples, LARGEST_EXACT))
    # Far from both ends the ratio depends only on j, and converges to 1.
    known = len(ratio) if samples <= LARGEST_EXACT else len(ratio) // 8
    return np.asarray(spectrum * np.where(j < known, ratio[np.minimum(j, known - 1)], 1.0))


def flicker_covariance(count: int) -> Array:
    """Return the generalised autocovariance −Cin(πk)/π of unit flicker samples band-limited at Nyquist, k = 0 … count − 1.

    Flicker has infinite variance; the omitted constant cancels in every combination of samples whose weights sum to zero.
    """
    from scipy.special import sici

    x = np.pi * np.arange(1, count)
    return np.concatenate([[0.0], -(np.euler_gamma + np.log(x) - sici(x)[1]) / np.pi])


@functools.lru_cache(maxsize=8)
def flicker_leakage(samples: int) -> Array:
    """Return the expected squared DCT-II coefficients of flicker divided by its spectrum, by index j (entry 0 unused).

    ``E c_j² = γ_0 + (2/n) Σ_h γ_h ((n − h) cos hθ − sin hθ / sin θ)``, θ = πj/n: the sum over the autocorrelation of a row of the DCT.
    """
    from scipy.fft import rfft

    lag = np.arange(samples)
    covariance = flicker_covariance(samples)
    j = np.arange(1, samples)
    cosine_sum = rfft(covariance * (samples - lag), 2 * samples).real[1:samples]
    sine_sum = -rfft(covariance, 2 * samples).imag[1:samples]
    power = 2.0 / samples * (cosine_sum - sine_sum / np.sin(np.pi * j / samples))
    return np.concatenate([[1.0], power * np.pi * j / samples])


def ramp_coefficients(samples: int, j: NDArray[np.int64]) -> Array:
    """Return the orthonormal DCT-II coefficients j ≥ 1 of the sequence 0, 1, 2, …: −√(2/n) cos(θ/2)/(2 sin² θ/2) for odd j, else 0."""
    half = 0.5 * np.pi * j / samples
    return np.asarray(np.where(j % 2 == 1, -math.sqrt(2.0 / samples) * np.cos(half) / (2.0 * np.sin(half) ** 2), 0.0))


def inner(a: Array, b: Array) -> float:
    """Return Σ a b of two vectors without BLAS, whose threads cost many times the sum itself where other work keeps the cores busy."""
    return float(np.einsum("i,i->", a, b))


class Bins(NamedTuple):
    """Sums over each bin: squared coefficients less a first slope, their products with those of the ramp, squares of those of the ramp."""

    number: Array
    square: Array
    product: Array
    ramp: Array
    basis: Array
    first_slope: float


def cosine_transform(values: Array, scale: float) -> Array:
    """Return the orthonormal DCT-II of values less their mean, times ``scale``."""
    from scipy.fft import dct

    coefficient = dct(values - values.mean(), type=2, norm="ortho", overwrite_x=True)
    coefficient *= scale
    return np.asarray(coefficient)


class Segment(NamedTuple):
    """Segment of a record without gaps: the bins of its cosine coefficients, and their expected squares for each noise term."""

    place: slice
    starts: NDArray[np.int64]
    last: int
    basis: Array


def segment(place: slice, dt: float, terms: Sequence[str], highest_frequency: float | None) -> Segment:
    """Return the bins of a segment of samples."""
    samples = place.stop - place.start
    last = last_coefficient(samples, dt, highest_frequency)
    starts = bin_starts(last)
    return Segment(place, starts, last, np.stack([mean_power(term, samples, dt, starts, last) for term in terms]))


def binned(coefficients: Sequence[Array], segments: Sequence[Segment], dt: float) -> tuple[list[Bins], Bins]:
    """Return the sums over the bins of each segment and of all, by increasing frequency; all segments have the same ramp."""
    low = [c[1 : min(segment.last, 1 << 20) + 1] for c, segment in zip(coefficients, segments, strict=True)]
    ramps = [
        dt * ramp_coefficients(len(c), np.arange(1, len(part) + 1)) for c, part in zip(coefficients, low, strict=True)
    ]
    slope = sum(inner(r, c) for r, c in zip(ramps, low, strict=True)) / sum(inner(r, r) for r in ramps)
    each = []
    for coefficient, segment in zip(coefficients, segments, strict=True):
        sums = []
        for s in bin_slices(segment.starts, segment.last):
            ramp = dt * ramp_coefficients(len(coefficient), np.arange(s.start, s.stop))
            rest = coefficient[s] - slope * ramp
            sums.append((len(rest), inner(rest, rest), inner(rest, ramp), inner(ramp, ramp)))
        number, square, product, ramp_square = np.array(sums, dtype=float).T
        each.append(Bins(number, square, product, ramp_square, segment.basis, slope))
    frequency = [segment.starts / len(c) for c, segment in zip(coefficients, segments, strict=True)]
    order = np.argsort(np.concatenate(frequency), kind="stable")
    joined = {
        name: np.concatenate([getattr(bins, name) for bins in each], axis=-1)[..., order]
        for name in ("number", "square", "product", "ramp", "basis")
    }
    return each, Bins(**joined, first_slope=slope)


MAX_PASSES, SMALLEST_GAIN, SHORTEST_STEP = 100, 1e-9, 1e-6
"""Limits of the passes of :func:`scored`: number, gain of the log-likelihood, part of a step."""
Fit = TypeVar("Fit", bound=Any)


def scored(
    bins: Any, at: Callable[[Array], Fit], power: Callable[[Fit], Array], start: Array, free: NDArray[np.bool_]
) -> Fit:
    """Return the maximum of the likelihood of bins over the free noise terms θ ≥ 0, by Fisher scoring.

    Each step is a non-negative least-squares problem of the ``power`` expected in the bins, with step halving. ``at`` is the fit at some θ,
    of which ``loss``, ``theta`` and ``variance`` are used.
    """
    from scipy.optimize import nnls

    fit, held = at(start), np.where(free, 0.0, start) @ bins.basis
    basis, root = bins.basis[free], np.sqrt(bins.number)
    for _ in range(MAX_PASSES if free.any() else 0):
        weight = root / fit.variance
        design = (basis * weight).T
        norm = np.sqrt((design * design).sum(axis=0))
        target = start.copy()
        target[free] = nnls(design / norm, (power(fit) / bins.number - held) * weight)[0] / norm
        step, trial = 1.0, at(target)
        while trial.loss > fit.loss and step > SHORTEST_STEP:
            step *= 0.5
            trial = at(fit.theta + step * (target - fit.theta))
        gain = fit.loss - trial.loss
        fit = trial if gain > 0.0 else fit
        if gain < SMALLEST_GAIN:
            break
    return fit
