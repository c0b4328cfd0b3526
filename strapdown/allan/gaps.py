"""Allan deviation of a record with gaps: evenly spaced samples, missing ones NaN.

Gaps must not depend on the lost values: those of a lost packet do not, those of a saturated sensor do.

This is the wavelet-variance estimator for gappy series of Mondal & Percival ("Wavelet variance analysis for gappy time series", Ann. Inst.
Stat. Math. 62, 2010) for the Haar wavelet, whose wavelet variance is the Allan variance: with the mean ``D_ij`` of the squared difference
of places i and j over all windows of 2m samples that have both, ``σ²(m) = −¼ Σ h_i h_j D_ij``, h being −1/m and then 1/m. It is unbiased
for every noise of the table in :mod:`strapdown.allan.deviation` and any gaps. Without gaps it is the overlapping estimator; with them it is
not a sum of squares: with few windows it may be negative; the deviation is then NaN and its band unbounded.

For more than :data:`DIRECT` samples the record is first averaged over blocks, 8 to 15 for each τ; with more the scatter is larger. If
nearly all samples are in complete blocks, only these are used. Otherwise a block of which at least half is known has the mean of that,
whose variance about that of the whole block is subtracted, s²(1/c − 1/q) for c of q samples with variance s² in a block: right for samples
lost at random, but not for quantisation noise whose samples are lost in bursts. The band is computed from simulated records with the same
gaps and power law.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks
from strapdown.allan.power_laws import MANY_BLOCKS, equivalent_degrees_of_freedom, power_law
from strapdown.checks import Array, InputError
from strapdown.kernels.allan import variance_of_pairs
from strapdown.kernels.machine import compiled, read_only

DIRECT = 16
"""Maximum number of samples of an averaging time for which the record is not averaged over blocks."""

SIMULATED = 1 << 11
"""Maximum number of samples of a simulated record, which for longer records combines several samples into one."""

FINEST = 4
"""Minimum number of samples of an averaging time in a simulation that combines several samples into one."""

RUNS = 400
"""Number of simulated records for each power law."""


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
    samples, record = len(record), record.T
    wanted = dt * spread_multiples(samples // 10) if taus is None else taus
    multiples = np.rint(np.atleast_1d(checks.array("taus", wanted, (...,))) / dt).astype(np.int64)
    if len(multiples) == 0 or multiples.min() < 1 or multiples.max() > samples // 2:
        raise InputError(
            f"taus must lie between {dt:g} s and {samples // 2 * dt:g} s, the sample interval and half the record"
        )
    multiples = np.unique([math.prod(_blocks(m)) for m in multiples.tolist()])
    centred = np.where(known, record - record[:, known].mean(axis=1)[:, None], 0.0)
    variance = _variances(centred, known, multiples)
    alphas = np.array([_power_laws(one, multiples) for one in np.where(known, record, np.nan)])
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


def _blocks(m: int) -> tuple[int, int]:
    """Return number and size of the blocks that make up m samples, or up to 6 % less."""
    return (m, 1) if m <= DIRECT else max(((k, m // k) for k in range(8, 16)), key=math.prod)


def _variances(x: Array, known: NDArray[np.bool_], multiples: NDArray[np.int64]) -> Array:
    """Return the Allan variance (s, k) of each series of x (s, n), 0 where not known, at each multiple of the sample interval."""
    found = np.empty((len(multiples), len(x)))
    for row, m in zip(found, multiples.tolist(), strict=True):
        half, size = _blocks(m)
        values, excess, there = map(read_only, _averaged(x, known, size))
        sums, counts = np.empty((2, len(there) + 1))
        compiled(variance_of_pairs)(values, excess, there, half, sums, counts, row)
    return found.T


def _averaged(x: Array, known: NDArray[np.bool_], size: int) -> tuple[Array, Array, Array]:
    """Return averages over blocks, what the variance of each exceeds that of the whole block by, and 1 for known ones, else 0."""
    if size == 1:
        return x, np.zeros(x.shape), known.astype(np.float64)
    whole = len(known) // size * size
    count = known[:whole].reshape(-1, size).sum(axis=1)
    parts = x[:, :whole].reshape(len(x), -1, size)
    complete = count == size
    there = complete if size * complete.sum() >= 0.85 * known.sum() else 2 * count >= size
    number = np.where(there, count, size)
    mean = parts.sum(axis=2) / number
    if there is complete:
        return mean, np.zeros(mean.shape), there.astype(np.float64)
    squares = np.einsum("ijk,ijk->ij", parts, parts) - number * mean**2
    within = np.sum(squares[:, there], axis=1, keepdims=True) / max(1, np.sum(count[there] - 1))
    return mean, within * (1.0 / number - 1.0 / size), there.astype(np.float64)


def _power_laws(x: Array, multiples: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the power law of the noise of one axis at each multiple of the sample interval; missing samples are NaN."""
    laws, alpha = [], 0
    for m in (max(1, min(int(multiples[0]), len(x) // MANY_BLOCKS)), *multiples.tolist()):
        parts = x[: len(x) // m * m].reshape(-1, m)
        count = np.isfinite(parts).sum(axis=1)
        means = np.nansum(parts, axis=1) / np.where(2 * count >= m, count, np.nan)
        alpha = power_law(means, alpha)
        laws.append(alpha)
    return np.array(laws[1:])


def spread_multiples(largest: int) -> NDArray[np.int64]:
    """Return averaging times in samples, 12 per decade up to the largest."""
    top = max(1, largest)
    return np.unique(np.rint(np.geomspace(1, top, 2 + int(12 * np.log10(top)))).astype(np.int64))


def _spread(
    known: NDArray[np.bool_], multiples: NDArray[np.int64], alphas: NDArray[np.int64], level: float, seed: int
) -> tuple[Array, Array, Array]:
    """Return degrees of freedom, and low and high quantile over the mean, of the estimator for simulated records with the same gaps.

    A simulation of a longer record combines several samples into one. Its degrees of freedom are to those of the record as they are without
    gaps; below :data:`FINEST` of its samples the distribution is χ².
    """
    from scipy.stats import chi2

    coarse = max(1, -(-len(known) // SIMULATED))
    parts = known[: len(known) // coarse * coarse].reshape(-1, coarse).mean(axis=1)
    there = parts > 0.5
    if there.sum() < 3:
        raise InputError(
            "values has too few samples between its gaps for a confidence band; cut it to a part with fewer gaps"
        )
    finest = FINEST if coarse > 1 else 1
    largest = max(1, len(there) // 2)
    usable = np.array([math.prod(_blocks(min(max(round(m / coarse), finest), largest))) for m in multiples.tolist()])
    simulated, place = np.unique(usable, return_inverse=True)
    tail = 0.5 - 0.5 * level
    edf, low, high = (np.empty(alphas.shape) for _ in range(3))
    random = np.random.default_rng(seed)
    for law in np.unique(alphas).tolist():
        found = _variances(_noise(law, (RUNS, len(there)), random) * there, there, simulated)
        quantiles = np.quantile(found / found.mean(axis=0), [tail, 1.0 - tail], axis=0)[:, place]
        scale = np.ones(len(multiples))
        if coarse > 1:
            scale = _without_gaps(law, len(known), multiples) / _without_gaps(law, len(there), usable)
            if law == 0:  # white noise is that of the known samples in a block
                scale *= np.mean(parts[there] ** 2)
        freedom = _freedom(found)[place] * scale
        ends = [
            np.where(
                (coarse > 1) & (multiples < finest * coarse),
                chi2.ppf(p, freedom) / freedom,
                1.0 + (q - 1.0) / np.sqrt(scale),
            )
            for p, q in zip((tail, 1.0 - tail), quantiles, strict=True)
        ]
        for target, values in ((edf, np.fmax(freedom, 1.0)), (low, ends[0]), (high, ends[1])):
            target[alphas == law] = np.broadcast_to(values, alphas.shape)[alphas == law]
    return edf, low, high


def _without_gaps(law: int, samples: int, multiples: NDArray[np.int64]) -> Array:
    """Return the degrees of freedom of a record without gaps at each multiple of the sample interval."""
    return np.array([equivalent_degrees_of_freedom(law, samples, m) for m in multiples.tolist()])


def _freedom(found: Array) -> Array:
    """Return the degrees of freedom of the χ² distribution with the mean and variance of each column."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(2.0 * found.mean(axis=0) ** 2 / found.var(axis=0, ddof=1))


def _noise(alpha: int, shape: tuple[int, int], random: np.random.Generator) -> Array:
    """Return simulated records (runs, samples) of a power law."""
    runs, samples = shape
    white = random.standard_normal((runs, samples + 1))
    if alpha == 2:
        return np.asarray(np.diff(white))
    if alpha == 0:
        return white[:, 1:]
    if alpha == -2:
        return np.cumsum(white[:, 1:], axis=1)
    from scipy.fft import irfft, rfft

    size = 2 * samples
    spectrum = rfft(random.standard_normal((runs, size)))
    spectrum[:, 1:] *= np.arange(1, size // 2 + 1) ** (0.5 * alpha)
    spectrum[:, 0] = 0.0
    return np.asarray(irfft(spectrum, size)[:, :samples])
