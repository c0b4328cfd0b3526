"""Tuning of a user-defined filter (:mod:`strapdown.estimation.filters.own`) by the objectives of the package's filter.

Each evaluation runs the filter, which need not provide derivatives: the search is the simplex of Nelder & Mead in the logarithms of the
parameters, suitable for a few of them.

>>> def make(values):  # doctest: +SKIP
...     return MyFilter(white=values["white"], walk=values["walk"])
>>> found = tuning.fit_own(make, [tuning.record_case(record, setup)], {"white": 1e-4, "walk": 1e-6})  # doctest: +SKIP
>>> found.values, replace(setup, estimator=found.estimator)  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from strapdown import consistency
from strapdown.checks import Array, InputError, one_of, positive
from strapdown.consistency import whitened
from strapdown.estimation.filters.own import as_own
from strapdown.records import Estimate
from strapdown.tuning.errors import MAX_EPOCHS, reference
from strapdown.tuning.objective import Case

OwnMeasure = Literal["innovations", "errors", "rmse"]
OWN_MEASURES = ("innovations", "errors", "rmse")
FIRST_STEP = 0.5
"""Initial size of the simplex, in the logarithm of each parameter."""
TOLERANCE = 1e-4
"""Final tolerance of the logarithms."""
CURVATURE_STEP = 0.05
"""Step of a log parameter for second derivatives."""
MAX_RUNS = 400
"""Maximum number of evaluations of the search, per parameter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnTuning:
    """The best parameters found.

    Parameters
    ----------
    values : mapping of str to float
        Best value of each parameter, in the unit of its starting value.
    relative_sigma : mapping of str to float
        Relative standard deviation of each value, by the curvature of the likelihood of white innovations; NaN for other measures.
    value : float
        Negative log likelihood without its constant, or the RMS attitude error per axis, rad.
    evaluations : int
        Number of evaluations of the objective; each runs the filter over all records.
    estimator : object
        The filter with these values, as ``make`` returned it.
    """

    values: Mapping[str, float]
    relative_sigma: Mapping[str, float]
    value: float
    evaluations: int
    estimator: Any


def fit_own(
    make: Callable[[dict[str, float]], Any],
    cases: Sequence[Case],
    start: Mapping[str, float],
    *,
    measure: OwnMeasure = "innovations",
) -> OwnTuning:
    """Return the parameters of a user-defined filter that fit records best.

    Parameters
    ----------
    make : callable
        Function of the values by name that returns the filter.
    cases : sequence of Case
        Records with the filter's initial states (:func:`strapdown.tuning.record_case`).
    start : mapping
        Starting values of the parameters by name, all greater than zero.
    measure : {"innovations", "errors", "rmse"}
        Likelihood of the innovations, likelihood of the errors against the truth by the filter's covariance, or the RMS attitude error.

    Returns
    -------
    OwnTuning
        Best values by name, their relative standard deviations, and the filter with them.

    Raises
    ------
    InputError
        If there is no record or parameter, the filter gives no innovations (or the records no truth), or the search does not converge.
    """
    from scipy.optimize import minimize

    one_of("measure", measure, OWN_MEASURES)
    if not cases:
        raise InputError("there is no record to tune on; give one")
    names = list(start)
    if not names:
        raise InputError("start names no parameter; give each with its starting value")
    first = np.log([positive(f"start: {name}", start[name]) for name in names])

    def objective(point: Array) -> float:
        values = dict(zip(names, np.exp(point).tolist(), strict=True))
        chosen = as_own(make(values))
        total = np.sum([_measured(chosen(case.record, case.initial), case, measure) for case in cases], axis=0)
        if measure == "rmse":
            return float(np.sqrt(total[0] / total[1]))
        return float(total[0]) if np.isfinite(total[0]) else np.inf

    if not np.isfinite(objective(first)):
        raise InputError("the filter fails with the starting values: its likelihood is not finite; give other values")
    simplex = np.concatenate([first[None], first + FIRST_STEP * np.eye(len(first))])
    options = {"initial_simplex": simplex, "xatol": TOLERANCE, "fatol": 1e-9, "maxfev": MAX_RUNS * len(first)}
    found = minimize(objective, first, method="Nelder-Mead", options=options)
    if not found.success:
        raise InputError(
            f"the search did not converge in {MAX_RUNS * len(first)} runs of the filter; tune fewer parameters, or start closer"
        )
    values = dict(zip(names, np.exp(found.x).tolist(), strict=True))
    sigma = _sigma(objective, found.x) if measure == "innovations" else np.full(len(names), np.nan)
    return OwnTuning(
        values=values,
        relative_sigma=dict(zip(names, sigma.tolist(), strict=True)),
        value=float(found.fun),
        evaluations=int(found.nfev),
        estimator=make(values),
    )


def _measured(estimate: Estimate, case: Case, measure: OwnMeasure) -> Array:
    """Return the contribution of a record to the objective, and its number of samples."""
    if measure == "innovations":
        total, number = 0.0, 0
        for innovations in estimate.innovations.values():
            inside = innovations.used & (innovations.time > case.first) & (innovations.time <= case.last)
            e, s = innovations.innovation[inside], innovations.variance[inside]
            total += 0.5 * float(np.sum(np.log(s) + e * e / s))
            number += e.size
        if not number:
            raise InputError("the filter gives no innovations; return them in its estimate, or tune by errors")
        return np.array([total, number])
    error, P = _errors(estimate, case)
    if measure == "rmse":
        return np.array([float(np.sum(error[:, :3] ** 2)), error[:, :3].size])
    white = whitened(error, P)
    return np.array([0.5 * float(np.sum(white * white) + np.sum(np.linalg.slogdet(P)[1])), error.size])


def _errors(estimate: Estimate, case: Case) -> tuple[Array, Array]:
    """Return errors and covariances at the epochs with a truth, thinned to a maximum number, without the start."""
    known = reference(case, np.searchsorted(case.record.time, estimate.time))
    known = known.at(known.epochs > 0)
    known = known.at(slice(None, None, -(-len(known.epochs) // MAX_EPOCHS) or 1))
    rows = known.epochs
    size = 6 if known.bias is not None and estimate.has_bias else 3
    bias = estimate.bias[rows] if known.bias is None else known.bias
    error = consistency.errors(estimate.attitude[rows], estimate.bias[rows], known.attitude, bias)[:, :size]
    assert estimate.covariance is not None
    return error, estimate.covariance[rows, :size, :size]


def _sigma(objective: Callable[[Array], float], point: Array) -> Array:
    """Return the standard deviations of log parameters by the curvature at the point; NaN if it is not that of a minimum."""
    n = len(point)
    steps = CURVATURE_STEP * np.eye(n)
    middle = objective(point)
    H = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            H[i, j] = H[j, i] = (
                objective(point + steps[i] + steps[j])
                - objective(point + steps[i] - steps[j])
                - objective(point - steps[i] + steps[j])
                + objective(point - steps[i] - steps[j])
                if i != j
                else 4.0 * (objective(point + steps[i]) - 2.0 * middle + objective(point - steps[i]))
            ) / (4.0 * CURVATURE_STEP**2)
    if not np.all(np.linalg.eigvalsh(H) > 0.0):
        return np.full(n, np.nan)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(H))))
