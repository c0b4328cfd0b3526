"""Functions for a gated, robust and iterated update, on tuples; :mod:`strapdown.kernels.gate` combines them.

State and error as in :mod:`strapdown.kernels.filter_step`. Scalar only.
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
"""Huber's weight: 1 up to a threshold of the residual, then inversely proportional to it."""
STUDENT = 2
"""Weight of Student's t distribution, variational mean."""
RELINEARIZED = 0.05
"""Tolerance of an iterated update, rad: it is relinearised until the correction is smaller."""
MIN_CORRECTION_UNKNOWN = 1e-4
"""The same for a nearly unknown attitude, rad. The unknown rotation must stay about the measured axis: an axis in error by half the last
correction would let an uncertainty of a radian about it appear as that fraction of a radian across it."""

UNKNOWN = 1.0
"""Trace of the attitude covariance, rad², above which the attitude is nearly unknown; a failed update is then tried from another start."""
KNOWN = 1e-2
"""Trace of the attitude covariance, rad², below which an iterated update ends like that of the plain filter, equal to first order."""
UNKNOWN_TILT = 4.0
"""Variance of the tilt, rad², above which it is unknown (after one direction it is at most half of this), and headings are not used."""
REFUSED = 0
ACCEPTED = 1
PASSED_OVER = 2
ONE_AXIS = 5.0
"""Ratio of the largest variance to the sum of the other two above which the least certain axis is treated separately."""
TURN_ASIDE = 2.0 * math.pi / 3.0
"""Rotation about the least certain axis of a repeated update, rad."""


def robust_weight(kind, parameter, numerator, passes, S, y, variance):
    """Return the weight of a measurement with innovation ``y`` (3,) and independent rows, by iteration from 1.

    ``S`` is H P Hᵀ (6-tuple), ``variance`` (3,) that of the measurement noise, the diagonal of D. With R = D/w the residual after the
    update is ``R (S + R)⁻¹ y`` and its part of the estimate's covariance ``H P⁺ Hᵀ = R − R (S + R)⁻¹ R``. Huber's ``parameter`` is k²;
    Student's weight is ``numerator`` over the sum of ``parameter`` and the mean square.
    """
    w = 1.0
    for _ in range(passes):
        r = scale(1.0 / w, variance)
        F = factored(with_noise(S, r))
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


def with_noise(S, variance):
    """Return an innovation covariance, upper triangle (6,), with the noise of its rows added."""
    return S[0] + variance[0], S[1], S[2], S[3] + variance[1], S[4], S[5] + variance[2]


def arc_over_chord(sine, along):
    """Return θ/sin θ for the angle θ between a measured and a predicted direction, from its sine and cosine times the length.

    With this factor the residual of a direction is the angle, so an iteration from a large error converges quickly and not at 180°.
    """
    return 1.0 if sine < 1e-9 else math.atan2(sine, along) / sine


def least_certain_axis(A):
    """Return the eigenvector of the largest eigenvalue of a symmetric matrix, approximately, by power iteration."""
    v = (0.6, 0.48, 0.64)
    for _ in range(20):
        v = symmetric_times_vector(A, v)
        v = scale(1.0 / math.sqrt(dot(v, v)), v)
    return v


def tangent_at(q, A):
    """Return M, which transforms a prior's attitude error to the tangent space at a rotation q from it, and the prior mean there (3,), rad.

    A Gaussian whose variance about one axis n is much larger than about the others represents attitudes ``exp(α n) ⊗ exp(ε)``, ε ⊥ n: one
    measured direction determines the tilt ε, and through it the gyro bias, in body axes, independently of the rotation α about it. With
    ``q = exp(α₀ n) ⊗ exp(ε₀)`` the error at q is ``exp(−[ε₀]) n (α − α₀) + J_r(ε₀) (ε − ε₀)``: the least certain axis follows the reference
    exactly, so no later measurement of that reference gains information about the rotation about it. Without such an axis the error is
    ``J_r(ε₀) (ε − ε₀)``, ε₀ the rotation vector of q. Only the rotation ``exp(−[ε₀]/2)`` of J_r is used: its scaling would appear as
    information.

    ``A`` is the covariance of the attitude.
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


def tangent_after(correction, A):
    """Return the quaternion of a correction (3,), rad, and its M of :func:`tangent_at`."""
    turn, _ = moved((1.0, 0.0, 0.0, 0.0), correction)
    M, _ = tangent_at(turn, A)
    return turn, M


def tilt_variance(R, A):
    """Return the sum of the variances of the rotations about the two horizontal fixed axes, rad²."""
    x = (R[0], R[1], R[2])
    y = (R[3], R[4], R[5])
    return dot(x, symmetric_times_vector(A, x)) + dot(y, symmetric_times_vector(A, y))
