"""Commutation error of the gyro's integration, which a filter cannot distinguish from a gyro bias."""

from __future__ import annotations

import itertools
import math

import numpy as np

from strapdown import coning, quaternion
from strapdown.checks import Array, InputError
from strapdown.estimation.setup import FilterSetup
from strapdown.records import Estimate, ImuRecord, Truth
from strapdown.tuning.diagnosis.causes import Cause
from strapdown.tuning.diagnosis.hypotheses import shown
from strapdown.tuning.diagnosis.likelihood import log_p
from strapdown.units import DEGREE_PER_HOUR

ACCURATE_ALGORITHM = "matched-1-8-8"
"""Integration algorithm with which others are compared."""


def commutation_drift(record: ImuRecord, algorithm: coning.Algorithm) -> tuple[Array, Array]:
    """Return the mean drift of an algorithm's attitude on a record, estimated minus true (3,), rad/s, body axes, and its standard error.

    The increments are integrated by the algorithm and by a more accurate one, and the rotations of each step compared. A filter estimates
    this drift as gyro bias, in addition to the true one.
    """
    n = algorithm.samples
    blocks = len(record.increments) // n
    if blocks < 2:
        raise InputError(f"record has {len(record.increments)} gyro samples, too few for {algorithm.name}")
    increments = record.increments[: blocks * n]
    edges = record.time[: blocks * n + 1]
    own = quaternion.exp(coning.rotation_vectors(increments, algorithm, edges=edges))
    best = quaternion.exp(coning.rotation_vectors(increments, ACCURATE_ALGORITHM, edges=edges)).reshape(blocks, n, 4)
    turn = best[:, 0]
    for k in range(1, n):
        turn = quaternion.multiply(turn, best[:, k])
    step = np.diff(record.time[: blocks * n + 1 : n])
    drift = quaternion.log(quaternion.multiply(quaternion.conjugate(turn), own))
    # Steps of one vibration are correlated, so the scatter is that between blocks much longer than its period.
    parts = min(20, blocks)
    bounds = np.linspace(0, blocks, parts + 1).astype(int)
    means = np.array([drift[a:b].sum(axis=0) / step[a:b].sum() for a, b in itertools.pairwise(bounds)])
    return drift.sum(axis=0) / step.sum(), means.std(axis=0, ddof=1) / math.sqrt(parts)


def commutation(record: ImuRecord, setup: FilterSetup, estimate: Estimate, truth: Truth | None, better: float) -> Cause:
    """Return commutation as a cause; its gain is by the bias error that it explains at the end, or would without a truth.

    Or it is ``better``, that of the innovations with the accurate algorithm, which has no parameter: its p-value is at most exp(−gain/2).
    """
    drift, error = commutation_drift(record, setup.integration)
    assert estimate.covariance is not None
    P = estimate.covariance[-1, 3:, 3:] + np.diag(error**2)
    if truth is None:
        gain = float(drift @ np.linalg.solve(P, drift))
    else:
        # If the drift is estimated as bias, b_true − b_est is −drift: the gain is by how well this explains the final error.
        e = truth.bias[-1] - estimate.bias[-1]
        gain = float(e @ np.linalg.solve(P, e) - (e + drift) @ np.linalg.solve(P, e + drift))
    size = float(np.linalg.norm(drift))
    sigma = math.sqrt(float(drift @ P @ drift)) / size if size > 0.0 else math.inf
    return Cause(
        name="commutation",
        of=setup.integration.name,
        estimate=drift,
        standard_error=error,
        unit="rad/s",
        gain=max(gain, better),
        log_p=min(log_p(gain, 1), -0.5 * better),
        words=(
            f"integration by {setup.integration.name} drifts by {shown(drift / DEGREE_PER_HOUR)} °/h on average, estimated as gyro bias; "
            f"the filter's σ in this direction is {sigma / DEGREE_PER_HOUR:.3g} °/h"
        ),
    )
