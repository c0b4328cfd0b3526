"""Rotations on tuples: quaternions (w, x, y, z), rotation vectors, right Jacobians. Conventions as in :mod:`strapdown`.

For small angles (up to ``LARGEST_ANGLE``) the functions are polynomials without branches, for floats or SIMD lanes: :func:`exponential`,
:func:`turned`, :func:`right_jacobian`, :func:`near_inverse_right_jacobian`. For any angle they are scalar: :func:`moved`,
:func:`logarithm`, :func:`inverse_right_jacobian`, :func:`composed`; only :func:`far_turn` accepts lanes too.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import (
    combine_matrices,
    dot,
    multiply,
    scale,
    skew_polynomial,
    square_root,
    transpose,
)
from strapdown.kernels.series import LARGEST_ANGLE, SQUARED_RANGE, cosine, polynomial, second, sinc, third

_ARCSINE = tuple(math.comb(2 * k, k) / (4.0**k * (2 * k + 1)) for k in range(12))
# |B_2k| / (2k)! for k = 1 … 6, with the Bernoulli numbers 1/6, 1/30, 1/42, 1/30, 5/66, 691/2730.
_BERNOULLI = (1.0 / 12.0, 1.0 / 720.0, 1.0 / 30240.0, 1.0 / 1209600.0, 1.0 / 47900160.0, 691.0 / 1307674368000.0)
SHORT = 1e-4
"""Maximum squared angle, rad², of both rotations for which four terms of the series of their composition are exact to rounding."""
_SINE_SQUARED = math.sin(0.5 * LARGEST_ANGLE) ** 2


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

    The factor (3 − |q|²)/2, one Newton step, is applied to the exponential, where it adds no latency. It removes the rounding of the
    previous step (a norm error of 1e-15 falls to 1e-30) and cannot hide a fault: an error of 1e-3 remains visible at 1e-6.
    """
    y = 0.25 * dot(phi, phi)
    n = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    h = 0.5 * n * sinc(y)
    return quaternion_multiply(q, (n * cosine(y), h * phi[0], h * phi[1], h * phi[2]))


def renormalized(q):
    """Return q scaled by (3 − |q|²)/2, the Newton step of :func:`turned`."""
    n = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (n * q[0], n * q[1], n * q[2], n * q[3])


def unit(q):
    """Return q over its norm."""
    n = 1.0 / square_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (n * q[0], n * q[1], n * q[2], n * q[3])


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


def far_turn(phi):
    """Return exp(φ) and J_r(φ) of a rotation beyond the range of the polynomials, from a 64th of it by doubling.

    ``J_r(2φ) = ½ (I + exp(−[φ])) J_r(φ)``. Exact to rounding up to 20 rad. A correction of more than half a rotation occurs only if the
    filter has diverged, but its Jacobian must still have a norm of at most one for the covariance to stay finite.
    """
    part = scale(0.015625, phi)
    q = exponential(part)
    J = right_jacobian(part)
    for _ in range(6):
        E = transpose(rotation_matrix(q))
        J = combine_matrices(0.5, J, 0.5, multiply(E, J))
        q = quaternion_multiply(q, q)
    return q, J


def arcsine(x):
    """Return asin s / s at s = √x, x ≤ sin²(``LARGEST_ANGLE``/2)."""
    xxx = x * x * x
    return polynomial(x, *_ARCSINE[:6]) + xxx * xxx * polynomial(x, *_ARCSINE[6:])


def arcsine_series(x):
    """Return 2 asin s / s at s = √x to the fourth term: exact to rounding for x ≤ ``SHORT``."""
    _, a1, a2, a3 = _ARCSINE[:4]
    return (2.0 + 2.0 * a1 * x) + (x * x) * (2.0 * a2 + 2.0 * a3 * x)


def logarithm(q):
    """Return the rotation vector of a unit quaternion, of any angle, as the shorter rotation."""
    v = (q[1], q[2], q[3])
    x = dot(v, v)
    if x <= _SINE_SQUARED:
        half = arcsine(x)
    else:
        s = math.sqrt(x)
        half = math.atan2(s, abs(q[0])) / s
    return scale(math.copysign(2.0 * half, q[0]), v)


def near_inverse_right_jacobian(phi):
    """Return :func:`inverse_right_jacobian` for θ ≤ ``LARGEST_ANGLE``, for floats or lanes."""
    return skew_polynomial(1.0, 0.5, polynomial(dot(phi, phi), *_BERNOULLI), phi)


def inverse_right_jacobian(phi):
    """Return ``J_r(φ)⁻¹ = I + ½ [φ] + (1 − (θ/2) cot(θ/2))/θ² [φ]²``, θ = |φ| ≤ π."""
    x = dot(phi, phi)
    if x <= SQUARED_RANGE:
        return near_inverse_right_jacobian(phi)
    half = 0.5 * math.sqrt(x)
    return skew_polynomial(1.0, 0.5, (1.0 - half / math.tan(half)) / x, phi)


def moved(q, phi):
    """Return q ⊗ exp(φ) and J_r(φ) for any angle: a correction of an attitude and of its tangent space."""
    x = dot(phi, phi)
    if x <= SQUARED_RANGE:
        return turned(q, phi), right_jacobian(phi)
    theta = math.sqrt(x)
    s = math.sin(0.5 * theta)
    q = quaternion_multiply(q, (math.cos(0.5 * theta), s / theta * phi[0], s / theta * phi[1], s / theta * phi[2]))
    return q, skew_polynomial(1.0, -2.0 * s * s / x, (theta - math.sin(theta)) / (theta * x), phi)


def composed(r, phi):
    """Return the rotation vector of r ⊗ exp(φ), r a unit quaternion, any angles."""
    u = (
        r[0] * phi[0] + (r[2] * phi[2] - r[3] * phi[1]),
        r[0] * phi[1] + (r[3] * phi[0] - r[1] * phi[2]),
        r[0] * phi[2] + (r[1] * phi[1] - r[2] * phi[0]),
    )
    x = dot(phi, phi)
    if x <= SQUARED_RANGE:
        c = cosine(0.25 * x)
        h = 0.5 * sinc(0.25 * x)
    else:
        theta = math.sqrt(x)
        c = math.cos(0.5 * theta)
        h = math.sin(0.5 * theta) / theta
    w = r[1] * phi[0] + r[2] * phi[1] + r[3] * phi[2]
    return logarithm((c * r[0] - h * w, c * r[1] + h * u[0], c * r[2] + h * u[1], c * r[3] + h * u[2]))
