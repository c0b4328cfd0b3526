"""The filter for a record, from what the record holds of its origin: the setup that matches its origin, and the initial state."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from strapdown import estimation, quaternion, setup
from strapdown.checks import InputError
from strapdown.estimation import multiple_model
from strapdown.estimation.states import State
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator
from strapdown.records import ImuRecord, Origin
from strapdown.scenarios import Scenario
from strapdown.setup import FilterSetup
from strapdown.setup.states import States
from strapdown.units import DEGREE
from strapdown.vectors.wahba import InconsistentError

UNEVEN = 2.0
"""Ratio of the largest to the smallest σ of an attitude above which both are reported."""

REMEDY = "give the initial attitude (--attitude, or --from-truth; initial= in Python)"


def matched_setup(
    record: ImuRecord,
    gyro: GyroSpec | None = None,
    *,
    states: bool | Sequence[str] | None = None,
) -> FilterSetup:
    """Return the filter setup that matches what a record's ``origin`` specifies of its gyro (or ``gyro`` does) and sensors.

    ``states``: True, with an error state for each error that is specified; names such as ``"gyro.scale"``, with these of them alone; False,
    attitude and gyro bias only. By default with all of them where an error is specified that the filter would have no state for.
    """
    origin = record.origin or Origin()
    spec = gyro or origin.gyro
    if spec is None:
        raise InputError(
            "the record does not specify its gyro; give the gyro's noise (--gyro; noise= in Python) or a filter (--filter; setup=)"
        )
    plain = setup.matched_to_record(spec, record)
    if states is False or (states is None and not unmodelled_errors(record, plain)):
        return plain
    if origin.scenario is None:
        chosen = setup.matched_to_record(spec, record, states=True)
    else:
        scenario = origin.scenario
        chosen = setup.matched_to_record(
            spec, record, states=True, sensors=scenario.sensors, gravity_f=scenario.gravity_f
        )
    optional = chosen.states or States()
    if states is not None and states is not True:
        optional = optional.chosen(tuple(states)) if states else States()
    if not optional.names:
        return dataclasses.replace(chosen, states=None)
    if "gyro.drift" not in optional.names:  # flicker without a state is matched by the two noises
        chosen = dataclasses.replace(chosen, process_noise=plain.process_noise)
    return dataclasses.replace(chosen, states=optional)


def matched_to_scenario(scenario: Scenario, *, states: bool | None = None) -> FilterSetup:
    """Return the filter setup that matches a scenario, by default with error states where the scenario specifies such errors."""
    if states is None:
        states = bool(setup.unmodelled_errors(scenario.gyro, scenario.sensors, gravity_f=scenario.gravity_f))
    found = setup.matched(scenario, states=states)
    if states and (found.states is None or not found.states.names):
        return setup.matched(scenario)
    return found


def unmodelled_errors(record: ImuRecord, chosen: FilterSetup) -> tuple[str, ...]:
    """Return, in words, the specified errors of a record that a filter has no state for; empty where nothing is specified."""
    origin = record.origin or Origin()
    if origin.gyro is None:
        return ()
    if origin.scenario is None:
        return setup.unmodelled_errors(origin.gyro, (), chosen.states)
    scenario = origin.scenario
    return setup.unmodelled_errors(origin.gyro, scenario.sensors, chosen.states, gravity_f=scenario.gravity_f)


class Start(NamedTuple):
    """Where a filter starts on a record.

    Parameters
    ----------
    state : State
        Initial attitude, bias and covariance.
    words : str
        How the state was found, in one sentence.
    edge : int, default 0
        Edge of the filter's steps at which the filter starts.
    """

    state: State
    words: str
    edge: int = 0


def start(record: ImuRecord, chosen: FilterSetup) -> Start:
    """Return the initial state from the first measurements of a record.

    They count as the filter models them (:func:`strapdown.setup.modelled_record`). Where one set of measurements does not give the
    attitude, or directions contradict each other, a bank of filters with different initial attitudes finds it
    (:mod:`strapdown.estimation.multiple_model`), and the estimate starts where one of them is left.
    """
    try:
        state = estimation.first_state(record, chosen.process_noise, bias_sigma=chosen.bias_sigma)
    except InconsistentError as error:
        problem = _without_remedy(error)
        # A sensor's own errors may be among the states, and then the filter estimates them.
        if chosen.states is None:
            raise InputError(
                f"{problem}; if a sensor has a bias, give the filter its state (--states; states=True in Python); or {REMEDY}"
            ) from None
        return _by_multiple_models(record, chosen, problem, f"{problem[:1].upper()}{problem[1:]}")
    except InputError as error:
        return _by_multiple_models(
            record, chosen, _without_remedy(error), "One direction at a time does not give the attitude at once"
        )
    return Start(state, f"Started from the first measurements, σ {_sigma_words(state)}.")


def _without_remedy(error: InputError) -> str:
    return str(error).removesuffix("; give the initial attitude")


def _by_multiple_models(record: ImuRecord, chosen: FilterSetup, problem: str, why: str) -> Start:
    """Return the state of the one filter of a bank that is left."""
    try:
        found = multiple_model.run(record, chosen.process_noise, bias_sigma=chosen.bias_sigma)
    except InputError as error:
        raise InputError(f"{problem}, nor does a bank of hypotheses ({error}); {REMEDY}") from None
    if not found.converged:
        raise InputError(f"{problem}, nor does a bank of hypotheses: {found.reason}; or {REMEDY}")
    edge = int(np.searchsorted(record.time, found.became_one))
    if edge >= len(record.increments):
        raise InputError(f"{problem}, and a bank of hypotheses found it only at the end; record longer, or {REMEDY}")
    row = int(np.searchsorted(found.estimate.time, found.became_one))
    assert found.estimate.covariance is not None
    state = State(
        attitude=found.estimate.attitude[row],
        bias=found.estimate.bias[row],
        covariance=found.estimate.covariance[row],
    )
    words = (
        f"{why}: {len(found.angles)} hypotheses about it became one at {found.became_one:.6g} s, σ {_sigma_words(state)}; the estimate "
        "begins there."
    )
    return Start(state, words, edge)


def _sigma_words(state: State) -> str:
    """Return the σ of an attitude in words: one, or where it differs by direction (tilt and heading) the least and the largest."""
    least, _, most = np.sqrt(np.maximum(np.linalg.eigvalsh(state.covariance[:3, :3]), 0.0)) / DEGREE
    if most < UNEVEN * least:
        return f"{np.sqrt(np.trace(state.covariance[:3, :3]) / 3.0) / DEGREE:.3g}° an axis"
    return f"{least:.3g} to {most:.3g}° by direction"


def drawn_start(record: ImuRecord, chosen: FilterSetup) -> Start:
    """Return the true initial state with errors drawn from the σ of the setup, by seed and run of the record's ``origin``."""
    if record.truth is None:
        raise InputError(
            "a start drawn about the truth (--from-truth) needs a record with its truth; this one has none"
        )
    origin = record.origin or Origin()
    draw = generator(origin.seed or 0, origin.run or 0, "initial error").standard_normal(6)
    q = quaternion.multiply(record.truth.attitude[0], quaternion.exp(-chosen.attitude_sigma * draw[:3]))
    bias = record.truth.bias[0] - chosen.bias_sigma * draw[3:]
    words = "Started from the truth, off by errors drawn from the filter's σ."
    return Start(setup.initial_state(chosen, q, bias), words)
