"""Initial state of the filter on a record for tuning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from strapdown import ahrs, estimation
from strapdown.ahrs import AhrsParameters
from strapdown.checks import InputError
from strapdown.estimation import setup as setups
from strapdown.estimation.setup import FilterSetup
from strapdown.gyro import GyroSpec
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.tuning.objective import Case
from strapdown.tuning.parameters import SCALE


def recording_case(recording: Recording) -> Case:
    """Return a recording as filtered by :func:`strapdown.ahrs.estimate`: with its reference.

    Delays between sensors are not compensated.

    Parameters
    ----------
    recording : Recording
        Recording with an accelerometer.

    Returns
    -------
    Case
        The record with its initial state; fixed frame East-North-Up, as in :func:`strapdown.ahrs.estimate`.

    Raises
    ------
    InputError
        If there is no accelerometer, or the recording is too short.
    """
    ahrs.need_accelerometer(recording)
    prepared = ahrs.prepare(recording, AhrsParameters())
    return Case(
        record=prepared.record,
        initial=prepared.initial,
        name=recording.source,
        true_attitude=None if recording.true_attitude is None else recording.true_attitude[prepared.edge],
        judged=None if recording.movement is None else recording.movement[prepared.edge],
    )


INDEPENDENT = 1.0
"""Spacing of measurements of a recording for nearly independent disturbances, s."""


def by_innovations(
    names: Sequence[str] | None, spacing: float = 0.0, *, gate: bool = False, priors: object = None
) -> tuple[Sequence[str], float]:
    """Return the parameters of a recording's filter that innovations can tune, only the scale of all σ, and the measurement spacing, s.

    On the eleven trials of BROAD this leaves the error unchanged, and the NEES per state is 0.01 to 0.91 (0.13 to 10 before). With all σ
    free the error grows on nine of them, from 3.0° to 7.7° on average; scaled by all innovations, the NEES is up to 28. ``gate`` and
    ``priors`` need a valid likelihood, so they are refused.
    """
    wanted = [name for name in names or [] if name != SCALE]
    wanted += [name for name, is_wanted in (("gate", gate), ("priors", priors)) if is_wanted]
    if wanted:
        raise InputError(
            f"{wanted[0]} cannot be tuned by the innovations of a recording: its disturbances last, so a filter of larger likelihood is "
            f"usually worse. Tune only {SCALE}, the default, or by the errors (truth) if there is a reference"
        )
    return (SCALE,) if names is None else names, spacing or INDEPENDENT


def record_case(record: ImuRecord, setup: FilterSetup, *, name: str = "", seed: int | None = None) -> Case:
    """Return a record with the filter's initial state.

    Parameters
    ----------
    record : ImuRecord
        Gyro increments and measurements.
    setup : FilterSetup
        Filter; defines the σ of the initial errors.
    name : str, optional
        Name of the record in messages and reports.
    seed : int, optional
        If given, start at the truth with errors drawn from the setup's σ. Default: the attitude of the first measurements
        (:func:`strapdown.estimation.first_state`) and zero bias; their errors decay soon if the initial σ are large compared with those
        of the measurements.

    Returns
    -------
    Case
        The whole record, with the initial state and its covariance from the setup.

    Raises
    ------
    InputError
        If the first measurements do not determine the attitude.
    """
    if seed is not None and record.truth is not None:
        return Case(record=record, initial=setups.drawn_state(setup, record, seed), name=name)
    try:
        first = estimation.first_state(record, setup.process_noise, bias_sigma=setup.bias_sigma)
    except InputError as error:
        raise InputError(f"{name or 'record'}: {error}") from None
    return Case(record=record, initial=setups.initial_state(setup, first.attitude), name=name)


NOISES = (
    "angle_random_walk",
    "rate_random_walk",
    "bias_instability",
    "markov_noise",
    "markov_correlation_time",
    "quantization",
    "rate_resolution",
)
"""Parameters of a gyro that the two tuned noise parameters represent."""


def one_gyro(specs: Mapping[str, GyroSpec]) -> None:
    """Raise if the records, by name, have gyros of different noise, which one set of parameters would not fit."""
    names = list(specs)
    for name in names[1:]:
        for field in NOISES:
            first, other = (np.broadcast_to(getattr(specs[sensor], field), (3,)) for sensor in (names[0], name))
            if not np.allclose(first, other, rtol=1e-9, atol=0.0):
                k = int(np.argmax(first != other))
                raise InputError(
                    f"{name} was recorded with another gyro than {names[0]}: {field} is {other[k]:.4g} and {first[k]:.4g} (SI); one filter "
                    "fits records of one type of gyro, so tune each type separately"
                )
