"""Attitude and heading from a recording: accelerometer as the vertical, magnetometer as the heading only, one filter for both.

The fixed frame is East-North-Up with magnetic North. The filter is :mod:`strapdown.mekf`; this module says what its measurements are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown import mekf, wahba
from strapdown.checks import Array, InputError, non_negative, positive
from strapdown.recordings import Recording, increments
from strapdown.records import Estimate, ImuRecord
from strapdown.units import DEGREE
from strapdown.vectors import VectorMeasurements

UP = np.array([0.0, 0.0, 1.0])
NORTH = np.array([0.0, 1.0, 0.0])
QUIET_SPAN = 1.0
"""Length of the quiet span that the filter starts from, s."""


@dataclass(frozen=True, kw_only=True)
class AhrsParameters:
    """What the filter believes of a hand-held unit. The defaults are one set for consumer and industrial MEMS units on a moving hand.

    The noises are those of *independent* samples at ``reference_rate``, and are spread so that the weight a second does not depend on the
    recording's rate. They are much larger than the sensors' own noise, because what disturbs them, acceleration and iron, lasts over
    many samples.
    """

    angle_random_walk: float = 3e-3
    """σ_v, rad/√s; scale-factor and alignment errors of a moving unit included."""
    rate_random_walk: float = 1e-5
    """σ_u, rad/s/√s."""
    specific_force_sigma: float = 10.0
    """Acceleration of the hand, each component, m/s²."""
    heading_sigma: float = 5.0
    """Disturbance of the magnetic heading, rad."""
    field_strength_weight: float = 10.0
    """Heading σ added, in rad, for each unit of relative deviation of the field's strength from that at the start."""
    reference_rate: float = 285.0
    """Rate that the two noises above are told for, Hz."""
    attitude_sigma: float = 3.0 * DEGREE
    """Error of the attitude at the start, each axis, rad."""
    bias_sigma: float = 0.5 * DEGREE
    """Gyro bias at the start, each axis, rad/s."""

    def __post_init__(self) -> None:
        """Check every field."""
        for name in self.__dataclass_fields__:
            check = non_negative if name in ("field_strength_weight", "rate_random_walk") else positive
            check(name, getattr(self, name))


def quiet_span(recording: Recording) -> slice:
    """Return the samples of the first quiet second: the first whose rate is no more than twice as restless as in the quietest.

    Raises
    ------
    InputError
        If the recording is shorter than that.
    """
    length = int(np.searchsorted(recording.time, recording.time[0] + QUIET_SPAN))
    if length >= len(recording.time) or length < 2:
        raise InputError(
            f"{recording.source} lasts {recording.time[-1] - recording.time[0]:.3g} s; the start needs at least {QUIET_SPAN:g} s of samples"
        )
    blocks = len(recording.time) // length
    rate = recording.rate[: blocks * length].reshape(blocks, length, 3)
    # The mean counts beside the spread, so that a steady turn is not taken for rest; half of it may be bias.
    restless = np.linalg.norm(rate.std(axis=1), axis=1) + 0.5 * np.linalg.norm(rate.mean(axis=1), axis=1)
    first = int(np.argmax(restless <= 2.0 * restless.min()))
    return slice(first * length, (first + 1) * length)


def imu_record(recording: Recording, quiet: slice, parameters: AhrsParameters) -> ImuRecord:
    """Return what the filter takes: increments by the trapezoid rule, specific force and heading with their noise.

    The strengths of gravity and of the field are those of the samples ``quiet``.
    """
    spread = np.sqrt(1.0 / (np.median(np.diff(recording.time)) * parameters.reference_rate))
    assert recording.specific_force is not None
    gravity = _norm(_mean(recording.specific_force[quiet], recording.source, "accelerometer"))
    vectors = [
        VectorMeasurements(
            sensor="accelerometer",
            kind="vector",
            time=recording.time,
            vector_b=recording.specific_force,
            reference_f=gravity * UP,
            sigma=np.full(len(recording.time), parameters.specific_force_sigma * spread),
        )
    ]
    if recording.magnetic_field is not None:
        strength = np.linalg.norm(recording.magnetic_field, axis=1, keepdims=True)
        strength[strength == 0.0] = np.nan  # a field of zero is no field: a missing sample
        _mean(recording.magnetic_field[quiet], recording.source, "magnetometer")
        deviation = np.nan_to_num(strength[:, 0] / np.nanmean(strength[quiet]) - 1.0)
        vectors.append(
            VectorMeasurements(
                sensor="magnetometer",
                kind="heading",
                time=recording.time,
                vector_b=recording.magnetic_field / strength,
                reference_f=NORTH,
                sigma=np.hypot(parameters.heading_sigma, parameters.field_strength_weight * deviation) * spread,
            )
        )
    return ImuRecord(time=recording.time, increments=increments(recording), vectors=tuple(vectors))


def start(recording: Recording, quiet: slice, parameters: AhrsParameters) -> mekf.State:
    """Return the state at the quiet samples: attitude by TRIAD from the mean vertical and field; any North without a magnetometer."""
    assert recording.specific_force is not None
    up = _mean(recording.specific_force[quiet], recording.source, "accelerometer")
    sigma = np.full(3, parameters.attitude_sigma)
    if recording.magnetic_field is None:
        # Any horizontal direction will do for a heading that nothing measures.
        across = np.eye(3)[np.argmin(np.abs(up))]
        attitude = wahba.from_vertical_and_heading(up, across)
    else:
        field = _mean(recording.magnetic_field[quiet], recording.source, "magnetometer")
        attitude = wahba.from_vertical_and_heading(up, field)
    return mekf.initial_state(attitude, attitude_sigma=sigma, bias_sigma=parameters.bias_sigma)


@dataclass(frozen=True, kw_only=True)
class AhrsEstimate:
    """An estimate beside the samples that it was made from, one row for one row."""

    recording: Recording
    """The recording from its first quiet second on."""
    estimate: Estimate


def estimate(
    recording: Recording, parameters: AhrsParameters | None = None, *, full_covariance: bool = False
) -> AhrsEstimate:
    """Return attitude and gyro bias over a recording, at its time stamps from the first quiet second on."""
    chosen = parameters or AhrsParameters()
    if recording.specific_force is None:
        raise InputError(f"{recording.source} has no accelerometer, which shows the vertical; add columns ax, ay, az")
    span = quiet_span(recording)
    used = recording.since(span.start)
    quiet = slice(0, span.stop - span.start)
    noise = mekf.ProcessNoise(angle_random_walk=chosen.angle_random_walk, rate_random_walk=chosen.rate_random_walk)
    result = mekf.run(
        imu_record(used, quiet, chosen), noise, start(used, quiet, chosen), full_covariance=full_covariance
    )
    return AhrsEstimate(recording=used, estimate=result)


def _mean(samples: Array, source: str, sensor: str) -> Array:
    known = samples[np.isfinite(samples).all(axis=1)]
    if len(known) == 0:
        raise InputError(
            f"{source}: the {sensor} has no valid sample in the first quiet second; cut the recording to where it has"
        )
    return np.asarray(known.mean(axis=0))


def _norm(vector: Array) -> float:
    return float(np.linalg.norm(vector))
