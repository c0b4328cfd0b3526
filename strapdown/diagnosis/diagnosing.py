"""All hypotheses on one record, ranked."""

from __future__ import annotations

import math

import numpy as np

from strapdown import consistency, estimation
from strapdown.checks import InputError
from strapdown.consistency.bounds import tail
from strapdown.diagnosis.causes import Diagnosis
from strapdown.diagnosis.commutation import commutation
from strapdown.diagnosis.hypotheses import conventions, mean_hypotheses, noise_hypotheses, outliers
from strapdown.diagnosis.likelihood import Model, by_mean, by_variance, run
from strapdown.records import ImuRecord, Truth
from strapdown.setup import FilterSetup, believed

GROSS = 3.0
"""Discrete conventions are tried where the NIS per degree of freedom of some sensor exceeds this: a wrong one is not subtle."""


def diagnose(
    record: ImuRecord, setup: FilterSetup, initial: estimation.State, *, probability: float = 0.99
) -> Diagnosis:
    """Return the likely causes of what is wrong with a filter on a record.

    Parameters
    ----------
    record : ImuRecord
        As the sensors gave it, gyro samples not yet compressed; its truth, if any, is used too.
    setup : FilterSetup
        What the filter believes. Gates and robust updates are left out here: they hide what is to be seen.
    initial : State
        Where the filter starts.
    probability : float
        A right filter is given no cause with at least this.

    Notes
    -----
    The filter is run some ten times a sensor, and a hundred times more where something is grossly wrong.
    """
    tail(probability)
    if not any(len(series.time) for series in record.vectors):
        raise InputError("record has no vector measurements, so there are no innovations to diagnose from")
    model = Model(record=believed(record, setup), noise=setup.process_noise, initial=initial)
    every = max(1, len(model.record.increments) // 1000)
    estimate = estimation.run(model.record, model.noise, model.initial, every=every, full_covariance=True)
    truth = model.record.truth
    kept = None if truth is None else Truth(attitude=truth.attitude[::every], bias=truth.bias[::every])
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
    least = math.log((1.0 - probability) / len(considered))
    return Diagnosis(
        causes=tuple(cause for cause in considered if cause.log_p <= least),
        considered=tuple(considered),
        judgement=judgement,
        probability=probability,
    )
