"""Noise coefficients of a record at rest, by maximum likelihood on its cosine transform, with model-averaged profile-likelihood intervals.

Quantisation Q, angle random walk N, bias instability B, rate random walk K and rate ramp R, as in :mod:`strapdown.allan.deviation`.

Why not least squares on the Allan deviation: its values at neighbouring τ share nearly all their data, so their errors are strongly
correlated, and at long τ, which alone contains K and R, they are far from Gaussian. The cosine (DCT-II) coefficients of
averaged-rate samples are independent and Gaussian instead, exactly for angle and rate random walk, which a DCT diagonalises, and
nearly for flicker and quantisation, whose exact variances are used; the Allan variance is a smoothing of their squares and holds no
more. So no covariance between taus has to be modelled, and the intervals are those of a likelihood.

Quantisation is white only while successive angles differ by noise or motion of about half a step or more; below that its error
follows the motion, no coefficient describes it, and ``NoiseFit.misfit_probability`` approaches zero.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import checks, units
from strapdown.allan.deviation import TERMS, AllanDeviation, averaged, confidence, model_deviation
from strapdown.allan.spectrum import (
    Bins,
    Segment,
    bin_slices,
    bin_starts,
    binned,
    cosine_transform,
    expected_power,
    last_coefficient,
    mean_power,
    ramp_coefficients,
    segment,
)
from strapdown.checks import Array, InputError
from strapdown.results import Listed, Listing, figure

SYMBOLS = dict(zip(TERMS, "QNBKR", strict=True))

SENSORS = ("gyro", "accelerometer", "magnetometer")
_MICRO_G = 1e-6 * units.STANDARD_GRAVITY
UNITS: Mapping[str, Mapping[str, tuple[str, float]]] = {
    "gyro": {
        "quantization": ("arcsec", units.ARCSECOND),
        "angle_random_walk": ("°/√h", units.DEGREE_PER_ROOT_HOUR),
        "bias_instability": ("°/h", units.DEGREE_PER_HOUR),
        "rate_random_walk": ("°/h/√h", units.DEGREE_PER_HOUR_PER_ROOT_HOUR),
        "rate_ramp": ("°/h/h", units.DEGREE_PER_HOUR / 3600.0),
    },
    "accelerometer": {
        "quantization": ("mm/s", 1e-3),
        "angle_random_walk": ("µg/√Hz", _MICRO_G),
        "bias_instability": ("µg", _MICRO_G),
        "rate_random_walk": ("µg/√h", _MICRO_G / 60.0),
        "rate_ramp": ("µg/h", _MICRO_G / 3600.0),
    },
    "magnetometer": {
        "quantization": ("nT s", 1e-9),
        "angle_random_walk": ("nT/√Hz", 1e-9),
        "bias_instability": ("nT", 1e-9),
        "rate_random_walk": ("nT/√h", 1e-9 / 60.0),
        "rate_ramp": ("nT/h", 1e-9 / 3600.0),
    },
}
"""Unit at the rim and its factor to SI, for each term of each sensor."""
NAMES: Mapping[str, Mapping[str, str]] = {
    "gyro": {},
    "accelerometer": {
        "angle_random_walk": "velocity_random_walk",
        "rate_random_walk": "acceleration_random_walk",
        "rate_ramp": "acceleration_ramp",
    },
    "magnetometer": {"angle_random_walk": "white_noise", "rate_random_walk": "random_walk", "rate_ramp": "ramp"},
}
"""Name of a term by sensor, where it differs from that of a gyro."""

TERM_COST = 1.5
"""Log-likelihood by which a coefficient must raise that of a combination of terms to raise its weight (Akaike's: 1).

Measured in 30 s of white noise and random walk alike on three axes: at a cost of 1 the interval of the largest axis covers 97.9 % (too
wide), at 1.5 96.6 %. Beside flicker that the record hardly shows, one axis's interval of the random walk covers 94 % at 1, 88 % at 1.5 and
86 % at 2.
"""

SUPPORT_PROBABILITY = 1e-3
"""A term is supported if a record without it would show as much of it by chance with less than this probability."""

MISFIT_PROBABILITY = 1e-3
"""Value of ``NoiseFit.misfit_probability`` below which the record contains more than the noises."""

SHORTEST = 64
"""Samples of the shortest segment without a gap that a fit uses."""

_STRETCHES = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseFit(Listed):
    """Noise coefficients of a record, SI units.

    Attributes
    ----------
    terms : tuple of str
        Terms fitted, a subset of :data:`TERMS`; they index the last axis below.
    estimate : ndarray (axes, terms)
        Coefficients, averaged over the combinations of terms; NaN where the record does not support the term.
    lower, upper : ndarray (axes, terms)
        Two-sided interval of confidence ``level``. Where the term is not supported ``lower`` is 0 and ``upper`` the upper end of
        that interval (for the ramp: a bound on its size), so that the pair covers the truth at least as often as ``level`` whether
        or not the term is supported; a looser bound there would fail where the threshold of support selects the low estimates.
    supported : ndarray of bool (axes, terms)
        Whether the record supports the term.
    covariance : ndarray (axes, terms, terms)
        Covariance of the estimates, from the Fisher information of all terms at their most likely values; NaN for unsupported terms.
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

    @property
    def warnings(self) -> tuple[str, ...]:
        """What of an axis is no such noise, a sentence each."""
        return tuple(
            f"axis {'xyz'[axis]} holds more than such noises: {what} (probability {max(probability, 1e-99):.0e})"
            for axis, (probability, what) in enumerate(zip(self.misfit_probability, self.misfit, strict=True))
            if probability < MISFIT_PROBABILITY
        )

    def listing(self) -> Listing:
        """Return the coefficients with their intervals, as a table."""
        rows = []
        for row in table(self):
            seen = (figure(row["estimate"]), figure(row["lower"])) if row["supported"] else ("not seen", "")
            what = f"{row['term']} ({row['symbol']})"
            rows.append(("xyz"[row["axis"]], what, row["unit"], *seen, figure(row["upper"])))
        title = f"Noise of the {self.sensor}, {self.samples} samples of {self.sample_interval:.6g} s, {100.0 * self.level:g} % intervals"
        return Listing(title, ("axis", "term", "unit", "estimate", "from", "to"), rows, self.warnings, left=3)


def fit_noise(
    values: ArrayLike,
    sample_interval: float,
    *,
    kind: str = "rate",
    sensor: str = "gyro",
    terms: Sequence[str] = TERMS,
    highest_frequency: float | None = None,
    level: float = 0.95,
) -> NoiseFit:
    """Return the noise coefficients of a record at rest, each with its interval, or a bound where it is not supported.

    Parameters
    ----------
    values : array_like (n,) or (n, axes)
        Averaged-rate samples, rad/s, or angle increments, rad, at most three axes. Missing ones, NaN, must not depend on the values
        lost; the segments between them of at least 64 samples are used, which ``samples`` of the result counts.
    sample_interval : float
        Sample interval, s.
    kind : {"rate", "increments"}, default "rate"
        Kind of the values.
    sensor : {"gyro", "accelerometer", "magnetometer"}, default "gyro"
        Sensor of the values, in m/s² or T where it is no gyro.
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

    Notes
    -----
    The squared DCT-II coefficients of the record, j = 1 … n − 1 at frequency j/(2 n dt), are modelled as independent χ² of one
    degree of freedom around ``Σ θ_i V_i(j)``, θ = (Q², N², B², K²) ≥ 0, V the exact expectation for each noise on a finite record;
    a rate ramp is a mean. Coefficients are pooled in bins of 5 % in frequency. θ maximises the likelihood restricted for the ramp
    (REML). In a record with gaps the likelihood is that within each segment: the differences between the means of segments are not used,
    so that many short ones contain little information on a random walk. ``misfit_probability`` is that of the worst, times their number.

    Which terms the sensor has is not known, and where one is absent, at the bound θ = 0 of the model, twice the fall of the
    likelihood of the *other* terms is no χ²: with all terms in the model their upper ends would be too low and their lower ends
    fail too seldom (Self & Liang 1987). Nor may a term be left out because the record does not show it, for what it adds would be
    attributed to the others. So the intervals are averaged over all combinations of terms, ``Σ_m w_m Φ(r_m(θ)) = (1 ± level)/2``, r_m
    being the signed root of twice the fall of the likelihood in combination m, maximised over its other terms (Fletcher & Turek
    2012), with the weights ``w_m ∝ exp(log L_m − TERM_COST · coefficients)``. The axes are units of one kind: L is the likelihood of
    all axes, each with its own coefficients. For a term count the combinations with it.

    References: Self & Liang, "Asymptotic properties of maximum likelihood estimators and likelihood ratio tests under
    nonstandard conditions", J. Am. Stat. Assoc. 82, 1987; Fletcher & Turek, "Model-averaged profile likelihood intervals", J.
    Agric. Biol. Environ. Stat. 17, 2012.
    """
    record, dt, scale = averaged(values, sample_interval, kind)
    level = confidence(level)
    checks.one_of("sensor", sensor, SENSORS)
    chosen = tuple(checks.one_of("terms: term", term, TERMS) for term in terms)
    chosen = tuple(term for term in TERMS if term in chosen)
    random_terms = tuple(term for term in chosen if term != "rate_ramp")
    if not random_terms:
        raise InputError("terms names no random noise; add one of quantization, angle_random_walk, …")
    places = without_gaps(np.asarray(~np.isnan(record).any(axis=1)))
    if not places:
        raise InputError(
            f"values has {len(record)} samples; at least {SHORTEST} are needed to separate the noises, in a row without a gap"
        )
    lasts = [last_coefficient(place.stop - place.start, dt, highest_frequency) for place in places]
    if highest_frequency is not None and (sum(lasts) < 32 or min(lasts) < 1):
        raise InputError(
            f"highest_frequency is {highest_frequency:g} Hz: only {sum(lasts)} coefficients lie below; raise it"
        )
    segments = [segment(place, dt, random_terms, highest_frequency) for place in places]
    fits, misfits = [], []
    for axis in range(record.shape[1]):
        rate = record[:, axis]
        coefficients = [cosine_transform(rate[place], scale) for place in places]
        each, whole = binned(coefficients, segments, dt)
        largest = scale * float(max(np.nanmax(rate), -np.nanmin(rate)))
        if not np.any(whole.square > (1e-13 * largest) ** 2 * whole.number):
            raise InputError(
                f"values, axis {axis}, holds no noise (it is constant or a straight line); pass a recorded sensor"
            )
        fits.append(fit_axis(whole, "rate_ramp" in chosen))
        misfits.append(_worst_misfit(coefficients, each, fits[-1].best, random_terms, segments, dt))
    samples = sum(place.stop - place.start for place in places)
    fit = _of_axes(chosen, fits, misfits, level=level, samples=samples, sample_interval=dt)
    return replace(fit, sensor=sensor)


def without_gaps(known: NDArray[np.bool_]) -> list[slice]:
    """Return the segments of samples between gaps, without those of fewer than :data:`SHORTEST`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= SHORTEST]


def expected_errors(parameters: Mapping[str, float], samples: int, sample_interval: float) -> dict[str, float]:
    """Return the standard errors, SI, that a fit of all terms would have: how long a record must be.

    ``parameters`` are coefficients, SI, by name in :data:`TERMS`. The Cramér–Rao bound of the cosine coefficients, which the fit attains
    where an error is well below the coefficient itself; elsewhere the record does not support the term.
    """
    checks.known_keys("parameters", parameters, TERMS)
    dt = checks.positive("sample_interval", sample_interval, unit="s")
    last = checks.count("samples", samples, minimum=64) - 1
    starts = bin_starts(last)
    random_terms = TERMS[:4]
    basis = np.stack([mean_power(term, samples, dt, starts, last) for term in random_terms])
    slices = bin_slices(starts, last)
    number = np.array([float(s.stop - s.start) for s in slices])
    theta = np.array([checks.non_negative(term, parameters.get(term, 0.0)) ** 2 for term in random_terms])
    if not np.any(theta > 0.0):
        raise InputError("parameters names no random noise; give one of quantization, angle_random_walk, …")
    variance = theta @ basis
    none = np.zeros_like(number)
    errors = _standard_errors(_information(Bins(number, none, none, none, basis, 0.0), variance))
    found = {
        term: float(0.5 * error / math.sqrt(value))  # d√θ/dθ
        for term, error, value in zip(random_terms, errors, theta, strict=True)
        if value > 0.0
    }
    if parameters.get("rate_ramp", 0.0) != 0.0:
        ramp = [float(np.sum((dt * ramp_coefficients(samples, np.arange(s.start, s.stop))) ** 2)) for s in slices]
        found["rate_ramp"] = 1.0 / math.sqrt(float(np.sum(np.array(ramp) / variance)))
    return found


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
    """Return the upper ends, SI, by term, one or one an axis, of the intervals of the terms that some axis does not support."""
    return _by_name(fit, fit.upper, np.asarray(~fit.supported.all(axis=0)))


def _by_name(fit: NoiseFit, values: Array, wanted: NDArray[np.bool_]) -> dict[str, float | tuple[float, ...]]:
    return {
        term: float(column[0]) if len(column) == 1 else tuple(map(float, column))
        for term, column, want in zip(fit.terms, values.T, wanted, strict=True)
        if want
    }


def name(sensor: str, term: str) -> str:
    """Return the name of a term for a sensor."""
    return NAMES[checks.one_of("sensor", sensor, SENSORS)].get(term, term)


def table(fit: NoiseFit) -> list[dict[str, Any]]:
    """Return one row per axis and term for printing, in the units of :data:`UNITS`: estimate, lower and upper (NaN: no such value)."""
    rows = []
    for axis, i in np.ndindex(*fit.estimate.shape):
        term = fit.terms[i]
        unit, factor = UNITS[fit.sensor][term]
        ends = {end: float(getattr(fit, end)[axis, i] / factor) for end in ("estimate", "lower", "upper")}
        known = {"unit": unit, "supported": bool(fit.supported[axis, i])}
        rows.append({"axis": axis, "term": name(fit.sensor, term), "symbol": SYMBOLS[term], **ends, **known})
    return rows


# Likelihood


class Optimum(NamedTuple):
    """Most likely coefficients of one axis."""

    loss: float
    theta: Array
    slope: float
    variance: Array


class AxisFit(NamedTuple):
    """Likelihood of one axis: the most likely coefficients of each combination of terms, and of all; a slope that is fixed, or None."""

    bins: Bins
    slope: float | None
    combinations: dict[tuple[bool, ...], Optimum]
    best: Optimum


def _loss(bins: Bins, theta: Array, slope: float | None, restricted: bool) -> Optimum:
    """Return −log likelihood at ``theta``; ``slope`` None profiles the ramp, restricted (REML) or not."""
    variance = theta @ bins.basis
    if not np.all(variance > 0.0):
        return Optimum(math.inf, theta, 0.0, variance)
    information = float(np.sum(bins.ramp / variance))
    best = float(np.sum(bins.product / variance)) / information if slope is None else slope
    power = bins.square - 2.0 * best * bins.product + best * best * bins.ramp
    loss = 0.5 * float(np.sum(bins.number * np.log(variance) + power / variance))
    if slope is None and restricted:
        loss += 0.5 * math.log(information)
    return Optimum(loss, theta, best, variance)


def _maximise(
    bins: Bins, start: Array, free: NDArray[np.bool_], *, slope: float | None = None, restricted: bool = True
) -> Optimum:
    """Return the most likely theta ≥ 0 by Fisher scoring, each step a non-negative least-squares problem, with step halving."""
    from scipy.optimize import nnls

    held = np.where(free, 0.0, start)
    point = _loss(bins, start, slope, restricted)
    if not free.any():
        return point
    for _ in range(100):
        variance = point.variance
        power = bins.square - 2.0 * point.slope * bins.product + point.slope**2 * bins.ramp
        if slope is None and restricted:
            power = power + bins.ramp / np.sum(bins.ramp / variance)
        weight = np.sqrt(bins.number) / variance
        residual = power / bins.number - held @ bins.basis
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


def _first_guess(bins: Bins) -> Array:
    """Return a positive theta: every term at the level where it alone would explain the quietest octave it is strongest in."""
    edges = np.searchsorted(np.cumsum(bins.number), 2.0 ** np.arange(3, 60))
    edges = np.unique(np.concatenate([[0], edges[edges < len(bins.number)]]))
    power = np.add.reduceat(bins.square, edges) / np.add.reduceat(bins.number, edges)
    basis = np.add.reduceat(bins.basis * bins.number, edges, axis=1) / np.add.reduceat(bins.number, edges)
    return np.asarray(np.min(np.maximum(power, 1e-9 * power.max()) / basis, axis=1) / len(basis))


def _information(bins: Bins, variance: Array) -> Array:
    """Return the Fisher information of theta."""
    weighted = bins.basis * np.sqrt(0.5 * bins.number) / variance
    return np.asarray(weighted @ weighted.T)


def _standard_errors(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information * np.outer(scale, scale))
    return np.asarray(np.sqrt(np.maximum(np.diag(inverse), 0.0)) * scale)


def fit_axis(bins: Bins, with_ramp: bool) -> AxisFit:
    """Return the most likely coefficients of each combination of terms on one axis."""
    slope, guess = None if with_ramp else -bins.first_slope, _first_guess(bins)
    combinations = {
        chosen: _maximise(bins, np.where(chosen, guess, 0.0), np.array(chosen), slope=slope)
        for chosen in itertools.product((False, True), repeat=len(guess))
        if any(chosen)
    }
    return AxisFit(bins, slope, combinations, min(combinations.values(), key=lambda one: one.loss))


def _weights(fits: Sequence[AxisFit], i: int) -> dict[tuple[bool, ...], float]:
    """Return the weights of the combinations with term i, of sum 1."""
    cost = {
        chosen: sum(fit.combinations[chosen].loss + TERM_COST * sum(chosen) for fit in fits)
        for chosen in fits[0].combinations
        if chosen[i]
    }
    least = min(cost.values())
    total = sum(math.exp(least - value) for value in cost.values())
    return {chosen: math.exp(least - value) / total for chosen, value in cost.items()}


def _interval(
    fit: AxisFit, i: int, weights: Mapping[tuple[bool, ...], float], level: float
) -> tuple[float, float, float]:
    """Return estimate, lower and upper of a term's coefficient on one axis; not supported: NaN, 0 and the upper end."""
    from scipy.optimize import brentq
    from scipy.special import ndtr, ndtri

    tail = 0.5 - 0.5 * level
    heavy = {chosen: weight for chosen, weight in weights.items() if weight > min(0.05 * tail, SUPPORT_PROBABILITY)}
    total = sum(heavy.values())

    @functools.cache
    def below(size: float) -> float:
        """Return the averaged probability that the coefficient is less."""
        return float(sum(w / total * ndtr(_signed_root(fit, np.array(c), i, size**2)) for c, w in heavy.items()))

    def crossing(probability: float, low: float, high: float) -> float:
        # The normal score is nearly a straight line, which the solver likes.
        score = lambda size: ndtri(min(max(below(size), 1e-15), 1.0 - 1e-15)) - ndtri(probability)  # noqa: E731
        return float(brentq(score, low, high, xtol=1e-5 * high))

    sizes = {chosen: math.sqrt(fit.combinations[chosen].theta[i]) for chosen in heavy}
    top, zero = max(sizes.values()), below(0.0)
    high = top if top > 0.0 else math.sqrt(_first_guess(fit.bins)[i])
    while below(high) < 1.0 - tail:
        high *= 1.5
    upper = crossing(1.0 - tail, top if below(top) < 1.0 - tail else 0.0, high)
    if zero >= SUPPORT_PROBABILITY:
        return math.nan, 0.0, upper
    estimate = sum(heavy[chosen] / total * size for chosen, size in sizes.items())
    return estimate, crossing(tail, 0.0, top) if zero < tail else 0.0, upper


def _signed_root(fit: AxisFit, chosen: NDArray[np.bool_], i: int, value: float) -> float:
    """Return the root of twice the fall of log likelihood from the most likely coefficients of some terms to ``value`` of θ_i, signed."""
    best = fit.combinations[tuple(chosen.tolist())]
    start, free = best.theta.copy(), chosen.copy()
    start[i], free[i] = value, False
    if not np.any(start > 0.0):
        start = np.where(free, _first_guess(fit.bins), start)
    fall = _maximise(fit.bins, start, free, slope=fit.slope).loss - best.loss
    return math.copysign(math.sqrt(2.0 * max(0.0, fall)), value - best.theta[i])


def _covariance(fit: AxisFit, estimate: Array) -> Array:
    """Return the covariance of the coefficients of one axis from the Fisher information; NaN where there is no estimate."""
    supported = ~np.isnan(estimate)
    size = np.where(supported, estimate, np.sqrt(fit.best.theta))
    used = np.flatnonzero(size > 0.0)
    information = _information(fit.bins, fit.best.variance)[np.ix_(used, used)]
    shrink = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information * np.outer(shrink, shrink)) * np.outer(shrink, shrink)
    covariance = np.full((len(estimate), len(estimate)), np.nan)
    covariance[np.ix_(used, used)] = inverse * np.outer(0.5 / size[used], 0.5 / size[used])  # d√θ/dθ
    covariance[~supported, :] = np.nan
    covariance[:, ~supported] = np.nan
    return covariance


def _of_axes(
    terms: tuple[str, ...],
    fits: Sequence[AxisFit],
    misfits: Sequence[tuple[float, str]],
    *,
    level: float,
    samples: int,
    sample_interval: float,
) -> NoiseFit:
    """Return the fits of single axes as one, with intervals; a misfit is its probability and what was seen."""
    count = len(fits[0].best.theta)
    estimate, lower, upper = np.empty((3, len(fits), len(terms)))
    covariance = np.full((len(fits), len(terms), len(terms)), np.nan)
    for i in range(count):
        weights = _weights(fits, i)
        for axis, fit in enumerate(fits):
            estimate[axis, i], lower[axis, i], upper[axis, i] = _interval(fit, i, weights, level)
    for axis, fit in enumerate(fits):
        covariance[axis, :count, :count] = _covariance(fit, estimate[axis, :count])
        if len(terms) > count:
            estimate[axis, -1], lower[axis, -1], upper[axis, -1] = _fit_ramp(fit, level)
            if not math.isnan(estimate[axis, -1]):
                covariance[axis, -1, :-1] = covariance[axis, :-1, -1] = np.where(
                    np.isnan(estimate[axis, :-1]), np.nan, 0.0
                )
                covariance[axis, -1, -1] = 1.0 / np.sum(fit.bins.ramp / fit.best.variance)
    return NoiseFit(
        terms=terms,
        estimate=estimate,
        lower=lower,
        upper=upper,
        supported=~np.isnan(estimate),
        covariance=covariance,
        misfit_probability=np.array([probability for probability, _ in misfits]),
        misfit=tuple(what for _, what in misfits),
        level=level,
        samples=samples,
        sample_interval=sample_interval,
    )


def _fit_ramp(fit: AxisFit, level: float) -> tuple[float, float, float]:
    """Return estimate, lower and upper of the ramp; unsupported: NaN, 0 and a bound on its size."""
    from scipy.optimize import brentq
    from scipy.stats import chi2

    bins, free = fit.bins, np.ones(len(fit.best.theta), dtype=bool)
    top = _maximise(bins, fit.best.theta, free, restricted=False)
    drop = 0.5 * float(chi2.ppf(level, 1))

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


# Misfit


def _worst_misfit(
    coefficients: Sequence[Array],
    each: Sequence[Bins],
    best: Optimum,
    random_terms: tuple[str, ...],
    segments: Sequence[Segment],
    dt: float,
) -> tuple[float, str]:
    """Return the least probability of :func:`_misfit_of` over the segments, times their number, and its description."""
    found = []
    for coefficient, bins, one in zip(coefficients, each, segments, strict=True):
        own = best._replace(variance=best.theta @ bins.basis)
        probability, what = _misfit_of(coefficient, bins, own, random_terms, one, dt)
        where = "" if len(segments) == 1 else f"in the segment from {one.place.start * dt:.6g} s "
        found.append((probability, where + what))
    probability, what = min(found, key=lambda one: one[0])
    return min(1.0, len(found) * probability), what


def _misfit_of(
    coefficient: Array, bins: Bins, best: Optimum, random_terms: tuple[str, ...], one: Segment, dt: float
) -> tuple[float, str]:
    """Return the probability of a departure from the fit this large, and its description; overwrites ``coefficient``.

    Divided by their fitted sizes and transformed back, the coefficients are a white series of unit variance. A turn or a step of the
    bias, whose spectrum may pass for a random walk's, stands out in it. Of three tests the smallest probability is multiplied by three.
    """
    samples, last = len(coefficient), one.last
    for s in bin_slices(one.starts, last):
        j = np.arange(s.start, s.stop)
        variance = np.zeros(len(j))
        for term, theta in zip(random_terms, best.theta, strict=True):
            if theta > 0.0:
                variance += theta * expected_power(term, samples, dt, j)
        coefficient[s] -= (bins.first_slope + best.slope) * dt * ramp_coefficients(samples, j)
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


def _spectrum_probability(bins: Bins, best: Optimum) -> float:
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
