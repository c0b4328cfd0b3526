"""All hypotheses on one record, ranked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from strapdown import consistency, estimation
from strapdown.checks import InputError
from strapdown.consistency import Judgement
from strapdown.consistency.bounds import tail
from strapdown.estimation.setup import FilterSetup, modelled_record, need_mekf
from strapdown.records import ImuRecord, Truth
from strapdown.tuning.diagnosis.causes import Diagnosis
from strapdown.tuning.diagnosis.commutation import commutation
from strapdown.tuning.diagnosis.hypotheses import conventions, mean_hypotheses, noise_hypotheses, outliers
from strapdown.tuning.diagnosis.likelihood import Model, by_mean, by_variance, run

GROSS = 3.0
"""Discrete conventions are tried where the NIS per degree of freedom of some sensor exceeds this: a wrong one is not subtle."""


def diagnose(
    record: ImuRecord,
    setup: FilterSetup,
    initial: estimation.State,
    *,
    probability: float = 0.99,
    judgement: Judgement | None = None,
) -> Diagnosis:
    """Return the verdict on a filter by all evidence in a record, and the likely causes of what is wrong with it.

    Parameters
    ----------
    record : ImuRecord
        As the sensors gave it, gyro samples not yet compressed; its truth, if any, is used too.
    setup : FilterSetup
        The filter's model. Gates and robust updates are left out here: they hide what is to be seen.
    initial : State
        Where the filter starts.
    probability : float
        A consistent filter passes and is given no cause with at least this probability.
    judgement : Judgement, optional
        Of the filter's own estimate, by :func:`strapdown.consistency.judge`; default: the filter is run here and judged.

    Returns
    -------
    Diagnosis
        Its ``judgement`` takes the statistics and the likelihood ratios of all hypotheses together, at one probability of a false alarm.

    Notes
    -----
    The filter is run some ten times a sensor, and a hundred times more where something is grossly wrong. Statistics may pass where a
    likelihood ratio does not: a rate random walk ten times too small leaves hardly a trace in the NIS.
    """
    tail(probability)
    if not any(len(series.time) for series in record.vectors):
        raise InputError("record has no vector measurements, so there are no innovations to diagnose from")
    need_mekf(setup, "the search for causes")
    modelled = modelled_record(record, setup)
    truth = modelled.truth
    # No hypothesis looks at the truth, which each of their many records would check anew.
    model = Model(record=replace(modelled, truth=None), noise=setup.process_noise, initial=initial)
    every = max(1, len(model.record.increments) // 1000)
    estimate = estimation.run(model.record, model.noise, model.initial, every=every, full_covariance=True)
    kept = None if truth is None else Truth(attitude=truth.attitude[::every], bias=truth.bias[::every])
    if judgement is None:
        judgement = consistency.judge(estimate, kept, probability=probability)
    base = run(model)
    considered = [by_variance(model, base, hypothesis) for hypothesis in noise_hypotheses(model)]
    considered += [by_mean(model, base, hypothesis) for hypothesis in mean_hypotheses(model)]
    considered += [
        outliers(sensor, found.whitened) for sensor, found in estimate.innovations.items() if len(found.time)
    ]
    considered.append(commutation(record, setup, estimate, kept))
    worst = max(float(np.mean(i.nis) / i.innovation.shape[1]) for i in estimate.innovations.values() if len(i.time))
    if worst > GROSS:
        considered += conventions(model, base)
    considered.sort(key=lambda cause: (cause.log_p, -cause.gain))
    evidence = [*judgement.findings, *(cause.finding for cause in considered)]
    together = consistency.concluded(
        evidence, judgement.limits, probability, states=judgement.states, unmodelled=judgement.unmodelled
    )
    rejected = [finding.rejected for finding in together.findings[len(judgement.findings) :]]
    return Diagnosis(
        causes=tuple(cause for cause, significant in zip(considered, rejected, strict=True) if significant),
        considered=tuple(considered),
        judgement=together,
        probability=probability,
    )
