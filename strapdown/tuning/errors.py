"""Tuning against a truth: the likelihood of the state errors under the filter's covariance, or the size of the attitude error.

Errors at neighbouring times are alike, so epochs are taken as far apart as the attitude error remembers, and the likelihood of all of them
is a composite one (Lindsay 1988): its maximum is right, its curvature is not an information, and standard errors come from the sandwich.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from strapdown import consistency
from strapdown.checks import Array, InputError, one_of
from strapdown.estimation.states import covariance_matrices
from strapdown.setup import FilterSetup
from strapdown.tuning.innovations import MOST, STEP, Case, Derivatives, Likelihood, likelihood

Measure = Literal["likelihood", "rmse"]
MAX_EPOCHS = 1000
"""Epochs taken of one record."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorObjective:
    """Objective of the parameters, from the errors of the state; built by :func:`error_objective`."""

    base: Likelihood
    measure: Measure
    epochs: tuple[np.ndarray, ...] = field(repr=False)
    """Edges judged, of each record."""
    parts: int = 20

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.base.names

    @property
    def start(self) -> Array:
        """Logarithms of their first values."""
        return self.base.start

    @property
    def composite(self) -> bool:
        """Whether the curvature is no information."""
        return True

    def setup(self, point: Array) -> FilterSetup:
        """Return the setup of a point."""
        return self.base.setup(point)

    def minus_log(self, points: Array) -> Array:
        """Return the value at several points (k, p): (k,)."""
        return np.array([self.derivatives(point).value.sum() for point in np.atleast_2d(points)])

    def derivatives(self, point: Array) -> Derivatives:
        """Return value, gradient and curvature at a point."""
        rows = np.concatenate([point[None], point + STEP * np.eye(len(point))])
        found = self.base.each(lambda number: self.errors_of(number, rows), range(len(self.epochs)))
        error = np.concatenate([e for e, _ in found])
        P = np.concatenate([covariance for _, covariance in found])
        return self._squares(error) if self.measure == "rmse" else self._likelihood(error, P)

    def errors_of(self, number: int, rows: Array) -> tuple[Array, Array]:
        """Return errors (m, lanes, n) and covariances (m, lanes, n, n) of one record; n is 3 where the true bias is not known."""
        case, epochs = self.base.prepared[number], self.epochs[number]
        states = np.moveaxis(self.base.states(number, rows, epochs), 1, 2)
        assert case.true_attitude is not None
        bias = states[..., 4:7] if case.true_bias is None else case.true_bias[epochs][:, None]
        error = consistency.errors(states[..., :4], states[..., 4:7], case.true_attitude[epochs][:, None], bias)
        n = 3 if case.true_bias is None or self.measure == "rmse" else 6
        return error[..., :n], covariance_matrices(states[..., 7:])[..., :n, :n]

    def _likelihood(self, error: Array, P: Array) -> Derivatives:
        scale = np.sqrt(np.einsum("mii->mi", P[:, 0]))  # rad beside rad/s
        error, P = error / scale[:, None], P / (scale[:, None, :, None] * scale[:, None, None, :])
        inverse = np.linalg.inv(P[:, 0])
        whitened = np.einsum("mlj,mlj->ml", error, np.linalg.solve(P, error[..., None])[..., 0])
        value = 0.5 * (whitened + np.linalg.slogdet(P)[1])
        score = (value[:, 1:] - value[:, :1]) / STEP
        change_e, change_p = (error[:, 1:] - error[:, :1]) / STEP, (P[:, 1:] - P[:, :1]) / STEP
        turned = np.einsum("mab,mlbc->mlac", inverse, change_p)
        information = np.einsum("mja,mab,mkb->jk", change_e, inverse, change_e) + 0.5 * np.einsum(
            "mjab,mkba->jk", turned, turned
        )
        whole = value[:, 0] + np.log(scale).sum(axis=1)
        return self._by_part(whole, score, information)

    def _squares(self, error: Array) -> Derivatives:
        # ½ N log Σ e²: as if the size of the errors were a free σ of their own, so that the value is a log likelihood in size.
        total, number = float(np.sum(error[:, 0] ** 2)), error[:, 0].size
        change = (error[:, 1:] - error[:, :1]) / STEP
        score = number / total * np.einsum("ma,mja->mj", error[:, 0], change)
        information = number / total * np.einsum("mja,mka->jk", change, change)
        value = np.full(len(error), 0.5 * number / len(error) * np.log(total / number))
        return self._by_part(value, score, information)

    def _by_part(self, value: Array, score: Array, information: Array) -> Derivatives:
        place = np.arange(len(value)) * self.parts // len(value)
        sums = np.zeros((self.parts, score.shape[1]))
        np.add.at(sums, place, score)
        return Derivatives(
            value=np.bincount(place, value, self.parts).astype(np.float64),
            score=sums,
            information=information,
            outer=score.T @ score,
        )


def error_objective(
    cases: Sequence[Case],
    chosen: FilterSetup,
    free: Sequence[str],
    *,
    measure: Measure = "likelihood",
    threads: int = 1,
) -> ErrorObjective:
    """Return the objective that judges the filter by its errors on records with a truth, or a reference attitude: then only the attitude.

    The likelihood of the errors under the filter's covariance asks that they be small and that the filter know how small; the root mean
    square of the attitude error asks for the first alone, and does not determine a common scale of all parameters.
    """
    one_of("measure", measure, ("likelihood", "rmse"))
    base = likelihood(cases, chosen, free, threads=threads)
    if len(base.names) > MOST:
        raise InputError(f"{len(base.names)} parameters are free; against a truth at most {MOST} can be")
    epochs = []
    for number, case in enumerate(cases):
        prepared = base.prepared[number]
        if prepared.true_attitude is None or not prepared.judged.any():
            raise InputError(
                f"{case.name or 'record'} has no truth where it is to be judged; tune by the innovations instead (leave truth out)"
            )
        known = np.flatnonzero(prepared.judged)
        epochs.append(_spread(base, number, known, measure))
    return ErrorObjective(base=base, measure=measure, epochs=tuple(epochs))


def _spread(base: Likelihood, number: int, known: np.ndarray, measure: Measure) -> np.ndarray:
    """Return edges far enough apart that the attitude error of the starting filter has forgotten."""
    picked = known[:: max(1, len(known) // MAX_EPOCHS)]
    if measure == "rmse" or len(picked) < 100:
        return picked
    case = base.prepared[number]
    assert case.true_attitude is not None
    states = base.states(number, base.start[None], picked)[..., 0]
    none = np.zeros((len(picked), 3))
    error = consistency.errors(states[:, :4], none, case.true_attitude[picked], none)[:, :3]
    white = error / np.sqrt(states[:, [7, 10, 12]])
    lag = 1
    while lag < len(picked) // 50 and np.sum(white[lag:] * white[:-lag]) > 0.2 * np.sum(white**2):
        lag += 1
    return picked[::lag]
