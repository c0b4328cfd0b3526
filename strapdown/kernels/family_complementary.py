"""The complementary filter of Mahony, Hamel & Pflimlin (2008) over whole records, with the covariance that its own gains give."""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    combine_matrices,
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
from strapdown.kernels.family_step import congruent, negated, predict_body_side
from strapdown.kernels.family_turns import right_jacobian_of_any_turn, turned_by_any
from strapdown.kernels.measurement import (
    ATTITUDE,
    HEADING,
    frame_at,
    has_heading,
    independent_rows,
    measurement_rows,
    six_at,
    vector_at,
)
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix
from strapdown.kernels.state import load_state, store_state

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

MOST_VARIANCE = 100.0
"""Of the attitude, all axes, rad²."""


def held(A):
    """Return the diagonal of A, each number at most a third of ``MOST_VARIANCE``.

    Gains that do not fit what is seen make the linear theory of the errors unstable. An attitude's error is bounded: beyond some radians
    it only says that nothing is known, and what it says of correlations is rounding.
    """
    most = MOST_VARIANCE / 3.0
    return (min(A[0], most), 0.0, 0.0, min(A[3], most), 0.0, min(A[5], most))


def combine_symmetric(s, A, t, B):
    """Return s A + t B of two symmetric matrices."""
    return (
        s * A[0] + t * B[0],
        s * A[1] + t * B[1],
        s * A[2] + t * B[2],
        s * A[3] + t * B[3],
        s * A[4] + t * B[4],
        s * A[5] + t * B[5],
    )


def corrected_covariance(A, B, C, M, V, gain, bias_gain):
    """Return the blocks of the covariance after a correction with gains of any size, not only Kalman's.

    The filter turns by g ω and moves its bias by κ ω, where to first order ``ω = M δθ + n``, Cov n = V: ``δθ⁺ = (I − g M) δθ − g n``,
    ``δb⁺ = δb − κ (M δθ + n)``. That is Joseph's form ``(I − K H) P (I − K H)ᵀ + K R Kᵀ``, which holds for any gain (Gelb 1974, section
    4.2).
    """
    noise = full(V)
    left = combine_matrices(1.0, IDENTITY, -gain, M)
    reduced = combine_matrices(1.0, B, -bias_gain, multiply(full(A), transpose(M)))
    MB = multiply(M, B)
    twice = (2.0 * MB[0], MB[1] + MB[3], MB[2] + MB[6], 2.0 * MB[4], MB[5] + MB[7], 2.0 * MB[8])
    shown = combine_symmetric(1.0, congruent(M, A), 1.0, V)
    return (
        combine_symmetric(1.0, congruent(left, A), gain * gain, V),
        combine_matrices(1.0, multiply(left, reduced), gain * bias_gain, noise),
        combine_symmetric(1.0, combine_symmetric(1.0, C, -bias_gain, twice), bias_gain * bias_gain, shown),
    )


def measured_turn(kind, q, R, z, frame, noise, h, y):
    """Return ω_mes, M (9-tuple) and V (6-tuple) of a measurement, ``ω_mes = M δθ + n`` to first order, Cov n = V; body axes.

    Of a direction or vector ``z × r_b``; of an attitude the vex of the antisymmetric part of ``R̂ᵀ R``, sin θ about the axis of the turn
    (the passive filter of the paper); of a heading, with its row h and error y, the turn y about the fixed z axis.
    """
    if kind == ATTITUDE:
        d = quaternion_multiply((q[0], -q[1], -q[2], -q[3]), (frame[0], frame[1], frame[2], frame[3]))
        return scale(2.0 * d[0], (d[1], d[2], d[3])), IDENTITY, noise
    if kind == HEADING:
        up = (R[6], R[7], R[8])
        M = minus_outer(NOTHING, negated(up), h)
        return scale(y, up), M, symmetric_minus_outer(NOTHING[:6], scale(-noise[0], up), up)
    r_b = transpose_times_vector(R, (frame[6], frame[7], frame[8]))
    # z = r_b + r_b × δθ + v: z × r_b = (I − r_b r_bᵀ) δθ − r_b × v.
    return cross(z, r_b), skew_polynomial(0.0, 0.0, -1.0, r_b), congruent(skew_polynomial(0.0, 1.0, 0.0, r_b), noise)


def run_complementary(
    dt,
    increment,
    event,
    row,
    angle_variance,
    rate_variance,
    event_kind,
    event_value,
    event_noise,
    event_reference,
    event_sensor,
    triads,
    gain,
    bias_gain,
    state,
    state_out,
    innovation_out,
):
    """Run the filter over the steps of a record; ``gain`` and ``bias_gain`` (1/s) hold one number a sensor.

    ``ω_mes = z × R̂ᵀ r`` of each measurement turns the attitude by ``gain`` ω_mes and moves the bias by ``bias_gain`` ω_mes: equations (32)
    of the paper over the interval of one sample, k_P dt and −k_I dt. What ω_mes is of other kinds, :func:`measured_turn` says.
    """
    q, b, A, B, C = load_state(state)
    for k in range(len(dt)):
        if dt[k] > 0.0:
            q, A, B, C = predict_body_side(q, b, A, B, C, vector_at(increment, k), dt[k], angle_variance, rate_variance)
        e = event[k]
        if e >= 0:
            R = rotation_matrix(q)
            z = vector_at(event_value, e)
            kind = event_kind[e]
            e1, s1, e2, s2, e3, s3 = math.nan, 0.0, 0.0, 1.0, 0.0, 1.0
            if kind != HEADING or has_heading(R, z):
                frame = frame_at(triads, event_reference[e])
                noise = six_at(event_noise, e)
                h1, h2, h3, y1, y2, y3, covariance = measurement_rows(kind, q, R, z, frame, noise)
                turn, M, V = measured_turn(kind, q, R, z, frame, noise, h1, y1)
                h1, h2, h3, e1, y2, y3, variance = independent_rows(h1, h2, h3, y1, y2, y3, covariance)
                # Innovations of this filter, made independent: each less its regression on the ones before it.
                p1 = symmetric_times_vector(A, h1)
                p2 = symmetric_times_vector(A, h2)
                p3 = symmetric_times_vector(A, h3)
                F = factored(
                    (
                        dot(h1, p1) + variance[0],
                        dot(h1, p2),
                        dot(h1, p3),
                        dot(h2, p2) + variance[1],
                        dot(h2, p3),
                        dot(h3, p3) + variance[2],
                    )
                )
                e2 = y2 - F[0] * e1
                e3 = y3 - F[1] * e1 - F[2] * e2
                s1, s2, s3 = 1.0 / F[3], 1.0 / F[4], 1.0 / F[5]
                g = gain[event_sensor[e]]
                kappa = bias_gain[event_sensor[e]]
                A, B, C = corrected_covariance(A, B, C, M, V, g, kappa)
                b = (b[0] + kappa * turn[0], b[1] + kappa * turn[1], b[2] + kappa * turn[2])
                correction = scale(g, turn)
                G = right_jacobian_of_any_turn(correction)
                q = turned_by_any(q, correction)
                A, B = congruent(G, A), multiply(G, B)
                if not A[0] + A[3] + A[5] < MOST_VARIANCE:
                    A, B, C = held(A), NOTHING, (C[0], 0.0, 0.0, C[3], 0.0, C[5])
            innovation_out[e, 0], innovation_out[e, 1] = e1, s1
            innovation_out[e, 2], innovation_out[e, 3] = e2, s2
            innovation_out[e, 4], innovation_out[e, 5] = e3, s3
        if row[k] >= 0:
            store_state(state_out[row[k]], q, b, A, B, C)
