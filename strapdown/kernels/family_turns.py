"""Turns of any size on tuples: exponential, right Jacobian, transition and process noise that stay exact where the polynomials end.

The polynomials of :mod:`strapdown.kernels.series` are made for gyro increments. A filter that starts far off meets larger turns: a
correction of radians, or a step whose bias, wrong for a while, turns the body several times. Polynomials run away there, and what should
be a rotation no longer is: covariances grow without bound until nothing is finite. Closed forms are rotations at any angle; below
``LARGEST_ANGLE``, where they would lose their digits, the polynomials serve.

:func:`strapdown.kernels.filter_step.far_turn` has exponential and Jacobian of such a turn too, for lanes, which have neither sines nor
branches: by doubling, to 20 rad. Noise over a step wants more coefficients than those, and at any angle.
"""

from __future__ import annotations

import math

from strapdown.kernels.algebra import dot, skew_polynomial
from strapdown.kernels.rotation import quaternion_multiply, unit
from strapdown.kernels.series import LARGEST_ANGLE, cosine, fifth, fourth, second, sinc, third

LARGEST_SQUARED = LARGEST_ANGLE * LARGEST_ANGLE


def turn_coefficients(x):
    """Return sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³, (θ²/2 − 1 + cos θ)/θ⁴ and (1/3 − 2(θ − sin θ)/θ³)/θ² at θ = √x of any size."""
    if x <= LARGEST_SQUARED:
        return sinc(x), second(x), third(x), fourth(x), fifth(x)
    angle = math.sqrt(x)
    s = math.sin(angle) / angle
    half = math.sin(0.5 * angle)
    c = 2.0 * half * half / x
    t = (1.0 - s) / x
    return s, c, t, (0.5 - c) / x, (1.0 / 3.0 - 2.0 * t) / x


def exponential_of_any_turn(phi):
    """Return the unit quaternion exp(φ)."""
    y = 0.25 * dot(phi, phi)
    if y <= LARGEST_SQUARED:
        w, h = cosine(y), 0.5 * sinc(y)
    else:
        half = math.sqrt(y)
        w, h = math.cos(half), 0.5 * math.sin(half) / half
    return (w, h * phi[0], h * phi[1], h * phi[2])


def turned_by_any(q, phi):
    """Return q ⊗ exp(φ), of norm one."""
    return unit(quaternion_multiply(q, exponential_of_any_turn(phi)))


def right_jacobian_of_any_turn(phi):
    """Return J_r(φ), whose norm is never above one."""
    _, c, t, _, _ = turn_coefficients(dot(phi, phi))
    return skew_polynomial(1.0, -c, t, phi)


def transition_over_any_turn(phi, dt):
    """Return Φ11 = exp(−[φ]) and Φ12 = −dt J_r(φ), as :func:`strapdown.kernels.filter_step.transition`."""
    s, c, t, _, _ = turn_coefficients(dot(phi, phi))
    return skew_polynomial(1.0, -s, c, phi), skew_polynomial(-dt, dt * c, -dt * t, phi)


def process_noise_over_any_turn(phi, dt, angle_variance, rate_variance):
    """Return Q11, Q12 and the diagonal of Q22, as :func:`strapdown.kernels.filter_step.process_noise`."""
    _, _, t, f, g = turn_coefficients(dot(phi, phi))
    u = rate_variance * dt
    v = u * dt
    w = v * dt
    g = w * g
    d = angle_variance * dt + 2.0 * w * t
    q11 = (
        d + g * (phi[0] * phi[0]),
        g * (phi[0] * phi[1]),
        g * (phi[0] * phi[2]),
        d + g * (phi[1] * phi[1]),
        g * (phi[1] * phi[2]),
        d + g * (phi[2] * phi[2]),
    )
    return q11, skew_polynomial(-0.5 * v, v * t, -v * f, phi), u
