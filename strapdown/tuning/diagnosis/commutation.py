"""Commutation error of the gyro's integration: to a filter it is a gyro bias."""

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
"""Integration algorithm that others are held against."""


def commutation_drift(record: ImuRecord, algorithm: coning.Algorithm) -> tuple[Array, Array]:
    """Return the mean drift of an algorithm's attitude on a record, estimated minus true (3,), rad/s, body axes, and its standard error.

    The increments are integrated by the algorithm and by a better one, and the turns of each step compared. To a filter this drift is a
    gyro bias: its bias estimate is too large by it.
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
    # Steps of one vibration are correlated: the scatter is taken between blocks that are long against it.
    parts = min(20, blocks)
    bounds = np.linspace(0, blocks, parts + 1).astype(int)
    means = np.array([drift[a:b].sum(axis=0) / step[a:b].sum() for a, b in itertools.pairwise(bounds)])
    return drift.sum(axis=0) / step.sum(), means.std(axis=0, ddof=1) / math.sqrt(parts)


def commutation(record: ImuRecord, setup: FilterSetup, estimate: Estimate, truth: Truth | None) -> Cause:
    """Return commutation as a cause: the gain is what it explains of the bias error at the end, or would if there is no truth."""
    drift, error = commutation_drift(record, setup.integration)
    assert estimate.covariance is not None
    P = estimate.covariance[-1, 3:, 3:] + np.diag(error**2)
    if truth is None:
        gain = float(drift @ np.linalg.solve(P, drift))
    else:
        # b_true − b_est is −drift if the drift is taken for bias: does that explain the error at the end?
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
        gain=gain,
        log_p=log_p(gain, 1),
        words=(
            f"integration by {setup.integration.name} drifts by {shown(drift / DEGREE_PER_HOUR)} °/h, taken for gyro bias by the filter; "
            f"its σ there is {sigma / DEGREE_PER_HOUR:.3g} °/h"
        ),
    )
