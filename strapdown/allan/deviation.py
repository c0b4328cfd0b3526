"""Allan deviation of a gyro record at rest: overlapping, robust, modified, or Hadamard, with χ² confidence bands.

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

Sources: IEEE Std 952-1997 annex C; NIST SP 1065 (Riley 2008); Greenhall & Riley, "Uncertainty of stability variances based on
finite differences", PTTI 2003; Riley & Greenhall, "Power law noise identification using the lag 1 autocorrelation", EFTF 2004.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks
from strapdown.allan import gaps
from strapdown.allan.spectrum import flicker_covariance
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
    record, dt, scale = averaged(values, sample_interval, kind)
    checks.one_of("estimator", estimator, ESTIMATORS)
    level = confidence(level)
    if np.isnan(record).any():
        if estimator != "overlapping":
            raise InputError(f"values has gaps (NaN), with which estimator {estimator!r} does not go; leave it out")
        found = gaps.allan_deviation(scale * record, dt, taus=taus, level=level)._asdict()
        noise_type = np.vectorize(NOISE_TYPES.__getitem__)(found.pop("alphas"))
        return AllanDeviation(**found, noise_type=noise_type, level=level, estimator="gaps", sample_interval=dt)
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
    checks.count("samples", samples, minimum=2)
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


def flicker_variance(multiples: ArrayLike) -> Array:
    """Return the exact Allan variance, over B², of samples with the two-sided PSD B²/(2π f) up to the Nyquist frequency.

    ``∫ (4/(2π f)) sin⁴(π f m)/(m sin π f)² df`` over f in (0, ½), as a sum over the autocovariance −Cin(π k)/π of the samples. It tends
    to 2 ln 2/π as 1/m² (to 1e-7 at m = 4096, beyond which the limit is returned), from above: one sample shows 19 % more.
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
            result[index] = weight @ (covariance[np.abs(lag)] - covariance[lag + m]) / m**2
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


def confidence(level: float) -> float:
    """Return a confidence level, checked."""
    number = checks.positive("level", level)
    if not 0.5 < number < 1.0:
        raise InputError(f"level is {number:g}; a confidence lies between 0.5 and 1, for example 0.95")
    return number


def averaged(values: ArrayLike, sample_interval: float, kind: str) -> tuple[Array, float, float]:
    """Return the record (n, axes), NaN where a sample is missing, its sample interval, and the factor that makes rates of its values."""
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    checks.one_of("kind", kind, ("rate", "increments"))
    record = checks.array("values", values, ("n",) if np.ndim(values) == 1 else ("n", "axes"), allow_nan=True)
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
