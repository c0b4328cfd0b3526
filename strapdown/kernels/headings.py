"""Headings from the field and hard iron of a unit, from the filter's steps up to each: :mod:`strapdown.ahrs.headings` has the method.

All that lasts from one step to the next is in arrays, so steps may be processed at once or one at a time, with the same bits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    cross,
    dot,
    factored,
    matrix_times_vector,
    scale,
    solved,
    subtract,
    transpose_times_vector,
)
from strapdown.kernels.measurement import quaternion_at, vector_at
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix, turned
from strapdown.kernels.state import store_row

NO_EQUATIONS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Normal matrix and right side for the iron without a change of the field."""


class Constants(NamedTuple):
    """Constants of the method, and of a unit."""

    vertical_share: float
    change_share: float
    memory_share: float
    iron_share: float
    rise_share: float
    """Factors of the low-pass filters: 1 − exp(−step over time constant)."""
    iron_interval: float
    """Interval of the steps over ``iron_share``, s."""
    every: int
    """Number of steps from one value of the running medians to the next."""
    lag: int
    """Number of steps over which the change of the field is computed."""
    step: float
    """Interval of the steps, s."""
    heading_interval: float
    span: float
    """Duration over which the change of the field is computed, s."""
    ridge: float
    """Squared ratio of the noise of the change to the prior σ of the iron."""
    left_ridge: float
    """The same of the noise with which the filter's states learn weak iron, which is left to them."""
    feigned: float
    negligible: float
    deviation_odds: float
    """Twice the square of the increase of the deviation at which iron is no longer subtracted."""
    own_iron: float
    """Iron that is left to the states of the filter, relative to the magnitude."""
    max_dip: float
    field_disturbance: float
    field_deviation: float
    iron_sigma: float
    iron_prior: float
    """Variance of each component of the iron that no rotation has shown, relative to the squared magnitude."""


class Steps(NamedTuple):
    """Samples of each step, in the frame fixed by the integrated gyro."""

    field: np.ndarray
    """Sum of the field (k, 3)."""
    number: np.ndarray
    """Number of its samples (k,)."""
    length: np.ndarray
    """Duration that they cover, s (k,)."""
    frame: np.ndarray
    """Attitude by the gyro in the middle of the step (k, 4)."""
    force: np.ndarray
    """Sum of the specific force (k, 3)."""
    force_number: np.ndarray
    end: np.ndarray
    """Attitude by the gyro at the end of the step (k, 4)."""
    time: np.ndarray
    """Time of the end, s (k,)."""
    turn_variance: np.ndarray
    """Variance of the rotation by the gyro about each body axis over the step in addition to its noise, rad²: gaps, clipping (k, 3)."""
    bias: np.ndarray
    """Bias of the gyro by the rests before (k, 3), rad/s; 0: no rest yet."""


class Memory(NamedTuple):
    """What lasts from one step to the next."""

    drift: np.ndarray
    """Rotation (4,) that removes the drift of the frame fixed by the gyro since the start, as far as rests have shown the bias."""
    counted: np.ndarray
    """1 with a field, 2 with a force, 3 with both so far; steps since there were both, and since the last uncertain rotation (3,)."""
    start: np.ndarray
    """Time of the first sample, s, and interval of the headings of the last step (2,)."""
    strength: np.ndarray
    """First usual magnitude (1,)."""
    held: np.ndarray
    """Last field and force (2, 3)."""
    vertical: np.ndarray
    """Force after each of two low-pass filters (2, 3)."""
    mean: np.ndarray
    """Mean field: as measured, without the iron that appears, without the iron subtracted (3, 3)."""
    deviation: np.ndarray
    """Square deviation from each of these means (3,)."""
    ordered: np.ndarray
    """Values of magnitude and dip of each, in order of size (6, capacity)."""
    stride: np.ndarray
    """Number of the values in order, and of steps from one to the next (6, 2)."""
    median: np.ndarray
    """Their medians (6,)."""
    ring: np.ndarray
    """Field (3), attitude by the gyro (4), and whether known, of the steps of the last second (lag, 8)."""
    ring_time: np.ndarray
    """Times of the steps in the ring, s (lag,)."""
    sums: np.ndarray
    """Normal equations of the iron (9,)."""
    iron: np.ndarray
    """Iron after its low-pass filter (3,)."""
    total: np.ndarray
    """Sum of the directions of a heading, and of their information (4,)."""


class Outputs(NamedTuple):
    """Results of each step."""

    direction: np.ndarray
    """Heading measurement in body axes (k, 3)."""
    sigma: np.ndarray
    """Its σ (k,); 0: there is none at this step."""
    usual: np.ndarray
    """Usual magnitude and dip (k, 2)."""
    iron: np.ndarray
    """Iron subtracted (k, 3)."""
    variance: np.ndarray
    """Variance of the heading by constant iron, rad² (k,)."""


def heading_steps(constants, steps, memory, out):
    """Process steps."""
    for k in range(len(steps.time)):
        heading_step(constants, steps, memory, out, k)


def equations_until(constants, field, frame, known, time, strength, k):
    """Return the equations by the change of the field over ``lag`` rows up to row k; zeros without such a change."""
    then = k - constants.lag
    if then < 0 or not is_pair(constants, known[k], time[k], known[then], time[then]):
        return NO_EQUATIONS
    return equations_of(
        vector_at(field, k), quaternion_at(frame, k), vector_at(field, then), quaternion_at(frame, then), strength
    )


def approached(share, sums, values):
    """Return low-passed numbers after others of the same kind."""
    return tuple(total + share * (value - total) for total, value in zip(sums, values, strict=True))


def added(rows, k, values):
    """Return the numbers of a row, each increased by a value."""
    return tuple(rows[k, i] + value for i, value in enumerate(values))


def iron_of_all(constants, rows, strength, before, iron, unshown):
    """Write the iron (k, 3) by the changes before and after each row, and its variance (k,); ``before`` (k, 9) is scratch.

    That variance is of the iron across the field (:func:`variance_across`).
    """
    field, up, frame, known, time = rows
    sums = NO_EQUATIONS
    for k in range(len(time)):
        equations = equations_until(constants, field, frame, known, time, strength, k)
        sums = approached(constants.iron_share, sums, equations)
        store_row(before, k, sums)
    sums = NO_EQUATIONS
    for k in range(len(time) - 1, -1, -1):
        if k + constants.lag < len(time):
            equations = equations_until(constants, field, frame, known, time, strength, k + constants.lag)
            sums = approached(constants.iron_share, sums, equations)
        total = added(before, k, sums)
        store_row(iron, k, iron_of(constants, total, strength))
        R = rotation_matrix(quaternion_at(frame, k))
        unshown[k] = variance_across(constants, total, R, vector_at(field, k), vector_at(up, k))


def heading_step(constants, steps, memory, out, k):
    """Process step k."""
    drift = drift_after(constants.step, steps.bias, steps.frame, memory.drift, k)
    C = rotation_matrix(drift)
    known = steps.number[k] > 0.0
    if known:
        store_row(memory.held, 0, matrix_times_vector(C, scale(1.0 / steps.number[k], vector_at(steps.field, k))))
        memory.counted[0] |= 1
    if steps.force_number[k] > 0.0:
        store_row(memory.held, 1, matrix_times_vector(C, scale(1.0 / steps.force_number[k], vector_at(steps.force, k))))
        memory.counted[0] |= 2
    out.sigma[k] = 0.0
    store_row(out.iron, k, (0.0, 0.0, 0.0))
    out.usual[k, 0], out.usual[k, 1] = 1.0, 0.0
    unshown = constants.iron_prior
    if memory.counted[0] == 3:
        unshown = look_at_field(constants, steps, memory, out, k, known, drift)
        memory.counted[1] += 1
    level = math.cos(out.usual[k, 1])
    out.variance[k] = (constants.iron_sigma * constants.iron_sigma + unshown) / (level * level)
    close_heading(constants, steps, memory, out, k, drift)


def drift_after(step, bias, frame, drift, k):
    """Return the rotation that removes the drift of the frame fixed by the gyro until step k, and write it in ``drift`` (4,).

    That frame rotates with the bias (k, 3), without which the field of a unit at rest would seem to rotate and to be iron. ``step``:
    interval of the steps, s.
    """
    rotation = matrix_times_vector(rotation_matrix(quaternion_at(frame, k)), vector_at(bias, k))
    q = turned((drift[0], drift[1], drift[2], drift[3]), scale(-step, rotation))
    for i in range(4):
        drift[i] = q[i]
    return q


def drifts(step, bias, frame, drift, out):
    """Write :func:`drift_after` of all steps (k, 4)."""
    for k in range(len(frame)):
        store_row(out, k, drift_after(step, bias, frame, drift, k))


def look_at_field(constants, steps, memory, out, k, known, drift):
    """Add the direction of the field of step k to the heading, with the information that its deviation leaves.

    Returns the variance of the iron that turns the heading (:func:`variance_across`).
    """
    field = vector_at(memory.held, 0)
    frame = quaternion_multiply(drift, quaternion_at(steps.frame, k))
    # After an uncertain rotation, directions before it are as uncertain in the frame fixed by the gyro: they are forgotten.
    turn = vector_at(steps.turn_variance, k)
    largest = max(turn[0], turn[1])
    largest = max(largest, turn[2])
    forgotten = largest / (largest + constants.field_deviation * constants.field_deviation)
    if forgotten > 0.5:
        memory.counted[2] = 0
        for i in range(len(memory.ring)):
            memory.ring[i, 7] = 0.0
    memory.counted[2] += 1
    share = max(constants.vertical_share, 1.0 / memory.counted[2])
    if share > constants.vertical_share:  # the mean field starts with the average of that time too, not with one sample
        forgotten = max(forgotten, share)
    low_passed(share, memory.vertical, 0, vector_at(memory.held, 1), memory.counted[1])
    low_passed(share, memory.vertical, 1, vector_at(memory.vertical, 0), memory.counted[1])
    up = vector_at(memory.vertical, 1)
    up = scale(1.0 / math.sqrt(dot(up, up)), up)
    look(constants, memory, 0, field, up, forgotten)
    if memory.counted[1] == 0:
        memory.strength[0] = memory.median[0]
    strength = memory.strength[0]
    iron = iron_step(constants, field, frame, known, steps.time[k], strength, memory)
    R = rotation_matrix(frame)
    unshown = variance_across(constants, memory.sums, R, field, up)
    look(constants, memory, 1, subtract(field, matrix_times_vector(R, iron)), up, forgotten)
    # Iron may have been attached or removed: it is subtracted only where that does not increase the deviation of the field.
    odds = min(max((memory.deviation[0] - memory.deviation[1]) / constants.deviation_odds, -50.0), 0.0)
    iron = scale(2.0 / (1.0 + math.exp(-odds)), iron)
    left = (constants.own_iron * strength) ** 2 / max(dot(iron, iron), 1e-30)
    iron = scale(max(1.0 - left, 0.0), iron)
    if math.sqrt(dot(iron, iron)) < constants.negligible * strength:
        iron = (0.0, 0.0, 0.0)
    store_row(out.iron, k, iron)
    field = subtract(field, matrix_times_vector(R, iron))
    size = look(constants, memory, 2, field, up, forgotten)
    out.usual[k, 0], out.usual[k, 1] = memory.median[4], memory.median[5]
    if known:
        steep = min(abs(memory.median[5]), constants.max_dip)
        relative = constants.field_disturbance / math.cos(steep)
        noise = (
            relative * relative * (1.0 + memory.deviation[2] / (constants.field_deviation * constants.field_deviation))
        )
        u = transpose_times_vector(R, up)
        variance = u[0] * u[0] * turn[0] + u[1] * u[1] * turn[1] + u[2] * u[2] * turn[2]  # about the vertical
        information = 1.0 / (noise / steps.length[k] + variance)  # the step's samples may precede that rotation too
        remaining = 1.0 / (1.0 + variance * memory.total[3])
        for i in range(3):
            memory.total[i] = remaining * memory.total[i] + field[i] / size * information
        memory.total[3] = remaining * memory.total[3] + information
    return unshown


def close_heading(constants, steps, memory, out, k, drift):
    """Write the heading measurement, if its interval ends with step k."""
    before = memory.start[1]
    memory.start[1] = math.floor((steps.time[k] + constants.step - memory.start[0]) / constants.heading_interval - 1e-6)
    total = (memory.total[0], memory.total[1], memory.total[2])
    if memory.start[1] != before and memory.total[3] > 0.0:
        R = rotation_matrix(quaternion_multiply(drift, quaternion_at(steps.end, k)))
        store_row(out.direction, k, transpose_times_vector(R, scale(1.0 / math.sqrt(dot(total, total)), total)))
        out.sigma[k] = 1.0 / math.sqrt(memory.total[3])
    if memory.start[1] != before:
        for i in range(4):
            memory.total[i] = 0.0


def low_passed(share, values, row, new, count):
    """Pass a vector through the low-pass filter in a row of ``values``, which starts with the first one."""
    for i in range(3):
        values[row, i] = new[i] if count == 0 else values[row, i] + share * (new[i] - values[row, i])


def look(constants, memory, which, field, up, forgotten):
    """Update usual magnitude and dip and the deviation from them; return the magnitude."""
    count = memory.counted[1]
    size = math.sqrt(dot(field, field))
    if size == 0.0:
        size = 1.0
    dip = math.asin(min(max(-dot(field, up) / size, -1.0), 1.0))
    insert(memory, 2 * which, size, count, constants.every)
    insert(memory, 2 * which + 1, dip, count, constants.every)
    low_passed(max(constants.change_share, forgotten), memory.mean, which, field, count)
    change = subtract(field, vector_at(memory.mean, which))
    usual = memory.median[2 * which]
    relative, steeper = size / usual - 1.0, dip - memory.median[2 * which + 1]
    square = relative * relative + steeper * steeper + dot(change, change) / (usual * usual)
    old = square if count == 0 else memory.deviation[which]
    memory.deviation[which] = old + constants.memory_share * (square - old)
    return size


def insert(memory, which, value, step, every):
    """Insert every ``every``-th value among those in order of size, and update the median.

    Where they are full, every other one is dropped, which keeps the median, and the stride is doubled.
    """
    if step == 0:
        memory.stride[which, 0], memory.stride[which, 1] = 0, every
    if step % memory.stride[which, 1] != 0:
        return
    ordered, count, capacity = memory.ordered, memory.stride[which, 0], memory.ordered.shape[1]
    if count == capacity:
        count = capacity // 2
        for k in range(count):
            ordered[which, k] = 0.5 * (ordered[which, 2 * k] + ordered[which, 2 * k + 1])
        memory.stride[which, 1] *= 2
    k = count
    while k > 0 and ordered[which, k - 1] > value:
        ordered[which, k] = ordered[which, k - 1]
        k -= 1
    ordered[which, k] = value
    count += 1
    memory.stride[which, 0] = count
    memory.median[which] = 0.5 * (ordered[which, (count - 1) // 2] + ordered[which, count // 2])


def is_pair(constants, known, time, known_then, then):
    """Return whether the gyro measures the rotation between two rows with a field: over a gap it does not."""
    return known and known_then and abs(time - then - constants.span) < 2.0 * constants.step


def equations_of(field, frame, then, old, strength):
    """Return the normal matrix (upper triangle) and the right side for the iron, by the change of the field from ``then`` to ``field``."""
    change = scale(1.0 / strength, subtract(field, then))
    # With A = R − R' and v the vector part of the quaternion of the rotation between them, AᵀA = 4 (|v|² I − v vᵀ).
    _, x, y, z = quaternion_multiply((frame[0], -frame[1], -frame[2], -frame[3]), old)
    right = subtract(
        transpose_times_vector(rotation_matrix(frame), change), transpose_times_vector(rotation_matrix(old), change)
    )
    return (
        4.0 * (y * y + z * z),
        -4.0 * x * y,
        -4.0 * x * z,
        4.0 * (x * x + z * z),
        -4.0 * y * z,
        4.0 * (x * x + y * y),
        right[0],
        right[1],
        right[2],
    )


def normal_factor(constants, sums, ridge):
    """Return the factor of the normal matrix of the iron, from low-passed equations and the prior σ."""
    h = constants.iron_interval
    normal = (
        h * sums[0] + ridge,
        h * sums[1],
        h * sums[2],
        h * sums[3] + ridge,
        h * sums[4],
        h * sums[5] + ridge,
    )
    return factored(normal)


def variance_across(constants, sums, R, field, up):
    """Return the variance of the iron, relative to the squared magnitude, in the horizontal direction across the field.

    Such iron turns the heading. Iron that no rotation has distinguished from the field of the surroundings is as uncertain as at first.
    """
    across = cross(field, up)
    across = transpose_times_vector(R, scale(1.0 / math.sqrt(max(dot(across, across), 1e-30)), across))
    shown = solved(normal_factor(constants, sums, constants.left_ridge), across)
    return constants.iron_prior * constants.left_ridge * dot(across, shown)


def iron_of(constants, sums, strength):
    """Return the iron by low-passed equations, less what a field that varies along the path feigns."""
    h = constants.iron_interval
    iron = solved(normal_factor(constants, sums, constants.ridge), (h * sums[6], h * sums[7], h * sums[8]))
    less = 1.0 - constants.feigned * constants.feigned / max(dot(iron, iron), 1e-30)
    return scale(strength * max(less, 0.0), iron)


def iron_step(constants, field, frame, known, time, strength, memory):
    """Return the iron that the change of the field since ``lag`` steps shows, together with all earlier changes."""
    lag, step, sums, ring = constants.lag, memory.counted[1], memory.sums, memory.ring
    r = step % lag
    old = (ring[r, 3], ring[r, 4], ring[r, 5], ring[r, 6])
    equations = NO_EQUATIONS
    if step >= lag and is_pair(constants, known, time, ring[r, 7] > 0.0, memory.ring_time[r]):
        equations = equations_of(field, frame, vector_at(ring, r), old, strength)
    for i in range(3):
        ring[r, i] = field[i]
    for i in range(4):
        ring[r, 3 + i] = frame[i]
    ring[r, 7] = 1.0 if known else 0.0
    memory.ring_time[r] = time
    for i in range(9):
        sums[i] += constants.iron_share * (equations[i] - sums[i])
    iron = iron_of(constants, sums, strength)
    for i in range(3):
        memory.iron[i] += constants.rise_share * (iron[i] - memory.iron[i])
    iron = (memory.iron[0], memory.iron[1], memory.iron[2])
    if math.sqrt(dot(iron, iron)) < constants.negligible * strength:
        iron = (0.0, 0.0, 0.0)
    return iron
