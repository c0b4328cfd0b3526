"""Allan deviation of a record with gaps: evenly spaced samples, missing ones NaN.

Gaps must not depend on the lost values: those of a lost packet do not, those of a saturated sensor do.

This is the wavelet-variance estimator for gappy series of Mondal & Percival ("Wavelet variance analysis for gappy time series", Ann. Inst.
Stat. Math. 62, 2010) for the Haar wavelet, whose wavelet variance is the Allan variance. With the semivariogram of all pairs of available
samples, ``V_k = ½⟨(x_{t+k} − x_t)²⟩``, it is ``σ²(m) = −Σ_{k=1}^{2m−1} r_k V_k / m²``, r being the autocorrelation of m times −1 and m
times +1. It is unbiased for every noise of the table in :mod:`strapdown.allan.deviation` and for any gaps, but not a sum of squares: with
few pairs it may be negative (6 % of records of white noise at a tenth of the record, a fifth of it lost); the deviation is then NaN and its
band unbounded. The band is computed from simulated records with the same gaps and power law.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks
from strapdown.allan.spectrum import inner
from strapdown.checks import Array, InputError

SIMULATED = 1 << 12
"""Maximum number of samples of a simulated record, which for longer records combines several samples into one."""
RUNS = 400
"""Number of simulated records for each power law."""
WHOLE_RUNS = 50
"""Number of simulated records with all samples, for records longer than :data:`SIMULATED`."""


class Deviation(NamedTuple):
    """Allan deviation (axes, k) at taus (k,), its confidence band, degrees of freedom and power laws; number of available samples."""

    taus: Array
    deviation: Array
    lower: Array
    upper: Array
    edf: Array
    alphas: NDArray[np.int64]
    samples: int


def allan_deviation(
    record: Array, dt: float, *, taus: ArrayLike | None = None, level: float = 0.95, seed: int = 0
) -> Deviation:
    """Return the Allan deviation of averaged samples with gaps (NaN), and its confidence band.

    By default at 12 averaging times per decade, up to a tenth of the record; NaN if too few pairs of samples have this spacing. The band is
    computed from simulated records (``seed``).
    """
    known = np.asarray(~np.isnan(record).any(axis=1))
    if known.sum() < 3:
        raise InputError(f"values has {int(known.sum())} samples that are not NaN; an Allan deviation needs at least 3")
    samples, record = len(record), np.where(known[:, None], record, 0.0)
    wanted = dt * spread_multiples(samples // 10) if taus is None else taus
    multiples = np.unique(np.rint(np.atleast_1d(checks.array("taus", wanted, (...,))) / dt).astype(np.int64))
    if len(multiples) == 0 or multiples[0] < 1 or multiples[-1] > samples // 2:
        raise InputError(
            f"taus must lie between {dt:g} s and {samples // 2 * dt:g} s, the sample interval and half the record"
        )
    pairs = _Pairs.of(known, int(multiples[-1]))
    variance = np.stack([pairs.variance(record[:, axis], multiples) for axis in range(record.shape[1])])
    grid = spread_multiples(min(samples // 10, int(multiples[-1])))
    alphas = np.stack([_power_laws(grid, pairs.variance(record[:, axis], grid)) for axis in range(record.shape[1])])
    alphas = alphas[:, np.clip(np.searchsorted(grid, multiples), 0, len(grid) - 1)]
    edf, low, high = _spread(known, multiples, alphas, level, seed)
    variance = np.where(variance > 0.0, variance, np.nan)
    deviation = np.sqrt(variance)
    return Deviation(
        taus=np.asarray(multiples * dt),
        deviation=deviation,
        lower=np.nan_to_num(np.sqrt(variance / high), nan=0.0),
        upper=np.where((low > 0.0) & (variance > 0.0), np.sqrt(variance / np.where(low > 0.0, low, 1.0)), np.inf),
        edf=edf,
        alphas=alphas,
        samples=int(known.sum()),
    )


class _Pairs(NamedTuple):
    """Pairs of available samples, by lag."""

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
        """Return the Allan variance at each multiple of the sample interval; NaN if a lag has no pair."""
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
            found[i] = -inner(correlation, semivariogram[1 : 2 * m]) / m**2
        return found


def _power_laws(multiples: NDArray[np.int64], variance: Array) -> NDArray[np.int64]:
    """Return the power law of the noise at each τ, the exponent of f in the PSD of the rate, from the local slope of the Allan variance."""
    usable = np.flatnonzero(variance > 0.0)
    if len(usable) < 3:
        return np.zeros(len(multiples), np.int64)
    x, y = np.log(multiples[usable]), np.log(variance[usable])
    slopes = np.empty(len(usable))
    for i in range(len(usable)):
        near = np.abs(x - x[i]) <= np.log(3.0)
        slopes[i] = np.polyfit(x[near], y[near], 1)[0] if near.sum() > 2 else -1.0
    law = np.where(slopes < -1.5, 2, np.where(slopes < -0.5, 0, np.where(slopes < 0.5, -1, -2)))
    for i in range(1, len(law)):  # the exponent of sensor noise decreases with τ, and few averages are uncertain
        law[i] = min(law[i], law[i - 1])
    return np.asarray(law[np.clip(np.searchsorted(usable, np.arange(len(multiples))), 0, len(usable) - 1)])


def spread_multiples(largest: int) -> NDArray[np.int64]:
    """Return averaging times in samples, 12 per decade up to the largest."""
    top = max(1, largest)
    return np.unique(np.rint(np.geomspace(1, top, 2 + int(12 * np.log10(top)))).astype(np.int64))


def _spread(
    known: NDArray[np.bool_], multiples: NDArray[np.int64], alphas: NDArray[np.int64], level: float, seed: int
) -> tuple[Array, Array, Array]:
    """Return degrees of freedom, and low and high quantile over the mean, of the estimator for simulated records with the same gaps.

    For records longer than :data:`SIMULATED`, the simulation with fewer samples gives the shape of the distribution (χ² below one of its
    samples), and a few records with all samples its variance: for white noise and τ at a given fraction of the record, the relative
    variance of the estimator increases with the number of samples.
    """
    from scipy.stats import chi2

    coarse = max(1, -(-len(known) // SIMULATED))
    rows = len(known) // coarse
    there = known[: rows * coarse].reshape(rows, coarse).mean(axis=1) > 0.5
    if there.sum() < 3:
        raise InputError(
            "values has too few samples between its gaps for a confidence band; cut it to a part with fewer gaps"
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
    """Return the degrees of freedom of the χ² distribution with the mean and variance of each column."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(2.0 * found.mean(axis=0) ** 2 / found.var(axis=0, ddof=1))


def _noise(alpha: int, samples: int, random: np.random.Generator) -> Array:
    """Return a simulated record of a power law."""
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
