"""Steps of the filters beside the MEKF, one at a time, on tuples: the same state (q, b, A, B, C), other definitions of the error.

``A``, ``B``, ``C`` are the blocks of the covariance of the error as each filter defines it (R = R_fb of the estimate):

- fixed-side and right-invariant: ``q_true = exp(δφ) ⊗ q``, ``δb = b_true − b``: δφ in fixed axes, δb in body axes;
- two-frame: ``q_true = exp(δφ) ⊗ q``, ``β = R (b_true − b)`` to first order: both in fixed axes;
- geometric: body side, (δθ, η) with ``η = b_true − exp(−[δθ]) b``, carried as (δθ, δb) and sheared where η's b changes.

Rows of a measurement are given in fixed axes, ``y = h · δφ + noise``: there they depend on the reference alone and not on the estimate.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    add_to_diagonal,
    combine,
    cross,
    dot,
    full,
    matrix_times_vector,
    minus_outer,
    multiply,
    multiply_add,
    scale,
    skew_polynomial,
    symmetric_minus_outer,
    symmetric_times_vector,
    times_transpose_upper,
    times_transpose_upper_add,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.family_turns import (
    exponential_of_any_turn,
    process_noise_over_any_turn,
    right_jacobian_of_any_turn,
    transition_over_any_turn,
    turn_coefficients,
    turned_by_any,
)
from strapdown.kernels.rotation import quaternion_multiply, rotation_matrix, unit

LARGEST_CORRECTION = 1.8954942670339809
"""rad; the root of θ = 2 sin θ. The geometric filter takes the bias b to ``exp(−[a]) b − b × a``; across a correction a that is
multiplication by ``e^{−iθ} + iθ``, of magnitude ``√(1 + θ² − 2 θ sin θ)``: above one for any larger turn. There each correction would
enlarge the bias and, by the shear, its variance, which makes room for the next: without end."""


def negated(v):
    """Return −v."""
    return (-v[0], -v[1], -v[2])


def turned_in_fixed_axes(q, phi):
    """Return exp(φ) ⊗ q, of norm one: a turn by φ of any size given in fixed axes."""
    return unit(quaternion_multiply(exponential_of_any_turn(phi), q))


def congruent(M, S):
    """Return the symmetric M S Mᵀ."""
    return times_transpose_upper(multiply(M, full(S)), M)


def predict_body_side(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Propagate (δθ, δb) as :func:`strapdown.kernels.filter_step.predict` does, over a turn of any size."""
    phi = combine(1.0, delta_theta, -dt, b)
    phi11, phi12 = transition_over_any_turn(phi, dt)
    q11, q12, q22 = process_noise_over_any_turn(phi, dt, angle_variance, rate_variance)
    theta_bias = multiply_add(phi11, B, multiply(phi12, full(C)))
    theta_theta = multiply_add(phi11, full(A), multiply(phi12, transpose(B)))
    return (
        turned_by_any(q, phi),
        times_transpose_upper_add(theta_theta, phi11, times_transpose_upper_add(theta_bias, phi12, q11)),
        add_matrices(theta_bias, q12),
        add_to_diagonal(C, q22),
    )


def predict_fixed_side(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Propagate (δφ, δb) over one gyro increment: ``δφ̇ = −R δb − R n_v``, ``δḃ = n_u``.

    The MEKF of Markley & Crassidis (2014, chapter 6) with its error in the reference frame: Φ11 = I, Φ12 = −∫R dt = −dt R₁ J_r(φ) with
    R₁ at the end; the noise is that of the body side seen from fixed axes, ``Q11(R₁φ)`` and ``R₁ Q12(φ)``.
    """
    phi = combine(1.0, delta_theta, -dt, b)
    q = turned_by_any(q, phi)
    R = rotation_matrix(q)
    _, body12 = transition_over_any_turn(phi, dt)
    phi12 = multiply(R, body12)
    q11, _, q22 = process_noise_over_any_turn(matrix_times_vector(R, phi), dt, angle_variance, rate_variance)
    _, q12, _ = process_noise_over_any_turn(phi, dt, angle_variance, rate_variance)
    theta_bias = multiply_add(phi12, full(C), B)
    theta_theta = multiply_add(phi12, transpose(B), full(A))
    identity = skew_polynomial(1.0, 0.0, 0.0, phi)
    return (
        q,
        times_transpose_upper_add(theta_theta, identity, times_transpose_upper_add(theta_bias, phi12, q11)),
        multiply_add(R, q12, theta_bias),
        add_to_diagonal(C, q22),
    )


def predict_two_frame(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Propagate (δφ, β) over one gyro increment: ``δφ̇ = −β − R n_v``, ``β̇ = [w_f] β + R n_u``.

    Two-frames group of Barrau & Bonnabel (2023, The geometry of navigation problems), right-invariant error. With φ_f = R φ:
    Φ11 = I, Φ12 = −dt J_l(φ_f), Φ22 = exp([φ_f]); the noise is isotropic in fixed axes.
    """
    phi = combine(1.0, delta_theta, -dt, b)
    q = turned_by_any(q, phi)
    phi_f = matrix_times_vector(rotation_matrix(q), phi)
    phi22, phi12 = transition_over_any_turn(negated(phi_f), dt)
    q11, q12, q22 = process_noise_over_any_turn(phi_f, dt, angle_variance, rate_variance)
    theta_bias = multiply_add(phi12, full(C), B)
    theta_theta = multiply_add(phi12, transpose(B), full(A))
    identity = skew_polynomial(1.0, 0.0, 0.0, phi)
    return (
        q,
        times_transpose_upper_add(theta_theta, identity, times_transpose_upper_add(theta_bias, phi12, q11)),
        add_matrices(multiply(theta_bias, transpose(phi22)), q12),
        add_to_diagonal(congruent(phi22, C), q22),
    )


def take_row(a, c, A, B, C, h, y, variance):
    """Take in one scalar row ``y = h · (attitude error) + v``, Var v = ``variance``, where rows before it have corrected by (a, c).

    Returns (a, c, A, B, C, innovation, its variance). Joseph's form ``(I − k hᵀ) P (I − k hᵀ)ᵀ + r k kᵀ``, written as the short form plus
    its rounding error on the attitude side, ``d = (P − k p) h − r k``.
    """
    pa = symmetric_times_vector(A, h)
    pb = transpose_times_vector(B, h)
    s = dot(h, pa) + variance
    ka = scale(1.0 / s, pa)
    kb = scale(1.0 / s, pb)
    innovation = y - dot(h, a)
    short = symmetric_minus_outer(A, ka, pa)
    d = combine(1.0, symmetric_times_vector(short, h), -variance, ka)
    return (
        combine(1.0, a, innovation, ka),
        combine(1.0, c, innovation, kb),
        symmetric_minus_outer(short, d, ka),
        minus_outer(minus_outer(B, ka, pb), d, kb),
        symmetric_minus_outer(C, kb, pb),
        innovation,
        s,
    )


def close_fixed_side(q, b, A, B, correction, bias_correction):
    """Move the state by a correction of (δφ, δb) and carry the covariance to the new tangent space.

    ``exp(δφ) = exp(δφ⁺) ⊗ exp(a)`` gives ``δφ⁺ = J_l(a) (δφ − a)`` to first order: G = J_l(a), the mirror image of the body side's J_r.
    """
    G = right_jacobian_of_any_turn(negated(correction))
    return turned_in_fixed_axes(q, correction), add(b, bias_correction), congruent(G, A), multiply(G, B)


def close_right_invariant(q, b, correction, bias_correction):
    """Move the state by a correction of (δφ, δb) and leave the covariance, as invariant filters do (Barrau & Bonnabel 2017)."""
    return turned_in_fixed_axes(q, correction), add(b, bias_correction)


def close_two_frame(q, b, correction, bias_correction):
    """Move the state by the group exponential of a correction (a, c) of (δφ, β), ``χ⁺ = exp(a, c) • χ``; the covariance stays.

    Of the group law (R₁, b₁) • (R₂, b₂) = (R₁R₂, b₂ + R₂ᵀ b₁) the exponential is (exp a, J_r(a) c): ``b⁺ = b + Rᵀ J_r(a) c``.
    """
    moved = matrix_times_vector(right_jacobian_of_any_turn(correction), bias_correction)
    return turned_in_fixed_axes(q, correction), add(b, transpose_times_vector(rotation_matrix(q), moved))


def close_geometric(q, b, A, B, C, correction, bias_correction):
    """Move the state by a correction of (δθ, δb) and carry the covariance, as a filter of (δθ, η), η = δb − [b] δθ, does.

    Its own correction is (a, c − [b] a) and moves the bias to ``b⁺ = exp(−[a]) b + c − b × a``; the covariance of (δθ, η) stays (Andrle &
    Crassidis 2015). Seen in (δθ, δb) that is one shear by [b⁺ − b]: going to η and back would cost the digits of a bias variance that is
    small beside b² times that of the attitude. A correction of more than ``LARGEST_CORRECTION`` is shortened to it, its bias in proportion.
    """
    squared = dot(correction, correction)
    if squared > LARGEST_CORRECTION * LARGEST_CORRECTION:
        shorter = LARGEST_CORRECTION / math.sqrt(squared)
        correction, bias_correction = scale(shorter, correction), scale(shorter, bias_correction)
    s, c, _, _, _ = turn_coefficients(dot(correction, correction))
    turn = cross(correction, b)
    moved = add(bias_correction, combine(1.0 - s, turn, c, cross(correction, turn)))
    B, C = sheared(A, B, C, skew_polynomial(0.0, 1.0, 0.0, moved))
    return turned_by_any(q, correction), add(b, moved), B, C


def sheared(A, B, C, X):
    """Return the blocks of the covariance of (x, y + X x) of those of (x, y)."""
    AX = multiply(full(A), transpose(X))
    S = times_transpose_upper_add(X, transpose(AX), C)
    XB = multiply(X, B)
    return (
        add_matrices(B, AX),
        (
            S[0] + 2.0 * XB[0],
            S[1] + (XB[1] + XB[3]),
            S[2] + (XB[2] + XB[6]),
            S[3] + 2.0 * XB[4],
            S[4] + (XB[5] + XB[7]),
            S[5] + 2.0 * XB[8],
        ),
    )


def attitude_turned_axes(M, A, B):
    """Return blocks A and B with the attitude error taken to other axes by the rotation M."""
    return congruent(M, A), multiply(M, B)


def bias_turned_axes(M, B, C):
    """Return blocks B and C with the bias error taken to other axes by the rotation M."""
    return multiply(B, transpose(M)), congruent(M, C)
