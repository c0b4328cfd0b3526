"""One step of the fixed-interval smoother backward in time, on tuples: Rauch–Tung–Striebel on the manifold.

State and error as in :mod:`strapdown.kernels.filter_step`. Each covariance lives in the tangent space at its own attitude, so the
smoothed one of the later time is carried to the predicted attitude before the step, and the result to the smoothed attitude after it.

With ``P⁻ = Φ P Φᵀ + Q`` the smoother's gain ``P Φᵀ P⁻⁻¹`` is written ``Φ⁻¹ N``, ``N = I − M``, ``M = Q P⁻⁻¹``. This is the same
number, but its rounding error is that of M, which is small where P⁻ is ill-conditioned (a diffuse start, one sharp measurement), and
the gain's own would be rounding times the condition number. The covariance follows without a difference of covariances:
``P + C (P_s − P⁻) Cᵀ = Φ⁻¹ {N P_s Nᵀ + N Q} Φ⁻ᵀ``, a sum of two positive parts, for ``N Q = (Q⁻¹ + (Φ P Φᵀ)⁻¹)⁻¹``.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    combine,
    dot,
    full,
    matrix_times_vector,
    multiply,
    multiply_add,
    scale,
    skew_polynomial,
    subtract,
    times_transpose_upper,
    times_transpose_upper_add,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.filter_step import predict, process_noise, transition
from strapdown.kernels.rotation import quaternion_multiply, right_jacobian, turned
from strapdown.kernels.series import LARGEST_ANGLE, polynomial

_A = tuple(math.comb(2 * k, k) / (4.0**k * (2 * k + 1)) for k in range(12))
_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8, _A9, _A10, _A11 = _A
# |B_2k| / (2k)! for k = 1 … 6, with the Bernoulli numbers 1/6, 1/30, 1/42, 1/30, 5/66, 691/2730.
_I0, _I1, _I2 = 1.0 / 12.0, 1.0 / 720.0, 1.0 / 30240.0
_I3, _I4, _I5 = 1.0 / 1209600.0, 1.0 / 47900160.0, 691.0 / 1307674368000.0
_SINE_SQUARED = math.sin(0.5 * LARGEST_ANGLE) ** 2


def arcsine(x):
    """Return asin s / s at s = √x, x ≤ sin²(``LARGEST_ANGLE``/2)."""
    xxx = x * x * x
    return polynomial(x, _A0, _A1, _A2, _A3, _A4, _A5) + xxx * xxx * polynomial(x, _A6, _A7, _A8, _A9, _A10, _A11)


def logarithm(q):
    """Return the rotation vector of a unit quaternion, the shorter way round, any angle."""
    v = (q[1], q[2], q[3])
    x = dot(v, v)
    if x <= _SINE_SQUARED:
        half = arcsine(x)
    else:
        s = math.sqrt(x)
        half = math.atan2(s, abs(q[0])) / s
    return scale(math.copysign(2.0 * half, q[0]), v)


def inverse_right_jacobian(phi):
    """Return ``J_r(φ)⁻¹ = I + ½ [φ] + (1 − (θ/2) cot(θ/2))/θ² [φ]²``, θ = |φ| ≤ π."""
    x = dot(phi, phi)
    if x <= LARGEST_ANGLE * LARGEST_ANGLE:
        quadratic = polynomial(x, _I0, _I1, _I2, _I3, _I4, _I5)
    else:
        half = 0.5 * math.sqrt(x)
        quadratic = (1.0 - half / math.tan(half)) / x
    return skew_polynomial(1.0, 0.5, quadratic, phi)


def moved(q, phi):
    """Return q ⊗ exp(φ) and J_r(φ) at any angle: what the filter does to an attitude and its tangent space, without its bound."""
    x = dot(phi, phi)
    if x <= LARGEST_ANGLE * LARGEST_ANGLE:
        return turned(q, phi), right_jacobian(phi)
    theta = math.sqrt(x)
    s = math.sin(0.5 * theta)
    q = quaternion_multiply(q, (math.cos(0.5 * theta), s / theta * phi[0], s / theta * phi[1], s / theta * phi[2]))
    return q, skew_polynomial(1.0, -2.0 * s * s / x, (theta - math.sin(theta)) / (theta * x), phi)


def factored(S):
    """Return S = L D Lᵀ of a symmetric positive-definite matrix, as (l10, l20, l21, 1/d0, 1/d1, 1/d2)."""
    i0 = 1.0 / S[0]
    l10 = S[1] * i0
    l20 = S[2] * i0
    i1 = 1.0 / (S[3] - l10 * S[1])
    m21 = S[4] - l10 * S[2]
    l21 = m21 * i1
    i2 = 1.0 / (S[5] - l20 * S[2] - l21 * m21)
    return (l10, l20, l21, i0, i1, i2)


def solved(F, v):
    """Return S⁻¹ v from the factors of S."""
    y1 = v[1] - F[0] * v[0]
    y2 = v[2] - F[1] * v[0] - F[2] * y1
    x2 = F[5] * y2
    x1 = F[4] * y1 - F[2] * x2
    return (F[3] * v[0] - F[0] * x1 - F[1] * x2, x1, x2)


def divided(X, F):
    """Return X S⁻¹ of a matrix X, from the factors of S."""
    a0, a1, a2 = solved(F, (X[0], X[1], X[2]))
    b0, b1, b2 = solved(F, (X[3], X[4], X[5]))
    c0, c1, c2 = solved(F, (X[6], X[7], X[8]))
    return (a0, a1, a2, b0, b1, b2, c0, c1, c2)


def subtract_matrices(A, B):
    """Return A − B of two 9-tuples."""
    return (
        A[0] - B[0],
        A[1] - B[1],
        A[2] - B[2],
        A[3] - B[3],
        A[4] - B[4],
        A[5] - B[5],
        A[6] - B[6],
        A[7] - B[7],
        A[8] - B[8],
    )


def subtract_symmetric(S, T):
    """Return S − T of two symmetric matrices."""
    return (S[0] - T[0], S[1] - T[1], S[2] - T[2], S[3] - T[3], S[4] - T[4], S[5] - T[5])


def scale_matrix(s, A):
    """Return s A of a scalar and a 9-tuple."""
    return (s * A[0], s * A[1], s * A[2], s * A[3], s * A[4], s * A[5], s * A[6], s * A[7], s * A[8])


def noise_share(A, B, C, q11, q12, q22):
    """Return the blocks of ``M = Q P⁻⁻¹`` (θθ, θb, bθ, bb): how much of the predicted uncertainty the last step's noise brought.

    P⁻ is (A, B, C). Eliminates the attitude block first: ``P⁻⁻¹`` by the Schur complement ``C − Bᵀ A⁻¹ B``, both 3×3 factored.
    """
    bt = transpose(B)
    F = factored(A)
    K = divided(bt, F)  # Bᵀ A⁻¹
    G = factored(subtract_symmetric(C, times_transpose_upper(K, bt)))
    kt = transpose(K)
    full11 = full(q11)
    q21 = transpose(q12)
    theta_bias = divided(subtract_matrices(q12, multiply(full11, kt)), G)
    theta_theta = subtract_matrices(divided(full11, F), multiply(theta_bias, K))
    remainder = multiply(q21, kt)
    bias_bias = divided(
        (
            q22 - remainder[0],
            -remainder[1],
            -remainder[2],
            -remainder[3],
            q22 - remainder[4],
            -remainder[5],
            -remainder[6],
            -remainder[7],
            q22 - remainder[8],
        ),
        G,
    )
    bias_theta = subtract_matrices(divided(q21, F), multiply(bias_bias, K))
    return theta_theta, theta_bias, bias_theta, bias_bias


def identity_minus(A):
    """Return I − A of a 9-tuple."""
    return (1.0 - A[0], -A[1], -A[2], -A[3], 1.0 - A[4], -A[5], -A[6], -A[7], 1.0 - A[8])


def smooth(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance, next_q, next_b, next_A, next_B, next_C):
    """Return the smoothed state at the start of a segment.

    (q, b, A, B, C) is the filtered state there, ``delta_theta`` and ``dt`` the increment from it, and (next_q, …) the *smoothed* state at
    the end of the segment. The prediction is computed anew, as the filter did it.
    """
    phi = combine(1.0, delta_theta, -dt, b)
    phi11, phi12 = transition(phi, dt)
    q11, q12, q22 = process_noise(phi, dt, angle_variance, rate_variance)
    predicted, A, B, C = predict(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance)
    inverse = (predicted[0], -predicted[1], -predicted[2], -predicted[3])
    # From the tangent space at the smoothed attitude to that at the predicted one: exp(a) ⊗ exp(ε) = exp(a + J_r(a)⁻¹ ε).
    a = logarithm(quaternion_multiply(inverse, next_q))
    d = subtract(next_b, b)
    J = inverse_right_jacobian(a)
    later_A = full(times_transpose_upper(multiply(J, full(next_A)), J))
    later_B = multiply(J, next_B)
    # M holds what of the correction is left to the noise of this step; N = I − M is what goes back to its start.
    m_tt, m_tb, m_bt, m_bb = noise_share(A, B, C, q11, q12, q22)
    n_tt = identity_minus(m_tt)
    n_bb = identity_minus(m_bb)
    n_tb = scale_matrix(-1.0, m_tb)
    n_bt = scale_matrix(-1.0, m_bt)
    theta = add(matrix_times_vector(n_tt, a), matrix_times_vector(n_tb, d))
    bias = add(matrix_times_vector(n_bt, a), matrix_times_vector(n_bb, d))
    bt = transpose(later_B)
    y_tt = multiply_add(n_tt, later_A, multiply(n_tb, bt))
    y_tb = multiply_add(n_tt, later_B, multiply(n_tb, full(next_C)))
    y_bt = multiply_add(n_bt, later_A, multiply(n_bb, bt))
    y_bb = multiply_add(n_bt, later_B, multiply(n_bb, full(next_C)))
    # N P_s Nᵀ + N Q, in the tangent space at the predicted attitude
    nq_tt = times_transpose_upper_add(n_tt, full(q11), times_transpose_upper(n_tb, q12))
    nq_tb = multiply_add(n_tt, q12, scale_matrix(q22, n_tb))
    nq_bb = times_transpose_upper_add(n_bt, transpose(q12), scale_upper(q22, n_bb))
    A = times_transpose_upper_add(y_tt, n_tt, times_transpose_upper_add(y_tb, n_tb, nq_tt))
    B = multiply_add(y_tt, transpose(n_bt), multiply_add(y_tb, transpose(n_bb), nq_tb))
    C = times_transpose_upper_add(y_bt, n_bt, times_transpose_upper_add(y_bb, n_bb, nq_bb))
    # Back by Φ⁻¹ = [[Φ11ᵀ, −Φ11ᵀ Φ12], [0, I]], then to the tangent space at the smoothed attitude.
    correction = transpose_times_vector(phi11, subtract(theta, matrix_times_vector(phi12, bias)))
    minus12 = scale_matrix(-1.0, phi12)
    X = multiply_add(minus12, full(C), B)
    inner = times_transpose_upper_add(minus12, B, times_transpose_upper_add(X, minus12, A))
    q, J = moved(q, correction)
    R = multiply(J, transpose(phi11))
    return q, add(b, bias), times_transpose_upper(multiply(R, full(inner)), R), multiply(R, X), C


def scale_upper(s, A):
    """Return s times the upper triangle of a 9-tuple."""
    return (s * A[0], s * A[1], s * A[2], s * A[4], s * A[5], s * A[8])
