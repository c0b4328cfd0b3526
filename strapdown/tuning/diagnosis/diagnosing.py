"""All hypotheses on one record, ranked."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from strapdown import coning, consistency, estimation, quaternion
from strapdown.checks import Array, InputError
from strapdown.consistency import Judgement
from strapdown.estimation.setup import FilterSetup, modelled_record, need_mekf, unmodelled
from strapdown.estimation.setup.matching import ACCURATE_ALGORITHM
from strapdown.records import Estimate, ImuRecord, Truth
from strapdown.tuning.diagnosis.causes import Cause, Diagnosis
from strapdown.tuning.diagnosis.hypotheses import conventions, mean_hypotheses, noise_hypotheses, outliers, shown
from strapdown.tuning.diagnosis.likelihood import Model, Run, by_mean, by_variance, log_p, run
from strapdown.units import DEGREE_PER_HOUR

GROSS = 3.0
"""Conventions are tested if the NIS per degree of freedom of a sensor exceeds this, because a wrong one has a large effect."""


def diagnose(
    record: ImuRecord,
    setup: FilterSetup,
    initial: estimation.State,
    *,
    judgement: Judgement | None = None,
) -> Diagnosis:
    """Return the verdict on a filter by all evidence in a record, and the likely causes of its faults.

    Parameters
    ----------
    record : ImuRecord
        Record as measured, with all gyro samples; its truth is used if there is one, and errors that its origin specifies are known.
    setup : FilterSetup
        The filter's model. Gates and robust updates are disabled here, because they hide faults.
    initial : State
        Initial state of the filter.
    judgement : Judgement, optional
        Judgement of the filter's estimate by :func:`strapdown.consistency.judge`; its confidence level is that of the causes too.
        Default: the filter is run and judged here, at 0.99.

    Returns
    -------
    Diagnosis
        The causes, and a ``judgement`` by statistics and all likelihood ratios at one joint probability of a false alarm.

    Notes
    -----
    The filter is run about ten times per sensor, and a hundred times more for gross faults. Statistics may pass where a likelihood ratio
    does not: a rate random walk ten times too small has hardly any effect on the NIS.
    """
    need_mekf(setup, "the search for causes")
    modelled = modelled_record(record, setup)
    truth = modelled.truth
    # The hypotheses do not use the truth, whose checks would be repeated for each of their records.
    model = Model(record=replace(modelled, truth=None), noise=setup.process_noise, initial=initial)
    every = max(1, len(model.record.increments) // 1000)
    estimate = estimation.run(model.record, model.noise, model.initial, every=every, full_covariance=True)
    measured = [innovations for innovations in estimate.innovations.values() if len(innovations.time)]
    if not measured:
        raise InputError("record has no vector measurements in its time, so there are no innovations to diagnose from")
    kept = None if truth is None else truth.taken(slice(None, None, every))
    if judgement is None:
        judgement = consistency.judge(replace(estimate, setup=setup, origin=record.origin), kept)
    base = run(model)
    accurate = modelled_record(record, replace(setup, integration=coning.ALGORITHMS[ACCURATE_ALGORITHM]))
    better = run(replace(model, record=replace(accurate, truth=None))).closer_than(base)
    considered = [*_causes(model, base, estimate), _commutation(record, setup, estimate, kept, better)]
    if max(float(np.mean(i.nis) / i.innovation.shape[1]) for i in measured) > GROSS:
        considered += conventions(model, base)
    known = {(error.of, error.name) for error in unmodelled(record.origin, setup)}
    considered = [replace(cause, known=(cause.of, cause.name) in known) for cause in considered]
    considered.sort(key=lambda cause: (cause.log_p, -cause.gain))
    evidence = [*judgement.findings, *(cause.finding for cause in considered)]
    together = consistency.concluded(
        evidence,
        judgement.limits,
        judgement.confidence_level,
        parts={part.of: part.why for part in judgement.parts},
        required=judgement.required,
        unmodelled=judgement.unmodelled,
    )
    rejected = [finding.rejected for finding in together.findings[len(judgement.findings) :]]
    return Diagnosis(
        causes=tuple(cause for cause, significant in zip(considered, rejected, strict=True) if significant),
        considered=tuple(considered),
        judgement=together,
    )


def _causes(model: Model, base: Run, estimate: Estimate) -> Iterator[Cause]:
    """Yield the causes that change the filter's model, and outliers, likely or not; ``base``: the innovations of that model."""
    for hypothesis in noise_hypotheses(model):
        yield by_variance(model, base, hypothesis)
    for hypothesis in mean_hypotheses(model):
        yield by_mean(model, base, hypothesis)
    for sensor, innovations in estimate.innovations.items():
        if len(innovations.time):
            yield outliers(sensor, innovations.whitened)


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
    drift = quaternion.rotation_between(turn, own)
    # Steps of one vibration are correlated, so the scatter is that between blocks much longer than its period.
    parts = min(20, blocks)
    bounds = np.linspace(0, blocks, parts + 1).astype(int)
    means = np.array([drift[a:b].sum(axis=0) / step[a:b].sum() for a, b in itertools.pairwise(bounds)])
    return drift.sum(axis=0) / step.sum(), means.std(axis=0, ddof=1) / math.sqrt(parts)


def _commutation(
    record: ImuRecord, setup: FilterSetup, estimate: Estimate, truth: Truth | None, better: float
) -> Cause:
    """Return commutation as a cause; its gain is by the bias error that it explains at the end, or would without a truth.

    Or it is ``better``, that of the innovations with the accurate algorithm, which has no parameter: its p-value is at most exp(−gain/2).
    """
    drift, error = commutation_drift(record, setup.integration)
    assert estimate.covariance is not None
    P = estimate.covariance[-1, 3:, 3:] + np.diag(error**2)
    # If the drift is estimated as bias, b_true − b_est is −drift: the gain is by how well this explains the final error.
    error_at_end = -drift if truth is None else truth.bias[-1] - estimate.bias[-1]
    left = error_at_end + drift
    gain = float(error_at_end @ np.linalg.solve(P, error_at_end) - left @ np.linalg.solve(P, left))
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
