"""Allan variance of a gyro record at rest, and identification of its noises.

Two views of one record:

- :func:`allan_deviation` is the picture: the overlapping, a robust, the modified Allan or the Hadamard deviation with χ² confidence
  bands.
- :func:`fit_noise` is the estimator: quantisation Q, angle random walk N, bias instability B, rate random walk K and rate ramp R by
  maximum likelihood on the cosine transform of the record, with profile-likelihood intervals.

Why not least squares on the Allan deviation: its values at neighbouring τ share nearly all their data, so their errors are strongly
correlated, and at long τ, which alone contains K and R, they are far from Gaussian. The cosine (DCT-II) coefficients of
averaged-rate samples are independent and Gaussian instead, exactly for angle and rate random walk, which a DCT diagonalises, and
nearly for flicker and quantisation, whose exact variances are used; the Allan variance is a smoothing of their squares and holds no
more. So no covariance between taus has to be modelled, and the intervals are those of a likelihood.

The noises, with the Allan variance σ²(τ) of samples that average the rate over the sample interval (exact at every τ; bias: the
floor):

============  ======================  =============  ==========================================================================
term          two-sided PSD of rate   σ²(τ)          unit
============  ======================  =============  ==========================================================================
quantization  (2π f)² Q² dt           3 Q²/τ²        rad; white error of the integrated angle at each sample, standard deviation Q
angle         N²                      N²/τ           rad/√s
bias          B²/(2π f)               (2 ln 2/π) B²  rad/s; flicker up to the Nyquist frequency, see :func:`flicker_variance`
rate          K²/(2π f)²              K² τ/3         rad/s/√s
ramp          deterministic R t       R² τ²/2        rad/s²
============  ======================  =============  ==========================================================================

Quantisation is white only while successive angles differ by noise or motion of about half a step or more; below that its error
follows the motion, no coefficient describes it, and ``NoiseFit.misfit_probability`` approaches zero.

Sources: IEEE Std 952-1997 annex C; NIST SP 1065 (Riley 2008); Greenhall & Riley, "Uncertainty of stability variances based on
finite differences", PTTI 2003; Riley & Greenhall, "Power law noise identification using the lag 1 autocorrelation", EFTF 2004.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks, units
from strapdown.checks import Array, InputError
from strapdown.kernels.allan import accumulate, second_difference_sizes, second_difference_squares
from strapdown.kernels.machine import compiled, read_only
from strapdown.results import Listed, Listing, figure

TERMS = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk", "rate_ramp")
"""The noise terms, in the order of every array over terms; also the names of the gyro specification."""

NOISE_TYPES = {
    2: "quantization",
    1: "flicker angle",
    0: "angle random walk",
    -1: "bias instability",
    -2: "rate random walk",
}
"""Name of each power law: the PSD of the rate goes as f to the key."""

SYMBOLS = dict(zip(TERMS, "QNBKR", strict=True))
UNITS = {
    "quantization": ("arcsec", units.ARCSECOND),
    "angle_random_walk": ("°/√h", units.DEGREE_PER_ROOT_HOUR),
    "bias_instability": ("°/h", units.DEGREE_PER_HOUR),
    "rate_random_walk": ("°/h/√h", units.DEGREE_PER_HOUR_PER_ROOT_HOUR),
    "rate_ramp": ("°/h/h", units.DEGREE_PER_HOUR / 3600.0),
}
"""Unit at the rim and its factor to SI, for each term."""

SUPPORT_PROBABILITY = 1e-3
"""A term is supported if its likelihood ratio would occur by chance, in a record without it, with less than this probability."""

MISFIT_PROBABILITY = 1e-3
"""Value of ``NoiseFit.misfit_probability`` below which the record contains more than the noises."""

ESTIMATORS = {
    "overlapping": "overlapping Allan deviation, OADEV",
    "robust": "Allan deviation by the median of second differences",
    "modified": "modified Allan deviation, MDEV: of the angle averaged over τ, which parts quantisation from flicker of the angle",
    "hadamard": "overlapping Hadamard deviation, HDEV: by third differences of the angle, which do not see a rate ramp",
}
"""Estimators of :func:`allan_deviation`."""

_MEDIAN_OF_NORMAL = 0.6744897501960817  # Φ⁻¹(3/4): median of |z|, z standard normal
_MEDIAN_EFFICIENCY = (
    0.3675  # of the median of |z| against the mean square, independent normal data: 8 (z φ(z))², z = Φ⁻¹(3/4)
)
_FEWEST_BLOCKS = 30  # below this the lag-1 autocorrelation says little (SP 1065, §5.5.6)
_MANY_BLOCKS = 128  # its scatter is then well below what moves the power law by one half
_MAX_BLOCKS = 1 << 17
_STRETCH = 1 << 16
_BIN_GROWTH = 1.05
_LARGEST_EXACT = 1 << 16
_STRETCHES = 64
_FLICKER_SUM_LIMIT = 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class AllanDeviation(Listed):
    """Allan, modified Allan or Hadamard deviation of a record with its confidence band.

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
    level : float
        Confidence of the band, pointwise.
    estimator : str
        Key of :data:`ESTIMATORS`.
    samples : int
        Samples of the record.
    sample_interval : float
        Sample interval, s.
    """

    taus: Array
    deviation: Array
    lower: Array
    upper: Array
    edf: Array
    noise_type: NDArray[np.str_]
    level: float
    estimator: str
    samples: int
    sample_interval: float

    def listing(self) -> Listing:
        """Return the deviation at averaging times about a factor of three apart, SI, as a table."""
        wanted = np.geomspace(self.taus[0], self.taus[-1], 2 + round(2.0 * math.log10(self.taus[-1] / self.taus[0])))
        places = np.unique([int(np.argmin(np.abs(np.log(self.taus / tau)))) for tau in wanted])
        axes = "xyz"[: len(self.deviation)]
        rows = [
            (
                figure(self.taus[i]),
                *(figure(one[i]) for one in self.deviation),
                figure(float(np.min(self.edf[:, i])), 3),
            )
            for i in places
        ]
        title = f"Allan deviation ({self.estimator}), {self.samples} samples of {self.sample_interval:.6g} s, SI"
        return Listing(title, ("τ, s", *axes, "degrees of freedom"), rows, left=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseFit(Listed):
    """Noise coefficients of a record, SI units.

    Attributes
    ----------
    terms : tuple of str
        Terms fitted, a subset of :data:`TERMS`; they index the last axis below.
    estimate : ndarray (axes, terms)
        Coefficients; NaN where the record does not support the term.
    lower, upper : ndarray (axes, terms)
        Two-sided interval of confidence ``level``. Where the term is not supported ``lower`` is 0 and ``upper`` the upper end of
        that interval (for the ramp: a bound on its size), so that the pair covers the truth at least as often as ``level`` whether
        or not the term is supported; a looser bound there would fail where the threshold of support selects the low estimates.
    supported : ndarray of bool (axes, terms)
        Whether the record supports the term.
    covariance : ndarray (axes, terms, terms)
        Covariance of the estimates, from the Fisher information; NaN for unsupported terms.
    misfit_probability : ndarray (axes,)
        Probability that a record of the fitted noises departs as far from them, by the most significant of three tests: its
        spectrum, its largest sample and its noise by segments, the last two after whitening. Near zero the record contains
        something else (motion, a vibration line, a low-pass filter, outliers, a Gauss–Markov bias), and the intervals do not hold.
    misfit : tuple of str
        What that test found and when, for each axis.
    level : float
        Confidence of the intervals.
    samples : int
        Samples of the record.
    sample_interval : float
        Sample interval, s.
    sensor : {"gyro", "accelerometer", "magnetometer"}, default "gyro"
        Sensor, for its units in print.
    """

    terms: tuple[str, ...]
    estimate: Array
    lower: Array
    upper: Array
    supported: NDArray[np.bool_]
    covariance: Array
    misfit_probability: Array
    misfit: tuple[str, ...]
    level: float
    samples: int
    sample_interval: float
    sensor: str = "gyro"

    def listing(self) -> Listing:
        """Return the coefficients with their intervals, as a table."""
        rows = []
        for row in table(self):
            axis, term, seen = int(str(row["axis"])), str(row["term"]), bool(row["supported"])
            factor = 1.0 if self.sensor == "gyro" else UNITS[term][1]
            unit = str(row["unit"]) if self.sensor == "gyro" else "SI"
            estimate, lower, upper = (float(row[end]) * factor for end in ("estimate", "lower", "upper"))  # type: ignore[arg-type]
            first = (figure(estimate), figure(lower)) if seen else ("not seen", "")
            rows.append(("xyz"[axis], f"{term} ({row['symbol']})", unit, *first, figure(upper)))
        notes = [
            f"axis {'xyz'[axis]} holds more than such noises: {what} (probability {max(probability, 1e-99):.0e})"
            for axis, (probability, what) in enumerate(zip(self.misfit_probability, self.misfit, strict=True))
            if probability < MISFIT_PROBABILITY
        ]
        title = f"Noise of the {self.sensor}, {self.samples} samples of {self.sample_interval:.6g} s, {100.0 * self.level:g} % intervals"
        return Listing(title, ("axis", "term", "unit", "estimate", "from", "to"), rows, notes, left=3)


def allan_deviation(
    values: ArrayLike,
    sample_interval: float,
    *,
    kind: str = "rate",
    taus: ArrayLike | None = None,
    estimator: str = "overlapping",
    level: float = 0.95,
) -> AllanDeviation:
    """Return the Allan, modified Allan or Hadamard deviation of a record with its confidence band.

    Parameters
    ----------
    values : array_like (n,) or (n, axes)
        Averaged-rate samples, rad/s, or angle increments, rad; at most three axes.
    sample_interval : float
        Sample interval, s.
    kind : {"rate", "increments"}, default "rate"
        Kind of the values.
    taus : array_like, optional
        Averaging times, s, each rounded to a multiple of the sample interval; repeated ones are dropped. Default: 12 a decade, up
        to a third of the record.
    estimator : {"overlapping", "robust", "modified", "hadamard"}, default "overlapping"
        Estimator, see the notes.
    level : float, default 0.95
        Confidence of the band, 0.5 to 1.

    Returns
    -------
    AllanDeviation
        The deviation of each axis.

    Raises
    ------
    InputError
        If samples are not finite, a τ is outside [sample interval, half the record] (modified and Hadamard: a third), or ``kind``
        or ``estimator`` is unknown.

    Notes
    -----
    The overlapping estimator equals ``allantools.oadev``, the modified one ``allantools.mdev`` and the Hadamard one
    ``allantools.ohdev``. The model of the module's table is that of the Allan variance only (of angle random walk, N²/τ, the
    modified variance is (1 + 1/m²)/2 of it at m samples, and the Hadamard one all of it).

    The robust estimator is the median size of the second differences over its value for a Gaussian. It withstands single outliers,
    bursts and bias steps as long as well under half of all spans of 2τ are affected, so only few of them at long τ. It does not
    suit records of a few coarse counts, whose median sits on the counts.

    The phase is kept as float64: the sum of the rate less its mean, carried with its rounding error, so that each value is rounded
    once (½ unit in the last place of the largest phase) also after 1e8 samples. Memory: one float64 per sample beyond the record,
    an axis at a time. Time: proportional to the samples for each τ.
    """
    record, dt, scale = _record(values, sample_interval, kind)
    checks.one_of("estimator", estimator, ESTIMATORS)
    level = _level(level)
    samples = record.shape[0]
    multiples = _multiples(taus, samples, dt, _order(estimator))
    deviation = np.empty((record.shape[1], len(multiples)))
    edf = np.empty_like(deviation)
    alphas = np.empty(deviation.shape, dtype=int)
    phase, lanes = np.empty(samples + 1), np.empty(512)
    for axis in range(record.shape[1]):
        rate = read_only(record[:, axis])
        compiled(accumulate)(rate, float(np.mean(rate)), phase)
        # Where the first τ has few averages, what comes before it is the longest one that has many.
        alpha = _power_law(phase, max(1, min(int(multiples[0]), samples // _MANY_BLOCKS)), 0)
        for i, m in enumerate(int(m) for m in multiples):
            alpha = _power_law(phase, m, alpha)
            alphas[axis, i] = alpha
            edf[axis, i] = equivalent_degrees_of_freedom(alpha, samples, m, estimator)
            if estimator == "robust":
                deviation[axis, i] = _median_deviation(phase, m, alpha)
                edf[axis, i] *= _MEDIAN_EFFICIENCY
        if estimator == "overlapping":
            squares = np.empty(len(multiples))
            compiled(second_difference_squares)(phase, multiples, lanes, np.empty(len(multiples)), squares)
            deviation[axis] = np.sqrt(squares / (2.0 * (samples + 1 - 2 * multiples))) / multiples
        elif estimator == "modified":
            summed = np.empty(samples + 2)
            compiled(accumulate)(read_only(phase), float(np.mean(phase)), summed)
            deviation[axis] = [math.sqrt(_third_differences(summed, int(m)) / 2.0) / m**2 for m in multiples]
        elif estimator == "hadamard":
            deviation[axis] = [math.sqrt(_third_differences(phase, int(m)) / 6.0) / m for m in multiples]
    deviation *= scale
    from scipy.stats import chi2

    return AllanDeviation(
        taus=np.asarray(multiples * dt),
        deviation=deviation,
        lower=deviation * np.sqrt(edf / chi2.ppf(0.5 + 0.5 * level, edf)),
        upper=deviation * np.sqrt(edf / chi2.ppf(0.5 - 0.5 * level, edf)),
        edf=edf,
        noise_type=np.vectorize(NOISE_TYPES.__getitem__)(alphas),
        level=level,
        estimator=estimator,
        samples=samples,
        sample_interval=dt,
    )


def _order(estimator: str) -> int:
    """Return the order of the differences that an estimator squares: of the angle, or of its sum for the modified Allan deviation."""
    return 3 if estimator in ("modified", "hadamard") else 2


def _third_differences(series: Array, m: int) -> float:
    """Return the mean of (y[k + 3m] − 3 y[k + 2m] + 3 y[k + m] − y[k])² over all k, a block at a time."""
    count = len(series) - 3 * m
    total = 0.0
    for start in range(0, count, _STRETCH):
        end = min(start + _STRETCH, count)
        a, b, c, d = (series[start + j * m : end + j * m] for j in range(4))
        difference = (d - a) - 3.0 * (c - b)
        total += float(difference @ difference)
    return total / count


def equivalent_degrees_of_freedom(alpha: int, samples: int, m: int, estimator: str = "overlapping") -> float:
    """Return the equivalent degrees of freedom of the variance averaged over m samples, out of ``samples`` of the rate.

    ``2 E²/Var`` of the mean of squared differences, by summing their squared autocorrelation (Greenhall & Riley 2003). Sampled
    phase of a noise that is white, flicker or random walk in continuous time has the generalised covariances −|t|, t² ln|t| and |t|³,
    which need no further approximation; quantisation is white phase. The sum of the phase, whose third differences the modified Allan
    deviation squares, has the second integrals of these.
    """
    if alpha not in NOISE_TYPES:
        raise InputError(f"alpha is {alpha!r}; it must be one of {', '.join(map(str, NOISE_TYPES))}")
    checks.one_of("estimator", estimator, ESTIMATORS)
    checks.count("samples", samples, least=2)
    order = _order(estimator)
    if not 1 <= m <= samples // order:
        raise InputError(f"m is {m!r}; with {samples} samples it must lie between 1 and {samples // order}")
    summed = estimator == "modified"
    count = samples + 1 + summed - order * m
    if alpha == 2 and not summed:  # overlaps of the differences by lags of 0, m, 2m, …
        weights = [math.comb(2 * order, order + j) for j in range(order + 1)]
        overlaps = sum((1 + (j > 0)) * w**2 * max(count - j * m, 0) for j, w in enumerate(weights))
        return float((weights[0] * count) ** 2 / overlaps)
    # Cells of one lag near the peaks at 0, m, 2m, … (sharp for flicker phase), wider ones elsewhere, each by its middle.
    end = min(count, 6 * m)
    if m <= 1000:
        edges = np.arange(end + 1)
    else:
        fine = [np.arange(centre - 1000, centre + 1001) for centre in range(0, (order + 1) * m, m)]
        edges = np.unique(np.concatenate([*fine, np.arange(0, end, m // 500), [0, end]]))
        edges = edges[(edges >= 0) & (edges <= end)]
    width = np.diff(edges)
    lag = edges[:-1] + 0.5 * (width - 1)
    covariance = _summed_phase_covariance if summed else _phase_covariance
    correlation = _difference_covariance(covariance, alpha, lag, m, order)
    correlation /= _difference_covariance(covariance, alpha, np.zeros(1), m, order)
    both_sides = np.where(edges[:-1] == 0, 1.0, 2.0) * width
    return float(max(1.0, count / float(np.sum(both_sides * correlation**2 * (1.0 - lag / count)))))


def _difference_covariance(
    covariance: Callable[[int, Array, int], Array], alpha: int, lag: Array, m: int, order: int
) -> Array:
    """Return the autocovariance of the differences over m of an order, up to a factor, from a generalised covariance."""
    total = np.zeros_like(lag)
    for j in range(-order, order + 1):
        total += (-1) ** j * math.comb(2 * order, order + j) * covariance(alpha, lag + j * m, m)
    return total


def _phase_covariance(alpha: int, k: Array, m: int) -> Array:
    """Return the generalised covariance of the phase at lags of k samples, in units of m samples, up to a factor."""
    t = np.abs(k) / m
    if alpha == 0:
        return np.asarray(-t)
    if alpha == -1:
        return np.asarray(t * t * _logarithm(t))
    if alpha == -2:
        return np.asarray(t**3)

    # Flicker of the phase has infinite variance unless its band ends: Greenhall's second difference over one sample interval.
    def smooth(j: Array) -> Array:
        return np.asarray(j * j * _logarithm(np.abs(j)))

    near = np.minimum(np.abs(k), 1000)
    difference = 2.0 * smooth(near) - smooth(near - 1) - smooth(near + 1)
    return np.asarray(np.where(np.abs(k) <= 1000, difference, -2.0 * np.log(np.maximum(np.abs(k), 1)) - 3.0))


def _summed_phase_covariance(alpha: int, k: Array, m: int) -> Array:
    """Return the same of the running sum of the phase: minus its second difference over one sample is that of the phase.

    Exactly so, but for flicker of the rate, where the difference approximates the derivative.
    """
    t, step = np.abs(k) / m, 1.0 / m
    if alpha == 2:
        return np.asarray(-t)
    if alpha == 1:
        return np.asarray(t * t * _logarithm(t))
    if alpha == 0:
        return np.asarray(t**3 - step**2 * t)
    if alpha == -1:
        return np.asarray(-(t**4) * _logarithm(t))
    return np.asarray(-(t**5) + step**2 * t**3 * 5.0 / 3.0 - step**4 * t * 2.0 / 3.0)


def _logarithm(t: Array) -> Array:
    """Return ln t, and 0 at 0, where a power of t stands before it."""
    return np.asarray(np.log(np.where(t > 0.0, t, 1.0)))


def _median_deviation(phase: Array, m: int, alpha: int) -> float:
    """Return the median size of the second differences, scaled to the standard deviation of a Gaussian, as an Allan deviation."""
    # Spans that overlap by 15/16 hold nearly all there is, unless the noise is in the phase itself.
    stride = 1 if alpha > 0 else max(1, m // 16)
    sizes = np.empty((len(phase) - 1 - 2 * m) // stride + 1)
    compiled(second_difference_sizes)(phase, m, stride, sizes)
    return float(np.median(sizes, overwrite_input=True)) / (_MEDIAN_OF_NORMAL * math.sqrt(2.0) * m)


def _power_law(phase: Array, m: int, otherwise: int) -> int:
    """Return the power law of the rate averaged over m samples, by the lag-1 autocorrelation (Riley & Greenhall 2004).

    A series with correlation r at lag 1 has fractional-difference parameter δ = r/(1 + r); it is differenced while δ ≥ ¼. A middle
    stretch of the record is enough where there are very many averages. Noises of a gyro redden with τ, so what few averages show may
    only be redder than ``otherwise``, the power law of the τ before: by chance they show anything.
    """
    edges = phase[::m]
    spare = max(0, len(edges) - _MAX_BLOCKS) // 2
    blocks = np.diff(edges[spare : spare + _MAX_BLOCKS])
    count = len(blocks)
    if count < _FEWEST_BLOCKS:
        return otherwise
    for differenced in range(3):
        centred = blocks - blocks.mean()
        power = float(centred @ centred)
        if power <= 0.0:
            return -2
        correlation = float(centred[1:] @ centred[:-1]) / power
        delta = correlation / (1.0 + correlation) if correlation > -1.0 else -math.inf
        if delta < 0.25 or differenced == 2:
            alpha = int(np.clip(np.round(-2.0 * (max(delta, -2.0) + differenced)), -2, 2))
            return alpha if count >= _MANY_BLOCKS else min(alpha, otherwise)
        blocks = np.diff(blocks)
    return otherwise


def fit_noise(
    values: ArrayLike,
    sample_interval: float,
    *,
    kind: str = "rate",
    terms: Sequence[str] = TERMS,
    highest_frequency: float | None = None,
    level: float = 0.95,
) -> NoiseFit:
    """Return the noise coefficients of a record at rest, each with its interval, or a bound where it is not supported.

    Parameters
    ----------
    values : array_like (n,) or (n, axes)
        Averaged-rate samples, rad/s, or angle increments, rad; at least 64 samples, at most three axes.
    sample_interval : float
        Sample interval, s.
    kind : {"rate", "increments"}, default "rate"
        Kind of the values.
    terms : sequence of str, default TERMS
        Terms to fit, of :data:`TERMS`.
    highest_frequency : float, optional
        Frequency, Hz, above which the spectrum is left out, where a low-pass filter or a vibration shapes it. The samples are then
        regarded as averages below it.
    level : float, default 0.95
        Confidence of the intervals, 0.5 to 1.

    Returns
    -------
    NoiseFit
        Coefficients, SI, of each axis.

    Raises
    ------
    InputError
        If samples are not finite, the record has no noise or is too short, or a term is unknown.

    Notes
    -----
    The squared DCT-II coefficients of the record, j = 1 … n − 1 at frequency j/(2 n dt), are modelled as independent χ² of one
    degree of freedom around ``Σ θ_i V_i(j)``, θ = (Q², N², B², K²) ≥ 0, V the exact expectation for each noise on a finite record;
    a rate ramp is a mean. Coefficients are pooled in bins of 5 % in frequency. θ maximises the likelihood restricted for the ramp
    (REML); intervals are those where twice the log-likelihood, maximised over all other terms, falls by the χ² quantile. Terms
    without support stay in the model at their most likely value while the others are judged, so that their uncertainty widens the
    other intervals.
    """
    record, dt, scale = _record(values, sample_interval, kind)
    level = _level(level)
    chosen = tuple(checks.one_of("terms: term", term, TERMS) for term in terms)
    chosen = tuple(term for term in TERMS if term in chosen)
    if not set(chosen) - {"rate_ramp"}:
        raise InputError("terms names no random noise; add one of quantization, angle_random_walk, …")
    samples = record.shape[0]
    if samples < 64:
        raise InputError(f"values has {samples} samples; at least 64 are needed to separate the noises")
    last = samples - 1
    if highest_frequency is not None:
        last = min(last, int(2.0 * samples * dt * checks.positive("highest_frequency", highest_frequency, unit="Hz")))
        if last < 32:
            raise InputError(
                f"highest_frequency is {highest_frequency:g} Hz: only {last} coefficients lie below; raise it"
            )
    starts = _bin_starts(last)
    random_terms = tuple(term for term in chosen if term != "rate_ramp")
    basis = np.stack([_basis(term, samples, dt, starts, last) for term in random_terms])
    fits, misfits = [], []
    for axis in range(record.shape[1]):
        rate = record[:, axis]
        coefficient = _cosine_transform(rate, scale)
        bins = _binned(
            coefficient,
            basis,
            starts,
            axis=axis,
            largest=scale * float(max(np.max(rate), -np.min(rate))),
            dt=dt,
            last=last,
        )
        fits.append(_fit_axis(bins, random_terms, "rate_ramp" in chosen, level))
        misfits.append(_misfit(coefficient, bins, fits[-1].best, random_terms, starts, last, dt))
    return _of_axes(chosen, fits, misfits, level=level, samples=samples, sample_interval=dt)


def expected_errors(parameters: Mapping[str, float], samples: int, sample_interval: float) -> dict[str, float]:
    """Return the standard errors, SI, that a fit of all terms would have: how long a record must be.

    ``parameters`` are coefficients, SI, by name in :data:`TERMS`. The Cramér–Rao bound of the cosine coefficients, which the fit attains
    where an error is well below the coefficient itself; elsewhere the record does not support the term.
    """
    checks.known_keys("parameters", parameters, TERMS)
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    last = checks.count("samples", samples, least=64) - 1
    starts = _bin_starts(last)
    random_terms = TERMS[:4]
    basis = np.stack([_basis(term, samples, dt, starts, last) for term in random_terms])
    slices = _slices(starts, last)
    number = np.array([float(s.stop - s.start) for s in slices])
    theta = np.array([checks.non_negative(term, parameters.get(term, 0.0)) ** 2 for term in random_terms])
    if not np.any(theta > 0.0):
        raise InputError("parameters names no random noise; give one of quantization, angle_random_walk, …")
    variance = theta @ basis
    none = np.zeros_like(number)
    errors = _standard_errors(_information(_Bins(number, none, none, none, basis, 0.0), variance))
    found = {
        term: float(0.5 * error / math.sqrt(value))  # d√θ/dθ
        for term, error, value in zip(random_terms, errors, theta, strict=True)
        if value > 0.0
    }
    if parameters.get("rate_ramp", 0.0) != 0.0:
        ramp = [float(np.sum((dt * _ramp_coefficients(samples, np.arange(s.start, s.stop))) ** 2)) for s in slices]
        found["rate_ramp"] = 1.0 / math.sqrt(float(np.sum(np.array(ramp) / variance)))
    return found


def flicker_variance(multiples: ArrayLike) -> Array:
    """Return the exact Allan variance, over B², of samples with the two-sided PSD B²/(2π f) up to the Nyquist frequency.

    ``∫ (4/(2π f)) sin⁴(π f m)/(m sin π f)² df`` over f in (0, ½), as a sum over the autocovariance −Cin(π k)/π of the samples. It tends
    to 2 ln 2/π as 1/m² (to 1e-7 at m = 4096, beyond which the limit is returned), from above: one sample shows 19 % more.
    """
    m_all = np.atleast_1d(checks.array("multiples", multiples, (...,)))
    limit = int(min(m_all.max(initial=1.0), _FLICKER_SUM_LIMIT))
    covariance = _flicker_covariance(2 * limit + 1)
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
            result[index] = weight @ (covariance[np.abs(lag)] - covariance[lag + m]) / m**2
    return result


def model_deviation(parameters: Mapping[str, float], taus: ArrayLike, sample_interval: float) -> dict[str, Array]:
    """Return the Allan deviation (t,), rad/s, of each noise term and of their sum, ``"total"``, at ``taus``, s.

    ``parameters`` are coefficients, SI, by name in :data:`TERMS`; absent ones are zero.
    """
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


def curves_by_axis(fit: NoiseFit, deviation: AllanDeviation) -> list[dict[str, Array]]:
    """Return, for each axis, the curves of each fitted term and their total at the taus of ``deviation``, rad/s, for plotting."""
    filled = np.where(fit.supported, fit.estimate, 0.0)
    return [
        model_deviation(dict(zip(fit.terms, map(float, row), strict=True)), deviation.taus, fit.sample_interval)
        for row in filled
    ]


def to_gyro_parameters(fit: NoiseFit) -> dict[str, float | tuple[float, ...]]:
    """Return the coefficients by the names of the gyro specification.

    Parameters
    ----------
    fit : NoiseFit
        Coefficients of one sensor.

    Returns
    -------
    dict of str to float or tuple of float
        Coefficients, SI, one number or one per axis. A term that no axis supports is left out; one that some axes support is 0 on
        the others.
    """
    return _by_name(fit, np.where(fit.supported, fit.estimate, 0.0), np.asarray(fit.supported.any(axis=0)))


def upper_bounds(fit: NoiseFit) -> dict[str, float | tuple[float, ...]]:
    """Return the upper ends, SI, by term, one or one an axis, of the intervals of the terms that some axis does not support.

    The record cannot exclude coefficients up to these; a filter that must not be overconfident may use them.
    """
    return _by_name(fit, fit.upper, np.asarray(~fit.supported.all(axis=0)))


def _by_name(fit: NoiseFit, values: Array, wanted: NDArray[np.bool_]) -> dict[str, float | tuple[float, ...]]:
    return {
        term: float(column[0]) if len(column) == 1 else tuple(map(float, column))
        for term, column, want in zip(fit.terms, values.T, wanted, strict=True)
        if want
    }


def table(fit: NoiseFit) -> list[dict[str, object]]:
    """Return one row per axis and term for printing, in the units of :data:`UNITS`: estimate, lower and upper (NaN: no such value)."""
    rows: list[dict[str, object]] = []
    for axis, i in np.ndindex(*fit.estimate.shape):
        term = fit.terms[i]
        unit, factor = UNITS[term]
        rows.append(
            {
                "axis": axis,
                "term": term,
                "symbol": SYMBOLS[term],
                "estimate": float(fit.estimate[axis, i] / factor),
                "lower": float(fit.lower[axis, i] / factor),
                "upper": float(fit.upper[axis, i] / factor),
                "unit": unit,
                "supported": bool(fit.supported[axis, i]),
            }
        )
    return rows


def _level(level: float) -> float:
    number = checks.positive("level", level)
    if not 0.5 < number < 1.0:
        raise InputError(f"level is {number:g}; a confidence lies between 0.5 and 1, for example 0.95")
    return number


def _record(values: ArrayLike, sample_interval: float, kind: str) -> tuple[Array, float, float]:
    """Return the record (n, axes), its sample interval, and the factor that makes rates of its values."""
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    checks.one_of("kind", kind, ("rate", "increments"))
    record = checks.array("values", values, ("n",) if np.ndim(values) == 1 else ("n", "axes"))
    if record.ndim == 1:
        record = record[:, None]
    if not 1 <= record.shape[1] <= 3:
        raise InputError(
            f"values has {record.shape[1]} axes; pass (n,) or (n, axes) with one to three axes (transpose it?)"
        )
    if len(record) < 3:
        raise InputError(f"values has {len(record)} samples; an Allan deviation needs at least 3")
    return record, dt, 1.0 if kind == "rate" else 1.0 / dt


def _multiples(taus: ArrayLike | None, samples: int, dt: float, order: int) -> NDArray[np.int64]:
    if taus is None:
        largest = max(1, samples // 3)
        return np.unique(np.round(np.geomspace(1, largest, 2 + int(12 * math.log10(largest)))).astype(np.int64))
    wanted = np.atleast_1d(checks.array("taus", taus, (...,))).ravel()
    multiples = np.round(wanted / dt)
    for tau, m in zip(wanted, multiples, strict=True):
        if not 1 <= m <= samples // order:
            raise InputError(
                f"taus holds {tau:g} s; with {samples} samples of {dt:g} s it must lie between {dt:g} s and {samples // order * dt:g} s"
            )
    if len(multiples) == 0:
        raise InputError("taus is empty; leave it out for the default")
    return np.unique(multiples.astype(np.int64))


# Spectra of the cosine transform


def _bin_starts(last: int) -> NDArray[np.int64]:
    """Return the first index of each bin of DCT coefficients 1 … last; each bin spans 5 % or one coefficient."""
    starts = [1]
    while (following := max(starts[-1] + 1, math.ceil(starts[-1] * _BIN_GROWTH))) <= last:
        starts.append(following)
    return np.array(starts, dtype=np.int64)


def _slices(starts: NDArray[np.int64], last: int) -> list[slice]:
    return [slice(int(a), int(b)) for a, b in zip(starts, [*starts[1:], last + 1], strict=True)]


def _basis(term: str, samples: int, dt: float, starts: NDArray[np.int64], last: int) -> Array:
    """Return the mean over each bin of the expected squared DCT-II coefficient for a unit coefficient of ``term``."""
    return np.array(
        [float(np.mean(_expected_power(term, samples, dt, np.arange(s.start, s.stop)))) for s in _slices(starts, last)]
    )


def _expected_power(term: str, samples: int, dt: float, j: NDArray[np.int64]) -> Array:
    """Return the expected square of the orthonormal DCT-II coefficients j of averaged-rate samples, unit coefficient of ``term``.

    With θ = πj/n: white rate is white. The difference of averaged random-walk samples has covariance dt (2/3, 1/6 at lag 1), which the
    sine transform diagonalises as the cosine transform does for the samples. Quantised phase, differenced, is the same Laplacian plus
    its two corners.
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
    ratio = _flicker_leakage(min(samples, _LARGEST_EXACT))
    known = (
        len(ratio) if samples <= _LARGEST_EXACT else len(ratio) // 8
    )  # far from both ends the ratio depends on j alone, and tends to 1
    return np.asarray(spectrum * np.where(j < known, ratio[np.minimum(j, known - 1)], 1.0))


def _flicker_covariance(count: int) -> Array:
    """Return the generalised autocovariance −Cin(πk)/π of unit flicker samples band-limited at Nyquist, k = 0 … count − 1.

    Flicker has infinite variance; the constant that is left out cancels in every combination of samples whose weights sum to zero.
    """
    from scipy.special import sici

    x = np.pi * np.arange(1, count)
    return np.concatenate([[0.0], -(np.euler_gamma + np.log(x) - sici(x)[1]) / np.pi])


@functools.lru_cache(maxsize=8)
def _flicker_leakage(samples: int) -> Array:
    """Return the expected squared DCT-II coefficients of flicker over its spectrum, by index j (entry 0 unused).

    ``E c_j² = γ_0 + (2/n) Σ_h γ_h ((n − h) cos hθ − sin hθ / sin θ)``, θ = πj/n: the autocorrelation of a cosine row, summed.
    """
    from scipy.fft import rfft

    lag = np.arange(samples)
    covariance = _flicker_covariance(samples)
    j = np.arange(1, samples)
    cosine_sum = rfft(covariance * (samples - lag), 2 * samples).real[1:samples]
    sine_sum = -rfft(covariance, 2 * samples).imag[1:samples]
    power = 2.0 / samples * (cosine_sum - sine_sum / np.sin(np.pi * j / samples))
    return np.concatenate([[1.0], power * np.pi * j / samples])


def _ramp_coefficients(samples: int, j: NDArray[np.int64]) -> Array:
    """Return the orthonormal DCT-II coefficients j ≥ 1 of the sequence 0, 1, 2, …: −√(2/n) cos(θ/2)/(2 sin² θ/2) for odd j, else 0."""
    half = 0.5 * np.pi * j / samples
    return np.asarray(np.where(j % 2 == 1, -math.sqrt(2.0 / samples) * np.cos(half) / (2.0 * np.sin(half) ** 2), 0.0))


class _Bins(NamedTuple):
    """Sums over each bin: of squared coefficients less a first slope, their product with the ramp's, the ramp's squares."""

    number: Array
    square: Array
    product: Array
    ramp: Array
    basis: Array
    first_slope: float


def _cosine_transform(values: Array, scale: float) -> Array:
    """Return the orthonormal DCT-II of values less their mean, times ``scale``."""
    from scipy.fft import dct

    coefficient = dct(values - values.mean(), type=2, norm="ortho", overwrite_x=True)
    coefficient *= scale
    return np.asarray(coefficient)


def _binned(
    coefficient: Array, basis: Array, starts: NDArray[np.int64], *, axis: int, largest: float, dt: float, last: int
) -> _Bins:
    """Return the sums over bins of coefficients 1 … last; ``largest`` is the record's largest size, against rounding."""
    low = np.arange(1, min(last, 1 << 20) + 1)
    ramp = dt * _ramp_coefficients(len(coefficient), low)
    slope = float(ramp @ coefficient[1 : len(low) + 1] / (ramp @ ramp))
    sums = []
    for s in _slices(starts, last):
        ramp = dt * _ramp_coefficients(len(coefficient), np.arange(s.start, s.stop))
        rest = coefficient[s] - slope * ramp
        sums.append((len(rest), rest @ rest, rest @ ramp, ramp @ ramp))
    count, square, product, ramp_square = np.array(sums, dtype=float).T
    if not np.any(square > (1e-13 * largest) ** 2 * count):
        raise InputError(
            f"values, axis {axis}, holds no noise (it is constant or a straight line); pass a recorded gyro"
        )
    return _Bins(count, square, product, ramp_square, basis, slope)


# Likelihood


class _Optimum(NamedTuple):
    loss: float
    theta: Array
    slope: float
    variance: Array


class _AxisFit(NamedTuple):
    estimate: Array
    lower: Array
    upper: Array
    supported: NDArray[np.bool_]
    covariance: Array
    best: _Optimum


def _loss(bins: _Bins, theta: Array, slope: float | None, restricted: bool) -> _Optimum:
    """Return −log likelihood at ``theta``; ``slope`` None profiles the ramp, restricted (REML) or not."""
    variance = theta @ bins.basis
    if not np.all(variance > 0.0):
        return _Optimum(math.inf, theta, 0.0, variance)
    information = float(np.sum(bins.ramp / variance))
    best = float(np.sum(bins.product / variance)) / information if slope is None else slope
    power = bins.square - 2.0 * best * bins.product + best * best * bins.ramp
    loss = 0.5 * float(np.sum(bins.number * np.log(variance) + power / variance))
    if slope is None and restricted:
        loss += 0.5 * math.log(information)
    return _Optimum(loss, theta, best, variance)


def _maximise(
    bins: _Bins, start: Array, *, held: int | None = None, slope: float | None = None, restricted: bool = True
) -> _Optimum:
    """Return the most likely theta ≥ 0 by Fisher scoring, each step a non-negative least-squares problem, with step halving.

    ``held`` keeps that component at its value in ``start``.
    """
    from scipy.optimize import nnls

    free = np.array([i != held for i in range(len(start))])
    point = _loss(bins, start, slope, restricted)
    if not free.any():
        return point
    for _ in range(100):
        variance = point.variance
        power = bins.square - 2.0 * point.slope * bins.product + point.slope**2 * bins.ramp
        if slope is None and restricted:
            power = power + bins.ramp / np.sum(bins.ramp / variance)
        weight = np.sqrt(bins.number) / variance
        residual = power / bins.number - (start[held] * bins.basis[held] if held is not None else 0.0)
        design = (bins.basis[free] * weight).T
        norm = np.linalg.norm(design, axis=0)
        target = start.copy()
        target[free] = nnls(design / norm, residual * weight)[0] / norm
        step, trial = 1.0, _loss(bins, target, slope, restricted)
        while trial.loss > point.loss and step > 1e-6:
            step *= 0.5
            trial = _loss(bins, point.theta + step * (target - point.theta), slope, restricted)
        gain = point.loss - trial.loss
        if gain > 0.0:
            point = trial
        if gain < 1e-9:
            break
    return point


def _first_guess(bins: _Bins) -> Array:
    """Return a positive theta: every term at the level where it alone would explain the quietest octave it is strongest in."""
    edges = np.searchsorted(np.cumsum(bins.number), 2.0 ** np.arange(3, 60))
    edges = np.unique(np.concatenate([[0], edges[edges < len(bins.number)]]))
    power = np.add.reduceat(bins.square, edges) / np.add.reduceat(bins.number, edges)
    basis = np.add.reduceat(bins.basis * bins.number, edges, axis=1) / np.add.reduceat(bins.number, edges)
    return np.asarray(np.min(np.maximum(power, 1e-9 * power.max()) / basis, axis=1) / len(basis))


def _information(bins: _Bins, variance: Array) -> Array:
    """Return the Fisher information of theta."""
    weighted = bins.basis * np.sqrt(0.5 * bins.number) / variance
    return np.asarray(weighted @ weighted.T)


def _standard_errors(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information * np.outer(scale, scale))
    return np.asarray(np.sqrt(np.maximum(np.diag(inverse), 0.0)) * scale)


def _fit_axis(bins: _Bins, random_terms: tuple[str, ...], with_ramp: bool, level: float) -> _AxisFit:
    from scipy.stats import chi2

    fixed_slope = None if with_ramp else -bins.first_slope
    best = _maximise(bins, _first_guess(bins), slope=fixed_slope)
    two_sided = 0.5 * float(chi2.ppf(level, 1))
    support = 0.5 * float(chi2.ppf(1.0 - 2.0 * SUPPORT_PROBABILITY, 1))
    information = _information(bins, best.variance)
    errors = _standard_errors(information)
    count = len(random_terms)
    estimate, lower, upper = np.full(count, np.nan), np.zeros(count), np.empty(count)
    supported = np.zeros(count, dtype=bool)
    for i in range(count):

        def fall(value: float, i: int = i) -> float:
            start = best.theta.copy()
            start[i] = value
            if not np.any(start > 0.0):
                start = errors.copy()
                start[i] = value
            return _maximise(bins, start, held=i, slope=fixed_slope).loss - best.loss

        supported[i] = best.theta[i] > 0.0 and (count == 1 or fall(0.0) > support)
        if supported[i]:
            estimate[i] = math.sqrt(best.theta[i])
            lower[i] = math.sqrt(_crossing(fall, best.theta[i], -best.theta[i], two_sided))
        upper[i] = math.sqrt(_crossing(fall, best.theta[i], 2.0 * errors[i], two_sided))
    covariance = np.full((count, count), np.nan)
    used = np.flatnonzero(best.theta > 0.0)
    shrink = 1.0 / np.sqrt(np.diag(information)[used])
    inverse = np.linalg.pinv(information[np.ix_(used, used)] * np.outer(shrink, shrink)) * np.outer(shrink, shrink)
    slope_of_root = 0.5 / np.sqrt(best.theta[used])  # d√θ/dθ
    covariance[np.ix_(used, used)] = inverse * np.outer(slope_of_root, slope_of_root)
    covariance[~supported, :] = np.nan
    covariance[:, ~supported] = np.nan
    if with_ramp:
        ramp = _fit_ramp(bins, best, two_sided, support)
        estimate, lower, upper = np.append(estimate, ramp[0]), np.append(lower, ramp[1]), np.append(upper, ramp[2])
        supported = np.append(supported, not math.isnan(ramp[0]))
        wide = np.full((count + 1, count + 1), np.nan)
        wide[:count, :count] = covariance
        if supported[-1]:
            wide[-1, :-1] = wide[:-1, -1] = np.where(supported[:-1], 0.0, np.nan)
            wide[-1, -1] = 1.0 / np.sum(bins.ramp / best.variance)
        covariance = wide
    return _AxisFit(estimate, lower, upper, supported, covariance, best)


def _of_axes(
    terms: tuple[str, ...],
    fits: Sequence[_AxisFit],
    misfits: Sequence[tuple[float, str]],
    *,
    level: float,
    samples: int,
    sample_interval: float,
) -> NoiseFit:
    """Return the fits of single axes as one; a misfit is its probability and what was seen."""
    return NoiseFit(
        terms=terms,
        estimate=np.stack([f.estimate for f in fits]),
        lower=np.stack([f.lower for f in fits]),
        upper=np.stack([f.upper for f in fits]),
        supported=np.stack([f.supported for f in fits]),
        covariance=np.stack([f.covariance for f in fits]),
        misfit_probability=np.array([probability for probability, _ in misfits]),
        misfit=tuple(what for _, what in misfits),
        level=level,
        samples=samples,
        sample_interval=sample_interval,
    )


def _crossing(fall: Callable[[float], float], centre: float, step: float, level: float) -> float:
    """Return where ``fall`` reaches ``level``, seen from ``centre`` in the direction of ``step`` (downwards: between 0 and centre)."""
    from scipy.optimize import brentq

    if step < 0.0:
        if fall(0.0) <= level:
            return 0.0
        return float(brentq(lambda v: fall(v) - level, 0.0, centre, xtol=1e-5 * centre))
    near, far = centre, centre + step
    while fall(far) < level:
        near, far = far, centre + 2.0 * (far - centre)
    return float(brentq(lambda v: fall(v) - level, near, far, xtol=1e-5 * (far - near)))


def _fit_ramp(bins: _Bins, best: _Optimum, two_sided: float, support: float) -> tuple[float, float, float]:
    """Return estimate, lower and upper of the ramp; unsupported: NaN, 0 and a bound on its size.

    The ramp's own interval profiles the unrestricted likelihood: how far K may go to explain the trend is part of it.
    """
    top = _maximise(bins, best.theta, restricted=False)

    def fall(slope: float) -> float:
        return _maximise(bins, top.theta, slope=slope).loss - top.loss

    error = 1.0 / math.sqrt(float(np.sum(bins.ramp / top.variance)))
    low = -_crossing(lambda v: fall(-v), -top.slope, 2.0 * error, two_sided) + bins.first_slope
    high = _crossing(fall, top.slope, 2.0 * error, two_sided) + bins.first_slope
    if fall(-bins.first_slope) > support:
        return top.slope + bins.first_slope, low, high
    return math.nan, 0.0, max(abs(low), abs(high))


# Misfit


def _misfit(
    coefficient: Array,
    bins: _Bins,
    best: _Optimum,
    random_terms: tuple[str, ...],
    starts: NDArray[np.int64],
    last: int,
    dt: float,
) -> tuple[float, str]:
    """Return the probability of a departure from the fit this large, and its description; overwrites ``coefficient``.

    Divided by their fitted sizes and transformed back, the coefficients are a white series of unit variance. A turn or a step of the
    bias, whose spectrum may pass for a random walk's, stands out in it. Of three tests the smallest probability is multiplied by three.
    """
    samples = len(coefficient)
    for s in _slices(starts, last):
        j = np.arange(s.start, s.stop)
        variance = np.zeros(len(j))
        for term, theta in zip(random_terms, best.theta, strict=True):
            if theta > 0.0:
                variance += theta * _expected_power(term, samples, dt, j)
        coefficient[s] -= (bins.first_slope + best.slope) * dt * _ramp_coefficients(samples, j)
        coefficient[s] /= np.sqrt(variance)
    from scipy.fft import idct

    coefficient[0] = 0.0
    coefficient[last + 1 :] = 0.0
    white = idct(coefficient, type=2, norm="ortho", overwrite_x=True)
    white *= math.sqrt(samples / last)
    largest = max(int(np.argmax(white)), int(np.argmin(white)), key=lambda k: abs(white[k]))
    size = abs(float(white[largest]))
    stretches = min(_STRETCHES, samples // 16)
    edges = np.linspace(0, samples, stretches + 1).astype(np.int64)
    energy = np.array([white[a:b] @ white[a:b] for a, b in itertools.pairwise(edges)])
    number = np.diff(edges)
    freedom = number * (last / samples)
    loudest = int(np.argmax(energy / number))
    found = (
        (samples * math.erfc(size / math.sqrt(2.0)), f"a sample at {dt * largest:.6g} s stands out by {size:.3g} σ"),
        (
            _probability(freedom, energy / number, stretches - 1),
            f"its noise is not steady, and largest from {dt * edges[loudest]:.6g} to {dt * edges[loudest + 1]:.6g} s",
        ),
        (_spectrum_probability(bins, best), "its spectrum has another shape"),
    )
    probability, what = min(found, key=lambda test: test[0])  # of several at 0 the one with a time
    return min(1.0, len(found) * probability), what


def _spectrum_probability(bins: _Bins, best: _Optimum) -> float:
    """Return the probability of a spectrum as far from the fit, over the bins of enough coefficients."""
    many = bins.number >= min(30.0, bins.number.max())
    power = bins.square - 2.0 * best.slope * bins.product + best.slope**2 * bins.ramp
    ratio = power[many] / (bins.number[many] * best.variance[many])
    return _probability(bins.number[many], ratio, max(1, int(many.sum()) - int(np.sum(best.theta > 0.0))))


def _probability(freedom: Array, ratio: Array, count: int) -> float:
    """Return the probability of as large a sum of squares of the normal scores of χ²/freedom ratios, the sum of ``count`` degrees.

    The cube root of a χ² is nearly normal (Wilson & Hilferty 1931); the Pearson statistic has too long a tail for 1e-3.
    """
    from scipy.stats import chi2

    spread = 2.0 / (9.0 * freedom)
    score = (np.cbrt(ratio) - 1.0 + spread) / np.sqrt(spread)
    return float(chi2.sf(score @ score, count))
