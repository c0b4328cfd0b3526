"""Heading measurements from a magnetometer.

Iron in the surroundings disturbs the heading, and the magnitude and the dip of the field too. The noise of the heading is computed from
their deviation from what is usual, and from the change of the whole field in the frame fixed by the gyro; it is larger for a steeper field.
Much iron in the unit is subtracted (:mod:`strapdown.recordings.hard_iron`); the rest of it has states in the filter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown import quaternion
from strapdown.ahrs.parameters import AhrsParameters
from strapdown.checks import Array, lengths, median
from strapdown.kernels import headings as kernel
from strapdown.kernels.alignment import iron_variance, sine_of_dip
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings import hard_iron
from strapdown.recordings.hard_iron import low_pass
from strapdown.vectors import VectorMeasurements

NORTH = np.array([0.0, 1.0, 0.0])
VERTICAL_TIME = 1.0
"""Time constant of the low-pass filter for the vertical from which the field's dip is measured, s."""
MEDIAN_INTERVAL = 0.3
"""Interval of the values of which running medians are computed, s."""
MEDIAN_SAMPLES = 256
"""Number of those values that are kept; above it every other one is dropped, and the interval doubled."""
OWN_IRON = 1.5
"""Iron up to this multiple of the σ of the filter's states for it is left to them."""
IRON_DEVIATION = 0.025
"""Increase of the deviation, relative to the magnitude, at which iron is no longer subtracted."""
MAX_DIP = np.radians(80.0)
"""Maximum dip for which the noise of the heading is computed, rad."""


class Headings(NamedTuple):
    """Heading measurements, and what was found of the field."""

    vectors: VectorMeasurements
    usual: Array
    """Usual magnitude, in the field's unit, and dip, rad, at each step (k, 2)."""
    iron: Array
    """Hard iron subtracted at each step (k, 3), body axes, in the field's unit."""
    variance: Array
    """Variance of the heading by constant iron, rad² (k,)."""


def online(steps: kernel.Steps, start: float, parameters: AhrsParameters, interval: float) -> Headings:
    """Return the heading measurements, each from the steps up to it; the first sample is at ``start``, s."""
    k = len(steps.time)
    out = kernel.Outputs(np.zeros((k, 3)), np.zeros(k), np.empty((k, 2)), np.empty((k, 3)), np.empty(k))
    constants = constants_of(parameters, interval)
    memory = memory_of(constants)
    memory.start[0] = start
    compiled(kernel.heading_steps)(constants, kernel.Steps(*map(read_only, steps)), memory, out)
    known = out.sigma > 0.0
    vectors = _measured(steps.time[known], out.direction[known], out.sigma[known])
    return Headings(vectors, out.usual, out.iron, out.variance)


def _measured(time: Array, direction: Array, sigma: Array) -> VectorMeasurements:
    """Return heading measurements from directions to magnetic North (m, 3), body axes, with σ (m,), rad."""
    return VectorMeasurements(
        sensor="magnetometer", kind="heading", time=time, vector_b=direction, reference_f=NORTH, sigma=sigma
    )


def constants_of(parameters: AhrsParameters, interval: float) -> kernel.Constants:
    """Return the kernel's constants for steps of an interval, s."""
    times = VERTICAL_TIME, parameters.field_change_time, parameters.field_memory
    vertical, change, memory = (-float(np.expm1(-interval / time)) for time in times)
    return kernel.Constants(
        vertical_share=vertical,
        change_share=change,
        memory_share=memory,
        every=max(1, round(MEDIAN_INTERVAL / interval)),
        heading_interval=parameters.heading_interval,
        deviation_odds=2.0 * IRON_DEVIATION**2,
        own_iron=OWN_IRON * parameters.hard_iron_sigma,
        max_dip=float(MAX_DIP),
        field_disturbance=parameters.field_disturbance,
        field_deviation=parameters.field_deviation,
        iron_sigma=parameters.iron_sigma,
        iron_prior=parameters.unshown_iron_sigma**2,
        **hard_iron.parts(interval),
    )


def memory_of(constants: kernel.Constants) -> kernel.Memory:
    """Return the kernel's memory at the start."""
    return hard_iron.memory(constants.lag, MEDIAN_SAMPLES)


def first_variance(force: Array, field: Array, parameters: AhrsParameters) -> float:
    """Return the variance of the heading by constant iron, rad², from the first specific force and field (3,)."""
    return float(iron_variance(parameters.first_iron_sigma, sine_of_dip(force.tolist(), field.tolist())))


def smoothed(steps: kernel.Steps, start: float, parameters: AhrsParameters, interval: float) -> Headings:
    """Return the heading measurements, each from all steps; the first sample is at ``start``, s.

    ``interval`` is that of the steps in the mean, s: those of 50 Hz are of one and two samples in turn.
    """
    if steps.bias.any():
        steps = _without_drift(steps, interval)
    known, shown = steps.number > 0.0, steps.force_number > 0.0
    field = _held(steps.field / np.maximum(steps.number, 1.0)[:, None], known)
    vertical = _vertical(_held(steps.force / np.maximum(steps.force_number, 1.0)[:, None], shown), interval)
    measured = _look(field, vertical, parameters, interval)
    usual = float(measured.usual[0, 0])
    iron, unshown = hard_iron.find(
        field, vertical, steps.frame, known, steps.time, interval, usual, parameters.unshown_iron_sigma
    )
    if iron.any():
        # Iron may have been attached or removed: it is subtracted only where that does not increase the deviation of the field.
        without = _look(field - quaternion.rotate(steps.frame, iron), vertical, parameters, interval)
        odds = np.clip((measured.deviation - without.deviation) / (2.0 * IRON_DEVIATION**2), -50.0, 0.0)
        iron *= (2.0 / (1.0 + np.exp(-odds)))[:, None]
        left = (OWN_IRON * parameters.hard_iron_sigma * usual) ** 2 / np.maximum(np.sum(iron**2, axis=1), 1e-30)
        iron *= np.maximum(1.0 - left, 0.0)[:, None]
        iron[lengths(iron) < hard_iron.NEGLIGIBLE * usual] = 0.0
        field = field - quaternion.rotate(steps.frame, iron)
        measured = _look(field, vertical, parameters, interval)
    steep = np.minimum(np.abs(measured.usual[:, 1]), MAX_DIP)
    noise = (parameters.field_disturbance / np.cos(steep)) ** 2 * (
        1.0 + measured.deviation / parameters.field_deviation**2
    )
    direction = np.where(known[:, None], field / measured.strength[:, None], 0.0)
    up = quaternion.rotate(quaternion.conjugate(steps.frame), vertical)
    variance = np.einsum("ki,ki->k", up**2, steps.turn_variance)  # of the rotation about the vertical
    vectors = _gathered(steps, start, direction, steps.length / noise, variance, parameters.heading_interval)
    by_iron = (parameters.iron_sigma**2 + unshown) / np.cos(measured.usual[:, 1]) ** 2
    return Headings(vectors, measured.usual, iron, by_iron)


class _Look(NamedTuple):
    """Magnitude of a field (k,), its usual magnitude and dip (k, 2), and its square deviation from what is usual, low-passed (k,)."""

    strength: Array
    usual: Array
    deviation: Array


def _look(field: Array, vertical: Array, parameters: AhrsParameters, interval: float) -> _Look:
    level = _strength_and_dip(field, vertical)
    usual = np.broadcast_to([median(column) for column in level.T], level.shape)
    share = interval / parameters.field_change_time
    change = field - 0.5 * (low_pass(field, share) + low_pass(field[::-1], share)[::-1])
    square = (
        (level[:, 0] / usual[:, 0] - 1.0) ** 2
        + (level[:, 1] - usual[:, 1]) ** 2
        + np.einsum("ki,ki->k", change, change) / usual[:, 0] ** 2
    )
    return _Look(level[:, 0], usual, low_pass(square[:, None], interval / parameters.field_memory)[:, 0])


def _without_drift(steps: kernel.Steps, interval: float) -> kernel.Steps:
    """Return the samples in a frame that does not rotate with the gyro's bias; ``interval``: that of the steps, s."""
    drift, out = np.array([1.0, 0.0, 0.0, 0.0]), np.empty_like(steps.frame)
    compiled(kernel.drifts)(interval, read_only(steps.bias), read_only(steps.frame), drift, out)
    return steps._replace(
        field=quaternion.rotate(out, steps.field),
        force=quaternion.rotate(out, steps.force),
        frame=quaternion.multiply(out, steps.frame),
        end=quaternion.multiply(out, steps.end),
    )


def _gathered(
    steps: kernel.Steps, start: float, direction: Array, information: Array, variance: Array, heading_interval: float
) -> VectorMeasurements:
    """Return heading measurements: directions (k, 3) averaged over the heading interval, weighted by their information (k,).

    ``variance`` (k,): of the rotation about the vertical over each step, in addition to the gyro's noise, rad².
    """
    edge = np.flatnonzero(np.diff(np.floor((steps.time - start) / heading_interval - 1e-6), append=np.inf))
    begin = np.append(0, edge[:-1] + 1)
    for k in np.flatnonzero(variance * information):  # directions before it are as uncertain
        before = slice(begin[np.searchsorted(begin, k, side="right") - 1], k)
        information[before] /= 1.0 + variance[k] * information[before].sum()
        information[k] /= 1.0 + variance[k] * information[k]
    total = np.add.reduceat(direction * information[:, None], begin, axis=0)
    information = np.add.reduceat(information, begin)
    informed = information > 0.0
    total = total[informed] / lengths(total[informed])[:, None]
    direction = quaternion.rotate(quaternion.conjugate(steps.end[edge][informed]), total)
    return _measured(steps.time[edge][informed], direction, 1.0 / np.sqrt(information[informed]))


def _vertical(force: Array, interval: float) -> Array:
    """Return the vertical (k, 3) from specific force passed twice through a low-pass filter."""
    share = interval / VERTICAL_TIME
    vertical = low_pass(low_pass(force, share), share)
    return np.asarray(vertical / lengths(vertical)[:, None])


def _strength_and_dip(field: Array, vertical: Array) -> Array:
    """Return the magnitude of a field, and its angle below the horizontal, rad (k, 2)."""
    strength = lengths(field)
    strength[strength == 0.0] = 1.0
    return np.column_stack(
        [strength, np.arcsin(np.clip(-np.einsum("ki,ki->k", field, vertical) / strength, -1.0, 1.0))]
    )


def _held(values: Array, known: np.ndarray) -> Array:
    """Return rows (k, …) with each unknown row replaced by the last known one before it, or by the first known one."""
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.asarray(values[np.where(last < 0, int(np.argmax(known)), last)])
