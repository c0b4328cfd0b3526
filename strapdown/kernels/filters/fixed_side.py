"""The MEKF with its attitude error in fixed axes, ``q_true = exp(δφ) ⊗ q``, reset by the left Jacobian: equivalent to the MEKF."""

from __future__ import annotations

from strapdown.kernels.algebra import (
    add,
    add_to_diagonal,
    combine,
    congruent,
    full,
    matrix_times_vector,
    multiply,
    multiply_add,
    times_transpose_upper_add,
    transpose,
)
from strapdown.kernels.filter_step import process_noise, transition
from strapdown.kernels.filters.extended import attitude_turned_axes, negated, turned_in_fixed_axes
from strapdown.kernels.filters.extended import rows_in_fixed_axes as error_rows
from strapdown.kernels.iterated_update import IDENTITY
from strapdown.kernels.rotation import moved, rotation_matrix, turned

__all__ = ["closed", "error_rows", "from_body_side", "propagated", "to_body_side"]


def from_body_side(q, A, B, C):
    """Return the blocks of (δφ, δb), δφ = R δθ."""
    A, B = attitude_turned_axes(rotation_matrix(q), A, B)
    return A, B, C


def to_body_side(q, A, B, C):
    """Return the blocks of (δθ, δb)."""
    A, B = attitude_turned_axes(transpose(rotation_matrix(q)), A, B)
    return A, B, C


def propagated(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Propagate (δφ, δb): ``δφ̇ = −R δb − R n_v``, ``δḃ = n_u``.

    The MEKF of Markley & Crassidis (2014, chapter 6) with its error in the reference frame: Φ11 = I, Φ12 = −∫R dt = −dt R₁ J_r(φ) with
    R₁ at the end; the noise is that of the body side, rotated to fixed axes, ``Q11(R₁φ)`` and ``R₁ Q12(φ)``.
    """
    phi = combine(1.0, delta_theta, -dt, b)
    q = turned(q, phi)
    R = rotation_matrix(q)
    _, body12 = transition(phi, dt)
    phi12 = multiply(R, body12)
    q11, _, q22 = process_noise(matrix_times_vector(R, phi), dt, angle_variance, rate_variance)
    _, q12, _ = process_noise(phi, dt, angle_variance, rate_variance)
    theta_bias = multiply_add(phi12, full(C), B)
    theta_theta = multiply_add(phi12, transpose(B), full(A))
    return (
        q,
        times_transpose_upper_add(theta_theta, IDENTITY, times_transpose_upper_add(theta_bias, phi12, q11)),
        multiply_add(R, q12, theta_bias),
        add_to_diagonal(C, q22),
    )


def closed(q, b, A, B, C, correction, bias_correction):
    """Correct the state by (δφ, δb) and transform the covariance to the new tangent space.

    ``exp(δφ) = exp(δφ⁺) ⊗ exp(a)`` gives ``δφ⁺ = J_l(a) (δφ − a)`` to first order: G = J_l(a), in place of J_r for the body side.
    """
    _, G = moved((1.0, 0.0, 0.0, 0.0), negated(correction))
    return turned_in_fixed_axes(q, correction), add(b, bias_correction), congruent(G, A), multiply(G, B), C
