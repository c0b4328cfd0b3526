"""The verdict: does the filter's covariance agree with its errors? In words, with the evidence, at one stated probability of a false alarm.

Every statistic gives a p-value, exact or nearly so. Holm's procedure (1979) combines them: whatever their dependence, the probability that
a consistent filter is rejected by any of them is at most 1 − ``probability``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from strapdown.checks import Array, InputError, unit_quaternions
from strapdown.consistency.bounds import log_mean_bounds, mean_bounds, mean_p_value, tail
from strapdown.consistency.manifold import SUBSETS, errors, nees
from strapdown.consistency.timeaverage import time_average
from strapdown.consistency.whiteness import (
    anderson_darling,
    cross_correlation_p_value,
    ljung_box,
    mean_innovation_p_value,
)
from strapdown.estimation.setup.for_record import unmodelled_errors
from strapdown.files import plain
from strapdown.records import Estimate, Truth
from strapdown.results import Listed, Listing, figure

Answer = Literal["consistent", "not consistent", "cannot tell"]

MIN_SAMPLES = 50
"""Minimum number of innovations of a sensor for the tests of whiteness, normality and mean."""

FEWEST_TO_AVERAGE = 20
"""Minimum number of epochs for errors to be judged over the run and not only at the end."""

RESOLUTION = 1.5
"""A filter that passes is "consistent" if the tests would have detected a σ wrong by this factor; else "cannot tell"."""

STATES = ("attitude", "bias")
"""States of every filter."""

WITHOUT_TRUTH = (
    "without a truth only the innovations are judged: they do not show an attitude error that all sensors share, "
    "nor a bias error that the initial state hides, such as commutation of coning"
)
"""A limit of a judgement."""

_LEANINGS = {
    frozenset[bool](): "the filter's model does not hold",
    frozenset({True}): "the filter is optimistic (its σ are too small)",
    frozenset({False}): "the filter is pessimistic (its σ are too large)",
    frozenset({True, False}): "the filter's σ are too small in part and too large in part",
}
"""Reason by whether the ratios that contradict the filter are greater than 1."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One statistic with its bounds for a consistent filter.

    Parameters
    ----------
    name : str
        Statistic: "NIS", "whiteness", "normality", "mean innovation", "cross-correlation", "NEES at the end",
        "time-averaged NEES", "ANEES", …
    of : str
        Sensor or subset of the states.
    value : float
        Value of the statistic; NIS and NEES per degree of freedom, 1 for a consistent filter.
    low : float, default nan
        Lower of the two-sided bounds, all findings together: the value is outside them if ``rejected``. NaN for a statistic without
        bounds and before the judgement.
    high : float, default nan
        Upper of these bounds.
    p_value : float
        Probability of a value at least as extreme for a consistent filter.
    samples : float
        Number of samples of the statistic; the effective number if they are correlated.
    degrees : int, default 1
        Degrees of freedom of one sample.
    epochs : int, default 1
        Number of epochs, of which the value is that of the worst (Bonferroni).
    at : str, default ""
        The worst epoch in words.
    rejected : bool, default False
        Whether it contradicts the filter, all findings together (Holm).
    means : str, default ""
        Explanation in words, valid if it is rejected.
    """

    name: str
    of: str
    value: float
    low: float = math.nan
    high: float = math.nan
    p_value: float
    samples: float
    degrees: int = 1
    epochs: int = 1
    at: str = ""
    rejected: bool = False
    means: str = ""

    @property
    def is_ratio(self) -> bool:
        """Whether the value is a mean χ² per degree of freedom, whose root is the factor by which σ is too small."""
        return self.name in _RATIOS

    @property
    def label(self) -> str:
        """Sensor or states, with the epoch if there is one."""
        return f"{self.of}, {self.at}" if self.at else self.of

    def _with_bounds(self, error: float) -> Finding:
        """Return the finding with the bounds of its value beyond which the p-value is below ``error``."""
        if not (self.is_ratio or self.name == LOG_NEES):
            return self
        within = 1.0 - error / self.epochs
        if self.is_ratio:
            low, high = mean_bounds(self.degrees, self.samples, within)
        else:
            low, high = log_mean_bounds(self.degrees, int(self.samples), within)
        return replace(self, low=low, high=high)


_INNOVATIONS = "innovations of "
LOG_NEES = "log-NEES"
_RATIOS = ("NIS", "NEES at the end", "time-averaged NEES", "ANEES")


@dataclass(frozen=True, kw_only=True)
class Power:
    """Smallest error of a σ that the tests detect."""

    of: str
    """"innovations of SENSOR", or a state: "attitude", "bias", an error state."""
    factor: float
    """A σ too small or large by this factor is detected with about the verdict's probability; infinite if no test covers it."""

    @property
    def seen(self) -> bool:
        """Whether the factor is at most :data:`RESOLUTION`."""
        return self.factor <= RESOLUTION


@dataclass(frozen=True, kw_only=True)
class Judgement(Listed):
    """A verdict with its evidence.

    Parameters
    ----------
    verdict : {"consistent", "not consistent", "cannot tell"}
        Whether the covariance agrees with the errors.
    reason : str
        Reason for the verdict, one sentence.
    findings : tuple of Finding
        Every statistic with its bounds and p-value.
    limits : tuple of str
        Limitations of the evidence, in words.
    probability : float
        Minimum probability that a consistent filter is not rejected.
    power : tuple of Power, default empty
        For the innovations of each sensor and for each state, the smallest factor on σ that the tests would have detected.
    unmodelled : tuple of str, default empty
        Specified errors that the filter has no state for.
    """

    verdict: Answer
    reason: str
    findings: tuple[Finding, ...]
    limits: tuple[str, ...]
    probability: float
    power: tuple[Power, ...] = ()
    unmodelled: tuple[str, ...] = ()

    @property
    def states(self) -> tuple[str, ...]:
        """States of the filter."""
        return tuple(one.of for one in self.power if not one.of.startswith(_INNOVATIONS))

    def listing(self) -> Listing:
        """Return the verdict and each statistic with its bounds, as a table."""
        rows = [
            (
                one.name,
                one.label,
                figure(one.value),
                f"{figure(one.low)} to {figure(one.high)}" if math.isfinite(one.low) else "",
                figure(one.p_value, 2),
                figure(one.samples),
                "FAIL" if one.rejected else "pass",
            )
            for one in self.findings
        ]
        columns = ("statistic", "of", "value", f"{100.0 * self.probability:g} % bounds", "p-value", "samples", "")
        return Listing(
            f"{self.verdict}: {self.reason}", columns, rows, [f"Note: {one}." for one in self.limits], left=2
        )

    @property
    def words(self) -> str:
        """The verdict and the findings that contradict the filter, as text."""
        lines = [f"{self.verdict}: {self.reason}"]
        lines += [f"  - {finding.means}" for finding in self.findings if finding.rejected and finding.means]
        return "\n".join(lines)

    def summary(self) -> dict[str, Any]:
        """Return the verdict and all findings as plain values for JSON; numbers that are not finite are None.

        Returns
        -------
        dict
            Verdict, reason, probability, findings, limits, power and unmodelled, by these names.
        """
        table = {
            "verdict": self.verdict,
            "reason": self.reason,
            "probability": self.probability,
            "findings": [{**vars(one), "means": one.means if one.rejected else ""} for one in self.findings],
            "limits": self.limits,
            "power": [{"of": one.of, "factor": one.factor} for one in self.power],
            "unmodelled": self.unmodelled,
        }
        return plain(table)  # type: ignore[no-any-return]


def judge(
    estimate: Estimate,
    truth: Truth | None = None,
    *,
    probability: float = 0.99,
) -> Judgement:
    """Return the verdict on one run.

    If the estimate is that of a recording (``motion``), the filter's noise covers disturbances that last over many samples. Its
    innovations are then neither white nor as large as their variance, and only larger ones contradict it: σ are upper bounds.

    Parameters
    ----------
    estimate : Estimate
        Estimate with innovations; if a truth is known, with full covariances.
    truth : Truth, optional
        Attitude and bias at the estimate's times, NaN if unknown. Default: that of the estimate; without any only the innovations are
        judged.
    probability : float, default 0.99
        A consistent filter is rejected with probability at most 1 − ``probability``, all tests together.

    Returns
    -------
    Judgement
        The verdict; its ``power`` is the error of each state's σ that the tests would have detected. Error states have no truth here and
        are not tested. Errors that the estimate's ``origin`` specifies and its filter has no state for are named in the verdict.

    References
    ----------
    S. Holm, A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6, 1979.
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.

    Examples
    --------
    >>> from strapdown import consistency
    >>> print(consistency.judge(estimate, truth))  # doctest: +SKIP
    """
    tail(probability)
    findings: list[Finding] = []
    limits: list[str] = []
    for sensor, innovations in estimate.innovations.items():
        used = innovations.used
        findings += _of_sensor(sensor, innovations.whitened[used], innovations.nis[used])
        if innovations.refused:
            limits.append(f"{innovations.refused} measurements of {sensor} that the gate refused are left out")
    findings += _of_pairs(estimate)
    beside = tuple(estimate.error_states)
    unmodelled = unmodelled_errors(estimate.origin, estimate.setup)
    truth = estimate.truth if truth is None else truth
    if truth is None:
        limits.append(WITHOUT_TRUTH)
    else:
        findings += _of_errors(estimate, truth, limits, beside)
    if estimate.motion:
        return _bounded(findings, limits, probability, unmodelled)
    return concluded(findings, limits, probability, states=(*STATES, *beside), unmodelled=unmodelled)


def _bounded(
    findings: Sequence[Finding], limits: Sequence[str], probability: float, unmodelled: Sequence[str]
) -> Judgement:
    """Return the verdict on a filter whose σ are upper bounds: one-sided tests of the ratios only."""
    ratios = [
        replace(one, p_value=mean_p_value(one.value, one.degrees, one.samples) if one.value > 1.0 else 1.0)
        for one in findings
        if one.is_ratio
    ]
    judged = concluded(ratios, limits, probability, states=(), unmodelled=unmodelled)
    judged = replace(judged, findings=tuple(replace(one, low=0.0) for one in judged.findings))
    errors_judged = any(one.name != "NIS" for one in ratios)
    if judged.verdict == "not consistent" or not ratios:
        return judged
    sizes = ", ".join(f"{math.sqrt(one.value):.2g} σ of {one.of}" for one in ratios if one.name == "NIS")
    reason = (
        "the filter's σ are upper bounds, because its noise covers lasting disturbances, and no error exceeds them"
        f"{f' (RMS innovations {sizes})' if sizes else ''}"
    )
    if not errors_judged:
        reason += "; the σ of attitude and bias are not tested without a truth"
    return replace(judged, verdict="consistent" if errors_judged else "cannot tell", reason=reason, power=())


def ratio(name: str, of: str, mean: float, degrees: int, samples: float, means: str) -> Finding:
    """Return the finding of a mean of χ² values per degree of freedom, of which ``samples`` are independent."""
    p = mean_p_value(mean, degrees, max(samples, 1.0))
    return Finding(name=name, of=of, value=mean, p_value=p, samples=samples, degrees=degrees, means=means)


def _of_sensor(sensor: str, white: Array, nis: Array) -> list[Finding]:
    samples, degrees = white.shape
    if samples == 0:
        return []
    mean = float(nis.mean() / degrees)
    size = ratio("NIS", sensor, mean, degrees, samples, innovation_words(sensor, mean))
    if samples < MIN_SAMPLES:
        return [size]
    statistic, number, p_white = ljung_box(white)
    square, p_normal = anderson_darling(white)
    mean_vector, p_mean = mean_innovation_p_value(white)
    off = float(np.linalg.norm(mean_vector))
    which = f"innovations of {sensor} are"
    late = f"{which} correlated in time: they contain information that the filter has not used"
    odd = f"{which} not normal: outliers, or noise that differs from the filter's model"
    shape = (
        ("whiteness", statistic / number, p_white, late),
        ("normality", square, p_normal, odd),
        ("mean innovation", off, p_mean, f"the mean innovation of {sensor} is not zero ({off:.3g} σ)"),
    )
    return [size, *(Finding(name=n, of=sensor, value=x, p_value=p, samples=samples, means=w) for n, x, p, w in shape)]


def innovation_words(sensor: str, mean: float) -> str:
    """Return the meaning of a NIS per degree of freedom in words."""
    return f"innovations of {sensor} are {math.sqrt(mean):.3g} times their σ (NIS {mean:.4g} per degree of freedom)"


def _of_pairs(estimate: Estimate) -> list[Finding]:
    found = []
    for (one, a), (other, b) in itertools.combinations(estimate.innovations.items(), 2):
        if min(int(a.used.sum()), int(b.used.sum())) < MIN_SAMPLES:
            continue
        series = (a.time[a.used], a.whitened[a.used], b.time[b.used], b.whitened[b.used])
        correlation, pairs, p = cross_correlation_p_value(*series)
        if math.isnan(p):
            continue
        largest = float(np.max(np.abs(correlation)))
        means = f"innovations of {one} and {other} are correlated: they share an error that the filter does not model"
        of = f"{one} and {other}"
        found.append(Finding(name="cross-correlation", of=of, value=largest, p_value=p, samples=pairs, means=means))
    return found


def _of_errors(estimate: Estimate, truth: Truth, limits: list[str], beside: Sequence[str]) -> list[Finding]:
    m = len(estimate.time)
    if np.shape(truth.attitude) != (m, 4) or np.shape(truth.bias) != (m, 3):
        raise InputError(
            f"truth has {len(truth.attitude)} attitudes and {len(np.atleast_1d(truth.bias))} biases, the estimate {m} times; "
            "give the truth at the estimate's own times"
        )
    seen = ~np.isnan(truth.attitude).all(axis=1)
    if not seen.any():
        limits.append("the reference has no attitude")
        return []
    attitude = unit_quaternions("truth.attitude", truth.attitude[seen])
    e = errors(estimate.attitude[seen], estimate.bias[seen], attitude, truth.bias[seen])
    variance = estimate.variance[seen]
    if estimate.covariance is None:
        limits.append(
            "the estimate holds variances only, so errors are judged axis by axis at the end; keep full covariances"
        )
        return [_largest_at_end(e[-1], variance[-1])]
    # The filter or the reference may have no bias.
    known = 6 if np.isfinite(e[:, 3:]).any() and np.isfinite(variance[:, 3:]).any() else 3
    e, P = e[:, :known], estimate.covariance[seen][:, :known, :known]
    found: list[Finding] = []
    hidden: list[str] = []
    for subset, states in SUBSETS.items():
        if max(states) >= known:
            continue
        value = float(nees(e[-1], P[-1], states)) / len(states)
        words = error_words(f"the {subset} error at the end", value)
        found.append(ratio("NEES at the end", subset, value, len(states), 1, words))
        if len(e) < FEWEST_TO_AVERAGE:
            continue
        if _averages(subset, beside):
            found += _over_the_run(subset, e, P, states, limits)
        else:
            hidden.append(subset)
    if hidden:
        limits.append(
            f"the {' and '.join(hidden)} errors of a filter with further error states are not averaged over one run, because their "
            "correlation time is not known"
        )
    return found


def _largest_at_end(error: Array, variance: Array) -> Finding:
    """Return the finding of the largest error at the end over the axes; its p-value includes their number (Bonferroni)."""
    squares = (error**2 / variance)[np.isfinite(error)]
    name = state_name(int(np.argmax(squares)))
    ratio = math.sqrt(float(np.max(squares)))
    return Finding(
        name="error at the end",
        of=name,
        value=ratio,
        p_value=min(1.0, len(squares) * min(mean_p_value(float(x), 1, 1) for x in squares)),
        samples=1,
        means=f"the {name} error at the end is {ratio:.3g} σ",
    )


def _over_the_run(subset: str, e: Array, P: Array, states: tuple[int, ...], limits: list[str]) -> list[Finding]:
    """Return the time-averaged NEES of a subset of the states; none, and a limit, if its error changes too slowly."""
    average = time_average(e, P, states)
    if not average.reliable:
        limits.append(
            f"the {subset} error changes too slowly for this run to average over: {average.effective:.3g} effective samples"
        )
        return []
    words = error_words(f"the {subset} error over the run", average.mean)
    return [ratio("time-averaged NEES", subset, average.mean, len(states), average.effective, words)]


def _averages(subset: str, beside: Sequence[str]) -> bool:
    """Return whether the error of a subset of the states may be averaged over one run of a filter with these further error states.

    The correlation is estimated from the six errors only. An error state adds a part that may last longer than the run; if that part
    happens to be small, the rest appears both fast and too small, and a consistent filter would be called pessimistic (20 % of single
    runs with states for flicker). Gyro states add such a part to the bias; only states of the sensors add one to the attitude.
    """
    return not beside or (subset == "attitude" and all(name.startswith(("gyro ", "gyro.")) for name in beside))


def error_words(what: str, ratio: float) -> str:
    """Return the meaning of a NEES per state in words."""
    return f"{what} is {math.sqrt(ratio):.3g} times the filter's σ (NEES {ratio:.4g} per state)"


def concluded(
    findings: Sequence[Finding],
    limits: Sequence[str],
    probability: float,
    *,
    states: Sequence[str] = STATES,
    needed: Sequence[str] = (),
    unmodelled: Sequence[str] = (),
) -> Judgement:
    """Return the verdict that findings lead to, all taken together; their ``rejected`` is ignored and evaluated again.

    ``states`` are the filter's states, whose power is reported; ``needed`` those whose σ the tests must be able to check for "consistent"
    (if empty, the most powerful test decides); ``unmodelled`` errors that the filter has no state for.
    """
    marked = holm(findings, 1.0 - probability)
    kept = sum(not one.rejected for one in marked)
    # Bounds at the significance level at which Holm's procedure has stopped.
    marked = [one._with_bounds((1.0 - probability) / max(kept, 1)) for one in marked]
    power = powers(marked, probability, states)
    rejected = [finding for finding in marked if finding.rejected]
    verdict: Answer
    if rejected:
        verdict = "not consistent"
        leaning = _LEANINGS[frozenset(finding.value > 1.0 for finding in rejected if finding.is_ratio)]
        reason = f"{leaning}; {len(rejected)} of {len(marked)} tests contradict it"
    elif not marked:
        verdict, reason = "cannot tell", "there is nothing to judge: no innovation, and no truth"
    else:
        sharpest = min((x for one, x in _factors(marked, probability) if one.samples > 1), default=math.inf)
        unseen = [one.of for one in power if one.of in needed and not one.seen]
        which = f"none of {len(marked)} tests contradicts" if len(marked) > 1 else "the one test does not contradict"
        outcome = f"{which} the filter"
        if sharpest > RESOLUTION:
            verdict = "cannot tell"
            factor = f"by a factor of {sharpest:.2g}" if math.isfinite(sharpest) else "by any factor"
            reason = f"{outcome}, but a σ wrong {factor} would not be seen either: too few samples"
        else:
            verdict = "cannot tell" if unseen else "consistent"
            reason = f"{outcome}; {power_words(power)}"
    if unmodelled:
        reason += f"; the filter has no state for {', '.join(unmodelled)}"
    return Judgement(
        verdict=verdict,
        reason=reason,
        findings=tuple(marked),
        limits=tuple(limits),
        probability=probability,
        power=power,
        unmodelled=tuple(unmodelled),
    )


def powers(findings: Sequence[Finding], probability: float, states: Sequence[str]) -> tuple[Power, ...]:
    """Return the smallest error of σ that the tests would have detected, by sensor (innovations) and by state."""
    best = {f"{_INNOVATIONS}{one.of}": math.inf for one in findings if one.name == "NIS"}
    best |= dict.fromkeys(states, math.inf)
    for one, factor in _factors(findings, probability):
        of = f"{_INNOVATIONS}{one.of}" if one.name == "NIS" else one.of
        if of in best:
            best[of] = min(best[of], factor)
    return tuple(Power(of=of, factor=factor) for of, factor in best.items())


def _factors(findings: Sequence[Finding], probability: float) -> Iterator[tuple[Finding, float]]:
    """Yield the ratios with the factor on σ that each detects: the root of the ratio of its bounds, with Bonferroni's correction."""
    within = (1.0 - probability) / max(len(findings), 1)
    for one in findings:
        if one.is_ratio:
            low, high = mean_bounds(one.degrees, one.samples, 1.0 - within / one.epochs)
            yield one, math.sqrt(high / low)


def power_words(power: Sequence[Power]) -> str:
    """Return in words which errors of σ would have been detected."""
    seen = [one for one in power if one.seen]
    coarse = [one for one in power if not one.seen and math.isfinite(one.factor)]
    untested = [one.of for one in power if math.isinf(one.factor)]
    words = []
    if seen:
        words.append(
            "a σ wrong by this factor would have been seen: "
            + ", ".join(f"{math.ceil(100.0 * one.factor) / 100.0:g} of the {one.of}" for one in seen)
        )
    if coarse:
        words.append(
            "this cannot show the σ of the "
            + ", ".join(f"{one.of} (only one wrong by a factor of {one.factor:.2g})" for one in coarse)
        )
    if untested:
        words.append(
            f"the σ of {', '.join(untested)} {'is' if len(untested) == 1 else 'are'} not tested: no truth for it"
        )
    return "; ".join(words)


def holm(findings: Iterable[Finding], error: float) -> list[Finding]:
    """Return the findings with those marked that Holm's step-down procedure rejects at a family-wise error of ``error``."""
    marked = [replace(finding, rejected=False) for finding in findings]
    order = sorted(range(len(marked)), key=lambda k: marked[k].p_value)
    for rank, k in enumerate(order):
        if not marked[k].p_value <= error / (len(marked) - rank):
            break
        marked[k] = replace(marked[k], rejected=True)
    return marked


def state_name(state: int) -> str:
    """Return the name, "attitude x" … "bias z", of a state by its index."""
    return f"{('attitude', 'bias')[state // 3]} {'xyz'[state % 3]}"
