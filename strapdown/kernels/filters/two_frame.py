"""The right-invariant filter of the two-frames group (Barrau & Bonnabel 2023, The geometry of navigation problems).

``q_true = exp(δφ) ⊗ q``, ``β = R (b_true − b)`` to first order: both errors in fixed axes.
"""

from __future__ import annotations

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    add_to_diagonal,
    combine,
    congruent,
    full,
    matrix_times_vector,
    multiply,
    multiply_add,
    times_transpose_upper_add,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import process_noise, transition
from strapdown.kernels.filters.extended import (
    attitude_turned_axes,
    bias_turned_axes,
    negated,
    turned_in_fixed_axes,
)
from strapdown.kernels.filters.extended import rows_in_fixed_axes as error_rows
from strapdown.kernels.iterated_update import IDENTITY
from strapdown.kernels.rotation import moved, rotation_matrix, turned

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "to_body_side"]


def from_body_side(q, A, B, C):
    """Return the blocks of (δφ, β)."""
    R = rotation_matrix(q)
    A, B = attitude_turned_axes(R, A, B)
    B, C = bias_turned_axes(R, B, C)
    return A, B, C


def to_body_side(q, A, B, C):
    """Return the blocks of (δθ, δb)."""
    R = transpose(rotation_matrix(q))
    A, B = attitude_turned_axes(R, A, B)
    B, C = bias_turned_axes(R, B, C)
    return A, B, C


def propagated(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Propagate (δφ, β): ``δφ̇ = −β − R n_v``, ``β̇ = [w_f] β + R n_u``.

    With φ_f = R φ: Φ11 = I, Φ12 = −dt J_l(φ_f), Φ22 = exp([φ_f]); the noise is isotropic in fixed axes.
    """
    phi = combine(1.0, delta_theta, -dt, b)
    q = turned(q, phi)
    phi_f = matrix_times_vector(rotation_matrix(q), phi)
    phi22, phi12 = transition(negated(phi_f), dt)
    q11, q12, q22 = process_noise(phi_f, dt, angle_variance, rate_variance)
    theta_bias = multiply_add(phi12, full(C), B)
    theta_theta = multiply_add(phi12, transpose(B), full(A))
    return (
        q,
        times_transpose_upper_add(theta_theta, IDENTITY, times_transpose_upper_add(theta_bias, phi12, q11)),
        add_matrices(multiply(theta_bias, transpose(phi22)), q12),
        add_to_diagonal(congruent(phi22, C), q22),
    )


def closed(q, b, A, B, C, correction, bias_correction):
    """Correct the state by the group exponential of (a, c), ``χ⁺ = exp(a, c) • χ``; the covariance is unchanged.

    For the group law (R₁, b₁) • (R₂, b₂) = (R₁R₂, b₂ + R₂ᵀ b₁) the exponential is (exp a, J_r(a) c): ``b⁺ = b + Rᵀ J_r(a) c``.
    """
    _, J = moved((1.0, 0.0, 0.0, 0.0), correction)
    step = transpose_times_vector(rotation_matrix(q), matrix_times_vector(J, bias_correction))
    return turned_in_fixed_axes(q, correction), add(b, step), A, B, C
