"""Noise coefficients of a record at rest, by maximum likelihood on its cosine transform, with model-averaged profile-likelihood intervals.

Quantisation Q, angle random walk N, bias instability B, rate random walk K and rate ramp R, as in :mod:`strapdown.allan.deviation`.

Least squares on the Allan deviation is not used: values at neighbouring τ are computed from nearly the same data, so that their errors are
strongly correlated, and at long τ, where K and R are observable, they are far from Gaussian. The cosine (DCT-II) coefficients of
averaged-rate samples, in contrast, are independent and Gaussian, exactly for angle and rate random walk, which a DCT diagonalises, and
nearly for flicker and quantisation, whose exact variances are used. The Allan variance is a smoothed function of their squares and has no
further information. No covariance between averaging times has to be modelled, and the intervals follow from the likelihood.

Quantisation is white only if successive angles differ by noise or motion of about half a step or more; otherwise its error is correlated
with the motion, no coefficient describes it, and ``NoiseFit.misfit_probability`` approaches zero.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from strapdown import checks, gyro, units
from strapdown.allan.deviation import TERMS, AllanDeviation, Source, averaged, confidence, model_deviation
from strapdown.allan.misfit import worst_misfit
from strapdown.allan.spectrum import Bins, Segment, binned, cosine_transform, last_coefficient, scored, segment
from strapdown.checks import Array, InputError
from strapdown.files import plain
from strapdown.results import Column, Listed, Table, figure

SYMBOLS = dict(zip(TERMS, "QNBKR", strict=True))


class Unit(NamedTuple):
    """Unit of a term of a sensor."""

    label: str
    factor: float
    """Factor to SI."""
    name: str
    """Name of the term for this sensor."""
    suffix: str
    """Unit in the key of a file."""


_G, _HOUR = 1e-6 * units.STANDARD_GRAVITY, 3600.0
UNITS: Mapping[str, Mapping[str, Unit]] = {
    "gyro": {
        term: Unit(label, gyro.FORM[term][0][1], term, gyro.FORM[term][0][0])
        for term, label in zip(TERMS, ("arcsec", "°/√h", "°/h", "°/h/√h", "°/h/h"), strict=True)
    },
    "accelerometer": {
        "quantization": Unit("mm/s", 1e-3, "quantization", "mm_per_s"),
        "angle_random_walk": Unit("µg/√Hz", _G, "velocity_random_walk", "ug_per_sqrt_hz"),
        "bias_instability": Unit("µg", _G, "bias_instability", "ug"),
        "rate_random_walk": Unit("µg/√h", _G / 60.0, "acceleration_random_walk", "ug_per_sqrt_hour"),
        "rate_ramp": Unit("µg/h", _G / _HOUR, "acceleration_ramp", "ug_per_hour"),
    },
    "magnetometer": {
        "quantization": Unit("nT s", 1e-9, "quantization", "nt_s"),
        "angle_random_walk": Unit("nT/√Hz", 1e-9, "white_noise", "nt_per_sqrt_hz"),
        "bias_instability": Unit("nT", 1e-9, "bias_instability", "nt"),
        "rate_random_walk": Unit("nT/√h", 1e-9 / 60.0, "random_walk", "nt_per_sqrt_hour"),
        "rate_ramp": Unit("nT/h", 1e-9 / _HOUR, "ramp", "nt_per_hour"),
    },
}
"""Unit of each term of each sensor in text and in files."""

TERM_COST = 1.5
"""Penalty on the log-likelihood of a combination of terms per coefficient (Akaike's: 1).

Measured in 30 s of white noise and random walk, equal on three axes: at a penalty of 1 the interval of the largest axis covers 97.9 % (too
large), at 1.5 96.6 %. With flicker that is hardly observable in the record, the interval of the random walk of one axis covers 94 % at 1,
88 % at 1.5 and 86 % at 2.
"""

SUPPORT_PROBABILITY = 1e-3
"""Significance level of a term: the probability that a record without it shows as much of it by chance."""

MISFIT_PROBABILITY = 1e-3
"""Threshold of ``NoiseFit.misfit_probability``, below which the record contains other errors than the noise terms."""

SHORTEST = 64
"""Minimum number of samples of a segment without gaps that the fit uses."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseFit(Listed):
    """Noise coefficients of a record, SI units.

    Attributes
    ----------
    terms : tuple of str
        Terms fitted, a subset of :data:`TERMS`; they index the last axis below.
    estimate : ndarray (axes, terms)
        Coefficients, averaged over the combinations of terms; NaN if the record does not support the term.
    lower, upper : ndarray (axes, terms)
        Two-sided interval. If the term is not supported, ``lower`` is 0 and ``upper`` the upper end of that
        interval (for the ramp: a bound on its magnitude), so that the coverage is at least the level whether or not the term is supported;
        a one-sided bound would have a lower coverage, since the threshold of support selects the low estimates.
    supported : ndarray of bool (axes, terms)
        Whether the record supports the term.
    misfit_probability : ndarray (axes,)
        p-value of the record under the fitted noise terms, by the most significant of three tests: its spectrum, its largest sample and its
        noise by segments, the last two after whitening. Near zero the record contains other errors (motion, a vibration line, a low-pass
        filter, outliers, a Gauss–Markov bias), and the intervals are not valid.
    misfit : tuple of str
        Description of the deviation found by that test, for each axis.
    confidence_level : float
        Confidence of the intervals.
    samples : int
        Number of samples of the record.
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
    misfit_probability: Array
    misfit: tuple[str, ...]
    confidence_level: float
    samples: int
    sample_interval: float
    sensor: str = "gyro"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about axes with other errors than the noise terms, one sentence each, and what to do."""
        sentences = [
            f"axis {'xyz'[axis]} has other errors than these noise terms: {what} (probability {max(probability, 1e-99):.0e})"
            for axis, (probability, what) in enumerate(zip(self.misfit_probability, self.misfit, strict=True))
            if probability < MISFIT_PROBABILITY
        ]
        remedy = (
            f"do not trust these intervals: cut the recording to an interval where the {self.sensor} is at rest, or exclude the band of a "
            "filter by the highest frequency of the fit"
        )
        return (*sentences, remedy) if sentences else ()

    def listing(self) -> Table:
        """Return the coefficients with their intervals, as a table."""
        rows = []
        for axis, i in np.ndindex(*self.estimate.shape):
            unit, symbol = UNITS[self.sensor][self.terms[i]], SYMBOLS[self.terms[i]]
            supported = bool(self.supported[axis, i])
            ends = [float(values[axis, i] / unit.factor) for values in (self.estimate, self.lower, self.upper)]
            shown = ends if supported else [None, None, ends[2]]
            rows.append(("xyz"[axis], f"{unit.name} ({symbol})", unit.name, symbol, unit.label, *shown, supported))
        columns = (
            Column("axis", "axis"),
            Column("term"),
            Column(None, "term"),
            Column(None, "symbol"),
            Column("unit", "unit"),
            Column("estimate", "estimate", shown=lambda value: "not detected" if value is None else figure(value)),
            Column("from", "lower", shown=lambda value: "" if value is None else figure(value)),
            Column("to", "upper"),
            Column(None, "supported"),
        )
        samples, percent = f"{self.samples} samples of {self.sample_interval:.6g} s", 100.0 * self.confidence_level
        title = f"Noise of the {self.sensor}, {samples}, {percent:g} % intervals"
        return Table(title, columns, rows, self.warnings, left=3, name=f"{self.sensor}-noise")

    def summary(self) -> dict[str, Any]:
        """Return the coefficients and the misfit of each axis as plain values for JSON.

        Returns
        -------
        dict
            ``coefficients`` in the units of :data:`UNITS`, ``sample_interval_s``, ``confidence_level``, ``misfit_probability``, ``misfit``.
        """
        own = {name: getattr(self, name) for name in ("confidence_level", "misfit_probability", "misfit")}
        return plain({"sample_interval_s": self.sample_interval, "coefficients": self.listing().records, **own})  # type: ignore[no-any-return]


def fit_noise(
    source: Source,
    sample_interval: float | None = None,
    *,
    sensor: str = "gyro",
    kind: str = "rate",
    terms: Sequence[str] = TERMS,
    highest_frequency: float | None = None,
    confidence_level: float = 0.95,
) -> NoiseFit:
    """Return the noise coefficients of a sensor at rest (angle random walk, bias instability, …), with confidence intervals.

    A term that the record does not support has an upper bound.

    Parameters
    ----------
    source : Recording, ImuRecord, GyroSamples or array_like (n,) or (n, axes)
        Samples at rest, at most three axes. Gaps, NaN in an array, must not depend on the lost values; segments of at least 64 samples
        between them are used, whose number of samples is ``samples`` of the result.
    sample_interval : float, optional
        For an array: time between its samples, s.
    sensor : {"gyro", "accelerometer", "magnetometer"}, default "gyro"
        Sensor; the values of an array are in m/s² or T if it is not a gyro.
    kind : {"rate", "increments"}, default "rate"
        For an array: averages over each sample interval, or integrals.
    terms : sequence of str, default TERMS
        Terms to fit, of :data:`TERMS`.
    highest_frequency : float, optional
        Maximum frequency of the spectrum that is used, Hz, to exclude a low-pass filter or a vibration. Below it the samples are treated as
        averages.
    confidence_level : float, default 0.95
        Confidence of the intervals, 0.5 to 1.

    Returns
    -------
    NoiseFit
        Coefficients, SI, and intervals of each axis; can be passed to :func:`strapdown.estimate` as ``noise``.

    Notes
    -----
    The squared DCT-II coefficients of the record, j = 1 … n − 1 at frequency j/(2 n dt), are modelled as independent χ² of one
    degree of freedom with mean ``Σ θ_i V_i(j)``, θ = (Q², N², B², K²) ≥ 0, V the exact expectation for each noise on a finite record;
    a rate ramp is a mean. Coefficients are pooled in bins of 5 % in frequency. θ maximises the likelihood restricted for the ramp
    (REML). In a record with gaps the likelihood is that within each segment: the differences between the means of segments are not used,
    so that many short segments contain little information on a random walk. ``misfit_probability`` is the minimum over the segments, times
    their number.

    The terms present in the sensor are unknown. If one is absent, that is, at the boundary θ = 0 of the model, twice the decrease of the
    log-likelihood of the *other* terms is not χ² distributed: with all terms in the model their upper ends would be too low and their lower
    ends would exceed the truth too seldom (Self & Liang 1987). Nor may a term be omitted because it is not significant, since its
    contribution would be attributed to the others. The intervals are therefore averaged over all combinations of terms,
    ``Σ_m w_m Φ(r_m(θ)) = (1 ± level)/2``, r_m being the signed root of twice the decrease of the log-likelihood in combination m, maximised
    over its other terms (Fletcher & Turek 2012), with the weights ``w_m ∝ exp(log L_m − TERM_COST · coefficients)``. All axes are assumed
    to have the same terms: L is the likelihood of all axes, each with its own coefficients. The average for a term is over the combinations
    that contain it.

    References: Self & Liang, "Asymptotic properties of maximum likelihood estimators and likelihood ratio tests under
    nonstandard conditions", J. Am. Stat. Assoc. 82, 1987; Fletcher & Turek, "Model-averaged profile likelihood intervals", J.
    Agric. Biol. Environ. Stat. 17, 2012.

    Examples
    --------
    >>> import strapdown as sd
    >>> noise = sd.fit_noise(sd.read("rest.csv", units={"gyro": "deg/s"}))  # doctest: +SKIP
    >>> estimate = sd.estimate(record, noise=noise)  # doctest: +SKIP
    """
    record, dt, scale = averaged(source, sample_interval, sensor, kind)
    confidence_level = confidence(confidence_level)
    checks.one_of("sensor", sensor, UNITS)
    names = [checks.one_of("terms: term", term, TERMS) for term in terms]
    in_order = tuple(term for term in TERMS if term in names)
    random_terms = tuple(term for term in in_order if term != "rate_ramp")
    if not random_terms:
        raise InputError("terms names no random noise; add one of quantization, angle_random_walk, …")
    segments = _segments(record, dt, random_terms, highest_frequency)
    fits, misfits = _fit_axes(record, dt, scale, segments, random_terms, with_ramp="rate_ramp" in in_order)
    estimate, lower, upper = _of_axes(fits, in_order, confidence_level)
    return NoiseFit(
        terms=in_order,
        estimate=estimate,
        lower=lower,
        upper=upper,
        supported=~np.isnan(estimate),
        misfit_probability=np.array([probability for probability, _ in misfits]),
        misfit=tuple(what for _, what in misfits),
        confidence_level=confidence_level,
        samples=sum(segment.place.stop - segment.place.start for segment in segments),
        sample_interval=dt,
        sensor=sensor,
    )


def _fit_axes(
    record: Array,
    dt: float,
    scale: float,
    segments: Sequence[Segment],
    terms: tuple[str, ...],
    *,
    with_ramp: bool,
) -> tuple[list[AxisFit], list[tuple[float, str]]]:
    """Return the fit of each axis of a record, and its worst misfit: probability and description."""
    fits, misfits = [], []
    for axis in range(record.shape[1]):
        coefficients = [cosine_transform(record[segment.place, axis], scale) for segment in segments]
        each, whole = binned(coefficients, segments, dt)
        largest = scale * float(max(np.nanmax(record[:, axis]), -np.nanmin(record[:, axis])))
        if not np.any(whole.square > (1e-13 * largest) ** 2 * whole.number):
            raise InputError(
                f"values, axis {axis}, has no noise (it is constant or a straight line); pass a recorded sensor"
            )
        fits.append(_fit_axis(whole, with_ramp))
        best = fits[-1].best
        misfits.append(worst_misfit(coefficients, each, segments, best.theta, best.slope, terms, dt))
    return fits, misfits


def _segments(
    record: Array, dt: float, random_terms: tuple[str, ...], highest_frequency: float | None
) -> list[Segment]:
    """Return the segments of a record between its gaps, which have enough coefficients below the highest frequency."""
    places = without_gaps(np.asarray(~np.isnan(record).any(axis=1)))
    if not places:
        raise InputError(
            f"values has {len(record)} samples; at least {SHORTEST} without a gap are needed to separate the noise terms"
        )
    lasts = [last_coefficient(place.stop - place.start, dt, highest_frequency) for place in places]
    if highest_frequency is not None and (sum(lasts) < 32 or min(lasts) < 1):
        raise InputError(
            f"highest_frequency is {highest_frequency:g} Hz: only {sum(lasts)} coefficients are below it; raise it"
        )
    return [segment(place, dt, random_terms, highest_frequency) for place in places]


def without_gaps(known: NDArray[np.bool_]) -> list[slice]:
    """Return the segments of at least :data:`SHORTEST` samples between gaps."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= SHORTEST]


def curves_by_axis(fit: NoiseFit, deviation: AllanDeviation) -> list[dict[str, Array]]:
    """Return, for each axis, the curves of each fitted term and their total at the taus of ``deviation``, rad/s, for plotting."""
    filled = np.where(fit.supported, fit.estimate, 0.0)
    return [
        model_deviation(dict(zip(fit.terms, map(float, row), strict=True)), deviation.taus, fit.sample_interval)
        for row in filled
    ]


def to_gyro_parameters(fit: NoiseFit) -> dict[str, float | tuple[float, ...]]:
    """Return the coefficients by their names in the gyro specification.

    Parameters
    ----------
    fit : NoiseFit
        Coefficients of one sensor.

    Returns
    -------
    dict of str to float or tuple of float
        Coefficients, SI, one number or one per axis. A term that no axis supports is omitted; one that some axes support is 0 on the
        others.
    """
    return _by_name(fit, np.where(fit.supported, fit.estimate, 0.0), np.asarray(fit.supported.any(axis=0)))


def upper_bounds(fit: NoiseFit) -> dict[str, float | tuple[float, ...]]:
    """Return the upper ends, SI, by term, one number or one per axis, of the intervals of the terms that some axis does not support."""
    return _by_name(fit, fit.upper, np.asarray(~fit.supported.all(axis=0)))


def _by_name(fit: NoiseFit, values: Array, wanted: NDArray[np.bool_]) -> dict[str, float | tuple[float, ...]]:
    return {
        term: float(column[0]) if len(column) == 1 else tuple(map(float, column))
        for term, column, want in zip(fit.terms, values.T, wanted, strict=True)
        if want
    }


# Likelihood


class Optimum(NamedTuple):
    """Maximum-likelihood coefficients of one axis."""

    loss: float
    theta: Array
    slope: float
    variance: Array


class AxisFit(NamedTuple):
    """Likelihood of one axis: maximum-likelihood coefficients for each combination of terms, and the best; a fixed slope, or None."""

    bins: Bins
    slope: float | None
    combinations: dict[tuple[bool, ...], Optimum]
    best: Optimum


def _loss(bins: Bins, theta: Array, slope: float | None, restricted: bool) -> Optimum:
    """Return −log likelihood at ``theta``; ``slope`` None profiles the ramp, restricted (REML) or not."""
    variance = theta @ bins.basis
    if not variance.min() > 0.0:  # not a number too
        return Optimum(math.inf, theta, 0.0, variance)
    # Methods of arrays are several times faster than NumPy's functions on arrays as short as these.
    information = float((bins.ramp / variance).sum())
    best = float((bins.product / variance).sum()) / information if slope is None else slope
    power = bins.square - 2.0 * best * bins.product + best * best * bins.ramp
    loss = 0.5 * float((bins.number * np.log(variance) + power / variance).sum())
    if slope is None and restricted:
        loss += 0.5 * math.log(information)
    return Optimum(loss, theta, best, variance)


def _maximise(
    bins: Bins, start: Array, free: NDArray[np.bool_], *, slope: float | None = None, restricted: bool = True
) -> Optimum:
    """Return the maximum-likelihood theta ≥ 0 for a slope that is given or profiled."""

    def power(point: Optimum) -> Array:
        square = bins.square - 2.0 * point.slope * bins.product + point.slope**2 * bins.ramp
        return square + bins.ramp / (bins.ramp / point.variance).sum() if slope is None and restricted else square

    return scored(bins, lambda theta: _loss(bins, theta, slope, restricted), power, start, free)


def _first_guess(bins: Bins) -> Array:
    """Return a positive initial theta: each term at most as large as the power of every octave allows, divided by the number of terms."""
    edges = np.searchsorted(np.cumsum(bins.number), 2.0 ** np.arange(3, 60))
    edges = np.unique(np.concatenate([[0], edges[edges < len(bins.number)]]))
    power = np.add.reduceat(bins.square, edges) / np.add.reduceat(bins.number, edges)
    basis = np.add.reduceat(bins.basis * bins.number, edges, axis=1) / np.add.reduceat(bins.number, edges)
    return np.asarray(np.min(np.maximum(power, 1e-9 * power.max()) / basis, axis=1) / len(basis))


def _fit_axis(bins: Bins, with_ramp: bool) -> AxisFit:
    """Return the maximum-likelihood coefficients of each combination of terms on one axis."""
    slope, guess = None if with_ramp else -bins.first_slope, _first_guess(bins)
    combinations = {
        subset: _maximise(bins, np.where(subset, guess, 0.0), np.array(subset), slope=slope)
        for subset in itertools.product((False, True), repeat=len(guess))
        if any(subset)
    }
    return AxisFit(bins, slope, combinations, min(combinations.values(), key=lambda optimum: optimum.loss))


def _weights(fits: Sequence[AxisFit], i: int) -> dict[tuple[bool, ...], float]:
    """Return the weights of the combinations with term i; their sum is 1."""
    cost = {
        subset: sum(fit.combinations[subset].loss + TERM_COST * sum(subset) for fit in fits)
        for subset in fits[0].combinations
        if subset[i]
    }
    least = min(cost.values())
    total = sum(math.exp(least - value) for value in cost.values())
    return {subset: math.exp(least - value) / total for subset, value in cost.items()}


def _interval(
    fit: AxisFit, i: int, weights: Mapping[tuple[bool, ...], float], confidence_level: float
) -> tuple[float, float, float]:
    """Return estimate, lower and upper end of a coefficient on one axis; if not supported NaN, 0 and the upper end."""
    from scipy.optimize import brentq
    from scipy.special import ndtr, ndtri

    tail = 0.5 - 0.5 * confidence_level
    heavy = {subset: weight for subset, weight in weights.items() if weight > min(0.05 * tail, SUPPORT_PROBABILITY)}
    total = sum(heavy.values())

    @functools.cache
    def below(size: float) -> float:
        """Return the averaged probability that the coefficient is below ``size``."""
        return float(sum(w / total * ndtr(_signed_root(fit, np.array(c), i, size**2)) for c, w in heavy.items()))

    def crossing(probability: float, low: float, high: float) -> float:
        # The normal score is nearly linear, so the solver converges fast.
        score = lambda size: ndtri(min(max(below(size), 1e-15), 1.0 - 1e-15)) - ndtri(probability)  # noqa: E731
        return float(brentq(score, low, high, xtol=1e-5 * high))

    sizes = {subset: math.sqrt(fit.combinations[subset].theta[i]) for subset in heavy}
    top, zero = max(sizes.values()), below(0.0)
    high = top if top > 0.0 else math.sqrt(_first_guess(fit.bins)[i])
    while below(high) < 1.0 - tail:
        high *= 1.5
    upper = crossing(1.0 - tail, top if below(top) < 1.0 - tail else 0.0, high)
    if zero >= SUPPORT_PROBABILITY:
        return math.nan, 0.0, upper
    estimate = sum(heavy[subset] / total * size for subset, size in sizes.items())
    return estimate, crossing(tail, 0.0, top) if zero < tail else 0.0, upper


def _signed_root(fit: AxisFit, subset: NDArray[np.bool_], i: int, value: float) -> float:
    """Return the signed root of twice the decrease of the log-likelihood of a combination of terms from its maximum to θ_i = ``value``."""
    best = fit.combinations[tuple(subset.tolist())]
    start, free = best.theta.copy(), subset.copy()
    start[i], free[i] = value, False
    if not np.any(start > 0.0):
        start = np.where(free, _first_guess(fit.bins), start)
    fall = _maximise(fit.bins, start, free, slope=fit.slope).loss - best.loss
    return math.copysign(math.sqrt(2.0 * max(0.0, fall)), value - best.theta[i])


def _of_axes(fits: Sequence[AxisFit], terms: tuple[str, ...], confidence_level: float) -> Array:
    """Return estimate, lower and upper end of each coefficient (3, axes, terms); if not supported NaN, 0 and the upper end."""
    ends = np.empty((3, len(fits), len(terms)))
    for i, term in enumerate(terms):
        weights = {} if term == "rate_ramp" else _weights(fits, i)
        for axis, fit in enumerate(fits):
            ends[:, axis, i] = _interval(fit, i, weights, confidence_level) if weights else _ramp(fit, confidence_level)
    return ends


def _ramp(fit: AxisFit, confidence_level: float) -> tuple[float, float, float]:
    """Return estimate, lower and upper end of the ramp; if not supported NaN, 0 and a bound on its magnitude."""
    from scipy.optimize import brentq
    from scipy.stats import chi2

    bins, free = fit.bins, np.ones(len(fit.best.theta), dtype=bool)
    top = _maximise(bins, fit.best.theta, free, restricted=False)
    drop = 0.5 * float(chi2.ppf(confidence_level, 1))

    def fall(slope: float) -> float:
        return _maximise(bins, top.theta, free, slope=slope).loss - top.loss

    def crossing(step: float) -> float:
        near, far = top.slope, top.slope + step
        while fall(far) < drop:
            near, far = far, top.slope + 2.0 * (far - top.slope)
        return float(brentq(lambda v: fall(v) - drop, near, far, xtol=1e-5 * abs(far - near))) + bins.first_slope

    error = 1.0 / math.sqrt(float(np.sum(bins.ramp / top.variance)))
    low, high = crossing(-2.0 * error), crossing(2.0 * error)
    if fall(-bins.first_slope) > 0.5 * float(chi2.ppf(1.0 - 2.0 * SUPPORT_PROBABILITY, 1)):
        return top.slope + bins.first_slope, low, high
    return math.nan, 0.0, max(abs(low), abs(high))
