"""Pieces of an update that is tested, weighed and iterated, on tuples; :mod:`strapdown.kernels.gate` puts them together.

State and error as in :mod:`strapdown.kernels.filter_step`. Scalar machine only.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    combine,
    dot,
    factored,
    matrix_times_vector,
    minus_outer,
    scale,
    solved,
    subtract,
    symmetric_times_vector,
    transpose,
)
from strapdown.kernels.rotation import logarithm, moved, quaternion_multiply, rotation_matrix, unit

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
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


def robust_weight(kind, parameter, numerator, passes, S, y, variance):
    """Return the weight of a measurement with innovation ``y`` (3,) and independent rows, by iteration from 1.

    ``S`` is H P Hᵀ (6-tuple), ``variance`` (3,) the rows' own. With R = D/w the residual after the update is ``R (S + R)⁻¹ y`` and the
    uncertainty of the estimate in it ``H P⁺ Hᵀ = R − R (S + R)⁻¹ R``. Huber's ``parameter`` is k²; Student's weight is ``numerator`` over
    ``parameter`` plus the mean square.
    """
    w = 1.0
    for _ in range(passes):
        r = scale(1.0 / w, variance)
        F = factored((S[0] + r[0], S[1], S[2], S[3] + r[1], S[4], S[5] + r[2]))
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


def arc_over_chord(sine, along):
    """Return θ/sin θ of the angle θ between a measured and a predicted direction, of its sine and cosine times the length.

    With it the residual of a direction is the angle itself, so that an update from afar neither creeps nor stops at the opposite.
    """
    return 1.0 if sine < 1e-9 else math.atan2(sine, along) / sine


def least_certain_axis(A):
    """Return the unit vector along which a symmetric matrix is largest, near enough: powers of it applied to a vector."""
    v = (0.6, 0.48, 0.64)
    for _ in range(20):
        v = symmetric_times_vector(A, v)
        v = scale(1.0 / math.sqrt(dot(v, v)), v)
    return v


def tangent_at(q, A):
    """Return M, which carries a prior's attitude error to the attitude the turn q away, and where the mean lies from there.

    A Gaussian that knows an axis n far less than the others stands for attitudes ``exp(α n) ⊗ exp(ε)``, ε across n: what one direction has
    shown of the tilt ε, and of the gyro's bias by it, holds in body axes whatever the turn α about it. With ``q = exp(α₀ n) ⊗ exp(ε₀)`` the
    error seen from there is ``exp(−[ε₀]) n (α − α₀) + J_r(ε₀) (ε − ε₀)``: the least certain axis goes the whole way with the reference, and
    no later measurement of that sees anything of the turn about it. Without such an axis it is ``J_r(ε₀) (ε − ε₀)``, ε₀ the rotation vector
    of q. Of J_r the turn alone is used, ``exp(−[ε₀]/2)``: its stretch would count as knowledge where nothing is known.

    ``A`` is the covariance of the attitude; the mean (3,) is in rad.
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
    return minus_outer(M, subtract(halfway, whole), axis), back


def seen_from(correction, A):
    """Return the turn q of a correction (3,), rad, and M of :func:`tangent_at` for it."""
    turn, _ = moved((1.0, 0.0, 0.0, 0.0), correction)
    M, _ = tangent_at(turn, A)
    return turn, M


def tilt_variance(R, A):
    """Return the variance of the turns about the two horizontal fixed axes, rad²."""
    x = (R[0], R[1], R[2])
    y = (R[3], R[4], R[5])
    return dot(x, symmetric_times_vector(A, x)) + dot(y, symmetric_times_vector(A, y))
