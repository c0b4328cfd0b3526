"""The verdict: does the filter's covariance agree with its errors? In words, with the evidence, at one stated probability of a false alarm.

Every statistic gives a p-value, exact or nearly so. Holm's procedure (1979) combines them: whatever their dependence, the probability that
a consistent filter is rejected by any of them is at most 1 − ``confidence_level``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from strapdown.checks import Array, InputError, are_finite, unit_quaternions
from strapdown.consistency.accuracy import accuracy
from strapdown.consistency.bounds import log_mean_bounds, mean_bounds, mean_p_value, tail
from strapdown.consistency.manifold import SUBSETS, errors, nees
from strapdown.consistency.timeaverage import time_average
from strapdown.consistency.whiteness import (
    anderson_darling,
    cross_correlation_p_value,
    ljung_box,
    mean_innovation_p_value,
)
from strapdown.estimation.setup import unmodelled_errors
from strapdown.files import plain
from strapdown.records import Estimate, Truth
from strapdown.results import ByValue, Column, Listed, Table, figure

Answer = Literal["consistent", "cannot tell", "not consistent"]
VERDICTS: tuple[Answer, ...] = get_args(Answer)
"""The last of several decides on all of them together."""

MIN_SAMPLES = 50
"""Minimum number of innovations of a sensor for the tests of whiteness, normality and mean."""

FEWEST_TO_AVERAGE = 20
"""Minimum number of epochs for errors to be judged over the run and not only at the end."""

DETECTABLE = 1.5
"""Default of the error of σ, as a factor, that tests must be able to detect for "consistent"."""

STATES = ("attitude", "bias")
"""States of a filter whose σ are tested."""
NO_TRUTH, NO_COVARIANCE = "the truth is not known", "no covariance"
"""Reasons why a part of a result is not tested."""

_LEANINGS = {
    frozenset[bool](): "the filter's model does not hold",
    frozenset({True}): "the filter is optimistic (its σ are too small)",
    frozenset({False}): "the filter is pessimistic (its σ are too large)",
    frozenset({True, False}): "the filter's σ are too small in part and too large in part",
}
"""Reason by whether the ratios that contradict the filter are greater than 1."""
_FAILED = "the filter failed: an error is not finite, or a covariance is not finite and positive definite"


@dataclass(frozen=True, kw_only=True, eq=False)
class Finding(ByValue):
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
    certainty : float, default inf
        Degrees of freedom with which an effective number of samples is known; infinite if the samples are counted.
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
    certainty: float = math.inf
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

    def _bounds(self, error: float) -> tuple[float, float]:
        """Return the bounds of the value beyond which the p-value is below ``error``; NaN for a statistic without bounds."""
        within = 1.0 - error / self.epochs
        if self.is_ratio:
            return mean_bounds(self.degrees, self.samples, within, certainty=self.certainty)
        if self.name == LOG_NEES:
            return log_mean_bounds(self.degrees, int(self.samples), within)
        return math.nan, math.nan


INNOVATIONS = "innovations of "
"""Beginning of the name of a part that is the innovations of a sensor."""
LOG_NEES = "log-NEES"
_RATIOS = ("NIS", "NEES at the end", "time-averaged NEES", "ANEES")


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a result whose σ is tested: the attitude, the bias, the innovations of a sensor."""

    of: str
    """"attitude", "bias" or "innovations of SENSOR"."""
    detectable_error: float
    """Detectable error of σ: σ too small or too large by this factor would have contradicted the filter, with about the probability of the
    confidence level; infinite if no test covers it."""
    why: str = ""
    """Reason why it is not tested; empty if it is."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement(ByValue, Listed):
    """A verdict with its evidence.

    Parameters
    ----------
    verdict : {"consistent", "not consistent", "cannot tell"}
        Whether the covariance agrees with the errors. "consistent" only if each part was tested and the tests would have detected an error
        of its σ by the factor ``required``.
    reason : str
        Which parts agree and which could not be tested, or what contradicts the filter; one sentence.
    findings : tuple of Finding
        Every statistic with its bounds and p-value.
    limits : tuple of str
        Limitations of the evidence, in words.
    confidence_level : float
        Minimum probability that a consistent filter is not rejected.
    parts : tuple of Part, default empty
        The innovations of each sensor, the attitude, the bias, with the detectable error of their σ.
    required : float, default 1.5
        Largest detectable error of σ of a part that counts as tested.
    unmodelled : tuple of str, default empty
        Specified errors that the filter does not model.
    """

    verdict: Answer
    reason: str
    findings: tuple[Finding, ...]
    limits: tuple[str, ...]
    confidence_level: float
    parts: tuple[Part, ...] = ()
    required: float = DETECTABLE
    unmodelled: tuple[str, ...] = ()

    @property
    def innovations_untested(self) -> bool:
        """Whether the innovations of a sensor are too few to detect the error ``required``."""
        return any(part.of.startswith(INNOVATIONS) and part.detectable_error > self.required for part in self.parts)

    @property
    def headline(self) -> str:
        """Verdict and reason, as the terminal, the JSON file and the report print them."""
        return f"{self.verdict}: {self.reason}"

    def listing(self) -> Table:
        """Return the verdict and each statistic with its bounds, as a table."""
        bounds = lambda f: f"{figure(f.low)} to {figure(f.high)}" if math.isfinite(f.low) else ""  # noqa: E731
        rows = [
            (f.name, f.label, f.value, f.low, f.high, bounds(f), f.p_value, float(f.samples), not f.rejected)
            for f in self.findings
        ]
        columns = (
            Column("statistic", "statistic"),
            Column("of", "of"),
            Column("value", "value"),
            Column(None, "lower_bound"),
            Column(None, "upper_bound"),
            Column(f"{100.0 * self.confidence_level:g} % bounds"),
            Column("p-value", "p_value", digits=2),
            Column("samples", "samples", shown="{:.0f}".format),
            Column("", "consistent", shown=lambda passed: "pass" if passed else "FAIL"),
        )
        meaning = (
            f"Bounds, pass and FAIL are for all tests together: a consistent filter fails with at most "
            f"{100.0 * (1.0 - self.confidence_level):.2g} %. Each p-value is for one statistic; NIS and NEES are per degree of freedom; "
            "the number of correlated samples is the effective one."
        )
        notes = [*([meaning] if rows else []), *(f"Note: {limit}." for limit in self.limits)]
        return Table(self.headline, columns, rows, notes, left=2, name="consistency")

    @property
    def words(self) -> str:
        """The verdict and the findings that contradict the filter, as text."""
        lines = [self.headline]
        lines += [f"  - {finding.means}" for finding in self.findings if finding.rejected and finding.means]
        return "\n".join(lines)

    def summary(self) -> dict[str, Any]:
        """Return the verdict and all findings as plain values for JSON; numbers that are not finite are None.

        Returns
        -------
        dict
            Verdict, reason, headline, confidence_level, findings, limits, parts, required and unmodelled, by these names.
        """
        table = {
            "verdict": self.verdict,
            "reason": self.reason,
            "headline": self.headline,
            "confidence_level": self.confidence_level,
            "findings": [
                {**vars(finding), "means": finding.means if finding.rejected else ""} for finding in self.findings
            ],
            "limits": self.limits,
            "parts": [vars(part) for part in self.parts],
            "required": self.required,
            "unmodelled": self.unmodelled,
        }
        return plain(table)  # type: ignore[no-any-return]


def judge(
    estimate: Estimate,
    truth: Truth | None = None,
    *,
    confidence_level: float = 0.99,
    detectable_error: float = DETECTABLE,
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
    confidence_level : float, default 0.99
        Minimum probability that a consistent filter is not rejected by any of the tests.
    detectable_error : float, default 1.5
        Largest detectable error of σ, as a factor, of a part that counts as tested.

    Returns
    -------
    Judgement
        The verdict; its ``parts`` have the error of their σ that the tests would have detected. Error states have no truth here and are not
        tested. Errors that the estimate's ``origin`` specifies and its filter does not model are named in the verdict.

    References
    ----------
    S. Holm, A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6, 1979.
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.

    Examples
    --------
    >>> from strapdown import consistency
    >>> print(consistency.judge(estimate))  # doctest: +SKIP
    """
    tail(confidence_level)
    if not detectable_error > 1.0:
        raise InputError(f"detectable_error is {detectable_error}; give the factor on σ, greater than 1")
    findings: list[Finding] = []
    limits: list[str] = []
    untested: dict[str, str] = {}
    if missing := int(np.sum(~estimate.known)):
        limits.append(f"no estimate at {missing} of {len(estimate.time)} times, which are not judged")
    gate = estimate.setup and estimate.setup.gate
    for sensor, innovations in estimate.innovations.items():
        used = innovations.used
        if used.any():
            white = innovations.whitened[used]
            findings += _of_sensor(sensor, gate.ungated(white) if gate else white)
            untested[f"{INNOVATIONS}{sensor}"] = ""
        if innovations.refused:
            limits.append(f"{innovations.refused} of {len(used)} measurements of {sensor} rejected by the gate")
    findings += _of_pairs(estimate)
    why = NO_TRUTH if estimate.has_covariance else NO_COVARIANCE
    untested |= dict.fromkeys(STATES if estimate.has_bias else STATES[:1], why)
    truth = estimate.truth if truth is None else truth
    if truth is None and findings:
        limits.append(
            "without a truth only the innovations are judged: they do not show an attitude error that all sensors share, nor a bias error "
            "that the initial state hides, such as the coning error of the integration"
        )
    elif truth is not None and estimate.has_covariance:
        findings += _of_errors(estimate, truth, limits, untested)
    if estimate.error_states:
        limits.append(f"the σ of {listed(tuple(estimate.error_states))} is not tested: {NO_TRUTH}")
    judged = concluded(
        _one_sided(findings) if estimate.motion else findings,
        limits,
        confidence_level,
        parts=untested,
        required=detectable_error,
        unmodelled=unmodelled_errors(estimate.origin, estimate.setup),
        agree="within σ" if estimate.motion else "consistent",
    )
    return _bounded(judged, estimate, truth) if estimate.motion else judged


def _one_sided(findings: Sequence[Finding]) -> list[Finding]:
    """Return the ratios, of which only those above 1 contradict a filter whose σ are upper bounds."""
    ratios = [finding for finding in findings if finding.is_ratio]
    return [replace(finding, p_value=finding.p_value if finding.value > 1.0 else 1.0) for finding in ratios]


def _bounded(judged: Judgement, estimate: Estimate, truth: Truth | None) -> Judgement:
    """Return the verdict by one-sided tests of the ratios of a filter whose σ are upper bounds, and name these ratios."""
    judged = replace(judged, findings=tuple(replace(finding, low=0.0) for finding in judged.findings))
    if judged.verdict == "not consistent" or not judged.findings:
        return judged
    sizes = {} if truth is None else accuracy(estimate, truth).rms_over_sigma
    sizes |= {f"{INNOVATIONS}{f.of}": math.sqrt(f.value) for f in judged.findings if f.name == "NIS"}
    words = ", ".join(f"{name} {size:.2g}" for name, size in sizes.items())
    reason = f"σ are upper bounds, because the filter's noise covers lasting disturbances; RMS over σ: {words}"
    return replace(judged, reason=f"{judged.reason} ({reason})")


def ratio(
    name: str, of: str, mean: float, degrees: int, samples: float, means: str, certainty: float = math.inf
) -> Finding:
    """Return the finding of a mean of χ² values per degree of freedom, of which ``samples`` are independent."""
    p = mean_p_value(mean, degrees, max(samples, 1.0), certainty=certainty)
    return Finding(
        name=name, of=of, value=mean, p_value=p, samples=samples, certainty=certainty, degrees=degrees, means=means
    )


def _of_sensor(sensor: str, white: Array) -> list[Finding]:
    samples, degrees = white.shape
    mean = float(np.mean(white**2))
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
    findings = []
    for (sensor, a), (other, b) in itertools.combinations(estimate.innovations.items(), 2):
        if min(int(a.used.sum()), int(b.used.sum())) < MIN_SAMPLES:
            continue
        series = (a.time[a.used], a.whitened[a.used], b.time[b.used], b.whitened[b.used])
        correlation, pairs, p = cross_correlation_p_value(*series)
        if math.isnan(p):
            continue
        largest = float(np.max(np.abs(correlation)))
        means = (
            f"innovations of {sensor} and {other} are correlated: they share an error that the filter does not model"
        )
        of = f"{sensor}, {other}"
        findings.append(Finding(name="cross-correlation", of=of, value=largest, p_value=p, samples=pairs, means=means))
    return findings


def _of_errors(estimate: Estimate, truth: Truth, limits: list[str], untested: dict[str, str]) -> list[Finding]:
    """Return the findings on the errors; ``untested`` receives the reason for each part that no test covers."""
    m = len(estimate.time)
    if np.shape(truth.attitude) != (m, 4) or np.shape(truth.bias) != (m, 3):
        raise InputError(
            f"truth has {len(truth.attitude)} attitudes and {len(np.atleast_1d(truth.bias))} biases, the estimate {m} times; "
            "give the truth at the estimate's own times"
        )
    has_truth = ~np.isnan(truth.attitude).all(axis=1) & estimate.known
    if truth.has_bias:
        has_truth &= are_finite(truth.bias)
    if not has_truth.any():
        limits.append("the reference has no attitude at a time with an estimate")
        return []
    attitude = unit_quaternions("truth.attitude", truth.attitude[has_truth])
    e = errors(estimate.attitude[has_truth], estimate.bias[has_truth], attitude, truth.bias[has_truth])
    # The filter or the reference may have no bias.
    known = 6 if np.isfinite(e[:, 3:]).any() and np.isfinite(estimate.variance[has_truth, 3:]).any() else 3
    untested |= dict.fromkeys(STATES[: known // 3], "no full covariances" if estimate.covariance is None else "")
    if estimate.covariance is None:
        return []
    e, P = e[:, :known], estimate.covariance[has_truth][:, :known, :known]
    findings: list[Finding] = []
    for subset, states in SUBSETS.items():
        if max(states) >= known:
            continue
        value = float(nees(e[-1], P[-1], states)) / len(states)
        words = error_words(f"the {subset} error at the end", value)
        findings.append(ratio("NEES at the end", subset, value, len(states), 1, words))
        average = _over_run(estimate, subset, e, P)
        if isinstance(average, Finding):
            findings.append(average)
        elif subset in untested:
            untested[subset] = average
    return findings


def _over_run(estimate: Estimate, subset: str, e: Array, P: Array) -> Finding | str:
    """Return the finding on the errors of a subset of the states over the run, or the reason why they are not tested."""
    if len(e) < FEWEST_TO_AVERAGE:
        return "too few epochs with a truth"
    # The correlation is estimated from the six errors only. An error state adds a part that may last longer than the run; if that part
    # happens to be small, the rest appears both fast and too small, and a consistent filter would be called pessimistic (20 % of single
    # runs with states for flicker). Gyro states add such a part to the bias; only states of the sensors add one to the attitude.
    of_sensors = [name for name in estimate.error_states if not name.startswith(("gyro ", "gyro."))]
    if not estimate.motion and (of_sensors if subset == "attitude" else estimate.error_states):
        return "the correlation time of errors with further error states is not known from one run"
    states = SUBSETS[subset]
    average = time_average(e, P, states)
    if not average.reliable:
        return f"its error changes too slowly, effective number of samples {average.effective:.2g}"
    size = (average.mean, len(states), average.effective)
    words = error_words(f"the {subset} error over the run", average.mean)
    return ratio("time-averaged NEES", subset, *size, words, average.certainty)


def error_words(what: str, ratio: float) -> str:
    """Return the meaning of a NEES per state in words."""
    return f"{what} is {math.sqrt(ratio):.3g} times the filter's σ (NEES {ratio:.4g} per state)"


def concluded(
    findings: Sequence[Finding],
    limits: Sequence[str],
    confidence_level: float,
    *,
    parts: Mapping[str, str],
    required: float = DETECTABLE,
    unmodelled: Sequence[str] = (),
    runs: str = "this run",
    agree: str = "consistent",
) -> Judgement:
    """Return the verdict that findings lead to, all taken together; their ``rejected`` is ignored and evaluated again.

    ``parts``: reason by part (:class:`Part`) why no test covers it, empty if one does; ``unmodelled``: errors that the filter does not
    model; ``runs``: the runs, in words; ``agree``: what is said of the parts that were tested.
    """
    contradicts = holm([finding.p_value for finding in findings], 1.0 - confidence_level)
    # Bounds at the significance level at which Holm's procedure has stopped.
    level = (1.0 - confidence_level) / max(contradicts.count(False), 1)
    marked = []
    for finding, is_rejected in zip(findings, contradicts, strict=True):
        low, high = finding._bounds(level)
        marked.append(replace(finding, rejected=is_rejected, low=low, high=high))
    errors = detectable_errors(marked, confidence_level)
    tested = tuple(Part(of=of, detectable_error=errors.get(of, math.inf), why=why) for of, why in parts.items())
    verdict, reason = _verdict(marked, tested, required, runs, agree)
    if unmodelled:
        reason += f"; the filter does not model {', '.join(unmodelled)}"
    return Judgement(
        verdict=verdict,
        reason=reason,
        findings=tuple(marked),
        limits=tuple(limits),
        confidence_level=confidence_level,
        parts=tested,
        required=required,
        unmodelled=tuple(unmodelled),
    )


def detectable_errors(findings: Sequence[Finding], confidence_level: float) -> dict[str, float]:
    """Return the detectable error of σ of each part that a ratio tests: the root of the ratio of its bounds, with Bonferroni's correction.

    If σ is too small by the factor f, the mean is f² times that of a consistent filter: it exceeds the upper bound with the probability
    that the mean of a consistent filter exceeds that bound divided by f², which is the lower bound.
    """
    best: dict[str, float] = {}
    for finding in findings:
        if not finding.is_ratio:
            continue
        low, high = finding._bounds((1.0 - confidence_level) / len(findings))
        of = f"{INNOVATIONS}{finding.of}" if finding.name == "NIS" else finding.of
        best[of] = min(best.get(of, math.inf), math.sqrt(high / low) if low > 0.0 else math.inf)
    return best


def _verdict(
    findings: Sequence[Finding], parts: Sequence[Part], required: float, runs: str, agree: str
) -> tuple[Answer, str]:
    """Return verdict and reason."""
    rejected = [finding for finding in findings if finding.rejected]
    if rejected:
        ratios = [finding.value for finding in rejected if finding.is_ratio]
        leaning = _LEANINGS[frozenset(value > 1.0 for value in ratios)] if np.isfinite(ratios).all() else _FAILED
        contradict = "contradicts" if len(rejected) == 1 else "contradict"
        return "not consistent", f"{leaning}; {len(rejected)} of {len(findings)} tests {contradict} it"
    if not findings:
        without = any(part.why == NO_COVARIANCE for part in parts)
        return "cannot tell", f"{NO_COVARIANCE if without else 'no innovation, and no truth'}: nothing to test"
    return _of_parts(parts, required, runs, agree)


def _of_parts(parts: Sequence[Part], required: float, runs: str, agree: str) -> tuple[Answer, str]:
    """Return the verdict if no test contradicts the filter, and which parts were tested."""
    tested = [part for part in parts if part.detectable_error <= required]
    others = [part for part in parts if part.detectable_error > required]
    factors = ", ".join(f"{part.of} ×{math.ceil(100.0 * part.detectable_error) / 100.0:g}" for part in tested)
    powers = f"; detectable error of σ: {factors}" if tested else ""
    if not others:
        return ("consistent", f"{_named(tested, parts)}{powers}") if tested else ("cannot tell", "no σ was tested")
    reasons: dict[str, list[Part]] = {}
    for other in others:
        coarse = f"only an error of σ of ×{other.detectable_error:.3g} or more is detectable"
        reasons.setdefault(
            other.why or (coarse if math.isfinite(other.detectable_error) else "too few samples"), []
        ).append(other)
    untested = "; ".join(f"{_named(part, parts)} not testable from {runs}: {why}" for why, part in reasons.items())
    agrees = f"{_named(tested, parts)} {agree}; " if tested else ""
    return "cannot tell", f"{agrees}{untested}{powers}"


def _named(some: Sequence[Part], parts: Sequence[Part]) -> str:
    """Return the names of some of the parts, those of all sensors' innovations together as "innovations"."""
    sensors, every = ([part.of for part in group if part.of.startswith(INNOVATIONS)] for group in (some, parts))
    states = [part.of for part in some if part.of not in sensors]
    return listed([*states, *(["innovations"] if sensors and sensors == every else sensors)])


def listed(names: Sequence[str]) -> str:
    """Return names in a sentence: "a", "a and b", "a, b and c"."""
    return " and ".join([*([", ".join(names[:-1])] if names[1:] else []), *names[-1:]])


def holm(p_values: Sequence[float], error: float) -> list[bool]:
    """Return which p-values Holm's step-down procedure rejects at a family-wise error of ``error``."""
    rejected = [False] * len(p_values)
    for rank, k in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        if not p_values[k] <= error / (len(p_values) - rank):
            break
        rejected[k] = True
    return rejected


def mark(is_likely: bool, is_known: bool) -> str:
    """Return what a table says of a cause: an error that is specified, or of which the filter's σ are bounds, is known, not likely."""
    return "no" if not is_likely else "known" if is_known else "likely"


def state_name(state: int) -> str:
    """Return the name, "attitude x" … "bias z", of a state by its index."""
    return f"{('attitude', 'bias')[state // 3]} {'xyz'[state % 3]}"
