"""The initial state of a filter for a record."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from strapdown import estimation
from strapdown.checks import Hint, InputError
from strapdown.estimation import multiple_model, setup
from strapdown.estimation.angular_acceleration import MIN_SAMPLES
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import PRIOR_INFLATION, State
from strapdown.records import ImuRecord, Origin, cut
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements
from strapdown.vectors.wahba import InconsistentError

UNEVEN = 2.0
"""Ratio of the largest to the smallest σ of an attitude above which both are reported."""

REMEDY = f"give the initial attitude, {Hint('initial')}"


class Start(NamedTuple):
    """Initial state of a filter for a record."""

    state: State
    words: str
    """Description of how the state was found, in one sentence."""
    edge: int = 0
    """Edge of the filter's steps at which the filter starts."""


def start(record: ImuRecord, filter_setup: FilterSetup) -> Start:
    """Return the initial state from the first measurements of a record.

    Their noise is that of the filter (:func:`strapdown.estimation.setup.modelled_record`). If one set of measurements does not determine
    the attitude, or directions contradict each other, a bank of filters with different initial attitudes finds it
    (:mod:`strapdown.estimation.multiple_model`), and the estimate starts where its hypotheses are merged into one.
    """
    first_state = partial(
        estimation.first_state, process_noise=filter_setup.process_noise, bias_sigma=filter_setup.bias_sigma
    )
    inflation = PRIOR_INFLATION
    try:
        if filter_setup.states is None or not filter_setup.states.sensors:
            state = first_state(record)
        else:
            rough = replace(record, vectors=tuple(series.noise_scaled(ROUGH) for series in record.vectors))
            inflation = ERRORS_INFLATION
            state = first_state(_with_sensor_errors(record, filter_setup, first_state(rough)), inflation=inflation)
    except InconsistentError as error:
        problem = _without_remedy(error)
        # With a sensor's errors among the states, the filter can estimate them.
        if filter_setup.states is None:
            raise InputError(
                f"{problem}; if a sensor has a bias, give the filter its state, {Hint('states', True)}; or {REMEDY}"
            ) from None
        return _by_multiple_models(record, filter_setup, problem, f"{problem[:1].upper()}{problem[1:]}")
    except InputError as error:
        return _by_multiple_models(
            record, filter_setup, _without_remedy(error), "One direction at a time does not determine the attitude"
        )
    again = f"with {inflation:g} times their σ, since the filter uses them again"
    return Start(state, f"Started from the first measurements {again}: σ {_sigma_words(state)}.")


ROUGH = 10.0
"""Factor on the σ of measurements whose sensors have errors that are states, for an attitude that shows how large these may be."""
ERRORS_INFLATION = 3.0
"""Factor on σ of an attitude with such errors: the variance after the filter's first update is too small by a tenth, while with a larger
factor the first update would be far from linear."""
KNOWN = 1e-12
"""Share of the variances of attitude and bias of a filter whose innovations show the errors of the sensors only."""


def _with_sensor_errors(record: ImuRecord, filter_setup: FilterSetup, state: State) -> ImuRecord:
    """Return the record with the σ that its measurements have before the filter has estimated any error of the sensors.

    It is that of the first innovation of a filter whose attitude and bias are known.
    """
    last = max(np.searchsorted(record.time, series.time[:1]).sum() for series in record.vectors) + 1
    last = max(last, 2 * MIN_SAMPLES)  # a lever arm needs the angular acceleration
    part = cut(record, 0, min(last, len(record.increments)))
    known = replace(state, covariance=KNOWN * state.covariance)
    innovations = setup.run_modelled(part, filter_setup, known, gate=None, robust=None).innovations

    def widened(series: VectorMeasurements) -> VectorMeasurements:
        variance = innovations[series.sensor].variance[:1]
        length = np.linalg.norm(series.references_f[:1]) if series.kind == "vector" else 1.0
        noise = np.einsum("kii->", series.covariances[:1]) / (3.0 * length**2)
        return series.noise_scaled(max(1.0, float(np.sqrt(variance.max() / noise)))) if len(variance) else series

    return replace(record, vectors=tuple(map(widened, record.vectors)))


def _without_remedy(error: InputError) -> str:
    return str(error).removesuffix("; give the initial attitude")


def _by_multiple_models(record: ImuRecord, filter_setup: FilterSetup, problem: str, why: str) -> Start:
    """Return the state of a bank of filters at which its hypotheses are merged into one."""
    try:
        bank = multiple_model.run(record, filter_setup.process_noise, bias_sigma=filter_setup.bias_sigma)
    except InputError as error:
        raise InputError(f"{problem}; a bank of hypotheses does not find it either ({error}); {REMEDY}") from None
    if not bank.converged:
        raise InputError(f"{problem}; a bank of hypotheses does not find it either: {bank.reason}; or {REMEDY}")
    edge = int(np.searchsorted(record.time, bank.became_one))
    if edge >= len(record.increments):
        raise InputError(f"{problem}, and a bank of hypotheses found it only at the end; record longer, or {REMEDY}")
    row = int(np.searchsorted(bank.estimate.time, bank.became_one))
    assert bank.estimate.covariance is not None
    state = State(
        attitude=bank.estimate.attitude[row],
        bias=bank.estimate.bias[row],
        covariance=bank.estimate.covariance[row],
    )
    words = (
        f"{why}: {bank.weights.shape[1]} hypotheses were merged into one at {bank.became_one:.6g} s, σ {_sigma_words(state)}; the estimate "
        "begins there."
    )
    return Start(state, words, edge)


def _sigma_words(state: State) -> str:
    """Return the σ of an attitude as text: one, or the smallest and the largest if it differs by direction (tilt and heading)."""
    least, _, most = np.sqrt(np.maximum(np.linalg.eigvalsh(state.covariance[:3, :3]), 0.0)) / DEGREE
    if most < UNEVEN * least:
        return f"{np.sqrt(np.trace(state.covariance[:3, :3]) / 3.0) / DEGREE:.3g}° per axis"
    return f"{least:.3g} to {most:.3g}° by direction"


def drawn_start(record: ImuRecord, filter_setup: FilterSetup) -> Start:
    """Return the true initial state with errors drawn from the setup's σ, by seed and run of the record's ``origin``."""
    if record.truth is None:
        raise InputError("a start drawn about the truth needs a record with its truth; this one has none")
    origin = record.origin or Origin()
    words = "Started from the truth with errors drawn from the filter's σ."
    return Start(setup.drawn_state(filter_setup, record, origin.seed or 0, origin.run or 0), words)
