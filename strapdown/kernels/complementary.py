"""The complementary filter of Mahony, Hamel & Pflimlin (2008), with the covariance for its gains: a body of :mod:`strapdown.kernels.walk`.

Each measurement rotates the attitude by the sensor's gain times ``ω_mes = z × R̂ᵀ r`` and changes the bias by its bias gain times ω_mes:
equations (32) of the paper over one sample interval, k_P dt and −k_I dt.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from strapdown.kernels.algebra import (
    combine,
    combine_matrices,
    congruent,
    cross,
    dot,
    factored,
    full,
    minus_outer,
    multiply,
    scale,
    skew_polynomial,
    symmetric_minus_outer,
    symmetric_times_vector,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import predict as propagated
from strapdown.kernels.iterated_update import IDENTITY
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    KIND,
    frame_of,
    has_heading,
    independent_rows,
    measurement_rows,
    noise_of,
    store_innovations,
    value_of,
)
from strapdown.kernels.rotation import moved, quaternion_multiply, rotation_matrix, unit
from strapdown.kernels.state import load_state, store_state
from strapdown.kernels.walk import step_within, turn_squared

NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

MAX_VARIANCE = 100.0
"""Maximum trace of the attitude covariance, rad²."""


class Body(NamedTuple):
    """State, noise and gains of the filter."""

    state: np.ndarray
    """Packed state (28,); at return, the end state."""
    angle_variance: float
    """σ_v², rad²/s."""
    rate_variance: float
    """σ_u², rad²/s³."""
    gains: np.ndarray
    """Gains of attitude and bias (1/s) by sensor (2, sensors)."""


class Outputs(NamedTuple):
    """Output arrays."""

    states: np.ndarray
    """Packed states (rows, 28)."""
    innovation: np.ndarray
    """(events, 6) by place."""


def begin(body):
    """Return (q, b, A, B, C)."""
    return load_state(body.state)


def longest_step(state, part, dt, body):
    """Return the longest step, s."""
    return step_within(turn_squared(part, dt, state[1]), dt)


def predict(state, part, dt, body, out):
    """Propagate."""
    q, b, A, B, C = state
    q, A, B, C = propagated(q, b, A, B, C, part, dt, body.angle_variance, body.rate_variance)
    return q, b, A, B, C


def keep(state, row, e, body, out):
    """Write a row."""
    q, b, A, B, C = state
    store_state(out.states[row], q, b, A, B, C)
    return state


def finish(state, row, e, body):
    """Store the end state."""
    q, b, A, B, C = state
    store_state(body.state, q, b, A, B, C)
    return row


def held(A):
    """Return the diagonal of A, each number at most a third of ``MAX_VARIANCE``.

    With unsuitable gains the linear error model is unstable, but an attitude error is bounded: a variance of several rad² only means that
    the attitude is unknown, and correlations are then rounding.
    """
    most = MAX_VARIANCE / 3.0
    return (min(A[0], most), 0.0, 0.0, min(A[3], most), 0.0, min(A[5], most))


def corrected_covariance(A, B, C, M, V, gain, bias_gain):
    """Return the blocks of the covariance after a correction with any gains.

    The filter rotates by g ω and changes its bias by κ ω, where to first order ``ω = M δθ + n``, Cov n = V: ``δθ⁺ = (I − g M) δθ − g n``,
    ``δb⁺ = δb − κ (M δθ + n)``. This is Joseph's form ``(I − K H) P (I − K H)ᵀ + K R Kᵀ``, valid for any gain (Gelb 1974, section 4.2).
    """
    noise = full(V)
    left = combine_matrices(1.0, IDENTITY, -gain, M)
    reduced = combine_matrices(1.0, B, -bias_gain, multiply(full(A), transpose(M)))
    MB = multiply(M, B)
    twice = (2.0 * MB[0], MB[1] + MB[3], MB[2] + MB[6], 2.0 * MB[4], MB[5] + MB[7], 2.0 * MB[8])
    shown = combine_matrices(1.0, congruent(M, A), 1.0, V)
    return (
        combine_matrices(1.0, congruent(left, A), gain * gain, V),
        combine_matrices(1.0, multiply(left, reduced), gain * bias_gain, noise),
        combine_matrices(1.0, combine_matrices(1.0, C, -bias_gain, twice), bias_gain * bias_gain, shown),
    )


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
    q, b, A, B, C = state
    place = measured.place[e]
    sensor = measured.sensor[e]
    kind = measured.series[sensor, KIND]
    z = value_of(measured, place, sensor)
    R = rotation_matrix(q)
    e1, s1, e2, s2, e3, s3 = math.nan, 0.0, 0.0, 1.0, 0.0, 1.0
    if kind != HEADING or has_heading(R, z):
        frame = frame_of(measured, place, sensor)
        noise = noise_of(measured, place, sensor, kind, z)
        h1, h2, h3, y1, y2, y3, covariance = measurement_rows(kind, q, R, z, frame, noise)
        turn, M, V = measured_turn(kind, q, R, z, frame, noise, h1, y1)
        h1, h2, h3, e1, y2, y3, variance = independent_rows(h1, h2, h3, y1, y2, y3, covariance)
        # Innovations decorrelated: each minus its regression on those before it.
        F = innovation_factors(A, h1, h2, h3, variance)
        e2 = y2 - F[0] * e1
        e3 = y3 - F[1] * e1 - F[2] * e2
        s1, s2, s3 = 1.0 / F[3], 1.0 / F[4], 1.0 / F[5]
        gain = body.gains[0, sensor]
        bias_gain = body.gains[1, sensor]
        A, B, C = corrected_covariance(A, B, C, M, V, gain, bias_gain)
        b = combine(1.0, b, bias_gain, turn)
        q, G = moved(q, scale(gain, turn))
        q = unit(q)
        A, B = congruent(G, A), multiply(G, B)
        if not A[0] + A[3] + A[5] < MAX_VARIANCE:
            A, B, C = held(A), NOTHING, (C[0], 0.0, 0.0, C[3], 0.0, C[5])
    store_innovations(out.innovation, place, (e1, e2, e3), (s1, s2, s3))
    return q, b, A, B, C


def innovation_factors(A, h1, h2, h3, variance):
    """Return the factors of S = H P Hᵀ + D (:func:`strapdown.kernels.algebra.factored`)."""
    p1 = symmetric_times_vector(A, h1)
    p2 = symmetric_times_vector(A, h2)
    p3 = symmetric_times_vector(A, h3)
    return factored(
        (
            dot(h1, p1) + variance[0],
            dot(h1, p2),
            dot(h1, p3),
            dot(h2, p2) + variance[1],
            dot(h2, p3),
            dot(h3, p3) + variance[2],
        )
    )
