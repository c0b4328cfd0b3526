"""Rotations on tuples: quaternions (w, x, y, z), rotation vectors, the right Jacobian. Conventions as in :mod:`strapdown`."""

from __future__ import annotations

import math

from strapdown.kernels.algebra import dot, skew_polynomial, square_root
from strapdown.kernels.series import cosine, second, sinc, third


def quaternion_multiply(p, q):
    """Return the Hamilton product p ⊗ q."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def exponential(phi):
    """Return the unit quaternion exp(φ) = (cos θ/2, φ/θ sin θ/2), θ = |φ| ≤ ``LARGEST_ANGLE``."""
    y = 0.25 * dot(phi, phi)
    h = 0.5 * sinc(y)
    return (cosine(y), h * phi[0], h * phi[1], h * phi[2])


def turned(q, phi):
    """Return q ⊗ exp(φ), with the norm of q brought back to one: equation (17) over a step at constant rate.

    The factor (3 − |q|²)/2, one Newton step, goes into the exponential, where it costs no latency. It removes the rounding of the step
    before (a norm error of 1e-15 falls to 1e-30) and cannot hide a fault: an error of 1e-3 stays visible at 1e-6.
    """
    y = 0.25 * dot(phi, phi)
    n = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    h = 0.5 * n * sinc(y)
    return quaternion_multiply(q, (n * cosine(y), h * phi[0], h * phi[1], h * phi[2]))


def renormalized(q):
    """Return q scaled by (3 − |q|²)/2, the Newton step of :func:`turned` on its own."""
    n = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (n * q[0], n * q[1], n * q[2], n * q[3])


def unit(q):
    """Return q over its norm."""
    n = 1.0 / square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (n * q[0], n * q[1], n * q[2], n * q[3])


def logarithm(q):
    """Return the rotation vector of a unit quaternion, the shorter way round. Scalar machine only."""
    sine = square_root(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    # Below that its square would underflow, and the angle is twice the vector part.
    factor = 2.0 if sine < 1e-150 else 2.0 * math.atan2(sine, abs(q[0])) / sine
    if q[0] < 0.0:
        factor = -factor
    return (factor * q[1], factor * q[2], factor * q[3])


def rotation_matrix(q):
    """Return the matrix R_fb of a unit quaternion q_fb: v_f = R_fb v_b."""
    dx = 2.0 * q[1]
    dy = 2.0 * q[2]
    dz = 2.0 * q[3]
    xx = dx * q[1]
    yy = dy * q[2]
    zz = dz * q[3]
    xy = dx * q[2]
    xz = dx * q[3]
    yz = dy * q[3]
    wx = dx * q[0]
    wy = dy * q[0]
    wz = dz * q[0]
    return (
        1.0 - (yy + zz),
        xy - wz,
        xz + wy,
        xy + wz,
        1.0 - (xx + zz),
        yz - wx,
        xz - wy,
        yz + wx,
        1.0 - (xx + yy),
    )


def right_jacobian(phi):
    """Return J_r(φ) = I − (1 − cos θ)/θ² [φ] + (θ − sin θ)/θ³ [φ]²: exp(φ + δ) = exp(φ) ⊗ exp(J_r(φ) δ) to first order."""
    x = dot(phi, phi)
    return skew_polynomial(1.0, -second(x), third(x), phi)
