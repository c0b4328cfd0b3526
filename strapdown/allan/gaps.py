"""Allan deviation and noise coefficients of a record with gaps: samples on an even grid, missing ones NaN.

Gaps must not depend on the values lost: those of a lost packet do not, those of a sensor that saturates do.

- :func:`allan_deviation` is the wavelet-variance estimator for gappy series of Mondal & Percival ("Wavelet variance analysis for gappy time
  series", Ann. Inst. Stat. Math. 62, 2010) for the Haar wavelet, whose variance the Allan variance is. With the semivariogram of all pairs
  of samples that are there, ``V_k = ½⟨(x_{t+k} − x_t)²⟩``, it is ``σ²(m) = −Σ_{k=1}^{2m−1} r_k V_k / m²``, r being the autocorrelation of m
  times −1 and m times +1. It is unbiased for every noise of the table in :mod:`strapdown.allan`, whatever the gaps, and no sum of squares:
  where few pairs are left it may come out below zero (6 % of records of white noise at a tenth of the record, a fifth of it lost); the
  deviation is NaN there and its band unbounded. The band comes from simulated records of the same gaps and the power law at hand.
- :func:`fit_noise` fits one set of coefficients to the cosine transforms of the segments between gaps: the likelihood within each
  segment. The differences between the means of segments are not used, so that many short segments contain little information on a
  random walk. Without a gap it is :func:`strapdown.allan.fit_noise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks
from strapdown.allan.deviation import NOISE_TYPES, TERMS, AllanDeviation
from strapdown.allan.noise_fit import NoiseFit, fit_axis, misfit_of, of_axes
from strapdown.allan.spectrum import Bins, bin_starts, cosine_transform, last_coefficient, mean_power, ramp_coefficients
from strapdown.checks import Array, InputError

SHORTEST = 64
"""Samples of the shortest segment that a fit uses."""
SIMULATED = 1 << 12
"""Largest number of samples of a simulated record; several samples of a longer record are one there."""
RUNS = 400
"""Simulated records for each power law."""
WHOLE_RUNS = 50
"""The same of records longer than :data:`SIMULATED`, with all their samples."""


def allan_deviation(
    values: ArrayLike, sample_interval: float, *, taus: ArrayLike | None = None, level: float = 0.95, seed: int = 0
) -> AllanDeviation:
    """Return the Allan deviation of averaged samples with gaps (NaN), estimator ``"gaps"``, and its confidence band.

    By default at 12 averaging times a decade, up to a tenth of the record; NaN where too few pairs of samples are that far apart. The band
    comes from simulated records (``seed``).
    """
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    if not 0.5 < level < 1.0:
        raise InputError(f"level is {level:g}; a confidence lies between 0.5 and 1, for example 0.95")
    record, known = _record(values)
    samples = len(record)
    wanted = dt * _multiples(samples // 10) if taus is None else taus
    multiples = np.unique(np.rint(np.atleast_1d(checks.array("taus", wanted, (...,))) / dt).astype(np.int64))
    if len(multiples) == 0 or multiples[0] < 1 or multiples[-1] > samples // 2:
        raise InputError(
            f"taus must lie between {dt:g} s and {samples // 2 * dt:g} s, the sample interval and half the record"
        )
    pairs = _Pairs.of(known, int(multiples[-1]))
    variance = np.stack([pairs.variance(record[:, axis], multiples) for axis in range(record.shape[1])])
    grid = _multiples(min(samples // 10, int(multiples[-1])))
    alphas = np.stack([_power_laws(grid, pairs.variance(record[:, axis], grid)) for axis in range(record.shape[1])])
    alphas = alphas[:, np.clip(np.searchsorted(grid, multiples), 0, len(grid) - 1)]
    edf, low, high = _spread(known, multiples, alphas, level, seed)
    variance = np.where(variance > 0.0, variance, np.nan)
    deviation = np.sqrt(variance)
    return AllanDeviation(
        taus=np.asarray(multiples * dt),
        deviation=deviation,
        lower=np.nan_to_num(np.sqrt(variance / high), nan=0.0),
        upper=np.where((low > 0.0) & (variance > 0.0), np.sqrt(variance / np.where(low > 0.0, low, 1.0)), np.inf),
        edf=edf,
        noise_type=np.vectorize(NOISE_TYPES.__getitem__)(alphas),
        level=level,
        estimator="gaps",
        samples=int(known.sum()),
        sample_interval=dt,
    )


def _record(values: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Return samples (n, axes), zero where missing, and which are there."""
    record = checks.array("values", values, ("n",) if np.ndim(values) == 1 else ("n", "axes"), allow_nan=True)
    record = record[:, None] if record.ndim == 1 else record
    known = np.asarray(~np.isnan(record).any(axis=1))
    if known.sum() < 3:
        raise InputError(f"values has {int(known.sum())} samples that are present; an Allan deviation needs at least 3")
    return np.where(known[:, None], record, 0.0), known


class _Pairs(NamedTuple):
    """Pairs of samples that are there, by lag."""

    known: NDArray[np.bool_]
    size: int
    transform: NDArray[np.complex128]
    number: Array

    @classmethod
    def of(cls, known: NDArray[np.bool_], largest: int) -> _Pairs:
        from scipy.fft import irfft, next_fast_len, rfft

        size = int(next_fast_len(len(known) + 2 * largest, real=True))
        transform = rfft(known.astype(np.float64), size)
        return cls(known, size, transform, np.rint(irfft(np.abs(transform) ** 2, size)[: 2 * largest]))

    def variance(self, x: Array, multiples: NDArray[np.int64]) -> Array:
        """Return the Allan variance at each multiple of the sample interval; NaN where a lag has no pair."""
        from scipy.fft import irfft, rfft

        centred = np.where(self.known, x - x[self.known].mean(), 0.0)
        products = irfft(np.abs(rfft(centred, self.size)) ** 2, self.size)[: len(self.number)]
        squares = irfft(2.0 * (np.conj(rfft(centred**2, self.size)) * self.transform).real, self.size)[
            : len(self.number)
        ]
        with np.errstate(divide="ignore", invalid="ignore"):
            semivariogram = np.where(self.number > 0.0, (0.5 * squares - products) / self.number, np.nan)
        found = np.empty(len(multiples))
        for i, m in enumerate(multiples.tolist()):
            k = np.arange(1, 2 * m)
            correlation = np.where(k <= m, 2.0 * m - 3.0 * k, k - 2.0 * m)
            found[i] = -float(correlation @ semivariogram[1 : 2 * m]) / m**2
        return found


def _power_laws(multiples: NDArray[np.int64], variance: Array) -> NDArray[np.int64]:
    """Return the power law of the noise at each τ, a key of NOISE_TYPES, from the local slope of the Allan variance."""
    usable = np.flatnonzero(variance > 0.0)
    if len(usable) < 3:
        return np.zeros(len(multiples), np.int64)
    x, y = np.log(multiples[usable]), np.log(variance[usable])
    slopes = np.empty(len(usable))
    for i in range(len(usable)):
        near = np.abs(x - x[i]) <= np.log(3.0)
        slopes[i] = np.polyfit(x[near], y[near], 1)[0] if near.sum() > 2 else -1.0
    law = np.where(slopes < -1.5, 2, np.where(slopes < -0.5, 0, np.where(slopes < 0.5, -1, -2)))
    for i in range(1, len(law)):  # few averages show anything, and noises redden with τ
        law[i] = min(law[i], law[i - 1])
    return np.asarray(law[np.clip(np.searchsorted(usable, np.arange(len(multiples))), 0, len(usable) - 1)])


def _multiples(largest: int) -> NDArray[np.int64]:
    """Return averaging times in samples, 12 a decade up to the largest."""
    top = max(1, largest)
    return np.unique(np.rint(np.geomspace(1, top, 2 + int(12 * np.log10(top)))).astype(np.int64))


def _spread(
    known: NDArray[np.bool_], multiples: NDArray[np.int64], alphas: NDArray[np.int64], level: float, seed: int
) -> tuple[Array, Array, Array]:
    """Return how the estimator spreads over simulated records with the same gaps: degrees of freedom, low and high quantile over its mean.

    Of records longer than :data:`SIMULATED` the simulation with fewer samples gives the shape of the distribution (χ² below one of its
    samples), and a few records of all samples its variance: of white noise the estimator spreads more, at one share of the record, the
    more samples there are.
    """
    from scipy.stats import chi2

    coarse = max(1, -(-len(known) // SIMULATED))
    rows = len(known) // coarse
    there = known[: rows * coarse].reshape(rows, coarse).mean(axis=1) > 0.5
    if there.sum() < 3:
        raise InputError(
            "values has too few samples between its gaps for a confidence band; cut it to where it has more"
        )
    random = np.random.default_rng(seed)
    at = multiples / coarse
    usable = np.unique(np.clip(np.rint(at).astype(np.int64), 1, max(1, rows // 2 - 1)))
    pairs = _Pairs.of(there, int(usable[-1]))
    place = np.searchsorted(usable, np.clip(np.rint(at).astype(np.int64), usable[0], usable[-1]))
    whole = _Pairs.of(known, int(multiples[-1]))
    tail = 0.5 - 0.5 * level
    edf, low, high = (np.empty(alphas.shape) for _ in range(3))
    for law in np.unique(alphas).tolist():
        found = np.stack([pairs.variance(_noise(law, rows, random), usable) for _ in range(RUNS)])
        freedom, quantiles = _freedom(found)[place], np.quantile(found / found.mean(axis=0), [tail, 1.0 - tail], axis=0)
        more = freedom
        if coarse > 1:
            more = _freedom(
                np.stack([whole.variance(_noise(law, len(known), random), multiples) for _ in range(WHOLE_RUNS)])
            )
        wider = np.sqrt(freedom / more)
        ends = [
            np.where(at < 1.0, chi2.ppf(p, more) / more, 1.0 + wider * (quantiles[k][place] - 1.0))
            for k, p in enumerate((tail, 1.0 - tail))
        ]
        for target, values in ((edf, np.fmax(more, 1.0)), (low, ends[0]), (high, ends[1])):
            target[alphas == law] = np.broadcast_to(values, alphas.shape)[alphas == law]
    return edf, low, high


def _freedom(found: Array) -> Array:
    """Return the degrees of freedom of the χ² with the mean and variance of each column."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(2.0 * found.mean(axis=0) ** 2 / found.var(axis=0, ddof=1))


def _noise(alpha: int, samples: int, random: np.random.Generator) -> Array:
    """Return a record of a power law."""
    white = random.standard_normal(samples + 1)
    if alpha == 2:
        return np.asarray(np.diff(white))
    if alpha == 0:
        return white[1:]
    if alpha == -2:
        return np.cumsum(white[1:])
    from scipy.fft import irfft, rfft

    size = 2 * samples
    spectrum = rfft(random.standard_normal(size))
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    spectrum[0] = 0.0
    return np.asarray(irfft(spectrum, size)[:samples])


class _Stretch(NamedTuple):
    """One segment between gaps: its cosine coefficients, and their bins."""

    coefficient: Array
    starts: NDArray[np.int64]
    last: int
    basis: Array


def stretches(known: NDArray[np.bool_], shortest: int = SHORTEST) -> list[slice]:
    """Return the segments of samples between gaps, without those of fewer than ``shortest``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= shortest]


def fit_noise(
    values: ArrayLike,
    sample_interval: float,
    *,
    terms: Sequence[str] = TERMS,
    highest_frequency: float | None = None,
    level: float = 0.95,
) -> NoiseFit:
    """Return the noise coefficients of averaged samples with gaps (NaN), with intervals; options as :func:`strapdown.allan.fit_noise`.

    They come from the segments of at least :data:`SHORTEST` samples, which ``samples`` counts; ``misfit_probability`` is that of the worst
    segment, times their number.
    """
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    record, known = _record(values)
    places = stretches(known)
    if not places:
        raise InputError(f"values has no {SHORTEST} samples in a row without a gap; record with fewer gaps")
    chosen = tuple(term for term in TERMS if term in {checks.one_of("terms: term", term, TERMS) for term in terms})
    random_terms = tuple(term for term in chosen if term != "rate_ramp")
    if not random_terms:
        raise InputError("terms names no random noise; add one of quantization, angle_random_walk, …")
    fits, misfits = [], []
    for axis in range(record.shape[1]):
        parts = [_stretch(record[place, axis].copy(), dt, random_terms, highest_frequency) for place in places]
        each, whole = _bins(parts, dt)
        largest = float(np.abs(record[known, axis]).max())
        if not np.any(whole.square > (1e-13 * largest) ** 2 * whole.number):
            raise InputError(
                f"values, axis {axis}, holds no noise (it is constant or a straight line); pass a recorded sensor"
            )
        fit = fit_axis(whole, "rate_ramp" in chosen)
        fits.append(fit)
        found = []
        for part, bins, place in zip(parts, each, places, strict=True):
            best = fit.best._replace(variance=fit.best.theta @ bins.basis)
            probability, what = misfit_of(part.coefficient, bins, best, random_terms, part.starts, part.last, dt)
            found.append(
                (probability, what if len(places) == 1 else f"in the segment from {place.start * dt:.6g} s {what}")
            )
        least = min(found, key=lambda one: one[0])
        misfits.append((min(1.0, len(found) * least[0]), least[1]))
    samples = sum(place.stop - place.start for place in places)
    return of_axes(chosen, fits, misfits, level=level, samples=samples, sample_interval=dt)


def _stretch(x: Array, dt: float, random_terms: tuple[str, ...], highest_frequency: float | None) -> _Stretch:
    samples = len(x)
    last = last_coefficient(samples, dt, highest_frequency)
    if highest_frequency is not None and last < 1:
        raise InputError(
            f"highest_frequency is {highest_frequency:g} Hz: a segment of {samples} samples has nothing below; raise it"
        )
    starts = bin_starts(last)
    basis = np.stack([mean_power(term, samples, dt, starts, last) for term in random_terms])
    return _Stretch(cosine_transform(x, 1.0), starts, last, basis)


def _bins(parts: Sequence[_Stretch], dt: float) -> tuple[list[Bins], Bins]:
    """Return the sums over bins of each segment and of all, the lowest frequencies first; one ramp goes through all of them."""
    ramps = [dt * ramp_coefficients(len(p.coefficient), np.arange(1, p.last + 1)) for p in parts]
    slope = float(
        sum(r @ p.coefficient[1 : p.last + 1] for r, p in zip(ramps, parts, strict=True)) / sum(r @ r for r in ramps)
    )
    each, frequency = [], []
    for ramp, part in zip(ramps, parts, strict=True):
        rest = part.coefficient[1 : part.last + 1] - slope * ramp
        begin = part.starts - 1
        sums = [np.add.reduceat(one, begin) for one in (np.ones_like(rest), rest * rest, rest * ramp, ramp * ramp)]
        each.append(Bins(sums[0], sums[1], sums[2], sums[3], part.basis, slope))
        frequency.append(part.starts / len(part.coefficient))
    order = np.argsort(np.concatenate(frequency), kind="stable")
    number, square, product, ramps_squared = (np.concatenate([one[k] for one in each])[order] for k in range(4))
    basis = np.concatenate([one.basis for one in each], axis=1)[:, order]
    return each, Bins(number, square, product, ramps_squared, basis, slope)
