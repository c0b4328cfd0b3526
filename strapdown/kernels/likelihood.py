"""The filter for eight sets of parameters together, one per lane, and the sensitivities of its innovations: a body of the walk.

The filter is that of :mod:`strapdown.kernels.covariance_form`; gyro noise, σ of each sensor and initial covariance differ between lanes. If
lane i is lane 0 with a small change of parameter i, differences between lanes are the derivatives of each innovation and of its variance,
from which score and information of the likelihood are summed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import add, combine, dot, matrix_times_vector, transpose_times_vector
from strapdown.kernels.filter_step import predict as propagated
from strapdown.kernels.filter_step import reset, update_row
from strapdown.kernels.lane_angles import arctangent, rotation_vector
from strapdown.kernels.lane_values import WIDTH, broadcast, load, store, sum_lanes
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    KIND,
    VECTOR,
    direction_rows,
    frame_at,
    frame_row,
    heading_row,
    sigma_of,
    value_of,
)
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.series import LARGEST_ANGLE, SQUARED_RANGE
from strapdown.kernels.state import load_lanes, load_quaternion, store_lanes, store_several
from strapdown.kernels.walk import MAX_TURN

REPLACEABLE = ("counted",)

HALF_RANGE = 0.25 * SQUARED_RANGE
"""Squared half of the maximum angle of the polynomials, rad²."""
FOUND = 12 * WIDTH
"""Offset of innovations and variances in the work space, after the rows of a measurement."""
WORK = 18 * WIDTH
WIDE = 21 * WIDTH
"""Offset of innovations and variances for the noise of an outlier."""
ROOM = 27 * WIDTH
"""Size of the work space."""


class Body(NamedTuple):
    """Parameters of each lane, and the time spans of the record with separate sums."""

    noise: np.ndarray
    """σ_v² and σ_u² in lanes (2 × WIDTH)."""
    factors: np.ndarray
    """Factor on the variances of each sensor (sensors × WIDTH)."""
    outliers: np.ndarray
    """Share and variance ratio of outliers (2 × WIDTH); empty without outliers."""
    state: np.ndarray
    """Initial states (28 × WIDTH); at return, the end states."""
    cuts: np.ndarray
    """Limits of the parts: part c is from ``cuts[c − 1]`` to ``cuts[c]``, the last one unlimited."""
    epochs: np.ndarray
    """Edges at which states are stored."""
    free: int
    """Number of parameters, changed by ``step`` in lanes 1, 2, …"""
    step: float
    room: np.ndarray
    """Scratch (``ROOM``,)."""


class Outputs(NamedTuple):
    """Sums by part of the record, and outputs of a run."""

    minus_log: np.ndarray
    """Σ ½ (log s + e²/s) of the innovations (parts × WIDTH)."""
    score: np.ndarray
    """Derivatives of lane 0 (parts, free)."""
    information: np.ndarray
    """Lower triangles (parts, free, free); with outliers, sums of the outer products of each measurement's gradient."""
    states: np.ndarray
    """States at the epochs (epochs × 28 × WIDTH)."""
    probability: np.ndarray
    """Probability that each measurement is an outlier, and mean ratio of its noise to its innovations' variances, in lane 0 (events, 2), or
    (0, 2)."""


def begin(body):
    """Return (q, b, A, B, C) in lanes, the part of the record, and the number of states stored."""
    q, b, A, B, C = load_lanes(body.state, 0)
    none = 0 * len(body.cuts)
    return q, b, A, B, C, none, none


def longest_step(state, part, dt, body):
    """Return the longest step, s, for all lanes except diverged ones, with angles above ``MAX_TURN``."""
    b = state[1]
    # Usually sufficient: the sum over the lanes is not less than the largest, and comparisons with NaN are false.
    if dot(part, part) <= HALF_RANGE and sum_lanes(dot(b, b)) * (dt * dt) < HALF_RANGE:
        return dt
    turn = combine(1.0, part, -dt, b)
    room = body.room
    store(room, WORK, dot(turn, turn))
    squared = SQUARED_RANGE
    for i in range(WIDTH):
        if squared < room[WORK + i] < MAX_TURN * MAX_TURN:
            squared = room[WORK + i]
    return dt * (LARGEST_ANGLE / math.sqrt(squared))


def predict(state, part, dt, body, out):
    """Propagate all lanes."""
    q, b, A, B, C, span, kept = state
    q, A, B, C = propagated(q, b, A, B, C, part, dt, load(body.noise, 0), load(body.noise, WIDTH))
    return q, b, A, B, C, span, kept


def part_at(span, now, cuts):
    """Return the part of the record at a time, searched from the previous part."""
    while span < len(cuts) and now > cuts[span]:
        span += 1
    return span


def put_row(rows, k, h, y):
    """Write row k of a measurement, h (3) and y in lanes, to the work space."""
    store_several(rows, 4 * WIDTH * k, (*h, y))


def put_axes(rows, y):
    """Write the rows of a measured error of the attitude."""
    for k in range(3):
        put_row(rows, k, tuple(broadcast(1.0 if i == k else 0.0) for i in range(3)), y[k])


def measured_rows(q, z, kind, t, triads, rows):
    """Write the rows of one measurement to ``rows`` and return their number."""
    if kind == ATTITUDE:
        measured = frame_at(triads, t)
        y = rotation_vector(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured))
        put_axes(rows, y)
        return 3
    R = rotation_matrix(q)
    if kind == HEADING:
        m = matrix_times_vector(R, z)
        east, north = triads[t, 6], triads[t, 7]
        put_row(rows, 0, heading_row(R, z), arctangent(m[0] * north - m[1] * east, m[0] * east + m[1] * north))
        return 1
    frame = frame_at(triads, t)
    h1, y1, h2, y2 = direction_rows(R, frame[:3], frame[3:6], z)
    put_row(rows, 0, h1, y1)
    put_row(rows, 1, h2, y2)
    if kind == VECTOR:
        store(rows, 8 * WIDTH, dot(transpose_times_vector(R, frame[6:]), z) - 1.0)
    return 2


def add_derivatives(room, number, free, step, score, information):
    """Add one event to the score Σ ∂ℓ/∂θ and the information; ℓ = ½ (log s + e²/s).

    The work space holds e and s of ``number`` innovations in lanes; lane i is lane 0 with parameter i changed by ``step``. The information
    is Fisher's by sensitivities, ``ė_j ė_k/s + ½ ṡ_j ṡ_k/s²`` (Segal & Weinstein 1989): positive semidefinite for any data.
    """
    found = room[FOUND:]
    work = room[WORK:]
    for j in range(free):
        work[j] = 0.0
    for r in range(number):
        place = 2 * WIDTH * r
        e = found[place]
        s = found[place + WIDTH]
        inverse = 1.0 / s
        over = inverse / step
        whitened = e * e * inverse
        for j in range(free):
            change_e = (found[place + 1 + j] - e) * over
            change_s = (found[place + WIDTH + 1 + j] - s) * over
            work[WIDTH + j] = change_e
            work[2 * WIDTH + j] = change_s
            work[j] += 0.5 * change_s * (1.0 - whitened) + e * change_e
        for j in range(free):
            a = work[WIDTH + j] * s
            c = 0.5 * work[2 * WIDTH + j]
            for k in range(j + 1):
                information[j, k] += a * work[WIDTH + k] + c * work[2 * WIDTH + k]
    for j in range(free):
        score[j] += work[j]


def variance_of(measured, place, sensor, kind, z, r):
    """Return the variance of row r of a measurement."""
    if kind == ATTITUDE:
        return z[0] if r == 0 else (z[1] if r == 1 else z[2])
    sigma = sigma_of(measured, place, sensor)
    return sigma * sigma


def update(state, e, now, measured, body, out):
    """Update all lanes with a measurement, and add to the sums of its part of the record."""
    q, b, A, B, C, span, kept = state
    span = part_at(span, now, body.cuts)
    place = measured.place[e]
    sensor = measured.sensor[e]
    z = value_of(measured, place, sensor)
    kind = measured.series[sensor, KIND]
    number = measured_rows(q, z, kind, frame_row(measured, place, sensor), measured.triads, body.room)
    correction, b, A, B, C = counted(b, A, B, C, e, span, number, measured, z, body, out)
    q, A, B = reset(q, A, B, correction)
    return q, b, A, B, C, span, kept


def counted(b, A, B, C, e, span, number, measured, z, body, out):
    """Update with the rows in the work space, and add to the sums; return the attitude correction, b, A, B, C."""
    room, place, sensor = body.room, measured.place[e], measured.sensor[e]
    factor = load(body.factors, WIDTH * sensor)
    correction, b, A, B, C = updated(b, A, B, C, number, measured, place, sensor, z, factor, room, FOUND)
    if measured.series[sensor, KIND] == VECTOR:
        number = 3
    for i in range(WIDTH):
        deviance, product = deviance_of(room, FOUND, number, i)
        out.minus_log[WIDTH * span + i] += 0.5 * (math.log(product) + deviance)
    if body.free > 0:
        add_derivatives(room, number, body.free, body.step, out.score[span], out.information[span])
    return correction, b, A, B, C


def updated(b, A, B, C, number, measured, place, sensor, z, factor, room, found):
    """Update with all variances of a measurement times ``factor``; return the attitude correction, b, A, B, C.

    Innovations and their variances are written to the work space at ``found``, in lanes; the third is that of a vector's length.
    """
    kind = measured.series[sensor, KIND]
    correction = (broadcast(0.0), broadcast(0.0), broadcast(0.0))
    for r in range(number):
        h, y = row_at(room, r)
        innovation = y - dot(h, correction)
        variance = variance_of(measured, place, sensor, kind, z, r) * factor
        turn, b, A, B, C, s = update_row(b, A, B, C, h, innovation, variance)
        correction = add(correction, turn)
        store_several(room, found + 2 * WIDTH * r, (innovation, s))
    if kind == VECTOR:
        variance = variance_of(measured, place, sensor, kind, z, 2) * factor
        store_several(room, found + 4 * WIDTH, (load(room, 8 * WIDTH), variance))
    return correction, b, A, B, C


def deviance_of(room, found, number, i):
    """Return the NIS of a measurement and the determinant of its innovation covariance in lane i."""
    deviance, product = 0.0, 1.0
    for r in range(number):
        e = room[found + 2 * WIDTH * r + i]
        s = room[found + 2 * WIDTH * r + WIDTH + i]
        deviance += e * e / s
        product *= s
    return deviance, product


def row_at(room, r):
    """Return h (3) and y of row r in lanes from the work space."""
    hy = load_quaternion(room, 4 * WIDTH * r)
    return hy[:3], hy[3]


def keep(state, row, e, body, out):
    """Write the state if the edge is an epoch."""
    q, b, A, B, C, span, kept = state
    if kept < len(body.epochs) and body.epochs[kept] == row:
        store_lanes(out.states, 28 * WIDTH * kept, q, b, A, B, C)
        kept += 1
    return q, b, A, B, C, span, kept


def finish(state, row, e, body):
    """Store the end states."""
    q, b, A, B, C, _, _ = state
    store_lanes(body.state, 0, q, b, A, B, C)
    return row
