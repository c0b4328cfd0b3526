"""All hypotheses on one record, ranked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from strapdown import coning, consistency, estimation
from strapdown.checks import InputError
from strapdown.consistency import Judgement
from strapdown.consistency.bounds import tail
from strapdown.estimation.setup import FilterSetup, modelled_record, need_mekf
from strapdown.records import Estimate, ImuRecord
from strapdown.tuning.diagnosis.causes import Cause, Diagnosis
from strapdown.tuning.diagnosis.commutation import ACCURATE_ALGORITHM, commutation
from strapdown.tuning.diagnosis.hypotheses import conventions, mean_hypotheses, noise_hypotheses, outliers
from strapdown.tuning.diagnosis.likelihood import Model, Run, by_mean, by_variance, run

GROSS = 3.0
"""Conventions are tested if the NIS per degree of freedom of a sensor exceeds this, because a wrong one has a large effect."""


def diagnose(
    record: ImuRecord,
    setup: FilterSetup,
    initial: estimation.State,
    *,
    probability: float = 0.99,
    judgement: Judgement | None = None,
) -> Diagnosis:
    """Return the verdict on a filter by all evidence in a record, and the likely causes of its faults.

    Parameters
    ----------
    record : ImuRecord
        Record as measured, with all gyro samples; its truth is used if there is one.
    setup : FilterSetup
        The filter's model. Gates and robust updates are disabled here, because they hide faults.
    initial : State
        Initial state of the filter.
    probability : float
        Minimum probability that a consistent filter passes and has no cause reported.
    judgement : Judgement, optional
        Judgement of the filter's estimate by :func:`strapdown.consistency.judge`. Default: the filter is run and judged here.

    Returns
    -------
    Diagnosis
        The causes, and a ``judgement`` by statistics and all likelihood ratios at one joint probability of a false alarm.

    Notes
    -----
    The filter is run about ten times per sensor, and a hundred times more for gross faults. Statistics may pass where a likelihood ratio
    does not: a rate random walk ten times too small has hardly any effect on the NIS.
    """
    tail(probability)
    if not any(len(series.time) for series in record.vectors):
        raise InputError("record has no vector measurements, so there are no innovations to diagnose from")
    need_mekf(setup, "the search for causes")
    modelled = modelled_record(record, setup)
    truth = modelled.truth
    # The hypotheses do not use the truth, whose checks would be repeated for each of their records.
    model = Model(record=replace(modelled, truth=None), noise=setup.process_noise, initial=initial)
    every = max(1, len(model.record.increments) // 1000)
    estimate = estimation.run(model.record, model.noise, model.initial, every=every, full_covariance=True)
    kept = None if truth is None else truth.taken(slice(None, None, every))
    if judgement is None:
        judgement = consistency.judge(estimate, kept, confidence_level=probability)
    base = run(model)
    accurate = modelled_record(record, replace(setup, integration=coning.ALGORITHMS[ACCURATE_ALGORITHM]))
    better = run(replace(model, record=replace(accurate, truth=None))).closer_than(base)
    considered = [*_causes(model, base, estimate), commutation(record, setup, estimate, kept, better)]
    worst = max(float(np.mean(i.nis) / i.innovation.shape[1]) for i in estimate.innovations.values() if len(i.time))
    if worst > GROSS:
        considered += conventions(model, base)
    considered.sort(key=lambda cause: (cause.log_p, -cause.gain))
    evidence = [*judgement.findings, *(cause.finding for cause in considered)]
    together = consistency.concluded(
        evidence,
        judgement.limits,
        probability,
        parts={part.of: part.why for part in judgement.parts},
        required=judgement.required,
        unmodelled=judgement.unmodelled,
    )
    rejected = [finding.rejected for finding in together.findings[len(judgement.findings) :]]
    return Diagnosis(
        causes=tuple(cause for cause, significant in zip(considered, rejected, strict=True) if significant),
        considered=tuple(considered),
        judgement=together,
        probability=probability,
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
