"""One measurement of any kind and any noise, tested, weighed and taken in, on tuples.

A measurement comes as three rows ``y = h · δθ + noise`` with one covariance (6-tuple); one with fewer degrees of freedom is filled up by
rows of h = 0, y = 0 and unit variance, which change nothing. The rows are made independent by the exact L D Lᵀ of their covariance.
State and error as in :mod:`strapdown.kernels.filter_step`. Scalar machine only.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    add,
    combine,
    dot,
    full,
    matrix_times_vector,
    minus_outer,
    multiply,
    scale,
    subtract,
    symmetric_times_vector,
    times_transpose_upper,
    transpose,
    transpose_times_vector,
)
from strapdown.kernels.filter_loop import ATTITUDE, DIRECTION, HEADING, VECTOR, heading_error
from strapdown.kernels.filter_step import VERTICAL, direction_rows, heading_row, reset, update_row
from strapdown.kernels.rotation import logarithm, quaternion_multiply, rotation_matrix, unit
from strapdown.kernels.smoother_step import factored, moved, solved

HUBER = 1
"""Kind of weight: 1 within a distance, then falling as its inverse."""
STUDENT = 2
"""Kind of weight: that of Student's t by the variational mean."""
RELINEARIZED = 0.05
"""rad; an iterated update is linearised anew until its correction is smaller."""
SETTLED = 1e-4
"""rad; the same of an attitude that is hardly known: the turn that is not known must stand on the axis that was measured. Off by half the
last correction, a radian about it would pass for that share of a radian across."""

UNKNOWN = 1.0
"""rad²; with more attitude variance than this in all it is hardly known, and an update that fails is tried again from elsewhere."""
KNOWN = 1e-2
"""rad²; with less attitude variance than this in all an iterated update ends as the plain filter's does: both are one to first order."""
UNKNOWN_TILT = 4.0
"""rad²; with more variance of the tilt than this nothing is known of it (one direction leaves at most half of that), and a heading tells
nothing."""
REFUSED = 0
ACCEPTED = 1
PASSED_OVER = 2
ONE_AXIS = 5.0
"""The least certain axis stands alone if its variance is so many times the sum of the others'."""
TURN_ASIDE = 2.0 * math.pi / 3.0
"""rad; how far elsewhere is."""


def measurement_rows(kind, q, R, z, frame, noise):
    """Return (h1, h2, h3, y1, y2, y3, covariance of the rows); ``frame`` the triad of the reference by rows, or a measured quaternion.

    ``noise`` is the covariance in body axes (6-tuple); of a heading its first number is the variance.
    """
    none = (0.0, 0.0, 0.0)
    if kind == ATTITUDE:
        y = logarithm(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), (frame[0], frame[1], frame[2], frame[3])))
        return (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), y[0], y[1], y[2], noise
    if kind == HEADING:
        error = heading_error(R, z, (frame[6], frame[7], frame[8]))
        return heading_row(R, z), none, none, error, 0.0, 0.0, (noise[0], 0.0, 0.0, 1.0, 0.0, 1.0)
    u = (frame[0], frame[1], frame[2])
    v = (frame[3], frame[4], frame[5])
    h1, y1, h2, y2 = direction_rows(R, u, v, z)
    ub = h2
    vb = (-h1[0], -h1[1], -h1[2])
    nu = symmetric_times_vector(noise, ub)
    nv = symmetric_times_vector(noise, vb)
    if kind == VECTOR:
        rb = transpose_times_vector(R, (frame[6], frame[7], frame[8]))
        nr = symmetric_times_vector(noise, rb)
        covariance = (dot(ub, nu), dot(ub, nv), dot(ub, nr), dot(vb, nv), dot(vb, nr), dot(rb, nr))
        return h1, h2, none, y1, y2, dot(rb, z) - 1.0, covariance
    return h1, h2, none, y1, y2, 0.0, (dot(ub, nu), dot(ub, nv), 0.0, dot(vb, nv), 0.0, 1.0)


def independent_rows(h1, h2, h3, y1, y2, y3, noise):
    """Return the rows by L⁻¹ of ``noise = L D Lᵀ`` and the three variances D: exact decorrelation, units kept."""
    l21 = noise[1] / noise[0]
    l31 = noise[2] / noise[0]
    d2 = noise[3] - l21 * noise[1]
    m32 = noise[4] - l21 * noise[2]
    l32 = m32 / d2
    d3 = noise[5] - l31 * noise[2] - l32 * m32
    h2 = combine(1.0, h2, -l21, h1)
    y2 = y2 - l21 * y1
    h3 = combine(1.0, combine(1.0, h3, -l31, h1), -l32, h2)
    y3 = y3 - l31 * y1 - l32 * y2
    return h1, h2, h3, y1, y2, y3, (noise[0], d2, d3)


def innovation_factors(A, h1, h2, h3, variance):
    """Return the factors of S = H P Hᵀ + D (:func:`strapdown.kernels.smoother_step.factored`)."""
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


def robust_weight(kind, parameter, numerator, passes, A, h1, h2, h3, y, variance):
    """Return the weight of a measurement with innovation ``y`` (3,) and independent rows, by iteration from 1.

    With R = D/w and S = H P Hᵀ + R the residual after the update is ``R S⁻¹ y`` and the uncertainty of the estimate in it
    ``H P⁺ Hᵀ = R − R S⁻¹ R``. Huber's ``parameter`` is k²; Student's weight is ``numerator`` over ``parameter`` plus the mean square.
    """
    w = 1.0
    for _ in range(passes):
        r = scale(1.0 / w, variance)
        F = innovation_factors(A, h1, h2, h3, r)
        x = solved(F, y)
        distance = (r[0] * r[0] * x[0] * x[0]) / variance[0]
        distance += (r[1] * r[1] * x[1] * x[1]) / variance[1]
        distance += (r[2] * r[2] * x[2] * x[2]) / variance[2]
        if kind == HUBER:
            w = 1.0
            if distance > parameter:
                w = math.sqrt(parameter / distance)
        else:
            # (S⁻¹)_ii from the factors, S⁻¹ = L⁻ᵀ D⁻¹ L⁻¹
            l20 = F[0] * F[2] - F[1]
            i0 = F[3] + F[0] * F[0] * F[4] + l20 * l20 * F[5]
            i1 = F[4] + F[2] * F[2] * F[5]
            spread = (r[0] - r[0] * r[0] * i0) / variance[0]
            spread += (r[1] - r[1] * r[1] * i1) / variance[1]
            spread += (r[2] - r[2] * r[2] * F[5]) / variance[2]
            w = numerator / (parameter + distance + spread)
    return w


def arc_over_chord(kind, R, z, frame, y1, y2):
    """Return θ/sin θ of the angle θ between a measured and a predicted direction; 1 for other kinds.

    With it the residual of a direction is the angle itself, so that an update from afar neither creeps nor stops at the opposite.
    """
    if kind in (ATTITUDE, HEADING):
        return 1.0
    sine = math.sqrt(y1 * y1 + y2 * y2)
    cosine = dot(transpose_times_vector(R, (frame[6], frame[7], frame[8])), z)
    if sine < 1e-9:
        return 1.0
    return math.atan2(sine, cosine) / sine


def behind(kind, R, z, frame):
    """Return whether a direction lies beyond a right angle from the predicted one, which the rows across it do not see."""
    return kind == DIRECTION and dot(transpose_times_vector(R, (frame[6], frame[7], frame[8])), z) < 0.0


def least_certain_axis(A):
    """Return the unit vector along which a symmetric matrix is largest, near enough: powers of it applied to a vector."""
    v = (0.6, 0.48, 0.64)
    for _ in range(20):
        v = symmetric_times_vector(A, v)
        v = scale(1.0 / math.sqrt(dot(v, v)), v)
    return v


def seen_from(q, A, B):
    """Return A and B of a prior at the attitude that lies the turn q from its mean, and where the mean lies seen from there (3,), rad.

    A Gaussian that knows an axis n far less than the others stands for attitudes ``exp(α n) ⊗ exp(ε)``, ε across n: what one direction has
    shown of the tilt ε, and of the gyro's bias by it, holds in body axes whatever the turn α about it. With ``q = exp(α₀ n) ⊗ exp(ε₀)`` the
    error seen from there is ``exp(−[ε₀]) n (α − α₀) + J_r(ε₀) (ε − ε₀)``: the least certain axis goes the whole way with the reference, and
    no later measurement of that sees anything of the turn about it. Without such an axis it is ``J_r(ε₀) (ε − ε₀)``, ε₀ the rotation vector
    of q. Of J_r the turn alone is taken, ``exp(−[ε₀]/2)``: its stretch would count as knowledge where nothing is known.
    """
    axis = least_certain_axis(A)
    largest = dot(axis, symmetric_times_vector(A, axis))
    turn = 0.0
    tilt = q
    if largest > ONE_AXIS * (A[0] + A[3] + A[5] - largest):
        half = math.atan2(dot(axis, (q[1], q[2], q[3])), q[0])
        c = math.cos(half)
        s = -math.sin(half)
        tilt = quaternion_multiply((c, s * axis[0], s * axis[1], s * axis[2]), q)
        turn = 2.0 * half
        if turn > math.pi:
            turn -= 2.0 * math.pi
        if turn < -math.pi:
            turn += 2.0 * math.pi
    else:
        axis = (0.0, 0.0, 0.0)
    if tilt[0] < 0.0:
        tilt = (-tilt[0], -tilt[1], -tilt[2], -tilt[3])
    M = transpose(rotation_matrix(unit((1.0 + tilt[0], tilt[1], tilt[2], tilt[3]))))
    halfway = matrix_times_vector(M, axis)
    whole = matrix_times_vector(M, halfway)
    back = combine(-turn, whole, -1.0, logarithm(tilt))
    M = minus_outer(M, subtract(halfway, whole), axis)
    return times_transpose_upper(multiply(M, full(A)), M), multiply(M, B), back


def corrected(q, A, B, correction):
    """Return q, A and B moved by a correction (3,), rad, as :func:`seen_from` has it."""
    turn, _ = moved((1.0, 0.0, 0.0, 0.0), correction)
    A, B, _ = seen_from(turn, A, B)
    return quaternion_multiply(q, turn), A, B


def has_heading(R, z):
    """Return whether a vector ``z`` (body) is not vertical (:func:`strapdown.kernels.filter_step.heading_row`)."""
    m = matrix_times_vector(R, z)
    return m[0] * m[0] + m[1] * m[1] > VERTICAL


def tilt_variance(R, A):
    """Return the variance of the turns about the two horizontal fixed axes, rad²."""
    x = (R[0], R[1], R[2])
    y = (R[3], R[4], R[5])
    return dot(x, symmetric_times_vector(A, x)) + dot(y, symmetric_times_vector(A, y))


def take_in(q, b, A, B, C, kind, z, frame, noise, passes, threshold, robust, parameter, numerator, robust_passes):
    """Test a measurement against the state and take it in if its NIS is not above ``threshold``, and a direction not behind.

    With ``passes`` above one the update is linearised anew, up to so many times, at the estimate that it leads to, while its correction
    exceeds ``RELINEARIZED``. The prior goes along, and the covariance in the end, as :func:`seen_from` says. Where that ends above the
    threshold and the attitude is hardly known, it is tried again from a third of a turn to either side about the least certain axis.

    With ``passes`` above one a heading is passed over while the tilt is not known: its row depends on it. That of a vertical vector, which
    shows none, always is, and its innovation is NaN.

    Returns ``ACCEPTED``, ``REFUSED`` or ``PASSED_OVER``, the weight, q, b, A, B, C and e₁, s₁, e₂, s₂, e₃, s₃: independent innovations and
    their variances under the nominal noise, of the last linearisation; where these do not come to rest, of the first. At last the least
    share that the noise has in such a variance where the measurement was taken in: its inverse is what the covariance loses by it.
    """
    now_q, now_A, now_B = q, A, B
    share = 1.0
    tolerance = SETTLED if A[0] + A[3] + A[5] >= UNKNOWN else RELINEARIZED
    prior = (0.0, 0.0, 0.0)  # where the prior's mean lies, seen from the attitude of the linearisation
    R = rotation_matrix(q)
    level = kind != HEADING or has_heading(R, z)
    known = passes == 1 or kind != HEADING or tilt_variance(R, A) <= UNKNOWN_TILT
    first_e = (0.0, 0.0, 0.0)
    first_F = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    done = 1
    trials = 0
    while True:
        h1, h2, h3, y1, y2, y3, covariance = measurement_rows(kind, now_q, R, z, frame, noise)
        far = 1.0
        if passes > 1:
            far = arc_over_chord(kind, R, z, frame, y1, y2)
        h1, h2, h3, y1, y2, y3, variance = independent_rows(h1, h2, h3, y1, y2, y3, covariance)
        y = (y1 - dot(h1, prior), y2 - dot(h2, prior), y3 - dot(h3, prior))
        F = innovation_factors(now_A, h1, h2, h3, variance)
        e1 = y[0]
        e2 = y[1] - F[0] * e1
        e3 = y[2] - F[1] * e1 - F[2] * e2
        accepted = e1 * e1 * F[3] + e2 * e2 * F[4] + e3 * e3 * F[5] <= threshold
        if threshold < math.inf and behind(kind, R, z, frame):
            accepted = False
        if passes == 1:
            break
        if done == 1 and trials == 0:
            first_e = (e1, e2, e3)
            first_F = F
        x = solved(F, (far * y1 - dot(h1, prior), far * y2 - dot(h2, prior), y[2]))
        back = add(combine(x[0], h1, x[1], h2), scale(x[2], h3))
        step = add(prior, symmetric_times_vector(now_A, back))
        converged = dot(step, step) < tolerance * tolerance
        if converged or done >= passes:
            accepted = accepted and converged
            if accepted or trials == 2 or A[0] + A[3] + A[5] < UNKNOWN:
                if not converged:
                    e1, e2, e3 = first_e
                    F = first_F
                break
            trials += 1
            done = 0
            now_q = q
            step = scale(math.copysign(TURN_ASIDE, trials - 1.5), least_certain_axis(A))
        now_q, _ = moved(now_q, step)
        R = rotation_matrix(now_q)
        now_A, now_B, prior = seen_from(quaternion_multiply((q[0], -q[1], -q[2], -q[3]), now_q), A, B)
        done += 1
    w = 0.0
    outcome = REFUSED
    if not level:
        outcome = PASSED_OVER
        e1 = math.nan
    elif not known:
        outcome = PASSED_OVER
    elif accepted:
        outcome = ACCEPTED
        w = 1.0
        share = min(F[3] * variance[0], F[4] * variance[1], F[5] * variance[2])
        if robust > 0:
            w = robust_weight(robust, parameter, numerator, robust_passes, now_A, h1, h2, h3, y, variance)
            variance = scale(1.0 / w, variance)
        part, b, now_A, now_B, C, _ = update_row(b, now_A, now_B, C, h1, y[0], variance[0])
        taken = part
        part, b, now_A, now_B, C, _ = update_row(b, now_A, now_B, C, h2, y[1] - dot(h2, taken), variance[1])
        taken = add(taken, part)
        part, b, now_A, now_B, C, _ = update_row(b, now_A, now_B, C, h3, y[2] - dot(h3, taken), variance[2])
        correction = add(prior, add(taken, part))
        if passes > 1 and now_A[0] + now_A[3] + now_A[5] > KNOWN:
            q, A, B = corrected(now_q, now_A, now_B, correction)
        else:
            q, A, B = reset(now_q, now_A, now_B, correction)
    return outcome, w, q, b, A, B, C, e1, 1.0 / F[3], e2, 1.0 / F[4], e3, 1.0 / F[5], share
