"""One step of the fixed-interval smoother backward in time, on tuples: Rauch–Tung–Striebel on the manifold.

State and error as in :mod:`strapdown.kernels.filter_step`. The smoother estimates the *error* of the filtered state, (ε, β) = (Log(q⁻¹ ⊗
q_s), b_s − b), with its covariance in the tangent space at the filtered attitude. The gain G and the covariance D below then depend only on
the filter and are computed for many segments at once; the recursion itself is ``(ε, β) ← G (a, d)``, ``P_s ← (G J) P_s (G J)ᵀ + D``. Here
(a, d) is the smoothed error at the end of the segment relative to the *predicted* state: with r the rotation and δb the change of bias by
the filter's updates there, ``a = Log(r ⊗ exp(ε))``, ``d = δb + β``, and J = J_r(a)⁻¹ J_r(ε) transforms the tangent space: exp(a) ⊗ exp(η) =
exp(a + J_r(a)⁻¹ η). Without a measurement there, a = ε and J = I.

**The gain.** With ``P⁻ = Φ P Φᵀ + Q`` the textbook form is ``P Φᵀ P⁻⁻¹``. With the noise referred to the start of the segment, ``Q̄ = Φ⁻¹ Q
Φ⁻ᵀ`` (the Q of a step back in time), it is ``G = N Φ⁻¹``, ``N = I − M``, ``M = Q̄ (P + Q̄)⁻¹``. The value is the same, but no prediction is
needed, and its rounding error is that of M. This is small if P is ill-conditioned (diffuse start, one precise measurement), whereas that
of the textbook form is rounding times the condition number. The covariance needs no difference of covariances:
``P + G (P_s − P⁻) Gᵀ = G P_s Gᵀ + D``, a sum of two positive parts, for ``D = N Q̄ = (Q̄⁻¹ + P⁻¹)⁻¹``.
"""

from __future__ import annotations

from strapdown.kernels.algebra import (
    add_matrices,
    add_to_diagonal,
    divided,
    factored,
    full,
    minus_times_transpose_upper,
    multiply,
    multiply_add,
    scale,
    scale_matrix,
    times_transpose_upper,
    times_transpose_upper_add,
    transpose,
)
from strapdown.kernels.filter_step import process_noise, transition


def minus_product(S, A, B):
    """Return S − A B of 9-tuples, summed so that every product fuses with a subtraction."""
    return tuple(
        ((S[i + j] - A[i] * B[j]) - A[i + 1] * B[j + 3]) - A[i + 2] * B[j + 6] for i in (0, 3, 6) for j in range(3)
    )


def noise_share(A, B, C, q11, q12, q22):
    """Return the blocks of ``M = Q W⁻¹`` (θθ, θb, bθ, bb): the share of the noise Q in the covariance W = P + Q.

    W is (A, B, C). Eliminates the attitude block first: ``W⁻¹`` by the Schur complement ``C − Bᵀ A⁻¹ B``, both 3×3 factored.
    """
    bt = transpose(B)
    F = factored(A)
    K = divided(bt, F)  # Bᵀ A⁻¹
    G = factored(minus_times_transpose_upper(C, K, bt))
    kt = transpose(K)
    full11 = full(q11)
    q21 = transpose(q12)
    theta_bias = divided(minus_product(q12, full11, kt), G)
    theta_theta = minus_product(divided(full11, F), theta_bias, K)
    bias_bias = divided(minus_product((q22, 0.0, 0.0, 0.0, q22, 0.0, 0.0, 0.0, q22), q21, kt), G)
    bias_theta = minus_product(divided(q21, F), bias_bias, K)
    return theta_theta, theta_bias, bias_theta, bias_bias


def identity_minus(A):
    """Return I − A of a 9-tuple."""
    return (1.0 - A[0], -A[1], -A[2], -A[3], 1.0 - A[4], -A[5], -A[6], -A[7], 1.0 - A[8])


def scale_upper(s, A):
    """Return s times the upper triangle of a 9-tuple."""
    return (s * A[0], s * A[1], s * A[2], s * A[4], s * A[5], s * A[8])


def step_noise(phi, dt, angle_variance, rate_variance):
    """Return Q̄ = Φ⁻¹ Q Φ⁻ᵀ over a rotation φ = ω dt (Q̄11, Q̄12, diagonal of Q̄22): the Q of the same rotation back in time."""
    return process_noise(scale(-1.0, phi), -dt, -angle_variance, -rate_variance)


def kept_share(A, B, C, q11, q12, q22):
    """Return the blocks of N = I − M, M = Q̄ (P + Q̄)⁻¹: share of a correction due to the state (A, B, C), not the noise Q̄."""
    W = add_matrices(A, q11), add_matrices(B, q12), add_to_diagonal(C, q22)
    m_tt, m_tb, m_bt, m_bb = noise_share(*W, q11, q12, q22)
    return identity_minus(m_tt), scale_matrix(-1.0, m_tb), scale_matrix(-1.0, m_bt), identity_minus(m_bb)


def gain(N, phi, dt):
    """Return the blocks of G = N Φ⁻¹ (θθ, θb, bθ, bb) over a rotation φ = ω dt; Φ⁻¹ is the transition back in time."""
    n_tt, n_tb, n_bt, n_bb = N
    r, s = transition(scale(-1.0, phi), -dt)
    return multiply(n_tt, r), multiply_add(n_tt, s, n_tb), multiply(n_bt, r), multiply_add(n_bt, s, n_bb)


def left_noise(N, q11, q12, q22):
    """Return D = N Q̄ (upper triangle, θb, upper triangle)."""
    n_tt, n_tb, n_bt, n_bb = N
    return (
        times_transpose_upper_add(n_tt, full(q11), times_transpose_upper(n_tb, q12)),
        multiply_add(n_tt, q12, scale_matrix(q22, n_tb)),
        times_transpose_upper_add(n_bt, transpose(q12), scale_upper(q22, n_bb)),
    )
