"""Misfit of a record and the noise terms fitted to it: tests of its spectrum, its largest sample and its noise by segments."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from strapdown.allan.spectrum import Bins, Segment, bin_slices, expected_power, inner, ramp_coefficients
from strapdown.checks import Array

STRETCHES = 64
"""Maximum number of parts of a segment whose noise is compared."""


def worst_misfit(
    coefficients: Sequence[Array],
    each: Sequence[Bins],
    segments: Sequence[Segment],
    theta: Array,
    slope: float,
    terms: Sequence[str],
    dt: float,
) -> tuple[float, str]:
    """Return the minimum over the segments of the p-value of a record under its fit, times their number, and its description.

    ``theta`` are the fitted terms squared, ``slope`` the ramp beyond the first one of the bins; overwrites ``coefficients``.
    """
    misfits = []
    for coefficient, bins, segment in zip(coefficients, each, segments, strict=True):
        white = _whitened(coefficient, segment, theta, bins.first_slope + slope, terms, dt)
        tests = (*_of_series(white, segment.last, dt), _of_spectrum(bins, theta, slope))
        probability, what = min(tests, key=lambda test: test[0])  # if several are 0, the first, which has a time
        where = "" if len(segments) == 1 else f"in the segment from {segment.place.start * dt:.6g} s "
        misfits.append((min(1.0, 3.0 * probability), where + what))
    probability, what = min(misfits, key=lambda misfit: misfit[0])
    return min(1.0, len(misfits) * probability), what


def _whitened(
    coefficient: Array, segment: Segment, theta: Array, slope: float, terms: Sequence[str], dt: float
) -> Array:
    """Return the coefficients divided by their fitted standard deviations and transformed back: a white series of unit variance.

    A rotation or a step of the bias, whose spectrum may resemble that of a random walk, is an outlier in this series.
    """
    from scipy.fft import idct

    samples, last = len(coefficient), segment.last
    for s in bin_slices(segment.starts, last):
        j = np.arange(s.start, s.stop)
        variance = np.zeros(len(j))
        for term, size in zip(terms, theta, strict=True):
            if size > 0.0:
                variance += size * expected_power(term, samples, dt, j)
        coefficient[s] -= slope * dt * ramp_coefficients(samples, j)
        coefficient[s] /= np.sqrt(variance)
    coefficient[0] = coefficient[last + 1 :] = 0.0
    white = idct(coefficient, type=2, norm="ortho", overwrite_x=True)
    white *= math.sqrt(samples / last)
    return np.asarray(white)


def _of_series(white: Array, last: int, dt: float) -> tuple[tuple[float, str], tuple[float, str]]:
    """Return the p-values of the largest sample, and of the energy of parts, of a series that should be white, with descriptions."""
    samples = len(white)
    largest = max(int(np.argmax(white)), int(np.argmin(white)), key=lambda k: abs(white[k]))
    size = abs(float(white[largest]))
    edges = np.linspace(0, samples, min(STRETCHES, samples // 16) + 1).astype(np.int64)
    energy = np.array([inner(white[a:b], white[a:b]) for a, b in itertools.pairwise(edges)])
    number = np.diff(edges)
    loudest = int(np.argmax(energy / number))
    span = f"{dt * edges[loudest]:.6g} to {dt * edges[loudest + 1]:.6g} s"
    return (
        (samples * math.erfc(size / math.sqrt(2.0)), f"a sample at {dt * largest:.6g} s is an outlier of {size:.3g} σ"),
        (
            chi_squared_probability(number * (last / samples), energy / number, len(number) - 1),
            f"its noise is not stationary, and largest from {span}",
        ),
    )


def _of_spectrum(bins: Bins, theta: Array, slope: float) -> tuple[float, str]:
    """Return the p-value of the spectrum, over the bins with enough coefficients, and its description."""
    many = bins.number >= min(30.0, bins.number.max())
    power = bins.square - 2.0 * slope * bins.product + slope**2 * bins.ramp
    ratio = power[many] / (bins.number[many] * (theta @ bins.basis)[many])
    count = max(1, int(many.sum()) - int(np.sum(theta > 0.0)))
    return chi_squared_probability(bins.number[many], ratio, count), "its spectrum has another shape"


def chi_squared_probability(freedom: Array, ratio: Array, count: int) -> float:
    """Return the p-value of the sum of squared normal scores of χ²/freedom ratios, with ``count`` degrees of freedom.

    The cube root of a χ² variable is nearly normal (Wilson & Hilferty 1931); the tail of the Pearson statistic is too heavy at 1e-3.
    """
    from scipy.stats import chi2

    spread = 2.0 / (9.0 * freedom)
    score = (np.cbrt(ratio) - 1.0 + spread) / np.sqrt(spread)
    return float(chi2.sf(score @ score, count))
