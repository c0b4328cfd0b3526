"""The reported covariance: the filter's own, scaled by what its innovations show.

One model serves slow and fast motion, good and poor units, clean and disturbed fields, so the filter's own σ is right on average only. An
estimate that averages many measurements errs by the slow part of their errors: for innovations that are not white its variance follows
their spectral density at low frequency. That of the accelerometer's level innovations scales the variance of the tilt, and that of the
magnetometer the variance of the heading. Without a magnetometer the variances of heading and bias are scaled by as much of the bias as
nothing has shown yet: of some phones it is many times the σ that gives the least error; or by the density of the accelerometer's
innovations if that is more, because acceleration that lasts longer than modelled passes for a bias about the vertical. The scales were
chosen so that the 95 % regions hold on the development halves of eight sets (``benchmarks/recordings.py``); the estimate does not depend on
them. The factors apply to the variance of a settled filter.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from strapdown.ahrs.parameters import AhrsParameters
from strapdown.ahrs.starting import MIN_LEVEL
from strapdown.checks import Array
from strapdown.kernels import recording_steps
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings.hard_iron import low_pass
from strapdown.records import Estimate, Innovations
from strapdown.units import STANDARD_GRAVITY

LEVEL_TIME = 5.0
"""Time constant of the average that gives the level of the acceleration, s; by it the innovations' variance is scaled."""
OWN_SHARE = 0.1
"""Share of the modelled variance of an innovation that comes from the sensor's errors, whatever the acceleration's level."""
AVERAGE_TIME = 10.0
"""Time constant of the moving average of innovations whose mean square gives their spectral density at low frequency, s."""
DENSITY_MEMORY = 60.0
"""Time constant with which the mean density forgets, s."""
MAX_HEADING = 38.0
"""Maximum factor on the variance of the heading from the innovations so far, whose density varies more than that of all."""
SCALE_WITHOUT_FIELD = 4.0
"""Factor on the variances of heading and bias without a magnetometer if the accelerometer's innovations are white. With it the regions of
the heading hold 0.95 to 0.96 of the time in those of 94 recordings, without their magnetometers, whose density exceeds 1; before 0.70 to
0.89."""
SWELL_TIMES = 2.0, 4.0
"""Time constants of the moving averages of innovations whose difference contains the frequencies of waves, 0.04 to 0.16 Hz, s."""
FIRST_DENSITY = (0.3, 2.5)
"""Density assumed at first, and the time over which innovations weigh as much, s."""


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


def scales(filtered: Estimate, force: Array, parameters: AhrsParameters, *, causal: bool) -> tuple[Array, Array]:
    """Return the factors on σ of tilt and heading at each edge of the steps (k + 1,), from the innovations before it, or from all.

    ``force`` (k + 1,): :func:`density` of the accelerometer's.
    """
    magnetometer = "magnetometer" in filtered.innovations
    field = density(filtered, "magnetometer", parameters.heading_interval, causal=causal) if magnetometer else force
    tilt, heading = np.empty((2, len(force)))
    constants = scales_of(parameters, magnetometer=magnetometer)
    if not causal:
        constants = constants._replace(max_heading=math.inf)
    compiled(recording_steps.scale_factors)(read_only(force), read_only(field), constants, tilt, heading)
    return tilt, heading


def scales_of(parameters: AhrsParameters, *, magnetometer: bool) -> recording_steps.Scales:
    """Return the constants for the kernel; without a magnetometer its density of the field is that of the force."""
    heading = parameters.heading_scale if magnetometer else SCALE_WITHOUT_FIELD
    return recording_steps.Scales(parameters.tilt_scale, heading, MAX_HEADING)


def density(filtered: Estimate, sensor: str, interval: float, *, causal: bool) -> Array:
    """Return the spectral density of a sensor's level innovations at low frequency at each edge of the steps (k + 1,), or of all.

    It is relative to that of white innovations, and 1 without measurements. ``interval``: that of the sensor's measurements, s.
    """
    innovations = filtered.innovations.get(sensor)
    if innovations is None or len(innovations.time) == 0:
        return np.ones(len(filtered.time))
    level = _level(innovations)
    memory, values = first_memory(level.shape[1], interval), np.empty(len(level))
    constants = averages(interval)
    if not causal:
        memory[-2:], constants = 0.0, constants._replace(forgotten=0.0)
    compiled(recording_steps.innovation_density)(read_only(level), constants, memory, values)
    if not causal:
        return np.full(len(filtered.time), values[-1])
    row = np.searchsorted(innovations.time, filtered.time, side="right")
    return np.asarray(np.append(FIRST_DENSITY[0], values)[row])


def _level(innovations: Innovations) -> Array:
    """Return the level innovations over their σ (m, 2), 0 if not known."""
    level = np.ascontiguousarray((innovations.innovation / np.sqrt(innovations.variance))[:, :2])
    level[~np.isfinite(level)] = 0.0
    return level


def swell_density(filtered: Estimate, interval: float) -> float:
    """Return the largest mean over :data:`DENSITY_MEMORY` of the density of the accelerometer's level innovations at waves' frequencies.

    It is relative to that of white innovations. ``interval``: that of the filter's steps, s.
    """
    level = _level(filtered.innovations["accelerometer"])
    a, b = (-math.expm1(-interval / time) for time in SWELL_TIMES)
    white = a / (2.0 - a) + b / (2.0 - b) - 2.0 * a * b / (1.0 - (1.0 - a) * (1.0 - b))
    square = np.mean((low_pass(level, a) - low_pass(level, b)) ** 2, axis=1) / white
    width = min(len(square), math.ceil(DENSITY_MEMORY / interval))
    total = np.append(0.0, np.cumsum(square))
    return float(np.max(total[width:] - total[:-width], initial=0.0)) / max(width, 1)


def averages(interval: float) -> recording_steps.Averages:
    """Return the constants of the density of innovations at an interval, s."""
    return recording_steps.Averages(-math.expm1(-interval / AVERAGE_TIME), interval / DENSITY_MEMORY)


def first_memory(number: int, interval: float) -> Array:
    """Return the kernel's memory at the start, for that number of innovations at an interval, s."""
    first, time = FIRST_DENSITY
    weight = time / interval
    return np.array([0.0] * (number + 1) + [first * weight, weight])


def limits(parameters: AhrsParameters, delay_sigma: float, *, magnetometer: bool) -> recording_steps.Limits:
    """Return the constants of the covariance at the stamps, whose delay has that σ, s.

    σ of a tilt known from the specific force at rest is the limit for the tilt, and that of the heading in the steepest field for it.
    """
    tilt = parameters.attitude_sigma**2
    accelerometer = (parameters.tilt_sigma / STANDARD_GRAVITY) ** 2
    return recording_steps.Limits(
        timing=delay_sigma**2,
        tilt=tilt,
        heading=tilt / MIN_LEVEL,
        accelerometer=accelerometer,
        bias=0.0 if magnetometer else parameters.bias_sigma**2,
        unshown=math.sqrt(parameters.heading_scale),
    )
