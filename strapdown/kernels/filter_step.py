"""The multiplicative extended Kalman filter, one step at a time, on tuples.

State: attitude ``q_fb``, gyro bias ``b`` (rad/s) and the covariance ``P`` of the error (δθ, δb) in three blocks: ``A`` = P_θθ (6-tuple),
``B`` = P_θb (9-tuple), ``C`` = P_bb (6-tuple). The error is body side, ``q_true = q ⊗ exp(δθ)``, ``δb = b_true − b``.

A measurement of any kind is processed as scalar rows ``y = h · δθ + noise``. The rows of one measurement share a correction: the innovation
of each row is reduced by the corrections of the rows before it, and attitude update and covariance reset follow once, at the end.

Every function takes floats or lanes (:mod:`strapdown.kernels.lane_values`). If runs in one group of lanes need different forms of a
formula, both are computed and selected by lane, so the bits of a run do not depend on its neighbours.
"""

from __future__ import annotations

from strapdown.kernels.algebra import (
    add,
    add_matrices,
    add_to_diagonal,
    combine,
    congruent,
    dot,
    full,
    minus_outer,
    multiply,
    multiply_add,
    scale,
    skew_polynomial,
    symmetric_minus_outer,
    symmetric_times_vector,
    times_transpose_upper_add,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.lane_values import all_lanes, any_lane, select
from strapdown.kernels.measurement import direction_rows
from strapdown.kernels.rotation import far_turn, logarithm, quaternion_multiply, right_jacobian, turned, unit
from strapdown.kernels.series import SQUARED_RANGE, fifth, fourth, second, sinc, third
from strapdown.kernels.structure import SHORT_FORM


def transition(phi, dt):
    """Return Φ11 and Φ12 of the error state over a rotation φ = ω dt at constant rate ω (6×6 Φ = [[Φ11, Φ12], [0, I]]).

    ``Φ11 = exp(−[φ])``, ``Φ12 = −dt J_r(φ)``: the exact solution of δθ̇ = −[ω] δθ − δb (Markley & Crassidis 2014, eq. (6.83)).
    """
    x = dot(phi, phi)
    c = second(x)
    return (
        skew_polynomial(1.0, -sinc(x), c, phi),
        skew_polynomial(-dt, dt * c, -dt * third(x), phi),
    )


def process_noise(phi, dt, angle_variance, rate_variance):
    """Return Q11 (symmetric), Q12 and the diagonal of Q22 over a rotation φ = ω dt, exact at constant ω.

    ``angle_variance`` is σ_v² (rad²/s), ``rate_variance`` σ_u² (rad²/s³). With x = |φ|, n = φ/x:
    ``Q11 = σ_v² dt I + σ_u² dt³ {n nᵀ/3 + 2 (x − sin x)/x³ (I − n nᵀ)}``,
    ``Q12 = −σ_u² dt² {I/2 − [φ] (x − sin x)/x³ + [φ]² (x²/2 − 1 + cos x)/x⁴}``, ``Q22 = σ_u² dt I``.
    """
    x = dot(phi, phi)
    t = third(x)
    u = rate_variance * dt
    v = u * dt
    w = v * dt
    g = w * fifth(x)
    d = angle_variance * dt + 2.0 * w * t
    q11 = (
        d + g * (phi[0] * phi[0]),
        g * (phi[0] * phi[1]),
        g * (phi[0] * phi[2]),
        d + g * (phi[1] * phi[1]),
        g * (phi[1] * phi[2]),
        d + g * (phi[2] * phi[2]),
    )
    return q11, skew_polynomial(-0.5 * v, v * t, -v * fourth(x), phi), u


def predict(q, b, A, B, C, delta_theta, dt, angle_variance, rate_variance):
    """Propagate over one gyro increment ``delta_theta`` (rad, the integral of the measured rate over dt).

    Attitude by the exponential of the bias-free increment, equation (17) at constant rate; covariance by ``Φ P Φᵀ + Q``, all exact at
    constant rate. |delta_theta − b dt| must not exceed ``series.LARGEST_ANGLE``.
    """
    phi = combine(1.0, delta_theta, -dt, b)
    phi11, phi12 = transition(phi, dt)
    q11, q12, q22 = process_noise(phi, dt, angle_variance, rate_variance)
    theta_bias = multiply_add(phi11, B, multiply(phi12, full(C)))
    theta_theta = multiply_add(phi11, full(A), multiply(phi12, transpose(B)))
    return (
        turned(q, phi),
        times_transpose_upper_add(theta_theta, phi11, times_transpose_upper_add(theta_bias, phi12, q11)),
        add_matrices(theta_bias, q12),
        add_to_diagonal(C, q22),
    )


def select_parts(condition, a, b):
    """Return the tuple a in lanes in which the condition holds, b in the others."""
    return tuple(select(condition, x, y) for x, y in zip(a, b, strict=True))


def update_row(b, A, B, C, h, innovation, variance):
    """Update with one scalar row ``innovation = h · δθ + v``, Var v = ``variance``.

    Returns the attitude correction, b, A, B, C and the innovation's variance. Joseph's form, written as the short form with a correction by
    ``d = (P − k p) h − r k``, its rounding error: it keeps P positive definite if the measurement is much more precise than the prior
    (Bierman 1977, ch. V), and is left out otherwise.
    """
    pa = symmetric_times_vector(A, h)
    pb = transpose_times_vector(B, h)
    s = dot(h, pa) + variance
    inverse = 1.0 / s
    ka = scale(inverse, pa)
    kb = scale(inverse, pb)
    A = symmetric_minus_outer(A, ka, pa)
    B = minus_outer(B, ka, pb)
    precise = s > SHORT_FORM * variance
    if any_lane(precise):
        d = combine(1.0, symmetric_times_vector(A, h), -variance, ka)
        A = select_parts(precise, symmetric_minus_outer(A, d, ka), A)
        B = select_parts(precise, minus_outer(B, d, kb), B)
    return (
        scale(innovation, ka),
        combine(1.0, b, innovation, kb),
        A,
        B,
        symmetric_minus_outer(C, kb, pb),
        s,
    )


def turned_by(q, correction):
    """Return q ⊗ exp(φ) and J_r(φ) of a correction of any size, one after the other."""
    moved = turned(q, correction)
    G = right_jacobian(correction)
    large = dot(correction, correction) > SQUARED_RANGE
    if any_lane(large):
        far, J = far_turn(correction)
        moved = select_parts(large, unit(quaternion_multiply(q, far)), moved)
        G = select_parts(large, J, G)
    return moved + G


def reset(q, A, B, correction):
    """Correct the attitude and transform the covariance to the new tangent space by G = J_r(correction).

    ``A ← G A Gᵀ``, ``B ← G B`` (conventions of :mod:`strapdown`; Markley & Crassidis 2014, section 6.2.1). Without this the filter is
    conservative or optimistic by second-order terms, and differs from the filter with the error in fixed axes.
    """
    both = turned_by(q, correction)
    moved, G = both[:4], both[4:]
    return moved, congruent(G, A), multiply(G, B)


def rows_at_once(b, A, B, C, pa1, pa2, h1, e1, h2, y2, S):
    """Update with two rows of innovation covariance S (s1, s12, s22) at once, so that the divisions are independent.

    Returns the correction, b, A, B, C, the second innovation decorrelated from the first with its variance, and the NIS.
    """
    s1, s12, s22 = S
    determinant = s1 * s22 - s12 * s12
    inverse1 = 1.0 / s1
    inverse = 1.0 / determinant
    share = inverse1 * s12
    e2 = y2 - share * e1
    pa2 = combine(1.0, pa2, -share, pa1)
    pb1 = transpose_times_vector(B, h1)
    pb2 = combine(1.0, transpose_times_vector(B, h2), -share, pb1)
    # The correction is on the critical path: it is computed directly from the divisions, not through the gains.
    g1 = inverse1 * e1
    g2 = inverse * (s1 * e2)
    correction = combine(g1, pa1, g2, pa2)
    b = add(b, combine(g1, pb1, g2, pb2))
    inverse2 = inverse * s1
    ka1, ka2 = scale(inverse1, pa1), scale(inverse2, pa2)
    kb1, kb2 = scale(inverse1, pb1), scale(inverse2, pb2)
    A = symmetric_minus_outer(symmetric_minus_outer(A, ka1, pa1), ka2, pa2)
    B = minus_outer(minus_outer(B, ka1, pb1), ka2, pb2)
    C = symmetric_minus_outer(symmetric_minus_outer(C, kb1, pb1), kb2, pb2)
    return correction, b, A, B, C, e2, inverse1 * determinant, g1 * e1 + g2 * e2


def row_after_row(b, A, B, C, h1, e1, h2, y2, variance):
    """Update with two rows in sequence by :func:`update_row`; return the same as :func:`rows_at_once`."""
    first, b, A, B, C, s1 = update_row(b, A, B, C, h1, e1, variance)
    e2 = y2 - dot(h2, first)  # the second innovation is reduced by the correction of the first
    second, b, A, B, C, s2 = update_row(b, A, B, C, h2, e2, variance)
    return add(first, second), b, A, B, C, e2, s2, e1 * e1 / s1 + e2 * e2 / s2


def update_direction(q, b, A, B, C, R, u, v, z, variance):
    """Update with a unit direction, two degrees of freedom; return (q, b, A, B, C), both innovations with their variances, and the NIS.

    ``R`` is the matrix of q, ``variance`` that of each component, rad². The innovations are independent: the NIS is e₁²/s₁ + e₂²/s₂.
    """
    h1, e1, h2, y2 = direction_rows(R, u, v, z)
    pa1 = symmetric_times_vector(A, h1)
    pa2 = symmetric_times_vector(A, h2)
    s1 = dot(h1, pa1) + variance
    s12 = dot(h1, pa2)
    s22 = dot(h2, pa2) + variance
    together = s1 + s22 < SHORT_FORM * variance
    if all_lanes(together):
        correction, b, A, B, C, e2, s2, nis = rows_at_once(b, A, B, C, pa1, pa2, h1, e1, h2, y2, (s1, s12, s22))
    elif any_lane(together):
        at_once = rows_at_once(b, A, B, C, pa1, pa2, h1, e1, h2, y2, (s1, s12, s22))
        one_by_one = row_after_row(b, A, B, C, h1, e1, h2, y2, variance)
        correction = select_parts(together, at_once[0], one_by_one[0])
        b = select_parts(together, at_once[1], one_by_one[1])
        A = select_parts(together, at_once[2], one_by_one[2])
        B = select_parts(together, at_once[3], one_by_one[3])
        C = select_parts(together, at_once[4], one_by_one[4])
        e2, s2, nis = select_parts(together, at_once[5:], one_by_one[5:])
    else:
        correction, b, A, B, C, e2, s2, nis = row_after_row(b, A, B, C, h1, e1, h2, y2, variance)
    q, A, B = reset(q, A, B, correction)
    return q, b, A, B, C, e1, s1, e2, s2, nis


def update_residual(q, b, A, B, C, y, variance):
    """Update with a measured error ``y`` of the attitude itself (3,), rad, body axes, of ``variance`` (3,) about the body axes, rad²."""
    first, b, A, B, C, s1 = update_row(b, A, B, C, (1.0, 0.0, 0.0), y[0], variance[0])
    e2 = y[1] - first[1]
    second, b, A, B, C, s2 = update_row(b, A, B, C, (0.0, 1.0, 0.0), e2, variance[1])
    e3 = y[2] - first[2] - second[2]
    third_part, b, A, B, C, s3 = update_row(b, A, B, C, (0.0, 0.0, 1.0), e3, variance[2])
    q, A, B = reset(q, A, B, add(first, add(second, third_part)))
    return q, b, A, B, C, y[0], s1, e2, s2, e3, s3


def update_attitude(q, b, A, B, C, measured, variance):
    """Update with a measured attitude q_fb: three degrees of freedom, ``variance`` (3,) about the body axes, rad².

    The residual is Log(q⁻¹ ⊗ measured), a measurement of the error state. Scalar only: lanes use
    :func:`strapdown.kernels.lane_angles.rotation_vector` and :func:`update_residual`.
    """
    y = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), measured))
    return update_residual(q, b, A, B, C, y, variance)


def update_heading(q, b, A, B, C, h, error, variance):
    """Update with a heading error (rad, about the fixed z axis, true minus estimated) of row ``h``, one degree of freedom."""
    correction, b, A, B, C, s = update_row(b, A, B, C, h, error, variance)
    q, A, B = reset(q, A, B, correction)
    return q, b, A, B, C, error, s
