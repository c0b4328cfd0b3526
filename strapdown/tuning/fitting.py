"""Maximum-likelihood parameters, from several starts, with an interval for each.

The search is Fisher's scoring, damped (Levenberg–Marquardt) and limited to steps of a factor e² in each parameter. If the data determine a
parameter well, its interval follows from the information; otherwise from the profile likelihood, which a parabola does not describe when
zero is as likely as the best value. Then only an upper bound is reported.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from strapdown.checks import Array, Hint, InputError, count, known_keys
from strapdown.consistency.judgement import VERDICTS
from strapdown.estimation.setup import FilterSetup
from strapdown.files import plain
from strapdown.results import Column, Listed, Table, figure
from strapdown.tuning.objective import REACH, Derivatives, Objective
from strapdown.tuning.parameters import RRW, SCALE, Prior, Unit

if TYPE_CHECKING:  # the steps after a search, which import this module
    from strapdown.tuning.outliers import TunedGate
    from strapdown.tuning.residual_checks import Unmodelled
    from strapdown.tuning.validation import Comparison

LONGEST_STEP = 2.0
"""Maximum change of a log parameter in one step of the search."""
WELL_KNOWN = 0.1
"""Standard error of a log parameter below which the log likelihood is a parabola within the interval."""
TWO_SIDED = 3.841458820694124
"""95 % quantile of χ² with one degree of freedom: values with a profile 2 Δℓ below it are inside the interval."""
ONE_SIDED = 2.705543454095404
"""90 % quantile of χ² with one degree of freedom: one-sided 95 % bound, and the test against zero, where the distribution is half a point
mass (Self & Liang 1987)."""
MIN_INFORMATION = 1e-10
"""Minimum information on a log parameter; less is treated as none."""
NEGLIGIBLE = 1e-3
"""Gain of the log likelihood that is negligible."""
NOT_IDENTIFIED = "not identified"
WORSE = 1.05
"""An increase of the attitude error on the held-out data by more than this factor is reported."""
MISFIT = 1.6
"""Ratio of the sandwich error to that of the information above which the innovations contradict the filter's model."""

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, eq=False)
class Local:
    """Value, gradient and information of an objective at a point, including the priors."""

    value: float
    score: Array
    information: Array
    derivatives: Derivatives

    @property
    def settled(self) -> np.ndarray:
        """Whether each parameter (p,) tends to zero with a negligible further gain: half its gradient at most."""
        return np.asarray((self.score > 0.0) & (self.score < NEGLIGIBLE) & (np.diag(self.information) < 0.1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimum:
    """End point of one search."""

    point: Array
    local: Local
    steps: int
    converged: bool


def local_at(objective: Objective, point: Array, priors: Mapping[str, Prior]) -> Local:
    """Return the objective with its priors at a point."""
    derivatives = objective.derivatives(point)
    objective.evaluated()
    value, score, information = (
        float(derivatives.value.sum()),
        derivatives.score.sum(axis=0),
        derivatives.information.copy(),
    )
    for j, name in enumerate(objective.names):
        if name in priors:
            prior = priors[name]
            away = (point[j] - np.log(prior.value)) / prior.spread
            value += 0.5 * away**2
            score[j] += away / prior.spread
            information[j, j] += prior.spread**-2
    return Local(value=value, score=score, information=information, derivatives=derivatives)


def search(
    objective: Objective,
    start: Array,
    priors: Mapping[str, Prior],
    *,
    fixed: Sequence[int] = (),
    steps: int = 200,
) -> Optimum:
    """Return the minimum reached from ``start``; the parameters with indices ``fixed`` are held fixed."""
    x = np.array(start, float)
    moving = np.array([j not in fixed for j in range(len(x))], bool)
    low, high = objective.limits
    here = local_at(objective, x, priors)
    damping, stretch = 1e-3, 1.0

    def ended(number: int, *, converged: bool = True) -> Optimum:
        return Optimum(point=x, local=here, steps=number, converged=converged)

    for number in range(steps):
        active = moving & ~here.settled & ~((x <= low) & (here.score > 0.0)) & ~((x >= high) & (here.score < 0.0))
        if not active.any():
            return ended(number)
        g, F = here.score[active], here.information[np.ix_(active, active)]
        scale = np.sqrt(np.maximum(np.diag(F), 1e-12))
        unit = F / np.outer(scale, scale)
        while True:
            delta = np.zeros(len(x))
            delta[active] = -stretch * np.linalg.solve(unit + damping * np.eye(len(g)), g / scale) / scale
            shortened = LONGEST_STEP / max(LONGEST_STEP, float(np.max(np.abs(delta))))
            delta *= shortened
            trial = np.clip(x + delta, low, high)
            trial[~moving] = x[~moving]
            gain = -float(here.score[active] @ delta[active])
            if gain < 1e-7 and np.abs(delta).max() < 0.05:
                return ended(number)
            there = local_at(objective, trial, priors)
            if there.value <= here.value:
                break
            damping, stretch = max(10.0 * damping, 1e-3), 1.0
            if damping > 1e12:
                return ended(number, converged=False)
        if shortened == 1.0 and not objective.composite:
            # If the information exceeds the curvature, as for innovations that contradict the model, steps are too short.
            bend = 2.0 * (gain - (here.value - there.value))
            stretch = float(
                np.clip(stretch * (np.clip(gain / bend, 0.5, 4.0) if bend > 0.25 * gain else 4.0), 1.0, 64.0)
            )
        x, here, damping = trial, there, max(0.1 * damping, 1e-9)
    return ended(steps, converged=False)


@dataclass(frozen=True, kw_only=True)
class Estimated:
    """One tuned parameter with its interval; SI."""

    name: str
    start: float
    value: float
    """Value used in the filter: the most likely one, or the mean over the profile likelihood if zero is not excluded."""
    most_likely: float
    lower: float
    """Lower end of the 95 % interval; zero if there is only an upper bound."""
    upper: float
    """Upper end of the 95 % interval; infinite if there is no bound."""
    standard_error: float
    """Standard error of the logarithm, by the information, or by the sandwich if :attr:`Tuning.misfit` or against a truth."""
    identified: bool
    """Whether zero is rejected at 95 % and an upper end exists."""
    note: str
    """Interpretation; :attr:`words` adds the bound."""
    unit: Unit
    """Unit in which it is printed."""

    @property
    def words(self) -> str:
        """Interpretation with the upper bound, in its unit."""
        if self.note != NOT_IDENTIFIED:
            return self.note
        if not math.isfinite(self.upper):
            return f"{NOT_IDENTIFIED}: no information in these records"
        return f"{NOT_IDENTIFIED}: at most {figure(self.upper / self.unit.factor, 3)} {self.unit.name}"


ENDS = {"before": "before", "after": "after", "from": "lower_95", "to": "upper_95"}
"""Headings of the values of a parameter in text and in files."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tuning(Listed):
    """Result of a tuning.

    Parameters
    ----------
    parameters : tuple of Estimated
        Tuned parameters with their intervals, SI.
    setup : FilterSetup
        The filter with the tuned values.
    point : ndarray (p,)
        Natural logarithms of the most likely values, SI.
    before : float
        Negative log likelihood (with priors, without its constant) at the start.
    after : float
        Negative log likelihood at the most likely point.
    covariance : ndarray (p, p)
        Covariance of the logarithms, from the information.
    starts : ndarray (k, p)
        Points at which the searches started.
    optima : ndarray (k, p)
        Points at which the searches ended.
    misfit : bool
        Whether the gradient varies over the record by more than the information allows: the innovations are not white, or their variance
        is not that of any such filter, and the maximum-likelihood filter need not be the best one.
    agreeing : int
        Number of searches that ended within 0.001 of the best log likelihood.
    objective : Objective
        Function that was minimised, for :func:`slices` of it.
    gate : TunedGate, optional
        The gate, if outliers were modelled.
    comparison : Comparison, optional
        The filter before and after on held-out data.
    unmodelled : tuple of Unmodelled
        Tests of records for errors that the tuned filter does not model.
    remarks : tuple of str
        What the filter that was tuned has no state for, and what of it was not applied.
    """

    parameters: tuple[Estimated, ...]
    setup: FilterSetup
    point: Array
    before: float
    after: float
    covariance: Array
    starts: Array
    optima: Array
    misfit: bool
    agreeing: int
    objective: Objective
    gate: TunedGate | None = None
    comparison: Comparison | None = None
    unmodelled: tuple[Unmodelled, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def composite(self) -> bool:
        """Whether the objective is no full likelihood, so that intervals come from the scatter of its gradient (sandwich)."""
        return self.objective.composite

    def summary(self) -> dict[str, Any]:
        """Return everything as plain values for JSON, in SI units.

        Returns
        -------
        dict
            Parameters with their intervals, objective, searches, errors not modelled, gate, and performance on held-out data; as text for
            a report the verdict, tables and words.
        """
        measure = "likelihood of the errors" if self.composite else "likelihood"
        content: dict[str, Any] = {
            "parameters": [
                {
                    **vars(parameter),
                    "note": parameter.words,
                    "unit": parameter.unit.name,
                    "si_per_unit": parameter.unit.factor,
                }
                for parameter in self.parameters
            ],
            "units": "SI: rad, s, units of whole vectors; divide by si_per_unit for the unit of a parameter; standard_error: relative",
            "objective": {"name": measure, "before": self.before, "after": self.after},
            "searches": {"number": len(self.starts), "at_the_best_point": self.agreeing},
            "innovations_fit": not self.misfit,
            "unmodelled": [check.summary() for check in self.unmodelled],
        }
        if self.gate is not None:
            content["gate"] = {
                name: getattr(self.gate, name) for name in ("probability", "lower", "upper", "thresholds")
            }
        if self.comparison is not None:
            content["held_out"] = self.comparison.summary()
        answer, reason, details = verdict(self)
        shown = {"words": list(self.words), "tables": [table.as_text for table in self.tables]}
        content["report"] = {"verdict": answer, "reason": reason, "details": details, **shown}
        return plain(content)  # type: ignore[no-any-return]

    @property
    def words(self) -> tuple[str, ...]:
        """Sentences on what the parameters do not say: the remarks, the gate, errors that the filter does not model."""
        worst = max(self.unmodelled, key=lambda check: check.severity, default=None)
        gate = () if self.gate is None else (self.gate.words,)
        return (*self.remarks, *gate, *(() if worst is None else worst.words))

    @property
    def tables(self) -> list[Table]:
        """The table of the parameters, and that of the filter before and after on held-out data."""
        return [self.listing(), *([] if self.comparison is None else [self.comparison.listing()])]

    def listing(self) -> Table:
        """Return the parameters with their intervals, as a table."""
        rows = []
        for parameter in self.parameters:
            values = (
                x / parameter.unit.factor for x in (parameter.start, parameter.value, parameter.lower, parameter.upper)
            )
            rows.append((parameter.name, parameter.unit.name, *values, parameter.words, parameter.identified))
        notes = [
            f"{self.agreeing} of {len(self.starts)} searches ended at the best point; log-likelihood + "
            f"{self.before - self.after:.4g}."
        ]
        if not all(parameter.identified for parameter in self.parameters):
            notes.append(
                "For a parameter that is not identified these records give only an upper bound; the filter uses the value in the column "
                f"“after”, the mean below that bound. A prior can be given by {Hint('priors')}."
            )
        if self.misfit:
            remedy = (
                "A common scale leaves the estimates unchanged; it makes σ correct on average, not at each time."
                if self.parameters[0].name == SCALE
                else "The maximum-likelihood filter may follow them and estimate worse. Tune only filter.scale, or against a truth "
                f"({Hint('truth', True)}), or try {Hint('spacing')}."
            )
            notes.append(
                "The innovations contradict any filter of this model: disturbances last over many samples, or vary. "
                + remedy
            )
        columns = (
            Column("parameter", "name"),
            Column("unit", "unit"),
            *(Column(label, key, 3) for label, key in ENDS.items()),
            Column(""),
            Column(None, "identified"),
        )
        return Table("Tuned parameters with 95 % intervals", columns, rows, notes, left=2, name="parameters")

    def __getitem__(self, name: str) -> Estimated:
        """Return the parameter with this name."""
        known_keys("tuning", [name], [parameter.name for parameter in self.parameters])
        return next(parameter for parameter in self.parameters if parameter.name == name)


def verdict(tuning: Tuning) -> tuple[str, str, list[str]]:
    """Return the verdict on the tuned filter, its reason, and findings against it; with held-out data, the worst of its judgements."""
    comparison = tuning.comparison
    if comparison is None:
        prove = f"{Hint('holdout')} validates a tuning on held-out data"
        details = [words for check in tuning.unmodelled for words in check.words]
        if tuning.misfit or details:
            return "not consistent", f"the tuned filter does not agree with the data used for tuning; {prove}", details
        if any(check.judgement.innovations_untested for check in tuning.unmodelled):
            return "cannot tell", f"the data used for tuning are too few to judge the filter; {prove}", []
        return "consistent", f"the tuned filter agrees with the data used for tuning; {prove}", []
    after = comparison.after.judgements
    if not after:
        return "cannot tell", "the held-out data were not judged", []
    worst = max(after, key=lambda judgement: VERDICTS.index(judgement.verdict))
    details = [finding.means for judgement in after for finding in judgement.findings if finding.rejected]
    if not comparison.better and not tuning.composite:
        details.append("on the held-out data the likelihood has decreased: keep the previous filter")
    elif comparison.after.attitude_rms > WORSE * comparison.before.attitude_rms:
        details.append("on the held-out data the attitude error has increased: keep the previous filter")
    return worst.verdict, f"{worst.reason}, on held-out data", details


@dataclass(frozen=True, kw_only=True, eq=False)
class _Known:
    lower: float
    upper: float
    mean: float
    identified: bool


def random_starts(point: Array, number: int, factor: float, generator: np.random.Generator) -> Array:
    """Return the point and ``number − 1`` others (number, p), each parameter times a log-uniform factor from 1/factor to factor."""
    spread = np.log(factor)
    off = generator.uniform(-spread, spread, (count("starts", number) - 1, len(point)))
    return np.concatenate([point[None], point + off])


def fit(
    objective: Objective,
    *,
    priors: Mapping[str, Prior] | None = None,
    starts: int = 4,
    factor: float = 30.0,
    seed: int = 0,
    threads: int = 1,
    intervals: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Tuning:
    """Return the maximum-likelihood parameters with their intervals.

    Parameters
    ----------
    objective : Objective
        Likelihood of the innovations (:func:`likelihood`), of the errors (:func:`error_objective`), or another of this package.
    priors : mapping of str to Prior, optional
        Prior knowledge by parameter; the result is then the maximum of the posterior density.
    starts : int, default 4
        Number of searches: the first from the setup's values, the others from random starts.
    factor : float, default 30
        Maximum factor, up or down, between random starts and the setup's values.
    seed : int, default 0
        Seed of the random starts.
    threads : int, default 1
        Number of searches in parallel.
    intervals : bool, default True
        Whether to evaluate the profile likelihood of parameters that are not well determined.
    progress : callable, optional
        Called after each evaluation of the objective with the progress, such as ``"searches: 1 of 4, 23 evaluations"``.

    Returns
    -------
    Tuning
        The tuned filter, parameters with 95 % intervals, and where each search ended.

    Raises
    ------
    InputError
        If a prior names no free parameter, ``factor`` is not above 1, or the search does not converge.

    References
    ----------
    F. C. Schweppe, Evaluation of likelihood functions for Gaussian signals, IEEE Trans. Information Theory 11(1), 1965.
    H. White, Maximum likelihood estimation of misspecified models, Econometrica 50(1), 1982 (intervals if the model does not hold).
    """
    known = dict(priors or {})
    known_keys("priors", known, objective.names)
    if not factor > 1.0:
        raise InputError(f"factor is {factor}; it must be greater than 1")
    points = np.clip(random_starts(objective.start, starts, factor, np.random.default_rng(seed)), *objective.limits)
    stage = _Stage(progress)
    silent, objective = objective, replace(objective, evaluated=stage.evaluated)

    optima = stage.each("searches", lambda point: search(objective, point, known), points, threads)
    best = _best(optima)
    errors = _errors(objective, best)

    def interval(j: int) -> _Known:
        if intervals and not errors.standard[j] < WELL_KNOWN:
            return _profiled(objective, best, j, known, float(errors.standard[j]), float(errors.swollen[j]) ** 2)
        return _wald(best, j, float(errors.standard[j]))

    ranges = stage.each("intervals", interval, range(len(points[0])), threads)
    stage.what = "parameters not identified"
    point = _with_means(objective, best.point, ranges, known)
    return Tuning(
        parameters=tuple(
            _estimated(objective, best, j, point, ranges[j], errors, known) for j in range(len(objective.names))
        ),
        setup=objective.setup(point),
        point=point,
        before=local_at(objective, objective.start, known).value,
        after=best.local.value,
        covariance=errors.covariance,
        misfit=errors.misfit,
        starts=points,
        optima=np.array([optimum.point for optimum in optima]),
        agreeing=sum(1 for optimum in optima if optimum.local.value < best.local.value + NEGLIGIBLE),
        objective=silent,
    )


def _estimated(
    objective: Objective,
    best: Optimum,
    j: int,
    point: Array,
    interval: _Known,
    errors: _Errors,
    priors: Mapping[str, Prior],
) -> Estimated:
    """Return parameter j with its interval; ``point`` has the values used in the filter."""
    name, error = objective.names[j], float(errors.standard[j])
    return Estimated(
        name=name,
        start=float(np.exp(objective.start[j])),
        value=float(np.exp(point[j])),
        most_likely=float(np.exp(best.point[j])) if not best.local.settled[j] else 0.0,
        lower=interval.lower,
        upper=interval.upper,
        standard_error=error,
        identified=interval.identified,
        note=_note(name, interval, error, best.local, j, priors, doubtful=errors.misfit),
        unit=objective.unit(name),
    )


def _best(optima: Sequence[Optimum]) -> Optimum:
    """Return the best end of the searches; one that did not converge is refused."""
    best = min(optima, key=lambda optimum: optimum.local.value)
    if not best.converged:
        raise InputError(
            "the search did not converge in 200 steps; free fewer parameters, or give priors for those that the record does not determine"
        )
    return best


def _with_means(objective: Objective, point: Array, ranges: Sequence[_Known], priors: Mapping[str, Prior]) -> Array:
    """Return a point with the parameters that are not identified at their means, and the others most likely given these."""
    loose = [j for j, interval in enumerate(ranges) if not interval.identified]
    if not loose:
        return point.copy()
    moved = point.copy()
    moved[loose] = np.log([ranges[j].mean for j in loose])
    return search(objective, moved, priors, fixed=loose).point


class _Stage:
    """Progress of a fit, reported after each evaluation: the number of evaluations of a search is not known beforehand."""

    def __init__(self, progress: Callable[[str], None] | None) -> None:
        self.progress, self.what, self.evaluations = progress, "", 0

    def evaluated(self) -> None:
        self.evaluations += 1
        if self.progress is not None:
            self.progress(f"{self.what}, {self.evaluations} evaluations")

    def each(self, what: str, work: Callable[[Any], T], jobs: Sequence[Any] | Array, threads: int) -> list[T]:
        done = itertools.count(1)
        self.what = f"{what}: 0 of {len(jobs)}"

        def counted(job: Any) -> T:
            result = work(job)
            self.what = f"{what}: {next(done)} of {len(jobs)}"
            return result

        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(counted, jobs))


class _Errors(NamedTuple):
    """Uncertainty of the best point."""

    covariance: Array
    """Covariance of the logarithms by the information (p, p)."""
    standard: Array
    """Standard errors of the logarithms (p,)."""
    swollen: Array
    """Ratio of the standard errors to those by the information (p,)."""
    misfit: bool


def _errors(objective: Objective, best: Optimum) -> _Errors:
    """Return the errors of the best point: by the information, or by the sandwich for a misfit or a composite objective."""
    local, information = best.local, best.local.information
    curvature = objective.curvature(best.point)
    if curvature is not None:  # with that of the priors, if positive definite
        own = curvature + information - local.derivatives.information
        information = own if np.linalg.eigvalsh(own)[0] > 0.0 else information
    covariance, robust = covariances(information, local.derivatives.score)
    standard, sandwich = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(robust))
    misfit = not objective.composite and bool(np.any(sandwich > MISFIT * standard))
    # A likelihood whose standard errors are too small by a factor falls too fast by its square.
    swollen = np.ones(len(best.point))
    if misfit or objective.composite:
        swollen = np.maximum(sandwich / standard, 0.0 if objective.composite else 1.0)
    return _Errors(covariance, swollen * standard, swollen, misfit)


@dataclass(frozen=True, kw_only=True, eq=False)
class Slices:
    """The likelihood along each parameter, with the others at their most likely values."""

    names: tuple[str, ...]
    values: Array
    """Values of the parameter (p, k), SI."""
    fallen: Array
    """2 Δℓ: decrease of twice the log likelihood from its maximum (p, k)."""

    def summary(self) -> list[dict[str, Any]]:
        """Return the slices as values for JSON, in SI units."""
        rows = zip(self.names, self.values, self.fallen, strict=True)
        return plain([{"name": name, "values": x, "fallen": y} for name, x, y in rows])  # type: ignore[no-any-return]


SLICE_POINTS = 25
"""Number of points of a slice, odd, so that the tuned one is the middle."""


def slices(tuning: Tuning) -> Slices:
    """Return slices of the objective of a tuning through the tuned point, somewhat wider than each interval, without priors.

    The points are densest about the tuned one: a slice may be much narrower than the interval, for which the other parameters vary too.
    """
    grid = np.linspace(-1.0, 1.0, SLICE_POINTS) ** 3
    values, fallen = [], []
    for j, parameter in enumerate(tuning.parameters):
        width = 2.5 * min(max(parameter.standard_error, 1e-3), 1.0)
        top = parameter.upper if np.isfinite(parameter.upper) else parameter.value * np.exp(width)
        ends = np.log(
            [
                max(min(parameter.lower, parameter.value), parameter.value * np.exp(-2.0 * width), 1e-300),
                max(top, parameter.value),
            ]
        )
        ends += np.array([-0.3, 0.3]) * max(float(np.ptp(ends)), 1e-3)
        points = np.tile(tuning.point, (SLICE_POINTS, 1))
        points[:, j] += np.where(grid < 0.0, tuning.point[j] - ends[0], ends[1] - tuning.point[j]) * grid
        value = tuning.objective.minus_log(points)
        values.append(np.exp(points[:, j]))
        fallen.append(2.0 * (value - value.min()))
    return Slices(names=tuning.objective.names, values=np.array(values), fallen=np.array(fallen))


def covariances(information: Array, parts: Array) -> tuple[Array, Array]:
    """Return the covariance of the log parameters by the information (p, p), and by the sandwich F⁻¹ J F⁻¹.

    J is the scatter of the gradient over parts (m, p) of the records (White 1982); with parts longer than the correlation of the
    innovations it holds for innovations that are not white. Without information the variance is a large number instead of infinite.
    """
    # For a parameter without effect the pseudo-inverse would give a variance of zero.
    F = information + np.diag(np.maximum(MIN_INFORMATION - np.diag(information), 0.0))
    scale = np.sqrt(np.diag(F))
    inverse = np.linalg.pinv(F / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(scale, scale)
    scatter = (parts - parts.mean(axis=0)).T @ (parts - parts.mean(axis=0)) * (len(parts) / max(len(parts) - 1, 1))
    return inverse, inverse @ scatter @ inverse


def _wald(best: Optimum, j: int, error: float) -> _Known:
    half = float(np.clip(np.nan_to_num(np.sqrt(TWO_SIDED) * error, nan=REACH), 0.0, REACH))
    value = float(np.exp(best.point[j]))
    return _Known(
        lower=float(value * np.exp(-half)),
        upper=float(value * np.exp(half)),
        mean=value,
        identified=bool(error < WELL_KNOWN),
    )


def _profiled(
    objective: Objective, best: Optimum, j: int, priors: Mapping[str, Prior], error: float, swollen: float
) -> _Known:
    """Return the interval of parameter j by its profile likelihood."""
    from scipy.integrate import simpson
    from scipy.optimize import brentq

    centre = best.point[j]
    warm = best.point.copy()
    drops: dict[float, float] = {centre: 0.0}

    def fallen(x: float) -> float:
        """2 Δℓ of the profile at log value x."""
        if x not in drops:
            warm[j] = x
            optimum = search(objective, warm, priors, fixed=[j], steps=50)
            warm[:] = optimum.point
            drops[x] = 2.0 * (optimum.local.value - best.local.value) / swollen
        return drops[x]

    nothing = -np.inf if objective.names[j] == RRW else centre - 7.0
    at_zero = fallen(nothing) if objective.names[j] not in priors else np.inf
    warm[:] = best.point
    refuted = at_zero > ONE_SIDED
    level = TWO_SIDED if refuted else ONE_SIDED
    step = float(np.clip(np.nan_to_num(2.0 * error, nan=2.0), 0.3, 2.0))

    def crossing(direction: float) -> float | None:
        near, far = centre, centre
        while fallen(far) < level:
            near, far = far, far + direction * step
            if far > objective.start[j] + REACH or far < centre - REACH:
                return None
        return float(brentq(lambda x: fallen(x) - level, near, far, xtol=0.005))

    top = crossing(1.0)
    warm[:] = best.point
    bottom = crossing(-1.0) if at_zero > level else None
    upper = float(np.exp(top)) if top is not None else np.inf
    lower = float(np.exp(bottom)) if bottom is not None else 0.0
    value = float(np.exp(centre))
    identified = refuted and top is not None
    if not identified and top is not None:
        # Mean of σ under the profile likelihood with a uniform prior on σ ≥ 0: strictly between zero and the bound.
        warm[:] = best.point
        grid = np.linspace(0.0, 2.0 * upper, 17)
        with np.errstate(divide="ignore"):
            logs = np.log(grid)
        weight = np.array([np.exp(-0.5 * max(fallen(x if k else nothing), 0.0)) for k, x in enumerate(logs)])
        value = float(simpson(grid * weight, x=grid) / simpson(weight, x=grid))
    return _Known(lower=lower, upper=upper, mean=value, identified=identified)


def _note(
    name: str, known: _Known, error: float, local: Local, j: int, priors: Mapping[str, Prior], *, doubtful: bool
) -> str:
    if name in priors:
        share = 1.0 - priors[name].spread ** -2 / local.information[j, j]
        if share < 0.5:
            return "from the prior; this record adds little"
    if not known.identified:
        return NOT_IDENTIFIED
    if doubtful and name != SCALE:
        return "in doubt: the innovations contradict the filter's model"
    if known.lower == 0.0 or known.upper > 4.0 * known.lower:
        return "identified, but poorly"
    return "identified" if error < WELL_KNOWN else "identified roughly"
