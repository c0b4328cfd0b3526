"""The complementary filter of Mahony, Hamel & Pflimlin (2008) over whole records, with the covariance that its own gains give."""

from __future__ import annotations

from strapdown.kernels.algebra import (
    cross,
    dot,
    full,
    multiply,
    scale,
    skew_polynomial,
    symmetric_times_vector,
    times_transpose_upper,
    transpose_times_vector,
)
from strapdown.kernels.family_loop import state_at
from strapdown.kernels.family_step import congruent, negated, predict_body_side
from strapdown.kernels.family_turns import right_jacobian_of_any_turn, turned_by_any
from strapdown.kernels.filter_loop import HEADING, VECTOR, heading_error, store_state, vector_at
from strapdown.kernels.rotation import rotation_matrix


def combine_matrices(s, A, t, B):
    """Return s A + t B of two 3×3 matrices."""
    return (
        s * A[0] + t * B[0],
        s * A[1] + t * B[1],
        s * A[2] + t * B[2],
        s * A[3] + t * B[3],
        s * A[4] + t * B[4],
        s * A[5] + t * B[5],
        s * A[6] + t * B[6],
        s * A[7] + t * B[7],
        s * A[8] + t * B[8],
    )


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


def corrected_covariance(A, B, C, M, gain, bias_gain, variance):
    """Return the blocks of the covariance after a correction with gains of any size, not only Kalman's.

    With M the projector on the axes that the measurement shows, ``δθ⁺ = (I − g M) δθ − g n``, ``δb⁺ = δb − κ (M δθ + n)`` and
    Cov n = σ² M: Joseph's form ``(I − K H) P (I − K H)ᵀ + K R Kᵀ``, which holds for any gain (Gelb 1974, section 4.2).
    """
    projector = full(M)
    left = combine_matrices(1.0, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), -gain, projector)
    reduced = combine_matrices(1.0, B, -bias_gain, multiply(full(A), projector))
    MB = multiply(projector, B)
    twice = (2.0 * MB[0], MB[1] + MB[3], MB[2] + MB[6], 2.0 * MB[4], MB[5] + MB[7], 2.0 * MB[8])
    shown = combine_symmetric(1.0, congruent(projector, A), variance, M)
    return (
        combine_symmetric(1.0, congruent(left, A), gain * gain * variance, M),
        combine_matrices(1.0, multiply(left, reduced), gain * bias_gain * variance, projector),
        combine_symmetric(1.0, combine_symmetric(1.0, C, -bias_gain, twice), bias_gain * bias_gain, shown),
    )


def run_complementary(
    dt,
    increment,
    event,
    row,
    angle_variance,
    rate_variance,
    event_kind,
    event_value,
    event_variance,
    event_reference,
    triads,
    gain,
    bias_gain,
    state,
    state_out,
    innovation_out,
):
    """Run the filter over the steps of a record; ``gain`` and ``bias_gain`` (1/s) hold one number a sensor.

    ``ω_mes = z × R̂ᵀ r`` of each measurement turns the attitude by ``gain`` ω_mes and moves the bias by ``bias_gain`` ω_mes: equations (32)
    of the paper over the interval of one sample, k_P dt and −k_I dt. A heading enters as the turn about the fixed z axis.
    """
    q, b, A, B, C = state_at(state)
    for k in range(len(dt)):
        if dt[k] > 0.0:
            q, A, B, C = predict_body_side(q, b, A, B, C, vector_at(increment, k), dt[k], angle_variance, rate_variance)
        e = event[k]
        if e >= 0:
            R = rotation_matrix(q)
            z = vector_at(event_value, e)
            t = event_reference[e]
            r = (triads[t, 6], triads[t, 7], triads[t, 8])
            variance = event_variance[e]
            if event_kind[e] == HEADING:
                h1 = (R[6], R[7], R[8])
                y1 = heading_error(R, z, r)
                turn = scale(y1, h1)
                M = (h1[0] * h1[0], h1[0] * h1[1], h1[0] * h1[2], h1[1] * h1[1], h1[1] * h1[2], h1[2] * h1[2])
                e2, s2 = 0.0, 1.0
                s1 = dot(h1, symmetric_times_vector(A, h1)) + variance
            else:
                r_b = transpose_times_vector(R, r)
                h1 = negated(transpose_times_vector(R, (triads[t, 3], triads[t, 4], triads[t, 5])))
                h2 = transpose_times_vector(R, (triads[t, 0], triads[t, 1], triads[t, 2]))
                turn = cross(z, r_b)
                across = skew_polynomial(0.0, 1.0, 0.0, r_b)
                M = times_transpose_upper(across, across)
                # Innovations of this filter, made independent: the second less its regression on the first.
                y1 = dot(h2, z)
                p1 = symmetric_times_vector(A, h1)
                s1 = dot(h1, p1) + variance
                slope = dot(h2, p1) / s1
                e2 = -dot(h1, z) - slope * y1
                s2 = dot(h2, symmetric_times_vector(A, h2)) + variance - slope * slope * s1
                if event_kind[e] == VECTOR:
                    innovation_out[e, 4], innovation_out[e, 5] = dot(r_b, z) - 1.0, variance
            innovation_out[e, 0], innovation_out[e, 1] = y1, s1
            innovation_out[e, 2], innovation_out[e, 3] = e2, s2
            g = gain[t]
            kappa = bias_gain[t]
            A, B, C = corrected_covariance(A, B, C, M, g, kappa, variance)
            b = (b[0] + kappa * turn[0], b[1] + kappa * turn[1], b[2] + kappa * turn[2])
            correction = scale(g, turn)
            G = right_jacobian_of_any_turn(correction)
            q = turned_by_any(q, correction)
            A, B = congruent(G, A), multiply(G, B)
        if row[k] >= 0:
            store_state(state_out[row[k]], q, b, A, B, C)
