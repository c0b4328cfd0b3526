"""Attitude of a unit from its specific force and field: at the first sample, and in motion from their means over up to a second.

In motion a single specific force may point anywhere. Its mean in the frame that the gyro keeps approaches the vertical, because no unit
accelerates in one direction for long. A filter that is linear in its errors is put right by these means, after durations that double: the
coarse alignment. All that lasts from one step to the next is in an array, so steps may be processed at once or one at a time, with the same
bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import cross, dot, scale, square_root, symmetric_times_vector, transpose_times_vector
from strapdown.kernels.measurement import quaternion_at, vector_at
from strapdown.kernels.rotation import rotation_matrix, unit
from strapdown.kernels.state import store_row

# ----------------------------------------------------------------------------------------------------------------- at the first sample


class FirstConstants(NamedTuple):
    """Constants of the variances at the first sample."""

    attitude_sigma: float
    """σ of the tilt of a unit at rest, rad."""
    max_tilt_sigma: float
    swing_time: float
    """Time over which the first rate is assumed to accelerate the unit, s."""
    gravity: float
    min_level: float
    """Squared cosine of the dip beyond which a field has hardly a heading."""
    field_sigma: float
    """σ of a disturbance of the field, relative to its magnitude."""


def first_attitude(force, across):
    """Return the attitude in East, North, up axes from the specific force and the field, or any other direction, in body axes."""
    up, north = direction(force), direction(across)
    east = direction(cross(north, up))
    north = cross(up, east)
    # Shepperd's method: the rows of 4 q qᵀ, of which the one with the largest component is normalised.
    w, x = 1.0 + (east[0] + north[1] + up[2]), 1.0 + (east[0] - north[1] - up[2])
    y, z = 1.0 + (north[1] - east[0] - up[2]), 1.0 + (up[2] - east[0] - north[1])
    if w >= x and w >= y and w >= z:
        q = (w, up[1] - north[2], east[2] - up[0], north[0] - east[1])
    elif x >= y and x >= z:
        q = (up[1] - north[2], x, north[0] + east[1], east[2] + up[0])
    elif y >= z:
        q = (east[2] - up[0], north[0] + east[1], y, up[1] + north[2])
    else:
        q = (north[0] - east[1], east[2] + up[0], up[1] + north[2], z)
    q = unit(q)
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    return q


def direction(v):
    """Return a vector of length 1."""
    return scale(1.0 / square_root(dot(v, v)), v)


def least_axis(v):
    """Return the axis to which a vector has the smallest component."""
    x, y, z = abs(v[0]), abs(v[1]), abs(v[2])
    if x <= y and x <= z:
        return (1.0, 0.0, 0.0)
    if y <= z:
        return (0.0, 1.0, 0.0)
    return (0.0, 0.0, 1.0)


def sine_of_dip(force, field):
    """Return the cosine of the angle between specific force and field."""
    return dot(direction(force), direction(field))


def tilt_variance(constants, force, rate):
    """Return the variance of the tilt, rad², with the deviation from gravity and the motion that the first rate implies."""
    moved = square_root(dot(force, force)) / constants.gravity - 1.0
    swing = constants.swing_time * square_root(dot(rate, rate))
    sigma = min(square_root(constants.attitude_sigma**2 + moved * moved + swing * swing), constants.max_tilt_sigma)
    return sigma * sigma


def heading_variance(constants, sine, tilt):
    """Return the variance of the heading, rad², by the tilt, because the field dips, and by a disturbance of the field."""
    return (sine * sine * tilt + constants.field_sigma**2) / max(1.0 - sine * sine, constants.min_level)


def iron_variance(sigma, sine):
    """Return the variance of the heading, rad², by iron with σ relative to the magnitude of the field."""
    return sigma * sigma / max(1.0 - sine * sine, 1e-12)


# ------------------------------------------------------------------------------------------------------------------- coarse alignment

DUE, NUMBER, FORCE, SQUARE, FIELD_NUMBER, FIELD, UNKNOWN = 0, 1, 2, 5, 6, 7, 10
"""Places in the memory: duration at which the next alignment is due, s; number of the samples of the specific force, their sum, the sum of
their squares; number of the samples of the field, their sum; 1 after a rotation of which nothing is known."""
SIZE = 11
UNKNOWN_TURN = 1.0
"""Variance of a rotation of which nothing is known, rad² about each axis."""
LARGE_TURN = 0.5
"""σ of an uncertain rotation about an axis, rad, above which the attitude after it is aligned coarsely."""
AGREES = 1.5
"""Difference of the filter's vertical from the mean, in σ of the mean, up to which the filter is left as it is."""

MIN_HORIZONTAL = 1e-6
"""Squared sine of the angle between field and vertical up to which the field gives no heading."""


class Constants(NamedTuple):
    """Constants of the coarse alignment, and of a unit."""

    interval: float
    """Usual interval of the samples, s."""
    first: float
    """Duration of the first alignment, s."""
    last: float
    """Longest duration of an alignment, s."""
    min_motion: float
    """Squared variation of the specific force, relative to gravity, up to which no alignment is needed."""
    change_time: float
    """Duration over which the acceleration has one direction, s."""
    known: float
    """Variance of the tilt without motion, rad²."""
    unknown: float
    """Largest variance of the tilt, rad²."""
    gravity: float


class Steps(NamedTuple):
    """Samples of each step, in the frame fixed by the integrated gyro."""

    force: np.ndarray
    """Sum of the specific force (k, 3)."""
    force_number: np.ndarray
    """Number of its samples (k,)."""
    field: np.ndarray
    """Sum of the field (k, 3); (0, 3) without a magnetometer."""
    field_number: np.ndarray
    """Number of its samples (k,)."""
    end: np.ndarray
    """Attitude by the gyro at the end of the step (k, 4)."""


class Outputs(NamedTuple):
    """Alignment at the end of each step."""

    force: np.ndarray
    """Mean specific force (k, 3), body axes."""
    field: np.ndarray
    """Mean field (k, 3), body axes; zero without one."""
    variance: np.ndarray
    """Variance of the tilt, rad² (k,); 0: there is no alignment at this step."""


def align_steps(constants, steps, memory, out):
    """Process steps."""
    for k in range(len(steps.force)):
        align_step(constants, steps, memory, out, k)


def align_step(constants, steps, memory, out, k):
    """Process step k."""
    out.variance[k] = 0.0
    if memory[DUE] > constants.last or not steps.force_number[k] > 0.0:
        return
    total = vector_at(steps.force, k)
    memory[NUMBER] += steps.force_number[k]
    memory[SQUARE] += dot(total, total) / steps.force_number[k]
    for i in range(3):
        memory[FORCE + i] += total[i]
    if len(steps.field) > 0:
        memory[FIELD_NUMBER] += steps.field_number[k]
        for i in range(3):
            memory[FIELD + i] += steps.field[k, i]
    duration = memory[NUMBER] * constants.interval
    if duration < memory[DUE]:
        return
    memory[DUE] = max(2.0 * memory[DUE], constants.first)
    mean = scale(1.0 / memory[NUMBER], (memory[FORCE], memory[FORCE + 1], memory[FORCE + 2]))
    square = dot(mean, mean)
    departure = square_root(square) / constants.gravity - 1.0
    spread = max(memory[SQUARE] / memory[NUMBER] - square, 0.0)
    motion = spread / (constants.gravity * constants.gravity) + departure * departure
    if motion < constants.min_motion and memory[UNKNOWN] == 0.0:
        return
    share = constants.change_time / duration
    out.variance[k] = min(constants.known + motion * share * share, constants.unknown)
    if duration < constants.first:
        out.variance[k] = constants.unknown
    R = rotation_matrix(quaternion_at(steps.end, k))
    field = (memory[FIELD], memory[FIELD + 1], memory[FIELD + 2])
    store_row(out.force, k, transpose_times_vector(R, mean))
    store_row(out.field, k, transpose_times_vector(R, scale(1.0 / max(memory[FIELD_NUMBER], 1.0), field)))


def departs(q, force, tilt):
    """Return whether the vertical of an attitude departs from a mean specific force by more than :data:`AGREES` σ of its ``tilt``, rad²."""
    R = rotation_matrix(q)
    return 2.0 - 2.0 * dot((R[6], R[7], R[8]), direction(force)) > AGREES * AGREES * tilt


def aligned(constants, force, field, tilt, unknown, q, covariance):
    """Return the attitude by mean specific force and field, body axes, and the variance of its heading in addition to that by the tilt.

    Without a field (zero), or with one along the force, the heading of the attitude ``q`` is kept, with its variance in ``covariance`` (xx,
    xy, xz, yy, yz, zz); after an ``unknown`` rotation also if it is more certain than that of the field.
    """
    up = direction(force)
    R = rotation_matrix(q)
    east, north = (R[0], R[1], R[2]), (R[3], R[4], R[5])
    across, heading = cross(up, east), dot(up, symmetric_times_vector(covariance, up))
    if abs(dot(up, north)) < abs(dot(up, east)):
        across = north
    square, vertical = dot(field, field), dot(up, field)
    if square - vertical * vertical > MIN_HORIZONTAL * square:
        by_field = heading_variance(constants, sine_of_dip(force, field), tilt)
        if unknown == 0.0 or by_field < heading:
            across, heading = field, by_field
    return first_attitude(force, across), heading
