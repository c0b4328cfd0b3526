"""Tuning against a truth: the likelihood of the state errors under the filter's covariance.

The likelihood is that of the filter with its error states, gate and robust weights. Without these two, eight points are computed at once.

Errors at neighbouring times are correlated, so epochs are spaced by the correlation time of the attitude error. The likelihood of all of
them is a composite one (Lindsay 1988): its maximum is consistent, its curvature is not the information, and standard errors come from the
sandwich, with the correlation of its parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import ClassVar, NamedTuple

import numpy as np

from strapdown import consistency, quaternion
from strapdown.checks import Array, InputError, are_finite
from strapdown.estimation.setup import FilterSetup
from strapdown.tuning.innovations import Likelihood, likelihood
from strapdown.tuning.objective import PARTS, STEP, Case, Derivatives, Objective

MAX_EPOCHS = 1000
"""Maximum number of epochs per record."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorObjective(Objective):
    """Objective of the parameters from the state errors; created by :func:`error_objective`."""

    base: Likelihood
    """The filter whose errors are judged."""
    references: tuple[Reference, ...] = field(repr=False)
    """Truth of each record at the judged edges."""
    composite: ClassVar[bool] = True

    def derivatives(self, point: Array) -> Derivatives:
        """Return value, gradient and curvature at a point."""
        rows = np.concatenate([point[None], point + STEP * np.eye(len(point))])
        parts = self.each(self.errors_of, [(number, rows) for number in range(len(self.references))])
        error = np.concatenate([e for e, _ in parts])
        P = np.concatenate([covariance for _, covariance in parts])
        scale = np.sqrt(np.einsum("mii->mi", P[:, 0]))  # attitude in rad, bias in rad/s
        error, P = error / scale[:, None], P / (scale[:, None, :, None] * scale[:, None, None, :])
        inverse = np.linalg.inv(P[:, 0])
        whitened = np.einsum("mlj,mlj->ml", error, np.linalg.solve(P, error[..., None])[..., 0])
        value = 0.5 * (whitened + np.linalg.slogdet(P)[1])
        score = (value[:, 1:] - value[:, :1]) / STEP
        change_e, change_p = (error[:, 1:] - error[:, :1]) / STEP, (P[:, 1:] - P[:, :1]) / STEP
        turned = np.einsum("mab,mlbc->mlac", inverse, change_p)
        information = np.einsum("mja,mab,mkb->jk", change_e, inverse, change_e)
        information += 0.5 * np.einsum("mjab,mkba->jk", turned, turned)
        part = np.arange(len(value)) * PARTS // len(value)
        sums = np.zeros((PARTS, len(point)))
        np.add.at(sums, part, score)
        whole = np.bincount(part, value[:, 0] + np.log(scale).sum(axis=1), PARTS)
        return Derivatives(value=np.asarray(whole, np.float64), score=sums, information=information)

    def errors_of(self, number: int, rows: Array) -> tuple[Array, Array]:
        """Return errors (m, lanes, n) and covariances (m, lanes, n, n) of one record; n is 3 if the true bias is unknown."""
        truth = self.references[number]
        attitude, bias, P = self.base.estimates(number, rows, truth.epochs)
        true_bias = bias if truth.bias is None else truth.bias[:, None]
        error = consistency.errors(attitude, bias, truth.attitude[:, None], true_bias)
        n = 3 if truth.bias is None else 6
        return error[..., :n], P[..., :n, :n]


def error_objective(
    cases: Sequence[Case], setup: FilterSetup, free: Sequence[str], *, threads: int = 1
) -> ErrorObjective:
    """Return the objective that judges the filter by its errors on records with a truth, or with a reference attitude (attitude only).

    The likelihood of the errors under the filter's covariance requires small errors.
    """
    base = likelihood(cases, setup, free, threads=threads)
    references = tuple(_reference(base, number) for number in range(len(base.cases)))
    if len({known.bias is None for known in references}) > 1:
        raise InputError(
            "some records have a true bias, others a reference attitude alone; tune on records of one kind"
        )
    problem = {each.name: getattr(base, each.name) for each in fields(Objective)}
    return ErrorObjective(**problem, base=base, references=references)


class Reference(NamedTuple):
    """Truth of one record at selected edges of the filter's steps."""

    epochs: np.ndarray
    """Indices of the edges (m,)."""
    attitude: Array
    """q_fb (m, 4)."""
    bias: Array | None
    """Gyro bias (m, 3) if known, rad/s."""


def _reference(base: Likelihood, number: int) -> Reference:
    """Return the truth of a record where it is used, at edges spaced by the correlation time of the attitude error."""
    case = base.cases[number]
    truth = case.record.truth
    attitude = case.true_attitude if truth is None else truth.attitude
    edges = np.arange(0, len(case.record.time), base.filter_setup.integration.samples)
    judged = (case.record.time[edges] >= case.first) & (case.record.time[edges] <= case.last)
    if case.judged is not None:
        judged &= case.judged[edges]
    if attitude is not None:
        judged &= are_finite(attitude[edges])
    if attitude is None or not judged.any():
        raise InputError(
            f"{case.name or 'record'} has no truth at the times to be judged; tune by the innovations instead (leave truth out), or give a "
            "reference"
        )
    epochs = np.flatnonzero(judged)
    epochs = epochs[:: max(1, len(epochs) // MAX_EPOCHS)]
    m, lag = len(epochs), 1
    if m >= 100:
        estimated, _, P = base.estimates(number, base.start[None], epochs)
        sigma = np.sqrt(np.diagonal(P[:, 0, :3, :3], axis1=1, axis2=2))
        white = quaternion.rotation_between(estimated[:, 0], attitude[edges[epochs]]) / sigma
        while lag < m // 50 and np.sum(white[lag:] * white[:-lag]) > 0.2 * np.sum(white**2):
            lag += 1
    epochs = epochs[::lag]
    rows = edges[epochs]
    return Reference(epochs, attitude[rows], None if truth is None else truth.bias[rows])
