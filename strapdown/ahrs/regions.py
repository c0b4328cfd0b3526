"""The reported covariance: the filter's own, scaled by what the recording shows so far of the field and of the accelerometer.

One model serves slow and fast motion, good and poor units, clean and disturbed fields, so the filter's own σ is right on average only. Its
innovations show how far a recording differs from it, and the specific force in slow motion how far the accelerometer errs. The scales were
chosen so that the 95 % regions hold on the development halves of eight sets (``benchmarks/recordings.py``); the estimate does not depend
on them. Scales below 1 apply to the variance of a settled filter.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from strapdown import quaternion
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.ahrs.starting import MIN_LEVEL
from strapdown.checks import Array
from strapdown.kernels import recording_steps
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings.hard_iron import low_pass
from strapdown.records import Estimate, Innovations
from strapdown.units import DEGREE, STANDARD_GRAVITY

LEVEL_TIME = 5.0
"""Time constant of the average that gives the level of the acceleration, s; by it the innovations' variance is scaled."""
OWN_SHARE = 0.1
"""Share of the modelled variance of an innovation that comes from the sensor's errors, whatever the acceleration's level."""
DISAGREEMENT_SHARE = 1.0
"""Variance added to that of the smoothed tilt, relative to the mean square difference between filtered and smoothed tilt."""
USUAL_DISAGREEMENT = 0.15 * DEGREE
"""Difference, rad, that a filter and a smoother whose model is right have too."""
MAX_HEADING = 38.0
"""Maximum factor on the variance of the heading from the measurements so far, whose mean NIS varies more than that of all."""
FIELD_LEVEL = 0.02
"""Mean NIS of the magnetometer in a field disturbed as that along the path of a phone indoors."""
FIRST_LEVEL = (0.01, 15.0)
"""Mean NIS of the magnetometer assumed at first, and the number of measurements that weigh as much."""
FIELD_MEMORY = 60.0
"""Time constant with which that mean forgets, s."""
SLOW_TIME = 1.0
"""Time constant of the mean specific force whose magnitude is compared with gravity, s."""
SLOW_CHANGE = 0.3
"""Standard deviation of the force within that time, m/s², at which the comparison counts a quarter."""
MAX_DEVIATION = 1.0
"""Maximum deviation from gravity that is an error of an accelerometer, m/s²."""
DEVIATION_TIME = 15.0
"""Time in slow motion, s, after which half of the mean square deviation is reported."""


def acceleration_level(filtered: Estimate, uncertain: np.ndarray, interval: float) -> Array:
    """Return the level (k + 1,) of the acceleration up to each edge of the steps: its variance, relative to that modelled.

    The same model serves slow and fast motion, so most motion is slower than modelled. The level is set to 1 at the start, without a
    measurement, and in steps whose rotation is ``uncertain`` (k,). ``interval``: that of the steps, s.
    """
    innovations = filtered.innovations["accelerometer"]
    nis = np.ones((len(filtered.time), 1))
    measured = innovations.nis / 3.0
    nis[np.searchsorted(filtered.time, innovations.time), 0] = np.where(np.isfinite(measured), measured, 1.0)
    begin = np.append(0, np.flatnonzero(uncertain) + 1)
    nis[begin] = 1.0
    return np.concatenate([low_pass(part, interval / LEVEL_TIME) for part in np.split(nis, begin[1:])])[:, 0]


def scaled_innovations(filtered: Estimate, level: Array) -> dict[str, Innovations]:
    """Return the innovations; the variance of the accelerometer's is scaled by the level of the acceleration before each."""
    own = filtered.innovations["accelerometer"]
    before = level[np.searchsorted(filtered.time, own.time) - 1]
    share = OWN_SHARE + (1.0 - OWN_SHARE) * before
    return {**filtered.innovations, "accelerometer": replace(own, variance=own.variance * share[:, None])}


def scales(
    filtered: Estimate, deviation: Array, parameters: AhrsParameters, *, disagreement: float | None = None
) -> tuple[Array, Array, Array]:
    """Return the factor on σ of the tilt, the variance that is added to it, rad², and the factor on σ of the heading (k + 1,) each.

    From the measurements before each step, and the ``deviation`` (k + 1,) of the specific force from gravity, which shows the
    accelerometer's errors (:func:`gravity_deviation`). If there is a ``disagreement``, from all measurements, and instead of the deviation
    the mean square difference, rad², between the smoother's tilt about one axis and its filter's (:func:`disagreement`): errors that last
    longer than σ allows, of the accelerometer and of the model, show there.
    """
    field = field_level(filtered, parameters, causal=disagreement is None)
    shares = shares_of(parameters, magnetometer="magnetometer" in filtered.innovations)
    if disagreement is not None:
        unusual = DISAGREEMENT_SHARE * max(disagreement - USUAL_DISAGREEMENT**2, 0.0)
        deviation = np.full(len(field), unusual * STANDARD_GRAVITY**2)
        shares = shares._replace(max_heading=np.inf)
    tilt, floor, heading = np.empty((3, len(field)))
    compiled(recording_steps.scale_factors)(read_only(field), read_only(deviation), shares, tilt, floor, heading)
    return tilt, floor, heading


def shares_of(parameters: AhrsParameters, *, magnetometer: bool) -> recording_steps.Shares:
    """Return the constants for the kernel."""
    return recording_steps.Shares(
        tilt=parameters.tilt_share,
        tilt_variance=parameters.tilt_sigma**2,
        tilt_by_field=parameters.tilt_by_field,
        max_tilt_by_field=parameters.max_tilt_by_field,
        heading=parameters.heading_share if magnetometer else 1.0,
        heading_by_field=parameters.heading_by_field,
        max_heading=MAX_HEADING,
        field_level=FIELD_LEVEL,
        gravity=STANDARD_GRAVITY,
    )


def slow_motion(step: float) -> recording_steps.SlowMotion:
    """Return the constants of the comparison with gravity over steps of an interval, s."""
    return recording_steps.SlowMotion(
        gravity=STANDARD_GRAVITY,
        share=-math.expm1(-step / SLOW_TIME),
        quiet_variance=SLOW_CHANGE**2,
        max_square=MAX_DEVIATION**2,
        steps=DEVIATION_TIME / step,
    )


def gravity_deviation(total: Array, number: Array, step: float) -> Array:
    """Return the mean square deviation of the specific force from gravity up to each edge of the steps (k + 1,), (m/s²)².

    It is that of the accelerometer's error along the vertical, by which its horizontal error, and thus the tilt's, is judged. ``total``
    (k, 3), ``number`` (k,): sums of each step's samples, in axes that do not rotate. ``step``: interval of the steps, s.
    """
    deviation = np.zeros(len(total) + 1)
    compiled(recording_steps.gravity_deviation)(
        read_only(total), read_only(number), slow_motion(step), np.zeros(7), deviation[1:]
    )
    return deviation


def limits(parameters: AhrsParameters, delay_sigma: float) -> recording_steps.Limits:
    """Return the constants of the covariance at the stamps, whose delay has that σ, s.

    σ of a tilt known from the specific force at rest is the limit for the tilt, and that of the heading in the steepest field for it.
    """
    tilt = parameters.attitude_sigma**2
    return recording_steps.Limits(timing=delay_sigma**2, tilt=tilt, heading=tilt / MIN_LEVEL)


def disagreement(smoothed: Array, filtered: Array) -> float:
    """Return the mean square rotation about one level axis between two attitudes (k, 4), rad², after the first tenth of the rows."""
    late = slice(len(smoothed) // 10, None)
    turn = quaternion.log(quaternion.multiply(filtered[late], quaternion.conjugate(smoothed[late])))
    return float(np.mean(turn[:, :2] ** 2))


def field_level(filtered: Estimate, parameters: AhrsParameters, *, causal: bool) -> Array:
    """Return the mean NIS of the magnetometer (k + 1,) up to each step, or of all; without a magnetometer 0."""
    innovations = filtered.innovations.get("magnetometer")
    if innovations is None or len(innovations.time) == 0:
        return np.zeros(len(filtered.time))
    nis = np.where(np.isfinite(innovations.nis), innovations.nis, 0.0)
    if not causal:
        return np.full(len(filtered.time), float(nis.mean()))
    first, weight = FIRST_LEVEL
    mean = np.empty(len(nis))
    share = parameters.heading_interval / FIELD_MEMORY
    compiled(recording_steps.running_mean)(read_only(nis), share, np.array([first * weight, weight]), mean)
    return np.asarray(np.append(first, mean)[np.searchsorted(innovations.time, filtered.time, side="right")])
