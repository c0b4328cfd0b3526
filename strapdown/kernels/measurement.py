"""Measurements: their kinds, their order of time, the storage of their numbers, and their rows in an update.

Every kind enters by scalar rows ``y = h · δθ + noise`` of the body-side attitude error (:mod:`strapdown.kernels.filter_step`), on floats or
lanes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    dot,
    matrix_times_vector,
    transpose_times_vector,
)
from strapdown.kernels.lane_values import select

DIRECTION = 0
"""Kind: a unit direction, two degrees of freedom."""
VECTOR = 1
"""Kind: a whole vector over the length of its reference, three degrees of freedom."""
HEADING = 2
"""Kind: a body vector of which only the heading of its horizontal part is used, one degree of freedom."""
ATTITUDE = 3
"""Kind: a whole attitude, three degrees of freedom. Its frame holds the quaternion in its first four numbers, its value the three
variances."""
KIND_CODES = {"direction": DIRECTION, "vector": VECTOR, "heading": HEADING, "attitude": ATTITUDE}
"""Codes of the kinds by their names."""

VERTICAL = 1e-24
"""Minimum squared horizontal part of a vector with a heading: of a unit vector at a picoradian from the vertical."""


class Measurements(NamedTuple):
    """Measurements of all sensors (m in total). *Place*: index of a measurement with one sensor after the other."""

    time: np.ndarray
    """Times in order (m,)."""
    place: np.ndarray
    """Place of each, in order of time (m,)."""
    sensor: np.ndarray
    """Sensor of each, in order of time (m,)."""
    value: np.ndarray
    """Three numbers per measurement, by place (3 m,)."""
    sigma: np.ndarray
    """σ of each measurement by place (m,)."""
    noise: np.ndarray
    """Covariances in body axes (m, 6) by place, or (0, 6) if σ defines all noise."""
    series: np.ndarray
    """One row per sensor (sensors, 4), with the columns below."""
    triads: np.ndarray
    """Right-handed frames (u, v, r) by rows about references r (rows, 9); for an attitude the measured quaternion."""


KIND = 0
FIRST_PLACE = 1
FIRST_FRAME = 2
"""Row of ``triads`` of a sensor's first measurement, and step in rows to the next measurement's, 0 or 1."""
FRAME_STEP = 3


def vector_at(array, k):
    """Return row k of an (n, 3) array as a 3-tuple."""
    return (array[k, 0], array[k, 1], array[k, 2])


def quaternion_at(array, k):
    """Return row k of an (n, 4) array as a 4-tuple."""
    return (array[k, 0], array[k, 1], array[k, 2], array[k, 3])


def six_at(array, k):
    """Return row k of an (n, 6) array as a 6-tuple."""
    return (array[k, 0], array[k, 1], array[k, 2], array[k, 3], array[k, 4], array[k, 5])


def value_of(measured, place):
    """Return the three numbers of a measurement."""
    value, first = measured.value, 3 * place
    return (value[first], value[first + 1], value[first + 2])


def frame_at(triads, t):
    """Return row t of the frames as a 9-tuple."""
    return tuple(triads[t, i] for i in range(9))


def frame_of(measured, place, sensor):
    """Return the frame of a measurement as a 9-tuple."""
    s = measured.series
    row = s[sensor, FIRST_FRAME] + s[sensor, FRAME_STEP] * (place - s[sensor, FIRST_PLACE])
    return frame_at(measured.triads, row)


def degrees_of_freedom(kind):
    """Return the number of degrees of freedom of a measurement of a kind."""
    if kind == HEADING:
        return 1
    return 2 if kind == DIRECTION else 3


def store_innovations(out, place, e, s):
    """Write innovations (3,) and their variances (3,) to a row of ``out`` (m, 6)."""
    for i in range(3):
        out[place, 2 * i] = e[i]
        out[place, 2 * i + 1] = s[i]


def direction_rows(R, u, v, z):
    """Return the two rows (h, y), (h, y) of a unit direction ``z`` (body) whose reference r has the right-handed triad u × v = r (fixed).

    A direction has two degrees of freedom: its components along the predicted u and v. With ``z = r_b + r_b × δθ``:
    ``u_b · z = −v_b · δθ``, ``v_b · z = u_b · δθ``.
    """
    ub = transpose_times_vector(R, u)
    vb = transpose_times_vector(R, v)
    return (-vb[0], -vb[1], -vb[2]), dot(ub, z), ub, dot(vb, z)


def heading_row(R, z):
    """Return h of the heading of the horizontal part of a vector ``z`` (body): a rotation δθ of the body changes it by h · δθ.

    With m = R z, a rotation δφ in fixed axes changes the heading by ``δφ_z − m_z (m_x δφ_x + m_y δφ_y)/(m_x² + m_y²)``: only for a
    horizontal vector is it the rotation about the vertical. A vertical vector has no heading, and its row is zero.
    """
    m = matrix_times_vector(R, z)
    level = m[0] * m[0] + m[1] * m[1]
    has_heading = level > VERTICAL
    tilt = -m[2] / select(has_heading, level, 1.0)
    whole = select(has_heading, level - level + 1.0, 0.0)
    return transpose_times_vector(R, (whole * (tilt * m[0]), whole * (tilt * m[1]), whole))


def has_heading(R, z):
    """Return whether a vector ``z`` (body) is not vertical; scalars only."""
    x, y, _ = matrix_times_vector(R, z)
    return x * x + y * y > VERTICAL


def heading_error(R, z, reference):
    """Return the angle about the fixed z axis from the horizontal part of R z to that of ``reference``, rad in (−π, π]."""
    x, y, _ = matrix_times_vector(R, z)
    return math.atan2(x * reference[1] - y * reference[0], x * reference[0] + y * reference[1])


def merge_order(time, heads, ends, ordered, place, sensor):
    """Merge several sorted series, stored one after the other in ``time``; at equal times the earlier series comes first.

    Writes time, place and index of the series of each measurement, in order of time. ``heads`` and ``ends`` bound each series; ``heads``
    is modified.
    """
    for e in range(len(place)):
        best = 0
        earliest = math.inf
        for s in range(len(heads)):
            k = heads[s]
            if k < ends[s] and time[k] < earliest:
                best = s
                earliest = time[k]
        ordered[e] = earliest
        place[e] = heads[best]
        sensor[e] = best
        heads[best] += 1


def common_order(time, number, ordered, place, sensor):
    """Write the result of :func:`merge_order` for ``number`` series with the same times ``time``."""
    count = len(time)
    for s in range(number):
        e = s
        for k in range(count):
            ordered[e] = time[k]
            place[e] = s * count + k
            sensor[e] = s
            e += number
