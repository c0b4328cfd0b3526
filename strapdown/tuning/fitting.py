"""Maximum-likelihood parameters, from several starts, with an interval for each.

The search is Fisher's scoring, damped (Levenberg–Marquardt) and limited to steps of a factor e² in each parameter. If the data determine a
parameter well, its interval follows from the information; otherwise from the profile likelihood, which a parabola does not describe when
zero is as likely as the best value. Then only an upper bound is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from strapdown.checks import Array, InputError, count, known_keys
from strapdown.results import counted
from strapdown.tuning.objective import REACH, Derivatives, Objective, need_measurements
from strapdown.tuning.parameters import RRW, SCALE, Prior
from strapdown.tuning.result import NOT_IDENTIFIED, Estimated, Tuning

START_FACTOR = 30.0
"""Maximum factor, up or down, between random starts and the setup's values."""
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
CONTRADICTED = 3.0
"""Difference of prior and data, relative to the σ of both together, above which the data contradict a prior."""
NEGLIGIBLE = 1e-3
"""Gain of the log likelihood that is negligible."""
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


def local_at(objective: Objective, point: Array) -> Local:
    """Return the objective with its priors at a point."""
    derivatives = objective.derivatives(point)
    value, score = float(derivatives.value.sum()), derivatives.score.sum(axis=0)
    information = derivatives.information.copy()
    for name, prior in objective.priors.items():
        j = objective.names.index(name)
        away = (point[j] - np.log(prior.value)) / prior.spread
        value += 0.5 * away**2
        score[j] += away / prior.spread
        information[j, j] += prior.spread**-2
    return Local(value=value, score=score, information=information, derivatives=derivatives)


def search(objective: Objective, start: Array, *, fixed: Sequence[int] = (), steps: int = 200) -> Optimum:
    """Return the minimum reached from ``start``; the parameters with indices ``fixed`` are held fixed."""
    x = np.array(start, float)
    moving = ~np.isin(np.arange(len(x)), fixed)
    low, high = objective.limits
    here = local_at(objective, x)
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
            there = local_at(objective, trial)
            if there.value <= here.value:
                break
            damping, stretch = max(10.0 * damping, 1e-3), 1.0
            if damping > 1e12:
                return ended(number, converged=False)
        if shortened == 1.0 and not objective.composite:
            # If the information exceeds the curvature, as for innovations that contradict the model, steps are too short.
            bend = 2.0 * (gain - (here.value - there.value))
            factor = np.clip(gain / bend, 0.5, 4.0) if bend > 0.25 * gain else 4.0
            stretch = float(np.clip(stretch * factor, 0.25, 64.0))
        x, here, damping = trial, there, max(0.1 * damping, 1e-9)
    return ended(steps, converged=False)


def fit(
    objective: Objective,
    *,
    priors: Mapping[str, Prior] | None = None,
    starts: int = 4,
    seed: int = 0,
    threads: int = 1,
    intervals: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Tuning:
    """Return the maximum-likelihood parameters with their intervals.

    Parameters
    ----------
    objective : Objective
        Likelihood of the innovations (:func:`likelihood`), or another objective of this package.
    priors : mapping of str to Prior, optional
        Prior knowledge by parameter; the result is then the maximum of the posterior density.
    starts : int, default 4
        Number of searches: the first from the setup's values, the others from random starts, up to a factor of 30 away.
    seed : int, default 0
        Seed of the random starts.
    threads : int, default 1
        Number of searches in parallel.
    intervals : bool, default True
        Whether to evaluate the profile likelihood of parameters that are not well determined.
    progress : callable, optional
        Called with the progress, such as ``"searches: 1 of 4"``.

    Returns
    -------
    Tuning
        The tuned filter, parameters with 95 % intervals, and where each search ended.

    Raises
    ------
    InputError
        If a prior names no free parameter, there are no more measurements than parameters without prior, or the search does not converge.

    References
    ----------
    F. C. Schweppe, Evaluation of likelihood functions for Gaussian signals, IEEE Trans. Information Theory 11(1), 1965.
    H. White, Maximum likelihood estimation of misspecified models, Econometrica 50(1), 1982 (intervals if the model does not hold).
    """
    known_keys("priors", priors or {}, objective.names)
    objective = replace(objective, priors=priors or {})
    measured, free = sum(map(need_measurements, objective.cases)), len(objective.names) - len(objective.priors)
    if measured <= free:
        words = f"{counted(measured, 'measurement')} cannot determine {counted(free, 'parameter')}"
        raise InputError(f"{words}; give more data, or priors")
    spread, shape = np.log(START_FACTOR), (count("starts", starts) - 1, len(objective.start))
    away = np.random.default_rng(seed).uniform(-spread, spread, shape)
    points = np.concatenate([objective.start[None], objective.start + away])
    points = np.clip(points, *objective.limits)
    optima = _each("searches", lambda point: search(objective, point), points, threads, progress)
    best = min(optima, key=lambda optimum: optimum.local.value)
    if not best.converged:
        raise InputError(
            "the search did not converge in 200 steps; free fewer parameters, or give priors for those that the record does not determine"
        )
    errors = _errors(objective, best)

    def interval(j: int) -> _Interval:
        known = errors.standard[j] < WELL_KNOWN or not intervals
        return _wald(best, j, errors) if known else _profiled(objective, best, j, errors)

    ranges = _each("intervals", interval, range(len(best.point)), threads, progress)
    point = _with_means(objective, best.point, ranges)
    return Tuning(
        parameters=tuple(_estimated(objective, best, j, point, ranges[j], errors) for j in range(len(point))),
        setup=objective.setup(point),
        point=point,
        before=local_at(objective, objective.start).value,
        after=best.local.value,
        covariance=errors.covariance,
        misfit=errors.misfit,
        contradicted=errors.contradicted,
        starts=points,
        optima=np.array([optimum.point for optimum in optima]),
        agreeing=sum(optimum.local.value < best.local.value + NEGLIGIBLE for optimum in optima),
        objective=objective,
    )


def _each(
    what: str,
    work: Callable[[Any], T],
    jobs: Sequence[Any] | Array,
    threads: int,
    progress: Callable[[str], None] | None,
) -> list[T]:
    """Return ``work`` of each job, distributed over the threads."""
    report = progress or (lambda words: None)
    report(f"{what}: 0 of {len(jobs)}")
    results: list[T] = []
    with ThreadPoolExecutor(threads) as pool:
        for result in pool.map(work, jobs):  # which cancels the rest at an exception or Ctrl-C
            results.append(result)
            report(f"{what}: {len(results)} of {len(jobs)}")
    return results


class _Errors(NamedTuple):
    """Uncertainty of the best point."""

    covariance: Array
    """Covariance of the logarithms (p, p)."""
    standard: Array
    """Standard errors of the logarithms (p,)."""
    swollen: Array
    """Ratio of the standard errors to those by the information (p,)."""
    misfit: bool
    contradicted: tuple[str, ...] = ()
    """Parameters whose priors the data contradict."""


def _errors(objective: Objective, best: Optimum) -> _Errors:
    """Return the errors of the best point: by the information, or by the sandwich for a misfit or a composite objective."""
    local, information = best.local, best.local.information
    curvature = objective.curvature(best.point)
    if curvature is not None:  # with that of the priors, if positive definite
        observed = curvature + information - local.derivatives.information
        information = observed if np.linalg.eigvalsh(observed)[0] > 0.0 else information
    covariance, robust = covariances(information, local.derivatives.score)
    standard, sandwich = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(robust))
    if objective.composite:  # errors of the bias last longer than a part
        sandwich *= np.sqrt(correlation_factor(local.derivatives.score @ covariance))
    misfit = not objective.composite and bool(np.any(sandwich > MISFIT * standard))
    # A likelihood whose standard errors are too small by a factor falls too fast by its square.
    swollen = np.ones(len(best.point))
    if misfit or objective.composite:
        swollen = np.maximum(sandwich / standard, 0.0 if objective.composite else 1.0)
    contradicted = tuple(
        name
        for name, prior in objective.priors.items()
        if _contradicts(best.point[j := objective.names.index(name)], float(standard[j]), prior)
    )
    return _Errors(covariance * np.outer(swollen, swollen), swollen * standard, swollen, misfit, contradicted)


def _contradicts(log_value: float, standard: float, prior: Prior) -> bool:
    """Return whether the data contradict a prior, given the most likely value by both and its standard error.

    With d the difference of the two and their variances s² and p², the most likely value is d p²/(p² + s²) from the prior, and its variance
    v = p² s²/(p² + s²); so its distance over √(p² − v) is d/√(p² + s²), which is normal if both are right.
    """
    left = prior.spread**2 - standard**2
    away = abs(log_value - float(np.log(prior.value)))
    # Without information the prior is the answer, to rounding.
    return left > 1e-6 * prior.spread**2 and away > CONTRADICTED * float(np.sqrt(left))


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


def correlation_factor(parts: Array) -> Array:
    """Return the factor on the variance of a sum of parts (m, p) by the correlation of neighbours: (1 + ρ)/(1 − ρ), that of AR(1).

    ρ from 0 to 0.8 is the autocorrelation at lag 1, corrected for its bias with an estimated mean, −(1 + 3ρ)/m (Marriott & Pope 1954).
    """
    parts, m = parts - parts.mean(axis=0), len(parts)
    estimated = np.sum(parts[1:] * parts[:-1], axis=0) / np.maximum(np.sum(parts**2, axis=0), np.finfo(float).tiny)
    rho = np.clip((m * estimated + 1.0) / (m - 3.0), 0.0, 0.8)
    return np.asarray((1.0 + rho) / (1.0 - rho))


class _Interval(NamedTuple):
    """95 % interval of a parameter."""

    lower: float
    upper: float
    mean: float
    """Value to use if the parameter is not identified."""
    identified: bool


def _wald(best: Optimum, j: int, errors: _Errors) -> _Interval:
    """Return the interval of parameter j by its standard error."""
    value, error = float(np.exp(best.point[j])), float(errors.standard[j])
    half = float(np.clip(np.nan_to_num(np.sqrt(TWO_SIDED) * error, nan=REACH), 0.0, REACH))
    return _Interval(value * float(np.exp(-half)), value * float(np.exp(half)), value, error < WELL_KNOWN)


def _profiled(objective: Objective, best: Optimum, j: int, errors: _Errors) -> _Interval:
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
            optimum = search(objective, warm, fixed=[j], steps=50)
            warm[:] = optimum.point
            drops[x] = 2.0 * (optimum.local.value - best.local.value) / float(errors.swollen[j]) ** 2
        return drops[x]

    nothing = -np.inf if objective.names[j] == RRW else centre - 7.0
    at_zero = fallen(nothing) if objective.names[j] not in objective.priors else np.inf
    warm[:] = best.point
    refuted = at_zero > ONE_SIDED
    level = TWO_SIDED if refuted else ONE_SIDED
    step = float(np.clip(np.nan_to_num(2.0 * errors.standard[j], nan=2.0), 0.3, 2.0))

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
        logs = [nothing, *np.log(grid[1:])]
        weight = np.array([np.exp(-0.5 * max(fallen(x), 0.0)) for x in logs])
        value = float(simpson(grid * weight, x=grid) / simpson(weight, x=grid))
    return _Interval(lower, upper, value, identified)


def _with_means(objective: Objective, point: Array, ranges: Sequence[_Interval]) -> Array:
    """Return a point with the parameters that are not identified at their means, and the others most likely given these."""
    loose = [j for j, interval in enumerate(ranges) if not interval.identified]
    if not loose:
        return point
    moved = point.copy()
    moved[loose] = np.log([ranges[j].mean for j in loose])
    return search(objective, moved, fixed=loose).point


def _estimated(
    objective: Objective, best: Optimum, j: int, point: Array, interval: _Interval, errors: _Errors
) -> Estimated:
    """Return parameter j with its interval; ``point`` has the values used in the filter."""
    return Estimated(
        name=objective.names[j],
        start=float(np.exp(objective.start[j])),
        value=float(np.exp(point[j])),
        most_likely=float(np.exp(best.point[j])) if not best.local.settled[j] else 0.0,
        lower=interval.lower,
        upper=interval.upper,
        standard_error=float(errors.standard[j]),
        identified=interval.identified,
        note=_note(objective, best, j, interval, errors),
        unit=objective.unit(objective.names[j]),
    )


def _note(objective: Objective, best: Optimum, j: int, interval: _Interval, errors: _Errors) -> str:
    """Return the interpretation of parameter j."""
    name = objective.names[j]
    prior = objective.priors.get(name)
    if name in errors.contradicted:
        return "in doubt: the data contradict its prior"
    if prior is not None and best.local.information[j, j] < 2.0 * prior.spread**-2:
        return "from the prior; this record adds little"
    if not interval.identified:
        return NOT_IDENTIFIED
    if errors.misfit and name != SCALE:
        return "in doubt: the innovations contradict the filter's model"
    if interval.lower == 0.0 or interval.upper > 4.0 * interval.lower:
        return "identified, but poorly"
    return "identified" if errors.standard[j] < WELL_KNOWN else "identified roughly"
