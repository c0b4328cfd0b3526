"""Where the filter starts on a record that is tuned on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from strapdown import ahrs, estimation, quaternion, setup
from strapdown.ahrs import AhrsParameters
from strapdown.checks import InputError
from strapdown.gyro import GyroSpec
from strapdown.randomness import generator
from strapdown.recordings import Recording
from strapdown.records import ImuRecord
from strapdown.setup import FilterSetup
from strapdown.tuning.innovations import Case


def recording_setup(parameters: AhrsParameters | None = None) -> FilterSetup:
    """Return the setup of the filter that :func:`strapdown.ahrs.estimate` runs, of ``ahrs.MOTIONS["any"]`` by default."""
    return (parameters or ahrs.MOTIONS["any"]).setup


def recording_case(recording: Recording, parameters: AhrsParameters | None = None) -> Case:
    """Return a recording as :func:`strapdown.ahrs.estimate` filters it: from its first quiet second on, with its reference.

    Delays between sensors are not compensated.

    Parameters
    ----------
    recording : Recording
        With an accelerometer.
    parameters : AhrsParameters, optional
        Default ``ahrs.MOTIONS["any"]``.

    Returns
    -------
    Case
        Fixed frame East-North-Up, as of :func:`strapdown.ahrs.estimate`.

    Raises
    ------
    InputError
        If there is no accelerometer, or the recording is too short.
    """
    if recording.specific_force is None:
        raise InputError(f"{recording.source} has no accelerometer, which shows the vertical; add columns ax, ay, az")
    span = ahrs.quiet_span(recording)
    used = recording.since(span.start)
    prepared = ahrs.prepare(used, slice(0, span.stop - span.start), parameters or ahrs.MOTIONS["any"])
    return Case(
        record=prepared.record,
        initial=prepared.initial,
        name=used.source,
        true_attitude=None if used.true_attitude is None else used.true_attitude[prepared.edge],
        judged=None if used.movement is None else used.movement[prepared.edge],
    )


def record_case(record: ImuRecord, chosen: FilterSetup, *, name: str = "", seed: int | None = None) -> Case:
    """Return a record with the filter's initial state on it.

    Parameters
    ----------
    record : ImuRecord
        Gyro increments and measurements.
    chosen : FilterSetup
        Its σ of the initial errors.
    name : str, optional
        What errors and reports call the record.
    seed : int, optional
        Start at the truth with errors drawn from the setup's σ. Default: the attitude of the first measurements
        (:func:`strapdown.estimation.first_state`) and zero bias; where the initial σ are large against the measurements both are soon
        forgotten.

    Returns
    -------
    Case
        The whole record, with the initial state and its covariance from the setup.

    Raises
    ------
    InputError
        If the first measurements do not give the attitude.
    """
    if seed is not None and record.truth is not None:
        draw = generator(seed, 0, "initial error").standard_normal(6)
        attitude = quaternion.multiply(record.truth.attitude[0], quaternion.exp(-chosen.attitude_sigma * draw[:3]))
        bias = record.truth.bias[0] - chosen.bias_sigma * draw[3:]
        return Case(record=record, initial=setup.initial_state(chosen, attitude, bias), name=name)
    try:
        first = estimation.first_state(record, chosen.process_noise, bias_sigma=chosen.bias_sigma)
    except InputError as error:
        raise InputError(f"{name or 'record'}: {error}") from None
    return Case(record=record, initial=setup.initial_state(chosen, first.attitude), name=name)


NOISES = (
    "angle_random_walk",
    "rate_random_walk",
    "bias_instability",
    "markov_noise",
    "markov_correlation_time",
    "quantization",
    "rate_resolution",
)
"""Parameters of a gyro that its two tuned noises represent."""


def one_gyro(specs: Mapping[str, GyroSpec]) -> None:
    """Refuse records, by name, whose gyros are of different noise: one set of parameters would fit none of them.

    Turn-on bias, scale factor and misalignment may differ, as they do from one gyro of a kind to the next.
    """
    names = list(specs)
    for name in names[1:]:
        for field in NOISES:
            first, other = (np.broadcast_to(getattr(specs[one], field), (3,)) for one in (names[0], name))
            if not np.allclose(first, other, rtol=1e-9, atol=0.0):
                k = int(np.argmax(first != other))
                raise InputError(
                    f"{name} was recorded with another gyro than {names[0]}: {field} is {other[k]:.4g} and {first[k]:.4g} (SI); one filter "
                    "fits records of one kind of gyro, so tune each kind by itself"
                )
