"""The filter for a record, from what the record says of itself: the setup that matches its origin, and the initial state."""

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

__all__ = ["Start", "drawn_start", "matched_setup", "matched_to_scenario", "start", "unmodelled_errors"]

UNEVEN = 2.0
"""Ratio of the largest to the smallest σ of an attitude above which both are reported."""

REMEDY = "give the initial attitude (--attitude, or --from-truth; initial= in Python)"


def matched_setup(
    record: ImuRecord,
    gyro: GyroSpec | None = None,
    *,
    states: bool | Sequence[str] | None = None,
    smooth: bool = False,
) -> FilterSetup:
    """Return the filter setup that matches what a record specifies of its gyro and sensors.

    Parameters
    ----------
    record : ImuRecord
        With its ``origin``, unless ``gyro`` is given.
    gyro : GyroSpec, optional
        Specification of the gyro, instead of that of ``record.origin``.
    states : bool or sequence of str, optional
        True: with an error state for each error that the gyro and the sensors of the scenario are specified with; names such as
        ``"gyro.scale"``: with these of them alone; False: attitude and gyro bias only. Default: with all of them where an error is
        specified that the filter would have no state for.
    smooth : bool, default False
        For a smoother: by default no state for gyro drifts, which smoothing does not have.

    Returns
    -------
    FilterSetup
        Setup with the noise of the gyro, the σ of the sensors, and the error states asked for.

    Raises
    ------
    InputError
        If neither ``gyro`` nor the record's origin specifies the gyro, or a name in ``states`` is none of the specified errors.
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
    if states is None and smooth:
        states = tuple(name for name in optional.names if name != "gyro.drift")
    if states is not None and states is not True:
        optional = optional.chosen(tuple(states)) if states else States()
    if not optional.names:
        return plain if smooth else dataclasses.replace(chosen, states=None)
    if "gyro.drift" not in optional.names:  # flicker without a state is matched by the two noises
        chosen = dataclasses.replace(chosen, process_noise=plain.process_noise)
    return dataclasses.replace(chosen, states=optional)


def matched_to_scenario(scenario: Scenario, *, states: bool | None = None) -> FilterSetup:
    """Return the filter setup that matches a scenario.

    Parameters
    ----------
    scenario : Scenario
        Its gyro, its sensors and its motion determine the setup.
    states : bool, optional
        With an error state for each error that the scenario specifies, or without. Default: with them where there are such errors.

    Returns
    -------
    FilterSetup
        Setup whose noise model, and error states if there are any, are those of the scenario.
    """
    if states is None:
        states = bool(setup.not_covered(scenario.gyro, scenario.sensors, gravity_f=scenario.gravity_f))
    found = setup.matched(scenario, states=states)
    if states and (found.states is None or not found.states.names):
        return setup.matched(scenario)
    return found


def unmodelled_errors(record: ImuRecord, chosen: FilterSetup) -> tuple[str, ...]:
    """Return, in words, the specified errors of a record that a filter has no state for; empty where nothing is specified.

    Parameters
    ----------
    record : ImuRecord
        With its ``origin``, which specifies gyro and sensors.
    chosen : FilterSetup
        Filter whose error states are compared with the specification.

    Returns
    -------
    tuple of str
        One phrase for each error, with its size.
    """
    origin = record.origin or Origin()
    if origin.gyro is None:
        return ()
    if origin.scenario is None:
        return setup.not_covered(origin.gyro, (), chosen.states)
    scenario = origin.scenario
    return setup.not_covered(origin.gyro, scenario.sensors, chosen.states, gravity_f=scenario.gravity_f)


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

    Where one set of measurements does not give the attitude, or directions contradict each other, a bank of filters with different initial
    attitudes finds it (:mod:`strapdown.estimation.multiple_model`), and the estimate starts where one of them is left.

    Parameters
    ----------
    record : ImuRecord
        As the filter processes it (:func:`strapdown.setup.believed`).
    chosen : FilterSetup
        Filter whose gyro noise and initial bias σ are applied.

    Returns
    -------
    Start
        State, how it was found, and the edge at which the filter starts with it.

    Raises
    ------
    InputError
        If the measurements do not give the attitude.
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
    """Return the true initial state of a record with errors added that are drawn from the σ of the setup.

    Parameters
    ----------
    record : ImuRecord
        With its truth; the errors are drawn with seed and run of its ``origin``.
    chosen : FilterSetup
        Filter whose initial σ of attitude and bias the errors are drawn with.

    Returns
    -------
    Start
        State at the first edge, with the σ of the setup.

    Raises
    ------
    InputError
        If the record has no truth.
    """
    if record.truth is None:
        raise InputError("--from-truth needs a record with the truth; this one has none")
    origin = record.origin or Origin()
    draw = generator(origin.seed or 0, origin.run or 0, "initial error").standard_normal(6)
    q = quaternion.multiply(record.truth.attitude[0], quaternion.exp(-chosen.attitude_sigma * draw[:3]))
    bias = record.truth.bias[0] - chosen.bias_sigma * draw[3:]
    words = "Started from the truth, off by errors drawn from the filter's σ."
    return Start(setup.initial_state(chosen, q, bias), words)
