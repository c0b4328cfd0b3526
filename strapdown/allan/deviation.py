"""Overlapping Allan deviation of a gyro record at rest, with χ² confidence bands.

Noise terms and the Allan variance σ²(τ) of samples that average the rate over the sample interval (exact at every τ; bias: the
minimum):

============  ======================  =============  ==========================================================================
term          two-sided PSD of rate   σ²(τ)          unit
============  ======================  =============  ==========================================================================
quantization  (2π f)² Q² dt           3 Q²/τ²        rad; white error of the integrated angle at each sample, standard deviation Q
angle         N²                      N²/τ           rad/√s
bias          B²/(2π f)               (2 ln 2/π) B²  rad/s; flicker up to the Nyquist frequency, see :func:`flicker_variance`
rate          K²/(2π f)²              K² τ/3         rad/s/√s
ramp          deterministic R t       R² τ²/2        rad/s²
============  ======================  =============  ==========================================================================

Sources: IEEE Std 952-1997 annex C; NIST SP 1065 (Riley 2008).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks, recordings
from strapdown.allan.power_laws import MANY_BLOCKS, NOISE_TYPES, equivalent_degrees_of_freedom, power_law
from strapdown.allan.spectrum import flicker_covariance, inner
from strapdown.checks import Array, InputError
from strapdown.kernels.allan import accumulate, second_difference_squares
from strapdown.kernels.machine import compiled, read_only
from strapdown.records import ImuRecord, Recording
from strapdown.results import Column, Listed, Table

Source = Recording | ImuRecord | recordings.GyroSamples | ArrayLike
"""Samples of a sensor at rest."""

TERMS = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk", "rate_ramp")
"""The noise terms, in the order of every array over terms; also the names of the gyro specification."""

_MAX_BLOCKS = 1 << 17

MIN_SHARE = 0.7
"""Minimum share of the samples of an average that must be there, in a record with gaps."""

_FLICKER_SUM_LIMIT = 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class AllanDeviation(Listed):
    """Allan deviation of a record with its confidence band.

    Attributes
    ----------
    taus : ndarray (t,)
        Averaging times τ, s.
    deviation : ndarray (axes, t)
        Deviation, rad/s.
    lower, upper : ndarray (axes, t)
        Confidence band, rad/s.
    edf : ndarray (axes, t)
        Equivalent degrees of freedom of the squared deviation.
    noise_type : ndarray of str (axes, t)
        A value of :data:`NOISE_TYPES`, found from the lag-1 autocorrelation at each τ.
    confidence_level : float
        Confidence of the band, pointwise.
    samples : int
        Number of samples of the record.
    sample_interval : float
        Sample interval, s.
    """

    taus: Array
    deviation: Array
    lower: Array
    upper: Array
    edf: Array
    noise_type: NDArray[np.str_]
    confidence_level: float
    samples: int
    sample_interval: float

    def listing(self) -> Table:
        """Return the deviation at averaging times about a factor of three apart, SI, as a table."""
        wanted = np.geomspace(self.taus[0], self.taus[-1], 2 + round(2.0 * math.log10(self.taus[-1] / self.taus[0])))
        places = np.unique([int(np.argmin(np.abs(np.log(self.taus / tau)))) for tau in wanted])
        axes = "xyz"[: len(self.deviation)]
        rows = [(self.taus[i], *(axis[i] for axis in self.deviation), float(np.min(self.edf[:, i]))) for i in places]
        title = f"Allan deviation, {self.samples} samples of {self.sample_interval:.6g} s, SI"
        return Table(title, ("τ, s", *axes, Column("degrees of freedom", digits=3)), rows, left=0)


def allan_deviation(
    source: Source,
    sample_interval: float | None = None,
    *,
    sensor: str = "gyro",
    kind: str = "rate",
    taus: ArrayLike | None = None,
    confidence_level: float = 0.95,
) -> AllanDeviation:
    """Return the Allan deviation of a sensor at rest, with its confidence band.

    Parameters
    ----------
    source : Recording, ImuRecord, GyroSamples or array_like (n,) or (n, axes)
        Samples at rest; in an array averages over each sample interval or integrals, at most three axes. Missing samples are NaN.
    sample_interval : float, optional
        For an array: time between its samples, s.
    sensor : {"gyro", "accelerometer", "magnetometer"}, default "gyro"
        For a recording: the sensor.
    kind : {"rate", "increments"}, default "rate"
        For an array: averages over each sample interval, rad/s, or integrals, rad.
    taus : array_like, optional
        Averaging times, s, each rounded to a multiple of the sample interval; duplicates are dropped. Default: 12 per decade, up to a
        third of the record, with gaps to a tenth.
    confidence_level : float, default 0.95
        Confidence of the band, 0.5 to 1.

    Returns
    -------
    AllanDeviation
        Deviation at each averaging time and axis, in the unit of the samples (increments: that unit per s), and its confidence band.

    Notes
    -----
    The overlapping estimator, equal to ``allantools.oadev``.

    With gaps (NaN), pairs of neighbouring averages count that have 70 % of their samples each; the degrees of freedom are reduced by the
    share of these pairs. For white noise, whose averages over fewer samples are larger, the squares are weighted. The bias of the variance
    is below 4 % for white noise and random walk, and below 10 % for quantisation noise cut by long gaps; if single samples are lost,
    quantisation noise appears white. Gaps must not depend on the lost values: those of a lost packet do not, those of a saturated sensor
    do.

    The phase is the sum of the rate less its mean, in float64 with compensated summation, so that each value is rounded once (½ unit in the
    last place of the largest phase), also after 1e8 samples. Memory: one float64 per sample in addition to the record, one axis at a time.
    Time: proportional to the number of samples for each τ.

    Examples
    --------
    >>> import numpy as np
    >>> import strapdown as sd
    >>> white = np.random.default_rng(1).standard_normal(100_000)
    >>> result = sd.allan_deviation(white, 0.01, taus=[1.0])
    >>> round(float(result.deviation[0, 0]), 2)  # σ √(dt/τ)
    0.1
    """
    record, dt, scale = averaged(source, sample_interval, sensor, kind)
    confidence_level = confidence(confidence_level)
    known = ~np.isnan(record).any(axis=1)
    samples = int(known.sum())
    if samples < 3:
        raise InputError(f"values has {samples} samples that are not NaN; an Allan deviation needs at least 3")
    counts = None if known.all() else np.concatenate([[0], np.cumsum(known)])
    multiples = _multiples(taus, len(record), dt, gaps=counts is not None)
    axes = [_of_axis(record[:, axis], multiples, counts) for axis in range(record.shape[1])]
    deviation, edf, alphas = (np.array(part) for part in zip(*axes, strict=True))
    deviation *= scale
    from scipy.stats import chi2

    return AllanDeviation(
        taus=np.asarray(multiples * dt),
        deviation=deviation,
        lower=deviation * np.sqrt(edf / chi2.ppf(0.5 + 0.5 * confidence_level, edf)),
        upper=deviation * np.sqrt(edf / chi2.ppf(0.5 - 0.5 * confidence_level, edf)),
        edf=edf,
        noise_type=np.vectorize(NOISE_TYPES.__getitem__)(alphas),
        confidence_level=confidence_level,
        samples=samples,
        sample_interval=dt,
    )


def _of_axis(
    rate: Array, multiples: NDArray[np.int64], counts: NDArray[np.int64] | None
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return deviation, degrees of freedom and power law of one axis at each multiple of the sample interval.

    ``counts`` is the number of samples that are there before each edge (n + 1,); None: all.
    """
    samples, phase = len(rate), np.empty(len(rate) + 1)
    mean = float(np.mean(rate) if counts is None else np.nanmean(rate))
    compiled(accumulate)(read_only(rate if counts is None else np.nan_to_num(rate, nan=mean)), mean, phase)
    # If the first τ has few averages, the power law before it is that of the longest τ with many.
    alpha = _power_law(phase, counts, max(1, min(int(multiples[0]), samples // MANY_BLOCKS)), 0)
    alphas, edf = np.empty(len(multiples), np.int64), np.empty(len(multiples))
    for i, m in enumerate(multiples.tolist()):
        alpha = alphas[i] = _power_law(phase, counts, m, alpha)
        edf[i] = equivalent_degrees_of_freedom(alpha, samples, m)
    if counts is None:
        return _deviation(phase, multiples), edf, alphas
    laws = zip(multiples.tolist(), alphas.tolist(), strict=True)
    deviation, share = np.array([_deviation_with_gaps(phase, counts, m, alpha) for m, alpha in laws]).T
    return deviation, np.maximum(edf * share, 1.0), alphas


def _deviation(phase: Array, multiples: NDArray[np.int64]) -> Array:
    """Return the deviation of one axis at each multiple of the sample interval."""
    squares = np.empty(len(multiples))
    compiled(second_difference_squares)(phase, multiples, np.empty(512), np.empty(len(multiples)), squares)
    return np.asarray(np.sqrt(squares / (2.0 * (len(phase) - 2 * multiples))) / multiples)


def _deviation_with_gaps(phase: Array, counts: NDArray[np.int64], m: int, alpha: int) -> tuple[float, float]:
    """Return the deviation over m samples, NaN if too many are missing, and the share of the pairs of averages from which it is."""
    number = counts[m:] - counts[:-m]
    most = number >= MIN_SHARE * m
    used = most[:-m] & most[m:]
    if not used.any():
        return math.nan, 0.0
    mean = (phase[m:] - phase[:-m]) / np.maximum(number, 1)
    squares = (mean[m:] - mean[:-m])[used] ** 2
    if alpha == 0:  # white noise of fewer samples is larger
        squares *= 2.0 / (m * (1.0 / number[:-m][used] + 1.0 / number[m:][used]))
    return math.sqrt(0.5 * float(np.mean(squares))), float(np.mean(used))


def _power_law(phase: Array, counts: NDArray[np.int64] | None, m: int, otherwise: int) -> int:
    """Return the power law of the rate averaged over m samples; if there are very many averages, only the middle of the record is used."""
    spare = max(0, len(phase[::m]) - _MAX_BLOCKS) // 2
    middle = slice(spare, spare + _MAX_BLOCKS)
    means = np.diff(phase[::m][middle])
    if counts is not None:
        number = np.diff(counts[::m][middle])
        means = means / np.where(number >= MIN_SHARE * m, number, np.nan)
    return power_law(means, otherwise)


def flicker_variance(multiples: ArrayLike) -> Array:
    """Return the exact Allan variance, divided by B², of samples with the two-sided PSD B²/(2π f) up to the Nyquist frequency.

    ``∫ (4/(2π f)) sin⁴(π f m)/(m sin π f)² df`` over f in (0, ½), as a sum over the autocovariance −Cin(π k)/π of the samples. It converges
    to 2 ln 2/π as 1/m² from above (to 1e-7 at m = 4096, beyond which the limit is returned); at one sample it is 19 % larger.
    """
    m_all = np.atleast_1d(checks.array("multiples", multiples, (...,)))
    limit = int(min(m_all.max(initial=1.0), _FLICKER_SUM_LIMIT))
    covariance = flicker_covariance(2 * limit + 1)
    result = np.empty(m_all.shape)
    for index, m_float in np.ndenumerate(m_all):
        m = int(m_float)
        if m < 1:
            raise InputError(f"multiples holds {m_float:g}; an averaging time is at least one sample")
        if m > _FLICKER_SUM_LIMIT:
            result[index] = 2.0 * math.log(2.0) / math.pi
        else:
            lag = np.arange(1 - m, m)
            weight = m - np.abs(lag)
            result[index] = inner(weight, covariance[np.abs(lag)] - covariance[lag + m]) / m**2
    return result


def model_deviation(parameters: Mapping[str, float], taus: ArrayLike, sample_interval: float) -> dict[str, Array]:
    """Return the Allan deviation (t,), rad/s, of each noise term and of their sum, ``"total"``, at ``taus``, s."""
    checks.known_keys("parameters", parameters, TERMS)
    tau = checks.array("taus", taus, ("t",))
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    shape = {
        "quantization": 3.0 / tau**2,
        "angle_random_walk": 1.0 / tau,
        "bias_instability": flicker_variance(np.maximum(np.round(tau / dt), 1.0)),
        "rate_random_walk": tau / 3.0,
        "rate_ramp": 0.5 * tau**2,
    }
    variance = {term: checks.finite(term, value) ** 2 * shape[term] for term, value in parameters.items()}
    total = np.sum(list(variance.values()), axis=0) if variance else np.zeros(len(tau))
    return {term: np.sqrt(value) for term, value in {**variance, "total": total}.items()}


def confidence(confidence_level: float) -> float:
    """Return a confidence level, checked."""
    number = checks.positive("confidence_level", confidence_level)
    if not 0.5 < number < 1.0:
        raise InputError(f"confidence_level is {number:g}; a confidence must be between 0.5 and 1, for example 0.95")
    return number


def averaged(source: Source, sample_interval: float | None, sensor: str, kind: str) -> tuple[Array, float, float]:
    """Return the samples (n, axes), NaN for missing ones, their interval, and the factor that converts their values to rates."""
    if isinstance(source, (Recording, ImuRecord)):
        source = recordings.samples_of(source, sensor)
    if isinstance(source, recordings.GyroSamples):
        if sample_interval is not None:
            raise InputError("sample_interval goes with an array; a recording has its own: leave it out")
        sample_interval, kind, source = source.sample_interval, source.kind, source.values
    if sample_interval is None:
        raise InputError("sample_interval is missing; for an array, give the time between its samples in s")
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    checks.one_of("kind", kind, ("rate", "increments"))
    record = checks.array("values", source, ("n",) if np.ndim(source) == 1 else ("n", "axes"), allow_nan=True)
    if record.ndim == 1:
        record = record[:, None]
    if not 1 <= record.shape[1] <= 3:
        raise InputError(
            f"values has {record.shape[1]} axes; pass (n,) or (n, axes) with one to three axes (transpose it?)"
        )
    if len(record) < 3:
        raise InputError(f"values has {len(record)} samples; an Allan deviation needs at least 3")
    return record, dt, 1.0 if kind == "rate" else 1.0 / dt


def _multiples(taus: ArrayLike | None, samples: int, dt: float, *, gaps: bool) -> NDArray[np.int64]:
    """Return averaging times in samples; by default 12 per decade."""
    if taus is None:
        top = max(1, samples // (10 if gaps else 3))
        return np.unique(np.rint(np.geomspace(1, top, 2 + int(12 * np.log10(top)))).astype(np.int64))
    wanted = np.atleast_1d(checks.array("taus", taus, (...,))).ravel()
    multiples = np.round(wanted / dt)
    for tau, m in zip(wanted, multiples, strict=True):
        if not 1 <= m <= samples // 2:
            raise InputError(
                f"taus holds {tau:g} s; with {samples} samples of {dt:g} s it must be between {dt:g} s and {samples // 2 * dt:g} s"
            )
    if len(multiples) == 0:
        raise InputError("taus is empty; leave it out for the default")
    return np.unique(multiples.astype(np.int64))
