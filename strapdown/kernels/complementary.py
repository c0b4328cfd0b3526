"""The complementary filter of Mahony, Hamel & Pflimlin (2008), with the covariance for its gains: a body of :mod:`strapdown.kernels.walk`.

Each measurement rotates the attitude by the sensor's gain times ``ω_mes = z × R̂ᵀ r`` and changes the bias by its bias gain times ω_mes:
equations (32) of the paper over one sample interval, k_P dt and −k_I dt. State, prediction and innovations are those of
:mod:`strapdown.kernels.filter`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    combine,
    congruent,
    cross,
    full,
    minus_outer,
    scale,
    skew_polynomial,
    symmetric_minus_outer,
    transpose_times_vector,
)
from strapdown.kernels.filter import WIDTH_OF_ROW, bias_at, judge, load, propagate_row, turn_tangent, write_row
from strapdown.kernels.gate import Options
from strapdown.kernels.iterated_update import IDENTITY, PASSED_OVER
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    KIND,
    frame_of,
    heading_row,
    six_at,
    store_innovations,
    value_of,
)
from strapdown.kernels.rotation import moved, quaternion_multiply, rotation_matrix, unit
from strapdown.kernels.structure import Body as Filter
from strapdown.kernels.walk import step_within, turn_squared

OPEN = ("bias_at", "judge", "load", "propagate_row", "turn_tangent", "write_row")

NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

MAX_VARIANCE = 100.0
"""Maximum trace of the attitude covariance, rad²."""


class Body(NamedTuple):
    """The filter, and its gains. The outputs are those of :mod:`strapdown.kernels.filter`."""

    form: Filter
    options: Options
    """A gate that refuses all, so that :func:`strapdown.kernels.filter.judge` returns innovations only."""
    gains: np.ndarray
    """Gains of attitude and bias (1/s) by sensor (2, sensors)."""
    room: np.ndarray
    """Scratch (2, 6, 6)."""


def begin(body):
    """Return the state of the walk, which is in arrays."""
    return 0 * len(body.gains)


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return step_within(turn_squared(part, dt, bias_at(body.form, 0)), dt)


def predict(state, part, dt, body, out):
    """Propagate."""
    propagate_row(body.form, 0, part, dt)
    return state


def keep(state, row, e, body, out):
    """Write a row."""
    write_row(body.form, row, out)
    return state


def stopped(state):
    """Return false: the walk goes to the end."""
    return state < 0


def finish(state, row, e, body):
    """Return the number of rows."""
    return row


def correct_covariance(P, room, M, V, gain, bias_gain):
    """Replace P by the covariance after a correction with any gains.

    The filter rotates by g ω and changes its bias by κ ω, where to first order ``ω = M δθ + n``, Cov n = V: ``δθ⁺ = (I − g M) δθ − g n``,
    ``δb⁺ = δb − κ (M δθ + n)``. This is Joseph's form ``(I − K H) P (I − K H)ᵀ + K R Kᵀ``, valid for any gain (Gelb 1974, section 4.2).
    """
    left, half = room[0], room[1]
    for i in range(6):
        for j in range(6):
            left[i, j] = 1.0 if i == j else 0.0
    for i, m in enumerate(M):
        left[i // 3, i % 3] -= gain * m
        left[3 + i // 3, i % 3] -= bias_gain * m
    for i in range(6):
        for j in range(6):
            half[i, j] = 0.0
            for k in range(6):
                half[i, j] += left[i, k] * P[WIDTH_OF_ROW * k + j]
    for i in range(6):
        for j in range(i, 6):
            s = 0.0
            for k in range(6):
                s += half[i, k] * left[j, k]
            P[WIDTH_OF_ROW * i + j] = s
    for i, v in enumerate(full(V)):
        a, b = WIDTH_OF_ROW * (i // 3) + i % 3, WIDTH_OF_ROW * (3 + i // 3) + i % 3
        P[a] += gain * gain * v
        P[a + 3] += gain * bias_gain * v
        P[b + 3] += bias_gain * bias_gain * v
    for i in range(6):
        for j in range(i):
            P[WIDTH_OF_ROW * i + j] = P[WIDTH_OF_ROW * j + i]


def limit_covariance(P):
    """If the trace of the attitude's covariance exceeds ``MAX_VARIANCE``, limit its diagonal, and drop the correlations.

    With unsuitable gains the linear error model is unstable, but an attitude error is bounded: a variance of several rad² only means that
    the attitude is unknown, and correlations are then rounding.
    """
    if not P[0] + P[WIDTH_OF_ROW + 1] + P[2 * WIDTH_OF_ROW + 2] < MAX_VARIANCE:
        for i in range(6):
            for j in range(6):
                if i != j:
                    P[WIDTH_OF_ROW * i + j] = 0.0
        for i in range(3):
            P[WIDTH_OF_ROW * i + i] = min(P[WIDTH_OF_ROW * i + i], MAX_VARIANCE / 3.0)


def measured_turn(kind, q, R, z, frame, noise, h, y):
    """Return ω_mes, M (9-tuple) and V (6-tuple) of a measurement, ``ω_mes = M δθ + n`` to first order, Cov n = V; body axes.

    For a direction or vector, ``z × r_b``; for an attitude, the vex of the antisymmetric part of ``R̂ᵀ R``, sin θ about the rotation axis
    (the passive filter of the paper); for a heading, with its row h and error y, the rotation y about the fixed z axis.
    """
    if kind == ATTITUDE:
        d = quaternion_multiply((q[0], -q[1], -q[2], -q[3]), (frame[0], frame[1], frame[2], frame[3]))
        return scale(2.0 * d[0], (d[1], d[2], d[3])), IDENTITY, noise
    if kind == HEADING:
        up = (R[6], R[7], R[8])
        M = minus_outer(NOTHING, scale(-1.0, up), h)
        return scale(y, up), M, symmetric_minus_outer(NOTHING[:6], scale(-noise[0], up), up)
    r_b = transpose_times_vector(R, (frame[6], frame[7], frame[8]))
    # z = r_b + r_b × δθ + v: z × r_b = (I − r_b r_bᵀ) δθ − r_b × v.
    return cross(z, r_b), skew_polynomial(0.0, 0.0, -1.0, r_b), congruent(skew_polynomial(0.0, 1.0, 0.0, r_b), noise)


def update(state, e, now, measured, body, out):
    """Correct attitude and bias with fixed gains."""
    form, x = body.form, body.form.x
    place, sensor = measured.place[e], measured.sensor[e]
    outcome, _, y, s, _ = judge(form.shape[sensor], form, measured, e, body.options, 0.0)
    store_innovations(out.innovation, place, y, s)
    if outcome != PASSED_OVER:
        q = load(form, 0)
        z, R = value_of(measured, place), rotation_matrix(q)
        frame, noise = frame_of(measured, place, sensor), six_at(measured.noise, place)
        turn, M, V = measured_turn(measured.series[sensor, KIND], q, R, z, frame, noise, heading_row(R, z), y[0])
        gain, bias_gain = body.gains[0, sensor], body.gains[1, sensor]
        correct_covariance(form.P[0], body.room, M, V, gain, bias_gain)
        after, G = moved(q, scale(gain, turn))
        turn_tangent(form, 0, q, G)
        limit_covariance(form.P[0])
        for i, value in enumerate((*unit(after), *combine(1.0, bias_at(form, 0), bias_gain, turn))):
            x[0, i] = value
    return state
